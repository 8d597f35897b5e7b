"""Soft stops: `swiftbot stop`, `resume`. `stops` is made from the registry of operations."""

import contextlib
from collections.abc import Generator

from cyclopts import App

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show, tell_left
from appliance.client import Stopped, answer_text
from appliance.errors import Exit, SwiftbotError
from appliance.operations import left_of


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (stop, resume):
        app.command(command, group=WORK)


async def stop(*robots: str, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Soft stop: robots hold, and accept no command until `resume`; without names, the whole fleet.

    Commands in flight are cancelled and the tasks that need the robots are paused. It survives restarts of gateways.
    It is no safety-rated emergency stop: that is a switch at the robot. Names may be typed as "Rover_1", "rover 1",
    "drones". Exit code 1 when a robot did not confirm, also an offline one, which is stopped once it is back. A name
    that no robot has stops nothing and is reported first (exit code 4 when nothing was stopped).
    """
    with reported_unconfirmed():
        async with where.client() as client:
            done = await Stopped.carry_out(client, robots, why=why)
            if as_json:
                return show_stopped(done, as_json=True)
            # At once: how they stand is told after that they do.
            code = show_stopped(done, as_json=False)
            # Of the fleet only those that hold something: the others are at rest, and `robots` lists them.
            known = client.known_robots()
            meant = done.robots or [name for name, each in sorted(known.items()) if each.holding]
            tell_left(await left_of(client, meant if done.answer is not None else (), stopped=True))
    return code


@contextlib.contextmanager
def reported_unconfirmed(is_stop: bool = True) -> Generator[None]:
    """Print first that a stop is not confirmed when it ends with an error."""
    try:
        yield
    except SwiftbotError:
        if is_stop:
            console.err.print("NOT CONFIRMED: use the switch at a robot that moves")
        raise


def show_stopped(done: Stopped, *, as_json: bool) -> int:
    """Print the outcome of a stop; the exit code says whether all of it is confirmed."""
    show(done.as_json(), as_json=as_json, table=done.text())
    if done.unknown:
        return Exit.REFUSED if done.answer is None else Exit.FAILED
    return Exit.DONE if done.confirmed else Exit.FAILED


async def resume(*robots: str, why: Why = "", as_json: Json = False, where: Where = HERE) -> int:
    """Lift the soft stops of these robots, or of all; their tasks continue. Exit code 1: a gateway did not confirm."""
    async with where.client() as client:
        answer = await client.resume_robots(robots, why=why)
    show(answer, as_json=as_json, table=answer_text(answer))
    return Exit.FAILED if answer.silent else Exit.DONE
