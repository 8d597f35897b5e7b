"""Clients that use records concurrently, each through a gateway of its own, and write down what they did and saw."""

import asyncio
import random
import time
import uuid
from collections.abc import Sequence

from msgspec import Struct

from appliance.bench.history.convergence import Write
from appliance.bench.history.linearizable import Op
from appliance.errors import ConflictError, SwiftbotError, UnreachableError
from appliance.model import VersionVector
from appliance.plane.messages import Found, RecordAsk, RecordChange, Written
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session

READ_S = 4.0
WRITE_S = 8.0
"""Longer than a gateway looks for a majority: what it says of the outcome is heard."""
TRIES = 3
"""Times that a write of unknown outcome is asked for again, with the same id."""


class Event(Struct, frozen=True, kw_only=True):
    """One line of a recorded history; `outcome` is ok, fail or info (unknown), as with Jepsen."""

    process: str
    key: str
    kind: str
    value: str | None
    old: str | None
    outcome: str
    called_ns: int
    returned_ns: int
    why: str = ""


class History:
    """What all clients did, by key."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.ops: dict[str, list[Op]] = {}
        self.writes: dict[str, list[Write]] = {}

    def add(self, event: Event, *, version: VersionVector | None = None) -> None:
        """Note an operation that has come back."""
        self.events.append(event)
        known = event.outcome != "info"
        if event.kind == "cas":
            self.writes.setdefault(event.key, []).append(
                Write(value=event.value or "", after=event.old, version=version, failed=event.outcome == "fail")
            )
        if event.outcome == "fail" and (event.kind == "read" or event.why != "conflict"):
            return  # it has changed nothing, and says nothing
        op = Op(
            process=event.process,
            kind="read" if event.kind == "read" else "cas",
            called_ns=event.called_ns,
            returned_ns=event.returned_ns if known else None,
            value=event.value,
            old=event.old,
            ok=event.outcome != "fail",
        )
        self.ops.setdefault(event.key, []).append(op)


class Client:
    """One client: reads and compare-and-sets on keys, one after the other.

    Args:
        name: in the history, and in the values it writes.
        session: a client session of its own.
        gateway: through which it works.
        quorum: whether it asks for one.
        history: where it writes down what it did.
        seed: of its choices.
    """

    def __init__(self, name: str, session: Session, *, gateway: str, quorum: bool, history: History, seed: int) -> None:
        self.name = name
        self._rpc = Rpc(session, None)
        self._gateway = gateway
        self._quorum = quorum
        self._history = history
        self._generator = random.Random(seed)  # noqa: S311 - a load, not secrets
        self._seen: dict[str, tuple[str | None, VersionVector | None]] = {}
        self._number = 0

    async def work(self, keys: Sequence[str], until: float, *, pause_s: float) -> None:
        """Use the keys at random until that time (monotonic)."""
        while time.monotonic() < until:
            key = self._generator.choice(list(keys))
            if key not in self._seen or self._generator.random() < 0.4:
                await self.read(key)
            else:
                await self._change(key)
            await asyncio.sleep(self._generator.uniform(0.0, 2 * pause_s))

    async def read(self, key: str) -> bool:
        """Read a key; returns whether there was an answer."""
        called_ns = time.monotonic_ns()
        try:
            ask = RecordAsk(key=key, quorum=self._quorum)
            record = (await self._rpc.call(self._gateway, "record_read", ask, Found, timeout_s=READ_S)).record
        except SwiftbotError as error:
            self._note("read", key, None, None, "fail", called_ns, error.code)
            await asyncio.sleep(0.1)
            return False
        value = None if record is None else record.value.decode()
        self._seen[key] = (value, None if record is None else record.version)
        self._note("read", key, value, None, "ok", called_ns)
        return True

    async def _change(self, key: str) -> None:
        """Replace what was seen last by a value that nobody else writes."""
        old, expected = self._seen[key]
        self._number += 1
        value = f"{self.name}.{self._number}"
        change = RecordChange(
            key=key, value=value.encode(), expected=expected, quorum=self._quorum, write=uuid.uuid4().hex
        )
        called_ns = time.monotonic_ns()
        unsure = ""
        for _ in range(TRIES):
            try:
                written = await self._rpc.call(self._gateway, "record_write", change, Written, timeout_s=WRITE_S)
            except ConflictError as error:
                # After a try of unknown outcome it may be this very write that moved the record on.
                del self._seen[key]
                self._note("cas", key, value, old, "info" if unsure else "fail", called_ns, unsure or error.code)
                return
            except SwiftbotError as error:
                sure = isinstance(error, UnreachableError) and "was not written" in error.message
                unsure = unsure if sure else f"{error.code}: {error.message[:80]}"
                if sure and not unsure:
                    self._note("cas", key, value, old, "fail", called_ns, error.code)
                    return
                await asyncio.sleep(0.1)
            else:
                self._seen[key] = (value, written.version)
                self._note("cas", key, value, old, "ok", called_ns, version=written.version)
                return
        del self._seen[key]
        self._note("cas", key, value, old, "info", called_ns, unsure)

    def _note(
        self,
        kind: str,
        key: str,
        value: str | None,
        old: str | None,
        outcome: str,
        called_ns: int,
        why: str = "",
        *,
        version: VersionVector | None = None,
    ) -> None:
        event = Event(
            process=self.name, key=key, kind=kind, value=value, old=old, outcome=outcome, called_ns=called_ns,
            returned_ns=time.monotonic_ns(), why=why,
        )  # fmt: skip
        self._history.add(event, version=version)
