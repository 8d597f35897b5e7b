"""Attacks: what somebody tries who may not. This folder is `make security`, and part of `make test`."""

from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from secured import Secured, secured

from appliance.identity import credentials
from appliance.plane import node
from tests.integration.conftest import bench, built, catalogue, folder, podman, probe

__all__ = ["bench", "built", "catalogue", "fleet", "folder", "podman", "probe"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what lies here as `fleet`, and what is long as `alone`, as in tests/integration."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.fleet)
            if item.get_closest_marker("long"):
                item.add_marker(pytest.mark.alone)


@pytest.fixture
async def fleet(anyio_backend: str, tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Secured]:
    """Two gateways with keys, and the keys of one member of each role."""
    looks = credentials.LOOK_S, node.ROSTER_S
    try:
        async with secured(tmp_path, free_ports(2)) as it:
            yield it
    finally:
        credentials.LOOK_S, node.ROSTER_S = looks
