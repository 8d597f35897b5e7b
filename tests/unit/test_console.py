"""What the command line shows of decisions: readable at 80 columns, complete, and safe with odd records."""

from typing import Any

import msgspec
import pytest
from rich.console import Console

from appliance import console
from appliance.errors import NotFoundError
from appliance.model import (
    Attempt,
    Choice,
    Considered,
    Failure,
    Phase,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Way,
    encode,
)
from appliance.model.pool_api import Evicted, PoolDecision
from appliance.model.task_api import TaskWhy
from appliance.reasons import why_text
from appliance.tasks.views import view, why

CHOICE = Choice(
    phase=Phase.REMOTE_WARM,
    way=Way.RUN_THERE,
    by="gw-1",
    gateway="gw-2",
    container="9f8e7d6c5b4a",
    cold_ms=1500,
    why="its state is not here, bringing 40 MB would be 1000 ms; on gw-2 score 1.00 for 2.0 ms",
    considered=(
        Considered(
            gateway="gw-2", container="9f8e7d6c5b4a", image="base", way=Way.RUN_THERE, score=1.0, cost_ms=2.0,
            taken=True, verdict="taken",
        ),
        Considered(
            gateway="gw-1", container="1a2b3c4d5e6f", image="base", way=Way.BRING_HERE, score=0.8, cost_ms=1000,
            verdict="1000 ms for 40 MB of state, dearer",
        ),
        Considered(gateway="gw-1", image="base", way=Way.BRING_HERE, cost_ms=1500, verdict="1500 ms, dearer"),
        Considered(gateway="gw-3", way=Way.RUN_THERE, verdict="had none when asked: no ready container any more"),
    ),
)  # fmt: skip
RECORD = TaskRecord(
    id="t-1",
    instruction="look around",
    state=TaskState.RUNNING,
    coordinator="gw-1",
    subtasks=(
        SubtaskRecord(
            subtask=Subtask(id="s1", skill="photograph"),
            state=SubtaskState.RUNNING,
            gateway="gw-2",
            partial={"seen": 3},
            attempts=(
                Attempt(
                    number=1, gateway="gw-3", placed="gw-3 0.91, gw-1 0.40",
                    failure=Failure(code="unreachable", message="gw-3 was lost", retryable=True),
                ),
                Attempt(
                    number=2, gateway="gw-2", container="9f8e7d6c5b4a", phase=Phase.REMOTE_WARM,
                    placed="gw-1 0.62, gw-2 0.40", choice=CHOICE,
                ),
            ),
        ),
        SubtaskRecord(subtask=Subtask(id="s2", skill="notify", after=("s1",))),
        SubtaskRecord(
            subtask=Subtask(id="s3", skill="goto"), state=SubtaskState.DISPATCHED,
            attempts=(Attempt(number=1, gateway="gw-1"),),
        ),
    ),
)  # fmt: skip


def shown(what: Any) -> str:
    """What a terminal of 80 columns shows."""
    terminal = Console(width=80, record=True, file=None, force_terminal=False)
    with terminal.capture() as captured:
        terminal.print(what)
    return captured.get()


def test_why_tells_who_decided_and_what_was_weighed_at_80_columns() -> None:
    """Each attempt with its gateway, scores, costs, ways and verdicts; nothing is cut off."""
    text = shown(why_text(why(RECORD)))
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
    flat = " ".join(text.split())
    for part in (
        "attempt 1 on gw-3", "failed: gw-3 was lost", "attempt 2 on gw-2, container 9f8e7d6c5b4a, remote warm",
        "gateways by coarse score: gw-1 0.62, gw-2 0.40", "gw-1 decided: run there, its state is not here",
        "how its container was chosen is not known (yet)", "bring here", "1.0 s", "9f8e7d6c", "1.00",
    ):  # fmt: skip
        assert part in flat, part
    assert text.count("▸") == 1


def test_why_of_one_subtask_and_of_none() -> None:
    """One subtask alone can be asked for; a wrong one is an error that names those there are."""
    assert [each.id for each in why(RECORD, "s2").subtasks] == ["s2"]
    with pytest.raises(NotFoundError, match="no subtask 's9'") as raised:
        why(RECORD, "s9")
    assert "s1, s2, s3" in raised.value.remedy
    with pytest.raises(NotFoundError, match="no subtask"):
        why(TaskRecord(id="t", instruction="x"), "s1")


def test_why_as_json_can_be_read_back() -> None:
    """The JSON form has every field, so that tools need no cases."""
    found = why(RECORD)
    assert msgspec.json.decode(encode(found), type=TaskWhy) == found


def test_a_task_shows_the_way_and_what_there_is_so_far() -> None:
    """`task show` mentions a container elsewhere and the last partial result; its JSON form has both."""
    flat = " ".join(shown(console.task_table(RECORD)).split())
    assert "s1 was passed on to gw-2 by gw-1: its state is not here" in flat
    assert "s1: so far: seen=3" in flat
    first, second, _ = view(RECORD).subtasks
    assert (first.way, first.partial, second.way, second.partial) == ("run there", {"seen": 3}, None, None)


def test_decisions_and_evictions_name_their_reasons() -> None:
    """A line each, with the gateway."""
    row = PoolDecision(at_ns=1, what="retire", image="base", container="abc", why="idle for long")
    assert "idle for long" in shown(console.decision_table([("gw-1", row)]))
    answer = Evicted(containers=("a", "b"), kept={"c": "it works"}, note="the floor keeps 1 of base")
    text = " ".join(shown(console.evicted_text({"gw-1": answer, "gw-2": Evicted(containers=())})).split())
    assert text == "gw-1 gave up a, b; kept c: it works; the floor keeps 1 of base gw-2 had none idle"
