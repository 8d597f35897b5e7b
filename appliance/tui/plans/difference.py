"""What an edit changed about a plan, subtask by subtask and field by field, as text that an operator approves."""

from enum import StrEnum

from msgspec import Struct
from rich.text import Text

from appliance.model import Plan, Subtask
from appliance.tui.plans import shape
from appliance.tui.plans.editing import params_text
from appliance.tui.safe import safe


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
    order = shape.ordered(after.subtasks)
    for place, name in enumerate(shape.ordered(before.subtasks)):
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
