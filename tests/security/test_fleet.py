"""A fleet of real processes with keys: gateways, recorder, a MAVLink vehicle and commands of people, end to end."""

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from fleets import command, fleet_in, swiftbot
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.connection import FleetState
from appliance.errors import IdentityError
from appliance.identity.authority import Authority
from appliance.model import Lease, TaskRequest, TaskState
from appliance.model.roles import Role
from workshop import keyring
from workshop.local_fleet import keys_folder

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300)]


@pytest.fixture
async def fleet(anyio_backend: str, tmp_path: Path) -> AsyncIterator[FleetState]:
    """Two gateways, a recorder and a vehicle, all links with keys."""
    async with fleet_in(tmp_path, gateways=2, mavlink=1, zenoh=0, sim_rate=4.0, secured=True) as state:
        yield state


async def test_a_task_is_done_in_the_name_of_a_certificate(fleet: FleetState) -> None:
    """Submitted, planned, coordinated, run, flown and recorded over links with keys; by the name that the keys have."""
    async with FleetClient(fleet.endpoint, operator="ceo") as client:
        record = await client.submit(TaskRequest(instruction="drone_1 take off to 3 m", submitter="ceo"))
        async for now in client.watch(record.id):
            record = now
        assert record.state is TaskState.SUCCEEDED, record
        assert record.submitter == keyring.BENCH
        acts, _ = await client.acts()
        assert {act.by for act in acts} == {keyring.BENCH}
        for status in client.plane.registry.gateways.values():
            assert not [kind for kind in status.refused if "unauthorized" in kind or "token without" in kind]
    logged = [path for path in Path(fleet.record_dir).iterdir() if path.suffix == ".mcap"]
    code, out, problems = await command("log", "info", *map(str, logged), "--json")
    assert code == 0, problems
    assert "task/" in out


@pytest.mark.long
async def test_each_role_does_by_the_command_line_what_it_may(fleet: FleetState) -> None:
    """A viewer looks and stops, and is told that it may not submit or drain; without keys nobody gets in."""
    authority = Authority.load(keys_folder(Path(fleet.directory)))
    viewer = authority.folder / "viewer-vera.pem"
    authority.issue(Role.VIEWER, "vera", out=viewer)
    code, out, problems = await swiftbot(fleet, "fleet", "--json", "--keys", str(viewer))
    assert code == 0, problems
    shown: Any = json.loads(out)
    assert "gw-1" in json.dumps(shown)
    for words in (("submit", "drone_1 land", "--yes"), ("drain", "gw-1"), ("resume",)):
        code, out, problems = await swiftbot(fleet, *words, "--keys", str(viewer))
        assert code == 9, out + problems
        assert "viewer vera may not ask" in problems
    code, _, problems = await swiftbot(fleet, "stop", "--keys", str(viewer))
    assert code in (0, 1), problems
    code, out, _ = await swiftbot(fleet, "stops", "--json", "--keys", str(viewer))
    assert '"vera"' in out
    endpoint = fleet.endpoints[0].replace("tls/", "tcp/")
    code, _, problems = await swiftbot(fleet, "fleet", "--connect", endpoint)
    assert code == 3
    assert "--keys" in problems


async def test_an_order_of_another_name_is_told_of_the_right_one(fleet: FleetState) -> None:
    """An operator who gives another's name is named for what the order was; revoked, nothing more is taken."""
    authority = Authority.load(keys_folder(Path(fleet.directory)))
    keys = authority.folder / "operator-olga.pem"
    authority.issue(Role.OPERATOR, "olga", out=keys)
    async with FleetClient(replace(fleet.endpoint, keys=str(keys)), operator="ceo") as client:
        lease = await client.take_over("drone_1", lease_s=30.0)
        assert lease.by == "olga"
        authority.revoke(Role.OPERATOR, "olga", why="left")
        with pytest.raises(IdentityError, match="revoked: left"):
            await _until_refused(client, lease)


async def _until_refused(client: FleetClient, lease: Lease) -> None:
    """Renew a takeover again and again; the gateways look for a new roster every few seconds."""
    while True:
        await client.renew(lease)
        await asyncio.sleep(0.5)
