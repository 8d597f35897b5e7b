# ruff: noqa: ARG002 - fakes take what the real ones take
"""A gateway's plane in memory: session, records, RPC, store, registry and ring, under the test's control."""

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from appliance.errors import ConflictError, SwiftbotError, UnreachableError
from appliance.model import Plan, TaskRecord, VersionVector, encode
from appliance.model.keys import Keys, Topic, Verb
from appliance.plane.dht import LeaveOut, Record
from appliance.plane.events import FleetEvents
from appliance.plane.records import increment
from appliance.plane.session import Message
from appliance.plane.settings import PlaneConfig
from tests.unit.tasks.sample_records import accepted, plan_of


class FakeCloser:
    """Counts nothing, closes nothing."""

    def close(self) -> None:
        """Do nothing."""


class FakeSession:
    """Delivers what is put to all subscribers, at once; keeps everything."""

    def __init__(self) -> None:
        self.keys = Keys("f")
        self.puts: list[tuple[str, bytes]] = []
        self.refused: dict[str, int] = {}
        self.on_denied: Callable[[str, str, str, str], None] | None = None
        self.subscribers: list[tuple[str, Callable[[Message], None]]] = []
        self.queries: list[bytes] = []
        self.replies: list[bytes | SwiftbotError] = []

    def put(self, key: str, payload: bytes, *, express: bool = False) -> None:
        """Keep and deliver."""
        self.puts.append((key, payload))
        for expr, callback in list(self.subscribers):
            if _matches(expr, key):
                callback(Message(key, payload, deleted=False, at_ns=0, encoding=""))

    def publish(self, topic: Topic[Any], value: Any, *names: str, express: bool = False) -> None:
        """Put a fact."""
        self.put(self.keys(topic, *names), encode(value), express=express)

    def subscribe(self, expr: str, callback: Callable[[Message], None]) -> FakeCloser:
        """Deliver raw messages."""
        self.subscribers.append((expr, callback))
        return FakeCloser()

    def subscribe_typed(
        self,
        topic: Topic[Any],
        callback: Callable[[str, Any], None],
        *names: str,
        heed: Callable[[str], bool] = lambda _: True,
    ) -> FakeCloser:
        """Deliver decoded messages."""

        def take(message: Message) -> None:
            if heed(message.key):
                callback(message.key, msgspec.json.decode(message.payload, type=topic.payload))

        return self.subscribe(self.keys(topic, *names), take)

    def refuse(self, what: str, **_: object) -> None:
        """Count."""
        self.refused[what] = self.refused.get(what, 0) + 1

    def deny(self, what: str, key: str, reason: str, by: str = "") -> None:
        """Count, and tell."""
        self.refuse(what)
        if self.on_denied is not None:
            self.on_denied(what, key, reason, by)

    def watch_denied(self, callback: Callable[[str, str, str, str], None]) -> None:
        """Tell of what is denied."""
        self.on_denied = callback

    async def query(self, key: str, payload: bytes, *, timeout_s: float, sign: bool, urgent: bool = False) -> bytes:
        """Answer with the next prepared reply; the last one again and again. Robots are asked with a signature only."""
        assert sign
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
        self.writes = 0
        self.watchers: list[tuple[Callable[[str], bool], Callable[[Record], None]]] = []

    async def read(self, key: str, *, replica: bool = False) -> Record | None:
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
        version = increment(current.version if current else {}, self.gateway)
        self.change(Record(key=key, value=value, version=version))
        await asyncio.sleep(0)  # the copy is known here before the writer hears that it is done
        return version

    def change(self, record: Record) -> None:
        """Have a copy change, as by a write or by a comparison with another gateway's, and tell who watches it."""
        self.records[record.key] = record
        for heed, tell in tuple(self.watchers):
            if heed(record.key):
                asyncio.get_running_loop().call_soon(tell, record)

    def watch(self, heed: Callable[[str], bool], tell: Callable[[Record], None]) -> Callable[[], None]:
        """Have changes told."""
        watcher = (heed, tell)
        self.watchers.append(watcher)
        return lambda: self.watchers.remove(watcher)

    async def remove(self, key: str, *, expected: VersionVector) -> None:
        """Remove, if it has not moved on."""
        await asyncio.sleep(0)
        if self.records[key].version != expected:
            raise ConflictError(f"{key} has moved on")
        del self.records[key]

    async def local(self, prefix: str, *, leave_out: LeaveOut | None = None) -> list[Record]:
        """Return the shard."""
        await asyncio.sleep(0)
        found = [record for key, record in self.records.items() if key.startswith(prefix)]
        if leave_out is None:
            return found
        return [each for each in found if not (leave_out.has in each.value and leave_out.lacks not in each.value)]

    def owns(self, key: str) -> bool:
        """Whether all keys are ours."""
        return self.mine


class FakeRpc:
    """Answers calls by functions of the test, `on[verb]`; without one nobody answers."""

    def __init__(self) -> None:
        self.on: dict[str, Callable[[str, Any], Awaitable[Any]]] = {}
        self.calls: list[tuple[str, str, Any]] = []
        self.registered: dict[str, Callable[[Any], Awaitable[Any]]] = {}

    def register(self, verb: Verb[Any, Any], handler: Callable[[Any], Awaitable[Any]]) -> None:
        """Keep a handler."""
        self.registered[verb.name] = handler

    async def call(self, gateway: str, verb: Verb[Any, Any], request: Any, *, timeout_s: float | None = None) -> Any:
        """Ask the test."""
        self.calls.append((gateway, verb.name, request))
        await asyncio.sleep(0)
        if verb.name not in self.on:
            raise UnreachableError(f"nobody answers {verb.name} on {gateway}")
        return await self.on[verb.name](gateway, request)


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
        self.ages: dict[str, float] = {}
        self.lost_ns: dict[str, int] = {}
        self.clock_s: dict[str, float] = {}

    def age_s(self, gateway: str) -> float:
        """Return what the test says; by default nothing was ever heard."""
        return self.ages.get(gateway, math.inf)

    def doubtful(self, robot: str) -> bool:
        """Return whether more than one may go by that name: none does here."""
        del robot
        return False

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

    plan_of = staticmethod(plan_of)

    def __init__(self, gateway: str = "gw-1") -> None:
        self.gateway = gateway
        self.config = PlaneConfig()
        self.session = FakeSession()
        self.keys = self.session.keys
        self.dht = FakeDht(gateway)
        self.rpc = FakeRpc()
        self.store = FakeStore()
        self.registry = FakeRegistry()
        self.ring = FakeRing(gateway)
        self.present = {"gw-1", "gw-2", "gw-3"}
        self.events = FleetEvents()

    async def owner_of(self, key: str) -> str:
        """Return the one owner."""
        return self.ring.owner(key)

    def sees(self, name: str) -> bool:
        """Whether it counts as a member."""
        return name in self.members()

    def members(self) -> frozenset[str]:
        """Return who is there."""
        return frozenset(self.present)

    def accepted(self, task: str = "t-1", plan: Plan | None = None) -> TaskRecord:
        """Return a record just accepted here."""
        return accepted(task, plan, self.gateway)
