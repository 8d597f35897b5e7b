"""The key of a plan: what may differ without meaning anything else, and what makes every earlier plan unreachable."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.llm.plan_cache import canonical, catalogue_digest, plan_key
from appliance.llm.settings import PlanContext
from appliance.model import Pose, RobotInfo, Site
from appliance.skills.catalogue import Catalogue


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("Go to dock 1", "go to dock 1."),
        ("go  to\n dock 1!", "Please, go to dock 1"),
        ("say “Hello”", 'say "Hello"'),
        ("Rover\u00a01: go home, thanks", "rover 1: go home"),
    ],
)
def test_the_same_words_are_the_same(one: str, other: str) -> None:
    """Typography, blanks, case and courtesy change nothing."""
    assert canonical(one) == canonical(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("go to dock 1", "go to dock 2"),
        ('say "STOP"', 'say "stop"'),
        ("go to dock 1 then dock 2", "go to dock 2 then dock 1"),
        ("do not go to dock 1", "do go to dock 1"),
        ("Robot_1: say thanks", "Robot_1: say please"),
        ("Robot_1: tell Ann thank you", "Robot_1: tell Ann"),
        ("Robot_1: announce dinner, please", "Robot_1: announce dinner, thanks"),
    ],
)
def test_other_words_are_others(one: str, other: str) -> None:
    """What may mean something else has another form; what is quoted keeps its case."""
    assert canonical(one) != canonical(other)


@given(st.text(max_size=200))
def test_the_form_is_stable(text: str) -> None:
    """The canonical form of a canonical form is itself, whatever the text."""
    assert canonical(canonical(text)) == canonical(text)


def test_whatever_a_plan_depends_on_is_in_its_key(
    catalogue: Catalogue, robots: tuple[RobotInfo, ...], site: Site
) -> None:
    """Roster, catalogue, site and policy change the key; where a robot stands just now does not."""
    context = PlanContext(instruction="go to dock 1", robots=robots, site=site)
    digest = catalogue_digest(catalogue)

    def key(context: PlanContext = context, catalogue: str = digest, policy: str = "p") -> str:
        return plan_key(context, catalogue=catalogue, policy=policy)

    moved = tuple(replace(each, pose=Pose(x=5), battery_percent=12.0, note="busy") for each in robots)
    assert key(replace(context, robots=moved)) == key()
    weaker = (replace(robots[0], uses=("base",)), *robots[1:])
    smaller = Catalogue(catalogue.domains, {k: v for k, v in catalogue.skills.items() if k != "goto"}, catalogue.images)
    others = {
        key(replace(context, robots=weaker)),
        key(replace(context, robots=robots[:1])),
        key(replace(context, robots=None)),
        key(replace(context, site=replace(site, altitude_limit_m=10))),
        key(catalogue=catalogue_digest(smaller)),
        key(policy="other"),
        key(replace(context, submitter="rover_1", from_robot=True)),
    }
    assert len(others) == 7
    assert key() not in others
