"""The last events of runs: what is kept of them, and which go."""

import pytest

from appliance.errors import RefusedError
from appliance.model import Need, RunEvent, RunEventKind, RunRequest, encode
from appliance.tasks import executor
from appliance.tasks.executor import KeptRuns
from tests.unit.tasks.fake_plane import FakeStore
from tests.unit.tasks.sample_records import event

pytestmark = pytest.mark.anyio


def told(task: str, attempt: int = 1, kind: RunEventKind = RunEventKind.SUCCEEDED, gateway: str = "gw-1") -> RunEvent:
    """An event of a run of s1."""
    request = RunRequest(task=task, subtask="s1", attempt=attempt, skill="work", need=Need(image="base"))
    return event(request, kind, gateway=gateway)


async def test_of_too_many_runs_the_oldest_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """What nobody asked after goes, in memory and on the disk; a run in progress stays however old it is."""
    monkeypatch.setattr(executor, "KEPT_RUNS", 2)
    store = FakeStore()
    kept = KeptRuns(store, "gw-1")
    for task in ("t-1", "t-2"):
        assert kept.remember(f"{task}/s1/1", told(task), busy=()) == []
        await kept.keep(f"{task}/s1/1", kept.last[f"{task}/s1/1"])
    assert kept.remember("t-3/s1/1", told("t-3"), busy={"t-1/s1/1"}) == ["t-2/s1/1"]
    await kept.forget("t-2/s1/1")
    assert set(kept.last) == {"t-1/s1/1", "t-3/s1/1"}
    assert set(store.values) == {"run/t-1/s1/1"}
    assert (kept.newest("t-1", "s1"), kept.newest("t-2", "s1")) == (1, 0)


async def test_after_a_restart_what_ran_has_failed_and_what_was_passed_on_is_known() -> None:
    """An outcome stands, a run in progress counts as lost, one elsewhere is asked after there, rubbish is dropped."""
    store = FakeStore()
    store.values = {
        "run/t-1/s1/2": encode(told("t-1", 2)),
        "run/t-2/s1/1": encode(told("t-2", kind=RunEventKind.PROGRESS)),
        "run/t-3/s1/1": encode(told("t-3", kind=RunEventKind.PROGRESS, gateway="gw-2")),
        "run/t-4/s1/1": b"{",
        "else": b"{",
    }
    kept = KeptRuns(store, "gw-1")
    assert await kept.load() == {"t-3/s1/1": "gw-2"}
    assert kept.last["t-1/s1/2"].kind is RunEventKind.SUCCEEDED
    failed = kept.last["t-2/s1/1"]
    assert failed.failure is not None
    assert (failed.kind, failed.failure.code, failed.failure.retryable) == (RunEventKind.FAILED, "unreachable", True)
    assert "run/t-4/s1/1" not in store.values
    assert "else" in store.values
    assert (kept.newest("t-1", "s1"), kept.newest("t-4", "s1")) == (2, 0)


async def test_a_disk_that_is_full_hides_nothing() -> None:
    """What cannot be kept is remembered all the same."""
    store = FakeStore()
    store.problem = RefusedError("the disk is full")
    kept = KeptRuns(store, "gw-1")
    kept.remember("t-1/s1/1", told("t-1"), busy=())
    await kept.keep("t-1/s1/1", told("t-1"))
    assert set(kept.last) == {"t-1/s1/1"}
