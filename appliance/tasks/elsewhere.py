"""Offers runs that wait here for a container to other gateways, as soon as one of them has a container for it.

A run that finds everything busy joins the queue of its gateway. That is right only as long as nobody else has room:
under uneven load one gateway's queue grows while others stand idle. So whenever facts of other gateways change, and
now and then in any case, those who wait are gone through in their turns:

    warm   another gateway has a ready container: the run is passed on to it
    anew   nobody has, but another gateway has room for a new one and nobody waiting, and the wait here is expected
           to take longer than such a start: the run is passed on, to be started there

A run is taken out of the queue here before it is offered, so that it cannot begin twice; if it is not taken there it
goes back to its old place in the queue, and is offered again after a pause that doubles. `choose` decides, without
I/O; `Elsewhere` looks and offers.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Collection, Mapping, Sequence

import structlog
from msgspec import Struct

from appliance.model import ContainerInfo, GatewayStatus, Need, RunRequest
from appliance.plane.node import Plane
from appliance.pool.pool import Pool
from appliance.pool.turns import Turn
from appliance.tasks.remote import RemoteContainers, Sent

log = structlog.get_logger(__name__)

LOOK_AT_MOST_EVERY_S = 0.02
"""Facts come in bursts, and those of one gateway are told together after 20 ms."""
LOOK_S = 0.25
"""How often those who wait are gone through when nothing is heard."""
AT_ONCE = 8
"""Runs on their way elsewhere at the same time: more would race each other for the same containers."""
MOST_OFFERS = 12
"""Times that one run is offered; then it stays."""
FIRST_PAUSE_S = 0.05
LONGEST_PAUSE_S = 1.0
ANEW_S = 0.5
"""A gateway is sent one run in this time to be started anew: by then its status tells of the container."""
WORTH = 1.5
"""The wait here must be expected to take so many times as long as a start elsewhere: both are estimates."""


class Offer(Struct, frozen=True, kw_only=True):
    """Where a waiting run is to be passed on to, and why."""

    gateway: str
    anew: bool
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
        gateways: other gateways that are there, with no run just sent to them to be started anew.
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
        return Offer(gateway=best.gateway, anew=False, why=f"{best.gateway} has a ready container")
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
    return Offer(gateway=best.id, anew=True, why=f"{best.id} has room for a new container")


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
        """Where the runs that were withdrawn are to go; taken from here by whoever passes them on."""
        self._promised: dict[str, Sent] = {}
        """The same runs, where a container that was ready was promised."""
        self._under_way: set[str] = set()
        self._anew: dict[str, float] = {}
        """Gateway -> until when it is not sent another run to be started anew."""
        self._looking: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to look."""
        self._plane.registry.on_change.append(self._on_fact)
        self._looking = asyncio.create_task(self._keep_looking(), name="look elsewhere for waiting runs")

    def stop(self) -> None:
        """Offer nothing more; those who wait go on waiting."""
        if self._looking is not None:
            self._looking.cancel()

    def look(self) -> None:
        """Go through those who wait soon: a run may have begun to."""
        self._wake.set()

    def _on_fact(self, kind: str) -> None:
        if kind in ("container", "gateway"):
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
        self._anew = {gateway: until for gateway, until in self._anew.items() if until > now}
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
                if name in members and name not in self._anew
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
        if offer.anew:
            self._anew[offer.gateway] = now + ANEW_S
        else:
            task, subtask, _ = run_id.split("/")
            self._promised[run_id] = self._remote.promise(offer.gateway, (task, subtask))

    def offer_of(self, run_id: str) -> Offer:
        """Where a run that was withdrawn is to go."""
        return self._offers[run_id]

    def forget(self, run_id: str) -> None:
        """Note that a run is not in progress here any more: it may have ended at the moment it was withdrawn."""
        self._offers.pop(run_id, None)
        self._promised.pop(run_id, None)
        self._under_way.discard(run_id)

    def offered(self, run_id: str, *, taken: bool | None, container: str = "") -> None:
        """Note what came of an offer; one that was not taken is made again after a pause.

        Args:
            run_id: what was offered.
            taken: whether the other gateway has it; None: it did not say. That is neither a container that was there
                nor one that was not: what is thought of the gateway stays, and its promised container is held no longer
                than any.
            container: the one that it got there.
        """
        del self._offers[run_id]
        self._under_way.discard(run_id)
        sent = self._promised.pop(run_id, None)
        if taken is None:
            self._tries.pop(run_id, None)
            self._remote.searches["unanswered"] += 1
            return
        if sent is not None:
            self._remote.turned_out(sent, good=taken, container=container)
        if taken:
            self._tries.pop(run_id, None)
            self._remote.searches["moved"] += 1
            return
        tries = self._tries.setdefault(run_id, _Tries(count=1))
        pause_s = min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2 ** (tries.count - 1))
        tries.not_before = time.monotonic() + pause_s
