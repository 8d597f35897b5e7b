"""A fleet with keys for the tests of this folder."""

from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from secured import Secured, secured

from appliance.identity import credentials
from appliance.plane import node


@pytest.fixture
async def fleet(anyio_backend: str, tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Secured]:
    """Two gateways with keys, and the keys of one member of each role."""
    looks = credentials.LOOK_S, node.ROSTER_S
    try:
        async with secured(tmp_path, free_ports(2)) as it:
            yield it
    finally:
        credentials.LOOK_S, node.ROSTER_S = looks
