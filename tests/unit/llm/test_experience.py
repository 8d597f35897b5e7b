"""What became of plans, skills and robots, and what follows from it."""

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.llm.experience import Experience, Outcome, PlanOutcome, outcomes, plan_outcomes
from appliance.llm.feedback import Memory
from appliance.llm.routing import Budget, Thresholds
from appliance.model import (
    Attempt,
    Decision,
    Failure,
    Plan,
    Provenance,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Tier,
    encode,
    plan_hash,
)

pytestmark = pytest.mark.anyio

STEP = Subtask(id="s1", skill="pick", robot="any", params={"object": "box"})


def plan(key: str = "k", confidence: float = 0.7, tier: Tier = Tier.LOCAL) -> Plan:
    """Return a plan of the decomposer."""
    made = Plan(domain="manipulation", subtasks=(STEP,), tier=tier, confidence=confidence)
    origin = Provenance(tier=tier, confidence=confidence, hash=plan_hash(made), key=key)
    return replace(made, provenance=origin)


def ended(
    task: str = "t-1",
    *,
    robot: str = "rover_1",
    failures: tuple[Failure, ...] = (),
    good: bool = True,
    ms: float = 4000.0,
    made: Plan | None = None,
) -> TaskRecord:
    """Return the last record of a task of one subtask; the attempts before the last failed so."""
    attempts = [
        Attempt(number=number, gateway="gw-1", robot=robot, failure=failure)
        for number, failure in enumerate(failures, start=1)
    ]
    if good:
        attempts.append(Attempt(number=len(attempts) + 1, gateway="gw-1", robot=robot, peak_mb=80.0))
    record = SubtaskRecord(
        subtask=STEP,
        state=SubtaskState.SUCCEEDED if good else SubtaskState.FAILED,
        bound_robot=robot,
        attempts=tuple(attempts),
        duration_ms=ms,
        failure=None if good else failures[-1],
    )
    return TaskRecord(
        id=task,
        instruction="pick the box",
        state=TaskState.SUCCEEDED if good else TaskState.FAILED,
        plan=made or plan(),
        subtasks=(record,),
        failure=None if good else failures[-1],
    )


DROPPED = Failure(code="robot", message="the gripper slipped")
LOST = Failure(code="unreachable", message="gw-1 was lost", retryable=True)
NO_PLACE = Failure(code="not-found", message="there is no such place")


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        """Return the time."""
        return self.now


def memory(clock: Clock | None = None) -> Memory:
    """Return a memory of nothing."""
    clock = clock or Clock()
    return Memory(
        thresholds=Thresholds({"local": 0.6}, clock=clock),
        budget=Budget(cost=0, requests=0, price_in=0, price_out=0),
        most_plans=8,
        clock=clock,
    )


# --- what a record says ---------------------------------------------------------------------------------------------


def test_only_what_is_their_own_fault_counts() -> None:
    """A robot's failure counts against it, a lost gateway does not, and the success after both counts for it."""
    found = outcomes(ended(failures=(LOST, DROPPED)))
    assert [(each.robot, each.good) for each in found] == [("rover_1", False), ("rover_1", True)]
    assert found[0].why == "the gripper slipped"
    assert found[1].duration_s == 4.0
    assert found[1].peak_mb == 80.0


@pytest.mark.parametrize(
    ("record", "said"),
    [
        (ended(), True),
        (ended(good=False, failures=(DROPPED,)), None),
        (ended(good=False, failures=(NO_PLACE,)), False),
        (replace(ended(), replans=1, revised=1), False),
        (replace(ended(), revised=1), None),
        (replace(ended(), state=TaskState.CANCELLED), None),
        (ended(made=replace(plan(), provenance=None)), None),
        (ended(made=replace(plan(), subtasks=(replace(STEP, params={"object": "bag"}),))), None),
    ],
)
def test_what_a_record_says_of_its_plan(record: TaskRecord, said: bool | None) -> None:
    """Success as it was made is good, asking for what there is not is bad; a broken robot says nothing of the plan."""
    assert [each.good for each in plan_outcomes(record)] == ([] if said is None else [said])


def judged(task: str, *, approved: bool) -> TaskRecord:
    """Return the last record of a task whose plan an operator rejected, or replaced by one that then succeeded."""
    before = plan()
    decision = Decision(approved=approved, by="ann", edited=approved, plan=before, note="confidence 0.7")
    if not approved:
        return TaskRecord(id=task, instruction="pick the box", state=TaskState.CANCELLED, decision=decision)
    origin = replace(before.provenance, edited=True) if before.provenance is not None else None
    edited = replace(before, subtasks=(replace(STEP, params={"object": "bag"}),), provenance=origin)
    return replace(ended(task, made=edited), decision=decision)


def test_a_plan_that_an_operator_rejects_or_edits_is_a_bad_one() -> None:
    """The decision has the plan that they turned down or changed; what an edited one comes to says nothing of it."""
    for approved in (False, True):
        (found,) = plan_outcomes(judged("t-1", approved=approved))
        assert found == PlanOutcome(plan().provenance, good=False)  # pyright: ignore[reportArgumentType]
    # A rejected plan after a failure says nothing of the first one, which is judged by itself.
    later = plan(key="k2", confidence=0.65)
    record = replace(ended(good=False, failures=(NO_PLACE,)), decision=Decision(approved=False, by="ann", plan=later))
    assert [each.origin.key for each in plan_outcomes(record)] == ["k2", "k"]


def test_rejections_and_edits_raise_the_threshold_until_they_are_forgotten() -> None:
    """Two rejections and an edit of plans that were sure enough: the next one has to be surer, for a shift."""
    clock = Clock()
    mind = memory(clock)
    before = mind.thresholds.of("local")
    for number, approved in enumerate((False, False, True)):
        mind.learn(judged(f"t-{number}", approved=approved))
    assert before < 0.7 < mind.thresholds.of("local")
    clock.now += 48 * 3600
    assert mind.thresholds.of("local") == before


def test_an_order_that_cannot_be_as_things_stand_is_not_the_robots_fault() -> None:
    """By the code of the error and not its text: the plan asked for it, the robot said so."""
    far = Failure(code="precondition", message="the box is 29.0 m away, the arm reaches 1.5 m")
    record = ended(good=False, failures=(far,))
    assert outcomes(record) == ()
    assert [each.good for each in plan_outcomes(record)] == [False]
    assert [each.good for each in outcomes(ended(good=False, failures=(replace(far, code="robot"),)))] == [False]


# --- the statistic --------------------------------------------------------------------------------------------------


def test_a_robot_that_keeps_failing_is_shunned_until_it_is_forgotten() -> None:
    """Failures in a row shun the pair, one failure does not, other skills are untouched, and time heals."""
    clock = Clock()
    known = Experience(clock)
    bad = Outcome(skill="pick", robot="rover_1", good=False, why="slipped")
    known.add([bad])
    assert known.shuns("pick", "rover_1") == ""
    known.add([bad, bad])
    assert "pick failed on rover_1" in known.shuns("pick", "rover_1")
    assert known.shuns("goto", "rover_1") == known.shuns("pick", "rover_2") == ""
    clock.now += 3 * 4 * 3600
    assert known.shuns("pick", "rover_1") == ""


def test_successes_win_a_robot_back() -> None:
    """A robot that does it again is trusted again."""
    known = Experience(Clock())
    known.add([Outcome(skill="pick", robot="r", good=False, why="x")] * 3)
    assert known.shuns("pick", "r")
    known.add([Outcome(skill="pick", robot="r", good=True)] * 4)
    assert not known.shuns("pick", "r")


def test_expected_durations_converge() -> None:
    """The expected duration comes to what runs take, by robot once there are enough of it, and follows a change."""
    known = Experience(Clock())
    assert known.expected_s("pick", "a") is None
    known.add(Outcome(skill="pick", robot="a", good=True, duration_s=10.0) for _ in range(5))
    known.add(Outcome(skill="pick", robot="b", good=True, duration_s=2.0) for _ in range(5))
    assert (known.expected_s("pick", "a"), known.expected_s("pick", "b")) == (10.0, 2.0)
    assert known.expected_s("pick", "c") in (2.0, 6.0, 10.0)
    errors = deque[float]()
    for _ in range(20):
        known.add([Outcome(skill="pick", robot="a", good=True, duration_s=4.0)])
        errors.append(abs((known.expected_s("pick", "a") or 0) - 4.0))
    assert errors[0] == 6.0
    assert errors[-1] == 0.0
    assert list(errors) == sorted(errors, reverse=True)


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40), st.booleans(), st.floats(0, 1e5)), max_size=80))
def test_the_table_is_bounded_and_survives_a_restart(rows: list[tuple[int, int, bool, float]]) -> None:
    """Never more pairs than allowed, shares between 0 and 1, and what is kept tells the same."""
    clock = Clock()
    known = Experience(clock, most=10)
    for skill, robot, good, took in rows:
        clock.now += 60
        known.add([Outcome(skill=f"s{skill}", robot=f"r{robot}", good=good, duration_s=took, why="w")])
    table = known.rows()
    assert len(table) <= 10
    assert all(0 <= row.reliability <= 1 for row in table)
    other = Experience(clock, most=10)
    other.load(table)
    assert {(row.skill, row.robot) for row in other.rows()} == {(row.skill, row.robot) for row in table}


# --- memory ---------------------------------------------------------------------------------------------------------


def test_memory_hears_ends_once_and_from_the_right_key() -> None:
    """The same end twice counts once; a record under another's key, one that goes on, or no record teaches nothing."""
    kept = memory()
    key = "swiftbot/f/task/t-1/record"
    kept.hear(key, encode(ended()))
    kept.hear(key, encode(ended()))
    kept.hear(key, encode(replace(ended("t-2"), state=TaskState.RUNNING)))
    kept.hear(key, encode(ended("t-3")))
    kept.hear(key, b'{"state":"succeeded", broken')
    (row,) = kept.experience.rows()
    assert row.good == 1.0
    assert kept.cache.find("k") is not None


def test_memory_moves_thresholds_and_drops_plans() -> None:
    """A plan that failed leaves the cache, and its tier must be surer from then on."""
    kept = memory()
    kept.learn(ended("a"))
    for number in range(4):
        kept.learn(ended(f"b{number}", good=False, failures=(NO_PLACE,)))
    assert kept.cache.find("k") is None
    assert kept.thresholds.of("local") > 0.7


class FakeStore:
    """A store in memory."""

    def __init__(self) -> None:
        self.kept: dict[str, bytes] = {}

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Keep a value."""
        del durable
        self.kept[key] = value

    async def delete(self, key: str) -> None:
        """Forget a key."""
        self.kept.pop(key, None)

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return what begins so."""
        return [(key, value) for key, value in self.kept.items() if key.startswith(prefix)]


async def test_memory_survives_a_restart_and_damage() -> None:
    """What was learned is there after a restart; a damaged value is learned again, the others stand."""
    store, kept = FakeStore(), memory()
    await kept.load(store)
    kept.learn(ended("a", failures=(DROPPED,)))
    await kept.close()
    again = memory()
    await again.load(store)
    assert again.experience.rows()[0].bad == 1.0
    assert again.cache.find("k") is not None
    store.kept["planner/experience"] = b"{"
    third = memory()
    await third.load(store)
    assert third.experience.rows() == []
    assert third.cache.find("k") is not None
    third.learn(ended("z", good=False, failures=(NO_PLACE,)))
    await third.close()
    assert "planner/plan/k" not in store.kept
