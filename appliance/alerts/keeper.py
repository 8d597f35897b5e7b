"""The alerts of one gateway: facts in, records and puts out, and the verbs `alerts` and `alert_ack`.

An alert is a record of the DHT, so that it outlives gateways and every operator sees the same. The owner of the record
looks after an alert about a gateway, robot or recorder, which every gateway can see; the coordinator of a task after
those of the task. What is kept is known from the puts of all gateways and, in case one was missed, from the shard.
"""

import asyncio
import contextlib
import shutil
import time
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.alerts import rules
from appliance.alerts.rules import Change, Facts, Finding
from appliance.errors import ConflictError, PayloadError, SwiftbotError
from appliance.model import Enquiry, GatewayStatus, Signed, TaskRecord, Word, encode, keyspace
from appliance.model.alerts import Alert, AlertAck, AlertList, AlertsAcked, AlertsAsk
from appliance.plane.dht import Record
from appliance.plane.events import FactsChanged, FleetEvent, Joined, Lost, Relinked, RingChanged, Stage
from appliance.plane.node import Plane

log = structlog.get_logger(__name__)

LOOK_S = 1.0
"""How often facts are looked at while they do not change: what is over is over by the clock."""
PAUSE_S = 0.25
"""Facts of many robots change all the time: they are looked at no more often."""
RESYNC_S = 15.0
"""How often the shard is read, in case a put was missed."""
DOUBT_S = 45.0
"""For how long after a change of the ring each look at the shard also asks about alerts of other owners, and of tasks:
what was over in another part of a partitioned fleet was not heard of here."""
MOST_DOUBTED = 64
"""Alerts that are asked about at one look at the shard."""
LIST_S = 1.5
TRIES = 3
MOST_WAITING = 2000
"""Tasks whose records wait to be looked at."""
DISK_STEP_MB = 64
"""Free space is published in steps, so that it is no news at every run."""

Q = TypeVar("Q", bound=Signed)
R = TypeVar("R", bound=Struct)
Sign = Callable[[str, Callable[[Q], Coroutine[Any, Any, R]]], Callable[[Q], Any]]


def disk_mb(folder: Path) -> tuple[int, int]:
    """Return free and total space of a folder's disk, MiB, in steps; zeros where it cannot be read."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError:
        return 0, 0
    return int(usage.free / 2**20) // DISK_STEP_MB * DISK_STEP_MB, int(usage.total / 2**20)


class Keeper:
    """Keeps the alerts of one gateway.

    Args:
        plane: what it knows of the fleet, and keeps records by.
        in_maintenance: robots that are out of use, by name.
        on_alert: called with each alert as it is now, or is over.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        in_maintenance: Callable[[], Mapping[str, str]] = dict,
        on_alert: Callable[[Alert], None] | None = None,
    ) -> None:
        self._hear = on_alert
        self._in_maintenance = in_maintenance
        self._plane = plane
        self._kept: dict[str, Alert] = {}
        self._lost: dict[str, int] = {}
        self._last: dict[str, GatewayStatus] = {}
        """What each member said last: one that drains and goes is not lost."""
        self._absent: dict[str, float] = {}
        """Since when the condition of each alert is not found any more, monotonic seconds."""
        self._tasks: dict[str, TaskRecord] = {}
        """Tasks that have changed and were not looked at yet, by id, the latest record of each."""
        self._reports: dict[str, Finding] = {}
        """What has happened and is not written yet, by id, the latest of each."""
        self._enquiries: dict[str, Enquiry] = {}
        """Questions to people, the latest word of each."""
        self._late: set[str] = set()
        """Alerts of the fleet that could not be written."""
        self._left_out: set[str] = set()
        """Alerts that there was no room for, as far as they have been counted."""
        self._changed = asyncio.Event()
        self._synced_at = float("-inf")
        self._ring_changed_at = float("-inf")
        self._closers: list[Callable[[], None]] = []
        self._work: asyncio.Task[None] | None = None

    def start(self, signed: Callable[[str, Any], Any]) -> None:
        """Listen, answer the verbs, and look after the alerts.

        Args:
            signed: puts an audit around the handler of an operator's verb.
        """
        plane = self._plane
        self._closers = [
            plane.session.subscribe_typed(keyspace.ALERT, self._on_alert).close,
            plane.session.subscribe_typed(keyspace.ENQUIRY, self._on_enquiry).close,
            plane.events.subscribe(Stage.WATCHERS, self._on_event),
        ]
        plane.rpc.register(keyspace.ALERTS, self.alerts)
        plane.rpc.register(keyspace.ALERT_ACK, signed("alert_ack", self.acknowledge))
        self._work = asyncio.create_task(self._keep(), name="alerts")

    async def close(self) -> None:
        """Look after them no more; the records stay."""
        for close in self._closers:
            close()
        if self._work is not None:
            self._work.cancel()
            await asyncio.gather(self._work, return_exceptions=True)

    def moved(self, record: TaskRecord) -> None:
        """Take the record of a task that is coordinated here, as it has been written; returns at once."""
        # Of a task that waits to be looked at the alert may not be written yet.
        ids = [rules.alert_id(kind, record.id) for kind in rules.TASK_KINDS]
        known = record.id in self._tasks or any(map(self._kept.get, ids)) or record.retried_by is not None
        if rules.of_task(record) is None and not known:
            return
        if record.id in self._tasks or len(self._tasks) < MOST_WAITING:
            self._tasks[record.id] = record
            self._changed.set()
        else:
            self._plane.session.refuse("no room for an alert", task=record.id)

    def report(self, finding: Finding) -> None:
        """Take something that has happened here and that no other gateway can see; returns at once."""
        if finding.id in self._reports or len(self._reports) < rules.MOST:
            self._reports[finding.id] = finding
            self._changed.set()
        else:
            self._plane.session.refuse("no room for an alert", alert=finding.id)

    # --- what is heard ------------------------------------------------------------------------------------------

    def _on_alert(self, _key: str, alert: Alert | None) -> None:
        if alert is not None:
            self._take(alert)

    def _on_enquiry(self, _key: str, enquiry: Enquiry | None) -> None:
        if enquiry is None:
            return
        self._enquiries.pop(enquiry.id, None)  # so that it stands last
        self._enquiries[enquiry.id] = enquiry
        while len(self._enquiries) > rules.MOST:
            # What nobody waits for goes first; a question that is open is never dropped unsaid.
            over = next((name for name, each in self._enquiries.items() if not each.open), None)
            if over is None:
                self._plane.session.refuse("no room for an open question", question=next(iter(self._enquiries)))
            del self._enquiries[over or next(iter(self._enquiries))]
        self._changed.set()

    def _take(self, alert: Alert) -> None:
        if self._hear is not None:
            self._hear(alert)
        if alert.cleared_ns:
            self._kept.pop(alert.id, None)
            if rules.given_up(alert, now_ns=alert.cleared_ns):
                self._lost.pop(alert.name, None)
        elif alert.id in self._kept or len(self._kept) < 4 * rules.MOST:
            self._kept[alert.id] = alert
        else:
            self._plane.session.refuse("no room for an alert", alert=alert.id)

    def _on_event(self, event: FleetEvent) -> None:
        match event:
            case Lost(gateway):
                status = self._last.get(gateway)
                if status is not None and not status.draining:
                    self._lost[gateway] = time.time_ns()
            case Joined(gateway):
                self._lost.pop(gateway, None)
                self._last.pop(gateway, None)  # what it said in an earlier life
            case FactsChanged("gateway"):
                self._last |= self._plane.registry.gateways
            case FactsChanged("robot"):
                pass
            case RingChanged() | Relinked():
                self._synced_at = float("-inf")
                self._ring_changed_at = time.monotonic()
            case _:
                return
        self._changed.set()

    # --- looking after them -------------------------------------------------------------------------------------

    async def _keep(self) -> None:
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    await self._changed.wait()
            self._changed.clear()
            try:
                await self._look()
            except SwiftbotError as error:
                log.info("alerts are looked at again", reason=str(error))
            except Exception:  # supervision boundary: operators rely on it
                log.exception("alerts could not be looked at")
            await asyncio.sleep(PAUSE_S)

    async def _look(self) -> None:
        now = time.monotonic()
        if now - self._synced_at >= RESYNC_S:
            self._synced_at = now
            await self._sync()
        await self._look_at_fleet(now)
        await self._look_at_tasks()
        await self._look_at_reports()

    async def _look_at_reports(self) -> None:
        for name, finding in list(self._reports.items()):
            await self._recall(name)
            alert = rules.reported(self._kept, finding, gateway=self._plane.gateway, now_ns=time.time_ns())
            if (alert is None or await self._written(Change(alert))) and self._reports.get(name) is finding:
                del self._reports[name]

    async def _look_at_fleet(self, now: float) -> None:
        facts = self._facts()
        found = rules.findings(facts)
        self._absent = {name: self._absent.get(name, now) for name in self._kept if name not in found}
        self._late &= {*self._kept, *found}
        wanted = rules.changes(
            self._kept,
            found,
            facts,
            mine=self._mine,
            absent_s=lambda name: now - self._absent.get(name, now),
            gateway=self._plane.gateway,
            now_ns=time.time_ns(),
            left_out=self._leave_out,
        )
        for change in sorted(wanted, key=lambda each: each.alert.id in self._late):
            if not await self._written(change):
                self._late.add(change.alert.id)
                return
            self._late.discard(change.alert.id)

    def _leave_out(self, name: str) -> None:
        """Say, once for each, that there is no room for an alert."""
        if name not in self._left_out:
            if len(self._left_out) > rules.MOST:
                self._left_out.clear()
            self._left_out.add(name)
            self._plane.session.refuse("no room for an alert", alert=name)

    async def _look_at_tasks(self) -> None:
        gateway, now_ns = self._plane.gateway, time.time_ns()
        while self._tasks:
            task, record = next(iter(self._tasks.items()))
            finding = rules.of_task(record)
            if finding is None and record.retried_by is not None:
                await self._recall(rules.alert_id("task-failed", task))
            for change in rules.task_change(
                self._kept, task, finding, gateway=gateway, now_ns=now_ns, left_out=self._leave_out
            ):
                if not await self._written(change):
                    self._tasks[task] = self._tasks.pop(task)  # so that it stands last
                    return
            # Changed meanwhile, it is looked at again.
            if self._tasks.get(task) is record:
                del self._tasks[task]

    async def _recall(self, name: str) -> None:
        """Know an alert that was put before this gateway was there, and whose record others hold."""
        if name not in self._kept:
            with contextlib.suppress(SwiftbotError):
                if (alert := _decoded(await self._stored(name))) is not None:
                    self._take(alert)

    async def _written(self, change: Change) -> bool:
        """Write a change; False where it cannot be written now: it is tried again after all others.

        Its owner may be a gateway that answers but whose disk is full, and each try takes seconds.
        """
        try:
            await self._write(change)
        except SwiftbotError as error:
            log.info("alert is written later", alert=change.alert.id, reason=str(error))
            return False
        return True

    def _facts(self) -> Facts:
        registry, members = self._plane.registry, self._plane.members()
        return Facts(
            gateways={name: status for name, status in registry.gateways.items() if name in members},
            lost=self._lost,
            robots=registry.robots,
            robots_lost_ns=registry.lost_ns,
            enquiries=self._enquiries,
            in_maintenance=frozenset(self._in_maintenance()),
            clock_s={**registry.clock_s, self._plane.gateway: 0.0},
        )

    def _mine(self, name: str) -> bool:
        return self._plane.dht.owns(_key(name))

    async def _sync(self) -> None:
        """Read the shard: what was put while this gateway did not hear, and what is gone."""
        held = {alert.id: alert for alert in map(_decoded, await self._plane.dht.local(keyspace.ALERT_RECORD.prefix))
                if alert is not None}  # fmt: skip
        for name in [name for name in self._kept if self._mine(name) and name not in held]:
            del self._kept[name]
        for alert in held.values():
            known = self._kept.get(alert.id)
            if known is None or known.changed_ns <= alert.changed_ns:
                self._take(alert)
        if time.monotonic() - self._ring_changed_at < DOUBT_S:
            await self._drop_unowned([name for name in self._kept if not self._mine(name) and name not in held])
            await self._clear_tasks([each for each in self._kept.values() if self._mine(each.id)])

    async def _drop_unowned(self, names: list[str]) -> None:
        """Forget alerts of other owners that are over: they were cleared while this gateway did not hear."""
        for name in names[:MOST_DOUBTED]:
            known = self._kept.get(name)
            with contextlib.suppress(SwiftbotError):
                if await self._stored(name) is None and self._kept.get(name) is known:
                    self._kept.pop(name, None)

    async def _clear_tasks(self, alerts: list[Alert]) -> None:
        """Clear alerts of tasks that their records give no reason for: the coordinator had not heard of the alert.

        It moves the task on in one part of a partitioned fleet while the alert begins in another.
        """
        doubted = [each for each in alerts if each.kind in rules.TASK_KINDS and each.name not in self._tasks]
        for alert in doubted[:MOST_DOUBTED]:
            try:
                stored = await self._plane.dht.read(keyspace.TASK_RECORD.key(alert.name))
                record = msgspec.json.decode(stored.value, type=TaskRecord) if stored and not stored.deleted else None
            except (SwiftbotError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                continue
            if rules.task_over(alert, record):
                await self._written(Change(alert, clear=True))

    async def _write(self, change: Change) -> None:
        """Write an alert, or remove its record, then tell the fleet; one that was changed meanwhile is left to it."""
        alert = change.alert
        try:
            stored = await self._stored(alert.id)
        except PayloadError as error:
            self._plane.session.refuse("alert without a key", alert=alert.id, reason=error.message)
            self._kept.pop(alert.id, None)
            return
        before = _decoded(stored)
        try:
            if change.clear:
                if stored is not None:
                    await self._plane.dht.remove(_key(alert.id), expected=stored.version)
                alert = replace(before or alert, cleared_ns=time.time_ns(), gateway=self._plane.gateway)
            else:
                if before is not None and before.kind == alert.kind:
                    alert = _kept_on(before, alert)
                expected = stored.version if stored is not None else None
                await self._plane.dht.write(_key(alert.id), encode(alert), expected=expected)
        except ConflictError:
            self._synced_at = float("-inf")
            return
        self._take(alert)
        self._plane.session.publish(keyspace.ALERT, alert, alert.id)
        if change.clear:
            log.info("alert is over", alert=alert.id)
        elif before is None:
            log.warning("alert", alert=alert.id, level=str(alert.level), what=alert.what, remedy=alert.remedy)

    async def _stored(self, name: str) -> Record | None:
        stored = await self._plane.dht.read(_key(name))
        return stored if stored is not None and not stored.deleted else None

    # --- verbs --------------------------------------------------------------------------------------------------

    async def alerts(self, ask: AlertsAsk) -> AlertList:
        """Answer `alerts`: of this gateway's shard, and of all others where the whole is asked for."""
        records = await self._plane.dht.local(keyspace.ALERT_RECORD.prefix)
        owned = [_decoded(record) for record in records if self._plane.dht.owns(record.key)]
        found = {alert.id: alert for alert in owned if alert is not None}
        silent: list[str] = []
        if not ask.local:
            others = sorted(self._plane.members() - {self._plane.gateway})
            for member, answer in zip(others, await asyncio.gather(*map(self._local_of, others)), strict=True):
                if answer is None:
                    silent.append(member)
                else:
                    found |= {each.id: each for each in answer.alerts}
        return AlertList(alerts=rules.ordered(found.values()), unreachable=tuple(silent))

    async def _local_of(self, member: str) -> AlertList | None:
        try:
            return await self._plane.rpc.call(member, keyspace.ALERTS, AlertsAsk(local=True), timeout_s=LIST_S)
        except SwiftbotError:
            return None

    async def acknowledge(self, ask: AlertAck) -> AlertsAcked:
        """Answer `alert_ack`: note who has seen them; one that was acknowledged before keeps who did it first."""
        acked: list[Alert] = []
        unknown: list[str] = []
        word = Word(by=ask.by or "unsigned", why=ask.why, act=ask.act, at_ns=time.time_ns())
        for name in dict.fromkeys(ask.ids):
            alert = await self._acknowledge(name, word)
            if alert is None:
                unknown.append(name)
            else:
                acked.append(alert)
        return AlertsAcked(alerts=tuple(acked), unknown=tuple(unknown))

    async def delivered(self, alert: Alert) -> None:
        """Note in the record of an alert that it is delivered outside; one that has changed is left as it is.

        Raises:
            SwiftbotError: it cannot be written now.
        """
        stored = await self._stored(alert.id)
        known = _decoded(stored)
        if stored is None or known is None or (known.since_ns, known.level) != (alert.since_ns, alert.level):
            return
        if not known.told_ns:
            known = replace(known, told_ns=time.time_ns())
            await self._plane.dht.write(_key(alert.id), encode(known), expected=stored.version)
        self._take(known)
        self._plane.session.publish(keyspace.ALERT, known, known.id)

    async def _acknowledge(self, name: str, word: Word) -> Alert | None:
        """Acknowledge one; None where there is none of that id."""
        for _ in range(TRIES):
            try:
                stored = await self._stored(name)
            except PayloadError:
                return None
            alert = _decoded(stored)
            if stored is None or alert is None:
                return None
            if alert.acked is not None:
                return alert
            alert = replace(alert, acked=word, changed_ns=max(alert.changed_ns, word.at_ns))
            try:
                await self._plane.dht.write(_key(name), encode(alert), expected=stored.version)
            except ConflictError:
                continue
            self._take(alert)
            self._plane.session.publish(keyspace.ALERT, alert, alert.id)
            return alert
        raise ConflictError(f"alert {name[:80]} changes just now", remedy="try again")


def _kept_on(before: Alert, alert: Alert) -> Alert:
    """Return an alert with what the record has of it that the writer of the change did not know."""
    worse = alert.level is not before.level and before.level is not rules.CRITICAL
    if before.acked is not None and alert.acked is None and alert.kind in rules.HAPPENED and alert.what != before.what:
        return alert  # it has happened again since it was acknowledged
    return replace(alert, since_ns=min(before.since_ns, alert.since_ns) or alert.since_ns,
                   acked=None if worse else before.acked, told_ns=0 if worse else before.told_ns)  # fmt: skip


def _key(name: str) -> str:
    return keyspace.ALERT_RECORD.key(name)


def _decoded(stored: Record | None) -> Alert | None:
    if stored is None or stored.deleted:
        return None
    try:
        return msgspec.json.decode(stored.value, type=Alert)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
