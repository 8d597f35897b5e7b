"""Starts of containers in progress, and images that would be started in vain.

It exists apart from the keeper because a start takes seconds and can fail in ways that concern its image, not the
pool: an image that keeps failing is left alone for a while with the reason (quarantine); one that is not there is
looked for, and started again as soon as it is, without anybody's word.
"""

import asyncio
import time
from collections.abc import Callable, Iterable

import structlog

from appliance.errors import PoolError, PrerequisiteError, SwiftbotError, UnreachableError
from appliance.model import ContainerState, Need
from appliance.pool.container import PooledContainer
from appliance.pool.decisions import Decisions
from appliance.pool.link import EngineLink
from appliance.pool.policies import ColdCosts, Quarantine
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter

log = structlog.get_logger(__name__)

LOOK_S = 3.0
"""How often Podman is asked for an image that was found missing."""


class Starts:
    """Starts containers and keeps account of how that goes.

    Args:
        config: quarantine, first guess of what a cold start costs.
        starter: makes the containers.
        link: Podman.
        decisions: is told of every start and every failure.
        on_end: told of each start that ended: the container, and why it is not there (None: it is).
    """

    def __init__(
        self,
        config: PoolConfig,
        *,
        starter: Starter,
        link: EngineLink,
        decisions: Decisions,
        on_end: Callable[[PooledContainer, SwiftbotError | None], None],
    ) -> None:
        self.costs = ColdCosts(config.cold_ms)
        self._config = config
        self._starter = starter
        self._link = link
        self._decisions = decisions
        self._on_end = on_end
        self._tasks: dict[str, asyncio.Task[SwiftbotError | None]] = {}
        self._quarantine = Quarantine(after=config.bad_starts, for_s=config.quarantine_s)
        self._missing: dict[str, tuple[str, float]] = {}
        """Images that are not there: why, and when a start is tried all the same (another gateway may have it)."""
        self._next_look = 0.0
        self._looking: asyncio.Task[None] | None = None

    def __len__(self) -> int:
        """Return how many starts are in progress."""
        return len(self._tasks)

    # --- starting ---------------------------------------------------------------------------------------------

    def begin(self, image: str, need: Need | None, why: str) -> PooledContainer:
        """Begin to start a container and return it."""
        container = self._starter.new(image, need)
        self._decisions.note("start", image=image, container=container.id, why=why)
        self._tasks[container.id] = asyncio.create_task(self._carry_out(container), name=f"start {container.id}")
        return container

    async def wait(self, container: PooledContainer) -> SwiftbotError | None:
        """Wait until a start has ended; returns why it failed. Whoever waits may go away without ending it."""
        task = self._tasks.get(container.id)
        return await asyncio.shield(task) if task is not None else None

    async def _carry_out(self, container: PooledContainer) -> SwiftbotError | None:
        image = container.info.image
        error: SwiftbotError | None = None
        try:
            await self._starter.start(container, *self._link.there())
            if container.info.state is ContainerState.DEAD:
                error = PoolError(f"container {container.id} died as soon as it was there")
        except SwiftbotError as caught:
            error = caught
        finally:
            del self._tasks[container.id]
        if error is None:
            cold_ms = container.info.cold_ms or 0.0
            self.costs.add(image, cold_ms)
            self.forgive(image)
            log.info("container ready", image=image, container=container.id, took_ms=round(cold_ms))
        else:
            self._failed(container, error)
        self._on_end(container, error)
        return error

    def _failed(self, container: PooledContainer, error: SwiftbotError) -> None:
        image, now = container.info.image, time.monotonic()
        self._decisions.note("fail", image=image, container=container.id, why=str(error))
        if isinstance(error, UnreachableError):
            self._link.lost(error)
        elif isinstance(error, PrerequisiteError):
            self._missing[image] = (str(error), now + self._config.quarantine_s)
            self._next_look = now + LOOK_S
        else:
            self._quarantine.failed(image, str(error), now)

    # --- images that are left alone ---------------------------------------------------------------------------

    def why_not(self, image: str) -> str:
        """Return why an image is not to be started now; empty when it is."""
        now = time.monotonic()
        reason, until = self._missing.get(image, ("", 0.0))
        return reason if now < until else self._quarantine.reason(image, now)

    def problems(self, images: Iterable[str]) -> dict[str, str]:
        """Return the reasons for all images that are left alone."""
        return {image: why for image in images if (why := self.why_not(image))}

    def forgive(self, image: str) -> None:
        """Start containers of an image again."""
        self._quarantine.succeeded(image)
        self._missing.pop(image, None)

    def tend(self, now: float, on_found: Callable[[], None]) -> None:
        """Look now and then whether images that were missing are there."""
        idle = self._looking is None or self._looking.done()
        if self._missing and now >= self._next_look and idle and not self._link.problem:
            self._next_look = now + LOOK_S
            self._looking = asyncio.create_task(self._look(on_found), name="look for missing images")

    async def _look(self, on_found: Callable[[], None]) -> None:
        try:
            engine, _ = self._link.there()
            tags = {tag for each in await engine.images() for tag in each.tags}
        except SwiftbotError as error:
            log.info("images could not be listed", reason=str(error))
            return
        for image in tuple(self._missing):
            if self._starter.reference(image) in tags:
                log.info("missing image is there", image=image)
                self.forgive(image)
                on_found()

    @property
    def unfinished(self) -> list[asyncio.Task[SwiftbotError | None]]:
        """Starts in progress."""
        return list(self._tasks.values())

    def cancel(self) -> None:
        """Look for nothing any more."""
        if self._looking is not None:
            self._looking.cancel()
