"""The table of metrics. Pure.

Names follow OpenTelemetry; Prometheus' are made of them as its conventions want it: `swiftbot.disk.free` in bytes is
`swiftbot_disk_free_bytes`, a counter ends in `_total`. Each gateway tells its own: sums over gateways are right.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Literal

from msgspec import Struct

from appliance.observe.facts import Facts
from appliance.record.models import SILENT

Row = tuple[float, dict[str, str]]
"""A value and its labels."""
MIB = 2**20
UNFINISHED = ("accepted", "needs approval", "running", "paused", "blocked", "cancelling")
"""States of tasks as people see them: none of them is missing from the metrics where there is no such task."""
ENDED = ("succeeded", "failed", "cancelled")
START_S = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
"""Bounds of the histogram of starts: a warm one takes milliseconds, a cold one seconds."""
RUN_S = (0.1, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0)


class Metric(Struct, frozen=True):
    """One metric."""

    name: str
    kind: Literal["gauge", "counter"]
    unit: str
    """As UCUM writes it: `By`, `s`, `1` for a share; `{task}` for a count."""
    help: str
    read: Callable[[Facts], Iterable[Row]]


def _each(counts: Mapping[str, float], label: str) -> list[Row]:
    return [(value, {label: name}) for name, value in sorted(counts.items())]


def _containers(facts: Facts) -> list[Row]:
    counts = Counter((each.image, str(each.state)) for each in facts.containers)
    return [(count, {"image": image, "state": state}) for (image, state), count in sorted(counts.items())]


def _alerts(facts: Facts) -> list[Row]:
    counts = Counter((str(each.level), "no" if each.acked is None else "yes") for each in facts.alerts)
    known = [(level, acked) for level in ("critical", "warning") for acked in ("no", "yes")]
    return [(counts[level, acked], {"level": level, "acknowledged": acked}) for level, acked in known]


def _planner(facts: Facts) -> list[Row]:
    planner = facts.status.planner
    tiers = sorted(planner.tiers.items()) if planner is not None else []
    return [
        (count, {"tier": tier, "taken": taken})
        for tier, figures in tiers
        for taken, count in (("yes", figures.asked - figures.failed), ("no", figures.failed))
    ]


def _robots(facts: Facts) -> list[Row]:
    online = sum(facts.robots.values())
    return [(online, {"online": "yes"}), (len(facts.robots) - online, {"online": "no"})]


def _deliveries(facts: Facts) -> list[Row]:
    told = facts.status.delivery
    return [] if told is None else [(told.sent, {"outcome": "sent"}), (told.failed, {"outcome": "failed"})]


def _link_frames(facts: Facts) -> list[Row]:
    return [
        (count, {"link": link.url, "direction": direction})
        for link in facts.links
        for direction, count in (("in", link.frames_in), ("out", link.frames_out))
    ]


METRICS = (
    Metric("swiftbot.tasks", "gauge", "{task}", "Unfinished tasks that this gateway coordinates, by state",
           lambda facts: _each(dict.fromkeys(UNFINISHED, 0) | facts.tasks, "state")),
    Metric("swiftbot.tasks.ended", "counter", "{task}", "Tasks that ended here, by final state",
           lambda facts: _each(dict.fromkeys(ENDED, 0) | facts.ended, "state")),
    Metric("swiftbot.runs", "gauge", "{run}", "Runs in progress on this gateway",
           lambda facts: [(facts.status.running, {})]),
    Metric("swiftbot.pool.containers", "gauge", "{container}", "Containers of the pool",
           _containers),
    Metric("swiftbot.pool.capacity", "gauge", "{container}", "Containers that the pool may hold",
           lambda facts: [(facts.status.capacity, {})]),
    Metric("swiftbot.pool.queue", "gauge", "{run}", "Runs that wait for a container",
           lambda facts: [(facts.status.queue, {})]),
    Metric("swiftbot.planner.answers", "counter", "{plan}", "Answers of the planner's tiers, taken or not",
           _planner),
    Metric("swiftbot.gateways", "gauge", "{gateway}", "Gateways of the fleet that this one sees, itself included",
           lambda facts: [(facts.gateways, {})]),
    Metric("swiftbot.gateway.draining", "gauge", "{gateway}", "1 while this gateway gives its runs away",
           lambda facts: [(int(facts.status.draining), {})]),
    Metric("swiftbot.gateway.cpu.ratio", "gauge", "1", "CPU use of the machine, 0 to 1",
           lambda facts: [(facts.status.cpu_percent / 100, {})]),
    Metric("swiftbot.gateway.memory", "gauge", "By", "Resident memory of the gateway's process",
           lambda facts: [(facts.status.memory_mb * MIB, {})]),
    Metric("swiftbot.disk.free", "gauge", "By", "Free space on the disk of the gateway's data",
           lambda facts: [(facts.status.disk_free_mb * MIB, {})]),
    Metric("swiftbot.disk.size", "gauge", "By", "Size of that disk",
           lambda facts: [(facts.status.disk_total_mb * MIB, {})]),
    Metric("swiftbot.robots", "gauge", "{robot}", "Robots of the fleet that this gateway knows",
           _robots),
    Metric("swiftbot.link.up", "gauge", "{link}", "1 while a MAVLink link has no problem",
           lambda facts: [(int(not link.problem), {"link": link.url}) for link in facts.links]),
    Metric("swiftbot.link.frames", "counter", "{frame}", "MAVLink frames since the link was opened", _link_frames),
    Metric("swiftbot.link.refused", "counter", "{frame}", "MAVLink frames that were damaged, not believed or not sent",
           lambda facts: [(sum(link.refused.values()), {"link": link.url}) for link in facts.links]),
    Metric("swiftbot.recorder.recording", "gauge", "{recorder}", "1 while a recorder of the fleet records",
           lambda facts: [(int(not each.problem and each.state != SILENT), {"recorder": each.id})
                          for each in facts.status.recorders]),
    Metric("swiftbot.recorder.missed", "counter", "{message}", "Messages of the fleet that are not in a recorder's log",
           lambda facts: [(each.missed, {"recorder": each.id}) for each in facts.status.recorders]),
    Metric("swiftbot.alerts", "gauge", "{alert}", "Alerts kept by this gateway; over all gateways, the fleet's",
           _alerts),
    Metric("swiftbot.alerts.deliveries", "counter", "{message}", "Messages to addresses outside, by outcome",
           _deliveries),
    Metric("swiftbot.refused", "counter", "{input}", "Bad input that was refused, by kind",
           lambda facts: _each(_kinds(facts.status.refused), "kind")),
)  # fmt: skip


def _kinds(refused: Mapping[str, int]) -> Counter[str]:
    """Counters without the keys that may stand in their names: there are as many of those as somebody likes."""
    found = Counter[str]()
    for kind, count in refused.items():
        found[" ".join(word for word in kind.split() if "/" not in word)[:40]] += count
    return found
