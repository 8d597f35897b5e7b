"""Images that skills run in: `swiftbot images …`."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, TOOLS, Json, Skills, Where, Why, show

images_app = App(name="images", help="Build, list and fetch the images that skills run in.", group=TOOLS)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(images_app)


@images_app.command(name="build")
async def images_build(
    names: tuple[str, ...] = (),
    /,
    *,
    skills: Skills = (),
    wheelhouse: Annotated[
        tuple[Path, ...],
        Parameter(help="Folder of wheels for requirements.txt; before wheelhouse/ beside it."),
    ] = (),
    force: bool = False,
    as_json: Json = False,
) -> int:
    """Build the images that skills run in, from Debian packages and wheels; existing ones are kept.

    Args:
        names: Which; all but those built on demand (such as learn) if not given.
        skills: Folder with further skills and images.
        wheelhouse: Folder of wheels.
        force: Build even if present.
        as_json: Print JSON: the reference of each image by its name.
    """
    from appliance.pool.images import build
    from appliance.skills.catalogue import load_catalogue

    catalogue = load_catalogue(skills)

    built: dict[str, str] = {}
    for name in names or tuple(name for name, spec in catalogue.images.items() if not spec.on_demand):
        built[name] = await build(
            name, catalogue, progress=console.err.print, force=force, wheelhouses=tuple(wheelhouse)
        )
        if not as_json:
            console.out.print(built[name])
    if as_json:
        show(built, as_json=True)
    return 0


@images_app.command(name="list")
async def images_list(
    *,
    skills: Skills = (),
    gateways: bool = False,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """List the images of the catalogue and whether they are built.

    Args:
        skills: Folder with further skills and images.
        gateways: Also show which gateways of a fleet have each.
    """
    from msgspec.structs import replace

    from appliance.pool.images import list_images
    from appliance.skills.catalogue import load_catalogue

    found = await list_images(load_catalogue(skills))
    if gateways:
        async with where.client() as client:
            await client.gateway()
            found = [replace(each, gateways=client.image_holders(each.reference)) for each in found]
    show(found, as_json=as_json, table=console.image_table(found, gateways=gateways))
    return 0


@images_app.command(name="fetch")
async def images_fetch(
    name: str,
    /,
    *,
    source: Annotated[str, Parameter(name="--from", help="Gateway to ask first; else any that has it.")] = "",
    skills: Skills = (),
    gateway: Annotated[str, Parameter(help="Gateway that fetches it; else the one that is linked to.")] = "",
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Fetch an image to a gateway from another: only missing layers, without a registry.

    Args:
        name: An image of the catalogue, such as base, or a full reference.
        source: Gateway to ask first.
        skills: Folder with further skills and images.
        gateway: Gateway that fetches it.
    """
    from appliance.pool.images import reference
    from appliance.pool.settings import PoolConfig
    from appliance.skills.catalogue import load_catalogue

    spec = load_catalogue(skills).images.get(name)
    full = name if spec is None else reference(spec, PoolConfig())

    async with where.client() as client:
        target = gateway or await client.gateway()
        found = await client.image_fetch(target, full, source, why=why)
    show(found, as_json=as_json, table=console.brought_text(found, target))
    return 0
