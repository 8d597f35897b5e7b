"""Rounds of a real fleet: each gateway a process, each client a run in a warm container, all on this machine.

A machine with fewer cores than clients cannot show a straggler: all clients wait for a core, and one that is slow hides
behind them. So devices are emulated, in the handler: a step takes a nominal device `nominal_batch_s`, and a slow one
several times that. The nominal time is chosen from what a step takes here so that all clients together need `BUSY` of
it at most, and what was measured counts only while no nominal client needed 10 % longer (`valid`).

Times are those at which this process hears of things, as a person at a terminal would.
"""

import asyncio
import contextlib
import itertools
import os
import shutil
import signal
import sys
import time
from collections.abc import AsyncGenerator, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import anyio
import psutil
from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import Endpoint, FleetState, Process
from appliance.errors import DeadlineError, PoolError, SwiftbotError, UnreachableError
from appliance.learn import records
from appliance.llm.settings import LlmConfig
from appliance.model import RunEvent, RunEventKind, RunRequest, keyspace
from appliance.model.learning import Clients, Emulation, Recipe, RoundRecord, RunRecord, RunState
from appliance.plane.events import FleetEvent, Lost, Stage
from appliance.plane.ring import Ring
from appliance.pool.engine import PodmanEngine
from appliance.pool.settings import PoolConfig
from appliance.skills._lib.learning import models
from appliance.skills.catalogue import load_catalogue
from appliance.tasks.orders import need_of as need_of_skill
from workshop import local_fleet
from workshop.bench.figures import summary
from workshop.bench.learning import data as data_sets
from workshop.bench.learning.cells import BUSY, speeds
from workshop.bench.learning.virtual import BY, Emulated, recipe_of
from workshop.bench.pooled import SKILL, fleet_name, need_of, workspace, write_skill
from workshop.bench.training import HANDLER, IMAGE
from workshop.local_fleet import Order

Progress = Callable[[str], None]
HERE = "gw-1"
"""Which gateway this process is connected to: none of those that are killed."""
START_S, START_EACH_S = 120.0, 20.0
ROUND_S = 120.0
"""After so long without any news a run is given up."""
EXCEEDED = 1.1
EVEN_MODES = ("sync", "partial")
"""Compared without stragglers too."""
LEARNT = 2
"""Rounds until clients' speeds are known: rounds after them are compared."""
BACK_S = 2.0
"""After so long a client's container is there again at the earliest."""
SINGLE_ROUNDS = 12
LOOK_S = 1.0
KILLED_IN = 2
"""Round whose coordinator is killed, of three."""
SKILL_S = 600.0


class Heard(NamedTuple):
    """A run of a handler: when it was heard of, by this process's clock, and its last event."""

    round: int
    subtask: str
    attempt: int
    started_at: float
    ended_at: float
    startup_ms: float
    event: RunEvent


class Watch:
    """Keeps what a fleet tells of runs of learning."""

    def __init__(self) -> None:
        self.changed = asyncio.Event()
        self.closed: dict[str, dict[int, float]] = {}
        """Run -> round -> when it was told that it is closed."""
        self.opened: dict[str, dict[int, float]] = {}
        """Run -> round -> when its cohort was told."""
        self.ended: dict[str, list[Heard]] = {}
        self.started: dict[str, list[tuple[float, int, RunEvent]]] = {}
        self.steps: list[tuple[float, str, int, str]] = []
        """When something was told of a round, of which run, its number, by which coordinator."""
        self.lost: list[tuple[float, str]] = []
        self._open: dict[tuple[str, str, int], tuple[float, float]] = {}

    def run_event(self, _: str, event: RunEvent | None) -> None:
        """Take in news of a run of a handler."""
        if event is None or (found := records.round_of(event.task)) is None:
            return
        run, number = found
        key, now = (event.task, event.subtask, event.attempt), time.monotonic()
        if event.kind is RunEventKind.STARTED:
            self._open[key] = (now, event.startup_ms or 0.0)
            self.started.setdefault(run, []).append((now, number, event))
        elif event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            began, startup_ms = self._open.pop(key, (now, 0.0))
            heard = Heard(number, event.subtask, event.attempt, began, now, startup_ms, event)
            self.ended.setdefault(run, []).append(heard)
        self.changed.set()

    def run_record(self, _: str, record: RunRecord | None) -> None:
        """Take in a run's record."""
        if record is not None and record.history:
            now = time.monotonic()
            self.closed.setdefault(record.id, {}).setdefault(record.history[-1].number, now)
            self.changed.set()

    def round_record(self, _: str, record: RoundRecord | None) -> None:
        """Take in a round's record."""
        if record is None:
            return
        now = time.monotonic()
        if record.target:
            self.opened.setdefault(record.run, {}).setdefault(record.number, now)
        self.steps.append((now, record.run, record.number, record.coordinator))
        self.changed.set()

    def fleet_event(self, event: FleetEvent) -> None:
        """Take in that a gateway has gone."""
        if isinstance(event, Lost):
            self.lost.append((time.monotonic(), event.gateway))

    def trained(self, run: str) -> list[Heard]:
        """Return the runs of clients that ended with an update."""
        return [each for each in self.ended.get(run, ()) if _is_update(each.event)]

    def summed(self, run: str) -> list[Heard]:
        """Return the aggregations that succeeded."""
        return [
            each
            for each in self.ended.get(run, ())
            if each.subtask.startswith("aggregate-") and each.event.kind is RunEventKind.SUCCEEDED
        ]


def _is_update(event: RunEvent) -> bool:
    return event.kind is RunEventKind.SUCCEEDED and "steps_of_epoch" in (event.result or {})


class Fleet:
    """A fleet of the measurement's own, and this process's connection to it."""

    def __init__(self, state: FleetState, client: FleetClient, data: Path, workload: str, clients: int) -> None:
        self.state = state
        self.client = client
        self.watch = Watch()
        self.again: list[Process] = []
        """Gateways that were started again."""
        self.workload, self.clients, self._data = workload, clients, data
        self.batch = models.read(workload).batch

    def listen(self) -> None:
        """Begin to keep what is told."""
        session = self.client.plane.session
        session.subscribe_typed(keyspace.RUN_EVENT, self.watch.run_event)
        session.subscribe_typed(keyspace.LEARN_RUN, self.watch.run_record)
        session.subscribe_typed(keyspace.LEARN_ROUND, self.watch.round_record)
        self.client.plane.events.subscribe(Stage.WATCHERS, self.watch.fleet_event)

    def recipe(
        self, mode: str, count: int, *, nominal_batch_s: float | None = None, slow: Mapping[str, float] | None = None
    ) -> Recipe:
        """Return a recipe of all clients."""
        wanted = recipe_of(self.workload, mode, clients=self.clients, count=count, data=self._data.name, seed=1)
        emulation = Emulation(nominal_batch_s=nominal_batch_s, speeds=dict(slow or {}))
        return replace(wanted, emulation=emulation)

    async def start(self, name: str, recipe: Recipe) -> None:
        """Start a run."""
        await self.client.learn_start(name, recipe)

    async def end_of(self, name: str, *, patience_s: float = ROUND_S) -> RunRecord:
        """Return a run's record when it has ended.

        Raises:
            DeadlineError: nothing was heard of it for so long; the message says what it waits for.
        """
        last, quiet_at = -1, time.monotonic()
        while True:
            record: RunRecord | None = None
            waits = ""
            with contextlib.suppress(UnreachableError, DeadlineError):  # gateways that have just come, or gone
                shown = await self.client.learn_show(name)
                record, waits = shown.run, shown.round.waits if shown.round is not None else ""
                if record.state.final:
                    break
                if record.round != last:
                    last, quiet_at = record.round, time.monotonic()
            if time.monotonic() - quiet_at > patience_s:
                raise DeadlineError(f"run {name} is in round {last} for {patience_s:.0f} s, waits for {waits or '?'}")
            await self.changes(LOOK_S)
        if record.state is not RunState.SUCCEEDED:
            raise PoolError(f"run {name} {record.state}: {record.why}")
        return record

    async def changes(self, longest_s: float) -> None:
        """Wait until something is told."""
        self.watch.changed.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(longest_s):
                await self.watch.changed.wait()

    async def until(self, found: Callable[[], bool], *, patience_s: float = ROUND_S) -> None:
        """Wait until something was heard; DeadlineError where it is not."""
        give_up = time.monotonic() + patience_s
        while not found():
            if time.monotonic() > give_up:
                raise DeadlineError(f"what the measurement waits for did not happen within {patience_s:.0f} s")
            await self.changes(0.2)

    def owner(self, run: str, number: int) -> str:
        """Return who coordinates a round while all gateways are there."""
        virtual = self.client.plane.config.virtual_nodes
        return Ring(sorted(self.state.gateways), virtual_nodes=virtual).owner(records.round_key(run, number))

    def kill(self, gateway: str) -> float:
        """Kill a gateway's process; returns when."""
        pid = self.client.plane.registry.gateways[gateway].pid
        at = time.monotonic()
        os.kill(pid, signal.SIGKILL)
        return at

    def revive(self, gateway: str) -> None:
        """Start a gateway again."""
        folder = Path(self.state.directory)
        command = (sys.executable, "-m", "appliance.cli", "gateway", "--config", str(folder / gateway / "gateway.toml"))
        self.again.append(local_fleet.spawn(gateway, command, folder / "logs" / f"{gateway}.log"))

    async def ready(self, wanted: int, *, patience_s: float = 180.0) -> None:
        """Wait until all gateways are there with so many ready containers together; DeadlineError where they do not."""
        give_up = time.monotonic() + patience_s
        while True:
            statuses = self.client.plane.registry.gateways
            there = [statuses.get(name) for name in self.state.gateways if name in self.client.plane.members()]
            known = [each for each in there if each is not None]
            if len(known) == len(self.state.gateways) and sum(each.ready for each in known) >= wanted:
                return
            if time.monotonic() > give_up:
                raise DeadlineError(f"{len(known)} gateways, {sum(each.ready for each in known)} containers are ready")
            await asyncio.sleep(0.1)

    async def run(self, gateway: str, skill: str, params: dict[str, Any], *, memory: bool = False) -> dict[str, Any]:
        """Run a skill at a gateway and return its result; PoolError where it fails."""
        name = f"n{time.monotonic_ns()}"
        ended: asyncio.Future[RunEvent] = asyncio.get_running_loop().create_future()

        def hear(_: str, event: RunEvent | None) -> None:
            if event is not None and event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED) and not ended.done():
                ended.set_result(event)

        hearing = self.client.plane.session.subscribe_typed(keyspace.RUN_EVENT, hear, "bench", name)
        need = need_of(IMAGE) if memory else need_of_skill(load_catalogue().skills[skill])
        request = RunRequest(
            task="bench", subtask=name, attempt=1, skill=skill, need=need, params=params, deadline_s=600.0
        )
        try:
            await self.client.plane.rpc.call(gateway, keyspace.RUN, request, timeout_s=60.0)
            async with asyncio.timeout(SKILL_S):
                event = await ended
        finally:
            hearing.close()
        if event.kind is not RunEventKind.SUCCEEDED or event.result is None:
            raise PoolError(f"{skill}: {event.failure.message if event.failure else 'it failed'}")
        return event.result


@asynccontextmanager
async def fleet(settings: Mapping[str, Any], data: Path, progress: Progress) -> AsyncGenerator[Fleet]:
    """A fleet with a container for each client, whose data are decoded already; all gone afterwards."""
    clients, gateways = int(settings["clients"]), int(settings["gateways"])
    each = -(-clients // gateways)
    with workspace() as folder:
        skills = write_skill(folder, IMAGE, handler=HANDLER)
        names = [f"gw-{number + 1}" for number in range(gateways)]
        decoded = data.parent.parent / "pool" / "data" / "cache" / IMAGE
        if linked := await anyio.Path(decoded).is_dir():
            for name in names:
                target = folder / "fleet" / name / "data" / "cache" / IMAGE
                await anyio.to_thread.run_sync(_link_tree, decoded, target)
        order = Order(
            fleet=fleet_name(),
            directory=folder / "fleet",
            gateways=gateways,
            mavlink=0,
            zenoh=0,
            pool=PoolConfig(
                floor={IMAGE: each}, capacity=each + 1, memory_mb=512 * (each + 1),
                folders={"learning": str(data.parent)},
            ),
            base=GatewayConfig(id="base", llm=LlmConfig(tiers=("rules",)), skills=(str(skills),)),
        )  # fmt: skip
        state = await local_fleet.up(order, progress=progress, timeout_s=START_S + START_EACH_S * clients)
        made: Fleet | None = None
        try:
            near = Endpoint(fleet=state.fleet, connect=(state.endpoints[0],))
            async with FleetClient(near) as client:
                made = Fleet(state, client, data, str(settings["workload"]), clients)
                made.listen()
                await made.ready(clients)
                for name in names if not linked else ():
                    progress(f"decoding data on {name}")
                    asked = {"model": made.workload, "data": {"name": data.name}, "split": "train"}
                    await made.run(name, "evaluate", asked)
                yield made
        finally:
            with anyio.CancelScope(shield=True):
                if made is not None:
                    await local_fleet.end(made.again, grace_s=20.0)
                await local_fleet.down(order.directory, progress=progress, volumes=True)


def _link_tree(source: Path, target: Path) -> None:
    """Give a gateway what was decoded before, as links where the file system can."""

    def link(one: str, other: str) -> None:
        try:
            os.link(one, other)
        except OSError:
            shutil.copyfile(one, other)

    shutil.copytree(source, target, copy_function=link, dirs_exist_ok=True)


# --- what is measured


async def _single(it: Fleet, progress: Progress) -> tuple[float, dict[str, Any]]:
    """Train with one client at a time; returns what a step takes, seconds, and the times of warm starts."""
    progress("one client at a time")
    recipe = it.recipe("sync", SINGLE_ROUNDS)
    one_each = Clients(partitions=it.clients, by=BY, per_round=1)
    await it.start("single", replace(recipe, clients=one_each))
    await it.end_of("single")
    found = [each for each in it.watch.trained("single") if each.round > LEARNT]
    results = [each.event.result or {} for each in found]
    batch_s = median(float(each["train_s"]) / int(each["steps"]) for each in results)
    return batch_s, {
        "batch_ms": round(batch_s * 1e3, 2),
        "start_ms": summary([each.startup_ms for each in found]),
        "first_step_ms": summary([float(each["first_step_s"]) * 1e3 for each in results]),
    }


def nominal_batch_s(batch_s: float, clients: int) -> float:
    """Return what a step takes a nominal device: this machine needs `BUSY` of it at most for all clients together."""
    return clients * batch_s / (psutil.cpu_count() or 1) / BUSY


def exceeded(found: Iterable[Heard], slow: Mapping[str, float], nominal_s: float) -> tuple[int, int]:
    """Return how many runs of nominal devices took 10 % longer than those do, and how many runs there were."""
    late = total = 0
    for each in found:
        result = each.event.result or {}
        if each.subtask in slow or "." in each.subtask:
            continue
        total += 1
        late += float(result["train_s"]) > EXCEEDED * int(result["steps"]) * nominal_s
    return late, total


async def wall(settings: Mapping[str, Any], data: Path, progress: Progress) -> dict[str, Any]:
    """Measure rounds of emulated devices by the clock, in all modes on one fleet and with one nominal time.

    Returns:
        `runs`: by mode, and with `-even` behind it without stragglers: `round_s` of each round, `p50_s` of those after
        the first `LEARNT`, `virtual_p50_s` of the same in virtual time, `valid`, and how many runs of nominal clients
        took too long (`exceeded`) of `nominal_runs`; `single`: as of `costs`.
    """
    runs: dict[str, Any] = {}
    held = await anyio.to_thread.run_sync(
        lambda: data_sets.samples(data, by=BY, clients=int(settings["clients"]), seed=1)
    )
    async with fleet(settings, data, progress) as it:
        batch_s, single = await _single(it, progress)
        nominal_s = nominal_batch_s(batch_s, it.clients)
        wanted = [(str(mode), mode, True) for mode in settings["modes"]]
        wanted += [(f"{mode}-even", mode, False) for mode in EVEN_MODES]
        for name, mode, stragglers in wanted:
            slow = speeds(it.clients, stragglers=stragglers)
            progress(f"{name}: {settings['rounds']} rounds, a nominal step takes {nominal_s * 1e3:.0f} ms")
            recipe = it.recipe(mode, int(settings["rounds"]), nominal_batch_s=nominal_s, slow=slow)
            await it.start(name, recipe)
            record = await it.end_of(name, patience_s=ROUND_S + 100 * nominal_s * it.batch)
            runs[name] = _by_clock(it, name, recipe, record, held)
    return {"nominal_batch_s": round(nominal_s, 4), "runs": runs, "single": single}


def _by_clock(it: Fleet, name: str, recipe: Recipe, record: RunRecord, held: Sequence[int]) -> dict[str, Any]:
    """Return the times of a run's rounds, beside those of the same rounds in virtual time."""
    slow, nominal_s = recipe.emulation.speeds, recipe.emulation.nominal_batch_s or 0.0
    late, total = exceeded(it.watch.trained(name), slow, nominal_s)
    took = [line.took_s for line in record.history]
    virtual = Emulated(recipe, held, slow, it.batch, nominal_batch_s=nominal_s).play().took_s
    return {
        "round_s": took,
        "period_s": [round(each, 3) for each in _periods(it.watch, name)],
        "p50_s": round(median(took[LEARNT:] or took), 3),
        "virtual_p50_s": round(median(virtual[LEARNT:] or virtual), 3),
        "valid": late == 0,
        "exceeded": late,
        "nominal_runs": total,
        "closed_by": [line.why for line in record.history],
    }


def _periods(watch: Watch, run: str) -> list[float]:
    """Return the times from one round's close to the next's."""
    at = [watch.closed.get(run, {}).get(number) for number in sorted(watch.closed.get(run, {}))]
    known = [each for each in at if each is not None]
    return [later - earlier for earlier, later in itertools.pairwise(known)]


def overheads(watch: Watch, run: str) -> list[dict[str, float]]:
    """Return of each round but the first where its time went beyond its slowest client, milliseconds.

    `whole`: from the close before to the close, less the longest training of a client. Its parts: `open` from the close
    before to the cohort being told, `start` to the last first line of a handler, `before` training and `after` it in
    the handler of the client that ended last, `news` to the start of the sum, `sum` the handler's run, `close` from
    its end to the round's.
    """
    found: list[dict[str, float]] = []
    closed, opened = watch.closed.get(run, {}), watch.opened.get(run, {})
    for number in sorted(closed):
        clients = [each for each in watch.trained(run) if each.round == number]
        sums = [each for each in watch.summed(run) if each.round == number]
        if number - 1 not in closed or number not in opened or not clients or not sums:
            continue
        longest_s = max(float((each.event.result or {})["train_s"]) for each in clients)
        last = max(clients, key=lambda each: each.ended_at)
        handler_s = last.ended_at - last.started_at - float((last.event.result or {})["train_s"])
        parts = {
            "whole": closed[number] - closed[number - 1] - longest_s,
            "open": opened[number] - closed[number - 1],
            "start": max(each.started_at for each in clients) - opened[number],
            "handler": handler_s,
            "news": sums[-1].started_at - last.ended_at,
            "sum": sums[-1].ended_at - sums[-1].started_at,
            "close": closed[number] - sums[-1].ended_at,
        }
        found.append({name: round(each * 1e3, 1) for name, each in parts.items()})
    return found


def _middle(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: round(median(each[name] for each in found), 1) for name in (found[0] if found else ())}


async def costs(settings: Mapping[str, Any], data: Path, progress: Progress) -> dict[str, Any]:
    """Measure what a round costs beside training, and memory.

    Returns:
        `single`: warm starts with one client at a time; `emulated` and `plain` (no emulation): `round_s`, and
        `overhead_ms` with its parts (`overheads`), medians; `container_mb`: private and shared memory of a container
        that has trained; `peak_mb` of clients' and aggregators' runs; `update_bytes`.
    """
    rounds = int(settings["rounds"])
    async with fleet(settings, data, progress) as it:
        batch_s, single = await _single(it, progress)
        nominal_s = nominal_batch_s(batch_s, it.clients)
        result: dict[str, Any] = {"single": single, "nominal_batch_s": round(nominal_s, 4)}
        for name, nominal in (("plain", None), ("emulated", nominal_s)):
            progress(f"{rounds} rounds, {name}")
            await it.start(name, it.recipe("sync", rounds, nominal_batch_s=nominal))
            record = await it.end_of(name)
            late, total = exceeded(it.watch.trained(name), {}, nominal) if nominal else (0, 0)
            parts = overheads(it.watch, name)
            periods = _periods(it.watch, name)
            result[name] = {
                "round_s": [line.took_s for line in record.history],
                "p50_s": round(median(periods), 3),
                "overhead_ms": _middle(parts),
                "overheads_ms": [each["whole"] for each in parts],
                "exceeded": late,
                "nominal_runs": total,
                "valid": late == 0,
            }
        held = await it.run(HERE, SKILL, {}, memory=True)
        result["container_mb"] = {
            "private": round(held["Pss_Anon"] / 1024, 1),
            "files": round(held["Pss_File"] / 1024, 1),
        }
        every = [*it.watch.trained("plain"), *it.watch.trained("emulated")]
        sums = [*it.watch.summed("plain"), *it.watch.summed("emulated")]
        result["peak_mb"] = {
            "train_local": max((each.event.peak_mb or 0.0 for each in every), default=0.0),
            "aggregate": max((each.event.peak_mb or 0.0 for each in sums), default=0.0),
        }
        last = every[-1].event.result or {}
        result["update_bytes"] = sum(int(each["bytes"]) for each in last["shards"])
    return result


async def takeover(settings: Mapping[str, Any], data: Path, progress: Progress) -> dict[str, Any]:
    """Kill the coordinator of round 2 of 3, in one phase of it, several times.

    Returns:
        `kills`: each with `detected_ms` after the kill, `next_step_ms` after detection, and whether the rounds' digests
        are those of an undisturbed run (`same`).
    """
    phase, count = str(settings["phase"]), int(settings["kills"])
    kills: list[dict[str, Any]] = []
    async with fleet(settings, data, progress) as it:
        recipe = it.recipe("sync", 3)
        await it.start("calm", recipe)
        calm = [line.digest for line in (await it.end_of("calm")).history]
        for number in range(count):
            progress(f"kill {number + 1} of {count}, {phase} the sum")
            name = next(
                name for name in (f"k{number}-{salt}" for salt in range(1000)) if it.owner(name, KILLED_IN) != HERE
            )
            victim = it.owner(name, KILLED_IN)
            await it.start(name, recipe)
            await it.until(lambda name=name: _reached(it, name, phase))
            at = it.kill(victim)
            await it.until(
                lambda victim=victim, at=at: any(when >= at and who == victim for when, who in it.watch.lost)
            )
            detected = next(when for when, who in it.watch.lost if when >= at and who == victim)
            record = await it.end_of(name)
            steps = (
                when
                for when, run, its, who in it.watch.steps
                if (run, who not in ("", victim)) == (name, True) and its >= KILLED_IN and when >= at
            )
            next_step = next(steps, None)
            digests = [line.digest for line in record.history]
            kills.append(
                {
                    "detected_ms": round((detected - at) * 1e3, 1),
                    "next_step_ms": None if next_step is None else round((next_step - detected) * 1e3, 1),
                    "same": digests == calm,
                    "rounds": [line.number for line in record.history],
                    "clients": [line.clients for line in record.history],
                }
            )
            it.revive(victim)
            await it.ready(it.clients)
    return {"phase": phase, "kills": kills}


def _reached(it: Fleet, run: str, phase: str) -> bool:
    """Whether round 2 of a run is where its coordinator is to be killed."""
    if phase == "before":
        return sum(each.round == KILLED_IN for each in it.watch.trained(run)) >= it.clients // 2
    if phase == "during":
        started = it.watch.started.get(run, ())
        return any(number == KILLED_IN and event.subtask.startswith("aggregate-") for _, number, event in started)
    return any(each.round == KILLED_IN for each in it.watch.summed(run))


async def restart(settings: Mapping[str, Any], data: Path, progress: Progress) -> dict[str, Any]:
    """Kill all gateways in a round, start them again, and see that the run ends with the models of a calm one."""
    at = int(settings["round"])
    async with fleet(settings, data, progress) as it:
        recipe = it.recipe("sync", at + 2)
        await it.start("calm", recipe)
        calm = [line.digest for line in (await it.end_of("calm")).history]
        await it.start("one", recipe)
        await it.until(lambda: at - 1 in it.watch.closed.get("one", {}))
        progress(f"all gateways are killed in round {at}")
        killed = time.monotonic()
        for name in it.state.gateways:
            it.kill(name)
        for name in it.state.gateways:
            it.revive(name)
        async with await _reached_again(it.state) as client:
            it.client = client
            it.listen()
            shown = (await client.learn_show("one")).run.round
            record = await it.end_of("one")
            first = next((line for line in record.history if line.number == at), None)
            back = it.watch.closed.get("one", {}).get(at)
            return {
                "killed_in_round": at,
                "went_on_in_round": shown,
                "round_closed_s": None if back is None else round(back - killed, 2),
                "same": [line.digest for line in record.history] == calm,
                "round_s": first.took_s if first is not None else None,
            }


async def _reached_again(state: FleetState) -> FleetClient:
    give_up = time.monotonic() + START_S
    while True:
        with contextlib.suppress(SwiftbotError):
            client = await FleetClient(state.endpoint).open()
            if len(client.plane.members()) == len(state.gateways):
                return client
            await client.close()
        if time.monotonic() > give_up:
            raise DeadlineError(
                f"the gateways are not back within {START_S:.0f} s", remedy=f"see {state.directory}/logs"
            )
        await asyncio.sleep(0.2)


async def clients_killed(settings: Mapping[str, Any], data: Path, progress: Progress) -> dict[str, Any]:
    """Kill the containers of a quarter of the clients in some rounds; another container is there after `BACK_S`.

    Returns:
        `loss` of each round, and `calm_loss` of the undisturbed run; `longest`: the longest round in that of the
        undisturbed run; `counted`: clients of each round; `killed`: containers in each.
    """
    rounds, at = int(settings["rounds"]), {int(each) for each in settings["killed_at"]}
    quarter = max(1, int(settings["clients"]) // 4)
    killed: dict[int, int] = {}
    engine = PodmanEngine(threads=2)
    try:
        async with fleet(settings, data, progress) as it:
            batch_s, _ = await _single(it, progress)
            nominal_s = nominal_batch_s(batch_s, it.clients)
            recipe = it.recipe("partial", rounds, nominal_batch_s=nominal_s)
            await it.start("calm", recipe)
            calm = await it.end_of("calm")
            await it.start("one", recipe)
            for number in sorted(at):
                await it.until(
                    lambda number=number: (
                        len(_working(it, "one", number)) >= quarter or number in it.watch.closed.get("one", {})
                    )
                )
                victims = sorted(_working(it, "one", number).items())[:quarter]
                progress(f"round {number}: {len(victims)} containers are killed")
                for _, container in victims:
                    with contextlib.suppress(SwiftbotError):
                        await engine.remove(container)
                killed[number] = len(victims)
            record = await it.end_of("one")
            late, total = exceeded([*it.watch.trained("calm"), *it.watch.trained("one")], {}, nominal_s)
    finally:
        engine.close()
    calm_p50 = median(line.took_s for line in calm.history[LEARNT:] or calm.history)
    pairs = [(line.loss or 0.0, other.loss or 0.0) for line, other in zip(record.history, calm.history, strict=True)]
    return {
        "killed": {str(number): count for number, count in killed.items()},
        "loss": [round(one, 5) for one, _ in pairs],
        "calm_loss": [round(other, 5) for _, other in pairs],
        "most_apart": round(max(abs(one - other) / max(1e-9, other) for one, other in pairs), 4),
        "round_s": [line.took_s for line in record.history],
        "calm_round_s": [line.took_s for line in calm.history],
        "longest": round(max(line.took_s for line in record.history[1:]) / calm_p50, 3),
        "counted": [line.clients for line in record.history],
        "valid": late == 0,
        "exceeded": late,
        "nominal_runs": total,
    }


def _working(it: Fleet, run: str, number: int) -> dict[str, str]:
    """Return the containers of clients that train for a round now, by client."""
    ended = {(each.subtask, each.attempt) for each in it.watch.ended.get(run, ()) if each.round == number}
    return {
        event.subtask: event.container
        for _, its, event in it.watch.started.get(run, ())
        if its == number
        and event.container
        and not event.subtask.startswith(("aggregate", "evaluate"))
        and (event.subtask, event.attempt) not in ended
    }
