"""The container manager: starts containers ahead and on demand, probes them, replaces them, gives them up.

It exists apart from the door (`pool.py`) because runs come and go by the second while containers have a life of
their own. It touches no container itself (`starter`, `container`) and decides nothing itself (`policies`): it shows the
planner what there is, carries out what that answers, and notes why (`decisions`). Which run holds which container is in
the `allocator`; Podman is behind the link of `engine`.

    glance            the allocator's containers as the planner sees them: facts without a way to change anything
    Keepsake          what the policies have learned, kept in the gateway's store: cold costs by image, the demand with
                      its histograms, the learned eviction policy. Written now and then, not with every run: losing a
                      minute of it costs nothing. What cannot be read, or is of another version, is learned again
    Starts            starts in progress. A start takes seconds and can fail in ways that concern its image, not the
                      pool: an image that keeps failing is left alone for a while with the reason (quarantine); one
                      that is not there is looked for, and started again as soon as it is, without an operator
    Planning          what the planner's answers mean here: it is plain code and knows neither allocator nor memory nor
                      clock. Whether there is room, for what another container would have to go, why nothing more can be
                      started, and how long a run would wait
    ContainerManager  the loop over all of it
"""

import asyncio
import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import msgspec
import structlog
from msgspec import Struct

from appliance.background import Background
from appliance.errors import PoolError, PrerequisiteError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import ContainerInfo, ContainerState, Need, PoolHint, encode
from appliance.pool.allocator import FOR_A_RUN, Allocator
from appliance.pool.container import Ending, PooledContainer, ending_of, hung
from appliance.pool.decisions import Decisions
from appliance.pool.engine import LABEL_ID, Engine, EngineFacts, EngineLink
from appliance.pool.fair_queue import Completions, Turn
from appliance.pool.policies import ColdCosts, Idle, Planner, PlannerState, Quarantine, Retire, Start, View
from appliance.pool.policies.planner import Weighed
from appliance.pool.pressure import MemoryWatch, Reading
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter


def glance(
    books: Allocator, costs: ColdCosts, *, now: float, budget_mb: int, capacity: int, blocked: Iterable[str]
) -> View:
    """Return what there is.

    Args:
        books: who has which container.
        costs: what a cold start of each image costs, for containers that were adopted.
        now: the clock that runs are timed by, seconds.
        budget_mb: memory that all together may take now.
        capacity: containers at most.
        blocked: images that are not to be started now.
    """
    idle: list[Idle] = []
    busy: Counter[str] = Counter()
    lasting: Counter[str] = Counter()
    starting: Counter[str] = Counter()
    for container in books:
        info = container.info
        match info.state:
            case ContainerState.READY:
                idle.append(
                    Idle(
                        id=info.id,
                        image=info.image,
                        memory_mb=info.memory_mb,
                        runs=info.runs,
                        cold_ms=info.cold_ms or costs.of(info.image),
                        since=container.idle_since,
                    )
                )
            case ContainerState.STARTING:
                starting[info.image] += 1
            case _:
                busy[info.image] += 1
                lasting[info.image] += (now - container.busy_since) * 1e3 >= costs.of(info.image)
    return View(
        idle=tuple(idle),
        busy=busy,
        lasting=lasting,
        starting=starting,
        memory_mb=books.memory_mb,
        containers=len(books),
        budget_mb=budget_mb,
        capacity=capacity,
        blocked=frozenset(blocked),
    )


log = structlog.get_logger(__name__)

EXPERIENCE_KEY = "pool/experience"
WRITE_S = 60.0


class Experience(Struct, frozen=True, kw_only=True):
    """All that is kept."""

    cold_ms: dict[str, tuple[float, ...]] = {}
    planner: PlannerState = PlannerState()


class Store(Protocol):
    """Where it is kept: the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Write a value."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Read all values whose keys begin so."""
        ...


class Keepsake:
    """Reads experience at the start and writes it from then on.

    Args:
        store: the gateway's; None: nothing is kept.
        recall: given what was kept.
        tell: returns what is to be kept.
    """

    def __init__(
        self, store: Store | None, *, recall: Callable[[Experience], None], tell: Callable[[], Experience]
    ) -> None:
        self._store = store
        self._recall = recall
        self._tell = tell
        self._written = b""
        self._writing: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Read what was kept, and begin to write."""
        if self._store is None:
            return
        for key, value in await self._store.scan(EXPERIENCE_KEY):
            if key != EXPERIENCE_KEY:
                continue
            try:
                self._recall(msgspec.json.decode(value, type=Experience))
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ValueError) as error:
                log.warning("what the pool had learned cannot be read; it starts from nothing", reason=str(error))
        self._writing = asyncio.create_task(self._write_forever(), name="keep what the pool learns")

    async def stop(self) -> None:
        """Write a last time."""
        if self._writing is not None:
            self._writing.cancel()
            await asyncio.gather(self._writing, return_exceptions=True)
            self._writing = None
            await self._write()

    async def _write_forever(self) -> None:
        while True:
            await asyncio.sleep(WRITE_S)
            await self._write()

    async def _write(self) -> None:
        if self._store is None:
            return
        value = encode(self._tell())
        if value == self._written:
            return
        try:
            await self._store.put(EXPERIENCE_KEY, value, durable=False)
            self._written = value
        except SwiftbotError as error:
            log.warning("what the pool has learned could not be kept", reason=str(error))


LOOK_S = 3.0
"""How often Podman is asked for an image that was found missing."""


class Starts:
    """Starts containers and keeps account of how that goes.

    Args:
        config: quarantine, first guess of what a cold start costs.
        starter: makes the containers.
        link: Podman.
        decisions: notes every start and every failure.
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
        """Wait until a start has ended; returns why it failed. Cancelling the wait does not end it."""
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


class Planning:
    """The planner of one gateway's pool with what it goes by.

    Args:
        config: section `[pool]`.
        gateway: this gateway's id.
        images: all images of the catalogue.
        books: who has which container.
        starts: starts in progress, and images in quarantine.
        starter: knows how large a container of an image is.
        link: Podman.
        on_change: called when there is something new to plan for.
        refused: counts what is declined.
        read_memory: what the kernel says of memory, unless a test says otherwise.
    """

    def __init__(
        self,
        config: PoolConfig,
        *,
        gateway: str,
        images: Iterable[str],
        books: Allocator,
        starts: Starts,
        starter: Starter,
        link: EngineLink,
        on_change: Callable[[], None],
        refused: Counter[str],
        read_memory: Callable[[], Reading] | None = None,
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._images = tuple(images)
        self._books = books
        self._starts = starts
        self._starter = starter
        self._link = link
        self._on_change = on_change
        self._refused = refused
        self._completions = Completions()
        self._planner = Planner(
            config.baseline(), starts.costs, lambda image: starter.size(image).memory_mb, hour=_hour
        )
        self.memory = MemoryWatch(
            config.pressure,
            memory_mb=config.memory_mb,
            held_mb=lambda: books.memory_mb,
            on_change=on_change,
            read=read_memory,
        )

    # --- what happens -----------------------------------------------------------------------------------------

    def hinted(self, hint: PoolHint) -> None:
        """Note what will be needed here."""
        self._planner.hinted(hint, time.monotonic())
        self._on_change()

    def arrived(self, image: str) -> None:
        """Note that a run begins here, or waits for a container."""
        self._planner.arrived(image, time.monotonic())

    def ended(self, image: str, held_s: float) -> None:
        """Note that a run that had arrived is over, having had its container for so long (0: it had none)."""
        if held_s > 0:
            self._completions.ended(held_s)
        self._planner.ended(image, held_s, time.monotonic())

    def evicted(self, idle: Idle) -> None:
        """Note that a container `make_room` named was given up."""
        self._planner.evicted(idle, time.monotonic())

    def experience(self) -> Experience:
        """Return what was learned, to be kept."""
        return Experience(cold_ms=self._starts.costs.state(), planner=self._planner.state())

    def recall(self, experience: Experience) -> None:
        """Go on from what was learned before a restart; images that are gone are forgotten."""
        known = set(self._images)
        cold_ms = {image: seen for image, seen in experience.cold_ms.items() if image in known}
        demand = {image: each for image, each in experience.planner.demand.items() if image in known}
        self._starts.costs.restore(cold_ms)
        self._planner.restore(msgspec.structs.replace(experience.planner, demand=demand), time.monotonic())

    # --- what there is ----------------------------------------------------------------------------------------

    @property
    def squeeze(self) -> str:
        """Why the pool holds less than it is allowed, when the machine is short of memory; empty otherwise."""
        squeeze = self.memory.squeeze
        return squeeze.reason and f"{squeeze.reason}: {squeeze.budget_mb} of {self._config.memory_mb} MB for containers"

    def _view(self) -> View:
        """Return what there is, as the planner sees it."""
        return glance(
            self._books,
            self._starts.costs,
            now=time.monotonic(),
            budget_mb=self.memory.squeeze.budget_mb,
            capacity=self._config.capacity,
            blocked=self._starts.problems(self._images),
        )

    def expected_s(self, position: int) -> float | None:
        """In how many seconds the run at a place in the queue (from 1) may have a container; None: not known."""
        return self._completions.expected_s(position, len(self._books))

    # --- room -------------------------------------------------------------------------------------------------

    def size_mb(self, need: Need) -> int:
        """Memory of a container for a need."""
        return self._starter.size(need.image, need).memory_mb

    def _room(self, memory_mb: int, *, for_run: bool) -> tuple[Retire, ...] | None:
        """Return whom to give up for a container of this size; None when there is no room."""
        return self._planner.room(self._view(), memory_mb, time.monotonic(), for_run=for_run)

    def has_room(self, need: Need) -> bool:
        """Whether there is room for one more container, if need be in place of an idle one."""
        return self._room(self.size_mb(need), for_run=True) is not None

    def make_room(self, need: Need) -> tuple[tuple[Idle, str], ...] | None:
        """Return whom a run's new container takes the place of, each with why; None when there is no room."""
        view = self._view()
        victims = self._planner.room(view, self.size_mb(need), time.monotonic(), for_run=True)
        if victims is None:
            return None
        idle = {each.id: each for each in view.idle}
        return tuple((idle[each.id], each.why) for each in victims)

    @property
    def weighed(self) -> Weighed | None:
        """What the last room for a run was made from, where it took the place of something."""
        return self._planner.weighed

    def tend(self, now: float) -> tuple[tuple[Start, ...], tuple[Retire, ...]]:
        """Return what to start ahead and what to give up, to be carried out together, retirements first."""
        return self._planner.tend(self._view(), now)

    # --- what cannot be ---------------------------------------------------------------------------------------

    def check_startable(self, need: Need, turn: Turn | None = None) -> None:
        """Raise when a cold start now would be in vain.

        Raises:
            PoolError: Podman is away.
            RefusedError: the image does not start, or everything is busy and too many wait.
        """
        self.check_image(need.image)
        if self._books.queue >= self._config.queue and not self.has_room(need):
            # A full queue turns away the run that would be served last, which need not be the newest.
            if turn is not None and self._books.queue and not self._books.would_be_last(turn):
                return
            self._refused["queue full"] += 1
            raise self.full()

    def check_image(self, image: str) -> None:
        """Raise PoolError when Podman is away, RefusedError when the image does not start."""
        if self._link.problem:
            raise PoolError(self._link.problem, remedy="swiftbot doctor tells more")
        if reason := self._starts.why_not(image):
            self._refused["quarantined image"] += 1
            raise RefusedError(reason, remedy="swiftbot images build, then swiftbot pool release")

    def full(self) -> RefusedError:
        """Return the refusal of a run for which there is no place in the queue."""
        after_s = self.expected_s(self._books.queue + 1)
        when = "wait" if after_s is None else f"ask again in about {after_s:.1f} s"
        return RefusedError(
            f"all {len(self._books)} containers of {self._gateway} are busy and {self._books.queue} runs wait"
            + (f"; {self.squeeze}" if self.squeeze else ""),
            remedy=f"{when}, or raise pool.capacity",
            retry_after_s=after_s or 0.0,
        )

    def why_no_start(self, image: str) -> str:
        """Return why one more container of an image cannot be started ahead now; empty when it can."""
        if reason := self._link.problem or self._starts.why_not(image):
            return reason
        size_mb = self._starter.size(image).memory_mb
        victims = self._room(size_mb, for_run=False)
        if victims is not None and not any(self._image_of(each) == image for each in victims):
            return ""
        holders = Counter(f"{each.info.state} {each.info.image}" for each in self._books)
        return (
            f"no room for one more {image} container ({size_mb} MB): {len(self._books)} of {self._config.capacity}"
            f" places and {self._books.memory_mb} of {self.memory.squeeze.budget_mb} MB are taken by "
            + ", ".join(f"{count} {what}" for what, count in sorted(holders.items()))
            + (f"; {self.squeeze}" if self.squeeze else "")
        )

    def _image_of(self, retirement: Retire) -> str:
        container = self._books.get(retirement.id)
        return container.info.image if container is not None else ""


def _hour(now: float) -> float:
    """Return the hour of the day (UTC) at a reading of the monotonic clock: what people do follows it."""
    return (time.time() - (time.monotonic() - now)) / 3600.0 % 24.0


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


class ContainerManager:
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
        self.books = Allocator(config, begin=self._begin, on_change=on_change, refused=refused, full=self._full)
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
        self.background = Background()
        """What `stop` waits for."""
        self._next_sweep = math.inf
        self.draining = False
        """Nothing new is begun here: no run, no hint, no warming."""
        self._adopted = False
        self._stopped = False
        self._standing = Background()

    # --- what is --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Why containers, or those of some image, cannot be started now; empty when they can."""
        return self.link.problem or "; ".join(self.starts.problems(self._images).values())

    def _full(self) -> RefusedError:
        """Say that there is no place for a run; the planner that knows is made after the allocator that asks."""
        return self.planning.full()

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
            self._standing.start(work, work.__qualname__)

    async def stop(self, *, keep_containers: bool, patience_s: float) -> None:
        """Let go of everything; containers go on running, to be adopted, if they are to be kept."""
        self._stopped = True
        self.books.send_away()
        self._standing.cancel()
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
        return [*self._standing.tasks, *self.link.unfinished, *self.starts.unfinished, *self.background.tasks]

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
            self.books.hold(container, FOR_A_RUN)  # with a lease, should its run go away at this very moment
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
        self.background.start(self._bury(container, ask=ask), f"remove {container.id}")
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
                self.background.start(self._probe(container), f"probe {container.id}")
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
            self.background.start(self._sweep(), "look for stray containers")

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
