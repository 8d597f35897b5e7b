"""Instructions with parameters: `{name}`, or `{name=default}`, in their text. Pure."""

import re
from collections.abc import Mapping, Sequence

from msgspec import Struct

from appliance.errors import PayloadError
from appliance.model.schedules import MAX_INSTRUCTION

MAX_VALUE = 200
MOST_PARAMETERS = 16
_PARAMETER = re.compile(r"\{([a-z][a-z0-9_]{0,31})(?:=([^{}]*))?\}")


class Parameter(Struct, frozen=True):
    """A parameter of a saved instruction."""

    name: str
    default: str | None = None
    """None: it has to be given."""


def parameters(text: str) -> tuple[Parameter, ...]:
    """Return the parameters of a text, each once, in the order in which they stand there.

    Raises:
        PayloadError: a brace that begins or ends no parameter, or two defaults for one.
    """
    found: dict[str, Parameter] = {}
    for match in _PARAMETER.finditer(text):
        name, default = match.group(1), match.group(2)
        known = found.get(name)
        if known is not None and default is not None and known.default not in (None, default):
            raise PayloadError(f"parameter {name} has two defaults", remedy="give one of them")
        if known is None or known.default is None:
            found[name] = Parameter(name, default)
    rest = _PARAMETER.sub("", text)
    if (brace := next((each for each in rest if each in "{}"), "")) != "":
        at = rest.index(brace)
        raise PayloadError(
            f"{brace!r} near {rest[max(0, at - 10) : at + 20]!r} is no parameter",
            remedy="write parameters like {place} or {place=dock 1}: a-z, 0-9, _",
        )
    if len(found) > MOST_PARAMETERS:
        raise PayloadError(
            f"{len(found)} parameters, at most {MOST_PARAMETERS} are possible", remedy="save two instructions"
        )
    return tuple(found.values())


def filled(text: str, values: Mapping[str, str]) -> str:
    """Return a text with values in the place of its parameters.

    Raises:
        PayloadError: one is missing, empty, too long, or the text has none of that name.
    """
    known = {each.name: each for each in parameters(text)}
    usage = ", ".join(f"{each.name}=…" for each in known.values()) or "none"
    if unknown := sorted(set(values) - set(known)):
        raise PayloadError(f"no parameter {unknown[0][:40]!r}", remedy=f"parameters: {usage}")
    missing = [each.name for each in known.values() if each.default is None and each.name not in values]
    if missing:
        raise PayloadError(
            f"no value for {', '.join(missing)}", remedy=f"give {' '.join(f'{name}=…' for name in missing)}"
        )
    for name, value in values.items():
        if not value.strip() or len(value) > MAX_VALUE or any(each in value for each in "{}\n\r"):
            raise PayloadError(
                f"the value of {name} is no text of a line, 1 to {MAX_VALUE} characters without braces",
                remedy="give a place, a robot, a thing or a number",
            )
    # Plain replacement: what stands in a value is text, whatever it looks like.
    result = _PARAMETER.sub(lambda match: values.get(match.group(1), known[match.group(1)].default or ""), text)
    if not result.strip() or len(result) > MAX_INSTRUCTION:
        raise PayloadError(f"the instruction would have {len(result):,} characters", remedy="give shorter values")
    return result


def read_values(words: Sequence[str]) -> dict[str, str]:
    """Return the values of `name=value` words; PayloadError for a word that is none, or a name given twice."""
    values: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals or name in values:
            what = "given twice" if equals else "no name=value"
            raise PayloadError(f"{word[:60]!r} is {what}", remedy='write it like place="dock 2"')
        values[name] = value
    return values
