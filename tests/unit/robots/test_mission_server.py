"""Missions uploaded to the gateway: taken item by item over bad links, held, given back, refused with a reason."""

import asyncio
import math
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import PayloadError
from appliance.llm.checks.schema import validate
from appliance.model import Box, Place, Plan, Site, TaskRecord, TaskRequest, TaskState
from appliance.model.site import to_globe
from appliance.robots.mavlink.command_server import CommandServer
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.mavlink.mission_server import Item, MissionServer, UnfitItem, plan_of
from appliance.robots.settings import RobotsConfig
from appliance.robots.task_listener import Tasks
from appliance.skills.catalogue import load_catalogue
from tests.unit.robots.conftest import FakeStore

pytestmark = pytest.mark.anyio

SITE = Site(
    places={"home": Place(x=4.0, y=4.0)},
    altitude_limit_m=30.0,
    forbidden=(Box(name="the pond", x=(40.0, 50.0), y=(40.0, 50.0)),),
    obstacles=(Box(name="the shed", x=(52.0, 56.0), y=(40.0, 50.0)),),
    fence=Box(name="the fence", x=(0.0, 60.0), y=(0.0, 60.0)),
    altitude_m=488.0,
)
ACCEPTED, DENIED, UNSUPPORTED, NO_SPACE, INVALID_SEQUENCE, CANCELLED = 0, 14, 3, 4, 13, 15
WAYPOINT, TAKEOFF, LAND, RETURN, TURNS, PICTURE, SPEED, JUMP = 16, 22, 21, 20, 18, 2000, 178, 177
LOITER_TIME, DELAY = 19, 93


def item(command: int, x: float = 0.0, y: float = 0.0, z: float = 8.0, *params: float, frame: int = 6) -> Item:
    """Return an item at a point of the site."""
    latitude, longitude, _ = to_globe(SITE, x, y)
    four = (*params, *([None] * 4))[:4]
    nowhere = command in (TAKEOFF, RETURN, PICTURE, SPEED, JUMP) or (command == LAND and not x)
    return Item(
        command=command,
        frame=frame,
        params=(four[0], four[1], four[2], four[3]),
        x=0 if nowhere else round(latitude * 1e7),
        y=0 if nowhere else round(longitude * 1e7),
        z=z,
    )


class Ground:
    """A ground station at the other end of a link, and the desk; what either sends may be lost, doubled or late."""

    def __init__(self, store: FakeStore, *, loss: float = 0.0, seed: int = 1, **changes: Any) -> None:
        self.now = 0.0
        self.refused: dict[str, int] = {}
        self.chance = random.Random(seed)  # noqa: S311 - a bad link, no secret
        self.loss = loss
        self.codec = Codec(255, 190)
        self.inbox: list[Message] = []
        self.acks: list[int] = []
        self.texts: list[str] = []
        config = RobotsConfig(**changes)
        self.desk = MissionServer(config, site=SITE, store=store, refused=self.refused, clock=lambda: self.now)

    def tell(self, name: str, *, robot: str = "drone_1", source: tuple[int, int] = (255, 190), **fields: Any) -> None:
        """Send a message to the desk, over the bad link."""
        raw = Codec(*source).pack(make(name, target_system=1, target_component=191, **fields))
        for _ in range(self._copies()):
            (frame,) = Codec(245, 191).read(raw)
            assert isinstance(frame, Frame)
            self.desk.take(frame, robot=robot, reply=self._hear)

    def _copies(self) -> int:
        return 0 if self.chance.random() < self.loss else 2 if self.chance.random() < self.loss else 1

    def _hear(self, message: Message) -> None:
        if message.get_type() == "STATUSTEXT":
            self.texts.append(message.text.decode() if isinstance(message.text, bytes) else message.text)
            return
        for _ in range(self._copies()):
            if message.get_type() == "MISSION_ACK":
                self.acks.append(message.type)
            elif self.chance.random() < self.loss:
                self.inbox.insert(0, message)
            else:
                self.inbox.append(message)

    def give(self, number: int, items: list[Item]) -> None:
        """Send an item."""
        each = items[number]
        params = {f"param{place + 1}": math.nan if value is None else value for place, value in enumerate(each.params)}
        fields = {
            "frame": each.frame,
            "command": each.command,
            "x": each.x,
            "y": each.y,
            "z": math.nan if each.z is None else each.z,
            **params,
        }
        self.tell("MISSION_ITEM_INT", seq=number, current=0, autocontinue=1, **fields)

    async def upload(self, items: list[Item]) -> int:
        """Upload as ground stations do, until it is acknowledged; returns the result."""
        self.acks.clear()
        for turn in range(2000):
            if self.acks:
                break
            if turn % 20 == 0 and not self.inbox:
                self.tell("MISSION_COUNT", count=len(items))
            while self.inbox:
                asked = self.inbox.pop()
                if asked.get_type() == "MISSION_REQUEST_INT":
                    self.give(asked.seq, items)
            self.now += 0.1
            self.desk.tick()
            for _ in range(4):
                await asyncio.sleep(0)
        return self.acks[0]


MISSION = [
    item(TAKEOFF, z=8.0),
    item(WAYPOINT, 10, 4),
    item(WAYPOINT, 20, 4),
    item(PICTURE, 0, 0, 0, 0.0, 0.0, 3.0),
    item(RETURN),
]


async def test_what_a_mission_means() -> None:
    """Each item becomes the skill that does it, one after the other, for the vehicle that it was uploaded to."""
    speed = item(SPEED, 0, 0, 0, 0.0, 4.0)
    items = [
        *MISSION[:4],
        item(TURNS, 12, 12, 8, 2.0, 0.0, 5.0),
        speed,
        item(WAYPOINT, 8, 8, 6, 10.0),
        item(LAND, 4, 4),
    ]
    plan = plan_of(items, robot="drone_1", site=SITE)
    assert [(each.skill, each.params) for each in plan.subtasks] == [
        ("takeoff", {"altitude_m": 8.0}),
        ("follow_path", {"path": "(10.0, 4.0, 8.0); (20.0, 4.0, 8.0)"}),
        ("photograph", {"target": "(20.0, 4.0, 8.0)", "count": 3}),
        ("orbit", {"target": "(12.0, 12.0, 8.0)", "laps": 2, "radius_m": 5.0}),
        ("goto", {"place": "(8.0, 8.0, 6.0)", "speed_mps": 4.0}),
        ("hold", {"duration_s": 10.0}),
        ("goto", {"place": "(4.0, 4.0, 8.0)", "speed_mps": 4.0}),
        ("land", {}),
    ]
    assert {each.robot for each in plan.subtasks} == {"drone_1"}
    assert [each.after for each in plan.subtasks] == [(), *((each.id,) for each in plan.subtasks[:-1])]


async def test_a_mission_of_more_subtasks_than_a_plan_may_have_is_refused_at_its_upload(store: FakeStore) -> None:
    """Not when it is started: the ground station hears the limit and to split it, and nothing is held."""
    ground = Ground(store)
    turns = [item(TURNS, 12, 12, 8, 2.0, 0.0, 5.0) for _ in range(65)]
    assert await ground.upload([MISSION[0], *turns]) == NO_SPACE
    told = "".join(ground.texts)
    assert "at most 64" in told
    assert "split the mission" in told
    assert not store.values


@pytest.mark.parametrize(
    ("bad", "result", "told"),
    [
        (item(JUMP), UNSUPPORTED, "DO_JUMP is not supported"),
        (item(WAYPOINT, 10, 4, frame=1), 2, "LOCAL_NED is not supported"),
        (item(WAYPOINT, 30_000, 4), 11, "10 km"),
        (item(WAYPOINT, 500, 4), 11, "outside the fence"),
        (item(WAYPOINT, 10, -500), 10, "outside the fence"),
        (item(WAYPOINT, 10, 4, -5.0), 12, "5 m under the ground"),
        (item(WAYPOINT, 10, 4, 480.0, frame=0), 12, "8 m under the ground"),
        (item(LAND, 61, 4, 0.0), 11, "outside the fence"),
        (item(LOITER_TIME, 10, 4, 31.0, 5.0), 12, "limit of 30 m"),
        (item(TURNS, 10, 10, 8.0, 1.0, 0.0, 12.0), 8, "a circle of 12 m lies outside the fence"),
        (item(WAYPOINT, 54, 45), DENIED, "inside the shed"),
        (item(SPEED, 0, 0, 0, 0.0, 9.0), 7, "param2"),
        (item(TAKEOFF, z=40.0), 12, "limit of 30 m"),
        (item(TAKEOFF, z=550.0, frame=0), 12, "62 m up"),
        (item(WAYPOINT, 10, 4, 80.0), 12, "limit of 30 m"),
        (item(WAYPOINT, 45, 45), DENIED, "the pond"),
        (item(WAYPOINT, 10, 4, 8.0, 1e9), 6, "param1"),
        (item(TAKEOFF, z=-3.0), 12, "3 m under the ground"),
        (item(TAKEOFF, z=0.2), 12, "too low"),
        (Item(command=WAYPOINT, frame=6, z=None), 12, "no altitude"),
    ],
)
async def test_what_cannot_be_flown(store: FakeStore, bad: Item, result: int, told: str) -> None:
    """It is refused with MAVLink's own reason and a sentence that names the item; nothing is held."""
    ground = Ground(store)
    if bad.z is not None:
        assert await ground.upload([*MISSION[:2], bad]) == result
        assert told in "".join(ground.texts)
        assert "item 2" in "".join(ground.texts)
        assert not store.values
    with pytest.raises(UnfitItem, match=told.replace("(", ".")) as caught:
        plan_of([*MISSION[:2], bad], robot="drone_1", site=SITE)
    assert caught.value.result == result


CATALOGUE = load_catalogue()


@pytest.mark.parametrize(
    "items",
    [
        [item(TAKEOFF), item(WAYPOINT, 10, 10)],
        [item(TAKEOFF), item(WAYPOINT, 10, 10, 8.0, 5.0)],
        [item(TAKEOFF), item(LOITER_TIME, 10, 10, 8.0, 5.0)],
        [item(TAKEOFF), item(LAND, 10, 10, 0.0)],
        [item(TAKEOFF), replace(item(LAND, 10, 10, 0.0), z=None)],
        [item(TAKEOFF, z=498.0, frame=0), item(WAYPOINT, 10, 10, 498.0, frame=0)],
        [item(TAKEOFF), item(WAYPOINT, 10, 10, -0.5), item(DELAY, 0, 0, 0, 0.0)],
        [item(WAYPOINT, number % 60, number // 5, 10) for number in range(200)],
    ],
)
async def test_what_is_accepted_may_run(store: FakeStore, items: list[Item]) -> None:
    """The plan of a mission that was accepted has no problem: the same check looks at both."""
    site = replace(SITE, obstacles=(), forbidden=())
    ground = Ground(store)
    ground.desk = MissionServer(
        RobotsConfig(), site=site, store=store, refused=ground.refused, clock=lambda: ground.now, problems=problems
    )
    assert await ground.upload(items) == ACCEPTED, ground.texts
    _, plan = ground.desk.request("drone_1", (0.0,) * 7)
    assert problems(plan) == ()


async def test_what_would_not_run_is_refused_with_the_reason_of_its_plan(store: FakeStore) -> None:
    """Whatever the check of plans has against a mission is said when it is uploaded, and nothing is held."""
    ground = Ground(store)
    ground.desk = MissionServer(
        RobotsConfig(), site=SITE, store=store, refused=ground.refused, clock=lambda: ground.now, problems=problems
    )
    assert await ground.upload([item(WAYPOINT, 1 + number % 30, 4, 8.0, 1.0) for number in range(40)]) == NO_SPACE
    assert "at most 64" in "".join(ground.texts)
    assert not store.values


def problems(plan: Plan) -> tuple[str, ...]:
    """What the check of plans has against one."""
    return validate(plan, CATALOGUE, site=replace(SITE, obstacles=(), forbidden=()), require_implemented=True)


@pytest.mark.parametrize("seed", range(8))
async def test_upload_over_a_bad_link(store: FakeStore, seed: int) -> None:
    """With a quarter lost, doubled and out of order each way, the mission arrives as it was sent."""
    ground = Ground(store, loss=0.25, seed=seed, tries=30)
    assert await ground.upload(MISSION) == ACCEPTED
    ground.loss = 0.0
    ground.inbox.clear()
    ground.tell("MISSION_REQUEST_LIST")
    assert ground.inbox.pop().count == len(MISSION)
    for number, sent in enumerate(MISSION):
        ground.tell("MISSION_REQUEST_INT", seq=number)
        back = ground.inbox.pop()
        assert (back.seq, back.command, back.x, back.y, back.z) == (number, sent.command, sent.x, sent.y, sent.z)


async def test_a_mission_outlives_a_restart_and_is_cleared(store: FakeStore) -> None:
    """What was acknowledged is there after a restart; what was cleared is not."""
    assert await Ground(store).upload(MISSION) == ACCEPTED
    again = Ground(store)
    await again.desk.load()
    text, plan = again.desk.request("drone_1", (0.0,) * 7)
    assert "drone_1" in text
    assert len(plan.subtasks) == 4
    assert len(again.desk.request("drone_1", (1.0, 2.0, 0, 0, 0, 0, 0))[1].subtasks) == 1
    with pytest.raises(PayloadError, match="items 3 to 99"):
        again.desk.request("drone_1", (3.0, 99.0, 0, 0, 0, 0, 0))
    again.tell("MISSION_CLEAR_ALL")
    for _ in range(4):
        await asyncio.sleep(0)
    assert again.acks == [ACCEPTED]
    with pytest.raises(PayloadError, match="no mission"):
        again.desk.request("drone_1", (0.0,) * 7)
    assert not store.values


async def test_what_is_no_upload(store: FakeStore) -> None:
    """Too many items, other kinds, no vehicle, items out of nowhere, two at once: each has its answer."""
    ground = Ground(store, mission_items=5)
    ground.tell("MISSION_COUNT", count=6)
    ground.tell("MISSION_COUNT", count=65_535)
    ground.tell("MISSION_COUNT", count=2, mission_type=1)
    ground.tell("MISSION_COUNT", count=2, robot="")
    ground.give(0, MISSION)
    ground.tell("MISSION_REQUEST_INT", seq=0)
    assert ground.acks == [NO_SPACE, NO_SPACE, UNSUPPORTED, DENIED, INVALID_SEQUENCE, INVALID_SEQUENCE]
    ground.acks.clear()
    ground.tell("MISSION_COUNT", count=3)
    ground.tell("MISSION_COUNT", count=2, source=(254, 190))
    assert ground.acks == [DENIED]
    assert "another one" in ground.texts[-1]
    assert ground.refused["mission_refused"] == 3


async def test_an_upload_that_is_left_is_given_up(store: FakeStore) -> None:
    """An item that does not come is asked for as often as is set, then the sender hears so, and another may begin."""
    ground = Ground(store, tries=4, ack_timeout_s=0.5)
    ground.tell("MISSION_COUNT", count=3)
    for _ in range(60):
        ground.now += 0.1
        ground.desk.tick()
    assert [each.seq for each in ground.inbox] == [0] * 4
    assert ground.acks == [CANCELLED]
    ground.inbox.clear()
    assert await ground.upload(MISSION) == ACCEPTED


@given(
    st.lists(
        st.tuples(st.integers(0, 6), st.integers(0, 70_000), st.integers(0, 255), st.floats(width=32)), max_size=60
    )
)
async def test_whatever_comes(messages: list[tuple[int, int, int, float]]) -> None:
    """Any mission messages in any order: no crash, and nothing grows beyond its bounds."""
    ground = Ground(FakeStore(), mission_items=20)
    names = ("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_ITEM", "MISSION_REQUEST_INT", "MISSION_CLEAR_ALL",
             "MISSION_WRITE_PARTIAL_LIST", "MISSION_ACK")  # fmt: skip
    for which, large, kind, value in messages:
        name, number = names[which], large % 65_536
        whole = name == "MISSION_ITEM_INT"
        place = {"x": number * 1000 if whole else value, "y": -number if whole else value, "z": value}
        params = {f"param{index}": value for index in range(1, 5)}
        ground.tell(
            name,
            source=(kind, 190),
            **(
                {"count": number} if name == "MISSION_COUNT"
                else {"seq": number % 4} if name == "MISSION_REQUEST_INT"
                else {"type": kind % 16} if name == "MISSION_ACK"
                else {"start_index": 0, "end_index": number % 32_768} if name == "MISSION_WRITE_PARTIAL_LIST"
                else {} if name == "MISSION_CLEAR_ALL"
                else {"seq": number % 4, "frame": kind % 21, "command": number, "current": 0, "autocontinue": 0,
                      **params, **place}
            ),
        )  # fmt: skip
        ground.now += 0.2
        ground.desk.tick()
        await asyncio.sleep(0)
    await ground.desk.close()
    assert len(ground.desk._uploads) <= 16


class Fleet:
    """The fleet's tasks, and what the command desk answered."""

    def __init__(self, store: FakeStore) -> None:
        self.ground = Ground(store)
        self.submitted: list[TaskRequest] = []
        self.cancelled: list[str] = []
        self.state = TaskState.CANCELLING
        self.said: list[Message] = []
        tasks = Tasks(submit=self.submit, cancel=lambda task, _: self.cancel(task), look=self.cancel)
        self.desk = CommandServer((), tasks=tasks, store=store, refused={}, mission=self.ground.desk.request)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task."""
        self.submitted.append(request)
        return TaskRecord(id=request.id, instruction=request.instruction)

    async def cancel(self, task: str) -> TaskRecord:
        """Cancel a task."""
        self.cancelled.append(task)
        return TaskRecord(id=task, instruction="", state=self.state)

    async def tell(self, message: Message) -> list[tuple[int, int]]:
        """Send a command; returns command and result of each acknowledgement so far."""
        (frame,) = Codec(245, 191).read(Codec(255, 190).pack(message))
        assert isinstance(frame, Frame)
        self.desk.take(frame, robot="drone_1", reply=self.said.append)
        for _ in range(20):
            await asyncio.sleep(0)
        return [(each.command, each.result) for each in self.said if each.get_type() == "COMMAND_ACK"]


def start(confirmation: int = 0) -> Message:
    """Return MAV_CMD_MISSION_START."""
    params = {f"param{place}": 0.0 for place in range(1, 8)}
    return make("COMMAND_LONG", target_system=1, target_component=191, command=300, confirmation=confirmation, **params)


async def test_a_mission_is_started_and_cancelled(store: FakeStore) -> None:
    """MISSION_START is accepted with the plan handed in, a repetition alike; COMMAND_CANCEL ends it as CANCELLED."""
    fleet = Fleet(store)
    assert (await fleet.tell(start()))[-1] == (300, 2)
    assert any("no mission" in str(each.text) for each in fleet.said if each.get_type() == "STATUSTEXT")
    assert await fleet.ground.upload(MISSION) == ACCEPTED
    assert (await fleet.tell(start()))[-2:] == [(300, 5), (300, 0)]
    assert (await fleet.tell(start(confirmation=1)))[-1] == (300, 0)
    (request,) = fleet.submitted
    assert request.plan is not None
    assert [each.skill for each in request.plan.subtasks] == ["takeoff", "follow_path", "photograph", "return_home"]
    cancel = make("COMMAND_CANCEL", command=300, target_system=1, target_component=191)
    assert (await fleet.tell(cancel))[-1] == (300, 6)
    assert fleet.cancelled == [request.id]
    fleet.state = TaskState.SUCCEEDED
    assert (await fleet.tell(cancel))[-1] == (300, 0)


async def test_nothing_to_cancel(store: FakeStore) -> None:
    """COMMAND_CANCEL for a command that asked for nothing is DENIED with a sentence; for others it is counted."""
    fleet = Fleet(store)
    cancel = {"target_system": 1, "target_component": 191}
    assert (await fleet.tell(make("COMMAND_CANCEL", command=31010, **cancel)))[-1] == (31010, 2)
    assert len(await fleet.tell(make("COMMAND_CANCEL", command=400, **cancel))) == 1
    assert fleet.cancelled == []
