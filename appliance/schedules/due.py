"""When a schedule is due, and what is to be done now. Pure: the present is given.

Intervals count seconds since the schedule was added, so that no clock that is put forward or back moves them. Cron
expressions go by the clock of their zone: `cronsim` steps through it. An expression for every hour (`*` in the hours'
field) goes by elapsed time; of any other each time of day is due once: where clocks are put back, the first time that
it is that time, and where they are put forward over it, at the first moment after the gap.

What is due at the same moment has the same name on every gateway (`task_id`), so that it is one task however often it
is submitted.
"""

import contextlib
import os
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, tzinfo
from functools import lru_cache
from itertools import islice
from pathlib import Path
from zoneinfo import ZoneInfo

from cronsim import CronSim, CronSimError
from msgspec import Struct

from appliance.errors import PayloadError, SwiftbotError
from appliance.model.schedules import SHORTEST_S, Schedule, ScheduleSpec

LOCALTIME = Path("/etc/localtime")
MOST_LOOKED_AT = 2000
"""Times that are counted one by one after a long absence; what was due beyond them is passed over."""
END_GRACE_NS = 60 * 10**9
"""How long after a schedule's end what was due just before it is still submitted, at most."""
_LATEST = datetime(9000, 1, 1, tzinfo=UTC)


def check(spec: ScheduleSpec, *, now_ns: int) -> None:
    """Check what a request alone can tell.

    Raises:
        PayloadError: not one of the three ways, a zone or expression that is none, or a time that is over.
    """
    sound(spec)
    if 0 < spec.at_ns <= now_ns:
        raise PayloadError(f"the time {when(spec.at_ns, spec.zone)} is over", remedy="give one that is to come")
    if not upcoming(spec, now_ns, since_ns=now_ns, count=1):
        raise PayloadError("the schedule is never due", remedy="give another time, or a later end")


def sound(spec: ScheduleSpec) -> None:
    """Check what does not depend on the present; records of others are held to it too.

    Raises:
        PayloadError: not one of the three ways, or a zone, interval or expression that is none.
    """
    ways = [spec.every_s > 0, bool(spec.cron), spec.at_ns > 0]
    if sum(ways) != 1:
        raise PayloadError(
            "a schedule needs one of an interval, a cron expression and a time", remedy="give one of them"
        )
    zone_of(spec.zone)
    if 0 < spec.every_s < SHORTEST_S:
        raise PayloadError(f"an interval of {spec.every_s:g} s is too short", remedy=f"give at least {SHORTEST_S:g} s")
    if spec.cron:
        _check_cron(spec.cron)


def _check_cron(text: str) -> None:
    if len(text.split()) != 5:
        raise PayloadError(
            f"cron expression {text[:80]!r} does not have 5 fields",
            remedy='write minute, hour, day of month, month, day of week, such as "0 7 * * mon-fri"',
        )
    try:
        CronSim(text, datetime(2000, 1, 1, tzinfo=UTC))
    except (CronSimError, AssertionError, ValueError) as error:
        raise PayloadError(
            f"cron expression {text[:80]!r}: {str(error).lower() or 'not understood'}",
            remedy='write it like "0 7 * * mon-fri" or "*/15 8-17 * * *"',
        ) from error


def zone_of(name: str) -> tzinfo:
    """Return a zone by its IANA name; PayloadError where there is none."""
    try:
        return UTC if name == "UTC" else ZoneInfo(name)
    except (OSError, ValueError, KeyError) as error:
        remedy = "give an IANA name, such as Europe/Zurich or UTC"
        raise PayloadError(f"no time zone {name[:60]!r}", remedy=remedy) from error


def when(at_ns: int, zone: str) -> str:
    """Return a moment by the clock of a zone, for people."""
    try:
        found = datetime.fromtimestamp(at_ns / 1e9, tz=zone_of(zone))
    except (OverflowError, OSError, ValueError, PayloadError):
        return f"{at_ns} ns"
    return f"{found:%Y-%m-%d %H:%M:%S %Z}"


def task_id(schedule: str, due_ns: int) -> str:
    """Return the id of the task that a schedule submits for a time: the same on every gateway."""
    return f"{schedule}.{datetime.fromtimestamp(due_ns // 10**9, tz=UTC):%Y%m%dt%H%M%Sz}"


# --- times --------------------------------------------------------------------------------------------------------


def upcoming(spec: ScheduleSpec, after_ns: int, *, since_ns: int, count: int) -> tuple[int, ...]:
    """Return the next times after a moment, Unix nanoseconds.

    Args:
        spec: the schedule.
        after_ns: the moment.
        since_ns: when it was added: what intervals are counted from.
        count: how many at most.
    """
    return tuple(islice(_times(spec, after_ns, since_ns=since_ns), count))


def _times(spec: ScheduleSpec, after_ns: int, *, since_ns: int) -> Iterator[int]:
    if spec.at_ns:
        found: Iterator[int] = iter((spec.at_ns,) if spec.at_ns > after_ns else ())
    elif spec.every_s:
        found = _interval(int(spec.every_s * 1e9), after_ns, since_ns)
    else:
        found = _cron(spec.cron, spec.zone, after_ns)
    for at_ns in found:
        if spec.until_ns and at_ns > spec.until_ns:
            return
        yield at_ns


def _interval(every_ns: int, after_ns: int, since_ns: int) -> Iterator[int]:
    at_ns = since_ns + max(1, (after_ns - since_ns) // every_ns + 1) * every_ns
    while True:
        yield at_ns
        at_ns += every_ns


def _cron(text: str, zone: str, after_ns: int) -> Iterator[int]:
    begin = datetime.fromtimestamp(after_ns // 10**9, tz=UTC)
    if begin >= _LATEST:
        return
    last_ns, place = after_ns, zone_of(zone)
    here, before = begin.astimezone(place), (begin - timedelta(hours=25)).astimezone(place)
    # Just after clocks were changed the same time of day may have been before: steps by the clock begin before that.
    for found in CronSim(_by_the_clock(text), here if here.utcoffset() == before.utcoffset() else before):
        if found.year >= _LATEST.year:
            return
        at_ns = int(found.timestamp()) * 10**9
        if at_ns > last_ns:  # times within a gap of the clock fall together at its end
            last_ns = at_ns
            yield at_ns


@lru_cache(maxsize=256)
def _by_the_clock(text: str) -> str:
    """Return an expression whose times of day are each due once, whatever is done to clocks; hourly ones stay.

    `cronsim` treats times of day so, as Debian's cron does, unless minute or hour begin with `*`: then it steps
    through elapsed time, which meets the hour that clocks are put back twice, and the one they skip never.
    """
    minute, hour, *rest = text.split()
    if hour == "*":
        return text
    hour = f"0-23{hour[1:]}" if hour.startswith("*") else hour
    minute = f"0-59{minute[1:]}" if minute.startswith("*") else minute
    return " ".join((minute, hour, *rest))


# --- what is to be done -------------------------------------------------------------------------------------------


class Step(Struct, frozen=True, kw_only=True):
    """What is to be done about a schedule now."""

    fire_ns: int = 0
    """Time for which its task is to be submitted; 0: none."""
    late: bool = False
    """Whether that was missed and is submitted late."""
    missed: int = 0
    """Times that were missed; the one of `fire_ns` is none of them, unless it is late."""
    missed_ns: int = 0
    """The last of them."""
    missed_why: str = ""
    handled_ns: int = 0
    """Up to here all is done once this is carried out; 0: nothing is to be done."""
    next_ns: int = 0
    """When it is due next; 0: never again, or it is paused."""


def step(schedule: Schedule, now_ns: int, *, busy: str = "", failed: str = "") -> Step:
    """Return what is to be done about a schedule.

    Args:
        schedule: its record.
        now_ns: now, Unix nanoseconds.
        busy: its last task, where that has not ended.
        failed: why the task that is due could not be submitted so far.
    """
    if schedule.paused is not None:
        return Step()
    spec, since_ns = schedule.spec, schedule.added.at_ns
    after_ns = max(schedule.handled_ns, since_ns)
    due: list[int] = []
    count = 0
    last_ns, next_ns = 0, 0
    for at_ns in _times(spec, after_ns, since_ns=since_ns):
        if at_ns > now_ns:
            next_ns = at_ns
            break
        count, last_ns = count + 1, at_ns
        due.append(at_ns)
        if count >= MOST_LOOKED_AT:
            # After so long an absence the times until now are not counted one by one.
            last_ns = now_ns
            next_ns = next(iter(_times(spec, now_ns, since_ns=since_ns)), 0)
            break
    if not count:
        return Step(next_ns=next_ns)
    grace_ns = int(spec.grace_s * 1e9)
    newest_ns = due[-1]
    over = 0 < spec.until_ns < now_ns - min(grace_ns, END_GRACE_NS)
    on_time = now_ns - newest_ns <= grace_ns and count < MOST_LOOKED_AT and not over
    blocked = busy if spec.overlap == "skip" else ""
    if on_time and not blocked:
        earlier = due[:-1]
        return Step(
            fire_ns=newest_ns, missed=len(earlier), missed_ns=earlier[-1] if earlier else 0,
            missed_why=_ABSENT if earlier else "", handled_ns=newest_ns, next_ns=next_ns,
        )  # fmt: skip
    why = f"its task {blocked} had not ended" if blocked else failed or _ABSENT
    late = spec.late == "run" and not blocked and not over
    return Step(
        fire_ns=newest_ns if late else 0, late=late, missed=count, missed_ns=newest_ns, missed_why=why,
        handled_ns=last_ns, next_ns=next_ns,
    )  # fmt: skip


_ABSENT = "no gateway that has the schedule was running, or its clock was set"


def times_text(spec: ScheduleSpec) -> str:
    """Return when a schedule is due, in words."""
    if spec.every_s:
        return f"every {interval_text(spec.every_s)}"
    return f"{spec.cron} {spec.zone}" if spec.cron else f"at {when(spec.at_ns, spec.zone)}"


def interval_text(seconds: float) -> str:
    """Return a duration as it is typed, such as 1h30m."""
    parts: list[str] = []
    left = int(seconds)
    for unit, size in (("d", 86_400), ("h", 3600), ("m", 60), ("s", 1)):
        count, left = divmod(left, size)
        if count:
            parts.append(f"{count}{unit}")
    return "".join(parts) or f"{seconds:g}s"


def local_zone() -> str:
    """Return the IANA name of this machine's time zone; UTC where it has none that is known."""
    names = [os.environ.get("TZ", "").removeprefix(":")]
    with contextlib.suppress(OSError):
        names.append(str(LOCALTIME.resolve()).partition("/zoneinfo/")[2])
    for name in filter(None, names):
        with contextlib.suppress(SwiftbotError):
            zone_of(name)
            return name
    return "UTC"
