"""Reading what gateways write into their logs."""

import json
from pathlib import Path

import pytest
from msgspec.structs import replace

from appliance.errors import DeadlineError, UnreachableError
from appliance.model import TaskRecord, TaskState
from appliance.plane.ring import Ring
from appliance.tasks.machine import Transition, TransitionKind
from workshop.bench.failover.takeover import Heard, LogTail, adoptions, apart, holder_without_a_part, wall_s

pytestmark = pytest.mark.anyio


async def test_only_new_whole_lines_are_read(tmp_path: Path) -> None:
    """What was there before is left, half a line waits for its rest, what is no JSON object is passed over."""
    path = tmp_path / "gw.log"
    path.write_text('{"event": "old"}\n')
    tail = LogTail(path)
    with path.open("a") as file:
        file.write('{"event": "one"}\nTraceback (most recent call last)\n[1]\n{"eve')
    assert [each["event"] for each in tail.read()] == ["one"]
    with path.open("a") as file:
        file.write('nt": "two"}\n')
        file.write('{"event": "more"}\n')
    assert (await tail.until(lambda line: line["event"] == "two", "two", wait_s=10))["event"] == "two"
    assert (await tail.until(lambda line: line["event"] == "more", "more", wait_s=10))["event"] == "more"
    with pytest.raises(DeadlineError, match="three"):
        await tail.until(lambda line: line["event"] == "three", "three", wait_s=0.01)


async def test_a_file_that_comes_later_is_read_from_its_beginning(tmp_path: Path) -> None:
    """A gateway's first line counts too; its time is that of the wall clock."""
    tail = LogTail(tmp_path / "gw.log")
    assert tail.read() == []
    line = {"event": "gateway lost", "timestamp": "2026-11-21T22:20:53.500000Z"}
    (tmp_path / "gw.log").write_text(json.dumps(line) + "\n")
    (found,) = tail.read()
    assert wall_s(found) == pytest.approx(1795299653.5)


def test_takeovers_are_read_from_the_successors_logs() -> None:
    """The first from the one that was lost counts, with what the time went into; those from others do not."""

    def line(second: float, event: str, **fields: object) -> dict[str, object]:
        return {"timestamp": f"2026-11-21T22:20:{second:06.3f}Z", "event": event, **fields}

    lines = {
        "gw-1": [
            line(10.1, "shard settled", why="arrival"),
            line(10.2, "shard settled", why="loss"),
            line(10.25, "task adopted", task="t-1", before="gw-2", wrote_ms=20.0),
            line(10.3, "task adopted", task="t-2", before="gw-3", wrote_ms=5.0),
            line(11.0, "task adopted", task="t-3", before="gw-2", wrote_ms=5.0),
        ],
        "gw-3": [line(10.5, "task adopted", task="t-3", before="gw-2", wrote_ms=7.0)],
    }
    found = adoptions(lines, "gw-2")
    assert {task: each.by for task, each in found.items()} == {"t-1": "gw-1", "t-3": "gw-3"}
    seen_at = wall_s(line(10.05, ""))
    assert found["t-1"].parts(seen_at) == pytest.approx({"settled": 150.0, "taken_up": 30.0, "written": 20.0}, abs=0.1)
    # A shard that was compared before the loss was seen is not what it waited for.
    assert found["t-3"].parts(seen_at) == pytest.approx({"settled": 0.0, "taken_up": 443.0, "written": 7.0}, abs=0.1)


def test_a_run_that_two_coordinators_tell_of_is_one_run() -> None:
    """Twice the same transition is one, two of the same attempt were one run, two attempts that succeeded are two."""
    heard = Heard(())
    for task, attempt, coordinator, sequence in (
        ("t-1", 1, "gw-1", 5), ("t-1", 1, "gw-1", 5), ("t-2", 1, "gw-1", 5), ("t-2", 1, "gw-2", 6),
        ("t-3", 1, "gw-1", 5), ("t-3", 2, "gw-2", 7),
    ):  # fmt: skip
        told = Transition(
            task=task, sequence=sequence, kind=TransitionKind.SUCCEEDED, at_ns=1, coordinator=coordinator,
            subtask="s1", attempt=attempt,
        )  # fmt: skip
        heard.hear(told)
    tasks = ("t-1", "t-2", "t-3")
    assert [each.split()[0] for each in heard.run_twice(tasks)] == ["t-3/s1"]
    assert heard.told_twice(tasks) == ["t-2/s1 attempt 1: gw-1 #5, gw-2 #6"]
    assert heard.run_twice(tasks[:2]) == heard.told_twice(tasks[:1]) == []
    assert (heard.tellers(tasks), heard.tellers(tasks[:1])) == ({"t-2": {"gw-1", "gw-2"}}, {})


async def test_two_coordinators_must_have_one_record_in_the_end() -> None:
    """They may take a moment to agree; records that stay different, or cannot be read, are named with who has what."""
    done = TaskRecord(id="t", instruction="i", state=TaskState.SUCCEEDED, coordinator="gw-1", sequence=7)
    behind = replace(done, coordinator="gw-2", sequence=6)
    has: dict[tuple[str, str], TaskRecord] = {
        ("gw-1", "late"): done, ("gw-2", "late"): behind, ("gw-1", "split"): done, ("gw-2", "split"): behind,
        ("gw-1", "lost"): done,
    }  # fmt: skip
    pauses: list[float] = []

    async def read(gateway: str, task: str) -> TaskRecord:
        if (gateway, task) not in has:
            raise UnreachableError("no answer")
        return has[gateway, task]

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        has["gw-2", "late"] = done

    both = {"gw-2", "gw-1"}
    assert await apart({"late": both}, read, tries=3, pause=pause) == []
    assert len(pauses) == 1
    split, lost = await apart({"late": both, "split": both, "lost": both}, read, tries=3, pause=pause)
    assert split == "split has no one record: gw-1 succeeded #7 of gw-1, gw-2 succeeded #6 of gw-2"
    assert lost == "lost has no one record: no answer"


def test_who_is_made_silent_holds_copies_and_takes_nothing_over() -> None:
    """Otherwise nobody would wait for it, or its own tasks would wait until it is lost too."""
    ring = Ring((f"gw-{number}" for number in range(1, 9)), virtual_nodes=32)
    tasks = [name for name in (f"t-{number}" for number in range(100)) if ring.owner(f"task/{name}") == "gw-1"][:3]
    mute = holder_without_a_part(ring, "gw-1", tasks)
    left = ring.without_member("gw-1")
    assert mute not in {left.owner(f"task/{name}") for name in tasks}
    assert any(mute in left.successors(f"task/{name}", 3) for name in tasks)
    assert holder_without_a_part(Ring(("gw-1", "gw-2"), virtual_nodes=32), "gw-1", tasks) == ""
