"""The keeper of alerts on one gateway: what is written when records cannot be, or were not heard of."""

from collections.abc import AsyncIterator
from typing import Any

import anyio
import pytest
from msgspec.structs import replace

from appliance.alerts import keeper
from appliance.alerts.keeper import Keeper
from appliance.errors import UnreachableError
from appliance.model import GatewayStatus, TaskState, VersionVector, Word, encode, keyspace
from appliance.model.alerts import Alert, AlertLevel, Subject
from appliance.plane.dht import LeaveOut, Record
from appliance.plane.events import RingChanged
from appliance.plane.node import Plane
from tests.unit.tasks.fake_plane import FakeDht, FakePlane

pytestmark = pytest.mark.anyio


class PartlyStuck(FakeDht):
    """Records, of which some cannot be written: their owner answers, but its disk is full."""

    stuck: frozenset[str] = frozenset()

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, durable: bool = True
    ) -> VersionVector:
        """Compare and set."""
        if key in self.stuck:
            raise UnreachableError(f"{key} could not be written")
        return await super().write(key, value, expected=expected, durable=durable)

    async def local(self, prefix: str, *, leave_out: LeaveOut | None = None) -> list[Record]:
        """Return the shard, unless all of it is with others."""
        return await super().local(prefix, leave_out=leave_out) if self.mine else []

    def alerts(self) -> set[str]:
        """Return the ids of the alerts that are written."""
        return {key.removeprefix(keyspace.ALERT_RECORD.prefix) for key in self.records}


@pytest.fixture
def plane(monkeypatch: pytest.MonkeyPatch) -> FakePlane:
    """Return a plane of three gateways; alerts are looked after without pauses."""
    monkeypatch.setattr(keeper, "LOOK_S", 0.01)
    monkeypatch.setattr(keeper, "PAUSE_S", 0.01)
    made = FakePlane()
    made.dht = PartlyStuck("gw-1")
    return made


@pytest.fixture
async def kept(plane: FakePlane) -> AsyncIterator[Keeper]:
    """Return its keeper."""
    fake: Any = plane
    real: Plane = fake
    made = Keeper(real)
    made.start(lambda _, handler: handler)
    yield made
    await made.close()


async def until_written(dht: PartlyStuck, wanted: set[str]) -> None:
    """Wait until these alerts are there, and no others."""
    with anyio.fail_after(10):
        while dht.alerts() != wanted:
            await anyio.sleep(0.01)


async def test_alerts_that_cannot_be_written_hold_up_no_others(plane: FakePlane, kept: Keeper) -> None:
    """The alerts of other tasks and of the fleet are written, and those as well once that is possible."""
    dht = plane.dht
    assert isinstance(dht, PartlyStuck)
    stuck = {"task-failed.t-1", "task-failed.t-2", "overload.gw-1", "overload.gw-2"}
    dht.stuck = frozenset(map(keyspace.ALERT_RECORD.key, stuck))
    plane.registry.gateways = {
        name: GatewayStatus(id=name, fleet="f", overloaded="too much", site_problem="no fence")
        for name in ("gw-1", "gw-2", "gw-3")
    }
    for task in ("t-1", "t-2", "t-3"):
        kept.moved(replace(plane.accepted(task), state=TaskState.FAILED))
    wanted = {f"{kind}.{name}" for kind in ("overload", "site") for name in plane.registry.gateways}
    wanted |= {"task-failed.t-1", "task-failed.t-2", "task-failed.t-3"}
    await until_written(dht, wanted - stuck)
    dht.stuck = frozenset()
    await until_written(dht, wanted)


async def test_a_retried_task_has_failed_no_more_though_its_alert_was_not_heard_of(
    plane: FakePlane, kept: Keeper
) -> None:
    """A coordinator that began after the task had failed, and holds no copy of the alert, ends it all the same."""
    dht = plane.dht
    assert isinstance(dht, PartlyStuck)
    dht.mine = False
    alert = Alert(
        id="task-failed.t-1", kind="task-failed", level=AlertLevel.CRITICAL, what="failed", subject=Subject.TASK,
        name="t-1",
    )  # fmt: skip
    await dht.write(keyspace.ALERT_RECORD.key(alert.id), encode(alert), expected=None)
    kept.moved(replace(plane.accepted("t-1"), state=TaskState.RUNNING, retried_by=Word(by="ann", at_ns=1)))
    await until_written(dht, set())
    assert [each.id for each in plane.session.sent(plane.keys(keyspace.ALERT, "*"), Alert) if each.cleared_ns] == [
        alert.id
    ]


class OfOthers(PartlyStuck):
    """Records whose owners are other gateways, and of which this one holds no copy."""

    async def local(self, prefix: str, *, leave_out: LeaveOut | None = None) -> list[Record]:
        """Return nothing."""
        del prefix, leave_out
        return []


async def test_alerts_of_other_owners_that_ended_unheard_are_dropped_after_a_partition(plane: FakePlane) -> None:
    """Once the ring has changed, what is kept of others and has no record any more is forgotten; the rest stays."""
    plane.dht = OfOthers("gw-1")
    plane.dht.mine = False
    fake: Any = plane
    made = Keeper(fake)
    made.start(lambda _, handler: handler)
    try:
        over, stands = (
            Alert(id=f"disk.{name}", kind="disk", level=AlertLevel.WARNING, what="full", subject=Subject.GATEWAY,
                  name=name)
            for name in ("gw-2", "gw-3")
        )  # fmt: skip
        await plane.dht.write(keyspace.ALERT_RECORD.key(stands.id), encode(stands), expected=None)
        for each in (over, stands):
            plane.session.publish(keyspace.ALERT, each, each.id)
        assert set(made._kept) == {over.id, stands.id}
        plane.events.publish(RingChanged())
        with anyio.fail_after(10):
            while over.id in made._kept:
                await anyio.sleep(0.01)
        assert set(made._kept) == {stands.id}
    finally:
        await made.close()


async def test_the_owner_clears_the_alert_of_a_task_that_went_on_in_another_part_of_the_fleet(
    plane: FakePlane, kept: Keeper
) -> None:
    """Its coordinator had moved the task on before it could know of the alert; a task that has failed keeps its own."""
    for name, state in (("t-1", TaskState.RUNNING), ("t-2", TaskState.FAILED)):
        alert = Alert(id=f"task-failed.{name}", kind="task-failed", level=AlertLevel.CRITICAL, what="failed",
                      subject=Subject.TASK, name=name)  # fmt: skip
        await plane.dht.write(keyspace.ALERT_RECORD.key(alert.id), encode(alert), expected=None)
        record = replace(plane.accepted(name), state=state)
        await plane.dht.write(keyspace.TASK_RECORD.key(name), encode(record), expected=None)
    plane.events.publish(RingChanged())
    with anyio.fail_after(10):
        while keyspace.ALERT_RECORD.key("task-failed.t-1") in plane.dht.records:
            await anyio.sleep(0.01)
    assert keyspace.ALERT_RECORD.key("task-failed.t-2") in plane.dht.records
