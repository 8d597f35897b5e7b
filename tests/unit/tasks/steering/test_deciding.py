"""What becomes of operators' orders by the record alone, and what a plan's hash is of."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConflictError, RefusedError
from appliance.model import (
    Approval,
    Decision,
    Plan,
    Proposal,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Tier,
)
from appliance.model.task_api import ApproveAsk, PauseAsk, ResumeAsk, RetryAsk
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.machine import matches, plan_hash
from appliance.tasks.steering import may_pause, may_resume, may_retry, needed_robots, needs_approval, proposal_for

PLAN = Plan(domain="any", subtasks=(Subtask(id="s1", skill="work", robot="r1"), Subtask(id="s2", skill="cut")))


def manifest(name: str, **fields: Any) -> SkillManifest:
    """Return a manifest."""
    return SkillManifest(id=name, domain="any", summary="x", runs="robot", image="base", **fields)


SKILLS = {"work": manifest("work", uses=("base",)), "cut": manifest("cut", danger="a blade")}

texts = st.text(max_size=5)
plans = st.builds(
    Plan,
    domain=st.sampled_from(["any", "media"]),
    subtasks=st.lists(
        st.builds(
            Subtask,
            id=st.sampled_from(["s1", "s2"]),
            skill=st.sampled_from(["work", "cut"]),
            robot=st.none() | st.sampled_from(["r1", "r2"]),
            params=st.dictionaries(texts, st.integers() | texts, max_size=2),
        ),
        max_size=2,
    ).map(tuple),
)


@given(plans, plans, st.floats(0, 1))
def test_a_hash_is_of_what_will_be_done(one: Plan, other: Plan, confidence: float) -> None:
    """It does not change with how the plan came to be, and does with anything else."""
    assert plan_hash(one) == plan_hash(replace(one, confidence=confidence, tier=Tier.UPSTREAM, latency_ms=3.0))
    same = (one.domain, one.subtasks) == (other.domain, other.subtasks)
    assert (plan_hash(one) == plan_hash(other)) is same
    assert matches(plan_hash(one)[:8], plan_hash(one))
    assert not matches(plan_hash(one)[:7], plan_hash(one))


def test_the_order_of_parameters_does_not_matter() -> None:
    """An editor may write them in another one."""
    one = Plan(domain="any", subtasks=(Subtask(id="s1", skill="work", params={"a": 1, "b": 2}),))
    other = Plan(domain="any", subtasks=(Subtask(id="s1", skill="work", params={"b": 2, "a": 1}),))
    assert plan_hash(one) == plan_hash(other)


def test_what_is_dangerous_waits() -> None:
    """By a skill's manifest, or since a robot flies; harmless plans do not, and `always` means every one."""
    flies = {"r1": RobotInfo(id="r1", kind="mavlink", flies=True)}
    drives = {"r1": RobotInfo(id="r1", kind="zenoh")}
    harmless = replace(PLAN, subtasks=PLAN.subtasks[:1])
    assert needs_approval(PLAN, Approval.NEVER, manifests=SKILLS, robots=flies) == ""
    assert needs_approval(harmless, Approval.DANGEROUS, manifests=SKILLS, robots=drives) == ""
    assert needs_approval(harmless, Approval.DANGEROUS, manifests=SKILLS, robots=flies) == "s1 (work): r1 flies"
    assert needs_approval(PLAN, Approval.DANGEROUS, manifests=SKILLS, robots=drives) == "s2 (cut): a blade"
    assert needs_approval(harmless, Approval.ALWAYS, manifests=SKILLS, robots=drives)


def test_a_robot_that_flies_and_may_be_chosen_is_dangerous() -> None:
    """Behind `any` stands each robot that is able to do it; one that flies and is not able does not count."""
    chosen = replace(PLAN, subtasks=(replace(PLAN.subtasks[0], robot="any1"),))
    drives = RobotInfo(id="r1", kind="zenoh", uses=("base",))
    flies = RobotInfo(id="r2", kind="mavlink", flies=True, uses=("base",))
    dangerous: Any = {"manifests": SKILLS, "wanted": Approval.DANGEROUS}
    assert needs_approval(chosen, robots={"r1": drives}, **dangerous) == ""
    said = "s1 (work): r2 may be chosen, which flies"
    assert needs_approval(chosen, robots={"r1": drives, "r2": flies}, **dangerous) == said
    assert needs_approval(chosen, robots={"r1": drives, "r2": replace(flies, uses=())}, **dangerous) == ""


@given(st.sampled_from(Approval), st.sampled_from(Approval))
def test_the_stricter_of_two_holds(one: Approval, other: Approval) -> None:
    """A request can ask for more than the configuration, never for less."""
    order = list(Approval)
    assert order.index(one.stricter(other)) == max(order.index(one), order.index(other))


def record(state: TaskState, **fields: Any) -> TaskRecord:
    """Return a record."""
    return TaskRecord(id="t", instruction="x", state=state, **fields)


@given(st.sampled_from(TaskState), st.booleans(), st.booleans())
def test_a_word_on_a_plan_is_taken_only_while_one_waits(state: TaskState, waits: bool, decided: bool) -> None:
    """Otherwise the answer says who was faster, or that nothing waits; never both silently."""
    proposal = Proposal(plan=PLAN, waits=waits, hash=plan_hash(PLAN))
    decision = Decision(approved=True, by="ann", act="a") if decided else None
    found = record(state, proposal=proposal, decision=decision)
    taken = waits and state in (TaskState.PROPOSED, TaskState.RUNNING)
    if taken:
        assert proposal_for(found, ApproveAsk(id="t", hash=proposal.hash, act="b")) is proposal
    else:
        with pytest.raises(ConflictError if decided else RefusedError):
            proposal_for(found, ApproveAsk(id="t", hash=proposal.hash, act="b"))
    if decided:
        assert proposal_for(found, ApproveAsk(id="t", act="a")) is None


@given(st.sampled_from(TaskState))
def test_pausing_and_resuming_fit_the_state(state: TaskState) -> None:
    """What has ended, or is being ended, is not paused; resuming what is not paused does nothing."""
    found = record(state)
    if state.final or state is TaskState.CANCELLING:
        with pytest.raises(RefusedError):
            may_pause(found, PauseAsk(id="t"))
    else:
        assert may_pause(found, PauseAsk(id="t"))
    if state.final:
        with pytest.raises(RefusedError):
            may_resume(found, ResumeAsk(id="t"))
    else:
        assert not may_resume(found, ResumeAsk(id="t"))


@given(st.sampled_from(TaskState), st.sampled_from(SubtaskState))
def test_what_has_succeeded_is_never_tried_again(state: TaskState, of: SubtaskState) -> None:
    """Neither a task nor a subtask."""
    found = record(state, subtasks=(SubtaskRecord(subtask=PLAN.subtasks[0], state=of),))
    if of is SubtaskState.SUCCEEDED:
        with pytest.raises(RefusedError):
            may_retry(found, RetryAsk(id="t", subtask="s1"))
    if state is TaskState.SUCCEEDED:
        with pytest.raises(RefusedError):
            may_retry(found, RetryAsk(id="t"))
    if state in (TaskState.FAILED, TaskState.CANCELLED):
        assert may_retry(found, RetryAsk(id="t"))


def test_the_robots_a_task_needs_are_those_of_what_is_left() -> None:
    """By name where one is chosen, by label where none is; of a plan that waits those it names."""
    subtasks = (
        SubtaskRecord(subtask=Subtask(id="a", skill="work", robot="r1"), state=SubtaskState.SUCCEEDED),
        SubtaskRecord(subtask=Subtask(id="b", skill="work", robot="any1"), bound_robot="r2"),
        SubtaskRecord(subtask=Subtask(id="c", skill="work", robot="any2")),
        SubtaskRecord(subtask=Subtask(id="d", skill="work")),
    )
    assert needed_robots(record(TaskState.RUNNING, subtasks=subtasks)) == ("any2", "r2")
    lift = Subtask(id="e", skill="lift", robot="r1", params={"robots": ["r1", "any3"]})
    assert needed_robots(record(TaskState.RUNNING, subtasks=(SubtaskRecord(subtask=lift),))) == ("any3", "r1")
    bound = SubtaskRecord(subtask=lift, bound_robot="r1", others=("r7",))
    assert needed_robots(record(TaskState.RUNNING, subtasks=(bound,))) == ("r1", "r7")
    waiting = record(TaskState.PROPOSED, proposal=Proposal(plan=PLAN, waits=True))
    assert needed_robots(waiting) == ("r1",)
