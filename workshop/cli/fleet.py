"""A fleet on this machine: `swiftbot up`, `down`, `demo`."""

import asyncio
import signal
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import FLEET, HERE, Json, Skills, Where, show
from appliance.errors import ConfigError, Exit


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (up, down, demo):
        app.command(command, group=FLEET)


DEMO = Where(fleet="demo")


def _robots(text: str) -> dict[str, int]:
    found = {"mavlink": 0, "zenoh": 0}
    for part in filter(None, text.split(",")):
        kind, _, number = part.partition("=")
        if kind not in found or not number.isdecimal():
            raise ConfigError(f"--robots {text!r} is not understood", remedy="write mavlink=1,zenoh=1")
        found[kind] = int(number)
    return found


def _order(where: Where, gateways: int, robots: str, site: str, rate: float, skills: tuple[Path, ...] = ()) -> Any:
    from workshop.local_fleet import Order

    numbers = _robots(robots)
    return Order(
        fleet=where.fleet,
        directory=where.folder(),
        gateways=gateways,
        mavlink=numbers["mavlink"],
        zenoh=numbers["zenoh"],
        site=site,
        sim_rate=rate,
        skills=skills,
    )


def up(
    *,
    gateways: int = 3,
    robots: str = "mavlink=1,zenoh=1",
    site: str = "warehouse",
    skills: Skills = (),
    rate: float = 1.0,
    detach: bool = False,
    where: Where = HERE,
) -> int:
    """Start a local fleet: gateways, recorder and simulated robots, each its own process.

    Args:
        gateways: How many gateways.
        robots: How many simulated robots of each kind; more than 8 MAVLink vehicles are in one process.
        site: Built-in site or site file.
        skills: Folder with further skills and images.
        rate: How many times faster than real the simulated robots move.
        detach: Return when the fleet is ready; end it with `swiftbot down`.
        where: The fleet.
    """
    from workshop import local_fleet

    async def go() -> None:
        order = _order(where, gateways, robots, site, rate, skills)
        state = await local_fleet.up(order, progress=console.err.print)
        console.out.print(f"fleet {state.fleet} is up: {', '.join(state.gateways)}; robots {', '.join(state.robots)}")
        if detach:
            return
        console.out.print("Ctrl-C ends it")
        stop = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
        await stop.wait()
        await local_fleet.down(order.directory, progress=console.err.print)

    asyncio.run(go())
    return 0


def down(
    *,
    volumes: Annotated[bool, Parameter(help="Remove its state volumes too.")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """End a local fleet and remove its containers; state volumes stay for the next `swiftbot up`.

    Args:
        volumes: Remove its state volumes too.
        as_json: Print JSON: processes, containers, removed and kept volumes.
        where: The fleet.
    """
    from workshop import local_fleet

    ended = asyncio.run(
        local_fleet.down(where.folder(), progress=console.err.print, volumes=volumes, fleet=where.fleet)
    )
    show(ended, as_json=as_json, table=_ended(ended, where, volumes=volumes))
    return 0


def _ended(ended: Any, where: Where, *, volumes: bool) -> str:
    """Return what `down` did as one line, with the command that removes what it kept."""
    from workshop.local_fleet import counted

    if ended.problem:
        return f"fleet {ended.fleet} is down; its containers and state volumes were left: {ended.problem}"
    parts = [f"removed {counted(ended.containers, 'container')}"]
    if ended.removed_volumes:
        parts.append(f"removed {counted(len(ended.removed_volumes), 'state volume')}")
    if ended.kept_volumes:
        options = "" if where.fleet == HERE.fleet else f" --fleet {where.fleet}"
        options += "" if where.directory is None else f" --dir {where.directory}"
        reason = "in use" if volumes else f"remove with: swiftbot down --volumes{options}"
        parts.append(f"kept {counted(len(ended.kept_volumes), 'state volume')} ({reason})")
    return f"fleet {ended.fleet} is down: {', '.join(parts)}"


def demo(
    *,
    ask: Annotated[tuple[str, ...], Parameter(help="A further instruction.")] = (),
    tui: Annotated[bool, Parameter(help="Open the terminal UI on the running fleet.")] = False,
    keep: Annotated[bool, Parameter(help="Leave the fleet running.")] = False,
    gateways: int = 3,
    robots: str = "mavlink=1,zenoh=1",
    site: str = "warehouse",
    rate: float = 4.0,
    where: Where = DEMO,
) -> int:
    """Run the main job once through: a fleet, instructions, plans, results, the log and its replay."""
    from workshop import demo as demonstration

    asks = [each for each in ask if each.strip()]
    good = asyncio.run(demonstration.run(_order(where, gateways, robots, site, rate), asks=asks, tui=tui, keep=keep))
    return Exit.DONE if good else Exit.FAILED
