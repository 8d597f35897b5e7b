"""Who commands a vehicle: the gateway, a person at it, or its own failsafes. A pure decider.

A gateway that goes on commanding while a pilot has taken the sticks fights with them. So it notices: a mode that it
did not order, sticks moved over the gateway (RC_CHANNELS_OVERRIDE, MANUAL_CONTROL), a failsafe in force. The vehicle
is then *seized*: the command in progress fails with the reason, further ones are refused, and nothing that the
gateway does of its own accord changes the mode. It is given back by whoever took it (the mode that the gateway had
ordered, or the guided mode, is chosen again; the motors are off; the failsafe is over), or taken back by an operator
(`release`).

A gateway that has just started, or a vehicle that has just been armed, has no order yet that a mode could be measured
by; but a gateway never orders a mode in which sticks move a vehicle, so whoever chose that one has it.

On the ground with the motors off nothing is seized: there a mode is a setting.
"""

from msgspec import Struct

from appliance.robots.mavlink.dialect import Message
from appliance.robots.mavlink.modes import Modes

OVERRIDES = frozenset({"RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"})
"""Messages by which a ground station moves a vehicle's sticks."""

STICKS_S = 3.0
"""Overrides come several times a second; after so long without one the sticks are let go."""
_REST = 60
"""Sticks are never quite in the middle: microseconds, or thousandths."""
_MIDDLE_US = 1500
_NO_CHANNEL = frozenset({0, 65535})
_NO_AXIS = 32767
CHANGE_S = 15.0
"""A mode that was ordered is to be taken up within so long; before, the old one is no takeover."""


class Seizure(Struct, frozen=True):
    """Who has the vehicle, and why, in words."""

    by: str
    """`pilot` or `failsafe`."""
    why: str


class Control:
    """Of one vehicle; times are monotonic seconds."""

    def __init__(self) -> None:
        self.seized: Seizure | None = None
        self._own: int | None = None
        """The mode in which it is the gateway's: ordered and taken up, or what it was taken back in; None: none yet."""
        self._wanted: int | None = None
        """The mode of a change in flight."""
        self._wanted_at = 0.0
        self._passing: frozenset[int] = frozenset()
        """Modes that may show until the change has been taken up: the one before, and changes ordered before it."""
        self._sticks_at: float | None = None
        self._failsafe = ""
        self._mode: int | None = None
        self._armed = False

    def order(self, mode: int, now: float) -> None:
        """Note that the gateway asks for a mode."""
        if self._wanted is None and mode in (self._own, self._mode):
            self._own = mode
            return
        # While another change is in flight the mode heard last says nothing: it may still be taken up.
        before = {each for each in (self._own, self._mode, self._wanted) if each is not None}
        self._passing = frozenset(before) | (self._passing if self._wanted is not None else frozenset())
        self._wanted, self._wanted_at = mode, now

    def hear(self, mode: int, armed: bool, failsafe: str, modes: Modes | None, now: float) -> bool:
        """Take in what a heartbeat says; returns whether the seizure changed.

        Args:
            mode: custom mode.
            armed: whether the motors are on.
            failsafe: failsafes in force in words.
            modes: of this kind of vehicle; None: they are not known, and nothing is decided.
            now: monotonic seconds.
        """
        before = self.seized
        landed = self._armed and not armed
        self._mode, self._armed, self._failsafe = mode, armed, failsafe
        if modes is None:
            return False
        if not armed:
            self._rest(mode, landed=landed)
            return before is not None
        if self._sticks_at is not None and now - self._sticks_at > STICKS_S:
            self._sticks_at = None
        given_back = mode in (self._own, self._wanted, modes.numbers[modes.guided])
        if self.seized is not None and given_back and not failsafe and self._sticks_at is None:
            self.seized = None
            # Where nothing was ordered yet there is still nothing that a mode could be measured by.
            ordered = self._own is not None or self._wanted is not None
            self._settle(mode if ordered else None)
        elif self.seized is None:
            self.seized = self._look(mode, modes, now)
        elif self.seized.by == "pilot" and failsafe:
            self.seized = Seizure("failsafe", _failsafe(failsafe, modes.name(mode)))
        return before != self.seized

    def _rest(self, mode: int, *, landed: bool) -> None:
        """Nobody has it while its motors are off; what the gateway orders for the next flight counts."""
        self.seized, self._sticks_at = None, None
        if landed:
            self._own, self._wanted = None, None
        elif mode == self._wanted:
            self._settle(mode)
        elif mode != self._own:
            self._own = None

    def _settle(self, mode: int | None) -> None:
        self._own, self._wanted, self._passing = mode, None, frozenset()

    def sticks(self, system: int, moved: bool, now: float) -> bool:
        """Take in an override that passed the gateway on its way to the vehicle; returns whether it is a seizure."""
        if not moved:
            return False
        self._sticks_at = now
        if not self._armed or self.seized is not None:
            return False
        self.seized = Seizure("pilot", f"somebody moves its sticks from system {system}")
        return True

    def release(self) -> Seizure | None:
        """Let an operator take it back; returns who had it. A failsafe in force seizes it again at once."""
        before, self.seized, self._sticks_at = self.seized, None, None
        # The mode it is in is not the one ordered before: it is the starting point of what comes next.
        self._settle(self._mode)
        return before

    def _look(self, mode: int, modes: Modes, now: float) -> Seizure | None:
        name = modes.name(mode)
        if self._failsafe:
            return Seizure("failsafe", _failsafe(self._failsafe, name))
        if self._wanted is not None:
            wanted = modes.name(self._wanted)
            if mode == self._wanted or name in modes.follows.get(wanted, frozenset()):
                self._settle(self._wanted)
            elif not self._may_show(mode, name, modes):
                return _changed(wanted, name)
            elif now - self._wanted_at <= CHANGE_S:
                return None
            else:
                # It was not taken up: what it stays in is the starting point of what comes next.
                self._settle(self._own if name in modes.by_hand else mode)
        if self._own is None:
            why = f"it is armed in {name}, where sticks move it, and this gateway did not choose that"
            return Seizure("pilot", why) if name in modes.by_hand else None
        own = modes.name(self._own)
        follows = mode == self._own or name in modes.follows.get(own, frozenset())
        return None if follows else _changed(own, name)

    def _may_show(self, mode: int, name: str, modes: Modes) -> bool:
        """Whether a mode may show while a change is in flight, without anybody but the gateway having chosen it.

        What was in force or ordered before may, with what the autopilot goes on to from its own mode by itself; the
        guided mode may, in which a pilot hands over.
        """
        before = "" if self._own is None else modes.name(self._own)
        return mode in self._passing or name == modes.guided or name in modes.follows.get(before, frozenset())


def _changed(before: str, now: str) -> Seizure:
    return Seizure("pilot", f"its mode was changed from {before} to {now}, not by this gateway")


def moved(name: str, message: Message) -> bool:
    """Whether an override holds a stick away from its middle; joysticks at rest are sent all the time."""
    if name == "MANUAL_CONTROL":
        return any(abs(value) > _REST for value in (message.x, message.y, message.r) if value != _NO_AXIS)
    channels = (message.chan1_raw, message.chan2_raw, message.chan4_raw)
    return any(abs(value - _MIDDLE_US) > _REST for value in channels if value not in _NO_CHANNEL)


def _failsafe(words: str, mode: str) -> str:
    return f"{words}: it is in {mode}" if words == "failsafe" else f"failsafe: {words}, it is in {mode}"
