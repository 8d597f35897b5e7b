"""Quantities said beside the verb: how long, how fast, how often. Taken out of a clause before it is matched.

"Film it for two minutes" and "for two minutes, film it" then need one pattern of the grammar and not four.
"""

import re
from typing import Any

from msgspec import Struct, field

from appliance.llm.rules import lexicon as lx

_N = lx.NUMBER
_T = lx.TIME_UNIT
_L = lx.LENGTH_UNIT


class Modifiers(Struct):
    """What was said of quantity; a skill takes what it has parameters for, the rest counts as not understood."""

    values: dict[str, Any] = field(default_factory=dict[str, Any])
    times: int = 0
    """Twice: 2; not said: 0."""
    words: dict[str, int] = field(default_factory=dict[str, int])
    """Key -> how many words said it."""


def _rule(pattern: str) -> re.Pattern[str]:
    return re.compile(pattern, re.IGNORECASE)


_WINDOW = (
    _rule(
        rf",?\s*\b(?:with|using|over|in)?\s*\b(?:an? |the )?(?:time )?window (?:length )?(?:of "
        rf")?(?P<n>{_N}) ?(?P<u>ms|milliseconds?|seconds?|s)\b"
    ),
    _rule(rf"\b(?:with|using|over|in) an? (?P<n>{_N})[ -]?(?P<u>ms|millisecond|second|s)\b window"),
)
_TIMEOUT = (
    _rule(rf",?\s*\b(?:for )?(?:at most|up to|no longer than|no more than|a maximum of) (?P<n>{_N})[ -]?(?P<u>{_T})"),
    _rule(rf",?\s*(?:for )?(?P<n>{_N})[ -]?(?P<u>{_T}) at (?:the )?most\b"),
)
_DURATION = (
    _rule(rf",?\s*\bfor (?:about |around |exactly |another |the next )?(?P<n>{_N})[ -]?(?P<u>{_T})"),
    _rule(r"\b(?P<n>\d+)[ -](?P<u>second|minute|hour)\b"),
)
_SPEED = (_rule(rf",?\s*\bat (?:a speed of )?(?P<n>{_N}) ?(?P<u>{lx.SPEED_UNIT})(?!\w)"),)
_FPS = (_rule(rf",?\s*\bat (?P<n>{_N}) ?(?:fps|frames (?:per|a) second)\b"),)
_RADIUS = (
    _rule(rf",?\s*\b(?:at|with|in) an? radius of (?P<n>{_N}) ?(?P<u>{_L})"),
    _rule(rf",?\s*\b(?:at|with|in) an? (?P<n>{_N})[ -]?(?P<u>{_L})[ -]radius\b"),
    _rule(rf",?\s*\b(?:with )?radius (?P<n>{_N}) ?(?P<u>{_L})"),
)
_EPOCHS = (_rule(rf",?\s*\b(?:for )?(?P<n>{_N}) (?:local )?epochs?\b"),)
_LAPS = (_rule(rf"\b(?P<n>{_N}) (?:full |complete )?(?:laps?|rounds?|circuits?|loops?|orbits?)\b"),)
_TIMES = (
    _rule(rf",?\s*\b(?P<n>{_N}) times\b"),
    _rule(r",?\s*\b(?P<n>twice|thrice)\b(?! as)"),
    _rule(r"(?<=\w)\s+(?P<n>once)$"),
)


def take(text: str, *, altitude: bool) -> tuple[str, Modifiers]:
    """Return the clause without its quantities, and the quantities.

    Args:
        text: one clause.
        altitude: whether lengths are altitudes (the clause takes off).
    """
    found = Modifiers()

    def use(key: str, patterns: tuple[re.Pattern[str], ...], convert: Any) -> None:
        nonlocal text
        for pattern in patterns:
            match = pattern.search(text)
            if match is None:
                continue
            groups = match.groupdict()
            value = convert(groups["n"], groups.get("u") or "")
            if value is None:
                continue
            found.values[key] = value
            found.words[key] = len(match[0].split())
            text = text[: match.start()] + " " + text[match.end() :]
            return

    use("window_ms", _WINDOW, _milliseconds)
    use("timeout_s", _TIMEOUT, lx.seconds)
    use("duration_s", _DURATION, lx.seconds)
    use("speed_mps", _SPEED, lx.speed)
    use("fps", _FPS, _count)
    use("radius_m", _RADIUS, lx.metres)
    use("epochs", _EPOCHS, _count)
    if altitude:
        use(
            "altitude_m",
            (
                _rule(
                    rf",?\s*\b(?:to|at|up to) (?:an? )?(?:altitude |height )?(?:of )?(?P<n>{_N}) ?(?P<u>{_L})"
                    rf"(?: altitude| high)?"
                ),
            ),
            lx.metres,
        )
    use("laps", _LAPS, _count)
    use("times", _TIMES, _count)
    found.times = int(found.values.pop("times", 0))
    return " ".join(text.split()), found


def _milliseconds(amount: str, unit: str) -> int | float | None:
    value = lx.number(amount)
    return None if value is None else lx.plain(value * (1.0 if unit.lower().startswith("m") else 1000.0))


def _count(amount: str, unit: str) -> int | float | None:
    del unit
    value = lx.number(amount)
    return None if value is None else lx.plain(value)
