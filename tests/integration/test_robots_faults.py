"""Faults of what is at the other ends of MAVLink links, as users of a real gateway process see them."""

import asyncio
import math
import time
from pathlib import Path
from typing import Any

import pytest
from robots_process import STATION, beats, gateway_process, read_frames, swiftbot

from appliance.robots.mavlink.dialect import Codec, make
from appliance.robots.settings import RobotsConfig, Template

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.fleet]
FOREIGN = bytes.fromhex("fd06000000050161ea0001020304fdff2ab4")
FOREIGN_LAST = bytes.fromhex("fd03000000010161ea0001020387fd")


async def test_a_false_header_holds_no_vehicle_back(tmp_path: Path) -> None:
    """Behind foreign frames with markers in their bodies, a TCP vehicle at 1 Hz comes and stays online."""
    async with gateway_process(tmp_path) as it:
        port = await it.link("tcp")
        end, beat = it.connect("tcp", port), beats(7)
        end.send(FOREIGN_LAST + beat() + beat())
        await it.until(lambda: "drone_7" in it.robots() and it.robots()["drone_7"].online, limit_s=10)
        offline = 0
        for _ in range(8):
            # In two pieces, so that the gateway reads damage that is not whole.
            end.send(FOREIGN[:7])
            await asyncio.sleep(0.05)
            end.send(FOREIGN[7:])
            until = time.monotonic() + 1.0
            end.send(beat())
            while time.monotonic() < until:
                offline += not it.robots()["drone_7"].online
                await asyncio.sleep(0.1)
        facts = await it.facts(port)
        assert not offline
        assert facts.refused == {"unknown_message": 9}
        assert facts.frames_in == 10


async def test_a_repeated_command_is_one_task(tmp_path: Path) -> None:
    """Sent three times, 0.5 s apart, with NaN in unused parameters, as MAVSDK does: one task by either message."""
    templates = (Template(id=1, instruction="go to dock 3"),)
    async with gateway_process(tmp_path, RobotsConfig(templates=templates)) as it:
        end = it.connect("udp", await it.link("udp"))
        station = Codec(245, 190)
        unset: dict[str, Any] = {f"param{number}": math.nan for number in range(2, 5)}
        common: dict[str, Any] = {"target_system": 242, "target_component": 191, "command": 31010, "param1": 1.0}
        heard: list[Any] = []

        async def acks(count: int) -> list[Any]:
            async with asyncio.timeout(30):
                while True:
                    heard.extend(each.message for each in read_frames(end) if each.name == "COMMAND_ACK")
                    done = [each for each in heard if each.result != 5]
                    if len(done) >= count:
                        return done
                    await asyncio.sleep(0.1)

        end.send(station.pack(make("HEARTBEAT", **STATION)))
        for confirmation in range(3):
            more = {f"param{number}": math.nan for number in (5, 6, 7)}
            end.send(station.pack(make("COMMAND_LONG", confirmation=confirmation, **(common | unset | more))))
            await asyncio.sleep(0.5)
        first = await acks(3)
        for _ in range(3):
            place = {"frame": 0, "current": 0, "autocontinue": 0, "x": 0, "y": 0, "z": math.nan}
            end.send(station.pack(make("COMMAND_INT", **(common | unset | place))))
            await asyncio.sleep(0.5)
        both = await acks(6)
        assert [each.result for each in both] == [0] * 6
        assert len({each.result_param2 for each in first}) == 1
        assert len({each.result_param2 for each in both}) == 2
        assert len((await it.client.tasks(100)).tasks) == 2


async def test_no_robot_of_senders_that_are_no_vehicle(tmp_path: Path) -> None:
    """System 0, component 0 and a station that names an autopilot are not in the list; an old row can be removed."""
    async with gateway_process(tmp_path) as it:
        end = it.connect("udp", await it.link("udp"))
        senders = [beats(*each) for each in ((7, 1), (0, 1), (0, 0), (5, 0), (255, 190))]

        def act() -> None:
            for beat in senders:
                end.send(beat())

        await it.until(lambda: it.robots().get("drone_7") and it.refused().get("no_sender", 0) > 5, act)
        code, printed = await swiftbot(it.fleet, "robots", "list")
        assert code == 0
        assert "drone_7" in printed
        assert not {"drone_0", "drone_5", "drone_255"} & set(it.robots())
        code, printed = await swiftbot(it.fleet, "robots", "forget", "drone_7")
        assert code != 0
        assert "drone_7 is online" in printed
        await it.until(lambda: not it.robots()["drone_7"].online)
        code, printed = await swiftbot(it.fleet, "robots", "forget", "drone_7")
        assert (code, "has forgotten drone_7" in printed) == (0, True), printed
        await it.until(lambda: "drone_7" not in it.robots())
        await asyncio.sleep(6.0)  # longer than rosters are reminded of vehicles that are offline
        assert "drone_7" not in it.robots()
        _, printed = await swiftbot(it.fleet, "robots", "list")
        assert "drone_7" not in printed
        assert (await swiftbot(it.fleet, "robots", "forget", "drone_7"))[0] != 0
        await it.until(lambda: "drone_7" in it.robots() and it.robots()["drone_7"].online, act)
