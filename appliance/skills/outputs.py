"""Whether a run's result holds what its skill's manifest promises. Pure.

Later subtasks, conditions and reports read results by name; one that lacks a value, or has another type, would fail
there, far from the handler that left it out.
"""

from collections.abc import Mapping
from typing import Any

from appliance.skills.catalogue import Output, SkillManifest

_NAMES = {
    "string": "a text",
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "array": "a list",
    "object": "a table",
    "any": "a value",
}
SHOWN = 40
"""Characters of a value that a message shows."""


def broken_promises(manifest: SkillManifest, result: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what of a result is not as the manifest says, each with output, expected and got; empty when all is.

    Args:
        manifest: of the skill that ran.
        result: what its handler returned, decoded from JSON.
    """
    return tuple(
        text for name, output in manifest.outputs.items() if (text := _problem(name, output, result.get(name), result))
    )


def _problem(name: str, output: Output, value: Any, result: Mapping[str, Any]) -> str:
    expected = _NAMES[output.type]
    if value is None:
        if not output.required:
            return ""
        got = "null" if name in result else f"a result with {_listed(result)}"
        return f"output {name!r} is missing: expected {expected}, got {got}"
    if _fits(output.type, value):
        return ""
    return f"output {name!r} has the wrong type: expected {expected}, got {_shown(value)}"


def _fits(kind: str, value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    match kind:
        case "string":
            return isinstance(value, str)
        case "number":
            return number
        case "integer":
            return number and (isinstance(value, int) or value.is_integer())
        case "boolean":
            return isinstance(value, bool)
        case "array":
            return isinstance(value, list | tuple)
        case "object":
            return isinstance(value, Mapping)
        case _:
            return True


def _listed(result: Mapping[str, Any]) -> str:
    names = [repr(name[:SHOWN]) for name in list(result)[:8]]
    return f"{', '.join(names)}{' and more' if len(result) > 8 else ''}" if names else "nothing in it"


def _shown(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return f"the text {value[:SHOWN]!r}"
        case int() | float():
            return f"the number {value:g}" if -1e15 < value < 1e15 else "a number"
        case list() | tuple():
            return f"a list of {len(value)}"  # pyright: ignore[reportUnknownArgumentType]
        case Mapping():
            return "a table"
        case _:
            return f"a {type(value).__name__}"
