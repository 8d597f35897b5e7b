"""The shell: what is sent to robots and when, what is reserved meanwhile, and what is given up at the end."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from msgspec.structs import replace

from appliance.errors import RobotError
from appliance.floor import keeper as shell
from appliance.floor.decisions import WayCase, way_again
from appliance.floor.keeper import FloorKeeper
from appliance.floor.settings import FloorConfig
from appliance.model import Failure, Place, Pose, RobotCommand, RobotInfo, RobotReply, Site
from appliance.model.floor import FloorState
from appliance.model.plane_api import LeaseAsk
from appliance.plane.leases import Claim, Grantor, Lease
from appliance.plane.node import Plane

pytestmark = pytest.mark.anyio
SITE = Site(places={"dock 1": Place(x=10.0, y=0.0)})


class Fake:
    """A fleet of one grantor, and robots that go where they are sent at once, unless they are held up."""

    def __init__(self) -> None:
        self.gateway = "gw-1"
        self.registry = SimpleNamespace(robots=dict[str, RobotInfo]())
        self.session = SimpleNamespace(
            keys=self._keys,
            subscribe=self._subscribe,
            subscribe_typed=self._subscribe,
            publish=self._publish,
            put=self._put,
        )
        self.leases = self
        self.grantor = Grantor(fence=0, now=time.monotonic())
        self.fence = 0
        self.sent: list[RobotCommand] = []
        self.told: list[FloorState] = []
        self.cases: list[bytes] = []
        self.notes: list[str] = []
        self.held_up = asyncio.Event()
        self.held_up.set()
        self.stopped: list[str] = []

    def _keys(self, *_: Any) -> str:
        return ""

    def _subscribe(self, *_: Any) -> Any:
        return SimpleNamespace(close=lambda: None)

    def _put(self, _key: str, case: bytes) -> None:
        self.cases.append(case)

    def _publish(self, _topic: Any, state: FloorState, _robot: str) -> None:
        self.told.append(state)

    async def claim(self, key: str, holder: str, parts: Any, *, ttl_s: float, after: int, cleared: Any) -> Claim:
        """As `Leases.claim`, of one grantor."""
        self.fence += 1
        answer = self.grantor.grant(
            LeaseAsk(
                key=key, holder=holder, fence=self.fence, ttl_s=ttl_s, voters="", parts=tuple(parts), after=after,
                cleared=tuple(cleared),
            ),
            time.monotonic(),
        )  # fmt: skip
        if not answer.granted:
            return Claim(holder=answer.holder, part=answer.part, ended=answer.left_s <= 0.0)
        until = time.clock_gettime(time.CLOCK_BOOTTIME) + ttl_s
        return Claim(lease=Lease(key=key, holder=holder, fence=self.fence, until=until))

    def tell(self, _told: Any) -> None:
        """As `Leases.tell`."""

    def put(self, robot: str, x: float, y: float = 0.0, **fields: Any) -> None:
        """A robot says where it is."""
        self.registry.robots[robot] = RobotInfo(id=robot, kind="zenoh", pose=Pose(x=x, y=y), **fields)

    async def send(self, command: RobotCommand) -> RobotReply:
        """The robot carries it out."""
        self.sent.append(command)
        try:
            await self.held_up.wait()
        except asyncio.CancelledError:
            self.stopped.append(command.id)
            raise
        if command.verb == "goto":
            self.put("a", command.args["waypoints"][-1]["x"], command.args["waypoints"][-1]["y"])
        return RobotReply(id=command.id)

    def free(self, *parts: str) -> bool:
        """Whether another could have these parts."""
        self.fence += 1
        asked = LeaseAsk(key="floor", holder="probe", fence=self.fence, ttl_s=0.001, voters="", parts=parts)
        return self.grantor.grant(asked, time.monotonic()).granted


@pytest.fixture
def fleet() -> Fake:
    """Return a fleet with a robot in it."""
    made = Fake()
    made.put("a", 0.0)
    return made


@pytest.fixture
async def floor(fleet: Fake, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[FloorKeeper]:
    """The floor of its gateway, with short times."""
    for name in ("WATCH_S", "RETRY_S", "RENEW_S"):
        monkeypatch.setattr(shell, name, 0.01)
    monkeypatch.setattr("appliance.floor.sight.STANDS_S", 0.05)
    made = FloorKeeper(cast("Plane", fleet), SITE, FloorConfig(wait_s=0.5), voters=True, takeoff_m=10.0)
    made.start()
    yield made
    await made.close()


def goto(x: float, y: float = 0.0, *, attempt: int = 1) -> RobotCommand:
    """Return a command."""
    args = {"waypoints": [{"x": x, "y": y}]}
    return RobotCommand(id="t/s1/1", verb="goto", args=args, task="t", attempt=attempt)


def drive(floor: FloorKeeper, fleet: Fake, command: RobotCommand) -> "asyncio.Task[RobotReply]":
    """Begin a command."""
    going = floor.drive("a", command, send=fleet.send, on_wait=fleet.notes.append, on_waited=lambda _: None)
    return asyncio.ensure_future(going)


async def until(holds: Callable[[], bool]) -> None:
    """Wait until something holds, which must be soon."""
    async with asyncio.timeout(5):
        while not holds():
            await asyncio.sleep(0.01)


async def test_the_way_and_the_place_are_reserved_meanwhile(floor: FloorKeeper, fleet: Fake) -> None:
    """All of it while it goes; afterwards the ground and the place that it stands on."""
    fleet.held_up.clear()
    going = drive(floor, fleet, goto(10.0))
    await until(lambda: bool(fleet.sent))
    assert fleet.sent == [goto(10.0)]
    assert not fleet.free("place/dock 1")
    assert not fleet.free("0,10,0")
    fleet.held_up.set()
    assert (await going).failure is None
    await until(lambda: fleet.free("0,10,0"))
    assert not fleet.free("place/dock 1")
    assert [each.state for each in fleet.told if each.state != "moves"] == ["stands"]


async def test_a_cancelled_command_gives_up_what_it_has_not_reached(floor: FloorKeeper, fleet: Fake) -> None:
    """The robot is stopped; the place and the way are free, the ground under it is not."""
    fleet.held_up.clear()
    going = drive(floor, fleet, goto(10.0))
    await until(lambda: bool(fleet.sent))
    fleet.put("a", 3.0)
    going.cancel()
    await asyncio.gather(going, return_exceptions=True)
    assert fleet.stopped == ["t/s1/1"]
    await until(lambda: fleet.free("place/dock 1", "0,14,0"))
    assert not fleet.free("0,6,0")


async def test_it_waits_with_the_reason_and_fails_with_it(floor: FloorKeeper, fleet: Fake) -> None:
    """Nothing is sent, and the error says who is in the way and what to do."""
    fleet.put("b", 10.2)
    with pytest.raises(RobotError, match="waits for b to leave dock 1") as failed:
        await drive(floor, fleet, goto(10.0))
    assert fleet.sent == []
    assert "floor.wait_s" in failed.value.remedy
    assert fleet.notes[0] == "waits for b to leave dock 1"


async def test_decisions_are_put_for_the_log(floor: FloorKeeper, fleet: Fake) -> None:
    """One for what it waits for, however often it asks, and one when it goes; each can be made again by itself."""
    fleet.put("b", 10.2)
    going = drive(floor, fleet, goto(10.0))
    await until(lambda: len(fleet.notes) > 0)
    await asyncio.sleep(0.1)
    fleet.put("b", 10.2, 8.0)
    await going
    cases = [msgspec.json.decode(each, type=WayCase) for each in fleet.cases]
    assert [each.why for each in cases].count("waits for b to leave dock 1") == 1
    assert cases[-1].why == ""
    for case in cases:
        again = way_again(case)
        assert again is not None
        assert again == {name: getattr(case, name) for name in again}


async def test_it_waits_for_a_lost_robot_with_the_remedy(floor: FloorKeeper, fleet: Fake) -> None:
    """The note while it waits, and the error at the end, name the command that forgets it."""
    fleet.put("b", 10.2, online=False)
    with pytest.raises(RobotError, match="lost at dock 1") as failed:
        await drive(floor, fleet, goto(10.0))
    assert "`swiftbot robots forget b`" in failed.value.remedy
    assert "`swiftbot robots forget b`" in fleet.notes[0]


async def test_it_goes_when_the_other_has_left(floor: FloorKeeper, fleet: Fake) -> None:
    """Without being told to."""
    fleet.put("b", 10.2)
    going = drive(floor, fleet, goto(10.0))
    await until(lambda: bool(fleet.notes))
    fleet.put("b", 10.2, 8.0)
    assert (await going).id == "t/s1/1"
    assert fleet.notes[-1] == "goes on its way"


async def test_it_stops_before_one_without_a_reservation(floor: FloorKeeper, fleet: Fake) -> None:
    """And goes on round it, by a command of another id: the first one's end is known to the robot."""
    fleet.held_up.clear()
    going = drive(floor, fleet, goto(10.0))
    await until(lambda: bool(fleet.sent))
    fleet.put("b", 1.0)
    await until(lambda: len(fleet.sent) > 1 or going.done())
    assert fleet.stopped == ["t/s1/1"]
    assert "waits for b, which is in its way" in fleet.notes
    assert fleet.sent[1].id == "t/s1/1~2"
    assert len(fleet.sent[1].args["waypoints"]) > 1
    fleet.held_up.set()
    assert (await going).failure is None


async def test_a_later_attempt_joins_the_way_that_its_robot_is_on(floor: FloorKeeper, fleet: Fake) -> None:
    """The gateway before has told the way; the same id is sent, and the way stays reserved."""
    way = ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (10.0, 0.0, 0.0))
    state = FloorState(robot="a", state="moves", command="t/s1/1~2", way=way, place="dock 1")
    for number in range(8):
        fleet.put("a", 5.5 + 0.2 * number)
        floor.bodies()
        await asyncio.sleep(0.01)
    floor.sight.hear(state, time.monotonic())
    await drive(floor, fleet, goto(10.0, attempt=2))
    assert [each.id for each in fleet.sent] == ["t/s1/1~2"]
    assert fleet.sent[0].args["waypoints"] == [{"x": 10.0, "y": 0.0}]


async def test_going_home_is_reserved_too(floor: FloorKeeper, fleet: Fake) -> None:
    """A robot on the ground is sent along a way that is reserved, then told to go home."""
    fleet.put("a", 0.0, home=Pose(x=4.0))
    await drive(floor, fleet, replace(goto(0.0), verb="return_home", args={}))
    assert [(each.id, each.verb) for each in fleet.sent] == [("t/s1/1~h1", "goto"), ("t/s1/1", "return_home")]


async def test_a_refusal_of_the_robot_is_its_answer(floor: FloorKeeper, fleet: Fake) -> None:
    """It is handed on, and nothing stays reserved but the ground."""
    failure = Failure(code="busy", message="it does something else")

    async def send(command: RobotCommand) -> RobotReply:
        return RobotReply(id=command.id, failure=failure)

    reply = await floor.drive("a", goto(10.0), send=send, on_wait=fleet.notes.append, on_waited=lambda _: None)
    assert reply.failure == failure
    await until(lambda: fleet.free("place/dock 1"))


@pytest.mark.parametrize("command", [replace(goto(5.0), verb="capture", args={"target": "x"}), goto(5.0)])
async def test_what_is_not_reserved_is_sent_at_once(fleet: Fake, command: RobotCommand) -> None:
    """Commands that move nothing, and all of them where nobody is named to grant ways."""
    voters = command.verb == "capture"
    floor = FloorKeeper(cast("Plane", fleet), SITE, FloorConfig(), voters=voters, takeoff_m=10.0)
    await drive(floor, fleet, command)
    assert fleet.sent == [command]
    assert fleet.told == []


async def test_a_way_that_another_crosses_is_gone_in_stretches(floor: FloorKeeper, fleet: Fake) -> None:
    """Each has an id of its own; the last one has the command's, and ends where the command does."""
    crossing = ((15.0, -8.0, 0.0), (15.0, 8.0, 0.0))
    fleet.put("b", 15.0, -8.0)
    floor.bodies()
    floor.sight.hear(FloorState(robot="b", state="moves", task="u", command="u/1", way=crossing), time.monotonic())
    assert (await drive(floor, fleet, goto(20.0))).failure is None
    ends = [each.args["waypoints"][-1]["x"] for each in fleet.sent]
    assert fleet.sent[0].id == "t/s1/1~p1.1"
    assert fleet.sent[-1].id == "t/s1/1"
    assert [each.id for each in fleet.sent[1:-1]] == [f"t/s1/1~p1.{number}" for number in range(2, len(ends))]
    assert ends == sorted(ends)
    assert ends[-1] == 20.0
    assert all(abs(end - 15.0) > 1.0 for end in ends)


async def test_a_later_attempt_goes_on_from_the_end_of_a_stretch(floor: FloorKeeper, fleet: Fake) -> None:
    """The gateway before has died meanwhile: points that the robot has passed are not gone to again."""
    fleet.put("a", 5.0, 3.0)
    floor.bodies()
    await asyncio.sleep(0.1)
    way = ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (5.0, 3.0, 0.0))
    state = FloorState(robot="a", state="moves", command="t/s1/1~p1.1", way=way, wants=((5.0, 8.0, 0.0),))
    floor.sight.hear(state, time.monotonic())
    args = {"waypoints": [{"x": 5.0, "y": 0.0}, {"x": 5.0, "y": 8.0}]}
    await drive(floor, fleet, replace(goto(0.0, attempt=2), args=args))
    assert [each.id for each in fleet.sent] == ["t/s1/1"]
    assert fleet.sent[0].args["waypoints"] == [{"x": 5.0, "y": 8.0}]
