"""A plan that waits, run on simulated robots first: the real gateway, containers and site, but no real machine.

A fleet of its own is started on this machine, which has no link to the real one: one gateway with the real fleet's map,
and a simulated robot for each real one, of the same name, where that stands, with its charge and what it holds. The
plan is handed in there as it is and followed to its end, then that fleet is removed.
"""

import asyncio
import contextlib
import math
import secrets
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from msgspec import Struct

from appliance.client import FleetClient
from appliance.errors import DeadlineError, RefusedError
from appliance.model import Plan, Pose, RobotInfo, Site, SubtaskState, TaskRecord, TaskRequest, TaskState
from appliance.pool.settings import PoolConfig
from appliance.skills.sites import site_text
from workshop import local_fleet
from workshop.local_fleet import Order, Progress, Simulated

MOST_ROBOTS = 8
"""Simulated at a time: those of the plan, then others, which stand where they stand."""
RATE = 4.0
_AIR_M = 0.5
NOTE = (
    "SIMULATION: simulated robots on this machine, no real one has moved; things, doors and people are as the site "
    "file has them"
)


class RobotAfter(Struct, frozen=True, kw_only=True):
    """A simulated robot when the plan has ended."""

    robot: str
    pose: Pose | None
    """Metres of the site."""
    battery_percent: float | None
    battery_used_percent: float | None
    holding: str


class StepDone(Struct, frozen=True, kw_only=True):
    """What came of a subtask in the simulation."""

    subtask: str
    skill: str
    robot: str
    state: SubtaskState
    took_s: float | None
    """On the clock of this machine; robots move `rate` times faster than real."""
    problem: str


class DryRun(Struct, frozen=True, kw_only=True):
    """What came of a plan on simulated robots."""

    task: str
    simulation: bool = True
    state: TaskState
    rate: float
    steps: tuple[StepDone, ...]
    robots: tuple[RobotAfter, ...]
    differs: tuple[str, ...]
    """In what the simulation was not as things are: robots that it was without, and those in the air."""
    problem: str
    note: str = NOTE


def plan_of(record: TaskRecord) -> Plan:
    """Return the plan that waits, or that the task has; RefusedError when it has none yet."""
    proposal = record.proposal
    plan = proposal.plan if proposal is not None and proposal.waits else record.plan
    if plan is None:
        raise RefusedError(f"task {record.id} has no plan yet", remedy="wait until it is planned")
    return plan


def simulated(plan: Plan, robots: Mapping[str, RobotInfo], site: Site) -> tuple[tuple[Simulated, ...], tuple[str, ...]]:
    """Return the robots to simulate, those of the plan first, and in what that differs from how things are. Pure.

    Raises:
        RefusedError: a robot that the plan names is not known, or has no position, or there are too many.
    """
    named = {each.robot for each in plan.subtasks if each.robot} & robots.keys()
    chosen: list[Simulated] = []
    differs: list[str] = []
    for name in sorted(robots, key=lambda name: (name not in named, name)):
        info = robots[name]
        reason = ""
        if info.pose is None:
            reason = "its position is not known"
        elif len(chosen) == MOST_ROBOTS:
            reason = f"{MOST_ROBOTS} are simulated at most"
        if not reason:
            chosen.append(_simulated(info, site))
            if info.pose is not None and info.flies and info.pose.z > _AIR_M:
                differs.append(f"{name} flies; simulated, it begins on the ground below")
        elif name in named:
            raise RefusedError(
                f"{name} cannot be simulated: {reason}", remedy="`swiftbot task estimate` needs no simulation"
            )
        elif info.online:
            differs.append(f"without {name}: {reason}")
    return tuple(chosen), tuple(differs)


def _simulated(info: RobotInfo, site: Site) -> Simulated:
    pose = info.pose or Pose()
    kind = "mobile" if info.kind == "zenoh" else "copter" if info.flies else "rover"
    at = _point(pose)
    usual = next((name for name in ("charger", "home") if site.find(name) is not None), at)
    battery = 100.0 if info.battery_percent is None else info.battery_percent
    return Simulated(
        name=info.id,
        kind=kind,
        start=usual if info.home is None else _point(info.home),
        at=at,
        battery_percent=battery if math.isfinite(battery) else 100.0,
        holding=info.holding if kind == "mobile" else "",
    )


def _point(pose: Pose) -> str:
    return f"{pose.x:.3f}, {pose.y:.3f}"


async def dry_run(
    client: FleetClient,
    task: str,
    *,
    skills: Iterable[Path] = (),
    rate: float = RATE,
    limit_s: float,
    progress: Progress,
) -> DryRun:
    """Run a task's plan on simulated robots of this machine, and remove them.

    Args:
        client: the real fleet, which is only looked at.
        task: whose plan.
        skills: folders with further skills, as the real gateways have them.
        rate: how many times faster than real the robots move.
        limit_s: after so long it ends as it stands.
        progress: takes lines on what is being done and what each subtask does.

    Raises:
        RefusedError: there is no plan, or no robot of it can be simulated.
        SwiftbotError: the simulation cannot be started here.
    """
    plan = plan_of(await client.task(task))
    site = await client.site()
    before = dict(client.known_robots())
    robots, differs = simulated(plan, before, site)
    with tempfile.TemporaryDirectory(prefix="swiftbot-dry-run-") as folder:
        order = Order(
            fleet=f"dry-run-{secrets.token_hex(3)}",
            directory=Path(folder, "fleet"),
            gateways=1,
            robots=robots,
            site=_map_file(site, Path(folder)),
            skills=tuple(skills),
            sim_rate=rate,
            pool=PoolConfig(floor={"base": 1}),
        )
        state = await local_fleet.up(order, progress=progress)
        try:
            async with FleetClient(state.endpoint, operator="dry-run") as simulation:
                accepted = await simulation.submit(
                    TaskRequest(instruction="dry run", plan=plan, id=f"dry-{secrets.token_hex(4)}")
                )
                planned = await simulation.planned(accepted.id)
                if planned.proposal is not None and planned.proposal.waits:
                    await simulation.approve(accepted.id, plan_hash=planned.proposal.hash, why="dry run")
                record, problem = await _followed(simulation, accepted.id, limit_s, progress)
                after = dict(simulation.known_robots())
        finally:
            await asyncio.shield(local_fleet.down(order.directory, progress=progress, volumes=True, grace_s=5.0))
    return DryRun(
        task=task,
        state=record.state,
        rate=rate,
        steps=tuple(_done(record)),
        robots=tuple(_after(after[each.name], each.battery_percent) for each in robots if each.name in after),
        differs=differs,
        problem=problem,
    )


def _map_file(site: Site, folder: Path) -> str:
    file = folder / "site.toml"
    file.write_text(site_text(site))
    return str(file)


async def _followed(client: FleetClient, task: str, limit_s: float, progress: Progress) -> tuple[TaskRecord, str]:
    """Follow a task to its end, or to the limit; returns its last record and why it did not go well."""
    shown: dict[str, tuple[SubtaskState, str]] = {}
    record = await client.task(task)
    try:
        async with asyncio.timeout(limit_s):
            async for record in client.watch(task):
                for each in record.subtasks:
                    news = (each.state, each.note)
                    if shown.get(each.subtask.id, (SubtaskState.WAITING, "")) != news:
                        shown[each.subtask.id] = news
                        note = f": {each.note}" if each.note else ""
                        progress(f"simulation: {each.subtask.id} {each.subtask.skill} {each.state}{note}")
    except TimeoutError:
        with contextlib.suppress(DeadlineError):
            record = await client.task(task)
        return record, f"it did not end within {limit_s:g} s"
    failure = record.failure
    return record, "" if failure is None else f"{failure.message}{f' ({failure.remedy})' if failure.remedy else ''}"


def _done(record: TaskRecord) -> Iterable[StepDone]:
    for each in record.subtasks:
        failure = each.failure
        yield StepDone(
            subtask=each.subtask.id,
            skill=each.subtask.skill,
            robot=each.bound_robot or each.subtask.robot or "",
            state=each.state,
            took_s=None if each.duration_ms is None else round(each.duration_ms / 1e3, 1),
            problem="" if failure is None else failure.message,
        )


def _after(info: RobotInfo, before_percent: float) -> RobotAfter:
    left = info.battery_percent
    return RobotAfter(
        robot=info.id,
        pose=info.pose,
        battery_percent=left,
        battery_used_percent=None if left is None else round(max(0.0, before_percent - left), 1),
        holding=info.holding,
    )
