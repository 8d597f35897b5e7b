"""The parameters of simulated autopilots and the protocol that reads and writes them.

Names and meanings are ArduPilot's where it has them; `SIM_*` break things, as they do in its own simulator. All travel
as 32-bit floats.
"""

from collections import deque
from collections.abc import Mapping

from appliance.robots.mavlink.dialect import Message, make

_REAL32 = 9
REQUESTS = frozenset(("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET"))
"""What is answered. PARAM_VALUE is an answer itself, and has no address: vehicles that answered it would not end."""
PER_STEP = 12
"""Values sent at a time when all are asked for: a radio link carries no more."""

SHARED: dict[str, float] = {
    "ARMING_CHECK": 1,
    "BATT_CAPACITY": 5200,
    "BATT_MONITOR": 4,
    "BATT_FS_LOW_ACT": 2,
    "BATT_LOW_PCT": 8,
    "BATT_CRT_PCT": 4,
    "BATT_ARM_PCT": 20,
    "FENCE_ENABLE": 0,
    "FENCE_ACTION": 1,
    "FENCE_RADIUS": 300,
    "FENCE_TYPE": 3,
    "FS_GCS_ENABLE": 0,
    "FS_GCS_TIMEOUT": 5,
    "SYSID_MYGCS": 255,
    "SYSID_THISMAV": 1,
    "SIM_GPS_DISABLE": 0,
    "SIM_RC_FAIL": 0,
    "SIM_WIND_SPD": 0,
    "SIM_WIND_DIR": 0,
    "RC1_TRIM": 1500,
    "RC2_TRIM": 1500,
    "RC3_TRIM": 1500,
    "RC4_TRIM": 1500,
    "GRIP_ENABLE": 1,
    "CAM1_TYPE": 6,
    "MNT1_TYPE": 6,
    "LOG_BITMASK": 0,
    "MIS_RESTART": 0,
}
COPTER: dict[str, float] = {
    **SHARED,
    "FENCE_ALT_MAX": 100,
    "FS_THR_ENABLE": 1,
    "FS_EKF_ACTION": 1,
    "RTL_ALT": 800,
    "WPNAV_SPEED": 500,
    "WPNAV_SPEED_UP": 250,
    "WPNAV_SPEED_DN": 150,
    "WPNAV_RADIUS": 50,
    "LAND_SPEED": 50,
    "FRAME_CLASS": 1,
}
ROVER: dict[str, float] = {
    **SHARED,
    "FS_THR_ENABLE": 1,
    "FS_ACTION": 2,
    "CRUISE_SPEED": 2,
    "WP_SPEED": 2,
    "WP_RADIUS": 0.5,
}


class Parameters:
    """Of one vehicle. `values` may be read and written directly."""

    def __init__(self, defaults: Mapping[str, float], *, system: int) -> None:
        self.values = {name: float(value) for name, value in defaults.items()} | {"SYSID_THISMAV": float(system)}
        self._names = sorted(self.values)
        self._due: deque[int] = deque()

    def __getitem__(self, name: str) -> float:
        return self.values.get(name, 0.0)

    def handle(self, name: str, message: Message) -> list[Message]:
        """Take in PARAM_REQUEST_LIST, PARAM_REQUEST_READ or PARAM_SET; return the answers that are due at once."""
        if name == "PARAM_REQUEST_LIST":
            self._due = deque(range(len(self._names)))
            return []
        wanted = _text(message.param_id)
        if name == "PARAM_REQUEST_READ" and 0 <= message.param_index < len(self._names):
            return [self._value(self._names[int(message.param_index)])]
        if wanted not in self.values:
            return []  # autopilots are silent about what they do not have
        if name == "PARAM_SET":
            self.values[wanted] = float(message.param_value)
        return [self._value(wanted)]

    def step(self) -> list[Message]:
        """Return the next values of a list that was asked for."""
        return [self._value(self._names[self._due.popleft()]) for _ in range(min(PER_STEP, len(self._due)))]

    def _value(self, name: str) -> Message:
        return make(
            "PARAM_VALUE",
            param_id=name.encode(),
            param_value=self.values[name],
            param_type=_REAL32,
            param_count=len(self._names),
            param_index=self._names.index(name),
        )


def _text(raw: str | bytes) -> str:
    return (raw.decode("ascii", "replace") if isinstance(raw, bytes) else raw).split("\0")[0]
