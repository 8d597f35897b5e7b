"""Concurrent clients on the records of gateways that are killed, stopped and cut off; then the checkers' word on it.

With a quorum each key is a compare-and-set register, and its history must be linearizable. Without one, replicas must
be equal in the end, hold what somebody wrote, and descend from every write that was acknowledged.
"""

import asyncio
import contextlib
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec

from appliance.bench.chaos.arena import Arena, Progress, Site, loopback
from appliance.bench.chaos.outages import Conditions, carry_out
from appliance.bench.history import convergence, linearizable
from appliance.bench.history.clients import Client, History
from appliance.bench.net import space
from appliance.bench.net.faults import Phase
from appliance.bench.pooled import fleet_name
from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.plane.messages import Found, KeyAsk
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig

HEAL_S = 60.0
"""How long the fleet may take to be whole again, and replicas to be equal: several rounds of anti-entropy."""


class Options(Conditions, frozen=True, kw_only=True):
    """What a run is made of."""

    gateways: int = 5
    clients: int = 8
    keys: int = 6
    seconds: float = 60.0
    quorum: bool = True
    every_s: float = 3.0
    freezes: float = 0.4
    pause_s: float = 0.02
    """Mean pause of a client between two operations."""


@asynccontextmanager
async def planes(
    options: Options, *, progress: Progress, sites: dict[str, Site] | None = None
) -> AsyncGenerator[Arena]:
    """Gateways with nothing but their planes; gone afterwards but for the folder named in `keep`."""
    folder = _folder(options.keep)
    sites = sites or loopback(options.gateways)
    arena = Arena(
        fleet=fleet_name(),
        directory=folder,
        sites=sites,
        pool=PoolConfig(),
        base=GatewayConfig(id="gw-1", llm=LlmConfig(tiers=("rules",)), plane=PlaneConfig(voters=tuple(sites))),
        command=(sys.executable, "-m", "appliance.bench.history.node"),
    )
    arena.prepare()
    try:
        for name in arena.names:
            arena.start(name)
        progress(f"{len(arena.names)} planes of fleet {arena.fleet} start")
        yield arena
    finally:
        await arena.stop(progress=lambda _: None)
        if not options.keep:
            shutil.rmtree(folder, ignore_errors=True)


def _folder(told: str) -> Path:
    folder = Path(told or tempfile.mkdtemp(prefix="swiftbot-history-"))
    folder.mkdir(parents=True, exist_ok=True)
    return folder


class Trial:
    """Clients on a fleet of planes, each linked to one gateway, in turn."""

    def __init__(self, options: Options, arena: Arena) -> None:
        self.options = options
        self.arena = arena
        self.history = History()
        self.keys = tuple(f"history/{number}" for number in range(options.keys))
        self.sessions: dict[str, Session] = {}
        """By gateway: what is asked of all replicas in the end goes over these."""

    async def connect(self, stack: contextlib.AsyncExitStack) -> list[Client]:
        """Link everybody; UnreachableError when a gateway is not there within the time allowed."""
        names = self.arena.names
        for name in names:
            self.sessions[name] = await self._session(name, stack)
        await self.whole(progress=lambda _: None)
        return [
            Client(
                f"c{number + 1}",
                await self._session(names[number % len(names)], stack),
                gateway=names[number % len(names)],
                quorum=self.options.quorum,
                history=self.history,
                seed=self.options.seed * 1000 + number,
            )
            for number in range(self.options.clients)
        ]

    async def _session(self, gateway: str, stack: contextlib.AsyncExitStack) -> Session:
        config = PlaneConfig(mode="client", connect=(self.arena.sites[gateway].endpoint,))
        until = time.monotonic() + HEAL_S
        while True:
            try:
                session = await Session.open(config, self.arena.fleet)
            except SwiftbotError:
                if time.monotonic() > until:
                    raise
                await asyncio.sleep(0.2)
            else:
                stack.push_async_callback(session.close)
                return session

    async def whole(self, *, progress: Progress) -> None:
        """Wait until through every gateway every key can be read; DeadlineError with what cannot."""
        until = time.monotonic() + HEAL_S
        while True:
            failed: list[str] = []
            for name, session in self.sessions.items():
                probe = Client("probe", session, gateway=name, quorum=self.options.quorum, history=History(), seed=0)
                failed += [f"{key} through {name}" for key in self.keys if not await probe.read(key)]
                if failed:
                    break
            if not failed:
                return
            progress(f"not whole yet: {failed[0]}")
            if time.monotonic() > until:
                raise DeadlineError(f"the fleet is not whole after {HEAL_S:g} s: {failed[0]} cannot be read")
            await asyncio.sleep(0.5)

    async def last_reads(self) -> None:
        """Read every key through every gateway, as part of the history."""
        for name, session in self.sessions.items():
            reader = Client(
                f"last-{name}", session, gateway=name, quorum=self.options.quorum, history=self.history, seed=0
            )
            for key in self.keys:
                await reader.read(key)

    async def copies(self, key: str) -> list[convergence.Copy]:
        """Return what each replica of a key holds."""
        found: list[convergence.Copy] = []
        ring = Ring(self.arena.names, virtual_nodes=PlaneConfig().virtual_nodes)
        for name in ring.successors(key, PlaneConfig().replicas):
            rpc = Rpc(self.sessions[name], None)
            record = (await rpc.call(name, "dht_read", KeyAsk(key), Found, timeout_s=4.0)).record
            value = None if record is None else record.value.decode()
            found.append(
                convergence.Copy(gateway=name, value=value, version=None if record is None else record.version)
            )
        return found

    async def converged(self) -> dict[str, dict[str, Any]]:
        """Wait until every key's replicas are as they must be; returns by key what is still wrong."""
        until = time.monotonic() + HEAL_S
        while True:
            found = {
                key: convergence.check(self.history.writes.get(key, []), await self.copies(key)) for key in self.keys
            }
            if not any(each["problems"] for each in found.values()) or time.monotonic() > until:
                return found
            await asyncio.sleep(1.0)


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Have clients use the records while gateways are killed and stopped, and check what they saw.

    Returns:
        `operations` by kind and outcome; with a quorum `linearizable` by key, else `convergence` by key; `held`:
        whether all is as it must be; `history`: the file with the recorded history when it is not, or `keep` is given.

    Raises:
        DeadlineError: the fleet was not whole again a minute after the last fault.
    """
    if not options.faults:
        return await _run(options, None, (), seconds=options.seconds, progress=progress)
    names, bad = options.names(), options.phases()
    async with space.net(names, seed=options.seed) as wire:
        seconds = bad[-1].until_s + options.rest_s
        return await _run(options, wire, bad, seconds=seconds, progress=progress)


async def _run(
    options: Options, wire: space.Net | None, bad: Sequence[Phase], *, seconds: float, progress: Progress
) -> dict[str, Any]:
    sites = wire.sites if wire is not None else None
    async with planes(options, progress=progress, sites=sites) as arena, contextlib.AsyncExitStack() as stack:
        trial = Trial(options, arena)
        clients = await trial.connect(stack)
        planned = options.outages(seconds)
        progress(f"{len(clients)} clients on {options.keys} keys, {len(planned)} outages, {len(bad)} faults")
        began = time.monotonic()
        frames: dict[str, int] = {}
        async with asyncio.TaskGroup() as group:
            for client in clients:
                group.create_task(client.work(trial.keys, began + seconds, pause_s=options.pause_s))
            group.create_task(carry_out(arena, planned, began, progress=progress))
            if wire is not None:
                frames = await space.disturb(wire, bad, began, progress)
        result = await judge(trial, progress=progress)
    result["outages"] = dict(Counter(each.kind for each in planned))
    if frames:
        result["faults"] = {each.name: each.until_s - each.at_s for each in bad}
        result["frames"] = frames
    return result | {"gateways": options.gateways, "clients": options.clients, "seconds": round(seconds, 1)}


async def judge(trial: Trial, *, progress: Progress) -> dict[str, Any]:
    """Wait until the fleet is whole, take the last reads, and check."""
    began = time.monotonic()
    await trial.whole(progress=progress)
    history = trial.history
    result: dict[str, Any] = {
        "quorum": trial.options.quorum,
        "seed": trial.options.seed,
        "whole_after_s": round(time.monotonic() - began, 2),
        "operations": _counts(history),
        "unknown": dict(Counter(each.why.partition(":")[0] for each in history.events if each.outcome == "info")),
    }
    if trial.options.quorum:
        await trial.last_reads()
        progress(f"checking {len(history.events)} operations")
        verdicts = {key: linearizable.check(ops) for key, ops in history.ops.items()}
        result["linearizable"] = {key: each.linearizable for key, each in verdicts.items()}
        result["checked"] = sum(each.operations for each in verdicts.values())
        result["counterexamples"] = {
            key: _counterexample(history.ops[key], each) for key, each in verdicts.items() if not each.linearizable
        }
        held = all(each.linearizable for each in verdicts.values())
    else:
        found = await trial.converged()
        result["problems"] = {key: each["problems"] for key, each in found.items() if each["problems"]}
        result["replaced"] = sum(each["replaced"] for each in found.values())
        result["acknowledged"] = sum(each.version is not None for writes in history.writes.values() for each in writes)
        held = not result["problems"]
    result["held"] = held
    if not held or trial.options.keep:
        result["history"] = _save(history)
    return result


def _counts(history: History) -> dict[str, dict[str, int]]:
    found: dict[str, Counter[str]] = {}
    for each in history.events:
        found.setdefault(each.kind, Counter())[each.outcome] += 1
    return {kind: dict(counter) for kind, counter in found.items()}


def _counterexample(ops: Sequence[linearizable.Op], verdict: linearizable.Verdict) -> dict[str, Any]:
    """The last operations that fitted, and those of which none could come next."""
    return {
        "fitted": len(verdict.order),
        "of": verdict.operations,
        "last": [_told(ops[number]) for number in verdict.order[-5:]],
        "stuck": [_told(ops[number]) for number in verdict.stuck],
    }


def _told(op: linearizable.Op) -> str:
    what = f"read {op.value}" if op.kind == "read" else f"cas {op.old} -> {op.value}{'' if op.ok else ' refused'}"
    until = "?" if op.returned_ns is None else f"{op.returned_ns / 1e6:.3f}"
    return f"{op.process} {what} [{op.called_ns / 1e6:.3f}, {until}] ms"


def _save(history: History) -> str:
    with tempfile.NamedTemporaryFile("wb", prefix="swiftbot-history-", suffix=".jsonl", delete=False) as file:
        file.writelines(msgspec.json.encode(each) + b"\n" for each in history.events)
    return file.name
