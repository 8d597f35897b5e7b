"""Recorded logs as regression tests: today's state machine must give the end states that were logged then.

`logs/` holds MCAP files that real fleets recorded: the demonstration, a coordinator and an executing gateway that
were killed in mid-task, a cancelled task, instructions without a valid plan, and work that went wrong: a stuck run, an
alternative skill, new plans that an operator agreed to and turned down. To add one, copy a file from a fleet's `record`
folder and name its end states here.
"""

from collections import Counter
from pathlib import Path

import msgspec
import pytest

from appliance.model import RobotCommand
from appliance.record.reader import info, read
from appliance.tasks.replay import replay

LOGS = Path(__file__).parent / "logs"
STATES = {
    "demo.mcap": ["succeeded", "succeeded"],
    "coordinator-killed.mcap": ["succeeded"],
    "executor-killed.mcap": ["succeeded"],
    "cancelled.mcap": ["cancelled"],
    "no-plan.mcap": ["failed", "failed", "succeeded"],
    "replanned.mcap": ["failed", "succeeded", "succeeded"],
}


def test_every_log_is_in_the_table() -> None:
    """A log that nobody looks at is no test."""
    assert {path.name for path in LOGS.glob("*.mcap")} == set(STATES)


@pytest.mark.parametrize("name", STATES)
def test_a_recorded_log_replays_to_the_states_it_was_logged_in(name: str) -> None:
    """Folding the logged transitions gives the logged records, takeovers included."""
    report = replay(LOGS / name)
    assert report.same, report
    assert sorted(task.replayed for task in report.tasks) == STATES[name]


@pytest.mark.parametrize("name", ["coordinator-killed.mcap", "executor-killed.mcap"])
def test_a_lost_gateway_shows_in_the_log_and_doubles_nothing(name: str) -> None:
    """There is a takeover or a second attempt, and each robot command was taken up once."""
    transitions: Counter[str] = Counter()
    commands: Counter[str] = Counter()
    for message in read(LOGS / name):
        if message.key.endswith("/transition"):
            transitions[msgspec.json.decode(message.payload)["kind"]] += 1
        elif message.key.endswith("/commanded"):
            commands[msgspec.json.decode(message.payload, type=RobotCommand).id] += 1
    assert transitions["adopted"] or transitions["attempt failed"]
    assert commands
    assert set(commands.values()) == {1}


def test_revisions_are_in_the_log_as_transitions_of_their_own() -> None:
    """What was found, proposed, agreed to and done about it, by its kind."""
    kinds: Counter[str] = Counter()
    for message in read(LOGS / "replanned.mcap"):
        if message.key.endswith("/transition"):
            kinds[msgspec.json.decode(message.payload)["kind"]] += 1
    expected = {"substituted": 1, "proposed": 2, "approved": 1, "replanned": 1, "replan failed": 1}
    assert {kind: kinds[kind] for kind in expected} == expected
    assert kinds["noticed"] >= 1


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.9, 0.99])
def test_a_log_that_was_cut_off_replays_as_far_as_it_goes(tmp_path: Path, keep: float) -> None:
    """A killed recorder's file is read up to its last whole chunk, and what is there agrees with itself."""
    whole = (LOGS / "demo.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: int(len(whole) * keep)])
    found = info(cut)
    assert found.recovered
    if any("/transition" in channel.key for channel in found.channels):
        report = replay(cut)
        assert all(not task.stale for task in report.tasks)
