"""What a coordinator knows is written before its gateway goes."""

import asyncio
from typing import Any

import pytest
from msgspec.structs import replace

from appliance.model import Plan, Subtask, encode, keyspace
from appliance.plane.dht import Record
from appliance.tasks import machine
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.record_writer import Draft, RecordWriter, SupersededError


def test_a_run_of_this_gateway_unsettles_until_its_end_is_written() -> None:
    """Unwritten transitions and runs here are awaited; runs elsewhere are not."""
    plan = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="hold", robot="rover_1"),))
    record = None
    steps: list[tuple[TransitionKind, dict[str, object]]] = [
        (TransitionKind.ACCEPTED, {"instruction": "x"}),
        (TransitionKind.PLANNED, {"plan": plan}),
        (TransitionKind.DISPATCHED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
    ]
    for number, (kind, fields) in enumerate(steps, start=1):
        event = Transition(task="t", sequence=number, kind=kind, at_ns=1, coordinator="gw-1", **fields)  # type: ignore[arg-type]
        record = machine.apply(record, event)
    assert record is not None
    for gateway, settled in (("gw-1", False), ("gw-2", True)):
        draft = Draft(record, gateway)
        assert draft.settled is settled
        assert draft.offer(TransitionKind.SUCCEEDED, subtask="s1", attempt=1)
        assert not draft.settled


def moving(plane: Any, **more: Any) -> RecordWriter:
    """A writer of an accepted task with a transition that is not written yet."""
    plane.dht.records["task/t-1"] = Record(key="task/t-1", value=b"{}", version={"gw-1": 1})
    draft = Draft(plane.accepted(), "gw-1")
    draft.apply(TransitionKind.PLANNED, plan=plane.plan_of())
    return RecordWriter(plane, draft, {"gw-1": 1}, **more)


@pytest.mark.anyio
async def test_a_writers_own_write_does_not_overtake_it(plane: Any) -> None:
    """The copy here changes before the write returns: that is the writer's own doing, and it goes on."""
    writer = moving(plane)
    plane.dht.watch(lambda _: True, lambda record: writer.copy_changed(record.version))
    await writer.flush()
    await asyncio.sleep(0)
    assert not writer.overtaken
    assert plane.session.puts


@pytest.mark.anyio
@pytest.mark.parametrize("durable", [True, False])
async def test_nothing_is_begun_by_a_record_that_was_overtaken(plane: Any, durable: bool) -> None:
    """Neither behind a write of its own, nor where nothing needs to be written: no order goes out twice.

    The record is not published. Its transitions are, for the log: others may have gone on from it.
    """
    begun: list[None] = []
    writer = moving(plane, on_written=lambda: begun.append(None))
    if durable:
        plane.dht.watch(lambda _: True, lambda record: writer.copy_changed({**record.version, "gw-2": 3}))
    else:
        await writer.flush()
        sent = {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}
        writer.draft.apply(TransitionKind.DISPATCHED, durable=False, **sent)
        begun.clear()
        writer.copy_changed({**writer.version, "gw-2": 3})
    plane.session.puts.clear()
    with pytest.raises(SupersededError):
        await writer.flush()
    told = [each.kind for each in plane.session.sent(plane.keys(keyspace.TRANSITION, "t-1"), Transition)]
    assert told == ([TransitionKind.PLANNED] if durable else [])
    assert len(plane.session.puts) == len(told)
    assert begun == []


@pytest.mark.anyio
@pytest.mark.parametrize("stands", [True, False])
async def test_a_write_that_stands_after_a_conflict_is_told(plane: Any, stands: bool) -> None:
    """Another version was written elsewhere too and lost: the writer stops, and the log has what led to what stands."""
    writer = moving(plane)
    standing = writer.draft.record if stands else replace(writer.draft.record, coordinator="gw-2")
    plane.dht.change(Record(key="task/t-1", value=encode(standing), version={"gw-1": 2, "gw-2": 1}))
    with pytest.raises(SupersededError):
        await writer.flush()
    assert bool(plane.session.sent(plane.keys(keyspace.TRANSITION, "t-1"), Transition)) is stands
