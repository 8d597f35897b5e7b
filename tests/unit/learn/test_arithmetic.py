"""Sums, robust rules, coding and seeds of federated learning."""

from itertools import pairwise, permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from appliance.skills._lib.learning import coding, robust, sums
from appliance.skills._lib.learning.seeds import seed
from appliance.skills._lib.learning.shards import ModelFileError, Piece
from appliance.skills._lib.learning.weights import WEIGHT_UNIT, stale_weight

weights = st.integers(1, 10_000 * WEIGHT_UNIT)


def updates(count: int, seeded: int, size: int = 50) -> NDArray[np.float32]:
    """Some updates as training makes them, stacked."""
    return np.random.default_rng(seeded).normal(scale=0.1, size=(count, size)).astype(np.float32)


@given(st.lists(st.tuples(weights, st.integers(1, 40), st.integers(1, 40)), min_size=1, max_size=5), st.integers(0, 99))
@settings(deadline=None, max_examples=40)
def test_the_order_of_updates_makes_no_difference(clients: list[tuple[int, int, int]], seeded: int) -> None:
    """Every order gives the same bits, and they are the weighted mean to 2^-24."""
    stack = updates(len(clients), seeded)
    total = sum(weight for weight, _, _ in clients)
    results: set[bytes] = set()
    for order in list(permutations(range(len(clients))))[:24]:
        mean = sums.FixedSum((50,), total_weight=total)
        for client in order:
            weight, done, of = clients[client]
            mean.add(stack[client], weight, scale=(of, done))
        results.add(mean.mean().tobytes())
    assert len(results) == 1
    exact = sum(
        stack[client].astype(np.float64) * (of / done) * weight / total
        for client, (weight, done, of) in enumerate(clients)
    )
    np.testing.assert_allclose(np.frombuffer(results.pop(), np.float32), exact, atol=2.0**-23, rtol=1e-6)


def test_parts_of_one_client_count_its_weight_once() -> None:
    """Two halves of a client's epoch, each its own delta, add up to that client's update beside another's."""
    one, half_a, half_b = updates(3, 1)
    mean = sums.FixedSum((50,), total_weight=2, added_weight=3)
    for delta in (one, half_a, half_b):
        mean.add(delta, 1)
    np.testing.assert_allclose(mean.mean(), (one + (half_a + half_b)) / 2, atol=1e-6)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_value_that_does_not_fit_changes_nothing(value: float) -> None:
    """It is refused, and the sum goes on with the others."""
    mean = sums.FixedSum((2,), total_weight=20)
    mean.add(np.ones(2, np.float32), 10)
    with pytest.raises(sums.SumOverflowError, match="fits 64 bits"):
        mean.add(np.array([0, value], np.float32), 10)
    mean.add(np.full(2, 3, np.float32), 10)
    assert mean.mean().tolist() == [2.0, 2.0]


@given(st.integers(1, 2**40), st.integers(1, 2**20))
def test_the_largest_values_do_not_overflow(total: int, parts: int) -> None:
    """All clients at the bound at once: the sum is right to the last bit that a float has."""
    parts = min(parts, total)
    largest = 2.0**61 / total / 2**sums.FRACTION_BITS
    mean = sums.FixedSum((1,), total_weight=total)
    for weight in (total - total // parts, total // parts):
        if weight:
            mean.add(np.array([largest], np.float32), weight)
    assert float(mean.mean()[0]) == pytest.approx(largest, rel=1e-6, abs=2.0**-23)


@pytest.mark.parametrize(
    ("values", "weight", "scale"), [((3,), 1, (1, 1)), ((2,), 0, (1, 1)), ((2,), 1, (0, 1)), ((2,), 11, (1, 1))]
)
def test_what_is_no_update_is_refused(values: tuple[int, ...], weight: int, scale: tuple[int, int]) -> None:
    """Another shape, a weight or scale of nothing, more weight than was to come."""
    mean = sums.FixedSum((2,), total_weight=10)
    with pytest.raises(ValueError, match=r"shape|weight"):
        mean.add(np.zeros(values, np.float32), weight, scale=scale)


@given(st.integers(1, 10**9), st.integers(0, 50))
def test_late_updates_weigh_less(samples: int, staleness: int) -> None:
    """Samples / sqrt(1 + staleness), in whole numbers."""
    weight = stale_weight(samples, staleness)
    assert weight == pytest.approx(samples * WEIGHT_UNIT / (1 + staleness) ** 0.5, abs=1)
    assert stale_weight(samples, staleness + 1) <= weight


def test_median_and_trimmed_mean_bear_a_hostile_quarter() -> None:
    """4 of 16 send something enormous: the result stays within what the others sent, the mean does not."""
    stack = updates(16, 2)
    stack[3:7] = 1e6
    for result in (robust.median(stack), robust.trimmed_mean(stack, 0.25)):
        assert np.abs(result).max() < 0.5
    assert np.abs(stack.mean(axis=0)).max() > 1e5


@given(st.integers(1, 9), st.integers(0, 99), st.floats(0, 0.3))
@settings(deadline=None)
def test_rules_give_what_numpy_gives(clients: int, seeded: int, share: float) -> None:
    """Median and trimmed mean against the textbook's definition, of any shape."""
    stack = updates(clients, seeded, 24).reshape(clients, 2, 3, 4)
    ordered = np.sort(stack.astype(np.float64), axis=0)
    cut = int(share * clients)
    np.testing.assert_allclose(robust.median(stack), np.median(stack, axis=0), atol=1e-7)
    np.testing.assert_allclose(robust.trimmed_mean(stack, share), ordered[cut : clients - cut].mean(0), atol=1e-7)
    with pytest.raises(ValueError, match="trimmed"):
        robust.trimmed_mean(stack, 0.5)


def test_multikrum_leaves_out_the_hostile() -> None:
    """Sign flipped and enlarged, noise, zeros: of 16 updates the 4 hostile ones are not chosen, shard by shard."""
    seeded = np.random.default_rng(3)
    stack = (updates(16, 4, 200) * 0.2 + seeded.normal(size=200).astype(np.float32)).astype(np.float32)
    hostile = {2, 5, 11, 14}
    for client, attack in zip(sorted(hostile), (-10, 8, -1, 0), strict=True):
        stack[client] *= attack
    distances = robust.Distances(16)
    for at in range(0, 200, 64):
        distances.add(stack[:, at : at + 64])
    exact = ((stack[:, None, :].astype(np.float64) - stack[None]) ** 2).sum(-1)
    np.testing.assert_allclose(distances.squares, exact, rtol=1e-9, atol=1e-9)
    chosen = robust.multikrum(distances.squares, 4)
    assert len(chosen) == 12
    assert not hostile & set(chosen)


def test_multikrum_needs_enough_updates() -> None:
    """Krum wants n >= 2f + 3, said with both numbers."""
    with pytest.raises(ValueError, match=r"multikrum:4 needs at least 11 updates a round, there are 10"):
        robust.check_krum(10, 4)
    robust.check_krum(11, 4)


@given(st.integers(0, 99), st.integers(1, 30))
@settings(deadline=None, max_examples=30)
def test_what_rounding_loses_comes_with_the_next_update(seeded: int, rounds: int) -> None:
    """The sum of decoded updates differs from the sum of real ones by the last remainder alone: half a step at most."""
    real, told = np.zeros(50), np.zeros(50)
    remainder: NDArray[np.float32] | None = None
    for number, delta in enumerate(updates(rounds, seeded)):
        coded = coding.encode(delta, remainder)
        real += delta
        told += coding.decode(coded.values, coded.scale)
        remainder = coded.remainder
        assert np.abs(remainder).max() <= float(coded.scale[0]) * 0.51, number
    assert remainder is not None
    np.testing.assert_allclose(told + remainder, real, atol=1e-4)


def test_coding_of_a_shard() -> None:
    """Each tensor, or part of one, has its own scale, under a name that no tensor of a model has."""
    pieces = (Piece("w", "F32", (2, 3), 0), Piece("v", "F32", (2,), 0, (1, 2)))
    arrays: dict[str, Any] = {"w": np.arange(6, dtype=np.float32).reshape(2, 3), "v#1": np.zeros(2, np.float32)}
    tensors, remainders = coding.encode_shard(arrays, pieces, {})
    assert [piece.key for piece in coding.coded_pieces(pieces)] == ["w", "w@scale", "v#1", "v@scale#1"]
    assert {piece.key: piece.shape for piece in coding.coded_pieces(pieces)} == {k: t.shape for k, t in tensors.items()}
    back = coding.decode_shard(tensors, pieces)
    for key, array in arrays.items():
        np.testing.assert_allclose(back[key] + remainders[key], array, atol=1e-6)


def test_no_coding_of_nan() -> None:
    """It would become a zero that nobody sees."""
    with pytest.raises(ModelFileError, match="NaN"):
        coding.encode(np.array([1.0, np.nan], np.float32))


def test_packed_files_are_unpacked_to_their_announced_size_only() -> None:
    """A bomb is refused after its announced size, a file that is shorter or goes on too."""
    data = bytes(1000)
    assert coding.inflate(coding.deflate(data), 1000) == data
    bomb = coding.deflate(bytes(64 << 20))
    for packed, size in ((bomb, 1000), (coding.deflate(data), 1001), (coding.deflate(data) + b"x", 1000), (b"no", 9)):
        with pytest.raises(ModelFileError):
            coding.inflate(packed, size)
    with pytest.raises(ModelFileError, match="at most"):
        coding.inflate(bomb, 64 << 20)


def test_each_use_of_chance_has_its_own_seed() -> None:
    """Seeds are fixed: a run that was made once can be made again by any later version."""
    assert seed(7, 3, "robot_1", "shuffle") == 3235283864454871554
    parts = [(7, 3, "robot_1", "shuffle"), (8, 3, "robot_1", "shuffle"), (7, 4, "robot_1", "shuffle")]
    parts += [(7, 3, "robot_2", "shuffle"), (7, 3, "robot_1", "choice")]
    found = sorted(seed(*each) for each in parts)
    assert all(one != other for one, other in pairwise(found))
    assert all(0 <= each < 2**63 for each in found)
    with pytest.raises(ValueError, match="'/'"):
        seed(1, 1, "a/b", "c")
