"""Missions uploaded over MAVLink to a real gateway process: bytes in at its socket, a flown vehicle out."""

import asyncio
import math
import socket
from pathlib import Path
from typing import Any

import pytest
from robots_process import STATION, Process, gateway_process, read_frames

from appliance.model import TaskRecord, TaskState
from appliance.model.site import to_globe
from appliance.robots.mavlink.dialect import Codec, make
from appliance.skills.sites import load_site

pytestmark = [pytest.mark.anyio, pytest.mark.podman]

SITE = load_site("warehouse")
TAKEOFF, WAYPOINT, LOITER_TIME, LAND = 22, 16, 19, 21
DENIED, BAD_LATITUDE, BAD_LONGITUDE, BAD_ALTITUDE = 14, 10, 11, 12
"""MAV_MISSION_RESULT."""
RELATIVE, ABSOLUTE = 6, 0
"""MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, MAV_FRAME_GLOBAL."""
Row = dict[str, Any]


def at(command: int, x: float, y: float, z: float, *, hold_s: float = 0.0, frame: int = RELATIVE) -> Row:
    """Return a mission item at a point of the site, metres."""
    latitude, longitude, _ = to_globe(SITE, x, y)
    place = {"x": round(latitude * 1e7), "y": round(longitude * 1e7), "z": z}
    return {
        "command": command,
        "frame": frame,
        "param1": hold_s,
        "param2": 1.0,
        "param3": 0.0,
        "param4": math.nan,
    } | place


UP = at(TAKEOFF, 4.0, 4.0, 8.0) | {"x": 0, "y": 0}


class Ground:
    """A ground station at a link of the gateway."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._codec = Codec(255, 190)
        self.texts: list[str] = []

    def send(self, name: str, **fields: Any) -> None:
        """Send a message to the gateway's component of vehicle 1."""
        self._end.send(self._codec.pack(make(name, **({"target_system": 1, "target_component": 191} | fields))))

    def beat(self) -> None:
        """Send a heartbeat."""
        self._end.send(self._codec.pack(make("HEARTBEAT", **STATION)))

    async def upload(self, rows: list[Row]) -> int:
        """Upload a mission as stations do; return its MAV_MISSION_RESULT."""
        self.send("MISSION_COUNT", count=len(rows), mission_type=0)
        async with asyncio.timeout(30):
            while True:
                for each in read_frames(self._end):
                    message = each.message
                    if each.name == "MISSION_REQUEST_INT":
                        more = {"seq": message.seq, "current": 0, "autocontinue": 1, "mission_type": 0}
                        self.send("MISSION_ITEM_INT", **(rows[message.seq] | more))
                    elif each.name == "STATUSTEXT":
                        self._hear(message)
                    elif each.name == "MISSION_ACK":
                        return int(message.type)
                await asyncio.sleep(0.02)

    async def start(self) -> int:
        """Send MAV_CMD_MISSION_START; return the final MAV_RESULT."""
        self.send("COMMAND_LONG", command=300, confirmation=0, **{f"param{number}": 0.0 for number in range(1, 8)})
        async with asyncio.timeout(30):
            while True:
                for each in read_frames(self._end):
                    if each.name == "STATUSTEXT":
                        self._hear(each.message)
                    elif each.name == "COMMAND_ACK" and each.message.command == 300 and each.message.result != 5:
                        return int(each.message.result)
                await asyncio.sleep(0.02)

    def _hear(self, message: Any) -> None:
        self.texts.append(message.text if isinstance(message.text, str) else message.text.decode())


async def vehicle_and_ground(it: Process) -> Ground:
    """Return a station that the gateway hears, once the simulated copter is there."""
    ground = Ground(it.connect("udp", await it.link("udp")))
    await it.until(lambda: "drone_1" in it.robots() and it.robots()["drone_1"].online, ground.beat)
    await it.until(lambda: it.robots()["drone_1"].pose is not None, ground.beat)
    return ground


async def ended(it: Process, before: set[str]) -> TaskRecord:
    """Return the new task once it has ended."""
    found: list[TaskRecord] = []

    async with asyncio.timeout(120):
        while not found or found[0].state not in (TaskState.SUCCEEDED, TaskState.FAILED, TaskState.CANCELLED):
            found = [each for each in (await it.client.tasks(100)).tasks if each.id not in before]
            await asyncio.sleep(0.2)
    return found[0]


async def test_missions_of_one_point_are_flown(tmp_path: Path) -> None:
    """Take-off and a waypoint, one with a hold, LOITER_TIME, LAND at a place: each succeeds with the vehicle there."""
    missions: list[tuple[list[Row], tuple[float, float], float | None]] = [
        ([UP, at(WAYPOINT, 10.0, 10.0, 8.0)], (10.0, 10.0), 8.0),
        ([at(WAYPOINT, 10.0, 20.0, 6.0, hold_s=2.0)], (10.0, 20.0), 6.0),
        ([at(LOITER_TIME, 26.0, 6.0, 494.0, hold_s=2.0, frame=ABSOLUTE)], (26.0, 6.0), 6.0),
        ([at(LAND, 10.0, 4.0, 0.0)], (10.0, 4.0), None),
        ([UP, at(LAND, 6.0, 10.0, math.nan)], (6.0, 10.0), None),
    ]
    async with gateway_process(tmp_path, mavlink=1, sim_rate=4.0) as it:
        ground = await vehicle_and_ground(it)
        for rows, (x, y), z in missions:
            before = {each.id for each in (await it.client.tasks(100)).tasks}
            assert await ground.upload(rows) == 0, ground.texts
            assert await ground.start() == 0, ground.texts
            task = await ended(it, before)
            assert task.state is TaskState.SUCCEEDED, (rows, task.failure)
            # The row follows the vehicle some tenths of a second later.
            await it.until(
                lambda x=x, y=y, z=z: (
                    (pose := it.robots()["drone_1"].pose) is not None
                    and math.hypot(pose.x - x, pose.y - y) < 1.5
                    and (abs(pose.z - z) < 1.0 if z is not None else not it.robots()["drone_1"].armed)
                ),
                ground.beat,
                limit_s=10.0,
            )


async def test_missions_to_where_nothing_may_fly_are_refused_when_they_are_uploaded(tmp_path: Path) -> None:
    """Each bad point is refused with MAVLink's result for its axis and a text with the reason; nothing is held."""
    bad = [
        (at(WAYPOINT, 540.0, 10.0, 8.0), BAD_LONGITUDE, "outside the fence"),
        (at(WAYPOINT, 10.0, -470.0, 8.0), BAD_LATITUDE, "outside the fence"),
        (at(LAND, 10.0, 31.0, 0.0), BAD_LATITUDE, "outside the fence"),
        (at(WAYPOINT, 10.0, 10.0, -5.0), BAD_ALTITUDE, "5 m under the ground"),
        (at(LOITER_TIME, 10.0, 10.0, 483.0, hold_s=1.0, frame=ABSOLUTE), BAD_ALTITUDE, "5 m under the ground"),
        (at(WAYPOINT, 10.0, 10.0, 31.0), BAD_ALTITUDE, "above this site's limit of 30 m"),
        (at(TAKEOFF, 4.0, 4.0, 45.0), BAD_ALTITUDE, "above this site's limit of 30 m"),
        (at(WAYPOINT, 30.0, 10.0, 8.0), DENIED, "maintenance pit"),
        (at(WAYPOINT, 18.0, 9.0, 8.0), DENIED, "rack a"),
    ]
    async with gateway_process(tmp_path, mavlink=1) as it:
        ground = await vehicle_and_ground(it)
        for row, result, why in bad:
            ground.texts.clear()
            assert await ground.upload([UP, row]) == result, (row, ground.texts)
            assert why in "".join(ground.texts)
            assert "item 1" in "".join(ground.texts)
        await it.until(lambda: it.refused().get("mission_refused") == len(bad))
        assert await ground.start() == 2
        assert "no mission is held for drone_1" in "".join(ground.texts)
        assert not (await it.client.tasks(100)).tasks
