"""Several robots that act together: none begins alone, and what ends for one ends for all, on fakes."""

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConfigError, ConflictError, PayloadError, RobotError, SwiftbotError, UnreachableError
from appliance.model import Need, RobotCommand, RobotInfo, RobotReply, RunRequest, encode
from appliance.pool.pool import Call
from appliance.tasks import together as module
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.handler_calls import Calls
from appliance.tasks.together import Together

pytestmark = pytest.mark.anyio
NAMES = ("r1", "r2", "r3")


class Fleet:
    """Robots that obey: what each does, who is away, stopped or leased, in the test's hands."""

    def __init__(self) -> None:
        self.robots = {name: RobotInfo(id=name, kind="zenoh") for name in NAMES}
        self.stopped: dict[str, str] = {}
        self.moving: set[str] = set()
        self.ended: list[str] = []
        self.held: list[str] = []
        self.failing: dict[str, SwiftbotError] = {}
        self.done = {name: asyncio.Event() for name in NAMES}
        self.leased: set[str] = set()
        self.released: list[str] = []
        self.grants: dict[str, SwiftbotError] = {}
        self.notes: list[str] = []
        self.renewed = 0
        self.lost: SwiftbotError | None = None
        session = SimpleNamespace(keys=lambda _, robot: robot, query=self.query)
        leases = SimpleNamespace(acquire=self.acquire, release=self.release, renew=self.renew)
        registry = SimpleNamespace(robots=self.robots, lost_ns={})
        self.plane: Any = SimpleNamespace(session=session, leases=leases, registry=registry)
        self.together = Together(self.plane, hindrance=lambda robot: self.stopped.get(robot, ""))

    async def query(self, robot: str, payload: bytes, **_: Any) -> bytes:
        """Hold: every command of the robot has ended before."""
        command = msgspec.json.decode(payload, type=RobotCommand)
        assert command.verb == "stop"
        self.held.append(robot)
        return encode(RobotReply(id=command.id))

    async def acquire(self, key: str, *, ttl_s: float) -> Any:
        """Grant, or raise what the test says."""
        assert ttl_s
        robot = key.removeprefix("joint/")
        if robot in self.grants:
            raise self.grants[robot]
        self.leased.add(robot)
        return SimpleNamespace(key=key, robot=robot, left_s=1.0)

    async def release(self, lease: Any) -> None:
        """Take it back."""
        self.released.append(lease.robot)

    async def renew(self, lease: Any, *, ttl_s: float) -> Any:
        """Go on, or raise what the test says."""
        assert ttl_s
        if self.lost is not None:
            raise self.lost
        self.renewed += 1
        return lease

    async def one(self, robot: str) -> str:
        """Move until the test says that it has arrived."""
        if robot in self.failing:
            raise self.failing[robot]
        self.moving.add(robot)
        try:
            await self.done[robot].wait()
        except asyncio.CancelledError:
            self.ended.append(robot)
            raise
        finally:
            self.moving.discard(robot)
        return f"{robot} is there"

    def start(self, *, give_up: float = 1e9, robots: tuple[str, ...] = NAMES) -> "asyncio.Task[dict[str, str]]":
        """Have all of them move."""
        return asyncio.create_task(
            self.together.run(robots, self.one, act="t/s/1", give_up=give_up, on_wait=self.notes.append)
        )

    async def until(self, what: Any) -> None:
        """Wait for something."""
        async with asyncio.timeout(60):
            while not what():
                await asyncio.sleep(0.002)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return three robots that are looked at often."""
    monkeypatch.setattr(module, "LOOK_S", 0.005)
    return Fleet()


async def test_all_move_and_all_are_waited_for(fleet: Fleet) -> None:
    """They are leased before, commanded at the same time, and it is done when the last has arrived."""
    doing = fleet.start()
    await fleet.until(lambda: fleet.moving == set(NAMES))
    assert fleet.leased == set(NAMES)
    fleet.done["r1"].set()
    await fleet.until(lambda: fleet.moving == {"r2", "r3"})
    assert not doing.done()
    fleet.done["r2"].set()
    fleet.done["r3"].set()
    assert await doing == {name: f"{name} is there" for name in NAMES}
    await fleet.until(lambda: sorted(fleet.released) == [*NAMES])
    assert not fleet.held


@pytest.mark.parametrize("away", NAMES)
async def test_none_moves_while_one_is_away_or_stopped(fleet: Fleet, away: str) -> None:
    """It is waited for with a note; in time, without any motion, that is an error."""
    fleet.robots[away] = replace(fleet.robots[away], online=False)
    doing = fleet.start()
    await fleet.until(lambda: fleet.notes == [f"waits for {away}: offline"])
    fleet.stopped[away] = "stopped by ann"
    fleet.robots[away] = replace(fleet.robots[away], online=True)
    await fleet.until(lambda: len(fleet.notes) == 2)
    assert fleet.notes[1] == f"waits for {away}: stopped by ann"
    assert not fleet.moving
    with pytest.raises(RobotError, match=f"cannot begin together: waits for {away}: stopped by ann"):
        await fleet.start(give_up=0.0)
    fleet.stopped.clear()
    await fleet.until(lambda: fleet.moving == set(NAMES))
    doing.cancel()
    await asyncio.gather(doing, return_exceptions=True)


async def test_leases_are_kept_while_a_robot_is_waited_for(fleet: Fleet) -> None:
    """They are renewed meanwhile; one that is lost all the same is leased again before any robot moves."""
    fleet.stopped["r3"] = "stopped by ann"
    doing = fleet.start()
    await fleet.until(lambda: fleet.renewed >= 2 * len(NAMES))
    assert not fleet.released
    fleet.lost = ConflictError("the lease on joint/r1 has ended")
    fleet.leased.clear()
    await fleet.until(lambda: "the lease on joint/r1 has ended" in fleet.notes)
    assert not fleet.moving
    fleet.lost = None
    fleet.stopped.clear()
    await fleet.until(lambda: fleet.moving == set(NAMES))
    assert fleet.leased == set(NAMES)
    doing.cancel()
    await asyncio.gather(doing, return_exceptions=True)


async def test_none_moves_while_another_run_has_one_of_them(fleet: Fleet) -> None:
    """Those that are leased already stay leased; where a majority of grantors is not there, nobody moves either."""
    for error in (ConflictError("leased"), UnreachableError("1 of 3 answer")):
        fleet.grants["r2"] = error
        with pytest.raises(RobotError, match="cannot begin together"):
            await fleet.start(give_up=0.0)
    assert fleet.notes == []
    assert not fleet.moving
    await fleet.until(lambda: fleet.released == ["r1", "r1"])
    fleet.grants = {name: ConfigError("plane.voters names nobody") for name in NAMES}
    doing = fleet.start()
    await fleet.until(lambda: fleet.moving == set(NAMES))
    doing.cancel()
    await asyncio.gather(doing, return_exceptions=True)


@pytest.mark.parametrize("lost", NAMES)
@pytest.mark.parametrize("how", ["lost", "stopped", "fails"])
async def test_what_ends_for_one_ends_for_all(fleet: Fleet, lost: str, how: str) -> None:
    """Also where that one has arrived already; those that may be commanded are told to hold, and the error says it."""
    fleet.done[lost].set()
    if how == "fails":
        fleet.failing[lost] = RobotError("the wheel is stuck")
    doing = fleet.start()
    others = sorted(set(NAMES) - {lost})
    if how != "fails":
        await fleet.until(lambda: sorted(fleet.moving) == others)
        if how == "lost":
            fleet.robots[lost] = replace(fleet.robots[lost], online=False)
        else:
            fleet.stopped[lost] = "stopped by ann"
    with pytest.raises(RobotError, match=f"{lost}: .*holds") as caught:
        await doing
    assert not fleet.moving
    assert how == "fails" or sorted(fleet.ended) == others
    assert sorted(fleet.held) == (sorted(NAMES) if how == "fails" else others)
    assert all(name in caught.value.message for name in fleet.held)


async def test_the_end_of_a_run_ends_the_commands_of_all(fleet: Fleet) -> None:
    """Cancelled, no robot goes on alone, and the leases are given back."""
    doing = fleet.start()
    await fleet.until(lambda: fleet.moving == set(NAMES))
    doing.cancel()
    await asyncio.gather(doing, return_exceptions=True)
    assert sorted(fleet.ended) == [*NAMES]
    await fleet.until(lambda: sorted(fleet.released) == [*NAMES])


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(["arrive", "lose", "stop", "cancel"])), max_size=6))
def test_whatever_happens_no_robot_goes_on_without_the_others(events: list[tuple[str, str]]) -> None:
    """After any order of arrivals, losses, stops and a cancel: all have arrived, all still move, or none does."""

    async def play() -> None:
        fleet = Fleet()
        doing = fleet.start()
        await fleet.until(lambda: fleet.moving == set(NAMES))
        arrived: set[str] = set()
        broken = False
        for robot, what in events:
            if what == "arrive":
                fleet.done[robot].set()
                arrived.add(robot)
                await fleet.until(lambda: not fleet.moving & arrived)  # before anything else happens
            elif what == "cancel":
                doing.cancel()
            elif what == "lose":
                fleet.robots[robot] = replace(fleet.robots[robot], online=False)
            else:
                fleet.stopped[robot] = "stopped by ann"
            if what != "arrive" and arrived != set(NAMES):
                broken = True
                break
        if broken or arrived == set(NAMES):
            (found,) = await asyncio.gather(doing, return_exceptions=True)
            assert broken is isinstance(found, BaseException)
            assert not fleet.moving
        else:
            await asyncio.sleep(0.01)
            assert not doing.done()
            assert fleet.moving == set(NAMES) - arrived
            doing.cancel()
            await asyncio.gather(doing, return_exceptions=True)
            assert not fleet.moving

    module_look, module.LOOK_S = module.LOOK_S, 0.001
    try:
        asyncio.run(play())
    finally:
        module.LOOK_S = module_look


async def test_a_handler_commands_only_robots_of_its_own(plane: Any, folder: Path) -> None:
    """Others, none at all, and arguments that are no table are refused before anything is sent."""
    calls = Calls(plane, Artifacts(folder, gateway="gw-1", max_bytes=1000), on_wait=lambda *_: None)
    run = RunRequest(
        task="t", subtask="s1", attempt=1, skill="lift", need=Need(image="base"), robot="r1", others=("r2",)
    )
    for robots in ({"r1": {}, "r9": {}}, {}, None, ["r1"], {"r1": "fast", "r2": {}}):
        with pytest.raises(PayloadError):
            await calls(Call(run=run, number=1, name="command_all", args={"verb": "goto", "robots": robots}))
    alone = replace(run, robot=None, others=())
    with pytest.raises(PayloadError, match="it has none"):
        await calls(Call(run=alone, number=1, name="command_all", args={"verb": "goto", "robots": {"r1": {}}}))
    assert not plane.session.queries
