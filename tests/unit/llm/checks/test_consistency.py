"""What cannot be meant by an instruction, though it is a plan."""

from appliance.llm.checks.consistency import Meaning, problems
from appliance.skills.catalogue import load_catalogue
from workshop.corpus.notation import parse

CATALOGUE = load_catalogue()


def said_of(text: str) -> tuple[str, ...]:
    """What speaks against one pair in the notation of the corpus."""
    (pair,) = parse(text, name="test").values()
    meaning = Meaning(instruction=pair.instruction, robots=pair.robots, domain=pair.domain, subtasks=pair.subtasks)
    return problems(meaning, CATALOGUE)


def test_a_thing_is_put_down_where_the_robot_is() -> None:
    """From dock 3 nobody reaches dock 2; a tray is at hand, and so is the dock that it was sent to."""
    said = "> Rex fetches the box from dock 3 and places it at dock 2.\nmanipulation\n"
    begun = f'{said}s1 rex goto place="dock 3"\ns2 rex pick object="box" < s1\n'
    assert said_of(f'{begun}s3 rex place object="box" at="dock 2" < s2\n') == (
        "s3: rex was sent to dock 3, and dock 2 is another",
    )
    gone = f'{begun}s3 rex goto place="dock 2" < s2\ns4 rex place object="box" at="dock 2" < s3\n'
    assert said_of(gone) == ()
    tray = "> Rex fetches the box from dock 3 and puts it on tray 2.\nmanipulation\n"
    tray += 's1 rex goto place="dock 3"\ns2 rex pick object="box" < s1\ns3 rex place object="box" at="tray 2" < s2\n'
    assert said_of(tray) == ()
