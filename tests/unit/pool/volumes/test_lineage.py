"""Which state of a volume stands: one total order, the same everywhere."""

import itertools

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.plane.records import increment
from appliance.pool.volumes.lineage import Relation, VolumeRecord, generation, read, relation, stronger

VERSIONS = st.dictionaries(st.sampled_from(["a", "b", "c"]), st.integers(1, 4), min_size=1)
WRITERS = st.sampled_from(["a", "b", "c"])
OPPOSITE = {
    Relation.SAME: Relation.SAME,
    Relation.NEWER: Relation.OLDER,
    Relation.OLDER: Relation.NEWER,
    Relation.WINS: Relation.LOSES,
    Relation.LOSES: Relation.WINS,
}


@given(one=VERSIONS, other=VERSIONS, writer=WRITERS, other_writer=WRITERS)
def test_both_sides_agree(one: dict[str, int], other: dict[str, int], writer: str, other_writer: str) -> None:
    """What one gateway finds of two states, the other finds the other way round."""
    found = relation(one, writer, other, other_writer)
    assert relation(other, other_writer, one, writer) is OPPOSITE[found]
    if found is Relation.NEWER:
        assert generation(one) > generation(other)


@given(version=VERSIONS, writer=WRITERS)
def test_a_change_is_newer(version: dict[str, int], writer: str) -> None:
    """A run that changed the volume makes a state that is newer than the one before, by one generation."""
    changed = increment(version, writer)
    assert relation(changed, writer, version, "a") is Relation.NEWER
    assert generation(changed) == generation(version) + 1


@given(values=st.lists(st.tuples(VERSIONS, WRITERS) | st.binary(max_size=5), min_size=1, max_size=4))
def test_records_resolve_alike_in_any_order(values: list[tuple[dict[str, int], str] | bytes]) -> None:
    """Whatever values meet, in whatever order, the same one is left, and a damaged one never against a good one."""
    encoded = [
        each
        if isinstance(each, bytes)
        else msgspec.json.encode(VolumeRecord(name="v", version=each[0], gateway=each[1]))
        for each in values
    ]
    left: set[bytes] = set()
    for order in itertools.permutations(encoded):
        stands = order[0]
        for each in order[1:]:
            stands = stronger(stands, each)
        left.add(stands)
    assert len(left) == 1
    if any(isinstance(each, tuple) for each in values):
        read(left.pop())


def test_more_runs_win_then_the_lower_id() -> None:
    """Three runs on one side stand against two on the other; at a tie the lower gateway id stands."""
    assert relation({"a": 1, "b": 2}, "b", {"a": 2}, "a") is Relation.WINS
    assert relation({"a": 2}, "a", {"a": 1, "b": 1}, "b") is Relation.WINS
    assert relation({"x": 1, "gw-10": 1}, "gw-10", {"x": 1, "gw-1": 1}, "gw-1") is Relation.LOSES


@pytest.mark.parametrize("value", [b"", b"{}", b"\xff", b'{"name":"v","version":{"a":0},"gateway":"a"}', b"[" * 5000])
def test_damaged_records_say_so(value: bytes) -> None:
    """What is no record of a volume is a PayloadError."""
    with pytest.raises(PayloadError):
        read(value)
