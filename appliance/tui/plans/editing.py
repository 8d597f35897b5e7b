"""The plan editor's model: an operator changes robot, parameters and order of subtasks, or takes some out.

Every edit makes a new draft, so undo is the draft before. An edit that no gateway could accept (an unknown subtask, a
circle, an empty plan) is refused here at once, in words; whether robots can do it is for the gateway's validator,
which sees the whole edited plan before it counts as checked.
"""

import re
from collections.abc import Sequence
from typing import Any

import msgspec
from msgspec import Struct, field
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.model import Plan, Subtask
from appliance.tui.plans import shape

MOST_UNDO = 100
MOST_PARAMS = 32
MOST_VALUE = 2000
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]{0,62}")
_NO_ROBOT = ("", "-", "–", "none", "gateway")


class Draft(Struct, frozen=True, kw_only=True):
    """A plan while it is edited. `proposed` stays what was proposed; `before` are the drafts that undo goes back to."""

    proposed: Plan
    subtasks: tuple[Subtask, ...]
    before: tuple[tuple[Subtask, ...], ...] = field(default=())

    @classmethod
    def of(cls, plan: Plan) -> "Draft":
        """Begin to edit a plan."""
        return cls(proposed=plan, subtasks=plan.subtasks)

    @property
    def plan(self) -> Plan:
        """The plan as edited."""
        return replace(self.proposed, subtasks=self.subtasks)

    @property
    def changed(self) -> bool:
        """Whether it differs from what was proposed."""
        return self.subtasks != self.proposed.subtasks

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of its subtasks."""
        return tuple(each.id for each in self.subtasks)

    def of_id(self, subtask: str) -> Subtask:
        """Return a subtask; PayloadError when there is none of that id."""
        for each in self.subtasks:
            if each.id == subtask:
                return each
        raise PayloadError(f"the plan has no subtask {subtask[:60]!r}", remedy=f"it has {', '.join(self.ids)}")

    # --- edits ------------------------------------------------------------------------------------------------

    def with_robot(self, subtask: str, robot: str) -> "Draft":
        """Have another robot do a subtask; `-`, `none` or `gateway`: it is computed on a gateway.

        Raises:
            PayloadError: the name is none.
        """
        name = robot.strip().lower()
        if name in _NO_ROBOT:
            return self._put(replace(self.of_id(subtask), robot=None))
        if not re.fullmatch(r"[a-z0-9][a-z0-9_.-]{0,62}", name):
            raise PayloadError(
                f"{robot[:60]!r} is no robot's name", remedy="a name of the roster, any, any1, all, or - for a gateway"
            )
        return self._put(replace(self.of_id(subtask), robot=name))

    def with_params(self, subtask: str, text: str) -> "Draft":
        """Give a subtask the parameters that a text names, and no others: see `params_of`."""
        return self._put(replace(self.of_id(subtask), params=params_of(text)))

    def with_after(self, subtask: str, others: Sequence[str]) -> "Draft":
        """Have a subtask begin after others.

        Raises:
            PayloadError: one of them is not in the plan, or they would wait for each other in a circle.
        """
        target = self.of_id(subtask)
        for other in others:
            if other == subtask:
                raise PayloadError(f"{subtask} cannot come after itself", remedy="name others")
            self.of_id(other)
        made = self._put(replace(target, after=tuple(dict.fromkeys(others))))
        if circle := shape.cycle(made.subtasks):
            raise PayloadError(
                f"{', '.join(circle)} would wait for each other in a circle",
                remedy=f"take {subtask} out of what comes before {' or '.join(others)} first",
            )
        return made

    def without(self, subtask: str) -> "Draft":
        """Take a subtask out; those after it come after what it came after, so the order of the rest stays.

        Raises:
            PayloadError: it is the only one.
        """
        gone = self.of_id(subtask)
        if len(self.subtasks) == 1:
            raise PayloadError("it is the only subtask of the plan", remedy="reject the plan instead")
        kept = tuple(
            replace(
                each,
                after=tuple(
                    dict.fromkeys(
                        other for name in each.after for other in (gone.after if name == subtask else (name,))
                    )
                ),
            )
            if subtask in each.after
            else each
            for each in self.subtasks
            if each.id != subtask
        )
        return self._to(kept)

    def moved(self, subtask: str, by: int) -> "Draft":
        """Move a subtask in the chain of the lines: up (-1) before what stands above it, down (1) after what is below.

        Only two neighbours that depend on each other change places: what came before the first comes before the second
        then, and what came after the second after the first.

        Raises:
            PayloadError: there is nothing to change places with.
        """
        target = self.of_id(subtask)
        if by < 0:
            if len(target.after) != 1:
                raise PayloadError(
                    f"{subtask} comes after {len(target.after)} subtasks", remedy="write what it comes after instead"
                )
            return self._swapped(self.of_id(target.after[0]), target)
        following = [each for each in self.subtasks if subtask in each.after]
        if len(following) != 1 or len(following[0].after) != 1:
            raise PayloadError(
                f"not exactly one subtask follows {subtask} alone", remedy="write what it comes after instead"
            )
        return self._swapped(target, following[0])

    def _swapped(self, first: Subtask, second: Subtask) -> "Draft":
        """Have `second`, which comes right after `first`, come before it."""
        made: list[Subtask] = []
        for each in self.subtasks:
            if each.id == first.id:
                made.append(replace(each, after=(second.id,)))
            elif each.id == second.id:
                made.append(replace(each, after=first.after))
            elif second.id in each.after:
                made.append(
                    replace(each, after=tuple(first.id if other == second.id else other for other in each.after))
                )
            else:
                made.append(each)
        if circle := shape.cycle(made):
            raise PayloadError(
                f"{', '.join(circle)} would wait for each other in a circle",
                remedy="write what each comes after instead",
            )
        return self._to(tuple(made))

    def undone(self) -> "Draft":
        """Go back one edit; the same draft when there was none."""
        if not self.before:
            return self
        return replace(self, subtasks=self.before[-1], before=self.before[:-1])

    def reset(self) -> "Draft":
        """Go back to what was proposed; undo brings the edits back."""
        return self._to(self.proposed.subtasks)

    def _put(self, changed: Subtask) -> "Draft":
        return self._to(tuple(changed if each.id == changed.id else each for each in self.subtasks))

    def _to(self, subtasks: tuple[Subtask, ...]) -> "Draft":
        if subtasks == self.subtasks:
            return self
        return replace(self, subtasks=subtasks, before=(*self.before, self.subtasks)[-MOST_UNDO:])


# --- parameters as text ----------------------------------------------------------------------------------------


def params_text(params: dict[str, Any]) -> str:
    """Return parameters as `params_of` reads them: `name=value`, quoted where that is needed."""
    return " ".join(f"{name}={_value_text(value)}" for name, value in params.items())


def _value_text(value: Any) -> str:
    if isinstance(value, str) and value and not re.search(r"[\s\"'{}\[\],=\\]", value) and _value(value) == value:
        return value
    return msgspec.json.encode(value).decode()


def params_of(text: str) -> dict[str, Any]:
    """Read parameters: `name=value` with spaces between; a value is JSON, or a text without spaces.

    Raises:
        PayloadError: it is not read as such, with the place.
    """
    found: dict[str, Any] = {}
    at = 0
    while at < len(text):
        if text[at].isspace():
            at += 1
            continue
        name, equals, _ = text[at:].partition("=")
        if not equals or not _NAME.fullmatch(name):
            raise PayloadError(
                f"at {text[at : at + 20]!r} a parameter was expected", remedy='write name=value, or name="two words"'
            )
        if name in found:
            raise PayloadError(f"parameter {name} is given twice", remedy="give it once")
        if len(found) >= MOST_PARAMS:
            raise PayloadError(f"more than {MOST_PARAMS} parameters", remedy="give fewer")
        at += len(name) + 1
        end = _end_of_value(text, at)
        if end - at > MOST_VALUE:
            raise PayloadError(f"parameter {name} has {end - at} characters", remedy=f"give at most {MOST_VALUE}")
        found[name] = _value(text[at:end])
        at = end
    return found


def _end_of_value(text: str, at: int) -> int:
    """Where a value that begins at `at` ends: at a space outside of quotes and brackets."""
    depth = 0
    quoted = False
    while at < len(text):
        each = text[at]
        if quoted:
            at += each == "\\"
            quoted = each != '"'
        elif each == '"':
            quoted = True
        elif each in "[{":
            depth += 1
        elif each in "]}":
            depth -= 1
        elif each.isspace() and depth <= 0:
            break
        at += 1
    return min(at, len(text))


def _value(text: str) -> Any:
    """Read a value: JSON if it is, else a text, with `true`, numbers and the like by their JSON meaning."""
    try:
        return msgspec.json.decode(text.encode())
    except msgspec.DecodeError as error:
        if text[:1] in '"[{':
            raise PayloadError(
                f"{text[:40]!r} is not finished: {error}", remedy="close the quote or bracket"
            ) from error
        return text
