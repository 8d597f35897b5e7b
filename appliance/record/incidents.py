"""What is worth keeping, and how to have what came before it: triggers, and a ring of the last seconds.

A recorder that keeps everything fills its disk with calm. Set to `incidents` it holds the last `before_s` seconds in
memory and writes nothing until something goes wrong; then all that it holds goes into a file, and everything that
comes until `after_s` after the last incident. Set to `all` it writes everything, and incidents are marked in the log.
Pure state with the clock passed in.
"""

import re
from collections import deque
from typing import Any

import msgspec
from msgspec import Struct

from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.recorder_api import Incident, Trigger
from appliance.record.models import LoggedMessage, compile_expression

EVERY = "every"
"""Recorder's name in a trigger that is meant for all recorders."""
_FAILED = re.compile(rb'"state"\s*:\s*"failed"')
_FAILSAFE = b"failsafe"
EACH = 300
"""Bytes that keeping a message takes beside its payload and its key, as measured."""
_MOST_REMEMBERED = 10_000


class _State(Struct):
    state: str = ""


class _Robot(Struct):
    failsafe: Any = None


class Triggers:
    """Says which messages are incidents: a task that failed, a failsafe, a soft stop, somebody who asks.

    A fact that is published again and again (a robot's state) is an incident when it begins.
    """

    def __init__(self, keys: Keys, recorder: str) -> None:
        self._record = compile_expression(keys(keyspace.TASK_UPDATE))
        self._robot = compile_expression(keys(keyspace.ROBOT))
        self._asked = tuple(compile_expression(keys(keyspace.RECORDER_TRIGGER, each)) for each in (recorder, EVERY))
        self._stop = compile_expression(keys(keyspace.STOP))
        self._told: dict[str, str] = {}

    def watches(self, key: str) -> str:
        """Return as what the messages of a key are looked at; "" when none of them can be an incident."""
        if self._record.fullmatch(key):
            return "record"
        if self._robot.fullmatch(key):
            return "robot"
        if any(each.fullmatch(key) for each in self._asked):
            return "asked"
        return "stop" if self._stop.fullmatch(key) else ""

    def incident(self, kind: str, message: LoggedMessage) -> Incident | None:
        """Return the incident that a message tells, or None."""
        if kind == "record":
            return self._once(
                message, "task failed" if _FAILED.search(message.payload) and _has_failed(message) else ""
            )
        if kind == "robot":
            return self._once(message, "failsafe" if _FAILSAFE in message.payload and _has_failsafe(message) else "")
        if kind == "stop":
            return self._once(message, "" if message.deleted else "stop")  # told again by the gateway that keeps it
        try:
            trigger = msgspec.json.decode(message.payload, type=Trigger)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return None  # one that is meant says why
        by = f" (by {trigger.by[:80]})" if trigger.by else ""
        return _incident(message, "asked", f"{trigger.reason[:300]}{by}")

    def _once(self, message: LoggedMessage, reason: str) -> Incident | None:
        before = self._told.pop(message.key, "")
        if reason:
            self._told[message.key] = reason
            if len(self._told) > _MOST_REMEMBERED:
                self._told.pop(next(iter(self._told)))
        return _incident(message, reason) if reason and reason != before else None


def _has_failed(message: LoggedMessage) -> bool:
    """Whether the task itself has: its subtasks have states, too."""
    try:
        return msgspec.json.decode(message.payload, type=_State).state == "failed"
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False


def _has_failsafe(message: LoggedMessage) -> bool:
    """Whether the robot says so, and not something in it."""
    try:
        return bool(msgspec.json.decode(message.payload, type=_Robot).failsafe)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False


def _incident(message: LoggedMessage, reason: str, detail: str = "") -> Incident:
    return Incident(reason=reason, detail=detail, key=message.key, at_ns=message.at_ns)


class Ring:
    """The messages of the last seconds, bounded by the memory they take too; the oldest go first and are no loss."""

    def __init__(self, *, seconds: float, most_bytes: int) -> None:
        self._seconds = seconds
        self._most_bytes = most_bytes
        self._held: deque[tuple[float, LoggedMessage]] = deque()
        self._bytes = 0

    def __len__(self) -> int:
        """Messages held."""
        return len(self._held)

    def hold(self, message: LoggedMessage, now: float) -> None:
        """Take a message, and let go of what is too old or too much."""
        self._held.append((now, message))
        self._bytes += _size(message)
        self._let_go(now)

    def _let_go(self, now: float) -> None:
        while self._held and (now - self._held[0][0] > self._seconds or self._bytes > self._most_bytes):
            _, gone = self._held.popleft()
            self._bytes -= _size(gone)

    def release(self, now: float) -> tuple[list[LoggedMessage], float]:
        """Return all that is held, in order, and how many seconds back it goes; the ring is empty then."""
        self._let_go(now)
        back_s = now - self._held[0][0] if self._held else 0.0
        out = [message for _, message in self._held]
        self._held.clear()
        self._bytes = 0
        return out, back_s


def _size(message: LoggedMessage) -> int:
    return len(message.payload) + len(message.key) + EACH


class Gate:
    """Lets messages through to the log: all of them, or those around incidents.

    Args:
        always: write everything.
        before_s: seconds kept for an incident.
        after_s: seconds that are written after the last one.
        ring_bytes: memory that what is held may take.
    """

    def __init__(self, *, always: bool, before_s: float, after_s: float, ring_bytes: int) -> None:
        self.always = always
        self._after_s = after_s
        self._ring = Ring(seconds=before_s, most_bytes=ring_bytes)
        self._until = float("-inf")
        self.incidents = 0
        self.last = ""

    @property
    def held(self) -> int:
        """Messages that wait for an incident."""
        return len(self._ring)

    def open(self, now: float) -> bool:
        """Whether what comes is written."""
        return self.always or now <= self._until

    def take(self, message: LoggedMessage, now: float) -> bool:
        """Note a message; whether it is to be written. One that is not is held."""
        if self.open(now):
            return True
        self._ring.hold(message, now)
        return False

    def happened(self, incident: Incident, now: float) -> tuple[Incident, list[LoggedMessage]]:
        """Note an incident; returns it with how far back the log goes, and what is to be written first."""
        self.incidents += 1
        self.last = f"{incident.reason}: {incident.detail}" if incident.detail else incident.reason
        before, back_s = self._ring.release(now)
        self._until = now + self._after_s
        return msgspec.structs.replace(incident, before_s=round(back_s, 3)), before
