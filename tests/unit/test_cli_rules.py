"""`swiftbot rules …`: what is asked of the fleet, what is printed, what is refused before anything is asked."""

# pyright: reportUnknownLambdaType=false, reportUnknownArgumentType=false

import json
from types import SimpleNamespace

import pytest

from appliance import console
from appliance.cli import rules
from appliance.cli.common import Where
from appliance.errors import NotFoundError
from appliance.model import Place, RobotInfo, Site, Word
from appliance.model.closures import Closure, ClosureList, Rule
from tests.unit.test_cli_faults_seen import run


class Fleet:
    """A fleet that keeps rules."""

    def __init__(self) -> None:
        self.rules: dict[str, Closure] = {}
        robots = {"rover_1": RobotInfo(id="rover_1", kind="zenoh")}
        self.plane = SimpleNamespace(registry=SimpleNamespace(robots=robots))

    async def __aenter__(self) -> "Fleet":
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def site(self) -> Site:
        """Return the map."""
        return Site(places={"dock 2": Place(x=1.0, y=2.0)})

    async def closures(self) -> ClosureList:
        """Return them."""
        return ClosureList(rules=tuple(self.rules.values()))

    async def add_rule(self, rule: Rule, *, until_ns: int = 0, why: str = "") -> Closure:
        """Keep one."""
        added = Closure(kind="rule", name=rule.id, rule=rule, by=Word(by="ann", why=why, at_ns=1), until_ns=until_ns)
        return self.rules.setdefault(rule.id, added)

    async def reopen(self, kind: str, name: str, *, why: str = "") -> Closure:
        """Remove one."""
        del why
        if kind != "rule" or name not in self.rules:
            raise NotFoundError(f"{name} is not a standing rule", remedy="see the list")
        return self.rules.pop(name)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return it in the place of a connection."""
    made = Fleet()
    monkeypatch.setattr(Where, "client", lambda _: made)
    return made


def test_a_rule_is_added_listed_and_removed(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """With who, why and until when; removing it twice is an error."""
    words = ("--robot", "rover_1", "--place", "dock 2", "--place", "gate", "--from", "22:00", "--to", "6:00")
    assert run("rules", "add", *words, "--day", "sat", "--zone", "Europe/Zurich", "--why", "wet", "--until", "2h") == 0
    assert "from 22:00 to 06:00 on sat Europe/Zurich;" in " ".join(capsys.readouterr().out.split())
    (added,) = fleet.rules.values()
    assert added.rule == Rule(
        robots=("rover_1",), places=("dock 2", "gate"), begin_min=1320, end_min=360, days=(5,), zone="Europe/Zurich"
    )
    assert added.until_ns > 0
    assert run("rules", "list") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert added.name in said
    assert "by ann: wet" in said
    assert run("rules", "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["rule"]["things"] == []
    assert run("rules", "remove", added.name) == 0
    assert run("rules", "remove", added.name) == 4
    assert run("rules") == 0
    assert "no standing rules" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "begin", "end"),
    [(("--from", "18:00"), 1080, 1440), (("--to", "06:00"), 0, 360), (("--from", "18:00", "--to", "24:00"), 1080, 1440),
     (("--from", "18:00", "--to", "00:00"), 1080, 1440), (("--day", "mon"), 0, 1440)],
)  # fmt: skip
def test_hours_may_be_open(words: tuple[str, ...], begin: int, end: int, fleet: Fleet) -> None:
    """Without an end they last to midnight, without a begin from midnight; without both all day."""
    assert run("rules", "add", *words) == 0
    ((rule,),) = ((each.rule for each in fleet.rules.values()),)
    assert rule is not None
    assert (rule.begin_min, rule.end_min) == (begin, end)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "names places, things, hours or days"),
        (("--robot", "rover_1"), "names places, things, hours or days"),
        (("--place", "dock 2", "--thing", "glass"), "not about both"),
        (("--place", "dock 2", "--from", "25:00"), "no time of day"),
        (("--place", "dock 2", "--to", "soon"), "no time of day"),
        (("--place", "dock 2", "--from", "6:00", "--to", "06:00"), "begin when they end"),
        (("--thing", "?!"), "names a thing by words"),
        (("--place", "dock 2", "--robot", "rover_1", "--group", "flying"), "do not go together"),
        (("--place", "dock 2", "--until", "soon"), "no time"),
    ],
)
def test_what_is_no_rule_is_refused(
    words: tuple[str, ...], says: str, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is asked of the fleet."""
    assert run("rules", "add", *words) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert fleet.rules == {}


def test_words_are_read_back_and_confirmed(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a terminal a person is asked; a script says --yes, and without it nothing is added but told how it is read."""
    text = "Rover_1 never goes to dock 2 between 22:00 and 06:00"
    read = "rover_1: never go to dock 2 from 22:00 to 06:00 UTC"
    assert run("rules", "add", text, "--zone", "UTC") == 2
    assert f"read as: {read}" in " ".join(capsys.readouterr().err.split())
    asked: list[str] = []
    monkeypatch.setattr(rules, "on_terminal", lambda: True)
    answers = iter(("n", "y"))
    monkeypatch.setattr(console.out, "input", lambda question, **_: asked.append(question) or next(answers))
    assert run("rules", "add", text, "--zone", "UTC") == 7
    assert fleet.rules == {}
    assert run("rules", "add", text, "--zone", "UTC") == 0
    assert [each.splitlines()[0] for each in asked] == [read, read]
    (added,) = fleet.rules.values()
    assert (added.rule is not None and added.rule.text, added.by.why) == (read, text)
    assert run("rules", "add", "never go to dock 2", "--yes", "--why", "wet") == 0
    assert len(fleet.rules) == 2


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("no robot flies over dock 2", "--yes"), '"over"'),
        (("go to dock 2", "--yes"), "what they never do"),
        (("never go to dock 9", "--yes"), "dock 9"),
        (("never go to dock 2", "--yes", "--robot", "rover_1"), "in words or by options"),
    ],
)
def test_words_that_no_rule_says_are_refused(
    words: tuple[str, ...], says: str, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the reason, and how a rule is said."""
    assert run("rules", "add", *words) != 0
    assert says in " ".join(capsys.readouterr().err.split())
    assert fleet.rules == {}
