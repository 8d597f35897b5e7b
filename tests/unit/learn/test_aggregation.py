"""Updates into a model: the order of updates changes nothing, and what is unfit is left out with its reason."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.skills._lib.learning import shards
from appliance.skills._lib.learning.aggregation import Aggregator, File, Result, TooFewError, Update
from appliance.skills._lib.learning.orders import Rule
from appliance.skills._lib.learning.shards import Manifest, Spec

MEAN = Rule("mean", 0.2, 1)
SPECS = (Spec("conv.weight", "F32", (40, 30)), Spec("head.bias", "F32", (7,)))
SMALL = 2500
"""Bytes of a shard in these tests: the first tensor is cut."""
PIECES = shards.layout(SPECS, shard_bytes=SMALL)

Arrays = dict[str, Any]


def arrays(seed: int, size: float = 0.01) -> Arrays:
    """Return the values of an update."""
    rng = np.random.default_rng(seed)
    return {spec.name: (rng.normal(size=spec.shape) * size).astype(np.float32) for spec in SPECS}


def update(
    client: str, values: Arrays, weight: int = 1024, scale: tuple[int, int] = (1, 1), *, shard_bytes: int = SMALL
) -> Update:
    """Return an update as it comes, and count how often each shard is fetched."""
    files = list(shards.split(values, shard_bytes=shard_bytes))
    manifest = shards.collect(files)
    return Update(client, (File(manifest, lambda index: files[index][1]),), weight, scale)


def raw(client: str, values: Arrays) -> Update:
    """Return an update whose values nobody looked at before it was sent."""
    good = update(client, {name: np.zeros_like(each) for name, each in values.items()})
    parts = {piece.key: _part(values, piece) for piece in PIECES}
    files = [shards.encode({piece.key: parts[piece.key] for piece in PIECES if piece.shard == index})
             for index in range(len(good.files[0].manifest.shards))]  # fmt: skip
    manifest = shards.collect(
        [(tuple(p for p in PIECES if p.shard == index), data) for index, data in enumerate(files)]
    )
    return Update(client, (File(manifest, lambda index: files[index]),), 1024)


def _part(values: Arrays, piece: shards.Piece) -> Any:
    rows = 0
    for each in PIECES:
        if each.key == piece.key:
            break
        rows += each.shape[0] if each.name == piece.name else 0
    whole = values[piece.name]
    return whole if piece.cut is None else whole[rows : rows + piece.shape[0]]


def aggregate(
    updates: list[Update], rule: Rule = MEAN, *, clip: float | None = None, noise: float | None = None
) -> tuple[Result, Arrays]:
    """Return the result, and the change of the model as whole arrays: the base is all ones."""
    base = {piece.key: np.ones(piece.shape, dtype=np.float32) for piece in PIECES}
    kept: dict[int, bytes] = {}
    result = Aggregator(PIECES, lambda _: base, kept.__setitem__).run(updates, rule, clip=clip, noise=noise)
    model = shards.join(result.manifest, [kept[index] for index in sorted(kept)])
    return result, {name: values - 1 for name, values in model.items()}


@settings(max_examples=20)
@given(st.permutations(range(5)), st.lists(st.integers(1, 2**20), min_size=5, max_size=5))
def test_order_makes_no_difference(order: list[int], weights: list[int]) -> None:
    """Whatever the order in which updates come, the model has the same digest."""
    updates = [update(f"c{number}", arrays(number), weights[number]) for number in range(5)]
    first, _ = aggregate(updates)
    other, _ = aggregate([updates[number] for number in order])
    assert first.manifest.digest == other.manifest.digest
    assert first.weight == sum(weights)


def test_a_mean_is_weighted_by_samples() -> None:
    """Three parts of one update and one of another, to the precision of the sums."""
    one, two = arrays(1), arrays(2)
    _, change = aggregate([update("a", one, 3072), update("b", two, 1024)])
    for name, values in change.items():
        assert np.allclose(values, 0.75 * one[name] + 0.25 * two[name], atol=3e-7)


def test_partial_work_counts_as_a_whole_epoch() -> None:
    """An update of 2 of 6 steps is scaled by 3, and its norm is compared as such."""
    one, part = arrays(1), {name: each / 3 for name, each in arrays(1).items()}
    whole, _ = aggregate([update("a", one)])
    scaled, change = aggregate([update("a", part, scale=(6, 2))])
    assert scaled.verdicts["a"].norm == pytest.approx(whole.verdicts["a"].norm, rel=1e-5)
    assert np.allclose(change["conv.weight"], one["conv.weight"], atol=3e-7)


@pytest.mark.parametrize("rule", [MEAN, Rule("median", 0, 0), Rule("trimmed", 0.2, 0), Rule("multikrum", 0, 1)])
def test_what_is_unfit_is_left_out(rule: Rule) -> None:
    """NaN, infinity, a norm far beyond the others', zeros: refused with the reason; the model is that of the rest."""
    good = [update(f"c{number}", arrays(number)) for number in range(6)]
    nan, inf = arrays(7), arrays(8)
    nan["head.bias"][3] = np.nan
    inf["conv.weight"][39, 29] = -np.inf
    bad = [
        raw("nan", nan),
        raw("inf", inf),
        update("large", arrays(9, size=10.0)),
        update("zero", {name: np.zeros_like(each) for name, each in arrays(1).items()}),
    ]
    result, _ = aggregate([*bad[:2], *good, *bad[2:]], rule)
    clean, _ = aggregate(good, rule)
    assert result.manifest.digest == clean.manifest.digest
    refused = {client: each.reason for client, each in result.verdicts.items() if client in {b.client for b in bad}}
    assert refused == {"nan": "nan", "inf": "nan", "large": "norm", "zero": "zero"}


def _other(**changes: Any) -> Arrays:
    values = arrays(3)
    for name, value in changes.items():
        values.pop(name.replace("__", "."), None)
        if value is not None:
            values[name.replace("__", ".")] = value
    return values


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (_other(head__bias=np.zeros(8, np.float32)), "shape"),
        (_other(head__bias=None), "missing"),
        (_other(tail__bias=np.zeros(1, np.float32)), "extra"),
        (_other(tail__bias=np.zeros(400, np.float32)), "manifest"),
        (_other(head__bias=np.zeros(7, np.int8)), "dtype"),
        ({f"t{number}": np.ones(1, np.float32) for number in range(3000)}, "manifest"),
    ],
)
def test_another_layout_is_refused(values: Arrays, reason: str) -> None:
    """A shape, name or type that the model does not have is refused before a byte of it is fetched."""

    def never(index: int) -> bytes:
        raise AssertionError(index)

    wrong = update("wrong", values)
    wrong = wrong._replace(files=(wrong.files[0]._replace(fetch=never),))
    result, _ = aggregate([wrong, update("a", arrays(1))])
    assert result.verdicts["wrong"].reason == reason
    assert result.verdicts["a"].accepted


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data: data[:-1], "size"),
        (lambda data: data[:-1] + b"\x01", "digest"),
        (lambda data: b"\x80\x04" + data[2:], "digest"),
        (lambda data: bytes(len(data)), "digest"),
    ],
)
def test_other_bytes_than_announced_are_refused(damage: Callable[[bytes], bytes], reason: str) -> None:
    """A shard that is not the announced one, whatever it is, is refused."""
    files = list(shards.split(arrays(3), shard_bytes=SMALL))
    broken = Update("broken", (File(shards.collect(files), lambda index: damage(files[index][1])),), 1024)
    result, _ = aggregate([broken, update("a", arrays(1))])
    assert result.verdicts["broken"].reason == reason


def test_values_beyond_the_sums_are_left_out_alone() -> None:
    """One of two updates has values that 64 bits cannot add at these weights: the other makes the model."""
    huge = {name: np.full_like(each, 1e9) for name, each in arrays(1).items()}
    result, change = aggregate([update("huge", huge, 1 << 30), update("a", huge, 1)])
    assert result.verdicts["huge"].reason == "overflow"
    assert result.verdicts["a"].accepted
    assert change["head.bias"][0] == pytest.approx(1e9)


@given(st.permutations(range(3)))
def test_parts_of_a_client_are_one_update(order: list[int]) -> None:
    """A share that three have trained counts once, as the sum of what they changed, in whichever order it comes."""
    parts = [arrays(number) for number in range(3)]
    files = tuple(update("a", parts[number]).files[0] for number in order)
    result, change = aggregate([Update("a", files, 2048), update("b", arrays(9), 2048)])
    assert result.weight == 4096
    assert len(result.verdicts) == 2
    for name, values in change.items():
        assert np.allclose(values, 0.5 * sum(part[name] for part in parts) + 0.5 * arrays(9)[name], atol=3e-7)
    other, _ = aggregate([Update("a", tuple(reversed(files)), 2048), update("b", arrays(9), 2048)])
    assert other.manifest.digest == result.manifest.digest


def test_a_client_with_a_bad_part_is_left_out_whole() -> None:
    """Half a share would weigh as a whole one: one part that is not finite refuses all of its client's."""
    nan = arrays(1)
    nan["head.bias"][0] = np.nan
    both = Update("a", (*update("a", arrays(2)).files, *raw("a", nan).files), 1024)
    result, _ = aggregate([both, update("b", arrays(3))])
    assert result.verdicts["a"].reason == "nan"
    assert result.weight == 1024


def test_hostile_updates_do_not_move_robust_rules() -> None:
    """Two of nine with flipped signs: median, trimmed mean and multi-Krum stay near the clean mean."""
    common = arrays(0)
    honest = [
        update(f"c{number}", {name: common[name] + arrays(10 + number, 0.002)[name] for name in common})
        for number in range(7)
    ]
    flipped = {name: -2 * each for name, each in common.items()}
    hostile = [update("x", flipped), update("y", flipped)]
    _, clean = aggregate(honest)

    def distance(rule: Rule) -> float:
        _, change = aggregate([*honest, *hostile], rule)
        return float(np.abs(change["conv.weight"] - clean["conv.weight"]).mean())

    plain = distance(MEAN)
    for rule in (Rule("median", 0, 0), Rule("trimmed", 0.25, 0), Rule("multikrum", 0, 2)):
        assert distance(rule) < plain / 4, rule
    result, _ = aggregate([*honest, *hostile], Rule("multikrum", 0, 2))
    assert result.verdicts["x"].reason == result.verdicts["y"].reason == "krum"


def test_a_clip_shortens_long_updates() -> None:
    """With a clip of half its norm an update moves the model half as far."""
    one = arrays(1)
    result, _ = aggregate([update("a", one)])
    norm = result.verdicts["a"].norm
    assert norm is not None
    _, change = aggregate([update("a", one)], clip=norm / 2)
    assert np.allclose(change["conv.weight"], one["conv.weight"] / 2, atol=3e-7)


@pytest.mark.parametrize(
    ("rule", "told"), [(Rule("multikrum", 0, 1), "needs at least 5 updates"), (Rule("trimmed", 0.6, 0), "trimmed")]
)
def test_too_few_for_a_rule(rule: Rule, told: str) -> None:
    """A rule that needs more updates than are fit says so."""
    with pytest.raises(ValueError, match=told):
        aggregate([update("a", arrays(1)), update("b", arrays(2))], rule)


def test_none_fit() -> None:
    """Where no update is fit, the reasons of all are reported and no model is made."""
    kept: list[int] = []
    aggregator = Aggregator(PIECES, lambda _: {}, lambda index, _: kept.append(index))
    wrong = update("a", {"other": np.ones(3, np.float32)})
    with pytest.raises(ValueError, match="none of 1 updates is fit to be summed: a: "):
        aggregator.run([wrong], MEAN)
    assert not kept


def test_a_mean_holds_few_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """With no room to keep files each shard is fetched twice, once to look at and once to add, and forgotten."""
    from appliance.skills._lib.learning import aggregation  # noqa: PLC0415 - its constant is changed

    monkeypatch.setattr(aggregation, "KEPT_BYTES", 0)
    fetched: list[tuple[str, int]] = []

    def counted(each: Update) -> Update:
        file = each.files[0]

        def fetch(index: int) -> bytes:
            fetched.append((each.client, index))
            return file.fetch(index)

        return each._replace(files=(file._replace(fetch=fetch),))

    updates = [counted(update(f"c{number}", arrays(number))) for number in range(4)]
    result, _ = aggregate(updates)
    count = len(result.manifest.shards)
    assert count > 1
    assert len(fetched) == 2 * 4 * count
    assert Manifest(PIECES, result.manifest.shards).bytes == result.manifest.bytes


@pytest.mark.parametrize("looks", [0, 1, 3])
def test_an_update_whose_files_are_gone_is_left_out(looks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gone at once, or after it was looked at and before it is added: the others make the model alone."""
    from appliance.skills._lib.learning import aggregation  # noqa: PLC0415 - its constant is changed

    monkeypatch.setattr(aggregation, "KEPT_BYTES", 0)
    gone = update("gone", arrays(9))
    file, fetched = gone.files[0], 0

    def fetch(index: int) -> bytes:
        nonlocal fetched
        fetched += 1
        if fetched > looks * len(file.manifest.shards):
            raise shards.ModelFileError("lost", "artifact 1234 is on no gateway that answers")
        return file.fetch(index)

    rest = [update(f"c{number}", arrays(number)) for number in range(3)]
    result, _ = aggregate([gone._replace(files=(file._replace(fetch=fetch),)), *rest])
    if looks < 2:
        assert (result.verdicts["gone"].accepted, result.verdicts["gone"].reason) == (False, "lost")
        assert result.manifest.digest == aggregate(rest)[0].manifest.digest
    else:
        assert result.verdicts["gone"].accepted


def test_too_few_updates_say_how_many_are_needed() -> None:
    """Of two, one of them unfit, multi-Krum with one hostile needs five; the verdict on the unfit one comes with it."""
    wrong = update("wrong", {"other": np.ones(3, np.float32)})
    with pytest.raises(TooFewError) as caught:
        aggregate([update("a", arrays(1)), wrong], Rule("multikrum", 0, 1))
    assert (caught.value.needed, list(caught.value.verdicts)) == (5, ["wrong"])


def test_noise_is_added_once_and_is_another_each_time() -> None:
    """Its deviation is that asked for over the sum of weights; a client far from the others is clipped."""
    plain = arrays(5)
    far = {name: values * np.float32(1000) for name, values in plain.items()}
    updates = [update("a", plain), update("b", plain), update("c", plain), update("d", far)]
    refused, _ = aggregate(updates, clip=0.5)
    assert not refused.verdicts["d"].accepted
    seen: list[Arrays] = []
    for _ in range(2):
        result, changes = aggregate(updates, clip=0.5, noise=3.0 * 1024)
        assert all(verdict.accepted for verdict in result.verdicts.values())
        assert result.bound is None, "JSON has no infinity"
        seen.append(changes)
    noise = np.concatenate([(seen[0][name] - seen[1][name]).reshape(-1) for name in plain])
    assert noise.std() == pytest.approx(3.0 / 4 * math.sqrt(2), rel=0.1)
    assert abs(noise.mean()) < 0.1
