"""Flight and driving modes by name: MAVLink tells them as a number that means something else for each kind of vehicle.

Numbers from ArduPilot (ArduCopter/mode.h, Rover/mode.h). A vehicle of a kind that is not here is watched and not
commanded: an order to a mode that means something else there is an accident.
"""

from msgspec import Struct

from appliance.robots.mavlink import dialect


class Modes(Struct, frozen=True, kw_only=True):
    """The modes of a kind of vehicle, and which of them the gateway uses for what."""

    numbers: dict[str, int]
    guided: str = "GUIDED"
    """Goes where it is told, and stays where it is when it has been told nothing."""
    mission: str = "AUTO"
    home: str = "RTL"
    land: str = ""
    """Empty: it does not fly."""
    follows: dict[str, frozenset[str]] = {}
    """Modes that the autopilot itself goes on to from another, without anybody having taken over."""
    by_hand: frozenset[str] = frozenset()
    """Modes in which a person's sticks, or hands, move it. GUIDED_NOGPS and FOLLOW are not: a computer does."""
    plain: frozenset[str] = frozenset()
    """Modes that anybody who commands it may choose: it stays, goes home, comes down, or waits for orders. In others it
    goes where nobody has checked that it may (AUTO flies whatever mission is on board), or does tricks."""

    def name(self, number: int) -> str:
        """Return a mode's name, its number where it has none."""
        return next((name for name, each in self.numbers.items() if each == number), str(number))


COPTER = Modes(
    numbers={
        **dialect.COPTER_MODES,
        "ACRO": 1,
        "CIRCLE": 7,
        "DRIFT": 11,
        "SPORT": 13,
        "FLIP": 14,
        "AUTOTUNE": 15,
        "THROW": 18,
        "GUIDED_NOGPS": 20,
        "FLOWHOLD": 22,
        "FOLLOW": 23,
        "ZIGZAG": 24,
        "AUTO_RTL": 27,
    },
    land="LAND",
    follows={"RTL": frozenset({"LAND"}), "SMART_RTL": frozenset({"RTL", "LAND"}), "BRAKE": frozenset({"LOITER"})},
    by_hand=frozenset(
        {
            "STABILIZE",
            "ACRO",
            "ALT_HOLD",
            "LOITER",
            "POSHOLD",
            "DRIFT",
            "SPORT",
            "FLOWHOLD",
            "FLIP",  # out of a mode flown by hand, and back to it
            "AUTOTUNE",
            "ZIGZAG",
            "CIRCLE",  # sticks change radius, speed and height; a circle that the gateway flies is a mission
            "THROW",  # armed in somebody's hand
        }
    ),
    plain=frozenset({"GUIDED", "BRAKE", "LAND", "RTL", "SMART_RTL"}),
)
ROVER = Modes(
    numbers={
        "MANUAL": 0,
        "ACRO": 1,
        "STEERING": 3,
        "HOLD": 4,
        "LOITER": 5,
        "FOLLOW": 6,
        "SIMPLE": 7,
        "AUTO": 10,
        "RTL": 11,
        "SMART_RTL": 12,
        "GUIDED": 15,
    },
    follows={"RTL": frozenset({"HOLD"}), "SMART_RTL": frozenset({"RTL", "HOLD"})},
    by_hand=frozenset({"MANUAL", "ACRO", "STEERING", "SIMPLE"}),
    plain=frozenset({"GUIDED", "HOLD", "LOITER", "RTL", "SMART_RTL"}),
)
GROUND = frozenset({dialect.constant("MAV_TYPE_GROUND_ROVER"), dialect.constant("MAV_TYPE_SURFACE_BOAT")})
"""What ArduRover drives."""


def modes_of(autopilot: int, kind: int) -> Modes | None:
    """Return the modes of a vehicle by its heartbeat (MAV_AUTOPILOT, MAV_TYPE), None when they are not known here."""
    if autopilot != dialect.AUTOPILOT_ARDUPILOT:
        return None
    if kind in dialect.MULTIROTORS:
        return COPTER
    return ROVER if kind in GROUND else None
