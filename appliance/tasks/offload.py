"""Offloading: runs that were accepted here and go to another gateway, at once or while they wait for a container.

**Finding a ready container elsewhere** (`RemoteContainers`; paper, Algorithm 1, phase 2, distributed search). What the
registry knows comes first: gateways push what changes, so a container that it knows to be ready, of a gateway that was
heard of lately, is as good as an answer and costs nothing. Only when it knows of none that can be had are the k
successors of hash(image) asked, and of those the ones of which nothing was heard lately, or to which runs were just
sent, which may be over; each answers with the ready containers it knows of, its own and those it has heard of. What
selection must know beside them comes from here too: the measured round trip to each gateway (a moving average, ms),
what moving bytes costs, and where the newest state of a volume is. A gateway whose offers turn out to be nothing,
several times in a row, is left out for a while: it is out of date, or it lies.

**Where a run begins** (`Choosing`): in a container here, or on another gateway that has a better one. One on another
gateway is reserved and started there by the order to run itself, so that nothing lies between the choice and the start.

**Offering queued runs** (`Elsewhere`). A run that finds everything busy joins the queue of its gateway. That is right
only as long as nobody else has room: under uneven load one gateway's queue grows while others stand idle. So whenever
facts of other gateways change, and now and then in any case, those who wait are gone through in their turns:

    warm   another gateway has a ready container: the run is passed on to it
    new    nobody has, but another gateway has room for a new one and nobody waiting, and the wait here is expected
           to take longer than such a start: the run is passed on, to be started there

A run is taken out of the queue here before it is offered, so that it cannot begin twice; if it is not taken there it
goes back to its old place in the queue, and is offered again after a pause that doubles (backoff). `choose` decides,
without I/O.

Both hand runs over by `handoff.Handoff`.

**Passing on** (`Passing`). The run is in one queue at any time. Taken there, its further events are that gateway's;
this one tells the coordinator where it is, and passes on questions after it and cancels. When it is not known whether
it was taken, the attempt has failed as `unreachable`: the next one, with a higher number, ends it wherever it is.
"""

import asyncio
import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import PoolError, SwiftbotError
from appliance.model import (
    Considered,
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Need,
    Phase,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    VolumeInfo,
    Way,
    keyspace,
)
from appliance.model.keys import Verb
from appliance.model.task_api import ContainerList, RunAsk, RunStatus
from appliance.plane.events import FactsChanged, FleetEvent, Lost, Stage
from appliance.plane.node import Plane
from appliance.pool.allocator import WithdrawnError
from appliance.pool.fair_queue import Turn, turn_of
from appliance.pool.pool import Pool
from appliance.pool.selection import MOST_CONSIDERED, UNMEASURED, Candidate, Decision, Facts, Link
from appliance.tasks.handoff import Handoff, Outcome
from appliance.tasks.placement import bytes_by_gateway
from appliance.tasks.records import MAX_NOTE, clean

ASK_TIMEOUT_S = 0.15
"""A neighbour slower than this is no help: a cold start costs about as much."""
FRESH_S = 10.0
"""What was heard of a gateway within this time is believed without asking: it tells its status every few seconds and
every change of a container at once, so silence for longer means that something is lost on the way."""
PROMISED_S = 0.25
"""For how long at most a container to which a run was sent is not counted on any more: by then its gateway has told
that it is busy (changes are published after 20 ms), or has had a run more."""
PATIENCE = 2.0
"""Once somebody has offered all that is needed, the others are waited for until so many times as long as that took: a
slower one is dearer anyhow, and one that does not answer would cost the whole of `ASK_TIMEOUT_S`."""
LEAST_PATIENCE_S = 0.002
EMPTY_OFFERS = 3
"""Offers in a row that were nothing, after which a gateway is left out; one or two are lost races."""
MOST_PROMISED = 64
LEFT_OUT_S = 10.0
"""For how long at most: it doubles with each further offer that is nothing, and one that is good ends it."""
FIRST_LEFT_OUT_S = 0.25
"""At first. Under load races are lost in rows: gateways with room that are left out for seconds leave a busy one
alone with its queue (80 runs/s, uneven: runs refused here while others stand idle)."""


class _Trust(Struct):
    """How a gateway's offers have turned out."""

    empty: int = 0
    until: float = 0.0


class Sent(Struct):
    """A run that was sent to a gateway. It holds one of its ready containers until that one is heard of again."""

    gateway: str
    until: float
    runs: dict[str, int]
    """Container -> how many runs it had had, of those that were ready there when it was sent."""
    container: str = ""
    """The one that it got; empty while that is not known."""
    run: tuple[str, str] = ("", "")
    """Its task and subtask."""


class RemoteContainers:
    """Finds ready containers on other gateways, and answers when others look for ours.

    Args:
        plane: the fleet.
        successors: how many neighbours on the ring are asked.
        link: what is measured of moving bytes from a gateway.
    """

    def __init__(self, plane: Plane, *, successors: int, link: Callable[[str], Link] = lambda _: UNMEASURED) -> None:
        self._plane = plane
        self._successors = successors
        self._link = link
        self._round_trip_ms: dict[str, float] = {}
        self._trust: dict[str, _Trust] = {}
        self._sent: dict[str, list[Sent]] = {}
        """Gateway -> the runs that were sent to it of late."""
        self._runs: dict[tuple[str, str], Sent] = {}
        """The same, by task and subtask."""
        self._doubted: dict[str, float] = {}
        """Gateway -> until when what is known of its containers is not believed: it had none when it was asked."""
        self.searches: Counter[str] = Counter()
        """For GatewayStatus.searches."""
        plane.events.subscribe(Stage.OFFLOAD, self._on_event)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Lost):
            self._forget(event.gateway)

    async def find(self, need: Need, avoid: Collection[str] = ()) -> list[Candidate]:
        """Containers on other gateways that could serve a need, in any state, each with its round trip.

        Args:
            need: T = (image, cpu, mem, volumes).
            avoid: gateways whose containers will not be used: what they have is returned, and ends no search.
        """
        here = self._plane.gateway
        self._plane.registry.asked(need.image)
        near = [each for each in self._plane.ring.successors(f"image/{need.image}", self._successors) if each != here]
        found = {(each.gateway, each.id): each for each in self._known(need)}
        enough = any(each.gateway not in avoid for each in self.ready(need))
        asked = [] if enough else [each for each in near if not self._is_fresh(each) or self._sent_to(each)]
        self.searches["saved"] += len(near) - len(asked)
        self.searches["asked"] += len(asked)
        taken = {(each.gateway, each.id) for each in self._promised_ones(found.values())}
        for gateway, containers in (await self._ask_all(asked, need, avoid)).items():
            # The answer counts in what was sent there: short runs are over before anything was published.
            taken = {key for key in taken if key[0] != gateway}
            # What a gateway says of its own containers is newer than what was heard of them.
            own = {each.id for each in containers if each.gateway == gateway}
            stale = [
                key
                for key, each in found.items()
                if each.gateway == gateway and each.state is ContainerState.READY and each.id not in own
            ]
            for key in stale:
                del found[key]
            for each in containers:
                key = (each.gateway, each.id)
                if each.gateway == gateway or (each.gateway not in asked and key not in found):
                    found[key] = each
        members = self._plane.members()
        return [
            Candidate(container=each, round_trip_ms=self._link_to(each.gateway).round_trip_ms)
            for key, each in found.items()
            if each.gateway != here and each.gateway in members and key not in taken
        ]

    def ready(self, need: Need) -> list[ContainerInfo]:
        """Containers of other gateways that are known to be ready for a need, and that no run was just sent to."""
        members, here = self._plane.members(), self._plane.gateway
        known = self._known(need)
        taken = {(each.gateway, each.id) for each in self._promised_ones(known)}
        left_out = self.left_out()
        return [
            each
            for each in known
            if each.state is ContainerState.READY
            and each.gateway != here
            and each.gateway in members
            and each.gateway not in left_out
            and (each.gateway, each.id) not in taken
            and self._is_fresh(each.gateway)
        ]

    def _is_fresh(self, gateway: str) -> bool:
        if self._doubted.get(gateway, 0.0) > time.monotonic():
            return False
        registry = self._plane.registry
        # In a large fleet each tells its status more rarely, and says so.
        return registry.age_s(gateway) <= FRESH_S or registry.keeps_promise(gateway)

    def _promised_ones(self, containers: Iterable[ContainerInfo]) -> list[ContainerInfo]:
        """The ready containers that runs were just sent to; where it is not known which, as many as runs were sent."""
        ready: dict[str, list[ContainerInfo]] = {}
        for each in containers:
            if each.state is ContainerState.READY and each.gateway in self._sent:
                ready.setdefault(each.gateway, []).append(each)
        found: list[ContainerInfo] = []
        for gateway, held in ready.items():
            sent = self._open(gateway)
            got = {each.container for each in sent}
            found += [each for each in held if each.id in got]
            left = sorted((each for each in held if each.id not in got), key=lambda each: each.id)
            found += left[: sum(not each.container for each in sent)]
        return found

    def _open(self, gateway: str) -> list[Sent]:
        """The runs that were sent to a gateway and of which it has not told yet."""
        now, known = time.monotonic(), self._plane.registry.containers.get(gateway, {})

        def untold(sent: Sent) -> bool:
            container = known.get(sent.container)
            return not sent.container or (
                container is not None
                and container.state is ContainerState.READY
                and container.runs == sent.runs.get(sent.container, container.runs)
            )

        return [each for each in self._sent.get(gateway, ()) if each.until > now and untold(each)]

    def _sent_to(self, gateway: str) -> bool:
        """Whether a run was sent to it so lately that it has not told of it yet."""
        return bool(self._open(gateway))

    def promise(self, gateway: str, run: tuple[str, str] = ("", "")) -> Sent:
        """Note that a run is being sent to a gateway: one of its ready containers is spoken for.

        What is returned tells `outcome` which of the runs that were sent there its answer is about.
        """
        known = self._plane.registry.containers.get(gateway, {})
        runs = {each.id: each.runs for each in known.values() if each.state is ContainerState.READY}
        sent = Sent(gateway=gateway, until=time.monotonic() + PROMISED_S, runs=runs, run=run)
        before = self._sent.get(gateway, ())
        kept = self._sent[gateway] = [*self._open(gateway)[-MOST_PROMISED:], sent]
        for each in before:
            if not any(each is other for other in kept):
                self._unwatch(each)
        self._runs[run] = sent
        return sent

    def waits_for(self, run: tuple[str, ...]) -> bool:
        """Whether a run was sent elsewhere so lately that its end is worth hearing of; asked on any thread."""
        return run in self._runs

    def over(self, run: tuple[str, str], gateway: str) -> None:
        """Note that a run has ended where it was sent to: its container is ready again, which will be told later.

        Not where others wait for it: it is theirs.
        """
        sent, status = self._runs.get(run), self._plane.registry.gateways.get(gateway)
        if sent is not None and sent.gateway == gateway and (status is None or not status.queue):
            self._drop(sent)

    def _unwatch(self, sent: Sent) -> None:
        # The next attempt at the same subtask may have been sent elsewhere meanwhile: that one is still waited for.
        if self._runs.get(sent.run) is sent:
            del self._runs[sent.run]

    def _drop(self, sent: Sent) -> None:
        self._unwatch(sent)
        if sent.gateway in self._sent:
            self._sent[sent.gateway] = [each for each in self._sent[sent.gateway] if each is not sent]

    async def _ask_all(
        self, gateways: Sequence[str], need: Need, avoid: Collection[str]
    ) -> dict[str, tuple[ContainerInfo, ...]]:
        """Ask at the same time; once one that may be used offers all that is needed, the rest is not waited for."""
        began = time.monotonic()
        asking = {asyncio.create_task(self._ask(each, need), name=f"ask {each}"): each for each in gateways}
        answers: dict[str, tuple[ContainerInfo, ...]] = {}
        pending, until = set(asking), math.inf
        try:
            while pending and (left_s := until - time.monotonic()) > 0:
                done, pending = await asyncio.wait(
                    pending, timeout=min(left_s, 2 * ASK_TIMEOUT_S), return_when=asyncio.FIRST_COMPLETED
                )
                for each in done:
                    gateway, containers = asking[each], each.result()
                    if containers is None:
                        continue
                    answers[gateway] = containers
                    if until < math.inf or gateway in avoid:
                        continue
                    if any(_is_all(one, need) and one.gateway == gateway for one in containers):
                        took_s = time.monotonic() - began
                        until = began + max(PATIENCE * took_s, took_s + LEAST_PATIENCE_S)
        finally:
            for each in pending:
                each.cancel()
        return {each: answers[each] for each in gateways if each in answers}

    async def _ask(self, gateway: str, need: Need) -> tuple[ContainerInfo, ...] | None:
        began = time.monotonic()
        try:
            answer = await self._plane.rpc.call(gateway, keyspace.FIND_CONTAINERS, need, timeout_s=ASK_TIMEOUT_S)
        except SwiftbotError:
            return None
        except asyncio.CancelledError:  # others were quicker: it takes this long at least
            if time.monotonic() - began > self._round_trip_ms.get(gateway, 0.0) / 1e3:
                self._measured(gateway, began)
            raise
        self._measured(gateway, began)
        return answer.containers

    def _measured(self, gateway: str, began: float) -> None:
        took_ms = (time.monotonic() - began) * 1e3
        before = self._round_trip_ms.get(gateway, took_ms)
        self._round_trip_ms[gateway] = 0.8 * before + 0.2 * took_ms

    def _known(self, need: Need) -> list[ContainerInfo]:
        return [
            each
            for containers in self._plane.registry.containers.values()
            for each in containers.values()
            if each.image == need.image or need.image in each.compatible
        ]

    async def answer(self, need: Need) -> ContainerList:
        """Answer `find_containers`: the ready containers this gateway knows of."""
        self._plane.registry.asked(need.image, here=False)
        return ContainerList(containers=tuple(each for each in self._known(need) if each.state is ContainerState.READY))

    # --- what selection must know beside them -------------------------------------------------------------------

    def facts(self, need: Need) -> Facts:
        """Where the newest state of the volumes asked for is, and what moving bytes costs."""
        held = {name: holders for name in need.volumes if (holders := self._holders(name))}
        return Facts(volumes=held, links={gateway: self._link_to(gateway) for gateway in self._plane.members()})

    def _holders(self, volume: str) -> tuple[VolumeInfo, ...]:
        """Who holds the newest state of a volume, of the gateways that are there."""
        members = self._plane.members()
        known = [
            each
            for gateway, status in self._plane.registry.gateways.items()
            for each in status.volumes
            if each.name == volume and each.gateway == gateway and gateway in members
        ]
        newest = max((each.generation for each in known), default=0)
        return tuple(each for each in known if each.generation == newest)

    def _link_to(self, gateway: str) -> Link:
        link = self._link(gateway)
        return replace(link, round_trip_ms=self._round_trip_ms.get(gateway, link.round_trip_ms))

    # --- how offers turn out --------------------------------------------------------------------------------------

    def left_out(self, now: Callable[[], float] = time.monotonic) -> dict[str, str]:
        """Gateways whose offers are not to be used just now, with the reason."""
        at = now()
        return {
            gateway: f"its last {trust.empty} offers were nothing"
            for gateway, trust in self._trust.items()
            if trust.until > at
        }

    def outcome(
        self,
        sent: Sent | None,
        *,
        taken: bool | None,
        container: str = "",
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Note what came of sending a run to a gateway.

        Args:
            sent: what `promise` returned; None: no ready container was promised.
            taken: whether the gateway has the run; None: it did not say. That is neither a container that was there
                nor one that was not: what is thought of the gateway stays, and its promised container is held no longer
                than any.
            container: the one that the run got.
            now: the clock, in seconds.
        """
        if taken is None:
            self.searches["unanswered"] += 1
        if taken is None or sent is None:
            return
        gateway = sent.gateway
        if taken:
            sent.container = container
            self._trust.pop(gateway, None)
            return
        # An answer that took long may be about a run that is not counted any more; those sent since are not meant.
        self._drop(sent)
        self._doubted[gateway] = time.monotonic() + PROMISED_S
        trust = self._trust.setdefault(gateway, _Trust())
        trust.empty += 1
        if trust.empty >= EMPTY_OFFERS:
            doublings = min(trust.empty - EMPTY_OFFERS, 16)
            trust.until = now() + min(LEFT_OUT_S, FIRST_LEFT_OUT_S * 2**doublings)

    def _forget(self, gateway: str) -> None:
        for each in self._sent.pop(gateway, ()):
            self._unwatch(each)
        self._doubted.pop(gateway, None)
        self._round_trip_ms.pop(gateway, None)
        self._trust.pop(gateway, None)


def _is_all(container: ContainerInfo, need: Need) -> bool:
    """Whether no other container could serve a need better."""
    return (
        container.state is ContainerState.READY
        and container.image == need.image
        and container.cpu >= need.cpu
        and container.memory_mb >= need.memory_mb
        and set(need.volumes) <= set(container.volumes)
    )


log = structlog.get_logger(__name__)

LOOK_AT_MOST_EVERY_S = 0.02
"""Facts come in bursts, and those of one gateway are published together after 20 ms."""
LOOK_S = 0.25
"""How often those who wait are gone through when nothing is heard."""
AT_ONCE = 8
"""Runs on their way elsewhere at the same time: more would race each other for the same containers."""
MOST_OFFERS = 12
"""Times that one run is offered; then it stays."""
FIRST_PAUSE_S = 0.05
LONGEST_PAUSE_S = 1.0
NEW_S = 0.5
"""A gateway is sent one run in this time to be started in a new container: by then its status tells of that one."""
WORTH = 1.5
"""The wait here must be expected to take so many times as long as a start elsewhere: both are estimates."""


class Offer(Struct, frozen=True, kw_only=True):
    """Where a waiting run is to be passed on to, and why."""

    gateway: str
    new_container: bool
    why: str


def choose(
    *,
    avoid: Collection[str],
    ready: Sequence[ContainerInfo],
    gateways: Mapping[str, GatewayStatus],
    need: Need,
    within: Sequence[str],
    waited_s: float,
    expected_s: float | None,
    cold_s: float,
) -> Offer | None:
    """Return where a waiting run should go, or None when it is best off where it waits.

    Args:
        avoid: gateways where it must not go: the one where it waits, and those where an attempt at it failed.
        ready: containers of others that are ready for it.
        gateways: other gateways that are there, with no run just sent to them to be started in a new container.
        need: what it asks of a container.
        within: gateways it may go to; empty: any.
        waited_s: how long it has waited.
        expected_s: how long it is expected to wait yet; None: not known.
        cold_s: what a cold start of its image takes.
    """
    unwilling = {name for name, status in gateways.items() if status.draining or status.overloaded}
    allowed = [
        each
        for each in ready
        if each.gateway not in avoid and each.gateway not in unwilling and (not within or each.gateway in within)
    ]
    if allowed:
        # The least loaded of those that have one: load comes with the status, and is 1 where there is none.
        def load(container: ContainerInfo) -> tuple[bool, float, str, str]:
            status = gateways.get(container.gateway)
            exact = container.image == need.image
            return (not exact, status.load if status else 1.0, container.gateway, container.id)

        best = min(allowed, key=load)
        return Offer(gateway=best.gateway, new_container=False, why=f"{best.gateway} has a ready container")
    # What has waited long already will wait long yet, whatever was expected.
    if max(expected_s or 0.0, waited_s) < WORTH * cold_s:
        return None
    roomy = [
        status
        for name, status in gateways.items()
        if name not in avoid
        and (not within or name in within)
        and name not in unwilling
        and not status.pool_problem
        and status.queue == 0
        and status.containers < status.capacity
        and status.running < status.containers + 1
        and (not status.pool_memory_mb or need.memory_mb <= status.pool_memory_mb)
    ]
    if not roomy:
        return None
    best = min(roomy, key=lambda status: (status.load, status.id))
    return Offer(gateway=best.id, new_container=True, why=f"{best.id} has room for a new container")


class _Tries(Struct):
    """How often a run was offered, and when it may be again."""

    count: int = 0
    not_before: float = 0.0


class Elsewhere:
    """Goes through the runs that wait here.

    Args:
        plane: the fleet.
        pool: where they wait.
        remote: what is known of other gateways' containers.
        request: the order of a run that is in progress here, by its id; None when there is none.
    """

    def __init__(
        self, plane: Plane, pool: Pool, remote: RemoteContainers, request: Callable[[str], RunRequest | None]
    ) -> None:
        self._plane = plane
        self._pool = pool
        self._remote = remote
        self._request = request
        self._wake = asyncio.Event()
        self._tries: dict[str, _Tries] = {}
        self._offers: dict[str, Offer] = {}
        """Where the runs that were withdrawn are to go; `QueuedOffer` takes them from here."""
        self._promised: dict[str, Sent] = {}
        """The same runs, where a container that was ready was promised."""
        self._under_way: set[str] = set()
        self._starting: dict[str, float] = {}
        """Gateway -> until when it is not sent another run to be started in a new container."""
        self._looking: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to look."""
        self._plane.events.subscribe(Stage.OFFLOAD, self._on_event)
        self._looking = asyncio.create_task(self._keep_looking(), name="look elsewhere for waiting runs")

    def stop(self) -> None:
        """Offer nothing more; those who wait go on waiting."""
        if self._looking is not None:
            self._looking.cancel()

    def look(self) -> None:
        """Go through those who wait soon: a run may have begun to."""
        self._wake.set()

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, FactsChanged) and event.kind in ("container", "gateway"):
            self._wake.set()

    async def _keep_looking(self) -> None:
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    await self._wake.wait()
            self._wake.clear()
            try:
                if self._pool.queue:
                    self._go_through(time.monotonic())
                else:
                    self._tries.clear()
            except Exception:  # supervision boundary: without it waiting runs would stay where they are for good
                log.exception("looking elsewhere broke")
            await asyncio.sleep(LOOK_AT_MOST_EVERY_S)

    def _go_through(self, now: float) -> None:
        waiting = self._pool.waiting()
        ids = {turn.id for turn, _ in waiting} | self._under_way
        self._tries = {run_id: tries for run_id, tries in self._tries.items() if run_id in ids}
        self._starting = {gateway: until for gateway, until in self._starting.items() if until > now}
        for position, (turn, need) in enumerate(waiting, start=1):
            if len(self._under_way) >= AT_ONCE:
                return
            tries = self._tries.setdefault(turn.id, _Tries())
            request = self._request(turn.id)
            if request is None or request.hops or need.volumes or tries.count >= MOST_OFFERS or tries.not_before > now:
                # One that was passed on stays where it is; one that waits for state has it on its way already.
                continue
            if (offer := self._choose(turn, need, request, position, now)) is not None:
                self._offer(turn.id, offer, tries, now)

    def _choose(self, turn: Turn, need: Need, request: RunRequest, position: int, now: float) -> Offer | None:
        members = self._plane.members()
        return choose(
            avoid={self._plane.gateway, *request.avoid},
            ready=self._remote.ready(need),
            gateways={
                name: status
                for name, status in self._plane.registry.gateways.items()
                if name in members and name not in self._starting
            },
            need=need,
            within=request.group,
            waited_s=now - turn.since,
            expected_s=self._pool.expected_s(position),
            cold_s=self._pool.cold_ms(need.image) / 1e3,
        )

    def _offer(self, run_id: str, offer: Offer, tries: _Tries, now: float) -> None:
        self._offers[run_id] = offer
        if not self._pool.withdraw(run_id):
            del self._offers[run_id]  # it has got a container this very moment
            return
        tries.count += 1
        self._under_way.add(run_id)
        if offer.new_container:
            self._starting[offer.gateway] = now + NEW_S
        else:
            task, subtask, _ = run_id.split("/")
            self._promised[run_id] = self._remote.promise(offer.gateway, (task, subtask))

    def offer_of(self, run_id: str) -> "QueuedOffer":
        """Where a run that was withdrawn is to go."""
        return QueuedOffer(self, run_id, self._offers[run_id])

    def forget(self, run_id: str) -> None:
        """Note that a run is not in progress here any more: it may have ended at the moment it was withdrawn."""
        self._offers.pop(run_id, None)
        self._promised.pop(run_id, None)
        self._under_way.discard(run_id)

    def offered(self, run_id: str, *, taken: bool | None, container: str = "") -> None:
        """Note what came of an offer; one that was not taken is made again after a pause.

        Args:
            run_id: what was offered.
            taken: whether the other gateway has it; None: it did not say.
            container: the one that it got there.
        """
        del self._offers[run_id]
        self._under_way.discard(run_id)
        self._remote.outcome(self._promised.pop(run_id, None), taken=taken, container=container)
        if taken is not False:
            self._tries.pop(run_id, None)
            self._remote.searches["moved"] += taken is True
            return
        tries = self._tries.setdefault(run_id, _Tries(count=1))
        pause_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2 ** (tries.count - 1))
        tries.not_before = time.monotonic() + pause_s


class QueuedOffer:
    """Offers for a run that was taken out of the queue here: the one gateway that `choose` found."""

    def __init__(self, elsewhere: Elsewhere, run_id: str, offer: Offer) -> None:
        self.offer = offer
        self._elsewhere = elsewhere
        self._run_id = run_id
        self._left = [offer.gateway]

    async def best(self) -> str:
        """Return it, once."""
        return self._left.pop() if self._left else ""

    def note(self, outcome: Outcome) -> None:
        """Note whether it has the run."""
        self._elsewhere.offered(self._run_id, taken=outcome.taken, container=outcome.container)


PASSED_ON_S = 1.0
"""How long the gateway that a run was passed on to may take to answer a question after it."""


class PassedOn(Struct, frozen=True):
    """Another gateway has the run, and tells how it ends; `event` tells the coordinator so."""

    event: RunEvent


class Passing:
    """The runs of one gateway that wait, and those that went elsewhere while they did."""

    def __init__(self, plane: Plane, pool: Pool, elsewhere: Elsewhere) -> None:
        self._plane = plane
        self._pool = pool
        self._elsewhere = elsewhere
        self.moving: set[str] = set()
        """Runs that are being offered to another gateway: neither here nor there."""
        self.moved: dict[str, str] = {}
        """Runs that were passed on after they had been accepted here, with the gateway that has them."""

    def start(self) -> None:
        """Begin to offer those who wait; a pool that keeps to itself lets them wait."""
        if self._pool.federated:
            self._elsewhere.start()

    def stop(self) -> None:
        """Offer nothing more."""
        self._elsewhere.stop()

    async def run(
        self,
        request: RunRequest,
        decision: Decision,
        tell: Callable[[RunEvent], None],
        *,
        since: float,
        check: Callable[[RunRequest], None],
    ) -> RunEvent | PassedOn:
        """Run it here, or pass it on while it waits.

        Args:
            request: what to run.
            decision: what selection said.
            tell: gets the run's events but the last.
            since: when the order came, on the monotonic clock: its place in the queue.
            check: raises what must not begin any more.
        """
        turn = turn_of(request, since)
        try:
            return await self._here_or_there(request, decision, tell, turn, check)
        finally:
            self._elsewhere.forget(request.run_id)

    async def _here_or_there(
        self,
        request: RunRequest,
        decision: Decision,
        tell: Callable[[RunEvent], None],
        turn: Turn,
        check: Callable[[RunRequest], None],
    ) -> RunEvent | PassedOn:
        while True:
            self._elsewhere.look()
            try:
                return await self._pool.run(request, decision, tell, turn=turn)
            except WithdrawnError:
                self.moving.add(request.run_id)
            try:
                passed_on = await self._pass_on(request, self._elsewhere.offer_of(request.run_id), turn.since)
            finally:
                self.moving.discard(request.run_id)
            if passed_on is not None:
                return passed_on
            # Much may have happened meanwhile; what was reserved for it is not any more.
            check(request)
            decision = replace(decision, container=None, reservation="")

    async def _pass_on(self, request: RunRequest, offers: QueuedOffer, since: float) -> PassedOn | None:
        offer = offers.offer
        order = replace(request, hops=1, new_container=offer.new_container)
        accepted = await Handoff(self._plane, order).begin(offers)
        if accepted is None:
            return None
        self.moved[request.run_id] = accepted.gateway
        why = f"waited {time.monotonic() - since:.1f} s on {self._plane.gateway}, then {offer.why}"
        choice = accepted.choice and replace(
            accepted.choice, by=self._plane.gateway, way=Way.NEW if offer.new_container else Way.RUN_THERE, why=why
        )
        return PassedOn(replace(whereabouts(request, accepted), note=clean(why, MAX_NOTE), choice=choice))

    async def ask(self, run_id: str, verb: Verb[RunAsk, RunStatus]) -> RunStatus:
        """Ask after a run that was passed on (`run_status`), or have it ended (`run_cancel`), where it is."""
        task, subtask, number = run_id.split("/")
        ask, there = RunAsk(task=task, subtask=subtask, attempt=int(number)), self.moved[run_id]
        try:
            return await self._plane.rpc.call(there, verb, ask, timeout_s=PASSED_ON_S)
        except SwiftbotError as error:
            log.info("no word of a run that was passed on", run=run_id, gateway=there, reason=str(error))
            return RunStatus(running=self._plane.sees(there))


def whereabouts(request: RunRequest, accepted: RunAccepted) -> RunEvent:
    """Return the event of a run that was accepted: where it is."""
    return RunEvent(
        task=request.task,
        subtask=request.subtask,
        attempt=request.attempt,
        kind=RunEventKind.PROGRESS,
        gateway=accepted.gateway,
        phase=accepted.phase,
    )


def explained(decision: Decision, avoid: Mapping[str, str]) -> Decision:
    """Have the choice name the gateways that were left out, also those that selection did not hear of again."""
    choice = decision.choice
    if choice is None or not avoid:
        return decision
    told = {each.gateway for each in choice.considered}
    missing = tuple(
        Considered(gateway=gateway, way=Way.RUN_THERE, verdict=reason)
        for gateway, reason in avoid.items()
        if gateway not in told
    )
    considered = (*choice.considered[: MOST_CONSIDERED - len(missing)], *missing)
    return replace(decision, choice=replace(choice, considered=considered[:MOST_CONSIDERED]))


def passed_on(accepted: RunAccepted, decision: Decision) -> RunAccepted:
    """The other gateway's answer with the reasons of the one that chose it; it picks the container itself."""
    choice = decision.choice
    if choice is None:
        return accepted
    choice = replace(choice, gateway=accepted.gateway, container=accepted.container)
    if accepted.choice is not None and accepted.choice.way is Way.BRING_HERE:
        choice = replace(choice, why=f"{choice.why}; there {accepted.choice.why}")
    return replace(accepted, why=decision.why, choice=choice)


REMOTE_TRIES = 3
"""Other gateways that are tried for one run before what is here has to do."""
MAX_VERDICT = 80


class Choosing:
    """Chooses for one gateway. `check` refuses an order that must not begin any more."""

    def __init__(
        self, plane: Plane, pool: Pool, remote: RemoteContainers, *, check: Callable[[RunRequest], None]
    ) -> None:
        self._plane = plane
        self._pool = pool
        self._remote = remote
        self._check = check

    async def choose(self, request: RunRequest) -> Decision | RunAccepted:
        """Select a container; what another gateway answered, where that has taken the run."""
        avoid = {
            **self._remote.left_out(),
            **self._outside(request),
            **dict.fromkeys(request.avoid, "an earlier attempt failed there"),
        }
        selection = Selection(self._pool, self._remote, request, avoid, check=self._check)
        accepted = await Handoff(self._plane, replace(request, hops=1)).begin(selection)
        decision = explained(selection.decision, selection.avoid)
        return decision if accepted is None else passed_on(accepted, decision)

    def _outside(self, request: RunRequest) -> dict[str, str]:
        """Gateways that the run may not be passed on to."""
        if not request.group:
            return {}
        return {each: "the submitter does not allow it" for each in self._plane.members() if each not in request.group}


class Selection:
    """Offers for a run that has just come: what selection chooses, as long as that is on another gateway.

    An offer that turns out to be nothing is counted, explained in the choice, and the next best is taken; the last try
    is without other gateways.
    """

    decision: Decision
    """What was selected last."""

    def __init__(
        self,
        pool: Pool,
        remote: RemoteContainers,
        request: RunRequest,
        avoid: dict[str, str],
        *,
        check: Callable[[RunRequest], None],
    ) -> None:
        self.avoid = avoid
        """Gateways whose containers are not used, with the reason."""
        self._pool = pool
        self._remote = remote
        self._request = request
        self._check = check
        self._inputs = bytes_by_gateway(request.inputs)
        self._left = REMOTE_TRIES
        self._sent: Sent | None = None

    async def best(self) -> str:
        """Select; empty when the container, or room for one, is here."""
        request = self._request
        self.decision = await self._pool.select(
            request.need,
            allow_remote=self._left > 0,
            inputs=self._inputs,
            avoid=self.avoid,
            turn=turn_of(request),
        )
        if self.decision.phase is not Phase.REMOTE_WARM:
            return ""
        if not self._left:
            raise PoolError("a selection without other gateways chose one")
        self._left -= 1
        self._check(request)
        self._sent = self._remote.promise(self.decision.gateway, (request.task, request.subtask))
        return self.decision.gateway

    def note(self, outcome: Outcome) -> None:
        """Leave a gateway out of the next selection that did not have what it was chosen for."""
        self._remote.outcome(self._sent, taken=outcome.taken, container=outcome.container)
        if outcome.taken is False:
            reason = f"had none when asked: {clean(outcome.reason, MAX_VERDICT)}"
            self.avoid = {**self.avoid, self.decision.gateway: reason}
