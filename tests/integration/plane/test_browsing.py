"""Records looked at and changed from outside, as `swiftbot plane` does, on real gateways' planes."""

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from appliance.connection import Endpoint
from appliance.errors import ConfigError, ConflictError, NotFoundError, PayloadError
from appliance.model import keyspace
from appliance.model.plane_api import Record, StoreAsk
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.records import Records

pytestmark = pytest.mark.anyio


@contextlib.asynccontextmanager
async def _fleet(folder: Path, ports: list[int]) -> AsyncIterator[list[Plane]]:
    """Gateways that have reconciled."""
    endpoints = [f"tcp/127.0.0.1:{port}" for port in ports]
    names = tuple(f"g{number}" for number in range(len(ports)))
    planes: list[Plane] = []
    async with contextlib.AsyncExitStack() as stack:
        for name, endpoint in zip(names, endpoints, strict=True):
            peers = dict(zip(names, endpoints, strict=True))
            config = PlaneConfig(listen=(endpoint,), peers=peers)
            planes.append(await Plane.open(config, fleet="browse", gateway=name, data_dir=folder / name))
            stack.push_async_callback(planes[-1].close)
        while not all(len(each.members()) == len(planes) and each.dht.settling.reconciled() for each in planes):
            await asyncio.sleep(0.02)
        yield planes


async def _swiftbot(endpoint: str, *arguments: str, value: bytes = b"") -> tuple[int, bytes]:
    """Run a command as a person does; returns its exit code and what it printed."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance.cli", "plane", *arguments, "--fleet", "browse", "--connect", endpoint,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    out, _ = await process.communicate(value)
    return process.returncode or 0, out


async def test_records_are_read_listed_and_changed(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Each way of reading finds what was written; a list has all copies; a change needs the present version."""
    async with _fleet(tmp_path, free_ports(4)) as planes:
        endpoint = planes[0].config.listen[0]
        async with Records(Endpoint(fleet="browse", connect=(endpoint,))) as records:
            version = await records.write("note/1", b"one", expected=None)
            for how in ("owner", "replica"):
                assert (await records.read("note/1", how)).value == b"one"  # type: ignore[arg-type]
            with pytest.raises(ConflictError):
                await records.write("note/1", b"two", expected=None)
            mine = await records.write("lock/1", b"mine", expected=None)
            place = await records.place("note/1")
            assert place.agree
            assert place.replicas == planes[0].ring.successors("note/1", 3)
            assert place.owner == place.replicas[0]
            assert all(each.version == version and each.size_bytes == 3 for each in place.copies)
            await records.write("note/2", b"zwei", expected=None)
            held, failed = await records.held("note/", 10)
            assert [each.key for each in held] == ["note/1", "note/2"]
            assert not failed
            assert all(each.agree and len(each.copies) == 3 for each in held)
            assert [each.key for each in (await records.held("", 2))[0]] == ["lock/1", "note/1"]
            await records.remove("note/2", expected={next(iter(held[1].newest.version)): 1})
            assert (await records.held("note/2", 10))[0][0].newest.deleted
            for how in ("owner", "replica"):
                with pytest.raises(NotFoundError):
                    await records.read("note/2", how)  # type: ignore[arg-type]
            with pytest.raises(ConfigError, match="--force"):
                await records.write("task/1", b"", expected=None)
            with pytest.raises(PayloadError):
                await records.read("")
            await records.remove("lock/1", expected=mine)
            with pytest.raises(NotFoundError):
                await records.read("lock/1")


async def test_a_replica_is_read_where_it_is_asked_for(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """A gateway that holds a copy answers from it, though it is behind; the owner and a list tell of the difference."""
    async with _fleet(tmp_path, free_ports(4)) as planes:
        by_name = {each.gateway: each for each in planes}
        key = next(key for at in range(10_000) if planes[0].ring.owner(key := f"note/{at}") != "g0"
                   and "g0" in planes[0].ring.successors(key, 3))  # fmt: skip
        old = await planes[0].dht.write(key, b"old", expected=None)
        owner = by_name[planes[0].ring.owner(key)]
        newer = Record(key=key, value=b"new", version={name: count + 1 for name, count in old.items()}, write="w")
        await planes[0].rpc.call(owner.gateway, keyspace.DHT_STORE, StoreAsk(newer))
        assert (await planes[0].dht.read(key, replica=True)).value == b"old"  # type: ignore[union-attr]
        assert (await planes[0].dht.read(key)).value == b"new"  # type: ignore[union-attr]
        outside = next(each for each in planes if each.gateway not in planes[0].ring.successors(key, 3))
        record = await outside.dht.read(key, replica=True)
        assert record is not None
        assert record.value in (b"old", b"new")
        async with Records(Endpoint(fleet="browse", connect=planes[0].config.listen)) as records:
            assert not (await records.place(key)).agree
            (held,), _ = await records.held(key, 1)
            assert not held.agree
            assert held.newest.version == newer.version


@pytest.mark.long
async def test_the_commands(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """`put`, `get`, `ls` and `rm` print for people and as JSON, and end with the documented codes."""
    async with _fleet(tmp_path, free_ports(3)) as planes:
        endpoint = planes[0].config.listen[0]
        assert (await _swiftbot(endpoint, "put", "note/1", "--stdin", value=b"[bold]\n"))[0] == 0
        assert await _swiftbot(endpoint, "get", "note/1", "--raw") == (0, b"[bold]\n")
        code, out = await _swiftbot(endpoint, "get", "note/1")
        assert code == 0
        assert b"[bold]" in out
        assert b"the copies agree" in out
        assert (await _swiftbot(endpoint, "put", "note/1", "x", "--new"))[0] == 4
        code, out = await _swiftbot(endpoint, "put", "lock/1", '{"by": 1}', "--json")
        version = json.loads(out)["version"]
        assert code == 0
        code, out = await _swiftbot(endpoint, "get", "lock/1", "--json")
        told = json.loads(out)
        assert (told["value"], told["version"], told["agree"]) == ({"by": 1}, version, True)
        assert {each["gateway"] for each in told["place"]["copies"]} == {"g0", "g1", "g2"}
        for kind in keyspace.RECORD_KINDS:
            key = kind.key(*("x-1" for _ in kind.fields))
            assert (await _swiftbot(endpoint, "put", key, '{"x":1}'))[0] == 2, key
        assert (await _swiftbot(endpoint, "put", "ask/x-1/s1/1", "{}", "--force"))[0] == 0
        code, out = await _swiftbot(endpoint, "get", "ask/x-1/s1/1", "--json")
        asked = json.loads(out)["version"]
        assert (await _swiftbot(endpoint, "rm", "ask/x-1/s1/1", "--expect", json.dumps(asked)))[0] == 2
        assert (await _swiftbot(endpoint, "rm", "ask/x-1/s1/1", "--expect", json.dumps(asked), "--force"))[0] == 0
        code, out = await _swiftbot(endpoint, "ls", "--json")
        assert [each["key"] for each in json.loads(out)] == ["lock/1", "note/1"]
        code, out = await _swiftbot(endpoint, "rm", "lock/1", "--expect", json.dumps(version))
        assert code == 0
        assert (await _swiftbot(endpoint, "get", "lock/1"))[0] == 4
        code, out = await _swiftbot(endpoint, "ls", "--removed")
        assert b"removed" in out
