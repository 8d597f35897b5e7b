# ruff: noqa: ARG002 - fakes take what the real ones take
"""A small fake of a gateway's surroundings: records, RPC, messages and a pool in memory, under the test's control.

They exist so that the shells (driver, executor, calls, manager) are tested where things go wrong: lost answers,
records that move on, gateways that vanish, without processes, sockets or containers.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest

from appliance.errors import ConflictError, NotFoundError, PlanError, SwiftbotError, UnreachableError
from appliance.model import (
    Choice,
    Group,
    Need,
    Phase,
    Plan,
    RobotInfo,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    Subtask,
    SubtaskRecord,
    TaskRecord,
    VersionVector,
    encode,
)
from appliance.plane.dht import Record
from appliance.plane.keys import Keys
from appliance.plane.session import Message
from appliance.pool.books import WithdrawnError
from appliance.pool.selection import Decision
from appliance.pool.turns import Turn
from appliance.skills.catalogue import Catalogue, SkillManifest
from appliance.tasks import machine
from appliance.tasks.checkpoints import Checkpoint
from appliance.tasks.driver import Driver
from appliance.tasks.line import Place
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.placement import Placement
from appliance.tasks.replan.robots import Robots
from appliance.tasks.settings import TasksConfig
from appliance.tasks.surroundings import FREE, Input, RunNews, Steered, task_key

FAST = TasksConfig(check_s=0.03, grace_s=0.1, run_timeout_s=0.05)


class FakeCloser:
    """Counts nothing, closes nothing."""

    def close(self) -> None:
        """Do nothing."""


class FakeSession:
    """Delivers what is put to whoever subscribed, at once; keeps everything."""

    def __init__(self) -> None:
        self.keys = Keys("f")
        self.puts: list[tuple[str, bytes]] = []
        self.refused: dict[str, int] = {}
        self.subscribers: list[tuple[str, Callable[[Message], None]]] = []
        self.queries: list[bytes] = []
        self.replies: list[bytes | SwiftbotError] = []

    def put(self, key: str, payload: bytes) -> None:
        """Keep and deliver."""
        self.puts.append((key, payload))
        for expr, callback in list(self.subscribers):
            if _matches(expr, key):
                callback(Message(key, payload, deleted=False, at_ns=0, encoding=""))

    def subscribe(self, expr: str, callback: Callable[[Message], None]) -> FakeCloser:
        """Deliver raw messages."""
        self.subscribers.append((expr, callback))
        return FakeCloser()

    def subscribe_typed(self, expr: str, kind: type[Any], callback: Callable[[str, Any], None]) -> FakeCloser:
        """Deliver decoded messages."""
        return self.subscribe(
            expr, lambda message: callback(message.key, msgspec.json.decode(message.payload, type=kind))
        )

    def refuse(self, what: str, **_: object) -> None:
        """Count."""
        self.refused[what] = self.refused.get(what, 0) + 1

    async def query(self, key: str, payload: bytes, *, timeout_s: float) -> bytes:
        """Answer with the next prepared reply; the last one again and again."""
        self.queries.append(payload)
        await asyncio.sleep(0)
        reply = self.replies.pop(0) if len(self.replies) > 1 else self.replies[0]
        if isinstance(reply, SwiftbotError):
            raise reply
        return reply

    def sent(self, key: str, kind: type[Any]) -> list[Any]:
        """What was put on a key, decoded."""
        return [msgspec.json.decode(payload, type=kind) for at, payload in self.puts if _matches(key, at)]


def _matches(expr: str, key: str) -> bool:
    ours, theirs = expr.split("/"), key.split("/")
    return len(ours) == len(theirs) and all(a in ("*", b) for a, b in zip(ours, theirs, strict=True))


class FakeDht:
    """Records with compare-and-set; `break_next` makes the next writes fail."""

    def __init__(self, gateway: str) -> None:
        self.records: dict[str, Record] = {}
        self.gateway = gateway
        self.mine = True
        self.break_next: list[Exception] = []
        self.on_ring_change: list[Callable[[], None]] = []
        self.resolver: object = None
        self.writes = 0

    async def read(self, key: str) -> Record | None:
        """Return a record."""
        await asyncio.sleep(0)
        return self.records.get(key)

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, durable: bool = True
    ) -> VersionVector:
        """Compare and set."""
        await asyncio.sleep(0)
        if self.break_next:
            raise self.break_next.pop(0)
        current = self.records.get(key)
        if (current.version if current else None) != expected:
            raise ConflictError(f"{key} has moved on")
        self.writes += 1
        version = {self.gateway: self.writes}
        self.records[key] = Record(key=key, value=value, version=version)
        return version

    async def remove(self, key: str, *, expected: VersionVector) -> None:
        """Remove, if it has not moved on."""
        await asyncio.sleep(0)
        if self.records[key].version != expected:
            raise ConflictError(f"{key} has moved on")
        del self.records[key]

    async def local(self, prefix: str) -> list[Record]:
        """Return the shard."""
        await asyncio.sleep(0)
        return [record for key, record in self.records.items() if key.startswith(prefix)]

    def owns(self, key: str) -> bool:
        """Whether all keys are ours."""
        return self.mine


class FakeRpc:
    """Answers calls by functions of the test, `on[verb]`; without one nobody answers."""

    def __init__(self) -> None:
        self.on: dict[str, Callable[[str, Any], Awaitable[Any]]] = {}
        self.calls: list[tuple[str, str, Any]] = []
        self.registered: dict[str, Callable[[Any], Awaitable[Any]]] = {}

    def register(self, verb: str, request: type[Any], handler: Callable[[Any], Awaitable[Any]]) -> None:
        """Keep a handler."""
        self.registered[verb] = handler

    async def call(self, gateway: str, verb: str, request: Any, reply: type[Any], *, timeout_s: float = 5.0) -> Any:
        """Ask the test."""
        self.calls.append((gateway, verb, request))
        await asyncio.sleep(0)
        if verb not in self.on:
            raise UnreachableError(f"nobody answers {verb} on {gateway}")
        return await self.on[verb](gateway, request)


class FakeStore:
    """Keys and values; `problem` makes writes fail."""

    def __init__(self) -> None:
        self.values: dict[str, bytes] = {}
        self.problem: SwiftbotError | None = None

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Keep."""
        if self.problem:
            raise self.problem
        self.values[key] = value

    async def delete(self, key: str) -> None:
        """Forget."""
        self.values.pop(key, None)

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return what begins so."""
        return [(key, value) for key, value in self.values.items() if key.startswith(prefix)]


class FakeRegistry:
    """Facts of others."""

    def __init__(self) -> None:
        self.gateways: dict[str, Any] = {}
        self.containers: dict[str, Any] = {}
        self.robots: dict[str, Any] = {}
        self.on_change: list[Callable[[str], None]] = []
        self.ages: dict[str, float] = {}

    def age_s(self, gateway: str) -> float:
        """Return what the test says; by default nothing was ever heard."""
        return self.ages.get(gateway, math.inf)

    def keeps_promise(self, gateway: str) -> bool:
        """Return that nobody promised anything."""
        return False

    def stale_s(self, gateway: str) -> float:
        """Return that nobody is late."""
        return 0.0

    def doubt(self, gateway: str) -> None:
        """Ask nobody."""

    def asked(self, image: str, *, here: bool = True) -> None:
        """Take no notice."""


class FakeRing:
    """One owner for all."""

    def __init__(self, owner: str) -> None:
        self.name = owner

    def owner(self, key: str) -> str:
        """Return it."""
        return self.name

    def successors(self, key: str, count: int) -> tuple[str, ...]:
        """Return three."""
        return ("gw-1", "gw-2", "gw-3")[:count]


class FakePlane:
    """A plane in memory."""

    plan_of: Callable[..., Plan]

    def __init__(self, gateway: str = "gw-1") -> None:
        self.gateway = gateway
        self.session = FakeSession()
        self.keys = self.session.keys
        self.dht = FakeDht(gateway)
        self.rpc = FakeRpc()
        self.store = FakeStore()
        self.registry = FakeRegistry()
        self.ring = FakeRing(gateway)
        self.present = {"gw-1", "gw-2", "gw-3"}
        self.on_member_lost: list[Callable[[str], None]] = []

    async def owner_of(self, key: str) -> str:
        """Return the one owner."""
        return self.ring.owner(key)

    def members(self) -> frozenset[str]:
        """Return who is there."""
        return frozenset(self.present)

    def accepted(self, task: str = "t-1", plan: Plan | None = None) -> TaskRecord:
        """Return a record just accepted here."""
        return accepted(task, plan, self.gateway)


class FakePool:
    """Selects at once or when `gate` opens; runs end when the test says how."""

    def __init__(self) -> None:
        self.decision = Decision(phase=Phase.LOCAL_WARM, gateway="gw-1", container="c1", why="warm")
        self.decisions: list[Decision] = []
        self.gate: asyncio.Event | None = None
        self.asked: list[tuple[bool, dict[str, int], dict[str, str]]] = []
        self.cancelled: list[str] = []
        self.tells: dict[str, Callable[[RunEvent], None]] = {}
        self.runs: dict[str, asyncio.Future[RunEvent]] = {}
        self.line: list[tuple[Turn, Need]] = []
        self.full = False
        self.room = True
        self.federated = True

    async def select(
        self,
        need: Need,
        *,
        allow_remote: bool,
        inputs: Mapping[str, int],
        avoid: Mapping[str, str],
        turn: Turn | None = None,
    ) -> Decision:
        """Return the prepared decision."""
        self.asked.append((allow_remote, dict(inputs), dict(avoid)))
        if self.gate is not None:
            await self.gate.wait()
        return self.decisions.pop(0) if self.decisions else self.decision

    def waiting(self) -> list[tuple[Turn, Need]]:
        """Return those whom the test has wait."""
        return self.line

    @property
    def queue(self) -> int:
        """How many wait."""
        return len(self.line)

    def withdraw(self, run_id: str) -> bool:
        """Take a run out of the line."""
        before = len(self.line)
        self.line = [each for each in self.line if each[0].id != run_id]
        if len(self.line) == before:
            return False
        self.runs[run_id].set_exception(WithdrawnError("withdrawn"))
        return True

    def expected_s(self, position: int) -> float | None:
        """Return a second for each place."""
        return float(position)

    def cold_ms(self, image: str) -> float:
        """Return what a cold start takes."""
        return 500.0

    def has_room(self, need: Need) -> bool:
        """Return what the test says."""
        return self.room

    async def run(
        self,
        request: RunRequest,
        decision: Decision,
        on_event: Callable[[RunEvent], None],
        *,
        turn: Turn | None = None,
    ) -> RunEvent:
        """Wait for the test."""
        if self.full and turn is not None:
            self.runs[request.run_id] = asyncio.get_running_loop().create_future()
            self.line.append((turn, request.need))
            return await self.runs[request.run_id]
        self.tells[request.run_id] = on_event
        future = self.runs[request.run_id] = asyncio.get_running_loop().create_future()
        on_event(event(request, RunEventKind.STARTED, startup_ms=1.0))
        return await future

    async def cancel(self, run_id: str) -> bool:
        """Remember."""
        self.cancelled.append(run_id)
        return True


def event(request: RunRequest, kind: RunEventKind, **fields: Any) -> RunEvent:
    """Return an event of a run."""
    return RunEvent(
        **{"task": request.task, "subtask": request.subtask, "attempt": request.attempt, "kind": kind, **fields}
    )


def manifest(skill: str = "work", **fields: Any) -> SkillManifest:
    """Return a skill's manifest."""
    return SkillManifest(
        **{"id": skill, "domain": "any", "summary": "works", "runs": "compute", "image": "base", "retries": 1, **fields}
    )


CATALOGUE = cast("Catalogue", type("C", (), {"skills": {"work": manifest()}, "domains": ("any",), "images": {}})())


def plan_of(*subtasks: Subtask) -> Plan:
    """Return a plan; by default of one subtask s1."""
    return Plan(domain="any", subtasks=subtasks or (Subtask(id="s1", skill="work"),))


FakePlane.plan_of = staticmethod(plan_of)


def accepted(task: str = "t-1", plan: Plan | None = None, coordinator: str = "gw-1") -> TaskRecord:
    """Return a record just accepted."""
    return machine.apply(
        None,
        Transition(
            task=task,
            sequence=1,
            kind=TransitionKind.ACCEPTED,
            at_ns=1,
            coordinator=coordinator,
            instruction="work",
            plan=plan,
        ),
    )


class FakeRecovery:
    """Facts for the monitor and replanning; `new_plan` is what the decomposer answers."""

    def __init__(self, skills: Callable[[], dict[str, SkillManifest]]) -> None:
        self._skills = skills
        self.roster: dict[str, RobotInfo] = {}
        self.known: dict[str, tuple[float, ...]] = {}
        self.noted: list[str] = []
        self.new_plan: Plan | Exception = PlanError("no planner is configured")
        self.asked: list[TaskRecord] = []
        self.asking: asyncio.Event | None = None
        self.forbidden: tuple[str, ...] = ()

    @property
    def manifests(self) -> dict[str, SkillManifest]:
        """Return the manifests."""
        return self._skills()

    def robots(self) -> Robots:
        """Return the roster."""
        return Robots(roster=self.roster)

    def experience(self, skill: str) -> tuple[float, ...]:
        """Return what is known."""
        return self.known.get(skill, ())

    def published(self, transition: Transition) -> None:
        """Hear of a transition."""

    def note(self, what: str, record: TaskRecord, target: SubtaskRecord, why: str) -> None:
        """Remember."""
        self.noted.append(what)

    def against(self, record: TaskRecord, target: SubtaskRecord, plan: Plan, robot: str = "") -> tuple[str, ...]:
        """Return what the test forbids: robots that take over, skills."""
        return tuple(f"{each} is forbidden" for each in self.forbidden if each in (robot, plan.subtasks[-1].skill))

    async def replan(self, record: TaskRecord) -> Plan:
        """Return the new plan or raise it."""
        self.asked.append(record)
        if self.asking is not None:
            await self.asking.wait()
        if isinstance(self.new_plan, Exception):
            raise self.new_plan
        return self.new_plan


class FakeSurroundings:
    """What a driver needs, with all of it in the test's hands."""

    def __init__(self, plane: FakePlane, plan: Plan | None = None) -> None:
        self.plane = plane
        self.config = FAST
        self.skills = {"work": manifest()}
        self.recovery = FakeRecovery(lambda: self.skills)
        self.the_plan: Plan | Exception = plan or plan_of()
        self.planning: asyncio.Event | None = None
        self.robot: tuple[str | None, str] = ("r1", "")
        self.places: list[str] = ["gw-1", "gw-2"]
        self.orders: asyncio.Queue[tuple[str, RunRequest]] = asyncio.Queue()
        self.refusals: list[Exception] = []
        self.passed_to = ""
        self.groups: list[Group] = []
        self.room = True
        self.left_s: list[float] = []
        self.expected = ""
        self.moved: list[tuple[tuple[str, ...], dict[str, float]]] = []
        self.durations: list[tuple[str, float]] = []
        self.checkpoints: dict[str, Checkpoint] = {}
        self.forgotten: list[str] = []
        self.choice: Choice | None = None
        self.slow_answer: asyncio.Event | None = None
        self.commands: Any = FREE
        self.approve_why = ""
        self.problems: tuple[str, ...] = ()

    def approval(self, record: TaskRecord, plan: Plan) -> str:
        """Return why the test wants it approved."""
        return self.approve_why

    def plan_problems(self, record: TaskRecord, plan: Plan) -> tuple[str, ...]:
        """Return what the test says is wrong."""
        return self.problems

    async def plan(self, record: TaskRecord) -> Plan:
        """Return the plan or raise it."""
        if self.planning is not None:
            await self.planning.wait()
        if isinstance(self.the_plan, Exception):
            raise self.the_plan
        return self.the_plan

    def manifest(self, skill: str) -> SkillManifest:
        """Return a manifest."""
        if skill not in self.skills:
            raise NotFoundError(f"no skill {skill}")
        return self.skills[skill]

    def bind(self, record: TaskRecord, target: SubtaskRecord) -> tuple[str | None, str]:
        """Return the robot."""
        return self.robot

    def place(self, record: TaskRecord, target: SubtaskRecord, robot: str | None) -> Placement:
        """Gateways in order, those where it failed last."""
        failed = {each.gateway for each in target.attempts if each.failure}
        return Placement(order=tuple(sorted(self.places, key=lambda each: each in failed)), why="none is there")

    def sent(self, record: TaskRecord, target: SubtaskRecord, placement: Placement) -> None:
        """Nobody keeps a log here."""

    def regroup(self, record: TaskRecord) -> Group | None:
        """Return the group that the test says."""
        return self.groups.pop(0) if self.groups else None

    def turn(self, record: TaskRecord, target: SubtaskRecord, placement: Placement, left_s: float) -> Place:
        """Send it to the first, while the test says that there is room."""
        self.left_s.append(left_s)
        return Place(gateway=placement.order[0]) if self.room else Place(position=1, waiting=1)

    def expect(self, plan: Plan, *, deadline_s: float, elapsed_s: float) -> str:
        """Return what the test says."""
        return self.expected

    def plan_moved(self, record: TaskRecord, running_s: Mapping[str, float]) -> None:
        """Remember the states told."""
        self.moved.append((tuple(str(each.state) for each in record.subtasks), dict(running_s)))

    def took(self, skill: str, duration_ms: float) -> None:
        """Remember."""
        self.durations.append((skill, duration_ms))

    async def checkpoint(self, task: str, subtask: str) -> Checkpoint | None:
        """Return the prepared checkpoint."""
        return self.checkpoints.get(subtask)

    async def forget_checkpoints(self, record: TaskRecord) -> None:
        """Remember for which task."""
        self.forgotten.append(record.id)

    async def order(self, gateway: str, request: RunRequest) -> RunAccepted:
        """Take an order, or refuse it."""
        self.orders.put_nowait((gateway, request))
        await asyncio.sleep(0)
        if self.refusals:
            raise self.refusals.pop(0)
        if self.slow_answer is not None:
            await self.slow_answer.wait()
        return RunAccepted(
            gateway=self.passed_to or gateway, container="c1", phase=Phase.LOCAL_WARM, choice=self.choice
        )


class Bench:
    """A driver on fakes, and what a test does with it."""

    plan_of = staticmethod(plan_of)

    def __init__(self) -> None:
        self.plane = FakePlane()
        self.around = FakeSurroundings(self.plane)
        self.driver: Driver | None = None
        self.task: asyncio.Task[None] | None = None

    async def start(self, record: TaskRecord | None = None, **more: Any) -> Driver:
        """Write the record and drive it."""
        record = record or accepted()
        key = task_key(record.id)
        old = self.plane.dht.records.get(key)
        version = await self.plane.dht.write(key, encode(record), expected=old.version if old else None)
        self.driver = Driver(cast("Any", self.around), record, version, on_change=lambda _: None, **more)
        self.task = asyncio.create_task(self.driver.run())
        return self.driver

    async def ordered(self) -> tuple[str, RunRequest]:
        """Wait for the next run order."""
        return await asyncio.wait_for(self.around.orders.get(), 60)

    def tell(self, request: RunRequest, kind: RunEventKind, *, gateway: str = "gw-1", **fields: Any) -> None:
        """Have a run tell something."""
        assert self.driver is not None
        self.driver.tell(RunNews(event(request, kind, gateway=gateway, **fields)))

    def say(self, news: Input) -> None:
        """Hand in news."""
        assert self.driver is not None
        self.driver.tell(news)

    async def order(self, ask: Any) -> TaskRecord:
        """Give an operator's order; returns the record as written with it, or raises why it was not taken."""
        assert self.driver is not None
        outcome: asyncio.Future[TaskRecord] = asyncio.get_running_loop().create_future()
        self.driver.tell(Steered(ask=ask, outcome=outcome))
        return await asyncio.wait_for(outcome, 60)

    async def until(self, holds: Callable[[TaskRecord], bool]) -> TaskRecord:
        """Wait until the record is so."""
        assert self.driver is not None
        async with asyncio.timeout(60):
            while not holds(self.driver.record):
                await asyncio.sleep(0.005)
        return self.driver.record

    async def end(self) -> TaskRecord:
        """Wait for the driver's end; returns its record."""
        assert self.task is not None
        assert self.driver is not None
        await asyncio.wait_for(self.task, 60)
        return self.driver.record

    def transitions(self, task: str = "t-1") -> list[Transition]:
        """The transitions that were published."""
        return self.plane.session.sent(self.plane.keys.transition(task), Transition)

    def stored(self, task: str = "t-1") -> TaskRecord:
        """The record as written."""
        return msgspec.json.decode(self.plane.dht.records[task_key(task)].value, type=TaskRecord)


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    """A driver's bench; the driver is ended afterwards."""
    made = Bench()
    yield made
    if made.task is not None:
        made.task.cancel()
        await asyncio.gather(made.task, return_exceptions=True)


@pytest.fixture
def plane() -> FakePlane:
    """Return a plane in memory."""
    return FakePlane()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder for files."""
    return tmp_path


@pytest.fixture
def pool() -> FakePool:
    """Return a pool that does what the test says."""
    return FakePool()


@pytest.fixture
def tasks_config() -> TasksConfig:
    """Return a configuration with short waits."""
    return FAST


@pytest.fixture
def catalogue() -> Catalogue:
    """Return a catalogue with one skill, `work`."""
    return CATALOGUE
