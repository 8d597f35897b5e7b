"""Simulated robots: `swiftbot sim mavlink`, `sim zenoh`."""

import asyncio
from typing import Annotated, Literal

from cyclopts import App, Parameter, validators

from appliance import logs
from appliance.cli.common import DAEMONS, HERE, Where
from appliance.cli.daemons import until_signalled

Percent = Annotated[float, Parameter(validator=validators.Number(gte=0, lte=100))]
sim_app = App(name="sim", help="Simulated robots.", group=DAEMONS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(sim_app)


@sim_app.command
def mavlink(
    *,
    to: tuple[str, ...],
    vehicles: int = 0,
    streams: float = 1.0,
    listen: bool = False,
    system: int = 1,
    site: str = "warehouse",
    rate: float = 1.0,
    start: str = "home",
    spot: int = 0,
    at: str = "",
    battery: Percent = 100.0,
    kind: Literal["copter", "rover"] = "copter",
    parameter: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    drop: float = 0.0,
    double: float = 0.0,
    mix: float = 0.0,
    delay_s: float = 0.0,
    seed: int = 1,
) -> int:
    """Simulate MAVLink vehicles that send to a gateway, or wait for one.

    Args:
        to: Where the gateway listens, udp://host:port or tcp://host:port; repeatable, vehicles take them by turns.
        vehicles: How many, in this one process; 0: one for each --to.
        streams: How many times as often as usual it sends each kind of telemetry, up to ten times a second.
        listen: Listen there (tcp), as SITL does, and let the gateway connect.
        system: MAVLink system id, 1 to 255, of the first vehicle; the others count on.
        site: Built-in site or site file.
        rate: How many times faster than real it moves.
        start: Its home, a place or a point "x, y".
        spot: Which spot beside it, nearest first, of the first vehicle; 0 is the place itself.
        at: Where it stands at first, a point "x, y"; at home if not given.
        battery: Percent.
        kind: A multirotor or a rover.
        parameter: NAME=VALUE of its autopilot that differ from the usual, such as SIM_WIND_SPD=6 or FENCE_ENABLE=1.
        drop: Share of frames that its link loses, each way.
        double: Share of frames that arrive twice.
        mix: Share of frames that arrive after later ones.
        delay_s: Time that frames are on their way.
        seed: Of the link's chances: the same one loses the same frames.
    """
    from appliance.skills.sites import load_site
    from workshop.robots.mavlink import VehicleSettings, read_parameters, run_vehicles

    logs.configure(style="text")
    ground = load_site(site)
    settings = [
        VehicleSettings(
            to=to[number % len(to)],
            listen=listen,
            system=system + number,
            site=ground,
            rate=rate,
            streams=streams,
            start=start,
            spot=spot + number,
            at=at,
            battery_percent=battery,
            kind=kind,
            parameters=read_parameters(parameter),
            drop=drop,
            double=double,
            mix=mix,
            delay_s=delay_s,
            seed=seed + number,
        )
        for number in range(vehicles or len(to))
    ]

    async def go() -> None:
        await run_vehicles(settings, stop=until_signalled())

    asyncio.run(go())
    return 0


@sim_app.command
def zenoh(
    *,
    name: str,
    site: str = "warehouse",
    rate: float = 1.0,
    start: str = "charger",
    spot: int = 0,
    at: str = "",
    battery: Percent = 100.0,
    holding: str = "",
    where: Where = HERE,
) -> int:
    """Simulate a mobile robot with arm and camera that speaks Zenoh.

    Args:
        name: Its name in the roster.
        site: Built-in site or site file.
        rate: How many times faster than real it moves.
        start: Its home, a place or a point "x, y".
        spot: Which spot beside it, nearest first; 0 is the place itself.
        at: Where it stands at first, a point "x, y"; at home if not given.
        battery: Percent.
        holding: What it has in its hand at first.
        where: The fleet.
    """
    from appliance.skills.sites import load_site
    from workshop.robots.zenoh_robot import RobotSettings, run_robot

    logs.configure(style="text")
    endpoint = where.endpoint()
    settings = RobotSettings(
        name=name,
        fleet=endpoint.fleet,
        connect=endpoint.connect,
        site=load_site(site),
        rate=rate,
        start=start,
        spot=spot,
        at=at,
        battery_percent=battery,
        holding=holding,
    )

    async def go() -> None:
        await run_robot(settings, stop=until_signalled())

    asyncio.run(go())
    return 0
