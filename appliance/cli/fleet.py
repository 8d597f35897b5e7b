"""A fleet on this machine: `swiftbot up`, `down`, `demo`."""

import asyncio
import signal
from typing import Annotated, Any

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import FLEET, HERE, Where
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


def _order(where: Where, gateways: int, robots: str, site: str, rate: float) -> Any:
    from appliance.local_fleet import Order

    numbers = _robots(robots)
    return Order(
        fleet=where.fleet,
        directory=where.folder(),
        gateways=gateways,
        mavlink=numbers["mavlink"],
        zenoh=numbers["zenoh"],
        site=site,
        sim_rate=rate,
    )


def up(
    *,
    gateways: int = 3,
    robots: str = "mavlink=1,zenoh=1",
    site: str = "warehouse",
    rate: float = 1.0,
    detach: Annotated[bool, Parameter(negative="")] = False,
    where: Where = HERE,
) -> int:
    """Start a local fleet: gateways, recorder and simulated robots, each its own process.

    Args:
        gateways: How many gateways.
        robots: How many simulated robots of each kind.
        site: Built-in site or site file.
        rate: How many times faster than real the simulated robots move.
        detach: Return when the fleet is ready; end it with `swiftbot down`.
        where: The fleet.
    """
    from appliance import local_fleet

    async def go() -> None:
        order = _order(where, gateways, robots, site, rate)
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


def down(*, where: Where = HERE) -> int:
    """End a local fleet and remove its containers."""
    from appliance import local_fleet

    asyncio.run(local_fleet.down(where.folder(), progress=console.err.print))
    console.out.print(f"fleet {where.fleet} is down")
    return 0


def demo(
    *,
    ask: Annotated[tuple[str, ...], Parameter(negative="", help="A further instruction.")] = (),
    tui: Annotated[bool, Parameter(negative="", help="Open the terminal UI on the running fleet.")] = False,
    keep: Annotated[bool, Parameter(negative="", help="Leave the fleet running.")] = False,
    gateways: int = 3,
    robots: str = "mavlink=1,zenoh=1",
    site: str = "warehouse",
    rate: float = 4.0,
    where: Where = DEMO,
) -> int:
    """Run the main job once through: a fleet, instructions, plans, results, the log and its replay."""
    from appliance import demo as demonstration

    asks = [each for each in ask if each.strip()]
    good = asyncio.run(demonstration.run(_order(where, gateways, robots, site, rate), asks=asks, tui=tui, keep=keep))
    return Exit.DONE if good else Exit.FAILED
