"""The hand-written training pairs: the notation, what the checker finds, and that every pair passes it."""

import json

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import PayloadError
from appliance.model import Subtask
from appliance.skills.catalogue import DOMAINS, Catalogue
from workshop.bench.plan import default_cases
from workshop.corpus import load
from workshop.corpus.__main__ import main
from workshop.corpus.check import problems, tally, too_near
from workshop.corpus.notation import KINDS, Pair, parse, write

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(900)]  # seconds on a free processor, minutes on a busy one

LEAST_OF_A_SKILL = 15
LEAST_OF_A_DOMAIN = 75

_LINE = st.text(st.characters(blacklist_categories=("Cc", "Cs"), blacklist_characters="\u2028\u2029"), max_size=30)
_NAME = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)
_VALUE = st.one_of(
    _LINE, st.integers(0, 9999), st.floats(0, 1e6, allow_nan=False), st.lists(_LINE, min_size=1, max_size=3)
)
_SUBTASK = st.builds(
    Subtask,
    id=st.integers(1, 99).map("s{}".format),
    skill=_NAME,
    robot=st.none() | _NAME,
    params=st.dictionaries(_NAME, _VALUE, max_size=3),
    after=st.lists(st.integers(1, 99).map("s{}".format), max_size=3).map(tuple),
)
_TEXT = st.lists(_LINE, min_size=1, max_size=3).map("\n".join).map(str.strip).filter(bool)
_PAIR = st.one_of(
    st.builds(
        Pair,
        instruction=_TEXT,
        voice=st.from_regex(r"[a-z]{1,8}", fullmatch=True),
        robots=st.lists(_NAME, max_size=3).map(tuple),
        domain=st.sampled_from(DOMAINS),
        source=st.sampled_from(("", "hand-1", "hand-2")),
        subtasks=st.lists(_SUBTASK, min_size=1, max_size=4).map(tuple),
    ),
    st.builds(Pair, instruction=_TEXT, refused=st.sampled_from(KINDS), reason=st.just("no skill does that")),
)
EXAMPLE = """> Rex, fetch the drill from bay 2.
~ foreman
@ rex max
manipulation
s1 rex goto place="bay 2"
s2 rex pick object="drill" < s1
"""


@pytest.fixture(scope="session")
def corpus() -> dict[str, Pair]:
    """Return every pair of the corpus."""
    return load()


@given(st.lists(_PAIR, max_size=3))
@settings(max_examples=25)
def test_what_is_written_is_read_as_the_same_pairs(pairs: list[Pair]) -> None:
    """Any pair survives the notation, whatever its texts contain."""
    assert list(parse(write(pairs)).values()) == pairs


def test_notation_and_pair_are_one_to_one() -> None:
    """A pair in the notation is read whole and written as the same characters."""
    (pair,) = parse(EXAMPLE).values()
    assert pair.voice == "foreman"
    assert pair.robots == ("rex", "max")
    assert pair.subtasks[1] == Subtask(id="s2", skill="pick", robot="rex", params={"object": "drill"}, after=("s1",))
    assert write([pair]) == EXAMPLE


@pytest.mark.parametrize(
    ("line", "wrong", "where"),
    [
        (1, "Rex, fetch the drill", "x.plan:1: a pair begins"),
        (2, "~ The Foreman", "x.plan:2: a voice"),
        (3, "@ Rex", "x.plan:3: a roster"),
        (4, "moving things", "x.plan:4: expected the plan's domain"),
        (4, "none whatever: no", "x.plan:4: a refusal is"),
        (4, "none question: no", "x.plan:5: nothing follows"),
        (5, 's1 rex goto place=bay 2"', "x.plan:5: the value of place"),
        (5, 's1 Rex goto place="bay 2"', "x.plan:5: 'Rex' is not allowed"),
        (5, 's1 rex goto place="bay 2" place="bay 3"', "x.plan:5: parameter place stands twice"),
        (6, 's2 rex pick object="drill" <', "x.plan:6: not understood"),
        (6, 's2 rex pick object="drill" < one', "x.plan:6: predecessors"),
    ],
)
def test_errors_name_the_line(line: int, wrong: str, where: str) -> None:
    """What is not in the notation is refused with file, line and reason."""
    lines = EXAMPLE.splitlines()
    lines[line - 1] = wrong
    with pytest.raises(PayloadError, match=where):
        parse("\n".join(lines), name="x.plan")


@pytest.mark.parametrize(
    ("plan", "wrong"),
    [
        ('perception\ns1 rex pick object="drill"', "domain perception"),
        ('manipulation\ns1 rex grab object="drill"', "no such skill"),
        ("manipulation\ns1 rex pick", "parameter object is missing"),
        ('manipulation\ns1 rex pick object="drill" at="bay 2"', "no parameter at"),
        ('manipulation\ns1 rex pick object="the drill"', "without article"),
        ('manipulation\ns1 rex pick object="Drill"', "lower-case"),
        ('manipulation\ns1 rex pick object="hammer"', "does not say hammer"),
        ('manipulation\ns1 max pick object="drill"', "does not say max"),
        ('manipulation\ns1 - pick object="drill"', "has a robot"),
        ('manipulation\ns2 rex pick object="drill"', "ids are s1"),
        ('manipulation\ns1 rex pick object="drill" < s2\ns2 rex open object="bay"', "must stand before"),
        ('manipulation\ns1 rex pick object="drill"\ns2 rex open object="bay"', "use the arm of one robot"),
        ('manipulation\ns1 rex goto place="bay 2"\ns2 rex pick object="drill"', "run together on one robot"),
        (
            'manipulation\ns1 rex goto place="bay 2"\ns2 rex pick object="drill" < s1\ns3 - report < s1 s2',
            "follows from its other",
        ),
        ('manipulation\ns1 rex place object="drill" at="bay 2"', "has not picked up"),
        (
            'manipulation\ns1 rex goto place="bay 2"\ns2 rex goto place="bay 2" < s1\ns3 rex pick object="drill" < s2',
            "sent there",
        ),
    ],
)
def test_checker_finds_what_breaks_the_rules(plan: str, wrong: str, catalogue: Catalogue) -> None:
    """Each kind of slip is found and said."""
    (pair,) = parse(f"> Rex, fetch the drill from bay 2.\n{plan}\n").values()
    assert any(wrong in problem for problem in problems(pair, catalogue)), problems(pair, catalogue)


def test_copies_are_found_whatever_their_nouns() -> None:
    """The same sentence about other things, and the same words in another order, are both too near."""
    first, second, third, other = parse(
        '> Would you kindly fetch the drill out of bay 2, Rex?\nmanipulation\ns1 rex pick object="drill"\n\n'
        '> Would you kindly fetch the lamp out of bay 3, Max?\nmanipulation\ns1 max pick object="lamp"\n\n'
        '> Rex, would you kindly fetch the drill out of bay 2?\nmanipulation\ns1 rex pick object="drill"\n\n'
        '> The lamp, please.\nmanipulation\ns1 any pick object="lamp"\n'
    ).values()
    plans = {"second": second, "third": third, "other": other}
    found = list(too_near(_plans(plans), _plans({"first": first})))
    assert [line.split(":")[0] for line in found] == ["second", "third"]


def test_no_pair_copies_a_test_case(corpus: dict[str, Pair]) -> None:
    """No instruction is near a development case, which are for testing only."""
    cases: dict[str, tuple[str, list[Subtask]]] = {}
    for line in default_cases().read_text().splitlines():
        case = json.loads(line)
        cases[case["id"]] = (case["instruction"], msgspec.convert(case["gold"]["subtasks"], list[Subtask]))
    assert list(too_near(_plans(corpus), cases)) == []


def test_corpus_covers_every_skill_and_domain(corpus: dict[str, Pair], catalogue: Catalogue) -> None:
    """Each skill, domain and kind of refusal occurs often enough to be learnt."""
    counted = tally(corpus.values())
    assert {each: counted.skills[each] for each in catalogue.skills if counted.skills[each] < LEAST_OF_A_SKILL} == {}
    assert {each: counted.domains[each] for each in DOMAINS if counted.domains[each] < LEAST_OF_A_DOMAIN} == {}
    assert set(counted.refused) == set(KINDS)


def test_every_pair_keeps_the_rules_and_copies_no_other(capsys: pytest.CaptureFixture[str]) -> None:
    """What a writer runs finds nothing wrong and counts every skill."""
    status, said = main(), capsys.readouterr().out
    assert status == 0, said
    assert "pairs, " in said


def _plans(pairs: dict[str, Pair]) -> dict[str, tuple[str, tuple[Subtask, ...]]]:
    return {name: (pair.instruction, pair.subtasks) for name, pair in pairs.items()}
