"""Reading what gateways write into their logs."""

import json
from pathlib import Path

import pytest

from appliance.bench.failover.logs import LogTail, wall_s
from appliance.errors import DeadlineError

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
