"""What a robot that speaks Zenoh asks tasks of the fleet with. Needs eclipse-zenoh and nothing else; can be copied.

    session = zenoh.open(config)
    client = ZenohTaskClient(session, fleet="local", robot="rover_1")
    task = client.submit("bring me to the charger", task="rover-1-17")     # the same id again is the same task
    for record in client.follow(task):
        print(record["state"])

Records are TaskRecords as docs/schemas/TaskRecord.json describes them. `AsyncZenohTaskClient` is the same for asyncio.
"""

import asyncio
import json
import queue
import secrets
import threading
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any, cast

FINAL = frozenset({"succeeded", "failed", "cancelled"})
"""States after which nothing follows."""
LOOK_S = 5.0
"""How often a task is looked at while nothing is heard of it: a put may be lost when a gateway dies."""

NAME_S = 12.0
"""How long a name that another robot has is waited for: one that was cut off is seen to be gone by then."""
SETTLE_S = 0.8
"""How long a robot shows itself before its name is its own: one that started at the same instant is heard by then."""
_STATE_S = 0.2

Record = dict[str, Any]


class ZenohTaskRejected(Exception):  # noqa: N818 - what it says
    """The fleet will not do it; `code` and `remedy` are the gateway's."""

    def __init__(self, message: str, *, code: str = "", remedy: str = "") -> None:
        super().__init__(message)
        self.code = code
        self.remedy = remedy


class ZenohTaskClient:
    """Asks for tasks and hears of them; thread-safe as far as the session is.

    Args:
        session: an open `zenoh.Session`, of any mode.
        fleet: the fleet's name.
        robot: the robot's name, as in the roster.
    """

    def __init__(self, session: Any, *, fleet: str, robot: str) -> None:
        self._session = session
        self._root = f"swiftbot/{fleet}"
        self._robot = robot

    def submit(self, instruction: str, *, task: str = "", timeout_s: float = 10.0, **request: Any) -> str:
        """Ask for a task; returns its id once it is durable on its replicas.

        Args:
            instruction: what to do, in words.
            task: its id; asked again with the same one, it is the same task. Made up when empty.
            timeout_s: how long the fleet is waited for.
            request: further fields of a TaskRequest (docs/schemas), as plain data: `plan`, so that no model is asked,
                `priority`, `deadline_s`, `group`, `approval`.

        Raises:
            ZenohTaskRejected: it will not be done, and why.
            TimeoutError: no gateway answered; asking again with the same id is safe.
        """
        task = task or f"r-{secrets.token_hex(6)}"
        wanted = {**request, "instruction": instruction, "id": task}
        record = self._ask(f"robot/{self._robot}/task", wanted, timeout_s)
        return str(record["id"])

    def register(
        self,
        *,
        uses: tuple[str, ...] = (),
        verbs: tuple[str, ...] = (),
        flies: bool = False,
        limits: dict[str, float] | None = None,
        wait_s: float = NAME_S,
    ) -> "Registration":
        """Make the robot known to the fleet, with what it can do; it is there until closed, or until it is cut off.

        Args:
            uses: actuators and sensors it has: base, arm, camera, ...
            verbs: commands that it answers on `robot/{robot}/command` (docs/robots.md).
            flies: whether it does.
            limits: `speed_mps`, `altitude_m`, `payload_kg`, `range_m`, as far as known.
            wait_s: how long a name that another robot has is waited for.

        Raises:
            ZenohTaskRejected: another robot has the name (`conflict`).
        """
        info: Record = {"id": self._robot, "kind": "zenoh", "uses": uses, "verbs": verbs, "flies": flies}
        if limits:
            info["limits"] = limits
        return Registration(self._session, f"{self._root}/robot/{self._robot}", info, wait_s=wait_s)

    def follow(self, task: str, *, timeout_s: float = 3600.0) -> Iterator[Record]:
        """Yield a task's record whenever it changes, until it ends; TimeoutError when it does not by then."""
        until = time.monotonic() + timeout_s
        heard: queue.SimpleQueue[bytes] = queue.SimpleQueue()

        def take(sample: Any) -> None:
            heard.put(sample.payload.to_bytes())

        subscriber = self._session.declare_subscriber(f"{self._root}/task/{task}/record", take)
        try:
            last = -1
            while True:
                try:
                    record = _table(heard.get(timeout=max(0.0, min(LOOK_S, until - time.monotonic()))))
                except queue.Empty:
                    record = self._look(task)
                sequence = int(record.get("sequence", 0))
                if record and sequence > last:  # what is no record, or not found, tells nothing
                    last = sequence
                    yield record
                    if record.get("state") in FINAL:
                        return
                if time.monotonic() > until:
                    raise TimeoutError(f"task {task} has not ended within {timeout_s:g} s")
        finally:
            subscriber.undeclare()

    def _look(self, task: str) -> Record:
        """Ask the gateways for a task's record; empty when none answers just now."""
        key = f"{self._root}/gw/*/rpc/task"
        for reply in self._session.get(key, payload=json.dumps({"id": task}).encode(), timeout=LOOK_S):
            if reply.ok is not None:
                return _table(reply.ok.payload.to_bytes())
        return {}

    def _ask(self, key: str, request: Record, timeout_s: float) -> Record:
        payload = json.dumps(request).encode()
        for reply in self._session.get(f"{self._root}/{key}", payload=payload, timeout=timeout_s):
            if reply.ok is not None:
                return _table(reply.ok.payload.to_bytes())
            error = _table(reply.err.payload.to_bytes())
            if error.get("code"):
                raise ZenohTaskRejected(
                    str(error.get("message", "")), code=str(error["code"]), remedy=str(error.get("remedy", ""))
                )
        raise TimeoutError("no gateway answered; asking again with the same id is safe")


class Registration:
    """A robot as the fleet knows it: its liveliness token says that it is there, its state what it is and where."""

    def __init__(self, session: Any, key: str, info: Record, *, wait_s: float = NAME_S) -> None:
        self._session = session
        self._key = f"{key}/state"
        self._info = info | {"speaker": f"{time.time_ns():020d}-{secrets.token_hex(4)}"}
        self._token: Any = None
        until = time.monotonic() + wait_s
        while True:
            if not self._is_taken():
                # One that started at the same instant holds no token yet: both show themselves first.
                self._settle()
                if not self._is_taken():
                    break
            if time.monotonic() >= until:
                self.update()  # heeded by no gateway while the other one is there, but seen
                raise self._conflict(f"there is a robot that calls itself {info['id']}")
            time.sleep(0.5)
        # Kept here: a token that nobody holds is taken back by the garbage collector.
        self._token = session.liveliness().declare_token(f"{key}/alive")
        self.update()

    def _is_taken(self) -> bool:
        key = self._key.removesuffix("state") + "alive"
        return any(reply.ok is not None for reply in self._session.liveliness().get(key, timeout=LOOK_S))

    def _settle(self) -> None:
        """Show itself for a moment: of two that start at the same instant the older has the name, as in rosters."""
        own, older = str(self._info["speaker"]), threading.Event()

        def take(sample: Any) -> None:
            other = _table(sample.payload.to_bytes()).get("speaker")
            if isinstance(other, str) and other and other < own:
                older.set()

        heard = self._session.declare_subscriber(self._key, take)
        until = time.monotonic() + SETTLE_S
        try:
            while time.monotonic() < until and not older.is_set():
                self.update()
                older.wait(_STATE_S)
        finally:
            heard.undeclare()
        if older.is_set():
            raise self._conflict(f"another robot that calls itself {self._info['id']} started earlier")

    @staticmethod
    def _conflict(message: str) -> ZenohTaskRejected:
        return ZenohTaskRejected(message, code="conflict", remedy="give each a name of its own")

    def update(self, **state: Any) -> None:
        """Tell its state: fields of RobotInfo such as `pose`, `battery_percent`, `mode`; some times a second."""
        self._info |= state
        self._session.put(self._key, json.dumps(self._info).encode(), encoding="application/json")

    def close(self) -> None:
        """Leave the fleet."""
        if self._token is not None:
            self._token.undeclare()
            self._token = None


class AsyncZenohTaskClient:
    """The same for asyncio; arguments as `ZenohTaskClient`. Waiting is done in threads."""

    def __init__(self, session: Any, *, fleet: str, robot: str) -> None:
        self._client = ZenohTaskClient(session, fleet=fleet, robot=robot)

    async def submit(self, instruction: str, *, task: str = "", timeout_s: float = 10.0, **request: Any) -> str:
        """As `ZenohTaskClient.submit`."""
        return await asyncio.to_thread(self._client.submit, instruction, task=task, timeout_s=timeout_s, **request)

    async def register(self, **what: Any) -> Registration:
        """As `ZenohTaskClient.register`."""
        return await asyncio.to_thread(self._client.register, **what)

    async def follow(self, task: str, *, timeout_s: float = 3600.0) -> AsyncIterator[Record]:
        """As `ZenohTaskClient.follow`."""
        records = self._client.follow(task, timeout_s=timeout_s)
        while (record := await asyncio.to_thread(next, records, None)) is not None:
            yield record


def _table(data: bytes) -> Record:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return cast("Record", value) if isinstance(value, dict) else {}
