"""The latest facts of the fleet: every gateway's status and containers, every robot. Each fact has one owner.

Owners put facts when they change (`speaker`). Whoever comes later asks: each member of a small fleet; in a large one a
neighbour for all that it knows, and then only those it knew nothing of. A fact carries its age: since it was heard, on
this machine's monotonic clock, and what its speaker said it was old by then; what is older than its speaker promised is
stale, counts less in decisions, and is asked for again. What a gateway said goes with it. Robots are the `roster`'s.
"""

import asyncio
import contextlib
import math
import random
import time
from collections.abc import Callable, Iterable, Mapping

import structlog
from msgspec.structs import replace

from appliance.errors import SwiftbotError
from appliance.model import ContainerInfo, ContainerState, GatewayStatus, RobotInfo, encode
from appliance.plane.facts import Facts, FactsAsk, Known
from appliance.plane.membership import Membership
from appliance.plane.namesake import Namesakes
from appliance.plane.roster import Roster
from appliance.plane.rpc import Rpc
from appliance.plane.session import Closer, Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.speaker import STATUS_S, Speaker

log = structlog.get_logger(__name__)

MOST_CONTAINERS = 4096
"""Bound on what is believed of one gateway."""
FEW = 8
"""Members that are each asked at once; with more the newcomer asks one for all, and the others wait for it to speak."""
LATE = 1.5
"""A status is overdue after so many of the intervals that its speaker promised."""
_FACTS_S = 2.0
_FACTS_TRIES = 3
_GATHER_S = 0.02
"""For so long a newcomer gathers members before it asks for their facts."""
_SPEAK_S = 0.2
"""For so long a newcomer is given to tell its own facts, and longer in a large fleet, at random."""
_SOON_S = (0.05, 0.15)
"""After so long a member of a small fleet asks another that has come, drawn, so that they do not all ask at once."""
_AT_ONCE = 8
_PAGE_BYTES = 2**20
_DOUBT_S = 1.0
"""A gateway whose facts are stale is asked again at most so often."""


class Registry:
    """What is known of the fleet just now. `on_change` gets `gateway`, `container` or `robot`."""

    def __init__(
        self, config: PlaneConfig, *, session: Session, rpc: Rpc, membership: Membership, gateway: str | None
    ) -> None:
        self.gateways: dict[str, GatewayStatus] = {}
        self.containers: dict[str, dict[str, ContainerInfo]] = {}
        self._roster = Roster(session, on_change=lambda: self._tell("robot"))
        self.robots: dict[str, RobotInfo] = self._roster.robots
        self.on_change: list[Callable[[str], None]] = []
        self._session = session
        self._rpc = rpc
        self._membership = membership
        self._gateway = gateway
        self._closers: list[Closer] = []
        self._heard: dict[str, int] = {}
        self._as_of: dict[str, float] = {}
        """Gateway -> when, on this clock, its status was so; what is known of its containers held then."""
        self._container_as_of: dict[tuple[str, str], float] = {}
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._missing: set[str] = set()
        """Members whose facts are not known and will be asked for."""
        self._catching_up: asyncio.Task[None] | None = None
        self._asked_by: dict[str, dict[str, float]] = {}
        """What those gateways that decide anything say is asked for."""
        self._doubted: dict[str, float] = {}
        self._speaker: Speaker | None = None
        self.namesakes: Namesakes | None = None
        """Others that go by this gateway's id."""
        if gateway is not None:
            self.namesakes = Namesakes(session, gateway, own=lambda: self.gateways.get(gateway))
            rpc.register("facts", FactsAsk, self._on_facts, exchange=False)
            self._speaker = Speaker(
                session, gateway, least_s=config.coalesce_ms / 1e3, most_s=config.coalesce_most_ms / 1e3,
                listeners=lambda: len(membership.members) - 1, elsewhere=self._asked_elsewhere,
            )  # fmt: skip
        membership.on_joined.append(self._on_joined)
        membership.on_lost.append(self._forget)

    def start(self) -> None:
        """Begin to listen."""
        session, keys = self._session, self._session.keys
        self._roster.start()
        self._closers = [
            session.subscribe_typed(keys.status(), GatewayStatus, self._on_status),
            session.subscribe_typed(keys.container(), ContainerInfo, self._on_container),
        ]

    @property
    def lost_ns(self) -> Mapping[str, int]:
        """When each robot that is offline was lost, Unix nanoseconds by this machine's clock."""
        return self._roster.lost_ns

    def doubtful(self, robot: str) -> bool:
        """Whether more than one may carry out what this robot is ordered."""
        return self._roster.doubtful(robot)

    # --- our own facts ----------------------------------------------------------------------------------------

    def publish_status(self, status: GatewayStatus) -> None:
        """Tell the fleet about this gateway, as soon and as often as its news is worth it."""
        self.gateways[status.id] = status
        self._as_of[status.id] = time.monotonic() - status.age_ms / 1e3
        if self._speaker is not None:
            self._speaker.status(status)
        self._tell("gateway")

    def publish_containers(self, containers: tuple[ContainerInfo, ...]) -> None:
        """Tell the fleet which containers this gateway holds: all of them; those left out are gone."""
        if self._gateway is not None:
            self.containers[self._gateway] = {each.id: each for each in containers}
        if self._speaker is not None:
            self._speaker.containers(containers)
        self._tell("container")

    def asked(self, image: str, *, here: bool = True) -> None:
        """Note a decision that rests on containers of an image; `here`: made on this gateway, not for another."""
        if self._speaker is not None:
            self._speaker.asked(image, here=here)

    def _asked_elsewhere(self, image: str) -> float:
        """Decisions a second that other gateways say rest on containers of an image; of any for the empty name."""
        asked = self._asked_by.values()
        return sum(sum(each.values()) if not image else each.get(image, 0.0) for each in asked)

    async def _on_facts(self, asked: FactsAsk) -> Facts:
        gateway = self._gateway or ""
        own = self.gateways.get(gateway)
        others, more = self._page(asked.after) if asked.all else ((), False)
        return Facts(
            gateway=gateway,
            status=self._speaker.now(own) if own is not None and self._speaker is not None else own,
            containers=tuple(self.containers.get(gateway, {}).values()),
            robots=() if asked.after else tuple(self.robots.values()),
            others=others,
            more=more,
        )

    def _page(self, after: str) -> tuple[tuple[Known, ...], bool]:
        """What is known of others from an id on, as much as goes into an answer."""
        page: list[Known] = []
        size = 0
        for name in sorted(each for each in self.gateways if each > after and each != self._gateway):
            known = Known(
                gateway=name, status=self.gateways[name], containers=tuple(self.containers.get(name, {}).values()),
                age_ms=min(2**31, round(self.age_s(name) * 1e3)),
            )  # fmt: skip
            size += len(encode(known))
            if page and size > _PAGE_BYTES:
                return tuple(page), True
            page.append(known)
        return tuple(page), False

    # --- how old facts are --------------------------------------------------------------------------------------

    def age_s(self, gateway: str, container: str = "") -> float:
        """How old what is known of a gateway, or of one of its containers, is at least; endless when nothing is."""
        if gateway == self._gateway:
            return 0.0
        as_of = self._as_of.get(gateway, -math.inf)
        if container:
            status = self.gateways.get(gateway)
            as_of -= status.untold_ms / 1e3 if status is not None else 0.0
            as_of = max(as_of, self._container_as_of.get((gateway, container), -math.inf))
        return time.monotonic() - as_of

    def stale_s(self, gateway: str) -> float:
        """For how long a gateway has been silent beyond what it promised; 0: what is known of it counts in full."""
        status = self.gateways.get(gateway)
        if gateway == self._gateway or status is None:
            return 0.0
        promised_s = status.again_ms / 1e3 if status.again_ms else STATUS_S
        return max(0.0, self.age_s(gateway) - LATE * promised_s)

    def keeps_promise(self, gateway: str) -> bool:
        """Whether a gateway has said when it will speak again, and is not late."""
        status = self.gateways.get(gateway)
        return status is not None and status.again_ms > 0 and self.stale_s(gateway) == 0

    def doubt(self, gateway: str) -> None:
        """Ask a gateway whose facts are stale for them, unless that was done a moment ago; returns at once."""
        now = time.monotonic()
        if gateway in self._asking or now - self._doubted.get(gateway, -math.inf) < _DOUBT_S:
            return
        self._doubted[gateway] = now
        if self._is_member(gateway):
            self._ask(gateway)

    # --- others' facts ----------------------------------------------------------------------------------------

    async def wait_for_facts(self) -> None:
        """Wait until every member that is known has told its facts, or could not within a few seconds."""
        while self._catching_up is not None or self._asking:
            tasks = [*self._asking.values(), *([self._catching_up] if self._catching_up is not None else [])]
            await asyncio.wait(tasks)

    def _on_status(self, key: str, status: GatewayStatus | None) -> None:
        gateway = key.split("/")[-2]
        if gateway == self._gateway and status is not None and self.namesakes is not None:
            self.namesakes.heard(status)
        if gateway == self._gateway or status is None or not self._is_member(gateway):
            return
        if status.id != gateway:
            self._session.refuse("misplaced gw/*/status", key=key, says=status.id)
            return
        self._count(gateway)
        self._learn_status(gateway, status, age_s=status.age_ms / 1e3)

    def _learn_status(self, gateway: str, status: GatewayStatus, *, age_s: float) -> None:
        self.gateways[gateway] = status
        if status.asked:
            self._asked_by[gateway] = status.asked
        else:
            self._asked_by.pop(gateway, None)
        # A speaker's clock may be off, and it may lie: no fact is from the future.
        self._as_of[gateway] = time.monotonic() - max(0.0, age_s)
        if status.containers <= len(self.containers.get(gateway, ())):
            self._missing.discard(gateway)  # otherwise it has put some of its containers before we listened
        self._tell("gateway")

    def _on_container(self, key: str, info: ContainerInfo | None) -> None:
        gateway, container = key.split("/")[-3], key.rsplit("/", maxsplit=1)[-1]
        if gateway == self._gateway or not self._is_member(gateway):
            return
        held = self.containers.setdefault(gateway, {})
        if info is None or info.state is ContainerState.DEAD:
            held.pop(container, None)
            self._container_as_of.pop((gateway, container), None)
        elif info.id != container or info.gateway != gateway:
            self._session.refuse("misplaced gw/*/pool/*", key=key, says=f"{info.gateway}/{info.id}")
            return
        elif len(held) >= MOST_CONTAINERS and container not in held:
            self._session.refuse("too many gw/*/pool/*", key=key)
            return
        else:
            held[container] = info
            self._container_as_of[gateway, container] = time.monotonic()
        self._count(gateway)
        self._tell("container")

    def _is_member(self, gateway: str) -> bool:
        """Facts of those whose token is not seen are left: they are asked for when it comes."""
        return gateway in self._membership.members

    def _count(self, gateway: str) -> None:
        self._heard[gateway] = self._heard.get(gateway, 0) + 1

    def _on_joined(self, gateway: str) -> None:
        """A member has come: what it put before we listened must be asked for, of it or of one that has heard it."""
        if gateway == self._gateway:
            return
        if len(self._membership.members) <= FEW:
            # One that has only just come has better to do, and tells its own facts besides.
            self._ask(gateway, after_s=0.0 if self._gateway is None else random.uniform(*_SOON_S))  # noqa: S311
            return
        self._missing.add(gateway)
        if self._catching_up is None:
            self._catching_up = asyncio.create_task(self._catch_up(), name="facts of the fleet")
            self._catching_up.add_done_callback(self._caught_up)

    def _caught_up(self, _: asyncio.Task[None]) -> None:
        self._catching_up = None

    async def _catch_up(self) -> None:
        """Learn the facts of those that are missing: from one member for all, then from each that it did not know."""
        await asyncio.sleep(_GATHER_S)
        members = self._membership.members
        if len(self._missing) > max(FEW, len(members) // 2):
            await self._ask_for_all()
        while self._missing:
            # One that has just come tells its facts by itself; so does each to all, whom all would ask at once.
            await asyncio.sleep(random.uniform(_SPEAK_S, _SPEAK_S + len(members) / 100))  # noqa: S311 - spreads load
            for gateway in list(self._missing)[:_AT_ONCE]:
                self._missing.discard(gateway)
                if self._is_member(gateway):
                    self._ask(gateway)
            if self._asking:
                await asyncio.wait(self._asking.values())

    async def _ask_for_all(self) -> None:
        others = sorted(self._membership.members - {self._gateway})
        for neighbour in random.sample(others, min(_FACTS_TRIES, len(others))):
            after = ""
            try:
                while True:
                    ask = FactsAsk(all=True, after=after)
                    facts = await self._rpc.call(neighbour, "facts", ask, Facts, timeout_s=_FACTS_S)
                    self._roster.take(facts.robots)
                    if not after and self._is_member(neighbour):
                        self._take(neighbour, facts)
                    self._take_others(facts.others)
                    if not facts.more or not facts.others or facts.others[-1].gateway <= after:
                        return
                    after = facts.others[-1].gateway
            except SwiftbotError as error:
                log.info("the facts of all could not be had", member=neighbour, reason=str(error))

    def _take_others(self, others: Iterable[Known]) -> None:
        for known in others:
            gateway, status = known.gateway, known.status
            if gateway == self._gateway or status is None or status.id != gateway or not self._is_member(gateway):
                continue
            if known.age_ms / 1e3 >= self.age_s(gateway):
                continue  # what was heard directly is newer
            self._take_containers(gateway, known.containers)
            self._learn_status(gateway, status, age_s=known.age_ms / 1e3)
            self._missing.discard(gateway)

    def _ask(self, gateway: str, *, after_s: float = 0.0) -> None:
        task = asyncio.create_task(self._ask_facts(gateway, after_s), name=f"facts of {gateway}")
        self._asking[gateway] = task
        task.add_done_callback(lambda done: self._asked(gateway, done))

    def _asked(self, gateway: str, done: asyncio.Task[None]) -> None:
        if self._asking.get(gateway) is done:
            del self._asking[gateway]

    async def _ask_facts(self, gateway: str, after_s: float) -> None:
        await asyncio.sleep(after_s)
        for attempt in range(_FACTS_TRIES):
            heard = self._heard.get(gateway, 0)
            try:
                facts = await self._rpc.call(gateway, "facts", FactsAsk(), Facts, timeout_s=_FACTS_S)
            except SwiftbotError as error:
                log.info("facts could not be had", member=gateway, reason=str(error))
                await asyncio.sleep(0.1)
                continue
            if not self._is_member(gateway):
                return
            self._roster.take(facts.robots)
            # What was put while the answer was on its way is newer than the answer: ask again.
            if self._heard.get(gateway, 0) == heard or attempt == _FACTS_TRIES - 1:
                self._take(gateway, facts)
                return

    def _take(self, gateway: str, facts: Facts) -> None:
        self._take_containers(gateway, facts.containers)
        if facts.status is not None and facts.status.id == gateway:
            # All that it holds was in the answer, told before or not.
            status = replace(facts.status, untold_ms=0)
            self._learn_status(gateway, status, age_s=status.age_ms / 1e3)
        self._missing.discard(gateway)

    def _take_containers(self, gateway: str, containers: tuple[ContainerInfo, ...]) -> None:
        self._drop_ages(gateway)
        self.containers[gateway] = {
            each.id: each
            for each in containers[:MOST_CONTAINERS]
            if each.gateway == gateway and each.state is not ContainerState.DEAD
        }
        self._tell("container")

    def _drop_ages(self, gateway: str) -> None:
        for container in self.containers.get(gateway, {}):
            self._container_as_of.pop((gateway, container), None)

    def _forget(self, gateway: str) -> None:
        """A gateway is lost: what it said goes with it, what it said of itself no longer holds."""
        if task := self._asking.pop(gateway, None):
            task.cancel()
        self._drop_ages(gateway)
        self._missing.discard(gateway)
        for noted in (self._heard, self._as_of, self._doubted, self._asked_by):
            noted.pop(gateway, None)
        if self.gateways.pop(gateway, None) is not None:
            self._tell("gateway")
        if self.containers.pop(gateway, None) is not None:
            self._tell("container")

    def _tell(self, kind: str) -> None:
        for callback in tuple(self.on_change):
            try:
                callback(kind)
            except Exception:  # supervision boundary: a listener's defect must not stop the facts
                log.exception("a listener to the facts failed", kind=kind)

    async def close(self) -> None:
        """Publish what waits, listen no more."""
        if self._speaker is not None:
            self._speaker.close()
        for closer in self._closers:
            closer.close()
        await self._roster.close()
        if self.namesakes is not None:
            await self.namesakes.close()
        tasks = [each for each in (self._catching_up, *self._asking.values()) if each is not None]
        for task in tasks:
            task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.gather(*tasks, return_exceptions=True)
