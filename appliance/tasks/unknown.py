"""What of a task record is kept though it is not understood: fields that only a newer version of the appliance knows.

A gateway that coordinates a task writes its record again and again. In a fleet that is being upgraded it may be one of
an older version; what a newer one has put into the record, or into anything in it, is still there when that one takes
over. Pure.
"""

from functools import cache
from typing import Any, NamedTuple, cast

import msgspec
from msgspec import Struct, field, inspect

from appliance.model import TaskRecord, encode


class Unknown(Struct):
    """The unknown fields of a struct, and of those in it."""

    fields: dict[str, Any] = field(default_factory=dict[str, Any])
    inside: dict[str, "Unknown"] = field(default_factory=dict[str, "Unknown"])
    """By the known field whose struct they are in."""
    items: dict[str, dict[str, "Unknown"]] = field(default_factory=dict[str, dict[str, "Unknown"]])
    """By the known field, and by which of its structs they are in."""

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self.fields or self.inside or self.items)


class _Shape(NamedTuple):
    """What is known of a kind of struct."""

    names: frozenset[str]
    one: dict[str, type[Struct]]
    """Fields that are a struct, or None."""
    many: dict[str, type[Struct]]
    """Fields that are a row of structs."""


@cache
def _shape(kind: type[Struct]) -> _Shape:
    info = cast("inspect.StructType", inspect.type_info(kind))
    one: dict[str, type[Struct]] = {}
    many: dict[str, type[Struct]] = {}
    for each in info.fields:
        types = each.type.types if isinstance(each.type, inspect.UnionType) else (each.type,)
        for part in types:
            if isinstance(part, inspect.StructType):
                one[each.encode_name] = part.cls
            elif isinstance(part, inspect.ListType | inspect.VarTupleType) and isinstance(
                part.item_type, inspect.StructType
            ):
                many[each.encode_name] = part.item_type.cls
    return _Shape(frozenset(each.encode_name for each in info.fields), one, many)


def unknown(value: bytes) -> Unknown:
    """Return the fields of a stored record that this version does not know; none for one that cannot be read."""
    try:
        raw = msgspec.json.decode(value)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return Unknown()
    return _find(cast("dict[str, Any]", raw), TaskRecord) if isinstance(raw, dict) else Unknown()


def _find(table: dict[str, Any], kind: type[Struct]) -> Unknown:
    shape = _shape(kind)
    found = Unknown({name: value for name, value in table.items() if name not in shape.names})
    for name, of in shape.one.items():
        value = table.get(name)
        if isinstance(value, dict) and (more := _find(cast("dict[str, Any]", value), of)):
            found.inside[name] = more
    for name, of in shape.many.items():
        value = table.get(name)
        for item in cast("list[Any]", value) if isinstance(value, list) else []:
            if isinstance(item, dict) and (more := _find(cast("dict[str, Any]", item), of)):
                found.items.setdefault(name, {})[_which(cast("dict[str, Any]", item), of)] = more
    return found


def _which(table: dict[str, Any], kind: type[Struct]) -> str:
    """What tells one struct of a row from the others, while it changes: its id or number; else what is known of it."""
    for name in ("id", "number", "subtask"):
        value = table.get(name) if name in _shape(kind).names else None
        if name == "subtask":  # a subtask's record has its subtask; elsewhere it is a name, and not the only one of it
            value = cast("dict[str, Any]", value).get("id") if isinstance(value, dict) else None
        if isinstance(value, str | int):
            return f"{name} {value}"
    try:
        return encode(msgspec.convert(table, kind)).decode()
    except msgspec.ValidationError:
        return ""


def with_unknown(record: TaskRecord, kept: Unknown) -> bytes:
    """Encode a record with those fields as they were; what is gone takes its own along."""
    if not kept:
        return encode(record)
    table: dict[str, Any] = msgspec.to_builtins(record)
    _put(table, TaskRecord, kept)
    return encode(table)


def _put(table: dict[str, Any], kind: type[Struct], kept: Unknown) -> None:
    shape = _shape(kind)
    for name, more in kept.inside.items():
        if isinstance(table.get(name), dict):
            _put(table[name], shape.one[name], more)
    for name, rows in kept.items.items():
        for item in cast("list[dict[str, Any]]", table.get(name, [])):
            if (more := rows.get(_which(item, shape.many[name]))) is not None:
                _put(item, shape.many[name], more)
    table |= kept.fields
