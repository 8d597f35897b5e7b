"""Text made of facts."""

from hypothesis import given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from appliance.model import Plan, Subtask, SubtaskRecord, SubtaskState
from appliance.tui import formatting, plan_editor, task_view


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Make acyclic plans, their subtasks in any order, some after subtasks that do not exist."""
    count = draw(st.integers(1, 8))
    subtasks = [
        Subtask(
            id=f"s{number}",
            skill="goto",
            after=tuple(sorted({f"s{draw(st.integers(-1, number - 1))}" for _ in range(draw(st.integers(0, 3)))})),
        )
        for number in range(count)
    ]
    return Plan(domain="d", subtasks=tuple(draw(st.permutations(subtasks))))


@settings(deadline=None)
@given(text=st.text(st.sampled_from("ab 漢é·"), max_size=120), margin=st.integers(0, 8), width=st.integers(0, 60))
def test_what_takes_several_lines_hangs_below_its_first(text: str, margin: int, width: int) -> None:
    """Every line has the margin, the words are those of the text, and only a word longer than a line is too long."""
    lines = formatting.hanging(text, " " * margin, width).split("\n")
    assert all(line.startswith(" " * margin) for line in lines)
    assert " ".join(line[margin:] for line in lines).split() == text.split()
    if width > margin + 20:
        assert all(cell_len(line) <= width or " " not in line[margin:].strip() for line in lines)


@settings(deadline=None)
@given(plan=plans())
def test_every_subtask_once_and_below_its_predecessors(plan: Plan) -> None:
    """The drawing has each subtask once, below all those it comes after, and deeper than them."""
    order = plan_editor.ordered(plan.subtasks)
    depth = plan_editor.depths(plan.subtasks)
    assert sorted(order) == sorted(each.id for each in plan.subtasks)
    for each in plan.subtasks:
        for parent in each.after:
            if parent in depth:
                assert order.index(parent) < order.index(each.id)
                assert depth[parent] < depth[each.id]


def test_cycle_is_drawn_all_the_same() -> None:
    """A plan with a cycle, which no gateway accepts, is still drawn and does not hang."""
    plan = Plan(
        domain="d", subtasks=(Subtask(id="a", skill="x", after=("b",)), Subtask(id="b", skill="y", after=("a",)))
    )
    assert task_view.plan_lines(plan.subtasks).plain.count("└─▶") >= 1


@settings(deadline=None)
@given(fraction=st.floats(allow_nan=False))
def test_bar_has_its_width(fraction: float) -> None:
    """A progress bar is as wide as it should be for any number that a skill reports."""
    drawn, _, percent = formatting.bar(fraction, 10).partition(" ")
    assert len(drawn) == 10
    assert 0 <= int(percent.rstrip("%")) <= 100


def test_results_are_told_briefly() -> None:
    """Files are shown by name, lists by length, long values are cut."""
    record = SubtaskRecord(
        subtask=Subtask(id="s", skill="photograph"),
        state=SubtaskState.SUCCEEDED,
        result={"image": {"artifact": "ab", "name": "door.png"}, "found": [1, 2], "text": "x" * 500},
    )
    text = task_view.subtask_lines(record, 0).plain
    assert "image=door.png found: 2" in text
    assert len(text) < 250
