"""How a stream and revisions look in a terminal."""

from appliance.console import revision_lines, stream_line
from appliance.model import Dropped, Plan, Proposal, Revision, RevisionKind, Subtask, SubtaskState, TaskRecord
from appliance.model.task_api import Line, LineKind


def test_a_line_says_when_where_and_what() -> None:
    """Time, gateway, subtask and attempt, kind, text, and the figures in words."""
    line = Line(
        kind=LineKind.METRICS,
        task="t",
        at_ns=1_000_000_000_123_456_789,
        gateway="gw-2",
        subtask="s1",
        attempt=2,
        text="succeeded after 14.0 ms",
        fields={"duration_ms": 14.0, "cpu_ms": 0.7, "peak_mb": 14.2, "container": "8822d4d7e2890", "phase": "cold"},
    )
    text = stream_line(line).plain
    assert text[8:].startswith(".123 gw-2     s1/2     metrics    succeeded after 14.0 ms")
    assert text.endswith(" (took 14 ms, cpu 0.7 ms, peak 14.2 MB, 8822d4d7e289 cold)")
    half = Line(kind=LineKind.PROGRESS, task="t", at_ns=1, text="half", fields={"progress": 0.5})
    assert "50% half" in stream_line(half).plain


def test_revisions_say_what_failed_and_what_was_done() -> None:
    """Each with what went out and came in; a proposal that waits names the command."""
    revision = Revision(
        number=1,
        kind=RevisionKind.SKILL,
        subtask="s2",
        why="saw nothing",
        note="r1_1 (find) takes the place of s2 (detect): saw nothing",
        dropped=(Dropped(id="s2", skill="detect", state=SubtaskState.FAILED),),
        added=("r1_1",),
    )
    plan = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="goto", robot="rover_1", params={"place": "x"}),))
    record = TaskRecord(
        id="t", instruction="x", revisions=(revision,), proposal=Proposal(plan=plan, subtask="s3", note="n", waits=True)
    )
    text = "\n".join(each.plain for each in revision_lines(record))
    assert "revision 1 (skill): r1_1 (find) takes the place" in text
    assert "since s2 failed: saw nothing" in text
    assert "out: s2 (detect) failed; in: r1_1" in text
    assert "swiftbot task approve t" in text
    assert "s1 goto rover_1" in text
