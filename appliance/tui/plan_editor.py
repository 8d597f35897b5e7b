"""The plan editor's model: a plan laid out as lines, drafts of it under edit, and what an edit changed.

An operator changes robot, parameters and order of subtasks, or takes some out. Every edit makes a new draft, so undo is
the draft before. An edit that no gateway could accept (an unknown subtask, a cycle, an empty plan) is refused here at
once, in words; whether robots can do it is for the gateway's validator, which sees the whole edited plan before it
counts as checked. The difference is listed subtask by subtask and field by field, as text that an operator approves.

A line stands below those of what its subtask comes after, indented by the longest chain before it. A record may come
from a version or a robot that checks nothing, so cycles and unknown predecessors are laid out as well, and no walk
recurses. Pure: no Textual, no network.
"""

import re
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import Any

import msgspec
from msgspec import Struct, field
from msgspec.structs import replace
from rich.text import Text

from appliance.errors import PayloadError
from appliance.model import Plan, Subtask
from appliance.tui.safe import safe

DEEPEST = 8
"""Levels that are indented further; deeper ones would leave no room at 80 columns."""


def depths(subtasks: Iterable[Subtask]) -> dict[str, int]:
    """Return the length of the longest chain before each subtask; one in a cycle counts what was settled before it."""
    after = _known(subtasks)
    found: dict[str, int] = {}
    waiting = dict(after)
    while waiting:
        free = [each for each, before in waiting.items() if all(other in found for other in before)]
        # None is free: a cycle, which the validator refuses. Its first one is laid out all the same.
        for each in free or [next(iter(waiting))]:
            found[each] = max((found[other] + 1 for other in waiting[each] if other in found), default=0)
            del waiting[each]
    return found


def ordered(subtasks: Iterable[Subtask]) -> list[str]:
    """Return ids so that each stands below all it comes after, and right below the last of them."""
    after = _known(subtasks)
    missing = {each: len(before) for each, before in after.items()}
    children: dict[str, list[str]] = {}
    for each, before in after.items():
        for other in before:
            children.setdefault(other, []).append(each)
    out: dict[str, None] = {}
    waiting = [each for each, count in missing.items() if not count][::-1]
    while waiting:
        node = waiting.pop()
        out[node] = None
        for child in children.get(node, ())[::-1]:
            missing[child] -= 1
            if not missing[child]:
                waiting.append(child)
    return [*out, *(each for each in after if each not in out)]


def _known(subtasks: Iterable[Subtask]) -> dict[str, set[str]]:
    """Return id -> ids before it that are in the plan; the first of several subtasks with one id counts."""
    found: dict[str, tuple[str, ...]] = {}
    for each in subtasks:
        found.setdefault(each.id, each.after)
    return {each: {other for other in after if other in found and other != each} for each, after in found.items()}


def branch(depth: int) -> str:
    """Return the indentation of a subtask of that depth."""
    return f"{'   ' * (min(depth, DEEPEST) - 1)}└─▶ " if depth else ""


def cycle(subtasks: Iterable[Subtask]) -> tuple[str, ...]:
    """Return the ids that wait for each other in a circle, or for those; empty when there is none."""
    waiting = _known(subtasks)
    while free := {each for each, before in waiting.items() if not before}:
        waiting = {each: before - free for each, before in waiting.items() if each not in free}
    return tuple(waiting)


def at_once(plan: Plan) -> int:
    """Return how many subtasks may start at the beginning."""
    return sum(not depth for depth in depths(plan.subtasks).values())


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
        if circle := cycle(made.subtasks):
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
        if circle := cycle(made):
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


class ChangeKind(StrEnum):
    """What became of a subtask."""

    SAME = "same"
    CHANGED = "changed"
    REMOVED = "removed"
    ADDED = "added"


class Change(Struct, frozen=True, kw_only=True):
    """One subtask before and after; `fields` are its changes as (name, before, after)."""

    kind: ChangeKind
    id: str
    skill: str
    fields: tuple[tuple[str, str, str], ...] = ()


_SIGNS = {
    ChangeKind.SAME: (" ", "dim"),
    ChangeKind.CHANGED: ("~", "yellow"),
    ChangeKind.REMOVED: ("-", "red"),
    ChangeKind.ADDED: ("+", "green"),
}


def difference(before: Plan, after: Plan) -> tuple[Change, ...]:
    """Return what became of each subtask, in the order of the new plan, those taken out where they stood."""
    old = {each.id: each for each in before.subtasks}
    new = {each.id: each for each in after.subtasks}
    order = ordered(after.subtasks)
    for place, name in enumerate(ordered(before.subtasks)):
        if name not in new:
            order.insert(min(place, len(order)), name)
    return tuple(_change(old.get(name), new.get(name)) for name in order)


def _change(old: Subtask | None, new: Subtask | None) -> Change:
    if old is None or new is None:
        there = new or old
        assert there is not None  # noqa: S101 - a name comes from one of the two
        kind = ChangeKind.REMOVED if new is None else ChangeKind.ADDED
        return Change(kind=kind, id=there.id, skill=there.skill, fields=_fields(there) if new is not None else ())
    fields = tuple(
        (name, was, now)
        for name, was, now in (
            ("skill", old.skill, new.skill),
            ("robot", _robot(old), _robot(new)),
            ("parameters", params_text(old.params) or "none", params_text(new.params) or "none"),
            ("after", _after(old), _after(new)),
        )
        if was != now
    )
    return Change(kind=ChangeKind.CHANGED if fields else ChangeKind.SAME, id=new.id, skill=new.skill, fields=fields)


def _fields(subtask: Subtask) -> tuple[tuple[str, str, str], ...]:
    return (
        ("robot", "", _robot(subtask)),
        ("parameters", "", params_text(subtask.params) or "none"),
        ("after", "", _after(subtask)),
    )


def _robot(subtask: Subtask) -> str:
    return subtask.robot or "a gateway"


def _after(subtask: Subtask) -> str:
    return ", ".join(sorted(subtask.after)) or "nothing"


def difference_text(before: Plan, after: Plan) -> Text:
    """Return the difference for people: `~` changed, `-` taken out, `+` new, with each field before and after."""
    changes = difference(before, after)
    out = Text()
    for each in changes:
        sign, style = _SIGNS[each.kind]
        out.append(f"{sign} {safe(each.id, 40)} {safe(each.skill, 60)}", style)
        if each.kind is ChangeKind.REMOVED:
            out.append("  taken out", style)
        out.append("\n")
        for name, was, now in each.fields:
            out.append(f"    {name}: ", "dim")
            if was:
                out.append(safe(was, 200), "strike dim" if each.kind is ChangeKind.CHANGED else "")
                out.append(" → ")
            out.append(f"{safe(now, 200)}\n", style)
    if all(each.kind is ChangeKind.SAME for each in changes):
        out.append("nothing is changed\n", "dim")
    return out
