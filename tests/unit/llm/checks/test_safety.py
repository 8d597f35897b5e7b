"""The safety policy: what it forbids, what contradicts itself, what was never said, what a person has to see."""

import ast
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.llm.checks.consistency import contradictions
from appliance.llm.checks.facts import Facts
from appliance.llm.checks.safety import policy_holds, ungrounded, unsafe
from appliance.llm.checks.schema import validate
from appliance.llm.prompt import MOST, quoted
from appliance.llm.settings import PlanContext, RobotLimits, SafetyConfig
from appliance.model import Place, Plan, Pose, RobotInfo, Severity, Site, Subtask
from appliance.skills.catalogue import Catalogue, load_catalogue


def step(name: str, skill: str, robot: str | None = "rover_1", *after: str, **params: object) -> Subtask:
    """Return a subtask."""
    return Subtask(id=name, skill=skill, robot=robot, params=params, after=after)


def plan(*subtasks: Subtask) -> Plan:
    """Return a plan of them."""
    return Plan(domain="navigation", subtasks=subtasks)


Ask = PlanContext


@pytest.fixture
def ask(robots: tuple[RobotInfo, ...], site: Site) -> PlanContext:
    """Return what is known."""
    return PlanContext(instruction="go", robots=robots, site=site)


def test_a_policy_that_forbids_nothing_finds_nothing(ask: Ask, catalogue: Catalogue) -> None:
    """Without settings no sound plan is refused."""
    sound = plan(step("s1", "goto", place="dock 1"), step("s2", "pick", "rover_1", "s1", object="box"))
    assert unsafe(sound, ask, catalogue, SafetyConfig()) == ()


@pytest.mark.parametrize(
    ("config", "subtask", "said"),
    [
        (SafetyConfig(skills_never=("cut",)), step("s1", "cut", object="rope"), "forbids the skill"),
        (SafetyConfig(places_never=("dock *",)), step("s1", "goto", place="the Dock 2"), "forbids 'dock 2'"),
        (SafetyConfig(places_never=("vault",)), step("s1", "open", object="vault"), "forbids vault"),
        (SafetyConfig(), step("s1", "photograph", target="pit edge"), "forbidden area pit"),
        (
            SafetyConfig(limits=(RobotLimits(robots=("drone_*",), altitude_m=10),)),
            step("s1", "takeoff", "drone_1", altitude_m=20),
            "limit of drone_1, 10 m",
        ),
        (
            SafetyConfig(
                limits=(RobotLimits(robots=("*",), speed_mps=2), RobotLimits(robots=("rover*",), speed_mps=1))
            ),
            step("s1", "goto", place="dock 1", speed_mps=1.5),
            "limit of rover_1, 1 m/s",
        ),
        (
            SafetyConfig(limits=(RobotLimits(robots=("rover_1",), skills_never=("p*",)),)),
            step("s1", "pick", "any", object="box"),
            "rover_1 may not do this",
        ),
        (
            SafetyConfig(limits=(RobotLimits(robots=("rover_1",), places_never=("shelf",)),)),
            step("s1", "goto", place="shelf"),
            "rover_1 may not go to shelf",
        ),
    ],
)
def test_what_the_policy_forbids_is_named(
    config: SafetyConfig, subtask: Subtask, said: str, ask: Ask, catalogue: Catalogue
) -> None:
    """Each rule refuses with the subtask, the reason and the setting."""
    config.check()
    (problem,) = unsafe(plan(subtask), ask, catalogue, config)
    assert said in problem
    assert problem.startswith("s1 (")


def test_an_unnamed_robot_is_held_to_the_strictest_that_can_do_it(ask: Ask, catalogue: Catalogue) -> None:
    """Limits of a robot that cannot do a skill do not count against `any`."""
    config = SafetyConfig(limits=(RobotLimits(robots=("rover_1",), altitude_m=1),))
    climb = plan(step("s1", "takeoff", "any", altitude_m=20))
    assert unsafe(climb, ask, catalogue, config) == ()


def test_one_robot_at_a_time(ask: Ask, catalogue: Catalogue) -> None:
    """Visits to an exclusive place by two robots must be ordered, with the first gone before the second comes."""
    config = SafetyConfig(exclusive_places=("dock *",))
    together = plan(step("s1", "goto", "rover_1", place="dock 1"), step("s2", "goto", "drone_1", place="dock 1"))
    assert "one robot at a time" in unsafe(together, ask, catalogue, config)[0]
    still_there = plan(together.subtasks[0], replace(together.subtasks[1], after=("s1",)))
    assert "have one leave" in unsafe(still_there, ask, catalogue, config)[0]
    left = plan(
        together.subtasks[0],
        step("s3", "goto", "rover_1", "s1", place="shelf"),
        step("s2", "goto", "drone_1", "s3", place="dock 1"),
    )
    assert unsafe(left, ask, catalogue, config) == ()
    elsewhere = plan(together.subtasks[0], step("s2", "goto", "drone_1", place="dock 2"))
    assert unsafe(elsewhere, ask, catalogue, config) == ()


@pytest.mark.parametrize(
    "params",
    [
        {"place": "goal two"},
        {"place": "the Goal Two."},
        {"place": "5, 5"},
        {"place": "(5.4, 5.3)"},
        {"path": "shelf, then goal two"},
        {"path": "shelf then (5, 5, 1) and dock 1"},
    ],
)
@pytest.mark.parametrize(
    "config",
    [
        SafetyConfig(places_never=("goal *2",)),
        SafetyConfig(limits=(RobotLimits(robots=("rover_*",), places_never=("goal *2",)),)),
    ],
)
def test_a_place_is_forbidden_by_whatever_name(
    config: SafetyConfig, params: dict[str, str], ask: Ask, catalogue: Catalogue
) -> None:
    """An alias, a coordinate at the place and a stop on a route are the place; beside it is elsewhere."""
    skill = "follow_path" if "path" in params else "goto"
    assert unsafe(plan(step("s1", skill, **params)), ask, catalogue, config)
    assert unsafe(plan(step("s1", "goto", place="5, 8")), ask, catalogue, config) == ()


@pytest.mark.parametrize("other", ["goal two", "5, 5", "(5.5, 5)"])
@pytest.mark.parametrize("pattern", ["goal 2", "goal two"])
def test_one_robot_at_a_time_by_whatever_name(pattern: str, other: str, ask: Ask, catalogue: Catalogue) -> None:
    """Two names of one exclusive place are one place, whichever of them the policy says."""
    config = SafetyConfig(exclusive_places=(pattern,))
    both = plan(step("s1", "goto", "rover_1", place="goal 2"), step("s2", "goto", "drone_1", place=other))
    assert "goal 2 is for one robot at a time" in unsafe(both, ask, catalogue, config)[0]


@pytest.mark.parametrize(
    ("subtask", "limit", "said"),
    [
        (step("s1", "record_video", target="shelf"), 3.0, "duration_s is usually 5 and the limit of rover_1 is 3 s"),
        (step("s1", "record_video", target="shelf"), 5.0, ""),
        (step("s1", "record_video", target="shelf", duration_s=2), 3.0, ""),
        (step("s1", "patrol", area="shelf"), 60.0, "duration_s is not known beforehand"),
        (step("s1", "patrol", area="shelf", duration_s=30), 60.0, ""),
        (step("s1", "hold"), 1.0, ""),
        (step("s1", "goto", place="shelf"), 1.0, ""),
    ],
)
def test_for_how_long_a_skill_usually_goes_on_counts(
    subtask: Subtask, limit: float, said: str, ask: Ask, catalogue: Catalogue
) -> None:
    """A plan that does not say is refused where the skill's usual time is above the limit, or is not known."""
    config = SafetyConfig(limits=(RobotLimits(robots=("rover_*",), duration_s=limit),))
    problems = unsafe(plan(subtask), ask, catalogue, config)
    assert said in problems[0] if said else problems == ()


def test_speeds_and_heights_that_a_skill_chooses_are_lowered_later(ask: Ask, catalogue: Catalogue) -> None:
    """A plan that says none is not refused for them: the order is held to the limit when it is sent."""
    config = SafetyConfig(limits=(RobotLimits(robots=("*",), altitude_m=1, speed_mps=0.5),))
    both = plan(step("s1", "takeoff", "drone_1"), step("s2", "goto", "rover_1", place="shelf"))
    assert unsafe(both, ask, catalogue, config) == ()


@pytest.mark.parametrize("place", ["the mast", "5, 8, 12"])
def test_a_place_that_lies_above_a_limit_is_refused(place: str, ask: Ask, site: Site, catalogue: Catalogue) -> None:
    """By name or as a coordinate: to fly there is to fly that high."""
    high = replace(site, places={**site.places, "mast": Place(x=5, y=8, z=12)})
    config = SafetyConfig(limits=(RobotLimits(robots=("drone_*",), altitude_m=10),))
    (problem,) = unsafe(plan(step("s1", "goto", "drone_1", place=place)), replace(ask, site=high), catalogue, config)
    assert "12 m up, above the limit of drone_1, 10 m" in problem
    assert unsafe(plan(step("s1", "goto", place=place)), replace(ask, site=high), catalogue, config) == ()


def test_usual_values_of_manifests_are_those_of_the_handlers(catalogue: Catalogue) -> None:
    """What the policy takes for usual is what a handler does without a word."""
    said = {
        (skill.id, name): param.usual
        for skill in catalogue.skills.values()
        for name, param in skill.params.items()
        if param.usual is not None
    }
    constants = {
        ("takeoff", "altitude_m"): ("USUAL_M", float),
        ("record_video", "duration_s"): ("USUAL_S", float),
        ("track", "duration_s"): ("USUAL_S", float),
        ("dock", "station"): ("USUAL", str),
    }
    assert said.pop(("hold", "duration_s")) == 0.0
    found: dict[tuple[str, str], object] = {}
    for (skill, name), (constant, _) in constants.items():
        text = (catalogue.skills[skill].folder / "handler.py").read_text()
        match = re.search(rf"^{constant} = (.+)$", text, re.MULTILINE)
        assert match is not None
        found[skill, name] = ast.literal_eval(match[1])
    assert found == said


def homes(ask: Ask, **told: tuple[float, float]) -> PlanContext:
    """Return what is known, with robots that have told their homes."""
    robots = [replace(each, home=Pose(x=told[each.id][0], y=told[each.id][1])) if each.id in told else each
              for each in ask.robots or ()]  # fmt: skip
    return replace(ask, robots=tuple(robots))


def test_a_return_home_goes_where_the_robots_home_is(ask: Ask, catalogue: Catalogue) -> None:
    """A home at a forbidden place is one; elsewhere it is not; each robot has its own."""
    back = plan(step("s1", "return_home", "rover_1"))
    config = SafetyConfig(places_never=("dock 1",))
    assert unsafe(back, homes(ask, rover_1=(1.3, 1.0)), catalogue, config) == (
        "s1 (return_home): the policy forbids the home of rover_1 (safety.places_never: dock 1): choose another",
    )
    assert unsafe(back, homes(ask, rover_1=(9.0, 9.0), drone_1=(1.0, 1.0)), catalogue, config) == ()
    own = SafetyConfig(limits=(RobotLimits(robots=("rover_*",), places_never=("dock 1",)),))
    assert "rover_1 may not go to the home of rover_1" in unsafe(back, homes(ask, rover_1=(1, 1)), catalogue, own)[0]
    assert unsafe(plan(step("s1", "return_home", "drone_1")), homes(ask, drone_1=(1, 1)), catalogue, own) == ()


def test_a_home_that_was_not_told_is_the_sites(ask: Ask, site: Site, catalogue: Catalogue) -> None:
    """Until a robot tells its home, the place that the site calls so counts."""
    back = plan(step("s1", "return_home", "rover_1"))
    config = SafetyConfig(places_never=("base",))
    assert unsafe(back, ask, catalogue, config) == ()
    based = replace(site, places={**site.places, "home": Place(x=4, y=4, aliases=("base",))})
    assert "the home of rover_1" in unsafe(back, replace(ask, site=based), catalogue, config)[0]


def test_one_robot_at_a_time_at_home(ask: Ask, catalogue: Catalogue) -> None:
    """Two robots whose homes are one exclusive place may not both return; with homes apart they may."""
    config = SafetyConfig(exclusive_places=("dock *",))
    both = plan(step("s1", "return_home", "rover_1"), step("s2", "return_home", "drone_1"))
    shared = homes(ask, rover_1=(1, 1), drone_1=(1.2, 1))
    assert "dock 1 is for one robot at a time" in unsafe(both, shared, catalogue, config)[0]
    assert unsafe(both, homes(ask, rover_1=(1, 1), drone_1=(2, 9)), catalogue, config) == ()
    visit = plan(step("s1", "goto", "rover_1", place="dock 1"), step("s2", "return_home", "drone_1"))
    assert "dock 1 is for one" in unsafe(visit, homes(ask, drone_1=(1, 1)), catalogue, config)[0]
    everybody = plan(step("s1", "return_home", "all"))
    assert "s1: dock 1 is for one" in unsafe(everybody, shared, catalogue, config)[0]
    assert unsafe(everybody, homes(ask, rover_1=(1, 1), drone_1=(2, 9)), catalogue, config) == ()


def test_a_dock_without_a_station_is_the_usual_one(ask: Ask, site: Site, catalogue: Catalogue) -> None:
    """The charger, by whatever pattern or alias the policy knows it."""
    charged = replace(ask, site=replace(site, places={"charger": Place(x=2, y=8, aliases=("charging dock",))}))
    for config in (SafetyConfig(places_never=("charg*",)), SafetyConfig(places_never=("charging dock",))):
        assert "charger, its usual station" in unsafe(plan(step("s1", "dock")), charged, catalogue, config)[0]
        assert unsafe(plan(step("s1", "dock", station="dock 1")), charged, catalogue, config) == ()
    exclusive = SafetyConfig(exclusive_places=("charger",))
    two = plan(step("s1", "dock", "rover_1"), step("s2", "dock", "drone_1"))
    assert "charger is for one robot at a time" in unsafe(two, charged, catalogue, exclusive)[0]


@pytest.mark.parametrize(("policy", "allowed"), [("any", True), ("own", False), ("never", False)])
def test_whom_a_robots_task_may_command(policy: str, allowed: bool, ask: Ask, catalogue: Catalogue) -> None:
    """With `own` a robot commands itself alone, with `never` nobody; people are not held to it."""
    config = SafetyConfig(robot_tasks=policy)  # type: ignore[arg-type]
    other, own = plan(step("s1", "hold", "drone_1")), plan(step("s1", "hold", "rover_1"))
    asked = replace(ask, submitter="rover_1", from_robot=True)
    assert (unsafe(other, asked, catalogue, config) == ()) is allowed
    assert (unsafe(own, asked, catalogue, config) == ()) is (policy != "never")
    assert unsafe(other, ask, catalogue, config) == ()


@pytest.mark.parametrize(
    ("subtasks", "contradicts"),
    [
        ((step("s1", "goto", place="dock 1"), step("s2", "goto", place="dock 2")), True),
        ((step("s1", "goto", place="dock 1"), step("s2", "goto", "rover_1", "s1", place="dock 2")), False),
        ((step("s1", "goto", place="dock 1"), step("s2", "goto", "rover_2", place="dock 2")), False),
        ((step("s1", "goto", place="dock 1"), step("s2", "record_video", target="aisle")), False),
        ((step("s1", "open", object="gate"), step("s2", "close", "rover_2", object="gate")), True),
        ((step("s1", "open", object="gate"), step("s2", "close", "rover_2", object="hatch")), False),
        ((step("s1", "takeoff", "drone_1"), step("s2", "land", "drone_1")), True),
        ((step("s1", "switch_on", object="lamp"), step("s2", "switch_off", "rover_1", "s1", object="lamp")), False),
    ],
)
def test_orders_that_contradict_each_other(subtasks: tuple[Subtask, ...], contradicts: bool) -> None:
    """Only what is certain: one robot in two places at once, or one thing opened and closed at once."""
    assert bool(tuple(contradictions(plan(*subtasks), load_catalogue()))) is contradicts


def test_each_robot_with_a_thing_of_its_own_does_not_contradict() -> None:
    """Two robots that each switch theirs on and then off mean two things by one name."""
    pairs = [
        each
        for number in (1, 2)
        for each in (
            step(f"a{number}", "switch_on", f"r{number}", object="headlight"),
            step(f"b{number}", "switch_off", f"r{number}", f"a{number}", object="headlight"),
        )
    ]
    assert not tuple(contradictions(plan(*pairs), load_catalogue()))


@pytest.mark.parametrize(
    ("instruction", "subtask", "grounded"),
    [
        ("Rover_1: photograph the shelves", step("s1", "photograph", target="shelf"), True),
        ("rover one, fetch two batteries", step("s1", "pick", object="battery"), True),
        ("Rover_1: go to dock four", step("s1", "goto", place="dock 4"), True),
        ("Rover_1: meet at grid point seven, then go home", step("s1", "goto", place="grid point 7"), True),
        ("Rover_1: read gauges two four and six", step("s1", "read", target="gauge 2"), True),
        ("Rover_1: pour the wine into glass one, please", step("s1", "pour", into="glass 1", object="wine"), True),
        ("Rover_1: go to dock four, then home", step("s1", "goto", place="dock 5"), False),
        ("Rover_1: go to dock 1", step("s1", "goto", place="vault"), False),
        ("Rover_1: go to dock 1", step("s1", "goto", place="dock 2"), False),
        ("Rover_1: check tanks 4 to 6", step("s1", "inspect", asset="tank 5"), True),
        ("both of you go to dock 1", step("s1", "goto", "drone_1", place="dock 1"), True),
        ("go to dock 1", step("s1", "goto", "any", place="dock 1"), True),
        ("tell me how many boxes there are", step("s1", "notify", None, to="operator"), True),
        ("count the boxes", step("s1", "say", text="open all the doors now"), False),
    ],
)
def test_what_was_never_said_is_found(
    instruction: str, subtask: Subtask, grounded: bool, robots: tuple[RobotInfo, ...]
) -> None:
    """Values in any inflection are grounded, inventions are not; robots of a roster have a check of their own."""
    found = ungrounded(plan(subtask), PlanContext(instruction=instruction, robots=robots))
    assert (found == ()) is grounded


def test_names_of_one_place_ground_each_other(site: Site, robots: tuple[RobotInfo, ...]) -> None:
    """Where the instruction says an alias, the plan may say the name."""
    asked = PlanContext(instruction="rover_1 to goal two", robots=robots, site=site)
    assert ungrounded(plan(step("s1", "goto", place="goal 2")), asked) == ()


def test_why_an_operator_should_look_first(catalogue: Catalogue) -> None:
    """A skill that the policy names holds any plan; otherwise nothing does."""
    cut = plan(step("s1", "cut", object="rope"))
    asked = PlanContext(instruction="cut the rope")
    config = SafetyConfig(confirm_skills=("cu*",))
    assert list(policy_holds(Facts(cut, asked, catalogue, SafetyConfig()))) == []
    (found,) = policy_holds(Facts(cut, asked, catalogue, config, edited=True))
    assert (found.severity, found.message) == (Severity.HOLD, "cut needs approval (safety.confirm_skills)")


@given(st.text(max_size=400))
def test_foreign_text_is_one_harmless_line(text: str) -> None:
    """Whatever was written: one line, cut, no quotation mark, no chat mark-up."""
    shown = quoted(text)
    assert len(shown) <= MOST
    assert not set(shown) & set('"\\\n\r\u2028')
    assert "<|" not in shown or "|>" not in shown


@given(st.data())
def test_the_policy_only_tightens(data: st.DataObject) -> None:
    """A stricter policy never allows what a looser one refuses."""
    from appliance.skills.catalogue import load_catalogue  # noqa: PLC0415 - once, when it is first needed

    catalogue = load_catalogue()
    names = ("dock 1", "vault", "shelf")
    subtasks = tuple(
        step(
            f"s{number}",
            data.draw(st.sampled_from(["goto", "pick", "cut", "photograph"])),
            data.draw(st.sampled_from(["rover_1", "drone_1"])),
            **{key: data.draw(st.sampled_from(names)) for key in ("place",)},
        )
        for number in range(data.draw(st.integers(1, 4)))
    )
    loose = SafetyConfig(skills_never=("cut",))
    strict = replace(loose, places_never=("vault",), exclusive_places=("dock 1",))
    asked = PlanContext(instruction="x")
    assert set(unsafe(plan(*subtasks), asked, catalogue, loose)) <= set(
        unsafe(plan(*subtasks), asked, catalogue, strict)
    )


@pytest.mark.parametrize(
    "config", [SafetyConfig(limits=(RobotLimits(robots=()),)), SafetyConfig(places_never=("Vault",))]
)
def test_a_wrong_policy_is_named(config: SafetyConfig) -> None:
    """A limit for nobody and a name that can never match are configuration errors."""
    with pytest.raises(ConfigError, match="safety"):
        config.check()


def test_a_sound_plan_is_valid_too(ask: Ask, catalogue: Catalogue) -> None:
    """The plans of these tests are ones that the validator passes, as far as they are meant to be sound."""
    sound = plan(step("s1", "goto", place="dock 1"), step("s2", "pick", "rover_1", "s1", object="box"))
    assert validate(sound, catalogue, robots=ask.robots, site=ask.site) == ()
