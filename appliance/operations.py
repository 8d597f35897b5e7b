"""The registry of operations: what people can do with a fleet, whichever way they ask for it.

An operation is an async function `(client, arguments, *, options) -> Outcome` with `@operation`, which states where it
is offered and what it needs. Derived from it: the command of `swiftbot` (`cli.common.derive`), the terminal UI's
`:` command, key bindings, palette entry and help (`tui.actions`), the tables of docs/tui.md and docs/commands.md, and
the name under which the audit log shows it (`audit_name`). To add one, write the function here; the rest follows.

Arguments are annotated with what they are (`TaskId`, `GatewayId`, ...): the terminal UI completes them, and takes them
from the selected row. An option annotated with a help text only is offered on the command line alone.
"""

import asyncio
import contextlib
import inspect
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from datetime import datetime
from typing import Annotated, Any, TypeVar, get_args

from msgspec import Meta, Struct
from msgspec.structs import replace
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from appliance.after_stop import Left, Offer, bring_back, lefts, origin_of, put_down, robots_of
from appliance.client import FleetClient, cancel_outcome, unknown_text
from appliance.errors import ConfigError, NotFoundError, PayloadError, RefusedError, SwiftbotError
from appliance.estimate import Estimate
from appliance.estimate import estimate as estimate_plan
from appliance.learn import tables
from appliance.llm.rule_words import rule_words
from appliance.model import Plan, RobotInfo, Site, TaskRecord, TaskRequest
from appliance.model.alerts import AlertsAcked
from appliance.model.closures import Rule
from appliance.model.learning import MOST_ROUNDS, RunRecord
from appliance.model.pool_api import Evicted, WarmAsk
from appliance.model.robot_api import LEASE_S
from appliance.model.roles import Role
from appliance.model.schedules import ScheduleSpec
from appliance.model.steering import MAX_WHY
from appliance.model.task_api import DrainState, MigrateAsk, TasksAsk
from appliance.reasons import time_of_day, why_text
from appliance.schedules import due
from appliance.schedules.records import made_name
from appliance.times import duration_s, moment_ns, until_of


class Outcome(Struct, frozen=True, kw_only=True):
    """What came of an operation."""

    value: Any
    """What `--json` prints; a task's record is shown as a task."""
    text: RenderableType = ""
    """For people: a sentence, or a table. Never markup."""
    ok: bool = True
    """Whether the command ends with exit code 0, else 1."""
    notes: tuple[str, ...] = ()
    """What is missing, such as gateways that did not answer."""


class Kind(Struct, frozen=True):
    """What an argument is."""

    name: str
    """gateway, robot, task, subtask (`task/subtask`), container, image, question, number, text, file, ..."""
    help: str = ""
    chosen: bool = False
    """Whether an optional one is taken from the selection as well."""
    absent: str = ""
    """What a confirmation calls it when it is not given."""
    rest: bool = False
    """Whether it is all that follows on the terminal UI's command line."""
    hidden: bool = False
    """Whether only the terminal UI gives it, and no person writes it."""


TaskId = Annotated[str, Kind("task", "Task ID.")]
TaskOrSubtask = Annotated[str, Kind("task", "Task, or one of its subtasks as TASK/SUBTASK.")]
SubtaskId = Annotated[str, Kind("subtask", "Subtask, as TASK/SUBTASK.")]
RobotId = Annotated[str, Kind("robot", "Robot ID.")]
GatewayId = Annotated[str, Kind("gateway", "Gateway ID.")]
AnyGateway = Annotated[str, Kind("gateway", "Gateway ID; any, or all concerned, if not given.")]
ImageName = Annotated[str, Kind("image", "Image, such as base.")]
QuestionId = Annotated[str, Kind("enquiry", "Question ID, as `swiftbot questions` shows it.")]
AlertId = Annotated[str, Kind("alert", "Alert ID, as `swiftbot alerts` shows it.")]
Folder = Annotated[str, Kind("text", "Folder on that gateway, made for onnxruntime-genai; lasts until its next start.")]
Reference = Annotated[str, Kind("text", "Full image reference.")]
Answer = Annotated[str, Kind("text", "Answer; one of the choices where there are any.", rest=True)]
Why = Annotated[str, Kind("text", "Reason, recorded in the audit log.", rest=True)]
BeforeTask = Annotated[str, Kind("task", "Task that it goes right before; none: all that wait.", absent="")]
HoldRuns = Annotated[bool, "Also end runs that save checkpoints; they continue from there."]
LeaseSeconds = Annotated[float, "Seconds until it ends without `robots renew`.", Meta(ge=1, le=120)]
Reason = Annotated[str, "Reason, recorded in the audit log."]
SeenStops = Annotated[str, Kind("stops", hidden=True)]
SeenAlerts = Annotated[str, Kind("alerts", hidden=True)]


class Argument(Struct, frozen=True, kw_only=True):
    """An argument of an operation on the terminal UI's command line."""

    kind: str
    name: str
    optional: bool = False
    chosen: bool = False
    absent: str = ""
    rest: bool = False
    default: Any = ""
    least: int | None = None
    most: int | None = None

    @property
    def usage(self) -> str:
        """As help writes it."""
        word = f"{self.name.upper()}…" if self.rest else self.name.upper()
        return f"[{word}]" if self.optional else word

    def read(self, text: str) -> Any:
        """Return the value of what was typed; PayloadError when it is no whole number, or out of range."""
        if not text or self.least is None or self.most is None:
            return text or self.default
        if not text.isdecimal() or not self.least <= int(text[:9]) <= self.most:
            remedy = f"give a whole number from {self.least} to {self.most}"
            raise PayloadError(f"{self.name} {text[:20]!r}", remedy=remedy)
        return int(text)


class Operation(Struct, frozen=True, kw_only=True):
    """Something a person can do."""

    name: str
    """Word after the colon in the terminal UI, and key in its settings; empty: not offered there."""
    help: str
    command: str = ""
    """Command of `swiftbot`, such as `task cancel`; empty: none."""
    title: str = ""
    """What the terminal UI's footer and palette call it."""
    keys: tuple[str, ...] = ()
    """In Textual's names."""
    screens: tuple[str, ...] = ()
    """Where its keys work; empty: everywhere."""
    takes: tuple[Argument, ...] = ()
    aliases: tuple[str, ...] = ()
    role: Role = Role.VIEWER
    """Who may do it where there are keys: this one, and those that may more (docs/security.md)."""
    always: bool = False
    """Whether it works read-only all the same, and in dialogs and input fields: a stop must always work."""
    danger: str = ""
    """What a confirmation says first, with `{…}` for arguments; empty: it asks nothing."""
    audit: str = ""
    """Verb that gateways record for it; empty: it is not audited."""
    call: str = ""
    """Textual's action of the application, in place of `run`; with `{…}` for arguments."""
    function: Callable[..., Awaitable[Outcome]] | None = None
    recorded: bool = False
    """Whether it is for recorded logs: its keys work on every screen while one is shown, and are nothing otherwise."""
    long: bool = False
    """Whether its outcome is to be read at leisure, instead of a sentence."""
    footer: bool = True
    local: bool = False
    """Whether it changes files of this machine alone; the fleet is not asked."""

    @property
    def writes(self) -> bool:
        """Whether it changes anything in the fleet: not while the terminal UI is read-only."""
        return (self.role is not Role.VIEWER or bool(self.audit)) and not self.local

    @property
    def dangerous(self) -> bool:
        """Whether the terminal UI asks first."""
        return bool(self.danger)

    @property
    def seen(self) -> tuple[str, ...]:
        """Arguments that are the IDs of what was in force (`stops`) or open (`alerts`) as it was begun, `/` between."""
        found = annotations(self.function) if self.function is not None else {}
        return tuple(name for name, each in found.items() if each.kind is not None and each.kind.hidden)

    @property
    def usage(self) -> str:
        """The form of it on the terminal UI's command line."""
        return " ".join([f":{self.name}", *(each.usage for each in self.takes)])

    def sentence(self, given: Mapping[str, str]) -> str:
        """Return what a confirmation says."""
        absent = {argument.name: argument.absent or f"any {argument.name}" for argument in self.takes}
        why = f" Reason: {given['why']}" if given.get("why") else ""
        return f"{self.danger.format_map(absent | dict(given))}{why}"

    def here(self, scope: str) -> bool:
        """Whether its keys work on a screen."""
        return not self.screens or scope in self.screens

    async def run(self, client: FleetClient, given: Mapping[str, str]) -> Outcome:
        """Carry it out with arguments as typed.

        Raises:
            SwiftbotError: with a remedy; an argument cannot be read, or the fleet refuses.
        """
        assert self.function is not None  # noqa: S101 - what has no call has this
        parameters = inspect.signature(self.function).parameters
        read = {argument.name: argument.read(given.get(argument.name, "")) for argument in self.takes}
        hidden = {name: given[name] for name in parameters if name in given and name not in read}
        return await self.function(client, **read, **hidden)


OPERATIONS: list[Operation] = []
"""In the order in which help and footer show them."""

F = TypeVar("F", bound=Callable[..., Awaitable[Outcome]])


class Annotation(Struct, frozen=True):
    """A parameter of an operation's function."""

    parameter: inspect.Parameter
    type: Any
    kind: Kind | None
    """What it is; None: an option of the command line alone."""
    help: str
    bounds: Meta | None


def annotations(function: Callable[..., Any]) -> dict[str, Annotation]:
    """Return the parameters of an operation's function after its client."""
    found: dict[str, Annotation] = {}
    for name, parameter in list(inspect.signature(function).parameters.items())[1:]:
        base, *extra = get_args(parameter.annotation)
        kind = next((one for one in extra if isinstance(one, Kind)), None)
        text = kind.help if kind is not None else next((one for one in extra if isinstance(one, str)), "")
        bounds = next((one for one in extra if isinstance(one, Meta)), None)
        found[name] = Annotation(parameter, base, kind, text, bounds)
    return found


def _takes(function: Callable[..., Any]) -> tuple[Argument, ...]:
    return tuple(
        Argument(
            kind=found.kind.name,
            name=name,
            optional=found.parameter.default is not inspect.Parameter.empty,
            chosen=found.kind.chosen,
            absent=found.kind.absent,
            rest=found.kind.rest,
            default="" if found.parameter.default is inspect.Parameter.empty else found.parameter.default,
            least=None if found.bounds is None else int(found.bounds.ge or 0),
            most=None if found.bounds is None else int(found.bounds.le or 0),
        )
        for name, found in annotations(function).items()
        if found.kind is not None and not found.kind.hidden
    )


def operation(
    command: str = "",
    *,
    name: str | None = None,
    takes: tuple[Argument, ...] | None = None,
    role: Role = Role.VIEWER,
    **more: Any,
) -> Callable[[F], F]:
    """Register a function; its name and the first line of its docstring are those of the operation.

    Args:
        command: Command of `swiftbot`; empty: the terminal UI alone has it.
        name: In the terminal UI, if not the function's; empty: not offered there.
        takes: Arguments on the terminal UI's command line, if not those of the function.
        role: The least of the roles that may do it.
        more: Other fields of `Operation`.
    """

    def register(function: F) -> F:
        OPERATIONS.append(
            Operation(
                name=function.__name__.replace("_", "-") if name is None else name,
                command=command,
                help=(inspect.getdoc(function) or "").split("\n")[0].removesuffix("."),
                takes=_takes(function) if takes is None else takes,
                role=role,
                function=function,
                **more,
            )
        )
        return function

    return register


def audit_name(verb: str) -> str:
    """Return what the audit log calls a verb that gateways recorded: the command that gives it."""
    return next((each.command for each in OPERATIONS if each.audit == verb and each.command), verb)


def not_answered(failed: Mapping[str, SwiftbotError]) -> tuple[str, ...]:
    """Return notes about gateways that did not answer."""
    return tuple(f"{name} did not answer: {error.message}" for name, error in sorted(failed.items()))


# --- tasks -----------------------------------------------------------------------------------------------------

WHY = Argument(kind="text", name="why", optional=True, rest=True)


OPERATIONS.append(
    Operation(
        name="submit",
        command="submit",
        title="Submit",
        help="Submit an instruction: plan it, show the plan, run it",
        keys=("s",),
        takes=(Argument(kind="text", name="instruction", optional=True, rest=True),),
        role=Role.OPERATOR,
        audit="submit",
        call="submit",
    )
)


@operation(
    "task cancel",
    title="Cancel",
    keys=("c",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    danger="Cancel task {task}? Its runs are ended where they are, and what has not begun never will.",
    audit="cancel",
)
async def cancel(client: FleetClient, task: TaskId, *, why: Why = "") -> Outcome:
    """Cancel a task."""
    record = await client.cancel(task, why=why)
    notes = left_lines(await left_of(client, robots_of(record), record=record), tui=True) if record.state.final else ()
    return Outcome(value=record, text=cancel_outcome(record), notes=notes)


@operation(
    "task why",
    title="Why",
    keys=("y",),
    screens=("tasks", "task", "pool"),
    long=True,
)
async def why(client: FleetClient, task: TaskOrSubtask) -> Outcome:
    """Explain why a task or subtask waits, or ran where it did: group, candidates, place, start time."""
    found = await client.why(*task_and_subtask(task))
    return Outcome(value=found, text=why_text(found))


@operation(
    "task migrate",
    title="Move",
    keys=("m",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    audit="migrate",
)
async def migrate(client: FleetClient, subtask: SubtaskId, *, gateway: AnyGateway = "", why: Why = "") -> Outcome:
    """Move a running subtask to another gateway, with its checkpoint."""
    task, part = split_subtask(subtask)
    moved = await client.migrate(MigrateAsk(task=task, subtask=part, to=gateway, why=why))
    if not moved.moved:
        return Outcome(value=moved, text=f"{moved.subtask} was not moved: {moved.why}", ok=False)
    state = "started there" if moved.started else "not yet started there"
    text = f"{moved.subtask} moved from {moved.source} to {moved.target}, {state} after {moved.took_ms:.0f} ms"
    return Outcome(value=moved, text=text, ok=moved.started)


@operation("task show", name="review", title="Review", keys=("a",), screens=("tasks", "task"), call="review")
async def show(client: FleetClient, task: TaskId) -> Outcome:
    """Show a task with its subtasks, or the plan that waits: approve, edit or reject it."""
    return Outcome(value=await client.task(task))


@operation(
    "task pause",
    title="Pause",
    keys=("p",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    audit="pause",
)
async def pause(
    client: FleetClient,
    task: TaskId,
    *,
    hold: HoldRuns = False,
    why: Why = "",
) -> Outcome:
    """Start no further subtask of a task until it is resumed; running subtasks continue."""
    record = await client.pause(task, hold=hold, why=why)
    going = [each.subtask.id for each in record.subtasks if each.state in ("dispatched", "running")]
    return Outcome(value=record, notes=(f"still running: {', '.join(going)}",) if going else ())


@operation(
    "",
    title="Hold",
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    danger="Hold task {task}? Nothing more of it is started, and runs that keep checkpoints are ended.",
    audit="pause",
    footer=False,
)
async def hold(client: FleetClient, task: TaskId, *, why: Why = "") -> Outcome:
    """Pause a task and end runs that can continue from a checkpoint later."""
    return Outcome(value=await client.pause(task, hold=True, why=why))


@operation(
    "task resume",
    title="Resume",
    keys=("r",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    danger="Resume task {task}? What waits in it is started, and its robots may move.",
    audit="resume",
)
async def resume(client: FleetClient, task: TaskId, *, why: Why = "") -> Outcome:
    """Resume a paused task."""
    return Outcome(value=await client.resume(task, why=why))


@operation(
    "task first",
    title="First",
    keys=("u",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    audit="first",
    footer=False,
)
async def first(client: FleetClient, task: TaskId, *, before: BeforeTask = "", why: Why = "") -> Outcome:
    """Put a task before the others that wait for its robots; one that has begun is not stopped."""
    record = await client.first(task, before=before, why=why)
    return Outcome(value=record, text=f"task {task} goes before {before or 'the others'}, priority {record.priority}")


@operation(
    "task retry",
    title="Retry",
    keys=("t",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    danger="Retry task {task}? What failed or was cancelled runs once more; what succeeded is kept.",
    audit="retry",
)
async def retry(client: FleetClient, task: TaskOrSubtask, *, why: Why = "") -> Outcome:
    """Retry what failed or was cancelled in a task; what succeeded is kept."""
    return Outcome(value=await client.retry(*task_and_subtask(task), why=why))


@operation(
    "",
    title="Retry one",
    screens=("task",),
    role=Role.OPERATOR,
    danger="Retry {subtask}? It runs once more.",
    audit="retry",
    footer=False,
)
async def retry_subtask(client: FleetClient, subtask: SubtaskId, *, why: Why = "") -> Outcome:
    """Retry one subtask."""
    return Outcome(value=await client.retry(*split_subtask(subtask), why=why))


@operation(
    "task duplicate",
    title="Duplicate",
    keys=("D",),
    screens=("tasks", "task"),
    role=Role.OPERATOR,
    danger="Submit the instruction of task {task} once more? It is planned and reviewed again, and robots may move.",
    audit="submit",
    footer=False,
)
async def duplicate(client: FleetClient, task: TaskId) -> Outcome:
    """Submit a task's instruction once more, as a new task with the same priority, deadline and gateways."""
    record = await client.duplicate(task)
    return Outcome(value=record, text=f"task {record.id} is accepted, a duplicate of {task}")


@operation("task estimate", title="Estimate", keys=("v",), screens=("tasks", "task", "review"), long=True, footer=False)
async def estimate(client: FleetClient, task: TaskId) -> Outcome:
    """Estimate what a task's plan does by the site's map: ways, times, places passed, limits; nothing is simulated."""
    record = await client.task(task)
    proposal = record.proposal
    plan = proposal.plan if proposal is not None and proposal.waits else record.plan
    if plan is None:
        raise RefusedError(f"task {record.id} has no plan yet", remedy="wait until it is planned")
    found = await estimate_of(client, plan)
    return Outcome(value=found, text=estimate_text(found))


OPERATIONS.append(
    Operation(
        name="simulate",
        command="task simulate",
        title="Simulate",
        help="Run a task's plan on simulated robots of this machine: the real map, no real robot moves",
        keys=("V",),
        screens=("tasks", "task", "review"),
        takes=(Argument(kind="task", name="task"),),
        call="simulate",
        long=True,
        footer=False,
    )
)


async def estimate_of(client: FleetClient, plan: Plan) -> Estimate:
    """Return what a plan is expected to do, by the site, the robots as they were heard last, and earlier runs."""
    rows = (await client.experience(1000)).rows
    measured = {(each.skill, each.robot): each.expected_s for each in rows if each.expected_s is not None}
    return estimate_plan(plan, site=await client.site(), robots=client.known_robots(), measured=measured)


def estimate_text(found: Estimate) -> RenderableType:
    """Return an estimate as a table of its steps, with what hinders it and what it does not know."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for title in ("subtask", "skill", "robot", "from", "takes", "way", "speed", "passes"):
        table.add_column(title, overflow="fold")
    for each in found.steps:
        cells = (
            each.subtask, each.skill, each.robot, f"{each.start_s:.0f} s",
            "not known" if each.takes_s is None else f"{each.takes_s:.0f} s",
            f"{each.length_m:.1f} m" if each.way else "",
            f"{each.speed_mps:g} m/s ({each.limit})" if each.limit else "", ", ".join(each.passes),
        )  # fmt: skip
        table.add_row(*(Text(cell) for cell in cells))
    whole = f"about {found.takes_s:.0f} s"
    if found.unknown:
        whole += f", without {', '.join(found.unknown)}, of which no run was measured yet"
    lines = [Text(whole, "bold"), *(Text(f"✘ {each}", "red") for each in found.problems)]
    return Group(table, *lines, Text(found.note, "dim"))


OPERATIONS.append(
    Operation(
        name="approve",
        command="task approve",
        title="Approve",
        help="Approve the plan: it runs as it is shown",
        keys=("a",),
        screens=("review",),
        takes=(WHY,),
        role=Role.OPERATOR,
        audit="approve",
        call="here approve",
    )
)


@operation(
    "task reject",
    title="Reject",
    keys=("x",),
    screens=("review",),
    takes=(WHY,),
    role=Role.OPERATOR,
    audit="reject",
    call="here reject",
)
async def reject(client: FleetClient, task: TaskId, *, why: Why = "") -> Outcome:
    """Reject the plan of a task that waits for approval; the task ends."""
    return Outcome(value=await client.reject(task, why=why))


def split_subtask(text: str) -> tuple[str, str]:
    """Return task and subtask of `t-1/s2`.

    Raises:
        PayloadError: it is not written so.
    """
    task, subtask = task_and_subtask(text)
    if not task or not subtask:
        raise PayloadError(f"{text[:60]!r} is no subtask", remedy="write task/subtask, such as t-1/s2")
    return task, subtask


def task_and_subtask(text: str) -> tuple[str, str]:
    """Return task and subtask of `t-1/s2`; the subtask is empty for `t-1`."""
    task, _, subtask = text.partition("/")
    return task, subtask


# --- robots ----------------------------------------------------------------------------------------------------


@operation(
    "robots takeover",
    title="Take over",
    keys=("o",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    audit="control_take",
    call="takeover",
)
async def takeover(
    client: FleetClient,
    robot: RobotId,
    *,
    lease: LeaseSeconds = 3 * LEASE_S,
    why: Why = "",
) -> Outcome:
    """Take a robot over and move it by hand: it holds, its tasks wait, and only the lease's holder moves it."""
    found = await client.take_over(robot, lease_s=lease, why=why)
    return Outcome(value=found, text=f"took over {robot} for {found.lease_s:g} s: --lease {found.id}")


OPERATIONS.append(
    Operation(
        name="release-robot",
        command="robots release",
        title="Release",
        help="Release the robot and leave",
        keys=("g",),
        screens=("takeover",),
        role=Role.OPERATOR,
        always=True,
        audit="control_give",
        call="here release",
    )
)


@operation("questions", name="")
async def questions(client: FleetClient) -> Outcome:
    """List the questions of skills and robots that wait for an answer."""
    found = await client.enquiries()
    lines = [
        f"{each.id}  {each.robot or each.task} asks {each.to or 'anyone'}: {each.question}"
        + (f" ({', '.join(each.choices)})" if each.choices else "")
        for each in found.enquiries
    ]
    notes = tuple(f"{name} did not answer; its questions may be missing" for name in found.unreachable)
    return Outcome(value=list(found.enquiries), text="\n".join(lines) or "no open questions", notes=notes)


@operation(
    "answer",
    title="Answer",
    keys=("A",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    audit="answer",
)
async def answer(
    client: FleetClient,
    question: QuestionId,
    answer: Answer,
    *,
    why: Reason = "",
) -> Outcome:
    """Answer a question of a robot or skill; the first answer counts."""
    found = await client.answer(question, answer, why=why)
    return Outcome(value=found, text=f"answered: {found.question[:120]} → {(found.answer or '')[:120]}")


@operation(
    "stop",
    title="STOP all",
    keys=("f8",),
    always=True,
    audit="soft_stop",
)
async def stop(client: FleetClient, robot: RobotId = "", *, why: Why = "") -> Outcome:
    """Soft stop: robots hold until resumed, all or one (`:stop ROBOT`); not an emergency stop."""
    # A first word that is no robot's name begins the reason, and all robots are stopped: a misspelt name must not
    # stop none.
    if robot and not client.knows_robot(robot):
        return await stop_these(client, (), f"{robot} {why}".strip())
    return await stop_these(client, (robot,) if robot else (), why)


@operation(
    "",
    title="Stop",
    keys=("x",),
    screens=("robots", "robot"),
    always=True,
    audit="soft_stop",
)
async def stop_robot(client: FleetClient, robot: RobotId, *, why: Why = "") -> Outcome:
    """Soft stop of one robot."""
    return await stop_these(client, (robot,), why)


@operation(
    "resume",
    title="Resume",
    keys=("z",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    danger="Lift the soft stop of {robot}? It may move at once, as its task continues. Is the way clear?",
    audit="soft_resume",
)
async def resume_robots(
    client: FleetClient,
    robot: Annotated[str, Kind("robot", chosen=True, absent="all robots")] = "",
    *,
    stops: SeenStops = "",
    why: Why = "",
) -> Outcome:
    """Lift the soft stop of a robot, or of all."""
    seen = [identity for identity in stops.split("/") if identity]
    found = await client.resume_robots((robot,) if robot else (), stops=seen, why=why)
    left = f"; soft stops still in force for others: {len(found.stops)}" if found.stops else ""
    return Outcome(value=found, text=f"{robot or 'all robots'} may move again{left}", ok=not found.silent)


@operation(
    "",
    title="Resume all",
    keys=("Z",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    danger="Lift the soft stops of all robots? They may move at once, as their tasks continue. Is the way clear?",
    audit="soft_resume",
)
async def resume_all(client: FleetClient, *, stops: SeenStops = "", why: Why = "") -> Outcome:
    """Lift the soft stops of all robots, wherever the cursor is."""
    return await resume_robots(client, stops=stops, why=why)


async def stop_these(client: FleetClient, robots: Sequence[str], why: str) -> Outcome:
    """Stop robots, or all when none is named; the outcome says who holds and who does not."""
    found = await client.stop(tuple(robots), why=why)
    held = f"holding: {', '.join(found.robots)}" if found.robots else "no robot has confirmed yet"
    problems = "".join(f"; NOT {name}: {reason}" for name, reason in sorted(found.problems.items()))
    silent = f"; not confirmed by {', '.join(found.silent)}" if found.silent else ""
    text = f"soft stop of {', '.join(robots) or 'the fleet'}: {held}{problems}{silent}"
    return Outcome(value=found, text=text, ok=not (found.problems or found.silent))


# --- after a cancel or a stop ------------------------------------------------------------------------------------

_SITE_S = 2.0
"""How long the site is waited for: without it the nearest place is not named."""
_MOST_LEFT = 12
"""Robots that are listed after a stop."""
_PICKS = 50
"""Latest tasks of a robot in which it is looked for where it picked up what it holds."""


async def left_of(
    client: FleetClient, names: Sequence[str], *, record: TaskRecord | None = None, stopped: bool = False
) -> tuple[Left, ...]:
    """Return where robots stand, what they hold and what can be done, as they were heard last.

    Args:
        client: connected.
        names: of robots; those that are not known are left out.
        record: the task that they worked for.
        stopped: whether a soft stop holds them.
    """
    robots = client.known_robots()
    if not any(name in robots for name in names):
        return ()
    return lefts(robots, names, record=record, site=await _site(client), stopped=stopped)


async def _site(client: FleetClient) -> Site | None:
    try:
        async with asyncio.timeout(_SITE_S):
            return await client.site()
    except (SwiftbotError, TimeoutError):
        return None


def left_lines(found: Sequence[Left], *, tui: bool = False) -> tuple[str, ...]:
    """Return a line for each robot: where it stands, what it holds, and the commands that are offered.

    Args:
        found: how robots stand.
        tui: whether commands are those of the terminal UI.
    """
    lines = [f"{each.text}{_offers(each.offers, tui=tui)}" for each in found[:_MOST_LEFT]]
    if len(found) > _MOST_LEFT:
        lines.append(f"{len(found) - _MOST_LEFT} further robots: swiftbot robots")
    return tuple(lines)


def _offers(offers: Sequence[Offer], *, tui: bool) -> str:
    if not offers:
        return ""
    by_function = {each.function.__name__: each for each in OPERATIONS if each.function is not None}
    commands = [
        f":{by_function[each.do].name} {each.on}" if tui else f"swiftbot {by_function[each.do].command} {each.on}"
        for each in offers
    ]
    return f" → {' or '.join(commands)}"


@operation(
    "robots put-down",
    title="Put down",
    name="put-down",
    keys=("d",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    danger="Have {robot} put down what it holds, where it stands? It is a task of its own.",
    audit="submit",
)
async def put_down_here(client: FleetClient, robot: RobotId) -> Outcome:
    """Have a robot put down what it holds, where it stands, as a task."""
    info = _holder(client, robot)
    return await _hand_in(client, put_down(info), f"{robot}: put the {info.holding} down here")


@operation(
    "robots bring-back",
    title="Bring back",
    name="bring-back",
    keys=("b",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    danger="Have {robot} bring what it holds to {place}, and put it down there? It moves, as a task of its own.",
    audit="submit",
)
async def bring_it_back(
    client: FleetClient,
    robot: RobotId,
    *,
    place: Annotated[
        str, Kind("place", "Place; where it was picked up if not given.", absent="where it picked it up", rest=True)
    ] = "",
) -> Outcome:
    """Have a robot bring back what it holds to where it picked it up, or to a place, as a task."""
    info = _holder(client, robot)
    site = await client.site()
    if place and site.find(place) is None:
        known = ", ".join(sorted(site.places))
        raise NotFoundError(f"the site has no place {place[:60]!r}", remedy=f"places: {known[:400]}")
    if not place:
        # Also those of which only the outcome is kept: they name no place, and end nothing.
        tasks = await client.tasks(_PICKS, wanted=TasksAsk(robot=robot))
        things = {each.name.lower(): each.at for each in site.objects}
        place = origin_of(tasks.tasks, robot, info.holding) or things.get(info.holding.lower(), "")
    if not place:
        raise RefusedError(
            f"where {robot} picked up the {info.holding} is not known",
            remedy=f"name the place: swiftbot robots bring-back {robot} --place PLACE",
        )
    return await _hand_in(client, bring_back(info, place, site), f"{robot}: bring the {info.holding} back to {place}")


def _holder(client: FleetClient, robot: str) -> RobotInfo:
    """Return a robot that holds something; an error says why it can put nothing down."""
    info = client.known_robots().get(robot)
    if info is None:
        known = ", ".join(sorted(client.known_robots())) or "none"
        raise NotFoundError(f"no robot {robot[:60]!r}", remedy=f"there are: {known[:400]}")
    if not info.online:
        raise RefusedError(f"{robot} is offline", remedy="wait until it is heard again")
    if not info.holding:
        raise RefusedError(f"{robot} holds nothing", remedy="`swiftbot robots` shows what robots hold")
    if "place" not in info.verbs:
        raise RefusedError(f"{robot} has no command to put things down", remedy="take what it holds out of its gripper")
    return info


async def _hand_in(client: FleetClient, plan: Plan, instruction: str) -> Outcome:
    """Submit a plan whose every step the instruction says."""
    record = await client.submit(TaskRequest(instruction=instruction, submitter=client.operator, plan=plan))
    return Outcome(value=record, text=f"task {record.id} is accepted: {instruction}")


async def stop_in_words(
    client: FleetClient, *, robots: str = "", unknown: str = "", roster: str = "", why: str = ""
) -> Outcome:
    """Stop the robots that an instruction names, or all; a name that no robot has stops none, and is reported first.

    Args:
        client: to the fleet.
        robots: their names, with `/` between.
        unknown: names that no robot has.
        roster: all names.
        why: the instruction.
    """
    names, lost, known = (tuple(filter(None, text.split("/"))) for text in (robots, unknown, roster))
    problems = [unknown_text(name, known) for name in lost]
    if problems and not names:
        raise RefusedError("; ".join(problems), remedy="F8 or :stop stops all robots")
    found = await stop_these(client, names, why[:MAX_WHY])
    return Outcome(value=found.value, text="; ".join([*problems, str(found.text)]), ok=found.ok and not problems)


STOP_IN_WORDS = Operation(
    name="stop",
    title="STOP",
    help="Soft stop of the robots that an instruction says to stop",
    always=True,
    function=stop_in_words,
)
"""What becomes of an instruction that is a stop; it is no command of its own."""


@operation("stops", name="")
async def stops(client: FleetClient) -> Outcome:
    """List the soft stops in force and the robots that operators have taken over: who, and why."""
    found = await client.standing()
    lines = [f"{', '.join(each.robots) or 'the fleet'}: {each.text}" for each in found.active]
    lines += [f"{each.robot}: {each.text}" for each in found.leases]
    text = "\n".join(lines) or "no soft stops, no robot taken over"
    return Outcome(value={"stops": found.active, "leases": found.leases}, text=text)


# --- alerts ----------------------------------------------------------------------------------------------------

OPERATIONS.append(
    Operation(
        name="alerts",
        command="alerts",
        title="Alerts",
        help="List the alerts: what is wrong or waits for a person, since when, and what to do about it",
        keys=("exclamation_mark",),
        call="alerts",
        footer=False,  # the header shows its key as soon as there are any
    )
)


@operation(
    "alerts ack",
    title="Acknowledge",
    keys=("a",),
    screens=("alerts",),
    role=Role.OPERATOR,
    audit="alert_ack",
)
async def ack(client: FleetClient, alert: AlertId, *, why: Why = "") -> Outcome:
    """Acknowledge an alert: it stays listed with your name, and counts no more."""
    found = await client.acknowledge([alert], why=why)
    return Outcome(value=found, text=acked_text(found))


@operation(
    "",
    title="Acknowledge all",
    keys=("A",),
    screens=("alerts",),
    role=Role.OPERATOR,
    danger="Acknowledge all alerts that are listed now? They count no more, until one becomes worse.",
    audit="alert_ack",
)
async def ack_all(client: FleetClient, *, alerts: SeenAlerts = "", why: Why = "") -> Outcome:
    """Acknowledge all alerts that are listed and not yet acknowledged."""
    # Not what is open by now: an alert that began while the question was open was not listed.
    return await ack_these(client, [name for name in alerts.split("/") if name], why=why)


async def ack_these(client: FleetClient, ids: Sequence[str], *, why: str) -> Outcome:
    """Acknowledge the alerts of these IDs; there may be none."""
    if not ids:
        return Outcome(value=AlertsAcked(), text="no alert waits for an acknowledgement")
    found = await client.acknowledge(ids, why=why)
    return Outcome(value=found, text=acked_text(found))


def acked_text(found: AlertsAcked) -> str:
    """Return which alerts are acknowledged, by whom, and which are over."""
    lines = [f"acknowledged by {each.acked.by if each.acked else 'nobody'}: {each.id}" for each in found.alerts]
    lines += [f"{name} is over" for name in found.unknown]
    return "\n".join(lines)


# --- places and robots out of use ----------------------------------------------------------------------------------

PlaceName = Annotated[str, Kind("place", "Place of the site, by its name or an alias.")]
UntilWhy = Annotated[
    str, Kind("text", "When it ends by itself (2h, 14:00) if it does, then the reason.", rest=True, absent="")
]


@operation(
    "place close",
    name="close-place",
    title="Close place",
    keys=("c",),
    screens=("schedules",),
    role=Role.OPERATOR,
    danger="Close {place}? No plan goes there, and subtasks that have not begun wait until it is open.",
    audit="place_close",
)
async def close_place(client: FleetClient, place: PlaceName, *, why: UntilWhy = "") -> Outcome:
    """Close a place: no plan goes there, and subtasks that have not begun wait until it is open."""
    until_ns, reason = until_and_why(why)
    found = await client.close_place(place, until_ns=until_ns, why=reason)
    return Outcome(value=found, text=f"{found.name} is {found.text}")


@operation(
    "place open", name="open-place", title="Open place", keys=("o",), screens=("schedules",), role=Role.OPERATOR,
    danger="Open {place}? Tasks that wait for it continue.", audit="place_open",
)  # fmt: skip
async def place_open(client: FleetClient, place: PlaceName, *, why: Why = "") -> Outcome:
    """Open a closed place: tasks that wait for it continue."""
    found = await client.reopen("place", place, why=why)
    return Outcome(value=found, text=f"{found.name} is open; it was {found.text}")


@operation(
    "robots maintain",
    name="maintain",
    title="Maintenance",
    keys=("m",),
    screens=("robots", "robot"),
    role=Role.OPERATOR,
    danger="Take {robot} into maintenance? No plan uses it and no task commands it until that ends.",
    audit="robot_maintain",
)
async def maintain(client: FleetClient, robot: RobotId, *, why: UntilWhy = "") -> Outcome:
    """Take a robot into maintenance: no plan uses it and no task commands it."""
    until_ns, reason = until_and_why(why)
    found = await client.maintain(robot, until_ns=until_ns, why=reason)
    return Outcome(value=found, text=f"{found.name} is {found.text}")


@operation(
    "",
    title="End maintenance",
    keys=("e",),
    screens=("robots", "robot", "schedules"),
    role=Role.OPERATOR,
    danger="End the maintenance of {robot}? Tasks may command it again.",
    audit="robot_maintain_end",
    footer=False,
)
async def end_maintenance(client: FleetClient, robot: RobotId, *, why: Why = "") -> Outcome:
    """End a robot's maintenance: tasks may command it again."""
    found = await client.reopen("robot", robot, why=why)
    return Outcome(value=found, text=f"{found.name} is in use again; it was {found.text}")


RuleText = Annotated[str, Kind("text", "Rule in words: who never does what, and when.", rest=True)]
RuleId = Annotated[str, Kind("rule", "Rule ID, as `swiftbot rules list` shows it.")]


@operation(
    "rules add", name="add-rule", title="Add rule", screens=("schedules",), role=Role.OPERATOR, audit="rule_add",
    footer=False, call="rule",
    danger='Add the standing rule "{text}"? Plans against it are refused, and subtasks that have not begun wait.',
)  # fmt: skip
async def add_rule(client: FleetClient, text: RuleText) -> Outcome:
    """Add a standing rule in words, such as "all robots: never go to dock 2 from 18:00 to 06:00"."""
    added = await client.add_rule(await read_rule(client, text, due.local_zone()), why=text[:MAX_WHY])
    return Outcome(value=added, text=f"added {added.name}: {added.text}")


async def read_rule(client: FleetClient, text: str, zone: str) -> Rule:
    """Return the rule that a text says.

    Args:
        client: whose robots and places may be named.
        text: as typed.
        zone: IANA name of the zone of its hours, where it names none.

    Raises:
        PayloadError: no rule says it whole; the message says why.
    """
    site, robots = await client.site(), tuple(client.plane.registry.robots.values())
    found = rule_words(text, robots, site, zone=zone)
    if found is None or found.rule is None:
        why = found.problem if found is not None else "it says of no robots what they never do"
        remedy = 'say it like "no drone enters the aisle from 18:00 to 06:00", or by options: swiftbot rules add --help'
        raise PayloadError(f"no standing rule: {why}", remedy=remedy)
    return found.rule


@operation(
    "rules remove", name="remove-rule", title="Remove rule", keys=("R",), screens=("schedules",), role=Role.OPERATOR,
    danger="Remove standing rule {rule}? Tasks that wait for it continue, and new plans may do what it forbids.",
    audit="rule_remove", footer=False,
)  # fmt: skip
async def remove_rule(client: FleetClient, rule: RuleId, *, why: Why = "") -> Outcome:
    """Remove a standing rule: tasks that wait for it continue."""
    found = await client.reopen("rule", rule, why=why)
    return Outcome(value=found, text=f"removed {found.name}: {found.text}")


def until_and_why(text: str) -> tuple[int, str]:
    """Return the moment that a reason begins with, Unix nanoseconds or 0 for none, and the reason without it."""
    first, _, rest = text.strip().partition(" ")
    if first[:1].isdigit():
        with contextlib.suppress(ConfigError):
            return until_of(first), rest.strip()
    return 0, text.strip()


# --- schedules and saved instructions --------------------------------------------------------------------------------

ScheduleName = Annotated[str, Kind("schedule", "Schedule, as `swiftbot schedule list` shows it.")]
InstructionName = Annotated[str, Kind("text", "Saved instruction, as `swiftbot instructions list` shows it.")]
When = Annotated[str, Kind("text", "Interval such as 10m or 1h30m, or the one time, such as 17:00.")]
Instruction = Annotated[str, Kind("text", "Instruction; it is planned and reviewed each time.", rest=True)]

OPERATIONS.append(
    Operation(
        name="schedules",
        command="schedule list",
        title="Schedules",
        help="Show the schedules, the closed places and the robots in maintenance",
        keys=("S",),
        call="schedules",
    )
)


@operation(
    "schedule add",
    title="New",
    keys=("n",),
    screens=("schedules",),
    role=Role.OPERATOR,
    danger="Add a schedule, {when}: {instruction}? The fleet submits it by itself, planned and reviewed each time.",
    audit="schedule_add",
)
async def schedule_add(client: FleetClient, when: When, instruction: Instruction) -> Outcome:
    """Add a schedule: an interval such as 10m, or one time such as 17:00, and the instruction."""
    zone = due.local_zone()
    now = datetime.now(due.zone_of(zone))
    every_s = duration_s(when)
    at_ns = moment_ns(when, now=now, option="WHEN", ahead=True) if every_s is None else 0
    spec = ScheduleSpec(
        id=made_name(instruction), instruction=instruction, every_s=every_s or 0.0, at_ns=at_ns, zone=zone
    )
    due.check(spec, now_ns=time.time_ns())
    await client.plan(instruction)  # so that one that cannot run is refused at once
    added = await client.schedule_add(spec)
    return Outcome(value=added, text=f"schedule {added.id}, {due.times_text(added.spec)}: {instruction}")


@operation(
    "schedule pause", title="Pause", keys=("p",), screens=("schedules",), role=Role.OPERATOR, audit="schedule_pause"
)
async def schedule_pause(client: FleetClient, schedule: ScheduleName, *, why: Why = "") -> Outcome:
    """Pause a schedule: nothing is submitted, and nothing counts as missed, until it is resumed."""
    found = await client.schedule_steer(schedule, "pause", why=why)
    return Outcome(value=found, text=f"schedule {found.id} is paused")


@operation(
    "schedule resume", title="Resume", keys=("r",), screens=("schedules",), role=Role.OPERATOR, audit="schedule_resume"
)
async def schedule_resume(client: FleetClient, schedule: ScheduleName, *, why: Why = "") -> Outcome:
    """Resume a paused schedule."""
    found = await client.schedule_steer(schedule, "resume", why=why)
    return Outcome(value=found, text=f"schedule {found.id} is active")


@operation(
    "schedule remove",
    title="Remove",
    keys=("x",),
    screens=("schedules",),
    role=Role.OPERATOR,
    danger="Remove schedule {schedule}? Nothing more of it is submitted; a task of it that has begun goes on.",
    audit="schedule_remove",
)
async def schedule_remove(client: FleetClient, schedule: ScheduleName, *, why: Why = "") -> Outcome:
    """Remove a schedule; a task of it that has begun goes on."""
    found = await client.schedule_steer(schedule, "remove", why=why)
    return Outcome(value=found, text=f"schedule {found.id} is removed: {found.spec.instruction[:120]}")


@operation("instructions remove", name="", role=Role.OPERATOR, audit="instruction_remove")
async def instructions_remove(client: FleetClient, name: InstructionName, *, why: Why = "") -> Outcome:
    """Remove a saved instruction; schedules that were made of it stay."""
    found = await client.instruction_remove(name, why=why)
    return Outcome(value=found, text=f"removed {found.id}: {found.text[:120]}")


OPERATIONS.append(
    Operation(
        name="",
        command="instructions save",
        help="Save an instruction with parameters",
        role=Role.OPERATOR,
        audit="instruction_save",
    )
)


# --- the audit log ---------------------------------------------------------------------------------------------


@operation("audit", title="Audit", long=True, footer=False)
async def audit(
    client: FleetClient, *, limit: Annotated[int, Kind("number", "How many at most."), Meta(ge=1, le=500)] = 50
) -> Outcome:
    """Show the audit log: the latest orders of operators, and their outcomes."""
    found, failed = await client.acts(limit)
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for title in ("at", "operator", "order", "target", "outcome", "reason"):
        table.add_column(title, overflow="fold")
    for each in found:
        outcome = each.outcome if not each.problem else f"{each.outcome}: {each.problem}"
        cells = (time_of_day(each.at_ns), each.by, audit_name(each.verb), each.target, outcome, each.why)
        table.add_row(*(Text(cell) for cell in cells))
    return Outcome(value=list(found), text=table if found else "audit log is empty", notes=not_answered(failed))


# --- gateways --------------------------------------------------------------------------------------------------


@operation(
    "drain",
    title="Drain",
    keys=("d",),
    screens=("fleet", "gateway"),
    role=Role.ENGINEER,
    danger="Drain {gateway}? Its runs are moved to other gateways, and no new ones start there until it is uncordoned.",
    audit="drain",
)
async def drain(client: FleetClient, gateway: GatewayId, *, why: Why = "") -> Outcome:
    """Drain a gateway: move its runs elsewhere and schedule no new ones."""
    state = await client.drain(gateway, 0.0, why=why)
    return Outcome(value=state, text=drain_text(state))


@operation(
    "uncordon",
    title="Uncordon",
    keys=("u",),
    screens=("fleet", "gateway"),
    role=Role.ENGINEER,
    audit="undrain",
)
async def uncordon(client: FleetClient, gateway: GatewayId, *, why: Why = "") -> Outcome:
    """Schedule runs on a drained gateway again."""
    state = await client.undrain(gateway, why=why)
    return Outcome(value=state, text=drain_text(state))


def drain_text(state: DrainState) -> str:
    """Return how far a gateway is with giving its runs away, and what each that is left waits for."""
    if not state.draining:
        return f"{state.gateway} accepts runs"
    head = f"{state.gateway} drains: {state.moved} runs moved away, {state.ended} ended there, {len(state.left)} left"
    return "\n".join([head, *(f"  {each.run} ({each.skill}): {each.why}" for each in state.left)])


@operation(
    "llm swap",
    name="swap-model",
    title="Swap model",
    keys=("m",),
    screens=("llm",),
    role=Role.ENGINEER,
    danger="Have {gateway} plan with the model in {folder} until it is restarted?",
    audit="llm_swap",
)
async def swap_model(client: FleetClient, gateway: GatewayId, folder: Folder, *, why: Why = "") -> Outcome:
    """Swap a gateway's local model; the new one is tested beside the old one, which stays if the test fails."""
    found = await client.swap_model(gateway, folder, why=why)
    text = f"{gateway} plans with {found.after} instead of {found.before or 'none'}, after {found.ms:.0f} ms"
    return Outcome(value=found, text="\n".join([text, *found.tests]))


# --- pools -----------------------------------------------------------------------------------------------------


@operation(
    "pool warm",
    title="Warm",
    keys=("w",),
    screens=("pool",),
    role=Role.ENGINEER,
    audit="pool_warm",
)
async def warm(
    client: FleetClient,
    image: ImageName,
    *,
    count: Annotated[int, Kind("number", "How many, besides those in use."), Meta(ge=1, le=100)] = 1,
    gateway: AnyGateway = "",
    keep: Annotated[float, "How long they are kept, seconds."] = 600.0,
    wait: Annotated[float, "How long to wait until they are ready, seconds; 0: do not wait."] = 30.0,
    why: Why = "",
) -> Outcome:
    """Keep containers of an image ready for ten minutes; exit code 1 when fewer are ready in time."""
    name = gateway or await client.gateway()
    found = await client.pool_warm(name, WarmAsk(image=image, count=count, keep_s=keep, wait_s=wait, why=why))
    problem = {"problem": found.problem} if found.problem else {}
    text = f"{name}: {found.ready} of {found.image} ready, {found.starting} starting"
    return Outcome(
        value={"gateway": name, "image": found.image, "ready": found.ready, "starting": found.starting} | problem,
        text=f"{text}; {found.problem}" if found.problem else text,
        ok=found.ready >= count or not wait,
    )


@operation(
    "pool evict",
    title="Evict",
    keys=("e",),
    screens=("pool",),
    role=Role.ENGINEER,
    danger="Evict {container}? The next run that needs such a container may have to wait for a cold start.",
    audit="pool_evict",
)
async def evict(
    client: FleetClient,
    container: Annotated[str, Kind("container", "Container ID or the beginning of it, or an image.")],
    *,
    gateway: AnyGateway = "",
    why: Why = "",
) -> Outcome:
    """Evict an idle container, or all idle ones of an image."""
    found = await client.pool_evict(container, gateway, why=why)
    rows = [
        {"gateway": name, "evicted": list(evicted.containers), "kept": evicted.kept, "note": evicted.note}
        for name, evicted in sorted(found.items())
    ]
    return Outcome(value=rows, text=evicted_text(found))


def evicted_text(found: Mapping[str, Evicted]) -> str:
    """Return what pools evicted and what they kept, a line a gateway."""
    lines: list[str] = []
    for gateway, evicted in sorted(found.items()):
        gone = f"evicted {', '.join(evicted.containers)}" if evicted.containers else "had none idle"
        kept = "".join(f"; kept {name}: {reason}" for name, reason in evicted.kept.items())
        lines.append(f"{gateway} {gone}{kept}{f'; {evicted.note}' if evicted.note else ''}")
    return "\n".join(lines)


@operation(
    "pool release",
    title="Release",
    keys=("r",),
    screens=("pool",),
    role=Role.ENGINEER,
    audit="pool_release_quarantine",
    footer=False,
)
async def release(client: FleetClient, image: ImageName, *, gateway: AnyGateway = "", why: Why = "") -> Outcome:
    """Release an image from quarantine: its containers are started again."""
    found = await client.pool_release(image, gateway, why=why)
    rows = [{"gateway": name, "image": image, "reason": found[name].reason} for name in sorted(found)]
    lines = [f"{name}: {image} released; it was in quarantine: {found[name].reason}" for name in sorted(found)]
    return Outcome(value=rows, text="\n".join(lines))


@operation(
    "images fetch",
    title="Fetch",
    role=Role.ENGINEER,
    audit="image_fetch",
    footer=False,
)
async def fetch(client: FleetClient, reference: Reference, gateway: GatewayId, *, why: Why = "") -> Outcome:
    """Fetch an image to a gateway from another, by its full reference."""
    brought = await client.image_fetch(gateway, reference, why=why)
    source = f" from {brought.gateway}" if brought.gateway else " already"
    return Outcome(value=brought, text=f"{brought.what} is on {gateway}{source}")


# --- federated learning ------------------------------------------------------------------------------------------

RunId = Annotated[str, Kind("run", "Run ID, as `swiftbot learn list` shows it.")]
ClientName = Annotated[str, Kind("client", "Client: a robot, or a part of the data set.")]
ModelNumber = Annotated[int, Kind("number", "Model number."), Meta(ge=0, le=MOST_ROUNDS)]


@operation("learn list", name="")
async def learn_list(client: FleetClient) -> Outcome:
    """List the runs of federated learning, newest first."""
    found, failed = await client.learn_runs()
    return Outcome(value=found, text=tables.runs(found), notes=not_answered(failed))


@operation("learn show", name="")
async def learn_show(client: FleetClient, run: RunId) -> Outcome:
    """Show a run: its round and what that waits for, the last rounds, the clients."""
    found = await client.learn_show(run)
    return Outcome(value=found, text=tables.shown(found))


RecipeName = Annotated[str, Kind("recipe", "Recipe: one of the product's, or a TOML file.")]
RobotNames = Annotated[str, Kind("robots", "Robots as clients, commas between; all if not given.", absent="all robots")]
RoundCount = Annotated[
    int, Kind("number", "Rounds; as the recipe says if not given.", absent="as the recipe says"),
    Meta(ge=1, le=MOST_ROUNDS),
]  # fmt: skip


@operation(
    "",
    title="Train",
    screens=("learning",),
    role=Role.OPERATOR,
    danger="Start a run of federated learning: {recipe}, on {robots}, rounds: {rounds}? It uses containers when tasks "
    "leave them idle; no robot moves, and no data leave their gateway.",
    audit="learn_start",
    footer=False,
)
async def learn_start(
    client: FleetClient, recipe: RecipeName, *, rounds: RoundCount = 0, robots: RobotNames = "", why: Why = ""
) -> Outcome:
    """Start a run of federated learning on robots, with the data at their gateways."""
    await client.gateway()
    known = client.plane.registry.robots
    chosen = tuple(name for name in robots.split(",") if name) if robots not in ("", "all") else ()
    from appliance.learn import recipe as recipes  # noqa: PLC0415 - loads numpy, which no other operation needs

    wanted = recipes.load(recipes.find(recipe))
    if rounds:
        wanted = replace(wanted, rounds=replace(wanted.rounds, count=rounds))
    there = tuple(sorted(name for name, robot in known.items() if robot.online))
    wanted = recipes.for_robots(wanted, chosen or there, recipe)
    started = await client.learn_start(f"{wanted.model}-{time.strftime('%m%d-%H%M%S')}", wanted, why=why)
    text = f"run {started.id} started on {', '.join(started.recipe.names)}"
    # Nothing is built here, and on the machine of whom asks it would be of no use.
    if not any("/learn:" in image for status in client.plane.registry.gateways.values() for image in status.images):
        text += "; no gateway has image learn yet: swiftbot images build learn, on one of them"
    return Outcome(value=started, text=text)


@operation("learn why", title="Why", keys=("y",), screens=("run",), long=True)
async def learn_why(client: FleetClient, run: RunId, name: ClientName) -> Outcome:
    """Explain what a client does in a run, and why its updates count or do not."""
    found = await client.learn_show(run)
    known = next((each for each in found.run.clients if each.name == name), None)
    if known is None:
        names = ", ".join(each.name for each in found.run.clients[:8])
        raise NotFoundError(f"no client {name[:60]!r} in run {run}", remedy=f"there are {names}")
    return Outcome(value=tables.explained(found, known), text=tables.why(found, known))


@operation("learn models", title="Models", keys=("m",), screens=("learning", "run"), long=True)
async def learn_models(client: FleetClient, run: RunId) -> Outcome:
    """List the models that a run keeps."""
    found = (await client.learn_show(run)).run.models
    return Outcome(value=found, text=tables.models(found))


@operation(
    "learn pause",
    title="Pause",
    keys=("p",),
    screens=("learning", "run"),
    role=Role.OPERATOR,
    audit="learn_pause",
)
async def learn_pause(client: FleetClient, run: RunId, *, why: Why = "") -> Outcome:
    """Pause a run: no client begins, no round closes, until it is resumed."""
    return _steered(await client.learn_steer(run, "pause", why=why))


@operation(
    "learn resume",
    title="Resume",
    keys=("r",),
    screens=("learning", "run"),
    role=Role.OPERATOR,
    audit="learn_resume",
)
async def learn_resume(client: FleetClient, run: RunId, *, why: Why = "") -> Outcome:
    """Resume a paused run."""
    return _steered(await client.learn_steer(run, "resume", why=why))


@operation(
    "learn stop",
    title="Stop run",
    keys=("x",),
    screens=("learning", "run"),
    role=Role.OPERATOR,
    danger="Stop run {run} for good? What its clients train is ended; the model of the last closed round is kept.",
    audit="learn_stop",
)
async def learn_stop(client: FleetClient, run: RunId, *, why: Why = "") -> Outcome:
    """Stop a run for good: the model of its last closed round is kept."""
    return _steered(await client.learn_steer(run, "stop", why=why))


@operation(
    "learn exclude",
    title="Exclude",
    keys=("e",),
    screens=("run",),
    role=Role.OPERATOR,
    danger="Exclude client {name} from run {run}? What it trains is ended, and nothing of it counts any more.",
    audit="learn_exclude",
)
async def learn_exclude(client: FleetClient, run: RunId, name: ClientName, *, why: Why = "") -> Outcome:
    """Exclude a client from a run: what it is at is ended, and nothing of it counts."""
    return _steered(await client.learn_steer(run, "exclude", client=name, why=why))


@operation(
    "learn include",
    title="Include",
    keys=("i",),
    screens=("run",),
    role=Role.OPERATOR,
    audit="learn_include",
)
async def learn_include(client: FleetClient, run: RunId, name: ClientName, *, why: Why = "") -> Outcome:
    """Include an excluded client again."""
    return _steered(await client.learn_steer(run, "include", client=name, why=why))


@operation("learn mark", screens=("learning", "run"), role=Role.OPERATOR, audit="learn_mark", footer=False)
async def learn_mark(client: FleetClient, run: RunId, model: ModelNumber, *, why: Why = "") -> Outcome:
    """Keep a model of a run, however many follow."""
    return _steered(await client.learn_steer(run, "mark", model=model, why=why))


@operation("learn unmark", screens=("learning", "run"), role=Role.OPERATOR, audit="learn_unmark", footer=False)
async def learn_unmark(client: FleetClient, run: RunId, model: ModelNumber, *, why: Why = "") -> Outcome:
    """Keep a model no longer than others."""
    return _steered(await client.learn_steer(run, "unmark", model=model, why=why))


@operation("learn remove", name="", role=Role.OPERATOR, audit="learn_remove")
async def learn_remove(client: FleetClient, run: RunId, *, why: Why = "") -> Outcome:
    """Remove a run that has ended: its records, models and files, on all gateways."""
    found = await client.learn_steer(run, "remove", why=why)
    return Outcome(value=found, text=f"run {found.id} removed: {found.state}, {len(found.models)} models")


def _steered(run: RunRecord) -> Outcome:
    return Outcome(value=run, text=f"run {run.id} {run.state}{f': {run.why}' if run.why else ''}, round {run.round}")


# --- keys of the fleet's members: files on the machine that keeps the authority ---------------------------------------

OPERATIONS.extend(
    Operation(name="", command=f"keys {word}", help=text, role=Role.ENGINEER, local=True)
    for word, text in (
        ("init", "Make the fleet's authority"),
        ("issue", "Issue a private key and certificate"),
        ("renew", "Issue a member's next private key and certificate"),
        ("revoke", "Revoke all certificates of a member"),
    )
)
