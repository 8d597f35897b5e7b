"""MAVSDK, MAVProxy and pymavlink at once, through one gateway process, to one vehicle: each as its users run it."""

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil
from robots_process import Process, gateway_process

from appliance.robots.client import TaskClient
from appliance.robots.settings import RobotsConfig, Template
from tests.integration.robots.test_stations import MavProxy, end_processes, first, mavproxy, mavsdk, until

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


class Stations:
    """What stations are started with, and ended."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.stations = folder, port
        self.processes: list[asyncio.subprocess.Process] = []

    async def start(self, *command: str, **pipes: Any) -> asyncio.subprocess.Process:
        """Start a process that is ended with the test."""
        process = await asyncio.create_subprocess_exec(*command, cwd=self.folder, **pipes)
        self.processes.append(process)
        return process


def _pymavlink(port: int) -> tuple[int, float, dict[str, Any]]:
    """Read a parameter, upload a mission to the vehicle's companion, and submit a task, with pymavlink alone.

    Returns the mission's result, the parameter, and the last news of the task.
    """
    ground: Any = mavutil.mavlink_connection(f"tcp:127.0.0.1:{port}", source_system=251, source_component=190)
    try:
        ground.wait_heartbeat(timeout=30)
        value = None
        for _ in range(20):
            ground.mav.heartbeat_send(6, 8, 0, 0, 4)
            ground.mav.param_request_read_send(1, 1, b"WPNAV_SPEED", -1)
            value = ground.recv_match(type="PARAM_VALUE", blocking=True, timeout=2)
            if value is not None and value.param_id == "WPNAV_SPEED":
                break
        assert value is not None
        result = None
        for _ in range(20):
            ground.mav.mission_count_send(1, 191, 1)
            asked = ground.recv_match(type="MISSION_REQUEST_INT", blocking=True, timeout=2)
            if asked is None:
                continue
            nan = math.nan
            ground.mav.mission_item_int_send(1, 191, 0, 6, 22, 0, 1, nan, nan, nan, nan, 0, 0, 8.0)
            result = ground.recv_match(
                type="MISSION_ACK", condition="MISSION_ACK.get_srcComponent()==191", blocking=True, timeout=5
            )
            if result is not None:
                break
        assert result is not None
        client = TaskClient(ground)
        task = client.submit("go to dock 3", task="by-pymavlink", timeout_s=60.0)
        assert task == "by-pymavlink"
        return int(result.type), float(value.param_value), next(iter(client.follow(task)))
    finally:
        ground.close()


async def test_three_stations_at_once(tmp_path: Path, free_port: int) -> None:
    """Each sees the vehicle, reads its parameters and has a task of its own, whose answer the others do not take."""
    templates = (Template(id=1, instruction="go to dock 3"),)
    async with gateway_process(tmp_path, RobotsConfig(templates=templates), mavlink=1) as it:
        await it.until(lambda: any(each.online and each.pose for each in it.robots().values()), limit_s=60)
        stations = Stations(tmp_path, await it.link("tcp"))
        try:
            drone, typed = await asyncio.gather(
                mavsdk(stations, f"tcpout://127.0.0.1:{stations.stations}", free_port),
                mavproxy(stations, f"tcp:127.0.0.1:{stations.stations}"),
            )
            try:
                await _all_three(it, stations, drone, typed)
            finally:
                await typed.close()
        finally:
            await end_processes(stations.processes)


async def _all_three(it: Process, stations: Stations, drone: Any, typed: MavProxy) -> None:
    await first(drone.telemetry.health(), lambda health: health.is_global_position_ok)
    by_hand = asyncio.create_task(asyncio.to_thread(_pymavlink, stations.stations))
    assert await drone.param.get_param_float("WPNAV_SPEED") == 500.0
    await until(lambda: "parameters" in typed.said and "online system 1" in typed.said)
    await typed.type("param show WPNAV_SPEED", "500.0")
    await typed.type("set target_component 191", "")
    await typed.type("set target_component", "191")
    await typed.type("long USER_1 1", "USER_1: ACCEPTED")
    result, value, news = await by_hand
    assert (result, value) == (0, 500.0)
    assert news["state"]
    tasks = (await it.client.tasks(100)).tasks
    assert "by-pymavlink" in {each.id for each in tasks}
    assert len(tasks) == 2
    await drone.action.arm()
    await it.until(lambda: any(each.armed for each in it.robots().values()))
