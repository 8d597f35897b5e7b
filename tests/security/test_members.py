"""Members of a fleet with keys: gateways that have proved who they are, and nobody who only shows a token."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnnecessaryComparison=false, reportPrivateUsage=false

import asyncio

import pytest
import zenoh
from secured import FLEET, Secured, until

from appliance.errors import IdentityError
from appliance.model import RobotInfo, keyspace
from appliance.model.keys import Keys
from appliance.model.roles import Role
from appliance.plane.session import Session

pytestmark = pytest.mark.anyio

KEYS = Keys(FLEET)


async def test_tokens_without_gateways_own_no_keys(fleet: Secured) -> None:
    """Sixty of them, shown with a gateway's certificate, change nothing: records are written at their owners."""
    raw = await fleet.raw(Role.GATEWAY, "g1")
    tokens = [raw.liveliness().declare_token(KEYS(keyspace.GATEWAY_ALIVE, f"evil-{number}")) for number in range(60)]
    session = fleet.planes["g0"].session
    await until(lambda: session.refused.get("token without a gateway", 0) >= 60)
    for plane in fleet.planes.values():
        assert plane.members() == {"g0", "g1"}
    for number in range(8):
        await fleet.planes["g0"].dht.write(f"note/{number}", b"x", expected=None)
    del tokens
    await asyncio.to_thread(raw.close)


async def test_one_that_answers_for_another_is_not_it(fleet: Secured) -> None:
    """A gateway's certificate proves one name: its holder cannot be a second gateway too."""
    raw = await fleet.raw(Role.GATEWAY, "g1")
    asked = asyncio.Event()
    loop = asyncio.get_running_loop()

    def answer(query: zenoh.Query) -> None:
        with query:
            loop.call_soon_threadsafe(asked.set)
            query.reply(str(query.key_expr), b'{"here": false, "proof": "AAAA"}')

    place = raw.declare_queryable(KEYS(keyspace.RPC, "evil", "*"), answer, complete=True)
    token = raw.liveliness().declare_token(KEYS(keyspace.GATEWAY_ALIVE, "evil"))
    await asked.wait()
    session = fleet.planes["g0"].session
    await until(lambda: session.refused.get("token without a gateway", 0) >= 2)
    assert fleet.planes["g0"].members() == {"g0", "g1"}
    del place, token
    await asyncio.to_thread(raw.close)


async def test_a_revoked_gateway_leaves_the_ring(fleet: Secured) -> None:
    """Once the others have the roster; it comes back with keys that were issued since."""
    one, other = fleet.planes["g0"], fleet.planes["g1"]
    fleet.look_often()
    await asyncio.sleep(0)
    fleet.authority.revoke(Role.GATEWAY, "g1", why="stolen")
    fleet.hand_out()
    await until(lambda: one.members() == {"g0"})
    await other.close()
    del fleet.planes["g1"]
    fleet.keys(Role.GATEWAY, "g1").unlink()
    fleet.issue(Role.GATEWAY, "g1")
    await fleet.start("g1")
    await until(lambda: one.members() == {"g0", "g1"})


async def test_a_revoked_robot_is_not_believed(fleet: Secured, monkeypatch: pytest.MonkeyPatch) -> None:
    """It counts as offline within moments, and its states, its token and its tasks are counted and dropped.

    Also while its link is there: gateways take turns to close it, and a router keeps it.
    """
    plane = fleet.planes["g0"]

    async def not_yet(_: str) -> None:
        await asyncio.sleep(0)

    monkeypatch.setattr(plane._reopener, "reopen", not_yet)
    robot = await Session.open(fleet.client(Role.ROBOT, "r1"), FLEET)
    asked: list[str] = []

    async def intake(key: str, payload: bytes) -> bytes:
        asked.append(key)
        return payload

    plane.session.serve(KEYS(keyspace.INTAKE), intake)
    token = robot.declare_alive(KEYS(keyspace.ROBOT_ALIVE, "r1"))
    state = RobotInfo(id="r1", kind="zenoh", verbs=("state", "stop"))

    def online() -> bool:
        robot.publish(keyspace.ROBOT, state, "r1")
        found = plane.registry.robots.get("r1")
        return found is not None and found.online

    await until(online)
    await robot.query(KEYS(keyspace.INTAKE, "r1"), b"want", timeout_s=2.0)
    fleet.look_often()
    fleet.authority.revoke(Role.ROBOT, "r1", why="lost")
    fleet.hand_out()
    await until(lambda: not plane.registry.robots["r1"].online)
    refused = plane.session.refused
    await until(lambda: not online() and refused.get("revoked robot/*/state", 0) > 0)
    with pytest.raises(IdentityError, match="revoked"):
        await robot.query(KEYS(keyspace.INTAKE, "r1"), b"want", timeout_s=2.0)
    assert len(asked) == 1
    assert not plane.registry.robots["r1"].online
    token.close()
    await robot.close()
