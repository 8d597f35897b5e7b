"""After a partition: doubled runs are ended, attempts fenced off, people told; once, and one's own go on."""

import asyncio
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from appliance.model import (
    Attempt,
    Decision,
    LostOrder,
    LostRun,
    Notice,
    Pause,
    RunEvent,
    RunEventKind,
    Split,
    SubtaskState,
    TaskRecord,
    TaskState,
    Word,
    encode,
    keyspace,
)
from appliance.model.task_api import RunAsk, RunStatus
from appliance.model.transitions import Transition, TransitionKind
from appliance.plane.dht import Record
from appliance.tasks.conflicts import foreign, heal, merged, split_of
from appliance.tasks.events import RunReported
from appliance.tasks.machine import apply
from appliance.tasks.record_writer import Draft, RecordWriter, SupersededError
from appliance.tasks.records import task_key

pytestmark = pytest.mark.anyio


def split(*runs: LostRun, coordinator: str = "gw-3", state: TaskState = TaskState.RUNNING) -> Split:
    """A version that lost."""
    return Split(coordinator=coordinator, sequence=9, state=state, runs=runs)


def lost(attempt: int, gateway: str, state: SubtaskState = SubtaskState.RUNNING) -> LostRun:
    """What it had of s1."""
    return LostRun(subtask="s1", attempt=attempt, gateway=gateway, state=state)


def record_of(plane: Any, *splits: Split, robot: str | None = None, attempt: int = 1) -> TaskRecord:
    """A record whose s1 runs on gw-1, with versions that lost."""
    record = apply(plane.accepted(), _step(2, TransitionKind.PLANNED, plan=plane.plan_of()))
    record = apply(record, _step(3, TransitionKind.DISPATCHED, subtask="s1", attempt=1, gateway="gw-1", robot=robot))
    target = record.subtasks[0]
    attempts = (*target.attempts, *(Attempt(number=number, gateway="gw-1") for number in range(2, attempt + 1)))
    return replace(record, subtasks=(replace(target, attempts=attempts),), splits=splits)


def _step(sequence: int, kind: TransitionKind, **fields: Any) -> Transition:
    return Transition(task="t-1", sequence=sequence, kind=kind, at_ns=1, coordinator="gw-1", **fields)


def test_doubled_runs_are_ended_and_later_attempts_fenced_off(plane: Any) -> None:
    """Those of the other side that are under way; not one's own, nor what has ended; the fence is the highest."""
    record = record_of(plane, split(lost(1, "gw-1"), lost(4, "gw-3"), lost(3, "gw-2", SubtaskState.SUCCEEDED)))
    healing = heal(record)
    assert healing is not None
    assert [(each.attempt, each.gateway) for each in healing.ends] == [(4, "gw-3")]
    assert healing.fences == {"s1": 4}
    assert healing.superseded == ()
    (note,) = healing.notes
    assert "s1 (attempt 4 on gw-3: ended now)" in note
    assert "attempt 3 on gw-2: it had succeeded" in note
    again = heal(replace(record, sequence=record.sequence + 3, coordinator="gw-2"))
    assert again is not None
    assert again.noted == healing.noted, "each gateway that settles it publishes it under the same name"
    after = apply(record, _step(4, TransitionKind.HEALED, splits=healing.splits, fences=healing.fences))
    assert heal(after) is None
    assert after.subtasks[0].next_attempt == 5


def test_nothing_doubled_is_nothing_to_tell(plane: Any) -> None:
    """Two views of one course, as when a coordinator was taken over: settled without a word."""
    healing = heal(record_of(plane, split(lost(1, "gw-1"))))
    assert healing is not None
    assert (healing.ends, healing.notes) == ((), ())


def test_a_run_taken_for_lost_that_went_on_is_doubled(plane: Any) -> None:
    """What one side repeated since it saw the gateway gone was still running there: it is ended, and told."""
    record = record_of(plane, split(lost(1, "gw-1")), attempt=2)
    healing = heal(record)
    assert healing is not None
    assert [(each.attempt, each.gateway) for each in healing.ends] == [(1, "gw-1")]
    (note,) = healing.notes
    assert "doubled: s1 (attempt 1 on gw-1: ended now)" in note
    failed = heal(record_of(plane, split(lost(1, "gw-1", SubtaskState.FAILED)), attempt=2))
    assert failed is not None
    assert (failed.ends, failed.notes) == ((), ())


def test_a_run_whose_robot_has_heard_a_later_attempt_is_repeated(plane: Any) -> None:
    """The robot would refuse it from now on; one without a robot goes on."""
    for robot, expected in (("r1", ("s1",)), (None, ())):
        healing = heal(record_of(plane, split(lost(2, "gw-3")), robot=robot))
        assert healing is not None
        assert healing.superseded == expected


def test_news_of_a_run_that_lost_are_refused_even_under_the_same_number(plane: Any) -> None:
    """Two gateways may run attempt 2 of one subtask: the record's own counts, the other's result does not."""
    record = record_of(plane, split(lost(1, "gw-3")))
    event = RunEvent(task="t-1", subtask="s1", attempt=1, kind=RunEventKind.SUCCEEDED, gateway="gw-3")
    assert foreign(record, event)
    assert not foreign(record, replace(event, gateway="gw-1"))
    assert not foreign(replace(record, splits=()), event)


async def test_a_driver_settles_what_was_lost_before_it_goes_on(bench: Any) -> None:
    """The run of the other side is ended there, its result is refused, with a notice, and the task ends by its own."""
    record = record_of(bench.plane, split(lost(1, "gw-3")))

    async def running(gateway: str, ask: RunAsk) -> RunStatus:
        return RunStatus(running=True)

    bench.plane.rpc.on = {"run_status": running, "run_cancel": running}
    await bench.start(record)
    await bench.until(lambda found: bool(found.splits) and found.splits[0].settled)
    async with asyncio.timeout(60):
        while not bench.plane.session.sent(bench.plane.keys(keyspace.NOTICE), Notice):
            await asyncio.sleep(0.005)
    ended = [(gateway, ask.attempt) for gateway, verb, ask in bench.plane.rpc.calls if verb == "run_cancel"]
    assert ended == [("gw-3", 1)]
    for gateway in ("gw-3", "gw-1"):
        event = RunEvent(
            task="t-1", subtask="s1", attempt=1, kind=RunEventKind.SUCCEEDED, gateway=gateway, result={"of": gateway}
        )
        bench.coordinator.put(RunReported(event))
    last = await bench.end()
    assert last.subtasks[0].result == {"of": "gw-1"}
    assert "partition" in bench.stored().splits[0].note


async def test_an_ended_task_tells_what_went_on_elsewhere(plane: Any) -> None:
    """The version that stands has ended: the other side's run is ended all the same, and the record has the note."""
    record = replace(record_of(plane, split(lost(2, "gw-3"))), state=TaskState.SUCCEEDED)
    plane.dht.records[task_key("t-1")] = Record(key=task_key("t-1"), value=encode(record), version={"gw-1": 7})
    healing = heal(record)
    assert healing is not None
    await healing.settle(plane, RecordWriter(plane, Draft(record, "gw-1"), {"gw-1": 7}))
    assert [(gateway, verb) for gateway, verb, _ in plane.rpc.calls] == [("gw-3", "run_cancel")]
    assert plane.session.sent(plane.keys(keyspace.TASK_UPDATE), TaskRecord)[-1].splits[0].settled


def met(plane: Any, one: TaskRecord, other: TaskRecord) -> TaskRecord:
    """What stands when two versions meet, the same whichever hears of the other."""
    value = merged(encode(one), encode(other))
    assert value == merged(encode(other), encode(one))
    return msgspec.json.decode(value, type=TaskRecord)


CANCEL = Word(by="ann", why="wrong room", act="o-1", at_ns=5)


async def test_whoever_gave_an_order_that_lost_gets_a_notice(plane: Any) -> None:
    """A cancel was answered as done on one side, the other went on to the end: its operator gets a notice, once."""
    base = record_of(plane)
    cancelled = replace(base, state=TaskState.CANCELLED, cancelled_by=CANCEL, coordinator="gw-2", sequence=5)
    done = tuple(replace(each, state=SubtaskState.SUCCEEDED) for each in base.subtasks)
    succeeded = replace(base, state=TaskState.SUCCEEDED, subtasks=done, sequence=4)
    record = met(plane, cancelled, succeeded)
    assert record.state is TaskState.SUCCEEDED
    healing = heal(record)
    assert healing is not None
    plane.dht.records[task_key("t-1")] = Record(key=task_key("t-1"), value=encode(record), version={"gw-1": 7})
    await healing.settle(plane, RecordWriter(plane, Draft(record, "gw-1"), {"gw-1": 7}))
    (notice,) = plane.session.sent(plane.keys(keyspace.NOTICE, "ann"), Notice)
    assert "the cancel of task t-1 by ann is void" in notice.text
    assert "(succeeded)" in notice.text
    assert notice.id == "t-1/healed/order-o-1", "the same from each gateway"
    settled = msgspec.json.decode(plane.dht.records[task_key("t-1")].value, type=TaskRecord)
    assert "void" in settled.splits[0].note
    assert heal(settled) is None


@pytest.mark.parametrize(
    ("lost", "stands", "told"),
    [
        ({"cancelled_by": CANCEL}, {}, True),
        ({"cancelled_by": CANCEL}, {"cancelled_by": CANCEL}, False),
        ({"cancelled_by": CANCEL}, {"state": TaskState.CANCELLING}, False),
        ({"decision": Decision(approved=True, by="ann", act="o-2")}, {}, True),
        ({"decision": Decision(approved=True, by="ann")}, {"decision": Decision(approved=True, by="bob")}, False),
        ({"decision": Decision(approved=False, by="ann")}, {"decision": Decision(approved=True, by="bob")}, True),
        ({"retried_by": CANCEL}, {}, True),
        ({"pauses": (Pause(by="ann", act="o-3"),)}, {}, True),
        ({"pauses": (Pause(by="ann", act="o-3"),)}, {"pauses": (Pause(by="bob", act="o-4"),)}, False),
        ({"pauses": (Pause(by="ann", stop="s-1"),)}, {}, False),
    ],
)
def test_an_order_is_lost_unless_what_stands_has_its_effect(
    plane: Any, lost: dict[str, Any], stands: dict[str, Any], told: bool
) -> None:
    """Two operators who wanted the same have both got it; what a soft stop did is no operator's order of the task."""
    base = record_of(plane)
    split = split_of(replace(base, coordinator="gw-2", sequence=5, **lost))
    healing = heal(replace(base, splits=(split,), **stands))
    assert healing is not None
    assert bool(healing.notes) is told
    assert healing.to == (("ann",) if told else ())


def test_an_operator_whose_name_is_no_key_is_told_as_an_operator(plane: Any) -> None:
    """A name with blanks cannot be part of a key: the notice goes to all, with the name in its text."""
    order = LostOrder(verb="cancel", by="Ann of the night shift", at_ns=3)
    healing = heal(record_of(plane, replace(split(), orders=(order,))))
    assert healing is not None
    assert (healing.to, healing.noted) == (("operator",), ("order-cancel-3",))
    assert "by Ann of the night shift" in healing.notes[0]


def test_fences_survive_the_loss_of_the_version_that_set_them(plane: Any) -> None:
    """Settled in a version that lost in its turn: no number is given twice, runs are ended, no notice comes twice."""
    settled = replace(split(lost(3, "gw-3")), settled=True, note="told")
    record = record_of(plane, settled)
    healing = heal(record)
    assert healing is not None
    assert healing.fences == {"s1": 3}
    assert [(each.attempt, each.gateway) for each in healing.ends] == [(3, "gw-3")]
    assert (healing.notes, healing.splits) == ((), (settled,))
    after = apply(record, _step(4, TransitionKind.HEALED, splits=healing.splits, fences=healing.fences))
    assert after.subtasks[0].next_attempt == 4
    assert heal(after) is None
    assert heal(record_of(plane, replace(split(lost(1, "gw-3")), settled=True))) is None, "below its own: fenced off"
    done = replace(record.subtasks[0], state=SubtaskState.SUCCEEDED)
    assert heal(replace(record, subtasks=(done,))) is None, "there will be no next attempt"


async def test_people_are_told_though_another_gateway_settles_at_once(plane: Any) -> None:
    """The refused side does not know whose write stands, and the mark of either outlives: both publish the same."""
    record = record_of(plane, split(lost(2, "gw-3")))
    healing = heal(record)
    assert healing is not None
    plane.dht.records[task_key("t-1")] = Record(key=task_key("t-1"), value=encode(record), version={"gw-2": 8})
    with pytest.raises(SupersededError):
        await healing.settle(plane, RecordWriter(plane, Draft(record, "gw-1"), {"gw-1": 7}))
    assert [each.id for each in plane.session.sent(plane.keys(keyspace.NOTICE), Notice)] == ["t-1/healed/gw-3-9"]


@pytest.mark.parametrize(("stands", "ended"), [("gw-1", [("gw-3", "run_cancel")]), ("gw-3", [])])
async def test_doubled_runs_are_ended_though_the_write_is_refused(
    plane: Any, stands: str, ended: list[tuple[str, str]]
) -> None:
    """Another gateway wrote meanwhile: a run that the record does not have is ended, one that it has goes on."""
    record = record_of(plane, split(lost(1, "gw-3")))
    healing = heal(record)
    assert healing is not None
    (target,) = record.subtasks
    (attempt,) = target.attempts
    newer = replace(record, subtasks=(replace(target, gateway=stands, attempts=(replace(attempt, gateway=stands),)),))
    plane.dht.records[task_key("t-1")] = Record(key=task_key("t-1"), value=encode(newer), version={"gw-2": 8})
    with pytest.raises(SupersededError):
        await healing.settle(plane, RecordWriter(plane, Draft(record, "gw-1"), {"gw-1": 7}))
    assert [(gateway, verb) for gateway, verb, _ in plane.rpc.calls] == ended
