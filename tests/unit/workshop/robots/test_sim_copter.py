"""The simulated copter's autopilot, by its messages."""

from typing import Any

import pytest

from appliance.model import Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import COPTER_MODES, Codec, Frame, Message, make
from workshop.robots.copter import SimCopter

_CODEC = Codec(245, 191)


class Pilot:
    """Speaks to a copter in frames, without a network."""

    def __init__(self, battery_percent: float = 100.0) -> None:
        self.copter = SimCopter(system=1, site=Site(), home=(0.0, 0.0), battery_percent=battery_percent)
        self.now = 0.0

    def send(self, name: str, **fields: Any) -> list[Message]:
        """Send a message; returns the answers."""
        (frame,) = _CODEC.read(_CODEC.pack(make(name, **fields)))
        assert isinstance(frame, Frame)
        return self.copter.handle(frame, self.now)

    def command(self, number: int, *values: float) -> int:
        """Send COMMAND_LONG; returns the result."""
        padded = (*values, *([0.0] * 7))[:7]
        answers = self.send(
            "COMMAND_LONG",
            target_system=1,
            target_component=1,
            command=number,
            confirmation=0,
            **{f"param{index + 1}": value for index, value in enumerate(padded)},
        )
        (ack,) = [each for each in answers if each.get_type() == "COMMAND_ACK"]
        assert (ack.command, ack.target_system, ack.target_component) == (number, 245, 191)
        return int(ack.result)

    def mode(self, name: str) -> int:
        """Change the mode."""
        return self.command(dialect.SET_MODE, 1, COPTER_MODES[name])

    def fly(self, seconds: float) -> list[Message]:
        """Let time pass; returns what it said."""
        said: list[Message] = []
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            said += self.copter.step(0.1, self.now)
        return said

    def item(self, number: int, command: int, x: int = 0, y: int = 0, z: float = 5.0, **values: float) -> list[Message]:
        """Send a mission item; x and y in 1e-7 degrees from the site's origin."""
        return self.send(
            "MISSION_ITEM_INT",
            target_system=1,
            target_component=1,
            seq=number,
            frame=dialect.FRAME_RELATIVE,
            command=command,
            current=0,
            autocontinue=1,
            **({"param1": 0.0, "param2": 0.0, "param3": 0.0, "param4": 0.0} | values),
            x=473977420 + x,
            y=85455940 + y,
            z=z,
            mission_type=0,
        )

    def count(self, number: int) -> list[Message]:
        """Begin an upload."""
        return self.send("MISSION_COUNT", target_system=1, target_component=1, count=number, mission_type=0)


def test_arming_and_taking_off_have_conditions() -> None:
    """Take-off needs GUIDED and armed motors, arming an armable mode and a charged battery; disarming the ground."""
    pilot = Pilot()
    assert pilot.command(dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == dialect.FAILED
    assert pilot.mode("LAND") == dialect.ACCEPTED
    assert pilot.command(dialect.ARM, 1) == dialect.FAILED
    assert pilot.mode("GUIDED") == dialect.ACCEPTED
    assert pilot.command(dialect.ARM, 1) == dialect.ACCEPTED
    assert pilot.command(dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == dialect.ACCEPTED
    pilot.fly(8)
    assert pilot.copter.flight.position.z == pytest.approx(5.0, abs=0.3)
    assert pilot.command(dialect.ARM, 0) == dialect.FAILED
    low = Pilot(battery_percent=10.0)
    low.mode("GUIDED")
    assert low.command(dialect.ARM, 1) == dialect.FAILED


@pytest.mark.parametrize("number", [31010, 400 + 5000, 176 + 1])
def test_unknown_commands_are_unsupported(number: int) -> None:
    """What it does not know it answers as UNSUPPORTED."""
    assert Pilot().command(number) == dialect.UNSUPPORTED


def test_unknown_modes_and_empty_missions_are_refused() -> None:
    """A mode that does not exist and AUTO without a mission fail; what is sent to others is not for it."""
    pilot = Pilot()
    assert pilot.command(dialect.SET_MODE, 1, 99) == dialect.FAILED
    assert pilot.mode("AUTO") == dialect.FAILED
    assert pilot.send("MISSION_CLEAR_ALL", target_system=9, target_component=1, mission_type=0) == []


def test_a_mission_is_taken_item_by_item_and_flown() -> None:
    """Items are asked for in order, repeats ignored, the end acknowledged again; AUTO flies it to its last item."""
    pilot = Pilot()
    (request,) = pilot.count(3)
    assert (request.get_type(), request.seq) == ("MISSION_REQUEST_INT", 0)
    assert pilot.item(0, dialect.WAYPOINT)[0].seq == 1
    assert pilot.item(0, dialect.WAYPOINT) == []
    assert pilot.item(1, dialect.TAKEOFF)[0].seq == 2
    ack = pilot.item(2, dialect.WAYPOINT, x=1000)[0]
    assert (ack.get_type(), ack.type) == ("MISSION_ACK", dialect.MISSION_OK)
    assert pilot.item(2, dialect.WAYPOINT, x=1000)[0].type == dialect.MISSION_OK
    pilot.mode("GUIDED")
    pilot.command(dialect.ARM, 1)
    pilot.mode("AUTO")
    assert pilot.command(dialect.MISSION_START) == dialect.ACCEPTED
    reached = [each.seq for each in pilot.fly(20) if each.get_type() == "MISSION_ITEM_REACHED"]
    assert reached == [1, 2]
    assert pilot.copter.complete
    assert pilot.copter.flight.position.y == pytest.approx(11.1, abs=0.6)
    assert pilot.copter.takeoffs == 1


def test_a_lost_item_is_asked_for_again_and_a_silent_sender_given_up() -> None:
    """Without an answer the request is repeated, and after a while the transfer is cancelled."""
    pilot = Pilot()
    pilot.count(2)
    said = [each.get_type() for each in pilot.fly(10)]
    assert said.count("MISSION_REQUEST_INT") >= 5
    assert said[-1] == "MISSION_ACK"
    assert pilot.item(0, dialect.WAYPOINT)[0].type == dialect.MISSION_ERROR


def test_missions_it_cannot_fly_are_refused() -> None:
    """Too many items, commands it does not know, and an upload while it flies one are refused."""
    pilot = Pilot()
    assert pilot.count(5000)[0].type == dialect.MISSION_NO_SPACE
    pilot.count(1)
    assert pilot.item(0, 31010)[-1].type == dialect.MISSION_UNSUPPORTED
    pilot.count(2)
    pilot.item(0, dialect.WAYPOINT)
    pilot.item(1, dialect.TAKEOFF)
    pilot.mode("GUIDED")
    pilot.command(dialect.ARM, 1)
    pilot.mode("AUTO")
    pilot.command(dialect.MISSION_START)
    assert pilot.count(2)[-1].type == dialect.MISSION_ERROR


def test_an_empty_battery_brings_it_home() -> None:
    """Low in the air it returns by itself, lands at home and disarms."""
    pilot = Pilot()
    pilot.mode("GUIDED")
    pilot.command(dialect.ARM, 1)
    pilot.command(dialect.TAKEOFF, 0, 0, 0, 0, 0, 0, 5)
    pilot.fly(8)
    pilot.copter.flight.battery_percent = 7.0
    pilot.fly(40)
    assert not pilot.copter.flight.armed
    assert pilot.copter.flight.position.z == pytest.approx(0.0, abs=0.05)
