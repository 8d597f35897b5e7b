"""Checkpoints of runs: kept beside the record, the newest only, fenced by attempt, bounded."""

import asyncio
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import UnreachableError
from appliance.model import RunEvent, RunEventKind, encode
from appliance.tasks import checkpoints as module
from appliance.tasks.checkpoints import (
    Checkpoint,
    Checkpoints,
    checkpoint_key,
    read_checkpoint,
    remove_checkpoint,
    stronger,
)

pytestmark = pytest.mark.anyio

KEY = checkpoint_key("t-1", "s1")


class Told:
    """What the checkpoints of a gateway tell and refuse."""

    def __init__(self, dht: Any, *, max_bytes: int = 1000) -> None:
        self.dht = dht
        self.events: list[RunEvent] = []
        self.refused: list[str] = []
        self.checkpoints = Checkpoints(
            dht,
            gateway="gw-1",
            max_bytes=max_bytes,
            tell=self.events.append,
            refuse=lambda what, reason: self.refused.append(f"{what}: {reason}"),
        )

    def add(self, data: dict[str, Any], attempt: int = 1) -> None:
        """Have a run save something."""
        self.checkpoints.add(event(RunEventKind.CHECKPOINT, attempt=attempt, result=data))

    async def end(self, kind: RunEventKind, attempt: int = 1) -> None:
        """End a run."""
        await self.checkpoints.end(event(kind, attempt=attempt))

    async def kept(self) -> int:
        """Wait until something is kept; returns how often."""
        async with asyncio.timeout(60):
            while not self.events:
                await asyncio.sleep(0.001)
        return len(self.events)


def event(kind: RunEventKind, *, attempt: int = 1, **fields: Any) -> RunEvent:
    """Return an event of a run."""
    return RunEvent(task="t-1", subtask="s1", attempt=attempt, kind=kind, **fields)


async def kept(dht: Any) -> dict[str, Any] | None:
    """Return the data of the subtask's checkpoint."""
    found = await read_checkpoint(dht, "t-1", "s1")
    return None if found is None else found.data


@pytest.fixture
def told(plane: Any) -> Told:
    """Return the checkpoints of a gateway on fakes."""
    return Told(plane.dht)


async def test_the_last_checkpoint_of_a_failed_run_is_what_the_next_attempt_gets(
    told: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first is written at once, those that follow within the pause are one write at the end: the newest."""
    monkeypatch.setattr(module, "EVERY_S", 3600.0)
    told.add({"at": 1})
    await told.kept()
    assert await kept(told.dht) == {"at": 1}
    for number in range(2, 50):
        told.add({"at": number})
    await told.end(RunEventKind.FAILED)
    assert await kept(told.dht) == {"at": 49}
    assert told.dht.writes == 2
    assert [each.kind for each in told.events] == [RunEventKind.CHECKPOINT] * 2
    assert all(each.result is None and "kept" in each.note for each in told.events)


async def test_writes_of_a_run_are_a_second_apart(told: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes meanwhile waits and is written without another one coming."""
    monkeypatch.setattr(module, "EVERY_S", 0.05)
    told.add({"at": 1})
    await told.kept()
    told.add({"at": 2})
    async with asyncio.timeout(60):
        while await kept(told.dht) != {"at": 2}:
            await asyncio.sleep(0.005)
    await told.end(RunEventKind.SUCCEEDED)


async def test_an_outdated_run_does_not_replace_a_newer_ones(told: Told) -> None:
    """The attempt fences; a later attempt does replace an earlier one's."""
    told.add({"of": 2}, attempt=2)
    await told.end(RunEventKind.FAILED, attempt=2)
    told.add({"of": 1}, attempt=1)
    await told.end(RunEventKind.FAILED, attempt=1)
    assert await kept(told.dht) == {"of": 2}
    told.add({"of": 3}, attempt=3)
    await told.end(RunEventKind.FAILED, attempt=3)
    assert await kept(told.dht) == {"of": 3}


@pytest.mark.parametrize("data", [{"x": "y" * 2000}, {"x": "\ud800"}, "deep"])
async def test_what_cannot_be_kept_is_refused_and_the_last_one_stands(told: Told, data: Any) -> None:
    """Oversize, not JSON, nested without end: counted, and told as a line of the run's log."""
    told.add({"at": 1})
    await told.kept()
    if data == "deep":
        data = {}
        for _ in range(5000):
            data = {"a": data}
    told.add(data)
    assert len(told.refused) == 1
    assert told.events[-1].kind is RunEventKind.LOG
    assert "the last one before it stands" in told.events[-1].note
    await told.end(RunEventKind.FAILED)
    assert await kept(told.dht) == {"at": 1}


async def test_a_plane_that_fails_costs_the_checkpoint_only(told: Told) -> None:
    """A write that does not work is tried again with the next one; a read that does not work is no checkpoint."""
    told.dht.break_next = [UnreachableError("no owner")]
    told.add({"at": 1})
    await told.end(RunEventKind.FAILED)
    assert await kept(told.dht) is None
    told.add({"at": 2}, attempt=2)
    await told.end(RunEventKind.FAILED, attempt=2)
    assert await kept(told.dht) == {"at": 2}

    async def away(key: str) -> None:
        raise UnreachableError("nobody answers")

    told.dht.read = away
    assert await kept(told.dht) is None
    await remove_checkpoint(told.dht, "t-1", "s1")


async def test_removed_is_gone(told: Told) -> None:
    """After the task's end nothing is left; removing what is not there does no harm."""
    told.add({"at": 1})
    await told.end(RunEventKind.FAILED)
    await remove_checkpoint(told.dht, "t-1", "s1")
    await remove_checkpoint(told.dht, "t-1", "s1")
    assert KEY not in told.dht.records


versions = st.one_of(
    st.binary(max_size=20),
    st.builds(
        lambda attempt, at: encode(Checkpoint(attempt=attempt, gateway="g", at_ns=at, data={})),
        st.integers(1, 20),
        st.integers(0, 10),
    ),
)


@given(versions, versions, versions)
def test_concurrent_checkpoints_settle_alike_everywhere(one: bytes, two: bytes, three: bytes) -> None:
    """Commutative and associative; a later attempt's wins."""
    assert stronger(one, two) == stronger(two, one)
    assert stronger(stronger(one, two), three) == stronger(one, stronger(two, three))
    try:
        found = [msgspec.json.decode(each, type=Checkpoint) for each in (one, two)]
    except (msgspec.DecodeError, UnicodeDecodeError):
        return
    winner = msgspec.json.decode(stronger(one, two), type=Checkpoint)
    assert winner.attempt == max(each.attempt for each in found)


RUN = ("t-1", "s1", 1)


async def test_a_fresh_checkpoint_is_written_at_once(told: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only when the pause between writes is over; and it says whether it came for the asking."""
    monkeypatch.setattr(module, "EVERY_S", 3600.0)
    told.add({"at": 1})
    await told.kept()

    async def ask() -> bool:
        told.add({"at": 2})
        return True

    assert await told.checkpoints.fresh(RUN, ask, wait_s=60.0, may_save=True)
    assert await kept(told.dht) == {"at": 2}
    assert told.checkpoints.any_of(RUN)


async def test_a_handler_that_saves_nothing_is_not_waited_for_long(told: Told) -> None:
    """What it saved before is written all the same; one whose skill never saves is not even asked."""
    asked: list[int] = []

    async def deaf() -> bool:
        asked.append(1)
        return True

    assert not await told.checkpoints.fresh(RUN, deaf, wait_s=0.05, may_save=False)
    assert not asked
    told.add({"at": 1})
    assert not await told.checkpoints.fresh(RUN, deaf, wait_s=0.05, may_save=False)
    assert asked == [1]
    assert await kept(told.dht) == {"at": 1}


async def test_a_checkpoint_that_cannot_be_written_does_not_hold_a_move_up(told: Told, plane: Any) -> None:
    """The run goes on from the one before, after the time it is given."""
    plane.dht.break_next = [UnreachableError("no owner")]

    async def ask() -> bool:
        told.add({"at": 1})
        return True

    assert not await told.checkpoints.fresh(RUN, ask, wait_s=0.05, may_save=True)
    assert await kept(told.dht) is None
