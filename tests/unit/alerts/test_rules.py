"""Which alerts there are, from facts; their severity and order; that a condition has one alert, and when it is over."""

from collections.abc import Mapping

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.alerts import rules
from appliance.alerts.rules import CRITICAL, WARNING, Change, Facts
from appliance.model import (
    Enquiry,
    Failure,
    GatewayStatus,
    Plan,
    PlannerStatus,
    Proposal,
    RecorderNote,
    Remembered,
    RobotInfo,
    SlotStatus,
    TaskRecord,
    TaskState,
    Word,
)
from appliance.model.alerts import Alert, AlertLevel, Subject

NOW_NS = 1_700_000_000 * 10**9
NAMES = ("gw-1", "gw-2", "gw-3")
ROBOTS = ("rover_1", "drone_1")


def gateway(name: str = "gw-1", **more: object) -> GatewayStatus:
    """Return a gateway that is well but for what is said."""
    return msgspec.convert({"id": name, "fleet": "f"} | more, GatewayStatus)


def robot(name: str = "rover_1", **more: object) -> RobotInfo:
    """Return a robot that is well but for what is said."""
    return msgspec.convert({"id": name, "kind": "zenoh"} | more, RobotInfo)


def of(*things: GatewayStatus | RobotInfo, **more: Mapping[str, float]) -> Facts:
    """Return facts of these gateways and robots."""
    return Facts(
        gateways={each.id: each for each in things if isinstance(each, GatewayStatus)},
        robots={each.id: each for each in things if isinstance(each, RobotInfo)},
        **more,  # pyright: ignore[reportArgumentType]
    )


# --- rules -----------------------------------------------------------------------------------------------------

QUESTION = Enquiry(id="t-1:s1:1", question="left or right?", choices=("left", "right"), at_ns=NOW_NS, expires_s=60.0)
down = PlannerStatus(slot=SlotStatus(model="m", state="down", problem="its process ended"))


@pytest.mark.parametrize(
    ("facts", "wanted"),
    [
        (of(gateway(), robot(), clock_s={"gw-1": 0.0}), {}),
        (of(gateway(), lost={"gw-2": 5}), {"gateway-lost.gw-2": CRITICAL}),
        (of(gateway("gw-2"), lost={"gw-2": 5}), {}),
        (of(gateway(pool_problem="podman.socket is absent")), {"pool.gw-1": CRITICAL}),
        (of(gateway(overloaded="load 1.00")), {"overload.gw-1": WARNING}),
        (of(gateway(limits_enforced=False)), {"no-limits.gw-1": WARNING}),
        (of(gateway(site_problem="site yard has no fence")), {"site.gw-1": WARNING}),
        (of(gateway(keys_problem="its certificate expires in 5 days")), {"keys.gw-1": WARNING}),
        (of(gateway(parts_problem="not in the list of parts: skill goto")), {"parts.gw-1": WARNING}),
        (of(gateway(disk_free_mb=2048, disk_total_mb=9000)), {}),
        (of(gateway(disk_free_mb=1984, disk_total_mb=9000)), {"disk.gw-1": WARNING}),
        (of(gateway(disk_free_mb=0, disk_total_mb=9000)), {"disk.gw-1": CRITICAL}),
        (of(gateway(disk_free_mb=0, disk_total_mb=0)), {}),
        (of(replace(gateway(), planner=down)), {"model.gw-1": WARNING}),
        (of(robot(online=False)), {"robot-offline.rover_1": CRITICAL}),
        (of(robot(online=False, failsafe="battery", warnings=("battery low",))), {"robot-offline.rover_1": CRITICAL}),
        (of(robot(failsafe="battery")), {"failsafe.rover_1": CRITICAL}),
        (of(robot(seized="a pilot has it")), {"seized.rover_1": WARNING}),
        (of(robot(warnings=("battery low",))), {"robot-warning.rover_1": WARNING}),
        (of(replace(gateway(), recorders=(RecorderNote(id="rec", state="silent"),))), {"recorder.rec": CRITICAL}),
        (of(replace(gateway(), recorders=(RecorderNote(id="rec", problem="disk full"),))), {"recorder.rec": CRITICAL}),
        (of(replace(gateway(), recorders=(RecorderNote(id="rec", going="logs go"),))), {"logs-go.rec": WARNING}),
        (of(replace(gateway(), recorders=(RecorderNote(id="rec", missed=3, keys={"gw/*/log": 3}),))),
         {"recorder.rec": WARNING}),
        (of(*map(gateway, NAMES), clock_s={"gw-1": 0.0, "gw-2": 0.4, "gw-3": -60.0}), {"clock.gw-3": WARNING}),
        (of(*map(gateway, NAMES), clock_s={"gw-1": 0.0, "gw-2": 60.0, "gw-3": 60.1}), {"clock.gw-1": WARNING}),
        (of(*map(gateway, NAMES[:2]), clock_s={"gw-1": 0.0, "gw-2": 9.0}),
         {"clock.gw-1": WARNING, "clock.gw-2": WARNING}),
        (of(gateway(), clock_s={"gw-1": 0.0, "gw-9": 99.0}), {}),
        (Facts(enquiries={"t-1:s1:1": QUESTION}), {"question.t-1:s1:1": WARNING}),
        (Facts(enquiries={"t-1:s1:1": replace(QUESTION, answer="left")}), {}),
        (Facts(enquiries={"t-1:s1:1": replace(QUESTION, closed="expired")}), {}),
    ],
)  # fmt: skip
def test_each_condition_has_its_alert(facts: Facts, wanted: dict[str, AlertLevel]) -> None:
    """What is well has none; each has what is the case and what to do about it."""
    found = rules.findings(facts)
    assert {name: each.level for name, each in found.items()} == wanted
    for each in found.values():
        assert each.what
        assert each.remedy


def task(state: TaskState = TaskState.FAILED, **more: object) -> TaskRecord:
    """Return a task's record."""
    return replace(TaskRecord(id="t-1", instruction="go home", state=state, updated_ns=NOW_NS), **more)


PLAN = Proposal(plan=Plan(domain="navigation", subtasks=()), hash="0123456789abcdef", waits=True, expires_s=60.0,
                at_ns=NOW_NS, note="a look")  # fmt: skip


def test_tasks_that_need_a_person() -> None:
    """One that failed, with why; one whose plan waits, with the time that is left; no other, nor one long gone."""
    failed = rules.of_task(task(failure=Failure(code="robot", message="no grip", remedy="look at the gripper")))
    assert failed is not None
    assert (failed.id, failed.level, failed.since_ns) == ("task-failed.t-1", CRITICAL, NOW_NS)
    assert "no grip" in failed.what
    assert failed.remedy == "look at the gripper"
    waits = rules.of_task(task(TaskState.PROPOSED, proposal=PLAN))
    assert waits is not None
    assert (waits.id, waits.level, waits.until_ns) == ("plan-waits.t-1", WARNING, NOW_NS + 60 * 10**9)
    assert "0123456789ab" in waits.remedy
    for state in TaskState:
        if state is not TaskState.FAILED:
            assert rules.of_task(task(state)) is None
    assert rules.of_task(task(remembered=Remembered())) is None
    assert rules.of_task(task(TaskState.RUNNING, proposal=replace(PLAN, waits=False))) is None


# --- what becomes of them ------------------------------------------------------------------------------------------

flags = st.booleans()
statuses = st.builds(
    lambda name, pool, limits, free: gateway(
        name, pool_problem="broken" if pool else "", limits_enforced=limits, disk_free_mb=free, disk_total_mb=9000
    ),
    st.sampled_from(NAMES), flags, flags, st.sampled_from((100, 1000, 5000)),
)  # fmt: skip
robots = st.builds(
    lambda name, online, low: robot(name, online=online, warnings=("low",) if low else ()),
    st.sampled_from(ROBOTS), flags, flags,
)  # fmt: skip
facts_of_a_fleet = st.builds(
    lambda things, lost: of(*things, lost=dict.fromkeys(lost, NOW_NS)),
    st.lists(statuses | robots, max_size=6), st.sets(st.sampled_from(NAMES)),
)  # fmt: skip


class Fleet:
    """Gateways that look after alerts by rules alone, each after its own."""

    def __init__(self, *, members: int = 1) -> None:
        self.kept: dict[str, Alert] = {}
        self.members = members
        self.now_ns = NOW_NS
        self.absent: dict[str, int] = {}
        self.written: list[Change] = []

    def look(self, facts: Facts) -> list[Change]:
        """Have each gateway look at the facts once, and carry out what it decides."""
        found = rules.findings(facts)
        self.absent = {name: self.absent.get(name, self.now_ns) for name in self.kept if name not in found}
        made: list[Change] = []
        for number in range(self.members):
            made += rules.changes(
                self.kept, found, facts,
                mine=lambda name, number=number: hash(name) % self.members == number,
                absent_s=lambda name: (self.now_ns - self.absent.get(name, self.now_ns)) / 1e9,
                gateway=f"gw-{number}", now_ns=self.now_ns,
            )  # fmt: skip
        for each in made:
            if each.clear:
                del self.kept[each.alert.id]
            else:
                self.kept[each.alert.id] = each.alert
        self.written += made
        return made

    def later(self, seconds: float) -> None:
        """Let time pass."""
        self.now_ns += round(seconds * 1e9)

    def acknowledge(self) -> None:
        """Acknowledge all."""
        self.kept = {
            name: replace(each, acked=each.acked or Word(by="ann", at_ns=self.now_ns))
            for name, each in self.kept.items()
        }


@given(facts_of_a_fleet, st.integers(1, 4))
def test_a_condition_has_one_alert_however_many_look(facts: Facts, members: int) -> None:
    """Each finding has the alert of its id, written once by one gateway; looked at again nothing is written."""
    fleet = Fleet(members=members)
    fleet.look(facts)
    assert set(fleet.kept) == set(rules.findings(facts))
    assert len(fleet.written) == len(fleet.kept)
    for _ in range(3):
        fleet.later(20)
        assert fleet.look(facts) == []


@given(facts_of_a_fleet, facts_of_a_fleet)
def test_what_is_over_is_cleared_and_what_nobody_sees_is_kept(first: Facts, second: Facts) -> None:
    """After a calm while all that is seen to be well again is gone; of what is not heard of any more it stays."""
    fleet = Fleet()
    fleet.look(first)
    before = dict(fleet.kept)
    fleet.look(second)
    fleet.later(rules.CALM_S + 1)
    fleet.look(second)
    found = rules.findings(second)
    unseen = {name for name, each in before.items() if not rules.seen(each, second)}
    assert set(fleet.kept) == set(found) | unseen
    # Acknowledged, it goes.
    fleet.acknowledge()
    fleet.look(second)
    assert set(fleet.kept) == set(found)


@given(facts_of_a_fleet, facts_of_a_fleet)
def test_what_comes_and_goes_is_one_alert(one: Facts, other: Facts) -> None:
    """A condition that is gone for less than a calm while keeps its alert, its time and who has acknowledged it."""
    fleet = Fleet()
    fleet.look(one)
    fleet.acknowledge()
    before = dict(fleet.kept)
    worse = {name for name, each in rules.findings(other).items() if name in before
             and each.level is CRITICAL and before[name].level is not CRITICAL}  # fmt: skip
    for _ in range(4):
        fleet.look(other)
        fleet.later(1.0)
        fleet.look(one)
    same = {name for name, each in before.items() if rules.seen(each, other) and name not in worse}
    assert same <= set(fleet.kept)
    for name in same:
        assert (fleet.kept[name].since_ns, fleet.kept[name].acked) == (before[name].since_ns, before[name].acked)


def test_a_question_is_over_with_its_answer() -> None:
    """At once, and with the time that there was for it."""
    fleet = Fleet()
    fleet.look(Facts(enquiries={QUESTION.id: QUESTION}))
    (alert,) = fleet.kept.values()
    assert alert.until_ns == NOW_NS + 60 * 10**9
    assert "left, right" in alert.remedy
    fleet.look(Facts(enquiries={QUESTION.id: replace(QUESTION, answer="left")}))
    assert fleet.kept == {}


def test_what_becomes_worse_is_to_be_acknowledged_again() -> None:
    """A disk that is nearly full was acknowledged: when it is full that counts again, at once."""
    fleet = Fleet()
    fleet.look(of(gateway(disk_free_mb=1000, disk_total_mb=9000)))
    fleet.acknowledge()
    assert rules.open_counts(fleet.kept.values()) == (0, 0)
    fleet.look(of(gateway(disk_free_mb=100, disk_total_mb=9000)))
    assert rules.open_counts(fleet.kept.values()) == (1, 0)
    fleet.acknowledge()
    fleet.later(20)
    fleet.look(of(gateway(disk_free_mb=1000, disk_total_mb=9000)))
    assert rules.open_counts(fleet.kept.values()) == (0, 0)


def test_a_lost_gateway_is_given_up_in_the_end() -> None:
    """One that never comes back is listed until an hour after somebody has acknowledged it, and no longer."""
    facts = of(gateway(), lost={"gw-2": NOW_NS})
    fleet = Fleet()
    fleet.look(facts)
    fleet.later(99 * rules.ENDED_KEPT_S)
    assert fleet.look(facts) == []
    fleet.acknowledge()
    fleet.later(rules.ENDED_KEPT_S - 1)
    assert fleet.look(facts) == []
    fleet.later(2)
    fleet.look(facts)
    assert fleet.kept == {}


def test_words_that_keep_changing_are_written_now_and_then() -> None:
    """A count that rises each second is written every ten seconds, and the last one in the end."""
    fleet = Fleet()
    for count in range(1, 32):
        fleet.look(of(replace(gateway(), recorders=(RecorderNote(id="rec", missed=count),))))
        fleet.later(1)
    assert len(fleet.written) == 4
    assert "31" in fleet.kept["recorder.rec"].what


@given(st.integers(0, 3 * rules.MOST))
def test_a_fleet_has_a_bounded_number_of_alerts(count: int) -> None:
    """Beyond the bound only critical ones are added, up to twice as many."""
    fleet = Fleet()
    offline = {f"r{number}": robot(f"r{number}", online=False) for number in range(count)}
    low = {f"w{number}": robot(f"w{number}", warnings=("low",)) for number in range(count)}
    fleet.look(Facts(robots=low))
    assert len(fleet.kept) == min(count, rules.MOST)
    fleet.look(Facts(robots=low | offline))
    assert len(fleet.kept) <= 2 * rules.MOST


def test_an_alert_that_there_is_no_room_for_is_told() -> None:
    """Its id is handed on, to be counted: nothing is left out silently."""
    one = rules.findings(Facts(robots={"r": robot("r", warnings=("low",))}))["robot-warning.r"]
    kept = {f"x{number}": rules.raised(one, gateway="gw-1", now_ns=1) for number in range(rules.MOST)}
    left_out: list[str] = []
    for name in ("late", "later"):
        facts = Facts(robots={name: robot(name, warnings=("low",))})
        rules.changes(
            kept, rules.findings(facts), facts, mine=lambda _: True, absent_s=lambda _: 0.0, gateway="gw-1",
            now_ns=2, left_out=left_out.append,
        )  # fmt: skip
    assert left_out == ["robot-warning.late", "robot-warning.later"]


# --- tasks -----------------------------------------------------------------------------------------------------


def changed(kept: dict[str, Alert], record: TaskRecord) -> dict[str, Alert]:
    """Return the alerts after a coordinator has looked at a record."""
    after = dict(kept)
    for each in rules.task_change(kept, record.id, rules.of_task(record), gateway="gw-1", now_ns=NOW_NS):
        if each.clear:
            del after[each.alert.id]
        else:
            after[each.alert.id] = each.alert
    return after


@given(st.lists(st.sampled_from(TaskState), max_size=8))
def test_a_task_has_the_alert_of_its_last_record(states: list[TaskState]) -> None:
    """Approved, rejected, retried or failed again: what the record does not say any more is over at once."""
    kept: dict[str, Alert] = {}
    record = task(TaskState.ACCEPTED)
    for state in states:
        record = task(state, proposal=PLAN if state is TaskState.PROPOSED else None)
        kept = changed(kept, record)
    finding = rules.of_task(record)
    assert set(kept) == ({finding.id} if finding is not None else set())


def test_a_flood_of_failed_tasks_is_counted_in_one() -> None:
    """Those beyond the bound have one alert together, which says how many they are."""
    kept: dict[str, Alert] = {}
    for number in range(rules.MOST_FAILED + 7):
        kept = changed(kept, replace(task(), id=f"t-{number}"))
    assert len(kept) == rules.MOST_FAILED + 1
    assert kept["tasks-failed.gw-1"].what.startswith("7 more")
    for said in ("", "many", "9" * 5000):  # as another member may have written it
        kept["tasks-failed.gw-1"] = replace(kept["tasks-failed.gw-1"], what=said)
        counted = changed(kept, replace(task(), id="t-further"))
        assert counted["tasks-failed.gw-1"].what.startswith("1 more")


def test_what_has_happened_is_over_some_time_after_it_was_acknowledged() -> None:
    """A failed task stays listed for an hour after that, for those who come later; without it, for good."""
    failed = rules.raised(rules.of_task(task()) or pytest.fail("no finding"), gateway="gw-1", now_ns=NOW_NS)
    hour_ns = int(rules.ENDED_KEPT_S * 1e9) + 1
    assert not rules.over(failed, Facts(), absent_s=1e9, now_ns=NOW_NS + 9 * hour_ns)
    acked = replace(failed, acked=Word(by="ann", at_ns=NOW_NS))
    assert not rules.over(acked, Facts(), absent_s=1e9, now_ns=NOW_NS + 1)
    assert rules.over(acked, Facts(), absent_s=0.0, now_ns=NOW_NS + hour_ns)
    plan = replace(acked, kind="plan-waits")
    assert not rules.over(plan, Facts(), absent_s=1e9, now_ns=NOW_NS + hour_ns), "its coordinator sees to it"


# --- lists -----------------------------------------------------------------------------------------------------

alerts = st.builds(
    lambda name, level, since, acked: Alert(
        id=name, kind="k", level=level, what="w", subject=Subject.ROBOT, name=name, since_ns=since,
        acked=Word(by="ann") if acked else None,
    ),
    st.text("abc", min_size=1, max_size=3), st.sampled_from((CRITICAL, WARNING)), st.integers(0, 5), flags,
)  # fmt: skip


@given(st.lists(alerts))
def test_the_most_urgent_come_first(listed: list[Alert]) -> None:
    """Those that nobody has acknowledged, of them the critical ones, of these the newest; none is lost."""
    found = rules.ordered(listed)
    assert sorted(found, key=repr) == sorted(listed, key=repr)
    ranks = [(each.acked is not None, each.level is not CRITICAL, -each.since_ns) for each in found]
    assert ranks == sorted(ranks)
    assert rules.ordered(reversed(listed)) == rules.ordered(found) or len({each.id for each in listed}) < len(listed)
    critical, warnings = rules.open_counts(listed)
    assert critical + warnings == sum(each.acked is None for each in listed)


@given(alerts, alerts, alerts)
def test_versions_of_a_partition_settle_alike(one: Alert, two: Alert, three: Alert) -> None:
    """In whatever order they meet; an acknowledgement is not lost."""
    a, b, c = (msgspec.json.encode(each) for each in (one, two, three))
    assert rules.stronger(a, b) == rules.stronger(b, a)
    assert rules.stronger(rules.stronger(a, b), c) == rules.stronger(a, rules.stronger(b, c))
    kept = msgspec.json.decode(rules.stronger(a, b), type=Alert)
    assert (kept.acked is not None) is (one.acked is not None or two.acked is not None)
    assert rules.stronger(a, b"no alert") == a
