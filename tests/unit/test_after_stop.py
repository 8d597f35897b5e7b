"""What is said of robots after a cancel or a stop, and the plans that have them get rid of what they hold."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.after_stop import Offer, bring_back, left, lefts, origin_of, put_down, robots_of, unfinished
from appliance.llm.checks.schema import validate
from appliance.model import (
    Attempt,
    Pause,
    Place,
    Plan,
    Pose,
    RobotInfo,
    Site,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.skills.catalogue import load_catalogue

SITE = Site(places={"dock 3": Place(x=10.0, y=4.0, aliases=("bay 3",)), "gate": Place(x=0.0, y=0.0)})
ROVER = RobotInfo(
    id="rover_1", kind="zenoh", pose=Pose(x=10.0, y=3.0), holding="red box", verbs=("goto", "pick", "place")
)


def step(
    name: str, skill: str, *, after: tuple[str, ...] = (), robot: str = "rover_1", **params: object
) -> SubtaskRecord:
    """Return a subtask that has succeeded."""
    return SubtaskRecord(
        subtask=Subtask(id=name, skill=skill, robot=robot, params=dict(params), after=after),
        state=SubtaskState.SUCCEEDED,
        attempts=(Attempt(number=1, gateway="gw-1"),),
    )


FETCHED = TaskRecord(
    id="t-1",
    instruction="rover_1: go to dock 3, pick the red box, go to the gate",
    state=TaskState.CANCELLED,
    subtasks=(
        step("s1", "goto", place="dock 3"),
        step("s2", "pick", after=("s1",), object="red box"),
        step("s3", "goto", after=("s2",), place="gate"),
    ),
)


def test_what_a_cancelled_task_leaves() -> None:
    """The robot stands near a place and holds something: put it down, bring it back, go on with the task."""
    found = left(ROVER, record=FETCHED, site=SITE)
    assert found.text == "rover_1 stands at 10.0 3.0 0.0 m (1.0 m from dock 3) and holds the red box"
    assert found.offers == (Offer("put_down_here", "rover_1"), Offer("bring_it_back", "rover_1"), Offer("retry", "t-1"))


def test_what_is_offered_depends_on_what_can_be_done() -> None:
    """Nothing is put down by a robot that is stopped, holds nothing or has no arm; a paused task is resumed."""
    assert left(ROVER, record=FETCHED, stopped=True).offers == (Offer("resume_robots", "rover_1"),)
    assert left(replace(ROVER, holding=""), record=FETCHED).offers == (Offer("retry", "t-1"),)
    assert left(replace(ROVER, verbs=())).offers == ()
    paused = replace(FETCHED, state=TaskState.RUNNING, pauses=(Pause(by="ann"),))
    assert left(replace(ROVER, holding=""), record=paused).offers == (Offer("resume", "t-1"),)
    offline = left(replace(ROVER, online=False, pose=None))
    assert offline.text == "rover_1 is offline, last heard somewhere and holds the red box"
    assert not unfinished(replace(FETCHED, state=TaskState.SUCCEEDED))
    assert unfinished(paused)


def test_only_robots_that_began_something_are_told_of() -> None:
    """A subtask without an attempt has moved nobody; a robot that has left the roster is left out."""
    waiting = SubtaskRecord(subtask=Subtask(id="s4", skill="goto", robot="rover_2"))
    record = replace(FETCHED, subtasks=(*FETCHED.subtasks, waiting, step("s5", "goto", robot="rover_9")))
    assert robots_of(record) == ("rover_1", "rover_9")
    assert [each.robot for each in lefts({"rover_1": ROVER}, robots_of(record))] == ["rover_1"]


def test_where_a_thing_was_picked_up() -> None:
    """The place that the robot went to before; else where it said that it was; of several tasks the newest tells."""
    assert origin_of([FETCHED], "rover_1", "red box") == "dock 3"
    assert origin_of([FETCHED], "rover_1", "the Red Box") == "dock 3"
    assert origin_of([FETCHED], "rover_2", "red box") == ""
    assert origin_of([FETCHED], "rover_1", "blue box") == ""
    there = replace(step("s1", "pick", object="red box"), result={"pose": {"x": 3.0, "y": 4.5, "z": 0.0}})
    newer = replace(FETCHED, id="t-2", subtasks=(there,))
    assert origin_of([newer, FETCHED], "rover_1", "red box") == "3.00, 4.50"
    failed = replace(newer, subtasks=(replace(there, state=SubtaskState.FAILED),))
    assert origin_of([failed, FETCHED], "rover_1", "red box") == "dock 3"


@given(
    st.lists(
        st.tuples(st.sampled_from(["goto", "pick", "place"]), st.lists(st.sampled_from(["s0", "s1", "s2", "s9"]))),
        max_size=4,
    ),
    st.dictionaries(st.text(max_size=5), st.none() | st.integers() | st.floats() | st.text(max_size=5), max_size=3),
)
def test_no_record_breaks_the_search(steps: list[tuple[str, list[str]]], pose: dict[str, object]) -> None:
    """Circles, unknown predecessors and results of any kind are searched to an end."""
    record = replace(
        FETCHED,
        subtasks=tuple(
            replace(step(f"s{n}", skill, after=tuple(after), object="red box", place="gate"), result={"pose": pose})
            for n, (skill, after) in enumerate(steps)
        ),
    )
    assert isinstance(origin_of([record], "rover_1", "red box"), str)


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        (put_down(ROVER), ["place red box here"]),
        (bring_back(ROVER, "bay 3", SITE), ["goto bay 3", "place red box bay 3"]),
        (bring_back(ROVER, "3.00, 4.50", SITE), ["goto 3.00, 4.50", "place red box here"]),
    ],
)
def test_plans_are_valid_and_say_what_they_do(plan: Plan, said: list[str]) -> None:
    """Each passes the checks of the catalogue; at coordinates the thing is put down where the robot stands."""
    assert [f"{each.skill} {' '.join(map(str, each.params.values()))}" for each in plan.subtasks] == said
    assert not validate(plan, load_catalogue())
