"""Each role against each key on real links: what is put, read, asked, answered and shown is what the table allows."""

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from secured import FLEET, NAMES, Secured, until

from appliance.errors import IdentityError, SwiftbotError, UnreachableError
from appliance.model import RobotCommand, keyspace
from appliance.model.keys import Keys, Topic
from appliance.model.plane_api import KeyAsk
from appliance.model.roles import Role
from appliance.plane import link
from appliance.plane.client import PlaneClient
from appliance.plane.session import Message, Session
from appliance.robots.sender import send_command

pytestmark = pytest.mark.anyio

KEYS = Keys(FLEET)
PUT = [each for each in keyspace.TOPICS if each.form not in ("token", "query")]
TOKENS = [each for each in keyspace.TOPICS if each.form == "token"]
STRANGERS = [role for role in Role if role is not Role.GATEWAY]
FENCES = {
    Role.RECORDER: KEYS(keyspace.RECORDER_STATUS, "fence"),
    Role.ROBOT: KEYS(keyspace.CAMERA, "r1"),
    **dict.fromkeys((Role.VIEWER, Role.OPERATOR, Role.ENGINEER), KEYS(keyspace.STOP, "fence")),
}
"""Where each role may put: what it put before has arrived or never will once that is there."""


def key(topic: Topic[Any], robot: str) -> str:
    """Return a key of a topic, of that robot where it has one."""
    return KEYS(topic, *(robot if field == "robot" else "one" for field in topic.fields))


def may_put(role: Role, topic: Topic[Any], robot: str) -> bool:
    """Return whether the table lets a role, of robots r1, put on the key of a topic with that robot."""
    own = role is not Role.ROBOT or robot == "r1" or "robot" not in topic.fields
    return role in topic.puts and own


@pytest.mark.parametrize("role", STRANGERS)
async def test_only_what_the_table_allows_is_written(fleet: Secured, role: Role) -> None:
    """Puts and deletes at a key of every topic, of the role's own name and another's; and with wildcards."""
    heard: set[tuple[str, bool]] = set()
    session = fleet.planes["g0"].session
    session.subscribe(KEYS.everything, lambda message: heard.add((message.key, message.deleted)))
    raw = await fleet.raw(role)
    expected: set[tuple[str, bool]] = {(FENCES[role], False)}
    for topic in PUT:
        for robot in ("r1", "r2"):
            raw.put(key(topic, robot), b"{}")
            raw.delete(key(topic, robot))
            if may_put(role, topic, robot):
                expected |= {(key(topic, robot), False), (key(topic, robot), True)}
    for wildcard in (KEYS.everything, f"{KEYS.root}/robot/*/state", f"{KEYS.root}/gw/**", f"{KEYS.root}/operator/*/*"):
        raw.put(wildcard, b"{}")
        raw.delete(wildcard)
    before = len(heard)
    raw.put(FENCES[role], b"fence")
    await until(lambda: len(heard) > before and (FENCES[role], False) in heard)
    await _quiet(lambda: len(heard))
    others = {f"{KEYS.root}/gw/g0/", f"{KEYS.root}/gw/g1/", f"{KEYS.root}/operator/act/g"}
    assert {each for each in heard if not any(each[0].startswith(begin) for begin in others)} == expected
    await asyncio.to_thread(raw.close)


@pytest.mark.parametrize("role", STRANGERS)
async def test_only_what_the_table_allows_is_read(fleet: Secured, role: Role) -> None:
    """By a subscription to each key, and by one to everything."""
    raw = await fleet.raw(role)
    heard: set[str] = set()

    def take(sample: zenoh.Sample) -> None:
        heard.add(str(sample.key_expr))

    subscribers = [raw.declare_subscriber(key(topic, robot), take) for topic in PUT for robot in ("r1", "r2")]
    subscribers += [
        raw.declare_subscriber(f"{KEYS.root}/robot/**", take),
        raw.declare_subscriber(KEYS.everything, take),
    ]
    expected = {
        key(topic, robot)
        for topic in PUT
        for robot in ("r1", "r2")
        if role in topic.reads and (role is not Role.ROBOT or robot == "r1" or "robot" not in topic.fields)
    }
    session = fleet.planes["g0"].session

    def say() -> bool:
        for topic in PUT:
            for robot in ("r1", "r2"):
                session.put(key(topic, robot), b"{}")
        return expected <= heard

    # Again until the subscriptions have arrived there.
    while not say():
        await asyncio.sleep(0.05)
    await _quiet(lambda: len(heard))
    assert {each for each in heard if "/gw/g" not in each and "/operator/act/g" not in each} == expected
    del subscribers
    await asyncio.to_thread(raw.close)


@pytest.mark.parametrize("role", STRANGERS)
async def test_only_what_the_table_allows_is_asked(fleet: Secured, role: Role) -> None:
    """Every verb there is: a question that is let in is answered, be it with an error, and another is not."""
    raw = await fleet.raw(role)

    def answered(verb: str) -> bool:
        return bool(list(raw.get(KEYS(keyspace.RPC, "g0", verb), payload=b"[]", timeout=2.0)))

    await asyncio.to_thread(answered, "task" if role is Role.ROBOT else "facts")
    found = {verb.name for verb in keyspace.VERBS if await asyncio.to_thread(answered, verb.name)}
    assert found == {verb.name for verb in keyspace.VERBS if role in verb.asks}
    await asyncio.to_thread(raw.close)


@pytest.mark.parametrize("role", STRANGERS)
async def test_only_what_the_table_allows_is_shown_as_alive(fleet: Secured, role: Role) -> None:
    """Tokens, which have passed a rule that denies all before (zenoh issue 1562): no stranger makes a gateway."""
    raw = await fleet.raw(role)
    tokens: list[zenoh.LivelinessToken] = []
    allowed: list[str] = []
    for topic in TOKENS:
        for robot in ("r1", "r2"):
            each = KEYS(topic, *(robot if field == "robot" else f"evil{robot}" for field in topic.fields))
            tokens.append(raw.liveliness().declare_token(each))
            if may_put(role, topic, robot):
                allowed.append(each)
    tokens += [raw.liveliness().declare_token(f"{KEYS.root}/{each}") for each in ("gw/*/alive", "**", "gw/evil/**")]
    arrived = asyncio.Event()
    session = fleet.planes["g0"].session
    session.subscribe(FENCES[role], lambda _: arrived.set())
    raw.put(FENCES[role], b"fence")
    await arrived.wait()
    shown = await session.alive_now(KEYS.everything)
    assert sorted(each for each in shown if "/gw/g" not in each) == sorted(allowed)
    assert fleet.planes["g0"].members() == {"g0", "g1"}
    del tokens
    await asyncio.to_thread(raw.close)


@pytest.mark.parametrize("role", STRANGERS)
async def test_nobody_answers_for_somebody_else(fleet: Secured, role: Role) -> None:
    """A queryable in a gateway's or another robot's place is asked nothing, and hears no question."""
    raw = await fleet.raw(role)
    heard: list[str] = []

    def take(query: zenoh.Query) -> None:
        with query:
            heard.append(str(query.key_expr))
            query.reply(str(query.key_expr), b"{}")

    places = [
        raw.declare_queryable(each, take, complete=True)
        for each in (
            KEYS(keyspace.COMMAND, "r2"),
            f"{KEYS.root}/robot/*/command",
            KEYS(keyspace.RPC, "g0", "*"),
            KEYS(keyspace.RPC, "g7", "facts"),
            KEYS(keyspace.CHUNK, "g7", "d", "0"),
            KEYS(keyspace.BACKLOG, "1a"),
            KEYS.everything,
        )
    ]
    arrived = asyncio.Event()
    session = fleet.planes["g0"].session
    session.subscribe(FENCES[role], lambda _: arrived.set())
    raw.put(FENCES[role], b"fence")
    await arrived.wait()
    asked = [KEYS(keyspace.COMMAND, "r2"), KEYS(keyspace.RPC, "g7", "facts"), KEYS(keyspace.CHUNK, "g7", "d", "0")]
    for expression in [*asked, KEYS(keyspace.BACKLOG, "1a")]:
        with pytest.raises(UnreachableError):
            await session.query(expression, b"{}", timeout_s=2.0)
    await fleet.planes["g1"].rpc.call("g0", keyspace.DHT_READ, KeyAsk(key="note/1"))
    assert heard == []
    del places
    await asyncio.to_thread(raw.close)


async def test_a_robot_does_what_robots_do(fleet: Secured) -> None:
    """Its state, its token, a command to it and a task of its own pass, through its own certificate."""
    session = await Session.open(fleet.client(Role.ROBOT, "r1"), FLEET)
    gateway = fleet.planes["g0"].session
    states: list[Message] = []
    alive: list[tuple[str, bool]] = []
    gateway.subscribe(KEYS(keyspace.ROBOT), states.append)
    gateway.watch_alive(KEYS(keyspace.ROBOT_ALIVE), lambda key, here: alive.append((key, here)))

    async def command(_: str, payload: bytes) -> bytes:
        return payload

    async def intake(_: str, payload: bytes) -> bytes:
        return payload

    gateway.serve(KEYS(keyspace.INTAKE), intake)
    session.serve(KEYS(keyspace.COMMAND, "r1"), command)
    token = session.declare_alive(KEYS(keyspace.ROBOT_ALIVE, "r1"))
    session.put(KEYS(keyspace.ROBOT, "r1"), b"{}")
    await until(lambda: states and alive)
    assert await gateway.query(KEYS(keyspace.COMMAND, "r1"), b"go", timeout_s=2.0) == b"go"
    assert await session.query(KEYS(keyspace.INTAKE, "r1"), b"want", timeout_s=2.0) == b"want"
    with pytest.raises(UnreachableError):
        await session.query(KEYS(keyspace.INTAKE, "r2"), b"want", timeout_s=2.0)
    token.close()
    await until(lambda: len(alive) == 2)
    await session.close()


async def test_a_robot_asks_no_other_robot(fleet: Secured) -> None:
    """Neither to do something, nor for what it has said, nor in its place; the one that is asked hears nothing."""
    other = await Session.open(fleet.client(Role.ROBOT, "r2"), FLEET)
    heard: list[str] = []

    async def command(key: str, payload: bytes) -> bytes:
        heard.append(key)
        return payload

    for name in ("r1", "r2"):
        fleet.planes["g0"].session.serve(KEYS(keyspace.INTAKE, name), command)
    other.serve(KEYS(keyspace.COMMAND, "r2"), command)
    while not heard:
        with contextlib.suppress(SwiftbotError):
            await fleet.planes["g0"].session.query(KEYS(keyspace.COMMAND, "r2"), b"go", timeout_s=1.0, sign=True)
    raw = await fleet.raw(Role.ROBOT, "r1")

    def answered(key: str) -> bool:
        return bool(list(raw.get(key, payload=b"{}", timeout=2.0)))

    assert await asyncio.to_thread(answered, KEYS(keyspace.INTAKE, "r1"))
    heard.clear()
    asked = [KEYS(keyspace.COMMAND, "r2"), KEYS(keyspace.INTAKE, "r2"), f"{KEYS.root}/robot/**", f"{KEYS.root}/**"]
    for each in asked:
        assert not await asyncio.to_thread(answered, each), each
    assert heard == []
    await asyncio.to_thread(raw.close)
    await other.close()


async def test_a_robot_that_the_roster_lacks_is_let_into_nothing(fleet: Secured) -> None:
    """Its certificate gives it a link; what it says goes nowhere until gateways open their sessions with the roster."""
    fleet.authority.issue(Role.ROBOT, "r9", out=fleet.folder / "robot-r9.pem")
    raw = await fleet.raw(Role.ROBOT, "r9")
    known = await fleet.raw(Role.ROBOT, "r1")
    heard: list[str] = []
    fleet.planes["g0"].session.subscribe(KEYS(keyspace.ROBOT), lambda message: heard.append(message.key))
    raw.put(KEYS(keyspace.ROBOT, "r9"), b"{}")
    known.put(KEYS(keyspace.ROBOT, "r1"), b"{}")
    await until(lambda: heard)
    await _quiet(lambda: len(heard))
    assert heard == [KEYS(keyspace.ROBOT, "r1")]
    for session in (raw, known):
        await asyncio.to_thread(session.close)


@pytest.mark.parametrize("role", [Role.VIEWER, Role.ROBOT])
async def test_a_session_id_gives_no_rights(fleet: Secured, role: Role) -> None:
    """Zenoh authenticates no session id: one that takes a gateway's has the rights of its own certificate."""
    gateway = fleet.planes["g1"]
    config = fleet.client(role)
    credentials = await asyncio.to_thread(link.read_credentials, config, FLEET)
    settings = link._zenoh_config(config, "", credentials)
    await gateway.close()
    del fleet.planes["g1"]
    settings.insert_json5("id", msgspec.json.encode(str(gateway.session._wire.source.source_id.zid)).decode())
    raw = await asyncio.to_thread(zenoh.open, settings)
    heard: list[str] = []
    arrived = asyncio.Event()
    session = fleet.planes["g0"].session
    session.subscribe(KEYS(keyspace.STATUS, "g1"), lambda message: heard.append(message.key))
    session.subscribe(FENCES[role], lambda _: arrived.set())
    token = raw.liveliness().declare_token(KEYS(keyspace.GATEWAY_ALIVE, "g1"))
    raw.put(KEYS(keyspace.STATUS, "g1"), b"{}")
    raw.put(FENCES[role], b"fence")
    await arrived.wait()
    assert heard == []
    assert fleet.planes["g0"].members() == {"g0"}
    token.undeclare()
    await asyncio.to_thread(raw.close)


async def test_who_may_not_is_told_so_before_anything_is_sent(fleet: Secured) -> None:
    """By the product's own client: gateways drop without a word what they deny."""
    client = await PlaneClient.open(fleet.client(Role.VIEWER), fleet=FLEET)
    with pytest.raises(IdentityError, match="viewer vera may not ask dht_read") as told:
        await client.rpc.call("g0", keyspace.DHT_READ, KeyAsk(key="note/1"))
    assert told.value.remedy == "who may: nobody but gateways"
    with pytest.raises(IdentityError, match="may not ask drain"):
        await client.rpc.call("g0", keyspace.DRAIN, keyspace.DRAIN.request())
    await client.close()


async def test_every_role_is_told_apart_in_one_fleet(fleet: Secured) -> None:
    """All at once, each linked with its own certificate, each asks what it may."""
    for role in NAMES:
        if role is not Role.GATEWAY and role is not Role.ROBOT:
            client = await PlaneClient.open(fleet.client(role), fleet=FLEET)
            assert client.members() == {"g0", "g1"}
            await client.close()


async def _quiet(count: Callable[[], int]) -> None:
    """Wait until nothing more has come for a moment."""
    before = -1
    while count() != before:
        before = count()
        await asyncio.sleep(0.3)


async def test_a_robots_own_program_is_one_of_the_fleet(fleet: Secured, project_root: Path) -> None:
    """The example of the documentation, in a process of its own: seen, heard and commanded with its certificate."""
    example = project_root / "docs" / "examples" / "robots" / "minimal_robot.py"
    files = (str(fleet.keys(Role.ROBOT, "r2")), str(fleet.authority.folder / "authority.crt"))
    process = await asyncio.create_subprocess_exec(
        sys.executable, str(example), FLEET, "r2", fleet.endpoints["g1"], *files,
        env=os.environ | {"PYTHONPATH": str(project_root)},
    )  # fmt: skip
    try:
        plane = fleet.planes["g0"]
        await until(lambda: "r2" in plane.registry.robots and plane.registry.robots["r2"].online)
        reply = await send_command(plane.session, "r2", RobotCommand(id="c-1", verb="state"), timeout_s=10.0)
        assert reply.failure is None
    finally:
        process.kill()
        await process.wait()
