"""Which alerts there are, how urgent, in which order, and what becomes of those that are kept. Pure.

Each rule makes findings of the facts that a gateway knows. An alert has the id of its finding, kind and name, so that a
condition has one alert however many gateways see it and however often it is looked at. It is kept until it is known to
be over: a robot that is forgotten, or a gateway that nobody hears of, is no better for it, so its alert stays until
somebody acknowledges it.

What is acknowledged stays listed and counts no more; a condition that becomes worse is to be acknowledged again.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from statistics import median

import msgspec
from msgspec import Struct, field
from msgspec.structs import replace

from appliance.model import Enquiry, GatewayStatus, RecorderNote, RobotInfo, TaskRecord, TaskState
from appliance.model.alerts import Alert, AlertLevel, Subject
from appliance.model.gateways import works_beside
from appliance.record.models import SILENT, problem_of, together

CRITICAL, WARNING = AlertLevel.CRITICAL, AlertLevel.WARNING

DISK_WARNING_MB = 2048
"""Free on the disk of a gateway's data, MiB: below it runs, records and logs are near their reserves."""
DISK_CRITICAL_MB = 512
DELIVERY = "delivery"
"""Kind of the alert that others are not delivered."""
CLOCK_S = 2.0
"""A clock that differs by more makes logs of several gateways hard to read, and times of day wrong."""
MOST = 500
"""Alerts of a fleet; beyond it only critical ones are added, up to twice as many."""
MOST_FAILED = 100
"""Failed tasks with an alert of their own; further ones are counted in one."""
MAX_WHAT = 400
ENDED_KEPT_S = 3600.0
"""How long the alert of something that has happened, such as a failed task, and that of a lost gateway are listed after
they were acknowledged."""
CALM_S = 5.0
"""A condition of a gateway or robot is over when it was not seen for so long: what comes and goes is one alert."""
SPACING_S = 10.0
"""Words of an alert that change, such as a count, are written at most so often; worse is written at once."""


class Finding(Struct, frozen=True, kw_only=True):
    """Something that operators have to know of."""

    kind: str
    level: AlertLevel
    what: str
    subject: Subject
    name: str
    remedy: str = ""
    since_ns: int = 0
    """When it began; 0: just now."""
    until_ns: int = 0

    @property
    def id(self) -> str:
        """Of its alert."""
        return alert_id(self.kind, self.name)


def alert_id(kind: str, name: str) -> str:
    """Return the id of the alert of a kind about something."""
    return f"{kind}.{name}"


class Facts(Struct, frozen=True, kw_only=True):
    """What a gateway knows of its fleet."""

    gateways: Mapping[str, GatewayStatus] = field(default_factory=dict[str, GatewayStatus])
    """Members, as they describe themselves."""
    lost: Mapping[str, int] = field(default_factory=dict[str, int])
    """Gateways that went away without draining, and when, Unix nanoseconds."""
    robots: Mapping[str, RobotInfo] = field(default_factory=dict[str, RobotInfo])
    robots_lost_ns: Mapping[str, int] = field(default_factory=dict[str, int])
    enquiries: Mapping[str, Enquiry] = field(default_factory=dict[str, Enquiry])
    """Questions to people that were heard of, those that need no answer any more too."""
    in_maintenance: frozenset[str] = frozenset()
    """Robots that operators have taken out of use: what is wrong with them is known."""
    clock_s: Mapping[str, float] = field(default_factory=dict[str, float])
    """By how much the clocks of gateways are ahead of this one's, seconds; this one's own is 0."""


def findings(facts: Facts) -> dict[str, Finding]:
    """Return all findings of facts, by id."""
    found: dict[str, Finding] = {}
    for rule in (_lost_gateways, _gateways, _clocks, _robots, _recorders, _questions):
        for each in rule(facts):
            found.setdefault(each.id, each)
    return found


def _lost_gateways(facts: Facts) -> Iterator[Finding]:
    for name, since_ns in facts.lost.items():
        if name not in facts.gateways:
            yield Finding(
                kind="gateway-lost",
                level=CRITICAL,
                what="does not answer",
                subject=Subject.GATEWAY,
                name=name,
                remedy="check power and network, then: systemctl status swiftbot-gateway",
                since_ns=since_ns,
            )


def _gateways(facts: Facts) -> Iterator[Finding]:
    for name, status in facts.gateways.items():

        def of(kind: str, level: AlertLevel, what: str, remedy: str, name: str = name) -> Finding:
            return Finding(
                kind=kind, level=level, what=what[:MAX_WHAT], subject=Subject.GATEWAY, name=name, remedy=remedy
            )

        if status.pool_problem:
            yield of("pool", CRITICAL, status.pool_problem, "`swiftbot doctor` there names the fix")
        if status.overloaded:
            yield of("overload", WARNING, status.overloaded, f"`swiftbot drain {name}` moves all runs away")
        if not status.limits_enforced:
            yield of("no-limits", WARNING, "container limits are not enforced (no cgroups)", "`swiftbot doctor` there")
        if status.site_problem:
            remedy = "`swiftbot site check FILE`, add what is missing ([fence]), then restart the gateway"
            yield of("site", WARNING, status.site_problem, remedy)
        if not works_beside(status):
            what = f"version {status.version} speaks protocol {status.protocol}, which the others do not"
            yield of("version", CRITICAL, what, "`swiftbot upgrade` brings all gateways to one version")
        if status.keys_problem:
            yield of("keys", WARNING, status.keys_problem, "`swiftbot keys list`, then `swiftbot keys renew ROLE NAME`")
        if status.parts_problem:
            yield of("parts", WARNING, status.parts_problem, "`swiftbot parts check` there; then sign what is to run")
        if status.disk_total_mb and status.disk_free_mb < DISK_WARNING_MB:
            level = CRITICAL if status.disk_free_mb < DISK_CRITICAL_MB else WARNING
            what = f"{status.disk_free_mb:,} MiB free of {status.disk_total_mb:,} on the disk of its data"
            yield of("disk", level, what, "remove files there; `swiftbot pool evict`, `record.max_bytes`")
        if status.delivery is not None and status.delivery.problem:
            what = f"alerts are not delivered: {status.delivery.problem}"
            yield of(DELIVERY, WARNING, what, "mend alerts.urls_file or the network; `swiftbot alerts test` there")
        slot = status.planner.slot if status.planner is not None else None
        if slot is not None and slot.state == "down":
            told = f": {slot.problem}" if slot.problem else ""
            yield of("model", WARNING, f"local model {slot.model} is down{told}", f"`swiftbot llm swap {name} FOLDER`")


def _clocks(facts: Facts) -> Iterator[Finding]:
    known = {name: offset for name, offset in facts.clock_s.items() if name in facts.gateways}
    if len(known) < 2:
        return
    middle = median(known.values())
    for name, offset in known.items():
        others = [each for other, each in known.items() if other != name]
        # Of two, nobody can say which is wrong: both are named.
        off = offset - (middle if len(known) > 2 else others[0])
        if abs(off) > CLOCK_S:
            what = f"clock is {abs(off):.0f} s {'ahead of' if off > 0 else 'behind'} the other gateways"
            yield Finding(
                kind="clock", level=WARNING, what=what, subject=Subject.GATEWAY, name=name,
                remedy="timedatectl there; `set-ntp true`",
            )  # fmt: skip


def _robots(facts: Facts) -> Iterator[Finding]:
    for name, robot in facts.robots.items():
        if name in facts.in_maintenance:
            continue

        def of(kind: str, level: AlertLevel, what: str, remedy: str, since_ns: int = 0, name: str = name) -> Finding:
            return Finding(
                kind=kind, level=level, what=what[:MAX_WHAT], subject=Subject.ROBOT, name=name, remedy=remedy,
                since_ns=since_ns,
            )  # fmt: skip

        if not robot.online:
            remedy = f"check the robot and its link; `swiftbot robots forget {name}` when it is gone for good"
            yield of("robot-offline", CRITICAL, "offline", remedy, facts.robots_lost_ns.get(name, 0))
            continue
        if robot.failsafe:
            yield of("failsafe", CRITICAL, robot.failsafe, "look after the robot; it flies or holds by itself")
        elif robot.seized:
            yield of("seized", WARNING, robot.seized, "its tasks wait until the pilot gives it back")
        if robot.warnings:
            yield of("robot-warning", WARNING, ", ".join(robot.warnings), "look after the robot")


def _recorders(facts: Facts) -> Iterator[Finding]:
    for note in together(note for status in facts.gateways.values() for note in status.recorders):
        if what := problem_of(note):
            broken = note.state == SILENT or bool(note.problem)
            yield Finding(
                kind="recorder",
                level=CRITICAL if broken else WARNING,
                what=f"recorder: {what}"[:MAX_WHAT],
                subject=Subject.RECORDER,
                name=_name(note),
                remedy="systemctl status swiftbot-recorder; make room" if broken else "`swiftbot log info FILE`",
            )
        if note.going:
            yield Finding(
                kind="logs-go", level=WARNING, what=note.going[:MAX_WHAT], subject=Subject.RECORDER, name=_name(note),
                remedy="copy them, `swiftbot log pin FILE`, or raise record.total_bytes or record.days",
            )  # fmt: skip


def _questions(facts: Facts) -> Iterator[Finding]:
    for name, each in facts.enquiries.items():
        if each.open:
            yield Finding(
                kind="question", level=WARNING, subject=Subject.QUESTION, name=name,
                what=f"{each.robot or each.task or 'a skill'} asks {each.to or 'anyone'}: {each.question}"[:MAX_WHAT],
                remedy=f"`swiftbot answer {name} ANSWER`" + (f" ({', '.join(each.choices)})" if each.choices else ""),
                since_ns=each.at_ns,
                until_ns=each.at_ns + int(each.expires_s * 1e9) if each.at_ns and each.expires_s else 0,
            )  # fmt: skip


def _name(note: RecorderNote) -> str:
    return note.id[:63]


def of_task(record: TaskRecord) -> Finding | None:
    """Return what a task's record gives reason for; None for one that needs nobody."""
    if record.state is TaskState.FAILED and record.remembered is None:
        failure = record.failure
        what = f"failed: {failure.message}" if failure is not None else "failed"
        return Finding(
            kind="task-failed", level=CRITICAL, what=f"{what} ({record.instruction[:80]})"[:MAX_WHAT],
            subject=Subject.TASK, name=record.id, since_ns=record.updated_ns,
            remedy=(failure.remedy if failure is not None else "") or f"`swiftbot task retry {record.id}`",
        )  # fmt: skip
    proposal = record.proposal
    if record.state.final or proposal is None or not proposal.waits:
        return None
    until_ns = proposal.at_ns + int(proposal.expires_s * 1e9) if proposal.expires_s and proposal.at_ns else 0
    return Finding(
        kind="plan-waits", level=WARNING,
        what=f"plan waits for approval: {proposal.note or 'every plan is approved first'} "
        f"({record.instruction[:80]})"[:MAX_WHAT],
        subject=Subject.TASK, name=record.id, since_ns=proposal.at_ns, until_ns=until_ns,
        remedy=f"`swiftbot task approve {record.id} --hash {proposal.hash[:12]}`, or reject",
    )  # fmt: skip


TASK_KINDS = ("task-failed", "plan-waits")
HAPPENED = frozenset({"task-failed", "tasks-failed", "schedule-missed"})
"""Kinds of what has happened and does not last: over once it is acknowledged."""
_BY_TASK = frozenset({*TASK_KINDS, "tasks-failed"})


def of_fleet(alert: Alert) -> bool:
    """Whether every gateway can see what it is about, so that the owner of its record looks after it."""
    return alert.kind not in _BY_TASK


def seen(alert: Alert, facts: Facts) -> bool:
    """Whether facts tell whether it is still so; of what nobody hears nothing is known."""
    match alert.subject:
        case Subject.GATEWAY:
            return alert.name in facts.gateways
        case Subject.ROBOT:
            return alert.name in facts.robots
        case Subject.RECORDER:
            return any(alert.name == _name(note) for each in facts.gateways.values() for note in each.recorders)
        case Subject.QUESTION:
            return alert.name in facts.enquiries
        case _:
            return False


def raised(finding: Finding, *, gateway: str, now_ns: int) -> Alert:
    """Return the alert of a finding that has none yet."""
    return Alert(
        id=finding.id, kind=finding.kind, level=finding.level, what=finding.what, subject=finding.subject,
        name=finding.name, remedy=finding.remedy, since_ns=finding.since_ns or now_ns, until_ns=finding.until_ns,
        changed_ns=now_ns, gateway=gateway,
    )  # fmt: skip


def renewed(alert: Alert, finding: Finding, *, gateway: str, now_ns: int) -> Alert | None:
    """Return an alert as a finding has it now; None where it says the same, or said something else a moment ago."""
    fresh = replace(
        alert, level=finding.level, what=finding.what, remedy=finding.remedy, until_ns=finding.until_ns
    )  # fmt: skip
    if fresh == alert:
        return None
    worse = finding.level is CRITICAL and alert.level is not CRITICAL
    if not worse and now_ns - alert.changed_ns < SPACING_S * 1e9:
        return None
    if worse:
        fresh = replace(fresh, acked=None, told_ns=0)
    return replace(fresh, changed_ns=now_ns, gateway=gateway)


def reported(kept: Mapping[str, Alert], finding: Finding, *, gateway: str, now_ns: int) -> Alert | None:
    """Return the alert of something that has happened, as it is to be written; None where it says the same already.

    What happens again after it was acknowledged is to be acknowledged again.
    """
    alert = kept.get(finding.id)
    fresh = raised(finding, gateway=gateway, now_ns=now_ns)
    if alert is None or (alert.acked is not None and finding.what != alert.what):
        return fresh
    return None if alert.what == finding.what else replace(fresh, since_ns=alert.since_ns)


class Change(Struct, frozen=True):
    """An alert as it is to be written, or cleared."""

    alert: Alert
    clear: bool = False


def changes(
    kept: Mapping[str, Alert],
    found: Mapping[str, Finding],
    facts: Facts,
    *,
    mine: Callable[[str], bool],
    absent_s: Callable[[str], float],
    gateway: str,
    now_ns: int,
    left_out: Callable[[str], None] = lambda _: None,
) -> list[Change]:
    """Return what is to be written of alerts that every gateway can see.

    Args:
        kept: the alerts as they are known, by id.
        found: what the facts give reason for.
        facts: what is known.
        mine: whether this gateway looks after an alert.
        absent_s: for how long the condition of an alert was not found, seconds.
        gateway: this one.
        now_ns: now, Unix nanoseconds.
        left_out: called with the id of each alert that there is no room for.
    """
    wanted: list[Change] = []
    room = Room(kept.values(), left_out)
    for name, finding in found.items():
        if not mine(name):
            continue
        alert = kept.get(name)
        if alert is None:
            if room.take(finding):
                wanted.append(Change(raised(finding, gateway=gateway, now_ns=now_ns)))
        elif given_up(alert, now_ns=now_ns):
            wanted.append(Change(alert, clear=True))
        elif (fresh := renewed(alert, finding, gateway=gateway, now_ns=now_ns)) is not None:
            wanted.append(Change(fresh))
    for name, alert in kept.items():
        if name not in found and mine(name) and over(alert, facts, absent_s=absent_s(name), now_ns=now_ns):
            wanted.append(Change(alert, clear=True))
    return wanted


def given_up(alert: Alert, *, now_ns: int) -> bool:
    """Whether a gateway that is lost is missed no more: somebody has acknowledged it long ago."""
    acked = alert.acked
    return alert.kind == "gateway-lost" and acked is not None and now_ns - acked.at_ns > ENDED_KEPT_S * 1e9


def over(alert: Alert, facts: Facts, *, absent_s: float, now_ns: int) -> bool:
    """Whether an alert whose condition is not found is over.

    One about something that is seen is over after a calm while; one about something that nobody hears of once it is
    acknowledged; one of what has happened some time after that.
    """
    if alert.kind in HAPPENED:
        return alert.acked is not None and now_ns - alert.acked.at_ns > ENDED_KEPT_S * 1e9
    if not of_fleet(alert):
        return False
    if not seen(alert, facts):
        return alert.acked is not None
    return absent_s >= CALM_S or alert.subject is Subject.QUESTION


class Room:
    """How many more alerts may be added; `left_out` is called with the id of one that there is no room for."""

    def __init__(self, kept: Iterable[Alert], left_out: Callable[[str], None]) -> None:
        self._count = sum(1 for _ in kept)
        self._left_out = left_out

    def take(self, finding: Finding) -> bool:
        """Whether there is room for one more, which is taken."""
        if self._count >= (2 * MOST if finding.level is CRITICAL else MOST):
            self._left_out(finding.id)
            return False
        self._count += 1
        return True


def task_change(
    kept: Mapping[str, Alert],
    task: str,
    finding: Finding | None,
    *,
    gateway: str,
    now_ns: int,
    left_out: Callable[[str], None] = lambda _: None,
) -> list[Change]:
    """Return what is to be written of the alerts of one task, whose coordinator this gateway is.

    Args:
        kept: the alerts as they are known, by id.
        task: whose record has changed.
        finding: what the record gives reason for.
        gateway: this one.
        now_ns: now, Unix nanoseconds.
        left_out: called with the id of an alert that there is no room for.
    """
    ids = [alert_id(kind, task) for kind in TASK_KINDS]
    wanted = [
        Change(kept[name], clear=True) for name in ids if name in kept and (finding is None or finding.id != name)
    ]
    if finding is None:
        return wanted
    alert = kept.get(finding.id)
    if alert is not None:
        fresh = renewed(alert, finding, gateway=gateway, now_ns=now_ns)
        return wanted if fresh is None else [*wanted, Change(fresh)]
    failed = sum(each.kind == "task-failed" for each in kept.values())
    if finding.kind == "task-failed" and failed >= MOST_FAILED:
        return [*wanted, _one_more(kept, gateway=gateway, now_ns=now_ns)]
    if Room(kept.values(), left_out).take(finding):
        wanted.append(Change(raised(finding, gateway=gateway, now_ns=now_ns)))
    return wanted


def task_over(alert: Alert, record: TaskRecord | None) -> bool:
    """Whether the alert of a task is over, by the record of the task; None: there is no record any more."""
    if record is None:
        return alert.kind not in HAPPENED  # what has happened is listed until it is acknowledged
    finding = of_task(record)
    return finding is None or finding.id != alert.id


_MOST_DIGITS = 9


def _one_more(kept: Mapping[str, Alert], *, gateway: str, now_ns: int) -> Change:
    """Count a failed task in the alert of those that have none of their own."""
    before = kept.get(alert_id("tasks-failed", gateway))
    # The record may be another member's: one that begins with no number counts from the start.
    said = before.what.split(" ", 1)[0] if before is not None and before.acked is None else ""
    count = 1 + (int(said) if said.isdecimal() and len(said) <= _MOST_DIGITS else 0)
    finding = Finding(
        kind="tasks-failed", level=CRITICAL, what=f"{count} more tasks failed, coordinated by {gateway}",
        subject=Subject.GATEWAY, name=gateway, remedy="`swiftbot task list`; acknowledge the others",
    )  # fmt: skip
    alert = raised(finding, gateway=gateway, now_ns=now_ns)
    return Change(alert if before is None or before.acked is not None else replace(alert, since_ns=before.since_ns))


def ordered(alerts: Iterable[Alert]) -> tuple[Alert, ...]:
    """Return alerts in the order of a list: not acknowledged first, then the more urgent, then the newer."""
    return tuple(
        sorted(alerts, key=lambda each: (each.acked is not None, each.level is not CRITICAL, -each.since_ns, each.id))
    )


def open_counts(alerts: Iterable[Alert]) -> tuple[int, int]:
    """Return how many nobody has acknowledged: critical ones, and warnings."""
    levels = [each.level for each in alerts if each.acked is None]
    return sum(each is CRITICAL for each in levels), sum(each is not CRITICAL for each in levels)


def stronger(one: bytes, other: bytes) -> bytes:
    """Return the version of an alert's record that stands after a partition: one that was acknowledged, else the newer.

    The same on both sides, in whatever order they hear.
    """

    def rank(value: bytes) -> tuple[bool, int, bytes]:
        try:
            alert = msgspec.json.decode(value, type=Alert)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return False, 0, value
        return alert.acked is not None, alert.changed_ns, value

    return max(one, other, key=rank)
