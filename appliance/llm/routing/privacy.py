"""What is never sent upstream: instructions by tag or pattern, and robots by the pattern of their ids. Pure."""

import re
from collections.abc import Sequence
from fnmatch import fnmatchcase

from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.llm.settings import PlanContext

_NAME = re.compile(r"[a-z0-9]+")


class Privacy:
    """Says what may leave this machine.

    Args:
        never: regular expressions; an instruction in which one is found stays here. Case does not matter.
        robots: shell patterns of robot ids: an instruction that names such a robot stays here, and none is told of it.
        tag: a word that keeps an instruction here; it is taken out before planning.

    Raises:
        ConfigError: an expression is none.
    """

    def __init__(self, *, never: Sequence[str], robots: Sequence[str], tag: str) -> None:
        try:
            self._never = [re.compile(each, re.IGNORECASE) for each in never]
        except re.error as error:
            raise ConfigError(
                f"llm.upstream_never: no regular expression: {error}", remedy="see Python's `re` for the form"
            ) from error
        self._robots = tuple(robots)
        self._tag = re.compile(rf"(?<!\S){re.escape(tag)}(?!\S)", re.IGNORECASE) if tag else None

    def marked(self, context: PlanContext) -> PlanContext:
        """Return the context with the tag taken out of its instruction, and private where it was there."""
        if self._tag is None or not self._tag.search(context.instruction):
            return context
        text = " ".join(self._tag.sub(" ", context.instruction).split())
        return replace(context, instruction=text, private=True)

    def withholds(self, context: PlanContext) -> str:
        """Return why an instruction must stay here, or ""."""
        if context.private:
            return "the instruction is private"
        for pattern in self._never:
            if pattern.search(context.instruction):
                return f"the instruction matches {pattern.pattern!r} (llm.upstream_never)"
        said = " ".join(_NAME.findall(context.instruction.casefold()))
        for robot in context.robots or ():
            if self._private(robot.id) and f" {' '.join(_NAME.findall(robot.id))} " in f" {said} ":
                return f"the instruction names {robot.id} (llm.upstream_never_robots)"
        return ""

    def trimmed(self, context: PlanContext) -> PlanContext:
        """Return the context without the robots that nobody elsewhere is told of."""
        if not self._robots or context.robots is None:
            return context
        return replace(context, robots=tuple(each for each in context.robots if not self._private(each.id)))

    def _private(self, robot: str) -> bool:
        return any(fnmatchcase(robot, pattern) for pattern in self._robots)
