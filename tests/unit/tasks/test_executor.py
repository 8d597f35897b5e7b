"""Runs on one gateway, on a fake pool: orders that come twice, too late or while draining, and their outcomes."""

import asyncio
from collections.abc import Callable
from typing import Any, cast

import msgspec
import pytest
from msgspec.structs import replace

from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import (
    Attempt,
    Choice,
    Considered,
    Need,
    Phase,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    Subtask,
    SubtaskRecord,
    TaskRecord,
    TaskState,
    Way,
    encode,
    keyspace,
)
from appliance.model.task_api import RunAsk, RunStatus
from appliance.pool.selection import Decision
from appliance.tasks.checkpoints import read_checkpoint
from appliance.tasks.executor import Executor
from appliance.tasks.handoff import Reservations
from appliance.tasks.offload import RemoteContainers
from appliance.tasks.records import task_key

pytestmark = pytest.mark.anyio

REQUEST = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=Need(image="base"))
ATTEMPT = Attempt(number=1, gateway="gw-1")
ASK = RunAsk(task="t-1", subtask="s1", attempt=1)
AWAY = Decision(phase=Phase.REMOTE_WARM, gateway="gw-2", container="c2")


@pytest.fixture
async def executor(plane: Any, pool: Any, tasks_config: Any) -> Executor:
    """Return an executor that hears records."""
    made = Executor(plane, pool, RemoteContainers(plane, successors=3), tasks_config)
    await made.start()
    return made


async def finish(pool: Any, run_id: str = "t-1/s1/1", **fields: Any) -> None:
    """End a run with a success."""
    async with asyncio.timeout(60):
        while run_id not in pool.runs:
            await asyncio.sleep(0.001)
    task, subtask, attempt = run_id.split("/")
    pool.runs[run_id].set_result(
        RunEvent(
            **{"task": task, "subtask": subtask, "attempt": int(attempt), "kind": RunEventKind.SUCCEEDED, **fields}
        )
    )


async def last_event(plane: Any) -> RunEvent:
    """Wait for the final event that is published."""
    async with asyncio.timeout(60):
        while True:
            told = plane.session.sent(plane.keys(keyspace.RUN_EVENT, "t-1", "s1"), RunEvent)
            if told and told[-1].kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
                return told[-1]
            await asyncio.sleep(0.001)


async def until(holds: Callable[[], Any]) -> None:
    """Wait until something holds."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.001)


async def test_an_order_that_comes_twice_runs_once(executor: Executor, plane: Any, pool: Any) -> None:
    """Also while the first is still being decided on: both get the same answer, and nothing fails."""
    pool.gate = asyncio.Event()
    orders = [asyncio.create_task(executor.run(REQUEST)) for _ in range(2)]
    await until(lambda: executor._accepting)
    assert (await executor.status(ASK)).running
    pool.gate.set()
    one, other = await asyncio.gather(*orders)
    assert one == other == await executor.run(REQUEST)
    assert executor.running == 1
    await finish(pool, result={"ok": 1})
    assert (await last_event(plane)).result == {"ok": 1}


@pytest.mark.parametrize("why", ["drain", "cancel", "newer attempt"])
async def test_an_order_overtaken_while_it_is_decided_on_does_not_begin(
    executor: Executor, pool: Any, why: str
) -> None:
    """Draining, a cancel or a newer attempt that comes during the selection is heeded after it."""
    pool.gate = asyncio.Event()
    order = asyncio.create_task(executor.run(REQUEST))
    await until(lambda: executor._accepting)
    if why == "drain":
        await executor.drain(0.1)
    elif why == "cancel":
        await executor.cancel(ASK)
    else:
        newer = asyncio.create_task(executor.run(replace(REQUEST, attempt=2)))
        await until(lambda: executor._withdrawn)
    pool.gate.set()
    with pytest.raises(RefusedError):
        await order
    if why == "newer attempt":
        assert (await newer).gateway == "gw-1"
    assert "t-1/s1/1" not in pool.runs


async def test_an_order_is_passed_on_once(executor: Executor, plane: Any, pool: Any) -> None:
    """The gateway with the warm container answers; what was passed on is not passed on again."""

    async def take(gateway: str, request: RunRequest) -> RunAccepted:
        assert request.hops == 1
        return RunAccepted(gateway=gateway, container="c2", phase=Phase.REMOTE_WARM)

    plane.rpc.on["run"] = take
    pool.decisions = [AWAY]
    assert (await executor.run(REQUEST)).gateway == "gw-2"
    assert executor.running == 0
    pool.decision = Decision(phase=Phase.COLD, gateway="gw-1")
    with pytest.raises(RefusedError, match="no ready container"):
        await executor.run(replace(REQUEST, subtask="s2", hops=1))


async def test_an_order_gets_the_container_that_is_held_for_it(plane: Any, pool: Any, tasks_config: Any) -> None:
    """Nothing is selected for it again, and it is not passed on, wherever a better one may be by now."""
    reservations = Reservations("gw-1", pool)
    executor = Executor(plane, pool, RemoteContainers(plane, successors=3), tasks_config, reservations=reservations)
    await executor.start()
    held = await reservations.reserve(REQUEST)
    assert reservations.hold(REQUEST.run_id, held)
    pool.decisions, pool.asked = [AWAY], []
    assert (await executor.run(REQUEST)).container == "c1"
    assert pool.asked == []
    await finish(pool)


async def test_whoever_asks_after_a_run_that_was_passed_on_learns_where_it_is(
    executor: Executor, plane: Any, pool: Any, tasks_config: Any
) -> None:
    """A coordinator that has taken over knows only whom the order went to, which has not to say that there is no run.

    The same order begins nothing in a second place, a cancel goes on to where it runs, over a restart too, and the end
    of the task ends the remembering.
    """

    async def take(gateway: str, request: RunRequest) -> RunAccepted:
        return RunAccepted(gateway=gateway, container="c2", phase=Phase.REMOTE_WARM)

    async def answer(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=(gateway, ask) == ("gw-2", ASK))

    plane.rpc.on.update(run=take, run_status=answer, run_cancel=answer)
    pool.decisions = [AWAY]
    assert await executor.run(REQUEST) == await executor.run(REQUEST)
    assert [verb for _, verb, _ in plane.rpc.calls] == ["run"]
    assert (await executor.status(ASK)).running
    await executor.cancel(ASK)
    assert plane.rpc.calls[-1] == ("gw-2", "run_cancel", ASK)
    await until(lambda: plane.store.values)
    again = Executor(plane, pool, RemoteContainers(plane, successors=3), tasks_config)
    await again.start()
    assert (await again.status(ASK)).running
    plane.session.publish(keyspace.TASK_UPDATE, replace(plane.accepted(), state=TaskState.CANCELLED), "t-1")
    await until(lambda: not plane.store.values)
    assert await again.status(ASK) == await executor.status(ASK) == RunStatus(running=False)


@pytest.mark.parametrize("error", [DeadlineError("no answer"), UnreachableError("it went away", sent=True)])
async def test_a_pass_on_without_an_answer_is_not_run_here_as_well(
    executor: Executor, plane: Any, pool: Any, error: SwiftbotError
) -> None:
    """It may run there: the same attempt in two places is refused, and a new attempt left to the coordinator.

    Nothing is thought worse of the gateway: no answer is no container that was not there.
    """

    async def silent(gateway: str, request: RunRequest) -> RunAccepted:
        raise error

    plane.rpc.on["run"] = silent
    pool.decisions = [AWAY]
    with pytest.raises(UnreachableError, match="did not say"):
        await executor.run(REQUEST)
    assert executor.running == 0
    remote = executor._choosing._remote
    assert (remote._trust, remote._doubted, remote.searches["unanswered"]) == ({}, {}, 1)
    assert "stale offer" not in plane.session.refused


async def test_a_pass_on_to_a_lost_gateway_falls_back_to_here(executor: Executor, pool: Any) -> None:
    """Nobody there took it: what is left is here."""
    pool.decisions = [AWAY]
    assert (await executor.run(REQUEST)).gateway == "gw-1"


@pytest.mark.parametrize("result", [{"x": "y" * 60_000}, {"text": "\ud800"}, "deep"])
async def test_results_that_no_record_can_hold_fail_the_run(
    executor: Executor, plane: Any, pool: Any, result: Any
) -> None:
    """Oversize, not writable as JSON, nested without end: told as a failure, never silence."""
    if result == "deep":
        result = {}
        for _ in range(5000):
            result = {"a": result}
    await executor.run(REQUEST)
    await finish(pool, result=result)
    final = await last_event(plane)
    assert final.kind is RunEventKind.FAILED
    assert final.failure is not None
    assert final.failure.code == "payload"


async def test_an_outcome_is_told_although_it_cannot_be_kept(executor: Executor, plane: Any, pool: Any) -> None:
    """A full disk does not hide a success."""
    plane.store.problem = RefusedError("the disk is full")
    await executor.run(REQUEST)
    await finish(pool, result={})
    assert (await last_event(plane)).kind is RunEventKind.SUCCEEDED


async def test_orders_with_impossible_names_or_numbers_are_refused(executor: Executor) -> None:
    """Forged orders leave nothing behind."""
    for wrong in (
        {"task": "../x"},
        {"subtask": "a/b"},
        {"attempt": 0},
        {"deadline_s": 1e300},
        {"deadline_s": -1.0},
    ):
        with pytest.raises(PayloadError):
            await executor.run(replace(REQUEST, **cast("Any", wrong)))
    assert executor._kept.last == {}


async def test_a_run_is_ended_when_its_task_moves_on_or_ends(executor: Executor, plane: Any, pool: Any) -> None:
    """The record is the word: a run of a task that has ended is cancelled, also while this gateway drains."""
    await executor.run(REQUEST)
    await until(lambda: pool.runs)
    draining = asyncio.create_task(executor.drain(60.0))
    await until(lambda: executor.draining)
    record = plane.accepted()
    plane.session.publish(keyspace.TASK_UPDATE, replace(record, state=TaskState.CANCELLED), "t-1")
    await until(lambda: pool.cancelled)
    assert pool.cancelled == ["t-1/s1/1"]
    await finish(pool)
    await asyncio.wait_for(draining, 60)
    with pytest.raises(RefusedError, match="draining"):
        await executor.run(replace(REQUEST, subtask="s2"))


async def test_a_restart_tells_of_lost_runs_and_skips_what_it_cannot_read(
    plane: Any, pool: Any, tasks_config: Any
) -> None:
    """A run in progress at the end has failed, retryable; a damaged row does not keep the gateway from starting."""
    begun = RunEvent(task="t-1", subtask="s1", attempt=1, kind=RunEventKind.STARTED)
    plane.store.values = {"run/t-1/s1/1": encode(begun), "run/t-1/s2/1": b"\xff"}
    executor = Executor(plane, pool, RemoteContainers(plane, successors=3), tasks_config)
    await executor.start()
    status = await executor.status(ASK)
    assert not status.running
    assert status.last is not None
    assert status.last.failure is not None
    assert status.last.failure.retryable
    assert "run/t-1/s2/1" not in plane.store.values
    assert msgspec.json.decode(plane.store.values["run/t-1/s1/1"], type=RunEvent).kind is RunEventKind.FAILED


def away(gateway: str) -> Decision:
    """A decision for a container elsewhere, with what was considered."""
    considered = (
        Considered(gateway=gateway, container=f"c-{gateway}", way=Way.RUN_THERE, taken=True, verdict="taken"),
    )
    choice = Choice(
        phase=Phase.REMOTE_WARM, way=Way.RUN_THERE, by="gw-1", gateway=gateway, considered=considered, why="warm there"
    )
    return Decision(
        phase=Phase.REMOTE_WARM, gateway=gateway, container=f"c-{gateway}", way=Way.RUN_THERE, why="warm there",
        choice=choice,
    )  # fmt: skip


HERE = Decision(
    phase=Phase.COLD, gateway="gw-1", way=Way.NEW, why="a new one",
    choice=Choice(phase=Phase.COLD, way=Way.NEW, by="gw-1", gateway="gw-1", why="a new one"),
)  # fmt: skip


async def test_a_container_that_is_not_there_is_counted_and_the_next_candidate_taken(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """A stale offer costs one message; the choice names the gateway that had none, and the next one serves."""

    async def take(gateway: str, request: RunRequest) -> RunAccepted:
        if gateway == "gw-2":
            raise RefusedError("gw-2 has no ready container of base any more")
        return RunAccepted(gateway=gateway, container="other", phase=Phase.REMOTE_WARM)

    plane.rpc.on["run"] = take
    pool.decisions = [away("gw-2"), away("gw-3")]
    accepted = await executor.run(REQUEST)
    assert (accepted.gateway, accepted.container) == ("gw-3", "other")
    assert plane.session.refused == {"stale offer": 1}
    assert accepted.choice is not None
    assert accepted.choice.container == "other"
    verdicts = {each.gateway: each.verdict for each in accepted.choice.considered}
    assert verdicts["gw-2"].startswith("had none when asked: gw-2 has no ready container")
    assert pool.asked[1][2].keys() == {"gw-2"}


async def test_liars_all_around_end_in_a_cold_start_here(executor: Executor, plane: Any, pool: Any) -> None:
    """After three candidates that were nothing, what is here has to do, and the record says whom it tried."""

    async def none(gateway: str, request: RunRequest) -> RunAccepted:
        raise NotFoundError("no such thing")

    plane.rpc.on["run"] = none
    pool.decisions = [away("gw-2"), away("gw-3"), away("gw-4"), HERE]
    accepted = await executor.run(REQUEST)
    assert (accepted.gateway, accepted.phase) == ("gw-1", Phase.COLD)
    assert plane.session.refused == {"stale offer": 3}
    assert [allowed for allowed, _, _ in pool.asked] == [True, True, True, False]
    assert accepted.choice is not None
    assert [each.gateway for each in accepted.choice.considered] == ["gw-2", "gw-3", "gw-4"]


async def test_a_gateway_whose_offers_are_nothing_again_and_again_is_left_out(
    executor: Executor, plane: Any, pool: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three in a row, and it is not asked for a while; a good one in between begins again."""
    monkeypatch.setattr("appliance.tasks.offload.FIRST_LEFT_OUT_S", 10.0)  # or a slow machine is too late to see it
    refuse = True

    async def answer(gateway: str, request: RunRequest) -> RunAccepted:
        if refuse:
            raise RefusedError("none ready")
        return RunAccepted(gateway=gateway, container="c", phase=Phase.REMOTE_WARM)

    async def order(number: int, expected: str) -> None:
        pool.decisions = [away("gw-2"), HERE]
        assert (await executor.run(replace(REQUEST, subtask=f"s{number}"))).gateway == expected

    plane.rpc.on["run"] = answer
    await order(1, "gw-1")
    await order(2, "gw-1")
    refuse = False
    await order(3, "gw-2")
    refuse = True
    for number in range(4, 7):
        assert "gw-2" not in executor._choosing._remote.left_out()
        await order(number, "gw-1")
    assert "gw-2" in executor._choosing._remote.left_out()
    pool.asked.clear()
    pool.decisions = [HERE]
    await executor.run(replace(REQUEST, subtask="s9"))
    assert pool.asked[0][2] == {"gw-2": "its last 3 offers were nothing"}


async def test_a_runs_checkpoints_are_kept_and_told_without_their_data(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """The event is small, the data lies beside the record, where the next attempt finds it."""
    await executor.run(REQUEST)
    async with asyncio.timeout(60):
        while "t-1/s1/1" not in pool.tells:
            await asyncio.sleep(0.001)
    begun = RunEvent(task="t-1", subtask="s1", attempt=1, kind=RunEventKind.CHECKPOINT, result={"at": 7})
    pool.tells["t-1/s1/1"](begun)
    await finish(pool, kind=RunEventKind.FAILED)
    await last_event(plane)
    told = plane.session.sent(plane.keys(keyspace.RUN_EVENT, "t-1", "s1"), RunEvent)
    kept = [each for each in told if each.kind is RunEventKind.CHECKPOINT]
    assert [each.result for each in kept] == [None]
    kept = await read_checkpoint(plane.dht, "t-1", "s1")
    assert kept is not None
    assert kept.data == {"at": 7}


async def test_a_run_is_not_ended_by_the_word_of_a_coordinator_that_was_succeeded(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """After a partition the side that lost still tells of its later attempt: what the record itself says counts."""
    await executor.run(REQUEST)
    one, two = (
        msgspec.json.decode(encode(plane.accepted()), type=TaskRecord) for _ in range(2)
    )  # two versions of one task
    one = replace(one, subtasks=(SubtaskRecord(subtask=Subtask(id="s1", skill="work"), attempts=(ATTEMPT,)),))
    two = replace(two, subtasks=(replace(one.subtasks[0], attempts=(replace(ATTEMPT, number=2),)),))
    version = await plane.dht.write(task_key("t-1"), encode(one), expected=None)
    plane.session.publish(keyspace.TASK_UPDATE, two, "t-1")
    await asyncio.sleep(0.05)
    assert not pool.cancelled
    await plane.dht.write(task_key("t-1"), encode(two), expected=version)
    plane.session.publish(keyspace.TASK_UPDATE, two, "t-1")
    async with asyncio.timeout(60):
        while pool.cancelled != ["t-1/s1/1"]:
            await asyncio.sleep(0.005)
    await finish(pool)


async def test_a_run_of_a_subtask_that_a_revised_plan_left_out_is_ended(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """Its gateway may have been away when it was to be ended: the record, from which it is gone, ends it."""
    await executor.run(REQUEST)
    other = SubtaskRecord(subtask=Subtask(id="r1_1", skill="work"))
    revised = replace(plane.accepted(), subtasks=(other,), retired=("s1",))
    await plane.dht.write(task_key("t-1"), encode(revised), expected=None)
    plane.session.publish(keyspace.TASK_UPDATE, revised, "t-1")
    async with asyncio.timeout(60):
        while pool.cancelled != ["t-1/s1/1"]:
            await asyncio.sleep(0.005)
    await finish(pool)
