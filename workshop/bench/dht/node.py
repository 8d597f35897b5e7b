"""One gateway's plane in a process of its own, told over its standard input what to do (`live`).

Reads commands {"op": "put" | "put_unsynced" | "get", "keys": [...], "value": "..."} and prints JSON lines as the other
side does (`kademlia_side`): {"event": "ready"} once as many members as it was told of are known and its shard is
reconciled with theirs, then for each command {"event": op, "ms": [...], "failed": n, "cpu_ms": ...}. Ends with its
input.
"""

import asyncio
import json
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import uvloop
from msgspec import Struct

from appliance import logs
from appliance.plane.dht import Dht
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig
from appliance.process import gentle_collector

_LOOK_S = 0.02


class NodeOptions(Struct, frozen=True, kw_only=True):
    """Which gateway this is, and how it finds the others."""

    fleet: str
    gateway: str
    folder: str
    listen: str
    connect: tuple[str, ...]
    members: int
    peers: dict[str, str] = {}
    """All of them, instead of `connect` (`plane.peers`)."""
    keys: str = ""


async def do(dht: Dht, command: dict[str, Any]) -> dict[str, Any]:
    """Put or get keys one after the other, as a command says; returns how long each took and how many failed."""
    op, value = command["op"], str(command["value"]).encode()
    times: list[float] = []
    failed, cpu = 0, time.process_time()
    for key in command["keys"]:
        began = time.perf_counter()
        if op in ("get", "get_any_copy"):
            found = await dht.read(key, replica=op == "get_any_copy") is not None
        else:
            found = bool(await dht.write(key, value, expected=None, durable=op == "put"))
        times.append((time.perf_counter() - began) * 1e3)
        failed += not found
    return {"event": op, "ms": times, "failed": failed, "cpu_ms": (time.process_time() - cpu) * 1e3}


async def serve(options: NodeOptions) -> None:
    """Join, obey, leave."""
    reader = asyncio.StreamReader(limit=2**24)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    config = PlaneConfig(listen=(options.listen,), connect=options.connect, peers=options.peers, keys=options.keys)
    plane = await Plane.open(config, fleet=options.fleet, gateway=options.gateway, data_dir=Path(options.folder))
    try:
        while len(plane.members()) < options.members or not plane.dht.settling.reconciled():  # noqa: ASYNC110 - no single event says so
            await asyncio.sleep(_LOOK_S)
        tell({"event": "ready"})
        while line := await reader.readline():
            tell(await do(plane.dht, json.loads(line)))
    finally:
        await plane.close()


def tell(what: dict[str, Any]) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main() -> None:
    """Serve until standard input ends."""
    logs.configure(level="error", style="text")
    with gentle_collector(collect=False):  # as a gateway does
        uvloop.run(serve(msgspec.json.decode(sys.argv[1], type=NodeOptions)))


if __name__ == "__main__":
    main()
