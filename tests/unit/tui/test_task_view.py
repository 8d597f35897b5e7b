"""Tasks as text: hostile and unknown contents among them."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.model import Failure, Plan, Proposal, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.model.task_api import CandidateWhy, SubtaskWhy, Waits
from appliance.tui.task_view import (
    brief,
    nodes,
    progress,
    reason,
    subtask_cells,
    subtask_text,
    task_cells,
    task_text,
    whole,
)

HOSTILE = st.text(max_size=40) | st.sampled_from(
    ["\x1b[2J\x1b]0;x\x07", "[bold red]x[/]", "\u202egnp.exe", "\u0300" * 50, "家" * 50, "שלום", "\x00\x7f", "a\nb\tc"]
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | HOSTILE,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(HOSTILE, inner, max_size=3),
    max_leaves=6,
)


@st.composite
def records(draw: st.DrawFn) -> TaskRecord:
    """Make records with anything in them that decodes."""
    names = draw(st.lists(HOSTILE, min_size=1, max_size=3))
    return TaskRecord(
        id=draw(HOSTILE),
        instruction=draw(HOSTILE),
        submitter=draw(HOSTILE),
        note=draw(HOSTILE),
        state=draw(st.sampled_from(list(TaskState))),
        created_ns=draw(st.integers(-(2**62), 2**62)),
        failure=draw(st.none() | st.builds(Failure, code=HOSTILE, message=HOSTILE, remedy=HOSTILE)),
        subtasks=tuple(
            SubtaskRecord(
                subtask=Subtask(id=name, skill=draw(HOSTILE), robot=draw(st.none() | HOSTILE), after=tuple(names)),
                state=draw(st.sampled_from(list(SubtaskState))),
                gateway=draw(HOSTILE),
                note=draw(HOSTILE),
                progress=draw(st.floats(allow_nan=False)),
                result=draw(st.none() | st.dictionaries(HOSTILE, VALUES, max_size=3)),
            )
            for name in names
        ),
    )


def harmless(text: str) -> bool:
    """Whether a terminal shows all of it and obeys none of it."""
    return all(line.isprintable() for line in text.split("\n"))


@given(record=records())
def test_whatever_a_record_says_is_shown_as_text(record: TaskRecord) -> None:
    """Escape sequences, markup, direction marks, circles and odd numbers in a record are text on every screen."""
    assert harmless(task_text(record).plain)
    assert harmless(reason(record))
    assert 0 <= progress(record) <= 1
    cells = [*task_cells(record)]
    for node in nodes(record).values():
        assert harmless(subtask_text(node.record, None, problem=record.note).plain)
        cells += subtask_cells(node)
    assert all(harmless(cell if isinstance(cell, str) else cell[0]) for cell in cells)


@given(result=st.dictionaries(HOSTILE, VALUES, max_size=5))
def test_results_are_shown_whole_and_in_brief(result: dict[str, object]) -> None:
    """A result of any shape is shown in a line, and in full."""
    assert harmless(brief(result))
    assert harmless(whole(result).plain)


def test_a_megabyte_is_cut() -> None:
    """A result with a line of a megabyte costs a few lines."""
    assert len(whole({"text": "x" * 2**20, "lines": "y\n" * 10**5}).plain) < 20_000


def test_why_a_task_waits() -> None:
    """Each kind of wait has its sentence: planning, approval with its expiry, what a subtask waits for."""
    assert reason(TaskRecord(id="t", instruction="x")) == "being planned"
    plan = Plan(domain="d", subtasks=(Subtask(id="s1", skill="goto", robot="r1"),))
    proposal = Proposal(plan=plan, waits=True, note="it flies", since_s=90.0, expires_s=600.0)
    proposed = TaskRecord(id="t", instruction="x", state=TaskState.PROPOSED, elapsed_s=100.0, proposal=proposal)
    assert reason(proposed) == "waits for approval: it flies; expires in 10 m"
    assert "s1 goto r1" in task_text(proposed).plain
    subtask = SubtaskRecord(subtask=plan.subtasks[0], state=SubtaskState.READY, note="r1 is offline")
    waiting = TaskRecord(id="t", instruction="x", state=TaskState.RUNNING, subtasks=(subtask,))
    assert reason(waiting) == "s1: r1 is offline"
    assert reason(TaskRecord(id="t", instruction="x", state=TaskState.FAILED)) == ""


def test_why_a_subtask_waits() -> None:
    """The wait's reason, place and time stand first, then who could serve it and who cannot, with why."""
    record = SubtaskRecord(subtask=Subtask(id="s1", skill="goto"), state=SubtaskState.READY)
    candidates = (CandidateWhy(gateway="gw-1", score=0.5), CandidateWhy(gateway="gw-2", excluded="it drains"))
    waits = Waits(reason="room at gw-1", position=2, waiting=5, expected_s=3.5, candidates=candidates)
    why = SubtaskWhy(id="s1", skill="goto", state="ready", note="", attempts=(), waits=waits)
    text = subtask_text(record, why).plain
    assert "waits for room at gw-1, place 2 of 5, in about 3.5 s" in text
    assert "gw-1: score 0.50" in text
    assert "gw-2: it drains" in text
    assert "not known: no answer" in subtask_text(record, None, problem="no answer").plain
