"""Missions, parameters and commands that broke other MAVLink programs, as their users reported.

The source of each is in the table (`tests/reports/reports.toml`), which names the test.
"""

import asyncio
import math
import struct
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.errors import NotFoundError, PayloadError
from appliance.robots.mavlink import dialect, protocols
from appliance.robots.mavlink.command_server import parameters_of
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.mavlink.mission_server import UnfitItem, plan_of
from appliance.robots.mavlink.protocols import RetryPolicy, command
from appliance.robots.verbs import RobotFailure, in_range
from tests.unit.robots.conftest import FakeStore
from tests.unit.robots.test_command_server import IN_PROGRESS, TEMPORARILY_REJECTED, Fleet
from tests.unit.robots.test_mission_server import (
    ACCEPTED,
    CANCELLED,
    INVALID_SEQUENCE,
    LAND,
    MISSION,
    SITE,
    TAKEOFF,
    WAYPOINT,
    Ground,
    item,
)
from tests.unit.robots.test_protocols import BEAT, PATIENCE, Fake, ack

pytestmark = pytest.mark.anyio
LOITER = 17


async def settle() -> None:
    """Let what was begun go on."""
    for _ in range(4):
        await asyncio.sleep(0)


# --- missions ----------------------------------------------------------------------------------------------------


async def test_a_count_that_comes_again_begins_no_deadlock(store: FakeStore) -> None:
    """The station did not hear the request and says the count again, before and after the first item.

    Reported as PX4/PX4-Autopilot#3051.
    """
    ground = Ground(store)
    ground.tell("MISSION_COUNT", count=2)
    ground.tell("MISSION_COUNT", count=2)
    ground.give(0, MISSION)
    ground.tell("MISSION_COUNT", count=2)
    assert [each.seq for each in ground.inbox] == [0, 0, 1, 0]
    for number in (0, 1):
        ground.give(number, MISSION)
    await settle()
    assert ground.acks == [ACCEPTED]
    assert ground.refused == {}


async def test_no_item_before_the_first_is_asked_for(store: FakeStore) -> None:
    """Where the count was lost nothing is asked, and an item alone is refused (mavlink/MAVSDK#678)."""
    ground = Ground(store)
    ground.give(1, MISSION)
    for _ in range(100):
        ground.now += 0.1
        ground.desk.tick()
    assert (ground.inbox, ground.acks) == ([], [INVALID_SEQUENCE])


async def test_one_question_has_one_count(store: FakeStore) -> None:
    """A list is answered once (PX4/PX4-Autopilot#4721)."""
    ground = Ground(store)
    ground.tell("MISSION_REQUEST_LIST")
    for _ in range(50):
        ground.now += 0.1
        ground.desk.tick()
    assert [(each.get_type(), each.count) for each in ground.inbox] == [("MISSION_COUNT", 0)]


async def test_an_item_that_comes_twice_ends_no_upload(store: FakeStore) -> None:
    """The station answers both requests of an item that was asked for again (mavlink/mavlink#950)."""
    ground = Ground(store)
    ground.tell("MISSION_COUNT", count=3)
    for number in (0, 0, 1, 0, 1, 2, 2):
        ground.give(number, MISSION)
    await settle()
    assert set(ground.acks) == {ACCEPTED}
    assert ground.refused == {}


async def test_an_item_out_of_turn_is_asked_for_in_its_turn(store: FakeStore) -> None:
    """A later item than the one asked for does not fail the transfer (mavlink/qgroundcontrol#5852)."""
    ground = Ground(store)
    ground.tell("MISSION_COUNT", count=3)
    ground.give(0, MISSION)
    ground.give(2, MISSION)
    assert [each.seq for each in ground.inbox] == [0, 1, 1]
    for number in (1, 2):
        ground.give(number, MISSION)
    await settle()
    assert ground.acks == [ACCEPTED]
    assert ground.refused == {"mission_out_of_order": 1}


async def test_an_upload_whose_items_do_not_come_has_an_end(store: FakeStore) -> None:
    """Both ends hear so, after so many tries, and a new upload is taken (mavlink/MAVSDK#617)."""
    ground = Ground(store, tries=3)
    ground.tell("MISSION_COUNT", count=2)
    for _ in range(50):
        ground.now += 0.1
        ground.desk.tick()
    assert ground.acks == [CANCELLED]
    assert len(ground.inbox) == 3
    ground.inbox.clear()
    assert await ground.upload(MISSION) == ACCEPTED


async def test_an_item_is_given_as_often_as_it_is_asked_for(store: FakeStore) -> None:
    """Answering it once does not remove it (mavlink/qgroundcontrol#6059)."""
    ground = Ground(store)
    assert await ground.upload(MISSION) == ACCEPTED
    for _ in range(3):
        ground.tell("MISSION_REQUEST_INT", seq=1)
    assert [each.seq for each in ground.inbox] == [1, 1, 1]


async def test_an_item_beyond_the_last_is_refused(store: FakeStore) -> None:
    """Silence would have the station ask for ever (ArduPilot/ardupilot#5595)."""
    ground = Ground(store)
    await ground.upload(MISSION)
    ground.acks.clear()
    ground.tell("MISSION_REQUEST_INT", seq=len(MISSION))
    assert (ground.inbox, ground.acks) == ([], [INVALID_SEQUENCE])


async def test_a_heading_that_is_not_set_is_no_error(store: FakeStore) -> None:
    """QGroundControl sends NaN as the yaw of an item where people leave it out (ArduPilot/ardupilot#27482)."""
    ground = Ground(store)
    assert await ground.upload([MISSION[0], item(LOITER, 10, 4, 8, 0.0, 0.0, 0.0, math.nan)]) == ACCEPTED
    _, plan = ground.desk.request("drone_1", (0.0, 0.0))
    assert all(value == value for each in plan.subtasks for value in each.params.values())  # noqa: PLR0124 - no NaN


def test_an_altitude_that_is_not_set() -> None:
    """NaN as param7 is the ground where a landing names a place; a take-off without a height is refused by its number.

    Reported as mavlink/qgroundcontrol#5183.
    """
    landing = replace(item(LAND, 12, 4), z=None)
    assert [each.skill for each in plan_of([MISSION[0], landing], robot="drone_1", site=SITE).subtasks][-1] == "land"
    with pytest.raises(UnfitItem, match="item 0: no altitude"):
        plan_of([replace(item(TAKEOFF), z=None), MISSION[1]], robot="drone_1", site=SITE)


async def test_a_mission_is_cleared_and_then_uploaded(store: FakeStore) -> None:
    """The upload behind a clear is not lost in it (mavlink/MAVSDK-Java#177)."""
    ground = Ground(store)
    await ground.upload(MISSION)
    ground.tell("MISSION_CLEAR_ALL")
    await settle()
    assert ground.acks[-1] == ACCEPTED
    assert await ground.upload(MISSION[:3]) == ACCEPTED
    ground.tell("MISSION_REQUEST_LIST")
    assert ground.inbox[-1].count == 3


async def test_a_long_mission_comes_whole_over_a_slow_link(store: FakeStore) -> None:
    """With a quarter of all messages lost or doubled, a hundred items (mavlink/MAVSDK#1441)."""
    ground = Ground(store, loss=0.25, seed=5, tries=20)
    way = [item(TAKEOFF), *(item(WAYPOINT, 5 + each % 30, 4) for each in range(99))]
    while not ground.inbox:
        ground.tell("MISSION_COUNT", count=len(way))
    while not ground.acks and ground.now < 1000.0:
        while ground.inbox:
            ground.give(ground.inbox.pop().seq, way)
        ground.now += 0.1
        ground.desk.tick()
        await settle()
        if not ground.inbox and len(way) - 1 == len(ground.desk._held.get("drone_1", ())) - 1:
            ground.give(len(way) - 1, way)  # the acknowledgement was lost
    assert set(ground.acks) == {ACCEPTED}
    assert len(ground.desk._held["drone_1"]) == 100


async def test_answers_that_come_after_the_next_question(store: FakeStore) -> None:
    """Each item takes longer than the wait for it, so that each is asked for and given twice.

    Reported as PX4/PX4-Autopilot#11078.
    """
    ground = Ground(store)
    ground.tell("MISSION_COUNT", count=len(MISSION))
    under_way: list[tuple[float, int]] = []
    while not ground.acks and ground.now < 60.0:
        under_way += [(ground.now + 1.2, each.seq) for each in ground.inbox]
        ground.inbox.clear()
        for at, seq in [each for each in under_way if each[0] <= ground.now]:
            under_way.remove((at, seq))
            ground.give(seq, MISSION)
        ground.now += 0.1
        ground.desk.tick()
        await settle()
    assert ground.acks == [ACCEPTED]
    assert ground.refused == {}


# --- commands that a station sends -------------------------------------------------------------------------------


@pytest.fixture
def fleet(store: FakeStore) -> Fleet:
    """Return the fleet's tasks and a desk."""
    return Fleet(store)


def test_nan_becomes_no_position() -> None:
    """Not-set numbers of a COMMAND_LONG stay what they are (ArduPilot/ardupilot#25187)."""
    unset: dict[str, Any] = {f"param{number}": math.nan for number in range(1, 8)}
    long_ = make("COMMAND_LONG", target_system=1, target_component=191, command=31010, confirmation=0, **unset)
    assert all(math.isnan(each) for each in parameters_of(long_))


async def test_each_confirmation_is_the_same_command(fleet: Fleet) -> None:
    """It is counted up with each repetition, 0 to 3 and as far as 255: one task (PX4/PX4-Autopilot#14808)."""
    for confirmation in (0, 1, 2, 3, 255):
        fleet.send(param1=1.0, confirmation=confirmation)
        await settle()
    await fleet.answered(6)
    assert len(fleet.submitted) == 1
    assert len({number for result, number in fleet.acks if result == 0}) == 1


async def test_two_in_a_row_are_told_apart(fleet: Fleet) -> None:
    """A second press of a button without a confirmation is another order (mavlink/qgroundcontrol#4417)."""
    for _ in range(2):
        fleet.send(param1=1.0)
        await fleet.answered(2 * (len(fleet.submitted) or 1))
    await fleet.answered(4)
    first, second = (number for result, number in fleet.acks if result == 0)
    assert first != second
    assert len(fleet.submitted) == 2


async def test_an_answer_is_of_one_command(fleet: Fleet) -> None:
    """Another one while the first has no answer is turned away: nobody mistakes whose the answer is.

    Reported as mavlink/qgroundcontrol#2975.
    """
    fleet.gate.clear()
    fleet.send(param1=1.0)
    fleet.send(param1=2.0, param2=5.0)
    await fleet.answered(2)
    fleet.gate.set()
    await fleet.answered(3)
    assert sorted(result for result, _ in fleet.acks) == [0, TEMPORARILY_REJECTED, IN_PROGRESS]
    assert len(fleet.submitted) == 1


async def test_repetitions_without_a_pause(fleet: Fleet) -> None:
    """A station whose timeout is 0 sends four in a row: one task, each answered (mavlink/MAVSDK#2420)."""
    for confirmation in range(4):
        fleet.send(param1=1.0, confirmation=confirmation)
    await fleet.answered(5)
    assert [result for result, _ in fleet.acks] == [*[IN_PROGRESS] * 4, 0]
    assert len(fleet.submitted) == 1


async def test_what_has_ended_is_not_cancelled_again(fleet: Fleet) -> None:
    """COMMAND_CANCEL of a task that has ended is answered, and stops nothing (mavlink/mavlink#1401)."""
    fleet.send(param1=1.0)
    await fleet.answered(2)
    (request,) = fleet.submitted
    fleet.error = NotFoundError("no task")
    cancel = make("COMMAND_CANCEL", target_system=1, target_component=191, command=31010)
    (frame,) = Codec(245, 191).read(Codec(255, 190).pack(cancel))
    assert isinstance(frame, Frame)
    for count in (3, 4):
        fleet.desk.take(frame, robot="drone_1", reply=fleet.said.append)
        await fleet.answered(count)
    assert fleet.submitted == [request]
    assert {result for result, _ in fleet.acks[2:]} <= {0, 2, 6}


# --- commands that the gateway sends -----------------------------------------------------------------------------


async def test_any_number_of_progress_reports_before_the_end() -> None:
    """The second IN_PROGRESS of a long command is no answer and no fault (mavlink/MAVSDK#2319)."""
    fake = Fake(lambda _: [ack(dialect.IN_PROGRESS)] * 5)
    running = asyncio.create_task(command(fake.vehicle, 400, patience=PATIENCE))
    for _ in range(5):
        await asyncio.sleep(0)
        fake.say(ack(dialect.IN_PROGRESS))
    fake.say(ack(dialect.ACCEPTED))
    assert (await running).number == 7
    assert len(fake.sent) == 1


async def test_progress_gives_more_time_and_stops_repetitions() -> None:
    """What reports that it goes on is neither given up nor sent again (mavlink/qgroundcontrol#10852)."""
    fake = Fake(lambda _: [ack(dialect.IN_PROGRESS)])
    running = asyncio.create_task(command(fake.vehicle, 400, patience=RetryPolicy(timeout_s=0.05, tries=2)))
    async with asyncio.timeout(60):
        while not fake.sent:
            await asyncio.sleep(0)
    for _ in range(10):
        await asyncio.sleep(0.02)
        fake.say(ack(dialect.IN_PROGRESS))
    assert not running.done()
    fake.say(ack(dialect.ACCEPTED))
    await running
    assert len(fake.sent) == 1


# --- parameters --------------------------------------------------------------------------------------------------


class Px4:
    """PX4's parameters: each has a type, and whole numbers lie in the float byte by byte."""

    def __init__(self, **values: int | float) -> None:
        self.values = values
        self.fake = Fake(self._answer)
        self.fake.say(make("HEARTBEAT", **(BEAT | {"autopilot": 12})))

    def _answer(self, sent: Message) -> list[Message]:
        raw = sent.param_id if isinstance(sent.param_id, bytes) else sent.param_id.encode()
        name = raw.split(b"\0")[0].decode()
        if name not in self.values:
            return []
        whole = isinstance(self.values[name], int)
        if sent.get_type() == "PARAM_SET" and sent.param_type == (6 if whole else 9):
            packed = struct.pack("<f", sent.param_value)
            self.values[name] = struct.unpack("<i", packed)[0] if whole else sent.param_value
        value: Any = self.values[name]
        shown = struct.unpack("<f", struct.pack("<i", value))[0] if whole else value
        told = {"param_value": shown, "param_type": 6 if whole else 9, "param_count": 2, "param_index": 0}
        return [make("PARAM_VALUE", param_id=raw, **told)]

    async def read(self, name: str) -> float:
        """Read one as the gateway does."""
        return await protocols.read_parameter(self.fake.vehicle, name, patience=PATIENCE)

    async def write(self, name: str, value: float) -> float:
        """Write one as the gateway does."""
        return await protocols.write_parameter(self.fake.vehicle, name, value, patience=PATIENCE)


@pytest.mark.parametrize("value", [0, 1, 5, -1, 1_065_353_216, 2**31 - 1, -(2**31)])
async def test_whole_numbers_are_read_byte_by_byte(value: int) -> None:
    """PX4's INT32 5 is 5, and not 7e-45 (PX4/PX4-Autopilot#19274)."""
    assert await Px4(COM_OBL_RC_ACT=value).read("COM_OBL_RC_ACT") == value


@pytest.mark.parametrize("value", [0, 1, 5, -1, 100_000])
async def test_whole_numbers_are_written_byte_by_byte(value: int) -> None:
    """An INT32 that is set to 1 is 1, and not 1065353216 (PX4/PX4-Autopilot#6159)."""
    px4 = Px4(COM_OBL_RC_ACT=7, MPC_XY_CRUISE=5.0)
    assert await px4.write("COM_OBL_RC_ACT", float(value)) == value
    assert px4.values["COM_OBL_RC_ACT"] == value
    assert await px4.write("MPC_XY_CRUISE", 2.5) == 2.5


@pytest.mark.parametrize("value", [0.5, 1.06535322e9 * 4, 1e300])
async def test_what_a_whole_number_cannot_be_is_not_sent(value: float) -> None:
    """Fractions and numbers out of range are refused here, and nothing is written (PX4/PX4-Autopilot#2166)."""
    px4 = Px4(INAV_ENABLED=1)
    with pytest.raises(RobotFailure, match="keeps a whole number"):
        await px4.write("INAV_ENABLED", value)
    assert px4.values == {"INAV_ENABLED": 1}
    assert {each.get_type() for each in px4.fake.sent} == {"PARAM_REQUEST_READ"}


async def test_ardupilots_whole_numbers_are_cast() -> None:
    """The other encoding, told by the autopilot: what is true of one is not done to the other.

    Reported as ArduPilot/pymavlink#743.
    """
    told = {"param_value": 5.0, "param_type": 6, "param_count": 2, "param_index": 0}
    fake = Fake(lambda _: [make("PARAM_VALUE", param_id=b"SYSTEM", **told)])
    assert await protocols.read_parameter(fake.vehicle, "SYSTEM", patience=PATIENCE) == 5.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_parameter_is_not_set_to_what_is_no_number(value: float) -> None:
    """NaN and infinities are refused before anything is sent (ArduPilot/ardupilot#13116)."""
    with pytest.raises((RobotFailure, PayloadError)):
        in_range("parameter", "value", value, -1e9, 1e9)
