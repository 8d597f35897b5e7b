"""Two robots of one name: the older one speaks for it, the other is seen, and no command is carried out by both."""

from collections import Counter
from typing import Any, cast

import msgspec
import pytest

from appliance.model import RobotCommand, RobotInfo, RobotReply, encode
from appliance.plane import registry as rosters
from appliance.plane.registry import Roster
from appliance.robots.sender import send_command
from tests.unit.robots.conftest import FakeSession

pytestmark = pytest.mark.anyio
OLD, NEW = "0001-a", "0002-b"


class Fleet:
    """A roster on a clock of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        self.refused: Counter[str] = Counter()
        monkeypatch.setattr(rosters.time, "monotonic", lambda: self.now)
        self.roster = Roster(cast("Any", self), on_change=lambda: None)

    def refuse(self, what: str, **_: Any) -> None:
        """Count bad input."""
        self.refused[what] += 1

    def put(self, speaker: str, mode: str, name: str = "cart_1", **fields: Any) -> None:
        """Put a state."""
        info = RobotInfo(id=name, kind="zenoh", mode=mode, speaker=speaker, **fields)
        cast("Any", self.roster)._on_robot(f"swiftbot/test/robot/{name}/state", info)

    @property
    def row(self) -> RobotInfo:
        """The robot as the list shows it."""
        return self.roster.robots["cart_1"]


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return a fleet."""
    return Fleet(monkeypatch)


@pytest.mark.parametrize("first", [OLD, NEW])
def test_the_older_one_speaks_whoever_is_heard_first(fleet: Fleet, first: str) -> None:
    """So every roster believes the same one; the row says that there is another, and that is counted."""
    modes = {OLD: "old", NEW: "new"}
    for speaker in (first, OLD if first == NEW else NEW, OLD, NEW, OLD):
        fleet.put(speaker, modes[speaker], note="busy")
        fleet.now += 0.2
    assert fleet.row.mode == "old"
    assert fleet.row.note == "another robot calls itself cart_1: give it a name of its own; busy"
    assert fleet.refused == {"namesake robot/*/state": 2}
    assert fleet.roster.doubtful("cart_1")
    fleet.now += rosters.RIVAL_S
    fleet.put(OLD, "old", note="busy")
    assert (fleet.row.note, fleet.roster.doubtful("cart_1")) == ("busy", False)


def test_a_restarted_robot_is_no_other(fleet: Fleet) -> None:
    """It is heeded as soon as the one before has been silent for a while, and there is no note."""
    fleet.put(OLD, "before")
    fleet.put(NEW, "too early")
    assert fleet.row.mode == "before"
    fleet.now += rosters.SPEAKER_S
    fleet.put(NEW, "after")
    assert (fleet.row.mode, fleet.row.note, fleet.roster.doubtful("cart_1")) == ("after", "", False)


def test_who_does_not_say_which_it_is_has_to_be_counted(fleet: Fleet) -> None:
    """A robot that others wrote; not one whose gateway sees to it, and not one that nobody knows."""
    fleet.put("", "own")
    fleet.put("", "drone", name="drone_1", gateway="gw-1")
    assert [fleet.roster.doubtful(each) for each in ("cart_1", "drone_1", "nobody")] == [True, False, False]


class Counted(FakeSession):
    """A plane on which so many answer."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count
        self.asked: list[RobotCommand] = []
        self.refused: Counter[str] = Counter()
        self.answer = self._do

    async def _do(self, payload: bytes) -> bytes:
        return encode(RobotReply(id=msgspec.json.decode(payload, type=RobotCommand).id))

    async def answerers(self, key: str, payload: bytes, *, timeout_s: float) -> int:
        """Count those that answer."""
        del key, timeout_s
        self.asked.append(msgspec.json.decode(payload, type=RobotCommand))
        return self.count

    def refuse(self, what: str, **_: Any) -> None:
        """Count bad input."""
        self.refused[what] += 1


@pytest.mark.parametrize(("count", "sent"), [(0, 1), (1, 1), (2, 0), (3, 0)])
async def test_a_command_that_several_would_carry_out_is_not_sent(count: int, sent: int) -> None:
    """The refusal says how many there are; one that nobody answered the question of may still be there."""
    session = Counted(count)
    order = RobotCommand(id="g-1", verb="goto")
    reply = await send_command(cast("Any", session), "cart_1", order, timeout_s=5.0, doubtful=True)
    assert len(session.queries) == sent
    assert [each.verb for each in session.asked] == ["state"]
    if not sent:
        assert reply.failure is not None
        assert f"{count} robots answer to the name cart_1" in reply.failure.message
        assert session.refused == {"namesake robot/*/command": 1}


@pytest.mark.parametrize(("verb", "doubtful"), [("stop", True), ("state", True), ("goto", False)])
async def test_what_needs_no_counting(verb: str, doubtful: bool) -> None:
    """A stop is never kept back, and robots that say which they are cost no question."""
    session = Counted(2)
    reply = await send_command(
        cast("Any", session), "cart_1", RobotCommand(id="x", verb=verb), timeout_s=5.0, doubtful=doubtful
    )
    assert (reply.failure, session.asked, len(session.queries)) == (None, [], 1)


def test_since_when_a_robot_is_lost_is_known_until_it_is_back(fleet: Fleet) -> None:
    """Once, from the first news that it is offline, whatever is said of it afterwards."""
    fleet.put(OLD, "drive")
    assert not fleet.roster.lost_ns
    fleet.put(OLD, "", online=False)
    since = dict(fleet.roster.lost_ns)
    assert list(since) == ["cart_1"]
    fleet.put(OLD, "again", online=False)
    assert fleet.roster.lost_ns == since
    fleet.put(OLD, "drive")
    assert not fleet.roster.lost_ns
