"""Writes a task's record for its coordinator: applies transitions in memory, writes them as one, then publishes them.

This is what makes two coordinators safe: nothing follows from a transition before the record with it is written under
compare-and-set, and a record that has moved on ends the driver.

Failures come from handlers (people's code), from robots, from other gateways and from the appliance's own errors. Where
the code that failed knew a remedy it is kept. Where it did not, the one of the failure's code is added here, so that no
task ends as failed without a next step that an operator can take.
"""

import time
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from appliance.errors import ConflictError, SwiftbotError
from appliance.model import Failure, TaskRecord, VersionVector, encode
from appliance.plane.node import Plane
from appliance.plane.records import descends
from appliance.tasks import machine
from appliance.tasks.context import task_key
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.records import Unknown, read_record, with_unknown
from appliance.tasks.transition import TAKES_OVER, fingerprint

_AGAIN = "`swiftbot task retry {task}` tries it again"
_LOG = "the last lines of its run and the gateway's log say more (`swiftbot task watch {task}`)"
_SKILL = f"correct the skill's handler: {_LOG}"
_ROBOT = f"check the robot (`swiftbot robots`), then {_AGAIN}"
_FLEET = f"check that all gateways run (`swiftbot fleet`), then {_AGAIN}"

BY_CODE: dict[str, str] = {
    # Of the error tree (`appliance.errors`).
    "internal": f"this is a fault of the gateway: {_LOG}; {_AGAIN}",
    "config": "correct the key that the message names; `swiftbot doctor` checks the configuration",
    "payload": "correct what the message names, then submit it again",
    "prerequisite": "`swiftbot doctor` says what the machine lacks",
    "unreachable": _FLEET,
    "deadline": f"give it more time (`timeout_s` of the skill, `--deadline` of the task), then {_AGAIN}",
    "conflict": _AGAIN,
    "superseded": _AGAIN,
    "stale": _AGAIN,
    "withdrawn": _AGAIN,
    "not-found": "check the name; `swiftbot fleet` and `swiftbot robots` list what there is",
    "refused": f"remove the reason that the message gives, then {_AGAIN}",
    "unapproved": "`swiftbot task retry {task}` asks for approval again (`swiftbot task approve {task}`)",
    "plan": "rephrase the instruction, or correct the plan, and submit it again",
    "pool": f"check the containers (`swiftbot pool`, `swiftbot doctor`), then {_AGAIN}",
    "robot": _ROBOT,
    "contract": "`swiftbot robots check NAME` says what the robot's program does not keep to",
    "precondition": "add the step that is missing, such as the way there, and submit it again",
    "taken": f"wait until its pilot gives the robot back, then {_AGAIN}",
    "record": "check that the disk has room; `swiftbot doctor` says more",
    "cancelled": _AGAIN,
    # Of runs.
    "skill": _SKILL,
    "crashed": _SKILL,
    "hung": f"raise timeout_s in its skill.toml, or find out what its handler waits for: {_LOG}",
    "memory": "raise memory_mb in its skill.toml",
    "preload": "correct the skill's `preload`: the gateway's log says what could not be loaded",
    "disk": "make room on the disk of the volumes, or have the skill write less",
    "stopped": f"its container was ended: {_AGAIN}",
    "orphaned": f"its gateway lost it: {_AGAIN}",
    "stuck": f"raise silent_s in its skill.toml, or find out what its handler waits for: {_LOG}",
    "straggling": _LOG,
    "busy": f"wait until the robot is free, then {_AGAIN}",
}
"""A remedy for each code that the appliance itself uses; `{task}` becomes the task's id."""
OTHER = f"{_LOG}; {_AGAIN}"
"""For a code that a handler or a robot made up."""


def remedied(failure: Failure, task: str) -> Failure:
    """Return a failure with a remedy: its own, or the one of its code."""
    if failure.remedy.strip():
        return failure
    return replace(failure, remedy=BY_CODE.get(failure.code, OTHER).replace("{task}", task))


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
