"""Forgetting old tasks: the newest stay, effects go only with their task."""

from types import SimpleNamespace
from typing import cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import UnreachableError
from appliance.model import TaskRecord, TaskState
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.tasks.retention import AT_ONCE, Retention, surplus
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
    assert await retention.round() == 2
    assert await retention.round() == 2
    assert await retention.round() == 0
    assert set(records.kept) == {
        "task/old-2", "task/old-3", "effect/old-2/s1/1", "effect/old-3/s1/1",
        "task/runs", "effect/runs/s1/1", "task/elsewhere",
    }  # fmt: skip


@given(st.lists(st.tuples(st.integers(0, 9), st.text("abc", min_size=1, max_size=3)), unique=True), st.integers(-1, 9))
def test_what_goes_is_older_than_what_stays(finished: list[tuple[int, str]], keep: int) -> None:
    """The newest are kept, never more than asked, and nothing else goes."""
    gone = surplus(finished, keep)
    assert len(finished) - len(gone) == min(len(finished), max(0, keep))
    stays = [row for row in finished if row[1] not in gone]
    goes = [row for row in finished if row[1] in gone and gone.count(row[1]) == 1]
    if stays and goes and len({key for _, key in finished}) == len(finished):
        assert max(goes) < min(stays)


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
