"""Fixtures of tests on real Podman; they run as a user with an API socket, and say so where there is none."""

import getpass
import shutil
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from fleets import fleet_in
from pool_bench import HANDLER, Bench, write_probe

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import PrerequisiteError
from appliance.pool import images
from appliance.pool.engine import remove_fleet, socket_path
from appliance.skills.catalogue import Catalogue, load_catalogue

HERE = Path(__file__).parent
MEASURES = HERE / "bench"
"""Tests whose figures would tell of what runs beside them."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what lies here as `fleet`: real processes, links and deadlines; and what measures or is long as `alone`."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.fleet)
            if MEASURES in item.path.parents or item.get_closest_marker("long"):
                item.add_marker(pytest.mark.alone)


@pytest.fixture(scope="module")
def podman() -> Path:
    """Return the API socket's path; fails, with the reason, where this user has no Podman."""
    try:
        path = socket_path()
    except PrerequisiteError as error:
        pytest.fail(f"{getpass.getuser()} has no Podman: {error}")
    if not path.is_socket():
        pytest.fail(f"{getpass.getuser()} has no Podman: {path} is not there; run the tests as the service user")
    return path


@pytest.fixture
def folder(podman: Path) -> Iterator[Path]:
    """Return a folder of the test's own, with a deep name: socket paths must not mind."""
    where = Path(tempfile.mkdtemp(prefix="swiftbot-test-")) / ("deep-" * 20)
    where.mkdir()
    yield where
    shutil.rmtree(where.parent, ignore_errors=True)


@pytest.fixture
def probe() -> tuple[str, str]:
    """Return the handler of the skill `probe` and further lines of its manifest; a test module may have its own."""
    return HANDLER, ""


@pytest.fixture
def catalogue(folder: Path, probe: tuple[str, str]) -> Catalogue:
    """Return the real catalogue with one skill more, which does what its parameters say."""
    return load_catalogue([write_probe(folder, *probe)])


@pytest.fixture
async def built(podman: Path) -> None:
    """Build the images that are missing."""
    catalogue = load_catalogue()
    for name in (name for name, spec in catalogue.images.items() if not spec.on_demand):
        await images.build(name, catalogue)


@pytest.fixture
async def bench(built: None, folder: Path, catalogue: Catalogue) -> AsyncIterator[Bench]:
    """Return a fleet of the test's own, removed afterwards."""
    it = Bench(folder, catalogue)
    yield it
    for pool in it.pools:
        await pool.stop(keep_containers=False)
    await remove_fleet(it.fleet, volumes=True)


@pytest.fixture
async def fleet(tmp_path: Path, request: pytest.FixtureRequest) -> AsyncIterator[FleetState]:
    """Run the fleet that the module's `FLEET` describes, each gateway, robot and recorder a process of its own."""
    async with fleet_in(tmp_path, **request.module.FLEET) as state:
        yield state


@pytest.fixture
async def client(fleet: FleetState) -> AsyncIterator[FleetClient]:
    """Return an operator on that fleet."""
    async with FleetClient(fleet.endpoint, operator="ann") as made:
        yield made
