"""What planners are told for an instruction: robots by name, points by a word, only the robots it can mean. Pure.

Planners read names better than "the drone", "(26, 6)" or a roster of robots that nobody spoke of. The review goes by
the words as they were typed and by the whole roster, so that nothing is lost by it.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from appliance.llm.checks.places import coordinate
from appliance.llm.checks.reading import Reading, normalise, read
from appliance.llm.settings import PlanContext
from appliance.model import Plan, RobotInfo, Site

_NUMBER = r"[-−]?\d{1,4}(?:\.\d+)?"
_POINT = re.compile(
    rf"(?:\b(?:the\s+)?(?:coordinates?|coords|position|point|location|spot|grid(?:\s+point)?)\s*:?\s*)?"
    rf"(?:\(\s*{_NUMBER}\s*[,;]\s*{_NUMBER}(?:\s*[,;]\s*{_NUMBER})?\s*\)"
    rf"|\bx\s*=?\s*{_NUMBER}\s*m?\s*(?:,|;|and)?\s*y\s*=?\s*{_NUMBER}(?:\s*m\b)?"
    rf"|(?<![\w.,])(?<!\d ){_NUMBER}\s?,\s?{_NUMBER}"
    r"(?![\w.,]*\d)(?!\s*(?:m\b|m/s|metres?|meters?|seconds?|s\b|laps?|(?:,|and|&|or)\s*\d)))",
    re.IGNORECASE,
)
"""A pair of figures that can only be a point: in brackets, with axes, or two figures with nothing but a comma."""
_LISTED = re.compile(
    r"\b(?:waypoints?|docks?|goals?|aisles?|bays?|stations?|racks?|rovers?|drones?|robots?|rooms?|numbers?)\s*$",
    re.IGNORECASE,
)
"""What stands before figures that are numbers of places: "docks 1, 2"."""
_OTHERS = frozenset(("other", "others", "another", "rest", "remaining", "else", "second", "latter", "former", "last"))
"""Words for robots that are not named."""


class Told(Struct, frozen=True, kw_only=True):
    """An instruction as planners are given it."""

    instruction: str
    robots: tuple[RobotInfo, ...] | None
    points: dict[str, str] = field(default_factory=dict)
    """Word -> the point that it stands for, as a plan writes it."""

    def context(self, context: PlanContext) -> PlanContext:
        """Return what a planner is asked with."""
        site = context.site
        if site is not None and self.points:
            spots = {word: spot for word, point in self.points.items() if (spot := coordinate(point)) is not None}
            site = replace(site, places={**site.places, **spots})
        return replace(context, instruction=self.instruction, robots=self.robots, site=site)

    def restored(self, plan: Plan) -> Plan:
        """Return a planner's plan with the points that words stand for."""
        if not self.points:
            return plan
        subtasks = tuple(replace(each, params=self._params(each.params)) for each in plan.subtasks)
        return replace(plan, subtasks=subtasks)

    def _params(self, params: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._value(value) if isinstance(value, str) else value for name, value in params.items()}

    def _value(self, text: str) -> str:
        for word, point in self.points.items():
            if text.casefold() == word:
                return point
            # In a path, beside others.
            text = re.sub(rf"\b{word}\b", f"({point})", text, flags=re.IGNORECASE)
        return text


def told(context: PlanContext) -> Told:
    """Return what planners are told for an instruction."""
    found = read(context.instruction, context.robots)
    robots = _meant(found, context.robots)
    if normalise(context.instruction)[0] != context.instruction:
        return Told(instruction=context.instruction, robots=robots)
    text, points = _with_points(_with_names(context.instruction, found, context.robots), context.site)
    return Told(instruction=text, robots=robots, points=points)


def _with_names(text: str, found: Reading, robots: Sequence[RobotInfo] | None) -> str:
    """Return an instruction with names of robots for their kinds: "the drone" is drone_1, where there is one."""
    for token in reversed(found.tokens) if robots else ():
        said = ""
        if token.group == "one" and len(token.robots) == 1 and token.text != token.robots[0]:
            said = token.robots[0]
        elif token.group == "all" and len(token.robots) > 1 and any(each.isdigit() for each in token.text):
            said = f"{', '.join(token.robots[:-1])} and {token.robots[-1]}"
        if said:
            text = f"{text[: token.start]}{said}{text[token.end :]}"
    return text


def _with_points(text: str, site: Site | None) -> tuple[str, dict[str, str]]:
    """Return an instruction with words for its points, and what each stands for: words that name nothing else."""
    points: dict[str, str] = {}

    def word(match: re.Match[str]) -> str:
        figures = ", ".join(f"{float(each.replace('−', '-')):g}" for each in re.findall(_NUMBER, match.group()))
        if _LISTED.search(text[: match.start()]) or coordinate(figures) is None or _quoted(text, match.start()):
            return match.group()
        name = next((known for known, point in points.items() if point == figures), "")
        number = len(points) + 7
        while not name:
            known = site is not None and site.find(f"waypoint {number}") is not None
            name = "" if known or re.search(rf"waypoint {number}\b", text, re.IGNORECASE) else f"waypoint {number}"
            number += 1
        points[name] = figures
        return name

    return _POINT.sub(word, text), points


def _quoted(text: str, at: int) -> bool:
    return text[:at].count('"') % 2 == 1


def _meant(found: Reading, robots: tuple[RobotInfo, ...] | None) -> tuple[RobotInfo, ...] | None:
    """Return the robots that the words can mean: those they name; all where they name none, or speak of others."""
    if robots is None or any(each.text in _OTHERS for each in found.tokens):
        return robots
    meant = {name for each in found.tokens if each.kind == "robot" for name in each.robots}
    return tuple(each for each in robots if each.id in meant) if meant else robots
