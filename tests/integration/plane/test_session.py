"""Session and RPC between real Zenoh sessions on loopback: delivery, errors, and every kind of bad input."""

import asyncio
import contextlib
import gc
import itertools
import time
from collections.abc import AsyncIterator

import msgspec
import pytest
import zenoh
from plane_fleet import until
from plane_pair import LIMIT, heard, linked_pair

from appliance.errors import PayloadError, RefusedError, UnreachableError
from appliance.model import ErrorReply, LogLine, encode, keyspace
from appliance.plane import session
from appliance.plane.session import Message, Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


@pytest.fixture
async def pair(free_port: int) -> AsyncIterator[tuple[Session, Session]]:
    """Two linked peers."""
    async with linked_pair(free_port) as both:
        yield both


async def test_facts_arrive_in_order_on_the_loop(pair: tuple[Session, Session]) -> None:
    """Puts and a delete arrive complete, in order, with the sender's clock and encoding, on the loop's thread."""
    one, other = pair
    seen: list[Message] = []
    closer = other.subscribe("swiftbot/f/x/*", seen.append)
    await heard(one, other)
    for n in range(500):
        one.put("swiftbot/f/x/a", str(n).encode(), encoding="text/plain")
    one.delete("swiftbot/f/x/a")
    await until(lambda: len(seen) == 501)
    assert [message.payload for message in seen[:-1]] == [str(n).encode() for n in range(500)]
    assert seen[-1].deleted
    assert not seen[0].deleted
    assert seen[0].encoding == "text/plain"
    assert all(first.at_ns < later.at_ns for first, later in itertools.pairwise(seen))
    closer.close()
    closer.close()
    one.put("swiftbot/f/x/a", b"late")
    await heard(one, other)
    assert len(seen) == 501


async def test_bad_facts_are_counted_and_dropped(pair: tuple[Session, Session]) -> None:
    """Malformed, mistyped, empty, deeply nested and oversize payloads are counted; good ones before and after count."""
    one, other = pair
    seen: list[tuple[str, LogLine | None]] = []
    other.subscribe_typed(keyspace.LOG, lambda key, value: seen.append((key, value)))
    await heard(one, other)
    good = encode(LogLine(at_ns=1, level="info", source="s", event="e"))
    key = one.keys(keyspace.LOG, "g")
    bad = [b"", b"{", b"\xff\xfe", b"[]", b'{"at_ns": "x"}', b"null", b"[" * 100_000]
    for payload in (good, *bad, good):
        one.put(key, payload)
    one._wire.raw.put(key, b"x" * (LIMIT + 1))  # a foreign client keeps to no limit
    one.delete(key)
    await until(lambda: len(seen) == 3)
    assert [value is None for _, value in seen] == [False, False, True]
    assert other.refused == {"malformed gw/*/log": len(bad), "oversize gw/*/log": 1}


async def test_a_put_on_all_keys_is_a_fact_of_none(pair: tuple[Session, Session]) -> None:
    """A stranger's put or token on `**` reaches every subscription that it matches: counted, and not taken apart."""
    one, other = pair
    seen: list[str] = []
    named = keyspace.LOG.names
    other.subscribe_typed(keyspace.LOG, lambda key, _: seen.append(key), heed=lambda key: bool(named(key)))
    other.watch_alive(other.keys(keyspace.ROBOT_ALIVE), lambda key, _: seen.append(key))
    await heard(one, other)
    one._wire.raw.put(f"{one.keys.root}/**", encode(LogLine(at_ns=1, level="info", source="s", event="e")))
    token = one._wire.raw.liveliness().declare_token(f"{one.keys.root}/**")
    await until(lambda: len(other.refused) == 2)
    token.undeclare()
    one.put(one.keys(keyspace.LOG, "g"), encode(LogLine(at_ns=1, level="info", source="s", event="e")))
    await until(lambda: seen)
    assert seen == [one.keys(keyspace.LOG, "g")]
    assert set(other.refused) == {"wildcard gw/*/log", "wildcard robot/*/alive"}


async def test_facts_that_nobody_wants_are_not_decoded(pair: tuple[Session, Session]) -> None:
    """What is not wanted by its key is neither delivered nor refused, whatever it says."""
    one, other = pair
    seen: list[str] = []
    other.subscribe_typed(keyspace.LOG, lambda key, _: seen.append(key), wanted=lambda key: key.endswith("/b/log"))
    await heard(one, other)
    good = encode(LogLine(at_ns=1, level="info", source="s", event="e"))
    for gateway, payload in (("a", good), ("a", b"{"), ("b", good), ("a", good), ("b", good)):
        one.put(one.keys(keyspace.LOG, gateway), payload)
    await until(lambda: len(seen) == 2)
    assert {key.split("/")[-2] for key in seen} == {"b"}
    assert other.refused == {}


async def test_what_is_not_heeded_does_not_reach_the_loop(pair: tuple[Session, Session]) -> None:
    """Keys that are nobody's business here are left on Zenoh's thread, however large or wrong what they say is."""
    one, other = pair
    seen: list[str] = []
    other.subscribe_typed(keyspace.LOG, lambda key, _: seen.append(key), heed=lambda key: key.endswith("/b/log"))
    await heard(one, other)
    posted = list[object]()
    post = other._wire.inbox.post
    other._wire.inbox.post = lambda *args, **more: posted.append(args) or post(*args, **more)  # type: ignore[method-assign]
    good = encode(LogLine(at_ns=1, level="info", source="s", event="e"))
    for gateway, payload in (("a", good), ("a", b"{"), ("b", good), ("a", good), ("b", good)):
        one.put(one.keys(keyspace.LOG, gateway), payload, express=True)
    one._wire.raw.put(one.keys(keyspace.LOG, "a"), b"x" * (LIMIT + 1))
    one.put(one.keys(keyspace.LOG, "b"), good)
    await until(lambda: len(seen) == 3)
    assert len(posted) == 3
    assert other.refused == {}


async def test_a_flood_is_bounded_and_counted(free_port: int) -> None:
    """What comes in faster than the loop takes it is dropped beyond the bound and counted; afterwards all is well."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    one = await Session.open(PlaneConfig(listen=(endpoint,), queue_messages=100), "f")
    other = await Session.open(PlaneConfig(connect=(endpoint,)), "f")
    seen: list[Message] = []
    one.subscribe("swiftbot/f/x", seen.append)
    await heard(other, one)
    for _ in range(5000):
        other.put("swiftbot/f/x", b"x" * 100)
    while other._wire.outbox.waiting:
        time.sleep(0.01)  # noqa: ASYNC251 - the loop must not turn: it is what is overrun here
    time.sleep(0.2)  # noqa: ASYNC251
    assert len(one._wire.inbox._waiting) == 100
    await until(lambda: one.refused.get("incoming queue full", 0) + len(seen) == 5000)
    seen.clear()
    other.put("swiftbot/f/x", b"after")
    await until(lambda: [message.payload for message in seen] == [b"after"])
    await one.close()
    await other.close()


async def test_an_oversize_put_is_refused_here(pair: tuple[Session, Session]) -> None:
    """A put larger than the limit is counted and not sent; a request raises."""
    one, _ = pair
    one.put("swiftbot/f/x", b"x" * (LIMIT + 1))
    assert one.refused == {"oversize put": 1}
    with pytest.raises(PayloadError, match="at most"):
        await one.query("swiftbot/f/x", b"x" * (LIMIT + 1), timeout_s=1)


@pytest.mark.parametrize("direct", [False, True])
async def test_a_question_that_may_have_been_heard_is_told_from_one_that_went_nowhere(
    pair: tuple[Session, Session], direct: bool
) -> None:
    """The one asked goes away before it answers: it may have done it. Nobody was there: nobody has."""
    one, other = pair
    asked = asyncio.Event()

    async def never(key: str, payload: bytes) -> bytes:
        asked.set()
        await asyncio.Event().wait()
        return payload

    await heard(one, other)  # a link that is only just there may have something asked over it all the same
    with pytest.raises(UnreachableError) as nobody:
        await one.query("swiftbot/f/q", b"x", timeout_s=60, direct=direct)
    assert not nobody.value.sent
    other.serve("swiftbot/f/q", never)
    await heard(one, other)
    session = asyncio.create_task(one.query("swiftbot/f/q", b"x", timeout_s=60, direct=direct))
    await asked.wait()
    # As the death of its process does: nobody hears anything.
    await asyncio.to_thread(other._wire.raw.close)
    with pytest.raises(UnreachableError) as gone:
        await session
    assert gone.value.sent


async def test_a_question_for_another_key_is_refused(pair: tuple[Session, Session]) -> None:
    """A query that Zenoh delivers to the wrong queryable reaches no handler: it is counted and may be asked again."""
    one, other = pair
    reached: list[str] = []

    async def handle(key: str, payload: bytes) -> bytes:
        reached.append(key)
        return payload

    key = other.keys(keyspace.COMMAND, "rover_2")
    other.serve(key, handle)
    await heard(one, other)
    wrong = one.keys(keyspace.COMMAND, "rover_4").encode()
    foreign = await asyncio.to_thread(lambda: list(one._wire.raw.get(key, payload=b"x", attachment=wrong, timeout=5)))
    assert foreign[0].err is not None
    assert msgspec.json.decode(foreign[0].err.payload.to_bytes(), type=ErrorReply).code == "unreachable"
    assert reached == []
    assert other.refused == {"misrouted robot/rover_2/command": 1}
    # The links are made again: what was asked meanwhile may have to be asked again.
    async with asyncio.timeout(20):
        while not reached:
            with contextlib.suppress(UnreachableError):
                assert await one.query(key, b"x", timeout_s=5) == b"x"
    plain = await asyncio.to_thread(lambda: list(one._wire.raw.get(key, payload=b"x", timeout=5)))
    assert plain[0].ok is not None


async def test_too_many_queries_at_once_are_refused(free_port: int) -> None:
    """Beyond `concurrent_queries` a query is answered `refused` at once; the others are answered."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    server = await Session.open(PlaneConfig(listen=(endpoint,), concurrent_queries=2), "f")
    client = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "f")
    go = asyncio.Event()

    async def handle(key: str, payload: bytes) -> bytes:
        await go.wait()
        return payload

    server.serve("swiftbot/f/q", handle)
    await heard(client, server)
    asked = [asyncio.create_task(client.query("swiftbot/f/q", b"x", timeout_s=20)) for _ in range(5)]
    await until(lambda: sum(each.done() for each in asked) == 3)
    go.set()
    results = await asyncio.gather(*asked, return_exceptions=True)
    assert sum(isinstance(each, RefusedError) for each in results) == 3
    assert sum(each == b"x" for each in results) == 2
    await client.close()
    await server.close()


async def test_closing_ends_what_is_under_way(free_port: int) -> None:
    """When the answering side closes, its caller hears at once; when the asking side closes, its own wait ends."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    server = await Session.open(PlaneConfig(listen=(endpoint,)), "f")
    client = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "f")
    begun = asyncio.Event()

    async def handle(key: str, payload: bytes) -> bytes:
        begun.set()
        await asyncio.Event().wait()
        return b""

    server.serve("swiftbot/f/q", handle)
    await heard(client, server)
    first = asyncio.create_task(client.query("swiftbot/f/q", b"", timeout_s=60))
    await begun.wait()
    await server.close()
    await server.close()
    with pytest.raises(UnreachableError):
        await first
    waiting = asyncio.create_task(client.query("swiftbot/f/q", b"", timeout_s=60))
    await asyncio.sleep(0)
    await client.close()
    with pytest.raises(UnreachableError):
        await waiting
    with pytest.raises(UnreachableError):
        await client.query("swiftbot/f/q", b"", timeout_s=1)


async def test_everybody_is_asked(pair: tuple[Session, Session]) -> None:
    """`query_all` returns each answer with its key, and leaves errors out."""
    one, other = pair

    async def good(key: str, payload: bytes) -> bytes:
        return payload + b"!"

    async def bad(key: str, payload: bytes) -> bytes:
        raise RefusedError("no")

    one.serve("swiftbot/f/all/one", good)
    other.serve("swiftbot/f/all/two", good)
    other.serve("swiftbot/f/all/three", bad)
    await heard(one, other)
    answers = await one.query_all("swiftbot/f/all/*", b"hi", timeout_s=5)
    assert {(each.key, each.payload) for each in answers} == {
        ("swiftbot/f/all/one", b"hi!"), ("swiftbot/f/all/two", b"hi!"),
    }  # fmt: skip


async def test_answers_to_everybody_are_bounded(free_port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more answers than are taken, by number or bytes, the rest is left out and counted; one has one."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    one = await Session.open(PlaneConfig(listen=(endpoint,), queue_bytes=2**20), "f")
    other = await Session.open(PlaneConfig(connect=(endpoint,)), "f")
    monkeypatch.setattr(session, "MOST_ANSWERS", 20)

    def many(query: zenoh.Query) -> None:
        payload = query.payload.to_bytes() if query.payload is not None else b""
        with query:
            for number in range(50):
                query.reply(f"swiftbot/f/many/{number}" if payload else "swiftbot/f/many/0", payload or b"%d" % number)

    handler = zenoh.handlers.Callback(many, indirect=False)
    queryable = other._wire.raw.declare_queryable("swiftbot/f/many/*", handler, complete=True)
    await heard(one, other)
    few = await one.query_all("swiftbot/f/many/*", b"x", timeout_s=20)
    assert len({each.key for each in few}) == 20
    await until(lambda: one.refused == {"answers beyond the limit": 30})
    heavy = await one.query_all("swiftbot/f/many/*", b"x" * 200_000, timeout_s=20)
    assert len(heavy) == 5
    await until(lambda: one.refused == {"answers beyond the limit": 75})
    assert await one.query("swiftbot/f/many/0", b"", timeout_s=20) == b"0"
    assert one.refused == {"answers beyond the limit": 75}
    queryable.undeclare()
    await other.close()
    await one.close()


async def test_tokens_are_seen_by_those_who_come_later(pair: tuple[Session, Session]) -> None:
    """A token is seen with history, listed on demand, and its end is seen."""
    one, other = pair
    token = one.declare_alive(one.keys(keyspace.GATEWAY_ALIVE, "a"))
    seen: list[tuple[str, bool]] = []
    key = one.keys(keyspace.GATEWAY_ALIVE, "a")
    while await other.alive_now(other.keys(keyspace.GATEWAY_ALIVE)) != [key]:
        await asyncio.sleep(0.01)
    other.watch_alive(other.keys(keyspace.GATEWAY_ALIVE), lambda each, alive: seen.append((each, alive)))
    await until(lambda: seen == [(key, True)])
    token.close()
    await until(lambda: seen == [(key, True), (key, False)])


async def test_a_token_lasts_though_nobody_holds_it(pair: tuple[Session, Session]) -> None:
    """A token whose Closer was thrown away stays until the session ends."""
    one, other = pair
    one.declare_alive(one.keys(keyspace.GATEWAY_ALIVE, "a"))
    gc.collect()
    seen: list[bool] = []
    other.watch_alive(other.keys(keyspace.GATEWAY_ALIVE), lambda _, alive: seen.append(alive))
    await until(lambda: seen)
    assert await other.alive_now(other.keys(keyspace.GATEWAY_ALIVE)) == [one.keys(keyspace.GATEWAY_ALIVE, "a")]
    await one.close()
    await until(lambda: seen == [True, False])


async def test_a_key_that_is_put_often_has_a_publisher(pair: tuple[Session, Session]) -> None:
    """Its puts arrive in order with those of others, numbered; those too large are counted; closed it puts no more."""
    other, one = pair
    seen: list[tuple[str, bytes]] = []
    one.subscribe("swiftbot/f/**", lambda message: seen.append((message.key, message.payload)))
    await heard(other, one)
    seen.clear()
    before = other._wire.backlog.last
    publisher = other.publisher("swiftbot/f/often", "application/mavlink")
    for number in range(200):
        publisher.put(b"%d" % number)
        other.put("swiftbot/f/seldom", b"%d" % number)
    publisher.put(b"x" * (LIMIT + 1))
    publisher.close()
    other.put("swiftbot/f/last", b"")
    await until(lambda: seen and seen[-1][0] == "swiftbot/f/last")
    expected = [(f"swiftbot/f/{key}", b"%d" % number) for number in range(200) for key in ("often", "seldom")]
    assert seen[:-1] == expected
    assert other._wire.backlog.last == before + 401
    assert other.refused == {"oversize put": 1}
