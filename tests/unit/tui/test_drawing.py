"""Text made of facts."""

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.model import Plan, RunEvent, RunEventKind, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.record.facts import RecorderStatus
from appliance.tui import drawing
from appliance.tui.board import Board


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
@given(plan=plans())
def test_every_subtask_once_and_below_its_predecessors(plan: Plan) -> None:
    """The drawing has each subtask once, below all those it comes after, and deeper than them."""
    order = drawing._ordered(plan)
    depth = drawing.depths(plan)
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
    assert drawing.plan_text(plan).plain.count("└─▶") >= 1


@settings(deadline=None)
@given(fraction=st.floats(allow_nan=False))
def test_bar_has_its_width(fraction: float) -> None:
    """A progress bar is as wide as it should be for any number that a skill reports."""
    drawn, _, percent = drawing.bar(fraction, 10).partition(" ")
    assert len(drawn) == 10
    assert 0 <= int(percent.rstrip("%")) <= 100


def test_results_are_told_briefly() -> None:
    """Files are told by name, lists by length, long values are cut."""
    record = SubtaskRecord(
        subtask=Subtask(id="s", skill="photograph"),
        state=SubtaskState.SUCCEEDED,
        result={"image": {"artifact": "ab", "name": "door.png"}, "found": [1, 2], "text": "x" * 500},
    )
    text = drawing.subtask_text(record, 0).plain
    assert "image=door.png found: 2" in text
    assert len(text) < 250


def test_board_keeps_the_later_record() -> None:
    """An older record that comes late does not replace a newer one."""
    board = Board(tasks=10, entries=10)
    new = TaskRecord(id="t", instruction="x", sequence=5, state=TaskState.RUNNING)
    board.take_task(new)
    assert not board.take_task(TaskRecord(id="t", instruction="x", sequence=4))
    assert board.tasks == (new,)


@settings(deadline=None)
@given(numbers=st.lists(st.integers(0, 60), max_size=80))
def test_board_is_bounded(numbers: list[int]) -> None:
    """However many tasks and lines come, only the newest are kept, newest task first."""
    board = Board(tasks=5, entries=7)
    for number in numbers:
        board.take_task(TaskRecord(id=f"t{number}", instruction="x", created_ns=number))
        board.take_run(RunEvent(task="t", subtask="s", attempt=1, kind=RunEventKind.LOG, note=str(number)), 1)
    assert [record.created_ns for record in board.tasks] == sorted(set(numbers), reverse=True)[:5]
    assert len(board.entries) == min(7, len(numbers))
    assert [entry.serial for entry in board.entries] == list(range(1, len(numbers) + 1))[-7:]


def test_lines_are_one_line_each() -> None:
    """A log text with line breaks is one line, and a very long one is cut."""
    board = Board(tasks=1, entries=5)
    board.add(1, kind="log", level="info", source="x", text="a\nb" + "c" * 9000)
    assert board.entries[0].text.startswith("a b")
    assert len(board.entries[0].text) == 500


def test_recorder_falls_silent() -> None:
    """A recorder not heard for a while is silent, one that stopped is forgotten, and only so many are believed."""
    board = Board(tasks=1, entries=1)
    for number in range(50):
        board.take_recorder(RecorderStatus(id=f"r{number}", fleet="f", state="recording"), now=100.0)
    assert len(board.recorders(100.0)) == 20
    board.take_recorder(RecorderStatus(id="r1", fleet="f", state="recording"), now=104.0)
    board.take_recorder(RecorderStatus(id="r2", fleet="f", state="stopped"), now=104.0)
    states = {status.id: status.state for status in board.recorders(106.0)}
    assert states["r0"] == "silent"
    assert states["r1"] == "recording"
    assert "r2" not in states
