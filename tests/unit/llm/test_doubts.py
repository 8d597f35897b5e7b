"""What makes a plan doubtful that may be meant."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.llm.corpus.notation import parse
from appliance.llm.doubts import doubts
from appliance.llm.checks.consistency import Meaning


def doubted(text: str) -> tuple[str, ...]:
    """The doubts about one pair in the notation of the corpus."""
    (pair,) = parse(text, name="test").values()
    return doubts(Meaning(instruction=pair.instruction, robots=pair.robots, domain=pair.domain, subtasks=pair.subtasks))


TWO = "> Robot A goes to dock 3 and robot B opens gate 2.\n@ robot_a robot_b\nnavigation\n"


def test_a_robot_that_is_named_and_has_nothing_to_do() -> None:
    """Whoever names a robot means it: a plan without it is doubtful, whether the roster is known or not."""
    assert doubted(f'{TWO}s1 robot_a goto place="dock 3"\ns2 robot_b open object="gate 2"\n') == ()
    assert doubted(f'{TWO}s1 robot_a goto place="dock 3"\ns2 robot_a open object="gate 2" < s1\n') == (
        "robot_b is named and has nothing to do",
    )
    unknown = "> Robot_1 goes to the dock, robot two waits.\nnavigation\n"
    assert doubted(f'{unknown}s1 robot_1 goto place="dock"\n') == ("robot_2 is named and has nothing to do",)
    assert doubted(f'{unknown}s1 robot_1 goto place="dock"\ns2 robot_2 hold\n') == ()


def test_a_robot_in_a_parameter_has_its_part() -> None:
    """A robot that something is handed to is not idle; one with a longer name is another."""
    handing = "> Unit 1, hand the box to unit 2.\n@ unit_1 unit_2\nmanipulation\n"
    assert doubted(f'{handing}s1 unit_1 handover object="box" to="unit_2"\n') == ()
    lost = doubted('> Unit 1 and unit 12 go to the dock.\n@ unit_1 unit_12\nnavigation\ns1 unit_12 goto place="dock"\n')
    assert lost == ("unit_1 is named and has nothing to do", "1 is said and stands nowhere")


def test_a_figure_that_is_said_and_stands_nowhere() -> None:
    """The third of three docks is missed; figures in other units, times of day and deadlines are not."""
    docks = "> Photograph dock 1, dock 2 and dock 3.\ninspection\n"
    assert doubted(f'{docks}s1 any photograph target="dock 1"\ns2 any photograph target="dock 2" < s1\n') == (
        "3 is said and stands nowhere",
    )
    film = "> By 22:30 film the gate for 2 minutes.\ninspection\n"
    assert doubted(f'{film}s1 any record_video target="gate" duration_s=120\n') == ()
    assert doubted('> Go to the gate within 10 minutes.\nnavigation\ns1 any goto place="gate"\n') == ()


def test_what_is_to_run_side_by_side() -> None:
    """A plan in which one thing follows the other is doubtful where "while" is said."""
    said = "> Rex films the gate while Max opens the door.\n@ rex max\ninspection\n"
    assert doubted(f'{said}s1 rex record_video target="gate"\ns2 max open object="door" < s1\n') == (
        '"while" is said and nothing runs side by side',
    )
    assert doubted(f'{said}s1 rex record_video target="gate"\ns2 max open object="door"\n') == ()


def test_the_same_thing_twice() -> None:
    """What one robot does twice has to be said so."""
    plan = 's1 rex read target="meter"\ns2 rex read target="meter" < s1\n'
    assert doubted(f"> Rex reads the meter, then the other.\ninspection\n{plan}") == ("s2 (read) is planned twice",)
    assert doubted(f"> Rex reads the meter twice.\ninspection\n{plan}") == ()


@given(st.text(max_size=200))
@pytest.mark.parametrize("robots", [(), ("robot_1", "a.b-c_2", "(", "+1")])
def test_whatever_is_said(robots: tuple[str, ...], text: str) -> None:
    """No text and no roster makes it fail."""
    doubts(Meaning(instruction=text, robots=robots, domain="navigation", subtasks=()))
