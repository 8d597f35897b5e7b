"""The books: those who wait are served in their order, and not asked for in vain."""

import asyncio
from collections import Counter
from pathlib import Path

import pytest

from appliance.model import ContainerInfo, ContainerState, Need
from appliance.pool.books import Books
from appliance.pool.container import PooledContainer
from appliance.pool.settings import PoolConfig

pytestmark = pytest.mark.anyio


def container(name: str, image: str) -> PooledContainer:
    """Return a container that is ready."""
    info = ContainerInfo(id=name, gateway="g1", image=image, state=ContainerState.READY)
    return PooledContainer(info, Path("/nowhere"), on_death=lambda _: None)


async def test_a_long_queue_asks_for_room_once_for_each_need() -> None:
    """With no room, needs that are alike are tried once; one of another image is tried for itself, and all wait on."""
    tried: list[str] = []

    def begin(need: Need) -> PooledContainer | None:
        tried.append(need.image)
        return None

    books = Books(PoolConfig(), begin=begin, on_change=lambda _: None, refused=Counter())
    wanted = [Need(image="base"), Need(image="base"), Need(image="vision"), Need(image="base")]
    waiting = [asyncio.create_task(books.wait(need)) for need in wanted]
    while books.queue < len(wanted):
        await asyncio.sleep(0)
    books.serve()
    assert tried == ["base", "vision"]
    books.add(first := container("c1", "base"))
    books.serve()
    assert await waiting[0] is first
    assert books.queue == 3
    for each in waiting:
        each.cancel()
    await asyncio.gather(*waiting, return_exceptions=True)
