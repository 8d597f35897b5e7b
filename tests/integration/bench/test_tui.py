"""The measurement of the terminal UI on a small fleet: real puts, a UI in a process of its own, keys painted."""

import pytest

from workshop.bench.tui.run import run

pytestmark = pytest.mark.anyio


async def test_keys_are_painted_while_the_fleet_is_busy() -> None:
    """All facts arrive, keys have their effect, changes keep being taken; figures of time, CPU and memory are there."""
    result = await run(seconds=4.0, gateways=12, robots=20, tasks=40, rate=200, plain=False, progress=lambda _: None)
    ui = result["ui"]
    assert ui["known"] == {"gateways": 12, "robots": 20, "tasks": 40, "containers": 48}
    assert ui["key_to_paint_ms"]["count"] > 0
    assert ui["keys_without_effect"] == 0
    assert ui["changes_taken_per_s"] > 0
    assert ui["cpu_share_of_a_core"] > 0
    assert ui["memory_mb"]
    assert set(result) == {"fleet", "terminal", "cores", "seconds", "targets", "ui"}
