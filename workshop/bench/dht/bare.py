"""Zenoh alone: as many sessions in one process as gateways beside it, and a question from one to another.

It says what a question and its answer cost before any code of ours: the queryable answers in the library's callback,
with as many bytes as a record has, and nothing is decoded. Reads commands and prints JSON lines as the other sides do
(`kademlia_side`), for the one op "get". Ends with its input.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
import json
import random
import sys
import time
from functools import partial
from typing import Any, cast

import uvloop
import zenoh

from appliance.plane import link
from appliance.plane.settings import PlaneConfig
from appliance.ports import free_port
from workshop.bench.dht.node import tell

ANSWER_S = 10.0


def _answer(key: str, query: zenoh.Query) -> None:
    """Answer with what was asked, as direct questions are answered."""
    payload = query.payload
    with query:
        query.reply(key, payload.to_bytes() if payload is not None else b"", express=True)


async def _ask(session: zenoh.Session, key: str, payload: bytes) -> None:
    loop = asyncio.get_running_loop()
    answered: asyncio.Future[None] = loop.create_future()

    def take(_: zenoh.Reply) -> None:
        loop.call_soon_threadsafe(settle)

    def settle() -> None:
        # A second answer, or one that comes when nobody waits any more, is none.
        if not answered.done():
            answered.set_result(None)

    session.get(
        key,
        link.callback(take),
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=ANSWER_S,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_HIGH,
        express=True,
        payload=payload,
    )
    async with asyncio.timeout(ANSWER_S):
        await answered


async def serve(nodes: int) -> None:
    """Open the sessions, obey, close them."""
    first = f"tcp/127.0.0.1:{free_port()}"
    sessions: list[zenoh.Session] = []
    for number in range(nodes):
        listen = first if number == 0 else f"tcp/127.0.0.1:{free_port()}"
        config = PlaneConfig(listen=(listen,), connect=() if number == 0 else (first,))
        sessions.append(await asyncio.to_thread(link.open_raw, config))
    answering = [
        each.declare_queryable(
            f"bare/{number}",
            link.callback(partial(_answer, f"bare/{number}")),
            complete=True,
        )
        for number, each in enumerate(sessions)
    ]
    while any(len(list(each.info.peers_zid())) < nodes - 1 for each in sessions):  # noqa: ASYNC110 - the library has no event for it
        await asyncio.sleep(0.02)
    reader = asyncio.StreamReader(limit=2**24)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    # Links are up a moment before what is served over them is known; the first round is not measured.
    for number in range(nodes):
        await _known(sessions[number - 1], f"bare/{number}")
    tell({"event": "ready"})
    while line := await reader.readline():
        command = json.loads(line)
        times: list[float] = []
        cpu = time.process_time()
        for _ in command["keys"]:
            asker, asked = random.sample(range(nodes), 2)
            began = time.perf_counter()
            await _ask(sessions[asker], f"bare/{asked}", str(command["value"]).encode())
            times.append((time.perf_counter() - began) * 1e3)
        tell({"event": command["op"], "ms": times, "failed": 0, "cpu_ms": (time.process_time() - cpu) * 1e3})
    for each in answering:
        each.undeclare()
    for each in sessions:
        await asyncio.to_thread(each.close)


async def _known(session: zenoh.Session, key: str) -> None:
    """Wait until somebody serves a key for this session."""
    with session.declare_querier(key) as querier:
        # The stubs take the status for a bool; it is a structure with one.
        while not cast("Any", querier.matching_status).matching:  # noqa: ASYNC110 - a listener would only say so on another thread
            await asyncio.sleep(0.01)


if __name__ == "__main__":
    uvloop.run(serve(int(sys.argv[1])))
