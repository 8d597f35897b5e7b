"""`swiftbot robots drive`: a robot that is taken over moves while a key of this terminal is held."""

import asyncio
import contextlib
import os
import signal
import sys
import termios
import time
import tty
from collections.abc import Generator, Mapping
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.control import strip_control_codes

from appliance.cli.common import HERE, Where, Why, on_terminal
from appliance.client import FleetClient
from appliance.errors import ConfigError, ConflictError, Exit, SwiftbotError
from appliance.jog import GIVE_BACK_S, LASTS_S, SPEEDS, TICK_S, Holding, Moves, velocity
from appliance.model import Lease

KEYS: Mapping[bytes, str] = {
    b"\x1b[A": Moves.FORWARD, b"\x1bOA": Moves.FORWARD, b"\x1b[B": Moves.BACK, b"\x1bOB": Moves.BACK,
    b"\x1b[D": Moves.TURN_LEFT, b"\x1bOD": Moves.TURN_LEFT, b"\x1b[C": Moves.TURN_RIGHT, b"\x1bOC": Moves.TURN_RIGHT,
    b"a": Moves.LEFT, b"d": Moves.RIGHT, b"\x1b[5~": Moves.UP, b"\x1b[6~": Moves.DOWN,
    b" ": "hold", b"+": "faster", b"=": "faster", b"-": "slower", b"q": "quit", b"\x03": "quit", b"\x04": "quit",
}  # fmt: skip
"""What terminals send for a key, and what it does."""
HELP = "hold ↑ ↓ move · ← → turn · a d aside · PgUp PgDn up, down · Space holds · + − speed · q or Esc releases"
_ESCAPE_S = 0.1
"""An escape that nothing follows for so long is the key itself."""


class Keys:
    """Takes bytes of a terminal apart into keys; what is none is dropped."""

    def __init__(self) -> None:
        self._rest = b""
        self._at = 0.0

    def read(self, data: bytes, now: float) -> list[str]:
        """Return what the keys in some bytes do, and a lone escape from before."""
        found: list[str] = []
        if self._rest == b"\x1b" and now - self._at >= _ESCAPE_S:
            found.append("quit")
            self._rest = b""
        if data:
            self._at = now
        left = (self._rest + data)[-64:]
        while left:
            key = next((each for each in KEYS if left.startswith(each)), None)
            if key is not None:
                found.append(KEYS[key])
                left = left[len(key) :]
            elif any(each.startswith(left) for each in KEYS):
                break  # the beginning of one: the rest is on its way
            else:
                left = left[1:]
        self._rest = left
        return found


@contextlib.contextmanager
def _unbuffered(terminal: int) -> Generator[None]:
    """Have a terminal give each key at once, unseen, ^C among them; as it was afterwards."""
    before = termios.tcgetattr(terminal)
    tty.setraw(terminal, termios.TCSANOW)
    after = termios.tcgetattr(terminal)
    after[1] |= termios.OPOST  # what is printed begins at the left edge all the same
    termios.tcsetattr(terminal, termios.TCSANOW, after)
    try:
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


class Drive:
    """One robot under this terminal's keys.

    Args:
        client: connected.
        lease: of the robot.
        speed_mps: at first; `+` and `-` go through `SPEEDS`.
    """

    def __init__(self, client: FleetClient, lease: Lease, speed_mps: float) -> None:
        self._client, self._lease = client, lease
        self._holding = Holding(time.monotonic())
        self._speed = speed_mps
        self._keys = Keys()
        self._heard = b""
        self._silent = False
        self._said = ""
        self._problem = ""

    def hear(self, data: bytes) -> None:
        """Take bytes of the terminal; none: it is gone."""
        self._heard += data
        self._silent = not data

    async def run(self) -> str:
        """Move the robot while keys are held; return why that ended."""
        renewing = asyncio.create_task(self._keep_renewing(), name="lease")
        try:
            while True:
                if (ended := await self._step(time.monotonic())) or renewing.done():
                    return ended or "the lease was lost"
                self._tell()
                await asyncio.sleep(TICK_S)
        except ConflictError as error:
            return error.message
        finally:
            renewing.cancel()

    async def _step(self, now: float) -> str:
        data, self._heard = self._heard, b""
        for key in self._keys.read(data, now):
            match key:
                case "quit":
                    return "released by key"
                case "hold":
                    self._holding.release(now)
                case "faster" | "slower":
                    self._holding.touch(now)
                    self._speed = other_speed(self._speed, faster=key == "faster")
                case _:
                    self._holding.press(key, now)
        if self._silent:
            return "the terminal is gone"
        step = self._holding.due(now)
        if step.give_back:
            return "no key came for a while"
        if step.move or step.stop:
            try:
                args = velocity(step.move, self._speed) | {"for_s": LASTS_S}
                await self._client.drive(self._lease, "velocity", timeout_s=2.0, **args)
                self._problem = ""
            except ConflictError:
                raise
            except SwiftbotError as error:
                self._problem = str(error)
                self._holding.release(now)
        return ""

    async def _keep_renewing(self) -> None:
        while True:
            await asyncio.sleep(self._lease.lease_s / 3)
            with contextlib.suppress(SwiftbotError):
                try:
                    await self._client.renew(self._lease)
                except ConflictError:
                    return

    def _tell(self) -> None:
        robot = self._client.known_robots().get(self._lease.robot)
        pose = robot.pose if robot is not None else None
        at = f"{pose.x:.1f} {pose.y:.1f} {pose.z:.1f} m" if pose is not None else "position not known"
        moving = f"● {self._holding.moving}" if self._holding.moving else "‖ holds"
        left_s = self._holding.left_s(time.monotonic())
        line = f"{self._lease.robot} · {at} · {self._speed:g} m/s · {moving} · released in {left_s:.0f} s without a key"
        if self._problem:
            line = f"✘ {self._problem}"
        if line != self._said:
            self._said = line
            columns = os.get_terminal_size(sys.stdout.fileno()).columns
            sys.stdout.write(f"\r\x1b[K{strip_control_codes(line)[: max(10, columns - 1)]}")
            sys.stdout.flush()


def other_speed(now_mps: float, *, faster: bool) -> float:
    """Return the next speed above or below one, metres a second; the same at the ends."""
    others = [each for each in SPEEDS if (each > now_mps if faster else each < now_mps)]
    return now_mps if not others else others[0] if faster else others[-1]


async def robots_drive(
    robot: str,
    /,
    *,
    speed: Annotated[
        float, Parameter(help="Metres a second; the robot's own limits hold besides.", validator=Number(gt=0, lte=2))
    ] = 0.5,
    why: Why = "",
    where: Where = HERE,
) -> int:
    """Take a robot over and drive it with this terminal's keys: it moves while a key is held, and holds otherwise.

    A movement lasts half a second at the robot and is requested again while the key repeats: when the terminal, this
    program or the network is lost, the robot stops by itself. It is released by q, Esc, Ctrl-C, 30 s without a key,
    and by the end of the lease (10 s) when this program is killed. The site's fence and the robot's limits hold.

    Args:
        robot: Robot ID.
    """
    if not on_terminal():
        raise ConfigError(
            "driving needs a terminal: standard input or output is a file or a pipe",
            remedy="`swiftbot robots takeover`, then `swiftbot robots move` moves it from a script",
        )
    terminal = sys.stdin.fileno()
    async with where.client() as client:
        lease = await client.take_over(robot, why=why)
        drive = Drive(client, lease, speed)
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task is not None  # noqa: S101 - this runs in one
        for number in (signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, task.cancel)
        loop.add_reader(terminal, lambda: drive.hear(os.read(terminal, 1024)))
        ended = "interrupted"
        try:
            sys.stdout.write(f"{HELP}\n")
            with _unbuffered(terminal):
                ended = await drive.run()
        finally:
            loop.remove_reader(terminal)
            with contextlib.suppress(SwiftbotError, TimeoutError):
                async with asyncio.timeout(GIVE_BACK_S):
                    await asyncio.shield(client.give_back(lease, why=ended))
            sys.stdout.write(f"\n{robot} is released: {strip_control_codes(ended)}\n")
    return Exit.DONE
