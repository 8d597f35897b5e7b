"""The pool's tie to Podman, with the real client and something that answers as Podman does."""

import asyncio
import contextlib
import os
import time
from pathlib import Path

import pytest

from appliance.errors import UnreachableError
from appliance.pool import engine
from appliance.pool.engine import Engine, EngineFacts, EngineLink, PodmanEngine

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
    """No runtime directory, no socket, nobody behind it, Podman: each is reported with its remedy, and tried again."""
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


async def test_a_podman_that_stands_still_and_one_that_hangs_up_give_no_sign_of_life(short_dir: Path) -> None:
    """Each is reported with its reason and remedy; one that answers again is heard over a connection that is kept."""
    asked: list[int] = []
    still = False

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        asked.append(0)
        try:
            while (await reader.readuntil(b"\r\n\r\n")).startswith(b"HEAD /_ping ") and not still:
                asked[-1] += 1
                writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n")
            await reader.read()
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            writer.close()

    socket = short_dir / "p.sock"
    podman = PodmanEngine(f"unix://{socket}")
    with pytest.raises(UnreachableError, match="is not there"):
        await podman.ping(5.0)
    server = await asyncio.start_unix_server(serve, socket)
    for _ in range(3):
        await podman.ping(60.0)
    assert asked == [3], "three signs of life over one connection"
    still = True
    with pytest.raises(UnreachableError, match=r"has not answered within 0.05 s at its API socket") as silent:
        await podman.ping(0.05)
    assert "restart podman.service" in silent.value.remedy
    still = False
    await podman.ping(60.0)
    podman.hang_up()
    podman.close()
    server.close()
    await server.wait_closed()


async def test_removing_waits_once_for_a_podman_that_hangs(short_dir: Path) -> None:
    """Podman that does not answer the kill is not asked for more: each question holds a thread until its timeout."""
    asked: list[bytes] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            asked.append((await reader.readuntil(b"\r\n\r\n")).split(b"?")[0])
            await reader.read()
        writer.close()

    socket = short_dir / "p.sock"
    server = await asyncio.start_unix_server(serve, socket)
    podman = PodmanEngine(f"unix://{socket}", threads=1, timeout_s=1.0)
    with pytest.raises(UnreachableError, match="does not answer"):
        await podman.remove("c1")
    assert [each.rpartition(b"/")[2] for each in asked] == [b"kill"]
    podman.close()
    server.close()
    await server.wait_closed()
