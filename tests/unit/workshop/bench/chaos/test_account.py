"""The invariants of a chaos run: each breach is found and named, a good run has none."""

from typing import Any

from msgspec.structs import replace

from appliance.model import Failure, Plan, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState
from appliance.tasks.machine import Transition, TransitionKind
from workshop.bench.chaos.account import Follower, Submitted, downtime, effects, outcomes
from workshop.bench.chaos.ledger import Line
from workshop.bench.chaos.plan import SKILL, Wanted

PLAN = Plan(
    domain="coordination",
    subtasks=(
        Subtask(id="s1", skill=SKILL, params={"steps": 2}),
        Subtask(id="s2", skill=SKILL, params={"steps": 1}, after=("s1",)),
    ),
)
TASK = Wanted(task="t-1", at_s=0.0, plan=PLAN)
DONE = TaskRecord(
    id="t-1",
    instruction="x",
    state=TaskState.SUCCEEDED,
    subtasks=tuple(SubtaskRecord(subtask=each, state=SubtaskState.SUCCEEDED) for each in PLAN.subtasks),
)


def found(*entries: str, record: TaskRecord | None = DONE) -> dict[str, Any]:
    """Check a ledger with these entries in order."""
    lines = [Line(entry=each, robot="r", at_ns=number) for number, each in enumerate(entries)]
    result = effects([TASK], {"t-1": record}, lines)
    return {kind: result[kind] for kind in ("doubled", "lost", "early", "strange") if result[kind]}


def test_each_breach_is_told_from_the_others() -> None:
    """Doubled, lost, too early and unasked effects are counted for what they are."""
    good = ("t-1/s1#0", "t-1/s1#1", "t-1/s2#0")
    assert found(*good) == {}
    assert found(*good, "t-1/s1#0")["doubled"] == 1
    assert found("t-1/s1#0", "t-1/s2#0") == {"lost": 1}
    assert found("t-1/s1#0", "t-1/s2#0", "t-1/s1#1") == {"early": 1}
    assert found(*good, "t-2/s1#0") == {"strange": 1}


def test_what_did_not_succeed_need_not_have_acted() -> None:
    """Effects of subtasks that failed, or of tasks without a record, may be missing but not doubled."""
    failed = replace(DONE, subtasks=tuple(replace(each, state=SubtaskState.FAILED) for each in DONE.subtasks))
    assert found("t-1/s1#0", record=failed) == {}
    assert found(record=None) == {}
    assert found("t-1/s1#0", "t-1/s1#0", record=failed) == {"doubled": 1}


def test_outcomes_tell_missing_and_open_tasks() -> None:
    """An accepted task without a record is missing, one that has not ended is open, one refused is neither."""
    handed_in = [Submitted(task=f"t-{number}", accepted=number != 3, problem="" if number != 3 else "unreachable")
                 for number in range(1, 5)]  # fmt: skip
    running = replace(DONE, id="t-2", state=TaskState.RUNNING)
    lost = replace(DONE, id="t-4", state=TaskState.FAILED, failure=Failure(code="robot", message="no"))
    result = outcomes(handed_in, {"t-1": None, "t-2": running, "t-3": None, "t-4": lost})
    assert result["missing"] == ["t-1"]
    assert len(result["open"]) == len(result["failed"]) == 1
    assert (result["accepted"], result["refused"]) == (3, {"unreachable": 1})


def test_takeovers_are_measured_from_the_fault_and_from_its_detection() -> None:
    """A kill that is noticed after 2 ms and made good after 5: both times, and who was down when."""
    follower = Follower()
    step = Transition(task="t-1", sequence=1, kind=TransitionKind.ACCEPTED, at_ns=0, coordinator="gw-1")
    follower.moved(step, 0)
    down = follower.down("gw-1", "kill", 10_000_000, 0)
    assert down.coordinated == ("t-1",)
    follower.noticed("gw-1", "gw-2", 12_000_000)
    follower.moved(replace(step, sequence=2, kind=TransitionKind.ADOPTED, coordinator="gw-2"), 15_000_000)
    down.until_ns = 20_000_000
    told = downtime(follower.downs)
    assert told["detection"]["kill"]["p50"] == 2.0
    assert told["takeover"]["p50"] == 5.0
    assert told["takeover_after_detection"]["p50"] == 3.0
    assert (told["most_down_at_once"], told["unnoticed"], follower.takeovers["t-1"]) == (1, [], 1)
