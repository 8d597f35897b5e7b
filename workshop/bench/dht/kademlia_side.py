"""The other side of the comparison, nodes of the `kademlia` package; runs under the Python that has it.

    python kademlia_side.py NODES KSIZE PORT FIRST [FOLDER]

All nodes run in this process, on one event loop, as the gateways beside them do; where each gateway has a process of
its own NODES is 1, and FIRST the port of the first node of all. Reads commands {"op": "put" | "get", "keys": [...],
"value": "..."} and prints JSON lines: {"event": "ready", "version": ...}, then for each command {"event": op, "ms":
[...], "failed": n, "cpu_ms": processor time of the process}; "bootstrap" has it meet the first node once more. Ends
with its input.

With a FOLDER each node has what it stores on the disk before it answers, as gateways do: the package takes any storage,
and this one writes to SQLite first. The package's own keeps everything in memory alone.
"""

import asyncio
import importlib
import importlib.metadata
import json
import random
import sqlite3
import sys
import time
from pathlib import Path
from typing import Any


def tell(event: str, **fields: Any) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
    sys.stdout.flush()


def durable(path: Path) -> Any:
    """The package's storage, with each value synced to a file of the same settings as a gateway's (WAL, FULL)."""
    memory: Any = importlib.import_module("kademlia.storage").ForgetfulStorage
    db = sqlite3.connect(path, isolation_level=None)
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")
    db.execute("CREATE TABLE stored (key BLOB PRIMARY KEY, value TEXT)")

    class Durable(memory):
        def __setitem__(self, key: bytes, value: str) -> None:
            db.execute("INSERT OR REPLACE INTO stored VALUES (?, ?)", (key, value))
            memory.__setitem__(self, key, value)

    return Durable()


async def main(nodes: int, ksize: int, port: int, first: int, folder: Path | None) -> None:
    """Start the nodes, obey, stop them."""
    network: Any = importlib.import_module("kademlia.network")
    stores = [durable(folder / f"{port + number}.sqlite") if folder else None for number in range(nodes)]
    servers: list[Any] = [network.Server(ksize=ksize, storage=store) for store in stores]
    for number, server in enumerate(servers):
        await server.listen(port + number, interface="127.0.0.1")

    async def bootstrap() -> None:
        for number, server in enumerate(servers):
            if port + number != first:
                await server.bootstrap([("127.0.0.1", first)])

    for _ in range(2):  # the first nodes learn of the last only in a second round
        await bootstrap()
    tell("ready", version=importlib.metadata.version("kademlia"))
    while line := await asyncio.to_thread(sys.stdin.readline):
        command = json.loads(line)
        if command["op"] == "bootstrap":
            await bootstrap()
        times: list[float] = []
        failed, cpu = 0, time.process_time()
        for key in command["keys"]:
            server = random.choice(servers)  # noqa: S311 - spreads load
            began = time.perf_counter()
            if command["op"] == "put":
                done = await server.set(key, command["value"])
            else:
                done = await server.get(key) is not None
            times.append((time.perf_counter() - began) * 1e3)
            failed += not done
        tell(command["op"], ms=times, failed=failed, cpu_ms=(time.process_time() - cpu) * 1e3)
    for server in servers:
        server.stop()


if __name__ == "__main__":
    count, copies, at, begin = (int(each) for each in sys.argv[1:5])
    asyncio.run(main(count, copies, at, begin, Path(sys.argv[5]) if len(sys.argv) > 5 else None))
