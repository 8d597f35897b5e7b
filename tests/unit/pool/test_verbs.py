"""What operators and other gateways ask of a pool: warm, evict, hint, release."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import NotFoundError, PayloadError, PoolError, RefusedError
from appliance.model import ContainerState, PoolHint
from appliance.model.pool_api import DecisionsAsk, EvictAsk, ReleaseAsk, WarmAsk

pytestmark = pytest.mark.anyio


async def test_warm(bench: Any) -> None:
    """An operator has containers ready besides those that work, hears when they are, and why they were started."""
    pool = await bench.pool()
    warmed = await pool.verbs.warm(WarmAsk(image="base", count=2, wait_s=30))
    assert (warmed.ready, warmed.starting, warmed.problem) == (2, 0, "")
    told = await pool.verbs.decisions(DecisionsAsk(limit=2))
    assert told.counts == {"start": 2}
    assert {each.container for each in told.decisions} == {each.id for each in pool.containers()}
    assert {(each.what, each.image) for each in told.decisions} == {("start", "base")}
    assert all(each.why for each in told.decisions)


async def test_warm_at_once(bench: Any) -> None:
    """Without waiting the answer says what is begun; what does not fit is begun in its turn."""
    pool = await bench.pool(capacity=2)
    warmed = await pool.verbs.warm(WarmAsk(image="base", count=1))
    assert warmed.ready == 0
    await bench.ready(pool, 1)
    warmed = await pool.verbs.warm(WarmAsk(image="base", count=5, wait_s=30))
    assert warmed.ready == 2
    assert "no room for one more base container" in warmed.problem
    assert "2 of 2 places" in warmed.problem


async def test_warm_that_cannot_be(bench: Any, tmp_path: Path) -> None:
    """An unknown image, numbers that cannot be, and a full pool are refused; the last says who holds the room."""
    pool = await bench.pool(capacity=1)
    with pytest.raises(NotFoundError, match="no image 'x'"):
        await pool.verbs.warm(WarmAsk(image="x"))
    with pytest.raises(PayloadError, match="0 containers"):
        await pool.verbs.warm(WarmAsk(image="base", count=0))
    sleeper = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    with pytest.raises(RefusedError, match=r"no room for one more vision .* taken by 1 busy base"):
        await pool.verbs.warm(WarmAsk(image="vision"))
    await pool.cancel("t/s1/1")
    await sleeper
    cold = await bench.pool(mode="cold", gateway="g2")
    with pytest.raises(RefusedError, match="mode is cold"):
        await cold.verbs.warm(WarmAsk(image="base"))
    assert pool.refused["no room to warm"] == 1


async def test_evict_by_image(bench: Any, tmp_path: Path) -> None:
    """All idle containers of an image go; one that works stays and the answer says why."""
    pool = await bench.pool(capacity=2)
    await pool.verbs.warm(WarmAsk(image="base", count=2, wait_s=30))
    sleeper = asyncio.create_task(bench.run(pool, bench.request(1, do="sleep", pid=str(tmp_path / "pid"))))
    await bench.until((tmp_path / "pid").exists, "the run")
    (busy,) = [each for each in pool.containers() if each.state is ContainerState.BUSY]
    evicted = await pool.verbs.evict(EvictAsk(image="base"))
    assert len(evicted.containers) == 1
    assert evicted.kept == {busy.id: "it runs t/s1/1"}
    with pytest.raises(RefusedError, match=r"not idle: it runs t/s1/1"):
        await pool.verbs.evict(EvictAsk(container=busy.id))
    await pool.cancel("t/s1/1")
    await sleeper


async def test_evict_one(bench: Any) -> None:
    """One container goes by its id, and the floor is filled again; a container that is not there is an error."""
    pool = await bench.pool(floor={"base": 1})
    await bench.ready(pool, 1)
    first = pool.containers()[0].id
    evicted = await pool.verbs.evict(EvictAsk(container=first))
    assert evicted.containers == (first,)
    assert evicted.note == "the floor keeps 1 of base"
    await bench.ready(pool, 1)
    assert pool.containers()[0].id != first
    with pytest.raises(NotFoundError, match="no container"):
        await pool.verbs.evict(EvictAsk(container=first))
    for ask in (EvictAsk(), EvictAsk(container=first, image="base")):
        with pytest.raises(PayloadError, match="neither"):
            await pool.verbs.evict(ask)


async def test_release_quarantine(bench: Any) -> None:
    """An image that is left alone is started again at the operator's word, not before its time otherwise."""
    bench.engine.refuse = "exec format error"
    pool = await bench.pool(floor={"base": 1}, quarantine_s=600)
    await bench.until(lambda: "exec format error" in pool.problem, "the quarantine")
    bench.engine.refuse = ""
    released = await pool.verbs.release_quarantine(ReleaseAsk(image="base"))
    assert "exec format error" in released.reason
    await bench.ready(pool, 1)
    with pytest.raises(RefusedError, match="not in quarantine"):
        await pool.verbs.release_quarantine(ReleaseAsk(image="base"))


async def test_hint(bench: Any) -> None:
    """What another gateway's plan will need is warmed; hints of nonsense are refused and counted."""
    pool = await bench.pool(mode="federated")
    assert (await pool.verbs.hint(PoolHint(image="base", in_s=1.0, keep_s=10.0))).taken
    await bench.ready(pool, 1)
    with pytest.raises(NotFoundError):
        await pool.verbs.hint(PoolHint(image="x"))
    with pytest.raises(PayloadError):
        await pool.verbs.hint(PoolHint(image="base", count=-1))
    assert pool.refused == {"unknown image": 1, "bad hint": 1}
    cold = await bench.pool(mode="cold", gateway="g2")
    assert not (await cold.verbs.hint(PoolHint(image="base"))).taken


async def test_warm_without_podman(bench: Any) -> None:
    """Without Podman nothing is warmed, and the answer says what is wrong."""
    bench.engine.away = True
    pool = await bench.pool()
    with pytest.raises((PoolError, RefusedError), match="socket is not there"):
        await pool.verbs.warm(WarmAsk(image="base"))
