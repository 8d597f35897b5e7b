"""From what is heard to what is written: secrets out, holes noticed, incidents marked, and held back if asked.

Runs on the recorder's writer thread, a message at a time, in the order in which they came. What is asked of a key
(does it have numbers, can it tell of an incident, is it JSON) is worked out once a key.
"""

import time
from collections.abc import Callable, Iterable

import msgspec
from msgspec import Struct

from appliance.plane.keys import Keys
from appliance.record.expressions import compile_expression
from appliance.record.facts import Incident, LoggedMessage
from appliance.record.incidents import Gate, Triggers
from appliance.record.openlog import Attached
from appliance.record.redact import Redactor
from appliance.record.sequences import Sequences
from appliance.record.settings import RecordConfig
from appliance.record.writer import VEHICLE, LogWriter

MOST_KEYS = 50_000
"""Keys whose plan is remembered; beyond, all are worked out anew. Each task has some of its own."""
_PLAN = b'"plan"'


class _Way(Struct, frozen=True):
    """What is to be done with the messages of a key."""

    raw: bool
    numbers: str
    incident: str
    plans: bool


class _Planned(Struct):
    task: str = ""
    sequence: int = 0
    plan: msgspec.Raw = msgspec.Raw()


class Pipeline:
    """What a recorder does with each message.

    Args:
        config: mode and times.
        fleet: whose messages.
        writer: gets what is to be in the log.
        secrets: values that must not be (see `redact`).
        clock: monotonic seconds.
    """

    def __init__(
        self,
        config: RecordConfig,
        *,
        fleet: str,
        writer: LogWriter,
        secrets: Iterable[str] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        keys = Keys(fleet)
        self.writer = writer
        self.redactor = Redactor(secrets)
        self.gate = Gate(
            always=config.mode == "all",
            before_s=config.before_s,
            after_s=config.after_s,
            ring_bytes=config.ring_bytes,
        )
        self._sequences = Sequences(keys)
        self._triggers = Triggers(keys, config.name)
        self._clock = clock
        self._ways: dict[str, _Way] = {}
        self._raw = tuple(map(compile_expression, (keys.mavlink(), keys.link_frames(), keys.camera())))
        self._transitions = compile_expression(keys.transition())

    def write(self, message: LoggedMessage) -> None:
        """Take a message on its way."""
        way = self._ways.get(message.key) or self._way_of(message.key)
        payload = message.payload
        clean = self.redactor.text(payload) if way.raw else self.redactor.json(payload)
        if clean is not payload:
            message = LoggedMessage(message.key, message.at_ns, clean, message.encoding, message.deleted)
        # A session that numbers what it puts is followed by those numbers, of whatever key; a vehicle has its own.
        if way.numbers and not message.deleted and (not message.number or way.numbers == VEHICLE):
            hole = self._sequences.heard(way.numbers, message.key, clean)
            if hole is not None:
                self.writer.miss(hole.source, hole.missing, hole.key, message.at_ns)
        incident = self._triggers.incident(way.incident, message) if way.incident else None
        if incident is not None:
            self._happened(incident)
        if self.gate.always or self.gate.take(message, self._clock()):
            self._log(message, way)

    def tick(self) -> None:
        """See to files that are due; end the one of an incident that is over."""
        if not self.gate.open(self._clock()) and self.writer.recording:
            self.writer.close()
        self.writer.tick()

    def _happened(self, incident: Incident) -> None:
        incident, before = self.gate.happened(incident, self._clock())
        for each in before:
            self._log(each, self._ways.get(each.key) or self._way_of(each.key))
        self.writer.mark(incident)

    def _log(self, message: LoggedMessage, way: _Way) -> None:
        if way.plans and _PLAN in message.payload:
            self._attach_plan(message)
        self.writer.write(message)

    def _attach_plan(self, message: LoggedMessage) -> None:
        try:
            told = msgspec.json.decode(message.payload, type=_Planned)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return
        if bytes(told.plan) not in (b"", b"null"):
            name = f"plan-{told.task[:80]}-{told.sequence}.json"
            self.writer.attach(Attached(name, "application/json", bytes(told.plan)))

    def _way_of(self, key: str) -> _Way:
        way = _Way(
            raw=any(each.fullmatch(key) for each in self._raw),
            numbers=self._sequences.kind_of(key),
            incident=self._triggers.watches(key),
            plans=self._transitions.fullmatch(key) is not None,
        )
        if len(self._ways) >= MOST_KEYS:
            self._ways.clear()
        self._ways[key] = way
        return way
