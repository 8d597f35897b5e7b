"""Commands to a robot that is stopped or taken over: refused by its executor, waited for by handlers."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.model import Lease, RobotCommand, RobotInfo, SoftStop, keyspace
from appliance.model.robot_api import StopAnswer, StopAsk
from appliance.model.steering import MAX_STOPPED
from appliance.robots.authority.authority import Authority
from appliance.robots.authority.lease import Leases
from appliance.robots.authority.soft_stop import Stops


class Known:
    """What an authority knows, without a fleet."""

    def __init__(self) -> None:
        self.stops = Stops()
        self.leases = Leases()


@pytest.fixture
def known() -> Known:
    """Return nothing known."""
    return Known()


@pytest.fixture
def authority(known: Known) -> Authority:
    """Return an authority that knows what the test says."""
    it = cast("Any", Authority.__new__(Authority))
    it._out_of_use = lambda _: ""  # pyright: ignore[reportUnknownLambdaType]
    it._stopping = it._leasing = known
    it._plane = SimpleNamespace(registry=SimpleNamespace(robots={}))
    return cast("Authority", it)


def order(verb: str = "goto", lease: str = "") -> RobotCommand:
    """Return a command."""
    return RobotCommand(id="c", verb=verb, lease=lease)


def test_a_stopped_robot_is_given_nothing_that_moves_it(authority: Authority, known: Known) -> None:
    """The reason names who and why; looking, stopping and holding are always possible; others are free."""
    known.stops.add(SoftStop(id="s", robots=("r1",), by="ann", why="a person"))
    assert authority.refuses("r1", order()) == "stopped by ann: a person"
    assert not any(authority.refuses("r1", order(verb)) for verb in ("state", "stop", "hold"))
    assert authority.refuses("r2", order()) == ""
    assert authority.hindrance("r1") == "stopped by ann: a person"
    assert authority.hindrance("r2") == ""


def test_only_commands_with_the_lease_move_a_robot_that_was_taken_over(authority: Authority, known: Known) -> None:
    """Others hear who has it; a soft stop counts for the one who has it as well."""
    known.leases.hear(Lease(id="l", robot="r1", by="ann"), 0.0)
    assert authority.refuses("r1", order()) == "taken over by ann"
    assert authority.refuses("r1", order(lease="other")) == "taken over by ann"
    assert authority.refuses("r1", order(lease="l")) == ""
    known.stops.add(SoftStop(id="s", by="bob"))
    assert authority.refuses("r1", order(lease="l")) == "stopped by bob"


def test_a_command_of_a_lease_that_has_ended_is_refused(authority: Authority, known: Known) -> None:
    """The robot is the tasks' again: what its former operator sent late does not move it; it still may be stopped."""
    known.leases.hear(Lease(id="l", robot="r1", by="ann"), 0.0)
    known.leases.hear(Lease(id="l", robot="r1", by="ann", ended="given back"), 1.0)
    assert authority.refuses("r1", order(lease="l")) == "no longer under that lease"
    assert authority.refuses("r1", order("stop", lease="l")) == ""
    assert authority.refuses("r1", order()) == ""


def test_a_lease_that_is_over_moves_nothing_and_frees_nothing(authority: Authority, known: Known) -> None:
    """Neither its operator nor a task has the robot until it holds."""
    known.leases.hear(Lease(id="l", robot="r1", by="ann"), 0.0)
    known.leases.due(100.0)
    assert authority.refuses("r1", order(lease="l")) == "no longer under that lease"
    assert authority.refuses("r1", order()) == "taken over by ann"
    assert authority.hindrance("r1") == "taken over by ann"


class Stopper:
    """A gateway that takes soft stops, and the robots that it sees online."""

    gateway = "gw-1"

    def __init__(self, *online: str) -> None:
        robots = {name: RobotInfo(id=name, kind="zenoh", gateway="gw-1", online=True) for name in online}
        self.registry = SimpleNamespace(robots=robots)
        self.session = SimpleNamespace(credentials=SimpleNamespace(roster=SimpleNamespace(number=7)))
        self.rpc = self
        self.asks: list[StopAsk] = []

    async def call(self, gateway: str, verb: object, ask: StopAsk) -> StopAnswer:
        """Take a stop; all of its robots hold."""
        assert (gateway, verb) == ("gw-1", keyspace.SOFT_STOP)
        self.asks.append(ask)
        return StopAnswer(stops=(), gateways=(gateway,), robots=ask.robots)

    async def revoke(self, *robots: str) -> dict[str, tuple[str, ...]]:
        """Have these robots stopped; returns the stops, by id."""
        it = cast("Any", Authority.__new__(Authority))
        it._plane = self
        await cast("Authority", it).hold_revoked(frozenset(robots))
        return {ask.act: ask.robots for ask in self.asks}


@pytest.mark.anyio
async def test_all_robots_that_are_revoked_at_once_are_stopped() -> None:
    """Also more than one stop can name."""
    names = [f"r{number:04}" for number in range(2 * MAX_STOPPED + 1)]
    stops = await Stopper(*names).revoke(*names)
    assert sorted(name for robots in stops.values() for name in robots) == names
    assert max(map(len, stops.values())) == MAX_STOPPED


@pytest.mark.anyio
async def test_a_stop_of_revoked_robots_has_the_id_of_no_stop_of_others() -> None:
    """Gateways that see the same robots online make one stop; one that sees another robot loses nothing by it."""
    one, same = await Stopper("r1").revoke("r1", "r2"), await Stopper("r1").revoke("r1", "r2")
    more = await Stopper("r1", "r2").revoke("r1", "r2")
    assert one == same
    assert one.keys().isdisjoint(more)
