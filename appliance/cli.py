"""`swiftbot …`: parses arguments and prints; the work is done in the rooms.

Exit codes: 0 done; 1 it failed (a task that did not succeed, an internal error); 2 the command line or a
configuration is wrong; 3 nobody answered; 4 refused or not found; 5 something the machine must have is missing;
6 too late; 7 cancelled; 130 interrupted.
"""

import asyncio
import os
import signal
import sys
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import uvloop
from cyclopts import App, CycloptsError, Group, Parameter
from rich.markup import escape

from appliance import console, logs, service
from appliance.client import Endpoint, FleetClient
from appliance.errors import ConfigError, NotFoundError, SwiftbotError
from appliance.model import TaskRecord, TaskRequest, TaskState
from appliance.tasks.view import view

DAEMONS = Group("Daemons", sort_key=3)
FLEET = Group("A fleet on this machine", sort_key=1)
WORK = Group("Work", sort_key=2)
TOOLS = Group("Logs, images, checks", sort_key=4)

app = App(
    name="swiftbot", help="SwiftBot gateway: instructions to a robot fleet, run in warm containers.", version="0.1.0"
)
task_app = App(name="task", help="List, show and cancel tasks.", group=WORK)
log_app = App(name="log", help="Look into MCAP logs and replay them.", group=TOOLS)
sim_app = App(name="sim", help="Simulated robots.", group=DAEMONS)
images_app = App(name="images", help="Images that skills run in.", group=TOOLS)
bench_app = App(name="bench", help="Measure a promise beside its alternative, in one run.", group=TOOLS)
for child in (task_app, log_app, sim_app, images_app, bench_app):
    app.command(child)

Json = Annotated[bool, Parameter(name="--json", negative="", help="Print JSON.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """Which fleet a command speaks to."""

    fleet: Annotated[str, Parameter(env_var="SWIFTBOT_FLEET", help="Name of the fleet.")] = "local"
    directory: Annotated[
        Path | None, Parameter(name="--dir", env_var="SWIFTBOT_DIR", help="Directory of a local fleet.")
    ] = None
    connect: Annotated[
        tuple[str, ...],
        Parameter(env_var="SWIFTBOT_CONNECT", negative="", help="Endpoint of a gateway, such as tcp/10.0.0.1:7447."),
    ] = ()

    def folder(self) -> Path:
        """Directory of the local fleet of that name."""
        from appliance.local_fleet import default_directory

        return self.directory or default_directory(self.fleet)

    def endpoint(self) -> Endpoint:
        """Where to connect: as told, or what the local fleet's state file says."""
        if self.connect:
            return Endpoint(fleet=self.fleet, connect=self.connect)
        from appliance.local_fleet import read_state

        return read_state(self.folder()).endpoint


HERE = Where()


def show(value: Any, *, as_json: bool, table: Any = None) -> None:
    """Print a value as JSON, or its table."""
    if as_json:
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(value), indent=2).decode() + "\n")
    else:
        console.out.print(table)


# --- a fleet on this machine ----------------------------------------------------------------------------------


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


@app.command(group=FLEET)
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


@app.command(group=FLEET)
def down(*, where: Where = HERE) -> int:
    """End a local fleet and remove its containers."""
    from appliance import local_fleet

    asyncio.run(local_fleet.down(where.folder(), progress=console.err.print))
    console.out.print(f"fleet {where.fleet} is down")
    return 0


@app.command(group=FLEET)
def demo(
    *,
    ask: Annotated[tuple[str, ...], Parameter(negative="", help="A further instruction.")] = (),
    tui: Annotated[bool, Parameter(negative="", help="Open the terminal UI on the running fleet.")] = False,
    keep: Annotated[bool, Parameter(negative="", help="Leave the fleet running.")] = False,
    gateways: int = 3,
    robots: str = "mavlink=1,zenoh=1",
    site: str = "warehouse",
    rate: float = 4.0,
    where: Where = Where(fleet="demo"),
) -> int:
    """Run the main job once through: a fleet, instructions, plans, results, the log and its replay."""
    from appliance import demo as demonstration

    asks = [each for each in ask if each.strip()]
    good = asyncio.run(demonstration.run(_order(where, gateways, robots, site, rate), asks=asks, tui=tui, keep=keep))
    return 0 if good else 1


# --- daemons ---------------------------------------------------------------------------------------------------


@app.command(group=DAEMONS)
def gateway(*, config: Path) -> int:
    """Run a gateway until SIGTERM, which drains it.

    Args:
        config: TOML file, see docs/configuration.md.
    """
    from appliance import config as configuration
    from appliance import gateway as daemon

    loaded = configuration.load(config)
    logs.configure(level=loaded.log_level, style=loaded.log_format)
    uvloop.run(daemon.run(loaded))
    return 0


@app.command(group=DAEMONS)
def record(*, config: Path | None = None, out: Path | None = None, where: Where = HERE) -> int:
    """Record every message of a fleet into MCAP until SIGTERM or Ctrl-C.

    Args:
        config: A gateway's TOML file: its fleet, endpoints and [record] section.
        out: Directory for the log files, instead of the configured one.
        where: The fleet, when no configuration is given.
    """
    from appliance import config as configuration
    from appliance.plane.settings import PlaneConfig
    from appliance.record.recorder import run_recorder
    from appliance.record.settings import RecordConfig

    if config is not None:
        loaded = configuration.load(config)
        logs.configure(level=loaded.log_level, style=loaded.log_format)
        fleet, settings = loaded.fleet, loaded.record
        connect = (*loaded.plane.listen, *loaded.plane.connect)
    else:
        endpoint = where.endpoint()
        fleet, connect, settings = endpoint.fleet, endpoint.connect, RecordConfig(directory=str(Path.cwd()))
        logs.configure(style="text")
    if out is not None:
        settings = msgspec.structs.replace(settings, directory=str(out))

    async def go() -> None:
        # A peer linked to every gateway: a client hangs on one, and would miss what happens while that one is gone.
        plane = PlaneConfig(mode="peer", connect=connect)
        await run_recorder(settings, plane, fleet, _until_signalled(), alive=_tell_systemd)

    uvloop.run(go())
    return 0


def _tell_systemd(_: object) -> None:
    service.ready()
    service.alive()


def _until_signalled() -> asyncio.Event:
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


@sim_app.command
def mavlink(*, to: str, system: int = 1, site: str = "warehouse", rate: float = 1.0, start: str = "home") -> int:
    """Simulate a MAVLink copter that sends to a gateway's UDP port.

    Args:
        to: Where the gateway listens, udp://host:port.
        system: MAVLink system id, 1 to 255.
        site: Built-in site or site file.
        rate: How many times faster than real it moves.
        start: Place it starts at.
    """
    from appliance.robots.sim.mavlink import VehicleSettings, run_vehicle
    from appliance.skills.sites import load_site

    logs.configure(style="text")
    settings = VehicleSettings(to=to, system=system, site=load_site(site), rate=rate, start=start)

    async def go() -> None:
        await run_vehicle(settings, stop=_until_signalled())

    asyncio.run(go())
    return 0


@sim_app.command
def zenoh(*, name: str, site: str = "warehouse", rate: float = 1.0, start: str = "charger", where: Where = HERE) -> int:
    """Simulate a mobile robot with arm and camera that speaks Zenoh.

    Args:
        name: Its name in the roster.
        site: Built-in site or site file.
        rate: How many times faster than real it moves.
        start: Place it starts at.
        where: The fleet.
    """
    from appliance.robots.sim.zenoh_robot import RobotSettings, run_robot
    from appliance.skills.sites import load_site

    logs.configure(style="text")
    endpoint = where.endpoint()
    settings = RobotSettings(
        name=name, fleet=endpoint.fleet, connect=endpoint.connect, site=load_site(site), rate=rate, start=start
    )

    async def go() -> None:
        await run_robot(settings, stop=_until_signalled())

    asyncio.run(go())
    return 0


# --- work ------------------------------------------------------------------------------------------------------


@app.command(group=WORK)
def plan(text: str, *, as_json: Json = False, where: Where = HERE) -> int:
    """Decompose an instruction and print the plan; nothing is run."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            answer = await client.plan(text)
        show(answer, as_json=as_json, table=console.plan_graph(answer.plan))

    asyncio.run(go())
    return 0


@app.command(group=WORK)
def submit(
    text: str,
    *,
    wait: Annotated[
        bool, Parameter(negative="", help="Show progress and wait for the end; Ctrl-C cancels it.")
    ] = False,
    task_id: Annotated[str, Parameter(name="--id", help="Task id; a known one is not done twice.")] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Hand in an instruction; without --wait it returns when the task is planned."""
    from appliance.demo import follow

    # The id is chosen here: an interrupt while the task is being handed in must know what to cancel.
    request = TaskRequest(instruction=text, id=task_id or f"t-{uuid.uuid4().hex[:10]}", submitter=_me())

    async def go() -> TaskRecord:
        async with FleetClient(where.endpoint()) as client:
            try:
                accepted = await client.submit(request)
                console.err.print(f"task {accepted.id} is accepted")
                if not wait:
                    return await client.planned(accepted.id)
                if not as_json:
                    return await follow(client, accepted.id)
                last = accepted
                async for record in client.watch(accepted.id):
                    last = record
            except asyncio.CancelledError:
                if wait:
                    await _cancel(client, request.id)
                raise
            return last

    record = asyncio.run(go())
    if as_json or not wait:
        show(view(record), as_json=as_json, table=console.task_table(record))
    return _outcome(record)


async def _cancel(client: FleetClient, task: str) -> None:
    """Cancel a task after an interrupt; that it cannot be done is said, and the command still ends as interrupted."""
    console.err.print(f"cancelling task {task}")
    try:
        await client.cancel(task)
    except NotFoundError:
        console.err.print(f"task {task} had not been accepted")
    except SwiftbotError as error:
        console.err.print(f"task {task} may go on: {error}", markup=False)


def _outcome(record: TaskRecord) -> int:
    if record.state is TaskState.FAILED:
        return 4 if record.failure is not None and record.failure.code == "plan" else 1
    return 7 if record.state is TaskState.CANCELLED else 0


def _me() -> str:
    return os.environ.get("USER") or f"uid {os.getuid()}"


@task_app.command(name="list")
def task_list(*, limit: int = 20, as_json: Json = False, where: Where = HERE) -> int:
    """List the newest tasks of the fleet."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            found = await client.tasks(limit)
        for each in found.unreachable:
            console.err.print(f"{each} did not answer; its tasks may be missing")
        show([view(each) for each in found.tasks], as_json=as_json, table=console.task_list(found.tasks))

    asyncio.run(go())
    return 0


@task_app.command(name="show")
def task_show(task: str, *, as_json: Json = False, where: Where = HERE) -> int:
    """Show a task with its subtasks."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            record = await client.task(task)
        show(view(record), as_json=as_json, table=console.task_table(record))

    asyncio.run(go())
    return 0


@task_app.command(name="cancel")
def task_cancel(task: str, *, as_json: Json = False, where: Where = HERE) -> int:
    """Stop a task; returns when it has ended."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            record = await client.cancel(task)
            if not record.state.final:
                console.err.print(f"task {task} is being cancelled")
            async for record in client.watch(task):  # noqa: B007 - the last one is shown
                pass
        show(view(record), as_json=as_json, table=console.task_table(record))

    asyncio.run(go())
    return 0


@app.command(group=WORK)
def fleet(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the gateways."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            found = sorted(client.plane.registry.gateways.values(), key=lambda each: each.id)
        show(found, as_json=as_json, table=console.gateway_table(found))

    asyncio.run(go())
    return 0


@app.command(group=WORK)
def pool(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the warm containers of all gateways."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            by_gateway = client.plane.registry.containers
            found = [each for name in sorted(by_gateway) for each in by_gateway[name].values()]
        show(found, as_json=as_json, table=console.container_table(found))

    asyncio.run(go())
    return 0


@app.command(group=WORK)
def robots(*, as_json: Json = False, where: Where = HERE) -> int:
    """Show the robots."""

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            await client.gateway()
            found = sorted(client.plane.registry.robots.values(), key=lambda each: each.id)
        show(found, as_json=as_json, table=console.robot_table(found))

    asyncio.run(go())
    return 0


@app.command(group=WORK)
def tui(*, where: Where = HERE) -> int:
    """Open the terminal UI on a fleet."""
    from appliance.plane.settings import PlaneConfig
    from appliance.tui.app import run_tui

    endpoint = where.endpoint()
    asyncio.run(run_tui(PlaneConfig(mode="client", connect=endpoint.connect), endpoint.fleet))
    return 0


# --- logs, images, checks -----------------------------------------------------------------------------------------


@log_app.command(name="info")
def log_info(path: Path, *, as_json: Json = False) -> int:
    """Say what an MCAP log holds, also one that was cut off."""
    from appliance.record.reader import info

    found = info(path)
    show(found, as_json=as_json, table=console.log_summary(found))
    return 0


@log_app.command(name="replay")
def log_replay(path: Path, *, as_json: Json = False) -> int:
    """Fold a log's transitions through the task state machine and compare the end states; 1 when they differ."""
    from appliance.tasks.replay import replay

    report = replay(path)
    show(report, as_json=as_json, table=console.replay_summary(report))
    return 0 if report.same else 1


@images_app.command(name="build")
def images_build(names: tuple[str, ...] = (), *, force: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Build the images that skills run in, from Debian packages; those that are there already are kept.

    Args:
        names: Which; all when none is given.
        force: Build even if present.
    """
    from appliance.pool.images import build
    from appliance.skills.catalogue import load_catalogue

    catalogue = load_catalogue()

    async def go() -> None:
        for name in names or tuple(catalogue.images):
            reference = await build(name, catalogue, progress=console.err.print, force=force)
            console.out.print(reference)

    asyncio.run(go())
    return 0


@images_app.command(name="list")
def images_list(*, as_json: Json = False) -> int:
    """List the images of the catalogue and whether they are built."""
    from appliance.pool.images import list_images
    from appliance.skills.catalogue import load_catalogue

    found = asyncio.run(list_images(load_catalogue()))
    show(found, as_json=as_json, table=console.image_table(found))
    return 0


@app.command(group=TOOLS)
def doctor(*, config: Path | None = None, as_json: Json = False) -> int:
    """Check everything this machine must have; names the remedy for each check that fails.

    Args:
        config: A gateway's TOML file, to check its ports and folders too.
    """
    from appliance import config as configuration
    from appliance.doctor import run_checks

    loaded = configuration.load(config) if config else None
    checks = asyncio.run(run_checks(loaded))
    show(checks, as_json=as_json, table=console.check_table(checks))
    return 0 if all(check.ok or not check.required for check in checks) else 5


@bench_app.command
def startup(*, count: int = 100, cold: int = 5, image: str = "base", as_json: Json = False) -> int:
    """Subtask startup: cold containers, warm local ones, warm ones found on another gateway, in one run.

    Args:
        count: Warm runs of each kind.
        cold: Cold runs.
        image: Image of the containers.
    """
    from appliance.bench.federated import run_all

    result = asyncio.run(run_all(count, cold, image=image, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command(name="record")
def bench_record(*, messages: int = 50_000, rounds: int = 3, as_json: Json = False) -> int:
    """Logging: messages/s of the recorder's writer beside the bare MCAP library.

    Args:
        messages: Messages a round.
        rounds: Rounds of each; the median counts.
    """
    from appliance.bench.record import run as bench

    result = asyncio.run(bench(messages=messages, rounds=rounds))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command(name="plan")
def bench_plan(*, cases: Path | None = None, limit: int = 0, as_json: Json = False) -> int:
    """Plans: how good the rules' plans are on a set of instructions with gold plans.

    Args:
        cases: JSONL file of cases with score.py beside it; by default the development set.
        limit: Use the first so many cases; 0 for all.
    """
    from appliance.bench.plan import run as bench

    result = asyncio.run(bench(cases, limit=limit, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


def main(arguments: list[str] | None = None) -> None:
    """Entry point: run a command and end with its exit code."""
    # Commands speak for themselves; daemons set up their own logging when they start.
    logs.configure(level="warning", style="text")
    try:
        code = app(arguments, exit_on_error=False, print_error=True, result_action="return_value")
        code = code if isinstance(code, int) else 0
    except CycloptsError:
        code = 2
    except SwiftbotError as error:
        # Messages hold what people and robots wrote: brackets in them are no markup.
        console.err.print(f"[red]error:[/red] {escape(error.message)}", markup=True)
        if error.remedy:
            console.err.print(f"  remedy: {error.remedy}", markup=False)
        code = error.exit_code
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
