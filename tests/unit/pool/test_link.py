"""The pool's tie to Podman, with the real client and something that answers as Podman does."""

import asyncio
import os
import time
from pathlib import Path

import pytest

from appliance.pool import engine
from appliance.pool.engine import Engine, EngineFacts, PodmanEngine
from appliance.pool.link import EngineLink

pytestmark = pytest.mark.anyio

INFO = b'{"host": {"cgroupVersion": "v2", "security": {"rootless": true}}, "version": {"Version": "4.3.1"}}'


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer every request with what Podman says of itself."""
    try:
        while await reader.readuntil(b"\r\n\r\n"):
            head = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nLibpod-API-Version: 4.3.1\r\n"
            writer.write(head + b"Content-Length: %d\r\n\r\n" % len(INFO) + INFO)
            await writer.drain()
    except (asyncio.IncompleteReadError, ConnectionError):
        writer.close()


async def test_what_is_missing_at_the_start_may_come(short_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No runtime directory, no socket, nobody behind it, Podman: each is told with its remedy, and tried again."""
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(engine, "RUNTIME_DIRS", short_dir)
    connected: list[str] = []

    async def on_connected(_: Engine, facts: EngineFacts) -> None:
        connected.append(facts.version)

    link = EngineLink(PodmanEngine, reconnect_s=0.01, on_connected=on_connected)

    async def until(said: str) -> None:
        async with asyncio.timeout(60):
            while not (said in link.problem if said else not link.problem):
                link.tend(time.monotonic())
                await asyncio.sleep(0.01)

    await link.start(60)
    assert "XDG_RUNTIME_DIR is not set" in link.problem
    assert "enable-linger" in link.problem
    folder = short_dir / str(os.getuid()) / "podman"
    folder.mkdir(parents=True)
    await until("podman.sock is not there")
    assert "podman.socket" in link.problem
    (folder / "podman.sock").touch()
    await until("podman.sock does not answer")
    (folder / "podman.sock").unlink()
    server = await asyncio.start_unix_server(_answer, folder / "podman.sock")
    await until("")
    assert connected == ["4.3.1"]
    assert link.there()[1].rootless
    await link.close()
    server.close()
    await server.wait_closed()
