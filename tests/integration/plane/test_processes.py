"""The plane between processes of their own: gateways killed with SIGKILL, and frozen."""

import asyncio
import json
import random
import signal
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.anyio

GATEWAY = """
import asyncio, base64, json, sys
from collections import Counter
from pathlib import Path
from appliance.errors import SwiftbotError
from appliance.model import keyspace
from appliance.model.plane_api import Member, MemberAsk
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig

async def main():
    number, folder, *endpoints = int(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:]
    peers = {f"g{each}": endpoint for each, endpoint in enumerate(endpoints)}
    if number < len(endpoints):
        config = PlaneConfig(listen=(endpoints[number],), peers=peers, lease_ms=LEASE_MS)
    else:  # a newcomer that the others have not been told of
        config = PlaneConfig(listen=("tcp/127.0.0.1:0",), connect=tuple(endpoints[:1]), lease_ms=LEASE_MS)
    plane = await Plane.open(config, fleet="f", gateway=f"g{number}", data_dir=folder / f"g{number}")
    print(json.dumps("open"), flush=True)
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    while line := await reader.readline():
        ask = json.loads(line)
        try:
            if ask["do"] == "write":
                answer = await plane.dht.write(ask["key"], ask["value"].encode(), expected=ask.get("expected"))
            elif ask["do"] == "read":
                record = await plane.dht.read(ask["key"])
                answer = None if record is None else [record.value.decode(), record.version]
            elif ask["do"] == "state":
                answer = [sorted(plane.members()), plane.dht.settling.reconciled(), plane.ring.owner(ask["key"])]
            elif ask["do"] == "hello":
                asked = MemberAsk(gateway=plane.gateway)
                others = sorted(plane.members() - {plane.gateway})
                calls = (plane.rpc.call(each, keyspace.MEMBER, asked) for each in others)
                said = await asyncio.gather(*calls, return_exceptions=True)
                seen = [each for each, answer in zip(others, said) if isinstance(answer, Member) and answer.here]
                links = Counter(str(each.zid) for each in plane.session._wire.raw.info.links())
                answer = [seen, sorted(links.values())]
        except SwiftbotError as error:
            answer = {"error": error.code}
        print(json.dumps(answer), flush=True)
    await plane.close()

asyncio.run(main())
"""


class Gateway:
    """One gateway process, told what to do over its standard input."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process

    async def ask(self, do: str, **fields: object) -> object:
        """Have it do something and return its answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, **fields}).encode() + b"\n")
        return await self.answer()

    async def answer(self) -> object:
        """Read its next line, past what it logs."""
        assert self.process.stdout is not None
        while line := await self.process.stdout.readline():
            try:
                return json.loads(line)
            except ValueError:
                continue
        raise AssertionError("the gateway ended")


class Fleet:
    """Gateway processes that name each other in `peers`."""

    def __init__(self, folder: Path, endpoints: list[str], *, lease_ms: int = 1000) -> None:
        self.folder, self.endpoints = folder, endpoints
        self.script = GATEWAY.replace("LEASE_MS", str(lease_ms))
        self.gateways: dict[int, Gateway] = {}

    async def start(self, number: int) -> None:
        """Start one and wait until it is open."""
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", self.script, str(number), str(self.folder), *self.endpoints,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        self.gateways[number] = Gateway(process)
        assert await self.gateways[number].answer() == "open"

    async def settled(self) -> None:
        """Wait until each sees all, and has reconciled."""
        names = sorted(f"g{number}" for number in self.gateways)
        for gateway in self.gateways.values():
            while (await gateway.ask("state", key="k"))[:2] != [names, True]:
                await asyncio.sleep(0.02)

    async def owned_by(self, number: int) -> str:
        """A new key of a gateway's."""
        while True:
            key = f"task/{random.randrange(10**9)}"  # noqa: S311 - any key will do
            if (await self.gateways[number].ask("state", key=key))[2] == f"g{number}":
                return key

    async def kill(self, number: int) -> None:
        """SIGKILL one."""
        process = self.gateways.pop(number).process
        process.kill()
        await process.wait()

    async def end(self) -> None:
        """SIGKILL all, the frozen ones too."""
        for number in list(self.gateways):
            await self.kill(number)


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways in processes of their own, started in any order."""
    made = Fleet(tmp_path, [f"tcp/127.0.0.1:{port}" for port in free_ports(3)])
    try:
        for number in (2, 0, 1):
            await made.start(number)
        await made.settled()
        yield made
    finally:
        await made.end()


async def test_the_owner_is_killed(fleet: Fleet) -> None:
    """A record whose owner got SIGKILL is read and written through the others; on its return it has the new version."""
    key = await fleet.owned_by(1)
    version = await fleet.gateways[0].ask("write", key=key, value="before")
    assert version == {"g1": 1}
    await fleet.kill(1)
    assert await fleet.gateways[0].ask("read", key=key) == ["before", version]
    newer = await fleet.gateways[2].ask("write", key=key, value="after", expected=version)
    assert await fleet.gateways[0].ask("write", key=key, value="stale", expected=version) == {"error": "conflict"}
    assert await fleet.gateways[0].ask("read", key=key) == ["after", newer]
    await fleet.start(1)
    await fleet.settled()
    assert await fleet.gateways[1].ask("read", key=key) == ["after", newer]
    assert await fleet.gateways[1].ask("write", key=key, value="home", expected=newer) == {**newer, "g1": 2}


async def test_acknowledged_writes_survive_the_kill_of_any_gateway(fleet: Fleet) -> None:
    """While records are written through one gateway each other is killed and restarted: no acknowledged one is lost."""
    acknowledged: dict[str, str] = {}
    stopping = asyncio.Event()

    async def write() -> None:
        number = 0
        while not stopping.is_set():
            number += 1
            key, value = f"task/{number}", str(number)
            answer = await fleet.gateways[0].ask("write", key=key, value=value)
            if not (isinstance(answer, dict) and "error" in answer):
                acknowledged[key] = value

    writing = asyncio.create_task(write())
    for number in (1, 2):
        await asyncio.sleep(0.3)
        await fleet.kill(number)
        await asyncio.sleep(0.3)
        await fleet.start(number)
    stopping.set()
    await writing
    await fleet.settled()
    assert len(acknowledged) > 20
    for number in (0, 1, 2):
        for key, value in acknowledged.items():
            assert (await fleet.gateways[number].ask("read", key=key))[0] == value


async def test_a_frozen_owner_is_replaced_and_comes_back(fleet: Fleet) -> None:
    """An owner that is frozen is succeeded after its lease; thawed, it joins again and has what was written since."""
    key = await fleet.owned_by(2)
    version = await fleet.gateways[0].ask("write", key=key, value="before")
    frozen = fleet.gateways.pop(2)
    frozen.process.send_signal(signal.SIGSTOP)
    try:
        newer = await fleet.gateways[1].ask("write", key=key, value="after", expected=version)
        assert await fleet.gateways[0].ask("read", key=key) == ["after", newer]
    finally:
        frozen.process.send_signal(signal.SIGCONT)
        fleet.gateways[2] = frozen
    await fleet.settled()
    assert await frozen.ask("read", key=key) == ["after", newer]


@pytest.mark.timeout(180)
@pytest.mark.long
async def test_a_standstill_mixes_up_no_links(tmp_path: Path, free_ports: Callable[..., list[int]]) -> None:
    """Each gateway in turn stands still for a lease and more: then each two have one link again, and each is answered.

    One of the five is a newcomer that the others do not name.
    """
    made = Fleet(tmp_path, [f"tcp/127.0.0.1:{port}" for port in free_ports(4)], lease_ms=500)
    try:
        for number in (3, 0, 1, 2, 4):
            await made.start(number)
        await made.settled()
        for turn in range(10):
            process = made.gateways[turn % 5].process
            process.send_signal(signal.SIGSTOP)
            await asyncio.sleep((0.7, 1.0, 1.5)[turn % 3])
            process.send_signal(signal.SIGCONT)
            await asyncio.sleep(0.5)  # a lease
            await made.settled()
            for number, gateway in made.gateways.items():
                others = [f"g{each}" for each in range(5) if each != number]
                assert await gateway.ask("hello") == [others, [1, 1, 1, 1]], f"of g{number}, after turn {turn}"
    finally:
        await made.end()
