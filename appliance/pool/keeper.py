"""Keeps the containers: starts them ahead and for those who wait, probes them, replaces them, gives them up.

It exists apart from the door (`pool.py`) because runs come and go by the second while containers have a life of
their own. It decides nothing itself (`policies`) and touches no container itself (`starter`, `container`): it shows
the planner what there is, carries out what that answers, and notes why (`decisions`). Who has which container is in the
`books`, starts in progress are in `starts`, Podman is behind the `link`.
"""

import asyncio
import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

import structlog

from appliance.errors import SwiftbotError, UnreachableError
from appliance.model import ContainerInfo, ContainerState, Need
from appliance.pool.books import FOR_A_RUN, Books
from appliance.pool.container import Ending, PooledContainer, ending_of, hung
from appliance.pool.decisions import Decisions
from appliance.pool.engine import LABEL_ID, Engine, EngineFacts
from appliance.pool.link import EngineLink
from appliance.pool.planning import Planning
from appliance.pool.policies.planner import Weighed
from appliance.pool.pressure import Reading
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter
from appliance.pool.starts import Starts
from appliance.pool.turns import Turn

log = structlog.get_logger(__name__)

TEND_S = 0.5
"""How often everything is gone through when nothing happens."""
TEND_AT_MOST_EVERY_S = 0.05
"""And how often when very much happens: each run changes the books three times."""
CONNECT_WAIT_S = 10.0
"""How long a start waits for Podman; after that it goes on without."""
SWEEP_S = 30.0
ENDING_S = 2.0
"""How long Podman is asked how a container ended in mid-run, before that counts as not known."""
ENDING_LOOK_S = 0.1
"""Pause between two such questions: it notices the end some 200 ms after the sockets are closed."""
"""How often Podman is asked whether it has containers of ours that are not in the books."""
FIRST_SWEEP_S = 2.0
"""The first time after Podman was reached: what a killed gateway had asked for may have come after the adoption."""


class Keeper:
    """The containers of one gateway.

    Args:
        config: section `[pool]`.
        gateway: this gateway's id.
        images: all images of the catalogue.
        make_starter: makes what makes containers; it is given what to call when one dies.
        make_engine: makes the connection to Podman.
        on_change: told the facts of all containers after something changed.
        refused: counts what is declined.
        read_memory: what the kernel says of memory, unless a test says otherwise.
        on_evicted: told whom a run's container takes the place of, and what was weighed.
    """

    def __init__(
        self,
        config: PoolConfig,
        *,
        gateway: str,
        images: Iterable[str],
        make_starter: Callable[[Callable[[PooledContainer], None]], Starter],
        make_engine: Callable[[], Engine],
        on_change: Callable[[tuple[ContainerInfo, ...]], None],
        refused: Counter[str],
        read_memory: Callable[[], Reading] | None = None,
        on_evicted: Callable[[Weighed], None] = lambda _: None,
    ) -> None:
        self.decisions = Decisions()
        self.books = Books(config, begin=self._begin, on_change=on_change, refused=refused)
        self.link = EngineLink(
            make_engine,
            reconnect_s=config.reconnect_s,
            on_connected=self._on_connected,
            on_problem=self.books.changed,
        )
        self._config = config
        self._images = tuple(images)
        self._on_evicted = on_evicted
        self._wake = asyncio.Event()
        self._starter = make_starter(lambda container: self.retire(container, "it died", died=True))
        self.starts = Starts(
            config, starter=self._starter, link=self.link, decisions=self.decisions, on_end=self._on_started
        )
        self.planning = Planning(
            config,
            gateway=gateway,
            images=self._images,
            books=self.books,
            starts=self.starts,
            starter=self._starter,
            link=self.link,
            on_change=self._wake.set,
            refused=refused,
            read_memory=read_memory,
        )
        self.books.full = self.planning.full
        self._background: set[asyncio.Task[None]] = set()
        self._next_sweep = math.inf
        self.draining = False
        """Nothing new is begun here: no run, no hint, no warming."""
        self._adopted = False
        self._stopped = False
        self._standing: list[asyncio.Task[None]] = []

    # --- what is --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Why containers, or those of some image, cannot be started now; empty when they can."""
        return self.link.problem or "; ".join(self.starts.problems(self._images).values())

    # --- what others ask --------------------------------------------------------------------------------------

    async def have(self, image: str, count: int) -> None:
        """Wait until so many containers of an image are ready, or no more can be started."""
        await self.books.until(
            lambda: (
                self.books.count(image, ContainerState.READY) >= count
                or (not self.starts and bool(self.planning.why_no_start(image)))
            )
        )

    def release_quarantine(self, image: str) -> str:
        """Start containers of an image again; returns why they were not, empty when they were."""
        reason = self.starts.why_not(image)
        self.starts.forgive(image)
        self._wake.set()
        return reason

    # --- life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect to Podman and adopt what is there; whatever is missing then is worked on in the background.

        Raises:
            ConfigError: the skills cannot be copied for containers to mount.
        """
        await self._starter.open()
        await self.link.start(CONNECT_WAIT_S)
        for work in (self._tend_forever(), self.planning.memory.run(), self.link.watch()):
            self._standing.append(asyncio.create_task(work, name=work.__qualname__))

    async def stop(self, *, keep_containers: bool, patience_s: float) -> None:
        """Let go of everything; containers go on running, to be adopted, if they are to be kept."""
        self._stopped = True
        self.books.send_away()
        for task in self._standing:
            task.cancel()
        self.link.cancel()
        self.starts.cancel()
        # Starts are let come to their end: one cut off between two steps would leave a container nobody knows.
        until = time.monotonic() + patience_s
        while tasks := self._unfinished():
            left_s = until - time.monotonic()
            await asyncio.wait(tasks, timeout=max(0.0, left_s), return_when=asyncio.FIRST_COMPLETED)
            if left_s <= 0:
                for task in tasks:
                    task.cancel()
                await asyncio.wait(tasks, timeout=1.0)
                break
        for container in self.books:
            container.close()
        engine = self.link.engine
        if not keep_containers and engine is not None:
            try:
                await asyncio.gather(*(self._starter.remove(each, engine) for each in self.books))
                await asyncio.gather(*(engine.remove(each.id) for each in await self._starter.own(engine)))
            except SwiftbotError as error:
                log.warning("containers were left", reason=str(error))
        self.books.clear()
        await self.link.close()

    def _unfinished(self) -> list[asyncio.Task[Any]]:
        standing = [task for task in self._standing if not task.done()]
        return [*standing, *self.link.unfinished, *self.starts.unfinished, *self._background]

    def spawn(self, work: Coroutine[Any, Any, None], name: str) -> None:
        """Run something in the background that `stop` waits for."""
        task = asyncio.create_task(work, name=name)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    # --- starting ---------------------------------------------------------------------------------------------

    async def acquire(self, need: Need, turn: Turn | None = None) -> PooledContainer:
        """Start a container, or wait for one when there is no room; one that comes free meanwhile is taken instead.

        Its reservation tells a new one: FOR_A_RUN.

        Raises:
            PoolError, PrerequisiteError, UnreachableError: none started, or none came free in time.
            RefusedError: too many wait already.
            WithdrawnError: it was taken out of the queue (`Books.withdraw`).
        """
        if (container := self.books.take(need)) is not None:
            return container  # it came free meanwhile
        self.planning.check_startable(need, turn)
        container = self._begin(need)
        if container is None:
            container = await self.books.wait(need, turn)
        if container.info.state is ContainerState.STARTING:
            return await self.books.sooner(need, turn, container, self.starts.wait(container))
        return container

    def _begin(self, need: Need) -> PooledContainer | None:
        """Begin a start for one run; None when there is no room. Raises when a start would be in vain."""
        victims = self.planning.make_room(need)
        if victims is None:
            return None
        self.planning.check_image(need.image)
        if victims and self.planning.weighed is not None:
            self._on_evicted(self.planning.weighed)
        for idle, why in victims:
            self.planning.evicted(idle)
            # Those who wait are served when the new one has its place, not in between.
            self.give_up(idle.id, why, serve=False)
        container = self._start(need.image, need, "a run waits for it")
        container.reservation = FOR_A_RUN
        return container

    def _start(self, image: str, need: Need | None, why: str) -> PooledContainer:
        container = self.starts.begin(image, need, why)
        self.books.add(container)
        return container

    def _on_started(self, container: PooledContainer, error: SwiftbotError | None) -> None:
        if error is not None:
            self.books.drop(container)
            self.books.serve()
        elif container.reservation == FOR_A_RUN:
            self.books.hold(container, FOR_A_RUN)  # with a lease, should whoever waits go away at this very moment
        else:
            self.books.ready(container)
        container.next_probe = time.monotonic() + self._config.probe_s
        self._wake.set()

    # --- after a run, and ending ------------------------------------------------------------------------------

    def taken(self, container: PooledContainer, run_id: str) -> None:
        """Note that a run has it."""
        self.books.busy(container, run_id)
        self._wake.set()

    def ran(self, container: PooledContainer) -> None:
        """Note that a run in it has ended well swept, and make it ready, or replace it when it has had its day."""
        container.count_run()
        grown_mb = container.rss_mb - container.first_rss_mb
        if container.info.runs >= self._config.max_runs:
            self.retire(container, f"it has had {container.info.runs} runs")
        elif grown_mb > self._config.max_growth_mb:
            self.retire(container, f"its runner has grown by {grown_mb:.0f} MB")
        else:
            self.books.ready(container)
            self._wake.set()

    def retire(
        self,
        container: PooledContainer,
        reason: str,
        *,
        serve: bool = True,
        ending: Ending | None = None,
        died: bool = False,
    ) -> None:
        """Take a container out of the books at once and remove it in the background.

        Args:
            container: any of this pool.
            reason: why, for the pool's decisions.
            serve: whether those who wait are served at once.
            ending: how it ended, for the run in it.
            died: it ended by itself: where a run was in it Podman is asked how, before it is removed.
        """
        run = container.info.run
        if not self.books.drop(container):
            return
        self.decisions.note("retire", image=container.info.image, container=container.id, why=reason)
        container.become(ContainerState.DEAD)
        ask = died and bool(run) and self.link.engine is not None and not self.link.problem
        if ending is not None:
            container.tell_ending(ending)
        container.close(told_later=ask)
        self.spawn(self._bury(container, ask=ask), f"remove {container.id}")
        if serve:
            self.books.serve()
        self._wake.set()

    def give_up(self, container_id: str, reason: str, *, serve: bool = True) -> None:
        """Retire a container that nobody has."""
        container = self.books.get(container_id)
        if container is not None and container.info.state is ContainerState.READY:
            self.retire(container, reason, serve=serve)

    async def _bury(self, container: PooledContainer, *, ask: bool = False) -> None:
        if ask:
            await self._ask_ending(container)
        try:
            await self._starter.remove(container, self.link.engine)
        except UnreachableError as error:
            self.link.lost(error)  # what is left is found by its label after reconnecting
        except SwiftbotError as error:
            log.warning("container was not removed", container=container.id, reason=str(error))

    async def _ask_ending(self, container: PooledContainer) -> None:
        """Ask Podman how a container ended; it notices that a moment after its sockets are closed."""
        ending: Ending | None = None
        try:
            async with asyncio.timeout(ENDING_S):
                while (engine := self.link.engine) is not None:
                    found = await engine.ended(container.engine_id)
                    if found is not None:
                        ending = ending_of(found.code, oom=found.oom)
                        break
                    await asyncio.sleep(ENDING_LOOK_S)
        except (TimeoutError, SwiftbotError) as error:
            log.info("how a container ended is not known", container=container.id, reason=str(error) or "too slow")
        finally:
            container.tell_ending(ending)

    # --- tending ----------------------------------------------------------------------------------------------

    async def _tend_forever(self) -> None:
        while True:
            try:
                self._tend(time.monotonic())
            except Exception:  # supervision boundary: the pool is tended for as long as the gateway lives
                log.exception("tending the pool broke")
            await asyncio.sleep(TEND_AT_MOST_EVERY_S)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TEND_S):
                    await self._wake.wait()
            self._wake.clear()

    def _tend(self, now: float) -> None:
        self.link.tend(now)
        self.books.expire(now)
        self.starts.tend(now, self._wake.set)
        for container in self.books:
            if container.mounts and self._starter.look_at_state(container):
                self.books.changed()
            if container.info.state is not ContainerState.STARTING and now >= container.next_probe:
                container.next_probe = math.inf  # one at a time
                self.spawn(self._probe(container), f"probe {container.id}")
        self.books.serve()
        if self._config.mode == "cold":
            for container in self.books:
                if container.info.state is ContainerState.READY:
                    self.retire(container, "mode is cold: each run has a new one")
        if self._stopped or self.link.problem:
            return
        if self._config.mode != "cold":
            self._plan(now)
        if now >= self._next_sweep:
            self._next_sweep = now + SWEEP_S
            self.spawn(self._sweep(), "look for stray containers")

    def _plan(self, now: float) -> None:
        """Carry out what the planner wants started and given up."""
        starts, retirements = self.planning.tend(now)
        for each in retirements:
            self.give_up(each.id, each.why, serve=False)
        for each in starts:
            self._start(each.image, None, each.why)

    async def _probe(self, container: PooledContainer) -> None:
        try:
            await container.ping(timeout_s=self._config.probe_timeout_s)
            container.missed_probes = 0
        except SwiftbotError as error:
            container.missed_probes += 1
            if container.missed_probes >= self._config.probe_failures:
                silent_s = container.missed_probes * self._config.probe_timeout_s
                detail = f"{container.missed_probes} probes in a row"
                self.retire(container, f"does not answer: {error.message}", ending=hung(silent_s, detail))
        finally:
            container.next_probe = time.monotonic() + self._config.probe_s

    async def _sweep(self) -> None:
        """Remove containers of ours that Podman has and the books have not."""
        engine = self.link.engine
        if engine is None:
            return
        try:
            own = await self._starter.own(engine)
            for found in own:
                if self._stopped or self.draining:
                    return  # what is kept is the next gateway's, which may be here already
                if self.books.get(found.labels.get(LABEL_ID, "")) is None:
                    log.info("stray container removed", container=found.name)
                    await engine.remove(found.id)
            await self._starter.forget_snapshots(own)
        except UnreachableError as error:
            self.link.lost(error)
        except SwiftbotError as error:
            log.warning("stray containers were not removed", reason=str(error))

    # --- Podman is there --------------------------------------------------------------------------------------

    async def _on_connected(self, engine: Engine, facts: EngineFacts) -> None:
        """Adopt what is there the first time; later look for what was left over."""
        self._next_sweep = time.monotonic() + FIRST_SWEEP_S
        if not self._adopted:
            for container in await self._starter.adopt(engine):
                self.books.add(container)
                container.next_probe = time.monotonic() + self._config.probe_s
                self.decisions.note("adopt", image=container.info.image, container=container.id, why="it runs")
                self.books.ready(container)
            self._adopted = True
            if not facts.limits_enforced:
                log.warning("limits of containers are not enforced here", cgroup=facts.cgroup_version)
        self._wake.set()
