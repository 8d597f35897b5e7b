"""What is delivered of alerts, when, and by which gateway."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.alerts.messages import DOWN_S, MOST_LINES, RETRY_S, Course, Message, delivered, sender
from appliance.alerts.settings import AlertsConfig
from appliance.model import GatewayStatus, Word
from appliance.model.alerts import Alert, AlertLevel, Subject
from appliance.model.gateways import Deliveries

CONFIG = AlertsConfig(urls_file="x", every_s=30)
LOST = Alert(
    id="robot-offline.rover_1", kind="robot-offline", level=AlertLevel.CRITICAL, what="offline", subject=Subject.ROBOT,
    name="rover_1", remedy="check the robot", since_ns=1_000_000_000,
)  # fmt: skip
DISK = Alert(
    id="disk.gw-1", kind="disk", level=AlertLevel.WARNING, what="9 MiB free", subject=Subject.GATEWAY, name="gw-1",
    since_ns=2_000_000_000,
)  # fmt: skip


def due(course: Course, *alerts: Alert, now: float = 0.0, config: AlertsConfig = CONFIG) -> Message | None:
    """Return what is delivered of alerts."""
    course.see(alerts)
    return course.message(alerts, config, fleet="yard", now=now)


def test_a_message_says_what_since_when_and_what_to_do() -> None:
    """The most urgent first, a line each; what others wrote cannot break lines or turn their direction."""
    told = replace(DISK, what="9 MiB\n\u202efree\x1b[2J")
    message = due(Course(), told, LOST)
    assert message is not None
    assert (message.title, message.critical) == ("SwiftBot yard: 1 critical, 1 warning", True)
    assert message.body.splitlines() == [
        "✘ robot rover_1: offline (since 1970-01-01 00:00:01 UTC) → check the robot",
        "▲ gateway gw-1: 9 MiB  free [2J (since 1970-01-01 00:00:02 UTC)",
    ]


def test_a_long_list_is_counted() -> None:
    """A message has so many lines, and says how many more there are."""
    many = tuple(replace(DISK, id=f"disk.gw-{number}") for number in range(MOST_LINES + 5))
    lines = Message("yard", many).body.splitlines()
    assert len(lines) == MOST_LINES + 1
    assert lines[-1] == "and 5 more: `swiftbot alerts` lists them"


def test_what_happens_within_the_pause_is_gathered() -> None:
    """An address gets one message in `every_s`; nothing of what happens meanwhile is lost."""
    course = Course()
    first = due(course, LOST)
    assert first is not None
    course.took(first, CONFIG, now=0.0)
    assert due(course, LOST, DISK, now=29.9) is None
    second = due(course, LOST, DISK, now=30.0)
    assert second is not None
    assert second.news == (DISK,)


def test_what_becomes_worse_or_begins_again_is_told_again() -> None:
    """Of an alert that is known only these are news."""
    course = Course()
    course.told = {DISK.id: DISK}
    assert due(course, replace(DISK, what="8 MiB free")) is None
    assert due(course, replace(DISK, told_ns=9)) is None
    assert due(course, replace(DISK, level=AlertLevel.CRITICAL)) is not None
    course.told = {DISK.id: DISK}
    assert due(course, replace(DISK, since_ns=DISK.since_ns + 1)) is not None


def test_only_what_nobody_has_seen_and_is_urgent_enough() -> None:
    """What is acknowledged is not delivered; of warnings `level` decides."""
    assert due(Course(), replace(LOST, acked=Word(by="ann"))) is None
    assert due(Course(), DISK, config=replace(CONFIG, level=AlertLevel.CRITICAL)) is None
    assert due(Course(), replace(LOST, told_ns=5)) is None  # another gateway has delivered it


def test_the_end_is_told_to_who_was_told_of_the_beginning() -> None:
    """Unless somebody acknowledged it, it is of what happens once, or it began again before the end was told."""
    course = Course()
    course.end(LOST)
    assert due(course) is None
    course.told = {LOST.id: LOST, DISK.id: DISK}
    course.end(LOST)
    course.end(replace(DISK, acked=Word(by="ann")))
    message = due(course)
    assert message is not None
    assert (message.title, message.body) == ("SwiftBot yard: 1 over", "✔ over: robot rover_1: offline")
    assert due(course, config=replace(CONFIG, over=False)) is None
    again = due(course, replace(LOST, since_ns=9_000_000_000))
    assert again is not None
    assert again.title == "SwiftBot yard: 1 critical"


def test_a_refused_message_is_tried_again_later_and_later() -> None:
    """Nothing of it is lost; the alert about it is for others."""
    course = Course()
    course.refused("no route", now=0.0)
    assert due(course, LOST, now=RETRY_S - 0.1) is None
    message = due(course, LOST, replace(DISK, kind="delivery", id="delivery.gw-1"), now=RETRY_S)
    assert message is not None
    assert message.news == (LOST,)
    course.refused("no route", now=RETRY_S)
    assert due(course, LOST, now=3 * RETRY_S - 0.1) is None
    assert due(course, LOST, now=3 * RETRY_S) is not None


def test_delivered_is_what_all_addresses_took() -> None:
    """One that has refused all for an hour is waited for no longer."""
    one, other = Course(told={LOST.id: LOST}), Course()
    other.refused("no route", now=0.0)
    assert delivered([LOST], [one, other], now=1.0) == []
    assert delivered([LOST], [one, other], now=DOWN_S + 1) == [LOST]
    assert delivered([replace(LOST, told_ns=5)], [one], now=0.0) == []
    assert delivered([LOST], [], now=0.0) == []


def test_one_gateway_delivers_for_all() -> None:
    """The first of those that are set to and can; where none can, one tries all the same."""

    def status(problem: str | None, *, draining: bool = False) -> GatewayStatus:
        delivery = None if problem is None else Deliveries(problem=problem)
        return GatewayStatus(id="gw", fleet="yard", delivery=delivery, draining=draining)

    assert sender({"a": status(None), "b": status("no route"), "c": status(""), "d": status("")}) == "c"
    assert sender({"b": status("no route"), "c": status("", draining=True), "d": status("")}) == "d"
    assert sender({"b": status("no route"), "c": status("no route")}) == "b"
    assert sender({"a": status(None)}) == ""


@given(
    events=st.lists(
        st.tuples(st.sampled_from(["begins", "worse", "over", "wait"]), st.integers(0, 3), st.booleans()), max_size=60
    )
)
def test_all_is_told_at_least_once_and_never_too_often(events: list[tuple[str, int, bool]]) -> None:
    """Whatever comes and goes, and whatever the address refuses: in the end it knows what there is, paced."""
    course, now, sent_at = Course(), 0.0, list[float]()
    alerts: dict[str, Alert] = {}

    def look(*, takes: bool) -> None:
        course.see(alerts.values())
        message = course.message(alerts.values(), CONFIG, fleet="yard", now=now)
        if message is None:
            return
        if takes:
            course.took(message, CONFIG, now=now)
            sent_at.append(now)
        else:
            course.refused("no route", now=now)

    for what, number, takes in events:
        now += 20.0
        name = f"disk.gw-{number}"
        if what == "begins":
            alerts.setdefault(name, replace(DISK, id=name, since_ns=int(now * 1e9) + 1))
        elif what == "worse" and name in alerts:
            alerts[name] = replace(alerts[name], level=AlertLevel.CRITICAL, told_ns=0)
        elif what == "over" and name in alerts:
            course.end(alerts.pop(name))
        look(takes=takes)
    now += 1000.0
    look(takes=True)
    assert {name: alert.level for name, alert in course.told.items()} == {
        name: alert.level for name, alert in alerts.items()
    }
    assert not course.over
    assert all(later - earlier >= CONFIG.every_s for earlier, later in pairwise(sent_at))
