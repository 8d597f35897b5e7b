"""Wrong doors between real Zenoh sessions: whose links are made again, and whose are not."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Callable

import msgspec
import pytest
import zenoh

from appliance.errors import SwiftbotError, UnreachableError
from appliance.plane import link
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


async def _until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.01)


@pytest.fixture
async def three(free_port: int) -> AsyncIterator[tuple[Session, Session, Session]]:
    """A gateway's session, and two that are linked to it alone."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    hub = await Session.open(PlaneConfig(listen=(endpoint,)), "f")
    one = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "f")
    other = await Session.open(PlaneConfig(mode="client", connect=(endpoint,)), "f")
    await _until(lambda: len(_links(hub)) == 2)
    yield hub, one, other
    for each in (other, one, hub):
        await each.close()


def _links(session: Session) -> set[tuple[str, str]]:
    """The ends of a session's links: other ones after a link was made again."""
    return {(each.src, each.dst) for each in session._wire.raw.info.links()}


async def _ask(session: Session, key: str) -> bytes:
    """Ask until there is an answer: a link may be under way."""
    while True:
        with contextlib.suppress(SwiftbotError):
            return await session.query(key, b"x", timeout_s=5)
        await asyncio.sleep(0.02)


def _wrongly(session: Session, source: zenoh.SourceInfo | None) -> list[str]:
    """Ask with a wrong key attached, as the session that is named; returns the codes of the answers."""
    wrong = link.mark("swiftbot/f/else", direct=False)
    answers = session._wire.raw.get("swiftbot/f/q", payload=b"", attachment=wrong, source_info=source, timeout=5)
    return [msgspec.json.decode(each.err.payload.to_bytes())["code"] for each in answers if each.err is not None]


async def _echo(key: str, payload: bytes) -> bytes:
    return payload


async def test_wrong_keys_break_nobodys_links(three: tuple[Session, Session, Session]) -> None:
    """A client that attaches wrong keys, in its own name, in another's and in nobody's, is refused and breaks nothing.

    Connections of the same process to others, such as a vehicle, stay as well.
    """
    hub, one, other = three
    hub.serve("swiftbot/f/q", _echo)
    assert await _ask(one, "swiftbot/f/q") == b"x"
    before = _links(hub)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as vehicle,
        server.accept()[0] as accepted,
    ):
        for asker in (one, other, hub, None, *(one for _ in range(10))):
            source = None if asker is None else zenoh.SourceInfo(asker._wire.raw.id, 0)
            for _ in range(3):
                assert await asyncio.to_thread(_wrongly, one, source) == ["unreachable"]
        await asyncio.sleep(0.2)
        assert _links(hub) == before
        assert await other.query("swiftbot/f/q", b"y", timeout_s=5) == b"y"
        vehicle.sendall(b"z")
        assert accepted.recv(1) == b"z"
    assert hub.refused["misrouted q"] == 42


async def test_who_asked_makes_that_one_link_anew(three: tuple[Session, Session, Session]) -> None:
    """A gateway whose question came to a wrong door replaces the link with the one that answered, and no other."""
    hub, one, other = three

    async def wrong(key: str, payload: bytes) -> bytes:
        raise UnreachableError(f"{key}: {link.WRONG_DOOR}")

    closer = one.serve("swiftbot/f/one", wrong)
    other.serve("swiftbot/f/other", _echo)
    assert await _ask(hub, "swiftbot/f/other") == b"x"
    before = _links(hub)
    at_other = _links(other)
    while _links(hub) & before == before:
        with contextlib.suppress(SwiftbotError):
            await hub.query("swiftbot/f/one", b"", timeout_s=5)
        await asyncio.sleep(0.02)
    closer.close()
    one.serve("swiftbot/f/one", _echo)
    assert await _ask(hub, "swiftbot/f/one") == b"x"
    assert _links(other) == at_other
    assert await hub.query("swiftbot/f/other", b"y", timeout_s=5) == b"y"


async def test_whoever_doubts_its_own_links_makes_all_of_them_anew(three: tuple[Session, Session, Session]) -> None:
    """After that the others are linked as before, by other links, and are answered."""
    hub, one, other = three
    hub.serve("swiftbot/f/q", _echo)
    assert await _ask(one, "swiftbot/f/q") == b"x"
    before = _links(hub)
    assert len(before) == 2
    hub.renew_links("a test does so")
    await _until(lambda: len(_links(hub)) == 2 and not _links(hub) & before)
    for each in (one, other):
        assert await _ask(each, "swiftbot/f/q") == b"x"
