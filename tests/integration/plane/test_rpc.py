"""Verbs of a gateway between real Zenoh sessions: answers, errors, bad input, and what other Zenoh clients see."""

import asyncio
import json
from collections.abc import AsyncIterator

import msgspec
import pytest
from plane_fleet import until
from plane_pair import LIMIT, heard, linked_pair
from structlog.testing import capture_logs

from appliance.errors import (
    ConfigError,
    DeadlineError,
    PayloadError,
    PlanError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import ErrorReply, Need, encode, keyspace
from appliance.model.keys import Verb
from appliance.model.plane_api import Exchange
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session

pytestmark = pytest.mark.anyio

NEED = Verb("need", Need, Need, "a verb of these tests")
QUIET = Verb("quiet", Need, Need, "the same, without exchange", exchange=False)
OTHER = Verb("need", Need, ErrorReply, "the same with another reply")
NOTHING = Verb("nothing", Need, Need, "nobody answers it")


@pytest.fixture
async def pair(free_port: int) -> AsyncIterator[tuple[Session, Session]]:
    """Two linked peers."""
    async with linked_pair(free_port) as both:
        yield both


async def _echo(need: Need) -> Need:
    return need


async def _get(session: Session, expr: str, **more: bytes) -> list[tuple[str, str]]:
    """Ask as any Zenoh client does; returns the key of each answer and what it says, or the code of its error."""
    found: list[tuple[str, str]] = []
    for reply in await asyncio.to_thread(lambda: list(session._wire.raw.get(expr, timeout=5, **more))):
        if reply.ok is not None:
            found.append((str(reply.ok.key_expr), reply.ok.payload.to_string()))
        else:
            found.append(("", msgspec.json.decode(reply.err.payload.to_bytes(), type=ErrorReply).code))
    return sorted(found)


async def test_requests_and_their_errors(pair: tuple[Session, Session]) -> None:
    """A verb answers; each error comes back as the class that was raised, a defect as `internal`."""
    one, other = pair
    caller, server = Rpc(one, "a"), Rpc(other, "b")

    async def handle(need: Need) -> Need:
        if need.image == "refuse":
            raise RefusedError("no", remedy="later")
        if need.image == "plan":
            raise PlanError("none", problems=("p1", "p2"))
        if need.image == "defect":
            raise ZeroDivisionError("oh")
        if need.image == "slow":
            await asyncio.sleep(30)
        return need

    server.register(NEED, handle)
    while True:  # until the queryable is known over there
        try:
            assert await caller.call("b", NEED, Need(image="x")) == Need(image="x")
            break
        except UnreachableError:
            await asyncio.sleep(0.01)
    with pytest.raises(RefusedError, match=r"no \(later\)"):
        await caller.call("b", NEED, Need(image="refuse"))
    with pytest.raises(PlanError) as caught:
        await caller.call("b", NEED, Need(image="plan"))
    assert caught.value.problems == ("p1", "p2")
    with pytest.raises(SwiftbotError, match="ZeroDivisionError: oh") as defect:
        await caller.call("b", NEED, Need(image="defect"))
    assert defect.value.code == "internal"
    with pytest.raises(DeadlineError):
        await caller.call("b", NEED, Need(image="slow"), timeout_s=0.1)
    with pytest.raises(UnreachableError):
        await caller.call("b", NOTHING, Need(image="x"))
    with pytest.raises(PayloadError, match="no ErrorReply"):
        await caller.call("b", OTHER, Need(image="x"))
    with pytest.raises(ConfigError):
        server.register(NEED, handle)


async def test_bad_requests_are_answered_with_the_reason(pair: tuple[Session, Session]) -> None:
    """Malformed and oversize requests get an ErrorReply of code `payload`, are counted, and reach no handler."""
    one, other = pair
    server = Rpc(other, "b")
    reached: list[Need] = []

    async def handle(need: Need) -> Need:
        reached.append(need)
        return need

    server.register(NEED, handle)
    key = one.keys(keyspace.RPC, "b", "need")
    await heard(one, other)
    bad = [b"", b"{", b"\xff", b"[]", b'{"image": 5}', b"[" * 100_000]
    for payload in bad:
        with pytest.raises(PayloadError, match="not a Need"):
            await one.query(key, payload, timeout_s=5)
    foreign = await asyncio.to_thread(lambda: list(one._wire.raw.get(key, payload=b"x" * (LIMIT + 1), timeout=5)))
    assert len(foreign) == 1
    assert foreign[0].err is not None
    assert msgspec.json.decode(foreign[0].err.payload.to_bytes(), type=ErrorReply).code == "payload"
    assert reached == []
    assert other.refused == {"malformed gw/b/rpc/need": len(bad), "oversize gw/b/rpc/need": 1}
    assert await one.query(key, b'{"image": "x"}', timeout_s=5) == b'{"image":"x"}'


async def test_exchanges_can_be_watched(pair: tuple[Session, Session]) -> None:
    """Each exchange is put: request and reply as JSON, what is too large by digest, errors by code."""
    one, other = pair
    seen: list[Exchange | None] = []
    one.subscribe_typed(keyspace.EXCHANGE, lambda _, exchange: seen.append(exchange))
    server = Rpc(other, "b")

    async def handle(need: Need) -> Need:
        return Need(image="y" * 40_000) if need.image == "large" else need

    async def quiet(need: Need) -> Need:
        return need

    server.register(NEED, handle)
    server.register(QUIET, quiet)
    await heard(other, one)
    await heard(one, other)
    caller = Rpc(one, "a")
    await caller.call("b", QUIET, Need(image="x"))
    await caller.call("b", NEED, Need(image="x"))
    await caller.call("b", NEED, Need(image="large"))
    with pytest.raises(PayloadError):
        await one.query(one.keys(keyspace.RPC, "b", "need"), b"\xff{", timeout_s=5)
    await until(lambda: len(seen) == 3)
    small, large, malformed = (json.loads(encode(each)) for each in seen)
    assert (small["verb"], small["gateway"], small["request"], small["reply"]) == (
        "need", "b", {"image": "x"}, {"image": "x"},
    )  # fmt: skip
    assert small["duration_ms"] >= 0
    assert large["reply"]["bytes"] > 40_000
    assert len(large["reply"]["sha256"]) == 64
    assert malformed["error"]["code"] == "payload"
    assert isinstance(malformed["request"], str)


async def test_other_zenoh_clients_ask_a_verb_of_one_gateway_or_of_all(pair: tuple[Session, Session]) -> None:
    """Each that is asked answers under its own key; nobody says what a wildcard in place of the verb would be."""
    one, other = pair
    for session, name in ((one, "a"), (other, "b")):
        Rpc(session, name).register(NEED, _echo)
    await heard(one, other)
    asked = b'{"image":"x"}'
    assert await _get(one, "swiftbot/f/gw/b/rpc/need", payload=asked) == [("swiftbot/f/gw/b/rpc/need", asked.decode())]
    assert await _get(one, "swiftbot/f/gw/*/rpc/need", payload=asked) == [
        ("swiftbot/f/gw/a/rpc/need", asked.decode()), ("swiftbot/f/gw/b/rpc/need", asked.decode()),
    ]  # fmt: skip
    for expr in ("swiftbot/f/gw/b/rpc/nothing", "swiftbot/f/gw/b/rpc/*", "swiftbot/f/gw/b/**"):
        assert await _get(one, expr, payload=asked) == [("", "unreachable")]
    assert other.refused == {}


async def test_a_verb_that_was_meant_for_another_key_is_refused(pair: tuple[Session, Session]) -> None:
    """Whether the key it came by is a verb's or nobody's: no handler is reached, and it is counted."""
    one, other = pair
    reached: list[Need] = []

    async def handle(need: Need) -> Need:
        reached.append(need)
        return need

    Rpc(other, "b").register(NEED, handle)
    await heard(one, other)
    for verb in ("need", "nothing"):
        for meant in (b"swiftbot/f/gw/b/rpc/other", b"swiftbot/f/robot/r/need", b"\xff"):
            key = f"swiftbot/f/gw/b/rpc/{verb}"
            assert await _get(one, key, payload=b'{"image":"x"}', attachment=meant) == [("", "unreachable")]
    assert reached == []
    assert other.refused == {"misrouted gw/b/rpc/need": 3, "misrouted gw/b/rpc": 3}


async def test_whoever_serves_no_more_is_as_if_it_was_not_there(pair: tuple[Session, Session]) -> None:
    """Its verbs are gone with it, however they are asked; another may serve them then."""
    one, other = pair
    server, caller = Rpc(other, "b"), Rpc(one, "a")
    server.register(NEED, _echo)
    await heard(one, other)
    for direct in (False, True):
        assert await caller.call("b", NEED, Need(image="x"), direct=direct) == Need(image="x")
    server.close()
    await heard(one, other)
    for direct in (False, True):
        with pytest.raises(UnreachableError) as nobody:
            await caller.call("b", NEED, Need(image="x"), direct=direct)
        assert not nobody.value.sent
    Rpc(other, "b").register(NEED, _echo)
    await heard(one, other)
    for direct in (False, True):
        assert await caller.call("b", NEED, Need(image="x"), direct=direct) == Need(image="x")


async def test_a_gateway_calls_its_own_verbs_without_a_message(pair: tuple[Session, Session]) -> None:
    """Answers and errors are those of another gateway; nobody sees an exchange, and the work outlives its caller."""
    one, other = pair
    rpc, exchanges, ended = Rpc(one, "a"), list[str](), asyncio.Event()
    other.subscribe(other.keys(keyspace.EXCHANGE), lambda message: exchanges.append(message.key))
    await heard(one, other)

    async def handle(need: Need) -> Need:
        if need.image == "refuse":
            raise RefusedError("no", remedy="later")
        if need.image == "defect":
            raise ZeroDivisionError("oh")
        if need.image == "slow":
            await asyncio.sleep(0.1)
            ended.set()
        return need

    rpc.register(NEED, handle)
    assert await rpc.call("a", NEED, Need(image="x")) == Need(image="x")
    with pytest.raises(RefusedError, match=r"no \(later\)"):
        await rpc.call("a", NEED, Need(image="refuse"))
    with pytest.raises(SwiftbotError, match="ZeroDivisionError: oh") as defect:
        await rpc.call("a", NEED, Need(image="defect"))
    assert defect.value.code == "internal"
    with pytest.raises(PayloadError, match="no ErrorReply"):
        await rpc.call("a", OTHER, Need(image="x"))
    with pytest.raises(DeadlineError):
        await rpc.call("a", NEED, Need(image="slow"), timeout_s=0.01)
    await asyncio.wait_for(ended.wait(), 10)
    await asyncio.sleep(0.1)
    assert exchanges == []


async def test_a_handler_that_is_stopped_cancels_no_caller_of_its_own_gateway(pair: tuple[Session, Session]) -> None:
    """What it waits for is cancelled, or the plane closes: `unreachable`, as of another gateway."""
    one, _ = pair
    rpc = Rpc(one, "a")

    async def handle(need: Need) -> Need:
        if need.image == "stopped":
            raise asyncio.CancelledError
        await asyncio.Event().wait()
        return need

    rpc.register(NEED, handle)
    with pytest.raises(UnreachableError, match="stopping"):
        await rpc.call("a", NEED, Need(image="stopped"))
    waiting = asyncio.create_task(rpc.call("a", NEED, Need(image="x")))
    await asyncio.sleep(0)
    rpc.close()
    with pytest.raises(UnreachableError, match="stopping"):
        await asyncio.wait_for(waiting, 2)


async def test_a_defect_is_logged_though_its_caller_has_gone(pair: tuple[Session, Session]) -> None:
    """A handler that fails after the deadline, or whose caller was cancelled, says so once."""
    one, _ = pair
    rpc, go = Rpc(one, "a"), asyncio.Event()

    async def handle(need: Need) -> Need:
        await go.wait()
        raise ZeroDivisionError(need.image) if need.image == "defect" else RefusedError("no")

    rpc.register(NEED, handle)
    calls = [asyncio.create_task(rpc.call("a", NEED, Need(image=each))) for each in ("defect", "refused")]
    await asyncio.sleep(0)
    for call in calls:
        call.cancel()
    await asyncio.gather(*calls, return_exceptions=True)
    with capture_logs() as logged:
        go.set()
        await until(lambda: not rpc._local_calls)
    assert [line["verb"] for line in logged if line["event"] == "a verb's handler failed"] == ["need"]
