"""The planner's queue: bounded, fair, and clear to those who find it full."""

import asyncio

import pytest

from appliance.errors import RefusedError
from appliance.llm.routing import Gate

pytestmark = pytest.mark.anyio


async def test_beyond_the_queue_is_refused_with_a_time() -> None:
    """Two inside, two wait, the fifth is refused at once with when to ask again; all others have their turn."""
    gate, go = Gate(at_once=2, waiting=2), asyncio.Event()
    done: list[int] = []

    async def one(number: int) -> None:
        async with gate.turn():
            await go.wait()
            done.append(number)

    tasks = [asyncio.create_task(one(number)) for number in range(4)]
    while gate.waiting < 2:
        await asyncio.sleep(0)
    with pytest.raises(RefusedError, match="2 instructions wait") as caught:
        async with gate.turn():
            pass
    assert caught.value.retry_after_s > 0
    assert gate.refused == 1
    go.set()
    await asyncio.gather(*tasks)
    assert sorted(done) == [0, 1, 2, 3]
    assert (gate.inside, gate.waiting) == (0, 0)


async def test_who_goes_away_leaves_no_place_taken() -> None:
    """A cancelled instruction, inside or waiting, frees its place."""
    gate = Gate(at_once=1, waiting=5)

    async def hold() -> None:
        async with gate.turn():
            await asyncio.Event().wait()

    tasks = [asyncio.create_task(hold()) for _ in range(3)]
    while gate.waiting < 2:
        await asyncio.sleep(0)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    async with gate.turn():
        assert (gate.inside, gate.waiting) == (1, 0)
