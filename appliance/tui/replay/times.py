"""Times and rates of a log as people give them and read them. Pure."""

from appliance.errors import PayloadError

RATES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 100.0)
"""Log seconds a second."""


def faster(rate: float) -> float:
    """Return the next rate above."""
    return next((each for each in RATES if each > rate), RATES[-1])


def slower(rate: float) -> float:
    """Return the next rate below."""
    return next((each for each in RATES[::-1] if each < rate), RATES[0])


def rate_of(text: str) -> float:
    """Read a rate: `2` or `2x`.

    Raises:
        PayloadError: it is none, or not within `RATES`.
    """
    try:
        rate = float(text.strip().rstrip("x"))
    except ValueError:
        rate = float("nan")
    if not RATES[0] <= rate <= RATES[-1]:
        raise PayloadError(f"{text[:40]!r} is no rate", remedy=f"give {RATES[0]:g} to {RATES[-1]:g}")
    return rate


def seconds_of(text: str, *, at_s: float, length_s: float) -> float:
    """Read a time in a log: `90`, `1:30`, `1:02:03`, `50%`, or `+10` and `-10` from where it is.

    Raises:
        PayloadError: it is none.
    """
    plain = text.strip()
    sign = plain[:1] if plain[:1] in ("+", "-") else ""
    try:
        if plain.endswith("%") and not sign:
            found = float(plain[:-1]) / 100 * length_s
        else:
            found = 0.0
            parts = plain.removeprefix(sign).split(":")
            if len(parts) > 3:
                raise ValueError  # noqa: TRY301 - told below
            if any(not part[:1].isdecimal() for part in parts):
                raise ValueError  # noqa: TRY301 - told below
            for part in parts:
                found = found * 60 + float(part)
    except ValueError:
        found = float("nan")
    if not 0 <= found < 1e12:
        raise PayloadError(f"{text[:40]!r} is no time of a log", remedy="give 90, 1:30, 50 %, or +10 and -10 from here")
    return at_s + (found if sign == "+" else -found) if sign else found


def told(seconds: float) -> str:
    """Return a time of a log for people: minutes and seconds with tenths, hours where there are any."""
    tenths = round(max(0.0, seconds) * 10)
    minutes, rest = divmod(tenths, 600)
    hours, minutes = divmod(minutes, 60)
    clock = f"{minutes:02}:{rest // 10:02}.{rest % 10}"
    return f"{hours}:{clock}" if hours else clock
