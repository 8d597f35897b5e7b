"""The books: those who wait are served in their order, and not asked for in vain."""

import asyncio
from collections import Counter
from pathlib import Path

import pytest

from appliance.errors import PoolError, RefusedError
from appliance.model import ContainerInfo, ContainerState, Need
from appliance.pool.allocator import FOR_A_RUN, Allocator, WithdrawnError
from appliance.pool.container import PooledContainer
from appliance.pool.fair_queue import Turn
from appliance.pool.manager import glance
from appliance.pool.policies import ColdCosts
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

    books = Allocator(PoolConfig(), begin=begin, on_change=lambda _: None, refused=Counter())
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


NEED = Need(image="base")


def full_books(queue: int = 32) -> Allocator:
    """Return books without a container, and without room for one."""
    return Allocator(PoolConfig(queue=queue), begin=lambda _: None, on_change=lambda _: None, refused=Counter())


async def queued(books: Allocator, *turns: Turn) -> dict[str, "asyncio.Task[PooledContainer]"]:
    """Have them wait, in this order."""
    waiting = {turn.id: asyncio.create_task(books.wait(NEED, turn)) for turn in turns}
    for _ in range(3):
        await asyncio.sleep(0)
    return waiting


async def end(waiting: dict[str, "asyncio.Task[PooledContainer]"]) -> None:
    """Have nobody wait any more."""
    for each in waiting.values():
        each.cancel()
    await asyncio.gather(*waiting.values(), return_exceptions=True)


async def test_a_free_container_goes_to_whose_turn_it_is() -> None:
    """By priority, then in turns between submitters, and not by who came first; positions follow that order."""
    books = full_books()
    waiting = await queued(
        books,
        *(Turn(id=f"flood{number}", submitter="flood") for number in range(3)),
        Turn(id="other", submitter="other"),
        Turn(id="urgent", submitter="flood", priority=9),
    )
    told = [turn.id for turn, _ in books.waiting()]
    assert told[0] == "urgent"
    assert told.index("other") <= 2
    served: list[str] = []
    for number in range(len(waiting)):
        books.add(container(f"c{number}", "base"))
        books.serve()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        served += [name for name, task in waiting.items() if task.done() and name not in served]
    assert served == told


async def test_a_full_queue_turns_away_whoever_would_be_served_last() -> None:
    """A flood that fills the queue makes room for another submitter; one that would be last is refused itself."""
    books = full_books(queue=3)
    waiting = await queued(books, *(Turn(id=f"flood{number}", submitter="flood") for number in range(3)))
    assert not books.would_be_last(Turn(id="other", submitter="other"))
    assert books.would_be_last(Turn(id="flood3", submitter="flood"))
    waiting |= await queued(books, Turn(id="other", submitter="other"))
    with pytest.raises(RefusedError):
        await waiting["flood2"]
    with pytest.raises(RefusedError):
        await books.wait(NEED, Turn(id="flood3", submitter="flood"))
    assert {turn.id for turn, _ in books.waiting()} == {"flood0", "flood1", "other"}
    await end(waiting)


async def test_a_run_is_withdrawn_once_and_only_while_it_waits() -> None:
    """After that it has no container and gets none; one that was served meanwhile stays."""
    books = full_books()
    waiting = await queued(books, Turn(id="a"), Turn(id="b"))
    assert books.withdraw("a")
    assert not books.withdraw("a")
    books.add(container("c1", "base"))
    books.serve()
    assert not books.withdraw("b"), "it has been handed a container"
    with pytest.raises(WithdrawnError):
        await waiting["a"]
    assert (await waiting["b"]).id == "c1"
    assert books.queue == 0


def starting(name: str) -> PooledContainer:
    """Return a container that is being started for a run."""
    found = container(name, "base")
    found.become(ContainerState.STARTING)
    found.reservation = FOR_A_RUN
    return found


async def test_what_comes_free_sooner_than_a_start_is_taken() -> None:
    """Who waits for a start takes what comes free before; what was started is ready for the next when it is there."""
    books, started = full_books(), asyncio.get_running_loop().create_future()
    books.add(other := container("c1", "base"))
    books.busy(other, "run")
    books.add(own := starting("c2"))
    waiting = asyncio.create_task(books.sooner(NEED, None, own, started))
    await asyncio.sleep(0)
    assert books.queue == 0  # it has a container to come: nobody need offer it elsewhere, or turn away others
    assert books.waiting() == []
    books.ready(other)
    assert await waiting is other
    assert (other.info.state, own.reservation) == (ContainerState.RESERVED, "")


async def test_a_start_that_ends_first_is_taken() -> None:
    """The container that was started for a run goes to it when it is the first to be there, and to nobody else."""
    books, started = full_books(), asyncio.get_running_loop().create_future()
    books.add(own := starting("c1"))
    waiting = asyncio.create_task(books.sooner(NEED, None, own, started))
    await asyncio.sleep(0)
    books.hold(own, FOR_A_RUN)
    started.set_result(None)
    assert await waiting is own
    assert own.reservation == FOR_A_RUN
    books.add(other := container("c2", "base"))
    books.serve()
    assert other.info.state is ContainerState.READY


async def test_a_start_that_fails_or_is_given_up_leaves_nothing_held() -> None:
    """A run that waits hears of a failed start; one that goes away gives back what was handed over meanwhile."""
    books, started = full_books(), asyncio.get_running_loop().create_future()
    started.set_result(PoolError("it ended at once"))
    with pytest.raises(PoolError, match="ended at once"):
        await books.sooner(NEED, None, starting("c1"), started)
    books.add(own := starting("c2"))
    books.add(other := container("c3", "base"))
    waiting = asyncio.create_task(books.sooner(NEED, None, own, asyncio.get_running_loop().create_future()))
    await asyncio.sleep(0)
    books.serve()
    assert other.info.state is ContainerState.RESERVED
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    assert (other.info.state, own.reservation) == (ContainerState.READY, "")


async def test_those_without_a_start_are_served_in_turn_with_those_that_have_one() -> None:
    """Who came first gets what comes free, whether a container is starting for him or not; the other is next."""
    books, started = full_books(), asyncio.get_running_loop().create_future()
    books.add(own := starting("c1"))
    first = asyncio.create_task(books.sooner(NEED, None, own, started))
    await asyncio.sleep(0)
    second = asyncio.create_task(books.wait(NEED))
    await asyncio.sleep(0)
    assert books.queue == 1
    books.add(free := container("c2", "base"))
    books.serve()
    assert await first is free
    assert not second.done()
    books.ready(own)  # its start has ended
    assert await second is own


async def test_the_planner_sees_who_has_a_container_for_long() -> None:
    """A run that takes longer than a start of its image is distinguished from one that has just begun."""
    books, costs = full_books(), ColdCosts(500.0)
    for name in ("c1", "c2"):
        books.add(each := container(name, "base"))
        books.busy(each, f"run of {name}")
    each.busy_since -= 0.6
    view = glance(books, costs, now=each.busy_since + 0.6, budget_mb=1024, capacity=4, blocked=())
    assert (view.busy, view.lasting) == ({"base": 2}, {"base": 1})
