"""The pool's tie to Podman: reached when it can be, known to be away when it cannot, tried again until it is back.

It exists because containers that run need no Podman: only starting and removing do. So its absence is a fact to be
told and a thing to be mended in the background, never a reason for the pool to stop.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable

import structlog

from appliance.errors import PoolError, SwiftbotError
from appliance.pool.engine import Engine, EngineFacts

log = structlog.get_logger(__name__)

MAX_RECONNECT_S = 30.0
WATCH_S = 0.5
"""Pause between two signs of life that Podman is asked for."""
ANSWER_S = 1.2
"""How long it may take for one. Two in a row that do not come make it a problem, so within 3 s."""


class EngineLink:
    """Podman as one pool reaches it.

    Args:
        make_engine: makes the connection's object; may raise SwiftbotError, and is then tried again.
        reconnect_s: first pause before another try; doubles up to MAX_RECONNECT_S.
        on_connected: awaited each time Podman answers (again), before it counts as there.
        on_problem: called when `problem` has changed.
    """

    def __init__(
        self,
        make_engine: Callable[[], Engine],
        *,
        reconnect_s: float,
        on_connected: Callable[[Engine, EngineFacts], Awaitable[None]],
        on_problem: Callable[[], None] = lambda: None,
    ) -> None:
        self.engine: Engine | None = None
        self.facts: EngineFacts | None = None
        self._problem = "not started"
        self._on_problem = on_problem
        self._silent = False
        """Whether the problem is that Podman gives no sign of life."""
        self._make_engine = make_engine
        self._on_connected = on_connected
        self._first_pause_s = self._pause_s = reconnect_s
        self._try_at = 0.0
        self._connecting: asyncio.Task[None] | None = None

    @property
    def problem(self) -> str:
        """Why Podman cannot be used; empty when it can."""
        return self._problem

    @problem.setter
    def problem(self, text: str) -> None:
        changed, self._problem = text != self._problem, text
        if changed:
            self._on_problem()

    async def watch(self) -> None:
        """Ask Podman for signs of life for ever: one that stands still is a problem before the next start needs it."""
        missed = 0
        while True:
            if not missed:
                await asyncio.sleep(WATCH_S)
            engine = self.engine
            if engine is None:
                missed = 0
                await asyncio.sleep(WATCH_S)
                continue
            try:
                await engine.ping(ANSWER_S)
            except SwiftbotError as error:
                missed += 1
                if missed >= 2:
                    self._silent = True
                    self.lost(error)
                    await asyncio.sleep(WATCH_S)
                continue
            missed = 0
            if self._silent:
                # It answers again: what was put off is tried now.
                self._silent = False
                self._try_at, self._pause_s = 0.0, self._first_pause_s
                self.tend(time.monotonic())

    async def start(self, wait_s: float) -> None:
        """Connect; what takes longer than `wait_s` goes on in the background."""
        self._connecting = asyncio.create_task(self._connect(), name="connect to Podman")
        await asyncio.wait({self._connecting}, timeout=wait_s)

    @property
    def unfinished(self) -> "list[asyncio.Task[None]]":
        """The attempt to connect that is in progress."""
        return [self._connecting] if self._connecting is not None and not self._connecting.done() else []

    def cancel(self) -> None:
        """Give up connecting."""
        for task in self.unfinished:
            task.cancel()

    async def close(self) -> None:
        """Let go of threads and connections."""
        engine, self.engine = self.engine, None
        if engine is not None:
            engine.hang_up()
            await asyncio.to_thread(engine.close)

    def there(self) -> tuple[Engine, EngineFacts]:
        """Return Podman and what it said of itself; PoolError when it was never reached."""
        if self.engine is None or self.facts is None:
            raise PoolError(self.problem or "Podman is not connected")
        return self.engine, self.facts

    def lost(self, error: SwiftbotError) -> None:
        """Note that Podman did not answer."""
        if not self.problem:
            self.problem = str(error)
            self._pause_s = self._first_pause_s
            self._try_at = time.monotonic() + self._pause_s
            log.warning("Podman is away", reason=str(error))

    def tend(self, now: float) -> None:
        """Try to reconnect when it is time to."""
        if self.problem and now >= self._try_at and not self.unfinished:
            self._connecting = asyncio.create_task(self._connect(), name="connect to Podman")

    async def _connect(self) -> None:
        try:
            self.engine = self.engine or self._make_engine()
            self.facts = await self.engine.facts()
            await self._on_connected(self.engine, self.facts)
        except SwiftbotError as error:
            if self.problem != str(error):
                log.warning("Podman cannot be used", reason=str(error))
            self.problem = str(error)
            self._try_at = time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, MAX_RECONNECT_S)
            return
        self.problem = ""
        self._pause_s = self._first_pause_s
