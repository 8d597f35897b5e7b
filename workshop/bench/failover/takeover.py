"""Gateways that coordinate running tasks are killed, and frozen: how soon it is noticed, and who goes on.

A killed process is noticed by its connections, at once; a frozen one (SIGSTOP, a machine that hangs) by its silence,
after `plane.lease_ms`. The third way is a kill while another gateway, which has copies of the tasks and takes none of
them over, is frozen: the successors see that one and hear nothing of it, and must not wait for long.

Survivors say in their logs when they lost a gateway, and the successor when the record is written by which it drives
the task: a client that was linked to the lost one hears nothing at just that moment. In the end each task must have
succeeded, each subtask must have ended exactly once, and where two coordinators have told of one end both must have the
same record once they have met.
"""

import asyncio
import contextlib
import json
import signal
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.errors import DeadlineError, SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.model import Plan, Subtask, SubtaskState, TaskRecord, TaskRequest, TaskState, keyspace
from appliance.model.task_api import TaskAsk
from appliance.plane.ring import Ring
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.tasks.machine import Transition, TransitionKind
from appliance.tasks.records import task_key
from workshop.bench.chaos.arena import Arena, Progress, loopback
from workshop.bench.figures import summary
from workshop.bench.pooled import SKILL, fleet_name, workspace, write_skill

LOOK_S = 0.005
"""Between two looks at a file."""


class LogTail:
    """The lines of a log file from where it ends now, decoded; lines that are no JSON are left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = path.stat().st_size if path.exists() else 0
        self._rest = b""
        self._unread: list[dict[str, Any]] = []

    def read(self) -> list[dict[str, Any]]:
        """The lines that have come since, and those that `until` left."""
        found, self._unread = [*self._unread, *self._new()], []
        return found

    def _new(self) -> list[dict[str, Any]]:
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._at)
            found = file.read()
        self._at += len(found)
        *lines, self._rest = (self._rest + found).split(b"\n")
        decoded: list[dict[str, Any]] = []
        for line in lines:
            try:
                each = json.loads(line)
            except ValueError:
                continue
            if isinstance(each, dict):
                decoded.append(each)  # pyright: ignore[reportUnknownArgumentType]
        return decoded

    async def until(self, wanted: Callable[[dict[str, Any]], bool], what: str, *, wait_s: float) -> dict[str, Any]:
        """The next line that is wanted, without those before it; DeadlineError, which says `what`, after `wait_s`."""
        give_up = time.monotonic() + wait_s
        while time.monotonic() < give_up:
            lines = self.read()
            for number, line in enumerate(lines):
                if wanted(line):
                    self._unread = lines[number + 1 :]
                    return line
            await asyncio.sleep(LOOK_S)
        raise DeadlineError(f"{what}: not in {self._path} within {wait_s:g} s", remedy="see the end of that file")


def wall_s(line: dict[str, Any]) -> float:
    """When a line was written, Unix seconds of the machine that all processes share."""
    return datetime.fromisoformat(str(line["timestamp"])).timestamp()


STEP_S = 120.0
ENDED_S = 2.0
"""After so long it is asked whether tasks that nobody has taken over had ended before: a takeover takes a second."""
MEET_S = 10.0
"""For how long two coordinators that have both told of a run's end may still have different records of its task."""
GOAL_MS = 1000.0
COPIES = PlaneConfig().replicas
_PARAMETER = """
retries = 5

[params.service_ms]
type = "number"
required = true
"""


class Options(Struct, frozen=True, kw_only=True):
    """What to measure."""

    gateways: int = 8
    kills: int = 10
    freezes: int = 5
    silents: int = 3
    """Kills while another holder of the tasks' records is frozen."""
    tasks: int = 8
    """Under way at the same time, of two subtasks each."""
    sleep_ms: float = 3000.0
    lease_ms: int = 1000
    image: str = "base"
    secured: bool = False


class Heard:
    """Which runs have succeeded, as it is published: heard by several clients, each linked to another gateway.

    What is published while a client's own gateway is lost, and until it is linked to the next, that client misses.
    """

    def __init__(self, clients: Sequence[FleetClient]) -> None:
        self._ended: dict[tuple[str, str], dict[int, set[tuple[str, int]]]] = {}
        """Task and subtask -> attempts that succeeded -> who has told so, as which transition of the record."""
        self._closers = [client.plane.session.subscribe_typed(keyspace.TRANSITION, self._take) for client in clients]

    def _take(self, _: str, transition: Transition | None) -> None:
        if transition is not None:
            self.hear(transition)

    def hear(self, told: Transition) -> None:
        """Take note of a transition; the same one may come from several clients."""
        if told.kind is TransitionKind.SUCCEEDED:
            attempts = self._ended.setdefault((told.task, told.subtask), {})
            attempts.setdefault(told.attempt, set()).add((told.coordinator, told.sequence))

    def run_twice(self, tasks: Sequence[str]) -> list[str]:
        """The subtasks of these tasks of which more than one attempt has succeeded, with who told so."""
        return [
            f"{task}/{subtask} succeeded in attempts {attempts}"
            for (task, subtask), attempts in self._ended.items()
            if task in tasks and len(attempts) > 1
        ]

    def told_twice(self, tasks: Sequence[str]) -> list[str]:
        """Those of which one attempt's end was written by two coordinators: they did not see each other."""
        return [
            f"{task}/{subtask} attempt {attempt}: {', '.join(f'{name} #{number}' for name, number in sorted(who))}"
            for (task, subtask), attempts in self._ended.items()
            for attempt, who in attempts.items()
            if task in tasks and len(who) > 1
        ]

    def tellers(self, tasks: Sequence[str]) -> dict[str, set[str]]:
        """The tasks of which one attempt's end was written by two coordinators, with these."""
        found: dict[str, set[str]] = {}
        for (task, _), attempts in self._ended.items():
            for who in attempts.values():
                if task in tasks and len(who) > 1:
                    found.setdefault(task, set()).update(name for name, _ in who)
        return found

    def close(self) -> None:
        """Listen no more."""
        for closer in self._closers:
            closer.close()


def holder_without_a_part(ring: Ring, victim: str, tasks: Sequence[str]) -> str:
    """A gateway with copies of these tasks that takes none of them over from the victim; "": there is none."""
    left = ring.without_member(victim)
    heirs = {left.owner(task_key(task)) for task in tasks}
    holders = Counter(name for task in tasks for name in left.successors(task_key(task), COPIES) if name not in heirs)
    return min(holders, key=lambda name: (-holders[name], name), default="")


async def apart(
    tellers: Mapping[str, Collection[str]],
    read: Callable[[str, str], Awaitable[TaskRecord]],
    *,
    tries: int = round(MEET_S / LOOK_S),
    pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
) -> list[str]:
    """Read tasks' records from all their coordinators; returns those that stay different, or cannot be read, and how.

    Args:
        tellers: task -> the coordinators that have told of it.
        read: a task's record as a gateway has it: gateway, task.
        tries: how often they are read before that is taken as it is.
        pause: waits so many seconds between two tries.
    """
    wrong: list[str] = []
    for task, gateways in tellers.items():
        problem = ""
        for _ in range(tries):
            problem = await _difference(sorted(gateways), task, read)
            if not problem:
                break
            await pause(LOOK_S)
        if problem:
            wrong.append(f"{task} has no one record: {problem}")
    return wrong


async def _difference(gateways: Sequence[str], task: str, read: Callable[[str, str], Awaitable[TaskRecord]]) -> str:
    try:
        records = {name: await read(name, task) for name in gateways}
    except SwiftbotError as error:
        return str(error)
    if all(each == records[gateways[0]] for each in records.values()):
        return ""
    return ", ".join(f"{name} {each.state} #{each.sequence} of {each.coordinator}" for name, each in records.items())


class Adoption(Struct, frozen=True, kw_only=True):
    """A takeover of a task, as the successor's log tells it; times are Unix seconds."""

    by: str
    at: float
    """When the record with the new coordinator was written."""
    wrote_ms: float
    settled: tuple[float, ...]
    """When shards were compared for a loss, before it."""

    def parts(self, seen_at: float) -> dict[str, float]:
        """What the time since the loss was seen went into, ms.

        `settled`: its shard compared with the others'; `taken_up`: until the driver of the task began to write;
        `written`: the record with the new coordinator.
        """
        settled_at = next((each for each in self.settled if each >= seen_at), seen_at)
        return {
            "settled": (settled_at - seen_at) * 1e3,
            "taken_up": max(0.0, (self.at - settled_at) * 1e3 - self.wrote_ms),
            "written": self.wrote_ms,
        }


def adoptions(lines: Mapping[str, Sequence[dict[str, Any]]], victim: str) -> dict[str, Adoption]:
    """The first takeover of each task from a gateway; `lines` of logs since then, by gateway."""
    found: dict[str, Adoption] = {}
    for name, log in lines.items():
        settled: list[float] = []
        for line in log:
            if line.get("event") == "shard settled" and line.get("why") == "loss":
                settled.append(wall_s(line))
            elif line.get("event") == "task adopted" and line.get("before") == victim:
                task, at = str(line["task"]), wall_s(line)
                if task not in found or at < found[task].at:
                    found[task] = Adoption(by=name, at=at, wrote_ms=float(line["wrote_ms"]), settled=tuple(settled))
    return found


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure kills, then freezes, then kills with a silent member; all processes and containers are gone afterwards.

    Returns:
        For `kill`, `freeze` and `silent`: `detected` by the successor and `detected_by_all`, ms after the signal;
        `adopted`, ms after the successor's detection, and the parts of that (`settled`, `taken_up`, `written`); and
        counts of tasks.
    """
    result: dict[str, Any] = {"gateways": options.gateways, "lease_ms": options.lease_ms, "goal_ms": GOAL_MS}
    with workspace() as folder:
        skills = write_skill(folder, options.image, more=_PARAMETER)
        base = GatewayConfig(
            id="gw-1", llm=LlmConfig(tiers=("rules",)), plane=PlaneConfig(lease_ms=options.lease_ms), drain_s=5.0
        )
        arena = Arena(
            fleet=fleet_name(), directory=folder / "fleet", base=base,
            sites=loopback(options.gateways, secured=options.secured),
            pool=PoolConfig(floor={options.image: 1}, capacity=3), skills=skills,
        )  # fmt: skip
        try:
            await arena.start_all(progress=progress, ready=1)
            # Each takes the first endpoint that answers: with one gateway lost at a time never the same one.
            half = len(arena.endpoints) // 2
            turned = (*arena.endpoints[half:], *arena.endpoints[:half])
            async with await arena.client() as client, await arena.client(turned) as other:
                rounds = _Rounds(options, arena, (client, other), progress)
                if options.kills:
                    result["kill"] = await rounds.run("kill", options.kills)
                if options.freezes:
                    result["freeze"] = await rounds.run("freeze", options.freezes)
                if options.silents:
                    result["silent"] = await rounds.run("silent", options.silents)
        finally:
            await arena.stop(progress=progress)
    return result


class _Rounds:
    def __init__(self, options: Options, arena: Arena, clients: Sequence[FleetClient], progress: Progress) -> None:
        self._options = options
        self._arena = arena
        self._client = clients[0]
        self._clients = clients
        self._progress = progress

    async def run(self, how: Literal["kill", "freeze", "silent"], rounds: int) -> dict[str, Any]:
        """Lose so many coordinators, one after the other."""
        heard = Heard(self._clients)
        detected: list[float] = []
        by_all: list[float] = []
        adopted: list[float] = []
        parts: dict[str, list[float]] = {"settled": [], "taken_up": [], "written": []}
        tasks = ended_before = 0
        problems: list[str] = []
        told_twice: list[str] = []
        for number in range(rounds):
            names = await self._submit(f"{how}-{number}")
            records = await self._running(names)
            roots = Counter(each.coordinator for each in records)
            victim = roots.most_common(1)[0][0]
            theirs = [each.id for each in records if each.coordinator == victim]
            mute = holder_without_a_part(self._client.plane.ring, victim, theirs) if how == "silent" else ""
            tails = {
                name: LogTail(self._arena.directory / "logs" / f"{name}.log")
                for name in self._arena.names
                if name not in (victim, mute)
            }
            if mute:
                self._arena.signal(mute, signal.SIGSTOP)
            at = time.time()
            if how == "freeze":
                self._arena.signal(victim, signal.SIGSTOP)
            else:
                await self._arena.kill(victim)
            lost = await self._lost(tails, victim)
            by_all.append((max(lost.values()) - at) * 1e3)
            taken = await self._adopted(tails, theirs, victim)
            ended_before += len(theirs) - len(taken)
            for each in taken.values():
                seen_at = lost[each.by]
                detected.append((seen_at - at) * 1e3)
                adopted.append((each.at - seen_at) * 1e3)
                for part, took_ms in each.parts(seen_at).items():
                    parts[part].append(took_ms)
            self._progress(
                f"{how} {number + 1} of {rounds}: {victim} with {len(theirs)} tasks"
                f"{f', {mute} silent' if mute else ''}, seen after {by_all[-1]:.0f} ms, "
                + (f"adopted {adopted[-1]:.0f} ms later" if taken else "which had ended before")
            )
            for each in (victim if how == "freeze" else "", mute):
                if each:
                    self._arena.signal(each, signal.SIGCONT)
            problems += await self._ended(heard, names)
            told_twice += heard.told_twice(names)
            tasks += len(names)
            if how != "freeze":
                self._arena.start(victim)
            await self._arena.settled(self._client, ready=0)
            problems += await apart(heard.tellers(names), self._record)
        heard.close()
        if not adopted:
            raise DeadlineError(
                "every task had ended before its coordinator was lost", remedy="give --sleep-ms more than on this run"
            )
        return {
            "rounds": rounds,
            "tasks": tasks,
            "tasks_ended_before": ended_before,
            "tasks_taken_over": len(adopted),
            "not_exactly_once": problems,
            "told_by_two": told_twice,
            "detected": summary(detected),
            "detected_by_all": summary(by_all),
            "adopted_after_detection": summary(adopted),
            "parts": {part: summary(took_ms) for part, took_ms in parts.items()},
        }

    async def _record(self, gateway: str, task: str) -> TaskRecord:
        """A task's record as a gateway has it."""
        return await self._client.plane.rpc.call(gateway, keyspace.TASK, TaskAsk(id=task))

    async def _submit(self, prefix: str) -> list[str]:
        steps = (
            Subtask(id="s1", skill=SKILL, params={"service_ms": self._options.sleep_ms}),
            Subtask(id="s2", skill=SKILL, params={"service_ms": 1.0}, after=("s1",)),
        )
        names = [f"{prefix}-{number}" for number in range(self._options.tasks)]
        for name in names:
            plan = Plan(domain="coordination", subtasks=steps)
            await self._client.submit(TaskRequest(id=name, instruction=name, plan=plan))
        return names

    async def _running(self, names: list[str]) -> list[TaskRecord]:
        """Wait until each task has a run under way."""
        give_up = time.monotonic() + STEP_S
        while True:
            records = [await self._client.task(name) for name in names]
            under_way = [
                each
                for each in records
                if each.subtasks and each.subtasks[0].state is SubtaskState.RUNNING and not each.state.final
            ]
            if len(under_way) >= len(names) // 2 or (under_way and time.monotonic() > give_up - STEP_S / 2):
                return under_way
            failed = [each for each in records if each.failure is not None]
            if failed or all(each.state.final for each in records) or time.monotonic() > give_up:
                states = Counter(str(each.state) for each in records)
                why = failed[0].failure.message if failed and failed[0].failure is not None else ""
                raise DeadlineError(f"the tasks do not run: {dict(states)} {why}", remedy="see the gateways' logs")
            await asyncio.sleep(0.05)

    async def _lost(self, tails: dict[str, LogTail], victim: str) -> dict[str, float]:
        """When each survivor noticed."""

        def is_loss(line: dict[str, Any]) -> bool:
            return line.get("event") == "gateway lost" and line.get("member") == victim

        lines = await asyncio.gather(
            *(tail.until(is_loss, f"{name} loses {victim}", wait_s=STEP_S) for name, tail in tails.items())
        )
        return {name: wall_s(line) for name, line in zip(tails, lines, strict=True)}

    async def _adopted(self, tails: dict[str, LogTail], tasks: list[str], victim: str) -> dict[str, Adoption]:
        """Wait until each of these tasks has been taken over, by the successors' own logs, or had ended before."""
        lines: dict[str, list[dict[str, Any]]] = {name: [] for name in tails}
        give_up = time.monotonic() + STEP_S
        look_at = time.monotonic() + ENDED_S
        while True:
            for name, tail in tails.items():
                lines[name] += tail.read()
            found = adoptions(lines, victim)
            missing = [task for task in tasks if task not in found]
            if time.monotonic() > look_at:
                ended = [task for task in missing if await self._had_ended(task, victim)]
                tasks = [task for task in tasks if task not in ended]
                missing = [task for task in missing if task not in ended]
                look_at = time.monotonic() + ENDED_S
            if not missing:
                return {task: found[task] for task in tasks}
            if time.monotonic() > give_up:
                raise DeadlineError(
                    f"nobody took {', '.join(missing)} over from {victim} within {STEP_S:g} s",
                    remedy="see the gateways' logs",
                )
            await asyncio.sleep(LOOK_S)

    async def _had_ended(self, task: str, victim: str) -> bool:
        """Whether a task had ended under its coordinator, while the benchmark was about to end that."""
        with contextlib.suppress(SwiftbotError):
            record = await self._client.task(task)
            return record.state.final and record.coordinator == victim
        return False

    async def _ended(self, heard: Heard, names: list[str]) -> list[str]:
        """Wait for the end of all tasks; returns those that did not succeed once and for all."""
        give_up = time.monotonic() + STEP_S
        records: list[TaskRecord] = []
        for name in names:
            while True:
                try:
                    record = await self._client.task(name)
                except SwiftbotError as error:
                    if time.monotonic() > give_up:
                        raise DeadlineError(f"{name} cannot be read: {error}") from error
                else:
                    if record.state.final:
                        break
                    if time.monotonic() > give_up:
                        raise DeadlineError(f"{name} did not end: {record.state}", remedy="see the gateways' logs")
                await asyncio.sleep(0.1)
            records.append(record)
        await asyncio.sleep(0.2)  # what was published with the last records arrives
        wrong = [f"{each.id} {each.state}" for each in records if each.state is not TaskState.SUCCEEDED]
        return wrong + heard.run_twice(names)
