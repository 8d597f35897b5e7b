"""`swiftbot place …` and `swiftbot robots maintain`: what is asked of the fleet, and what is printed."""

# pyright: reportUnknownLambdaType=false, reportUnknownArgumentType=false

import json
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.cli.common import Where
from appliance.errors import NotFoundError
from appliance.model import Place, RobotInfo, Site, Word
from appliance.model.closures import Closure, ClosureList
from appliance.model.robot_api import Standing
from tests.unit.test_cli_faults_seen import run


class Fleet:
    """A fleet with two places and a robot."""

    def __init__(self) -> None:
        self.closed: dict[str, Closure] = {}
        robots = {"rover_1": RobotInfo(id="rover_1", kind="zenoh")}
        self.plane = SimpleNamespace(registry=SimpleNamespace(robots=robots))

    async def __aenter__(self) -> "Fleet":
        return self

    async def __aexit__(self, *_: object) -> None:
        return None

    async def gateway(self) -> str:
        """Return the one there is."""
        return "gw-1"

    async def standing(self) -> Standing:
        """Return that nothing is stopped."""
        return Standing()

    async def site(self) -> Site:
        """Return the map."""
        return Site(places={"dock 2": Place(x=1.0, y=2.0), "gate": Place(x=0.0, y=0.0)})

    async def closures(self) -> ClosureList:
        """Return what is out of use."""
        return ClosureList(closures=tuple(self.closed.values()))

    def _close(self, kind: Any, name: str, until_ns: int, why: str) -> Closure:
        made = Closure(kind=kind, name=name, by=Word(by="ann", why=why, at_ns=1), until_ns=until_ns)
        self.closed[made.id] = made
        return made

    async def close_place(self, name: str, *, until_ns: int = 0, why: str = "") -> Closure:
        """Close one."""
        return self._close("place", name, until_ns, why)

    async def maintain(self, robot: str, *, until_ns: int = 0, why: str = "") -> Closure:
        """Take one out of use."""
        return self._close("robot", robot, until_ns, why)

    async def reopen(self, kind: Any, name: str, *, why: str = "") -> Closure:
        """Take one into use."""
        del why
        found = next((each for each in self.closed.values() if (each.kind, each.name) == (kind, name)), None)
        if found is None:
            raise NotFoundError(f"{name} is not closed", remedy="see the list")
        return self.closed.pop(found.id)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Return it in the place of a connection."""
    made = Fleet()
    monkeypatch.setattr(Where, "client", lambda _: made)
    return made


def test_a_place_is_closed_listed_and_opened(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """With who, why and until when; opening one that is open is an error."""
    assert run("place", "close", "dock 2", "--until", "2h", "--why", "wet floor") == 0
    assert "dock 2 is closed until" in capsys.readouterr().out
    assert fleet.closed["place.dock-2"].until_ns > 0
    assert run("place", "list") == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "by ann: wet floor" in said
    assert "gate" in said
    assert run("place", "--json") == 0
    found = {each["name"]: each["closed"] for each in json.loads(capsys.readouterr().out)}
    assert found["gate"] is None
    assert "wet floor" in found["dock 2"]
    assert run("place", "open", "dock 2") == 0
    assert run("place", "open", "dock 2") == 4


def test_a_robot_in_maintenance_says_so(fleet: Fleet, capsys: pytest.CaptureFixture[str]) -> None:
    """In the list of robots too, until its maintenance is ended."""
    assert run("robots", "maintain", "rover_1", "--why", "tyres") == 0
    assert "rover_1 is in maintenance by ann: tyres" in capsys.readouterr().out
    assert run("robots", "list", "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["maintenance"] == "in maintenance by ann: tyres"
    assert run("robots", "list") == 0
    assert "in maintenance" in " ".join(capsys.readouterr().out.split())
    assert run("robots", "maintain", "rover_1", "--end") == 0
    assert "in use again" in capsys.readouterr().out
    assert fleet.closed == {}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("place", "close", "gate", "--until", "soon"), "no time"),
        (("robots", "maintain", "rover_1", "--end", "--until", "2h"), "--until or --end"),
    ],
)
def test_what_cannot_be_is_refused(
    words: tuple[str, ...], says: str, fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is asked of the fleet."""
    assert run(*words) == 2
    assert says in capsys.readouterr().err
    assert fleet.closed == {}
