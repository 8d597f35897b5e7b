"""The robots that a model is shown: those that the words can mean, whatever the size and order of the fleet."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import PlanError
from appliance.llm.checks.reading import Token, read
from appliance.llm.plan_cache import plan_key
from appliance.llm.preprocessing import told
from appliance.llm.review import Facts, review
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.llm.shortlist import MOST_COUNTED, MOST_GROUPS, STAND_INS, Group, Shortlist, shortlist
from appliance.model import MAX_SUBTASKS, Plan, RobotInfo, Subtask
from appliance.skills.catalogue import Catalogue, load_catalogue
from appliance.skills.sites import load_site
from workshop.bench.intent.cases import robot
from workshop.bench.plan.rosters import SIZES, fleet

CATALOGUE = load_catalogue()
NOTHING: dict[str, object] = {}
"""No parameters."""
ORDERS = (
    "rover_5: go to dock 1, then photograph the shelf",
    "go to dock 1, then photograph the shelf",
    "a drone photographs the gate",
    "the rover photographs the gate",
    "three drones film the yard",
    "all drones return home",
    "every robot goes to dock 2",
    "all robots go to dock 1, then all drones take off",
    "everyone except rover_5 returns home",
    "rover_5 goes to dock 1, the others return home",
    "rover_5 goes to dock 1 and another rover goes to dock 2",
    "drone_1 takes off while all rovers go to dock 2 and a drone films it",
)


def asked(text: str, robots: tuple[RobotInfo, ...] | None) -> Shortlist:
    """Return what a model is shown for an instruction, as the cascade has it."""
    context = PlanContext(instruction=text, robots=robots)
    return shortlist(told(context).context(context))


def bots(*names: str) -> tuple[RobotInfo, ...]:
    """Return robots that can do everything."""
    uses = tuple(sorted({use for each in CATALOGUE.skills.values() for use in each.uses}))
    verbs = tuple(sorted({verb for each in CATALOGUE.skills.values() for verb in each.verbs}))
    return tuple(RobotInfo(id=each, kind="zenoh", uses=uses, verbs=verbs, flies=True) for each in names)


# --- who is shown -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ORDERS)
def test_a_model_is_asked_the_same_for_fleets_of_all_sizes(text: str) -> None:
    """From 8 robots on the words and the roster of a prompt are the same: so are its time and its confidence."""
    first, *others = [asked(text, fleet(size)) for size in SIZES if size >= 8]
    for each in others:
        assert (each.instruction, each.typed, each.names) == (first.instruction, first.typed, first.names)
        assert len(each.robots or ()) <= len(each.names or ()) + 4


@given(text=st.sampled_from(ORDERS), size=st.integers(2, 40), seed=st.integers(0, 99))
def test_the_order_of_the_roster_changes_nothing(text: str, size: int, seed: int) -> None:
    """A gateway learns of robots in any order; the same words get the same prompt and the same plan."""
    robots = list(fleet(size))
    before = asked(text, tuple(robots))
    random.Random(seed).shuffle(robots)  # noqa: S311 - any order will do
    assert asked(text, tuple(robots)) == before


_NAMES = st.one_of(
    st.from_regex(r"[a-z0-9][a-z0-9_.-]{0,12}", fullmatch=True),
    st.sampled_from(
        ("rover_1", "rover_10", "rover_100", "rover", "r", "goto", "land", "all", "drone", "dock_1", "7up", "u", "n_x3")
    ),
    st.sampled_from(("ровер_1", "无人机_3", "διάνα", "ロボ", "🤖", "🤖_2", "🚁🚁", "ännchen", "ﬁsh_1", "İz_1")),
)


@settings(max_examples=300)
@given(names=st.lists(_NAMES, min_size=1, max_size=30, unique=True), data=st.data())
def test_a_robot_that_is_named_is_always_shown(names: list[str], data: st.DataObject) -> None:
    """Whatever a name is made of, and whatever the other names are; as it is written, or with blanks in it."""
    name = data.draw(st.sampled_from(names))
    said = data.draw(st.sampled_from((name, name.upper() if name.isascii() else name, name.replace("_", " "))))
    text = data.draw(st.sampled_from(("{} goes to dock 1", "go to dock 1, {}", "{}: land, then rover_1 takes off")))
    if not any(each.isalnum() or not each.isascii() for each in name):
        return
    assert name in (asked(text.format(said), bots(*names)).names or ())


@settings(max_examples=300)
@given(
    text=st.lists(
        st.sampled_from(
            "rover_1 rover_2 drone_3 drone rovers all both every a the two three others everyone except goes to dock 1 "  # noqa: SIM905 - a list of words
            ", . and while then photographs".split()
        ),
        min_size=1,
        max_size=14,
    ).map(" ".join),
    size=st.integers(2, 120),
)
def test_as_many_robots_are_shown_as_the_words_have_groups(text: str, size: int) -> None:
    """No fleet is large enough to crowd out the words, and no robot is shown that the fleet does not have."""
    robots = fleet(size)
    shown = asked(text, robots).names or ()
    words = text.split()
    groups = sum(
        each in ("drone", "rovers", "others", "everyone", "all", "both", "every", "two", "three") for each in words
    )
    named = {each for each in words if "_" in each}
    assert len(shown) <= len(named) + STAND_INS * MOST_GROUPS + MOST_COUNTED * groups
    assert set(shown) <= {each.id for each in robots}
    assert len(set(shown)) == len(shown)


def test_names_that_begin_like_others_are_told_apart() -> None:
    """`rover_1` stands in no "rover_10", and "lee" in no "lee_ann"."""
    robots = bots("rover_1", "rover_10", "rover_100", "lee", "lee_ann", "lee_anne")
    assert asked("rover_10: go to dock 1", robots).names == ("rover_10",)
    assert asked("Rover 1 and Lee Ann go to dock 100", robots).names == ("lee_ann", "rover_1")
    assert asked("lee goes to dock 10", robots).names == ("lee",)


def test_robots_that_are_called_like_skills_are_shown_where_they_are_said() -> None:
    """The word "land" may be the robot or the order: it is shown, and the plan is reviewed as any."""
    assert "land" in (asked("Land, go to dock 1", bots("goto", "land", "rover_1")).names or ())
    assert asked("rover_1: go to dock 1", bots("goto", "land", "rover_1")).names == ("rover_1",)


def test_without_a_name_nobody_is_shown() -> None:
    """The plan then says `any`, and the roster and `safety.choose_robot` decide; of no roster nothing is known."""
    assert asked("go to dock 1", fleet(64)).names == ()
    assert asked("go to dock 1", ()).names == ()
    assert asked("a robot goes to dock 1", fleet(64)).names == ()
    assert asked("all drones land", None) == Shortlist(
        instruction="all drones land", typed="all drones land", names=None, robots=None
    )


def test_the_rover_is_a_name_only_where_the_whole_fleet_has_one() -> None:
    """A robot that stands for others is one of those that are meant, and is chosen by a person."""
    alone = PlanContext(instruction="the rover photographs the gate", robots=(robot("rover_7"), *fleet(64)[32:]))
    assert shortlist(told(alone).context(alone)) == Shortlist(
        instruction="rover_7 photographs the gate", typed="rover_7 photographs the gate", names=("rover_7",),
        robots=shortlist(told(alone).context(alone)).robots,
    )  # fmt: skip
    several = PlanContext(instruction=alone.instruction, robots=fleet(64))
    shown = asked(several.instruction, several.robots)
    (group,) = shown.groups
    assert (group.each, len(group.members)) == (False, 32)
    plan = shown.whole(planned(("photograph", "rover_1", {"target": "gate"})), several.robots, CATALOGUE)
    found = review(Facts(plan, several, CATALOGUE, SafetyConfig()))
    assert {each.check for each in found.findings} >= {"choose_robot"}


def test_a_fleet_of_ten_thousand_shows_no_more_than_one_of_eight() -> None:
    """Only what the words say counts; the largest fleet's prompt is as short as any."""
    robots = fleet(10_000)
    for text in ORDERS:
        assert asked(text, robots).names == asked(text, fleet(8)).names


def test_messages_to_everybody_are_no_work_for_everybody() -> None:
    """Robots that something is said to, or are where something is brought, stand as they were typed."""
    for text in (
        "tell everyone lunch is ready",
        "bring the box to a drone",
        'rover_5 says "all drones land"',
        "move the units to dock 2",
    ):
        assert asked(text, fleet(16)).instruction == text
    assert asked("tell all drones to land", fleet(16)).instruction == "tell drone_1 and drone_2 to land"
    assert asked("the drones land", fleet(16)).instruction == "drone_1 and drone_2 land"


def test_whoever_is_left_out_is_no_member() -> None:
    """All but some, "the others" and "everyone else" are the fleet without those that are named."""
    for text in (
        "everyone except rover_1 lands",
        "rover_1 waits, the others land",
        "everyone else lands; rover_1 waits",
    ):
        (group,) = asked(text, fleet(16)).groups
        assert set(group.members) == {each.id for each in fleet(16)} - {"rover_1"}
    (group,) = asked("all drones except drone_2 and drone_3 land", fleet(16)).groups
    assert group.shown == ("drone_1", "drone_4")
    assert set(group.members) & {"drone_2", "drone_3"} == set()


def test_a_number_that_the_fleet_does_not_have_stands_for_nobody() -> None:
    """Whom "both drones" and "all three drones" of eight are is not guessed."""
    for text in ("both drones land", "all three drones land"):
        assert asked(text, fleet(16)).groups == ()
    assert [each.count for each in told_tokens("two drones land") if each.kind == "robot"] == [2]


def told_tokens(text: str) -> tuple[Token, ...]:
    """Return the tokens of an instruction to sixteen robots."""
    return read(text, fleet(16)).tokens


def test_the_key_of_a_plan_is_that_of_the_whole_fleet() -> None:
    """A robot that joins makes plans for groups old, though the prompt stays the same."""
    keys = {
        plan_key(PlanContext(instruction="all drones land", robots=fleet(size)), catalogue="", policy="")
        for size in (16, 32, 64)
    }
    assert len(keys) == 3


# --- the plan for all -------------------------------------------------------------------------------------------------


def _at(place: str) -> dict[str, object]:
    return {"place": place}


def planned(*steps: tuple[str, str | None, dict[str, object]] | tuple[str, str | None, dict[str, object], str]) -> Plan:
    """Return a plan of skill, robot, parameters and the numbers of those before, as "1 2"."""
    subtasks = tuple(
        Subtask(
            id=f"s{number}",
            skill=skill,
            robot=who,
            params=dict(params),
            after=tuple(f"s{one}" for one in (after[0].split() if after else ())),
        )
        for number, (skill, who, params, *after) in enumerate(steps, start=1)
    )
    return Plan(domain="navigation", subtasks=subtasks)


def edges(plan: Plan) -> set[tuple[str, str]]:
    """Return the edges of a plan by skill and robot."""
    named = {each.id: f"{each.skill} {each.robot}" for each in plan.subtasks}
    return {(named[one], named[each.id]) for each in plan.subtasks for one in each.after}


def everybody(size: int, *, shown: int = 2) -> tuple[Group, Shortlist]:
    """Return a group of drones, and a list with it."""
    members = tuple(f"drone_{each}" for each in range(1, size + 1))
    group = Group(members[:shown], members, each=True)
    return group, Shortlist(instruction="", typed="", names=members[:shown], robots=(), groups=(group,))


@given(size=st.integers(3, 20), tail=st.booleans())
def test_every_member_does_what_the_stand_ins_do_and_nobody_else_does(size: int, tail: bool) -> None:
    """Each in its own order, and what waits for the stand-ins waits for all."""
    group, shown = everybody(size)
    steps: list[tuple[str, str | None, dict[str, object], str]] = [
        ("goto", "rover_1", _at("dock 1"), ""),
        ("takeoff", "drone_1", NOTHING, "1"),
        ("takeoff", "drone_2", NOTHING, "1"),
        ("goto", "drone_1", {"place": "gate"}, "2"),
        ("goto", "drone_2", {"place": "gate"}, "3"),
        *([("report", None, {"to": "operator"}, "4 5")] if tail else []),
    ]
    plan = shown.whole(planned(*steps), bots(*group.members), CATALOGUE)
    assert [each.id for each in plan.subtasks] == [f"s{number}" for number in range(1, len(plan.subtasks) + 1)]
    place = {each.id: number for number, each in enumerate(plan.subtasks)}
    assert all(place[one] < place[each.id] for each in plan.subtasks for one in each.after)
    for name in group.members:
        own = [each for each in plan.subtasks if each.robot == name]
        assert [(each.skill, each.params) for each in own] == [("takeoff", NOTHING), ("goto", {"place": "gate"})]
    wanted = {("goto rover_1", f"takeoff {name}") for name in group.members}
    wanted |= {(f"takeoff {name}", f"goto {name}") for name in group.members}
    wanted |= {(f"goto {name}", "report None") for name in group.members} if tail else set()
    assert edges(plan) == wanted
    assert len(plan.subtasks) == 1 + 2 * size + tail


@pytest.mark.parametrize(
    "steps",
    [
        pytest.param((("land", "drone_1", NOTHING), ("land", "drone_2", NOTHING, "1")), id="one after the other"),
        pytest.param((("goto", "drone_1", _at("dock 1")), ("goto", "drone_2", _at("dock 2"))), id="elsewhere"),
        pytest.param((("land", "drone_1", NOTHING),), id="one of them"),
        pytest.param((("takeoff", "drone_1", NOTHING), ("land", "drone_2", NOTHING)), id="something else"),
        pytest.param(
            (("land", "drone_1", NOTHING), ("land", "drone_2", NOTHING), ("goto", "rover_1", _at("a"), "1")),
            id="awaited",
        ),
        pytest.param((("goto", "any", _at("dock 1")),), id="neither"),
    ],
)
def test_what_stand_ins_do_differently_is_given_to_nobody_else(
    steps: tuple[tuple[str, str, dict[str, object]], ...],
) -> None:
    """Whether they take turns or share the work cannot be told of others: the plan stays, and the review holds it."""
    _, shown = everybody(8)
    plan = planned(*steps)
    assert shown.whole(plan, (), CATALOGUE) == plan


def test_a_subtask_for_several_together_gets_all_of_them() -> None:
    """A joint skill lists its robots; it stays one subtask."""
    group, shown = everybody(5)
    plan = planned(
        ("takeoff", "drone_1", NOTHING),
        ("takeoff", "drone_2", NOTHING),
        ("rendezvous", "drone_1", {"robots": ["drone_1", "drone_2"], "place": "dock 1"}, "1 2"),
    )
    whole = shown.whole(plan, (), CATALOGUE)
    assert whole.subtasks[-1].params["robots"] == list(group.members)
    assert len(whole.subtasks[-1].after) == 5


def test_a_plan_for_too_many_is_refused_with_the_number_and_what_to_do() -> None:
    """As the rules say it: how many subtasks it would be, how many there may be, and to split it."""
    _, shown = everybody(MAX_SUBTASKS + 1)
    with pytest.raises(PlanError, match=f"{MAX_SUBTASKS + 1} subtasks") as refused:
        shown.whole(planned(("land", "drone_1", NOTHING), ("land", "drone_2", NOTHING)), (), CATALOGUE)
    assert refused.value.oversize
    assert refused.value.remedy


def test_one_of_a_kind_is_one_that_can_do_it_and_is_there(catalogue: Catalogue) -> None:
    """The first by number; who cannot fly, is offline, or has work already is passed over where there is another."""
    first, second, third, fourth = bots("drone_1", "drone_2", "drone_3", "drone_4")
    robots = (replace(first, flies=False), replace(second, online=False), third, fourth)
    group = Group(("drone_1",), ("drone_1", "drone_2", "drone_3", "drone_4"), each=False)
    shown = Shortlist(instruction="", typed="", names=("drone_1",), robots=(), groups=(group,))
    taken = shown.whole(planned(("takeoff", "drone_1", NOTHING)), robots, catalogue)
    assert taken.subtasks[0].robot == "drone_3"
    busy = planned(("takeoff", "drone_1", NOTHING), ("goto", "drone_3", _at("dock 1")))
    assert shown.whole(busy, robots, catalogue).subtasks[0].robot == "drone_4"
    nobody = tuple(replace(each, flies=False) for each in robots)
    assert shown.whole(planned(("takeoff", "drone_1", NOTHING)), nobody, catalogue).subtasks[0].robot == "drone_1"


@given(size=st.integers(3, 30))
def test_the_whole_plan_passes_the_review_of_the_whole_fleet(size: int) -> None:
    """What is expanded leaves nobody of the group out and takes nobody in: no check of robots speaks against it."""
    robots = fleet(2 * size)
    context = PlanContext(instruction="all drones return home", robots=robots)
    shown = asked(context.instruction, robots)
    plan = planned(*(("return_home", each, NOTHING) for each in shown.names or ()))
    found = review(Facts(shown.whole(plan, robots, CATALOGUE), context, CATALOGUE, SafetyConfig()))
    assert found.findings == ()
    short = review(Facts(plan, context, CATALOGUE, SafetyConfig()))
    assert {each.check for each in short.findings} >= {"assignment"}


def test_a_place_that_is_called_like_a_robot_keeps_its_name() -> None:
    """The drone pad of a site is no drone; without such a place it may be one."""
    text = "photograph the drone pad with rover_1"
    context = PlanContext(instruction=text, robots=fleet(8), site=load_site("warehouse"))
    assert (shortlist(context).instruction, shortlist(context).names) == (text, ("rover_1",))
