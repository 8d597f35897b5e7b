"""One real fleet for all tests of a module: starting one takes longer than what most of them do with it."""

import asyncio
import importlib.util
import io
import tarfile
import textwrap
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from fleets import fleet_in
from moving_bench import write_skills

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.llm.settings import LlmConfig
from appliance.pool.images import reference
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import load_catalogue
from appliance.tui.actions import BY_NAME

from .operating import AUDITED, LONG_S, WATCHED, Operator, operator
from .ordering import is_told

LAME = "lame"
"""An image that the fleet knows and that does not exist until a test makes it."""


def write_image(skills: Path) -> Path:
    """Write the description of that image beside skills; returns its folder."""
    folder = skills / "images" / LAME
    folder.mkdir(parents=True)
    (folder / "image.toml").write_text(
        textwrap.dedent(f"""
            # Of this run alone: {skills}
            name = "{LAME}"
            packages = ["python3"]
        """)
    )
    return folder


@pytest.fixture(scope="module")
def lame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of that image."""
    return write_image(write_skills(tmp_path_factory.mktemp("skills")))


@pytest.fixture(scope="module")
async def fleet(lame: Path, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[FleetState]:
    """Two gateways with skills that count, a recorder and two rovers, each a process of its own.

    Plans are the rules': the same words give the same plan, before and after a test brings a model.
    """
    async with fleet_in(
        tmp_path_factory.mktemp("fleet"),
        gateways=2,
        zenoh=2,
        sim_rate=4.0,
        pool=PoolConfig(floor={"base": 2}, bad_starts=1, quarantine_s=600.0, starts_at_once=2),
        base=GatewayConfig(
            id="gw-1", llm=LlmConfig(tiers=("rules", "local"), local_model=""), skills=(str(lame.parent.parent),)
        ),
    ) as state:
        yield state


async def podman(*arguments: str) -> None:
    """Run podman; fails with what it says."""
    process = await asyncio.create_subprocess_exec(
        "podman", *arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    said, _ = await process.communicate()
    assert process.returncode == 0, said.decode()


@pytest.fixture
async def broken(lame: Path, tmp_path: Path) -> AsyncIterator[Callable[[], Awaitable[None]]]:
    """Make an image of which no container starts; returns what mends it."""
    catalogue = load_catalogue([lame.parent.parent])
    mine, good = (reference(catalogue.images[name], PoolConfig()) for name in (LAME, "base"))
    empty = tmp_path / "empty.tar"
    with tarfile.open(empty, "w") as archive:
        archive.addfile(tarfile.TarInfo("nothing"), io.BytesIO())
    await podman("import", str(empty), mine)

    async def mend() -> None:
        await podman("tag", good, mine)

    yield mend
    await podman("rmi", "--force", "--ignore", mine)


@pytest.fixture
def toy(project_root: Path, tmp_path: Path) -> Path:
    """Return the folder of a model that is small and knows nothing."""
    spec = importlib.util.spec_from_file_location("tiny_model", project_root / "tests" / "tiny_model.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.build(tmp_path / "toy")


@pytest.fixture
async def client(fleet: FleetState) -> AsyncIterator[FleetClient]:
    """Return somebody else's eyes on the fleet."""
    async with FleetClient(fleet.endpoint, operator="eve") as made:
        yield made


@pytest.fixture
async def watched(request: pytest.FixtureRequest, client: FleetClient) -> AsyncIterator[None]:
    """Hold a test to what it says it `does`: each action was done, and stands in the audit with who and why."""
    began_ns = time.time_ns()
    WATCHED.clear()
    yield
    wanted = getattr(request.function, "does", ())
    begun = {each for app in WATCHED for each in app.begun}
    done = {each for app in WATCHED for each in app.done}
    for name in wanted:
        assert name in (done if not BY_NAME[name].call else {action for action, _ in begun}), name
    names = {app.view.operator for app in WATCHED}
    verbs = {AUDITED[name] for name in wanted if name in AUDITED}
    whys = {(AUDITED[name], why) for name, why in begun if name in wanted and why}
    told: set[tuple[str, str]] = set()
    try:
        # What an order does can be seen before the gateway that it was given to has put it down.
        async with asyncio.timeout(LONG_S):
            while not (verbs <= {verb for verb, _ in told} and all(is_told(each, told) for each in whys)):
                acts, _ = await client.acts(500)
                told = {(each.verb, each.why) for each in acts if each.by in names and each.at_ns >= began_ns
                        and each.outcome == "done"}  # fmt: skip
    except TimeoutError:
        pytest.fail(f"the audit has {told}, and should have {verbs}, {whys}")


@pytest.fixture
async def ann(fleet: FleetState) -> AsyncIterator[Operator]:
    """Return an operator at a terminal UI on it."""
    async with operator(fleet, "ann") as it:
        yield it
