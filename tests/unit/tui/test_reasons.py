"""Orders carry why they are given, and whatever the terminal UI can do is a command of the command line as well."""

import inspect
from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

import pytest

from appliance.cli import app
from appliance.pool.api import Evicted, Released, Warmed
from appliance.pool.transfer.protocol import Brought
from appliance.robots.api import StopAnswer
from appliance.tasks.api import DrainState, Migrated
from appliance.tui import command_line
from appliance.tui.actions import ACTIONS, BY_NAME, SCREENS

from .conftest import RUNNING

if TYPE_CHECKING:
    from appliance.client import FleetClient

    from .conftest import FakeView

pytestmark = pytest.mark.anyio
DRAINING = DrainState(gateway="gw-a", draining=True, done=False, moved=0, ended=0, left=())
WITH_WHY = [
    ("cancel t-running a visitor", "cancel", RUNNING),
    ("migrate t-running/s2 gw-b a visitor", "migrate", Migrated(task="t", subtask="s2", moved=True)),
    ("drain gw-a a visitor", "drain", DRAINING),
    ("undrain gw-a a visitor", "undrain", DRAINING),
    ("warm base 2 gw-b a visitor", "pool_warm", Warmed(image="base", ready=2, starting=0)),
    ("evict c1 gw-a a visitor", "pool_evict", {"gw-a": Evicted(containers=("c1",))}),
    ("release base gw-a a visitor", "pool_release", {"gw-a": Released(image="base", reason="it died")}),
    ("fetch localhost/x:1 gw-b a visitor", "image_fetch", Brought(what="image/x")),
    ("swap-model gw-a /m a visitor", "swap_model", SimpleNamespace(before="old", after="new")),
    ("stop-robot drone-1 a visitor", "stop", StopAnswer(stops=())),
    ("stop drone-1 a visitor", "stop", StopAnswer(stops=())),
    ("resume-robots drone-1 a visitor", "resume_robots", StopAnswer(stops=())),
    ("resume-all a visitor", "resume_robots", StopAnswer(stops=())),
    ("pause t-running a visitor", "pause", RUNNING),
    ("hold t-running a visitor", "pause", RUNNING),
    ("resume t-running a visitor", "resume", RUNNING),
    ("retry t-running a visitor", "retry", RUNNING),
    ("retry-subtask t-running/s3 a visitor", "retry", RUNNING),
]


@pytest.mark.parametrize(("line", "verb", "answer"), WITH_WHY, ids=[each[0].split()[0] for each in WITH_WHY])
async def test_why_goes_along_with_an_order(view: "FakeView", line: str, verb: str, answer: object) -> None:
    """What follows on the line is why, for the audit, whatever is ordered; a question shows it before the yes."""
    view.orders.answers[verb] = answer
    command = command_line.read(line, {})
    assert command.given["why"] == "a visitor"
    if command.action.dangerous:
        assert command.action.sentence(command.given).endswith("Why: a visitor")
    assert command.action.do is not None
    await command.action.do(cast("FleetClient", view.orders), command.given, "ann")
    (asked,) = view.orders.of(verb)
    told = [getattr(each, "why", None) for each in asked] + [view.orders.options.get(verb, {}).get("why")]
    assert "a visitor" in told


def test_orders_that_change_something_take_why() -> None:
    """Every order of the registry that a gateway audits can be given a reason; an answer is its own."""
    without = {action.name for action in ACTIONS if action.writes and "why" not in {each.name for each in action.takes}}
    assert without == {"submit", "answer"}


async def test_a_name_written_wrongly_does_not_stop_nobody(view: "FakeView") -> None:
    """`:stop` with words that name no robot stops them all, and the words are why."""
    view.orders.answers["stop"] = StopAnswer(stops=())
    command = command_line.read("stop rovr-1 is too fast", {})
    assert command.action.do is not None
    told = await command.action.do(cast("FleetClient", view.orders), command.given, "ann")
    assert "soft stop of the fleet" in str(told)
    assert view.orders.of("stop") == [((),)]
    assert view.orders.options["stop"] == {"why": "rovr-1 is too fast"}


COMMANDS = {
    "submit": "submit", "cancel": "task cancel", "why": "task why", "migrate": "task migrate", "review": "task show",
    "pause": "task pause", "hold": "task pause", "resume": "task resume", "retry": "task retry",
    "retry-subtask": "task retry", "approve": "task approve", "reject": "task reject",
    "takeover": "robots take", "give-back": "robots give", "answer": "answer",
    "stop": "stop", "stop-robot": "stop", "resume-robots": "resume",
    "resume-all": "resume", "acts": "acts",
    "drain": "drain", "undrain": "undrain", "swap-model": "llm swap",
    "warm": "pool warm", "evict": "pool evict", "release": "pool release", "fetch": "images fetch",
    "fleet": "fleet", "tasks": "task list", "robots": "robots list", "pool": "pool list", "llm": "fleet",
    "log": "task watch", "replay": "log replay",
}  # fmt: skip
"""Commands of the command line by the action that does the same; plans are edited as files (`task approve --plan`)."""


def test_everything_is_a_command_too() -> None:
    """Whatever asks something of the fleet, and each screen of it, is a command with --json."""
    asking = {action.name for action in ACTIONS if action.do is not None or action.writes}
    screens = set(SCREENS) - {"learning"}  # there are no rounds that a command could tell of
    assert asking | screens <= COMMANDS.keys() <= BY_NAME.keys()
    for command in {
        *COMMANDS.values(),
        "task check",
        "robots move",
        "robots renew",
        "asks",
        "standing",
        "pool decisions",
    }:
        found = app
        for word in command.split():
            found = found[word]
        assert callable(found.default_command), command
        assert "as_json" in inspect.signature(found.default_command).parameters, command
    assert "plan" in inspect.signature(app["task"]["approve"].default_command).parameters
