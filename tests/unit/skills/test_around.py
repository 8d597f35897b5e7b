"""Handlers that do something with doors, devices and people, against a fake robot."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

Make = Callable[..., Any]
Load = Callable[..., ModuleType]


@pytest.mark.parametrize("skill", ["open", "close", "switch_on", "switch_off"])
def test_a_thing_is_turned_by_one_order(make_ctx: Make, handler: Load, skill: str) -> None:
    """The order has the skill's name and the thing's, and its outcome is the result; without a thing none is given."""
    ctx = make_ctx(object="  office   door ")
    assert handler(skill).run(ctx) == {"did": skill, "object": "office door"}
    assert ctx.commands == [(skill, {"object": "office door"})]
    assert ctx.steps[-1][0] == 1.0
    ctx = make_ctx()
    with pytest.raises(ctx.Fail, match="'object' is missing"):
        handler(skill).run(ctx)
    assert ctx.commands == []


def test_give_names_thing_and_person(make_ctx: Make, handler: Load) -> None:
    """Who has it now is who the robot says has it."""
    ctx = make_ctx(object="red box", to="Ann")
    ctx.answers["give"] = lambda args: {"to": args["to"].lower()}
    assert handler("give").run(ctx) == {"object": "red box", "to": "ann", "given_to": "ann"}
    assert ctx.commands == [("give", {"object": "red box", "to": "Ann"})]


def test_say_addresses_somebody_and_has_a_bound(make_ctx: Make, handler: Load) -> None:
    """A name comes first; too long a text is refused before anything is said."""
    ctx = make_ctx(text="mind your heads", to="everybody")
    assert handler("say").run(ctx)["said"] == "everybody: mind your heads"
    assert ctx.sent("say") == [{"text": "everybody: mind your heads"}]
    ctx = make_ctx(text="x" * 400)
    with pytest.raises(ctx.Fail, match="400 characters"):
        handler("say").run(ctx)
    assert ctx.commands == []


def test_guide_speaks_leads_and_speaks(make_ctx: Make, handler: Load) -> None:
    """It speaks before and after, and goes no faster than people walk."""
    ctx = make_ctx(person="Ann", place="dock 3")
    result = handler("guide").run(ctx)
    assert [verb for verb, _ in ctx.commands] == ["say", "state", "goto", "say"]
    assert ctx.sent("goto")[0]["speed_mps"] == 1.0
    assert (result["person"], result["place"]) == ("Ann", "dock 3")
    assert "follow me to dock 3" in ctx.sent("say")[0]["text"]


def test_dock_drives_to_the_charger_or_the_station_named(make_ctx: Make, handler: Load) -> None:
    """Without a station it is the charger; a robot that flies hears what to do instead, and stays."""
    ctx = make_ctx()
    ctx.info["battery_percent"] = 71.0
    result = handler("dock").run(ctx)
    assert (result["place"], result["battery_percent"]) == ("charger", 71.0)
    assert handler("dock").run(make_ctx(station="dock 2"))["place"] == "dock 2"
    ctx = make_ctx()
    ctx.info["flies"] = True
    with pytest.raises(ctx.Fail, match="docks are for those that drive"):
        handler("dock").run(ctx)
    assert "goto" not in [verb for verb, _ in ctx.commands]
