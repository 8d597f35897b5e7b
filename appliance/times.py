"""Moments and durations as people write them on a command line. Pure."""

import re
from datetime import UTC, datetime, time, timedelta, tzinfo

from appliance.errors import ConfigError

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_DURATION = re.compile(r"(?:\d+(?:\.\d+)?[smhdw])+|\d+(?:\.\d+)?")
_PART = re.compile(r"(\d+(?:\.\d+)?)([smhdw])")
LONGEST_S = 1e9
"""Some thirty years."""


def duration_s(text: str) -> float | None:
    """Return the seconds of `90`, `90s`, `5m`, `1h30m`, `2d`, `1w`; None where it is no duration."""
    text = text.strip().casefold()
    if not _DURATION.fullmatch(text):
        return None
    parts = _PART.findall(text)
    seconds = sum(float(number) * _UNITS[unit] for number, unit in parts) if parts else float(text)
    return seconds if seconds < LONGEST_S else None


def moment_ns(text: str, *, now: datetime, option: str, zone: tzinfo | None = None, ahead: bool = False) -> int:
    """Return a moment, Unix nanoseconds: `2026-11-27`, `2026-11-27T07:30`, with or without offset, or `07:30`.

    Args:
        text: as typed; without an offset it is in `zone`. A time of day alone is today's, with `ahead` the next one.
        now: the present, with its zone.
        option: what is named in an error.
        zone: None: that of `now`.
        ahead: whether it is a moment to come.

    Raises:
        ConfigError: it is none, or there is none of that name on that day (clocks are put forward).
    """
    place = zone or now.tzinfo or UTC
    text = text.strip()
    try:
        if re.fullmatch(r"\d{1,2}:\d{2}(:\d{2})?", text):
            of_day = time.fromisoformat(text.zfill(len(text) + (text.index(":") == 1)))
            day = now.astimezone(place).date()
            found = datetime.combine(day, of_day, place)
            if ahead and found <= now:
                found = datetime.combine(day + timedelta(days=1), of_day, place)
        else:
            found = datetime.fromisoformat(text)
            found = found if found.tzinfo is not None else found.replace(tzinfo=place)
        exists = found.astimezone(UTC).astimezone(found.tzinfo).replace(fold=0) == found.replace(fold=0)
        stamp = found.timestamp()
    except (ValueError, OverflowError) as error:
        raise ConfigError(
            f"{option} {text[:60]!r} is no time", remedy="write it like 07:30, 2026-11-27 or 2026-11-27T07:30+01:00"
        ) from error
    if not exists:
        raise ConfigError(f"{option}: there is no {text[:60]} in {place} on that day", remedy="choose another time")
    return int(stamp) * 10**9 + found.microsecond * 1000


def since_ns(text: str, *, now: datetime, option: str = "--since") -> int:
    """Return since when: a duration ago, or a moment; 0 for no text. Unix nanoseconds.

    Raises:
        ConfigError: it is neither.
    """
    if not text:
        return 0
    if (ago := duration_s(text)) is not None:
        return max(0, int((now.timestamp() - ago) * 1e9))
    return moment_ns(text, now=now, option=option)


def until_of(text: str) -> int:
    """Return the moment of an option `--until`: after a duration, or a moment to come; 0 for no text."""
    now = datetime.now().astimezone()
    if not text:
        return 0
    if (seconds := duration_s(text)) is not None:
        return int((now.timestamp() + seconds) * 1e9)
    return moment_ns(text, now=now, option="--until", ahead=True)
