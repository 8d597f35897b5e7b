"""The audit: every order leaves a mark, whatever came of it."""
# pyright: reportPrivateUsage=false

from itertools import count
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConflictError, PayloadError
from appliance.model import Act, TaskRecord, TaskRequest, keyspace
from appliance.model.robot_api import StopAsk
from appliance.model.task_api import ActsAsk, PauseAsk, RetryAsk
from appliance.model.transfer_api import FetchAsk
from appliance.tasks.audit import DENIED_AT_ONCE, KEPT, MOST_KINDS, Audit, target_of
from tests.unit.tasks.fake_plane import FakePlane

pytestmark = pytest.mark.anyio


async def done(ask: PauseAsk) -> TaskRecord:
    """Carry out an order."""
    return TaskRecord(id=ask.id, instruction="x")


async def late(ask: PauseAsk) -> TaskRecord:
    """Come second."""
    raise ConflictError("ann was faster")


async def broken(ask: PauseAsk) -> TaskRecord:
    """Break."""
    raise ValueError("a defect")


async def test_what_came_of_an_order_is_put(plane: Any) -> None:
    """Done, refused and broken ones, with who, what, why and when; what gateways hand on is no order of its own."""
    audit = Audit(plane.session, plane.keys, "gw-1")
    await audit.signed("pause", done)(PauseAsk(id="t-1", by="ann", why="lunch", act="o-1"))
    with pytest.raises(ConflictError):
        await audit.signed("pause", late)(PauseAsk(id="t-1", by="bob"))
    with pytest.raises(ValueError, match="a defect"):
        await audit.signed("pause", broken)(PauseAsk(id="t-1"))
    await audit.signed("pause", done)(PauseAsk(id="t-1", by="ann", here=True))
    await audit.signed("pause", done, when=lambda _: False)(PauseAsk(id="t-1", by="ann"))
    told = plane.session.sent(plane.keys(keyspace.ACT, "gw-1"), Act)
    assert [(each.by, each.target, each.outcome) for each in told] == [
        ("ann", "t-1", "done"),
        ("bob", "t-1", "conflict"),
        ("unsigned", "t-1", "internal"),
    ]
    assert (told[0].id, told[0].why) == ("o-1", "lunch")
    assert told[1].problem == "ann was faster"
    newest = (await audit.acts(ActsAsk(limit=2))).acts
    assert [each.by for each in newest] == ["unsigned", "bob"]


async def test_orders_given_to_other_gateways_are_remembered(plane: Any) -> None:
    """One that dies takes none along; one that says it is another's is not believed; the number is bounded."""
    audit = Audit(plane.session, plane.keys, "gw-1")
    audit.listen()
    plane.session.publish(keyspace.ACT, Act(id="a", verb="stop", by="ann", gateway="gw-2"), "gw-2")
    plane.session.publish(keyspace.ACT, Act(id="b", verb="stop", by="eve", gateway="gw-2"), "gw-3")
    assert [each.id for each in (await audit.acts(ActsAsk())).acts] == ["a"]
    for number in range(KEPT + 10):
        plane.session.publish(keyspace.ACT, Act(id=f"n{number}", verb="x", by="ann", gateway="gw-2"), "gw-2")
    assert len((await audit.acts(ActsAsk(limit=10_000))).acts) == KEPT


async def test_submissions_are_audited_apart(plane: Any) -> None:
    """Who submitted what, taken or refused; however many they are, the orders before them are still told."""

    async def taken(request: TaskRequest) -> TaskRecord:
        if not request.instruction:
            raise PayloadError("the instruction is empty")
        return TaskRecord(id=request.id, instruction=request.instruction)

    audit = Audit(plane.session, plane.keys, "gw-1")
    await audit.signed("pause", done)(PauseAsk(id="t-1", by="ann"))
    submit = audit.submission(taken)
    await submit(TaskRequest(instruction="go", id="t-2", submitter="bob"))
    with pytest.raises(PayloadError):
        await submit(TaskRequest(instruction=""))
    told = [
        (each.verb, each.by, each.target, each.outcome)
        for each in plane.session.sent(plane.keys(keyspace.ACT, "gw-1"), Act)
    ]
    assert told[1:] == [("submit", "bob", "t-2", "done"), ("submit", "unsigned", "a new task", "payload")]
    for number in range(KEPT + 10):
        await submit(TaskRequest(instruction="go", id=f"t-{number}"))
    acts = (await audit.acts(ActsAsk(limit=10_000))).acts
    assert (len(acts), acts[0].target, acts[-1].verb) == (KEPT + 1, f"t-{KEPT + 9}", "pause")


async def test_what_is_refused_for_whom_it_is_from_is_told(plane: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With whose it was, where that is proven; a flood is counted, pushes out no order, and hides no other sender."""
    clock = count(1000.0, 0.001)
    monkeypatch.setattr("appliance.tasks.audit.time.monotonic", lambda: next(clock))
    audit = Audit(plane.session, plane.keys, "gw-1")
    audit.listen()
    key = plane.keys(keyspace.RPC, "gw-1", "pause")
    await audit.signed("pause", done)(PauseAsk(id="t-1", by="ann"))
    for _ in range(3 * KEPT):
        plane.session.deny("unauthorized gw/gw-1/rpc/pause", key, "the request is not signed")
    plane.session.deny("unauthorized gw/gw-1/rpc/pause", key, "viewer vera may not ask pause", "vera")
    plane.session.deny(
        "unverified gw/gw-1/rpc/soft_stop", plane.keys(keyspace.RPC, "gw-1", "soft_stop"), "no signature"
    )
    acts = (await audit.acts(ActsAsk(limit=10_000))).acts
    assert [(each.verb, each.by, each.outcome) for each in acts[:3]] == [
        ("soft_stop", "unproven", "unverified"), ("pause", "vera", "denied"), ("pause", "unproven", "denied"),
    ]  # fmt: skip
    assert len(acts) == 3 + DENIED_AT_ONCE
    assert acts[1].target == "gw/gw-1/rpc/pause"
    assert "vera may not ask pause" in acts[1].problem
    clock = count(1100.0, 0.001)
    plane.session.deny("unauthorized gw/gw-1/rpc/pause", key, "the request is not signed")
    told = plane.session.sent(plane.keys(keyspace.ACT, "gw-1"), Act)
    assert told[-1].problem.endswith(f"({3 * KEPT - DENIED_AT_ONCE:,} more before)")


@given(floods=st.lists(st.tuples(st.integers(0, 400), st.integers(1, 50)), max_size=30))
async def test_however_many_strangers_there_are_memory_is_bounded(floods: list[tuple[int, int]]) -> None:
    """Of the senders of refused orders the longest silent are forgotten."""
    plane = FakePlane()
    audit = Audit(plane.session, plane.keys, "gw-1")  # pyright: ignore[reportArgumentType]
    audit.listen()
    for sender, times in floods:
        for _ in range(times):
            plane.session.deny("unauthorized x", "k", "no", f"m{sender}")
    assert len((await audit.acts(ActsAsk(limit=10_000))).acts) <= KEPT // 5
    assert len(audit._sparing) <= MOST_KINDS


def test_an_order_names_what_it_is_about() -> None:
    """A task, its subtask, robots, or the fleet."""
    assert target_of(RetryAsk(id="t", subtask="s1")) == "t/s1"
    assert target_of(StopAsk(robots=("r1", "r2"))) == "r1, r2"
    assert target_of(StopAsk()) == "the fleet"
    assert target_of(FetchAsk(reference="localhost/base:1")) == "localhost/base:1"
