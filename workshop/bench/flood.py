"""Thousands of tasks of one sender handed in to a fleet, while an operator gives orders and others read.

The tasks do nothing, so that they end as fast as a fleet can end any: what is measured is whether they are accepted,
and what becomes of everything else meanwhile. An open loop of orders and reads runs beside them; their times count from
when each was due.
"""

import asyncio
import os
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import psutil
from msgspec import Struct

from appliance.client import FleetClient
from appliance.errors import SwiftbotError
from appliance.model import PLAIN_PRIORITY, Plan, RunEvent, RunEventKind, Subtask, TaskRecord, TaskRequest, keyspace
from appliance.pool.settings import PoolConfig
from appliance.submission import submit_all
from workshop.bench.chaos.arena import Arena, Progress, loopback
from workshop.bench.figures import summary
from workshop.bench.pooled import SKILL, fleet_name, workspace, write_skill

ORDER_EVERY_S = 1.0
READ_EVERY_S = 0.25
START_S = 30.0
"""An order that has not started after so long counts with this."""
PLAN = Plan(domain="coordination", subtasks=(Subtask(id="s1", skill=SKILL),))
RATE, SUBMISSION_MS, START_MS, MEMORY_MB = 150.0, 300.0, 1000.0, 100.0
"""Promised: tasks a second accepted on two free cores, p99 of a submission, of the start of an order among them, and
what ten thousand that wait take of a gateway's memory."""


class Options(Struct, frozen=True, kw_only=True):
    """What is measured."""

    tasks: int = 3000
    gateways: int = 3
    containers: int = 2
    """Kept ready by each gateway."""


class Orders:
    """An operator's orders, one after the other, and when each starts."""

    def __init__(self, client: FleetClient) -> None:
        self._client = client
        self._started: dict[str, asyncio.Future[float]] = {}
        self.took_ms: list[float] = []
        self.refused: Counter[str] = Counter()
        client.plane.session.subscribe_typed(keyspace.RUN_EVENT, self._told)

    def _told(self, key: str, event: RunEvent | None) -> None:
        del key
        if event is None or event.kind not in (RunEventKind.STARTED, RunEventKind.SUCCEEDED):
            return
        waiting = self._started.get(event.task)
        if waiting is not None and not waiting.done():
            waiting.set_result(time.monotonic())

    async def keep_on(self) -> None:
        """Give an order each second until cancelled."""
        number, due = 0, time.monotonic()
        async with asyncio.TaskGroup() as group:
            while True:
                number += 1
                group.create_task(self._one(f"order-{os.getpid()}-{number}", due))
                due += ORDER_EVERY_S
                await asyncio.sleep(max(0.0, due - time.monotonic()))

    async def _one(self, task: str, due: float) -> None:
        started = self._started[task] = asyncio.get_running_loop().create_future()
        try:
            await self._client.submit(TaskRequest(instruction="do nothing", id=task, submitter="operator", plan=PLAN))
            async with asyncio.timeout(START_S):
                self.took_ms.append((await started - due) * 1e3)
        except TimeoutError:
            self.took_ms.append(START_S * 1e3)
        except SwiftbotError as error:
            self.refused[error.code] += 1


class Reads:
    """Questions of somebody who watches the fleet."""

    def __init__(self, client: FleetClient) -> None:
        self._client = client
        self.took_ms: list[float] = []
        self.refused: Counter[str] = Counter()

    async def keep_on(self) -> None:
        """Ask for the newest tasks, and for one of them, until cancelled."""
        due = time.monotonic()
        while True:
            try:
                found = await self._client.tasks(20)
                if found.tasks:
                    await self._client.task(found.tasks[0].id)
                self.took_ms.append((time.monotonic() - due) * 1e3)
            except SwiftbotError as error:
                self.refused[error.code] += 1
            due = max(due + READ_EVERY_S, time.monotonic())
            await asyncio.sleep(max(0.0, due - time.monotonic()))


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Hand the tasks in, and say what became of them, of the orders and of the reads.

    Returns:
        `accepted`, `rate_per_s`, `submission` (ms), `order_start` (ms), `reads` (ms), what was `refused` to whom, what
        gateways used (`cpu_ms_per_task`, `memory_mb` grown by), tasks `waiting` when the last was accepted and
        `ended_meanwhile`, `warnings` in the logs of slow replicas, the `load` of the machine before, and `targets`.

    Raises:
        SwiftbotError: the fleet does not come up, or does not answer any more.
    """
    with workspace("swiftbot-flood-") as folder:
        arena = Arena(
            fleet=fleet_name(),
            directory=folder,
            sites=loopback(options.gateways),
            pool=PoolConfig(floor={"base": options.containers}, capacity=options.containers + 1),
            skills=write_skill(folder, "base", handler="def run(ctx):\n    return {}\n"),
        )
        load = os.getloadavg()[0]
        try:
            await arena.start_all(progress=progress, ready=options.containers)
            async with await arena.client() as sender, await arena.client() as other:
                found = await _flood(options, arena, sender, other, progress)
        finally:
            await arena.stop(progress=progress)
        logs = "".join(path.read_text(errors="replace") for path in (folder / "logs").glob("gw-*.log"))
    found["warnings"] = logs.count('"replicas are slow"')
    found["load"] = round(load, 1)
    return found


async def _flood(
    options: Options, arena: Arena, sender: FleetClient, other: FleetClient, progress: Progress
) -> dict[str, Any]:
    began: dict[str, float] = {}

    def requests() -> Iterator[TaskRequest]:
        for number in range(options.tasks):
            task = f"flood-{os.getpid()}-{number}"
            began[task] = time.monotonic()
            yield TaskRequest(
                instruction="do nothing", id=task, submitter="flood", priority=PLAIN_PRIORITY - 1, plan=PLAN
            )

    processes = [psutil.Process(each.pid) for each in arena.processes.values()]
    memory, cpu = [each.memory_info().rss for each in processes], _cpu_s(processes)
    orders, reads = Orders(other), Reads(other)
    beside = [asyncio.create_task(each.keep_on()) for each in (orders, reads)]
    took_ms: list[float] = []
    refused: Counter[str] = Counter()
    start = time.monotonic()
    try:
        async for request, outcome in submit_all(sender, requests()):
            if isinstance(outcome, TaskRecord):
                took_ms.append((time.monotonic() - began[request.id]) * 1e3)
            else:
                refused[outcome.code] += 1
            if len(took_ms) % 500 == 0:
                progress(f"{len(took_ms):,} accepted after {time.monotonic() - start:.1f} s")
        seconds = time.monotonic() - start
        used_s = _cpu_s(processes) - cpu
        gateways = other.plane.registry.gateways
        waiting = {name: each.tasks_waiting for name, each in sorted(gateways.items())}
        unfinished = sum(each.tasks for each in gateways.values())
        grown = max(now.memory_info().rss - before for now, before in zip(processes, memory, strict=True))
        await asyncio.sleep(2 * ORDER_EVERY_S)  # the last orders start, and gateways tell how they stand
    finally:
        for each in beside:
            each.cancel()
        await asyncio.gather(*beside, return_exceptions=True)
    found: dict[str, Any] = {
        "tasks": options.tasks,
        "gateways": options.gateways,
        "accepted": len(took_ms),
        "seconds": round(seconds, 1),
        "rate_per_s": round(len(took_ms) / seconds, 1),
        "submission": summary(took_ms),
        "order_start": summary(orders.took_ms),
        "reads": summary(reads.took_ms),
        "refused": {"tasks": dict(refused), "orders": dict(orders.refused), "reads": dict(reads.refused)},
        "cpu_ms_per_task": round(used_s * 1e3 / max(1, len(took_ms)), 1),
        "memory_mb": round(grown / 2**20, 1),
        "waiting": waiting,
        "ended_meanwhile": max(0, len(took_ms) - unfinished),
    }
    return found | {"targets": targets(found)}


def _cpu_s(processes: list[psutil.Process]) -> float:
    return sum(each.cpu_times().user + each.cpu_times().system for each in processes)


def targets(found: dict[str, Any]) -> dict[str, Any]:
    """Return the promises beside what was reached."""

    def at_most(promised: float, reached: float | None) -> dict[str, Any]:
        return {"promised": promised, "reached": reached, "kept": reached is not None and reached <= promised}

    rate = found["rate_per_s"]
    lost = found["tasks"] - found["accepted"] + sum(sum(each.values()) for each in found["refused"].values())
    return {
        "rate_per_s": {"promised": RATE, "reached": rate, "kept": rate >= RATE},
        "submission_p99_ms": at_most(SUBMISSION_MS, found["submission"].get("p99")),
        "order_start_p99_ms": at_most(START_MS, found["order_start"].get("p99")),
        "memory_mb": at_most(MEMORY_MB * max(1.0, found["tasks"] / 10_000), found["memory_mb"]),
        "refused_or_lost": at_most(0, lost),
    }
