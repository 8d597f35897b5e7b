"""Orders carry why they are given, and whatever the terminal UI can do is a command of the command line as well."""
# pyright: basic, reportArgumentType=false, reportAttributeAccessIssue=false

import inspect
from typing import TYPE_CHECKING, cast, get_args

import pytest

from appliance.cli import app
from appliance.model.keyspace import VERBS
from appliance.model.learn_api import Steering
from appliance.model.planner_api import Swapped
from appliance.model.pool_api import Evicted, Released, Warmed
from appliance.model.robot_api import StopAnswer
from appliance.model.task_api import DrainState, Migrated
from appliance.model.transfer_api import Brought
from appliance.operations import OPERATIONS, audit_name
from appliance.tui import command_line
from appliance.tui.actions import ACTIONS, SCREENS

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
    ("uncordon gw-a a visitor", "undrain", DRAINING),
    ("warm base 2 gw-b a visitor", "pool_warm", Warmed(image="base", ready=2, starting=0)),
    ("evict c1 gw-a a visitor", "pool_evict", {"gw-a": Evicted(containers=("c1",))}),
    ("release base gw-a a visitor", "pool_release", {"gw-a": Released(image="base", reason="it died")}),
    ("fetch localhost/x:1 gw-b a visitor", "image_fetch", Brought(what="image/x")),
    ("swap-model gw-a /m a visitor", "swap_model", Swapped(before="old", after="new", ms=1.0, tests=())),
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
        assert command.action.sentence(command.given).endswith("Reason: a visitor")
    await command.action.run(cast("FleetClient", view.orders), command.given)
    (asked,) = view.orders.of(verb)
    told = [getattr(each, "why", None) for each in asked] + [view.orders.options.get(verb, {}).get("why")]
    assert "a visitor" in told


def test_orders_that_change_something_take_why() -> None:
    """Every order of the registry that a gateway audits can be given a reason; an answer is its own."""
    without = {action.name for action in ACTIONS if action.writes and "why" not in {each.name for each in action.takes}}
    assert without == {
        "submit",
        "duplicate",
        "answer",
        "release-robot",
        "put-down",
        "bring-back",
        "schedule-add",
        "add-rule",
    }


async def test_a_name_written_wrongly_does_not_stop_nobody(view: "FakeView") -> None:
    """`:stop` with words that name no robot stops them all, and the words are why."""
    view.orders.answers["stop"] = StopAnswer(stops=())
    command = command_line.read("stop rovr-1 is too fast", {})
    outcome = await command.action.run(cast("FleetClient", view.orders), command.given)
    assert "soft stop of the fleet" in str(outcome.text)
    assert view.orders.of("stop") == [((),)]
    assert view.orders.options["stop"] == {"why": "rovr-1 is too fast"}


SCREENED = {
    "overview": "alerts list", "fleet": "fleet", "tasks": "task list", "robots": "robots list", "pool": "pool list",
    "llm": "fleet", "learning": "learn list", "log": "task watch", "replay": "log replay",
}  # fmt: skip
"""Commands that show what a screen does."""
ONLY_HERE = {
    "hold": "task pause",
    "retry-subtask": "task retry",
    "stop-robot": "stop",
    "resume-all": "resume",
    "ack-all": "alerts ack",
    "learn-start": "learn start",
    "end-maintenance": "robots maintain",
}
"""Commands that do what these operations do with other arguments; plans are edited as files (`task approve --plan`)."""


def test_audited_operations_are_verbs_of_gateways() -> None:
    """The audit log's verbs are in the table of keys, and each is shown as the command that gives it."""
    verbs = {operation.audit for operation in OPERATIONS if operation.audit}
    # Verbs that are audited by what they do.
    apart = {f"learn_{do}" for do in get_args(Steering)} | {
        "place_close",
        "place_open",
        "robot_maintain",
        "robot_maintain_end",
        "rule_add",
        "rule_remove",
    }
    apart |= {"schedule_pause", "schedule_resume", "schedule_remove"}
    assert verbs <= {verb.name for verb in VERBS} | apart
    assert {operation.name for operation in OPERATIONS if operation.writes and not operation.audit} == set()
    assert (audit_name("undrain"), audit_name("control_take"), audit_name("else")) == (
        "uncordon",
        "robots takeover",
        "else",
    )


def test_everything_is_a_command_too() -> None:
    """Whatever asks something of the fleet, and each screen of it, is a command with --json."""
    commands = {operation.name or operation.command: operation.command for operation in OPERATIONS}
    assert {name for name, command in commands.items() if not command} == ONLY_HERE.keys()
    assert SCREENED.keys() == set(SCREENS)
    assert {action.name for action in ACTIONS if action.writes} <= commands.keys()
    for command in {*filter(None, commands.values()), *SCREENED.values(), *ONLY_HERE.values()}:
        found = app
        for word in command.split():
            found = found[word]
        assert callable(found.default_command), command
        assert "as_json" in inspect.signature(found.default_command).parameters, command
    assert "plan" in inspect.signature(app["task"]["approve"].default_command).parameters
