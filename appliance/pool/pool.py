"""The pool's door: choose a container for a subtask, run it there, tell what becomes of it.

It exists because a container takes hundreds of milliseconds to start and a fork in one that runs takes one or
two: so containers are started before they are wanted, handed out by reservation, replaced when they die, and
taken over again after a restart.

Guarantees:
    - Two selections never get the same container; one that is selected and not used is free again after a lease.
    - Nothing here waits without bound, and no queue is without bound.
    - Podman absent or dying stops new containers only: `problem` says why, and those that run serve on.
    - Whatever a handler does, its run ends with one last event.

`Verbs` is what operators and other gateways ask of a pool: warm this, give up that, start again what would not
start. None of it is on a run's way. Every answer says what was done, or why not and what to do about it.
"""

import asyncio
import contextlib
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConfigError, NotFoundError, PayloadError, RefusedError, SwiftbotError
from appliance.identity.parts import ALL, InForce
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
from appliance.model.pool_api import (
    DecisionList,
    DecisionsAsk,
    EvictAsk,
    Evicted,
    Hinted,
    ReleaseAsk,
    Released,
    WarmAsk,
    Warmed,
)
from appliance.pool.container import PooledContainer
from appliance.pool.decisions import eviction_case, selection_case
from appliance.pool.engine import Engine, PodmanEngine
from appliance.pool.fair_queue import Turn, turn_of
from appliance.pool.manager import ContainerManager, Keepsake, Store
from appliance.pool.policies.forecast import OPERATOR
from appliance.pool.policies.planner import Weighed
from appliance.pool.pressure import Reading
from appliance.pool.runs import Call, Runs
from appliance.pool.selection import Candidate, Decision, Facts, select
from appliance.pool.settings import PoolConfig
from appliance.pool.starter import MAX_RESULT_BYTES, Starter
from appliance.pool.volumes import ALONE, State
from appliance.skills.catalogue import Catalogue, SkillManifest, broken_promises

log = structlog.get_logger(__name__)

MOST_AHEAD_S = 86400.0
"""A day: nobody plans further ahead, and nothing is kept ready for longer on one word."""
MOST_WAIT_S = 60.0
"""An answer that is waited for longer is not wanted any more."""


class Verbs:
    """The pool's verbs, as the gateway serves them over RPC (`model.pool_api` has the structs)."""

    def __init__(
        self, config: PoolConfig, keeper: ContainerManager, *, gateway: str, catalogue: Catalogue, refused: Counter[str]
    ) -> None:
        self._config = config
        self._keeper = keeper
        self._gateway = gateway
        self._catalogue = catalogue
        self._refused = refused

    async def hint(self, hint: PoolHint) -> Hinted:
        """Take note of what another gateway's plan will need here; best effort. A count of 0 takes it back.

        Raises:
            NotFoundError: there is no such image.
            PayloadError: numbers that cannot be.
        """
        self._check_image(hint.image)
        if not (hint.count >= 0 and 0 <= hint.in_s <= MOST_AHEAD_S and 0 < hint.keep_s <= MOST_AHEAD_S):
            self._refused["bad hint"] += 1
            raise PayloadError(
                f"{hint.count} containers in {hint.in_s:g} s for {hint.keep_s:g} s cannot be had ready",
                remedy=f"none or more, within and for at most {MOST_AHEAD_S:g} s",
            )
        if why := self._no_warming():
            return Hinted(taken=False, why=why)
        self._keeper.planning.hinted(replace(hint, count=min(hint.count, self._config.capacity)))
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
            self._refused["bad warm"] += 1
            raise PayloadError(
                f"{ask.count} containers for {ask.keep_s:g} s, answered within {ask.wait_s:g} s, cannot be had ready",
                remedy=f"at least one, for at most {MOST_AHEAD_S:g} s, waiting at most {MOST_WAIT_S:g} s",
            )
        if why := self._no_warming():
            raise RefusedError(why)
        counted = self._count(ask.image)
        if sum(counted) < ask.count and (why := self._keeper.planning.why_no_start(ask.image)):
            self._refused["no room to warm"] += 1
            raise RefusedError(why, remedy="swiftbot pool evict something, raise pool.memory_mb, or wait")
        self._keeper.planning.hinted(PoolHint(image=ask.image, count=ask.count, keep_s=ask.keep_s, task=OPERATOR))
        if ask.wait_s:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ask.wait_s):
                    await self._keeper.have(ask.image, ask.count)
        ready, starting = self._count(ask.image)
        problem = ""
        if ready + starting < ask.count:
            problem = self._keeper.planning.why_no_start(ask.image) or "they are started as soon as others have been"
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
        held = [each for each in self._keeper.books.facts() if each.id == ask.container or each.image == ask.image]
        if ask.container and not held:
            known = ", ".join(each.id for each in self._keeper.books.facts())
            raise NotFoundError(f"no container {ask.container[:60]!r} here", remedy=f"there are: {known or 'none'}")
        kept = {each.id: why for each in held if (why := _why_kept(each))}
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

    async def decisions(self, ask: DecisionsAsk) -> DecisionList:
        """Return what was started and given up lately, and why."""
        return self._keeper.decisions.recent(ask.limit)

    def _count(self, image: str) -> tuple[int, int]:
        books = self._keeper.books
        return books.count(image, ContainerState.READY), books.count(image, ContainerState.STARTING)

    def _no_warming(self) -> str:
        if self._keeper.draining:
            return f"{self._gateway} is draining"
        return "pool.mode is cold: nothing is kept ready" if self._config.mode == "cold" else ""

    def _check_image(self, image: str) -> None:
        if image not in self._catalogue.images:
            raise unknown_image(image, self._catalogue, self._refused)


def unknown_image(image: str, catalogue: Catalogue, refused: Counter[str]) -> NotFoundError:
    """Count that an unknown image was asked for; returns the error to raise."""
    refused["unknown image"] += 1
    return NotFoundError(f"no image {image[:60]!r}", remedy=f"known: {', '.join(sorted(catalogue.images))}")


def _why_kept(info: ContainerInfo) -> str:
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


class Pool:
    """Warm containers of one gateway.

    Args:
        config: section `[pool]`.
        gateway: this gateway's id.
        fleet: its fleet; containers of other fleets and gateways are never touched.
        run_dir: folder for the containers' sockets.
        data_dir: folder of this gateway's state; the snapshots of skills that containers mount are in it.
        catalogue: skills and images.
        site: the map that handlers get.
        find_remote: offers of other gateways for a need; told too whose will not be used.
        facts: what selection must know of the fleet for a need: where state is, what moving bytes costs.
        on_call: carries out what a handler asks of the appliance.
        on_change: told the facts of all containers whenever one of them changes.
        state: where state volumes and images of other gateways come from.
        store: keeps what the pool learns over a restart; None: it begins from nothing each time.
        on_decided: told each selection and eviction with what it rested on (`decisions`), if the settings say so.
        make_engine: Podman, unless a test says otherwise.
        read_memory: what the kernel says of memory, unless a test says otherwise.

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
        data_dir: Path,
        catalogue: Catalogue,
        site: Site,
        find_remote: Callable[[Need, Collection[str]], Awaitable[list[Candidate]]],
        facts: Callable[[Need], Facts] = lambda _: Facts(),
        on_call: Callable[[Call], Awaitable[dict[str, Any]]],
        on_change: Callable[[tuple[ContainerInfo, ...]], None],
        state: State = ALONE,
        store: Store | None = None,
        on_decided: Callable[[Struct, str], None] = lambda _case, _what: None,
        make_engine: Callable[[], Engine] | None = None,
        read_memory: Callable[[], Reading] | None = None,
        parts: InForce = ALL,
        max_result_bytes: int = MAX_RESULT_BYTES,
    ) -> None:
        known = ", ".join(sorted(catalogue.images))
        for image in config.floor:
            if image not in catalogue.images:
                raise ConfigError(f"pool.floor: there is no image {image!r}", remedy=f"known: {known}")
        self.gateway = gateway
        self.refused: Counter[str] = Counter()
        self._config = config
        self._catalogue = catalogue
        self._find_remote = find_remote
        self._facts = facts
        self._on_decided = on_decided

        def make_starter(on_death: Callable[[PooledContainer], None]) -> Starter:
            return Starter(
                config,
                gateway=gateway,
                fleet=fleet,
                run_dir=run_dir,
                data_dir=data_dir,
                catalogue=catalogue,
                site=msgspec.to_builtins(site),
                refused=self.refused,
                on_death=on_death,
                state=state,
                parts=parts,
                max_result_bytes=max_result_bytes,
            )

        self._keeper = ContainerManager(
            config,
            gateway=gateway,
            images=catalogue.images,
            make_starter=make_starter,
            make_engine=make_engine or (lambda: PodmanEngine(config.podman_url)),
            on_change=on_change,
            refused=self.refused,
            read_memory=read_memory,
            on_evicted=self._evicted,
        )
        self._keepsake = Keepsake(store, recall=self._keeper.planning.recall, tell=self._keeper.planning.experience)
        self._runs = Runs(
            config,
            self._keeper,
            gateway=gateway,
            on_call=on_call,
            state=state,
            refused=self.refused,
        )
        self.verbs = Verbs(config, self._keeper, gateway=gateway, catalogue=catalogue, refused=self.refused)

    # --- what is --------------------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Why containers, or those of some image, cannot be started now; empty when they can."""
        return self._keeper.problem

    @property
    def squeeze(self) -> str:
        """Why the pool holds less than it is allowed, when the machine is short of memory; empty otherwise."""
        return self._keeper.planning.squeeze

    @property
    def limits_enforced(self) -> bool:
        """Whether memory, CPU and process limits of containers hold here; False while Podman was never reached."""
        facts = self._keeper.link.facts
        return facts is not None and facts.limits_enforced

    @property
    def federated(self) -> bool:
        """Whether runs that come here may be served by other gateways' containers (`pool.mode`)."""
        return self._config.mode == "federated"

    @property
    def queue(self) -> int:
        """Runs that wait for a container."""
        return self._keeper.books.queue

    def containers(self) -> tuple[ContainerInfo, ...]:
        """Return the facts of all containers held."""
        return self._keeper.books.facts()

    def cold_ms(self, image: str) -> float:
        """Return what a cold start of an image is expected to take here, milliseconds."""
        return self._keeper.starts.costs.of(image)

    # --- life -----------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Connect to Podman, adopt this gateway's containers, and warm up to the floor in the background.

        Raises:
            ConfigError: the skills cannot be copied for containers to mount.
        """
        await self._keepsake.start()
        await self._keeper.start()

    async def drain(self, deadline_s: float) -> None:
        """Take no new run and wait for those in progress; what is left after `deadline_s` is cancelled."""
        self._keeper.draining = True
        await self._runs.drain(deadline_s)

    async def stop(self, *, keep_containers: bool) -> None:
        """Let go of everything; containers go on running, to be adopted, if they are to be kept."""
        self._keeper.draining = True
        await self._keepsake.stop()
        await self._keeper.stop(keep_containers=keep_containers, patience_s=self._runs.patience_s)

    # --- selecting ------------------------------------------------------------------------------------------

    async def select(
        self,
        need: Need,
        *,
        allow_remote: bool,
        inputs: Mapping[str, int] | None = None,
        avoid: Mapping[str, str] | None = None,
        turn: Turn | None = None,
    ) -> Decision:
        """Decide where a subtask runs (Algorithm 1); a local container is reserved for the lease.

        Args:
            need: T = (image, cpu, mem, volumes).
            allow_remote: whether other gateways may be asked (phase 2).
            inputs: bytes of the subtask's input files by the gateway that holds them.
            avoid: gateways whose containers are not to be used, with the reason.
            turn: who asks: a full queue has a place for one who would not be served last.

        Raises:
            NotFoundError: there is no such image.
            RefusedError: draining; or all containers are busy and too many wait; or the image does not start.
            PoolError: no container is ready and none can be started.
        """
        self._check(need)
        facts = msgspec.structs.replace(self._facts(need), inputs=inputs or {}, avoid=avoid or {})
        offers: list[Candidate] = []
        decision = self._choose(need, offers, facts)
        wanting = decision.phase is Phase.COLD or decision.way is Way.BRING_HERE
        if wanting and allow_remote and self.federated:
            # Not held while others are asked: a container that another run could use must not wait for that.
            try:
                async with asyncio.timeout(self._config.remote_timeout_s):
                    offers = await self._find_remote(need, facts.avoid)
            except (TimeoutError, SwiftbotError) as error:
                log.info("other gateways could not be asked", reason=str(error) or "too slow")
            decision = self._choose(need, offers, facts)
        self._tell(decision, need, offers, facts)
        if decision.phase is Phase.COLD:
            self._keeper.planning.check_startable(need, turn)
        elif decision.phase is Phase.LOCAL_WARM and decision.container is not None:
            return msgspec.structs.replace(decision, reservation=self._keeper.books.reserve(decision.container))
        return decision

    def _choose(self, need: Need, offers: list[Candidate], facts: Facts) -> Decision:
        cold_ms = self.cold_ms(need.image)
        return select(need, self.containers(), offers, cold_ms, self._config, gateway=self.gateway, facts=facts)

    def _tell(self, decision: Decision, need: Need, offers: list[Candidate], facts: Facts) -> None:
        """Tell a decision with what it rested on; nothing has changed since it was made."""
        if not self._config.tell_decisions:
            return
        case = selection_case(
            decision,
            need=need,
            local=self.containers(),
            remote=offers,
            cold_ms=self.cold_ms(need.image),
            config=self._config,
            gateway=self.gateway,
            facts=facts,
        )
        self._on_decided(case, "selection")

    def _evicted(self, weighed: Weighed) -> None:
        if self._config.tell_decisions:
            self._on_decided(eviction_case(weighed, gateway=self.gateway), "eviction")

    def _check(self, need: Need) -> None:
        if need.image not in self._catalogue.images:
            raise unknown_image(need.image, self._catalogue, self.refused)
        if need.cpu <= 0 or need.memory_mb <= 0:
            self.refused["bad need"] += 1
            raise RefusedError("a need of no CPU or no memory", remedy="ask for more than 0 of each")
        if need.memory_mb > self._config.memory_mb:
            self.refused["bad need"] += 1
            raise RefusedError(
                f"{need.memory_mb} MB wanted, {self._config.memory_mb} MB is all this gateway has for containers",
                remedy="raise pool.memory_mb, or run it elsewhere",
            )
        if self._keeper.draining:
            raise RefusedError(f"{self.gateway} is draining", remedy="another gateway takes it")

    # --- running --------------------------------------------------------------------------------------------

    async def run(
        self,
        request: RunRequest,
        decision: Decision,
        on_event: Callable[[RunEvent], None],
        *,
        turn: Turn | None = None,
    ) -> RunEvent:
        """Run one attempt of a subtask here, warm or cold, to its end.

        Args:
            request: what to run.
            decision: what `select` said; if its container is gone, another is taken or started.
            on_event: gets every event but the last, in order, on the event loop.
            turn: its place among those who wait; by default it comes now.

        Returns:
            The last event, `succeeded` or `failed`. Its `phase` is what really happened.

        Raises:
            RefusedError, NotFoundError, PoolError, PrerequisiteError, UnreachableError: it was not begun, and why.
            WithdrawnError: it was taken out of the queue (`withdraw`); it was not begun.
        """
        self._check(request.need)
        skill = self._catalogue.skills.get(request.skill)
        if skill is None or not skill.implemented:
            self.refused["unknown skill"] += 1
            raise NotFoundError(f"skill {request.skill[:60]!r} is not implemented here", remedy="see docs/skills.md")
        if decision.phase is Phase.REMOTE_WARM and decision.gateway != self.gateway:
            raise RefusedError(f"the container chosen is on {decision.gateway}", remedy="send the run there")
        return self._checked(await self._runs.run(request, decision, on_event, turn or turn_of(request)), skill)

    def _checked(self, final: RunEvent, skill: SkillManifest) -> RunEvent:
        """Return a run's last event; a success whose result is not what the manifest promises becomes a failure."""
        if final.kind is not RunEventKind.SUCCEEDED or not (broken := broken_promises(skill, final.result or {})):
            return final
        self.refused["result"] += 1
        failure = Failure(
            code="payload",
            message=f"the result of {skill.id} is not what its manifest promises: {'; '.join(broken)}",
            remedy=f"have the handler of {skill.id} return it, or correct `produces` and `results` in its skill.toml",
        )
        return msgspec.structs.replace(final, kind=RunEventKind.FAILED, result=None, failure=failure)

    def waiting(self) -> list[tuple[Turn, Need]]:
        """Return the runs that wait for a container, in the order in which they will be served; ids are run ids."""
        return self._keeper.books.waiting()

    def withdraw(self, run_id: str) -> bool:
        """Take a run out of the queue if it still waits there: `run` raises WithdrawnError. It has not begun."""
        return self._keeper.books.withdraw(run_id)

    def has_room(self, need: Need) -> bool:
        """Whether a container for a need could be started at once for a run that comes now: room, and no queue."""
        return not self._keeper.books.queue and self._keeper.planning.has_room(need)

    def expected_s(self, position: int) -> float | None:
        """In how many seconds the run at a place in the queue (from 1) may have a container; None: not known."""
        return self._keeper.planning.expected_s(position)

    async def save(self, run_id: str) -> bool:
        """Ask a run's handler for a checkpoint now; False when there is none that could hear it."""
        return await self._runs.save(run_id)

    def keep(self, decision: Decision, lease_s: float) -> bool:
        """Hold a selected container for longer than the usual lease; False when it is held no more."""
        return self._keeper.books.extend(decision.container or "", decision.reservation, lease_s)

    def release(self, decision: Decision) -> None:
        """Let go of a selected container that will not be used."""
        self._keeper.books.release(decision.container or "", decision.reservation)

    async def cancel(self, run_id: str) -> bool:
        """Ask a run to end; its last event follows from `run`. False when there is none of that id."""
        return await self._runs.cancel(run_id)
