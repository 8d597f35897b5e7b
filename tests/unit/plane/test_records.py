"""Version vectors and what becomes of records when versions meet."""

import msgspec
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConflictError, PayloadError
from appliance.model.plane_api import Record, Write
from appliance.plane.records import (
    MAX_KEY,
    Behind,
    by_bytes,
    check_key,
    check_record,
    check_write,
    concurrent,
    decide,
    descends,
    digest,
    follows_here,
    increment,
    merge,
    settle,
    summary,
)

versions = st.dictionaries(st.sampled_from(["a", "b", "c"]), st.integers(1, 4), max_size=3)
records = st.builds(
    Record,
    key=st.just("k"),
    value=st.binary(max_size=3),
    version=versions.filter(bool),
    deleted=st.booleans(),
    write=st.sampled_from(["w1", "w2"]),
)


@given(versions, versions)
def test_merge_is_the_smallest_common_descendant(one: dict[str, int], other: dict[str, int]) -> None:
    """The merged version descends from both, and from nothing that neither has seen."""
    both = merge(one, other)
    assert descends(both, one)
    assert descends(both, other)
    assert both == merge(other, one)
    assert all(count in (one.get(name), other.get(name)) for name, count in both.items())


@given(versions, versions)
def test_versions_are_ordered_or_concurrent(one: dict[str, int], other: dict[str, int]) -> None:
    """Exactly one holds: one descends from the other (or equals it), or they are concurrent."""
    assert concurrent(one, other) != (descends(one, other) or descends(other, one))
    if descends(one, other) and descends(other, one):
        assert one == other


@given(versions, st.sampled_from(["a", "b", "c"]))
def test_a_write_moves_on(version: dict[str, int], gateway: str) -> None:
    """The version after a write descends from the one before, and not the other way round."""
    after = increment(version, gateway)
    assert descends(after, version)
    assert not descends(version, after)


@given(records, records)
def test_settling_is_the_same_on_both_sides(one: Record, other: Record) -> None:
    """Two replicas that hear of each other's copy end with equal records."""
    assert settle(one, other, by_bytes) == settle(other, one, by_bytes)


@given(records, records, records)
def test_settling_converges_in_any_order(one: Record, two: Record, three: Record) -> None:
    """Concurrent versions heard in different orders leave the same version, and never one that is older."""
    left = settle(settle(one, two, by_bytes), three, by_bytes)
    right = settle(settle(three, two, by_bytes), one, by_bytes)
    assert left.version == right.version
    assert all(descends(left.version, each.version) for each in (one, two, three))
    # Once the two meet they are equal, whatever each had settled on.
    assert settle(left, right, by_bytes) == settle(right, left, by_bytes)


@given(records)
def test_settling_twice_changes_nothing(record: Record) -> None:
    """A message delivered again does no harm."""
    assert settle(None, record, by_bytes) == record
    assert settle(record, record, by_bytes) == record


def test_the_resolver_is_asked_only_when_versions_are_concurrent() -> None:
    """A newer version stands whatever the resolver would prefer."""

    def refuse(key: str, one: Record, other: Record) -> Record:
        raise AssertionError("not asked")

    old = Record(key="k", value=b"z", version={"a": 1})
    new = Record(key="k", value=b"a", version={"a": 2})
    assert settle(old, new, refuse) == new
    assert settle(new, old, refuse) == new


def test_compare_and_set() -> None:
    """A write stands when its writer saw the present version, and conflicts otherwise."""
    first = decide(None, Write(key="k", value=b"1", write="w1"), "a")
    assert first == Record(key="k", value=b"1", version={"a": 1}, write="w1")
    second = decide(first, Write(key="k", value=b"2", expected={"a": 1}, write="w2"), "b")
    assert second.version == {"a": 1, "b": 1}
    with pytest.raises(ConflictError, match="exists"):
        decide(first, Write(key="k", value=b"3", write="w3"), "a")
    with pytest.raises(ConflictError, match="moved on"):
        decide(second, Write(key="k", value=b"3", expected={"a": 1}, write="w3"), "a")


def test_a_repeated_write_is_done_once() -> None:
    """A writer that lost the answer and asks again finds its own write, not a conflict."""
    asked = Write(key="k", value=b"1", write="w1")
    done = decide(None, asked, "a")
    assert decide(done, asked, "b") is done


def test_a_removed_record_can_be_made_again() -> None:
    """A tombstone counts as absent, and what follows descends from it."""
    gone = decide(
        Record(key="k", value=b"1", version={"a": 1}), Write(key="k", deleted=True, expected={"a": 1}, write="w2"), "a"
    )
    assert gone.deleted
    assert gone.value == b""
    again = decide(gone, Write(key="k", value=b"2", write="w3"), "b")
    assert again.version == {"a": 2, "b": 1}


def test_an_owner_that_is_behind_says_so() -> None:
    """A writer that saw a newer version than the owner holds gets it to catch up, not a conflict."""
    here = Record(key="k", value=b"1", version={"a": 1})
    with pytest.raises(Behind):
        decide(here, Write(key="k", value=b"2", expected={"a": 2}, write="w"), "a")


@pytest.mark.parametrize("version", [{"a": 2**53 - 1}, {f"g{number}": 1 for number in range(256)}])
def test_what_the_replicas_would_refuse_is_not_decided(version: dict[str, int]) -> None:
    """A version without room for one more write, as only a forged one is, is refused by its owner, with the reason."""
    full = check_record(Record(key="k", value=b"1", version=version), max_bytes=10)
    for deleted in (False, True):
        with pytest.raises(PayloadError, match="k cannot be changed any more"):
            decide(full, Write(key="k", deleted=deleted, expected=version, write="w"), "a")


@given(records, records)
def test_digests_tell_records_apart(one: Record, other: Record) -> None:
    """Digests are equal exactly when version, content and removal are."""
    same = (one.version, one.value, one.deleted) == (other.version, other.value, other.deleted)
    assert (digest(one) == digest(other)) == same


digests = st.dictionaries(st.text("ab/", min_size=1, max_size=3), st.sampled_from([f"{n:016x}" for n in range(3)]))


@given(digests, digests)
def test_summaries_tell_shards_apart(one: dict[str, str], other: dict[str, str]) -> None:
    """Summaries are equal exactly when every key has the same digest, in whatever order they are given."""
    assert (summary(one) == summary(other)) == (one == other)
    assert summary(dict(sorted(one.items(), reverse=True))) == summary(one)


def test_records_that_are_alike_do_not_cancel_out() -> None:
    """An even number of records that are alike but for their key is distinguished from as many older ones."""
    old, new = Record(key="k", value=b"old", version={"a": 1}), Record(key="k", value=b"new", version={"a": 1, "b": 1})
    keys = [f"task/{n}" for n in range(4)]
    assert summary(dict.fromkeys(keys, digest(old))) != summary(dict.fromkeys(keys, digest(new)))


@pytest.mark.parametrize("key", ["", "x" * (MAX_KEY + 1), "a\nb", "\x00"])
def test_bad_keys_are_refused(key: str) -> None:
    """A key is 1 to 512 printable characters."""
    with pytest.raises(PayloadError):
        check_key(key)


@pytest.mark.parametrize(
    "record",
    [
        Record(key="k", value=b"x" * 11, version={"a": 1}),
        Record(key="k", version={}),
        Record(key="k", version={"a": 0}),
        Record(key="k", version={"a": 2**60}),
        Record(key="k", version={"A/b": 1}),
        Record(key="k", version={f"g{n}": 1 for n in range(300)}),
    ],
)
def test_bad_records_from_elsewhere_are_refused(record: Record) -> None:
    """Too large a value, or a version that no gateway can have made, is refused with the reason."""
    with pytest.raises(PayloadError):
        check_record(record, max_bytes=10)
    if record.version:
        with pytest.raises(PayloadError):
            check_write(Write(key="k", value=record.value, expected=record.version), max_bytes=10)


@given(records)
def test_records_survive_the_wire(record: Record) -> None:
    """A record is the same after JSON."""
    assert msgspec.json.decode(msgspec.json.encode(record), type=Record) == record


@given(records, st.integers(1, 4))
def test_what_a_gateway_decides_upon_a_record_follows_it_here(record: Record, decisions: int) -> None:
    """A chain of one gateway's own decisions follows each record it began with, and none follows a later one."""
    chain = [record]
    for number in range(decisions):
        current = chain[-1]
        expected = None if current.deleted else current.version
        asked = Write(key="k", value=b"%d" % number, expected=expected, write=f"new{number}")
        chain.append(decide(current, asked, "a"))
    for earlier in range(len(chain)):
        for later in range(len(chain)):
            assert follows_here(chain[later], chain[earlier], "a") == (later > earlier)
            assert not follows_here(chain[later], chain[earlier], "b")


@given(records, records)
def test_what_was_settled_with_anothers_write_follows_nothing_here(record: Record, other: Record) -> None:
    """Where another gateway has ordered a write meanwhile the record may be gone: that is for its writer to hear."""
    decided = replace(record, version=increment(record.version, "a"), write="w3")
    # Of its own decisions others know none that it has not made itself yet.
    assume(other.version.get("a", 0) <= decided.version["a"])
    assume(concurrent(decided.version, other.version))
    assert not follows_here(settle(decided, other, by_bytes), decided, "a")
