"""A large busy fleet, as a terminal UI hears it: real puts on the plane by one process, and answers to what it asks.

Run as `python -m workshop.bench.tui.feed OPTIONS-AS-JSON`; prints `ready` when it listens, and at the end of its input
how many updates it has put.
"""

import asyncio
import itertools
import random
import sys
import time

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    LogLine,
    Plan,
    Pose,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Tier,
    keyspace,
)
from appliance.model.plane_api import Facts, FactsAsk, Known, Member, MemberAsk
from appliance.model.task_api import TaskList, TasksAsk
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

_TICK_S = 0.02
_CONTAINERS = 4
"""Of each gateway."""
_PLAN = Plan(
    domain="inspection",
    subtasks=tuple(
        Subtask(id=f"s{number}", skill="goto", robot="any", params={"place": "gate"}) for number in range(4)
    ),
    tier=Tier.LOCAL,
    confidence=0.93,
)


class Size(Struct, frozen=True, kw_only=True):
    """How large the fleet is, and how many updates a second it puts."""

    fleet: str
    listen: str
    gateways: int = 100
    robots: int = 500
    tasks: int = 1000
    rate: int = 2000


class Feed:
    """The facts of the fleet, and their changes."""

    def __init__(self, session: Session, size: Size) -> None:
        self.put = 0
        """Updates so far."""
        self._session = session
        self._size = size
        self._chance = random.Random(1)  # noqa: S311 - the same fleet each time
        self._gateways = [self._gateway(number) for number in range(size.gateways)]
        self._containers = {each.id: self._pool(each.id) for each in self._gateways}
        self._robots = [
            RobotInfo(
                id=f"robot-{number}", kind="mavlink", gateway=self._gateways[number % size.gateways].id, mode="AUTO",
                pose=Pose(x=float(number)), battery_percent=80.0,
            )
            for number in range(size.robots)
        ]  # fmt: skip
        self._tasks = [self._task(number) for number in range(size.tasks)]
        self._turns = {kind: itertools.count() for kind in ("gateway", "robot", "task", "container")}

    def _gateway(self, number: int) -> GatewayStatus:
        return GatewayStatus(
            id=f"gw-{number:03}", fleet=self._size.fleet, version="0.1.0", cores=4, capacity=8, containers=_CONTAINERS,
            ready=3, models=("local:plan", "rules"), started_ns=time.time_ns(), again_ms=60_000,
        )  # fmt: skip

    def _pool(self, gateway: str) -> tuple[ContainerInfo, ...]:
        return tuple(
            ContainerInfo(
                id=f"{gateway}-c{number}", gateway=gateway, image=f"localhost/swiftbot/image-{number}:1",
                state=ContainerState.READY, since_ns=time.time_ns(),
            )
            for number in range(_CONTAINERS)
        )  # fmt: skip

    def _task(self, number: int) -> TaskRecord:
        return TaskRecord(
            id=f"t-{number:04}", instruction=f"inspect section {number} and report what is there", plan=_PLAN,
            state=TaskState.RUNNING, coordinator=self._gateways[number % self._size.gateways].id, created_ns=number + 1,
            subtasks=tuple(SubtaskRecord(subtask=each, state=SubtaskState.RUNNING) for each in _PLAN.subtasks),
        )  # fmt: skip

    def serve(self) -> None:
        """Show all gateways, and answer what a client asks them."""
        keys = self._session.keys
        known = tuple(
            Known(gateway=each.id, status=each, containers=self._containers[each.id]) for each in self._gateways
        )
        for status in self._gateways:
            rpc = Rpc(self._session, status.id)

            async def facts(ask: FactsAsk, status: GatewayStatus = status) -> Facts:
                return Facts(
                    status.id, status, self._containers[status.id], tuple(self._robots) if ask.all else (),
                    tuple(each for each in known if each.gateway > ask.after) if ask.all else (),
                )  # fmt: skip

            rpc.register(keyspace.FACTS, facts)
            rpc.register(keyspace.MEMBER, _member)
            rpc.register(keyspace.TASKS, self._listed)
            self._session.declare_alive(keys(keyspace.GATEWAY_ALIVE, status.id))

    async def _listed(self, ask: TasksAsk) -> TaskList:
        return TaskList(tasks=tuple(reversed(self._tasks[-ask.limit :])))

    def begin(self) -> None:
        """Tell everything once."""
        for number in range(self._size.gateways):
            self._put_gateway(number)
        for number in range(self._size.robots):
            self._put_robot(number)
        for number in range(self._size.tasks):
            self._put_task(number)

    def step(self, count: int) -> None:
        """Put so many changes: half are of robots, four in ten of tasks, the rest of gateways, containers and logs."""
        for _ in range(count):
            dice = self._chance.random()
            if dice < 0.5:
                self._put_robot(next(self._turns["robot"]) % self._size.robots)
            elif dice < 0.9:
                self._put_task(next(self._turns["task"]) % self._size.tasks)
            elif dice < 0.96:
                self._put_gateway(next(self._turns["gateway"]) % self._size.gateways)
            elif dice < 0.99:
                self._put_container(next(self._turns["container"]) % self._size.gateways)
            else:
                name = self._chance.choice(self._gateways).id
                line = LogLine(at_ns=time.time_ns(), level="info", source=name, event="container started")
                self._session.publish(keyspace.LOG, line, name)
            self.put += 1

    def _put_gateway(self, number: int) -> None:
        status = self._gateways[number] = replace(
            self._gateways[number], load=self._chance.random(), cpu_percent=100 * self._chance.random()
        )
        self._session.publish(keyspace.STATUS, status, status.id)

    def _put_container(self, number: int) -> None:
        gateway = self._gateways[number].id
        first, *others = self._containers[gateway]
        busy = first.state is ContainerState.READY
        first = replace(first, state=ContainerState.BUSY if busy else ContainerState.READY, runs=first.runs + 1)
        self._containers[gateway] = (first, *others)
        self._session.publish(keyspace.CONTAINER, first, gateway, first.id)

    def _put_robot(self, number: int) -> None:
        pose = Pose(x=100 * self._chance.random(), y=100 * self._chance.random(), z=10.0)
        info = self._robots[number] = replace(
            self._robots[number], pose=pose, battery_percent=100 * self._chance.random()
        )
        self._session.publish(keyspace.ROBOT, info, info.id)

    def _put_task(self, number: int) -> None:
        record = self._tasks[number]
        first, *others = record.subtasks
        first = replace(first, progress=self._chance.random(), note=f"leg {record.sequence}")
        record = self._tasks[number] = replace(record, subtasks=(first, *others), sequence=record.sequence + 1)
        self._session.publish(keyspace.TASK_UPDATE, record, record.id)


async def _member(ask: MemberAsk) -> Member:
    return Member(here=bool(ask.gateway))


async def feed(size: Size) -> None:
    """Be the fleet until the input ends."""
    session = await Session.open(PlaneConfig(listen=(size.listen,)), size.fleet)
    try:
        fleet = Feed(session, size)
        fleet.serve()
        fleet.begin()
        print("ready", flush=True)
        ended = asyncio.create_task(asyncio.to_thread(sys.stdin.read))
        began = time.monotonic()
        while not ended.done():
            await asyncio.sleep(_TICK_S)
            due = int((time.monotonic() - began) * size.rate)
            fleet.step(min(size.rate, due - fleet.put))
        print(msgspec.json.encode({"put": fleet.put, "seconds": time.monotonic() - began}).decode(), flush=True)
    finally:
        await session.close()


if __name__ == "__main__":
    asyncio.run(feed(msgspec.json.decode(sys.argv[1], type=Size)))
