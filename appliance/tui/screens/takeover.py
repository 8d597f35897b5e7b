"""A robot under an operator's hand: it moves while a key is held, and is given back when this screen is left.

What keeps it safe when a terminal is lost stands at several places: a movement lasts half a second at the robot, keys
that come no more count as let go, and the lease ends at the gateways when it is not renewed.

Terminals tell of no release: a held key comes again and again, first after the keyboard's delay (a quarter to two
thirds of a second), then some thirty times a second. So for `Holding` the key counts as held for a while after each,
longer after the first, and everything that silences the terminal, a closed window, a cut link, a frozen machine, is a
release as well. The lease itself is renewed only while keys come: an operator who is gone loses it. `Holding` is
pure; the clock is passed in.
"""

import asyncio
import contextlib
import time
from enum import StrEnum
from typing import Any

from msgspec import Struct
from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import ConflictError, SwiftbotError
from appliance.model import Lease
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.part_keys import DRIVE, part_bindings
from appliance.tui.robot_view import Ground, KnownRobots, place
from appliance.tui.safe import safe
from appliance.tui.store import Store

FIRST_S = 0.7
"""For so long the first press counts as held: beyond the slowest usual delay before a keyboard repeats."""
NEXT_S = 0.25
"""The same for repeats: several of them, so that a jittery link does not make it stutter."""
SEND_S = 0.2
"""How often a movement is requested again; each lasts `LASTS_S` at the robot."""
LASTS_S = 0.5
"""How long a robot goes on with a movement that is not asked for again: two lost messages."""
IDLE_S = 30.0
"""A lease without any key for so long is given back."""


class Step(Struct, frozen=True, kw_only=True):
    """What is to be sent now: a movement, a stop, the lease given back, or nothing."""

    move: str = ""
    """A direction, `""` for none."""
    stop: bool = False
    give_back: bool = False


class Moves(StrEnum):
    """Directions, in the robot's own frame."""

    FORWARD = "forward"
    BACK = "back"
    LEFT = "left"
    RIGHT = "right"
    UP = "up"
    DOWN = "down"
    TURN_LEFT = "turn left"
    TURN_RIGHT = "turn right"


class Holding:
    """Keys of one take-over.

    Args:
        now: the time, seconds of a monotonic clock.
    """

    def __init__(self, now: float) -> None:
        self._move = ""
        self._until = now
        self._sent = float("-inf")
        self._moving = False
        self._last_key = now

    @property
    def moving(self) -> str:
        """The direction that is held, empty when none is."""
        return self._move

    def press(self, move: str, now: float) -> None:
        """Take a press or a repeat of the key of a direction."""
        repeated = move == self._move and now < self._until
        self._until = now + (NEXT_S if repeated else FIRST_S)
        if not repeated:
            self._sent = float("-inf")  # another direction: told at once
        self._move = move
        self._last_key = now

    def release(self, now: float) -> None:
        """Take it that no key is held: another key was pressed, or the window has lost the focus."""
        self._until = min(self._until, now)
        self._last_key = now

    def touch(self, now: float) -> None:
        """Note that the operator is there, without a movement."""
        self._last_key = now

    def due(self, now: float) -> Step:
        """Return what is to be sent now; called some ten times a second."""
        if self._move and now >= self._until:
            self._move = ""
        if self._move:
            if now - self._sent >= SEND_S:
                self._sent = now
                self._moving = True
                return Step(move=self._move)
            return Step()
        if self._moving:
            self._moving = False
            return Step(stop=True)
        return Step(give_back=self.left_s(now) <= 0)

    def left_s(self, now: float) -> float:
        """Return in how many seconds the robot is given back when no key comes."""
        return max(0.0, self._last_key + IDLE_S - now)


TICK_S = 0.05
SPEEDS = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0)
"""Metres a second; the robot's own limit holds besides."""
TURN_DPS = 30.0
GIVE_BACK_S = 3.0
"""How long leaving waits for the robot to be released; beyond it the lease ends by itself."""


def velocity(move: str, speed_mps: float) -> dict[str, float]:
    """Return the arguments of the verb `velocity` for a direction."""
    wanted: dict[str, dict[str, float]] = {
        Moves.FORWARD: {"forward_mps": speed_mps},
        Moves.BACK: {"forward_mps": -speed_mps},
        Moves.LEFT: {"left_mps": speed_mps},
        Moves.RIGHT: {"left_mps": -speed_mps},
        Moves.UP: {"up_mps": speed_mps / 2},
        Moves.DOWN: {"up_mps": -speed_mps / 2},
        Moves.TURN_LEFT: {"turn_dps": TURN_DPS},
        Moves.TURN_RIGHT: {"turn_dps": -TURN_DPS},
    }
    return {"forward_mps": 0.0, "left_mps": 0.0, "up_mps": 0.0, "turn_dps": 0.0} | wanted.get(move, {})


class Pad(Static, can_focus=True):
    """Takes the keys; it has the focus as long as the screen is open."""

    BINDINGS = part_bindings(DRIVE)

    def action_move(self, move: str) -> None:
        """Take a press or repeat of a direction."""
        self._of().press(move)

    def action_hold(self) -> None:
        """Stop moving."""
        self._of().release()

    def action_speed(self, step: int) -> None:
        """Move faster or slower from now on."""
        self._of().change_speed(step)

    def _of(self) -> "TakeoverScreen":
        screen = self.screen
        assert isinstance(screen, TakeoverScreen)  # noqa: S101 - only made there
        return screen


class TakeoverScreen(FleetScreen):
    """One robot, taken over."""

    scope = "takeover"
    tab = "robots"
    shows = ("robots", "tasks", "gateways", "enquiries", "stops")
    BINDINGS = bindings("takeover")

    def __init__(self, robot: str, *, why: str = "") -> None:
        super().__init__()
        self.robot_id = robot
        self.lease: Lease | None = None
        """While it is ours."""
        self._why = why
        self._known = KnownRobots()
        self._holding = Holding(time.monotonic())
        self._speed = 2
        self._problem = ""
        self._pad_said: Any = None
        self._ended = ""

    def title_of(self) -> str:
        """Return the robot."""
        return f"{self.robot_id} by hand"

    def body(self) -> ComposeResult:
        """Make the parts."""
        yield Pad(id="pad")
        yield Ground(id="ground")

    def on_mount(self) -> None:
        """Take it over."""
        self.query_one(Pad).focus()
        self._keep()

    # --- keys ------------------------------------------------------------------------------------------------------

    def press(self, move: str) -> None:
        """Take a press or repeat of a direction's key."""
        if self.lease is not None:
            self._holding.press(move, time.monotonic())

    def release(self) -> None:
        """Stop moving."""
        self._holding.release(time.monotonic())

    def change_speed(self, step: int) -> None:
        """Move faster or slower from now on."""
        self._speed = min(max(0, self._speed + step), len(SPEEDS) - 1)
        self._holding.touch(time.monotonic())
        self.flush(force=True)

    def do_release(self, _given: object) -> None:
        """Give it back and leave."""
        self.application.pop_screen()

    # --- the lease ---------------------------------------------------------------------------------------------------

    @work(exclusive=True, group="lease")
    async def _keep(self) -> None:
        """Have the lease, as long as this screen is open and keys come."""
        orders = self.view.orders
        try:
            lease = await orders.take_over(self.robot_id, why=self._why)
        except SwiftbotError as error:
            self._end(f"{error.message} → {error.remedy or 'try again later'}")
            return
        self.lease = lease
        self._holding = Holding(time.monotonic())
        self.flush(force=True)
        renewing = asyncio.create_task(self._keep_renewing(lease), name="lease")
        try:
            await self._drive(lease)
        finally:
            renewing.cancel()
            self.lease = None
            # Leaving cancels this worker; the robot is given back all the same.
            await asyncio.shield(asyncio.create_task(self._give_back(lease), name="give back"))

    async def _give_back(self, lease: Lease) -> None:
        with contextlib.suppress(SwiftbotError, TimeoutError):
            async with asyncio.timeout(GIVE_BACK_S):
                await self.view.orders.give_back(lease)

    async def _keep_renewing(self, lease: Lease) -> None:
        while True:
            await asyncio.sleep(lease.lease_s / 3)
            try:
                await self.view.orders.renew(lease)
            except ConflictError as error:
                self._end(error.message)
                return
            except SwiftbotError as error:
                self._problem = f"the lease could not be renewed: {error.message}"

    async def _drive(self, lease: Lease) -> None:
        while not self._ended:
            now = time.monotonic()
            if not self.application.app_focus:
                self._holding.release(now)
            step = self._holding.due(now)
            if step.give_back:
                self._end("no key came for a while: given back")
                return
            try:
                if step.move:
                    await self._move(lease, step.move)
                elif step.stop:
                    await self._move(lease, "")
            except ConflictError as error:
                self._end(error.message)
                return
            except SwiftbotError as error:
                self._problem = f"{error.message} {f'→ {error.remedy}' if error.remedy else ''}".rstrip()
                self._holding.release(now)
            self._draw_pad()
            await asyncio.sleep(TICK_S)

    async def _move(self, lease: Lease, move: str) -> None:
        args = velocity(move, SPEEDS[self._speed]) | {"for_s": LASTS_S}
        await self.view.orders.drive(lease, "velocity", timeout_s=2.0, **args)
        self._problem = ""

    def _end(self, why: str) -> None:
        self._ended = why
        self.flush(force=True)

    # --- drawing -----------------------------------------------------------------------------------------------------

    def draw_body(self, store: Store) -> None:
        """Show the robot among the others."""
        robots = self._known.of(store)
        self.query_one(Ground).show(robots.values(), selected=self.robot_id, view=self.view)
        self._draw_pad()

    def _draw_pad(self) -> None:
        if not self.ready:
            return
        now = time.monotonic()
        left_s = self._holding.left_s(now)
        robot = self.store.robots.get(self.robot_id)
        said = (self.lease, self._holding.moving, round(left_s), self._speed, self._problem, self._ended, robot)
        if said == self._pad_said:
            return
        self._pad_said = said
        self.query_one(Pad).update(self._pad(left_s))

    def _pad(self, left_s: float) -> Text:
        robot = self.store.robots.get(self.robot_id)
        at = f" · {place(robot.pose)} m" if robot is not None else ""
        if self._ended:
            return Text.assemble(
                ("▲ not under your hand: ", "bold yellow"), (safe(self._ended, 300), "yellow"), "\nEsc leaves"
            )
        if self.lease is None:
            return Text("… taking it over", "dim")
        moving = self._holding.moving
        out = Text.assemble(
            ("⇅ yours", "bold magenta"),
            f"{at} · {SPEEDS[self._speed]:g} m/s · ",
            (f"● {moving}" if moving else "‖ holds", "bold yellow" if moving else ""),
            f" · back in {left_s:.0f} s without a key\n",
            ("hold ↑ ↓ move · ← → turn · a d aside · PgUp PgDn · Space holds · + − speed", "dim"),
        )
        if self._problem:
            out.append(f"\n✘ {safe(self._problem, 300)}", "red")
        return out
