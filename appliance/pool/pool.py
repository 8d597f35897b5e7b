"""The pool's door: choose a container for a subtask, run it there, tell what becomes of it.

It exists because a container takes hundreds of milliseconds to start and a fork in one that runs takes one or
two: so containers are started before they are wanted, handed out by reservation, replaced when they die, and
taken over again after a restart.

Guarantees:
    - Two selections never get the same container; one that is selected and not used is free again after a lease.
    - Nothing here waits without bound, and nobody waits in a queue without bound.
    - Podman absent or dying stops new containers only: `problem` says why, and those that run serve on.
    - Whatever a handler does, its run ends with one last event.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import structlog

from appliance.errors import (
    CancelledByOperatorError,
    ConfigError,
    NotFoundError,
    PayloadError,
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
    PoolHint,
    RunEvent,
    RunEventKind,
    RunRequest,
    Site,
    Way,
)
from appliance.pool.api import EvictAsk, Evicted, Hinted, ReleaseAsk, Released, WarmAsk, Warmed
from appliance.pool.container import Connection, PooledContainer
from appliance.pool.conversation import Call, Conversation, order
from appliance.pool.engine import Engine, PodmanEngine
from appliance.pool.keeper import FOR_A_RUN, Keeper
from appliance.pool.selection import Candidate, Decision, Facts, select
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import Starter
from appliance.skills.catalogue import Catalogue

__all__ = ["Call", "Pool"]

log = structlog.get_logger(__name__)

BACKSTOP_S = 3.0
"""How much longer than the runner itself the pool waits for a run to end, before it ends the container."""
MOST_AHEAD_S = 86400.0
"""A day: nobody plans further ahead, and nothing is kept ready for longer on one word."""
MOST_WAIT_S = 60.0
"""An answer that is waited for longer is not wanted any more."""
TRIES = 3
"""Containers that may be found dead at the moment a run is sent to them, before the run is given back."""


class _Run:
    """A run in progress here."""

    def __init__(self) -> None:
        self.cancelled = False
        self.acquiring: asyncio.Task[PooledContainer] | None = None
        self.container: PooledContainer | None = None
        self.patience: asyncio.Timeout | None = None


class Pool:
    """Warm containers of one gateway.

    Args:
        config: section `[pool]`.
        gateway: this gateway's id.
        fleet: its fleet; containers of other fleets and gateways are never touched.
        run_dir: folder for the containers' sockets.
        catalogue: skills and images.
        site: the map that handlers get.
        find_remote: offers of other gateways for a need.
        facts: what selection must know of the fleet for a need: where state is, what moving bytes costs.
        on_call: carries out what a handler asks of the appliance.
        on_change: told the facts of all containers whenever one of them changes.
        make_engine: Podman, unless a test says otherwise.

    Raises:
        ConfigError: the floor names an image that is not there.
    """

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
        facts: Callable[[Need], Facts] = lambda _: Facts(),
        on_call: Callable[[Call], Awaitable[dict[str, Any]]],
        on_change: Callable[[tuple[ContainerInfo, ...]], None],
        make_engine: Callable[[], Engine] | None = None,
    ) -> None:
        known = ", ".join(sorted(catalogue.images))
        for image in config.floor:
            if image not in catalogue.images:
                raise ConfigError(f"pool.floor: there is no image {image!r}", remedy=f"known: {known}")
        self.gateway = gateway
        self.refused: Counter[str] = Counter()
        self._config = config
        self._catalogue = catalogue
        self._site: dict[str, Any] = msgspec.to_builtins(site)
        self._find_remote = find_remote
        self._facts = facts
        self._on_call = on_call
        self._runs: dict[str, _Run] = {}
        self._idle = asyncio.Event()
        self._idle.set()
        self._draining = False

        def make_starter(on_death: Callable[[PooledContainer], None]) -> Starter:
            return Starter(
                config, gateway=gateway, fleet=fleet, run_dir=run_dir, catalogue=catalogue, on_death=on_death
            )

        self._keeper = Keeper(
            config,
            gateway=gateway,
            make_starter=make_starter,
            make_engine=make_engine or (lambda: PodmanEngine(config.podman_url)),
            on_change=on_change,
            refused=self.refused,
        )

    # --- what is --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Why containers, or those of some image, cannot be started now; empty when they can."""
        return self._keeper.problem

    @property
    def limits_enforced(self) -> bool:
        """Whether memory, CPU and process limits of containers hold here; False while Podman was never reached."""
        return self._keeper.facts is not None and self._keeper.facts.limits_enforced

    @property
    def queue(self) -> int:
        """Runs that wait for a container."""
        return self._keeper.queue

    def containers(self) -> tuple[ContainerInfo, ...]:
        """Return the facts of all containers held."""
        return self._keeper.containers()

    def cold_ms(self, image: str) -> float:
        """Return what a cold start of an image is expected to take here, milliseconds."""
        return self._keeper.costs.of(image)

    # --- life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect to Podman, adopt this gateway's containers, and warm up to the floor in the background."""
        await self._keeper.start()

    async def drain(self, deadline_s: float) -> None:
        """Take no new run and wait for those in progress; what is left after `deadline_s` is cancelled."""
        self._draining = True
        for wait_s in (deadline_s, self._config.cancel_grace_s + 2 * BACKSTOP_S):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._idle.wait()
            for run_id in list(self._runs):
                await self.cancel(run_id)

    async def stop(self, *, keep_containers: bool) -> None:
        """Let go of everything; containers go on running, to be adopted, if they are to be kept."""
        self._draining = True
        await self._keeper.stop(
            keep_containers=keep_containers, patience_s=self._config.cancel_grace_s + 2 * BACKSTOP_S
        )

    # --- selecting ------------------------------------------------------------------------------------------

    async def select(
        self,
        need: Need,
        *,
        allow_remote: bool,
        inputs: Mapping[str, int] | None = None,
        avoid: Mapping[str, str] | None = None,
    ) -> Decision:
        """Decide where a subtask runs (Algorithm 1); a local container is reserved for the lease.

        Args:
            need: T = (image, cpu, mem, volumes).
            allow_remote: whether other gateways may be asked (phase 2).
            inputs: bytes of the subtask's input files by the gateway that holds them.
            avoid: gateways whose containers are not to be used, with the reason.

        Raises:
            NotFoundError: there is no such image.
            RefusedError: draining; or all containers are busy and too many wait; or the image does not start.
            PoolError: no container is ready and none can be started.
        """
        self._check(need)
        facts = msgspec.structs.replace(self._facts(need), inputs=inputs or {}, avoid=avoid or {})
        decision = self._choose(need, [], facts)
        wanting = decision.phase is Phase.COLD or decision.way is Way.BRING_HERE
        if wanting and allow_remote and self._config.mode == "federated":
            # Not held while others are asked: a container that another run could use must not wait for that.
            offers: list[Candidate] = []
            try:
                async with asyncio.timeout(self._config.remote_timeout_s):
                    offers = await self._find_remote(need)
            except (TimeoutError, SwiftbotError) as error:
                log.info("other gateways could not be asked", reason=str(error) or "too slow")
            decision = self._choose(need, offers, facts)
        if decision.phase is Phase.COLD:
            self._keeper.check_startable(need)
        elif decision.phase is Phase.LOCAL_WARM and decision.container is not None:
            return msgspec.structs.replace(decision, reservation=self._keeper.reserve(decision.container))
        return decision

    def _choose(self, need: Need, offers: list[Candidate], facts: Facts) -> Decision:
        cold_ms = self.cold_ms(need.image)
        return select(need, self.containers(), offers, cold_ms, self._config, gateway=self.gateway, facts=facts)

    def _check(self, need: Need) -> None:
        self._check_image(need.image)
        if need.cpu <= 0 or need.memory_mb <= 0:
            self.refused["bad need"] += 1
            raise RefusedError("a need of no CPU or no memory", remedy="ask for more than 0 of each")
        if need.memory_mb > self._config.memory_mb:
            self.refused["bad need"] += 1
            raise RefusedError(
                f"{need.memory_mb} MB wanted, {self._config.memory_mb} MB is all this gateway has for containers",
                remedy="raise pool.memory_mb, or run it elsewhere",
            )
        if self._draining:
            raise RefusedError(f"{self.gateway} is draining", remedy="another gateway takes it")

    # --- what others and operators ask ------------------------------------------------------------------------

    async def hint(self, hint: PoolHint) -> Hinted:
        """Take note of what another gateway's plan will need here; best effort.

        Raises:
            NotFoundError: there is no such image.
            PayloadError: numbers that cannot be.
        """
        self._check_image(hint.image)
        if not (hint.count >= 1 and 0 <= hint.in_s <= MOST_AHEAD_S and 0 < hint.keep_s <= MOST_AHEAD_S):
            self.refused["bad hint"] += 1
            raise PayloadError(
                f"{hint.count} containers in {hint.in_s:g} s for {hint.keep_s:g} s cannot be had ready",
                remedy=f"at least one, within and for at most {MOST_AHEAD_S:g} s",
            )
        if why := self._no_warming():
            return Hinted(taken=False, why=why)
        self._keeper.want(hint.image, min(hint.count, self._config.capacity), hint.in_s + hint.keep_s)
        return Hinted(taken=True)

    async def warm(self, ask: WarmAsk) -> Warmed:
        """Have containers of an image ready; answers at once, or when those that start are there.

        Raises:
            NotFoundError: there is no such image.
            PayloadError: numbers that cannot be.
            RefusedError: draining, mode cold, or none more can be started, with the reason.
        """
        self._check_image(ask.image)
        if not (ask.count >= 1 and 0 < ask.keep_s <= MOST_AHEAD_S and 0 <= ask.wait_s <= MOST_WAIT_S):
            self.refused["bad warm"] += 1
            raise PayloadError(
                f"{ask.count} containers for {ask.keep_s:g} s, answered within {ask.wait_s:g} s, cannot be had ready",
                remedy=f"at least one, for at most {MOST_AHEAD_S:g} s, waiting at most {MOST_WAIT_S:g} s",
            )
        if why := self._no_warming():
            raise RefusedError(why)
        counted = self._count(ask.image)
        if sum(counted) < ask.count and (why := self._keeper.why_no_start(ask.image)):
            self.refused["no room to warm"] += 1
            raise RefusedError(why, remedy="swiftbot pool evict something, raise pool.memory_mb, or wait")
        self._keeper.want(ask.image, ask.count, ask.keep_s)
        if ask.wait_s:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ask.wait_s):
                    await self._keeper.have(ask.image, ask.count)
        ready, starting = self._count(ask.image)
        problem = ""
        if ready + starting < ask.count:
            problem = self._keeper.why_no_start(ask.image) or "they are started as soon as others have been"
        return Warmed(image=ask.image, ready=ready, starting=starting, problem=problem)

    async def evict(self, ask: EvictAsk) -> Evicted:
        """Give up one idle container, or all idle ones of an image.

        Raises:
            NotFoundError: there is no such container or image.
            PayloadError: none is named, or both.
            RefusedError: the one that is named works.
        """
        if bool(ask.container) == bool(ask.image):
            raise PayloadError("neither a container nor an image is named, or both", remedy="name one of the two")
        if ask.image:
            self._check_image(ask.image)
        held = [each for each in self.containers() if each.id == ask.container or each.image == ask.image]
        if ask.container and not held:
            known = ", ".join(each.id for each in self.containers())
            raise NotFoundError(f"no container {ask.container[:60]!r} here", remedy=f"there are: {known or 'none'}")
        kept = {each.id: why for each in held if (why := self._keeper.why_kept(each))}
        if ask.container in kept:
            raise RefusedError(
                f"container {ask.container} is not idle: {kept[ask.container]}",
                remedy="wait for its run to end, or cancel the task",
            )
        gone = tuple(each.id for each in held if each.id not in kept)
        for each in gone:
            self._keeper.give_up(each, "an operator gave it up")
        floors = {each.image: self._config.floor.get(each.image, 0) for each in held if each.id not in kept}
        note = "; ".join(f"the floor keeps {count} of {image}" for image, count in floors.items() if count)
        return Evicted(containers=gone, kept=kept, note=note)

    async def release_quarantine(self, ask: ReleaseAsk) -> Released:
        """Start containers of an image again that kept failing.

        Raises:
            NotFoundError: there is no such image.
            RefusedError: it is not in quarantine.
        """
        self._check_image(ask.image)
        reason = self._keeper.release_quarantine(ask.image)
        if not reason:
            raise RefusedError(f"image {ask.image} is not in quarantine", remedy="swiftbot fleet shows which are")
        log.info("quarantine released", image=ask.image, reason=reason)
        return Released(image=ask.image, reason=reason)

    def _count(self, image: str) -> tuple[int, int]:
        states = [each.state for each in self.containers() if each.image == image]
        return states.count(ContainerState.READY), states.count(ContainerState.STARTING)

    def _no_warming(self) -> str:
        if self._draining:
            return f"{self.gateway} is draining"
        return "pool.mode is cold: nothing is kept ready" if self._config.mode == "cold" else ""

    def _check_image(self, image: str) -> None:
        if image not in self._catalogue.images:
            self.refused["unknown image"] += 1
            raise NotFoundError(
                f"no image {image[:60]!r}", remedy=f"known: {', '.join(sorted(self._catalogue.images))}"
            )

    # --- running --------------------------------------------------------------------------------------------

    async def run(self, request: RunRequest, decision: Decision, on_event: Callable[[RunEvent], None]) -> RunEvent:
        """Run one attempt of a subtask here, warm or cold, to its end.

        Args:
            request: what to run.
            decision: what `select` said; if its container is gone, another is taken or started.
            on_event: gets every event but the last, in order, on the event loop.

        Returns:
            The last event, `succeeded` or `failed`. Its `phase` is what really happened.

        Raises:
            RefusedError, NotFoundError, PoolError, PrerequisiteError, UnreachableError: it was not begun, and why.
        """
        entered_ns = time.monotonic_ns()
        self._check(request.need)
        skill = self._catalogue.skills.get(request.skill)
        if skill is None or not skill.implemented:
            self.refused["unknown skill"] += 1
            raise NotFoundError(f"skill {request.skill[:60]!r} is not implemented here", remedy="see docs/skills.md")
        if decision.phase is Phase.REMOTE_WARM and decision.gateway != self.gateway:
            raise RefusedError(f"the container chosen is on {decision.gateway}", remedy="send the run there")
        if request.run_id in self._runs:
            raise RefusedError(f"run {request.run_id} is in progress here")
        run = self._runs[request.run_id] = _Run()
        self._idle.clear()
        try:
            container, connection, phase = await self._place(request, decision, run)
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
            return RunEvent(
                task=request.task,
                subtask=request.subtask,
                attempt=request.attempt,
                kind=RunEventKind.FAILED,
                gateway=self.gateway,
                failure=Failure(code=error.code, message=error.message),
            )
        finally:
            del self._runs[request.run_id]
            if not self._runs:
                self._idle.set()

    async def _place(
        self, request: RunRequest, decision: Decision, run: _Run
    ) -> tuple[PooledContainer, Connection, Phase]:
        """Get a container and send the run to it; one that turns out to be dead is replaced by another."""
        keeper = self._keeper
        for _ in range(TRIES):
            container = keeper.claim(
                request.need, container_id=decision.container or "", reservation=decision.reservation
            )
            if container is None:
                container = await self._acquire(request, run)
            phase = Phase.COLD if container.reservation == FOR_A_RUN else Phase.LOCAL_WARM
            run.container = container
            keeper.busy(container, request.run_id)
            try:
                return container, await container.begin(order(request, self._site)), phase
            except UnreachableError:
                keeper.retire(container, "it was found dead")  # nothing has run
            except SwiftbotError:
                keeper.release(container)
                raise
        raise PoolError(f"{TRIES} containers in a row were found dead", remedy="see the gateway's log")

    async def _acquire(self, request: RunRequest, run: _Run) -> PooledContainer:
        run.acquiring = asyncio.create_task(self._keeper.acquire(request.need), name=f"get {request.run_id}")
        try:
            return await run.acquiring
        except asyncio.CancelledError:
            run.acquiring.cancel()
            if not run.cancelled:
                raise
            raise CancelledByOperatorError(f"{request.run_id} was cancelled before it began") from None

    async def _listen(
        self,
        request: RunRequest,
        run: _Run,
        container: PooledContainer,
        connection: Connection,
        conversation: Conversation,
    ) -> RunEvent:
        ended = False
        try:
            if run.cancelled:
                await self.cancel(request.run_id)
            limit_s = request.deadline_s + self._config.cancel_grace_s + BACKSTOP_S
            async with asyncio.timeout(limit_s) as run.patience:
                final = await conversation.listen()
                ended = not conversation.broken
                return final
        except TimeoutError:
            code = "cancelled" if run.cancelled else "deadline"
            return conversation.failed(
                code, "the run did not end when told to; its container was ended", retryable=not run.cancelled
            )
        finally:
            if ended:
                self._keeper.spawn(self._wind_up(container, connection, conversation), f"wind up {container.id}")
            else:
                connection.close()
                self._keeper.retire(container, "its run did not end as it should")

    async def _wind_up(self, container: PooledContainer, connection: Connection, conversation: Conversation) -> None:
        """After a run: wait until the runner has swept up, then give the container to the next."""
        try:
            async with asyncio.timeout(self._config.cancel_grace_s + BACKSTOP_S):
                await conversation.gone()
            await container.refill()
        except (TimeoutError, SwiftbotError) as error:
            self._keeper.retire(container, f"did not come back from its run: {error}")
        else:
            self._keeper.ran(container)
        finally:
            connection.close()

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
