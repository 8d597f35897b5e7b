"""A simulated rover in a process of its own, reached over real Zenoh sessions."""

import asyncio
import base64
import contextlib
import io
import json
import sys
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

from appliance.errors import PayloadError, UnreachableError
from appliance.model import (
    Box,
    Device,
    Door,
    Enquiry,
    Person,
    Place,
    RobotCommand,
    RobotInfo,
    RobotReply,
    Site,
    SiteObject,
    TaskRequest,
    encode,
    keyspace,
)
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.robots import retry
from appliance.robots.sender import send_command
from appliance.robots.task_listener import TaskListener
from workshop.robots.world import WORLD
from workshop.robots.zenoh_robot import RobotSettings

pytestmark = pytest.mark.anyio

SITE = Site(
    places={"charger": Place(x=0.0, y=0.0), "dock 3": Place(x=12.0, y=0.0), "table": Place(x=12.0, y=6.0)},
    obstacles=(Box(name="rack", x=(4.0, 6.0), y=(2.0, 4.0)),),
    objects=(SiteObject(name="red box", colour="red", at="dock 3"),),
)
_PROCESS = """
import asyncio, sys, msgspec
from workshop.robots.zenoh_robot import RobotSettings, run_robot
asyncio.run(run_robot(msgspec.json.decode(sys.argv[1], type=RobotSettings)))
"""


class Hall:
    """A gateway's session, and rovers that reach it."""

    def __init__(self, session: Session, endpoint: str) -> None:
        self.session = session
        self.endpoint = endpoint
        self.infos: dict[str, RobotInfo] = {}
        self.commanded: list[RobotCommand] = []
        self.pictures: list[dict[str, Any]] = []
        self.alive: dict[str, bool] = {}
        self.things: dict[str, dict[str, Any]] = {}
        self.processes: list[asyncio.subprocess.Process] = []
        self.number = 0
        keys = session.keys
        session.subscribe_typed(keyspace.ROBOT, self._info)
        session.subscribe(
            keys(keyspace.COMMANDED), lambda m: self.commanded.append(msgspec.json.decode(m.payload, type=RobotCommand))
        )
        session.subscribe(keys(WORLD), lambda m: self.things.update({m.key.rsplit("/", 1)[-1]: json.loads(m.payload)}))
        session.subscribe(keys(keyspace.CAMERA), lambda m: self.pictures.append(json.loads(m.payload)))
        session.watch_alive(
            keys(keyspace.ROBOT_ALIVE), lambda key, alive: self.alive.update({key.split("/")[-2]: alive})
        )

    def _info(self, _: str, info: RobotInfo | None) -> None:
        if info is not None:
            self.infos[info.id] = info

    async def rover(self, name: str, **settings: Any) -> asyncio.subprocess.Process:
        """Start a rover and wait until it is on the roster."""
        order = RobotSettings(
            name=name, fleet="hall", connect=(self.endpoint,), **({"rate": 10.0, "site": SITE} | settings)
        )
        process = await asyncio.create_subprocess_exec(sys.executable, "-c", _PROCESS, encode(order).decode())
        self.processes.append(process)
        await until(lambda: self.alive.get(name) and name in self.infos)
        return process

    async def tell(self, robot: str, verb: str, *, identity: str = "", **args: Any) -> RobotReply:
        """Give a rover a command."""
        self.number += 1
        command = RobotCommand(
            id=identity or f"t/s/{self.number}", verb=verb, args=args, task="t", subtask="s", attempt=1
        )
        return await send_command(self.session, robot, command, timeout_s=60.0)

    async def done(self, robot: str, verb: str, **args: Any) -> RobotReply:
        """Give a rover a command that must succeed."""
        reply = await self.tell(robot, verb, **args)
        assert reply.failure is None, reply.failure
        return reply


async def until(holds: Callable[[], object], limit_s: float = 30.0) -> None:
    """Wait for something to become true."""
    async with asyncio.timeout(limit_s):
        while not holds():
            await asyncio.sleep(0.02)


@pytest.fixture
async def hall(free_port: int) -> AsyncIterator[Hall]:
    """Open a gateway's session; rovers are ended afterwards."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    session = await Session.open(PlaneConfig(listen=(endpoint,)), "hall")
    hall = Hall(session, endpoint)
    try:
        yield hall
    finally:
        for process in hall.processes:
            if process.returncode is None:
                process.kill()
            await process.wait()
        await session.close()


def red_pixels(data: bytes) -> int:
    """Count the red pixels of a picture."""
    pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=int)
    return int(((pixels[..., 0] > 90) & (pixels[..., 1] < 70) & (pixels[..., 2] < 70)).sum())


async def test_fetching_a_box(hall: Hall) -> None:
    """Drive, photograph, pick, carry, place: each does what it says, and what is impossible says why."""
    await hall.rover("rover_1")
    info = hall.infos["rover_1"]
    assert (info.kind, info.uses, info.gateway) == (
        "zenoh",
        ("base", "arm", "camera", "speaker", "microphone"),
        "",
    )
    failure = (await hall.tell("rover_1", "pick", object="red box")).failure
    assert failure is not None
    assert (failure.message, failure.remedy) == (
        "the red box is 12.0 m away, the arm reaches 1.5 m",
        "drive to dock 3 first",
    )
    result = (await hall.done("rover_1", "goto", waypoints=[{"x": 6, "y": 0}, {"x": 12, "y": 0}])).result
    assert (result["pose"]["x"], result["pose"]["y"]) == pytest.approx((12, 0), abs=0.2)
    picture = await hall.done("rover_1", "capture", target="the red box")
    assert picture.blobs["image.png"].startswith(b"\x89PNG")
    assert red_pixels(picture.blobs["image.png"]) > 500
    assert (await hall.done("rover_1", "pick", object="red box")).result["holding"] == "red box"
    await until(lambda: hall.infos["rover_1"].holding == "red box")
    failure = (await hall.tell("rover_1", "place", object="red box", at="table")).failure
    assert failure is not None
    assert failure.remedy == "drive to table first"
    await hall.done("rover_1", "goto", waypoints=[{"x": 12, "y": 6}])
    assert (await hall.done("rover_1", "place", object="red box", at="table")).result["holding"] == ""
    await hall.done("rover_1", "return_home")
    state = (await hall.done("rover_1", "state")).result
    assert (state["pose"]["x"], state["pose"]["y"]) == pytest.approx((0, 0), abs=0.2)
    assert state["flies"] is False


async def test_a_film_is_frames_and_is_on_the_camera_key(hall: Hall) -> None:
    """A record answers as many JPEG frames as asked, and each is put as a CompressedImage."""
    await hall.rover("rover_1")
    reply = await hall.done("rover_1", "record", target="red box", duration_s=2, fps=4)
    assert sorted(reply.blobs) == [f"frame-{number:03d}.jpg" for number in range(8)]
    await until(lambda: len(hall.pictures) == 8)
    picture = hall.pictures[0]
    assert (picture["format"], picture["frame_id"]) == ("jpeg", "rover_1/camera")
    assert set(picture["timestamp"]) == {"sec", "nsec"}
    assert base64.b64decode(picture["data"]) == reply.blobs["frame-000.jpg"]
    failure = (await hall.tell("rover_1", "record", target="x", duration_s=100, fps=30)).failure
    assert failure is not None
    assert failure.code == "payload"


async def test_a_repeated_pick_picks_once(hall: Hall) -> None:
    """The same id twice at once and once after is one pick, announced once, with one answer."""
    await hall.rover("rover_1")
    await hall.done("rover_1", "goto", waypoints=[{"x": 12, "y": 0}])
    both = await asyncio.gather(
        *(hall.tell("rover_1", "pick", identity="t/pick/1", object="red box") for _ in range(2))
    )
    again = await hall.tell("rover_1", "pick", identity="t/pick/1", object="red box")
    assert both == [again, again]
    assert again.failure is None
    assert [each.verb for each in hall.commanded] == ["goto", "pick"]


async def test_driving_and_looking_at_once_but_not_driving_twice(hall: Hall) -> None:
    """Base and camera work side by side; a second goto is busy; a stop ends the first where it is."""
    await hall.rover("rover_1", rate=2.0)
    going = asyncio.create_task(hall.tell("rover_1", "goto", waypoints=[{"x": 12, "y": 0}], speed_mps=0.5))
    await until(lambda: hall.infos["rover_1"].mode == "goto")
    await hall.done("rover_1", "capture", target="red box")
    busy = (await hall.tell("rover_1", "goto", waypoints=[{"x": 0, "y": 0}])).failure
    assert busy is not None
    assert (busy.code, busy.retryable) == ("busy", True)
    await hall.done("rover_1", "stop")
    ended = (await going).failure
    assert ended is not None
    assert ended.code == "cancelled"
    assert (await hall.done("rover_1", "state")).result["pose"]["x"] < 11.0


async def test_a_way_through_a_rack_is_refused(hall: Hall) -> None:
    """A rover does not drive through what the site says is there."""
    await hall.rover("rover_1")
    failure = (await hall.tell("rover_1", "goto", waypoints=[{"x": 10, "y": 6}])).failure
    assert failure is not None
    assert failure.message == "the leg to waypoint 1 goes through rack"


async def test_two_rovers_share_their_world(hall: Hall) -> None:
    """What one has taken the other cannot pick, not even one that comes later; what it puts down the other can."""
    await hall.rover("rover_1")
    await hall.done("rover_1", "goto", waypoints=[{"x": 12, "y": 0}])
    await hall.done("rover_1", "pick", object="red box")
    await hall.rover("rover_2")
    await hall.done("rover_2", "goto", waypoints=[{"x": 12, "y": 0}])
    failure = (await hall.tell("rover_2", "pick", object="red box")).failure
    assert failure is not None
    assert failure.message == "the red box is held by rover_1"
    await hall.done("rover_1", "place", object="red box", at="dock 3")

    async def picked() -> bool:
        return (await hall.tell("rover_2", "pick", object="red box")).failure is None

    async with asyncio.timeout(60):
        while not await picked():
            await asyncio.sleep(0.05)


async def test_doors_devices_and_people(hall: Hall) -> None:
    """A shut door is in the way until it is opened, a light is switched, a person is asked and given a box."""
    site = Site(
        places={"charger": Place(x=0.0, y=0.0), "office": Place(x=8.0, y=0.0)},
        objects=(SiteObject(name="red box", colour="red", at="charger"),),
        doors=(Door(name="office door", x=(4.0, 4.2), y=(-50.0, 50.0)),),
        devices=(Device(name="light", at="office"),),
        people=(Person(name="Ann", at="office", answers={"box": "give it to me"}),),
    )
    await hall.rover("rover_1", site=site)
    await hall.done("rover_1", "pick", object="red box")
    into = {"waypoints": [{"x": 7, "y": 0}]}
    failure = (await hall.tell("rover_1", "goto", **into)).failure
    assert failure is not None
    assert failure.message == "the leg to waypoint 1 goes through the shut office door"
    await hall.done("rover_1", "goto", waypoints=[{"x": 3, "y": 0}])
    assert (await hall.done("rover_1", "open", object="office door")).result["changed"] is True
    assert (await hall.done("rover_1", "open", object="office door")).result["changed"] is False
    await hall.done("rover_1", "goto", **into)
    assert (await hall.done("rover_1", "switch_on", object="light")).result["state"] == "on"
    asked = (await hall.done("rover_1", "ask", question="Where does the box go?", to="Ann")).result
    assert (asked["answer"], asked["by"]) == ("give it to me", "Ann")
    assert (await hall.done("rover_1", "say", text="here you are")).result["heard_by"] == ["Ann"]
    assert (await hall.done("rover_1", "give", object="red box", to="Ann")).result["to"] == "Ann"
    await until(lambda: hall.infos["rover_1"].holding == "")


async def test_tools_work_on_what_is_within_reach(hall: Hall) -> None:
    """A cover is loosened once for all robots, a bottle is poured, a cart is pushed, and what is too far is refused."""
    site = Site(
        places={"charger": Place(x=0.0, y=0.0), "bay": Place(x=6.0, y=0.0)},
        objects=tuple(SiteObject(name=name, colour="red", at="charger") for name in ("cover", "bottle", "bucket")),
    )
    await hall.rover("rover_1", site=site)
    await hall.rover("rover_2", site=site)
    for verb, condition in (("unfasten", "loose"), ("clean", "clean"), ("fasten", "fastened"), ("cut", "cut")):
        assert (await hall.done("rover_1", verb, object="cover")).result["condition"] == condition
    await until(lambda: hall.things.get("cover", {}).get("condition") == "cut")
    failure = (await hall.tell("rover_1", "pour", object="bottle", into="bucket")).failure
    assert failure is not None
    assert failure.remedy == "pick the bottle first"
    await hall.done("rover_1", "pick", object="bottle")
    assert (await hall.done("rover_1", "pour", object="bottle", into="bucket")).result["into"] == "bucket"
    await hall.done("rover_1", "place", object="bottle", at="here")
    assert (await hall.done("rover_1", "push", object="cover", to="bay")).result["pushed_m"] == 6.0
    assert (await hall.tell("rover_2", "push", object="cover")).failure is not None  # it is 6 m away now
    failure = (await hall.tell("rover_2", "clean", object="ladder")).failure
    assert failure is not None
    assert failure.code == "not-found"


async def test_a_rover_follows_another_and_measures(hall: Hall) -> None:
    """It keeps two metres behind; a device that is switched on is warm and is heard; a wall is seen by the scan."""
    site = Site(
        places={"charger": Place(x=0.0, y=0.0), "pump room": Place(x=8.0, y=0.0)},
        obstacles=(Box(name="wall", x=(-5.0, 20.0), y=(4.0, 5.0)),),
        devices=(Device(name="pump", at="pump room"),),
    )
    await hall.rover("rover_1", site=site)
    await hall.rover("rover_2", site=site)
    follow = asyncio.create_task(hall.tell("rover_2", "follow", target="rover_1", duration_s=5.0))
    await hall.done("rover_1", "goto", waypoints=[{"x": 7.0, "y": 0.0}])
    followed = await follow
    assert followed.failure is None
    assert followed.result["in_sight"] is True
    await until(lambda: abs(hall.infos["rover_2"].pose.x - 5.0) < 0.5)  # pyright: ignore[reportOptionalMemberAccess]
    assert (await hall.done("rover_1", "measure", quantity="temperature", target="pump")).result["number"] == 20.0
    before = (await hall.done("rover_1", "measure", quantity="noise")).result["number"]
    await hall.done("rover_1", "switch_on", object="pump")
    assert (await hall.done("rover_1", "measure", quantity="temperature", target="pump")).result["number"] == 55.0
    assert (await hall.done("rover_1", "measure", quantity="noise")).result["number"] > before
    thermal = await hall.done("rover_1", "thermal", target="pump")
    celsius = np.asarray(Image.open(io.BytesIO(thermal.blobs["thermal.png"]))) / 100.0 - 273.15
    assert (round(celsius.max(), 1), celsius.shape) == (55.0, (120, 160))
    assert len((await hall.done("rover_1", "listen", duration_s=1.0)).blobs["sound.wav"]) == 16_044
    scan = (await hall.done("rover_1", "scan")).result
    assert scan["ranges_m"][0] == pytest.approx(4.0, abs=0.1)
    assert scan["ranges_m"][90] is None
    for verb, args in (("measure", {"quantity": "radiation"}), ("follow", {"target": "ghost", "duration_s": 5.0})):
        failure = (await hall.tell("rover_1", verb, **args)).failure
        assert failure is not None
        assert failure.code == "not-found"


async def test_people_answer_what_a_skill_asks_through_a_robot(hall: Hall) -> None:
    """A question that a gateway puts for people is heard by the robot it goes through, and a person near it answers."""
    site = Site(
        places={"charger": Place(x=0.0, y=0.0)},
        people=(Person(name="Ann", at="charger", answers={"door": "it is open"}),),
    )
    answers: list[dict[str, Any]] = []

    async def answer(key: str, payload: bytes) -> bytes:
        answers.append(json.loads(payload))
        return b"{}"

    hall.session.serve(hall.session.keys(keyspace.RPC, "gw-1", "answer"), answer)
    hall.session.declare_alive(hall.session.keys(keyspace.GATEWAY_ALIVE, "gw-1"))
    await hall.rover("rover_1", site=site)
    asked = Enquiry(id="t:s:1", question="Is the door open?", to="Ann", robot="rover_1")
    for enquiry in (
        asked,
        msgspec.structs.replace(asked, id="t:s:2", robot="rover_2"),
        msgspec.structs.replace(asked, id="t:s:3", question="What time is it?"),
        msgspec.structs.replace(asked, id="t:s:4", answer="yes"),
    ):
        hall.session.publish(keyspace.ENQUIRY, enquiry, enquiry.id)
    async with asyncio.timeout(30):
        while not answers:
            hall.session.publish(keyspace.ENQUIRY, asked, asked.id)
            await asyncio.sleep(0.1)
    await asyncio.sleep(1.0)
    assert [(each["id"], each["answer"], each["by"]) for each in answers] == [("t:s:1", "it is open", "Ann")]
    assert answers[0]["act"]


async def test_bad_input_is_answered(hall: Hall) -> None:
    """Malformed commands and world changes are refused and the rover goes on."""
    await hall.rover("rover_1")
    key = hall.session.keys(keyspace.COMMAND, "rover_1")
    for payload in (b"", b"nonsense", b'{"id": 3}'):
        with pytest.raises(PayloadError):
            await hall.session.query(key, payload, timeout_s=5.0)
    for payload in (b"", b"[]", b'{"name": "red box"}', b"x" * 100_000):
        hall.session.put(hall.session.keys(WORLD, "red_box"), payload)
    failure = (await hall.tell("rover_1", "teleport")).failure
    assert failure is not None
    assert "it can: ask, capture, clean, close, cut" in failure.remedy
    await hall.done("rover_1", "state")


async def test_an_unknown_robot_is_unreachable(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command for a robot that nobody speaks for ends with the remedy."""
    monkeypatch.setattr(retry, "UNREACHABLE_S", 0.5)
    with pytest.raises(UnreachableError, match="no answer from robot rover_9"):
        await hall.tell("rover_9", "state")


async def test_a_killed_rover_is_gone_from_the_living(hall: Hall) -> None:
    """The liveliness token of a killed process goes."""
    process = await hall.rover("rover_1")
    process.kill()
    await until(lambda: not hall.alive["rover_1"])


async def test_a_rover_waits_for_its_gateway(free_port: int) -> None:
    """A rover that is switched on before any gateway comes online when one is there."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    order = RobotSettings(name="rover_1", fleet="hall", connect=(endpoint,), site=SITE)
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", _PROCESS, encode(order).decode())
    session: Session | None = None
    try:
        await asyncio.sleep(1.0)
        session = await Session.open(PlaneConfig(listen=(endpoint,)), "hall")
        hall = Hall(session, endpoint)
        await until(lambda: hall.alive.get("rover_1"))
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
        if session is not None:
            await session.close()


async def test_tasks_of_robots_reach_the_gateway(hall: Hall) -> None:
    """A TaskRequest put by a robot is handed over with its name; what is none is counted."""
    client = await Session.open(PlaneConfig(mode="client", connect=(hall.endpoint,)), "hall")
    asked: list[tuple[str, TaskRequest]] = []
    intake = TaskListener(hall.session, lambda robot, request: asked.append((robot, request)))
    intake.start()
    try:

        async def put_until_heard(payload: bytes, holds: Callable[[], bool]) -> None:
            async with asyncio.timeout(60):
                while not holds():
                    client.put(client.keys(keyspace.INTAKE, "rover_1"), payload)
                    await asyncio.sleep(0.05)

        await put_until_heard(b"{", lambda: intake.refused.get("task_malformed", 0) > 0)
        await put_until_heard(b'{"instruction": "charge me"}', lambda: len(asked) > 0)
        robot, request = asked[0]
        assert (robot, request.instruction, request.submitter) == ("rover_1", "charge me", "rover_1")
        assert request.id.startswith("r-")
    finally:
        intake.stop()
        await client.close()
