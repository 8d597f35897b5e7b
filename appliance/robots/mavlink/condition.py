"""How a vehicle is: what its estimator, battery, fence and failsafes say, as flags in words.

Everything here is the vehicle's own account (EKF_STATUS_REPORT, ESTIMATOR_STATUS, FENCE_STATUS, BATTERY_STATUS,
HEARTBEAT.system_status, SYS_STATUS); nothing is concluded from silence. Pure.
"""

from msgspec import Struct

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message

_ESTIMATOR = {
    0x01: "no attitude",
    0x02: "no horizontal velocity",
    0x04: "no vertical velocity",
    0x10: "no position",
    0x20: "no height",
}
"""Bits of EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS, which agree on them, and what it means that one is missing."""
_RELATIVE = 0x08
"""A position relative to the start stands in for an absolute one."""
_CONST_POSITION = 0x80
_GLITCH = 0x400
_CRITICAL, _EMERGENCY, _TERMINATING = (
    dialect.constant(f"MAV_STATE_{name}") for name in ("CRITICAL", "EMERGENCY", "FLIGHT_TERMINATION")
)
_CHARGE = {2: "battery low", 3: "battery critical", 4: "battery emergency", 5: "battery failed", 6: "battery unhealthy"}
"""MAV_BATTERY_CHARGE_STATE."""
_LOW_IS_NO_FAILSAFE = frozenset({"battery low"})
_FENCE = {1: "below the fence's floor", 2: "above the fence's ceiling", 3: "outside the fence"}
"""FENCE_BREACH."""
PREARM_CHECK = dialect.constant("MAV_SYS_STATUS_PREARM_CHECK")


class Condition:
    """Flags of one vehicle. `hear` returns whether any of them changed."""

    def __init__(self) -> None:
        self.estimator: tuple[str, ...] = ()
        """What the estimator does not know, empty when it is well or has said nothing."""
        self.estimating = False
        """It has said something."""
        self.prearm: bool | None = None
        """Whether the autopilot would arm; None when it does not say."""
        self._state = ""
        self._charge = ""
        self._fence = ""

    @property
    def failsafe(self) -> str:
        """The failsafes in force in words, empty when there is none."""
        charge = "" if self._charge in _LOW_IS_NO_FAILSAFE else self._charge
        return ", ".join(each for each in (self._state, charge, self._fence) if each)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is not well and no failsafe."""
        return (self._charge,) if self._charge in _LOW_IS_NO_FAILSAFE else ()

    def hear(self, name: str, message: Message) -> bool:
        """Take in a message of the autopilot."""
        before = (self.estimator, self.failsafe, self.warnings, self.prearm)
        match name:
            case "HEARTBEAT":
                self._state = _STATES.get(int(message.system_status), "")
            case "EKF_STATUS_REPORT" | "ESTIMATOR_STATUS":
                self.estimating = True
                self.estimator = estimator(int(message.flags))
            case "BATTERY_STATUS":
                if message.id == 0:
                    self._charge = _CHARGE.get(int(getattr(message, "charge_state", 0)), "")
            case "FENCE_STATUS":
                self._fence = _FENCE.get(int(message.breach_type), "fence breached") if message.breach_status else ""
            case "SYS_STATUS":
                if message.onboard_control_sensors_enabled & PREARM_CHECK:
                    self.prearm = bool(message.onboard_control_sensors_health & PREARM_CHECK)
            case _:
                return False
        return before != (self.estimator, self.failsafe, self.warnings, self.prearm)


_STATES = {_CRITICAL: "failsafe", _EMERGENCY: "emergency", _TERMINATING: "flight termination"}


class Summary(Struct, frozen=True):
    """What of it goes into the roster."""

    estimator: tuple[str, ...]
    failsafe: str


def estimator(flags: int) -> tuple[str, ...]:
    """Return in words what an estimator's flags say is missing or wrong."""
    missing = [
        words
        for bit, words in _ESTIMATOR.items()
        if not flags & bit and not (bit == 0x10 and flags & _RELATIVE and not flags & _CONST_POSITION)
    ]
    if flags & _CONST_POSITION and "no position" not in missing:
        missing.append("no position")
    if flags & _GLITCH:
        missing.append("GPS glitch")
    return tuple(missing)
