"""Soft stops by the names that people type: "Rover_1" and "rover 1" are `rover_1`; an unknown name stops none."""

import difflib
import re
from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import Struct

from appliance.robots.authority.api import StopAnswer
from appliance.steering import SteeringCalls


def robot_named(name: str, roster: Sequence[str]) -> str | None:
    """Return the robot that a typed name means; None when none or several do."""
    if name in roster:
        return name
    plain = _plain(name)
    found = [each for each in roster if _plain(each) == plain]
    return found[0] if len(found) == 1 else None


def unknown_text(name: str, roster: Sequence[str]) -> str:
    """Return what is said of a name that no robot has: first of all that nothing was stopped by it."""
    near = difflib.get_close_matches(_plain(name), [_plain(each) for each in roster], n=1, cutoff=0.5)
    like = next((each for each in roster if near and _plain(each) == near[0]), "")
    hint = (
        f"did you mean {like}? swiftbot stop {like}" if like else f"known: {', '.join(sorted(roster)[:12]) or 'none'}"
    )
    return f"NOT STOPPED: no robot {name!r}; {hint}; to stop all: swiftbot stop"


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


class Stopped(Struct, frozen=True, kw_only=True):
    """What came of a stop by names."""

    robots: tuple[str, ...] = ()
    """The robots that were stopped; empty with an answer: all."""
    unknown: tuple[str, ...] = ()
    roster: tuple[str, ...] = ()
    answer: StopAnswer | None = None
    """None: no robot was named that is there."""

    @staticmethod
    async def carry_out(client: SteeringCalls, names: Sequence[str], *, why: str = "") -> "Stopped":
        """Stop the robots of these names, all when there are none.

        A fleet whose roster is not known yet takes the names as they are: a stop must not wait for it.

        Raises:
            UnreachableError, DeadlineError: no gateway confirms that it is kept.
        """
        roster: tuple[str, ...] = ()
        if names:
            await client.gateway()
            roster = tuple(sorted(client.plane.registry.robots))
        meant = {name: robot_named(name, roster) if roster else name for name in names}
        robots = tuple(dict.fromkeys(robot for robot in meant.values() if robot is not None))
        unknown = tuple(name for name, robot in meant.items() if robot is None)
        answer = await client.stop(robots, why=why) if robots or not names else None
        return Stopped(robots=robots, unknown=unknown, roster=roster, answer=answer)

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` prints: the answer's fields, and the names that no robot has."""
        answer: dict[str, Any] = msgspec.to_builtins(self.answer) if self.answer is not None else {}
        return {**answer, "unknown": list(self.unknown)}
