"""The list of parts spreads between gateways by itself, and each checks it against the authority of its own keys."""
# pyright: reportPrivateUsage=false

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
from fleets import command
from secured import FLEET, Secured, until

from appliance.errors import IdentityError
from appliance.identity import parts
from appliance.identity.authority import Authority
from appliance.identity.parts import InForce, Kind, Parts
from appliance.model import keyspace
from appliance.model.plane_api import SealedAsk
from appliance.model.roles import Role
from appliance.plane.client import PlaneClient

pytestmark = pytest.mark.anyio

ONE, TWO = "1" * 64, "2" * 64


def lists(fleet: Secured, name: str) -> InForce:
    """Return what counts for a gateway, as on a machine of its own."""
    credentials = fleet.planes[name].session.credentials
    assert credentials is not None
    return InForce.beside(credentials.bundle, fleet.folder / f"own-{name}.json", fleet.folder / f"kept-{name}.json")


async def handed_on(fleet: Secured) -> dict[str, InForce]:
    """Have each gateway hand its list of parts on."""
    found = {name: lists(fleet, name) for name in fleet.planes}
    for name, plane in fleet.planes.items():
        await plane.hand_on(found[name], keyspace.PARTS)
    fleet.look_often()
    return found


def signed(fleet: Secured, digest: str) -> tuple[int, bytes]:
    """Sign the next list; returns its number and its file."""
    number = fleet.authority.sign_parts(Parts(skill={"goto": (digest,)})).number
    return number, (fleet.authority.folder / parts.FILE).read_bytes()


async def test_a_list_at_one_gateway_counts_at_all(fleet: Secured) -> None:
    """As a file beside the keys of one, or published by an engineer; a gateway that comes later has it at its start."""
    counts = await handed_on(fleet)
    _, first = signed(fleet, ONE)
    (fleet.folder / "own-g0.json").write_bytes(first)
    await until(lambda: counts["g1"].number == 1)
    counts["g1"].check(Kind.SKILL, "goto", ONE)

    signed(fleet, TWO)
    code, out, problems = await command(
        "parts", "publish", "--connect", fleet.endpoints["g1"], "--keys", str(fleet.keys(Role.ENGINEER)),
        "--authority", str(fleet.authority.folder), "--fleet", FLEET, "--json",
    )  # fmt: skip
    assert (code, json.loads(out)) == (0, {"parts": 2}), problems
    await until(lambda: counts["g0"].number == 2)
    with pytest.raises(IdentityError, match="is not signed"):
        counts["g0"].check(Kind.SKILL, "goto", ONE)
    await until(lambda: (fleet.folder / "kept-g0.json").exists() and lists(fleet, "g0").number == 2)  # over a restart

    await fleet.planes.pop("g1").close()
    (fleet.folder / "kept-g1.json").unlink()
    await until(lambda: len(fleet.planes["g0"].members()) == 1)
    plane = await fleet.start("g1")
    await until(lambda: len(plane.members()) == 2)
    anew = lists(fleet, "g1")
    await plane.hand_on(anew, keyspace.PARTS)
    assert anew.number == 2


async def test_what_is_older_or_forged_is_refused_and_counted(fleet: Secured, tmp_path: Path) -> None:
    """By the verb, with an engineer's or a gateway's keys, it changes nothing."""
    counts = await handed_on(fleet)
    _, old = signed(fleet, ONE)
    number, good = signed(fleet, TWO)
    stranger = Authority.create(tmp_path / "stranger", FLEET, datetime.now(UTC))
    stranger.sign_parts(Parts(skill={"goto": (ONE,)}))
    forged = (stranger.folder / parts.FILE).read_bytes()
    (fleet.folder / "own-g0.json").write_bytes(good)
    await until(lambda: {each.number for each in counts.values()} == {2})
    engineer = await PlaneClient.open(fleet.client(Role.ENGINEER), fleet=FLEET)
    bad = (
        old,
        forged,
        good[:-9],
        good.replace(TWO[:9].encode(), ONE[:9].encode()),
        fleet.authority.roster_file.read_bytes(),
    )
    for tried, sealed in enumerate(bad, start=1):
        for ask in (engineer.rpc, fleet.planes["g1"].rpc):
            with pytest.raises(IdentityError):
                await ask.call("g0", keyspace.PARTS, SealedAsk(number=number + 1, sealed=sealed))
        assert fleet.planes["g0"].session.refused["bad parts"] == 2 * tried
    told = await engineer.rpc.call("g0", keyspace.PARTS, SealedAsk(number=1, sealed=old))
    assert told.number == 2
    await engineer.close()
    assert {each.number for each in counts.values()} == {2}


@pytest.mark.parametrize("role", [Role.VIEWER, Role.OPERATOR])
async def test_only_engineers_and_gateways_hand_a_list_in(fleet: Secured, role: Role) -> None:
    """Though it is a good one."""
    counts = await handed_on(fleet)
    number, sealed = signed(fleet, ONE)
    client = await PlaneClient.open(fleet.client(role), fleet=FLEET)
    with pytest.raises(IdentityError, match="may not ask parts"):
        await client.rpc.call("g0", keyspace.PARTS, SealedAsk(number=number, sealed=sealed))
    await client.close()
    assert {each.number for each in counts.values()} == {0}
