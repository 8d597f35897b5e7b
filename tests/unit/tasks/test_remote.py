"""What is known of containers and state elsewhere: whose word counts, what is out of date, what things cost."""

import asyncio
from typing import Any

import pytest

from appliance.model import ContainerInfo, ContainerState, GatewayStatus, Need, VolumeInfo
from appliance.model.task_api import ContainerList
from appliance.plane.events import Lost
from appliance.pool.selection import UNMEASURED
from appliance.tasks.offload import EMPTY_OFFERS, FIRST_LEFT_OUT_S, LEFT_OUT_S, RemoteContainers

pytestmark = pytest.mark.anyio

NEED = Need(image="base", volumes=("maps", "fresh"))
READY, BUSY = ContainerState.READY, ContainerState.BUSY


def container(gateway: str, name: str, state: ContainerState = READY, **fields: Any) -> ContainerInfo:
    """Return a container."""
    return ContainerInfo(**{"id": name, "gateway": gateway, "image": "base", "state": state, **fields})


@pytest.fixture
def remote(plane: Any, monkeypatch: pytest.MonkeyPatch) -> RemoteContainers:
    """Return what gw-1 knows of gw-2, gw-3 (asked) and gw-4 (heard of)."""
    monkeypatch.setattr("appliance.tasks.offload.PROMISED_S", 3600.0)  # or a slow machine is too late to see a promise
    plane.present = {"gw-1", "gw-2", "gw-3", "gw-4"}
    return RemoteContainers(plane, successors=3)


def know(plane: Any, *containers: ContainerInfo) -> None:
    """Have heard of containers."""
    for each in containers:
        plane.registry.containers.setdefault(each.gateway, {})[each.id] = each


def answers(plane: Any, **by_gateway: tuple[ContainerInfo, ...]) -> None:
    """What gateways answer when asked; the others do not."""

    async def find(gateway: str, need: Need) -> ContainerList:
        return ContainerList(containers=by_gateway[gateway.replace("-", "_")])

    plane.rpc.on["find_containers"] = find


async def found(remote: RemoteContainers, avoid: tuple[str, ...] = ()) -> dict[str, ContainerState]:
    """Look, and return what was found, by id."""
    return {each.container.id: each.container.state for each in await remote.find(NEED, avoid)}


async def test_a_gateways_own_word_is_newer_than_what_was_heard(remote: RemoteContainers, plane: Any) -> None:
    """A ready one that its gateway does not name is gone; hearsay of one that was asked itself does not count."""
    know(plane, container("gw-2", "old"), container("gw-2", "works", BUSY), container("gw-4", "heard"))
    answers(
        plane,
        gw_2=(container("gw-2", "new"), container("gw-3", "rumour"), container("gw-4", "heard", BUSY)),
        gw_3=(container("gw-4", "more"),),
    )
    assert await found(remote) == {"works": BUSY, "new": READY, "heard": READY, "more": READY}


async def test_those_that_do_not_answer_are_known_by_what_was_heard(remote: RemoteContainers, plane: Any) -> None:
    """Without an answer the registry counts; what is here, of nobody, or of another image does not."""
    know(
        plane,
        container("gw-2", "a"),
        container("gw-1", "here"),
        container("gw-9", "gone"),
        container("gw-2", "other", image="vision"),
        container("gw-3", "also", image="vision", compatible=("base",)),
    )
    assert await found(remote) == {"a": READY, "also": READY}
    assert {each.id for each in (await remote.answer(NEED)).containers} >= {"a", "here"}
    know(plane, container("gw-2", "a", BUSY))
    assert "a" not in {each.id for each in (await remote.answer(NEED)).containers}


async def test_state_is_where_its_newest_generation_is(remote: RemoteContainers, plane: Any) -> None:
    """Several may hold it; an older one, one of a lost gateway and one told by somebody else do not count."""

    def volume(gateway: str, generation: int) -> VolumeInfo:
        return VolumeInfo(name="maps", gateway=gateway, generation=generation, size_bytes=12_500_000)

    for gateway, volumes in {
        "gw-1": (volume("gw-1", 2),),
        "gw-2": (volume("gw-2", 3),),
        "gw-3": (volume("gw-3", 3), volume("gw-4", 8)),
        "gw-9": (volume("gw-9", 9),),
    }.items():
        plane.registry.gateways[gateway] = GatewayStatus(id=gateway, fleet="f", volumes=volumes)
    facts = remote.facts(NEED)
    assert set(facts.volumes) == {"maps"}
    assert [each.gateway for each in facts.volumes["maps"]] == ["gw-2", "gw-3"]
    assert facts.link("gw-2") == UNMEASURED


async def test_empty_offers_leave_a_gateway_out_for_a_while(remote: RemoteContainers, plane: Any) -> None:
    """The clock is passed in; a good offer, and the gateway's going, end it."""
    now = 100.0
    for _ in range(EMPTY_OFFERS - 1):
        remote.outcome(remote.promise("gw-2"), taken=False, now=lambda: now)
    assert remote.left_out(lambda: now) == {}
    remote.outcome(remote.promise("gw-2"), taken=False, now=lambda: now)
    assert set(remote.left_out(lambda: now)) == {"gw-2"}
    assert remote.left_out(lambda: now + FIRST_LEFT_OUT_S) == {}
    for _ in range(20):  # one that goes on offering nothing is left out for longer and longer, up to a bound
        remote.outcome(remote.promise("gw-2"), taken=False, now=lambda: now)
    assert set(remote.left_out(lambda: now + LEFT_OUT_S - 0.1)) == {"gw-2"}
    assert remote.left_out(lambda: now + LEFT_OUT_S) == {}
    plane.events.publish(Lost("gw-2"))
    assert remote.left_out(lambda: now) == {}


async def test_what_is_known_saves_asking(remote: RemoteContainers, plane: Any) -> None:
    """A ready container of a gateway heard of lately is enough; without one, only those not heard of are asked."""
    answers(plane, gw_2=(), gw_3=(container("gw-3", "new"),))
    know(plane, container("gw-4", "ready"), container("gw-2", "works", BUSY))
    plane.registry.ages = {"gw-4": 0.5, "gw-2": 0.5}
    assert await found(remote) == {"ready": READY, "works": BUSY}
    assert not plane.rpc.calls
    assert remote.searches == {"saved": 2, "asked": 0}
    know(plane, container("gw-4", "ready", BUSY))
    assert await found(remote) == {"ready": BUSY, "works": BUSY, "new": READY}
    assert [gateway for gateway, _, _ in plane.rpc.calls] == ["gw-3"]
    assert remote.searches == {"saved": 3, "asked": 1}


async def test_a_container_that_a_run_was_just_sent_to_is_not_offered_to_the_next(
    remote: RemoteContainers, plane: Any
) -> None:
    """As many as runs were sent there are left out, until its gateway can have told; one that had none is asked."""
    know(plane, container("gw-2", "a"), container("gw-2", "b"))
    answers(plane, gw_2=(container("gw-2", "b"),), gw_3=())
    plane.registry.ages = {"gw-2": 0.1, "gw-3": 0.1}
    assert {each.id for each in remote.ready(NEED)} == {"a", "b"}
    sent = remote.promise("gw-2")
    assert {each.id for each in remote.ready(NEED)} == {"b"}
    assert await found(remote) == {"b": READY}
    remote.outcome(sent, taken=False)
    assert remote.ready(NEED) == []
    assert set(await found(remote)) == {"b"}
    assert [gateway for gateway, _, _ in plane.rpc.calls] == ["gw-2"]


async def test_what_a_gateway_has_that_may_not_be_used_ends_no_search(
    remote: RemoteContainers, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither what is known of it saves asking, nor its answer, the first, waiting for one that can be used."""
    monkeypatch.setattr("appliance.tasks.offload.PATIENCE", 0.0)
    monkeypatch.setattr("appliance.tasks.offload.LEAST_PATIENCE_S", 0.0)
    know(plane, container("gw-4", "known"))
    plane.registry.ages = {"gw-4": 0.1}
    whole = {"cpu": 8.0, "memory_mb": 8192, "volumes": NEED.volumes}

    async def find(gateway: str, need: Need) -> ContainerList:
        if gateway == "gw-3":
            for _ in range(20):  # a search that ends with the other's answer has ended by then
                await asyncio.sleep(0)
        return ContainerList(containers=(container(gateway, f"of {gateway}", **whole),))

    plane.rpc.on["find_containers"] = find
    assert await found(remote) == {"known": READY}
    assert await found(remote, avoid=("gw-2", "gw-4")) == {"known": READY, "of gw-2": READY, "of gw-3": READY}
    assert await found(remote, avoid=("gw-4",)) == {"known": READY, "of gw-2": READY}, "that one ends it"


async def test_short_runs_one_after_the_other_find_the_same_container(remote: RemoteContainers, plane: Any) -> None:
    """Where a run was just sent to is asked when nobody else has one: the run may be over, and its word counts."""
    know(plane, container("gw-2", "a"))
    answers(plane, gw_2=(container("gw-2", "a"),), gw_3=())
    plane.registry.ages = {"gw-2": 0.1, "gw-3": 0.1}
    for _ in range(3):
        remote.promise("gw-2")
        assert remote.ready(NEED) == []
        assert await found(remote) == {"a": READY}
    assert [gateway for gateway, _, _ in plane.rpc.calls] == ["gw-2"] * 3


async def test_a_run_holds_its_container_until_that_one_is_told_of(remote: RemoteContainers, plane: Any) -> None:
    """Once it is known which one a run got, the others are counted on, and it too as soon as it is heard of again."""
    know(plane, container("gw-2", "a", runs=3), container("gw-2", "b"))
    plane.registry.ages = {"gw-2": 0.1}
    sent = remote.promise("gw-2")
    assert {each.id for each in remote.ready(NEED)} == {"b"}
    remote.outcome(sent, taken=True, container="b")
    assert {each.id for each in remote.ready(NEED)} == {"a"}
    know(plane, container("gw-2", "b", BUSY))
    remote.outcome(remote.promise("gw-2"), taken=True, container="a")
    assert remote.ready(NEED) == []
    know(plane, container("gw-2", "a", runs=4))  # so short that it was never told to be busy
    assert {each.id for each in remote.ready(NEED)} == {"a"}


async def test_a_run_that_was_heard_to_end_holds_nothing(remote: RemoteContainers, plane: Any) -> None:
    """Its container is ready long before its gateway says so, unless others wait there; only its gateway ends it."""
    know(plane, container("gw-2", "a"))
    plane.registry.ages = {"gw-2": 0.1}
    run = ("t1", "s1")
    remote.outcome(remote.promise("gw-2", run), taken=True, container="a")
    assert remote.waits_for(run)
    remote.over(run, "gw-3")
    remote.over(("t1", "s2"), "gw-2")
    assert remote.ready(NEED) == []
    remote.over(run, "gw-2")
    assert not remote.waits_for(run)
    assert {each.id for each in remote.ready(NEED)} == {"a"}
    remote.promise("gw-2", run)
    plane.registry.gateways["gw-2"] = GatewayStatus(id="gw-2", fleet="f", queue=1)
    remote.over(run, "gw-2")
    assert remote.ready(NEED) == []


async def test_runs_that_were_sent_are_not_remembered_for_ever(
    remote: RemoteContainers, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those whose time is over go when the next one is sent, those of a lost gateway with it."""
    know(plane, container("gw-2", "a"))
    monkeypatch.setattr("appliance.tasks.offload.PROMISED_S", -1.0)
    for number in range(5):
        remote.promise("gw-2", ("t1", f"s{number}"))
    assert [remote.waits_for(("t1", f"s{number}")) for number in range(5)] == [False] * 4 + [True]
    remote._forget("gw-2")
    assert not remote.waits_for(("t1", "s4"))


async def test_the_next_attempt_is_waited_for_when_the_one_before_is_given_up(
    remote: RemoteContainers, plane: Any
) -> None:
    """The end of a run is heard where it was sent last, whatever becomes late of where it was sent before."""
    know(plane, container("gw-2", "a"), container("gw-3", "b"))
    plane.registry.ages = {"gw-2": 0.1, "gw-3": 0.1}
    run = ("t1", "s1")
    first = remote.promise("gw-2", run)
    remote.outcome(remote.promise("gw-3", run), taken=True, container="b")
    remote.outcome(first, taken=False)
    remote._forget("gw-2")
    assert remote.waits_for(run)
    remote.over(run, "gw-3")
    assert not remote.waits_for(run)
    assert "b" in {each.id for each in remote.ready(NEED)}


async def test_an_offer_that_came_to_nothing_holds_no_container(remote: RemoteContainers, plane: Any) -> None:
    """A run that was refused has none: when its gateway is believed again, all that are ready there count."""
    know(plane, container("gw-2", "a"))
    plane.registry.ages = {"gw-2": 0.1}
    remote.outcome(remote.promise("gw-2"), taken=False)
    assert not remote._open("gw-2")


async def test_an_answer_that_took_long_is_not_taken_for_another_runs(
    remote: RemoteContainers, plane: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal frees what the refused run held, and a container is that of the run that got it, in whatever order."""
    know(plane, container("gw-2", "a"), container("gw-2", "b"), container("gw-2", "c"))
    plane.registry.ages = {"gw-2": 0.1}
    monkeypatch.setattr("appliance.tasks.offload.PROMISED_S", -1.0)
    slow = [remote.promise("gw-2"), remote.promise("gw-2")]
    monkeypatch.setattr("appliance.tasks.offload.PROMISED_S", 3600.0)
    later = remote.promise("gw-2")
    remote.outcome(slow[0], taken=True, container="c")
    assert {each.id for each in remote.ready(NEED)} == {"b", "c"}, "whose answer is still to come holds one"
    remote.outcome(slow[1], taken=False)
    assert remote._open("gw-2") == [later]
    remote.outcome(later, taken=True, container="a")
    remote._doubted.clear()
    assert {each.id for each in remote.ready(NEED)} == {"b", "c"}


async def test_the_slowest_is_not_waited_for_when_another_has_all_that_is_needed(
    remote: RemoteContainers, plane: Any
) -> None:
    """One that never answers does not hold up a search that has found a container; one that is not enough does."""
    never = asyncio.Event()
    offer = container("gw-2", "a", cpu=8.0, memory_mb=8192, volumes=NEED.volumes)

    async def find(gateway: str, need: Need) -> ContainerList:
        if gateway == "gw-3":
            await never.wait()
        return ContainerList(containers=(offer,))

    plane.rpc.on["find_containers"] = find
    assert await asyncio.wait_for(found(remote), 30) == {"a": READY}
    offer = container("gw-2", "a", cpu=8.0, memory_mb=8192, volumes=())
    looking = asyncio.create_task(found(remote))
    done, _ = await asyncio.wait([looking], timeout=0.05)
    assert not done, "volumes are missing there: the other may have them"
    never.set()
    assert await asyncio.wait_for(looking, 30) == {"a": READY}
