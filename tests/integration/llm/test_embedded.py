"""The planner that comes with the program, as a gateway runs it: in a process of its own, on this machine alone."""

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from appliance.llm.checks.schema import validate
from appliance.llm.local import LocalTier
from appliance.llm.settings import EMBEDDED, EMBEDDED_FOLDER, LlmConfig, PlanContext
from appliance.model import RobotInfo
from appliance.skills.catalogue import load_catalogue

pytestmark = pytest.mark.anyio

CATALOGUE = load_catalogue()
MOST_MB = 40
MOST_RESIDENT_MB = 200
ORDERS = (
    ("Rover_1, drive to shelf 3.", ("rover_1",), ["goto rover_1 place=shelf 3"]),
    ("Husky: go to zorblat 7, then inspect the frimple.", ("husky",),
     ["goto husky place=zorblat 7", "inspect husky asset=frimple < s1"]),
    ("Kit_1 photographs the gate while Kit_2 films the fence for two minutes", ("kit_1", "kit_2"),
     ["photograph kit_1 target=gate", "record_video kit_2 duration_s=120 target=fence"]),
    ("drone 4 take off and then return home", ("drone_4",), ["takeoff drone_4", "return_home drone_4 < s1"]),
    ("Rover_1 fetches the red box from dock 3 and places it at dock 2", ("rover_1",),
     ["goto rover_1 place=dock 3", "pick rover_1 object=red box < s1", "goto rover_1 place=dock 2 < s2",
      "place rover_1 at=dock 2 object=red box < s3"]),
)  # fmt: skip


@pytest.fixture(scope="module")
async def tier() -> AsyncIterator[LocalTier]:
    """The local tier as it is by default."""
    tier = LocalTier(LlmConfig(), CATALOGUE)
    await tier.start()
    yield tier
    await tier.close()


def test_it_is_in_the_package_and_small() -> None:
    """It is what a gateway has when nothing else is configured: no download, and room on any gateway."""
    assert LlmConfig().local_model == EMBEDDED
    assert (EMBEDDED_FOLDER / "planner.json").is_file()
    assert "## Held-out pairs" in (EMBEDDED_FOLDER / "README.md").read_text()
    assert sum(each.stat().st_size for each in EMBEDDED_FOLDER.rglob("*")) < MOST_MB * 2**20


@pytest.mark.parametrize(("instruction", "robots", "plan"), ORDERS)
async def test_plain_orders_are_planned(
    tier: LocalTier, instruction: str, robots: tuple[str, ...], plan: list[str]
) -> None:
    """Names that no dictionary has are copied, quantities become numbers, and what is side by side stays so."""
    known = tuple(RobotInfo(id=each, kind="zenoh") for each in robots)
    proposal = await tier.propose(PlanContext(instruction=instruction, robots=known))
    assert not validate(proposal.plan, CATALOGUE)
    told = [
        " ".join(
            (each.skill, str(each.robot), *(f"{name}={value}" for name, value in sorted(each.params.items())))
            + ((f"< {' '.join(each.after)}",) if each.after else ())
        )
        for each in proposal.plan.subtasks
    ]
    assert told == plan
    assert proposal.model == Path(EMBEDDED_FOLDER).name


async def test_it_passes_its_self_test_and_stays_small(tier: LocalTier) -> None:
    """As after a swap: valid plans for plain orders; its process has no more memory than was promised."""
    assert all("not valid" not in each and "no plan" not in each for each in await tier.self_test())
    assert 0 < tier.status.memory_mb < MOST_RESIDENT_MB
