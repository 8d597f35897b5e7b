"""Steering recorders and players over the plane from a command line: a trigger, and a replay steered by keys."""

import asyncio
import contextlib
import os
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Generator, Sequence
from pathlib import Path

from appliance.errors import RefusedError
from appliance.model import keyspace
from appliance.model.keys import Keys, fleet_and_rest
from appliance.model.recorder_api import RecorderStatus, Trigger
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.record.incidents import EVERY
from appliance.record.player import Played, Player, PlayOptions

JUMP_S = 5.0
SETTLE_S = 0.3
"""How long listeners are given to link before the first message."""
_LEFT, _RIGHT = b"\x1b[D", b"\x1b[C"


async def trigger(
    fleet: str, connect: tuple[str, ...], reason: str, *, by: str, wait_s: float, keys: str = ""
) -> list[RecorderStatus]:
    """Tell all recorders of a fleet that something is worth keeping; returns the accounts of those that confirm it.

    Raises:
        UnreachableError: the fleet cannot be joined.
    """
    session = await Session.open(PlaneConfig(mode="client", connect=connect, keys=keys), fleet)
    before: dict[str, int] = {}
    confirmed: dict[str, RecorderStatus] = {}
    heard, done = asyncio.Event(), asyncio.Event()

    def take(_key: str, status: RecorderStatus | None) -> None:
        if status is None:
            return
        heard.set()
        if status.incidents > before.setdefault(status.id, status.incidents):
            confirmed[status.id] = status
            if confirmed.keys() >= before.keys():
                done.set()

    try:
        session.subscribe_typed(keyspace.RECORDER_STATUS, take)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                await heard.wait()
        session.publish(keyspace.RECORDER_TRIGGER, Trigger(reason=reason, by=by), EVERY)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(wait_s):
                await done.wait()
        return list(confirmed.values())
    finally:
        await session.close()


async def replay(
    paths: Sequence[Path],
    options: PlayOptions,
    *,
    fleet: str,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    tell: Callable[[str], None] = lambda _: None,
) -> Played:
    """Play logs onto a plane: of a session that listens, or of the fleet that is joined.

    Args:
        paths: the logs.
        options: how.
        fleet: whose keys they are played on.
        listen: endpoints for those who want to see it.
        connect: endpoints to join.
        tell: gets a line on how far it is.

    Raises:
        NotFoundError, RecordError: a log cannot be read.
        ConfigError, UnreachableError: an endpoint cannot be listened on, or joined.
        RefusedError: gateways are at work in the fleet that is played onto.
    """
    session = await Session.open(PlaneConfig(mode="peer", listen=listen, connect=connect), fleet)
    try:
        player = Player(session, paths, options)
        began = time.monotonic()

        def told(position_ns: int, messages: int) -> None:
            at_s, of_s = (position_ns - player.start_ns) / 1e9, (player.end_ns - player.start_ns) / 1e9
            head = player.head
            how = "stands" if head.paused else (f"×{head.rate:g}" if head.rate else "as fast as it goes")
            rate = messages / max(1e-3, time.monotonic() - began)
            tell(f"{at_s:.1f} of {of_s:.1f} s, {how}, {messages:,} messages, {rate:,.0f}/s")

        player.on_told(told)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, player.stop)
        await asyncio.sleep(SETTLE_S)
        for each in ({fleet} | {fleet_and_rest(f"{new}/")[0] for _, new in options.remap}) - {""}:
            if members := await session.alive_now(Keys(each)(keyspace.GATEWAY_ALIVE)):
                raise RefusedError(
                    f"fleet {each} is at work ({len(members)} gateways): what is replayed would be taken for its own",
                    remedy="replay onto a fleet of another name, with --as",
                )
        with _keyboard(player):
            return await player.play()
    finally:
        await session.close()


@contextlib.contextmanager
def _keyboard(player: Player) -> Generator[None]:
    """Have keys steer a replay, where there is a terminal."""
    try:
        terminal = sys.stdin.fileno()
        before = termios.tcgetattr(terminal)
    except (OSError, ValueError, termios.error):  # none
        yield
        return
    loop = asyncio.get_running_loop()
    tty.setcbreak(terminal)
    loop.add_reader(terminal, lambda: steer(player, os.read(terminal, 64)))
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def steer(player: Player, keys: bytes) -> None:
    """Do what keys mean."""
    now = time.monotonic()
    here_ns = player.head.position_ns(now)
    if keys in (_LEFT, _RIGHT):
        player.seek(here_ns + round((JUMP_S if keys == _RIGHT else -JUMP_S) * 1e9))
        return
    for each in keys.decode("ascii", "ignore"):
        match each:
            case " ":
                player.pause(paused=not player.head.paused)
            case ".":
                player.step()
            case "+" | "=":
                player.set_rate(player.head.rate * 2)
            case "-":
                player.set_rate(player.head.rate / 2)
            case "q":
                player.stop()
            case _:
                pass
