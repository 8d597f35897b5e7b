"""Direct questions between real Zenoh sessions: plain messages, what a query would tell, and every bad input."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

import asyncio
import contextlib
from collections.abc import AsyncIterator
from types import SimpleNamespace

import msgspec
import pytest
import zenoh
from plane_fleet import until
from plane_pair import heard, linked_pair

from appliance.errors import DeadlineError, PlanError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import ErrorReply
from appliance.plane import direct, link
from appliance.plane.session import Answer, Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio

KEY = "swiftbot/f/gw/b/rpc/ask"
DOOR = "swiftbot/f/gw/b/rpc/@direct"


@pytest.fixture
async def pair(free_port: int) -> AsyncIterator[tuple[Session, Session]]:
    """Two linked peers."""
    async with linked_pair(free_port) as sessions:
        yield sessions


class _Door:
    """What comes to the door of the one that is asked, and what it says of itself."""

    def __init__(self, listener: Session) -> None:
        self.came: list[tuple[bytes, str]] = []
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscriber = listener._wire.raw.declare_subscriber(DOOR, handler)

    def _take(self, sample: zenoh.Sample) -> None:
        attached = sample.attachment.to_string() if sample.attachment is not None else ""
        self.came.append((sample.payload.to_bytes(), attached))

    async def known(self, asker: Session) -> None:
        """Ask until a message comes."""
        while not self.came:
            with contextlib.suppress(SwiftbotError):
                await asker.query(KEY, b"first", timeout_s=5, direct=True)
            await asyncio.sleep(0.01)

    async def heard(self, payload: bytes) -> str:
        """What a message said of itself, once it has come."""
        while payload not in dict(self.came):
            await asyncio.sleep(0.01)
        return dict(self.came)[payload]


async def _echo(key: str, payload: bytes) -> bytes:
    return payload


async def test_a_direct_question_is_a_message(pair: tuple[Session, Session]) -> None:
    """It comes to the door, is answered, and whoever listens to everything is sent neither; large ones are queries."""
    one, other = pair
    everything = list[str]()
    for each in pair:
        each.subscribe("swiftbot/f/**", lambda message: everything.append(message.key))
    other.serve(KEY, _echo, direct=True)
    door = _Door(other)
    await door.known(one)
    assert await one.query(KEY, b"hello", timeout_s=5, direct=True) == b"hello"
    number, session, key = (await door.heard(b"hello")).split(" ")
    assert number.isdigit()
    assert session == str(one._wire.raw.zid())
    assert key == KEY
    large = b"x" * (link.MOST_DIRECT + 1)
    assert await one.query(KEY, large, timeout_s=5, direct=True) == large
    assert await one.query(KEY, b"y", timeout_s=5) == b"y"
    assert await one.query(KEY, b"last", timeout_s=5, direct=True) == b"last"
    await door.heard(b"last")
    assert not {large, b"y"} & dict(door.came).keys()
    one.put("swiftbot/f/after", b"")
    await until(lambda: everything.count("swiftbot/f/after") == 2)
    assert not [key for key in everything if "@" in key]
    assert not one._asking._direct._waiting


async def test_what_a_query_tells_a_message_tells(pair: tuple[Session, Session]) -> None:
    """Errors come with all they say, an answer too large for a message comes by a query, what is late is not heard."""
    one, other = pair
    go = asyncio.Event()
    large = b"y" * (link.MOST_DIRECT + 1)

    async def handle(key: str, payload: bytes) -> bytes:
        match payload:
            case b"refuse":
                raise RefusedError("no room", remedy="wait", retry_after_s=2.5)
            case b"plan":
                raise PlanError("a bad plan", problems=("one", "two"))
            case b"defect":
                raise ZeroDivisionError
            case b"slow":
                await go.wait()
                return b"late"
            case _:
                return large

    other.serve(KEY, handle, direct=True)
    door = _Door(other)
    await door.known(one)
    with pytest.raises(RefusedError, match="no room") as refused:
        await one.query(KEY, b"refuse", timeout_s=5, direct=True)
    assert (refused.value.remedy, refused.value.retry_after_s) == ("wait", 2.5)
    with pytest.raises(PlanError) as plan:
        await one.query(KEY, b"plan", timeout_s=5, direct=True)
    assert plan.value.problems == ("one", "two")
    with pytest.raises(SwiftbotError, match="ZeroDivisionError"):
        await one.query(KEY, b"defect", timeout_s=5, direct=True)
    with pytest.raises(DeadlineError):
        await one.query(KEY, b"slow", timeout_s=0.05, direct=True)
    go.set()
    assert await one.query(KEY, b"large", timeout_s=5, direct=True) == large
    for payload in (b"refuse", b"plan", b"defect", b"slow", b"large"):
        await door.heard(payload)
    assert not one._asking._direct._waiting


async def test_whoever_goes_ends_what_waits_for_it(pair: tuple[Session, Session]) -> None:
    """Nobody there: nobody has heard it. Gone before the answer: it may have been done."""
    one, other = pair
    asked = asyncio.Event()

    async def handle(key: str, payload: bytes) -> bytes:
        if payload == b"never":
            asked.set()
            await asyncio.Event().wait()
        return payload

    await heard(one, other)  # a link that is only just there may have something asked over it all the same
    with pytest.raises(UnreachableError) as nobody:
        await one.query(KEY, b"x", timeout_s=60, direct=True)
    assert not nobody.value.sent
    other.serve(KEY, handle, direct=True)
    door = _Door(other)
    await door.known(one)
    asking = asyncio.create_task(one.query(KEY, b"never", timeout_s=60, direct=True))
    await asked.wait()
    await door.heard(b"never")
    # As the death of its process does: nobody is told anything.
    await asyncio.to_thread(other._wire.raw.close)
    with pytest.raises(UnreachableError) as gone:
        await asking
    assert gone.value.sent
    assert not one._asking._direct._waiting
    with pytest.raises(UnreachableError):
        await one.query(KEY, b"x", timeout_s=60, direct=True)


async def test_whoever_is_known_to_listen_is_looked_for_again_in_doubt(pair: tuple[Session, Session]) -> None:
    """Nobody is looked for before each question; a notice that never came costs one question its time, not each."""
    one, other = pair
    go = asyncio.Event()

    async def handle(key: str, payload: bytes) -> bytes:
        await go.wait()
        return payload

    closer = other.serve(KEY, handle, direct=True)
    door = _Door(other)
    go.set()
    await door.known(one)
    way = one._asking._direct._ways[DOOR]
    assert await one.query(KEY, b"x", timeout_s=5, direct=True) == b"x"
    assert way._listened
    go.clear()
    with pytest.raises(DeadlineError):
        await one.query(KEY, b"late", timeout_s=0.05, direct=True)
    assert not way._listened
    go.set()
    assert await one.query(KEY, b"y", timeout_s=5, direct=True) == b"y"
    assert way._listened
    closer.close()
    door._subscriber.undeclare()
    await until(lambda: not way.open)
    assert not way._listened
    way._listened = True
    with pytest.raises(DeadlineError):
        await one.query(KEY, b"x", timeout_s=0.05, direct=True)
    with pytest.raises(UnreachableError) as nobody:
        await one.query(KEY, b"x", timeout_s=60, direct=True)
    assert not nobody.value.sent


async def test_what_is_told_while_it_is_looked_is_the_newer(
    pair: tuple[Session, Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look that ends after the notice that nobody listens any more leaves nothing behind that says otherwise."""
    one, other = pair
    other.serve(KEY, _echo, direct=True)
    await _Door(other).known(one)
    way = one._asking._direct._ways[DOOR]
    gone = SimpleNamespace(matching=False)

    class Slow:
        """A publisher whose look is overtaken by a notice."""

        @property
        def matching_status(self) -> SimpleNamespace:
            way._changed(gone)  # pyright: ignore[reportArgumentType]
            return SimpleNamespace(matching=True)

    way.doubt()
    with monkeypatch.context() as patched:
        patched.setattr(way, "_publisher", Slow())
        assert way.open
        assert not way._listened
    assert way.open
    assert way._listened


async def test_a_message_at_the_wrong_door_is_asked_again(pair: tuple[Session, Session]) -> None:
    """What is meant for another key reaches no handler, is counted, and its empty answer has it asked as a query."""
    one, other = pair
    reached = list[bytes]()

    async def handle(key: str, payload: bytes) -> bytes:
        reached.append(payload)
        return payload

    other.serve(KEY, handle, direct=True)
    await _Door(other).known(one)
    reached.clear()
    way = one._asking._direct._ways[DOOR]
    put = way.put

    def astray(payload: bytes, attachment: bytes) -> None:
        put(payload, attachment=attachment.replace(b"/gw/b/", b"/gw/c/"))

    way.put = astray  # pyright: ignore[reportAttributeAccessIssue]
    assert await one.query(KEY, b"x", timeout_s=5, direct=True) == b"x"
    assert reached == [b"x"]
    assert other.refused == {"misrouted gw/b/rpc/@direct": 1}
    way.put = put


async def test_bad_messages_reach_no_handler(pair: tuple[Session, Session]) -> None:
    """Questions that do not say whose they are, are too large or say they are of a wildcard, and forged answers."""
    one, other = pair
    reached = list[bytes]()
    answers = list[bytes]()

    async def handle(key: str, payload: bytes) -> bytes:
        reached.append(payload)
        return payload

    def at_once(payload: bytes, answer: Answer) -> bool:
        return False

    other.serve(KEY, handle, direct=True, at_once=at_once)
    await _Door(other).known(one)
    reached.clear()
    raw = one._wire.raw
    session = raw.declare_subscriber(
        "swiftbot/f/@answers/abc",
        zenoh.handlers.Callback(lambda sample: answers.append(sample.payload.to_bytes()), indirect=False),
    )
    for attached in (
        None, b"", b"x", b"1", b"1 ", b"-1 abc k", b"1 * k", b"1 a/b k", b"1 ABC k", b"1 " + b"a" * 33 + b" k",
        b"9" * 40 + b" abc k",
    ):  # fmt: skip
        raw.put(DOOR, b"x", attachment=attached)
    await until(lambda: other.refused.get("malformed gw/b/rpc/@direct") == 11)
    raw.put(DOOR, b"x" * (link.MOST_DIRECT + 1), attachment=f"7 abc {KEY}".encode())
    await until(lambda: answers)
    assert msgspec.json.decode(answers[0], type=ErrorReply).code == "payload"
    assert other.refused["oversize gw/b/rpc/ask"] == 1
    assert reached == []
    mine = f"swiftbot/f/@answers/{raw.zid()}"
    for attached in (None, b"", b"+", b"+1", b"-1", b"+x", b"?5", b"+" + b"9" * 5000):
        other._wire.raw.put(mine, b"forged", attachment=attached)
    assert await one.query(KEY, b"x", timeout_s=5, direct=True) == b"x"
    assert reached == [b"x"]
    session.undeclare()


async def test_a_client_of_a_gateway_asks_by_queries(free_port: int) -> None:
    """Where something stands between, a direct question is a query, and answered as any."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    hub = await Session.open(PlaneConfig(listen=(endpoint,)), "f")
    client = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "f")
    hub.serve(KEY, _echo, direct=True)
    door = _Door(hub)
    answer = b""
    while not answer:
        with contextlib.suppress(SwiftbotError):
            answer = await client.query(KEY, b"x", timeout_s=5, direct=True)
    assert answer == b"x"
    assert not door.came
    await client.close()
    await hub.close()


async def test_ways_are_bounded(pair: tuple[Session, Session], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more doors than are kept the oldest is forgotten; a question that waits there ends, and new ones go on."""
    one, other = pair
    monkeypatch.setattr(direct, "_MOST_WAYS", 2)
    asked = asyncio.Event()

    async def handle(key: str, payload: bytes) -> bytes:
        if payload == b"never":
            asked.set()
            await asyncio.Event().wait()
        return payload

    other.serve(KEY, handle, direct=True)
    await _Door(other).known(one)
    asking = asyncio.create_task(one.query(KEY, b"never", timeout_s=60, direct=True))
    await asked.wait()
    for number in range(3):
        with pytest.raises(UnreachableError):
            await one.query(f"swiftbot/f/gw/{number}/rpc/ask", b"x", timeout_s=60, direct=True)
    with pytest.raises(UnreachableError) as gone:
        await asking
    assert gone.value.sent
    assert len(one._asking._direct._ways) == 2
    assert await one.query(KEY, b"x", timeout_s=5, direct=True) == b"x"
