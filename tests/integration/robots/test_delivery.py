"""Tasks over a MAVLink link that loses, doubles and reorders: a real hub, real UDP, real clients on threads."""

import asyncio
from collections import Counter
from pathlib import Path

import pytest
import zenoh

from appliance.errors import NotFoundError, RefusedError
from appliance.model import RobotInfo, RobotLimits, Site, TaskRecord, TaskRequest, keyspace
from appliance.model.robot_api import LinkAdd, LinksAsk, MavlinkLink
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.robots.client import AsyncZenohTaskClient
from appliance.robots.hub import RobotHub
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks
from workshop.bench.mavlink.delivery import answers, ask_all
from workshop.bench.mavlink.relay import BadLink, Badness

pytestmark = pytest.mark.anyio


class Ledger:
    """Takes tasks as the task manager does: the same id again is the same task; now and then it is too busy."""

    def __init__(self) -> None:
        self.asked = Counter[str]()
        self.records: dict[str, TaskRecord] = {}

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task, slowly; every seventh question is refused for now."""
        self.asked[request.id] += 1
        if self.asked.total() % 7 == 0:
            raise RefusedError("too many tasks")
        await asyncio.sleep(0.02)
        return self.records.setdefault(request.id, TaskRecord(id=request.id, instruction=request.instruction))

    async def look(self, task: str) -> TaskRecord:
        """Return a task."""
        if task not in self.records:
            raise NotFoundError(f"no task {task}")
        return self.records[task]


@pytest.mark.timeout(300)
async def test_each_task_is_accepted_once(free_port: int, free_udp_port: int, tmp_path: Path) -> None:
    """With 20 % lost, doubled and delayed each way, over a link added at run time, each task is there once."""
    session = await Session.open(PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port}",)), "delivery")
    store = await Store.open(tmp_path / "store.sqlite")
    ledger = Ledger()
    doors = Tasks(submit=ledger.submit, cancel=lambda task, _: ledger.look(task), look=ledger.look)
    hub = RobotHub(RobotsConfig(), session=session, store=store, gateway="gw-1", site=Site(), tasks=doors)
    await hub.start()
    await hub.add_link(LinkAdd(link=MavlinkLink(listen=f"udp://127.0.0.1:{free_udp_port}"), by="a test"))
    link = BadLink(("127.0.0.1", free_udp_port), Badness(loss=0.2, doubled=0.2, delayed=0.3))
    try:
        tasks = [f"d-{number}" for number in range(40)]
        text = "go to the gate, " * 20 + "and look"
        askers = await ask_all(link.port, tasks, robots=4, instruction=lambda task: f"{task}: {text}")
        told = answers(askers)
        assert told["refused"] == {}
        assert sorted(task for each in askers for task in each.accepted) == sorted(tasks)
        assert {task: record.instruction for task, record in ledger.records.items()} == {
            task: f"{task}: {text}" for task in tasks
        }
        (facts,) = (await hub.links(LinksAsk())).links
        assert len([each for each in facts.senders if each.lost]) > 0
        assert min(link.counts.values()) > 0
    finally:
        link.close()
        await hub.stop()
        await store.close()
        await session.close()


async def test_a_robot_registers_itself(free_port: int) -> None:
    """A plain Zenoh session registers with capabilities and limits: the roster has it online until its session ends."""
    config = PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port}",))
    session = await Session.open(config, "delivery")
    roster, alive = dict[str, RobotInfo](), dict[str, bool]()

    def state(_: str, info: RobotInfo | None) -> None:
        if info is not None:
            roster[info.id] = info

    session.subscribe_typed(keyspace.ROBOT, state)
    session.watch_alive(
        session.keys(keyspace.ROBOT_ALIVE), lambda key, there: alive.update({key.split("/")[-2]: there})
    )
    raw = await asyncio.to_thread(_open_zenoh, free_port)
    try:
        client = AsyncZenohTaskClient(raw, fleet="delivery", robot="rover_7")
        limits = {"speed_mps": 1.5, "payload_kg": 20.0}
        mine = await client.register(uses=("base", "arm"), verbs=("state", "goto"), limits=limits)
        async with asyncio.timeout(30):
            while not (alive.get("rover_7") and "rover_7" in roster):
                mine.update(battery_percent=80.0)
                await asyncio.sleep(0.05)
        info = roster["rover_7"]
        assert (info.uses, info.verbs, info.kind) == (("base", "arm"), ("state", "goto"), "zenoh")
        assert info.limits == RobotLimits(speed_mps=1.5, payload_kg=20.0)
    finally:
        await asyncio.to_thread(raw.close)
    async with asyncio.timeout(30):
        while alive["rover_7"]:
            await asyncio.sleep(0.05)
    await session.close()


def _open_zenoh(port: int) -> zenoh.Session:
    """Open a session as a robot's own program does."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    return zenoh.open(config)
