"""What a record tells of how attempts were placed and served, and of what runs said on their way."""

import asyncio
from typing import Any

import msgspec
import pytest

from appliance.errors import RefusedError
from appliance.model import (
    Attempt,
    Choice,
    Considered,
    Failure,
    Phase,
    RunEvent,
    RunEventKind,
    SubtaskState,
    TaskRecord,
    TaskState,
    Way,
    encode,
    keyspace,
)
from appliance.tasks import coordinator, decide, machine
from appliance.tasks.checkpoints import Checkpoint, checkpoint_key
from appliance.tasks.decide import MAX_PARTIAL_BYTES, PartialResults, shown
from appliance.tasks.machine import KEPT_CHOICES, Transition, TransitionKind

pytestmark = pytest.mark.anyio

CHOICE = Choice(
    phase=Phase.LOCAL_WARM,
    way=Way.HERE,
    by="gw-1",
    gateway="gw-1",
    container="c1",
    considered=(Considered(gateway="gw-1", container="c1", taken=True, verdict="taken"),),
    why="warm",
)


async def test_an_attempt_keeps_why_it_was_placed_and_chosen(bench: Any) -> None:
    """The coarse reason stands from the dispatch, the fine one from the first line of the run."""
    bench.context.choice = CHOICE
    await bench.start()
    _, request = await bench.ordered()
    assert bench.coordinator.record.subtasks[0].attempts[0].placed == "none is there"
    bench.tell(request, RunEventKind.STARTED, container="c1", phase=Phase.LOCAL_WARM)
    await bench.until(lambda record: record.subtasks[0].state is SubtaskState.RUNNING)
    await bench.until(lambda record: record.subtasks[0].attempts[0].choice == CHOICE)
    bench.tell(request, RunEventKind.SUCCEEDED)
    await bench.end()
    assert bench.stored().subtasks[0].attempts[0].choice == CHOICE


async def test_a_run_that_ends_before_its_order_is_answered_is_explained_too(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last subtask's end waits a moment for the answer that says how its container was chosen."""
    monkeypatch.setattr(coordinator, "ANSWER_S", 60.0)
    bench.context.choice = CHOICE
    bench.context.slow_answer = asyncio.Event()
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.SUCCEEDED)
    await asyncio.sleep(0.02)
    bench.context.slow_answer.set()
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    assert ended.subtasks[0].attempts[0].choice == CHOICE


async def test_an_answer_that_never_comes_holds_nothing_up(bench: Any) -> None:
    """After a quarter of a second the end is taken without it."""
    bench.context.slow_answer = asyncio.Event()
    await bench.start()
    _, request = await bench.ordered()
    bench.tell(request, RunEventKind.SUCCEEDED)
    ended = await bench.end()
    assert ended.state is TaskState.SUCCEEDED
    assert ended.subtasks[0].attempts[0].choice is None


async def test_the_next_attempt_goes_on_from_the_last_checkpoint(bench: Any) -> None:
    """A first attempt has none; one that comes after a failure gets what was kept; the end removes it."""
    saved = Checkpoint(attempt=1, gateway="gw-1", at_ns=1, data={"at": 3}, calls=2)
    key = checkpoint_key("t-1", "s1")
    await bench.plane.dht.write(key, encode(saved), expected=None)
    await bench.start()
    _, request = await bench.ordered()
    assert request.resume is None
    bench.tell(request, RunEventKind.CHECKPOINT, note="kept")
    record = await bench.until(lambda record: record.subtasks[0].checkpoint_ns > 0)
    assert record.subtasks[0].state is SubtaskState.DISPATCHED
    async with asyncio.timeout(60):
        while not bench.stored().subtasks[0].checkpoint_ns:
            await asyncio.sleep(0.005)
    bench.tell(request, RunEventKind.FAILED, failure=Failure(code="pool", message="died", retryable=True))
    _, again = await bench.ordered()
    assert (again.resume, again.calls) == ({"at": 3}, 2)
    bench.tell(again, RunEventKind.SUCCEEDED, gateway="gw-2")
    await bench.end()
    assert key not in bench.plane.dht.records


async def test_the_last_partial_result_is_shown_until_there_is_a_result(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Many partial results are few transitions; the newest stands; the result takes its place."""
    monkeypatch.setattr(decide, "PARTIAL_EVERY_S", 0.05)
    await bench.start()
    _, request = await bench.ordered()
    for number in range(100):
        bench.tell(request, RunEventKind.PARTIAL, result={"seen": number})
    await bench.until(lambda record: record.subtasks[0].partial == {"seen": 99})
    told = bench.plane.session.sent(bench.plane.keys(keyspace.TRANSITION, "t-1"), Transition)
    assert sum(each.kind is TransitionKind.PARTIAL for each in told) <= 3
    bench.tell(request, RunEventKind.SUCCEEDED, result={"seen": 100})
    assert (await bench.end()).subtasks[0].partial is None


def test_partials_wait_for_their_turn() -> None:
    """One a second for each subtask; what an ended attempt told is dropped."""
    waiting = PartialResults()

    def told(subtask: str, number: int) -> RunEvent:
        return RunEvent(task="t", subtask=subtask, attempt=1, kind=RunEventKind.PARTIAL, result={"n": number})

    waiting.add(told("s1", 1))
    assert [each.result for each in waiting.due(10.0)] == [{"n": 1}]
    waiting.add(told("s1", 2))
    waiting.add(told("s1", 3))
    waiting.add(told("s2", 1))
    assert [each.subtask for each in waiting.due(10.5)] == ["s2"]
    assert waiting.next_at() == 11.0
    assert [each.result for each in waiting.due(11.0)] == [{"n": 3}]
    waiting.add(told("s1", 4))
    waiting.drop("s1")
    assert waiting.next_at() is None


def test_a_partial_result_that_is_too_large_is_left_out_with_the_reason() -> None:
    """A record stays small whatever handlers tell."""
    assert shown({"a": 1}) == {"a": 1}
    assert shown(None) == {}
    assert "bytes" in shown({"a": "x" * MAX_PARTIAL_BYTES})["left_out"]


def step(record: TaskRecord, kind: TransitionKind, **fields: Any) -> TaskRecord:
    """Apply the next transition."""
    event = Transition(
        task=record.id, sequence=record.sequence + 1, kind=kind, at_ns=1, coordinator="gw-1", subtask="s1", **fields
    )
    return machine.apply(record, event)


def test_only_the_latest_attempts_keep_all_that_was_considered(plane: Any) -> None:
    """A subtask that was lost eight times does not make its record large."""
    record = step(plane.accepted(), TransitionKind.PLANNED, plan=plane.plan_of())
    lost = Failure(code="unreachable", message="lost", retryable=True)
    for number in range(1, 7):
        record = step(record, TransitionKind.DISPATCHED, attempt=number, gateway="gw-1", placed="gw-1 0.90")
        record = step(record, TransitionKind.STARTED, attempt=number, gateway="gw-1", choice=CHOICE)
        record = step(record, TransitionKind.ATTEMPT_FAILED, attempt=number, failure=lost)
    attempts = record.subtasks[0].attempts
    assert [bool(each.choice and each.choice.considered) for each in attempts] == [False] * 3 + [True] * KEPT_CHOICES
    assert all(each.choice is not None and each.choice.why == "warm" for each in attempts)
    assert msgspec.json.decode(encode(record), type=TaskRecord) == record


def test_records_from_before_still_decode() -> None:
    """An attempt without reasons, a subtask without partial result or checkpoint: as they were written before."""
    old = (
        b'{"id":"t","instruction":"x","subtasks":[{"subtask":{"id":"s1","skill":"work"},"state":"running",'
        b'"attempts":[{"number":1,"gateway":"gw-1","phase":"cold"}]}]}'
    )
    record = msgspec.json.decode(old, type=TaskRecord)
    assert record.of("s1").attempts == (Attempt(number=1, gateway="gw-1", phase=Phase.COLD),)
    assert record.of("s1").partial is None


async def test_a_refused_order_leaves_its_reason_in_the_attempt(bench: Any) -> None:
    """An attempt that was never served has a failure and no choice."""
    bench.context.refusals = [RefusedError("gw-1 is draining")]
    await bench.start()
    await bench.ordered()
    _, again = await bench.ordered()
    assert again.attempt == 2
    first = bench.coordinator.record.subtasks[0].attempts[0]
    assert first.choice is None
    assert first.failure is not None
