"""A real fleet whose robots may only so much: what is sent to them is held to it, for every caller."""

import asyncio
import json
import os
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from fleets import RULES

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.errors import RefusedError
from appliance.llm.settings import RobotLimits, SafetyConfig
from appliance.model import RobotCommand, RobotReply, TaskRequest, TaskState, encode, keyspace
from appliance.pool.settings import PoolConfig
from appliance.robots.zenoh_client import ZenohTaskClient
from workshop import local_fleet
from workshop.local_fleet import Order

pytestmark = [pytest.mark.anyio, pytest.mark.podman]


@pytest.fixture
async def fleet(tmp_path: Path) -> AsyncIterator[FleetState]:
    """A gateway whose configuration has rovers go at a metre a second, and a rover; ended and cleaned up afterwards."""
    limits = RobotLimits(robots=("rover_*",), speed_mps=1.0, altitude_m=99.0, duration_s=999.0)
    slow = SafetyConfig(limits=(limits,))
    order = Order(
        fleet=f"t{os.getpid()}-{time.monotonic_ns() % 100000}",
        directory=tmp_path / "fleet",
        gateways=1,
        sim_rate=4.0,
        zenoh=1,
        mavlink=0,
        pool=PoolConfig(floor={"base": 1}),
        base=GatewayConfig(id="gw-1", llm=RULES, safety=slow),
    )
    state = await local_fleet.up(order, progress=print, timeout_s=90.0)
    try:
        yield state
    finally:
        await local_fleet.down(order.directory, progress=print, volumes=True)


class Cart:
    """A robot that others wrote: it registers, carries out every command, and looks at nothing."""

    def __init__(self, fleet: FleetState) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps(fleet.endpoints))
        self.told: list[RobotCommand] = []
        self._session = zenoh.open(config)
        self._served = self._session.declare_queryable(f"swiftbot/{fleet.fleet}/robot/cart_1/command", self._do)
        client = ZenohTaskClient(self._session, fleet=fleet.fleet, robot="cart_1")
        self.registration = client.register(uses=("base",), verbs=("goto", "state", "stop"), limits={"speed_mps": 0.5})
        self.registration.update(pose={"x": 10.0, "y": 4.0})

    def _do(self, query: Any) -> None:
        command = msgspec.json.decode(query.payload.to_bytes(), type=RobotCommand)
        self.told.append(command)
        query.reply(str(query.key_expr), encode(RobotReply(id=command.id)))

    def close(self) -> None:
        """Leave."""
        self.registration.close()
        self._served.undeclare()
        self._session.close()


async def test_orders_of_tasks_and_operators_are_held_to_limits(fleet: FleetState) -> None:
    """A skill's own speed is lowered; what an operator orders above a limit, or across a pit, is not sent."""
    cart = await asyncio.to_thread(Cart, fleet)
    try:
        async with FleetClient(fleet.endpoint, operator="ann") as client:
            told: list[RobotCommand] = []
            session = client.plane.session
            session.subscribe_typed(keyspace.COMMANDED, lambda _, each: each and told.append(each), "rover_1")
            await client.submit(TaskRequest(instruction="Rover_1: go to the packing table", id="slow"))
            async with asyncio.timeout(90):
                while not (record := await client.task("slow")).state.final:
                    await asyncio.sleep(0.2)
            assert record.state is TaskState.SUCCEEDED, record.subtasks
            assert {each.args["speed_mps"] for each in told if each.verb == "goto"} == {1.0}

            rover = await client.take_over("rover_1", lease_s=60.0)
            with pytest.raises(RefusedError, match=r"2 m/s is above 1 m/s, by the limits of rover_1 in \[safety\]"):
                await client.drive(rover, "velocity", forward_mps=2.0)
            with pytest.raises(RefusedError, match="goes through maintenance pit"):
                await client.drive(rover, "goto", waypoints=[{"x": 27, "y": 10}, {"x": 34, "y": 10}])
            await client.give_back(rover)

            async with asyncio.timeout(30):
                while "cart_1" not in client.plane.registry.robots:
                    await asyncio.sleep(0.1)
            mine = await client.take_over("cart_1", lease_s=60.0)
            with pytest.raises(RefusedError, match="by the limits that cart_1 registered"):
                await client.drive(mine, "goto", waypoints=[{"x": 10, "y": 6}], speed_mps=1.0)
            with pytest.raises(RefusedError, match="goes through rack a"):
                await client.drive(mine, "goto", waypoints=[{"x": 15, "y": 6}, {"x": 15, "y": 13}], speed_mps=0.4)
            assert {each.verb for each in cart.told} <= {"stop"}
            await client.drive(mine, "goto", waypoints=[{"x": 10, "y": 6}], speed_mps=0.4)
            await client.drive(mine, "goto", waypoints=[{"x": 10, "y": 5}])
            await client.give_back(mine)
        assert [each.args["speed_mps"] for each in cart.told if each.verb == "goto"] == [0.4, 0.5]
    finally:
        await asyncio.to_thread(cart.close)
