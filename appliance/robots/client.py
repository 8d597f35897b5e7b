"""What a robot's companion computer, or a script beside a ground station, asks tasks of the fleet with, over MAVLink.

Needs pymavlink and, of this project, the modules `appliance.robots.mavlink.tunnel` and, for robots that speak Zenoh
instead, `appliance.robots.zenoh_client`; the three files can be copied. The connection is an ordinary one of
`pymavlink.mavutil`; messages that are not for this client go to `on_other`.

    connection = mavutil.mavlink_connection("udpout:gateway:14550", source_system=1, source_component=192)
    client = TaskClient(connection)
    task = client.submit("photograph the gate, then come home")
    for news in client.follow(task):
        print(news["state"], news.get("done"), news.get("total"))

A whole plan may come with it, so that no model is asked: `client.submit("to the gate", plan={"domain": ..., "subtasks":
[...]})`.
`AsyncTaskClient` is the same for asyncio.
"""

import asyncio
import json
import secrets
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, cast

from appliance.robots.mavlink.tunnel import MAX_PAYLOAD, PAYLOAD_TYPE, SILENT, Channel, NotDelivered
from appliance.robots.zenoh_client import AsyncZenohTaskClient, ZenohTaskClient, ZenohTaskRejected

__all__ = [
    "AsyncTaskClient",
    "AsyncZenohTaskClient",
    "TaskClient",
    "TaskRejected",
    "ZenohTaskClient",
    "ZenohTaskRejected",
]

FINAL = frozenset({"succeeded", "failed", "cancelled"})
"""States after which nothing follows."""
POLL_S = 0.05
BEAT_S = 1.0
_ONBOARD = (18, 8, 0, 0, 4)
"""MAV_TYPE_ONBOARD_CONTROLLER, no autopilot, active."""
LOOK_S = 15.0
"""How often a task is asked after while nothing is heard of it: its gateway may have been restarted."""
MAX_NEWS = 1000
"""Messages kept that nobody asked for yet."""

News = dict[str, Any]


class TaskRejected(Exception):  # noqa: N818 - what it says
    """The fleet will not do it. `retry` tells whether it may later; `code` and `remedy` are the gateway's."""

    def __init__(self, message: str, *, code: str = "", remedy: str = "", retry: bool = False) -> None:
        super().__init__(message)
        self.code = code
        self.remedy = remedy
        self.retry = retry


class TaskClient:
    """Asks for tasks and hears of them. Not for several threads at once.

    Args:
        connection: of `pymavlink.mavutil`; it is switched to MAVLink 2 where it is not.
        gateway: system and component id of the gateway.
        on_other: given every message that is not this client's.
        beats: send a heartbeat every second, as an onboard computer: gateways listen to those only whose heartbeat they
            have heard. False where the connection's owner sends its own.
    """

    def __init__(
        self,
        connection: Any,
        *,
        gateway: tuple[int, int] = (242, 191),
        on_other: Callable[[Any], None] | None = None,
        beats: bool = True,
    ) -> None:
        if not hasattr(connection.mav, "tunnel_send") and hasattr(connection, "auto_mavlink_version"):
            connection.auto_mavlink_version(b"\xfd")  # mavutil begins with MAVLink 1, which has no TUNNEL
        self._connection = connection
        self._beats = beats
        self._beat_at = 0.0
        self._gateway = gateway
        self._on_other = on_other
        self._channel = Channel(lambda: secrets.randbits(32))
        self._news: deque[News] = deque(maxlen=MAX_NEWS)

    def submit(self, instruction: str, *, task: str = "", timeout_s: float = 60.0, **request: Any) -> str:
        """Ask for a task; returns its id once it is durable.

        Args:
            instruction: what to do, in words.
            task: its id; asked again with the same one, it is the same task. Made up when empty.
            timeout_s: how long the fleet is waited for.
            request: further fields of a TaskRequest (docs/schemas), as plain data: `plan`, so that no model is asked,
                `priority`, `deadline_s`, `group`, `approval`. All together have at most 16 KiB.

        Raises:
            TaskRejected: it will not be done, and why.
            TimeoutError: nothing was heard; asking again with the same id is safe.
        """
        task = task or f"r-{secrets.token_hex(6)}"
        letter: dict[str, Any] = {"op": "submit", "id": task, "instruction": instruction}
        if request:
            letter = {"op": "submit", "id": task, "request": {"instruction": instruction, **request}}
        self._ask(letter, timeout_s)
        return task

    def cancel(self, task: str, *, timeout_s: float = 60.0) -> str:
        """Stop a task; returns its state. Errors as `submit`."""
        return str(self._ask({"op": "cancel", "id": task}, timeout_s).get("state", ""))

    def follow(self, task: str, *, timeout_s: float = 3600.0, again: bool = False) -> Iterator[News]:
        """Yield a task's news until it ends.

        Args:
            task: id of a task submitted here; or of another one, with `again`.
            timeout_s: TimeoutError when it has not ended by then.
            again: ask to be told, as after a restart. Errors then as `submit`.
        """
        until = time.monotonic() + timeout_s
        told: News = {}
        if again:
            self._ask({"op": "follow", "id": task}, timeout_s)
        while True:
            found = self._news_of(task, until)
            if found == told:
                continue  # asked after, and nothing has changed
            told = found
            yield found
            if found.get("state") in FINAL:
                return

    def _news_of(self, task: str, until: float) -> News:
        """Wait for a task's news, and ask for them where none come; TimeoutError, TaskRejected."""
        while True:
            look_at = time.monotonic() + LOOK_S
            try:
                return self._wait(lambda news: news.get("op") == "news" and news.get("id") == task, min(until, look_at))
            except TimeoutError:
                if time.monotonic() >= until:
                    raise
            try:
                self._ask({"op": "follow", "id": task}, min(2 * LOOK_S, until - time.monotonic()))
            except TimeoutError:
                continue  # there is nobody just now
            except TaskRejected as error:
                if not error.retry:
                    raise

    def pump(self, timeout_s: float = POLL_S) -> None:
        """Send what is due and take in what comes; the other methods do so while they wait."""
        now = time.monotonic()
        if self._beats and now >= self._beat_at:
            self._beat_at = now + BEAT_S
            self._connection.mav.heartbeat_send(*_ONBOARD)
        for payload in self._channel.due(now):
            self._connection.mav.tunnel_send(
                *self._gateway, PAYLOAD_TYPE, len(payload), list(payload.ljust(MAX_PAYLOAD, b"\0"))
            )
        message = self._connection.recv_match(blocking=True, timeout=timeout_s)
        while message is not None:
            self.handle(message)
            message = self._connection.recv_match(blocking=False)

    def handle(self, message: Any) -> None:
        """Take in one message, for those who read the connection themselves."""
        mine = message.get_type() == "TUNNEL" and message.payload_type == PAYLOAD_TYPE
        if not mine or (message.get_srcSystem(), message.get_srcComponent()) != self._gateway:
            if self._on_other is not None:
                self._on_other(message)
            return
        whole = self._channel.take(bytes(message.payload[: message.payload_length]), time.monotonic())
        if whole is not None:
            try:
                news = json.loads(whole)
            except (ValueError, RecursionError):
                return
            if isinstance(news, dict):
                self._news.append(cast("News", news))

    def _ask(self, letter: dict[str, Any], timeout_s: float) -> News:
        until = time.monotonic() + timeout_s

        def answered(news: News) -> bool:
            if news.get("op") not in ("accepted", "rejected") or news.get("id") not in (letter["id"], ""):
                return False
            return news.get("to", letter["op"]) == letter["op"]

        for late in [news for news in self._news if answered(news)]:
            self._news.remove(late)  # of an earlier question, which was not waited for any longer
        try:
            number = self._channel.send(json.dumps(letter).encode(), time.monotonic())
        except (NotDelivered, TypeError, ValueError, RecursionError) as error:
            raise TaskRejected(str(error), code="payload") from error
        answer = self._wait(answered, until, number)
        if answer["op"] == "rejected":
            raise TaskRejected(
                str(answer.get("message", "")),
                code=str(answer.get("code", "")),
                remedy=str(answer.get("remedy", "")),
                retry=bool(answer.get("retry", False)),
            )
        return answer

    def _wait(self, wanted: Callable[[News], bool], until: float, number: int | None = None) -> News:
        while True:
            for news in self._news:
                if wanted(news):
                    self._news.remove(news)
                    return news
            if number is not None and number in self._channel.failed:
                why = self._channel.failed.pop(number)
                if why == SILENT:
                    raise TimeoutError(f"the gateway does not answer: {why}")
                raise TaskRejected(why, code="payload")
            if time.monotonic() > until:
                raise TimeoutError("the gateway does not answer in time; asking again with the same id is safe")
            self.pump()


class AsyncTaskClient:
    """The same for asyncio; arguments as `TaskClient`. Each call runs in a thread, one at a time."""

    def __init__(self, connection: Any, **options: Any) -> None:
        self._client = TaskClient(connection, **options)
        self._lock = threading.Lock()

    async def submit(self, instruction: str, *, task: str = "", timeout_s: float = 60.0, **request: Any) -> str:
        """As `TaskClient.submit`."""
        return await self._run(lambda: self._client.submit(instruction, task=task, timeout_s=timeout_s, **request))

    async def cancel(self, task: str, *, timeout_s: float = 60.0) -> str:
        """As `TaskClient.cancel`."""
        return await self._run(lambda: self._client.cancel(task, timeout_s=timeout_s))

    async def follow(self, task: str, *, timeout_s: float = 3600.0, again: bool = False) -> AsyncIterator[News]:
        """As `TaskClient.follow`."""
        news = self._client.follow(task, timeout_s=timeout_s, again=again)
        while (found := await self._run(lambda: next(news, None))) is not None:
            yield found

    async def _run(self, work: Callable[[], Any]) -> Any:
        def locked() -> Any:
            with self._lock:
                return work()

        return await asyncio.to_thread(locked)
