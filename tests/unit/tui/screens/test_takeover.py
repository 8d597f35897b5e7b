"""A robot under an operator's hand, under Textual's pilot on a fake fleet that notes what it is ordered."""

import asyncio
from collections.abc import Callable

import pytest
from textual.pilot import Pilot

from appliance.errors import ConflictError, RefusedError, SwiftbotError
from appliance.model import Lease, RobotInfo, RobotReply
from appliance.tui.app import SwiftbotApp
from appliance.tui.screens.takeover import TakeoverScreen
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Connection, Store

pytestmark = pytest.mark.anyio

LEASE = Lease(id="l-1", robot="rover_1", by="olga", lease_s=10.0)


class Orders:
    """A fleet that gives leases and notes orders in their order."""

    def __init__(self) -> None:
        self.told: list[tuple[str, dict[str, float]]] = []
        self.taken: SwiftbotError | None = None
        self.driven: SwiftbotError | None = None

    async def take_over(self, robot: str, *, why: str = "") -> Lease:
        """Give a lease, or say who has it."""
        self.told.append((f"take {robot} {why}".strip(), {}))
        if self.taken is not None:
            raise self.taken
        return LEASE

    async def renew(self, lease: Lease) -> Lease:
        """Keep it."""
        return lease

    async def drive(self, lease: Lease, verb: str, *, timeout_s: float, **args: float) -> RobotReply:
        """Note a movement, or raise what is set."""
        assert (lease, timeout_s > 0) == (LEASE, True)
        self.told.append((verb, args))
        if self.driven is not None:
            raise self.driven
        return RobotReply(id="x")

    async def give_back(self, lease: Lease) -> Lease:
        """Take it back."""
        self.told.append((f"give back {lease.robot}", {}))
        return lease

    async def site(self) -> object:
        """Have no map."""
        raise RefusedError("no site here")


class View:
    """A view of one robot."""

    fleet = "test"
    operator = "olga"
    steerable = True
    moment = ""
    role = None

    def __init__(self) -> None:
        self.store = Store()
        self.store.tell(Connection(connected=True))
        self.store.take_robots({"rover_1": RobotInfo(id="rover_1", kind="zenoh")})
        self.orders = Orders()

    async def start(self) -> None:
        """Nothing begins."""

    async def close(self) -> None:
        """Nothing ends."""

    def sync(self) -> None:
        """Nothing comes."""


async def until(pilot: Pilot[None], check: Callable[[], bool]) -> None:
    """Wait until something holds."""
    for _ in range(500):
        await pilot.pause(0.02)
        if check():
            return
    pytest.fail("it does not come about")


async def taken(app: SwiftbotApp, pilot: Pilot[None]) -> TakeoverScreen:
    """Take the robot over."""
    await pilot.press("3", "o")
    await pilot.pause()
    await pilot.press("y")
    await until(pilot, lambda: isinstance(app.screen, TakeoverScreen))
    screen = app.screen
    assert isinstance(screen, TakeoverScreen)
    return screen


async def test_moves_while_held_and_is_given_back() -> None:
    """A held key moves it in steps that end by themselves, letting go stops it, Esc gives it back."""
    view = View()
    app = SwiftbotApp(view, TuiConfig(write=True))  # pyright: ignore[reportArgumentType] - the fake of this test
    async with app.run_test(size=(80, 24)) as pilot:
        screen = await taken(app, pilot)
        await until(pilot, lambda: screen.lease is not None)
        for _ in range(10):
            await pilot.press("up")
            await asyncio.sleep(0.05)
        await until(pilot, lambda: any(args.get("forward_mps") == 0.0 for _, args in view.orders.told))
        moves = [args for verb, args in view.orders.told if verb == "velocity"]
        assert moves[0]["forward_mps"] > 0
        assert all(0 < args["for_s"] <= 1 for args in moves)
        assert moves[-1]["forward_mps"] == moves[-1]["turn_dps"] == 0.0
        await pilot.press("escape")
        await until(pilot, lambda: view.orders.told[-1][0] == "give back rover_1")
        assert not isinstance(app.screen, TakeoverScreen)


async def test_quitting_gives_it_back() -> None:
    """Leaving the UI altogether gives the robot back as well."""
    view = View()
    app = SwiftbotApp(view, TuiConfig(write=True))  # pyright: ignore[reportArgumentType] - the fake of this test
    async with app.run_test(size=(80, 24)) as pilot:
        screen = await taken(app, pilot)
        await until(pilot, lambda: screen.lease is not None)
        await pilot.press("q")
        await pilot.pause(0.5)
    assert view.orders.told[-1][0] == "give back rover_1"


async def test_somebody_else_has_it() -> None:
    """Where another operator has it the screen says who, and no movement is asked for."""
    view = View()
    view.orders.taken = ConflictError("bea has rover_1", remedy="ask bea")
    app = SwiftbotApp(view, TuiConfig(write=True))  # pyright: ignore[reportArgumentType] - the fake of this test
    async with app.run_test(size=(80, 24)) as pilot:
        screen = await taken(app, pilot)
        await until(pilot, lambda: "bea has rover_1" in screen._ended)
        await pilot.press("up", "up")
        await pilot.pause(0.3)
        assert [verb for verb, _ in view.orders.told] == ["take rover_1"]


async def test_lost_lease_ends_it() -> None:
    """When the lease has ended meanwhile, the screen says so and sends nothing more."""
    view = View()
    view.orders.driven = ConflictError("the lease of rover_1 has expired")
    app = SwiftbotApp(view, TuiConfig(write=True))  # pyright: ignore[reportArgumentType] - the fake of this test
    async with app.run_test(size=(80, 24)) as pilot:
        screen = await taken(app, pilot)
        await until(pilot, lambda: screen.lease is not None)
        await pilot.press("up")
        await until(pilot, lambda: "expired" in screen._ended and screen.lease is None)
