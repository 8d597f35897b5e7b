"""Soft stops: kept on disk, told to every gateway, and to the robots until they say that they hold.

Which robots are stopped is an observed-remove set (Shapiro et al., "A comprehensive study of convergent and commutative
replicated data types", 2011, section 3.3.5), which any two gateways merge to the same (`Stops`, pure): a lifting names
the stops that the operator who lifted them had seen, so one that was given meanwhile elsewhere, behind a partition too,
stays in force. No clock has a part in it. What is forgotten of liftings, beyond `MOST`, can only bring a stop back,
never lose one.

A stop is published before any gateway is asked, so each gateway that hears it acts on it by itself; the
gateway that is asked besides confirms which others have it on disk and which robots hold. What was missed is made up
for when gateways meet (`authority`).
"""

import asyncio
import itertools
import time
import uuid
from collections.abc import Awaitable, Callable, Iterable
from typing import NoReturn

import msgspec
import structlog

from appliance.background import Background
from appliance.errors import RefusedError, SwiftbotError
from appliance.model import Lifted, SoftStop, encode, keyspace
from appliance.model.robot_api import ResumeRobotsAsk, StandingAsk, StopAnswer, StopAsk
from appliance.plane.node import Plane
from appliance.plane.session import Closer
from appliance.robots.sender import tell_to_hold

MOST = 1024
"""Stops and liftings that are remembered, each: years of use, and what a flood can cost."""
RESERVE = 64
"""Of these, only for stops of the whole fleet: however many robots are stopped one by one, it can still be stopped."""
MOST_OPERATORS = 1024
"""Beyond `MOST` each operator has room for one stop of the whole fleet: it ends when that one is lifted, and not with
the stops of others. So many operators have it."""


class Stops:
    """All that is known of soft stops."""

    def __init__(self) -> None:
        self._stops: dict[str, SoftStop] = {}
        self._lifted: dict[str, Lifted] = {}
        self._whole: set[str] = set()
        """Stops that are lifted for all."""
        self._of: dict[str, set[str]] = {}
        """Stop -> robots that it is lifted for."""

    @property
    def stops(self) -> tuple[SoftStop, ...]:
        """Every stop that is remembered, by id."""
        return tuple(self._stops[each] for each in sorted(self._stops))

    @property
    def lifted(self) -> tuple[Lifted, ...]:
        """Every lifting that is remembered, by id."""
        return tuple(self._lifted[each] for each in sorted(self._lifted))

    @property
    def active(self) -> tuple[SoftStop, ...]:
        """The stops in force for some robot, those of the whole fleet first."""
        found = [each for each in self._stops.values() if self._in_force(each)]
        return tuple(sorted(found, key=lambda each: (bool(each.robots), each.id)))

    def room(self, stop: SoftStop) -> bool:
        """Whether a stop can be remembered, or is; what has no effect any more is forgotten for it."""
        most = MOST - RESERVE if stop.robots else MOST
        if not stop.robots and len(self._stops) >= MOST and self.whole_of(stop.by) is None:
            most += MOST_OPERATORS
        if stop.id not in self._stops and len(self._stops) >= most:
            self.forget(most - 1)
        return stop.id in self._stops or len(self._stops) < most

    def add(self, stop: SoftStop) -> bool:
        """Take a stop in; returns whether it was new. The first of an id stands."""
        if stop.id in self._stops:
            return False
        self._stops[stop.id] = stop
        return True

    def lift(self, lifted: Lifted) -> bool:
        """Take a lifting in; returns whether it was new. It counts for stops that are heard of later, too."""
        if lifted.id in self._lifted:
            return False
        self._lifted[lifted.id] = lifted
        for each in lifted.stops:
            if lifted.robots:
                self._of.setdefault(each, set()).update(lifted.robots)
            else:
                self._whole.add(each)
        if len(self._lifted) > MOST:
            self.forget()
        return True

    def merge(self, stops: Iterable[SoftStop], lifted: Iterable[Lifted]) -> bool:
        """Take in what another knows; returns whether anything was new."""
        new = [self.add(each) for each in stops]
        new += [self.lift(each) for each in lifted]
        return any(new)

    def of(self, robot: str) -> SoftStop | None:
        """The stop that holds a robot, one of the whole fleet before others; None when it may move."""
        return next((each for each in self.active if self.holds(each, robot)), None)

    def holds(self, stop: SoftStop, robot: str) -> bool:
        """Whether a stop is in force for a robot."""
        if stop.id not in self._stops or stop.id in self._whole or robot in self._of.get(stop.id, ()):
            return False
        return not stop.robots or robot in stop.robots

    def in_force(self, stop: str) -> bool:
        """Whether a stop is known, and in force for some robot."""
        return stop in self._stops and self._in_force(self._stops[stop])

    @property
    def whole(self) -> SoftStop | None:
        """A stop of the fleet that is lifted for no robot, or None."""
        return next((each for each in self.active if not each.robots and not self._of.get(each.id)), None)

    def whole_of(self, operator: str) -> SoftStop | None:
        """A stop of the fleet that this operator gave and that is lifted for no robot, or None."""
        found = (each for each in self.active if not each.robots and not self._of.get(each.id))
        return next((each for each in found if each.by == operator), None)

    def ended(self, stop: str, robots: Iterable[str]) -> bool:
        """Whether a stop is known to hold none of those robots any more; one never heard of is not known to."""
        if stop in self._whole:
            return True
        known = self._stops.get(stop)
        lifted_for = self._of.get(stop, set())
        names = list(robots)
        if known is None:
            return bool(names) and lifted_for.issuperset(names)
        return not any(self.holds(known, each) for each in names)

    def to_lift(self, robots: Iterable[str]) -> tuple[str, ...]:
        """Ids of the stops in force for some of these robots; of all when none is named."""
        names = tuple(robots)
        return tuple(each.id for each in self.active if not names or any(self.holds(each, robot) for robot in names))

    def forget(self, most: int = MOST) -> None:
        """Forget the oldest of what has no effect any more, until `most` stops and `MOST` liftings are left."""
        done = [each.id for each in self._stops.values() if not self._in_force(each)]
        for each in done[: max(0, len(self._stops) - most)]:
            del self._stops[each]
        for each in list(self._lifted)[: max(0, len(self._lifted) - MOST)]:
            gone = self._lifted.pop(each)
            for stop in gone.stops:
                if stop in self._stops and not self._in_force(self._stops[stop]):
                    # Kept without its lifting it would be in force again after a restart.
                    del self._stops[stop]
                if stop not in self._stops:
                    self._whole.discard(stop)
                    self._of.pop(stop, None)

    def _in_force(self, stop: SoftStop) -> bool:
        if stop.id in self._whole:
            return False
        return not stop.robots or not self._of.get(stop.id, set()).issuperset(stop.robots)


log = structlog.get_logger(__name__)

STORED = "authority/stops"
CONFIRM_S = 1.5
"""How long another gateway may take to confirm; one that is slower hears it by the put."""
AGAIN_S = (0.0, 0.5, 1.0)
"""The first pauses before robots are looked at that have not confirmed that they hold."""
EVERY_S = 1.0
"""The pauses after these, as long as the stop is in force: for robots and gateways that were away."""
_ABSENT = "it is not in the roster and could not be told; it will be if it comes while the stop is in force"
_REVOKED = (
    "its certificate is revoked, and it is still linked: it was told to hold and says that it does, which is not "
    "believed; look at it"
)
_AWAY = (
    "it is offline and could not be told; it will be when it is back while the stop is in force, and until then its "
    "own failsafe has it"
)


class Stopping:
    """The soft stops as this gateway knows them. `changed` is called when they are others."""

    def __init__(self, plane: Plane, *, changed: Callable[[], None]) -> None:
        self._plane = plane
        self._changed = changed
        self.stops = Stops()
        self._closers: list[Closer] = []
        self._tasks = Background()
        self._held: dict[str, set[str]] = {}
        """Stop that is pursued -> robots that have confirmed that they hold, and are here since."""
        self._writing = asyncio.Lock()

    async def start(self) -> None:
        """Take up what was kept, and listen."""
        for _, value in await self._plane.store.scan(STORED):
            try:
                kept = msgspec.json.decode(value, type=StandingAsk)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                log.warning("kept soft stops cannot be read; the others are asked", reason=str(error))
                continue
            self.stops.merge(kept.stops, kept.lifted)
        session = self._plane.session
        self._closers = [
            session.subscribe_typed(keyspace.STOP, self._on_stop),
            session.subscribe_typed(keyspace.LIFTED, self._on_lifted),
        ]
        for each in self.stops.active:
            self._pursue(each)

    async def close(self) -> None:
        """Listen no more."""
        for closer in self._closers:
            closer.close()
        await self._tasks.close()

    async def merge(self, stops: Iterable[SoftStop], lifted: Iterable[Lifted]) -> None:
        """Take in what another gateway knows; on disk when it returns. What there is no room for is counted.

        It is not in what this gateway answers then: who asked does not count it among those that have confirmed.
        """
        new: list[SoftStop] = []
        for each in stops:
            if not self.stops.room(each):
                self._plane.session.refuse("no room for a soft stop", stop=each.id, by=each.by)
            elif self.stops.add(each):
                new.append(each)
        gone = [self.stops.lift(each) for each in lifted]
        if new or any(gone):
            await self._keep()
            for each in new:
                self._pursue(each)
            self._changed()

    async def stop(self, ask: StopAsk) -> StopAnswer:
        """Answer `soft_stop`; RefusedError when as many stops are in force as are kept: its robots are told once."""
        stop = SoftStop(
            id=ask.act or f"o-{uuid.uuid4().hex[:16]}",
            robots=ask.robots,
            by=ask.by,
            why=ask.why,
            at_ns=time.time_ns(),
        )
        if not self.stops.room(stop):
            standing = self.stops.whole_of(stop.by) if not stop.robots else None
            if standing is None:
                await self._refuse(stop)
            stop = standing  # This operator has stopped the fleet already: its robots get that stop again.
        self.stops.add(stop)
        self._changed()
        self._plane.session.publish(keyspace.STOP, stop, stop.id)
        roster = self._plane.registry.robots
        names = [each for each, info in roster.items() if info.online and self.stops.holds(stop, each)]
        # A revoked robot counts as offline, and may be linked and moving all the same.
        revoked = self._revoked(stop)
        _, confirmed, told, (linked, _) = await asyncio.gather(
            self._keep(),
            self._confirm((stop,), ()),
            tell_to_hold(self._plane.session, names, act=stop.id),
            tell_to_hold(self._plane.session, revoked, act=stop.id),
        )
        held, problems = told
        problems |= {each: _ABSENT for each in stop.robots if each not in roster}
        away = [each for each, info in roster.items() if not info.online and self.stops.holds(stop, each)]
        problems |= dict.fromkeys(away, _AWAY)
        problems |= dict.fromkeys(linked, _REVOKED)
        log.warning("soft stop", by=stop.by, why=stop.why, robots=list(stop.robots) or "the fleet", held=list(held))
        self._pursue(stop, held)
        return StopAnswer(
            stops=self.stops.active, gateways=confirmed[0], silent=confirmed[1], robots=held, problems=problems
        )

    async def _refuse(self, stop: SoftStop) -> NoReturn:
        """Refuse a stop that there is no room for, after its robots were told to hold: they must not go on for that."""
        roster = self._plane.registry.robots
        names = [each for each in stop.robots or roster if each in roster and roster[each].online]
        held, _ = await tell_to_hold(self._plane.session, names, act=stop.id)
        self._plane.session.refuse("no room for a soft stop", stop=stop.id, by=stop.by)
        raise RefusedError(
            f"{len(self.stops.active)} soft stops are in force already, and this one is not kept: "
            + (
                f"{', '.join(held[:10])} held once, and may be moved again"
                if held
                else "no robot has said that it holds"
            ),
            remedy="`swiftbot stop` without a robot stops the fleet and is kept; `swiftbot resume` lifts stops",
        )

    async def resume(self, ask: ResumeRobotsAsk, learn: Callable[[], Awaitable[None]]) -> StopAnswer:
        """Answer `soft_resume`: only what was seen is lifted, by the operator, or here, after `learn` asked the others.

        Repeated under the same act it is done already, whatever was stopped meanwhile.
        """
        done = next((each for each in self.stops.lifted if ask.act and each.id == ask.act), None)
        if done is not None:
            confirmed, silent = await self._confirm((), (done,))
            return StopAnswer(stops=self.stops.active, gateways=confirmed, silent=silent)
        await learn()
        names = ask.stops or self.stops.to_lift(ask.robots)
        if not names:
            return StopAnswer(stops=self.stops.active, gateways=(self._plane.gateway,))
        lifted = Lifted(
            id=ask.act or f"o-{uuid.uuid4().hex[:16]}",
            stops=names,
            robots=ask.robots,
            by=ask.by,
            why=ask.why,
            at_ns=time.time_ns(),
        )
        self.stops.lift(lifted)
        await self._keep()
        self._plane.session.publish(keyspace.LIFTED, lifted, lifted.id)
        self._changed()
        log.warning("soft stop lifted", by=lifted.by, why=lifted.why, robots=list(lifted.robots) or "all that it held")
        confirmed, silent = await self._confirm((), (lifted,))
        return StopAnswer(stops=self.stops.active, gateways=confirmed, silent=silent)

    def _on_stop(self, key: str, stop: SoftStop | None) -> None:
        if stop is None or stop.id in {each.id for each in self.stops.stops}:
            return
        if not key.endswith(f"/{stop.id}"):
            self._plane.session.refuse("misplaced operator/stop/*", key=key, says=stop.id)
            return
        self._tasks.start(self.merge((stop,), ()), "soft stop")

    def _on_lifted(self, key: str, lifted: Lifted | None) -> None:
        if lifted is None:
            return
        if not key.endswith(f"/{lifted.id}"):
            self._plane.session.refuse("misplaced operator/resume/*", key=key, says=lifted.id)
            return
        self._tasks.start(self.merge((), (lifted,)), "soft stop")

    def _pursue(self, stop: SoftStop, held: Iterable[str] = ()) -> None:
        """Have the robots of a stop hold, once and for as long as it is in force."""
        if stop.id not in self._held:
            self._held[stop.id] = set()
            self._tasks.start(self._have_hold(stop), "soft stop")
            self._tasks.start(self._have_revoked_hold(stop), "soft stop of revoked robots")
        self._held[stop.id].update(held)

    def _revoked(self, stop: SoftStop) -> set[str]:
        """The robots of a stop whose certificate is revoked."""
        credentials = self._plane.session.credentials
        return {each for each in credentials.barred if self.stops.holds(stop, each)} if credentials else set()

    async def _have_revoked_hold(self, stop: SoftStop) -> None:
        """Tell the revoked robots that this gateway answers for, a few times; no other waits for their answers."""
        left = {each for each in self._revoked(stop) if self._mine(each, "")}
        for pause_s in AGAIN_S if left else ():
            await asyncio.sleep(pause_s)
            if not self.stops.in_force(stop.id):
                return
            linked, _ = await tell_to_hold(self._plane.session, left, act=stop.id)
            left.difference_update(linked)

    async def _have_hold(self, stop: SoftStop) -> None:
        """Tell the robots that this gateway answers for until each has said that it holds, and who comes back again."""
        held = self._held[stop.id]
        said: dict[str, str] = {}
        try:
            for pause_s in itertools.chain(AGAIN_S, itertools.repeat(EVERY_S)):
                await asyncio.sleep(pause_s)
                if not self.stops.in_force(stop.id):
                    return
                roster = self._plane.registry.robots
                mine = {
                    each
                    for each, info in roster.items()
                    if info.online and self._mine(each, info.gateway) and self.stops.holds(stop, each)
                }
                # One that was away, or with another gateway, may have been told to move there.
                held &= mine
                if left := mine - held:
                    done, problems = await tell_to_hold(self._plane.session, left, act=stop.id)
                    held.update(done)
                    for robot, problem in problems.items():
                        if said.get(robot) != problem:
                            log.warning("a robot does not confirm that it holds", robot=robot, reason=problem)
                    said = problems
        finally:
            del self._held[stop.id]

    def _mine(self, robot: str, gateway: str) -> bool:
        return gateway == self._plane.gateway or (not gateway and self._plane.dht.owns(f"robot/{robot}"))

    async def _confirm(
        self, stops: tuple[SoftStop, ...], lifted: tuple[Lifted, ...]
    ) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Have the other gateways keep something; those that have, and those that did not say so in time."""
        others = sorted(self._plane.members() - {self._plane.gateway})
        ask = StandingAsk(stops=stops, lifted=lifted)

        async def tell(member: str) -> bool:
            try:
                found = await self._plane.rpc.call(member, keyspace.STANDING, ask, timeout_s=CONFIRM_S)
            except SwiftbotError as error:
                log.warning("a gateway does not confirm a soft stop", member=member, reason=str(error))
                return False
            if missing := {each.id for each in stops} - {each.id for each in found.stops}:
                log.warning("a gateway has no room for a soft stop", member=member, stops=sorted(missing))
            return not missing

        said = dict(zip(others, await asyncio.gather(*(tell(each) for each in others)), strict=True))
        confirmed = tuple(sorted([self._plane.gateway, *(each for each, done in said.items() if done)]))
        return confirmed, tuple(each for each, done in said.items() if not done)

    async def _keep(self) -> None:
        async with self._writing:
            kept = StandingAsk(stops=self.stops.stops, lifted=self.stops.lifted)
            await self._plane.store.put(STORED, encode(kept))
