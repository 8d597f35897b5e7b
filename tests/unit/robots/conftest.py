"""A fake of the plane's session for tests of one process: puts are kept, queries go to functions."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import msgspec
import pytest

from appliance.errors import UnreachableError
from appliance.model import RobotCommand, encode
from appliance.model.keys import Keys, Topic
from tests.unit.robots.flown import EVERY_S, Flown


class FakeSession:
    """Keeps what is put; `answer` answers queries (None: nobody does)."""

    def __init__(self) -> None:
        self.keys = Keys("test")
        self.puts: list[tuple[str, bytes]] = []
        self.queries: list[bytes] = []
        self.answer: Callable[[bytes], Awaitable[bytes]] | None = None
        self.alive = False
        self.credentials: Any = None

    def publish(self, topic: Topic[Any], value: Any, *names: str) -> None:
        """Put a fact."""
        self.put(self.keys(topic, *names), encode(value))

    def put(self, key: str, payload: bytes, *, encoding: str = "application/json") -> None:  # noqa: ARG002
        """Keep a put."""
        self.puts.append((key, payload))

    def publisher(self, key: str, encoding: str) -> "FakePublisher":
        """Return a way to put a key."""
        return FakePublisher(self, key, encoding)

    async def query(self, key: str, payload: bytes, *, timeout_s: float, sign: bool, urgent: bool = False) -> bytes:  # noqa: ARG002
        """Answer as `answer` does; robots are asked with a signature only."""
        assert sign
        self.queries.append(payload)
        if self.answer is None:
            raise UnreachableError(f"nobody answers {key}")
        return await self.answer(payload)

    async def alive_now(self, expr: str) -> list[str]:
        """The key, where a token is there."""
        return [expr] if self.alive else []

    def commanded(self) -> list[RobotCommand]:
        """Return the commands that were announced as taken up."""
        return [msgspec.json.decode(value, type=RobotCommand) for key, value in self.puts if key.endswith("/commanded")]


class FakePublisher:
    """Puts of one key."""

    def __init__(self, session: FakeSession, key: str, encoding: str) -> None:
        self._session, self._key, self._encoding = session, key, encoding

    def put(self, payload: bytes) -> None:
        """Keep a put."""
        self._session.put(self._key, payload, encoding=self._encoding)

    def close(self) -> None:
        """Close."""


class FakeStore:
    """Key-value store in memory, as the plane's Store keeps them on disk."""

    def __init__(self) -> None:
        self.values: dict[str, bytes] = {}

    async def get(self, key: str) -> bytes | None:
        """Read."""
        return self.values.get(key)

    async def put(self, key: str, value: bytes) -> None:
        """Write."""
        self.values[key] = value

    async def delete(self, key: str) -> None:
        """Remove."""
        self.values.pop(key, None)

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """List."""
        return [(key, value) for key, value in self.values.items() if key.startswith(prefix)]


@pytest.fixture
def session() -> FakeSession:
    """Return a fake session."""
    return FakeSession()


@pytest.fixture
def store() -> FakeStore:
    """Return an empty store."""
    return FakeStore()


@pytest.fixture
async def flown() -> AsyncIterator[Flown]:
    """A copter on the ground."""
    each = Flown()
    life = asyncio.create_task(each.live())
    await asyncio.sleep(EVERY_S)
    yield each
    life.cancel()
    await asyncio.wait([life])
