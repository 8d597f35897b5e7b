"""A gateway takes up robots, revocations and certificates while the fleet goes on: its session is opened again."""
# pyright: reportPrivateUsage=false, reportUnknownMemberType=false, reportUnknownArgumentType=false

import asyncio
import contextlib
import socket
import ssl
from collections.abc import AsyncGenerator, Awaitable, Callable
from urllib.parse import urlsplit

import msgspec
import pytest
import zenoh
from cryptography import x509
from secured import FLEET, Secured, until

from appliance.errors import SwiftbotError, UnreachableError
from appliance.identity import certificates
from appliance.model import RobotCommand, RobotReply, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.plane_api import FactsAsk, KeyAsk
from appliance.model.roles import Role
from appliance.plane import link, session
from appliance.plane.events import Lost, Relinked, Stage
from appliance.plane.session import Session
from appliance.robots.sender import tell_to_hold

pytestmark = pytest.mark.anyio

KEYS = Keys(FLEET)


@contextlib.asynccontextmanager
async def heard(fleet: Secured, robot: str) -> AsyncGenerator[Callable[[], bool]]:
    """Have a robot put its state, as a program of its own does; gives whether a gateway has heard it."""
    raw = await fleet.raw(Role.ROBOT, robot)
    states: list[str] = []
    closer = fleet.planes["g0"].session.subscribe(
        KEYS(keyspace.ROBOT, robot), lambda message: states.append(message.key)
    )

    def say() -> bool:
        raw.put(KEYS(keyspace.ROBOT, robot), b"{}")
        return bool(states)

    yield say
    closer.close()
    await asyncio.to_thread(raw.close)


def serial_at(endpoint: str, fleet: Secured) -> str:
    """The serial number of the certificate that a gateway shows."""
    address = urlsplit(f"//{endpoint.partition('/')[2]}")
    context = ssl.create_default_context(cafile=str(fleet.authority.folder / "authority.crt"))
    keys = fleet.keys(Role.OPERATOR)
    context.load_cert_chain(keys, keys)
    assert address.hostname is not None
    assert address.port is not None
    with context.wrap_socket(
        socket.create_connection((address.hostname, address.port)), server_hostname="127.0.0.1"
    ) as s:
        shown = s.getpeercert(binary_form=True)
    assert shown is not None
    return certificates.serial_of(x509.load_der_x509_certificate(shown))


async def test_a_robot_that_is_new_is_let_in_without_a_restart(fleet: Secured) -> None:
    """Nobody is lost, what is put arrives in order and whole, and questions are answered throughout."""
    fleet.look_often()
    one, other = fleet.planes["g0"], fleet.planes["g1"]
    lost: list[object] = []
    relinked: list[str] = []
    for plane in (one, other):
        plane.events.subscribe(Stage.WATCHERS, lambda event: lost.append(event) if isinstance(event, Lost) else None)
        plane.events.subscribe(
            Stage.WATCHERS, lambda event: relinked.append(event.gateway) if isinstance(event, Relinked) else None
        )
    numbers: list[int] = []
    other.session.subscribe(KEYS(keyspace.STOP, "count"), lambda message: numbers.append(int(message.payload)))
    await one.dht.write("note/1", b"kept", expected=None)
    failed: list[SwiftbotError] = []
    sent = 0
    asking = True

    async def ask() -> None:
        while asking:
            for asker, asked in ((one, "g1"), (other, "g0")):
                try:
                    await asker.rpc.call(asked, keyspace.FACTS, FactsAsk())
                    await asker.rpc.call(asked, keyspace.DHT_READ, KeyAsk(key="note/1"))
                except SwiftbotError as error:
                    failed.append(error)
            await asyncio.sleep(0.001)

    async def put() -> None:
        nonlocal sent
        while asking:
            one.session.put(KEYS(keyspace.STOP, "count"), str(sent).encode())
            sent += 1
            await asyncio.sleep(0.001)

    work = [asyncio.create_task(each()) for each in (ask, put)]
    await until(lambda: len(numbers) > 10)
    fleet.issue(Role.ROBOT, "r9")
    async with heard(fleet, "r9") as say:
        while not say():
            await asyncio.sleep(0.05)
    await until(lambda: {"g0", "g1"} <= set(relinked))
    seen = len(numbers)
    await until(lambda: len(numbers) > seen + 10)
    asking = False
    await asyncio.gather(*work)
    await until(lambda: numbers and numbers[-1] == sent - 1)
    assert lost == []
    assert failed == []
    first = numbers[0]
    # Of what `g0` puts nothing is lost while it reopens; what came while the listener did is not its session's.
    assert numbers == sorted(set(numbers))
    assert first < 10
    assert one.members() == other.members() == {"g0", "g1"}


async def test_what_was_declared_before_is_there_after(fleet: Secured) -> None:
    """Subscriptions, services, tokens and watches of the gateway's session, and what other members have of them."""
    one, other = fleet.planes["g0"], fleet.planes["g1"]
    session = one.session

    async def echo(_: str, payload: bytes) -> bytes:
        return payload

    alive: list[tuple[str, bool]] = []
    came: list[str] = []
    served = session.serve(KEYS(keyspace.COMMAND, "r1"), echo)
    session.serve(KEYS(keyspace.COMMAND, "r2"), echo)
    token = session.declare_alive(KEYS(keyspace.ROBOT_ALIVE, "r1"))
    session.declare_alive(KEYS(keyspace.ROBOT_ALIVE, "r2"))
    other.session.watch_alive(KEYS(keyspace.ROBOT_ALIVE), lambda key, here: alive.append((key, here)))
    session.subscribe(KEYS(keyspace.ROBOT), lambda message: came.append(message.key))
    publisher = session.publisher(KEYS(keyspace.STATUS, "g0"), "application/json")
    publisher.put(b"{}")
    await until(lambda: len(alive) == 2)
    await one._reopener.reopen("a test")
    served.close()
    token.close()
    assert await other.session.query(KEYS(keyspace.COMMAND, "r2"), b"go", timeout_s=2.0) == b"go"
    with pytest.raises(UnreachableError):
        await other.session.query(KEYS(keyspace.COMMAND, "r1"), b"go", timeout_s=2.0)
    other.session.put(KEYS(keyspace.ROBOT, "r2"), b"{}")
    await until(lambda: came)
    # The one that was ended since is told of, late, since tokens are given time to come back; no other.
    await until(lambda: len(alive) > 2)
    assert alive[2:] == [(KEYS(keyspace.ROBOT_ALIVE, "r1"), False)]
    publisher.put(b"{}")
    publisher.close()


async def test_a_stop_does_not_wait_for_the_session_to_be_reopened(
    fleet: Secured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the gateway waits for what is under way, its robots are told to hold at once; other questions wait."""
    monkeypatch.setattr(session, "QUIET_S", 30.0)
    one, other = fleet.planes["g0"], fleet.planes["g1"]
    done, order = asyncio.Event(), list[str]()

    async def slow(_: str, payload: bytes) -> bytes:
        if payload != b"ready":
            await done.wait()
        return payload

    async def robot(_: str, payload: bytes) -> bytes:
        return encode(RobotReply(id=msgspec.json.decode(payload, type=RobotCommand).id))

    async def follow(what: str, work: Awaitable[object]) -> object:
        answer = await work
        order.append(what)
        return answer

    other.session.serve(KEYS(keyspace.COMMAND, "r2"), slow)
    other.session.serve(KEYS(keyspace.COMMAND, "r1"), robot)
    state = encode(RobotCommand(id="1", verb="state"))
    for key, payload in ((KEYS(keyspace.COMMAND, "r1"), state), (KEYS(keyspace.COMMAND, "r2"), b"ready")):
        while True:  # what a session serves is known to the other a moment later
            with contextlib.suppress(UnreachableError):
                await one.session.query(key, payload, timeout_s=30.0)
                break
            await asyncio.sleep(0.01)
    work = [asyncio.create_task(follow("slow", one.session.query(KEYS(keyspace.COMMAND, "r2"), b"", timeout_s=30.0)))]
    await asyncio.sleep(0)
    work.append(asyncio.create_task(follow("reopened", one._reopener.reopen("a test"))))
    await until(lambda: one.session._wire.held)
    work.append(
        asyncio.create_task(follow("state", one.session.query(KEYS(keyspace.COMMAND, "r1"), state, timeout_s=30.0)))
    )
    await asyncio.sleep(0)
    held, problems = await tell_to_hold(one.session, ["r1"], act="s1", timeout_s=20.0)
    order.append("stop")
    done.set()
    await asyncio.gather(*work)
    assert (held, problems) == (("r1",), {})
    assert order[:2] == ["stop", "slow"]
    assert sorted(order[2:]) == ["reopened", "state"]


async def test_a_robot_that_is_revoked_is_let_into_nothing(fleet: Secured) -> None:
    """Its link is closed, and what it says over the next goes nowhere; what others say arrives."""
    fleet.look_often()
    async with heard(fleet, "r1") as say, heard(fleet, "r2") as other:
        while not (say() and other()):
            await asyncio.sleep(0.05)
        opened = fleet.planes["g0"].session._wire.raw
        fleet.authority.revoke(Role.ROBOT, "r1")
        fleet.hand_out()
        await until(lambda: fleet.planes["g0"].session._wire.raw is not opened)
        raw, states = fleet.planes["g0"].session._wire.raw, list[str]()
        subscriber = raw.declare_subscriber(KEYS(keyspace.ROBOT), lambda sample: states.append(str(sample.key_expr)))
        while states.count(KEYS(keyspace.ROBOT, "r2")) < 5:
            say()
            other()
            await asyncio.sleep(0.05)
        assert KEYS(keyspace.ROBOT, "r1") not in states
        subscriber.undeclare()


async def test_a_renewed_certificate_is_shown_without_a_restart(fleet: Secured) -> None:
    """Whoever dials sees the new one, what is signed is signed with it, and the gateway stays a member."""
    endpoint = fleet.endpoints["g0"]
    first = await asyncio.to_thread(serial_at, endpoint, fleet)
    fleet.look_often()
    fleet.authority.renew(Role.GATEWAY, "g0", out=fleet.keys(Role.GATEWAY, "g0"))
    fleet.hand_out()
    latest = fleet.authority.roster.valid(Role.GATEWAY, "g0", 0)[-1].serial
    assert latest != first

    async def shown() -> str:
        try:
            return await asyncio.to_thread(serial_at, endpoint, fleet)
        except OSError:  # just being reopened
            return ""

    while await shown() != latest:
        await asyncio.sleep(0.05)
    await fleet.planes["g0"].rpc.call("g1", keyspace.DHT_READ, KeyAsk(key="note/1"))
    assert fleet.planes["g1"].members() == {"g0", "g1"}


async def test_keys_that_are_not_good_are_not_taken(fleet: Secured) -> None:
    """Another member's, those of another authority, and a file cut off change nothing: the gateway goes on."""
    fleet.look_often()
    plane = fleet.planes["g0"]
    credentials, path = plane.session.credentials, fleet.keys(Role.GATEWAY, "g0")
    assert credentials is not None
    before, opened = credentials.identity.serial, plane.session._wire.raw
    good = path.read_bytes()
    for bad in (fleet.keys(Role.GATEWAY, "g1").read_bytes(), good[: len(good) // 2], b""):
        path.write_bytes(bad)
        await until(lambda: credentials._keys_stamp is not None and credentials._keys_stamp.size == path.stat().st_size)
        assert credentials.identity.serial == before
    assert not credentials.stale
    assert plane.session._wire.raw is opened


async def test_a_session_that_cannot_be_opened_so_is_opened_as_it_was(
    fleet: Secured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gateway keeps its place with the certificate of before, and does not try the same over and over."""
    plane = fleet.planes["g0"]
    credentials = plane.session.credentials
    assert credentials is not None
    before = credentials.opened
    real, tried = link.open_raw, list[int]()

    def refuse_the_first(*args: object) -> zenoh.Session:
        tried.append(1)
        if len(tried) == 1:
            credentials.open()
            raise UnreachableError("Zenoh does not take it")
        return real(*args)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(link, "open_raw", refuse_the_first)
    fleet.authority.issue(Role.ROBOT, "r9", out=fleet.folder / "robot-r9.pem")
    fleet.hand_out()
    credentials._look_at = 0.0
    credentials.refresh()
    assert credentials.stale
    await plane._reopener.reopen("a test")
    assert len(tried) == 2
    assert credentials.opened == before
    assert not credentials.stale
    await plane.rpc.call("g1", keyspace.DHT_READ, KeyAsk(key="note/1"))


async def test_a_gateway_whose_session_cannot_be_opened_at_all_ends(
    fleet: Secured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process is told why, so that it is started again, and what it closes on its way out does not hang."""
    plane = fleet.planes["g0"]

    def refuse(*_: object) -> zenoh.Session:
        raise UnreachableError("the endpoint is taken")

    monkeypatch.setattr(link, "open_raw", refuse)
    monkeypatch.setattr(session, "_GIVE_UP_S", 0.5)
    fleet.look_often()
    fleet.issue(Role.ROBOT, "r9")
    async with asyncio.timeout(60):
        with pytest.raises(UnreachableError, match="taken"):
            await plane.until_gone()
        await plane.close()


async def test_a_client_goes_on_with_the_gateway_that_reopened(fleet: Secured) -> None:
    """Its link is closed and made again by itself; its subscription is there."""
    client = await Session.open(fleet.client(Role.VIEWER), FLEET)
    heard_there: list[str] = []
    client.subscribe(KEYS(keyspace.STATUS, "g0"), lambda message: heard_there.append(message.key))
    session = fleet.planes["g0"].session
    while not heard_there:
        session.put(KEYS(keyspace.STATUS, "g0"), b"{}")
        await asyncio.sleep(0.02)
    await fleet.planes["g0"]._reopener.reopen("a test")
    heard_there.clear()
    while not heard_there:
        session.put(KEYS(keyspace.STATUS, "g0"), b"{}")
        await asyncio.sleep(0.02)
    await client.close()
