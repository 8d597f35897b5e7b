"""The pool: this gateway's containers, who has which, and what happens when one goes.

It exists because a container takes hundreds of milliseconds to start and a fork in one that runs takes one or
two: so containers are started before they are wanted, handed out by reservation, replaced when they die, and
taken over again after a restart. It decides nothing itself: `selection` and `policies` decide, `starter` and
`container` act, and this module keeps the books between them.

Guarantees:
    - Two selections never get the same container; one that is selected and not used is free again after a lease.
    - Nothing here waits without bound, and nobody waits in a queue without bound.
    - Podman absent or dying stops new containers only: `problem` says why, and those that run serve on.
"""

import asyncio
import contextlib
import secrets
import time
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec
import structlog

from appliance.errors import (
    CancelledByOperatorError,
    ConfigError,
    NotFoundError,
    PoolError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import (
    ContainerInfo,
    ContainerState,
    Failure,
    Need,
    Phase,
    RunEvent,
    RunEventKind,
    RunRequest,
    Site,
)
from appliance.pool import policies
from appliance.pool.container import Connection, PooledContainer
from appliance.pool.conversation import Call, Conversation, order
from appliance.pool.engine import Engine, EngineFacts, PodmanEngine
from appliance.pool.selection import Candidate, Decision, best_local, select
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter
from appliance.skills.catalogue import Catalogue

__all__ = ["Call", "Pool"]

log = structlog.get_logger(__name__)

TEND_S = 0.5
"""How often the books are gone through when nothing happens."""
MAX_RECONNECT_S = 30.0
BACKSTOP_S = 3.0
"""How much longer than the runner itself the pool waits for a run to end, before it ends the container."""


class _Waiter:
    """Somebody in the queue."""

    def __init__(self, need: Need) -> None:
        self.need = need
        self.got: asyncio.Future[PooledContainer] = asyncio.get_running_loop().create_future()


class _Run:
    """A run in progress here."""

    def __init__(self) -> None:
        self.cancelled = False
        self.acquiring: asyncio.Task[PooledContainer] | None = None
        self.container: PooledContainer | None = None
        self.patience: asyncio.Timeout | None = None


class Pool:
    """Warm containers of one gateway."""

    def __init__(
        self,
        config: PoolConfig,
        *,
        gateway: str,
        fleet: str,
        run_dir: Path,
        catalogue: Catalogue,
        site: Site,
        find_remote: Callable[[Need], Awaitable[list[Candidate]]],
        on_call: Callable[[Call], Awaitable[dict[str, Any]]],
        on_change: Callable[[tuple[ContainerInfo, ...]], None],
        make_engine: Callable[[], Engine] | None = None,
    ) -> None:
        for image in config.floor:
            if image not in catalogue.images:
                raise ConfigError(
                    f"pool.floor: there is no image {image!r}", remedy=f"known: {', '.join(sorted(catalogue.images))}"
                )
        self.gateway = gateway
        self.refused: Counter[str] = Counter()
        self._config = config
        self._catalogue = catalogue
        self._site: dict[str, Any] = msgspec.to_builtins(site)
        self._find_remote = find_remote
        self._on_call = on_call
        self._on_change = on_change
        self._make_engine = make_engine or (lambda: PodmanEngine(config.podman_url))
        self._starter = Starter(
            config, gateway=gateway, fleet=fleet, run_dir=run_dir, catalogue=catalogue, on_death=self._died
        )
        self._pooled: dict[str, PooledContainer] = {}
        self._starts: dict[str, asyncio.Task[SwiftbotError | None]] = {}
        self._waiting: deque[_Waiter] = deque()
        self._runs: dict[str, _Run] = {}
        self._background: set[asyncio.Task[None]] = set()
        self._costs = policies.ColdCosts(config.cold_ms)
        self._quarantine = policies.Quarantine(after=config.bad_starts, for_s=config.quarantine_s)
        self._clock = 0.0
        self._engine: Engine | None = None
        self._facts: EngineFacts | None = None
        self._podman_problem = "not started"
        self._pause_s = config.reconnect_s
        self._try_at = 0.0
        self._adopted = False
        self._draining = False
        self._wake = asyncio.Event()
        self._tender: asyncio.Task[None] | None = None

    # --- what is --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Why containers, or those of some image, cannot be started now; empty when they can."""
        return self._podman_problem or "; ".join(self._quarantine.reasons(time.monotonic()))

    @property
    def limits_enforced(self) -> bool:
        """Whether memory, CPU and process limits of containers hold on this machine."""
        return self._facts is not None and self._facts.limits_enforced

    @property
    def queue(self) -> int:
        """Runs that wait for a container."""
        return len(self._waiting)

    def containers(self) -> tuple[ContainerInfo, ...]:
        """Return the facts of all containers held."""
        return tuple(each.info for each in self._pooled.values())

    def cold_ms(self, image: str) -> float:
        """Return what a cold start of an image is expected to take here, milliseconds."""
        return self._costs.of(image)

    # --- life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect to Podman, adopt this gateway's containers, and warm up to the floor in the background."""
        await self._connect()
        self._tender = asyncio.create_task(self._tend_forever(), name="pool")

    async def drain(self, deadline_s: float) -> None:
        """Take no new run and wait for those in progress; what is left after `deadline_s` is cancelled."""
        self._draining = True
        until = time.monotonic() + deadline_s
        while self._runs and time.monotonic() < until:
            await asyncio.sleep(0.02)
        for run_id in list(self._runs):
            await self.cancel(run_id)
        until = time.monotonic() + self._config.cancel_grace_s + BACKSTOP_S
        while self._runs and time.monotonic() < until:
            await asyncio.sleep(0.02)

    async def stop(self, *, keep_containers: bool) -> None:
        """Let go of everything; containers go on running, to be adopted, if they are to be kept."""
        self._draining = True
        tasks: list[asyncio.Task[Any]] = [*self._starts.values(), *self._background]
        if self._tender is not None:
            tasks.append(self._tender)
        for waiter in self._waiting:
            waiter.got.cancel()
        for task in self._starts.values():
            task.cancel()
        if self._tender is not None:
            self._tender.cancel()
        if tasks:
            _, late = await asyncio.wait(tasks, timeout=self._config.cancel_grace_s + 2 * BACKSTOP_S)
            for task in late:
                task.cancel()
        for container in self._pooled.values():
            container.close()
        if not keep_containers and self._engine is not None:
            removals = (self._starter.remove(each, self._engine) for each in self._pooled.values())
            for result in await asyncio.gather(*removals, return_exceptions=True):
                if isinstance(result, BaseException):
                    log.warning("container was left", reason=str(result))
        self._pooled.clear()
        if self._engine is not None:
            await asyncio.to_thread(self._engine.close)
            self._engine = None

    # --- selecting ------------------------------------------------------------------------------------------

    async def select(self, need: Need, *, allow_remote: bool) -> Decision:
        """Decide where a subtask runs (Algorithm 1); a local container is reserved for the lease.

        Raises:
            NotFoundError: there is no such image.
            RefusedError: draining; or all containers are busy and too many wait; or the image does not start.
            PoolError: no container is ready and none can be started.
        """
        self._check(need)
        decision = self._choose(need, ())
        if decision.phase is Phase.COLD and allow_remote and self._config.mode == "federated":
            offers: list[Candidate] = []
            try:
                async with asyncio.timeout(self._config.remote_timeout_s):
                    offers = await self._find_remote(need)
            except (TimeoutError, SwiftbotError) as error:
                log.info("other gateways could not be asked", reason=str(error) or "too slow")
            decision = self._choose(need, offers)
        if decision.phase is Phase.COLD:
            self._check_startable(need)
        return decision

    def _check(self, need: Need) -> None:
        if need.image not in self._catalogue.images:
            self.refused["unknown image"] += 1
            raise NotFoundError(
                f"no image {need.image[:60]!r}", remedy=f"known: {', '.join(sorted(self._catalogue.images))}"
            )
        if need.cpu <= 0 or need.memory_mb <= 0:
            self.refused["bad need"] += 1
            raise RefusedError("a need of no CPU or no memory", remedy="ask for more than 0 of each")
        if self._draining:
            raise RefusedError(f"{self.gateway} is draining", remedy="another gateway takes it")

    def _check_startable(self, need: Need) -> None:
        """Raise when a cold start now would be in vain."""
        if self._podman_problem:
            raise PoolError(self._podman_problem, remedy="swiftbot doctor tells more")
        reason = self._quarantine.reason(need.image, time.monotonic())
        if reason:
            self.refused["quarantined image"] += 1
            raise RefusedError(reason, remedy="swiftbot images build, then swiftbot doctor")
        if len(self._waiting) >= self._config.queue and self._room(need, commit=False) is None:
            self.refused["queue full"] += 1
            raise RefusedError(
                f"all {len(self._pooled)} containers of {self.gateway} are busy and {len(self._waiting)} runs wait",
                remedy="wait, or raise pool.capacity",
            )

    def _choose(self, need: Need, offers: list[Candidate] | tuple[()]) -> Decision:
        decision = select(
            need, self.containers(), offers, self._costs.of(need.image), self._config, gateway=self.gateway
        )
        if decision.phase is Phase.LOCAL_WARM and decision.container is not None:
            container = self._pooled[decision.container]
            self._reserve(container)
            return msgspec.structs.replace(decision, reservation=container.reservation)
        return decision

    def _reserve(self, container: PooledContainer) -> None:
        container.reservation = secrets.token_hex(4)
        container.lease_until = time.monotonic() + self._config.lease_s
        container.become(ContainerState.RESERVED)
        self._changed()

    # --- running --------------------------------------------------------------------------------------------

    async def run(
        self, request: RunRequest, decision: Decision, on_event: Callable[[RunEvent], None]
    ) -> RunEvent:
        """Run one attempt of a subtask here, warm or cold, to its end.

        Args:
            request: what to run.
            decision: what `select` said; if its container is gone, another is taken or started.
            on_event: gets every event but the last, in order, on the event loop.

        Returns:
            The last event, `succeeded` or `failed`. Its `phase` is what really happened.

        Raises:
            RefusedError, NotFoundError, PoolError: it was not begun, and why.
        """
        entered_ns = time.monotonic_ns()
        self._check(request.need)
        skill = self._catalogue.skills.get(request.skill)
        if skill is None or not skill.implemented:
            self.refused["unknown skill"] += 1
            raise NotFoundError(f"skill {request.skill[:60]!r} is not implemented here", remedy="swiftbot plan shows it")
        if decision.phase is Phase.REMOTE_WARM and decision.gateway != self.gateway:
            raise RefusedError(f"the container chosen is on {decision.gateway}", remedy="send the run there")
        if request.run_id in self._runs:
            raise RefusedError(f"run {request.run_id} is in progress here")
        run = self._runs[request.run_id] = _Run()
        try:
            while True:
                container = self._claim(request.need, decision)
                warm = container is not None
                if container is None:
                    run.acquiring = asyncio.create_task(self._acquire(request.need), name=f"get {request.run_id}")
                    try:
                        container = await run.acquiring
                    except asyncio.CancelledError:
                        if not run.cancelled:
                            run.acquiring.cancel()
                            raise
                        raise CancelledByOperatorError(f"{request.run_id} was cancelled before it began") from None
                    # A start that was made for this run says so; from the queue a used one may come.
                    warm = container.reservation != "cold"
                phase = Phase.LOCAL_WARM if warm else Phase.COLD
                run.container = container
                container.reservation = ""
                container.become(ContainerState.BUSY, run=request.run_id)
                self._changed()
                try:
                    connection = await container.begin(order(request, self._site))
                    break
                except UnreachableError:
                    # It died unnoticed: nothing has run, so another one is taken.
                    self._retire(container, "dead")
                except SwiftbotError:
                    self._release(container)
                    raise
            conversation = Conversation(
                connection,
                request,
                gateway=self.gateway,
                container=container.id,
                phase=phase,
                entered_ns=entered_ns,
                on_event=on_event,
                on_call=self._on_call,
                refused=self.refused,
            )
            return await self._listen(request, run, container, connection, conversation)
        except CancelledByOperatorError as error:
            return _ended_before(request, self.gateway, error)
        finally:
            del self._runs[request.run_id]

    async def _listen(
        self,
        request: RunRequest,
        run: _Run,
        container: PooledContainer,
        connection: Connection,
        conversation: Conversation,
    ) -> RunEvent:
        healthy = False
        try:
            if run.cancelled:
                await self.cancel(request.run_id)
            limit_s = request.deadline_s + self._config.cancel_grace_s + BACKSTOP_S
            async with asyncio.timeout(limit_s) as run.patience:
                final = await conversation.listen()
            healthy = True
            return final
        except TimeoutError:
            code = "cancelled" if run.cancelled else "deadline"
            return conversation.failed(code, "the run did not end when told to; its container was ended")
        finally:
            if healthy:
                self._spawn(self._wind_up(container, connection, conversation), f"wind up {container.id}")
            else:
                connection.close()
                self._retire(container, "its run did not end")

    async def _wind_up(self, container: PooledContainer, connection: Connection, conversation: Conversation) -> None:
        """After a run: wait until the runner has swept up, then give the container to the next."""
        try:
            async with asyncio.timeout(self._config.cancel_grace_s + BACKSTOP_S):
                await conversation.gone()
            connection.close()
            await container.refill()
        except (TimeoutError, SwiftbotError) as error:
            connection.close()
            self._retire(container, f"did not come back from its run: {error}")
            return
        container.info = msgspec.structs.replace(container.info, runs=container.info.runs + 1)
        container.clock = self._clock
        if self._config.mode == "cold":
            self._retire(container, "mode is cold")
        elif container.info.runs >= self._config.max_runs:
            self._retire(container, f"it has had {container.info.runs} runs")
        elif container.rss_mb - container.first_rss_mb > self._config.max_growth_mb:
            self._retire(container, f"its runner has grown to {container.rss_mb:.0f} MB")
        else:
            self._release(container)

    async def cancel(self, run_id: str) -> bool:
        """Ask a run to end; its last event follows from `run`. False when there is none of that id."""
        run = self._runs.get(run_id)
        if run is None:
            return False
        run.cancelled = True
        if run.container is None:
            if run.acquiring is not None:
                run.acquiring.cancel()
            return True
        grace_s = self._config.cancel_grace_s
        with contextlib.suppress(SwiftbotError):  # dead, or deaf: the backstop ends it
            await run.container.cancel(run_id, reason="cancelled", grace_s=grace_s)
        if run.patience is not None and not run.patience.expired():
            with contextlib.suppress(RuntimeError):  # it has ended meanwhile
                run.patience.reschedule(asyncio.get_running_loop().time() + grace_s + BACKSTOP_S)
        return True

    # --- getting a container ----------------------------------------------------------------------------------

    def _claim(self, need: Need, decision: Decision) -> PooledContainer | None:
        """Return the container a decision holds, or else another that is ready."""
        if self._config.mode == "cold":
            return None
        held = self._pooled.get(decision.container or "")
        if held is not None and decision.reservation and held.reservation == decision.reservation:
            held.reservation = ""
            return held
        return self._take_ready(need)

    def _take_ready(self, need: Need) -> PooledContainer | None:
        found = best_local(self.containers(), need, self._config.weights) if self._config.mode != "cold" else None
        return self._pooled[found[0].id] if found is not None else None

    async def _acquire(self, need: Need) -> PooledContainer:
        """Start a container, or wait for one when there is no room."""
        container = self._begin_cold(need)
        if container is None:
            container = await self._wait_in_queue(need)
        if container.info.state is ContainerState.STARTING:
            task = self._starts[container.id]
            try:
                error = await asyncio.shield(task)
            except asyncio.CancelledError:
                container.reservation = ""  # nobody waits for it any more: it joins the ready ones
                raise
            if error is not None:
                raise error
        return container

    def _begin_cold(self, need: Need) -> PooledContainer | None:
        """Begin a start for one waiting run; None when there is no room. Raises when a start would be in vain."""
        self._check_startable(need)
        if self._room(need, commit=True) is None:
            return None
        container = self._start(need.image, need)
        container.reservation = "cold"
        return container

    async def _wait_in_queue(self, need: Need) -> PooledContainer:
        waiter = _Waiter(need)
        self._waiting.append(waiter)
        try:
            async with asyncio.timeout(self._config.queue_wait_s):
                return await waiter.got
        except TimeoutError as error:
            self.refused["queue wait"] += 1
            raise PoolError(
                f"no container came free within {self._config.queue_wait_s:g} s", remedy="raise pool.capacity"
            ) from error
        finally:
            with contextlib.suppress(ValueError):
                self._waiting.remove(waiter)
            if waiter.got.done() and not waiter.got.cancelled() and asyncio.current_task() is not None:
                current = asyncio.current_task()
                if current is not None and current.cancelling():
                    self._give_back(waiter.got)

    def _give_back(self, got: "asyncio.Future[PooledContainer]") -> None:
        """Free a container that was handed to somebody who has just gone away."""
        if got.exception() is None:
            container = got.result()
            container.reservation = ""
            if container.info.state is not ContainerState.STARTING:
                self._release(container)

    def _serve_queue(self) -> None:
        """Hand what is ready, or room for a new one, to those who wait, first come first served."""
        for waiter in list(self._waiting):
            if waiter.got.done():
                continue
            container = self._take_ready(waiter.need)
            if container is not None:
                container.reservation = "queue"
                container.lease_until = time.monotonic() + self._config.lease_s
                container.become(ContainerState.RESERVED)
            else:
                try:
                    container = self._begin_cold(waiter.need) if self._room(waiter.need, commit=False) else None
                except SwiftbotError as error:
                    waiter.got.set_exception(error)
                    continue
            if container is not None:
                waiter.got.set_result(container)

    def _room(self, need: Need, *, commit: bool) -> tuple[policies.Idle, ...] | None:
        """Return whom to give up for a container of this need; None when there is no room. `commit` does it."""
        memory = self._starter.size(need.image, need).memory_mb
        return self._free(memory, spare_floor=False, commit=commit)

    def _free(self, memory_mb: int, *, spare_floor: bool, commit: bool) -> tuple[policies.Idle, ...] | None:
        held = sum(each.info.memory_mb for each in self._pooled.values())
        idle = [
            policies.Idle(
                id=each.id,
                image=each.info.image,
                memory_mb=each.info.memory_mb,
                runs=each.info.runs,
                cold_ms=each.info.cold_ms or self._costs.of(each.info.image),
                clock=each.clock,
            )
            for each in self._pooled.values()
            if each.info.state is ContainerState.READY
        ]
        chosen = policies.victims(
            idle,
            slots=len(self._pooled) + 1 - self._config.capacity,
            memory_mb=held + memory_mb - self._config.memory_mb,
            floor=self._config.floor,
            spare_floor=spare_floor,
        )
        for each in chosen or () if commit else ():
            self._clock = max(self._clock, policies.priority(each))
            self._retire(self._pooled[each.id], "its place is needed")
        return chosen

    # --- keeping containers -----------------------------------------------------------------------------------

    def _start(self, image: str, need: Need | None) -> PooledContainer:
        container = self._starter.new(image, need)
        self._pooled[container.id] = container
        self._starts[container.id] = asyncio.create_task(self._carry_start(container), name=f"start {container.id}")
        self._changed()
        return container

    async def _carry_start(self, container: PooledContainer) -> SwiftbotError | None:
        """Start a container; returns why it did not, for whoever waits for it."""
        image = container.info.image
        try:
            if self._engine is None or self._facts is None:
                raise PoolError(self._podman_problem or "Podman is not connected")
            await self._starter.start(container, self._engine, self._facts)
        except SwiftbotError as error:
            log.warning("container did not start", image=image, container=container.id, reason=str(error))
            self._pooled.pop(container.id, None)
            if isinstance(error, UnreachableError):
                self._lost(error)
            else:
                self._quarantine.failed(image, str(error), time.monotonic())
            return error
        except asyncio.CancelledError:
            self._pooled.pop(container.id, None)
            raise
        finally:
            del self._starts[container.id]
            if container.id not in self._pooled:
                self._changed()
        self._quarantine.succeeded(image)
        cold_ms = container.info.cold_ms or 0.0
        self._costs.add(image, cold_ms)
        log.info("container ready", image=image, container=container.id, took_ms=round(cold_ms))
        container.next_probe = time.monotonic() + self._config.probe_s
        if container.id not in self._pooled:  # it died between its answer and here
            return PoolError(f"container {container.id} died at once")
        if not container.reservation:
            if self._config.mode == "cold":
                self._retire(container, "nobody waits for it any more")
            else:
                self._release(container)
        return None

    def _release(self, container: PooledContainer) -> None:
        """Make a container ready for the next."""
        if self._pooled.get(container.id) is not container:
            return
        container.reservation = ""
        container.idle_since = time.monotonic()
        container.become(ContainerState.READY)
        self._serve_queue()
        self._changed()

    def _retire(self, container: PooledContainer, reason: str) -> None:
        """Take a container out of the books at once and remove it in the background."""
        if self._pooled.pop(container.id, None) is None:
            return
        log.info("container retired", container=container.id, image=container.info.image, reason=reason)
        container.become(ContainerState.DEAD)
        container.close()
        self._spawn(self._bury(container), f"remove {container.id}")
        self._serve_queue()
        self._changed()

    async def _bury(self, container: PooledContainer) -> None:
        try:
            await self._starter.remove(container, self._engine)
        except UnreachableError as error:
            self._lost(error)  # what is left is found by its label after reconnecting
        except SwiftbotError as error:
            log.warning("container was not removed", container=container.id, reason=str(error))

    def _died(self, container: PooledContainer) -> None:
        """End of file on the control connection: the container is dead."""
        self._retire(container, "it died")

    def _changed(self) -> None:
        self._wake.set()
        self._on_change(self.containers())

    def _spawn(self, work: Coroutine[Any, Any, None], name: str) -> None:
        task = asyncio.create_task(work, name=name)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    # --- tending ----------------------------------------------------------------------------------------------

    async def _tend_forever(self) -> None:
        while True:
            try:
                await self._tend()
            except Exception:  # noqa: BLE001 - supervision boundary: the pool is tended for as long as the gateway lives
                log.exception("tending the pool broke")
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TEND_S):
                    await self._wake.wait()

    async def _tend(self) -> None:
        now = time.monotonic()
        if self._podman_problem and now >= self._try_at:
            await self._connect()
        for container in list(self._pooled.values()):
            state = container.info.state
            if state is ContainerState.RESERVED and container.reservation and now >= container.lease_until:
                self.refused["lease expired"] += 1
                self._release(container)
            elif (
                state is ContainerState.READY
                and now - container.idle_since > self._config.idle_s
                and self._count(container.info.image) > self._config.floor.get(container.info.image, 0)
            ):
                self._retire(container, "idle for long")
            elif state is not ContainerState.STARTING and now >= container.next_probe:
                container.next_probe = now + self._config.probe_s
                self._spawn(self._probe(container), f"probe {container.id}")
        self._serve_queue()
        if not self._draining and not self._podman_problem and self._config.mode != "cold":
            self._prewarm(now)

    def _count(self, image: str) -> int:
        coming = (ContainerState.READY, ContainerState.STARTING)
        return sum(each.info.image == image and each.info.state in coming for each in self._pooled.values())

    def _prewarm(self, now: float) -> None:
        coming = {image: self._count(image) for image in self._config.floor}
        for image in policies.wanted(self._config.floor, coming):
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
                self._retire(container, f"does not answer: {error.message}")

    # --- Podman -----------------------------------------------------------------------------------------------

    def _lost(self, error: SwiftbotError) -> None:
        if not self._podman_problem:
            self._podman_problem = str(error)
            self._pause_s = self._config.reconnect_s
            self._try_at = time.monotonic() + self._pause_s
            log.warning("Podman is away", reason=str(error))

    async def _connect(self) -> None:
        """Reach Podman; the first time adopt what is there, later remove what was left over."""
        try:
            self._engine = self._engine or self._make_engine()
            self._facts = await self._engine.facts()
            if self._adopted:
                await self._remove_strays(self._engine)
            else:
                for container in await self._starter.adopt(self._engine):
                    self._pooled[container.id] = container
                    container.next_probe = time.monotonic() + self._config.probe_s
                    log.info("container adopted", container=container.id, image=container.info.image)
                    self._release(container)
                self._adopted = True
        except SwiftbotError as error:
            if self._podman_problem != str(error):
                log.warning("Podman cannot be used", reason=str(error))
            self._podman_problem = str(error)
            self._try_at = time.monotonic() + self._pause_s
            self._pause_s = min(2 * self._pause_s, MAX_RECONNECT_S)
            return
        if not self._facts.limits_enforced:
            log.warning(
                "limits of containers are not enforced on this machine",
                cgroup=self._facts.cgroup_version,
                controllers=sorted(self._facts.controllers),
            )
        self._podman_problem = ""
        self._pause_s = self._config.reconnect_s
        self._changed()

    async def _remove_strays(self, engine: Engine) -> None:
        for found in await self._starter.own(engine):
            if found not in {each.engine_id for each in self._pooled.values()}:
                await engine.remove(found)


def _ended_before(request: RunRequest, gateway: str, error: SwiftbotError) -> RunEvent:
    return RunEvent(
        task=request.task,
        subtask=request.subtask,
        attempt=request.attempt,
        kind=RunEventKind.FAILED,
        gateway=gateway,
        failure=Failure(code=error.code, message=error.message, remedy=error.remedy),
    )
