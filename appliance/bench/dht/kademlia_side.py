"""The other side of the comparison, nodes of the `kademlia` package; runs under the Python that has it.

    python kademlia_side.py NODES KSIZE PORT [FIRST]

All nodes run in this process, on one event loop, as the gateways beside them do; where each gateway has a process of
its own NODES is 1, and FIRST the port of the first node of all. Reads commands {"op": "put" | "get", "keys": [...],
"value": "..."} and prints JSON lines: {"event": "ready", "version": ...}, then for each command {"event": op, "ms":
[...], "failed": n}; "bootstrap" has it meet the first node once more. Ends with its input.
"""

import asyncio
import importlib
import importlib.metadata
import json
import random
import sys
import time
from typing import Any


def tell(event: str, **fields: Any) -> None:
    """Print a line."""
    sys.stdout.write(json.dumps({"event": event, **fields}) + "\n")
    sys.stdout.flush()


async def main(nodes: int, ksize: int, port: int, first: int) -> None:
    """Start the nodes, obey, stop them."""
    network: Any = importlib.import_module("kademlia.network")
    servers: list[Any] = [network.Server(ksize=ksize) for _ in range(nodes)]
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
        failed = 0
        for key in command["keys"]:
            server = random.choice(servers)  # noqa: S311 - spreads load
            began = time.perf_counter()
            if command["op"] == "put":
                done = await server.set(key, command["value"])
            else:
                done = await server.get(key) is not None
            times.append((time.perf_counter() - began) * 1e3)
            failed += not done
        tell(command["op"], ms=times, failed=failed)
    for server in servers:
        server.stop()


if __name__ == "__main__":
    count, copies, at = (int(each) for each in sys.argv[1:4])
    asyncio.run(main(count, copies, at, int(sys.argv[4]) if len(sys.argv) > 4 else at))
