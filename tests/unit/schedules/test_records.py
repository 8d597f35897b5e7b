"""Which version of a schedule stands after a partition: the same everywhere, and nothing is submitted again."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Word, encode
from appliance.model.schedules import SavedInstruction, Schedule, ScheduleSpec
from appliance.plane.records import Record
from appliance.schedules import records

SPEC = ScheduleSpec(id="patrol", instruction="go", every_s=60.0)
SCHEDULES = st.builds(
    Schedule, spec=st.just(SPEC), added=st.just(Word(by="ann", at_ns=1)),
    paused=st.sampled_from((None, Word(by="bob"))),
    removed=st.sampled_from((None, None, Word(by="eve"))), edited_ns=st.integers(0, 3), handled_ns=st.integers(0, 3),
    fired=st.integers(0, 3), fired_ns=st.integers(0, 3), task=st.sampled_from(("a", "b")), missed=st.integers(0, 3),
    missed_ns=st.integers(0, 3), missed_why=st.sampled_from(("", "x")),
)  # fmt: skip


def record(value: bytes, name: str, *, deleted: bool = False) -> Record:
    """Return a version that one gateway has written."""
    return Record(key="schedule/patrol", value=value, version={name: 1}, deleted=deleted, write=name)


@given(SCHEDULES, SCHEDULES)
def test_both_sides_choose_alike(one: Schedule, other: Schedule) -> None:
    """In whatever order they meet; what either has handled is handled, and the later word of an operator holds."""
    first, second = record(encode(one), "gw-1"), record(encode(other), "gw-2")
    found = records.resolve(first.key, first, second)
    assert found.value == records.resolve(first.key, second, first).value
    merged = records.read(found.value, Schedule)
    assert merged.handled_ns == max(one.handled_ns, other.handled_ns)
    assert (merged.removed is None) == (one.removed is None and other.removed is None)
    if one.edited_ns != other.edited_ns and (one.removed is None) == (other.removed is None):
        assert merged.paused == max(one, other, key=lambda each: each.edited_ns).paused
    again = records.resolve(first.key, found, second)
    assert again.value == found.value


def test_a_removed_one_stays_removed() -> None:
    """Whatever the other side has submitted meanwhile."""
    value = encode(Schedule(spec=SPEC, added=Word(by="ann"), handled_ns=9))
    gone = record(b"", "gw-1", deleted=True)
    assert records.resolve(gone.key, record(value, "gw-2"), gone).deleted


def test_what_cannot_be_read_loses_to_nothing_and_breaks_nothing() -> None:
    """A record of another version of the program, or garbage: the same one stands on both sides."""
    one, other = record(b"{", "gw-1"), record(b"[]", "gw-2")
    assert records.resolve(one.key, one, other).value == records.resolve(one.key, other, one).value


def test_of_saved_instructions_the_later_one_stands() -> None:
    """By when it was saved."""
    early, late = (encode(SavedInstruction(id="a", text=text, saved=Word(by="ann", at_ns=at)))
                   for text, at in (("z", 1), ("a", 2)))  # fmt: skip
    pair = [Record(key="instruction/a", value=value, version={str(n): 1}) for n, value in enumerate((early, late))]
    assert records.resolve("instruction/a", *pair).value == late
