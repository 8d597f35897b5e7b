"""One stream of a task: what becomes a line, in which order lines come out, and what is bounded and counted."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Failure, LogLine, Notice, Phase, RunEvent, RunEventKind
from appliance.model.task_api import Line, LineKind, TaskLinesAsk
from appliance.model.transitions import Transition, TransitionKind
from appliance.tasks.lines import of_event, of_log, of_notice, of_transition
from appliance.tasks.stream import Kept, Merge

SECOND = 1_000_000_000


def event(kind: RunEventKind, **more: Any) -> RunEvent:
    """An event of a run on gw-1."""
    return RunEvent(task="t", subtask="s1", attempt=1, kind=kind, gateway="gw-1", at_ns=SECOND, **more)


def line(gateway: str, number: int, at_ns: int, *, source: str = "run s1/1", kind: LineKind = LineKind.LOG) -> Line:
    """A line of a run."""
    return Line(kind=kind, task="t", at_ns=at_ns, gateway=gateway, source=source, number=number, text=str(number))


def texts(lines: list[Line]) -> list[str]:
    """What they say."""
    return [f"{each.gateway}:{each.text}" for each in lines if each.kind is not LineKind.DROPPED]


def test_figures_of_a_run_are_a_line() -> None:
    """Startup at its beginning; duration, CPU time, memory, container and phase at its end."""
    began = of_event(event(RunEventKind.STARTED, startup_ms=4.2))
    ended = of_event(
        event(RunEventKind.SUCCEEDED, duration_ms=1500.0, cpu_ms=80.0, peak_mb=21.5, container="c1", phase=Phase.COLD)
    )
    assert began is not None
    assert ended is not None
    assert (began.text, ended.text) == ("started in 4.2 ms", "succeeded after 1.50 s")
    assert ended.fields == {
        "duration_ms": 1500.0, "cpu_ms": 80.0, "peak_mb": 21.5, "container": "c1", "phase": "cold"
    }  # fmt: skip


def test_a_failed_run_says_why_and_a_sign_of_life_says_nothing() -> None:
    """Its end is a warning with the reason; a heartbeat is no line."""
    found = of_event(event(RunEventKind.FAILED, failure=Failure(code="skill", message="saw nothing")))
    assert found is not None
    assert (found.level, found.text, found.fields["code"]) == ("warning", "failed: saw nothing", "skill")
    assert of_event(event(RunEventKind.ALIVE)) is None


def test_log_lines_of_gateways_belong_to_the_task_they_name() -> None:
    """Others are none of its stream's business."""
    told = LogLine(at_ns=1, level="info", source="", event="order sent", fields={"task": "t", "subtask": "s1", "x": 1})
    found = of_log("gw-2", told)
    assert found is not None
    assert (found.task, found.subtask, found.gateway, found.fields) == ("t", "s1", "gw-2", {"x": 1})
    of_run = of_log("gw-2", replace(told, fields={"run": "t/s1/2", "reason": "x"}))
    assert of_run is not None
    assert (of_run.task, of_run.subtask, of_run.attempt) == ("t", "s1", 2)
    assert of_log("gw-2", replace(told, fields={})) is None
    assert of_log("gw-2", replace(told, fields={"run": "t/s1/x"})) is None
    assert of_log("gw-2", replace(told, fields={"task": 7})) is None
    assert of_notice(Notice(id="n", to="ann", text="done", task="t")).text == "to ann: done"


def test_transitions_that_runs_tell_themselves_are_left_out() -> None:
    """Progress of a run comes from the run; why a subtask waits comes from its coordinator."""
    common: dict[str, Any] = {"task": "t", "sequence": 3, "at_ns": 1, "coordinator": "gw-1", "subtask": "s1"}
    assert of_transition(Transition(kind=TransitionKind.PROGRESS, gateway="gw-2", note="half", **common)) is None
    waits = of_transition(Transition(kind=TransitionKind.PROGRESS, note="waits for rover_1: offline", **common))
    assert waits is not None
    assert waits.kind is LineKind.STATE
    stuck = of_transition(Transition(kind=TransitionKind.NOTICED, condition="stuck", note="stuck: silent", **common))
    assert stuck is not None
    assert (stuck.kind, stuck.level) == (LineKind.MONITOR, "warning")


def test_large_fields_are_cut() -> None:
    """A partial result of a megabyte is not a megabyte of a stream."""
    found = of_event(event(RunEventKind.PARTIAL, result={f"k{number}": "x" * 10_000 for number in range(500)}))
    assert found is not None
    assert len(str(found.fields)) < 10_000


def test_lines_of_two_gateways_come_in_the_order_of_time_even_if_one_clock_is_an_hour_off() -> None:
    """Each gateway's clock is brought to the reader's by what it showed when asked."""
    hour = 3600 * SECOND
    merge = Merge(hold_s=1.0)
    merge.set_clock("gw-1", theirs_ns=0, ours_ns=0)
    merge.set_clock("gw-2", theirs_ns=hour, ours_ns=0)
    merge.add(line("gw-1", 1, 1 * SECOND), 10.0)
    merge.add(line("gw-1", 2, 3 * SECOND), 10.1)
    merge.add(line("gw-2", 1, hour + 2 * SECOND), 10.2)
    assert merge.due(10.9) == []
    assert texts(merge.due(11.3)) == ["gw-1:1", "gw-2:1", "gw-1:2"]


def test_a_line_that_comes_twice_is_shown_once() -> None:
    """What gateways kept comes again beside what was heard."""
    merge = Merge(hold_s=0.0)
    for _ in range(3):
        merge.add(line("gw-1", 1, SECOND), 1.0)
    assert texts(merge.due(2.0)) == ["gw-1:1"]
    merge.add(line("gw-1", 1, SECOND), 2.0)
    assert merge.due(3.0) == []


def test_missing_numbers_of_a_run_are_told_where_they_are_missing() -> None:
    """Lines 2 and 3 never came: the stream says so before line 4."""
    merge = Merge(hold_s=0.0)
    merge.add(line("gw-1", 1, SECOND), 1.0)
    merge.add(line("gw-1", 4, 2 * SECOND), 1.0)
    found = merge.due(2.0)
    assert [(each.kind, each.fields.get("count")) for each in found] == [
        (LineKind.LOG, None),
        (LineKind.DROPPED, 2),
        (LineKind.LOG, None),
    ]


def test_a_slow_reader_loses_log_lines_first_and_is_told() -> None:
    """Beyond the bound handlers' lines go, transitions stay, and the count is in the stream."""
    merge = Merge(hold_s=1.0, most=10)
    for number in range(1, 6):
        merge.add(line("gw-1", number, number, source="record", kind=LineKind.STATE), 1.0)
    for number in range(1, 101):
        merge.add(line("gw-2", number, 1000 + number), 1.0)
    merge.missed(7, "gw-3")
    found = merge.due(5.0)
    assert sum(each.kind is LineKind.STATE for each in found) == 5
    assert len([each for each in found if each.kind is LineKind.LOG]) == 5
    assert {each.gateway for each in found if each.kind is LineKind.DROPPED} >= {"gw-3"}


@given(
    said=st.lists(st.tuples(st.sampled_from(["gw-1", "gw-2", "gw-3"]), st.integers(0, 50)), max_size=60),
    offsets=st.lists(st.integers(-(10**13), 10**13), min_size=3, max_size=3),
    order=st.randoms(use_true_random=False),
)
def test_whatever_comes_when_each_source_keeps_its_order_and_nothing_is_lost(
    said: list[tuple[str, int]], offsets: list[int], order: Any
) -> None:
    """Lines of one source come out by their numbers, each exactly once, whichever way they arrived."""
    clocks = dict(zip(["gw-1", "gw-2", "gw-3"], offsets, strict=True))
    merge = Merge(hold_s=10.0)
    for gateway, offset in clocks.items():
        merge.set_clock(gateway, theirs_ns=offset, ours_ns=0)
    counts: dict[str, int] = {}
    lines: list[Line] = []
    now = 0
    for gateway, pause in said:
        now += pause
        counts[gateway] = counts.get(gateway, 0) + 1
        lines.append(line(gateway, counts[gateway], now + clocks[gateway]))
    ranks = {gateway: order.random() for gateway in clocks}
    # Messages of one gateway arrive in the order in which they were put; gateways overtake each other.
    arriving = sorted(lines, key=lambda each: ranks[each.gateway])
    for each in arriving:
        merge.add(each, 0.0)
    found = [each for each in merge.due(100.0) if each.kind is not LineKind.DROPPED]
    assert len(found) == len(lines)
    assert [each.at_ns for each in found] == sorted(each.at_ns for each in found)
    for gateway, count in counts.items():
        assert [each.number for each in found if each.gateway == gateway] == list(range(1, count + 1))


@pytest.mark.anyio
async def test_a_gateway_keeps_the_last_lines_of_each_task_within_one_bound() -> None:
    """The oldest lines of a task go first, then the task not heard of for longest; how many is shown."""
    kept = Kept("gw-1", per_task=5, altogether=12)
    for number in range(1, 9):
        kept.hear_event(replace(event(RunEventKind.LOG, note=str(number)), number=number))
    answer = await kept.answer(TaskLinesAsk(task="t"))
    assert [each.text for each in answer.lines] == ["4", "5", "6", "7", "8"]
    assert (answer.gateway, answer.dropped) == ("gw-1", 3)
    assert (await kept.answer(TaskLinesAsk(task="t", limit=2))).dropped == 6
    for other in ("u", "v"):
        for number in range(1, 5):
            kept.hear_log(LogLine(at_ns=number, level="info", source="", event="x", fields={"task": other}))
    assert (await kept.answer(TaskLinesAsk(task="t"))).lines == ()
    assert len((await kept.answer(TaskLinesAsk(task="v"))).lines) == 4
    assert (await kept.answer(TaskLinesAsk(task="nobody"))).lines == ()
