"""Gateways as clients of a router: no links among themselves, and yet one ring."""

import asyncio
import contextlib
import os
import socket
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from msgspec import Struct

from appliance.errors import ConfigError, ConflictError, UnreachableError
from appliance.model.keys import Verb
from appliance.plane.node import Plane, run_router
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


class Word(Struct):
    """Something to say."""

    text: str


ECHO = Verb("echo", Word, Word, "a verb of these tests")
NOTHING = Verb("nothing", Word, Word, "nobody answers it")


async def _until(condition: Callable[[], object]) -> None:
    """Wait until something is so; the test's own timeout bounds it."""
    while not condition():
        await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def _router(listen: str, *connect: str) -> AsyncIterator[Session]:
    """A router in this process."""
    stop, opened = asyncio.Event(), asyncio.get_running_loop().create_future()
    config = PlaneConfig(mode="router", listen=(listen,), connect=connect)
    running = asyncio.create_task(run_router(config, stop=stop, ready=opened.set_result, alive=lambda: None))
    try:
        yield await opened
    finally:
        stop.set()
        await running


@contextlib.asynccontextmanager
async def _gateway(folder: Path, name: str, *connect: str) -> AsyncIterator[Plane]:
    config = PlaneConfig(mode="client", connect=connect)
    plane = await Plane.open(config, fleet="f", gateway=name, data_dir=folder / name)
    try:
        yield plane
    finally:
        await plane.close()


async def _together(*planes: Plane) -> None:
    await _until(lambda: all(len(each.members()) == len(planes) and each.dht.settling.reconciled() for each in planes))


async def test_clients_of_a_router_form_a_ring(tmp_path: Path, free_port: int) -> None:
    """Two gateways that are clients of one router replicate records, refuse stale writes and call each other."""
    at = f"tcp/127.0.0.1:{free_port}"
    async with _router(at), _gateway(tmp_path, "g1", at) as one, _gateway(tmp_path, "g2", at) as two:
        await _together(one, two)
        for number in range(20):
            version = await one.dht.write(f"key/{number}", b"1", expected=None)
            read = await two.dht.read(f"key/{number}")
            assert read is not None
            assert read.version == version
            assert await one.store.record(f"key/{number}") == await two.store.record(f"key/{number}") == read
            with pytest.raises(ConflictError):
                await two.dht.write(f"key/{number}", b"2", expected=None)

        async def echo(word: Word) -> Word:
            return Word(f"g2 heard {word.text}")

        two.rpc.register(ECHO, echo)
        # A door that has just been opened is nobody's to the other until the router has told of it.
        while True:
            with contextlib.suppress(UnreachableError):
                heard = await one.rpc.call("g2", ECHO, Word("it"))
                break
            await asyncio.sleep(0.02)
        assert heard.text == "g2 heard it"


async def test_verbs_behind_a_router(tmp_path: Path, free_port: int) -> None:
    """A verb of all gateways is answered by each under its own key, one that nobody serves by nobody."""
    at = f"tcp/127.0.0.1:{free_port}"
    async with _router(at), _gateway(tmp_path, "g1", at) as one, _gateway(tmp_path, "g2", at) as two:
        await _together(one, two)

        async def echo(word: Word) -> Word:
            return word

        for plane in (one, two):
            plane.rpc.register(ECHO, echo)
        asked = b'{"text":"it"}'
        answers: list[tuple[str, bytes]] = []
        while len(answers) < 2:  # the router has yet to tell of both
            messages = await one.session.query_all("swiftbot/f/gw/*/rpc/echo", asked, timeout_s=5)
            answers = sorted((each.key, each.payload) for each in messages)
        assert answers == [(f"swiftbot/f/gw/{name}/rpc/echo", asked) for name in ("g1", "g2")]
        with pytest.raises(UnreachableError):
            await one.rpc.call("g2", NOTHING, Word("it"))
        two.rpc.close()
        while len(await one.session.query_all("swiftbot/f/gw/*/rpc/echo", asked, timeout_s=5)) > 1:
            await asyncio.sleep(0.02)
        with pytest.raises(UnreachableError):
            await one.rpc.call("g2", ECHO, Word("it"))


async def test_a_gateway_behind_a_router_is_missed(tmp_path: Path, free_port: int) -> None:
    """When one of two clients leaves, the other sees it go and serves all records alone."""
    at = f"tcp/127.0.0.1:{free_port}"
    async with _router(at), _gateway(tmp_path, "g1", at) as one:
        async with _gateway(tmp_path, "g2", at) as two:
            await _together(one, two)
            await two.dht.write("key/x", b"1", expected=None)
        await _until(lambda: one.members() == {"g1"})
        read = await one.dht.read("key/x")
        assert read is not None
        assert read.value == b"1"


async def test_clients_of_different_routers_meet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Gateways at the ends of a line of three routers are one ring."""
    ends = [f"tcp/127.0.0.1:{port}" for port in free_ports(3)]
    async with (
        _router(ends[0]),
        _router(ends[1], ends[0]),
        _router(ends[2], ends[1]),
        _gateway(tmp_path, "g1", ends[0]) as one,
        _gateway(tmp_path, "g2", ends[2]) as two,
    ):
        await _together(one, two)
        await one.dht.write("key/x", b"1", expected=None)
        assert await two.dht.read("key/x") == await one.dht.read("key/x") is not None


async def test_a_router_comes_back(tmp_path: Path, free_port: int) -> None:
    """When the router is restarted its clients link again by themselves, and are one ring again."""
    at = f"tcp/127.0.0.1:{free_port}"
    async with contextlib.AsyncExitStack() as stack:
        async with _router(at):
            one = await stack.enter_async_context(_gateway(tmp_path, "g1", at))
            two = await stack.enter_async_context(_gateway(tmp_path, "g2", at))
            await _together(one, two)
            await one.dht.write("key/x", b"1", expected=None)
        await _until(lambda: one.members() == {"g1"} and two.members() == {"g2"})
        async with _router(at):
            await _together(one, two)
            await two.dht.write("key/y", b"2", expected=None)
            read = await one.dht.read("key/y")
            assert read is not None
            assert read.value == b"2"


async def test_a_router_must_listen() -> None:
    """A router without an endpoint to listen on says so."""
    with pytest.raises(ConfigError, match="nothing to listen on"):
        await run_router(PlaneConfig(), stop=asyncio.Event(), ready=lambda _: None, alive=lambda: None)


async def test_the_service_tells_systemd(tmp_path: Path, free_port: int, project_root: Path) -> None:
    """`swiftbot router`, as its unit runs it, says that it is ready once it listens, goes on, and ends with 0."""
    at = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told:
        told.bind(str(at))
        told.setblocking(False)
        loop = asyncio.get_running_loop()
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "appliance.cli", "router", "--listen", f"tcp/127.0.0.1:{free_port}",
            env={**os.environ, "NOTIFY_SOCKET": str(at)}, cwd=project_root, stdout=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            assert await loop.sock_recv(told, 100) == b"READY=1"
            _, writer = await asyncio.open_connection("127.0.0.1", free_port)
            writer.close()
            assert await loop.sock_recv(told, 100) == b"WATCHDOG=1"
            assert await loop.sock_recv(told, 100) == b"WATCHDOG=1"
            process.terminate()
            assert await process.wait() == 0
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
