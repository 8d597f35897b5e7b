"""The command that schedules an instruction with clock times, delays or repeats in it. Pure.

An instruction is carried out now; when it is to be carried out is an option of `swiftbot schedule add`. A sentence of a
known form is taken apart into both; of any other the command is named without its arguments.
"""

import re
import shlex
from collections.abc import Sequence

GENERIC = "`swiftbot schedule add --help`: submits it by interval, cron expression or at a time"
_NUMBERS = {
    "a": 1.0, "an": 1.0, "one": 1.0, "other": 2.0, "two": 2.0, "three": 3.0, "four": 4.0, "five": 5.0, "six": 6.0,
    "ten": 10.0, "fifteen": 15.0, "twenty": 20.0, "thirty": 30.0, "half": 0.5,
}  # fmt: skip
_SECONDS = {
    "s": 1,
    "sec": 1,
    "second": 1,
    "min": 60,
    "minute": 60,
    "h": 3600,
    "hour": 3600,
    "day": 86_400,
    "week": 604_800,
}
_DAYS = {
    "monday": "mon", "tuesday": "tue", "wednesday": "wed", "thursday": "thu", "friday": "fri", "saturday": "sat",
    "sunday": "sun", "day": "*", "night": "*", "morning": "*", "evening": "*", "afternoon": "*",
}  # fmt: skip
_EVERY = re.compile(r"(?:every|each)\s+(?:(\d+|[a-z]+)\s+)?(?:an?\s+)?([a-z]+)", re.IGNORECASE)
_IN = re.compile(r"(?:in|after)\s+(?:about\s+|around\s+)?(\d+|[a-z]+)\s+(?:an?\s+)?([a-z]+)", re.IGNORECASE)
_OF_DAY = re.compile(r"(\d{1,2})(?::(\d{2}))?\s*(am|pm|a\.m|p\.m|o'clock)?", re.IGNORECASE)
_LEAD = re.compile(r"(?:,?\s*\b(?:at|from|around|about|by))?\s*$", re.IGNORECASE)
_TAIL = re.compile(r"^\.?\s*(?:sharp|today)?\s*", re.IGNORECASE)


def command(text: str, spans: Sequence[tuple[int, int]]) -> str:
    """Return the command for an instruction, with what it does.

    Args:
        text: the instruction.
        spans: begin and end in it of each expression of a time, in order.
    """
    words = [text[begin:end] for begin, end in spans]
    option = _option(words)
    rest = _without(text, spans)
    if not option or not rest:
        return GENERIC
    return f"`swiftbot schedule add {shlex.quote(rest)} {option}` submits it then"


def _option(words: Sequence[str]) -> str:
    """Return the option for expressions of time; empty where they are of no known form."""
    every = next((found for each in words if (found := _EVERY.fullmatch(each.strip()))), None)
    of_day = next((found for each in words if (found := _OF_DAY.fullmatch(each.strip()))), None)
    delay = next((found for each in words if (found := _IN.fullmatch(each.strip()))), None)
    if len(words) != sum(each is not None for each in (every, of_day, delay)):
        return ""
    if delay is not None:
        alone = every is None and of_day is None
        return _duration("--in", delay.group(1), delay.group(2).casefold().removesuffix("s")) if alone else ""
    if every is not None:
        unit = every.group(2).casefold().removesuffix("s")
        if of_day is not None:
            return _daily(every.group(1), unit, of_day)
        return _duration("--every", every.group(1) or "1", unit)
    hour, minute = _hour(of_day) if of_day is not None else (24, 0)
    return f"--at {hour:02d}:{minute:02d}" if hour < 24 else ""


def _duration(option: str, number: str, unit: str) -> str:
    count = float(number) if number.isdecimal() and len(number) < 6 else _NUMBERS.get(number.casefold(), 0.0)
    seconds = count * _SECONDS.get(unit, 0)
    if not 10 <= seconds <= 366 * 86_400:
        return ""
    for name, size in (("d", 86_400), ("h", 3600), ("m", 60)):
        if seconds % size == 0:
            return f"{option} {seconds // size:.0f}{name}"
    return f"{option} {seconds:.0f}s"


def _daily(number: str | None, unit: str, of_day: "re.Match[str]") -> str:
    hour, minute = _hour(of_day)
    if number is not None or unit not in _DAYS or hour > 23:
        return ""
    return f'--cron "{minute} {hour} * * {_DAYS[unit]}"'


def _hour(of_day: "re.Match[str]") -> tuple[int, int]:
    """Return hour and minute; hour 24 where it is no time of day."""
    hour, minute = int(of_day.group(1)), int(of_day.group(2) or 0)
    half = (of_day.group(3) or "").casefold()
    if half[:1] in ("a", "p"):
        hour = hour % 12 + (12 if half[0] == "p" else 0) if 1 <= hour <= 12 else 24
    return (hour, minute) if minute < 60 else (24, 0)


def _without(text: str, spans: Sequence[tuple[int, int]]) -> str:
    """Return an instruction without its expressions of time."""
    rest = text
    for begin, end in reversed(spans):
        rest = f"{_LEAD.sub('', rest[:begin])} {_TAIL.sub('', rest[end:])}"
    return re.sub(r"\s+([,.;])", r"\1", re.sub(r"\s+", " ", rest)).strip(" ,;.")
