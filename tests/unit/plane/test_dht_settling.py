"""When a gateway may answer for a key as its owner, and how long requests wait until it may."""

import asyncio
from types import SimpleNamespace
from typing import cast

import pytest

from appliance.plane import dht
from appliance.plane.dht import Settling
from appliance.plane.membership import Membership, StallDetector
from appliance.plane.ring import Ring

pytestmark = pytest.mark.anyio

RING = Ring(("a", "b"), virtual_nodes=8)
MINE = next(key for number in range(1000) if RING.owner(key := f"key/{number}") == "a")
OTHERS = next(key for number in range(1000) if RING.owner(key := f"key/{number}") == "b")


def _settling() -> tuple[Settling, SimpleNamespace, SimpleNamespace]:
    membership, pulse = SimpleNamespace(ring=RING), SimpleNamespace(stalls=0)
    made = Settling(
        gateway="a",
        membership=cast("Membership", membership),
        pulse=cast("StallDetector", pulse),
        replicas=2,
        virtual_nodes=8,
    )
    return made, membership, pulse


async def test_a_request_waits_until_the_shard_is_compared() -> None:
    """It wants the comparison, and goes on once that is done; for another's key nobody is waited for again."""
    here, _, _ = _settling()
    waiting = asyncio.create_task(here.until_mine(MINE))
    await here.wanted.wait()
    here.wanted.clear()
    assert not here.reconciled()
    assert not waiting.done()
    await here.settled(RING, 0)
    assert await waiting
    assert here.reconciled()
    assert here.mine(MINE)
    assert not here.mine(OTHERS)
    assert await here.until_mine(MINE)
    assert not here.wanted.is_set()


async def test_a_standstill_undoes_it() -> None:
    """After this process stood still others may have ordered writes: nothing counts as compared until it is again."""
    here, _, pulse = _settling()
    await here.settled(RING, 0)
    pulse.stalls = 1
    assert not here.reconciled()
    assert not here.mine(MINE)
    await here.settled(RING, 1)
    assert here.mine(MINE)


async def test_whoever_came_back_is_waited_for_a_shorter_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A write waits for one that was away only so long as it says; a read as long as for the comparison itself."""
    here, _, _ = _settling()
    await here.settled(RING, 0)
    here.returned = frozenset({"b"})
    monkeypatch.setattr(dht, "SETTLE_S", 3600.0)
    assert not await here.until_mine(MINE, returned_s=0.01)
    waiting = asyncio.create_task(here.until_mine(MINE))
    await asyncio.sleep(0.02)
    assert not waiting.done()
    here.returned = frozenset()
    await here.settled(RING, 0)
    assert await waiting
    monkeypatch.setattr(dht, "SETTLE_S", 0.01)
    here.returned = frozenset({"b"})
    assert not await here.until_mine(MINE)


async def test_those_never_compared_with_are_waited_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who has just come may have what is not here: until it was compared with, or the moment is over."""
    here, membership, _ = _settling()
    await here.settled(RING, 0)
    assert here.met()
    membership.ring = RING.with_member("c")
    assert not here.met()
    monkeypatch.setattr(dht, "RETURNED_S", 0.01)
    await here.until_met()
    assert not here.met()
    monkeypatch.setattr(dht, "RETURNED_S", 3600.0)
    waiting = asyncio.create_task(here.until_met())
    await asyncio.sleep(0)
    await here.settled(membership.ring, 0)
    await waiting
    assert here.met()


async def test_a_request_for_a_key_that_is_given_away_waits_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Members of a partition come back one by one: a key owned for a moment is another's once the last has come."""
    monkeypatch.setattr(dht, "SETTLE_S", 3600.0)
    here, membership, _ = _settling()
    membership.ring = Ring(("a",), virtual_nodes=8)
    waiting = asyncio.create_task(here.until_mine(OTHERS))
    await asyncio.sleep(0.02)
    membership.ring = RING
    assert not waiting.done()
    await here.settled(RING, 0)
    async with asyncio.timeout(60):
        assert not await waiting
