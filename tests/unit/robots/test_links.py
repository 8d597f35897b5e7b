"""MAVLink links over loopback: who hears whom, over which of UDP and TCP, and what happens when an end goes."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from appliance.errors import ConfigError
from appliance.model.robot_api import Remote, read_remote
from appliance.robots.mavlink.dialect import Codec, Frame, make
from appliance.robots.mavlink.links import Address, Link, open_link

pytestmark = pytest.mark.anyio

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}


class End:
    """A link and what it heard."""

    def __init__(self) -> None:
        self.heard: list[tuple[int, Address]] = []
        self.busy = False
        self.link: Link

    @classmethod
    @asynccontextmanager
    async def open(cls, remote: Remote, system: int) -> AsyncIterator["End"]:
        """Open a link of a system."""
        end = cls()
        end.link = await open_link(remote, Codec(system, 1), end)
        try:
            yield end
        finally:
            await end.link.close()

    def receive(self, link: int, frame: Frame, address: Address) -> None:
        """Take a frame."""
        del link
        self.heard.append((frame.system, address))

    def beat(self) -> None:
        """Send a heartbeat to every other end that is known."""
        for other in (*self.link.others, *(address for _, address in self.heard[-1:])):
            self.link.send(make("HEARTBEAT", **BEAT), other)


async def until(done: Callable[[], bool], act: Callable[[], object] = lambda: None) -> None:
    """Wait until something is so, doing something again and again meanwhile."""
    async with asyncio.timeout(20):
        while not done():
            act()
            await asyncio.sleep(0.02)


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
async def test_both_ways(scheme: str) -> None:
    """A link that connects is heard by one that listens, and the answer comes back; each knows who sent."""
    async with End.open(read_remote(f"{scheme}://127.0.0.1:0", listens=True), 1) as server:
        remote = read_remote(f"{scheme}://127.0.0.1:{server.link.address[1]}", listens=False)
        async with End.open(remote, 2) as client:
            await until(lambda: bool(server.heard), client.beat)
            await until(lambda: bool(client.heard), server.beat)
            assert server.heard[0][0] == 2
            assert client.heard[0] == (1, server.link.address)


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
async def test_an_end_that_comes_back_is_found_again(scheme: str) -> None:
    """A link that connects needs nobody there at first, and goes on when the other end goes and comes back."""
    async with End.open(read_remote(f"{scheme}://127.0.0.1:0", listens=True), 1) as server:
        port = server.link.address[1]
    remote = read_remote(f"{scheme}://127.0.0.1:{port}", listens=False)
    async with End.open(remote, 2) as client:
        for system in (3, 4):
            async with End.open(read_remote(f"{scheme}://127.0.0.1:{port}", listens=True), system) as again:
                await until(lambda again=again: bool(again.heard), client.beat)
                await until(lambda system=system: any(who == system for who, _ in client.heard), again.beat)


async def test_a_frame_in_pieces_and_garbage_over_tcp() -> None:
    """A frame that comes byte by byte is one frame; garbage is counted, and other connections are not disturbed."""
    async with End.open(read_remote("tcp://127.0.0.1:0", listens=True), 1) as server:
        _, slow = await asyncio.open_connection(*server.link.address)
        _, bad = await asyncio.open_connection(*server.link.address)
        bad.write(b"GET / HTTP/1.1\r\n\r\n")
        for byte in Codec(5, 1).pack(make("HEARTBEAT", **BEAT)):
            slow.write(bytes([byte]))
            await slow.drain()
        await until(lambda: bool(server.heard) and bool(server.link.refused))
        assert [who for who, _ in server.heard] == [5]
        assert server.link.refused == {"noise": 1}
        slow.write(b"\xfd\x09\x00")
        for writer in (slow, bad):
            writer.close()
            await writer.wait_closed()
        await until(lambda: "truncated" in server.link.refused)


async def test_an_end_that_does_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames for an end that does not read are dropped and counted; memory does not grow and nobody waits."""
    monkeypatch.setattr("appliance.robots.mavlink.links.TCP_MAX_UNSENT", 1000)
    async with End.open(read_remote("tcp://127.0.0.1:0", listens=True), 1) as server:
        _, writer = await asyncio.open_connection(*server.link.address, limit=1)
        await until(lambda: bool(server.link.others))
        writer.transport.pause_reading()  # pyright: ignore[reportAttributeAccessIssue]
        raw = Codec(1, 1).pack(make("STATUSTEXT", severity=6, text=b"x" * 50)) * 1000
        for _ in range(1000):
            server.link.transmit(raw, server.link.others[0])
        assert server.link.refused["not_read"] > 0
        writer.transport.abort()


@pytest.mark.parametrize("scheme", ["udp", "tcp"])
async def test_a_port_that_is_taken(scheme: str) -> None:
    """Listening where somebody listens is a ConfigError with the address and the remedy."""
    async with End.open(read_remote(f"{scheme}://127.0.0.1:0", listens=True), 1) as first:
        port = first.link.address[1]
        with pytest.raises(ConfigError, match=f"{scheme}://127.0.0.1:{port}") as told:
            await open_link(read_remote(f"{scheme}://127.0.0.1:{port}", listens=True), Codec(2, 1), End())
        assert "another robots.mavlink listen" in told.value.remedy
