"""Orders that wait until the record is written: what is known of their attempts meanwhile."""

import asyncio
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.model import Need, RunRequest, SubtaskRecord
from appliance.tasks.context import MoveReady
from appliance.tasks.orders import Orders

OLD = RunRequest(task="t-1", subtask="s1", attempt=1, skill="work", need=Need(image="base"))
NEW = RunRequest(task="t-1", subtask="s1", attempt=2, skill="work", need=Need(image="base"))


def orders() -> Orders:
    """Orders of a task whose first attempt has been ordered."""
    made = Orders(cast("Any", SimpleNamespace()), lambda _news: None)
    made.add("gw-1", OLD)
    return made


def test_an_attempt_is_as_new_as_its_order() -> None:
    """Before its record is written, a new attempt is not taken for one whose order went out with the last one's."""
    made = orders()
    before = time.monotonic()
    made.add("gw-2", NEW)
    assert made.sent_at("s1") >= before
    assert made.silent_since("s1", before) >= before


@pytest.mark.anyio
async def test_a_moved_run_is_not_asked_after_before_it_is_ordered() -> None:
    """Nor one that moves, whose order waits for the run that is left: it was found unknown there, and begun twice."""
    made = orders()
    news = MoveReady(
        subtask="s1", attempt=1, next_attempt=2, gateway="gw-2", why="operator", placed="",
        outcome=asyncio.get_running_loop().create_future(),
    )  # fmt: skip
    before = time.monotonic()
    made.move(news, NEW, left=cast("SubtaskRecord", SimpleNamespace(gateway="gw-1", attempt=1)))
    assert made.sent_at("s1") > before
