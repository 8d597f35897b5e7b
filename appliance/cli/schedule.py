"""Schedules: `swiftbot schedule …`. `pause`, `resume` and `remove` are made from the registry of operations."""

from datetime import datetime
from typing import Annotated, Literal

from cyclopts import App, Parameter
from cyclopts.validators import Number
from rich.table import Table
from rich.text import Text

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, show
from appliance.cli.instructions import instruction_of
from appliance.client import FleetClient
from appliance.errors import ConfigError, Exit, PlanError
from appliance.model import PLAIN_PRIORITY, Approval
from appliance.model.schedules import Schedule, ScheduleShown, ScheduleSpec
from appliance.schedules import due, records
from appliance.schedules.records import no_schedule
from appliance.times import duration_s, moment_ns

schedule_app = App(
    name="schedule", help="Submit instructions at times: by interval, cron expression, once.", group=WORK
)


def add_to(app: App) -> None:
    """Add this group."""
    app.command(schedule_app)


@schedule_app.command(name="add")
async def schedule_add(
    instruction: Annotated[str, Parameter(help="Instruction; not with --saved.")] = "",
    /,
    *values: Annotated[str, Parameter(help="With --saved: values of its parameters, as name=value.")],
    every: Annotated[str, Parameter(help="Interval: 30s, 10m, 1h30m, 1d; counted from now.")] = "",
    cron: Annotated[str, Parameter(help='Minute, hour, day of month, month, day of week: "0 7 * * mon-fri".')] = "",
    at: Annotated[str, Parameter(help="Once: 17:00, 2026-12-01T07:30.")] = "",
    after: Annotated[str, Parameter(name="--in", help="Once, after a duration: 20m, 1h30m.")] = "",
    zone: Annotated[str, Parameter(help="Time zone, such as Europe/Zurich; this machine's if not given.")] = "",
    until: Annotated[str, Parameter(help="Submit nothing after: 17:00, 2026-12-01.")] = "",
    name: Annotated[str, Parameter(help="Name; made of the instruction if not given.")] = "",
    saved: Annotated[str, Parameter(help="Saved instruction to submit (`swiftbot instructions`).")] = "",
    late: Annotated[
        Literal["report", "run"], Parameter(help="A missed time: an alert alone, or the last one is also run late.")
    ] = "report",
    grace: Annotated[str, Parameter(help="How late it may begin and is not missed.")] = "60s",
    overlap: Annotated[
        Literal["skip", "allow"], Parameter(help="While its last task has not ended: skip the time, or submit.")
    ] = "skip",
    priority: Annotated[
        int, Parameter(help="Priority, 0 (lowest) to 9.", validator=Number(gte=0, lte=9))
    ] = PLAIN_PRIORITY,
    deadline: Annotated[
        float, Parameter(help="Seconds after which a task of it fails; 0: none.", validator=Number(gte=0))
    ] = 0.0,
    group: Annotated[tuple[str, ...], Parameter(help="A gateway that may run it; repeatable. None: any.")] = (),
    approval: Annotated[Approval, Parameter(help="Whether plans of it need approval.")] = Approval.NEVER,
    unchecked: Annotated[bool, Parameter(help="Do not plan the instruction now to see whether it can run.")] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Add a schedule: an instruction that the fleet submits by itself, planned and reviewed each time.

    The instruction is planned now, without running, so that one that cannot run is refused at once.
    """
    if saved and instruction:
        values, instruction = (instruction, *values), ""  # `--saved fetch thing=box`: the first word is a value
    if not (instruction or saved):
        raise ConfigError(
            "give an instruction, or --saved", remedy='swiftbot schedule add "rover_1: go to dock 1" --every 10m'
        )
    if not (every or cron or at or after):
        raise ConfigError("it is not said when", remedy="give --every, --cron, --at or --in")
    if values and not saved:
        raise ConfigError(f"{values[0][:60]!r} follows the instruction", remedy="write the instruction in quotes")
    place = zone or due.local_zone()
    zone_info = due.zone_of(place)
    now = datetime.now(zone_info)
    async with where.client() as client:
        text = await instruction_of(client, saved, values) if saved else instruction
        spec = ScheduleSpec(
            id=name or records.made_name(saved or text), instruction=text,
            every_s=_seconds("--every", every) if every else 0.0,
            cron=cron, at_ns=_once(at, after, now), zone=place,
            until_ns=moment_ns(until, now=now, option="--until", ahead=True) if until else 0, late=late,
            grace_s=_seconds("--grace", grace), overlap=overlap, priority=priority, deadline_s=deadline, group=group,
            approval=approval,
        )  # fmt: skip
        due.check(spec, now_ns=int(now.timestamp() * 1e9))
        if not unchecked:
            await _check(client, text)
        added = await client.schedule_add(spec, why=why)
        shown = await _found(client, added.id)
    show(shown, as_json=as_json, table=schedule_text(shown))
    return Exit.DONE


async def _check(client: FleetClient, text: str) -> None:
    """Plan the instruction and run nothing; PlanError where it cannot run."""
    try:
        answer = await client.plan(text)
    except PlanError as error:
        error.remedy = f"{error.remedy or 'rephrase it'}; --unchecked adds it all the same"
        raise
    if approval := (await client.check_plan(answer.plan)).approval:
        console.err.print(f"each plan of it waits for approval, with an alert: {approval}", markup=False)


def _once(at: str, after: str, now: datetime) -> int:
    """Return the one time of a schedule, Unix nanoseconds; 0: it has none."""
    if at and after:
        raise ConfigError("give --at or --in", remedy="leave one of them out")
    if after:
        return int(now.timestamp() + _seconds("--in", after)) * 10**9
    return moment_ns(at, now=now, option="--at", ahead=True) if at else 0


def _seconds(option: str, text: str) -> float:
    seconds = duration_s(text)
    if seconds is None or seconds <= 0:
        raise ConfigError(f"{option} {text[:40]!r} is no duration", remedy="write it like 30s, 10m, 1h30m, 1d")
    return seconds


async def _found(client: FleetClient, name: str) -> ScheduleShown:
    found = await client.schedules()
    shown = next((each for each in found.schedules if each.schedule.id == name), None)
    if shown is None:
        silent = f"; {', '.join(found.unreachable)} did not answer" if found.unreachable else ""
        error = no_schedule(name)
        error.message += silent
        raise error
    return shown


@schedule_app.default
@schedule_app.command(name="list")
async def schedule_list(*, as_json: Json = False, where: Where = HERE) -> int:
    """List the schedules: when each is due next, its last task, what was missed."""
    async with where.client() as client:
        found = await client.schedules()
    for gateway in found.unreachable:
        console.err.print(f"{gateway} did not answer; its schedules may be missing")
    show(found.schedules, as_json=as_json, table=schedule_table(found.schedules) if found.schedules else "no schedules")
    return Exit.FAILED if found.unreachable else Exit.DONE


@schedule_app.command(name="show")
async def schedule_show(schedule: str, /, *, as_json: Json = False, where: Where = HERE) -> int:
    """Show a schedule with its next times.

    Args:
        schedule: Its name.
    """
    async with where.client() as client:
        shown = await _found(client, schedule)
    show(shown, as_json=as_json, table=schedule_text(shown))
    return Exit.DONE


def schedule_table(shown: tuple[ScheduleShown, ...]) -> Table:
    """Schedules, a line each."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("schedule", "when", "next", "runs", "missed", "last task", "instruction"):
        table.add_column(name, overflow="fold")
    for each in shown:
        schedule = each.schedule
        table.add_row(
            schedule.id, due.times_text(schedule.spec), _next(each), str(schedule.fired),
            Text(str(schedule.missed), style="yellow" if schedule.missed else ""), schedule.task or "–",
            schedule.spec.instruction,
        )  # fmt: skip
    return table


def _next(shown: ScheduleShown) -> Text:
    if shown.schedule.paused is not None:
        return Text("paused", style="yellow")
    if not shown.next_ns:
        return Text("over", style="dim")
    return Text(due.when(shown.next_ns[0], shown.schedule.spec.zone))


def schedule_text(shown: ScheduleShown) -> str:
    """Return a schedule in lines."""
    schedule: Schedule = shown.schedule
    spec = schedule.spec
    why = f": {schedule.added.why}" if schedule.added.why else ""
    lines = [f"{schedule.id}: {spec.instruction}", f"  when      {due.times_text(spec)}"]
    if spec.until_ns:
        lines.append(f"  until     {due.when(spec.until_ns, spec.zone)}")
    lines.append(f"  added by  {schedule.added.by}{why}")
    if (paused := schedule.paused) is not None:
        lines.append(f"  paused by {paused.by}{f': {paused.why}' if paused.why else ''}")
    times = [due.when(each, spec.zone) for each in shown.next_ns]
    lines.append(f"  next      {'; '.join(times) or ('after `schedule resume`' if paused else 'over')}")
    last = f", the last {schedule.task} due {due.when(schedule.fired_ns, spec.zone)}" if schedule.task else ""
    lines.append(f"  tasks     {schedule.fired}{last}")
    if schedule.missed:
        lines.append(
            f"  missed    {schedule.missed}, the last {due.when(schedule.missed_ns, spec.zone)}: {schedule.missed_why}"
        )
    late = "an alert, and the last one is run late" if spec.late == "run" else "an alert"
    lines.append(f"  missed is {late}; on time within {due.interval_text(spec.grace_s)}; overlap: {spec.overlap}")
    return "\n".join(lines)
