"""Places of the site: `swiftbot place …`. `open` is made from the registry of operations."""

from typing import Annotated

from cyclopts import App, Parameter
from msgspec import Struct
from rich.table import Table
from rich.text import Text

from appliance.cli.common import HERE, WORK, Json, Where, Why, show
from appliance.errors import Exit
from appliance.times import until_of

place_app = App(name="place", help="List the places of the site, close and open them.", group=WORK)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(place_app)


class PlaceShown(Struct, frozen=True, kw_only=True):
    """A place of the site."""

    name: str
    x: float
    """Site coordinates, metres."""
    y: float
    aliases: tuple[str, ...] = ()
    closed: str | None = None
    """Who has closed it, why and until when, in words; null: it is open."""


@place_app.default
@place_app.command(name="list")
async def place_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the places of the site, and which are closed."""
    async with where.client() as client:
        site = await client.site()
        closed = {each.name: each.text for each in (await client.closures()).closures if each.kind == "place"}
    found = [
        PlaceShown(name=name, x=each.x, y=each.y, aliases=each.aliases, closed=closed.get(name))
        for name, each in sorted(site.places.items())
    ]
    show(found, as_json=as_json, table=place_table(found) if found else "the site has no places")
    return Exit.DONE


def place_table(places: list[PlaceShown]) -> Table:
    """Places, a line each."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("place", "x y", "also called", "state"):
        table.add_column(name, overflow="fold")
    for each in places:
        state = Text(each.closed, style="yellow") if each.closed else Text("open")
        table.add_row(each.name, f"{each.x:.1f} {each.y:.1f}", ", ".join(each.aliases), state)
    return table


@place_app.command(name="close")
async def place_close(
    place: str,
    /,
    *,
    until: Annotated[str, Parameter(help="When it opens by itself: 14:00, 2026-12-01, or a duration such as 2h.")] = "",
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Close a place: no plan goes there, and subtasks that have not begun wait until it is open.

    A robot that is there, or on its way, is not stopped: `swiftbot stop` does that.

    Args:
        place: Its name on the site, or an alias.
    """
    until_ns = until_of(until)
    async with where.client() as client:
        closed = await client.close_place(place, until_ns=until_ns, why=why)
    show(closed, as_json=as_json, table=f"{closed.name} is {closed.text}")
    return Exit.DONE
