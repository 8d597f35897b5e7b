"""Forgetting old tasks: the newest stay, effects go only with their task."""

from types import SimpleNamespace
from typing import cast
from unittest.mock import ANY

import msgspec
import pytest
from structlog.testing import capture_logs

from appliance.errors import UnreachableError
from appliance.model import Remembered, TaskRecord, TaskState
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.tasks.retention import AT_ONCE, Retention
from appliance.tasks.settings import TasksConfig

pytestmark = pytest.mark.anyio


class Records:
    """A DHT of one gateway that owns what does not say otherwise."""

    def __init__(self) -> None:
        self.kept: dict[str, Record] = {}

    def put(self, key: str, value: bytes = b"{}") -> None:
        """Keep a record."""
        self.kept[key] = Record(key=key, value=value, version={"gw-1": 1}, deleted=False, write="w")

    def task(self, task: str, state: TaskState, ended: int) -> None:
        """Keep a task's record."""
        record = TaskRecord(id=task, instruction="x", state=state, updated_ns=ended)
        self.put(f"task/{task}", msgspec.json.encode(record))

    def owns(self, key: str) -> bool:
        """Whether a key is ours."""
        return "elsewhere" not in key

    async def local(self, prefix: str) -> list[Record]:
        """The shard."""
        return [record for key, record in self.kept.items() if key.startswith(prefix)]

    async def read(self, key: str) -> Record | None:
        """One record."""
        if "away" in key:
            raise UnreachableError("whoever may have it did not answer")
        return self.kept.get(key)

    async def write(self, key: str, value: bytes, *, expected: dict[str, int]) -> dict[str, int]:
        """Replace one; its version stays as it is, for the sake of `remove`."""
        assert expected == self.kept[key].version
        self.put(key, value)
        return expected

    async def remove(self, key: str, *, expected: dict[str, int]) -> None:
        """Remove one."""
        assert expected == {"gw-1": 1}
        del self.kept[key]


async def test_old_finished_tasks_and_their_effects_are_forgotten() -> None:
    """Running tasks and those of other owners stay, whatever their age; effects follow their task."""
    records = Records()
    for number in range(4):
        records.task(f"old-{number}", TaskState.SUCCEEDED, number)
        records.put(f"effect/old-{number}/s1/1")
    records.task("runs", TaskState.RUNNING, 0)
    records.put("effect/runs/s1/1")
    records.task("elsewhere", TaskState.SUCCEEDED, 0)
    retention = Retention(cast("Plane", SimpleNamespace(dht=records)), TasksConfig(keep_finished=2))
    assert await retention.round() == 4
    assert await retention.round() == 0
    assert set(records.kept) == {
        "task/old-2", "task/old-3", "effect/old-2/s1/1", "effect/old-3/s1/1",
        "task/runs", "effect/runs/s1/1", "task/elsewhere",
    }  # fmt: skip


async def test_checkpoints_of_ended_tasks_are_forgotten() -> None:
    """A task that runs keeps its checkpoints; one that has ended, or is gone, has none."""
    records = Records()
    records.task("runs", TaskState.RUNNING, 0)
    records.task("ended", TaskState.SUCCEEDED, 0)
    for task in ("runs", "ended", "gone"):
        records.put(f"checkpoint/{task}/s1")
    plane = cast("Plane", SimpleNamespace(dht=records))
    assert await Retention(plane, TasksConfig()).round() == 2
    assert [key for key in records.kept if key.startswith("checkpoint/")] == ["checkpoint/runs/s1"]


async def test_what_belongs_to_a_task_that_cannot_be_looked_up_stays() -> None:
    """Whoever has its record may only be away; what belongs to others is forgotten all the same."""
    records = Records()
    for task in ("away", "gone"):
        records.put(f"effect/{task}/s1/1")
        records.put(f"checkpoint/{task}/s1")
    plane = cast("Plane", SimpleNamespace(dht=records))
    assert await Retention(plane, TasksConfig()).round() == 2
    assert sorted(records.kept) == ["checkpoint/away/s1", "effect/away/s1/1"]


async def test_many_tasks_that_are_kept_do_not_hide_what_is_left_over_behind_them() -> None:
    """More than a round looks up: the next goes on from there, and then begins anew."""
    records = Records()
    for number in range(AT_ONCE + 10):
        records.task(f"a{number:04}", TaskState.RUNNING, 0)
        records.put(f"effect/a{number:04}/s1/1")
    records.put("effect/gone/s1/1")
    retention = Retention(cast("Plane", SimpleNamespace(dht=records)), TasksConfig())
    assert [await retention.round() for _ in range(2)] == [0, 1]
    records.put("effect/a/s1/1")
    assert [await retention.round() for _ in range(2)] == [1, 0]


async def test_ids_of_old_tasks_stay_with_their_outcome_and_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tombstone in place of the record, with the log of its time; it goes in the end, or beyond the bound."""
    records, now_ns = Records(), 1_800_000_000 * 10**9
    monkeypatch.setattr("time.time_ns", lambda: now_ns)
    for number in range(4):
        records.task(f"t-{number}", TaskState.SUCCEEDED, now_ns - (4 - number) * 10**9)
        records.put(f"effect/t-{number}/s1/1")
    config = TasksConfig(keep_finished=1, remember_days=1.0, remember_most=2)
    retention = Retention(cast("Plane", SimpleNamespace(dht=records)), config)
    retention.files.heard("recorder", "one.mcap", now_ns - 2 * 10**9)
    with capture_logs() as said:
        await retention.round()
    assert retention.forgotten == 1
    assert [each["count"] for each in said if "before their time" in each["event"]] == [1]
    await retention.round()
    found = {
        key: msgspec.json.decode(each.value, type=TaskRecord) for key, each in records.kept.items() if "task/" in key
    }
    assert {key: each.remembered is not None for key, each in found.items()} == {
        "task/t-1": True, "task/t-2": True, "task/t-3": False,
    }  # fmt: skip
    assert found["task/t-2"].remembered == Remembered(log="one.mcap", request=ANY)
    assert found["task/t-1"].state is TaskState.SUCCEEDED
    assert [key for key in records.kept if key.startswith("effect/")] == ["effect/t-3/s1/1"]
    assert await retention.round() == 0, "what was done is done"
    now_ns += 2 * 86_400 * 10**9
    await retention.round()
    assert [key for key in records.kept if key.startswith("task/")] == ["task/t-3"]
    assert retention.forgotten == 1, "those had their time"
