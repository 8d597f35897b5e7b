"""A gateway alone with robots that hold on command, in memory."""

import asyncio
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from appliance.errors import UnreachableError
from appliance.model import RobotCommand, RobotInfo, RobotReply, VersionVector, encode, keyspace
from appliance.model.keys import Keys, Topic
from appliance.plane.dht import Record


class FakePlane:
    """A gateway alone with robots that hold on command; those in `deaf` cannot be reached."""

    gateway = "gw-1"

    def __init__(self) -> None:
        self.keys = Keys("f")
        self.session = self.dht = self.store = self
        self.registry = SimpleNamespace(robots={}, doubtful=lambda _: False)
        self.credentials: Any = None
        self.told: list[str] = []
        self.deaf: set[str] = set()
        self.mad: dict[str, bytes] = {}
        """Robots that answer with these bytes, to every command."""
        self.values: dict[str, bytes] = {}
        self.puts: list[str] = []
        self.records: dict[str, Record] = {}
        self.mine = True
        self.others: set[str] = set()
        self.rpc: Any = None
        self.refused: list[str] = []
        """What was refused and counted."""

    def robot(self, name: str, *, online: bool = True, gateway: str = "gw-1") -> None:
        """Have the roster say so of a robot."""
        self.registry.robots[name] = RobotInfo(id=name, kind="mavlink", gateway=gateway, online=online)

    def refuse(self, what: str, **_: Any) -> None:
        """Count it."""
        self.refused.append(what)

    def members(self) -> frozenset[str]:
        """Return this gateway alone."""
        return frozenset({self.gateway, *self.others})

    def owns(self, key: str) -> bool:
        """Whether a robot of no gateway is ours."""
        return key.startswith("robot/") and self.mine

    async def read(self, key: str) -> Record | None:
        """Return a record."""
        return self.records.get(key)

    async def write(self, key: str, value: bytes, *, expected: VersionVector | None) -> VersionVector:
        """Write a record that has not moved on."""
        known = self.records.get(key)
        assert (known.version if known is not None else None) == expected
        version = {self.gateway: len(self.puts) + 1}
        self.records[key] = Record(key=key, value=value, version=version)
        return version

    def subscribe_typed(self, *_: Any) -> Any:
        """Hear nothing."""
        return SimpleNamespace(close=lambda: None)

    def publish(self, topic: Topic[Any], value: Any, *names: str) -> None:
        """Put a fact."""
        self.put(self.keys(topic, *names), encode(value))

    def put(self, key: str, payload: bytes) -> Any:
        """Keep it: what is put on the store is awaited, what is put on a key is not."""
        self.puts.append(key)
        self.values[key] = payload
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        done.set_result(None)
        return done

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return what is kept."""
        return [(key, value) for key, value in self.values.items() if key.startswith(prefix)]

    async def query(self, key: str, payload: bytes, *, timeout_s: float, sign: bool, urgent: bool = False) -> bytes:  # noqa: ARG002 - as a session
        """Do it, or hold."""
        robot = next(each for each in self.registry.robots if self.keys(keyspace.COMMAND, each) == key)
        if robot in self.deaf:
            raise UnreachableError(f"{robot} is not reached")
        if robot in self.mad:
            return self.mad[robot]
        command = msgspec.json.decode(payload, type=RobotCommand)
        self.told.append(robot if command.verb == "stop" else command.verb)
        return encode(RobotReply(id=command.id))


@pytest.fixture
def plane() -> FakePlane:
    """Return a plane without robots."""
    return FakePlane()
