"""The roster spreads between gateways by itself, an older one never counts, and a robot holds before it is revoked."""
# pyright: reportPrivateUsage=false

import asyncio
import shutil
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace
from secured import FLEET, NAMES, Secured, until

from appliance.errors import IdentityError
from appliance.identity.authority import Authority as Issuer
from appliance.model import RobotCommand, RobotInfo, RobotReply, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.plane_api import SealedAsk
from appliance.model.robot_api import StopAsk
from appliance.model.roles import Role
from appliance.plane.client import PlaneClient
from appliance.plane.node import ROSTER_FILE, Plane
from appliance.plane.session import Session
from appliance.robots.authority.authority import Authority

pytestmark = pytest.mark.anyio

KEYS = Keys(FLEET)


async def apart(fleet: Secured) -> Path:
    """Start `g1` again with a roster file of its own, as on another machine; returns that."""
    own = fleet.folder / "elsewhere.json"
    if not own.exists():
        shutil.copy(fleet.folder / "roster.json", own)
    plane = fleet.planes.pop("g1")
    await plane.close()
    config = replace(plane.config, roster=str(own))
    fleet.planes["g1"] = await Plane.open(config, fleet=FLEET, gateway="g1", data_dir=fleet.folder / "data-g1")
    await until(lambda: all(len(each.members()) == 2 for each in fleet.planes.values()))
    fleet.look_often()
    return own


def number_at(fleet: Secured, gateway: str) -> int:
    """The number of the roster that counts at a gateway."""
    credentials = fleet.planes[gateway].session.credentials
    assert credentials is not None
    return credentials.roster.number


async def test_a_revocation_at_one_gateway_holds_at_all(fleet: Secured) -> None:
    """The other has it within moments, from nobody's hand, and keeps it with its data."""
    own = await apart(fleet)
    before = own.read_bytes()
    fleet.authority.revoke(Role.OPERATOR, NAMES[Role.OPERATOR])
    fleet.hand_out()
    newest = fleet.authority.roster.number
    await until(lambda: number_at(fleet, "g1") == newest)
    credentials = fleet.planes["g1"].session.credentials
    assert credentials is not None
    assert credentials.roster == fleet.authority.roster
    assert own.read_bytes() == before
    await until((fleet.folder / "data-g1" / ROSTER_FILE).exists)


async def test_an_older_roster_brings_nothing_back(fleet: Secured) -> None:
    """Neither over the verb, nor as a file beside the keys, nor over a restart with that file."""
    own = await apart(fleet)
    old = own.read_bytes()
    fleet.authority.revoke(Role.OPERATOR, NAMES[Role.OPERATOR])
    fleet.hand_out()
    newest = fleet.authority.roster.number
    await until(lambda: number_at(fleet, "g1") == newest)
    await until((fleet.folder / "data-g1" / ROSTER_FILE).exists)
    ask = SealedAsk(number=newest - 1, sealed=old)
    told = await fleet.planes["g0"].rpc.call("g1", keyspace.ROSTER, ask)
    assert told.number == newest
    with pytest.raises(IdentityError, match="counts already"):
        await fleet.planes["g0"].rpc.call("g1", keyspace.ROSTER, SealedAsk(number=newest + 1, sealed=old))
    await apart(fleet)
    assert number_at(fleet, "g1") == newest


async def test_only_the_authority_makes_rosters(fleet: Secured, tmp_path: Path) -> None:
    """One that another has signed, or that was changed, is refused whoever hands it in."""
    other = Issuer.create(tmp_path / "other", FLEET, datetime.now(UTC))
    good = fleet.authority.roster_file.read_bytes()
    client = await PlaneClient.open(fleet.client(Role.ENGINEER), fleet=FLEET)
    for bad in (other.roster_file.read_bytes(), good.replace(b"olga", b"eve1"), good[:100], b""):
        before = number_at(fleet, "g0")
        if bad:
            with pytest.raises(IdentityError):
                await client.rpc.call("g0", keyspace.ROSTER, SealedAsk(number=10**6, sealed=bad))
        assert number_at(fleet, "g0") == before
    await client.close()


async def test_an_operator_gives_the_fleet_the_roster_and_a_viewer_may_not(fleet: Secured) -> None:
    """Over any gateway; what came so lets a new robot in everywhere."""
    fleet.look_often()
    fleet.authority.issue(Role.ROBOT, "r9", out=fleet.folder / "robot-r9.pem")
    sealed, number = fleet.authority.roster_file.read_bytes(), fleet.authority.roster.number
    viewer = await PlaneClient.open(fleet.client(Role.VIEWER), fleet=FLEET)
    with pytest.raises(IdentityError, match="may not ask roster"):
        await viewer.rpc.call("g0", keyspace.ROSTER, SealedAsk(number=number, sealed=sealed))
    await viewer.close()
    client = await PlaneClient.open(fleet.client(Role.OPERATOR), fleet=FLEET)
    told = await client.rpc.call("g0", keyspace.ROSTER, SealedAsk(number=number, sealed=sealed))
    assert told.number == number
    await client.close()

    def lets_in(gateway: str) -> bool:
        credentials = fleet.planes[gateway].session.credentials
        return credentials is not None and credentials.opened is not None and "r9" in credentials.opened.robots

    await until(lambda: lets_in("g0") and lets_in("g1"))


async def test_a_robot_holds_before_its_link_is_closed(fleet: Secured) -> None:
    """It is told to stop when its certificate is revoked, and a later stop reaches it too; nothing else does."""
    plane = fleet.planes["g0"]
    authority = Authority(plane)
    await authority.start()
    plane.on_revoked = authority.hold_revoked
    # As on a robot: it has no roster.
    robot = await Session.open(replace(fleet.client(Role.ROBOT, "r1"), roster=str(fleet.folder / "none.json")), FLEET)
    verbs: list[str] = []
    opened = plane.session._wire.raw
    at: list[bool] = []

    async def command(_: str, payload: bytes) -> bytes:
        asked = msgspec.json.decode(payload, type=RobotCommand)
        verbs.append(asked.verb)
        at.append(plane.session._wire.raw is opened)
        return encode(RobotReply(id=asked.id))

    robot.serve(KEYS(keyspace.COMMAND, "r1"), command, signers=keyspace.COMMAND.asks)
    state = RobotInfo(id="r1", kind="zenoh", verbs=("state", "stop"))

    def online() -> bool:
        robot.publish(keyspace.ROBOT, state, "r1")
        found = plane.registry.robots.get("r1")
        return found is not None and found.online

    await until(online)
    fleet.look_often()
    fleet.authority.revoke(Role.ROBOT, "r1", why="stolen")
    fleet.hand_out()
    await until(lambda: verbs)
    assert (verbs[0], at[0]) == ("stop", True)
    assert [each.robots for each in authority.active] == [("r1",)]
    await until(lambda: plane.session._wire.raw is not opened and not plane._reopener._lock.locked())
    count = len(verbs)
    while len(verbs) == count:
        await plane.rpc.call("g0", keyspace.SOFT_STOP, StopAsk(robots=("r1",), by="olga"))
        await asyncio.sleep(0.1)
    assert set(verbs) == {"stop"}
    await robot.close()
    await authority.close()
