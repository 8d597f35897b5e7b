"""Recorded runs of real fleets: today's deciders must decide as they did then, and the terminal UI must show it.

`logs/runs/` has a normal run, one whose gateways were killed, one that was cut in two and healed, and one whose gateway
was short of memory and gave its runs away; `scripts/record_replay_logs.sh` records them again. docs/replay.md says how
an incident becomes such a test.
"""

from collections import Counter
from functools import cache
from pathlib import Path

import msgspec
import pytest

from appliance.learn.decisions import all_traced
from appliance.model import ContainerInfo, ContainerState, TaskRecord
from appliance.model.keys import Keys
from appliance.record.models import LoggedMessage
from appliance.record.reader import info, read
from appliance.tasks.replay import CheckReport, check
from appliance.tui.store import Store
from appliance.tui.subscriptions import Hearing

LOGS = Path(__file__).parent / "logs" / "runs"
LARGEST_BYTES = 300_000
RUNS: dict[str, set[str]] = {
    "normal.mcap": set(),
    "gateway-killed.mcap": {"adopted", "attempt failed"},
    "partition.mcap": {"adopted", "healed"},
    "overload-migration.mcap": {"moved"},
}
"""Each with the kinds of transitions that make it what it is."""


@cache
def messages(name: str) -> tuple[LoggedMessage, ...]:
    """Return a log's messages."""
    return tuple(read(LOGS / name))


@cache
def report(name: str) -> CheckReport:
    """Return what comes of making its decisions again."""
    return check([LOGS / name], traced=all_traced())


@pytest.mark.parametrize("name", RUNS)
def test_every_decision_comes_out_as_it_was(name: str) -> None:
    """Task state machine, placements and the pool's selections: made again from what they rested on then."""
    found = report(name)
    assert found.same, found.divergences[0]
    assert {"machine", "record", "placement", "selection"} <= found.checked.keys()
    assert found.problems == ()


@pytest.mark.parametrize("name", RUNS)
def test_the_log_shows_what_its_name_says(name: str) -> None:
    """A run of a killed gateway has takeovers, a partition heals, overload moves runs; nothing ends in failure.

    That a task has ended may be published by nobody: its coordinator was killed.
    """
    kinds: Counter[str] = Counter()
    ends: dict[str, str] = {}
    for message in messages(name):
        if message.key.endswith("/transition"):
            kinds[msgspec.json.decode(message.payload)["kind"]] += 1
        elif message.key.endswith("/record"):
            record = msgspec.json.decode(message.payload, type=TaskRecord)
            ends[record.id] = str(record.state)
    assert RUNS[name] <= kinds.keys()
    assert {"succeeded"} <= set(ends.values()) <= {"succeeded", "running"}
    if not RUNS[name]:
        assert not {"adopted", "attempt failed", "healed", "moved"} & kinds.keys()


@pytest.mark.parametrize("name", RUNS)
def test_the_terminal_ui_shows_it(name: str) -> None:
    """Its store, fed with the log, has each task as it ended, each gateway, and the containers that were left."""
    fleet = info(LOGS / name).metadata["fleet"]
    store, keys = Store(), Keys(fleet)
    hearing = Hearing(store, fleet)
    ends: dict[str, TaskRecord] = {}
    statuses: set[str] = set()
    left: dict[str, ContainerInfo] = {}
    for message in messages(name):
        hearing.hear(message.key, message.payload, message.at_ns, deleted=message.deleted)
        chunks = message.key.removeprefix(f"{keys.root}/").split("/")
        match chunks:
            case ["task", task, "record"]:
                ends[task] = msgspec.json.decode(message.payload, type=TaskRecord)
            case ["gw", gateway, "status"]:
                statuses.add(gateway)
            case ["gw", gateway, "pool", container]:
                left.pop(f"{gateway}/{container}", None)
                if not message.deleted:
                    told = msgspec.json.decode(message.payload, type=ContainerInfo)
                    if told.state is not ContainerState.DEAD:
                        left[f"{gateway}/{container}"] = told
            case _:
                pass
    assert hearing.refused == {}
    assert {task: record.state for task, record in store.tasks.items()} == {
        task: record.state for task, record in ends.items()
    }
    assert {name for name, _ in store.gateways.items()} == statuses
    assert {key: each.state for key, each in store.containers.items()} == {
        key: each.state for key, each in left.items()
    }


@pytest.mark.parametrize("name", RUNS)
def test_logs_are_small(name: str) -> None:
    """A repository keeps what it was given for good."""
    assert (LOGS / name).stat().st_size <= LARGEST_BYTES
