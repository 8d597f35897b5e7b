"""Runs that wait at a busy gateway: offered elsewhere when there is room, back to their place when not, never twice."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import (
    Choice,
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Need,
    Phase,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    Way,
    keyspace,
)
from appliance.model.task_api import RunAsk, RunStatus
from appliance.plane.events import FactsChanged
from appliance.pool.selection import Decision
from appliance.tasks.executor import Executor
from appliance.tasks.offload import Offer, RemoteContainers, choose

pytestmark = pytest.mark.anyio

NEED = Need(image="base")
REQUEST = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=NEED)
ASK = RunAsk(task="t-1", subtask="s1", attempt=1)
GATEWAYS = ("gw-1", "gw-2", "gw-3", "gw-4")


@st.composite
def statuses(draw: st.DrawFn) -> dict[str, GatewayStatus]:
    """Gateways in whatever state."""
    return {
        name: GatewayStatus(
            id=name,
            fleet="f",
            load=draw(st.floats(0, 1)),
            capacity=draw(st.integers(0, 8)),
            containers=draw(st.integers(0, 8)),
            running=draw(st.integers(0, 8)),
            queue=draw(st.integers(0, 2)),
            draining=draw(st.booleans()),
            pool_problem=draw(st.sampled_from(("", "Podman is away"))),
            pool_memory_mb=draw(st.sampled_from((0, 64, 4096))),
        )
        for name in draw(st.sets(st.sampled_from(GATEWAYS)))
    }


def ready(gateway: str, image: str = "base") -> ContainerInfo:
    """Return a ready container."""
    return ContainerInfo(id=f"c-{gateway}", gateway=gateway, image=image, state=ContainerState.READY)


@settings(deadline=None)
@given(
    statuses(),
    st.sets(st.sampled_from(GATEWAYS[1:])),
    st.sets(st.sampled_from(GATEWAYS)),
    st.floats(0, 60),
    st.one_of(st.none(), st.floats(0, 60)),
)
def test_an_offer_is_always_one_that_can_be_taken(
    gateways: dict[str, GatewayStatus], holders: set[str], within: set[str], waited_s: float, expected_s: float | None
) -> None:
    """Never to here or outside of what is allowed; a new container where there is room, and when it is worth it."""
    offer = choose(
        avoid={"gw-1"},
        ready=[ready(each) for each in sorted(holders)],
        gateways=gateways,
        need=NEED,
        within=sorted(within),
        waited_s=waited_s,
        expected_s=expected_s,
        cold_s=0.5,
    )
    draining = {name for name, status in gateways.items() if status.draining}
    allowed = {each for each in holders - draining if not within or each in within}
    if offer is None:
        assert not allowed
        return
    assert offer.gateway != "gw-1"
    assert not within or offer.gateway in within
    if not offer.new_container:
        assert offer.gateway in allowed
        return
    assert not allowed
    assert max(waited_s, expected_s or 0.0) >= 0.5
    status = gateways[offer.gateway]
    assert not status.draining
    assert not status.pool_problem
    assert status.queue == 0
    assert status.containers < status.capacity


def test_the_right_image_and_the_least_load_are_preferred() -> None:
    """A container of the image itself before a compatible one, then the gateway with less to do."""
    gateways = {
        name: GatewayStatus(id=name, fleet="f", load=load)
        for name, load in {"gw-2": 0.1, "gw-3": 0.8, "gw-4": 0.3}.items()
    }
    found = choose(
        avoid={"gw-1"}, ready=[ready("gw-2", "vision"), ready("gw-3"), ready("gw-4")], gateways=gateways, need=NEED,
        within=(), waited_s=0.0, expected_s=None, cold_s=0.5,
    )  # fmt: skip
    assert found == Offer(gateway="gw-4", new_container=False, why="gw-4 has a ready container")


# --- the way of a run ------------------------------------------------------------------------------------------


@pytest.fixture
async def executor(plane: Any, pool: Any, tasks_config: Any) -> AsyncIterator[Executor]:
    """Return an executor whose pool has everything busy."""
    pool.full = True
    pool.decision = Decision(phase=Phase.COLD, gateway="gw-1", way=Way.NEW, why="a new one")
    made = Executor(plane, pool, RemoteContainers(plane, successors=3), tasks_config)
    await made.start()
    yield made
    made._passing.stop()


def hear_of(plane: Any, gateway: str) -> None:
    """A container of another gateway becomes ready, and that is heard."""
    plane.registry.containers[gateway] = {f"c-{gateway}": ready(gateway)}
    plane.registry.ages[gateway] = 0.0
    plane.events.publish(FactsChanged("container"))


async def until(holds: Any) -> None:
    """Wait until something holds."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.005)


def told(plane: Any, kind: RunEventKind) -> list[RunEvent]:
    """What was told of the run, of one kind."""
    return [
        each for each in plane.session.sent(plane.keys(keyspace.RUN_EVENT, "t-1", "s1"), RunEvent) if each.kind is kind
    ]


async def test_a_waiting_run_goes_where_a_container_becomes_ready(executor: Executor, plane: Any, pool: Any) -> None:
    """Accepted here, passed on once, and from then on asked after and cancelled there; no end is published."""
    orders: list[tuple[str, RunRequest]] = []

    async def take(gateway: str, request: RunRequest) -> RunAccepted:
        orders.append((gateway, request))
        choice = Choice(phase=Phase.LOCAL_WARM, way=Way.HERE, by=gateway, gateway=gateway)
        return RunAccepted(gateway=gateway, container="c", phase=Phase.REMOTE_WARM, choice=choice)

    async def status(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=True, position=1)

    plane.rpc.on |= {"run": take, "run_status": status, "run_cancel": status}
    assert (await executor.run(REQUEST)).gateway == "gw-1"
    await until(lambda: pool.line)
    assert (await executor.status(ASK)).position == 1
    hear_of(plane, "gw-2")
    await until(lambda: executor.running == 0)
    assert [(gateway, order.hops, order.new_container) for gateway, order in orders] == [("gw-2", 1, False)]
    moved = told(plane, RunEventKind.PROGRESS)[-1]
    assert moved.gateway == "gw-2"
    assert moved.choice is not None
    assert "waited" in moved.choice.why
    assert not told(plane, RunEventKind.FAILED)
    assert (await executor.status(ASK)).running
    await executor.cancel(ASK)
    assert [(gateway, verb) for gateway, verb, _ in plane.rpc.calls][-1] == ("gw-2", "run_cancel")
    assert executor._choosing._remote.searches["moved"] == 1


async def test_a_pool_that_keeps_to_itself_offers_nothing(plane: Any, pool: Any, tasks_config: Any) -> None:
    """With `pool.mode` local or cold, which are there to be compared with, a run waits where it was ordered."""
    pool.full, pool.federated = True, False
    pool.decision = Decision(phase=Phase.COLD, gateway="gw-1", way=Way.NEW, why="a new one")
    executor = Executor(plane, pool, RemoteContainers(plane, successors=3), tasks_config)
    await executor.start()
    await executor.run(REQUEST)
    await until(lambda: pool.line)
    hear_of(plane, "gw-2")
    await asyncio.sleep(0.1)
    assert len(pool.line) == 1
    assert not plane.rpc.calls
    executor._passing.stop()


async def test_a_run_that_is_not_taken_goes_back_to_its_place(executor: Executor, plane: Any, pool: Any) -> None:
    """The container was gone: it waits here again since it first came, is offered again later, and ends here."""

    async def refuse(gateway: str, request: RunRequest) -> RunAccepted:
        raise RefusedError("gone")

    plane.rpc.on["run"] = refuse
    await executor.run(REQUEST)
    await until(lambda: pool.line)
    since = pool.line[0][0].since
    hear_of(plane, "gw-2")
    await until(lambda: plane.session.refused.get("stale offer", 0) >= 2)
    await until(lambda: pool.line)
    assert pool.line[0][0].since == since
    plane.registry.containers.clear()
    run = pool.runs["t-1/s1/1"]
    pool.line.clear()
    run.set_result(RunEvent(task="t-1", subtask="s1", attempt=1, kind=RunEventKind.SUCCEEDED))
    await until(lambda: told(plane, RunEventKind.SUCCEEDED))
    assert told(plane, RunEventKind.SUCCEEDED)[0].gateway == "gw-1"


@pytest.mark.parametrize("error", [DeadlineError("no answer"), UnreachableError("it went away", sent=True)])
async def test_a_run_that_may_or_may_not_have_been_taken_is_not_begun_here(
    executor: Executor, plane: Any, pool: Any, error: SwiftbotError
) -> None:
    """Without an answer the attempt has failed as unreachable, so that only a new one, which fences it, follows.

    The offer was neither good nor empty: the gateway is not left out for it.
    """

    async def silent(gateway: str, request: RunRequest) -> RunAccepted:
        raise error

    plane.rpc.on["run"] = silent
    await executor.run(REQUEST)
    await until(lambda: pool.line)
    hear_of(plane, "gw-2")
    await until(lambda: told(plane, RunEventKind.FAILED))
    failure = told(plane, RunEventKind.FAILED)[0].failure
    assert failure is not None
    assert (failure.code, failure.retryable) == ("unreachable", True)
    assert not pool.line
    remote = executor._choosing._remote
    assert (remote._trust, remote._doubted, remote.searches["unanswered"]) == ({}, {}, 1)
    assert "stale offer" not in plane.session.refused


async def test_a_run_offered_to_a_gateway_that_nobody_reaches_waits_on_here(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """The order went nowhere, so nobody has taken it: the run is back in its place, and that gateway is doubted."""

    async def gone(gateway: str, request: RunRequest) -> RunAccepted:
        raise UnreachableError("nobody answers")

    plane.rpc.on["run"] = gone
    await executor.run(REQUEST)
    await until(lambda: pool.line)
    hear_of(plane, "gw-2")
    await until(lambda: plane.session.refused.get("stale offer", 0) >= 1)
    await until(lambda: pool.line)
    assert not told(plane, RunEventKind.FAILED)
    assert "gw-2" in executor._choosing._remote._trust


async def test_a_run_that_is_called_off_while_it_is_offered_is_ended_where_it_went(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """The cancel comes while the other gateway decides: it follows the run there."""
    asked, answer = asyncio.Event(), asyncio.Event()

    async def take(gateway: str, request: RunRequest) -> RunAccepted:
        asked.set()
        await answer.wait()
        return RunAccepted(gateway=gateway, container="c", phase=Phase.REMOTE_WARM)

    async def cancelled(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=False)

    plane.rpc.on |= {"run": take, "run_cancel": cancelled}
    await executor.run(REQUEST)
    await until(lambda: pool.line)
    hear_of(plane, "gw-2")
    await asyncio.wait_for(asked.wait(), 60)
    await executor.cancel(ASK)
    answer.set()
    await until(lambda: ("gw-2", "run_cancel") in [(gateway, verb) for gateway, verb, _ in plane.rpc.calls])


async def test_runs_stay_that_were_passed_on_that_need_state_or_that_may_not_go(
    executor: Executor, plane: Any, pool: Any
) -> None:
    """One hop is the most; state is on its way here already; a group is a limit."""
    stay = (
        replace(REQUEST, subtask="a", hops=1, new_container=True),
        replace(REQUEST, subtask="b", need=Need(image="base", volumes=("maps",))),
        replace(REQUEST, subtask="c", group=("gw-1", "gw-3")),
    )
    for each in stay:
        await executor.run(each)
    await until(lambda: len(pool.line) == len(stay))
    hear_of(plane, "gw-2")
    await asyncio.sleep(0.1)
    assert len(pool.line) == len(stay)
    assert not plane.rpc.calls


async def test_a_run_passed_on_to_be_started_anew_is_refused_where_there_is_no_room(
    executor: Executor, pool: Any
) -> None:
    """The asker has a queue itself: it must not get into another one. With room, it is a cold start there."""
    pool.full, pool.room = False, False
    with pytest.raises(RefusedError, match="no room"):
        await executor.run(replace(REQUEST, hops=1, new_container=True))
    with pytest.raises(RefusedError, match="no ready container"):
        await executor.run(replace(REQUEST, attempt=2, hops=1))
    pool.room = True
    assert (await executor.run(replace(REQUEST, attempt=3, hops=1, new_container=True))).phase is Phase.COLD
