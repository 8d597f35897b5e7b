"""A robot under an operator's hand: it moves while a key is held, and is given back when this screen is left.

`appliance.jog` says which movement is requested when, and what keeps it safe when the terminal is lost.
"""

import asyncio
import contextlib
import time
from typing import Any

from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.widgets import Static

from appliance.errors import ConflictError, SwiftbotError
from appliance.jog import GIVE_BACK_S, LASTS_S, SPEEDS, TICK_S, Holding, velocity
from appliance.model import Lease
from appliance.tui.actions import bindings
from appliance.tui.base_screen import FleetScreen
from appliance.tui.part_keys import DRIVE, part_bindings
from appliance.tui.robot_view import Ground, KnownRobots, place
from appliance.tui.safe import safe
from appliance.tui.store import Store


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
