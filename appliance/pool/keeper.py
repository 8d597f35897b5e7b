"""Keeps the containers: the books of who is there and who has which, and the tending of both.

It exists apart from the door (`pool.py`) because runs come and go by the second while containers have a life of
their own: they are started ahead, probed, leased, given up, lost and found. It decides nothing itself
(`selection`, `policies`) and touches no container itself (`starter`, `container`); it only makes sure that the
books are right, at every step between two awaits.
"""

import asyncio
import contextlib
import secrets
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine
from typing import Any

import structlog

from appliance.errors import PoolError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import ContainerInfo, ContainerState, Need
from appliance.pool import policies
from appliance.pool.container import PooledContainer
from appliance.pool.engine import Engine, EngineFacts
from appliance.pool.policies.greedy_dual import GreedyDual
from appliance.pool.policies.planner import missing, victims
from appliance.pool.selection import best_local
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter

log = structlog.get_logger(__name__)

TEND_S = 0.5
"""How often the books are gone through when nothing happens."""
MAX_RECONNECT_S = 30.0
CONNECT_WAIT_S = 10.0
"""How long a start waits for Podman; after that it goes on without."""
FOR_A_RUN = "cold"
"""Reservation of a container that is started for one waiting run."""


class _Waiter:
    """Somebody in the queue."""

    def __init__(self, need: Need) -> None:
        self.need = need
        self.got: asyncio.Future[PooledContainer] = asyncio.get_running_loop().create_future()


class Keeper:
    """The containers of one gateway. `starter` makes them; `refused` counts what is declined."""

    def __init__(
        self,
        config: PoolConfig,
        *,
        gateway: str,
        make_starter: Callable[[Callable[[PooledContainer], None]], Starter],
        make_engine: Callable[[], Engine],
        on_change: Callable[[tuple[ContainerInfo, ...]], None],
        refused: Counter[str],
    ) -> None:
        self.facts: EngineFacts | None = None
        self.podman_problem = "not started"
        self.costs = policies.ColdCosts(config.cold_ms)
        self._config = config
        self._gateway = gateway
        self._starter = make_starter(lambda container: self.retire(container, "it died"))
        self._make_engine = make_engine
        self._on_change = on_change
        self._refused = refused
        self._pooled: dict[str, PooledContainer] = {}
        self._starts: dict[str, asyncio.Task[SwiftbotError | None]] = {}
        self._waiting: deque[_Waiter] = deque()
        self._background: set[asyncio.Task[None]] = set()
        self._quarantine = policies.Quarantine(after=config.bad_starts, for_s=config.quarantine_s)
        self._asked: dict[str, tuple[int, float]] = {}
        """Containers of each image that somebody asked to have ready, and until when."""
        self._evictor = GreedyDual()
        self._engine: Engine | None = None
        self._connecting: asyncio.Task[None] | None = None
        self._pause_s = config.reconnect_s
        self._try_at = 0.0
        self._adopted = False
        self._stopped = False
        self._wake = asyncio.Event()
        self._watchers: set[asyncio.Event] = set()
        self._tender: asyncio.Task[None] | None = None

    # --- what is --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Why containers, or those of some image, cannot be started now; empty when they can."""
        return self.podman_problem or "; ".join(self._quarantine.reasons(time.monotonic()))

    @property
    def queue(self) -> int:
        """Runs that wait for a container."""
        return len(self._waiting)

    def containers(self) -> tuple[ContainerInfo, ...]:
        """Return the facts of all containers held."""
        return tuple(each.info for each in self._pooled.values())

    def check_startable(self, need: Need) -> None:
        """Raise when a cold start now would be in vain.

        Raises:
            PoolError: Podman is away.
            RefusedError: the image does not start, or everything is busy and too many wait.
        """
        if self.podman_problem:
            raise PoolError(self.podman_problem, remedy="swiftbot doctor tells more")
        reason = self._quarantine.reason(need.image, time.monotonic())
        if reason:
            self._refused["quarantined image"] += 1
            raise RefusedError(reason, remedy="swiftbot images build, then swiftbot doctor")
        if len(self._waiting) >= self._config.queue and self._room(need, commit=False) is None:
            self._refused["queue full"] += 1
            raise RefusedError(
                f"all {len(self._pooled)} containers of {self._gateway} are busy and {len(self._waiting)} runs wait",
                remedy="wait, or raise pool.capacity",
            )

    # --- what others ask --------------------------------------------------------------------------------------

    def want(self, image: str, count: int, for_s: float) -> None:
        """Have so many containers of an image ready for so long, as far as there is room."""
        now = time.monotonic()
        before, until = self._asked.get(image, (0, 0.0))
        if until > now:
            count, for_s = max(before, count), max(until - now, for_s)
        self._asked[image] = (count, now + for_s)
        self._wake.set()

    def why_no_start(self, image: str) -> str:
        """Return why one more container of an image cannot be started now; empty when it can."""
        if self.podman_problem:
            return self.podman_problem
        reason = self._quarantine.reason(image, time.monotonic())
        if reason:
            return reason
        size_mb = self._starter.size(image).memory_mb
        if self._free(size_mb, spare_floor=True, commit=False) is not None:
            return ""
        held_mb = sum(each.info.memory_mb for each in self._pooled.values())
        holders = Counter(f"{each.info.state} {each.info.image}" for each in self._pooled.values())
        return (
            f"no room for one more {image} container ({size_mb} MB): {len(self._pooled)} of {self._config.capacity}"
            f" places and {held_mb} of {self._config.memory_mb} MB are taken by "
            + ", ".join(f"{count} {what}" for what, count in sorted(holders.items()))
        )

    async def have(self, image: str, count: int) -> None:
        """Wait until so many containers of an image are ready, or no more can be started."""
        changed = asyncio.Event()
        self._watchers.add(changed)
        try:
            while self._count(image, ContainerState.READY) < count and (self._starts or not self.why_no_start(image)):
                await changed.wait()
                changed.clear()
        finally:
            self._watchers.discard(changed)

    def why_kept(self, info: ContainerInfo) -> str:
        """Return why a container cannot be given up now; empty when it can."""
        match info.state:
            case ContainerState.READY:
                return ""
            case ContainerState.BUSY:
                return f"it runs {info.run}"
            case ContainerState.RESERVED:
                return "a run is about to begin in it"
            case state:
                return f"it is {state}"

    def give_up(self, container_id: str, why: str) -> None:
        """Retire a container that is idle."""
        self.retire(self._pooled[container_id], why)

    def release_quarantine(self, image: str) -> str:
        """Start containers of an image again; returns why they were not, empty when they were."""
        reason = self._quarantine.reason(image, time.monotonic())
        self._quarantine.succeeded(image)
        self._wake.set()
        return reason

    # --- life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect to Podman and adopt what is there; whatever is missing then is worked on in the background."""
        self._connecting = asyncio.create_task(self._connect(), name="connect to Podman")
        await asyncio.wait({self._connecting}, timeout=CONNECT_WAIT_S)
        self._tender = asyncio.create_task(self._tend_forever(), name="tend the pool")

    async def stop(self, *, keep_containers: bool, patience_s: float) -> None:
        """Let go of everything; containers go on running, to be adopted, if they are to be kept."""
        self._stopped = True
        for waiter in self._waiting:
            waiter.got.cancel()
        for task in (self._tender, self._connecting):
            if task is not None:
                task.cancel()
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
        for container in self._pooled.values():
            container.close()
        if not keep_containers and self._engine is not None:
            try:
                await asyncio.gather(*(self._starter.remove(each, self._engine) for each in self._pooled.values()))
                await asyncio.gather(*(self._engine.remove(each) for each in await self._starter.own(self._engine)))
            except SwiftbotError as error:
                log.warning("containers were left", reason=str(error))
        self._pooled.clear()
        if self._engine is not None:
            await asyncio.to_thread(self._engine.close)
            self._engine = None

    def _unfinished(self) -> list[asyncio.Task[Any]]:
        own = [task for task in (self._tender, self._connecting) if task is not None and not task.done()]
        return [*own, *self._starts.values(), *self._background]

    # --- handing out ------------------------------------------------------------------------------------------

    def reserve(self, container_id: str) -> str:
        """Hold a ready container for the lease and return the reservation's name."""
        container = self._pooled[container_id]
        self._hold(container, secrets.token_hex(4))
        self._changed()
        return container.reservation

    def _hold(self, container: PooledContainer, reservation: str) -> None:
        container.reservation = reservation
        container.lease_until = time.monotonic() + self._config.lease_s
        container.become(ContainerState.RESERVED)

    def claim(self, need: Need, *, container_id: str, reservation: str) -> PooledContainer | None:
        """Return the container that is held under a reservation, or else another that is ready, or None."""
        held = self._pooled.get(container_id)
        if held is not None and reservation and held.reservation == reservation:
            return held
        return self._ready_for(need)

    def _ready_for(self, need: Need) -> PooledContainer | None:
        if self._config.mode == "cold":
            return None
        found = best_local(self.containers(), need, self._config.weights)
        return self._pooled[found[0].id] if found is not None else None

    def busy(self, container: PooledContainer, run_id: str) -> None:
        """Note that a run has it."""
        container.reservation = ""
        container.become(ContainerState.BUSY, run=run_id)
        self._changed()

    async def acquire(self, need: Need) -> PooledContainer:
        """Start a container, or wait for one when there is no room. Its reservation tells a new one: FOR_A_RUN.

        Raises:
            PoolError, PrerequisiteError, UnreachableError: none started, or none came free in time.
            RefusedError: too many wait already.
        """
        container = self._begin_cold(need)
        if container is None:
            container = await self._wait_in_queue(need)
        if container.info.state is ContainerState.STARTING:
            try:
                error = await asyncio.shield(self._starts[container.id])
            except asyncio.CancelledError:
                container.reservation = ""  # nobody waits for it any more: it joins the ready ones
                raise
            if error is not None:
                raise error
        return container

    def _begin_cold(self, need: Need) -> PooledContainer | None:
        """Begin a start for one run; None when there is no room. Raises when a start would be in vain."""
        self.check_startable(need)
        if self._room(need, commit=True) is None:
            return None
        container = self._start(need.image, need)
        container.reservation = FOR_A_RUN
        return container

    async def _wait_in_queue(self, need: Need) -> PooledContainer:
        waiter = _Waiter(need)
        self._waiting.append(waiter)
        try:
            async with asyncio.timeout(self._config.queue_wait_s):
                try:
                    return await waiter.got
                except asyncio.CancelledError:
                    if waiter.got.done() and not waiter.got.cancelled() and waiter.got.exception() is None:
                        self._give_back(waiter.got.result())  # it was handed over at the very moment
                    raise
        except TimeoutError as error:
            self._refused["queue wait"] += 1
            raise PoolError(
                f"no container came free within {self._config.queue_wait_s:g} s", remedy="raise pool.capacity"
            ) from error
        finally:
            self._waiting.remove(waiter)

    def _give_back(self, container: PooledContainer) -> None:
        container.reservation = ""
        if container.info.state is not ContainerState.STARTING:
            self.release(container)

    def _serve_queue(self) -> None:
        """Hand what is ready, or room for a new one, to those who wait, first come first served."""
        for waiter in list(self._waiting):
            if waiter.got.done():
                continue
            container = self._ready_for(waiter.need)
            if container is not None:
                self._hold(container, "queue")
            elif self._room(waiter.need, commit=False) is not None:
                try:
                    container = self._begin_cold(waiter.need)
                except SwiftbotError as error:
                    waiter.got.set_exception(error)
                    continue
            if container is not None:
                waiter.got.set_result(container)

    def _room(self, need: Need, *, commit: bool) -> tuple[policies.Idle, ...] | None:
        """Return whom to give up for a container of this need; None when there is no room. `commit` does it."""
        return self._free(self._starter.size(need.image, need).memory_mb, spare_floor=False, commit=commit)

    def _free(self, memory_mb: int, *, spare_floor: bool, commit: bool) -> tuple[policies.Idle, ...] | None:
        now = time.monotonic()
        held = sum(each.info.memory_mb for each in self._pooled.values())
        idle = [
            policies.Idle(
                id=each.id,
                image=each.info.image,
                memory_mb=each.info.memory_mb,
                runs=each.info.runs,
                cold_ms=each.info.cold_ms or self.costs.of(each.info.image),
                since=each.idle_since,
            )
            for each in self._pooled.values()
            if each.info.state is ContainerState.READY
        ]
        chosen = victims(
            idle,
            self._evictor.worths(idle, now),
            slots=len(self._pooled) + 1 - self._config.capacity,
            memory_mb=held + memory_mb - self._config.memory_mb,
            spare=self._wanted(now) if spare_floor else {},
        )
        if commit:
            for each in chosen or ():
                self._evictor.evicted(each, now)
                # Those who wait are served when the new one has its place, not in between.
                self.retire(self._pooled[each.id], "its place is needed", serve=False)
        return chosen

    # --- starting and ending ----------------------------------------------------------------------------------

    def _start(self, image: str, need: Need | None) -> PooledContainer:
        container = self._starter.new(image, need)
        self._pooled[container.id] = container
        self._starts[container.id] = asyncio.create_task(self._carry_start(container), name=f"start {container.id}")
        self._changed()
        return container

    async def _carry_start(self, container: PooledContainer) -> SwiftbotError | None:
        """Start a container; returns why it did not, for whoever waits for it."""
        image = container.info.image
        error: SwiftbotError | None = None
        try:
            if self._engine is None or self.facts is None:
                raise PoolError(self.podman_problem or "Podman is not connected")
            await self._starter.start(container, self._engine, self.facts)
        except SwiftbotError as caught:
            error = caught
            log.warning("container did not start", image=image, container=container.id, reason=str(error))
            if isinstance(error, UnreachableError):
                self._lost(error)
            else:
                self._quarantine.failed(image, str(error), time.monotonic())
        finally:
            del self._starts[container.id]
            if container.info.cold_ms is None:
                self._pooled.pop(container.id, None)
        if error is None and container.id not in self._pooled:
            error = PoolError(f"container {container.id} died as soon as it was there")
            self._quarantine.failed(image, str(error), time.monotonic())
        if error is not None:
            self._serve_queue()
            self._changed()
            return error
        self._quarantine.succeeded(image)
        cold_ms = container.info.cold_ms or 0.0
        self.costs.add(image, cold_ms)
        log.info("container ready", image=image, container=container.id, took_ms=round(cold_ms))
        container.next_probe = time.monotonic() + self._config.probe_s
        if container.reservation != FOR_A_RUN:
            if self._config.mode == "cold":
                self.retire(container, "nobody waits for it any more")
            else:
                self.release(container)
        return None

    def ran(self, container: PooledContainer) -> None:
        """Note that a run in it has ended well swept, and make it ready, or replace it when it has had its day."""
        container.count_run()
        grown_mb = container.rss_mb - container.first_rss_mb
        if self._config.mode == "cold":
            self.retire(container, "mode is cold")
        elif container.info.runs >= self._config.max_runs:
            self.retire(container, f"it has had {container.info.runs} runs")
        elif grown_mb > self._config.max_growth_mb:
            self.retire(container, f"its runner has grown by {grown_mb:.0f} MB")
        else:
            self.release(container)

    def release(self, container: PooledContainer) -> None:
        """Make a container ready for the next."""
        if self._pooled.get(container.id) is not container:
            return
        container.reservation = ""
        container.idle_since = time.monotonic()
        container.become(ContainerState.READY)
        self._serve_queue()
        self._changed()

    def retire(self, container: PooledContainer, reason: str, *, serve: bool = True) -> None:
        """Take a container out of the books at once and remove it in the background."""
        if self._pooled.pop(container.id, None) is None:
            return
        log.info("container retired", container=container.id, image=container.info.image, reason=reason)
        container.become(ContainerState.DEAD)
        container.close()
        self.spawn(self._bury(container), f"remove {container.id}")
        if serve:
            self._serve_queue()
        self._changed()

    async def _bury(self, container: PooledContainer) -> None:
        try:
            await self._starter.remove(container, self._engine)
        except UnreachableError as error:
            self._lost(error)  # what is left is found by its label after reconnecting
        except SwiftbotError as error:
            log.warning("container was not removed", container=container.id, reason=str(error))

    def spawn(self, work: Coroutine[Any, Any, None], name: str) -> None:
        """Run something in the background that `stop` waits for."""
        task = asyncio.create_task(work, name=name)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    def _changed(self) -> None:
        self._wake.set()
        for watcher in self._watchers:
            watcher.set()
        self._on_change(self.containers())

    # --- tending ----------------------------------------------------------------------------------------------

    async def _tend_forever(self) -> None:
        while True:
            try:
                self._tend(time.monotonic())
            except Exception:  # supervision boundary: the pool is tended for as long as the gateway lives
                log.exception("tending the pool broke")
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TEND_S):
                    await self._wake.wait()

    def _tend(self, now: float) -> None:
        if self.podman_problem and now >= self._try_at and (self._connecting is None or self._connecting.done()):
            self._connecting = asyncio.create_task(self._connect(), name="connect to Podman")
        for container in list(self._pooled.values()):
            self._look_at(container, now)
        self._serve_queue()
        if not self._stopped and not self.podman_problem and self._config.mode != "cold":
            self._prewarm(now)

    def _look_at(self, container: PooledContainer, now: float) -> None:
        info = container.info
        if info.state is ContainerState.RESERVED and now >= container.lease_until:
            self._refused["lease expired"] += 1
            self.release(container)
        elif (
            info.state is ContainerState.READY
            and now - container.idle_since > self._config.idle_s
            and self._count(info.image) > self._wanted(now).get(info.image, 0)
        ):
            self.retire(container, "idle for long")
        elif info.state is not ContainerState.STARTING and now >= container.next_probe:
            container.next_probe = now + self._config.probe_s
            self.spawn(self._probe(container), f"probe {container.id}")

    def _count(self, image: str, *states: ContainerState) -> int:
        states = states or (ContainerState.READY, ContainerState.STARTING)
        return sum(each.info.image == image and each.info.state in states for each in self._pooled.values())

    def _wanted(self, now: float) -> dict[str, int]:
        """Return how many containers of each image are to be ready: the floor, and what was asked for."""
        self._asked = {image: each for image, each in self._asked.items() if each[1] > now}
        wanted = dict(self._config.floor)
        for image, (count, _) in self._asked.items():
            wanted[image] = max(count, wanted.get(image, 0))
        return wanted

    def _prewarm(self, now: float) -> None:
        wanted = self._wanted(now)
        coming = {image: self._count(image) for image in wanted}
        for image in missing(wanted, coming):
            if len(self._starts) >= self._config.starts_at_once:
                return
            if self._quarantine.reason(image, now):
                continue
            if self._free(self._starter.size(image).memory_mb, spare_floor=True, commit=True) is not None:
                self._start(image, None)

    async def _probe(self, container: PooledContainer) -> None:
        try:
            await container.ping(timeout_s=self._config.probe_timeout_s)
            container.missed_probes = 0
        except SwiftbotError as error:
            container.missed_probes += 1
            if container.missed_probes >= self._config.probe_failures:
                self.retire(container, f"does not answer: {error.message}")

    # --- Podman -----------------------------------------------------------------------------------------------

    def _lost(self, error: SwiftbotError) -> None:
        if not self.podman_problem:
            self.podman_problem = str(error)
            self._pause_s = self._config.reconnect_s
            self._try_at = time.monotonic() + self._pause_s
            log.warning("Podman is away", reason=str(error))

    async def _connect(self) -> None:
        """Reach Podman; the first time adopt what is there, later remove what was left over."""
        try:
            self._engine = self._engine or self._make_engine()
            self.facts = await self._engine.facts()
            if self._adopted:
                await self._remove_strays(self._engine)
            else:
                await self._adopt(self._engine)
        except SwiftbotError as error:
            if self.podman_problem != str(error):
                log.warning("Podman cannot be used", reason=str(error))
            self.podman_problem = str(error)
            self._try_at = time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, MAX_RECONNECT_S)
            return
        self.podman_problem = ""
        self._pause_s = self._config.reconnect_s
        self._changed()

    async def _adopt(self, engine: Engine) -> None:
        for container in await self._starter.adopt(engine):
            self._pooled[container.id] = container
            container.next_probe = time.monotonic() + self._config.probe_s
            log.info("container adopted", container=container.id, image=container.info.image)
            if self._config.mode == "cold":
                self.retire(container, "mode is cold")
            else:
                self.release(container)
        self._adopted = True
        if self.facts is not None and not self.facts.limits_enforced:
            log.warning("limits of containers are not enforced here", cgroup=self.facts.cgroup_version)

    async def _remove_strays(self, engine: Engine) -> None:
        """Remove what could not be removed while Podman was away."""
        for found in await self._starter.own(engine):
            if found not in {each.engine_id for each in self._pooled.values()} and not self._starts:
                await engine.remove(found)
