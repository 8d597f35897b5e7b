"""The live view: a page of another site in an operator's browser does not see the fleet through it."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator

import aiohttp
import pytest

from appliance.errors import ConfigError
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.record.foxglove_bridge import LiveOptions, viewing

pytestmark = pytest.mark.anyio
PROTOCOL = "foxglove.sdk.v1"


@pytest.fixture
async def viewer(anyio_backend: str, free_port: int) -> AsyncIterator[Session]:
    """A session for the view."""
    session = await Session.open(PlaneConfig(mode="peer", listen=(f"tcp/127.0.0.1:{free_port}",)), "fox1")
    yield session
    await session.close()


@pytest.mark.parametrize(
    ("origin", "served"),
    [
        (None, True),  # a program
        ("http://localhost:8080", True),
        ("http://127.0.0.1:3000", True),
        ("https://app.foxglove.dev", True),
        ("https://APP.foxglove.dev", True),
        ("https://evil.example", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://127.0.0.1.evil.example", False),
        ("http://localhost@evil.example", False),
        ("null", False),
        ("file://", False),
        ("", False),
    ],
)
async def test_pages_of_other_sites_are_not_served(viewer: Session, origin: str | None, served: bool) -> None:
    """A real client of the protocol with the Origin that a browser would send; what is refused is counted."""
    options = LiveOptions(port=0, origins=("https://app.foxglove.dev",))
    async with viewing(viewer, options) as (_, gate, port), aiohttp.ClientSession() as http:
        connecting = http.ws_connect(f"ws://127.0.0.1:{port}", protocols=[PROTOCOL], origin=origin)
        if served:
            async with connecting as socket:
                assert socket.protocol == PROTOCOL
                assert json.loads((await socket.receive()).data)["op"] == "serverInfo"
        else:
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await connecting
            assert refused.value.status == 403
        assert gate.refused.total() == (not served)


async def test_what_is_behind_the_gate_is_for_no_browser(viewer: Session) -> None:
    """Its own port speaks TLS with a certificate that is trusted nowhere, so no page can go round the gate."""
    async with viewing(viewer, LiveOptions(port=0)) as (view, _, port), aiohttp.ClientSession() as http:
        assert view.port != port
        for scheme in ("ws", "wss"):
            with pytest.raises(aiohttp.ClientError):
                await http.ws_connect(f"{scheme}://127.0.0.1:{view.port}", protocols=[PROTOCOL])
        async with http.get(f"http://127.0.0.1:{port}/") as answer:
            assert answer.status == 403


async def test_what_is_no_request_costs_nothing(viewer: Session) -> None:
    """A head without an end, or none of HTTP: the connection is closed, and others are served."""
    async with viewing(viewer, LiveOptions(port=0)) as (_, _, port), aiohttp.ClientSession() as http:
        for junk in (b"x" * 100_000, b"\x16\x03\x01\r\n\r\n", b"GET / HTTP/1.1\r\nOrigin"):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(junk)
            writer.write_eof()
            async with asyncio.timeout(30):
                with contextlib.suppress(ConnectionError):
                    await reader.read()
            writer.close()
        async with http.ws_connect(f"ws://127.0.0.1:{port}", protocols=[PROTOCOL]) as socket:
            assert socket.protocol == PROTOCOL


@pytest.mark.parametrize(
    "origin", ["null", "app.foxglove.dev", "https://a.example/path", "https://a.example/", "*", ""]
)
def test_what_is_no_origin_is_refused(origin: str) -> None:
    """Before anything listens, with what one looks like."""
    with pytest.raises(ConfigError, match="no origin") as refused:
        LiveOptions(origins=(origin,)).check()
    assert "https://app.foxglove.dev" in refused.value.remedy
