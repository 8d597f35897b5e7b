"""Keys of a fleet that lives for one run: an authority of its own, and a file for each member."""

import asyncio
import shutil
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

from appliance.config import GatewayConfig
from appliance.deploy import parts
from appliance.identity.authority import Authority
from appliance.model.roles import Role

BENCH = "bench"
"""The name of whoever is neither a gateway nor a robot."""


def file_of(folder: Path, role: Role, name: str = BENCH) -> Path:
    """Where the keys of a member are, in a folder of keys."""
    return folder / f"{role}-{name}.pem"


def issue(folder: Path, fleet: str, *, gateways: Mapping[str, str], robots: Iterable[str] = ()) -> None:
    """Make the keys of a fleet anew: gateways, robots, a recorder and an engineer; with the roster beside them.

    Args:
        folder: of the keys; what is there is removed.
        fleet: its name.
        gateways: the host under which each is dialled, by its id.
        robots: their names.
    """
    shutil.rmtree(folder, ignore_errors=True)
    authority = Authority.create(folder, fleet, datetime.now(UTC))
    for role in (Role.RECORDER, Role.ENGINEER):
        authority.issue(role, BENCH, out=file_of(folder, role))
    for robot in robots:
        authority.issue(Role.ROBOT, robot, out=file_of(folder, Role.ROBOT, robot))
    for name, host in gateways.items():
        authority.issue(Role.GATEWAY, name, out=file_of(folder, Role.GATEWAY, name), hosts=(host,))


def sign_parts(folder: Path, config: GatewayConfig) -> None:
    """Sign all images, skills and models that are on this machine for gateways of this configuration; blocks."""
    with ThreadPoolExecutor(max_workers=1) as thread:  # there may be a loop in this one
        found = thread.submit(asyncio.run, parts.collect(config)).result()
    parts.sign(Authority.load(folder), [found])
