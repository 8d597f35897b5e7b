"""Images and checks: `swiftbot images …`, `doctor`."""

import asyncio
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, TOOLS, Json, Skills, Where, Why, show
from appliance.errors import Exit

images_app = App(name="images", help="Images that skills run in.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(images_app)
    app.command(doctor, group=TOOLS)


@images_app.command(name="build")
def images_build(
    names: tuple[str, ...] = (),
    *,
    skills: Skills = (),
    wheelhouse: Annotated[
        tuple[Path, ...],
        Parameter(negative="", help="Folder of wheels for requirements.txt; before wheelhouse/ beside it."),
    ] = (),
    force: Annotated[bool, Parameter(negative="")] = False,
    as_json: Json = False,
) -> int:
    """Build the images that skills run in, from Debian packages and wheels; those that are there already are kept.

    Args:
        names: Which; all when none is given.
        skills: Folder with further skills and images.
        wheelhouse: Folder of wheels.
        force: Build even if present.
        as_json: Print JSON: the reference of each image by its name.
    """
    from appliance.pool.images import build
    from appliance.skills.catalogue import load_catalogue

    catalogue = load_catalogue(skills)

    async def go() -> None:
        built: dict[str, str] = {}
        for name in names or tuple(catalogue.images):
            built[name] = await build(
                name, catalogue, progress=console.err.print, force=force, wheelhouses=tuple(wheelhouse)
            )
            if not as_json:
                console.out.print(built[name])
        if as_json:
            show(built, as_json=True)

    asyncio.run(go())
    return 0


@images_app.command(name="list")
def images_list(
    *,
    skills: Skills = (),
    gateways: Annotated[bool, Parameter(negative="")] = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """List the images of the catalogue and whether they are built.

    Args:
        skills: Folder with further skills and images.
        gateways: Ask a fleet which of its gateways have each.
        as_json: Print JSON.
        where: The fleet, if it is asked.
    """
    from msgspec.structs import replace

    from appliance.client import FleetClient
    from appliance.pool.images import list_images
    from appliance.skills.catalogue import load_catalogue

    async def go() -> None:
        found = await list_images(load_catalogue(skills))
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
    skills: Skills = (),
    gateway: Annotated[str, Parameter(help="Gateway that fetches it; the one that is linked to otherwise.")] = "",
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Have a gateway fetch an image from another: only the layers that it lacks, without a registry.

    Args:
        name: An image of the catalogue, such as base, or a full reference.
        source: Gateway to ask first.
        skills: Folder with further skills and images.
        gateway: Gateway that fetches it.
        why: Why, for the audit.
        as_json: Print JSON.
        where: The fleet.
    """
    from appliance.client import FleetClient
    from appliance.pool.images import reference
    from appliance.pool.settings import PoolConfig
    from appliance.skills.catalogue import load_catalogue

    spec = load_catalogue(skills).images.get(name)
    full = name if spec is None else reference(spec, PoolConfig())

    async def go() -> None:
        async with FleetClient(where.endpoint()) as client:
            target = gateway or await client.gateway()
            found = await client.image_fetch(target, full, source, why=why)
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
    return Exit.DONE if all(check.ok or not check.required for check in checks) else Exit.MISSING
