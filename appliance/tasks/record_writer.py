"""A task's record as its coordinator holds it (`Draft`), and how it is written (`RecordWriter`).

Transitions are applied to the draft in memory, written as one, then published. This is what makes two coordinators
safe: nothing follows from a transition before the record with it is written under compare-and-set, and a record that
has moved on ends the coordinator.

Failures come from handlers (people's code), from robots, from other gateways and from the appliance's own errors. Where
the code that failed knew a remedy it is kept. Where it did not, the one of the failure's code is added here, so that no
task ends as failed without a next step that an operator can take.
"""

import time
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from appliance.errors import ConflictError, SwiftbotError
from appliance.model import Failure, TaskRecord, VersionVector, keyspace
from appliance.model.transitions import TAKES_OVER, StaleTransitionError, fingerprint
from appliance.plane.node import Plane
from appliance.plane.records import descends
from appliance.tasks import machine
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.records import Unknown, read_record, task_key, with_unknown

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
    "identity": "see the roles in docs/keyspace.md; `swiftbot keys show FILE` says whether a certificate is good",
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


class Draft:
    """A record with the transitions that are not written yet. No I/O.

    Args:
        record: as it was written last.
        gateway: who coordinates it.
        elapsed_s: since the task was accepted, as far as it is known here.
    """

    def __init__(self, record: TaskRecord, gateway: str, elapsed_s: float = 0.0) -> None:
        self.record = record
        self.gateway = gateway
        self.pending: list[Transition] = []
        """Applied, and not published yet."""
        self.dirty = False
        """Whether the record has to be written before they are published."""
        self.ready_ns: dict[str, int] = {}
        """When each subtask became ready, on this machine's monotonic clock."""
        self._since = time.monotonic() - max(record.elapsed_s, elapsed_s)
        """When the task was accepted, by this machine's monotonic clock."""

    @property
    def elapsed_s(self) -> float:
        """Seconds since the task was accepted: those that the record carries, and those since it was taken up here."""
        return time.monotonic() - self._since

    @property
    def settled(self) -> bool:
        """Whether all that is known is written, and nothing is awaited of this gateway's own runs."""
        here = any(subtask.gateway == self.gateway for subtask in machine.active(self.record))
        return not here and not self.pending and not self.dirty

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
            coordinator=self.gateway,
            elapsed_s=round(self.elapsed_s, 3),
            **fields,
        )

    def apply(self, kind: TransitionKind, *, durable: bool = True, **fields: Any) -> None:
        """Apply the next transition in memory; StaleTransitionError when it does not fit.

        Args:
            kind: of the transition.
            durable: whether the record must be written for it; else it is written with the next one that must.
            fields: of the transition.
        """
        before = {subtask.subtask.id for subtask in machine.ready(self.record)}
        transition = self.transition(kind, **fields)
        self.record = machine.apply(self.record, transition)
        self.pending.append(transition)
        self.dirty = self.dirty or durable
        for subtask in machine.ready(self.record):
            if subtask.subtask.id not in before:
                self.ready_ns[subtask.subtask.id] = time.monotonic_ns()

    def offer(self, kind: TransitionKind, *, durable: bool = True, **fields: Any) -> bool:
        """Apply the next transition if it fits; returns whether it did."""
        try:
            self.apply(kind, durable=durable, **fields)
        except StaleTransitionError:
            return False
        return True


class RecordWriter:
    """Writes and publishes the record of one draft.

    Args:
        plane: the fleet.
        draft: the record.
        version: of the record as it was read.
        unknown: fields of the record that this version of the appliance does not know, and keeps.
        on_written: called when the record is written, before it is published: what follows from it may begin.
        on_published: gets each transition that is written and published.
        on_change: gets the record that is written.
    """

    def __init__(
        self,
        plane: Plane,
        draft: Draft,
        version: VersionVector,
        *,
        unknown: Unknown | None = None,
        on_written: Callable[[], None] = lambda: None,
        on_published: Callable[[Transition], None] = lambda _: None,
        on_change: Callable[[TaskRecord], None] = lambda _: None,
    ) -> None:
        self._plane = plane
        self.draft = draft
        self.written = draft.record
        """The record as it was written and published last: what others may see, since a successor knows it too."""
        self.version = version
        """The record's version as it was written last."""
        self._unknown = unknown or Unknown()
        self._on_written = on_written
        self._on_published = on_published
        self._on_change = on_change
        self._writing = False
        self._latest: VersionVector = version
        """The newest version of this gateway's copy."""

    @property
    def value(self) -> bytes:
        """The record as it is stored."""
        return with_unknown(self.draft.record, self._unknown)

    @property
    def overtaken(self) -> bool:
        """Whether the record is known to have moved on under this writer: its draft is of the past.

        While a write is under way that is not known, since the copy here is changed by that write before it returns;
        `flush` looks when it has returned.
        """
        return not self._writing and not descends(self.version, self._latest)

    def copy_changed(self, version: VersionVector) -> bool:
        """Take in the version of this gateway's copy, which has just changed; returns whether it was `overtaken`."""
        if not descends(self.version, version):
            self._latest = version
        return self.overtaken

    async def flush(self) -> None:
        """Write the record, have begin what follows, then publish the record and the transitions that led to it.

        Raises SupersededError when the record has moved on.

        One write covers all transitions since the last: a finished subtask and the dispatch of its successors
        become durable together, which takes a replicated write off the successors' start.
        """
        draft = self.draft
        if wrote := draft.dirty:
            self._writing = True
            try:
                # Every write survives the death of processes. Only an end is synced to disk: what a power cut of
                # the whole site takes from the middle of a task is done again under the same effect ids.
                self.version = await self._plane.dht.write(
                    task_key(draft.record.id), self.value, expected=self.version, durable=draft.record.state.final
                )
            except ConflictError:
                await self._reread()
            finally:
                self._writing = False
            draft.dirty = False
        if self.overtaken:
            # Nothing follows from it, and it is not published: the coordinator by the record that stands sees to both.
            # What was written is published all the same: others may have gone on from it, so a log must have it.
            if wrote:
                self._publish()
            raise SupersededError("the record has changed under it")
        if not draft.pending:
            return
        self._on_written()
        self._publish()
        self._plane.session.put(self._plane.keys(keyspace.TASK_UPDATE, draft.record.id), self.value)
        self.written = draft.record
        self._on_change(draft.record)

    def _publish(self) -> None:
        """Publish the transitions that led to what is written."""
        for transition in self.draft.pending:
            self._plane.session.publish(keyspace.TRANSITION, transition, transition.task)
            self._on_published(transition)
        self.draft.pending.clear()

    async def _reread(self) -> None:
        """The record has moved on: stop, and let the coordinator that owns the key read it again."""
        record = self.draft.record
        current = await self._plane.dht.read(task_key(record.id))
        holder = ""
        if current is not None:
            found = read_record(current.value)
            holder = found.coordinator
            if (holder, found.sequence, found.updated_ns) == (record.coordinator, record.sequence, record.updated_ns):
                # It was written, and stands with what another version adds to it: a log must have what led there.
                self._publish()
        raise SupersededError(f"the record has moved on to {holder or 'nobody'}")
