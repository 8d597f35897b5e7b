"""Site files: `swiftbot site check` and `swiftbot site show`."""

import math
from itertools import combinations
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter
from msgspec import Struct
from rich.console import Group
from rich.table import Table
from rich.text import Text

from appliance.cli.common import HERE, TOOLS, Json, Where, show
from appliance.errors import Exit
from appliance.estimate import unreachable
from appliance.model import Site
from appliance.skills.sites import load_site
from appliance.tui.widgets.map import areas_of, draw

site_app = App(name="site", help="Check and show site files: places, obstacles, fence, limits.", group=TOOLS)
NEAR_M = 0.5
"""Two places nearer than this are one to a robot."""
MAP = (78, 20)
"""Columns and lines of the map."""


def add_to(app: App) -> None:
    """Add this group."""
    app.command(site_app)


class SiteChecked(Struct, frozen=True, kw_only=True):
    """What a check of a site file found."""

    site: str
    """Its name, as the file gives it."""
    places: int
    warnings: tuple[str, ...]


@site_app.command(name="check")
def site_check(file: Path, /, *, as_json: Json = False) -> int:
    """Check a site file. Exit code 5: it cannot be loaded, with file and key; 1: it loads, with warnings.

    A gateway that is given a file with errors does not start. Warnings are a missing fence, places that no robot on the
    ground can reach, or from which none can return along one-way aisles, and places that lie on each other.

    Args:
        file: TOML file such as yard.toml, or the name of a site that comes with the product.
    """
    site = load_site(str(file))
    found = SiteChecked(site=site.name, places=len(site.places), warnings=tuple(warnings(site)))
    lines = [
        f"{site.name}: {len(site.places)} places, {len(site.obstacles)} obstacles, {len(site.forbidden)} forbidden"
        + (f", {len(site.aisles)} one-way aisles" if site.aisles else "")
    ]
    lines += [f"warning: {each}" for each in found.warnings] or ["no errors, no warnings"]
    show(found, as_json=as_json, table=Text("\n".join(lines)))
    return Exit.FAILED if found.warnings else Exit.DONE


def warnings(site: Site) -> list[str]:
    """Return what a site allows and is most likely a mistake."""
    found = [] if site.fence is not None else ["no [fence]: points far outside the site are taken for valid"]
    found += [
        f"{one} and {other} are {distance:.2f} m apart"
        for (one, a), (other, b) in combinations(site.places.items(), 2)
        if (distance := math.hypot(a.x - b.x, a.y - b.y)) < NEAR_M and abs(a.z - b.z) < NEAR_M
    ]
    return found + list(unreachable(site))


@site_app.command(name="show")
async def site_show(
    file: Annotated[Path | None, Parameter(help="TOML file or built-in site; the fleet's site if not given.")] = None,
    /,
    *,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Show the site of the fleet, or of a file: a map, its places, fence and limits."""
    if file is not None:
        site = load_site(str(file))
    else:
        async with where.client() as client:
            site = await client.site()
    show(site, as_json=as_json, table=site_text(site))
    return Exit.DONE


def site_text(site: Site) -> Group:
    """Return a site as a map, its limits, and a table of its places."""
    places = {name: (each.x, each.y) for name, each in site.places.items()}
    lines = draw((), *MAP, places=places, areas=areas_of(site))
    scale = lines[-1].plain.partition("N↑")[0]
    picture = Text("\n").join([*(Text.assemble(*line.pieces) for line in lines[:-1]), Text(f"{scale}N↑", "dim")])
    fence = site.fence
    extent = f"x {fence.x[0]:g} to {fence.x[1]:g} m, y {fence.y[0]:g} to {fence.y[1]:g} m" if fence else "none"
    facts = Text(
        f"{site.name} at {site.latitude_deg:.6f}, {site.longitude_deg:.6f}, {site.altitude_m:g} m\n"
        f"fence: {extent}; speed up to {site.speed_limit_mps:g} m/s, height up to {site.altitude_limit_m:g} m"
    )
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for title in ("place", "x y z", "also called"):
        table.add_column(title, overflow="fold")
    for name, each in sorted(site.places.items()):
        table.add_row(Text(name), f"{each.x:.1f} {each.y:.1f} {each.z:.1f}", Text(", ".join(each.aliases)))
    return Group(picture, facts, table)
