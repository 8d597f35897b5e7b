"""The schedules of a gateway: submitted once by the owner of the record, also over takeovers, failures and pauses."""

# pyright: reportPrivateUsage=false

from typing import Any

import pytest
from msgspec.structs import replace

from appliance.alerts.rules import Finding
from appliance.errors import ConflictError, NotFoundError, PayloadError, RefusedError, UnreachableError
from appliance.model import TaskRecord, TaskRequest, TaskState, encode
from appliance.model.keys import check_name
from appliance.model.schedules import (
    InstructionRemove,
    InstructionsAsk,
    InstructionSave,
    Schedule,
    ScheduleAdd,
    ScheduleList,
    SchedulesAsk,
    ScheduleSpec,
    ScheduleSteer,
)
from appliance.model.task_api import TaskAsk
from appliance.plane.dht import Record
from appliance.schedules import records
from appliance.schedules.manager import ScheduleManager
from tests.unit.tasks.fake_plane import FakeDht, FakePlane

pytestmark = pytest.mark.anyio
S = 10**9
SPEC = ScheduleSpec(id="patrol", instruction="rover_1: go to dock 1", every_s=60.0, priority=7)


class Fleet:
    """What gateways share: records, tasks by id, and a clock."""

    def __init__(self) -> None:
        self.dht = FakeDht("gw-1")
        self.tasks: dict[str, TaskRecord] = {}
        self.submitted: list[TaskRequest] = []
        self.told: list[Finding] = []
        self.now = 1000 * S
        self.problem: Exception | None = None

    def gateway(self) -> ScheduleManager:
        """Return the schedules of one more gateway that owns the records."""
        plane: Any = FakePlane()
        plane.dht = self.dht
        return ScheduleManager(
            plane,
            submit=self.submit,
            task=self.task,
            check=self.check,
            report=self.told.append,
            now_ns=lambda: self.now,
        )

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task; the same id is the same task."""
        if self.problem is not None:
            raise self.problem
        check_name(request.id, "task")
        self.submitted.append(request)
        return self.tasks.setdefault(
            request.id, TaskRecord(id=request.id, instruction=request.instruction, state=TaskState.SUCCEEDED)
        )

    async def task(self, ask: TaskAsk) -> TaskRecord:
        """Return a task."""
        if ask.id not in self.tasks:
            raise NotFoundError(ask.id)
        return self.tasks[ask.id]

    def check(self, request: TaskRequest) -> None:
        """Refuse a stop."""
        if request.instruction == "stop":
            raise RefusedError("it is a stop")

    def record(self, name: str = "patrol") -> Schedule:
        """Return a schedule as it is stored."""
        return records.read(self.dht.records[records.schedule_key(name)].value, Schedule)


@pytest.fixture
def fleet() -> Fleet:
    """Return an empty one."""
    return Fleet()


async def added(fleet: Fleet, **fields: Any) -> ScheduleManager:
    """Return a gateway with one schedule, added just now."""
    made = fleet.gateway()
    await made.add(ScheduleAdd(spec=replace(SPEC, **fields), by="ann", why="at night"))
    return made


async def test_a_task_is_submitted_when_it_is_due(fleet: Fleet) -> None:
    """In the name of who added it, with what the schedule says; the record says up to where it is handled."""
    made = await added(fleet)
    assert await made.look() == 5.0
    assert fleet.submitted == []
    fleet.now += 61 * S
    await made.look()
    await made.look()
    (request,) = fleet.submitted
    assert (request.id, request.submitter, request.priority) == ("patrol.19700101t001740z", "ann", 7)
    found = fleet.record()
    assert (found.fired, found.task, found.missed) == (1, request.id, 0)
    assert found.handled_ns == found.fired_ns == 1060 * S
    fleet.now += 57 * S
    assert await made.look() == pytest.approx(2.0)


async def test_a_takeover_never_submits_twice(fleet: Fleet) -> None:
    """The owner goes after it has submitted and before it has noted that: the next one submits the same task."""
    first = await added(fleet)
    fleet.now += 60 * S
    fleet.dht.break_next = [UnreachableError("gone")]
    await first.look()
    assert fleet.record().fired == 0
    await fleet.gateway().look()
    assert [each.id for each in fleet.submitted] == ["patrol.19700101t001740z"] * 2
    assert len(fleet.tasks) == 1
    assert fleet.record().fired == 1


async def test_two_owners_at_a_time_are_one_task(fleet: Fleet) -> None:
    """While the ring settles both may look: one of them writes, and neither moves a robot twice."""
    one, other = await added(fleet), fleet.gateway()
    fleet.now += 60 * S
    stored = fleet.dht.records[records.schedule_key("patrol")]
    await one.look()
    fleet.dht.records[records.schedule_key("patrol")], written = stored, fleet.dht.records[stored.key]
    fleet.dht.break_next = [ConflictError("moved on")]
    await other.look()
    fleet.dht.records[stored.key] = written
    await other.look()
    assert len(fleet.tasks) == 1


async def test_a_gateway_that_does_not_own_it_leaves_it(fleet: Fleet) -> None:
    """It looks, and does nothing."""
    made = await added(fleet)
    fleet.dht.mine = False
    fleet.now += 600 * S
    assert await made.look() == 5.0
    assert fleet.submitted == []


async def test_missed_times_are_reported(fleet: Fleet) -> None:
    """While nothing ran nine times were due: an alert says how many, the last when, and what to do; one is on time."""
    made = await added(fleet)
    fleet.now += 10 * 60 * S
    await made.look()
    (told,) = fleet.told
    assert told.id == "schedule-missed.patrol"
    assert "missed 9 times" in told.what
    assert told.remedy
    assert [each.id for each in fleet.submitted] == ["patrol.19700101t002640z"]
    assert (fleet.record().missed, fleet.record().fired) == (9, 1)


async def test_a_missed_time_is_run_late_by_setting(fleet: Fleet) -> None:
    """The last one, once; the alert says so."""
    made = await added(fleet, every_s=3600.0, late="run")
    fleet.now += (2 * 3600 + 900) * S
    await made.look()
    await made.look()
    assert len(fleet.submitted) == 1
    assert "submitted late" in fleet.told[0].what
    assert (fleet.record().missed, fleet.record().fired) == (2, 1)


async def test_what_cannot_be_submitted_is_tried_until_it_is_too_late(fleet: Fleet) -> None:
    """A full fleet: nothing is written until then; then it counts as missed, with the reason."""
    made = await added(fleet)
    fleet.problem = RefusedError("the coordinator is full")
    fleet.now += 60 * S
    assert await made.look() == 1.0
    assert fleet.record().handled_ns == 1000 * S
    fleet.now += 59 * S
    await made.look()
    assert fleet.told == []
    fleet.now += 2 * S
    fleet.problem = None
    await made.look()
    assert [each.id for each in fleet.submitted] == ["patrol.19700101t001840z"]
    assert fleet.record().missed == 1
    fleet.problem = RefusedError("the coordinator is full")
    fleet.now += 59 * S
    await made.look()
    fleet.now += 1000 * S
    await made.look()
    assert fleet.told[-1].what.count("no gateway") + fleet.told[-1].what.count("full") == 1


async def test_while_its_last_task_runs_the_next_is_missed(fleet: Fleet) -> None:
    """Unless tasks of it may overlap; one whose record cannot be read counts as running."""
    made = await added(fleet)
    fleet.now += 60 * S
    await made.look()
    task = fleet.submitted[0].id
    fleet.tasks[task] = replace(fleet.tasks[task], state=TaskState.RUNNING)
    fleet.now += 60 * S
    await made.look()
    assert len(fleet.submitted) == 1
    assert f"{task} had not ended" in fleet.told[-1].what
    fleet.tasks[task] = replace(fleet.tasks[task], state=TaskState.FAILED)
    fleet.now += 60 * S
    await made.look()
    assert len(fleet.submitted) == 2


async def test_paused_and_resumed(fleet: Fleet) -> None:
    """Nothing is submitted or missed during a pause; afterwards it goes on at its own times."""
    made = await added(fleet)
    paused = await made.steer(ScheduleSteer(id="patrol", do="pause", by="bob", why="holidays"))
    assert paused.paused is not None
    assert (await made.schedules(SchedulesAsk(local=True))).schedules[0].next_ns == ()
    fleet.now += 6000 * S
    await made.look()
    await made.steer(ScheduleSteer(id="patrol", do="resume", by="bob"))
    await made.look()
    assert (fleet.submitted, fleet.told, fleet.record().missed) == ([], [], 0)
    fleet.now += 60 * S
    await made.look()
    assert len(fleet.submitted) == 1


async def test_removed_it_is_over(fleet: Fleet) -> None:
    """It answers with what it was; then there is none of that name."""
    made = await added(fleet)
    assert (await made.steer(ScheduleSteer(id="patrol", do="remove", by="bob"))).spec == SPEC
    fleet.now += 60 * S
    await made.look()
    assert fleet.submitted == []
    for do in ("pause", "resume", "remove"):
        with pytest.raises(NotFoundError, match="patrol"):
            await made.steer(ScheduleSteer(id="patrol", do=do))


async def test_a_removed_one_is_remembered(fleet: Fleet) -> None:
    """For months, so that no gateway that was off brings it back; its name is free, and in the end it is forgotten."""
    made = await added(fleet)
    await made.steer(ScheduleSteer(id="patrol", do="remove", by="bob", why="moved out"))
    removed = fleet.record().removed
    assert removed is not None
    assert (removed.by, removed.why) == ("bob", "moved out")
    assert (await made.schedules(SchedulesAsk(local=True))).schedules == ()
    fleet.now += 80 * 86_400 * S
    await made.look()
    assert fleet.record().removed == removed
    fresh = await made.add(ScheduleAdd(spec=SPEC, by="ann"))
    assert (fresh.removed, fresh.fired, fleet.record()) == (None, 0, fresh)
    await made.steer(ScheduleSteer(id="patrol", do="remove", by="bob"))
    fleet.now += 91 * 86_400 * S
    await made.look()
    assert fleet.dht.records == {}
    assert fleet.submitted == []


async def test_adding_is_once(fleet: Fleet) -> None:
    """The same again is the same one; another of that name, a stop, a bad name and a bad time are refused."""
    made = await added(fleet)
    before = fleet.record()
    assert await made.add(ScheduleAdd(spec=SPEC, by="bob")) == before
    for spec, error in (
        (replace(SPEC, every_s=61.0), RefusedError), (replace(SPEC, id="b", instruction="stop"), RefusedError),
        (replace(SPEC, id="Not A Name"), PayloadError), (replace(SPEC, id="x" * 41), PayloadError),
        (replace(SPEC, id="c", cron="0 7 * * *"), PayloadError),
    ):  # fmt: skip
        with pytest.raises(error) as refused:
            await made.add(ScheduleAdd(spec=spec, by="ann"))
        assert getattr(refused.value, "remedy", "") or spec.instruction == "stop"
    assert set(fleet.dht.records) == {"schedule/patrol"}


async def test_a_record_that_cannot_be_read_stops_no_other(fleet: Fleet) -> None:
    """It is counted; the others' tasks are submitted."""
    made = await added(fleet)
    fleet.dht.records["schedule/a"] = Record(key="schedule/a", value=b"{", version={"gw-1": 1})
    fleet.now += 60 * S
    await made.look()
    assert len(fleet.submitted) == 1


@pytest.mark.parametrize(
    "times", [{"cron": "61 * * * *"}, {"every_s": 1e-12}, {"cron": "0 7 * * *", "zone": "Nowhere"}, {}]
)
async def test_a_record_whose_times_are_none_stops_no_other(fleet: Fleet, times: dict[str, Any]) -> None:
    """It has the form of a schedule: it is counted and left out of the list, and the others' tasks are submitted."""
    made = await added(fleet)
    bad = replace(fleet.record(), spec=ScheduleSpec(id="a", instruction="rover_1: go to dock 1", **times))
    good = fleet.dht.records.pop("schedule/patrol")
    fleet.dht.records["schedule/a"] = Record(key="schedule/a", value=encode(bad), version={"gw-1": 1})
    fleet.dht.records["schedule/patrol"] = good
    fleet.now += 60 * S
    await made.look()
    assert len(fleet.submitted) == 1
    plane: Any = made._plane
    assert plane.session.refused
    assert [each.schedule.id for each in (await made.schedules(SchedulesAsk(local=True))).schedules] == ["patrol"]


async def test_all_schedules_of_a_fleet(fleet: Fleet) -> None:
    """Those of each gateway's shard, by name; who does not answer is named."""
    made = await added(fleet)
    other = (await made.schedules(SchedulesAsk(local=True))).schedules[0]
    shown = replace(other, schedule=replace(other.schedule, spec=replace(SPEC, id="a")), owner="gw-2")
    plane: Any = made._plane

    async def answer(gateway: str, ask: SchedulesAsk) -> ScheduleList:
        assert ask.local
        if gateway == "gw-3":
            raise UnreachableError("gone")
        return ScheduleList(schedules=(shown,))

    plane.rpc.on["schedules"] = answer
    found = await made.schedules(SchedulesAsk())
    assert [(each.schedule.id, each.owner) for each in found.schedules] == [("a", "gw-2"), ("patrol", "gw-1")]
    assert found.schedules[1].next_ns[:2] == (1060 * S, 1120 * S)
    assert found.unreachable == ("gw-3",)


async def test_saved_instructions(fleet: Fleet) -> None:
    """Saved, listed, replaced only when that is asked for, removed."""
    made = fleet.gateway()
    ask = InstructionSave(id="fetch", text="rover_1: fetch {thing}", by="ann")
    saved = await made.save(ask)
    assert saved.saved is not None
    assert (await made.saved(InstructionsAsk(local=True))).instructions == (saved,)
    with pytest.raises(RefusedError, match="fetch"):
        await made.save(ask)
    with pytest.raises(PayloadError):
        await made.save(replace(ask, id="b", text="{"))
    again = await made.save(replace(ask, text="rover_2: fetch {thing}", replace=True))
    assert (await made.saved(InstructionsAsk(local=True))).instructions == (again,)
    assert await made.remove(InstructionRemove(id="fetch")) == again
    with pytest.raises(NotFoundError):
        await made.remove(InstructionRemove(id="fetch"))


async def test_a_clock_that_is_put_back_submits_nothing_again(fleet: Fleet) -> None:
    """What is handled is handled, whatever the clock says."""
    made = await added(fleet)
    fleet.now += 60 * S
    await made.look()
    fleet.now -= 60 * S
    await made.look()
    fleet.now += 60 * S
    await made.look()
    assert len(fleet.submitted) == 1
