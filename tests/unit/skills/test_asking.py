"""Handlers that ask people: `ask` and `wait_for`."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

Make = Callable[..., Any]
Load = Callable[..., ModuleType]


def test_ask_returns_what_was_answered(make_ctx: Make, handler: Load) -> None:
    """The question goes to whom the plan names, and the answer is the result's text."""
    ctx = make_ctx(question="Which box?", to="ann")
    ctx.said = "the red one"
    assert handler("ask").run(ctx)["text"] == "the red one"
    assert ctx.questions == [("ann", "Which box?")]


def test_an_event_is_confirmed_by_a_person(make_ctx: Make, handler: Load) -> None:
    """Yes ends the wait; no fails it with the reason."""
    ctx = make_ctx(event="the truck arrives")
    assert handler("wait_for").run(ctx)["confirmed"] is True
    assert "waits for: the truck arrives" in ctx.questions[0][1]
    ctx = make_ctx(event="the truck arrives")
    ctx.said = "no"
    with pytest.raises(ctx.Fail, match="it has not happened"):
        handler("wait_for").run(ctx)


@pytest.mark.parametrize("event", ["0 s", "0.01 seconds", "0 minutes"])
def test_a_time_is_waited_for_without_asking(make_ctx: Make, handler: Load, event: str) -> None:
    """A number of seconds or minutes needs nobody."""
    ctx = make_ctx(event=event)
    assert "waited_s" in handler("wait_for").run(ctx)
    assert not ctx.questions


def test_too_long_is_refused(make_ctx: Make, handler: Load) -> None:
    """With what to do instead."""
    ctx = make_ctx(event="20 minutes")
    with pytest.raises(ctx.Fail, match="longer than"):
        handler("wait_for").run(ctx)
