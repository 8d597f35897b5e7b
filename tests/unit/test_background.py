"""Tasks that are left running: none is lost, none breaks unseen, all end with what started them."""

import asyncio
from typing import Any

import pytest
from structlog.testing import capture_logs

from appliance.background import Background
from appliance.errors import UnreachableError

pytestmark = pytest.mark.anyio


async def forever() -> None:
    """Wait."""
    await asyncio.Event().wait()


async def broken(error: Exception) -> None:
    """Raise it."""
    raise error


async def test_what_is_started_is_counted_until_it_ends() -> None:
    """And its result is there for a caller that kept the task."""
    background = Background()
    task = background.start(asyncio.sleep(0, "done"), "quick")
    assert (background.count, task.get_name()) == (1, "quick")
    await background.finish(5.0)
    assert (background.count, task.result()) == (0, "done")
    await background.finish(5.0)


async def test_closing_ends_all_and_waits() -> None:
    """One that tidies up when it is cancelled has done so."""
    background, tidied = Background(), asyncio.Event()

    async def tidy() -> None:
        try:
            await forever()
        finally:
            await asyncio.sleep(0)
            tidied.set()

    tasks = [background.start(tidy(), "tidy"), background.start(forever(), "forever")]
    await asyncio.sleep(0)
    await background.close()
    assert tidied.is_set()
    assert all(task.cancelled() for task in tasks)
    assert background.count == 0


@pytest.mark.parametrize(("error", "level"), [(ValueError("a defect"), "error"), (UnreachableError("gone"), "warning")])
async def test_what_breaks_is_logged_at_once(error: Exception, level: str) -> None:
    """A defect with its traceback, a failure that was foreseen with its reason; the others go on."""
    background = Background()
    other = background.start(forever(), "other")
    with capture_logs() as logged:
        background.start(broken(error), "broken")
        while background.count > 1:
            await asyncio.sleep(0)
    lines: list[dict[str, Any]] = [dict(each) for each in logged]
    assert [(line["log_level"], line["task"]) for line in lines] == [(level, "broken")]
    assert not other.done()
    await background.close()
