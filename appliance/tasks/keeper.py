"""Keeps a task's record for its driver: applies transitions in memory, writes them as one, then publishes them.

It is the half of driving that makes two coordinators safe: nothing follows from a transition before the record
with it is written under compare-and-set, and a record that has moved on ends the driver.
"""

import time
from collections.abc import Callable
from typing import Any

from appliance.errors import ConflictError, SwiftbotError
from appliance.model import TaskRecord, VersionVector, encode
from appliance.plane.node import Plane
from appliance.plane.versions import descends
from appliance.tasks import machine
from appliance.tasks.bounds import read_record
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.remedies import remedied
from appliance.tasks.surroundings import task_key
from appliance.tasks.transition import TAKES_OVER, fingerprint
from appliance.tasks.unknown import Unknown, with_unknown


class SupersededError(SwiftbotError):
    """Another gateway coordinates the task now."""

    code = "superseded"


class Keeper:
    """A record, its version, and the transitions that are not written yet."""

    def __init__(
        self,
        plane: Plane,
        record: TaskRecord,
        version: VersionVector,
        on_change: Callable[[TaskRecord], None],
        elapsed_s: float = 0.0,
    ) -> None:
        self._plane = plane
        self.record = record
        self.told = record
        """The record as it was written and published last: what others may be told, since a successor knows it too."""
        self._version = version
        self._on_change = on_change
        self._pending: list[Transition] = []
        self._dirty = False
        self._writing = False
        self._heard: VersionVector = version
        """The version of this gateway's copy that was heard of last."""
        self.unknown = Unknown()
        """Fields of the record that this version does not know, and keeps."""
        self.ready_ns: dict[str, int] = {}
        """When each subtask became ready, on this machine's clock."""
        self._since = time.monotonic() - max(record.elapsed_s, elapsed_s)
        """When the task was accepted, by this machine's monotonic clock."""
        self.on_written: Callable[[], None] = lambda: None
        """The record is written: what follows from it may begin."""
        self.on_published: Callable[[Transition], None] = lambda _: None
        """A transition that is written was published."""

    @property
    def version(self) -> VersionVector:
        """The record's version as it was written last."""
        return self._version

    @property
    def overtaken(self) -> bool:
        """Whether the record is known to have moved on under this keeper: what it holds in memory is of the past.

        While a write is under way that is not known, since the copy here is changed by that write before it returns;
        `flush` looks when it has returned.
        """
        return not self._writing and not descends(self._version, self._heard)

    def heard(self, version: VersionVector) -> bool:
        """Take in the version of this gateway's copy, which has just changed; returns whether it was `overtaken`."""
        if not descends(self._version, version):
            self._heard = version
        return self.overtaken

    @property
    def elapsed_s(self) -> float:
        """Seconds since the task was accepted: those that the record carries, and those since it was taken up here."""
        return time.monotonic() - self._since

    @property
    def settled(self) -> bool:
        """Whether all that is known is written, and nothing is awaited of this gateway's own runs."""
        here = any(each.gateway == self._plane.gateway for each in machine.active(self.record))
        return not here and not self._pending and not self._dirty

    def transition(self, kind: TransitionKind, **fields: Any) -> Transition:
        """Return the next transition of the record; a failure in it without a remedy is given that of its code."""
        if (failure := fields.get("failure")) is not None:
            fields["failure"] = remedied(failure, self.record.id)
        if kind in TAKES_OVER:
            fields["base"] = fingerprint(self.record)
        return Transition(
            task=self.record.id,
            sequence=self.record.sequence + 1,
            kind=kind,
            at_ns=time.time_ns(),
            coordinator=self._plane.gateway,
            elapsed_s=round(self.elapsed_s, 3),
            **fields,
        )

    def apply(self, transition: Transition, *, durable: bool = True) -> None:
        """Apply a transition in memory; `flush` writes and publishes it before anything follows from it."""
        before = {each.subtask.id for each in machine.ready(self.record)}
        self.record = machine.apply(self.record, transition)
        self._pending.append(transition)
        self._dirty = self._dirty or durable
        for each in machine.ready(self.record):
            if each.subtask.id not in before:
                self.ready_ns[each.subtask.id] = time.monotonic_ns()

    async def flush(self) -> None:
        """Write the record, then publish what led to it and send the orders that follow.

        Raises SupersededError when the record has moved on.

        One write covers all transitions since the last: a finished subtask and the dispatch of its successors
        become durable together, which takes a replicated write off the successors' start.
        """
        if written := self._dirty:
            self._writing = True
            try:
                # Every write survives the death of processes. Only an end is synced to disk: what a power cut of
                # the whole site takes from the middle of a task is done again under the same effect ids.
                self._version = await self._plane.dht.write(
                    task_key(self.record.id),
                    with_unknown(self.record, self.unknown),
                    expected=self._version,
                    durable=self.record.state.final,
                )
            except ConflictError:
                await self._reread()
            finally:
                self._writing = False
            self._dirty = False
        if self.overtaken:
            # Nothing follows from it, and the record is no news: whoever drives by the one that stands sees to both.
            # What was written is told all the same: others may have gone on from it, so a log must have it.
            if written:
                self._publish()
            raise SupersededError("the record has changed under it")
        if not self._pending:
            return
        self.on_written()
        self._publish()
        self._plane.session.put(self._plane.keys.task(self.record.id), with_unknown(self.record, self.unknown))
        self.told = self.record
        self._on_change(self.record)

    def _publish(self) -> None:
        """Publish the transitions that led to what is written."""
        for transition in self._pending:
            self._plane.session.put(self._plane.keys.transition(self.record.id), encode(transition))
            self.on_published(transition)
        self._pending.clear()

    def take(self, transition: Transition, *, durable: bool = True) -> bool:
        """Apply a transition if it fits; returns whether it did."""
        if fits := machine.fits(self.record, transition):
            self.apply(transition, durable=durable)
        return fits

    async def _reread(self) -> None:
        """The record has moved on: stop, and let the coordinator that owns the key read it anew."""
        current = await self._plane.dht.read(task_key(self.record.id))
        holder = ""
        if current is not None:
            found = read_record(current.value)
            holder = found.coordinator
            if (holder, found.sequence, found.updated_ns) == (
                self.record.coordinator, self.record.sequence, self.record.updated_ns,
            ):  # fmt: skip
                # It was written, and stands with what another version adds to it: a log must have what led there.
                self._publish()
        raise SupersededError(f"the record has moved on to {holder or 'nobody'}")
