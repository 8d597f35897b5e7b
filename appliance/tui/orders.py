"""What the terminal UI asks of a fleet for a person: one coroutine an order, each ending in a sentence.

They take the arguments as typed and raise `SwiftbotError` with a remedy, like the command line, whose client they use.
"""

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from appliance.client import FleetClient
from appliance.errors import PayloadError
from appliance.pool.api import Evicted, WarmAsk
from appliance.tui.action import Given
from appliance.tui.drawing import clock, counted
from appliance.tui.safe import safe

WARM_WAIT_S = 30.0
MOST_WARM = 100


def number(given: Given, name: str, default: int, *, least: int, most: int) -> int:
    """Return a whole number that was given; PayloadError when it is none or out of range."""
    text = given.get(name, "")
    if not text:
        return default
    if not text.isdecimal() or not least <= int(text[:9]) <= most:
        raise PayloadError(f"{name} {text[:20]!r}", remedy=f"give a whole number from {least} to {most}")
    return int(text)


def _why(given: Given) -> str:
    return given.get("why", "")


# --- the audit ----------------------------------------------------------------------------------------------


async def acts(fleet: FleetClient, given: Given, _by: str) -> RenderableType:
    """Tell what operators ordered lately, and what came of it."""
    found, silent = await fleet.acts(number(given, "count", 50, least=1, most=500))
    table = Table(box=None, pad_edge=False)
    for title in ("at", "who", "what", "of", "outcome", "why"):
        table.add_column(title, overflow="fold")
    for each in found:
        outcome = each.outcome if not each.problem else f"{each.outcome}: {each.problem}"
        cells = (each.by, each.verb, each.target, outcome, each.why)
        table.add_row(clock(each.at_ns), *(Text(safe(cell, 200)) for cell in cells))
    lines = [Text(f"{safe(name, 63)} did not tell: {safe(error.message)}", "yellow") for name, error in silent.items()]
    return Group(table if found else Text("no orders yet", "dim"), *lines)


# --- gateways ------------------------------------------------------------------------------------------------


async def drain(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway give its runs away and take no more."""
    state = await fleet.drain(given["gateway"], 0.0, why=_why(given))
    return f"{state.gateway} drains: {counted(len(state.left), 'run')} left"


async def undrain(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway take runs again."""
    state = await fleet.undrain(given["gateway"], why=_why(given))
    return f"{state.gateway} takes runs again"


async def swap(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway plan with another local model."""
    swapped = await fleet.swap_model(given["gateway"], given["folder"], why=_why(given))
    return f"{given['gateway']} plans with {swapped.after} instead of {swapped.before}"


# --- pools ---------------------------------------------------------------------------------------------------


async def warm(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have containers of an image ready."""
    count = number(given, "count", 1, least=1, most=MOST_WARM)
    name = given.get("gateway") or await fleet.gateway()
    ask = WarmAsk(image=given["image"], count=count, wait_s=WARM_WAIT_S, why=_why(given))
    found = await fleet.pool_warm(name, ask)
    problem = f"; {found.problem}" if found.problem else ""
    return f"{name}: {found.ready} of {found.image} ready, {found.starting} starting{problem}"


async def evict(fleet: FleetClient, given: Given, _by: str) -> str:
    """Give up a container, or all idle ones of an image."""
    answers = await fleet.pool_evict(given["container"], given.get("gateway", ""), why=_why(given))
    return "; ".join(_evicted(name, answers[name]) for name in sorted(answers))


def _evicted(gateway: str, answer: Evicted) -> str:
    kept = "".join(f", kept {name}: {why}" for name, why in sorted(answer.kept.items()))
    note = f" ({answer.note})" if answer.note else ""
    return f"{gateway}: {len(answer.containers)} given up{kept}{note}"


async def release(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have an image started again that is in quarantine."""
    found = await fleet.pool_release(given["image"], given.get("gateway", ""), why=_why(given))
    return "; ".join(f"{each}: started again, it was left alone: {found[each].reason}" for each in sorted(found))


async def fetch(fleet: FleetClient, given: Given, _by: str) -> str:
    """Have a gateway bring an image to itself."""
    brought = await fleet.image_fetch(given["gateway"], given["reference"], why=_why(given))
    whence = f" from {brought.gateway}" if brought.gateway else ": it was there already"
    return f"{brought.what} is on {given['gateway']}{whence}"
