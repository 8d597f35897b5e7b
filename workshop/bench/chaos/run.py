"""Runs tasks on a fleet whose gateways are killed, stopped and started again, and checks what became of them.

At most r-1 gateways are down at once, which is what replication is made for: then nothing that was accepted may be
lost. With `down_at_once` more can be told to be down; then too nothing may be lost in the end, since every gateway
comes back with its disk, but tasks may stand still until one that holds their record is back.
"""

import asyncio
import contextlib
import shutil
import signal
import tempfile
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from appliance.client import FleetClient
from appliance.errors import NotFoundError, SwiftbotError
from appliance.learn.decisions import all_traced
from appliance.model import LogLine, TaskRecord, TaskRequest, keyspace
from appliance.model.roles import Role
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.tasks.machine import Transition
from appliance.tasks.replay import check
from workshop import keyring
from workshop.bench.chaos import account, partition, plan
from workshop.bench.chaos.account import Down, Follower, Submitted
from workshop.bench.chaos.arena import Arena, Progress, Site, loopback
from workshop.bench.chaos.ledger import LedgerFile, LedgerRobot
from workshop.bench.chaos.partition import AGREE_S, Partitions
from workshop.bench.net import space
from workshop.bench.net.faults import REST_S, Phase, phases
from workshop.bench.pooled import fleet_name, write_skill


class Conditions(Struct, frozen=True, kw_only=True):
    """Under what a fleet is tried."""

    gateways: int
    seconds: float
    """How long gateways go down; with faults of the network their times count."""
    every_s: float
    """Mean time between outages; 0: there are none."""
    freezes: float
    """Share of outages in which the gateway is only stopped and goes on later."""
    down_at_once: int = 2
    """r - 1: more than that is not what replication promises to survive without waiting."""
    seed: int = 1
    faults: tuple[str, ...] = ()
    """Faults of the network that it goes through, one after the other (`net.faults`); each gateway has a network
    namespace of its own then, and the process must be inside one (`net.space.enter`)."""
    fault_s: float = 0.0
    """How long each lasts; 0: as a full run has it."""
    rest_s: float = REST_S
    secured: bool = False
    """Whether links have keys; with faults of the network they have, since these are between machines."""
    keep: str = ""
    """Folder for data and logs of the run; empty: a temporary one."""

    def names(self) -> tuple[str, ...]:
        """Names of the gateways."""
        return tuple(f"gw-{number + 1}" for number in range(self.gateways))

    def phases(self) -> tuple[Phase, ...]:
        """The faults of the network with their times."""
        return tuple(phases(self.faults, self.names(), fault_s=self.fault_s, rest_s=self.rest_s, seed=self.seed))

    def outages(self, seconds: float) -> tuple[plan.Outage, ...]:
        """The outages of so many seconds."""
        if self.every_s <= 0:
            return ()
        return plan.outages(
            self.names(), seconds=seconds, most=self.down_at_once, every_s=self.every_s, freezes=self.freezes,
            seed=self.seed,
        )  # fmt: skip


async def carry_out(
    arena: Arena,
    planned: Sequence[plan.Outage],
    began: float,
    *,
    progress: Progress,
    noted: Callable[[plan.Outage], Callable[[], None]] = lambda _: lambda: None,
) -> None:
    """Have gateways go down and come back as planned, from `began` (monotonic) on.

    `noted` is called as one goes down; what it returns, when it is back.
    """

    async def outage(each: plan.Outage) -> None:
        if each.gateway not in arena.up():
            progress(f"{each.gateway} is not up when it should go down: see its log")
            return
        back = noted(each)
        if each.kind == "freeze":
            arena.signal(each.gateway, signal.SIGSTOP)
        else:
            await arena.kill(each.gateway)
        try:
            await asyncio.sleep(max(0.0, began + each.until_s - time.monotonic()))
        finally:
            if each.kind == "freeze":
                arena.signal(each.gateway, signal.SIGCONT)
            else:
                arena.start(each.gateway)
            back()

    async with asyncio.TaskGroup() as group:
        for each in planned:
            await asyncio.sleep(max(0.0, began + each.at_s - time.monotonic()))
            group.create_task(outage(each))


ROBOTS = 4
CUTS_S = (5.0, 20.0, 60.0)
"""How long the partitions of a run last: one shorter than what follows from a loss, one longer, and a long one."""
MANIFEST = """
id = "bench_ledger"
domain = "coordination"
summary = "Make some effects, each a line in a ledger, to count them."
runs = "robot"
image = "base"
cpu = 0.1
memory_mb = 48
timeout_s = 60
retries = 3
verbs = ["pick"]

[params.name]
type = "string"
required = true

[params.steps]
type = "integer"
required = true

[params.pause_ms]
type = "integer"
required = true

[params.save]
type = "string"
required = true
"""
HANDLER = """
import time


def run(ctx):
    done = (ctx.resume or {}).get("done", 0)
    begun = done
    while done < ctx.params["steps"]:
        ctx.command("pick", timeout_s=50, object=f"{ctx.params['name']}#{done}")
        done += 1
        if ctx.params["save"] == "each":
            ctx.checkpoint({"done": done})
        time.sleep(ctx.params["pause_ms"] / 1e3)
    return {"begun": begun, "done": done, "attempt": ctx.attempt}
"""


class Options(Conditions, frozen=True, kw_only=True):
    """What a run is made of."""

    gateways: int = 8
    tasks: int = 200
    """Handed in over the first 80 % of the time."""
    seconds: float = 300.0
    every_s: float = 4.0
    freezes: float = 0.2
    settle_s: float = 120.0
    """How long tasks may take to end once everybody is up again."""
    containers: int = 1
    """Kept ready by each gateway."""
    orders: int = 1
    """Rounds of orders on both sides of each partition (`partition.KINDS`): 11 tasks a round."""

    def phases(self) -> tuple[Phase, ...]:
        """The faults of the network with their times; a partition comes several times, short and long."""
        return tuple(
            phases(self.faults, self.names(), fault_s=self.fault_s, rest_s=self.rest_s, seed=self.seed, cuts_s=CUTS_S)
        )


class Trial:
    """One fleet with its ledger robots, and what is heard of it."""

    def __init__(
        self, options: Options, arena: Arena, client: FleetClient, observer: Session, file: LedgerFile
    ) -> None:
        self.options = options
        self.arena = arena
        self.client = client
        self.observer = observer
        self.file = file
        self.follower = Follower()
        self.submitted: dict[str, Submitted] = {}
        # A peer without a token: linked to every gateway, so that it misses nothing when one of them dies.
        session = observer
        session.subscribe_typed(keyspace.TRANSITION, self._moved)
        session.subscribe_typed(keyspace.TASK_UPDATE, self._told)
        session.subscribe_typed(keyspace.LOG, self._logged)

    def _moved(self, key: str, step: Transition | None) -> None:
        del key
        if step is not None:
            self.follower.moved(step, time.monotonic_ns())

    def _told(self, key: str, record: TaskRecord | None) -> None:
        del key
        if record is not None:
            self.follower.told(record)

    def _logged(self, key: str, line: LogLine | None) -> None:
        if line is not None and line.event == "gateway lost":
            self.follower.noticed(str(line.fields.get("member", "")), keyspace.LOG.names(key)[0], time.monotonic_ns())

    async def submit(self, wanted: Sequence[plan.Wanted], began: float) -> None:
        """Hand the tasks in when they are wanted."""
        async with asyncio.TaskGroup() as group:
            for each in wanted:
                await asyncio.sleep(max(0.0, began + each.at_s - time.monotonic()))
                group.create_task(self._submit(each))

    async def _submit(self, each: plan.Wanted) -> None:
        request = TaskRequest(instruction=f"chaos {each.task}", id=each.task, plan=each.plan)
        try:
            await self.client.submit(request)
            self.submitted[each.task] = Submitted(task=each.task, accepted=True)
        except SwiftbotError as error:
            self.submitted[each.task] = Submitted(task=each.task, accepted=False, problem=error.code)

    def noted(self, each: plan.Outage) -> Callable[[], None]:
        """Note that a gateway goes down; what is returned notes that it is back."""
        down: Down = self.follower.down(each.gateway, each.kind, time.monotonic_ns(), time.time_ns())

        def back() -> None:
            down.until_ns = time.monotonic_ns()

        return back

    async def ended(self, wanted: Sequence[plan.Wanted], *, wait_s: float, progress: Progress) -> None:
        """Wait until every task that was handed in has ended, at most so long."""
        until = time.monotonic() + wait_s
        told = -1
        while time.monotonic() < until:
            open_tasks = [each.task for each in wanted if each.task not in self.follower.ended]
            if open_tasks and len(open_tasks) == told:
                # A push may have been missed: the record decides.
                for task in open_tasks:
                    record = await self.record(task)
                    problem = self.submitted[task].problem if task in self.submitted else "not handed in"
                    if (record is not None and record.state.final) or (record is None and problem):
                        self.follower.ended.add(task)
            if not open_tasks:
                return
            if len(open_tasks) != told:
                told = len(open_tasks)
                progress(f"{told} tasks are under way")
            await asyncio.sleep(1.0)

    async def record(self, task: str, *, patient: bool = False) -> TaskRecord | None:
        """Return a task's record as the fleet has it; None when it has none.

        `patient`: for ten seconds at least: right after a partition the gateway that is asked may not see the others.
        """
        for _ in range(20):
            try:
                return await self.client.task(task)
            except NotFoundError:
                if not patient:
                    return None
                await asyncio.sleep(0.5)
            except SwiftbotError:
                await asyncio.sleep(0.5)
        return None


@asynccontextmanager
async def trial(
    options: Options,
    *,
    progress: Progress,
    sites: dict[str, Site] | None = None,
    sides: Sequence[Sequence[str]] = (),
) -> AsyncGenerator[Trial]:
    """A fleet, its ledger robots and a client; all gone afterwards but for the folder named in `keep`.

    Args:
        options: what it is made of.
        progress: told what happens.
        sites: where the gateways run; by default on the loopback.
        sides: of a partition to come: robots link to gateways of one side only, in turn.
    """
    folder, skills = _folder(options.keep)
    arena = Arena(
        fleet=fleet_name(),
        directory=folder,
        sites=sites or loopback(options.gateways, secured=options.secured),
        pool=PoolConfig(floor={"base": options.containers}, capacity=max(4, options.containers)),
        skills=skills,
        robots=robots(),
    )
    file = LedgerFile(folder / "ledger.jsonl")
    async with contextlib.AsyncExitStack() as stack:
        stack.callback(file.close)
        stack.push_async_callback(arena.stop, progress=progress)
        await arena.start_all(progress=progress, ready=options.containers)
        client = await stack.enter_async_context(await arena.client())
        config = PlaneConfig(mode="peer", connect=arena.endpoints, keys=arena.keys(Role.ENGINEER))
        observer = await Session.open(config, arena.fleet)
        stack.push_async_callback(observer.close)
        it = Trial(options, arena, client, observer, file)
        for number, name in enumerate(robots()):
            side = sides[number % len(sides)] if sides else arena.names
            connect = tuple(arena.sites[each].endpoint for each in side)
            robot = await LedgerRobot.start(
                name, file, fleet=arena.fleet, connect=connect, keys=arena.keys(Role.ROBOT, name)
            )
            stack.push_async_callback(robot.close)
        yield it


def _folder(told: str) -> tuple[Path, Path]:
    """Make the run's folder, and that of its skill in it."""
    folder = Path(told or tempfile.mkdtemp(prefix="swiftbot-chaos-"))
    folder.mkdir(parents=True, exist_ok=True)
    skills = write_skill(folder, "base", skill=plan.SKILL, handler=HANDLER)
    (skills / plan.SKILL / "skill.toml").write_text(MANIFEST)
    return folder, skills


def robots() -> tuple[str, ...]:
    """Names of the ledger robots."""
    return tuple(f"ledger_{number + 1}" for number in range(ROBOTS))


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Run the tasks while gateways are killed and stopped.

    Returns:
        `tasks` (`account.outcomes`), `effects` (`account.effects`), `downtime` (`account.downtime`), `takeovers` by
        task, `decisions`: what making the log's decisions again gave (`tasks.check`), `held`: whether all invariants
        were; `kept`: the folder with the MCAP log, the ledger and the gateways' logs when they were not, or when it
        was asked for.

    Raises:
        DeadlineError, PrerequisiteError: the fleet did not start.
    """
    if options.faults:
        return await _on_a_bad_wire(options, progress=progress)
    async with trial(options, progress=progress) as it:
        result = await _run(it, _nothing(), seconds=options.seconds, progress=progress)
        folder = it.arena.directory
    return await asyncio.to_thread(keep, result, folder, asked=bool(options.keep))


async def _on_a_bad_wire(options: Options, *, progress: Progress) -> dict[str, Any]:
    names, planned = options.names(), options.phases()
    sides = next((phase.sides for phase in planned if phase.sides), ())
    seconds = planned[-1].until_s
    async with (
        space.net(names, seed=options.seed) as wire,
        trial(options, progress=progress, sites=wire.sites, sides=sides) as it,
    ):
        began = time.monotonic()
        partitions = Partitions(
            it.observer,
            gateways=names,
            planned=planned,
            robots=robots(),
            rounds=options.orders,
            seed=options.seed,
            operator=keyring.BENCH if it.arena.secured else "",
        )
        faults = space.disturb(wire, planned, began, progress, noted=partitions.noted)
        result = await _run(it, faults, seconds=seconds, progress=progress, partitions=partitions)
        folder = it.arena.directory
    result["faults"] = [{"fault": each.name, "seconds": each.until_s - each.at_s} for each in planned]
    result["sides"] = sides
    return await asyncio.to_thread(keep, result, folder, asked=bool(options.keep))


async def _nothing() -> dict[str, int]:
    return {}


async def _run(
    it: Trial,
    faults: Coroutine[Any, Any, dict[str, int]],
    *,
    seconds: float,
    progress: Progress,
    partitions: Partitions | None = None,
) -> dict[str, Any]:
    options = it.options
    wanted = plan.tasks(
        options.tasks, seconds=seconds * 0.8, robots=robots(), prefix=f"c{options.seed}-", seed=options.seed
    )
    planned = options.outages(seconds)
    progress(f"{len(wanted)} tasks over {seconds * 0.8:.0f} s, {len(planned)} outages")
    began = time.monotonic()
    async with asyncio.TaskGroup() as group:
        group.create_task(it.submit(wanted, began))
        group.create_task(carry_out(it.arena, planned, began, progress=progress, noted=it.noted))
        disturbing = group.create_task(faults)
        if partitions is not None:
            group.create_task(partitions.run(began, progress))
    if partitions is not None:
        await partitions.clear()
    result = await judge(it, wanted, partitions=partitions, progress=progress)
    if frames := disturbing.result():
        result["frames"] = frames
    return result | {"gateways": options.gateways, "seconds": round(seconds, 1), "seed": options.seed}


async def judge(
    it: Trial, wanted: Sequence[plan.Wanted], *, progress: Progress, partitions: Partitions | None = None
) -> dict[str, Any]:
    """Wait for the ends, then check the invariants; `partitions`: with what was ordered on both sides of them."""
    began = time.monotonic()
    contested = partitions.handed_in() if partitions is not None else []
    await it.ended([*wanted, *contested], wait_s=it.options.settle_s, progress=progress)
    settled_s = time.monotonic() - began
    accepted = {task for task, each in it.submitted.items() if each.accepted}
    records = {each.task: await it.record(each.task, patient=each.task in accepted) for each in wanted}
    submitted = [it.submitted[each.task] for each in wanted]
    tasks = account.outcomes(submitted, records)
    found: dict[str, Any] = {}
    if partitions is not None and partitions.cuts:
        kept = {each.task: await it.record(each.task, patient=True) for each in contested}
        found["partitions"] = partition.account(partitions.cuts, kept, partitions.notices)
        records |= kept
        wanted = (*wanted, *partitions.wanted)
    effects = account.effects(wanted, records, it.file.read())
    broken = [
        *(f"{len(tasks[kind])} {kind}" for kind in ("missing", "open", "failed") if tasks[kind]),
        *(f"{effects[kind]} effects {kind}" for kind in ("doubled", "lost", "early", "strange") if effects[kind]),
        *(partition.broken(found["partitions"], within_s=AGREE_S) if found else ()),
    ]
    return {
        "held": not broken,
        "broken": broken,
        "tasks": tasks,
        "effects": effects,
        **found,
        "downtime": account.downtime(it.follower.downs),
        "takeovers": sum(it.follower.takeovers.values()),
        "tasks_taken_over": len(it.follower.takeovers),
        "settled_s": round(settled_s, 1),
    }


def keep(result: dict[str, Any], folder: Path, *, asked: bool) -> dict[str, Any]:
    """Make the decisions in the run's logs again; name the folder when there is a reason to look there, else remove it.

    A decision that comes out differently breaks the run as a doubled effect does.
    """
    result = with_check(result, sorted(folder.glob("record/*.mcap")))
    if asked or not result["held"]:
        return result | {"kept": str(folder), "log": [str(each) for each in sorted(folder.glob("record/*.mcap"))]}
    shutil.rmtree(folder, ignore_errors=True)
    return result


def with_check(result: dict[str, Any], logs: Sequence[Path]) -> dict[str, Any]:
    """Return a result with what `swiftbot log check` says of the run's logs."""
    try:
        report = check(logs, traced=all_traced())
    except SwiftbotError as error:
        return result | {"decisions": {"problem": error.message}}
    decisions: dict[str, Any] = {
        "checked": report.checked,
        "unchecked": report.unchecked,
        "diverged": report.diverged,
        "problems": report.problems,
    }
    if report.divergences:
        decisions["first"] = msgspec.to_builtins(report.divergences[0])
        broken = [*result["broken"], f"{report.diverged} decisions come out differently"]
        result = result | {"held": False, "broken": broken}
    return result | {"decisions": decisions}
