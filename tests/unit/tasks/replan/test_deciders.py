"""What is done about a subtask that was given up: another robot, another skill, a new plan, in that order."""

from typing import Any

import pytest
from msgspec.structs import replace

from appliance.model import Failure, Plan, RobotInfo, Subtask, SubtaskState, TaskRecord
from appliance.model.transitions import Transition, TransitionKind
from appliance.skills.catalogue import SkillManifest, load_catalogue
from appliance.tasks import machine
from appliance.tasks.replan import (
    AskDecomposer,
    GiveUp,
    Rebinding,
    Robots,
    Substitution,
    alternative_skill,
    another_robot,
    decide,
    is_the_robots,
    mapped,
    problems,
    remainder,
    splice,
)
from appliance.tasks.settings import ReplanConfig

SKILLS = load_catalogue().skills
CONFIG = ReplanConfig()
OFFLINE = Failure(code="unreachable", message="rover_1 does not answer", retryable=True)
BROKEN = Failure(code="skill", message="saw nothing")


def rover(name: str, **more: Any) -> RobotInfo:
    """A rover that can do all that rovers do."""
    verbs = ("state", "goto", "pick", "place", "capture", "record", "hold", "return_home")
    return replace(RobotInfo(id=name, kind="zenoh", uses=("base", "arm", "camera"), verbs=verbs), **more)


ROBOTS = Robots(roster={"rover_1": rover("rover_1", online=False), "rover_2": rover("rover_2")})


def step(record: TaskRecord | None, kind: TransitionKind, **fields: Any) -> TaskRecord:
    """Apply the next transition of a record."""
    sequence = record.sequence + 1 if record else 1
    return machine.apply(
        record, Transition(task="t", sequence=sequence, kind=kind, at_ns=sequence, coordinator="gw-1", **fields)
    )


def given_up(subtasks: tuple[Subtask, ...], failed: str, failure: Failure, *, handed_in: bool = False) -> TaskRecord:
    """A record in which all before a subtask has succeeded on rover_1, and that one was given up."""
    plan = Plan(domain="navigation", subtasks=subtasks)
    record = step(None, TransitionKind.ACCEPTED, instruction="x", plan=plan if handed_in else None)
    record = step(record, TransitionKind.PLANNED, plan=plan)
    for each in subtasks:
        robot = None if each.robot is None else "rover_1"
        common = {"subtask": each.id, "attempt": 1, "gateway": "gw-1"}
        record = step(record, TransitionKind.DISPATCHED, robot=robot, **common)
        if each.id == failed:
            return step(record, TransitionKind.ATTEMPT_FAILED, failure=failure, give_up=True, replan=True, **common)
        record = step(record, TransitionKind.SUCCEEDED, result={"of": each.id}, **common)
    raise AssertionError(failed)


GOTO = Subtask(id="s1", skill="goto", robot="any", params={"place": "dock 3"})
PHOTO = Subtask(id="s2", skill="photograph", robot="any", params={"target": "shelf"}, after=("s1",))
PICK = Subtask(id="s2", skill="pick", robot="any", params={"object": "box"}, after=("s1",))
PLACE = Subtask(id="s3", skill="place", robot="any", params={"object": "box", "at": "dock 2"}, after=("s2",))
NOTE = Subtask(id="s9", skill="notify", params={"to": "operator"}, after=("s2",))


def rebind(record: TaskRecord, name: str, **more: Any) -> Rebinding | str:
    """Look for another robot."""
    given = {"manifests": SKILLS, "robots": ROBOTS, "config": CONFIG, **more}
    return another_robot(record, record.of(name), "it is offline", **given)


def test_another_robot_repeats_what_the_rest_builds_on() -> None:
    """The way to the dock is gone by the new robot before it takes the picture; the first one's stays finished."""
    found = rebind(given_up((GOTO, PHOTO, NOTE), "s2", OFFLINE), "s2")
    assert isinstance(found, Rebinding)
    assert found.robot == "rover_2"
    by_id = {each.id: each for each in found.plan.subtasks}
    assert by_id["r1ltn_1"].params == {"place": "dock 3"}
    assert set(by_id["s2"].after) == {"s1", "r1ltn_1"}
    assert by_id["s9"].after == ("s2",)


def test_what_the_rest_does_anew_is_not_repeated() -> None:
    """Going on to another place needs no way to the one before."""
    on = Subtask(id="s2", skill="goto", robot="any", params={"place": "dock 1"}, after=("s1",))
    found = rebind(given_up((GOTO, on), "s2", OFFLINE), "s2")
    assert isinstance(found, Rebinding)
    assert [each.id for each in found.plan.subtasks] == ["s1", "s2"]


def test_a_robot_with_a_load_cannot_be_replaced() -> None:
    """What rover_1 has picked rover_2 cannot place; after placing it could go on."""
    found = rebind(given_up((GOTO, PICK, PLACE), "s3", OFFLINE), "s3")
    assert found == "rover_1 still has the load of s2"
    on = Subtask(id="s4", skill="photograph", robot="any", params={"target": "shelf"}, after=("s3",))
    assert isinstance(rebind(given_up((GOTO, PICK, PLACE, on), "s4", OFFLINE), "s4"), Rebinding)


@pytest.mark.parametrize(
    ("label", "policy", "allowed"),
    [("rover_1", "any", False), ("rover_1", "all", True), ("any1", "any", True), ("any", "never", False)],
)
def test_the_operators_wish_decides_which_robots_may_be_replaced(label: str, policy: Any, allowed: bool) -> None:
    """A robot that was named stays unless tasks.replan.robots says otherwise."""
    record = given_up((replace(GOTO, robot=label), replace(PHOTO, robot=label)), "s2", OFFLINE)
    found = rebind(record, "s2", config=ReplanConfig(robots=policy))
    assert isinstance(found, Rebinding) is allowed, found


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"online": False}, "is offline"),
        ({"battery_percent": 12.0}, "has too little charge"),
        ({"holding": "red box"}, "holds red box"),
        ({"uses": ("base",)}, "has no camera"),
        ({"verbs": ("goto", "state")}, "does not know"),
    ],
)
def test_a_robot_that_cannot_take_over_is_not_chosen_and_the_reason_is_told(other: Any, reason: str) -> None:
    """Offline, nearly empty, with its gripper full, without the camera or the command."""
    roster = {**ROBOTS.roster, "rover_2": rover("rover_2", **other)}
    robots = Robots(roster=roster, short=lambda robot, _: "has too little charge" if robot.battery_percent else "")
    found = rebind(given_up((GOTO, PHOTO), "s2", OFFLINE), "s2", robots=robots)
    assert isinstance(found, str)
    assert reason in found


def test_which_failures_are_the_robots() -> None:
    """Being away, its own failures and its final refusals are; a handler that saw nothing is not."""
    here = rover("r")
    assert is_the_robots(BROKEN, None)
    assert is_the_robots(BROKEN, rover("r", online=False))
    assert is_the_robots(Failure(code="robot", message="motor"), here)
    assert is_the_robots(Failure(code="refused", message="battery too low"), here)
    assert not is_the_robots(Failure(code="refused", message="gw-1 is full", retryable=True), here)
    assert not is_the_robots(BROKEN, here)


def manifest(name: str, **more: Any) -> SkillManifest:
    """A skill on a gateway."""
    given = {"id": name, "domain": "any", "summary": "x", "runs": "compute", "image": "base", "implemented": True}
    return SkillManifest(**{**given, **more})


def test_an_alternative_takes_the_place_with_its_parameters_mapped() -> None:
    """Detect gives way to find: a new id, the same robot, its parameters, and what came after comes after it."""
    detect = Subtask(id="s2", skill="detect", robot="any", params={"target": "red box"}, after=("s1",))
    record = given_up((GOTO, detect, NOTE), "s2", BROKEN)
    found = alternative_skill(record, record.of("s2"), manifests=SKILLS)
    assert isinstance(found, Substitution)
    assert found.subtask == replace(detect, id="r1ltn_1", skill="find")
    assert [each.after for each in found.plan.subtasks] == [(), ("s1",), ("r1ltn_1",)]
    after = step(record, TransitionKind.SUBSTITUTED, subtask="s2", plan=found.plan, note=found.note)
    assert after.of("r1ltn_1").instead_of == ("detect",)
    assert after.of("r1ltn_1").state is SubtaskState.READY
    assert after.retired == ("s2",)


def test_an_alternative_that_was_given_up_before_is_not_tried_again() -> None:
    """Find was in its place already: no circle."""
    record = given_up((replace(GOTO, skill="detect", params={"target": "red box"}),), "s1", BROKEN)
    target = replace(record.of("s1"), instead_of=("find",))
    found = alternative_skill(record, target, manifests=SKILLS)
    assert found == "find was given up here before"


def test_an_alternative_must_give_what_is_used_of_the_other() -> None:
    """A film does not serve what reads pictures."""
    photo = replace(PHOTO, after=())
    looks = Subtask(id="s3", skill="reads", after=("s2",))
    skills = {**SKILLS, "reads": manifest("reads", consumes=("image",))}
    record = given_up((photo, looks), "s2", BROKEN)
    found = alternative_skill(record, record.of("s2"), manifests=skills)
    assert found == "record_video gives no image, which later subtasks use"


def test_parameters_that_were_not_given_are_left_out() -> None:
    """An optional one that is mapped and absent stays absent; plain text stands for itself."""
    (choice,) = SKILLS["detect"].alternatives
    assert mapped(choice, {"target": "box"}) == {"target": "box"}


def test_the_order_of_what_is_tried() -> None:
    """The robot first if it is its failure, then the skill, then the decomposer; what cannot be says why."""
    record = given_up((GOTO, PHOTO), "s2", OFFLINE)
    given: dict[str, Any] = {"manifests": SKILLS, "robots": ROBOTS, "config": CONFIG}
    assert isinstance(decide(record, record.of("s2"), **given), Rebinding)
    alone = {**given, "robots": Robots(roster={"rover_1": rover("rover_1", online=False)})}
    assert isinstance(decide(record, record.of("s2"), **alone), Substitution)
    bare = {**alone, "config": replace(CONFIG, skills=False)}
    asked = decide(record, record.of("s2"), **bare)
    assert isinstance(asked, AskDecomposer)
    assert "no other robot can take over" in asked.note
    handed_in = given_up((GOTO, PHOTO), "s2", OFFLINE, handed_in=True)
    for given_record, config in (
        (handed_in, bare["config"]),
        (record, replace(bare["config"], decompose=False)),
        (replace(record, replans=2), bare["config"]),
        (replace(record, revised=6), CONFIG),
    ):
        found = decide(given_record, given_record.of("s2"), **{**bare, "config": config})
        assert isinstance(found, GiveUp), found


def test_what_the_policy_forbids_is_not_tried() -> None:
    """A robot that may not take over gives way to one that may, a skill to the next option; why is reported."""
    record = given_up((GOTO, PHOTO), "s2", OFFLINE)
    three = Robots(roster={**ROBOTS.roster, "rover_3": rover("rover_3")})
    given: dict[str, Any] = {"manifests": SKILLS, "robots": three, "config": CONFIG}
    target = record.of("s2")

    def not_rover_2(plan: Plan, robot: str) -> tuple[str, ...]:
        del plan
        return ("rover_2 may not do this",) if robot == "rover_2" else ()

    found = decide(record, target, **given, against=not_rover_2)
    assert isinstance(found, Rebinding)
    assert found.robot == "rover_3"
    nothing = decide(record, target, **given, against=lambda plan, _: (f"no {plan.subtasks[-1].skill}",))
    assert isinstance(nothing, AskDecomposer)
    assert "rover_2 may not take over: no goto" in nothing.note
    assert "may not take its place" in nothing.note


def test_what_is_left_of_a_revised_plan_names_who_is_to_do_it() -> None:
    """What is done is left out, the label of the robot that failed is the robot that takes over."""
    record = given_up((GOTO, PHOTO), "s2", OFFLINE)
    assert record.plan is not None
    (rest,) = remainder(record, record.of("s2"), record.plan, "rover_2").subtasks
    assert (rest.id, rest.robot, rest.after) == ("s2", "rover_2", ())
    (same,) = remainder(record, record.of("s2"), record.plan, "").subtasks
    assert same.robot == "rover_1"


def test_a_confirmed_plan_of_the_decomposer_may_be_planned_anew() -> None:
    """What the terminal UI hands in was made by the decomposer; what a person wrote was not."""
    record = given_up((replace(GOTO, robot=None, skill="report", params={}),), "s1", BROKEN, handed_in=True)
    given: dict[str, Any] = {"manifests": SKILLS, "robots": ROBOTS, "config": CONFIG}
    assert isinstance(decide(record, record.of("s1"), **given), GiveUp)
    assert record.plan is not None
    sure = replace(record, plan=replace(record.plan, confidence=0.9))
    assert isinstance(decide(sure, sure.of("s1"), **given), AskDecomposer)


def test_a_new_plan_keeps_what_is_finished_by_what_it_is_not_by_its_id() -> None:
    """A model may number as it likes: the way that was gone is known by skill, robot and place."""
    record = given_up((GOTO, PHOTO, NOTE), "s2", BROKEN)
    proposed = Plan(
        domain="navigation",
        subtasks=(
            Subtask(id="a", skill="goto", robot="rover_1", params={"place": "dock 3"}),
            Subtask(id="s1", skill="record_video", robot="any", params={"target": "shelf"}, after=("a",)),
            Subtask(id="c", skill="notify", params={"to": "operator"}, after=("s1",)),
        ),
    )
    assert problems(record, proposed, SKILLS) == ()
    spliced = splice(record, proposed)
    assert [(each.id, each.skill, each.after) for each in spliced.plan.subtasks] == [
        ("s1", "goto", ()),
        ("r1ltn_1", "record_video", ("s1",)),
        ("s9", "notify", ("r1ltn_1",)),
    ]
    assert (spliced.added, spliced.ending) == (("r1ltn_1",), ())
    record = step(record, TransitionKind.PROPOSED, subtask="s2", plan=proposed)
    record = step(record, TransitionKind.REPLANNED, subtask="s2", plan=spliced.plan)
    assert record.of("s1").result == {"of": "s1"}
    assert (record.replans, record.proposal, record.retired) == (1, None, ("s2",))


def test_a_new_plan_must_not_repeat_what_failed_or_move_a_load() -> None:
    """The same again, and a box in rover_1's gripper that rover_2 is to put down, are sent back to the model."""
    record = given_up((GOTO, PICK, PLACE), "s3", BROKEN)
    same = Plan(domain="manipulation", subtasks=(replace(PLACE, id="x", after=()),))
    assert any("this has failed (saw nothing)" in each for each in problems(record, same, SKILLS))
    other = Plan(domain="manipulation", subtasks=(replace(PLACE, id="x", robot="rover_2", after=()),))
    assert any("rover_1 has the load, not rover_2" in each for each in problems(record, other, SKILLS))
