"""Signed requests on real links: who ordered what is the certificate's name, and an order counts once."""

import asyncio
import contextlib
import time

import msgspec
import pytest
import zenoh
from secured import FLEET, NAMES, Secured

from appliance.errors import IdentityError, SwiftbotError
from appliance.identity.member import SENDER, Identity
from appliance.identity.signing import Signer
from appliance.model import Lifted, SoftStop, TaskRecord, encode, keyspace
from appliance.model.keys import Keys
from appliance.model.plane_api import Record, RecordChange
from appliance.model.robot_api import StandingAsk, StopAnswer, StopAsk
from appliance.model.roles import Role
from appliance.model.task_api import DrainAsk, DrainState, PauseAsk
from appliance.plane import link
from appliance.plane.client import PlaneClient
from appliance.plane.session import Session
from appliance.robots.authority.authority import Authority

pytestmark = pytest.mark.anyio

KEYS = Keys(FLEET)
PAUSE = KEYS(keyspace.RPC, "g0", "pause")


class Paused:
    """What the verb `pause` was asked at g0: the request as the handler got it, and who signed it."""

    def __init__(self, fleet: Secured) -> None:
        self.asked: list[tuple[PauseAsk, Identity | None]] = []
        self.plane = fleet.planes["g0"]
        self.plane.rpc.register(keyspace.PAUSE, self._on_pause)

    async def _on_pause(self, ask: PauseAsk) -> TaskRecord:
        self.asked.append((ask, SENDER.get()))
        return TaskRecord(id=ask.id, instruction="x")

    @property
    def refused(self) -> int:
        """How often the gateway counted a question that it was not allowed."""
        return self.plane.session.refused.get("unauthorized gw/g0/rpc/pause", 0)


def ask(raw: zenoh.Session, key: str, payload: bytes, attachment: bytes | None) -> tuple[bytes, str]:
    """Ask without the product's code; returns the answer, or the error's code."""
    for reply in raw.get(key, payload=payload, attachment=attachment, timeout=3.0):
        if reply.ok is not None:
            return reply.ok.payload.to_bytes(), ""
        if reply.err is not None:
            return b"", msgspec.json.decode(reply.err.payload.to_bytes())["code"]
    return b"", "nobody"


def signer(fleet: Secured, role: Role) -> Signer:
    """Return what signs with somebody's keys."""
    config = fleet.client(role)
    found = link.read_credentials(config, FLEET)
    assert found is not None
    return Signer(found.bundle.key, found.bundle.certificate)


def now_ns() -> int:
    """Return the time."""
    return time.time_ns()


async def test_the_certificate_says_who_ordered_it(fleet: Secured) -> None:
    """Whatever name the order gives itself."""
    paused = Paused(fleet)
    client = await PlaneClient.open(fleet.client(Role.OPERATOR), fleet=FLEET)
    await client.rpc.call("g0", keyspace.PAUSE, PauseAsk(id="t-1", by="ceo", why="because"))
    ((asked, sender),) = paused.asked
    assert (asked.by, asked.why) == (NAMES[Role.OPERATOR], "because")
    assert sender is not None
    assert (sender.role, sender.name) == (Role.OPERATOR, NAMES[Role.OPERATOR])
    await client.close()


async def test_a_gateway_passes_on_what_others_ordered(fleet: Secured) -> None:
    """Under their names: it has checked them, and is believed."""
    paused = Paused(fleet)
    await fleet.planes["g1"].rpc.call("g0", keyspace.PAUSE, PauseAsk(id="t-1", by="olga"))
    ((asked, sender),) = paused.asked
    assert asked.by == "olga"
    assert sender is not None
    assert sender.role is Role.GATEWAY


async def test_an_order_without_a_good_signature_is_refused_and_counted(fleet: Secured) -> None:
    """None, of another key or payload, of a role that may not, with damage; a good one counts once."""
    paused = Paused(fleet)
    raw, payload = await fleet.raw(Role.OPERATOR), encode(PauseAsk(id="t-1"))
    own, viewer = signer(fleet, Role.OPERATOR), signer(fleet, Role.VIEWER)
    good = own.sign(PAUSE, payload, now_ns())
    wrong = [
        None,
        PAUSE.encode(),
        link.mark(PAUSE, direct=False, signature=own.sign(KEYS(keyspace.RPC, "g1", "pause"), payload, now_ns())),
        link.mark(PAUSE, direct=False, signature=own.sign(PAUSE, b"{}", now_ns())),
        link.mark(PAUSE, direct=False, signature=viewer.sign(PAUSE, payload, now_ns())),
        link.mark(PAUSE, direct=False, signature=good[:-1]),
        link.mark(PAUSE, direct=False, signature=good[:60]),
        link.mark(PAUSE, direct=False, signature=own.sign(PAUSE, payload, now_ns() - 3600 * 10**9)),
    ]
    for attachment in wrong:
        assert await asyncio.to_thread(ask, raw, PAUSE, payload, attachment) == (b"", "identity"), attachment
    assert paused.asked == []
    attachment = link.mark(PAUSE, direct=False, signature=good)
    assert (await asyncio.to_thread(ask, raw, PAUSE, payload, attachment))[1] == ""
    # Also by somebody else who has heard it.
    other = await fleet.raw(Role.ENGINEER)
    for session in (raw, other):
        assert await asyncio.to_thread(ask, session, PAUSE, payload, attachment) == (b"", "identity")
    assert len(paused.asked) == 1
    assert paused.refused == len(wrong) + 2
    for session in (raw, other):
        await asyncio.to_thread(session.close)


async def test_a_role_is_checked_where_the_order_is_carried_out(fleet: Secured) -> None:
    """An operator's own signature on an engineer's verb is refused, though it came over a gateway's link."""
    plane = fleet.planes["g0"]
    drained: list[DrainAsk] = []

    async def drain(asked: DrainAsk) -> DrainState:
        drained.append(asked)
        return DrainState(gateway="g0", draining=True, done=False, moved=0, ended=0)

    plane.rpc.register(keyspace.DRAIN, drain)
    key, payload = KEYS(keyspace.RPC, "g0", "drain"), encode(DrainAsk())
    relayed = await fleet.raw(Role.GATEWAY)
    for role, code in ((Role.OPERATOR, "identity"), (Role.ENGINEER, "")):
        signature = signer(fleet, role).sign(key, payload, now_ns())
        answer = await asyncio.to_thread(ask, relayed, key, payload, link.mark(key, direct=False, signature=signature))
        assert answer[1] == code
    assert len(drained) == 1
    await asyncio.to_thread(relayed.close)


async def test_whoever_is_revoked_orders_nothing_more(fleet: Secured) -> None:
    """As soon as the gateway has the new roster, on a link that stays open; others go on."""
    fleet.look_often()
    paused = Paused(fleet)
    client = await PlaneClient.open(fleet.client(Role.OPERATOR), fleet=FLEET)
    await client.rpc.call("g0", keyspace.PAUSE, PauseAsk(id="t-1"))
    fleet.authority.revoke(Role.OPERATOR, NAMES[Role.OPERATOR], why="left")
    fleet.hand_out()
    with pytest.raises(IdentityError, match="revoked: left"):
        await client.rpc.call("g0", keyspace.PAUSE, PauseAsk(id="t-2"))
    await fleet.planes["g1"].rpc.call("g0", keyspace.PAUSE, PauseAsk(id="t-3"))
    assert [asked.id for asked, _ in paused.asked] == ["t-1", "t-3"]
    await client.close()


async def test_keys_that_were_issued_since_work_at_once(fleet: Secured) -> None:
    """A new operator needs no restart of a gateway, and no new roster."""
    paused = Paused(fleet)
    out = fleet.folder / "operator-new.pem"
    fleet.authority.issue(Role.OPERATOR, "new", out=out)
    client = await PlaneClient.open(fleet.client(Role.OPERATOR, "new"), fleet=FLEET)
    await client.rpc.call("g0", keyspace.PAUSE, PauseAsk(id="t-1"))
    assert paused.asked[0][0].by == "new"
    await client.close()


async def test_records_are_written_by_engineers_and_gateways(fleet: Secured) -> None:
    """The verbs that write them are signed like orders; an operator learns that he may not."""
    change = RecordChange(key="note/1", value=b"x")
    engineer = await PlaneClient.open(fleet.client(Role.ENGINEER), fleet=FLEET)
    await engineer.rpc.call("g0", keyspace.RECORD_WRITE, change)
    found = await fleet.planes["g1"].dht.read("note/1")
    assert isinstance(found, Record)
    operator = await PlaneClient.open(fleet.client(Role.OPERATOR), fleet=FLEET)
    with pytest.raises(IdentityError, match="who may: engineer"):
        await operator.rpc.call("g0", keyspace.RECORD_WRITE, change)
    for client in (engineer, operator):
        await client.close()


async def test_a_robot_carries_out_what_is_signed(fleet: Secured) -> None:
    """By a gateway or an operator; what anybody else sends over a gateway's link it does not."""
    robot = await Session.open(fleet.client(Role.ROBOT), FLEET)
    done: list[str] = []

    async def command(_: str, payload: bytes) -> bytes:
        sender = SENDER.get()
        done.append(sender.text if sender is not None else "nobody")
        return payload

    key = KEYS(keyspace.COMMAND, "r1")
    robot.serve(key, command, signers=keyspace.COMMAND.asks)
    gateway = fleet.planes["g0"].session

    async def sent() -> bool:
        with contextlib.suppress(SwiftbotError):
            await gateway.query(key, b"go", timeout_s=2.0, sign=True)
        return bool(done)

    while not await sent():
        await asyncio.sleep(0.05)
    with pytest.raises(IdentityError, match="not signed"):
        await gateway.query(key, b"go", timeout_s=2.0)
    assert done == ["gateway g0"]
    await robot.close()


async def test_a_stop_is_carried_out_whoever_asks(fleet: Secured) -> None:
    """Also where the signature is not good, as with a clock that is off; then no certificate names who it was."""
    plane = fleet.planes["g0"]
    stopped: list[tuple[str, Identity | None]] = []

    async def stop(asked: StopAsk) -> StopAnswer:
        stopped.append((asked.by, SENDER.get()))
        return StopAnswer(stops=())

    plane.rpc.register(keyspace.SOFT_STOP, stop)
    key, payload = KEYS(keyspace.RPC, "g0", "soft_stop"), encode(StopAsk(by="vera"))
    raw = await fleet.raw(Role.VIEWER)
    late = signer(fleet, Role.VIEWER).sign(key, payload, now_ns() - 3600 * 10**9)
    for attachment in (None, link.mark(key, direct=False, signature=late)):
        assert (await asyncio.to_thread(ask, raw, key, payload, attachment))[1] == ""
    assert [sender for _, sender in stopped] == [None, None]
    assert plane.session.refused["unverified gw/g0/rpc/soft_stop"] == 2
    await asyncio.to_thread(raw.close)


async def test_nobody_lifts_a_stop_by_telling_of_it(fleet: Secured) -> None:
    """Gateways tell each other which stops are lifted; a viewer or operator who says so is answered, not believed."""
    authority = Authority(fleet.planes["g0"])
    await authority.start()
    stop = SoftStop(id="s-1", by="olga")
    lifted = Lifted(id="l-1", stops=("s-1",))
    told = fleet.planes["g1"].rpc
    await told.call("g0", keyspace.STANDING, StandingAsk(stops=(stop,)))
    for role in (Role.VIEWER, Role.OPERATOR):
        client = await PlaneClient.open(fleet.client(role), fleet=FLEET)
        answer = await client.rpc.call("g0", keyspace.STANDING, StandingAsk(lifted=(lifted,)))
        assert [each.id for each in answer.active] == ["s-1"]
        await client.close()
    answer = await told.call("g0", keyspace.STANDING, StandingAsk(lifted=(lifted,)))
    assert answer.active == ()
    await authority.close()
