"""When schedules are due: by the clock of their zone, each time once, whatever is done to clocks and gateways."""

from datetime import UTC, date, datetime, time, timedelta
from itertools import pairwise
from zoneinfo import ZoneInfo

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.model import Word
from appliance.model.schedules import Schedule, ScheduleSpec
from appliance.schedules import due

ZONES = ("Europe/Zurich", "America/New_York", "Australia/Lord_Howe", "Pacific/Apia", "America/Sao_Paulo", "UTC")
"""With a gap of half an hour, one over midnight, and one of a whole day (Apia, 30 December 2011)."""
S = 10**9


def ns(text: str) -> int:
    """Return a moment with its offset, Unix nanoseconds."""
    return int(datetime.fromisoformat(text).timestamp()) * S


def spec(**fields: object) -> ScheduleSpec:
    """Return a schedule's."""
    return ScheduleSpec(**{"id": "patrol", "instruction": "rover_1: go to dock 1", **fields})  # pyright: ignore[reportArgumentType]


def expected(day: date, at: time, zone: ZoneInfo) -> int:
    """Return when a time of day is due: the first time that the clock shows it, or the first moment after the gap."""
    found = datetime.combine(day, at, zone)
    while found.astimezone(UTC).astimezone(zone).replace(tzinfo=None) != found.replace(tzinfo=None):
        found += timedelta(minutes=1)
    return int(found.replace(fold=0).timestamp()) * S


@given(
    zone=st.sampled_from(ZONES), begin=st.integers(1_262_304_000, 1_798_761_600),
    hours=st.sets(st.integers(0, 4), min_size=1), minutes=st.sets(st.sampled_from((0, 15, 30, 59)), min_size=1),
    days=st.integers(1, 4), near=st.sampled_from(("2026-03-28", "2026-10-24", "2011-12-29", "2016-10-15", "")),
)  # fmt: skip
def test_each_time_of_day_is_due_once(
    zone: str, begin: int, hours: set[int], minutes: set[int], days: int, near: str
) -> None:
    """Against an independent count: not twice where clocks are put back, not never where they are put forward."""
    after = datetime.fromtimestamp(begin, UTC)
    if near:
        after = datetime.combine(date.fromisoformat(near), after.timetz())
    place = ZoneInfo(zone)
    text = f"{','.join(map(str, sorted(minutes)))} {','.join(map(str, sorted(hours)))} * * *"
    until = after + timedelta(days=days)
    found = [
        each
        for each in due.upcoming(spec(cron=text, zone=zone), int(after.timestamp()) * S, since_ns=0, count=200)
        if each <= int(until.timestamp()) * S
    ]
    first = after.astimezone(place).date() - timedelta(days=2)
    wanted = {
        expected(first + timedelta(days=number), time(hour, minute), place)
        for number in range(days + 5) for hour in hours for minute in minutes
    }  # fmt: skip
    assert found == sorted(each for each in wanted if after.timestamp() * S < each <= until.timestamp() * S)


@pytest.mark.parametrize("text", ["*/20 2 * * *", "* 2 * * *", "30 */2 * * *", "0-59/20 0-23/2 * * *"])
def test_steps_within_a_day_are_times_of_day_too(text: str) -> None:
    """Where clocks are put back over 2 o'clock nothing is due twice; where they skip it, it is due after the gap."""
    zurich = ZoneInfo("Europe/Zurich")
    for day in ("2026-10-25", "2026-03-29"):
        begin = ns(f"{day}T00:30:00+02:00") if day.startswith("2026-10") else ns(f"{day}T00:30:00+01:00")
        found = [each for each in due.upcoming(spec(cron=text, zone="Europe/Zurich"), begin, since_ns=0, count=200)
                 if each < begin + 86_400 * S]  # fmt: skip
        shown = [datetime.fromtimestamp(each / 1e9, zurich).replace(tzinfo=None) for each in found]
        assert len(set(shown)) == len(shown)
        assert any(each.hour in (2, 3) for each in shown)


def test_every_hour_is_every_hour() -> None:
    """Where clocks are put back it is due in both hours of that name: an hour lies between any two times."""
    begin = ns("2026-10-25T00:00:00+02:00")
    found = due.upcoming(spec(cron="30 * * * *", zone="Europe/Zurich"), begin, since_ns=0, count=6)
    assert [later - earlier for earlier, later in pairwise(found)] == [3600 * S] * 5


@given(st.integers(10, 10**6), st.integers(0, 10**9), st.integers(0, 10**9))
def test_intervals_are_counted_from_when_it_was_added(every: int, since: int, later: int) -> None:
    """Wherever it is looked at, the same moments; the next one lies less than an interval ahead."""
    (found,) = due.upcoming(spec(every_s=every), (since + later) * S, since_ns=since * S, count=1)
    assert (found - since * S) % (every * S) == 0
    assert 0 < found - (since + later) * S <= every * S


SCHEDULES = st.one_of(
    st.builds(spec, every_s=st.sampled_from((10.0, 61.0, 3600.0))),
    st.builds(
        spec, cron=st.sampled_from(("*/5 * * * *", "0 7 * * mon-fri", "30 2 * * *")), zone=st.sampled_from(ZONES)
    ),
    st.builds(spec, at_ns=st.integers(1, 10**6).map(lambda each: ns("2026-03-28T12:00:00+00:00") + each * S)),
)


@given(
    SCHEDULES, st.lists(st.integers(0, 40_000), min_size=1, max_size=25), st.sampled_from(("report", "run")),
    st.sampled_from((5.0, 60.0, 3600.0)), st.integers(0, 10**6),
)  # fmt: skip
def test_nothing_is_submitted_twice_and_nothing_is_passed_over(
    one: ScheduleSpec, pauses: list[int], late: str, grace_s: float, until_s: int
) -> None:
    """However rarely it is looked at: each time that was due is submitted or counted as missed, and once."""
    begin = ns("2026-03-28T12:00:00+00:00")
    one = replace(one, late=late, grace_s=grace_s, until_ns=begin + until_s * S)  # pyright: ignore[reportArgumentType]
    schedule = Schedule(spec=one, added=Word(by="ann", at_ns=begin), handled_ns=begin)
    now, submitted, missed = begin, list[int](), 0
    for pause in pauses:
        now += pause * S
        found = due.step(schedule, now)
        if not found.handled_ns:
            assert (found.fire_ns, found.missed) == (0, 0)
            continue
        assert found.handled_ns <= now
        if found.fire_ns:
            assert found.late or now - found.fire_ns <= grace_s * S
            assert now <= one.until_ns + due.END_GRACE_NS, "nothing begins after the end, nothing late either"
            assert late == "run" or not found.late
            submitted.append(found.fire_ns)
        missed += found.missed - found.late
        schedule = replace(schedule, handled_ns=found.handled_ns)
        assert not due.step(schedule, now).handled_ns, "what is done is done"
        assert not found.next_ns or found.next_ns > now
    assert len(set(submitted)) == len(submitted)
    times = [each for each in due.upcoming(one, begin, since_ns=begin, count=100_000 if one.every_s < 60 else 20_000)
             if each <= now]  # fmt: skip
    assert set(submitted) <= set(times)
    if len(times) < due.MOST_LOOKED_AT:
        assert len(submitted) + missed == len(times)


def test_while_its_last_task_runs_a_time_is_missed_with_that_reason() -> None:
    """Also a late one: a robot is not sent twice at a time."""
    for late in ("report", "run"):
        one = Schedule(spec=spec(every_s=60.0, late=late), added=Word(by="ann", at_ns=0))
        found = due.step(one, 61 * S, busy="patrol.1")
        assert (found.fire_ns, found.missed, found.handled_ns) == (0, 1, 60 * S)
        assert "patrol.1 had not ended" in found.missed_why
    allowed = Schedule(spec=spec(every_s=60.0, overlap="allow"), added=Word(by="ann", at_ns=0))
    assert due.step(allowed, 61 * S, busy="patrol.1").fire_ns == 60 * S


def test_a_long_absence_is_not_counted_time_by_time() -> None:
    """After a year without gateways the next look is as quick as any, and goes on from now."""
    one = Schedule(spec=spec(every_s=10.0), added=Word(by="ann", at_ns=0))
    found = due.step(one, 365 * 86_400 * S)
    assert found.missed == due.MOST_LOOKED_AT
    assert found.handled_ns == 365 * 86_400 * S
    assert not found.fire_ns


@pytest.mark.parametrize("grace_s", [60.0, 86_400.0])
def test_nothing_is_submitted_after_the_end(grace_s: float) -> None:
    """A gateway that was away at the end of a schedule moves no robot in the night: the time is missed."""
    begin = ns("2026-11-27T16:00:00+00:00")
    one = spec(every_s=3600.0, until_ns=begin + 3600 * S, late="run", grace_s=grace_s)
    schedule = Schedule(spec=one, added=Word(by="ann", at_ns=begin), handled_ns=begin)
    assert due.step(schedule, one.until_ns + 5 * S).fire_ns == one.until_ns
    found = due.step(schedule, one.until_ns + 8 * 3600 * S)
    assert (found.fire_ns, found.late, found.missed, found.handled_ns) == (0, False, 1, one.until_ns)


def test_a_paused_one_is_never_due() -> None:
    """Nothing is submitted and nothing is missed."""
    one = Schedule(spec=spec(every_s=10.0), added=Word(by="ann", at_ns=0), paused=Word(by="bob"))
    assert due.step(one, 10**15) == due.Step()


def test_a_task_is_named_after_schedule_and_time() -> None:
    """In UTC, whatever the zone: two gateways give it the same name, and two times differ."""
    assert due.task_id("patrol", ns("2026-11-27T07:00:00+01:00")) == "patrol.20261127t060000z"


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({}, "one of"), ({"every_s": 60.0, "cron": "0 7 * * *"}, "one of"), ({"every_s": 9.0}, "too short"),
        ({"cron": "0 7 * *"}, "5 fields"), ({"cron": "0 0 7 * * *"}, "5 fields"), ({"cron": "61 7 * * *"}, "minute"),
        ({"cron": "0 7 * * monday"}, "day-of-week"), ({"cron": "0 7 30 2 *"}, "day-of-month"),
        ({"cron": "*/x * * * *"}, "minute"), ({"cron": "0 7 * * *", "zone": "Europe/Nowhere"}, "time zone"),
        ({"cron": "0 7 * * *", "zone": "../etc/passwd"}, "time zone"), ({"cron": "0 7 * * *", "zone": ""}, "time zone"),
        ({"at_ns": 5}, "is over"), ({"every_s": 60.0, "until_ns": 10**9 + 1}, "never due"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(fields: dict[str, object], says: str) -> None:
    """With what is wrong and what to write instead."""
    with pytest.raises(PayloadError, match=says) as refused:
        due.check(spec(**fields), now_ns=10**9)
    assert refused.value.remedy


@given(st.text(alphabet="0123456789*/-,LW#? abcmon\x00é", max_size=40), st.text(max_size=20))
def test_no_expression_and_no_zone_breaks_it(cron: str, zone: str) -> None:
    """Whatever is given is a schedule, or refused."""
    for one in (spec(cron=cron), spec(cron="0 7 * * *", zone=zone)):
        try:
            due.check(one, now_ns=ns("2026-11-27T07:00:00+01:00"))
        except PayloadError:
            continue
        assert due.upcoming(one, ns("2026-11-27T07:00:00+01:00"), since_ns=0, count=1)
