"""What is taken, what is sent away and until when, what a task must expect, and how one ends that is too late."""

import asyncio
import math
import time
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import Group, Plan, RunEventKind, Subtask, TaskRecord, TaskRequest, TaskState, encode
from appliance.plane.session import Message
from appliance.tasks.admission import LONGEST_PAUSE_S, LONGEST_RETRY_S, Admission, Ends, expectation, full, longest_s
from appliance.tasks.machine import TransitionKind
from appliance.tasks.timing import Ages, left_s

pytestmark = pytest.mark.anyio


@settings(deadline=None)
@given(st.lists(st.floats(0.01, 10), min_size=1, max_size=80), st.integers(1, 50))
def test_when_to_come_back_follows_the_measured_rate(gaps: list[float], ends: int) -> None:
    """No estimate before two have ended; then as many ends as are wanted, at the rate of late, within bounds."""
    measured, now = Ends(), 100.0
    assert measured.retry_after_s(1, now) == 0.0
    measured.ended(now)
    for gap in gaps:
        now += gap
        measured.ended(now)
    after_s = measured.retry_after_s(ends, now)
    assert 0 <= after_s <= LONGEST_RETRY_S
    mean = sum(gaps[-31:]) / (len(gaps[-31:]) + 1)
    assert after_s == pytest.approx(min(LONGEST_RETRY_S, ends * mean), rel=0.05, abs=0.06)
    assert measured.retry_after_s(ends, now + 1000.0) >= after_s, "while none ends, one is sent away for longer"


def test_a_refusal_names_the_reason_and_the_time() -> None:
    """Also where nothing was measured."""
    error = full("gw-1", 200, 12.5)
    assert "200 unfinished" in error.message
    assert "12.5 s" in error.remedy
    assert error.retry_after_s == 12.5
    assert "wait for some" in full("gw-1", 200, 0.0).remedy


def test_a_plan_takes_as_long_as_its_longest_chain() -> None:
    """Side by side counts once; a circle ends the counting."""
    plan = Plan(
        domain="any",
        subtasks=(
            Subtask(id="a", skill="x"), Subtask(id="b", skill="x", after=("a",)), Subtask(id="c", skill="x"),
        ),
    )  # fmt: skip
    assert longest_s(plan, {"a": 2.0, "b": 3.0, "c": 4.0}) == 5.0
    circle = Plan(domain="any", subtasks=(Subtask(id="a", skill="x", after=("a",)),))
    assert longest_s(circle, {"a": 1.0}) == 0.0


def test_what_a_task_must_expect_is_said() -> None:
    """Nothing when it may start and has time; the wait and the deadline that can hardly be met otherwise."""
    assert expectation(waiting=0, wait_s=None, work_s=10.0, deadline_s=0.0) == ""
    assert expectation(waiting=0, wait_s=5.0, work_s=10.0, deadline_s=11.0) == ""
    assert "12.0 s" in expectation(waiting=3, wait_s=12.0, work_s=None, deadline_s=0.0)
    assert "hardly" in expectation(waiting=3, wait_s=12.0, work_s=5.0, deadline_s=15.0)
    assert "hardly" in expectation(waiting=0, wait_s=None, work_s=10.0, deadline_s=11.0, elapsed_s=5.0)


def record(**fields: Any) -> TaskRecord:
    """Return a record with a deadline."""
    return TaskRecord(**{"id": "t-1", "instruction": "x", "deadline_s": 60.0, "elapsed_s": 10.0, **fields})


def test_age_is_counted_on_from_when_a_record_was_heard() -> None:
    """The gap between a coordinator's last word and its successor counts, by the successor's own clock alone."""
    now = 1000.0
    ages = Ages(lambda: now)
    told = record()
    key = "swiftbot/f/task/t-1/record"
    for payload in (b"{", b'{"deadline_s":1}', encode(record(id="t-2")), encode(told)):
        ages.hear(Message(key, payload, deleted=False, at_ns=0, encoding=""))
    now = 1025.0
    assert ages.elapsed_s(told) == 35.0
    assert left_s(told, ages.elapsed_s(told)) == 25.0
    assert ages.elapsed_s(record(id="t-2")) == 10.0, "never heard of: as old as its record says"
    assert left_s(record(deadline_s=0.0), 1e9) == math.inf


async def test_a_task_whose_deadline_passes_ends_with_that_reason(bench: Any) -> None:
    """Its run is cancelled, its record says how far it was, and nothing is repeated."""
    await bench.start(replace(bench.plane.accepted(), deadline_s=2.0))
    _, request = await bench.ordered()
    assert 0 < request.due_s <= 2.0
    bench.tell(request, RunEventKind.STARTED)
    ended = await bench.end()
    assert ended.state is TaskState.FAILED
    assert ended.failure.code == "deadline"
    assert "0 of 1 subtasks" in ended.failure.message
    assert "run_cancel" in {verb for _, verb, _ in bench.plane.rpc.calls}


async def test_a_deadline_counts_over_a_takeover_and_while_planning(bench: Any) -> None:
    """What had passed before counts; a planner that takes too long is not waited for."""
    bench.context.planning = asyncio.Event()
    await bench.start(replace(bench.plane.accepted(), deadline_s=60.0), elapsed_s=59.9)
    ended = await bench.end()
    assert ended.failure.code == "deadline"
    assert "not planned" in ended.failure.message
    assert ended.elapsed_s >= 60.0


async def test_a_group_is_in_the_record_before_anything_is_sent(bench: Any) -> None:
    """The transition comes before the dispatch; the order names the gateways that the submitter allows."""
    bench.context.groups = [Group(members=("gw-1", "gw-2"), root="gw-1", why="formed")]
    await bench.start(replace(bench.plane.accepted(), within=("gw-1", "gw-2", "gw-3")))
    _, request = await bench.ordered()
    assert request.group == ("gw-1", "gw-2", "gw-3")
    stored = bench.stored()
    assert stored.group is not None
    assert stored.group.root == "gw-1"
    kinds = [each.kind for each in bench.transitions()]
    assert kinds.index(TransitionKind.GROUPED) < kinds.index(TransitionKind.DISPATCHED)


async def test_without_room_a_subtask_waits_with_a_note_and_uses_up_no_attempt(bench: Any) -> None:
    """It is sent when there is room, as its first attempt; what it waits for stands in the record meanwhile."""
    bench.context.room = False
    bench.context.expected = "3 subtasks wait for room before it"
    await bench.start()
    waiting = await bench.until(
        lambda record: "waits for room" in record.subtasks[0].note if record.subtasks else False
    )
    assert waiting.subtasks[0].attempt == 0
    assert waiting.note == "3 subtasks wait for room before it"
    bench.context.room = True
    assert (await bench.ordered())[1].attempt == 1


async def test_submissions_under_way_at_once_are_bounded_and_others_are_told_when_to_return() -> None:
    """The bound holds whatever comes; when one has ended the next is let in."""
    admission, going = Admission("gw-1", 100), asyncio.Event()

    async def take(request: TaskRequest) -> TaskRecord:
        await going.wait()
        return TaskRecord(id=request.id, instruction="x")

    submit = admission.paced(take, most=3)
    works = [asyncio.create_task(submit(TaskRequest(instruction="x", id=f"t-{each}"))) for each in range(5)]
    await asyncio.sleep(0)
    going.set()
    answers = await asyncio.gather(*works, return_exceptions=True)
    refused = [each for each in answers if isinstance(each, RefusedError)]
    assert len(refused) == 2
    assert all(0 < each.retry_after_s <= LONGEST_PAUSE_S for each in refused)
    assert (await submit(TaskRequest(instruction="x", id="t-9"))).id == "t-9"


def test_acceptances_are_slow_by_what_they_take_and_only_while_some_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine on which each takes long is not slow for that; what was slow a while ago does not count."""
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)

    def took(seconds: float, times: int, admission: Admission) -> None:
        nonlocal now
        for number in range(times):
            with admission.one_more(f"t-{number}", 0):
                now += seconds

    quick, steady = Admission("gw-1", 100), Admission("gw-1", 100)
    took(0.008, 20, quick)
    assert not quick.slow(now, 0.001)
    assert quick.slow(now, 0.05), "the event loop is late"
    took(0.2, 20, quick)
    assert quick.slow(now, 0.001)
    assert not quick.slow(now + 10.0, 0.05)
    took(0.2, 100, steady)
    assert not steady.slow(now, 0.001)
