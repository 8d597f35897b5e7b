"""Soft stops by the names that people type: "Rover_1" and "rover 1" are `rover_1`; an unknown name stops none."""

import contextlib
import difflib
import re
from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import Struct

from appliance.errors import DeadlineError, UnreachableError
from appliance.llm.stop_words import stop_request
from appliance.model.steering import MAX_STOPPED, MAX_WHY
from appliance.robots.api import StopAnswer
from appliance.steering import SteeringCalls


class Named(Struct, frozen=True, kw_only=True):
    """What typed names mean."""

    robots: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    """Names that no robot has, as they were typed."""

    @property
    def fleet(self) -> bool:
        """Whether no robot is named, so that all are meant."""
        return not (self.robots or self.unknown)


def named(names: Sequence[str], roster: Sequence[str]) -> Named:
    """Return the robots that typed names mean: exact names, "Rover_1", "rover 1", "the drones", "all"."""
    if all(name in roster for name in names):
        return Named(robots=tuple(dict.fromkeys(names)))
    exact = [name for name in names if name in roster]
    # All words together: the shell splits "rover 1" and "rover_1 and drone_1".
    if (said := stop_request(f"stop {' '.join(names)}", roster)) is not None:
        typed = {_plain(name): name for name in names}
        both = (*said.robots, *exact) if said.robots or said.unknown else ()
        return Named(
            robots=tuple(dict.fromkeys(both)), unknown=tuple(typed.get(_plain(each), each) for each in said.unknown)
        )
    robots: list[str] = []
    unknown: list[str] = []
    for name in names:
        said = None if name in exact else stop_request(f"stop {name}", roster)
        if said is not None and not (said.robots or said.unknown):
            return Named()  # "all"
        found = [name] if name in exact else [each for each in roster if _plain(each) == _plain(name)]
        robots += found or (said.robots if said is not None else ())
        if not found and (said is None or said.unknown):
            unknown.append(name)
    return Named(robots=tuple(dict.fromkeys(robots)), unknown=tuple(dict.fromkeys(unknown)))


def unknown_text(name: str, roster: Sequence[str]) -> str:
    """Return what is said of a name that no robot has: first of all that nothing was stopped by it."""
    plain = {_plain(each): each for each in roster}
    near = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.5)
    known = f"; robots: {', '.join(sorted(roster)[:12])}{', …' if len(roster) > 12 else ''}" if roster else ""
    hint = f"; did you mean {plain[near[0]]}?" if near else known
    return f"NOT STOPPED: no robot {name[:60]!r}{hint}"


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.casefold())


class Stopped(Struct, frozen=True, kw_only=True):
    """What came of a stop by names."""

    robots: tuple[str, ...] = ()
    """The robots that were stopped; empty with an answer: all."""
    unknown: tuple[str, ...] = ()
    roster: tuple[str, ...] = ()
    answer: StopAnswer | None = None
    """None: no robot was named that the fleet has, and none was stopped."""

    @staticmethod
    async def carry_out(client: SteeringCalls, names: Sequence[str], *, why: str = "") -> "Stopped":
        """Stop the robots of these names, all when there are none.

        Where no gateway answers, the names are taken as they are: a stop is put all the same.

        Raises:
            UnreachableError, DeadlineError: no gateway confirms that it is kept.
        """
        meant, roster = Named(robots=tuple(names)), ()
        if names:
            with contextlib.suppress(UnreachableError, DeadlineError):
                await client.gateway()
                roster = roster_of(client)
                meant = named(names, roster)
        robots = meant.robots if len(meant.robots) <= MAX_STOPPED else ()
        answer = await client.stop(robots, why=why[:MAX_WHY]) if meant.robots or meant.fleet else None
        return Stopped(robots=robots, unknown=meant.unknown, roster=roster, answer=answer)

    @property
    def confirmed(self) -> bool:
        """Whether every robot that was meant is stopped and every gateway keeps it."""
        return not self.unknown and self.answer is not None and not (self.answer.silent or self.answer.problems)

    def as_json(self) -> dict[str, Any]:
        """Return what `--json` prints: the answer's fields, and the names that no robot has."""
        answer: dict[str, Any] = msgspec.to_builtins(self.answer or StopAnswer(stops=()))
        return {**answer, "unknown": list(self.unknown)}

    def text(self) -> str:
        """Return what is printed: what was not stopped or not confirmed first, in capitals."""
        lines = [unknown_text(name, self.roster) for name in self.unknown]
        if self.answer is not None:
            lines.append(answer_text(self.answer, stopping=True))
        elif self.unknown:
            lines.append("no robot was stopped")
        if self.unknown:
            lines.append("to stop all robots: swiftbot stop")
        return "\n".join(lines)


def answer_text(answer: StopAnswer, *, stopping: bool = False) -> str:
    """Return what came of a stop, or of lifting one, in lines.

    Args:
        answer: of the gateway.
        stopping: whether it was a stop, so that what is not confirmed comes first.
    """
    lines: list[str] = []
    if stopping and (answer.problems or answer.silent):
        lost = [*sorted(answer.problems), *(f"gateway {each}" for each in answer.silent)]
        lines.append(f"NOT CONFIRMED by {', '.join(lost)}: use the switch at a robot that moves")
    lines += [f"{', '.join(each.robots) or 'the fleet'}: {each.text}" for each in answer.stops] or [
        "nothing is stopped"
    ]
    if answer.robots:
        lines.append(f"hold: {', '.join(answer.robots)}")
    lines += [f"{robot} did not confirm: {reason}" for robot, reason in sorted(answer.problems.items())]
    lines.append(f"kept by {', '.join(answer.gateways)}")
    if answer.silent:
        lines.append(f"no word yet from {', '.join(answer.silent)}")
    return "\n".join(lines)


def roster_of(client: SteeringCalls) -> tuple[str, ...]:
    """Return the names of the robots that a connected client knows."""
    return tuple(sorted(client.plane.registry.robots))
