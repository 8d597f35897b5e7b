"""Which robots are stopped: a set of soft stops and of liftings that any two gateways merge to the same. Pure.

An observed-remove set (Shapiro et al., "A comprehensive study of convergent and commutative replicated data types",
2011, section 3.3.5): a lifting names the stops that whoever lifted them had seen, so one that was given meanwhile
elsewhere, behind a partition too, stays in force. No clock has a part in it. What is forgotten of liftings, beyond
`MOST`, can only bring a stop back, never lose one.
"""

from collections.abc import Iterable

from appliance.model import Lifted, SoftStop

MOST = 1024
"""Stops and liftings that are remembered, each: years of use, and what a flood can cost."""
RESERVE = 64
"""Of these, only for stops of the whole fleet: however many robots are stopped one by one, it can still be stopped."""


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

    def covers(self, robots: Iterable[str]) -> bool:
        """Whether all of these are stopped already; none named: whether a stop of the whole fleet is untouched."""
        names = tuple(robots)
        if names:
            return all(self.of(each) is not None for each in names)
        return self.whole is not None

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
