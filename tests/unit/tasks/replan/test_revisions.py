"""Revised plans in the state machine, in whatever order: nothing finished is lost, no id comes twice."""

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.model import Decision, Failure, Plan, RobotInfo, Subtask, SubtaskState, TaskRecord, TaskState, encode
from appliance.model.transitions import StaleTransitionError, Transition, TransitionKind
from appliance.skills.catalogue import Alternative, SkillManifest
from appliance.tasks import machine
from appliance.tasks.replan import Rebinding, Robots, Substitution, alternative_skill, another_robot, problems, splice
from appliance.tasks.settings import ReplanConfig

SKILLS = {
    name: SkillManifest(
        id=name,
        domain="navigation",
        summary="x",
        runs="robot",
        image="base",
        implemented=True,
        prepares=("position",) if name == "go" else (),
        ties=("load",) if name == "take" else (),
        frees=("load",) if name == "put" else (),
        alternatives=(Alternative(skill="look"),) if name == "see" else (),
    )
    for name in ("go", "take", "put", "see", "look")
}
ROBOTS = Robots(roster={name: RobotInfo(id=name, kind="zenoh") for name in ("r1", "r2", "r3")})
CONFIG = ReplanConfig(robots="all", max_revisions=100)
FAILURE = Failure(code="robot", message="slipped", retryable=True)


@st.composite
def plans(draw: st.DrawFn, prefix: str = "s") -> Plan:
    """A plan of a few subtasks that come after earlier ones."""
    count = draw(st.integers(1, 6))
    subtasks: list[Subtask] = []
    for number in range(count):
        before = [each.id for each in subtasks]
        subtasks.append(
            Subtask(
                id=f"{prefix}{number + 1}",
                skill=draw(st.sampled_from(sorted(SKILLS))),
                robot=draw(st.sampled_from(["any", "any1", "r1"])),
                params={"n": draw(st.integers(0, 2))},
                after=tuple(draw(st.lists(st.sampled_from(before), unique=True, max_size=2)) if before else ()),
            )
        )
    return Plan(domain="navigation", subtasks=tuple(subtasks))


class Walk:
    """A record, driven at random; keeps every transition that was applied."""

    def __init__(self, plan: Plan) -> None:
        self.log: list[Transition] = []
        self.record: TaskRecord | None = None
        self.finished: dict[str, Any] = {}
        self.ids: set[str] = set()
        self.apply(TransitionKind.ACCEPTED, instruction="x")
        self.apply(TransitionKind.PLANNED, plan=plan)

    def apply(self, kind: TransitionKind, **fields: Any) -> None:
        """Apply a transition and check what must always hold."""
        before = self.record
        sequence = before.sequence + 1 if before else 1
        event = Transition(task="t", sequence=sequence, kind=kind, at_ns=sequence, coordinator="gw-1", **fields)
        self.record = machine.apply(before, event)
        self.log.append(event)
        record = self.record
        names = [each.subtask.id for each in record.subtasks]
        assert len(set(names)) == len(names)
        assert not set(names) & set(record.retired), "an id was given again"
        assert not machine.cyclic(tuple(each.subtask for each in record.subtasks))
        for name, result in self.finished.items():
            assert record.of(name).result == result, "something finished was lost"
        for each in record.subtasks:
            if each.state is SubtaskState.SUCCEEDED:
                self.finished[each.subtask.id] = each.result
        if before is not None and before.subtasks:
            gone = {each.subtask.id for each in before.subtasks} - set(names)
            states = {before.of(name).state for name in gone}
            assert not states & {SubtaskState.SUCCEEDED, *machine.ACTIVE}, "a run was left behind"

    def act(self, choose: st.DataObject) -> None:
        """Do one thing that could happen now."""
        record = self.record
        assert record is not None
        stranded = machine.stranded(record)
        options = ["run", "end", "fail", "notice", *(["rebind", "substitute", "propose"] * bool(stranded))]
        if record.proposal is not None:
            options = ["run", "end", "replan", "replan"]
        what = choose.draw(st.sampled_from(options))
        ready, active = machine.ready(record), machine.active(record)
        if what == "run" and ready:
            target = choose.draw(st.sampled_from(ready))
            robot = target.bound_robot or choose.draw(st.sampled_from(sorted(ROBOTS.roster)))
            self.apply(
                TransitionKind.DISPATCHED,
                subtask=target.subtask.id,
                attempt=target.next_attempt,
                gateway="g",
                robot=robot,
            )
        elif what == "end" and active:
            target = choose.draw(st.sampled_from(active))
            result = {"of": target.subtask.id, "attempt": target.attempt}
            self.apply(TransitionKind.SUCCEEDED, subtask=target.subtask.id, attempt=target.attempt, result=result)
        elif what == "fail" and active:
            target = choose.draw(st.sampled_from(active))
            again = choose.draw(st.booleans())
            self.apply(
                TransitionKind.ATTEMPT_FAILED,
                subtask=target.subtask.id,
                attempt=target.attempt,
                failure=FAILURE,
                give_up=not again,
                replan=not again,
            )
        elif what == "notice" and active:
            target = active[0]
            self.apply(TransitionKind.NOTICED, subtask=target.subtask.id, attempt=target.attempt, condition="stuck")
        elif what == "rebind":
            found = another_robot(record, stranded[0], "x", manifests=SKILLS, robots=ROBOTS, config=CONFIG)
            if isinstance(found, Rebinding):
                name = stranded[0].subtask.id
                self.apply(TransitionKind.REBOUND, subtask=name, plan=found.plan, robot=found.robot)
                assert self.record is not None
                assert self.record.of(name).bound_robot == found.robot
        elif what == "substitute":
            swap = alternative_skill(record, stranded[0], manifests=SKILLS)
            if isinstance(swap, Substitution):
                self.apply(TransitionKind.SUBSTITUTED, subtask=stranded[0].subtask.id, plan=swap.plan)
        elif what == "propose":
            proposed = choose.draw(plans("p"))
            if not problems(record, proposed, SKILLS):
                self.apply(TransitionKind.PROPOSED, subtask=stranded[0].subtask.id, plan=proposed)
        elif what == "replan" and record.proposal is not None:
            spliced = splice(record, record.proposal.plan)
            event = {"subtask": record.proposal.subtask, "plan": spliced.plan}
            if spliced.ending:
                with pytest.raises(StaleTransitionError):
                    self.apply(TransitionKind.REPLANNED, **event)
            else:
                self.apply(TransitionKind.REPLANNED, **event)


@settings(max_examples=60, deadline=None)
@given(plan=plans(), choose=st.data(), steps=st.integers(5, 50))
def test_whatever_happens_nothing_finished_is_lost(plan: Plan, choose: st.DataObject, steps: int) -> None:
    """Any order of runs, failures, rebindings, substitutions and new plans keeps the rules and replays exactly."""
    walk = Walk(plan)
    for _ in range(steps):
        assert walk.record is not None
        if walk.record.state.final:
            break
        walk.act(choose)
    folded: TaskRecord | None = None
    for event in walk.log:
        told = msgspec.json.decode(encode(event), type=Transition)
        folded = machine.apply(folded, told)
    assert folded == walk.record
    assert msgspec.json.decode(encode(folded), type=TaskRecord) == folded


def base() -> Walk:
    """A task of two subtasks, the first finished, the second given up."""
    walk = Walk(
        Plan(
            domain="navigation",
            subtasks=(
                Subtask(id="s1", skill="go", robot="any"),
                Subtask(id="s2", skill="see", robot="any", after=("s1",)),
            ),
        )
    )
    walk.apply(TransitionKind.DISPATCHED, subtask="s1", attempt=1, gateway="g", robot="r1")
    walk.apply(TransitionKind.SUCCEEDED, subtask="s1", attempt=1, result={})
    walk.apply(TransitionKind.DISPATCHED, subtask="s2", attempt=1, gateway="g", robot="r1")
    walk.apply(
        TransitionKind.ATTEMPT_FAILED, subtask="s2", attempt=1, failure=FAILURE, give_up=True, replan=True
    )  # fmt: skip
    return walk


def test_a_subtask_given_up_for_replanning_leaves_its_task_running() -> None:
    """It is stranded; `replan failed` ends the task with its failure and says why nothing could be done."""
    walk = base()
    assert walk.record is not None
    assert walk.record.state is TaskState.RUNNING
    assert [each.subtask.id for each in machine.stranded(walk.record)] == ["s2"]
    walk.apply(TransitionKind.REPLAN_FAILED, subtask="s2", note="no other robot")
    assert walk.record.state is TaskState.FAILED
    assert walk.record.failure is not None
    assert walk.record.failure.message == "s2 (see): slipped; not replanned: no other robot"


def test_a_cancel_ends_a_task_that_is_being_replanned() -> None:
    """Nothing runs any more: it is cancelled at once."""
    walk = base()
    walk.apply(TransitionKind.CANCEL)
    assert walk.record is not None
    assert walk.record.state is TaskState.CANCELLED


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda plan: replace(plan, subtasks=plan.subtasks[1:]), "for none of it"),
        (lambda plan: replace(plan, subtasks=(replace(plan.subtasks[1], after=()),)), "leaves out or changes s1"),
        (
            lambda plan: replace(plan, subtasks=(replace(plan.subtasks[0], params={"n": 1}), plan.subtasks[1])),
            "leaves out or changes s1",
        ),
        (
            lambda plan: replace(plan, subtasks=(plan.subtasks[0], replace(plan.subtasks[1], skill="look"))),
            "another subtask of s2",
        ),
        (
            lambda plan: replace(plan, subtasks=(plan.subtasks[0], replace(plan.subtasks[1], after=("s2",)))),
            "wait for each other",
        ),
        (lambda plan: replace(plan, subtasks=(*plan.subtasks, plan.subtasks[0])), "of them different"),
    ],
)
def test_a_revised_plan_that_would_lose_or_double_something_is_refused(change: Any, said: str) -> None:
    """What is finished left out or changed, an id for another subtask, a circle, an id twice."""
    walk = base()
    assert walk.record is not None
    assert walk.record.plan is not None
    with pytest.raises(StaleTransitionError, match=said):
        walk.apply(TransitionKind.REBOUND, subtask="s2", robot="r2", plan=change(walk.record.plan))


def test_an_id_that_was_taken_out_is_never_given_again() -> None:
    """The effects of its handler are known by it."""
    walk = base()
    assert walk.record is not None
    swap = alternative_skill(walk.record, walk.record.of("s2"), manifests=SKILLS)
    assert isinstance(swap, Substitution)
    walk.apply(TransitionKind.SUBSTITUTED, subtask="s2", plan=swap.plan)
    back = replace(swap.plan, subtasks=(*swap.plan.subtasks, Subtask(id="s2", skill="see", robot="any")))
    with pytest.raises(StaleTransitionError, match="uses the id s2 again"):
        walk.apply(TransitionKind.REBOUND, subtask="r1ltn_1", robot="r2", plan=back)


def test_nothing_takes_effect_that_was_not_proposed_and_agreed_to() -> None:
    """A new plan needs its proposal, one at a time; agreeing needs one that waits."""
    walk = base()
    assert walk.record is not None
    plan = walk.record.plan
    with pytest.raises(StaleTransitionError, match="not proposed"):
        walk.apply(TransitionKind.REPLANNED, subtask="s2", plan=plan)
    approval = Decision(approved=True, by="ann")
    with pytest.raises(StaleTransitionError, match="waits for"):
        walk.apply(TransitionKind.APPROVED, subtask="s2", decision=approval)
    walk.apply(TransitionKind.PROPOSED, subtask="s2", plan=plan, waits=True)
    with pytest.raises(StaleTransitionError, match="second proposal"):
        walk.apply(TransitionKind.PROPOSED, subtask="s2", plan=plan)
    walk.apply(TransitionKind.APPROVED, subtask="s2", decision=approval)
    assert walk.record.proposal is not None
    assert not walk.record.proposal.waits
