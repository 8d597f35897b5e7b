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

import msgspec
import structlog

from appliance.errors import PoolError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import ContainerInfo, ContainerState, Need, PoolHint
from appliance.pool.books import FOR_A_RUN, Books
from appliance.pool.container import PooledContainer
from appliance.pool.decisions import Decisions
from appliance.pool.engine import LABEL_ID, Engine, EngineFacts
from appliance.pool.experience import Experience
from appliance.pool.glance import glance
from appliance.pool.link import EngineLink
from appliance.pool.policies import Planner, Retire, View
from appliance.pool.policies.planner import Weighed
from appliance.pool.pressure import MemoryWatch, Reading
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter
from appliance.pool.starts import Starts
from appliance.pool.turns import Completions, Turn

log = structlog.get_logger(__name__)

TEND_S = 0.5
"""How often everything is gone through when nothing happens."""
TEND_AT_MOST_EVERY_S = 0.05
"""And how often when very much happens: each run changes the books three times."""
CONNECT_WAIT_S = 10.0
"""How long a start waits for Podman; after that it goes on without."""
SWEEP_S = 30.0
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
        self.books.full = self._full
        self._completions = Completions()
        self.link = EngineLink(make_engine, reconnect_s=config.reconnect_s, on_connected=self._on_connected)
        self._config = config
        self._gateway = gateway
        self._images = tuple(images)
        self._refused = refused
        self._on_evicted = on_evicted
        self._wake = asyncio.Event()
        self._starter = make_starter(lambda container: self.retire(container, "it died"))
        self.starts = Starts(
            config, starter=self._starter, link=self.link, decisions=self.decisions, on_end=self._on_started
        )
        self._planner = Planner(
            config.baseline(), self.starts.costs, lambda image: self._starter.size(image).memory_mb, hour=_hour
        )
        self._memory = MemoryWatch(
            config.pressure,
            memory_mb=config.memory_mb,
            held_mb=lambda: self.books.memory_mb,
            on_change=self._wake.set,
            read=read_memory,
        )
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

    @property
    def squeeze(self) -> str:
        """Why the pool holds less than it is allowed, when the machine is short of memory; empty otherwise."""
        squeeze = self._memory.squeeze
        return squeeze.reason and f"{squeeze.reason}: {squeeze.budget_mb} of {self._config.memory_mb} MB for containers"

    def check_startable(self, need: Need, turn: Turn | None = None) -> None:
        """Raise when a cold start now would be in vain.

        Raises:
            PoolError: Podman is away.
            RefusedError: the image does not start, or everything is busy and too many wait.
        """
        self._check_image(need.image)
        if self.books.queue >= self._config.queue and self._room(self._size_mb(need), for_run=True) is None:
            # A full queue turns away whoever would be served last, which need not be the one who comes.
            if turn is not None and self.books.queue and not self.books.would_be_last(turn):
                return
            self._refused["queue full"] += 1
            raise self._full()

    def _full(self) -> RefusedError:
        after_s = self.expected_s(self.books.queue + 1)
        when = "wait" if after_s is None else f"ask again in about {after_s:.1f} s"
        return RefusedError(
            f"all {len(self.books)} containers of {self._gateway} are busy and {self.books.queue} runs wait"
            + (f"; {self.squeeze}" if self.squeeze else ""),
            remedy=f"{when}, or raise pool.capacity",
            retry_after_s=after_s or 0.0,
        )

    def expected_s(self, position: int) -> float | None:
        """In how many seconds the run at a place in the queue (from 1) may have a container; None: not known."""
        return self._completions.expected_s(position, len(self.books))

    def _check_image(self, image: str) -> None:
        if self.link.problem:
            raise PoolError(self.link.problem, remedy="swiftbot doctor tells more")
        if reason := self.starts.why_not(image):
            self._refused["quarantined image"] += 1
            raise RefusedError(reason, remedy="swiftbot images build, then swiftbot pool release")

    def why_no_start(self, image: str) -> str:
        """Return why one more container of an image cannot be started ahead now; empty when it can."""
        if reason := self.link.problem or self.starts.why_not(image):
            return reason
        size_mb = self._starter.size(image).memory_mb
        victims = self._room(size_mb, for_run=False)
        if victims is not None and not any(self._image_of(each) == image for each in victims):
            return ""
        holders = Counter(f"{each.info.state} {each.info.image}" for each in self.books)
        return (
            f"no room for one more {image} container ({size_mb} MB): {len(self.books)} of {self._config.capacity}"
            f" places and {self.books.memory_mb} of {self._memory.squeeze.budget_mb} MB are taken by "
            + ", ".join(f"{count} {what}" for what, count in sorted(holders.items()))
            + (f"; {self.squeeze}" if self.squeeze else "")
        )

    # --- what others ask --------------------------------------------------------------------------------------

    def hinted(self, hint: PoolHint) -> None:
        """Note what will be needed here."""
        self._planner.hinted(hint, time.monotonic())
        self._wake.set()

    def arrived(self, image: str) -> None:
        """Note that a run begins here, or waits for a container."""
        self._planner.arrived(image, time.monotonic())

    def ended(self, image: str, held_s: float) -> None:
        """Note that a run that had arrived is over, having had its container for so long (0: it had none)."""
        if held_s > 0:
            self._completions.ended(held_s)
        self._planner.ended(image, held_s, time.monotonic())

    async def have(self, image: str, count: int) -> None:
        """Wait until so many containers of an image are ready, or no more can be started."""
        await self.books.until(
            lambda: (
                self.books.count(image, ContainerState.READY) >= count
                or (not self.starts and bool(self.why_no_start(image)))
            )
        )

    def release_quarantine(self, image: str) -> str:
        """Start containers of an image again; returns why they were not, empty when they were."""
        reason = self.starts.why_not(image)
        self.starts.forgive(image)
        self._wake.set()
        return reason

    def experience(self) -> Experience:
        """Return what was learned, to be kept."""
        return Experience(cold_ms=self.starts.costs.state(), planner=self._planner.state())

    def recall(self, experience: Experience) -> None:
        """Go on from what was learned before a restart; images that are gone are forgotten."""
        known = set(self._images)
        cold_ms = {image: seen for image, seen in experience.cold_ms.items() if image in known}
        demand = {image: each for image, each in experience.planner.demand.items() if image in known}
        self.starts.costs.restore(cold_ms)
        self._planner.restore(msgspec.structs.replace(experience.planner, demand=demand), time.monotonic())

    # --- life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect to Podman and adopt what is there; whatever is missing then is worked on in the background."""
        await self.link.start(CONNECT_WAIT_S)
        for work in (self._tend_forever(), self._memory.run()):
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

    # --- room -------------------------------------------------------------------------------------------------

    def has_room(self, need: Need) -> bool:
        """Whether there is room for one more container, if need be in place of an idle one."""
        return self._room(self._size_mb(need), for_run=True) is not None

    def _size_mb(self, need: Need) -> int:
        return self._starter.size(need.image, need).memory_mb

    def _view(self) -> View:
        """Return what there is, as the planner sees it."""
        return glance(
            self.books,
            self.starts.costs,
            budget_mb=self._memory.squeeze.budget_mb,
            capacity=self._config.capacity,
            blocked=self.starts.problems(self._images),
        )

    def _room(self, memory_mb: int, *, for_run: bool) -> tuple[Retire, ...] | None:
        """Return whom to give up for a container of this size; None when there is no room."""
        return self._planner.room(self._view(), memory_mb, time.monotonic(), for_run=for_run)

    def _image_of(self, retirement: Retire) -> str:
        container = self.books.get(retirement.id)
        return container.info.image if container is not None else ""

    def _make_room(self, retirements: tuple[Retire, ...], view: View) -> None:
        idle = {each.id: each for each in view.idle}
        for each in retirements:
            self._planner.evicted(idle[each.id], time.monotonic())
            # Those who wait are served when the new one has its place, not in between.
            self.give_up(each.id, each.why, serve=False)

    # --- starting ---------------------------------------------------------------------------------------------

    async def acquire(self, need: Need, turn: Turn | None = None) -> PooledContainer:
        """Start a container, or wait for one when there is no room. Its reservation tells a new one: FOR_A_RUN.

        Raises:
            PoolError, PrerequisiteError, UnreachableError: none started, or none came free in time.
            RefusedError: too many wait already.
            WithdrawnError: it was taken out of the queue (`Books.withdraw`).
        """
        if (container := self.books.take(need)) is not None:
            return container  # it came free meanwhile
        self.check_startable(need, turn)
        container = self._begin(need)
        if container is None:
            container = await self.books.wait(need, turn)
        if container.info.state is ContainerState.STARTING:
            try:
                error = await self.starts.wait(container)
            except asyncio.CancelledError:
                self.books.give_back(container)
                raise
            if error is not None:
                raise error
        return container

    def _begin(self, need: Need) -> PooledContainer | None:
        """Begin a start for one run; None when there is no room. Raises when a start would be in vain."""
        view = self._view()
        victims = self._planner.room(view, self._size_mb(need), time.monotonic(), for_run=True)
        if victims is None:
            return None
        self._check_image(need.image)
        if victims and self._planner.weighed is not None:
            self._on_evicted(self._planner.weighed)
        self._make_room(victims, view)
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

    def retire(self, container: PooledContainer, reason: str, *, serve: bool = True) -> None:
        """Take a container out of the books at once and remove it in the background."""
        if not self.books.drop(container):
            return
        self.decisions.note("retire", image=container.info.image, container=container.id, why=reason)
        container.become(ContainerState.DEAD)
        container.close()
        self.spawn(self._bury(container), f"remove {container.id}")
        if serve:
            self.books.serve()
        self._wake.set()

    def give_up(self, container_id: str, reason: str, *, serve: bool = True) -> None:
        """Retire a container that nobody has."""
        container = self.books.get(container_id)
        if container is not None and container.info.state is ContainerState.READY:
            self.retire(container, reason, serve=serve)

    async def _bury(self, container: PooledContainer) -> None:
        try:
            await self._starter.remove(container, self.link.engine)
        except UnreachableError as error:
            self.link.lost(error)  # what is left is found by its label after reconnecting
        except SwiftbotError as error:
            log.warning("container was not removed", container=container.id, reason=str(error))

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
        starts, retirements = self._planner.tend(self._view(), now)
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
                self.retire(container, f"does not answer: {error.message}")
        finally:
            container.next_probe = time.monotonic() + self._config.probe_s

    async def _sweep(self) -> None:
        """Remove containers of ours that Podman has and the books have not."""
        engine = self.link.engine
        if engine is None:
            return
        try:
            for found in await self._starter.own(engine):
                if self._stopped or self.draining:
                    return  # what is kept is the next gateway's, which may be here already
                if self.books.get(found.labels.get(LABEL_ID, "")) is None:
                    log.info("stray container removed", container=found.name)
                    await engine.remove(found.id)
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


def _hour(now: float) -> float:
    """Return the hour of the day (UTC) at a reading of the monotonic clock: what people do follows it."""
    return (time.time() - (time.monotonic() - now)) / 3600.0 % 24.0
