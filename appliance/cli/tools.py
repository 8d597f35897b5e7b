"""Logs, images, checks: `swiftbot log …`, `images …`, `doctor`."""

import asyncio
import os
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, TOOLS, Json, Where, show
from appliance.errors import ConfigError

log_app = App(name="log", help="Look into MCAP logs and replay them.", group=TOOLS)
images_app = App(name="images", help="Images that skills run in.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(log_app)
    app.command(images_app)
    app.command(doctor, group=TOOLS)


@log_app.command(name="info")
def log_info(path: Path, *, as_json: Json = False) -> int:
    """Say what an MCAP log holds, also one that was cut off."""
    from appliance.record.reader import info

    found = info(path)
    show(found, as_json=as_json, table=console.log_summary(found))
    return 0


Keys = Annotated[tuple[str, ...], Parameter(name="--key", negative="", help="Only keys that match, such as **/task/*.")]
Without = Annotated[tuple[str, ...], Parameter(negative="", help="Not keys that match.")]
Since = Annotated[str, Parameter(name="--from", help="Seconds from the start, before the end (-3), or ISO 8601 time.")]
Until = Annotated[str, Parameter(help="The same; not included.")]
Out = Annotated[Path, Parameter(name=("--out", "-o"), help="File to write; must not exist.")]


def _select(paths: tuple[Path, ...], keys: tuple[str, ...], without: tuple[str, ...], since: str, until: str) -> Any:
    from appliance.record.edit import Select, instant, span

    if not paths:
        raise ConfigError("no log file is named", remedy="name one or more MCAP files")
    if not since and not until:
        return Select(keys=keys, without=without)
    start_ns, end_ns = span(paths)
    moments = [instant(each, start_ns=start_ns, end_ns=end_ns) if each else None for each in (since, until)]
    return Select(keys=keys, without=without, since_ns=moments[0], until_ns=moments[1])


def _copied(paths: tuple[Path, ...], out: Path, select: Any, *, as_json: bool) -> int:
    from appliance.record.edit import copy

    with console.err.status("reading") as status:
        made = copy(paths, out, select, progress=lambda count: status.update(f"{count:,} messages"))
    show(made, as_json=as_json, table=console.log_summary(made))
    return 0


@log_app.command(name="recover")
def log_recover(path: Path, out: Path | None = None, *, as_json: Json = False) -> int:
    """Make a proper file of an unfinished or damaged one; the original is left as it is.

    Args:
        path: The log of a recorder that was killed, or of a disk that was full or is dying.
        out: File to write; NAME.recovered.mcap beside it by default.
    """
    return _copied((path,), out or path.with_name(f"{path.stem}.recovered.mcap"), None, as_json=as_json)


@log_app.command(name="merge")
def log_merge(paths: tuple[Path, ...], *, out: Out, as_json: Json = False) -> int:
    """Make one file of several, by time: those of one recorder after rotation, or of several recorders.

    Args:
        paths: The logs.
    """
    return _copied(paths, out, _select(paths, (), (), "", ""), as_json=as_json)


@log_app.command(name="trim")
def log_trim(
    path: Path,
    *,
    out: Out,
    since: Since = "",
    until: Until = "",
    keys: Keys = (),
    without: Without = (),
    as_json: Json = False,
) -> int:
    """Write a part of a log, by time and key, as a file of its own.

    Args:
        path: The log.
    """
    return _copied((path,), out, _select((path,), keys, without, since, until), as_json=as_json)


@log_app.command(name="cat")
def log_cat(
    paths: tuple[Path, ...],
    *,
    since: Since = "",
    until: Until = "",
    keys: Keys = (),
    without: Without = (),
    grep: Annotated[str, Parameter(help="Only messages whose text matches this regular expression.")] = "",
    limit: Annotated[int, Parameter(help="Stop after so many; 0: all.")] = 0,
    as_json: Json = False,
) -> int:
    """Print a log's messages, a line each: time, key, payload; --json prints JSON lines.

    Args:
        paths: The logs, one after the other.
    """
    from appliance.record.cat import cat

    select = _select(paths, keys, without, since, until)
    try:
        damaged = cat(paths, select, grep=grep, limit=limit, as_json=as_json, write=sys.stdout.write)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read it has enough (`| head`); nothing more may be written, not even when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    for problem in damaged:
        console.err.print(f"! {problem}", markup=False)
    return 1 if damaged else 0


@log_app.command(name="pin")
def log_pin(paths: tuple[Path, ...], *, remove: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Keep logs whatever the recorder's disk budget says (an incident, say); --remove lets them go with the others.

    Args:
        paths: The logs.
        remove: Unpin them.
    """
    from appliance.record.budget import pin

    for path in paths:
        pin(path, pinned=not remove)
        console.out.print(f"{path} is {'no longer pinned' if remove else 'pinned'}", markup=False)
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
def images_list(
    *, gateways: Annotated[bool, Parameter(negative="")] = False, as_json: Json = False, where: Where = HERE
) -> int:
    """List the images of the catalogue and whether they are built.

    Args:
        gateways: Ask a fleet which of its gateways have each.
        as_json: Print JSON.
        where: The fleet, if it is asked.
    """
    from msgspec.structs import replace

    from appliance.client import FleetClient
    from appliance.pool.images import list_images
    from appliance.skills.catalogue import load_catalogue

    async def go() -> None:
        found = await list_images(load_catalogue())
        if gateways:
            async with FleetClient(where.endpoint()) as client:
                await client.gateway()
                found = [replace(each, gateways=client.image_holders(each.reference)) for each in found]
        show(found, as_json=as_json, table=console.image_table(found, gateways=gateways))

    asyncio.run(go())
    return 0


@images_app.command(name="fetch")
def images_fetch(
    name: str,
    *,
    source: Annotated[str, Parameter(name="--from", help="Gateway to ask first; any that has it otherwise.")] = "",
    gateway: Annotated[str, Parameter(help="Gateway that fetches it; the one that is linked to otherwise.")] = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Have a gateway fetch an image from another: only the layers that it lacks, without a registry.

    Args:
        name: An image of the catalogue, such as base, or a full reference.
        source: Gateway to ask first.
        gateway: Gateway that fetches it.
        as_json: Print JSON.
        where: The fleet.
    """
    from appliance.client import FleetClient
    from appliance.pool.images import reference
    from appliance.pool.settings import PoolConfig
    from appliance.skills.catalogue import load_catalogue

    spec = load_catalogue().images.get(name)
    full = name if spec is None else reference(spec, PoolConfig())

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            target = gateway or await client.gateway()
            found = await client.image_fetch(target, full, source)
        show(found, as_json=as_json, table=console.brought_text(found, target))

    asyncio.run(go())
    return 0


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
