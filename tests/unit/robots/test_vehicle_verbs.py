# ruff: noqa: ARG002 - verbs have one shape
"""Which verbs a vehicle has, by the methods that are marked, and that each has arguments and a row in the manual."""

import re
from pathlib import Path

import pytest

from appliance.model import Site
from appliance.robots.executor import Done, Terms, verb, verbs_of
from appliance.robots.mavlink.command_dispatcher import CommandDispatcher
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.settings import RobotsConfig
from appliance.robots.verbs import NoArgs, RobotFailure, args_of

pytestmark = pytest.mark.anyio

FLYING = {"takeoff", "land", "orbit"}


def verbs(monkeypatch: pytest.MonkeyPatch, *, flies: bool, known: bool = True) -> set[str]:
    """Return the verbs of a vehicle; `known`: whether its modes are."""
    monkeypatch.setattr(Vehicle, "commandable", property(lambda _: known))
    monkeypatch.setattr(Vehicle, "flies", property(lambda _: flies))
    vehicle = Vehicle("drone_1", site=Site(), send=lambda _: None, own=242)
    return set(CommandDispatcher(vehicle, site=Site(), config=RobotsConfig()).verbs())


def test_a_vehicle_has_the_verbs_of_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that flies has three more; one whose modes are not known tells its state and does nothing."""
    copter, rover = verbs(monkeypatch, flies=True), verbs(monkeypatch, flies=False)
    assert copter - rover == FLYING
    assert rover < copter
    assert {"goto", "return_home", "hold", "mission", "gimbal", "state"} <= rover
    assert verbs(monkeypatch, flies=True, known=False) == {"state"}


def test_each_verb_has_arguments_and_a_row_in_the_manual(monkeypatch: pytest.MonkeyPatch, project_root: Path) -> None:
    """Without arguments it could not be read from an order; without a row nobody would know of it."""
    rows = [line for line in (project_root / "docs" / "robots.md").read_text().splitlines() if line.startswith("| `")]
    described = {name for line in rows for name in re.findall(r"`(\w+)`", line.split("|")[1])}
    found = verbs(monkeypatch, flies=True)
    assert {name for name in found if args_of(name) is None} == set()
    assert found <= described


class Part:
    """Something with a verb that a failsafe does not keep, one that it does, and one that nothing does."""

    @verb(Terms(safe=True))
    async def land(self, args: NoArgs) -> Done:
        """Land."""
        return Done({})

    @verb(Terms(flying=True, uses=("wings",)))
    async def climb(self, args: NoArgs) -> Done:
        """Climb."""
        return Done({})

    @verb(Terms(guarded=False, resumable=False))
    async def look(self, args: NoArgs) -> Done:
        """Look."""
        return Done({})

    async def nothing(self, args: NoArgs) -> Done:
        """Not a verb."""
        raise AssertionError


async def test_a_guarded_verb_is_refused_while_somebody_else_has_the_robot() -> None:
    """The guard learns whether the verb is a safe one; a verb that moves nothing has none."""

    def failsafe(safe: bool) -> None:
        if not safe:
            raise RobotFailure("refused", "a failsafe has it")

    found = verbs_of(Part(), check=failsafe, flies=True)
    assert set(found) == {"land", "climb", "look"}
    assert (found["climb"].uses, found["climb"].resumable, found["look"].resumable) == (("wings",), True, False)
    assert await found["land"].run(NoArgs()) == Done({})
    assert await found["look"].run(NoArgs()) == Done({})
    with pytest.raises(RobotFailure, match="failsafe"):
        await found["climb"].run(NoArgs())
    assert set(verbs_of(Part(), check=failsafe, flies=False)) == {"land", "look"}
