"""Standing rules: `swiftbot rules …`. `remove` is made from the registry of operations."""

import asyncio
import re
from typing import Annotated, Literal

from cyclopts import App, Parameter
from rich.table import Table

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, on_terminal, show
from appliance.errors import ConfigError, Exit
from appliance.model.closures import DAY_MIN, DAYS, Closure, Rule
from appliance.model.steering import MAX_WHY
from appliance.operations import read_rule
from appliance.schedules import due
from appliance.times import until_of

rules_app = App(name="rules", help="List, add and remove standing rules: what robots never do.", group=WORK)

_CLOCK = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)|24:00")


def add_to(app: App) -> None:
    """Add this group."""
    app.command(rules_app)


@rules_app.default
@rules_app.command(name="list")
async def rules_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the standing rules: what they say, who added them, why and until when."""
    async with where.client() as client:
        found = (await client.closures()).rules
    show(list(found), as_json=as_json, table=rules_table(found) if found else "there are no standing rules")
    return Exit.DONE


def rules_table(rules: tuple[Closure, ...]) -> Table:
    """Rules, a line each."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("id", "rule"):
        table.add_column(name, overflow="fold")
    for each in rules:
        table.add_row(each.name, each.text)
    return table


@rules_app.command(name="add")
async def rules_add(
    text: str = "",
    /,
    *,
    robot: Annotated[tuple[str, ...], Parameter(help="A robot it is for; repeatable. None: all of --group.")] = (),
    group: Annotated[Literal["all", "flying", "ground"], Parameter(help="Robots it is for.")] = "all",
    place: Annotated[tuple[str, ...], Parameter(help="A place they never go to; repeatable.")] = (),
    thing: Annotated[
        tuple[str, ...], Parameter(help='What they never take up, such as "glass", or anything; repeatable.')
    ] = (),
    begin: Annotated[str, Parameter(name="--from", help="Each day from this time: 22:00.")] = "",
    end: Annotated[str, Parameter(name="--to", help="Each day to this time, if earlier on the next day: 06:00.")] = "",
    day: Annotated[
        tuple[Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"], ...],
        Parameter(help="On this day of the week only; repeatable."),
    ] = (),
    zone: Annotated[str, Parameter(help="Time zone, such as Europe/Zurich; this machine's if not given.")] = "",
    until: Annotated[str, Parameter(help="When it ends by itself: 14:00, 2026-12-01, or a duration such as 2h.")] = "",
    yes: Annotated[bool, Parameter(name=("--yes", "-y"), help="Add what TEXT says without asking.")] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Add a standing rule: what some robots, or all, never do, always or at some times of the day.

    It is said by options or in words ("no drone enters the aisle after 18:00"). Words are read back as the rule that
    they are, and added when that is confirmed, or with --yes; what no rule says whole is refused with the reason.

    A plan against it is refused whoever made it, and a subtask of an earlier plan that has not begun waits. What has
    begun is not stopped: `swiftbot stop` does that. Without --place and --thing, at these times no subtask begins on
    these robots at all. A robot that passes a place on its way elsewhere is not kept from it. The same rule again is
    the same rule, with the new reason and end.

    Args:
        text: The rule in words, instead of the options that say it.
    """
    if text:
        if robot or group != "all" or place or thing or begin or end or day:
            raise ConfigError(
                "a rule is said in words or by options", remedy="leave one of them out; --zone goes with both"
            )
        async with where.client() as client:
            rule = await read_rule(client, text, zone or due.local_zone())
            if not yes and not await _confirmed(rule):
                console.err.print("no rule was added")
                return Exit.CANCELLED
            added = await client.add_rule(rule, until_ns=until_of(until), why=why or text[:MAX_WHY])
        show(added, as_json=as_json, table=f"added {added.name}: {added.text}")
        return Exit.DONE
    try:
        rule = Rule(
            robots=robot, group=group, places=place, things=thing,
            begin_min=_minute("--from", begin) % DAY_MIN if begin else 0,
            end_min=(_minute("--to", end) or DAY_MIN) if end else DAY_MIN,
            days=tuple(sorted(DAYS.index(each) for each in set(day))),
            zone=zone or (due.local_zone() if begin or end or day else "UTC"),
        )  # fmt: skip
    except ValueError as error:
        remedy = "give --place or --thing, or --from, --to and --day alone"
        raise ConfigError(str(error), remedy=remedy) from error
    if robot and group != "all":
        raise ConfigError("--robot and --group do not go together", remedy="leave --group out")
    async with where.client() as client:
        added = await client.add_rule(rule, until_ns=until_of(until), why=why)
    show(added, as_json=as_json, table=f"added {added.name}: {added.text}")
    return Exit.DONE


async def _confirmed(rule: Rule) -> bool:
    """Read a rule back and ask whether it is meant; the fleet is heard meanwhile."""
    if not on_terminal():
        raise ConfigError(f"read as: {rule.text}", remedy="add it with --yes")
    question = f"{rule.text}\nAdd this rule? [y]es, [N]o: "
    try:
        said = await asyncio.to_thread(console.out.input, question, markup=False, emoji=False)
    except EOFError:
        console.out.print()
        return False
    return said.strip().casefold() in ("y", "yes")


def _minute(option: str, text: str) -> int:
    found = _CLOCK.fullmatch(text.strip())
    if found is None:
        raise ConfigError(f"{option} {text[:20]!r} is no time of day", remedy="write it like 06:00 or 22:30")
    return int(found[1]) * 60 + int(found[2]) if found[1] else DAY_MIN
