"""Tasks over a MAVLink link that loses, doubles and reorders frames each way, through a real fleet: each is run once.

Robots' clients (`appliance.robots.client`) ask in words through TUNNEL frames over a UDP relay that is as bad as is
wanted; the gateway's link is added while it runs. A task sends a notice, so that one that was run twice is seen.
"""

import asyncio
import secrets
import socket
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from msgspec import Struct
from pymavlink import mavutil

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.model import Notice, TaskState, keyspace
from appliance.model.robot_api import LinkAdd, MavlinkLink
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port
from appliance.robots.client import TaskClient, TaskRejected
from workshop import local_fleet
from workshop.bench.figures import summary
from workshop.bench.mavlink.relay import BadLink, Badness
from workshop.bench.pooled import fleet_name
from workshop.local_fleet import Order

Progress = Callable[[str], None]
FIRST_SYSTEM = 100
"""System ids of the robots that ask: companion computers without a vehicle."""
_DONE_S = 300.0


class Options(Struct, frozen=True, kw_only=True):
    """What is delivered over what."""

    tasks: int = 1000
    robots: int = 16
    """That ask at the same time, each one task after the other."""
    gateways: int = 3
    badness: Badness = Badness()


class Asker(threading.Thread):
    """One robot: asks for its tasks one after the other, each again with the same id until it is answered."""

    def __init__(self, port: int, number: int, tasks: list[str], instruction: Callable[[str], str]) -> None:
        super().__init__(name=f"robot {number}", daemon=True)
        self._port = port
        self._number = number
        self._tasks = tasks
        self._instruction = instruction
        self.waits_ms: list[float] = []
        self.accepted: list[str] = []
        self.again = 0
        self.refused: dict[str, str] = {}

    def run(self) -> None:
        """Ask."""
        connection: Any = cast("Any", mavutil).mavlink_connection(
            f"udpout:127.0.0.1:{self._port}", source_system=FIRST_SYSTEM + self._number, source_component=192
        )
        try:
            client = TaskClient(connection)
            for task in self._tasks:
                self._ask(client, task)
        finally:
            connection.close()

    def _ask(self, client: TaskClient, task: str) -> None:
        began = time.monotonic()
        for _ in range(20):
            try:
                client.submit(self._instruction(task), task=task, timeout_s=60.0)
            except TimeoutError:
                self.again += 1
                continue
            except TaskRejected as error:
                if not error.retry:
                    self.refused[task] = str(error)
                    return
                self.again += 1
                time.sleep(0.5)
                continue
            self.accepted.append(task)
            self.waits_ms.append((time.monotonic() - began) * 1e3)
            return
        self.refused[task] = "no answer"


async def ask_all(port: int, tasks: list[str], *, robots: int, instruction: Callable[[str], str]) -> list[Asker]:
    """Have robots ask for tasks over the link at a port; returns when all have been answered, or given up."""
    askers = [Asker(port, number, tasks[number::robots], instruction) for number in range(robots)]
    for asker in askers:
        asker.start()
    await asyncio.gather(*(asyncio.to_thread(asker.join) for asker in askers))
    return askers


def answers(askers: list[Asker]) -> dict[str, Any]:
    """Say what the robots were told."""
    return {
        "accepted": sum(len(each.accepted) for each in askers),
        "asked_again": sum(each.again for each in askers),
        "refused": {task: why for each in askers for task, why in each.refused.items()},
        "answer_ms": summary([wait for each in askers for wait in each.waits_ms]),
    }


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure; see the module."""
    with tempfile.TemporaryDirectory(prefix="swiftbot-bench-") as folder:
        order = Order(
            fleet=fleet_name(),
            directory=Path(folder) / "fleet",
            gateways=options.gateways,
            mavlink=0,
            zenoh=0,
            base=GatewayConfig(id="gw-1", llm=LlmConfig(tiers=("rules",))),
            pool=PoolConfig(floor={"base": 2}, capacity=4),
        )
        state = await local_fleet.up(order, progress=progress)
        try:
            async with FleetClient(state.endpoint) as client:
                return await _deliver(client, options, progress=progress)
        finally:
            await local_fleet.down(order.directory, progress=progress, volumes=True)


async def _deliver(client: FleetClient, options: Options, *, progress: Progress) -> dict[str, Any]:
    port = free_port(socket.SOCK_DGRAM)
    url = f"udp://127.0.0.1:{port}"
    await client.gateway()
    gateway = min(client.plane.members())
    await client.robot_link_add(gateway, LinkAdd(link=MavlinkLink(listen=url), by="swiftbot bench"))
    notices = Counter[str]()

    def take(_: str, notice: Notice | None) -> None:
        if notice is not None:
            notices[notice.text] += 1

    closer = client.plane.session.subscribe_typed(keyspace.NOTICE, take)
    run_name = secrets.token_hex(3)
    tasks = [f"d-{run_name}-{number}" for number in range(options.tasks)]
    link = BadLink(("127.0.0.1", port), options.badness)
    try:
        progress(f"{options.tasks} tasks over {url} by {options.robots} robots")
        began = time.monotonic()
        askers = await ask_all(link.port, tasks, robots=options.robots, instruction=lambda task: f"notify ops: {task}")
        asked_s = time.monotonic() - began
        progress("all asked; waiting for their ends")
        ends = await _ends(client, tasks)
        facts = (await client.robot_links(gateway))[0][gateway]
    finally:
        link.close()
        closer.close()
    mine = {text: count for text, count in notices.items() if run_name in text}
    return {
        "tasks": options.tasks,
        **answers(askers),
        "seconds": round(asked_s, 1),
        "ended": dict(ends["states"]),
        "attempts": dict(ends["attempts"]),
        "notices": {"tasks": len(mine), "once": sum(count == 1 for count in mine.values())},
        "link": link.counts,
        "refused_frames": next(each.refused for each in facts.links if each.url == url),
    }


async def _ends(client: FleetClient, tasks: list[str]) -> dict[str, Counter[str]]:
    """Wait until all have ended; how, and how many attempts their subtasks took."""
    states, attempts = Counter[str](), Counter[str]()
    until = time.monotonic() + _DONE_S
    waiting = list(tasks)
    while waiting:
        left: list[str] = []
        for task in waiting:
            try:
                record = await client.task(task)
            except SwiftbotError as error:
                if time.monotonic() > until:
                    states[error.code] += 1
                else:
                    left.append(task)
                continue
            if not record.state.final and time.monotonic() < until:
                left.append(task)
                continue
            states[record.state] += 1
            if record.state is TaskState.SUCCEEDED:
                attempts[str(sum(len(each.attempts) for each in record.subtasks))] += 1
        waiting = left
        await asyncio.sleep(0.5 if waiting else 0.0)
    return {"states": states, "attempts": attempts}
