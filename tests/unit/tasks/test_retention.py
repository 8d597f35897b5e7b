"""Forgetting old tasks: the newest stay, effects go only with their task."""

import asyncio
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import ANY

import msgspec
import pytest
from structlog.testing import capture_logs

from appliance.errors import PrerequisiteError, RefusedError, UnreachableError
from appliance.model import Remembered, TaskRecord, TaskState
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.tasks import retention as retention_module
from appliance.tasks.artifacts import Artifacts
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
            raise UnreachableError("the gateway that may have it did not answer")
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


async def test_what_belongs_to_a_running_task_stays_whatever_the_rest_of_its_key() -> None:
    """A newer version may write keys of more names: they go with their task all the same."""
    records = Records()
    for task in ("runs", "gone"):
        records.put(f"effect/{task}/s1/1/part")
        records.put(f"ask/{task}")
    records.task("runs", TaskState.RUNNING, 0)
    assert await Retention(cast("Plane", SimpleNamespace(dht=records)), TasksConfig()).round() == 2
    assert sorted(records.kept) == ["ask/runs", "effect/runs/s1/1/part", "task/runs"]


class Store:
    """A gateway's store on a disk that cannot be read."""

    async def get(self, key: str) -> bytes:
        """Fail."""
        raise PrerequisiteError(f"{key}: the disk fails")

    async def put(self, key: str, value: bytes, *, durable: bool) -> None:
        """Keep nothing."""


async def test_nothing_that_a_round_meets_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """It runs as a root task: its end would be the gateway's, and that of the record's next owner."""
    session = SimpleNamespace(subscribe_typed=lambda *_: None)
    plane = cast("Plane", SimpleNamespace(dht=Records(), store=Store(), session=session))
    retention, rounds = Retention(plane, TasksConfig(retention_s=0.01)), list[int]()

    async def round_() -> int:
        rounds.append(len(rounds))
        raise (ValueError if len(rounds) % 2 else RefusedError)("a record like no other")

    monkeypatch.setattr(retention, "round", round_)
    running = asyncio.create_task(retention.run())
    while len(rounds) < 4 and not running.done():
        await asyncio.sleep(0.01)
    assert not running.done()
    running.cancel()


async def test_what_belongs_to_a_task_that_cannot_be_looked_up_stays() -> None:
    """The owner of its record may only be away; what belongs to others is forgotten all the same."""
    records = Records()
    for task in ("away", "gone"):
        records.put(f"effect/{task}/s1/1")
        records.put(f"checkpoint/{task}/s1")
    plane = cast("Plane", SimpleNamespace(dht=records))
    assert await Retention(plane, TasksConfig()).round() == 2
    assert sorted(records.kept) == ["checkpoint/away/s1", "effect/away/s1/1"]


async def test_many_tasks_that_are_kept_do_not_hide_what_is_left_over_behind_them() -> None:
    """More than a round looks up: the next goes on from there, and then begins again."""
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


async def test_files_go_with_their_task(tmp_path: Path) -> None:
    """Files of tasks that are trimmed are removed, those of others stay, and so does what other records own."""
    records = Records()
    records.task("kept", TaskState.RUNNING, 0)
    trimmed = TaskRecord(
        id="trimmed", instruction="x", state=TaskState.SUCCEEDED, updated_ns=time.time_ns(), remembered=Remembered()
    )
    records.put("task/trimmed", msgspec.json.encode(trimmed))
    files = Artifacts(tmp_path, gateway="gw-1", max_bytes=100)
    owners = ["learn/r1", "task/away", "task/gone", "task/kept", "task/trimmed"]
    for owner in owners:
        await files.put("a", owner.encode(), "text/plain", owner=owner)
    await files.put("a", b"shared", "text/plain", owner="task/trimmed")
    await files.put("a", b"shared", "text/plain", owner="task/kept")
    retention = Retention(cast("Plane", SimpleNamespace(dht=records)), TasksConfig(), files)
    await retention.round()
    assert await files.owners() == ("learn/r1", "task/away", "task/gone", "task/kept")
    assert len(list(tmp_path.glob("??/*"))) == 5


async def test_files_outlast_a_partition(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gateway cut off from all that hold a task's record keeps its files; they go when it is absent for a day."""
    records, files = Records(), Artifacts(tmp_path, gateway="gw-1", max_bytes=100)
    await files.put("a", b"picture", "image/png", owner="task/t-1")
    retention = Retention(cast("Plane", SimpleNamespace(dht=records)), TasksConfig(), files)
    await retention.round()
    records.task("t-1", TaskState.RUNNING, 0)
    await retention.round()
    monkeypatch.setattr(retention_module, "ABSENT_S", 0.05)
    del records.kept["task/t-1"]
    await retention.round()
    assert await files.owners() == ("task/t-1",)
    await asyncio.sleep(0.1)
    await retention.round()
    assert await files.owners() == ()


async def test_all_owners_of_files_have_their_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With more owners than a round looks up, the next round goes on behind them, and then begins again."""
    monkeypatch.setattr(retention_module, "AT_ONCE", 2)
    monkeypatch.setattr(retention_module, "ABSENT_S", 0.0)
    records, files = Records(), Artifacts(tmp_path, gateway="gw-1", max_bytes=100)
    for number in range(5):
        await files.put("a", b"%d" % number, "text/plain", owner=f"task/{number}")
        if number < 4:
            records.task(str(number), TaskState.RUNNING, 0)
    retention = Retention(cast("Plane", SimpleNamespace(dht=records)), TasksConfig(), files)
    for _ in range(3):
        await retention.round()
    assert await files.owners() == ("task/0", "task/1", "task/2", "task/3")
    del records.kept["task/0"]
    await retention.round()
    assert await files.owners() == ("task/1", "task/2", "task/3")
