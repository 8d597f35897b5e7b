"""Secure aggregation: only the sum of all can be read, also where clients drop out; with the codec of the handlers."""

import contextlib
import secrets
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from appliance.errors import PayloadError, RefusedError
from appliance.learn import secagg
from appliance.learn.secagg import Holder, MissingSharesError
from appliance.model.learn_api import Revealed
from appliance.model.learning import Cohort
from appliance.skills._lib.learning import aggregation, masks, shards
from appliance.skills._lib.learning.aggregation import Aggregator
from appliance.skills._lib.learning.masks import Masked, Seed
from appliance.skills._lib.learning.orders import Rule
from appliance.skills._lib.learning.shards import Spec

Arrays = dict[str, NDArray[np.float32]]
SHAPES = {"conv.weight": (8, 1, 3, 3), "head.weight": (300, 70), "head.bias": (300,)}


def cohort(count: int, gateways: int = 4) -> tuple[Cohort, dict[str, Holder]]:
    """So many clients with keys and shares, in turn at so many gateways."""
    epoch = secrets.token_hex(8)
    holders = {f"gw-{number}": Holder(f"gw-{number}") for number in range(gateways)}
    keys = [
        key
        for number, holder in enumerate(holders.values())
        for key in holder.advertise(epoch, [f"c{client:02d}" for client in range(number, count, gateways)])
    ]
    made = Cohort(epoch=epoch, clients=tuple(keys))
    sealed = [each for holder in holders.values() for each in holder.share(made)]
    assert sum(holder.hold(made, sealed) for holder in holders.values()) == count
    return made, holders


def masks_of(made: Cohort, holders: Mapping[str, Holder]) -> dict[str, list[Seed]]:
    """The masks of each client, as its gateway gives them to its container."""
    return {each.client: holders[each.gateway].masks(made.epoch, each.client) for each in made.clients}


def updates(count: int, seed: int = 1) -> dict[str, tuple[Arrays, int]]:
    """What so many clients' training changed, and their samples."""
    chance = np.random.default_rng(seed)
    return {
        f"c{client:02d}": (
            {name: chance.normal(0, 0.1, shape).astype(np.float32) for name, shape in SHAPES.items()},
            int(chance.integers(1, 500)),
        )
        for client in range(count)
    }


def sent(client: str, values: Arrays, samples: int, seeds: list[Seed], *, shard_bytes: int = 1 << 16) -> Masked:
    """A masked update as it leaves a container, in files of the handlers' codec."""
    files = list(shards.split(masks.masked(values, samples, seeds), shard_bytes=shard_bytes))
    manifest = shards.parse_manifest(shards.collect(files).to_json())
    return Masked(client, manifest, lambda index: files[index][1], samples)


def layout(shard_bytes: int = 1 << 16) -> tuple[shards.Piece, ...]:
    """Where the values of a masked update lie."""
    return shards.layout([Spec(name, "I64", shape) for name, shape in SHAPES.items()], shard_bytes=shard_bytes)


def plain(given_: Mapping[str, tuple[Arrays, int]], clients: Iterable[str]) -> Arrays:
    """The same updates' mean by the ordinary aggregation, of a model of zeros."""
    found: list[aggregation.Update] = []
    pieces = shards.layout([Spec(name, "F32", shape) for name, shape in SHAPES.items()])
    zeros = {name: np.zeros(shape, dtype=np.float32) for name, shape in SHAPES.items()}
    for client in clients:
        values, samples = given_[client]
        files = list(shards.split(values))
        file = aggregation.File(shards.collect(files), lambda index, files=files: files[index][1])
        found.append(aggregation.Update(client, (file,), samples * 1024))
    kept: dict[int, bytes] = {}
    result = Aggregator(pieces, lambda _: zeros, kept.__setitem__).run(found, Rule("mean", 0.0, 0))
    return shards.join(result.manifest, [kept[index] for index in sorted(kept)])


@pytest.mark.parametrize("gone", [(), ("c03", "c07", "c12")])
def test_the_sum_of_masked_updates_is_that_of_plain_ones(gone: tuple[str, ...]) -> None:
    """16 clients, of which none or 3 drop out after masks were agreed: the model is that of the others, to each bit."""
    made, holders = cohort(16)
    seeds, given_ = masks_of(made, holders), updates(16)
    came = [client for client in sorted(given_) if client not in gone]
    masked_ = [sent(client, *given_[client], seeds[client]) for client in came]
    revealed = [each for holder in holders.values() for each in holder.unmask(made.epoch, came)]
    mean = masks.mean(masked_, layout(), secagg.leftover(made, came, revealed))
    wanted = plain(given_, came)
    for name, values in wanted.items():
        assert np.abs(values - mean[name]).max() <= 1e-4
        assert np.array_equal(values, mean[name])


@given(st.integers(3, 9), st.sets(st.integers(0, 8), max_size=3), st.integers(0, 3), st.integers(3, 4))
@settings(deadline=None, max_examples=25)
def test_any_clients_up_to_the_threshold_may_drop_out(
    count: int, numbers: set[int], silent: int, gateways: int
) -> None:
    """Whoever drops out, and whichever gateways answer: the mean of the rest, or it is said that shares are missing."""
    try:
        made, holders = cohort(count, gateways)
    except RefusedError:
        assert -(-count // gateways) >= secagg.threshold(count)
        return
    seeds, given_ = masks_of(made, holders), updates(count)
    came = sorted(client for client in given_ if int(client[1:]) not in numbers)
    if len(came) < secagg.threshold(count):
        with pytest.raises(RefusedError, match="of the cohort are needed"):
            holders["gw-0"].unmask(made.epoch, came)
        return
    answering = [holder for name, holder in holders.items() if name != f"gw-{silent}"]
    revealed = [each for holder in answering for each in holder.unmask(made.epoch, came)]
    try:
        left = secagg.leftover(made, came, revealed)
    except MissingSharesError:
        held = sum(each.gateway != f"gw-{silent}" for each in made.clients)
        assert held < secagg.threshold(count)
        return
    mean = masks.mean([sent(client, *given_[client], seeds[client]) for client in came], layout(), left)
    assert all(np.array_equal(values, mean[name]) for name, values in plain(given_, came).items())


def test_one_masked_update_says_nothing() -> None:
    """Its numbers are spread over all 64 bits, whatever the update; without the masks of others it is not read."""
    made, holders = cohort(5)
    seeds = masks_of(made, holders)["c00"]
    zeros = {"head.weight": np.full((300, 70), 1e-3, dtype=np.float32)}
    found = masks.masked(zeros, 10, seeds)["head.weight"].astype(np.uint64)
    assert np.unique(found).size == found.size
    for bit in range(64):
        assert np.mean((found >> np.uint64(bit)) & np.uint64(1)) == pytest.approx(0.5, abs=0.03)
    with pytest.raises(ValueError, match="do not cancel"):
        masks.mean([sent("c00", updates(1)["c00"][0], 10, seeds)], layout(), seeds[:1])


def test_shares_are_given_for_one_set_of_clients_only() -> None:
    """Of each client that of its mask or that of its key, never both: else the aggregator could read its update."""
    made, holders = cohort(6, 3)
    names = [each.client for each in made.clients]
    first = holders["gw-0"].unmask(made.epoch, names)
    assert holders["gw-0"].unmask(made.epoch, list(reversed(names))) == first
    with pytest.raises(RefusedError, match="given for other updates"):
        holders["gw-0"].unmask(made.epoch, names[:5])
    with pytest.raises(RefusedError, match="3 updates are summed, 4 of the cohort are needed"):
        holders["gw-1"].unmask(made.epoch, names[:3])
    with pytest.raises(PayloadError, match="no keys of c00"):
        holders["gw-0"].masks(made.epoch, "c00")


def test_fewer_shares_than_the_threshold_say_nothing() -> None:
    """Of a secret among five of which three are needed: two fit any secret, three give it back."""
    secret = secrets.token_bytes(32)
    shares = dict(enumerate(secagg.split(secret, 5, 3), start=1))
    assert secagg.join({x: shares[x] for x in (1, 3, 5)}) == secret
    assert secagg.join({x: shares[x] for x in (2, 3, 4)}) == secret
    # With any other value in the place of the third share another secret follows: the two exclude none.
    third = {"one": secagg.split(secrets.token_bytes(32), 3, 3)[2], "other": secrets.randbelow(secagg.PRIME)}
    for y in third.values():
        with contextlib.suppress(PayloadError):
            assert secagg.join({1: shares[1], 2: shares[2], 3: y}) != secret
    made, holders = cohort(5, 3)
    came = [each.client for each in made.clients]
    with pytest.raises(MissingSharesError, match="2 of 3 shares"):
        secagg.leftover(made, came, holders["gw-0"].unmask(made.epoch, came))


@pytest.mark.parametrize(
    ("count", "gateways", "told"),
    [(2, 2, "at least 3"), (4, 1, "4 of 4 clients are at gw-0"), (5, 2, "3 of 5 clients are at gw-0")],
)
def test_a_cohort_that_hides_nothing_is_refused(count: int, gateways: int, told: str) -> None:
    """Too few clients, or a gateway that has a majority of them: it could work out the others' masks alone."""
    with pytest.raises(RefusedError, match=told):
        cohort(count, gateways)


def test_a_share_that_was_changed_on_its_way_is_refused() -> None:
    """The coordinator passes shares on; it can neither read nor replace them."""
    epoch = "e"
    holders = {name: Holder(name) for name in ("a", "b", "c")}
    made = Cohort(epoch=epoch, clients=tuple(holder.advertise(epoch, [name])[0] for name, holder in holders.items()))
    sealed = holders["a"].share(made)
    for each in sealed:
        data = bytearray.fromhex(each.data)
        data[7] ^= 1
        with pytest.raises(PayloadError, match=f"share of a for {each.to} was changed"):
            holders[each.to].hold(made, [replace(each, data=data.hex())])


def test_keys_are_forgotten_with_a_restart() -> None:
    """A gateway that has begun anew has no masks for its clients: they drop out, and the error says so."""
    made, _ = cohort(4)
    with pytest.raises(PayloadError, match="gw-0 has no keys of c00 for this round"):
        Holder("gw-0").masks(made.epoch, "c00")


@pytest.mark.parametrize(("value", "reason"), [(np.nan, "nan"), (np.inf, "nan"), (65.0, "norm"), (0.0, "zero")])
def test_what_cannot_be_summed_is_refused_where_it_is_masked(value: float, reason: str) -> None:
    """Nobody can look at it later."""
    with pytest.raises(shards.ModelFileError) as refused:
        masks.masked({"a": np.array([0.0, value], dtype=np.float32)}, 3, [])
    assert refused.value.reason == reason


def test_sums_that_may_not_fit_are_refused_beforehand() -> None:
    """1,000 clients of a million samples need 24 + 6 + 10 + 20 bits; of 2^30 samples they would need 70."""
    masks.check_bits(1000, 1_000_000)
    with pytest.raises(ValueError, match="62 are there"):
        masks.check_bits(1000, 1 << 30)


def test_a_client_whose_file_is_not_what_it_announced_is_named() -> None:
    """Nothing is summed then: what is left of the masks would be noise."""
    made, holders = cohort(3, 3)
    seeds, given_ = masks_of(made, holders), updates(3)
    masked_ = [sent(client, *given_[client], seeds[client]) for client in sorted(given_)]
    damaged = masked_[1]._replace(fetch=lambda _: b"something else")
    with pytest.raises(masks.UnreadableError) as refused:
        masks.mean([masked_[0], damaged, masked_[2]], layout(), [])
    assert (refused.value.client, refused.value.reason) == ("c01", "size")
    other = sent("c01", {"head.bias": np.ones(300, dtype=np.float32)}, 3, seeds["c01"])
    with pytest.raises(masks.UnreadableError) as refused:
        masks.mean([masked_[0], other], layout(), [])
    assert (refused.value.client, refused.value.reason) == ("c01", "manifest")


@pytest.mark.parametrize("value", [[["zz", 1]], [["00" * 32, 2]], [["00", 1]], "text", [3]])
def test_seeds_that_are_none_are_refused(value: Any) -> None:
    """They come as JSON."""
    with pytest.raises(ValueError, match=r"mask|hex"):
        masks.read_seeds(value)


def test_revealed_shares_that_do_not_fit_are_refused() -> None:
    """A gateway that gives another's share under a wrong number breaks the sum, and that is seen."""
    made, holders = cohort(4)
    came = [each.client for each in made.clients]
    revealed = [each for holder in holders.values() for each in holder.unmask(made.epoch, came)]
    wrong = [Revealed(of=each.of, x=each.x, y=f"{int(each.y, 16) ^ (each.x << 400):x}") for each in revealed]
    with pytest.raises(PayloadError, match="do not fit together"):
        secagg.leftover(made, came, wrong)
