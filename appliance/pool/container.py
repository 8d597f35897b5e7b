"""One pooled container as the gateway holds it: its facts, its two connections, and what can be asked of it.

Two connections to the runner's socket are kept: one for control (ping, cancel; its end of file is the
container's death) and one spare that the next run is sent on, so that a start is one message and one fork.
None of it needs Podman's API, so warm containers serve on while Podman is away.
"""

import asyncio
import contextlib
import os
import signal
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import DeadlineError, PayloadError, PoolError, UnreachableError
from appliance.model import ContainerInfo, ContainerState
from appliance.pool.runner.frames import BYTES_TAG, Decoder, FrameError, encode, untagged

log = structlog.get_logger(__name__)

SOCKET = "runner.sock"
CONTROL_TIMEOUT_S = 2.0
Frame = dict[str, Any]
_TAG = BYTES_TAG.encode()


def _parse(body: bytes) -> Any:
    """Read a frame's JSON: some five times as quick as the runner's own reader, and no NaN or broken text passes."""
    value = msgspec.json.decode(body)
    return _with_bytes(value) if _TAG in body else value


def _with_bytes(value: Any) -> Any:
    """Return a value with the bytes that are tagged in it."""
    if isinstance(value, dict):
        return untagged({key: _with_bytes(each) for key, each in cast("dict[str, Any]", value).items()})
    if isinstance(value, list):
        return [_with_bytes(each) for each in cast("list[Any]", value)]
    return value


class Connection:
    """A connection to a runner: whole frames in and out."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self._decoder = Decoder(_parse)

    @classmethod
    async def open(cls, folder: Path) -> "Connection":
        """Connect to the runner whose socket is in `folder`.

        The path goes through /proc/self/fd, so that a long folder name never meets the 108 bytes that a socket's
        address may have. The folder is the container's to write: a link that a handler has put in the socket's place is
        not followed, or the gateway would speak to whatever it leads to.

        Raises:
            OSError: there is no socket, or nobody listens.
        """
        handle = os.open(folder / SOCKET, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            if not stat.S_ISSOCK(os.fstat(handle).st_mode):
                raise ConnectionRefusedError(f"{folder / SOCKET} is no socket")
            reader, writer = await asyncio.open_unix_connection(f"/proc/self/fd/{handle}", limit=2**20)
        finally:
            os.close(handle)
        return cls(reader, writer)

    async def send(self, frame: Frame) -> None:
        """Send one frame; OSError when the other side is gone, PayloadError when it is too long."""
        try:
            data = encode(frame)
        except (FrameError, TypeError, ValueError) as error:
            raise PayloadError(f"cannot be sent to the runner: {error}") from error
        self._writer.write(data)
        await self._writer.drain()

    async def receive(self) -> Frame | None:
        """Return the next frame, or None at the end of file between frames.

        Raises:
            PayloadError: it is no frame, or the connection ended within one.
        """
        while True:
            try:
                frame = self._decoder.next()
            except FrameError as error:
                raise PayloadError(f"the runner sent garbage: {error}") from error
            if frame is not None:
                return frame
            try:
                data = await self._reader.read(2**18)
            except OSError:
                data = b""
            if not data:
                if self._decoder.pending:
                    raise PayloadError("the run was cut off within a message")
                return None
            self._decoder.feed(data)

    def close(self) -> None:
        """Hang up."""
        self._writer.close()


class Ending(Struct, frozen=True, kw_only=True):
    """How a container ended in mid-run, as the run's failure says it."""

    code: str
    message: str
    remedy: str


LOST = Ending(
    code="pool",
    message="the connection to its container was lost in mid-run, and Podman does not say why",
    remedy="another container takes its place; the gateway's log says more",
)


def hung(silent_s: float, detail: str) -> Ending:
    """Return how a container ended whose runner was ended by the watchdog after `silent_s` without an answer."""
    return Ending(
        code="hung",
        message=f"the runner of its container did not answer for {silent_s:g} s ({detail}); the watchdog ended it",
        remedy="look for what stopped its processes or starved them: load and memory of the gateway (`swiftbot fleet`)",
    )


def ending_of(code: int, *, oom: bool) -> Ending:
    """Return how a container ended by what Podman says of its process 1: exit code, and whether memory ran out."""
    if oom:
        return Ending(
            code="memory",
            message="its container ran out of memory and was killed by the kernel",
            remedy="raise memory_mb in its skill.toml",
        )
    how = f"was killed by {signal.Signals(code - 128).name}" if code - 128 in _SIGNALS else f"exited with code {code}"
    return Ending(
        code="pool",
        message=f"its container {how} in mid-run",
        remedy="another container takes its place; the gateway's log and the kernel's (out of memory?) say more",
    )


_SIGNALS = frozenset(int(each) for each in signal.Signals)


class PooledContainer:
    """A container of the pool. The pool alone changes its `info`; reservation and times are the pool's notes."""

    def __init__(
        self,
        info: ContainerInfo,
        folder: Path,
        *,
        mounts: tuple[str, ...] = (),
        on_death: Callable[["PooledContainer"], None],
    ) -> None:
        self.info = info
        self.folder = folder
        self.mounts = mounts
        """State volumes that are mounted in it; `info.volumes` are those whose newest state is here."""
        self.engine_id = ""
        self.reservation = ""
        self.lease_until = 0.0
        self.idle_since = time.monotonic()
        self.busy_since = 0.0
        """When it was last reserved or given a run."""
        self.next_probe = 0.0
        self.missed_probes = 0
        self.rss_mb = 0.0
        self.first_rss_mb = 0.0
        self.problems: dict[str, str] = {}
        self._on_death: Callable[[PooledContainer], None] | None = on_death
        self._control: Connection | None = None
        self._spare: Connection | None = None
        self._active: Connection | None = None
        self._closed = False
        self._ending: Ending | None = None
        self._ended = asyncio.Event()
        """How it ended is known, or will not be."""
        self._replies: asyncio.Queue[Frame] = asyncio.Queue(maxsize=16)
        self._asking = asyncio.Lock()
        self._watcher: asyncio.Task[None] | None = None

    @property
    def id(self) -> str:
        """Its short id."""
        return self.info.id

    def become(self, state: ContainerState, *, run: str = "") -> None:
        """Change its state."""
        self.info = msgspec.structs.replace(self.info, state=state, run=run)

    def count_run(self) -> None:
        """Note that it has had one more run."""
        self.info = msgspec.structs.replace(self.info, runs=self.info.runs + 1)

    async def connect(self, *, timeout_s: float, alive: Callable[[], Any]) -> None:
        """Wait for the runner and open both connections; `alive` is awaited now and then and raises if it ended.

        Raises:
            PoolError: the runner did not answer in time.
        """
        until = time.monotonic() + timeout_s
        next_look = time.monotonic() + 1.0
        while True:
            try:
                self._control = await self._open()
                break
            except OSError as error:
                now = time.monotonic()
                if now > until:
                    raise PoolError(f"the runner of {self.id} did not answer within {timeout_s:g} s") from error
                if now > next_look:
                    next_look = now + 1.0
                    await alive()
            await asyncio.sleep(0.005)
        self._watcher = asyncio.create_task(self._watch(self._control), name=f"watch {self.id}")
        await self.ping(timeout_s=max(0.5, until - time.monotonic()))
        await self.refill()

    async def _watch(self, control: Connection) -> None:
        try:
            while (frame := await control.receive()) is not None:
                with contextlib.suppress(asyncio.QueueFull):  # nobody asked for so many
                    self._replies.put_nowait(frame)
        except PayloadError as error:
            log.warning("runner broke its protocol", container=self.id, reason=error.message)
        if self._on_death is not None:
            self._on_death(self)

    async def _ask(self, frame: Frame, timeout_s: float) -> Frame:
        control = self._control
        if control is None:
            raise UnreachableError(f"container {self.id} is not connected")
        async with self._asking:
            while not self._replies.empty():
                self._replies.get_nowait()
            try:
                async with asyncio.timeout(timeout_s):
                    await control.send(frame)
                    return await self._replies.get()
            except TimeoutError as error:
                raise DeadlineError(f"the runner of {self.id} did not answer within {timeout_s:g} s") from error
            except OSError as error:
                raise UnreachableError(f"the runner of {self.id} is gone") from error

    async def ping(self, *, timeout_s: float) -> Frame:
        """Ask how the runner is: its run, how many it has had, its memory, what it could not import.

        Raises:
            DeadlineError, UnreachableError: it does not answer.
        """
        reply = await self._ask({"op": "ping"}, timeout_s)
        problems: Any = reply.get("problems") or {}
        self.problems = {str(key): str(value) for key, value in problems.items()} if isinstance(problems, dict) else {}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
        self.rss_mb = float(reply.get("rss_mb", 0.0))
        self.first_rss_mb = self.first_rss_mb or self.rss_mb
        return reply

    async def hello(self, *, timeout_s: float) -> dict[str, str]:
        """Ask what code the runner has loaded: SHA-256 digests by `ROOT/path`; empty when it cannot tell.

        Raises:
            DeadlineError, UnreachableError: it does not answer.
        """
        code: Any = (await self._ask({"op": "hello"}, timeout_s)).get("code")
        return {str(path): str(digest) for path, digest in code.items()} if isinstance(code, dict) else {}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]

    async def cancel(self, run_id: str, *, reason: str, grace_s: float) -> bool:
        """Ask the runner to end a run; False when it has none of that id."""
        reply = await self._ask(
            {"op": "cancel", "run": run_id, "reason": reason, "grace_s": grace_s}, CONTROL_TIMEOUT_S
        )
        return bool(reply.get("ok"))

    async def save(self, run_id: str) -> bool:
        """Ask a run's handler for a checkpoint; False when the runner has no run of that id."""
        return bool((await self._ask({"op": "save", "run": run_id}, CONTROL_TIMEOUT_S)).get("ok"))

    async def begin(self, order: Frame) -> Connection:
        """Send a run on the spare connection and return it.

        Raises:
            UnreachableError: the runner is gone.
            PayloadError: the order cannot be sent; nothing of it was, and the connection is kept for the next.
        """
        connection, self._spare = self._spare, None
        try:
            if connection is None:
                connection = await self._open()
            self._active = connection
            await connection.send(order)
        except OSError as error:
            raise UnreachableError(f"the runner of {self.id} is gone") from error
        except PayloadError:
            self._spare = connection
            raise
        return connection

    async def _open(self) -> Connection:
        connection = await Connection.open(self.folder)
        if self._closed:
            connection.close()
            raise ConnectionAbortedError(f"container {self.id} is closed")
        return connection

    async def refill(self) -> None:
        """Open the spare connection unless it is there; UnreachableError when the runner is gone."""
        if self._spare is None:
            try:
                self._spare = await self._open()
            except OSError as error:
                raise UnreachableError(f"the runner of {self.id} is gone") from error

    def tell_ending(self, ending: Ending | None) -> None:
        """Note how it ended; None where that is not known."""
        self._ending = self._ending or ending
        self._ended.set()

    async def ending(self, timeout_s: float) -> Ending:
        """Return how it ended, once that is known; LOST when nobody says so in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._ended.wait()
        return self._ending or LOST

    def close(self, *, told_later: bool = False) -> None:
        """Hang up; a run in progress is ended by its runner, and its listener sees the end of file.

        `told_later`: how it ended is being found out, and `tell_ending` follows.
        """
        self._closed = True
        if not told_later:
            self._ended.set()
        self._on_death = None
        if self._watcher is not None:
            self._watcher.cancel()
        for connection in (self._control, self._spare, self._active):
            if connection is not None:
                connection.close()
        self._control = self._spare = self._active = None
