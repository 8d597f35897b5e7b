"""Phase 2 of container selection, finding a ready container elsewhere (paper, Algorithm 1, distributed search).

What the registry knows comes first: gateways push what changes, so a container that it knows to be ready, of a gateway
that was heard of lately, is as good as an answer and costs nothing. Only when it knows of none that can be had are the
k successors of hash(image) asked, and of those the ones of which nothing was heard lately, or to which runs were just
sent, which may be over; each answers with the ready
containers it knows of, its own and those it has heard of. What selection must know beside them comes from here too:
the measured round trip to each gateway (a moving average), what moving bytes costs, and where the newest state of a
volume is. A gateway whose offers turn out to be nothing, several times in a row, is left out for a while: it is out of
date, or it lies.
"""

import asyncio
import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Protocol

from msgspec import Struct

from appliance.errors import SwiftbotError
from appliance.model import ContainerInfo, ContainerState, Need, VolumeInfo
from appliance.plane.node import Plane
from appliance.pool.selection import Candidate, Facts
from appliance.pool.transfer.flow import Link
from appliance.tasks.api import ContainerList

ASK_TIMEOUT_S = 0.15
"""A neighbour slower than this is no help: a cold start costs about as much."""
UNKNOWN_ROUND_TRIP_MS = 5.0
BRING_MS = 40.0
"""What bringing a volume costs however small it is: asking for it, the snapshot there, the swap here (measured with a
file of 14 bytes on a loaded machine: 50 to 80 ms to the first line of the handler)."""
FRESH_S = 10.0
"""What was heard of a gateway within this time is believed without asking: it tells its status every few seconds and
every change of a container at once, so silence for longer means that something is lost on the way."""
PROMISED_S = 0.25
"""For how long at most a container to which a run was sent is not counted on any more: by then its gateway has told
that it is busy (changes are told after 20 ms), or has had a run more."""
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


class Links(Protocol):
    """What moving bytes costs: `pool.transfer.Transfers`."""

    def bandwidth_mbps(self, gateway: str) -> float:
        """Megabits per second with a gateway."""
        ...

    def cost_ms(self, size_bytes: int, gateway: str) -> float:
        """Serialise + size / bandwidth + deserialise, milliseconds."""
        ...


class UnmeasuredLinks:
    """Careful guesses, the same for every gateway, where nothing is moved that could be measured."""

    def bandwidth_mbps(self, gateway: str) -> float:  # noqa: ARG002 - all are guessed alike
        """Megabits per second."""
        return Link().bandwidth * 8 / 1e6

    def cost_ms(self, size_bytes: int, gateway: str) -> float:  # noqa: ARG002
        """Serialise + size / bandwidth + deserialise, milliseconds."""
        return Link().cost_ms(size_bytes)


class _Trust(Struct):
    """How a gateway's offers have turned out."""

    empty: int = 0
    until: float = 0.0


class Sent(Struct):
    """A run that was sent to a gateway. It holds one of its ready containers until that one is told of anew."""

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
        links: what is measured of moving bytes to and from other gateways.
    """

    def __init__(self, plane: Plane, *, successors: int, links: Links) -> None:
        self._plane = plane
        self._successors = successors
        self._links = links
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
        plane.on_member_lost.append(self._forget)

    async def find(self, need: Need, avoid: Collection[str] = ()) -> list[Candidate]:
        """Containers on other gateways that could serve a need, in any state, each with its round trip.

        Args:
            need: T = (image, cpu, mem, volumes).
            avoid: gateways whose containers will not be used: what they have is told, and ends no search.
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
            # Whoever answers has counted in what was sent to it: short runs are over before anything was told.
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
            Candidate(container=each, round_trip_ms=self._round_trip_ms.get(each.gateway, UNKNOWN_ROUND_TRIP_MS))
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

        What is returned tells `turned_out` which of the runs that were sent there its answer is about.
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

    def waits_for(self, run: tuple[str, str]) -> bool:
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
            answer = await self._plane.rpc.call(
                gateway, "find_containers", need, ContainerList, timeout_s=ASK_TIMEOUT_S
            )
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
        return Facts(volumes=held, files_ms=self._files_ms, state_ms=self._state_ms)

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

    def _files_ms(self, size: int, gateway: str) -> float:
        """Bytes at so many megabits per second: 1 Mbit/s is 1000 bits a millisecond."""
        return size * 8 / (1e3 * self._links.bandwidth_mbps(gateway))

    def _state_ms(self, size: int, gateway: str) -> float:
        round_trip_ms = self._round_trip_ms.get(gateway, UNKNOWN_ROUND_TRIP_MS)
        return BRING_MS + round_trip_ms + self._links.cost_ms(size, gateway)

    # --- how offers turn out --------------------------------------------------------------------------------------

    def left_out(self, now: Callable[[], float] = time.monotonic) -> dict[str, str]:
        """Gateways whose offers are not to be used just now, with the reason."""
        at = now()
        return {
            gateway: f"its last {trust.empty} offers were nothing"
            for gateway, trust in self._trust.items()
            if trust.until > at
        }

    def turned_out(
        self, sent: Sent, *, good: bool, container: str = "", now: Callable[[], float] = time.monotonic
    ) -> None:
        """Note whether a container that a gateway offered was there, and which one the run that was sent there got."""
        gateway = sent.gateway
        if good:
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
