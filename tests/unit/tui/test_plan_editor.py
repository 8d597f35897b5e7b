"""The plan editor's model."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.model import Plan, Subtask
from appliance.tui import plan_editor
from appliance.tui.plan_editor import ChangeKind, Draft, difference, difference_text, params_of, params_text

PLAN = Plan(
    domain="inspection",
    subtasks=(
        Subtask(id="s1", skill="takeoff", robot="drone_1", params={"altitude_m": 10}),
        Subtask(id="s2", skill="goto", robot="drone_1", params={"place": "north gate"}, after=("s1",)),
        Subtask(id="s3", skill="photograph", robot="rover_1"),
        Subtask(id="s4", skill="report", after=("s2", "s3")),
    ),
)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Make acyclic plans, their subtasks in any order."""
    count = draw(st.integers(2, 8))
    subtasks = [
        Subtask(
            id=f"s{number}",
            skill="goto",
            after=tuple(sorted({f"s{draw(st.integers(0, number - 1))}" for _ in range(draw(st.integers(0, 3)))}))
            if number
            else (),
        )
        for number in range(count)
    ]
    return Plan(domain="d", subtasks=tuple(draw(st.permutations(subtasks))))


def before(plan: Plan, name: str) -> set[str]:
    """Return all that come before a subtask, directly or not."""
    after = {each.id: each.after for each in plan.subtasks}
    found: set[str] = set()
    waiting = list(after[name])
    while waiting:
        each = waiting.pop()
        if each not in found:
            found.add(each)
            waiting.extend(after[each])
    return found


def test_robot_is_changed_and_undone() -> None:
    """Another robot does the subtask; undo brings the first back; the proposal stays what it was."""
    draft = Draft.of(PLAN).with_robot("s3", "Rover_2")
    assert draft.of_id("s3").robot == "rover_2"
    assert draft.changed
    assert draft.proposed == PLAN
    assert not draft.undone().changed
    assert draft.undone().undone().plan == PLAN
    assert Draft.of(PLAN).with_robot("s3", "-").of_id("s3").robot is None


@pytest.mark.parametrize("name", ["two words", "a/b", "x" * 80, "\x1b[31m"])
def test_what_is_no_robot_is_refused(name: str) -> None:
    """A name that no robot may have is refused with a remedy."""
    with pytest.raises(PayloadError) as caught:
        Draft.of(PLAN).with_robot("s3", name)
    assert caught.value.remedy


def test_unknown_subtask_is_refused() -> None:
    """An edit of a subtask that is not there names those that are."""
    with pytest.raises(PayloadError, match="no subtask") as caught:
        Draft.of(PLAN).with_robot("s9", "rover_1")
    assert "s1, s2, s3, s4" in caught.value.remedy


def test_circle_is_refused() -> None:
    """An order in which subtasks would wait for each other is refused, and the draft stays as it was."""
    draft = Draft.of(PLAN)
    with pytest.raises(PayloadError, match="circle"):
        draft.with_after("s1", ("s4",))
    with pytest.raises(PayloadError, match="itself"):
        draft.with_after("s1", ("s1",))
    assert not draft.changed


def test_removal_keeps_the_order_of_the_rest() -> None:
    """What came after a subtask that is taken out comes after what came before that."""
    draft = Draft.of(PLAN).without("s2")
    assert draft.ids == ("s1", "s3", "s4")
    assert draft.of_id("s4").after == ("s1", "s3")


def test_last_subtask_stays() -> None:
    """An empty plan cannot be made; the remedy is to reject."""
    draft = Draft.of(Plan(domain="d", subtasks=(Subtask(id="s1", skill="goto"),)))
    with pytest.raises(PayloadError, match="only subtask") as caught:
        draft.without("s1")
    assert "reject" in caught.value.remedy


def test_neighbours_change_places() -> None:
    """A subtask moves before the one that it came after, and back."""
    plan = Plan(
        domain="d",
        subtasks=(
            Subtask(id="a", skill="x"),
            Subtask(id="b", skill="x", after=("a",)),
            Subtask(id="c", skill="x", after=("b",)),
        ),
    )
    up = Draft.of(plan).moved("b", -1)
    assert plan_editor.ordered(up.subtasks) == ["b", "a", "c"]
    assert plan_editor.ordered(up.moved("b", 1).subtasks) == ["a", "b", "c"]
    with pytest.raises(PayloadError):
        Draft.of(plan).moved("a", -1)


@given(plan=plans(), data=st.data())
def test_no_edit_makes_a_circle_or_loses_an_order(plan: Plan, data: st.DataObject) -> None:
    """Whatever is taken out, the others keep what came before them; a swap makes no circle."""
    gone = data.draw(st.sampled_from([each.id for each in plan.subtasks]))
    left = Draft.of(plan).without(gone).plan
    for each in left.subtasks:
        assert before(left, each.id) == before(plan, each.id) - {gone}
    try:
        swapped = Draft.of(plan).moved(gone, data.draw(st.sampled_from([-1, 1])))
    except PayloadError:
        return
    assert not plan_editor.cycle(swapped.subtasks)
    assert sorted(swapped.ids) == sorted(each.id for each in plan.subtasks)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(params=st.dictionaries(st.from_regex(r"\A[a-z_][a-z0-9_]{0,8}\Z"), VALUES, max_size=4))
def test_parameters_are_read_as_they_are_written(params: dict[str, object]) -> None:
    """Parameters written out for editing and read back are the same, whatever texts and types they have."""
    assert params_of(params_text(params)) == params


@pytest.mark.parametrize("text", ["=1", "a", "a=1 a=2", 'a="open', "a=[1,", "a b=1", "1=2", "\x1b=1"])
def test_bad_parameters_are_refused(text: str) -> None:
    """What is no list of parameters is refused with what was expected."""
    with pytest.raises(PayloadError) as caught:
        params_of(text)
    assert caught.value.remedy


def test_difference_names_each_field() -> None:
    """The difference has each changed field before and after, what was taken out, and leaves out what is the same."""
    edited = Draft.of(PLAN).with_robot("s3", "rover_2").without("s1").plan
    kinds = {each.id: each.kind for each in difference(PLAN, edited)}
    assert kinds == {
        "s1": ChangeKind.REMOVED,
        "s2": ChangeKind.CHANGED,
        "s3": ChangeKind.CHANGED,
        "s4": ChangeKind.SAME,
    }
    text = difference_text(PLAN, edited).plain
    assert "- s1 takeoff  taken out" in text
    assert "robot: rover_1 → rover_2" in text
    assert "after: s1 → nothing" in text
    assert "nothing is changed" in difference_text(PLAN, PLAN).plain
