"""How the command line shows things: plans as graphs, tasks and their streams, fleets. Prints only.

Of plans also where they came from, what they ask for, how they were revised, and what was learned from them. Rich finds
out whether it writes to a terminal: without one there are no colours and no live region.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from appliance.identity.parts import DEVELOPMENT
from appliance.model import (
    PLAIN_PRIORITY,
    ContainerInfo,
    GatewayStatus,
    Plan,
    Provenance,
    RecorderNote,
    RobotInfo,
    RobotWork,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
    Way,
)
from appliance.model.planner_api import Analysis
from appliance.model.pool_api import Evicted, PoolDecision
from appliance.model.task_api import ExperienceList, Line, LineKind, PlanAnswer
from appliance.model.transfer_api import Brought
from appliance.reasons import milliseconds, time_of_day
from appliance.record.models import LogInfo, kinds_text, problem_of, together
from appliance.tasks.records import done_text
from appliance.tasks.views import status, waits_for

if TYPE_CHECKING:  # of results that are printed: commands that print no such result start without what makes them
    from appliance.doctor import Check
    from appliance.pool.images import ImageState
    from appliance.record.player import Played
    from appliance.tasks.replay import CheckReport, ReplayReport

_LINE_STYLES = {
    LineKind.STATE: "",
    LineKind.MONITOR: "bold yellow",
    LineKind.PROGRESS: "dim",
    LineKind.LOG: "",
    LineKind.GATEWAY: "dim",
    LineKind.PARTIAL: "dim",
    LineKind.CHECKPOINT: "dim",
    LineKind.METRICS: "cyan",
    LineKind.NOTICE: "bold",
    LineKind.DROPPED: "bold red",
}
_LOG_LEVEL_STYLES = {"warning": "yellow", "error": "red", "critical": "red"}
_RUN_FIGURES = (("startup_ms", "startup"), ("duration_ms", "took"), ("cpu_ms", "cpu"), ("peak_mb", "peak"))


def stream_line(line: Line) -> Text:
    """One line of a stream: time, gateway, subtask/attempt, what it is, what it says."""
    at = time.strftime("%H:%M:%S", time.localtime(line.at_ns / 1e9)) + f".{line.at_ns // 1_000_000 % 1000:03d}"
    which = f"{line.subtask}/{line.attempt}" if line.attempt else line.subtask or "–"
    style = _LOG_LEVEL_STYLES.get(line.level, _LINE_STYLES[line.kind])
    text = line.text
    if line.kind is LineKind.PROGRESS:
        text = f"{line.fields.get('progress', 0.0):.0%} {line.text}"
    elif line.kind is LineKind.METRICS:
        text = f"{line.text}{_figures(line)}"
    elif line.fields and line.kind in (LineKind.LOG, LineKind.GATEWAY, LineKind.PARTIAL):
        text = f"{line.text} {' '.join(f'{name}={value}' for name, value in line.fields.items())}"
    return Text.assemble((f"{at} ", "dim"), f"{line.gateway or '–':<8} {which:<8} {line.kind:<10} ", (text, style))


def _figures(line: Line) -> str:
    told: list[str] = []
    for name, word in _RUN_FIGURES:
        value = line.fields.get(name)
        if isinstance(value, int | float) and name != "startup_ms":
            told.append(f"{word} {value:g} {'MB' if name == 'peak_mb' else 'ms'}")
    where = " ".join(str(line.fields[name])[:12] for name in ("container", "phase") if name in line.fields)
    return f" ({', '.join([*told, where] if where else told)})" if told or where else ""


def revision_lines(record: TaskRecord) -> Iterator[Text]:
    """What was changed about a task's plan, and why; what waits for an operator, and what operators ordered."""
    if record.paused:
        yield Text(f"  {record.paused}", style="bold yellow")
    if record.cancelled_by is not None and record.cancelled_by.by:
        said = f": {record.cancelled_by.why}" if record.cancelled_by.why else ""
        yield Text(f"  cancelled by {record.cancelled_by.by}{said}", style="magenta")
    if record.retried_by is not None:
        said = f": {record.retried_by.why}" if record.retried_by.why else ""
        yield Text(f"  tried again by {record.retried_by.by or 'an operator'}{said}", style="dim")
    if (decision := record.decision) is not None:
        did = "approved" if decision.approved else "turned down"
        edited = ", edited" if decision.edited else ""
        said = f": {decision.why}" if decision.why else ""
        yield Text(f"  plan {did}{edited} by {decision.by or 'an operator'}{said}", style="dim")
    for each in record.revisions:
        yield Text(f"  revision {each.number} ({each.kind}): {each.note}", style="yellow")
        if each.why:
            yield Text(f"    since {each.subtask} failed: {each.why}", style="dim")
        changes = [f"{one.id} ({one.skill}) {one.state}" for one in each.dropped]
        if changes or each.added:
            yield Text(f"    out: {', '.join(changes) or 'none'}; in: {', '.join(each.added) or 'none'}", style="dim")
    if record.proposal is not None:
        short = record.proposal.hash[:12]
        waits = (
            f"\n  waits for `swiftbot task approve {record.id} --hash {short}` or `task reject {record.id}`"
            if record.proposal.waits
            else ""
        )
        yield Text(f"  proposed: {record.proposal.note}{waits}", style="bold yellow")
        for each in record.proposal.plan.subtasks:
            after = f" after {', '.join(each.after)}" if each.after else ""
            yield Text(f"    {each.id} {each.skill} {each.robot or '–'} {each.params}{after}")
    for each in record.subtasks:
        if each.condition:
            yield Text(f"  {each.subtask.id} is {each.condition}: {each.note}", style="yellow")


def provenance_text(found: Provenance) -> Text:
    """Where a plan came from, in a few lines."""
    by = f"{found.tier}{f' ({found.model})' if found.model else ''}"
    lines = [f"by {by} on {found.gateway or 'this machine'}, {found.confidence:.2f} sure, hash {found.hash[:12]}"]
    if found.cache:
        lines.append(f"from the cache: {found.cache}")
    lines += [
        f"  {each.tier}: {'taken' if each.ok else 'not taken'}, {each.latency_ms:.0f} ms"
        f"{f': {each.problems[0]}' if each.problems else ''}"
        for each in found.attempts
    ]
    lines += [
        f"{'held' if each.severity == 'hold' else each.severity}: {each.message} [{each.check}]"
        f"{f'; hint: {each.hint}' if each.hint else ''}"
        for each in found.findings
    ]
    return Text("\n".join(lines))


def analysis_text(found: Analysis) -> Group:
    """What an instruction asks for, beside its plan."""
    lines = [
        f"{each.kind}: {each.text}{f' ({each.value:g} {each.unit})' if each.value is not None else ''}"
        for each in found.constraints
    ]
    for each in found.able:
        last = "".join(f"; {robot} last: {why}" for robot, why in each.shunned.items())
        lines.append(f"{each.label}: capable: {', '.join(each.robots) or 'no known robot'}{last}")
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("image", "containers", "cpu", "memory", "volumes", "from", "for", "subtasks"):
        table.add_column(name, overflow="fold")
    for each in found.allocation:
        table.add_row(
            each.image,
            str(each.count),
            f"{each.cpu:g}",
            f"{each.memory_mb} MB{f' (seen {each.seen_mb:.0f})' if each.seen_mb else ''}",
            ", ".join(each.volumes) or "–",
            f"{each.start_s:.0f} s",
            f"{each.busy_s:.0f} s",
            ", ".join(each.subtasks),
        )
    head = Text(f"{expected_text(found)}; containers it needs:", style="bold")
    return Group(*(Text(line) for line in lines), head, table)


def expected_text(found: Analysis) -> str:
    """Return how long a plan is expected to take; of skills that never ran nothing is known."""
    if not found.unmeasured:
        return f"expected duration: {found.expected_s:.0f} s when nothing waits"
    return f"expected duration: not known, no run of {', '.join(found.unmeasured)} was measured yet"


def experience_table(found: ExperienceList) -> Group:
    """How skills have done on robots."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("skill", "robot", "good", "bad", "reliable", "takes", "memory", "latest failure"):
        table.add_column(name, overflow="fold")
    for row in found.rows:
        table.add_row(
            row.skill,
            row.robot or "–",
            f"{row.good:.1f}",
            f"{row.bad:.1f}",
            f"{100 * row.reliability:.0f} %{' (chosen last)' if row.shunned else ''}",
            f"{row.expected_s:.1f} s" if row.expected_s is not None else "–",
            f"{row.peak_mb:.0f} MB" if row.peak_mb else "–",
            row.why or "–",
        )
    moved = ", ".join(f"{tier} {value:.2f}" for tier, value in found.thresholds.items())
    tail = Text(f"plans run without approval from confidence: {moved or '–'}")
    return Group(Text(f"source: {found.gateway}", style="bold"), table, tail)


PIPE_WIDTH = 160
"""Columns where there is no terminal to ask: logs and CI wrap by themselves, if at all."""

_CONTROLS = {
    code: "\ufffd"
    for code in (
        *range(0x20),
        *range(0x7F, 0xA0),
        *range(0x202A, 0x202F),
        *range(0x2066, 0x206A),
        *range(0xD800, 0xE000),
    )
    if chr(code) not in "\n\t"
}
"""Control characters and direction overrides, which a terminal obeys instead of showing them; and halves of surrogate
pairs, by which Python has bytes that are no text, and which nothing can write."""


class SafeConsole(Console):
    """A console that shows control characters of texts as `\ufffd`; its own styles and controls pass."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render with each text freed of control characters: an instruction may hold escape sequences."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else text.translate(_CONTROLS), style, control)


# No text of a user is markup: an instruction may hold "[/red]" or ":warning:".
out = SafeConsole(highlight=False, markup=False, emoji=False, width=None if sys.stdout.isatty() else PIPE_WIDTH)
err = SafeConsole(
    stderr=True, highlight=False, markup=False, emoji=False, width=None if sys.stderr.isatty() else PIPE_WIDTH
)

_STYLES = {
    SubtaskState.WAITING: "dim",
    SubtaskState.READY: "cyan",
    SubtaskState.DISPATCHED: "cyan",
    SubtaskState.RUNNING: "yellow",
    SubtaskState.SUCCEEDED: "green",
    SubtaskState.FAILED: "red",
    SubtaskState.CANCELLED: "magenta",
}
_TASK_STYLES = {
    TaskState.SUCCEEDED: "green",
    TaskState.FAILED: "red",
    TaskState.CANCELLED: "magenta",
    TaskState.CANCELLING: "magenta",
}


def depths(plan: Plan) -> dict[str, int]:
    """Length of the longest chain before each subtask: its column in the graph."""
    after = {each.id: each.after for each in plan.subtasks}
    found: dict[str, int] = {}

    def depth(node: str) -> int:
        if node not in found:
            found[node] = 0
            found[node] = max((depth(parent) + 1 for parent in after[node] if parent in after), default=0)
        return found[node]

    for node in after:
        depth(node)
    return found


def params_text(params: dict[str, object]) -> str:
    """Parameters as `name=value`."""
    return " ".join(f"{key}={value}" for key, value in params.items())


def plan_graph(plan: Plan) -> Group:
    """A plan as a graph: one line a subtask, indented by depth, with what it comes after."""
    depth = depths(plan)
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("subtask", "skill", "robot", "parameters", "after", "tier", "confidence"):
        table.add_column(name, overflow="fold")
    for each in plan.subtasks:
        level = depth[each.id]
        branch = "  " * max(0, level - 1) + ("└─▶ " if level else "")
        table.add_row(
            f"{branch}{each.id}",
            each.skill,
            each.robot or "–",
            params_text(each.params),
            ", ".join(each.after) or "–",
            str(plan.tier),
            f"{plan.confidence:.2f}",
        )
    ids = {each.id for each in plan.subtasks if depth[each.id] == 0}
    head = Text(
        f"plan: {plan.domain}, {len(plan.subtasks)} subtasks, {len(ids)} may start at once, "
        f"planned in {plan.latency_ms:.0f} ms",
        style="bold",
    )
    return Group(head, table)


def held_text(record: TaskRecord) -> Group:
    """A plan that waits for approval: what it does, why it waits, how to approve it, until when."""
    proposal = record.proposal
    if proposal is None or not proposal.waits:
        return Group()
    lines = [
        f"task {record.id} waits for approval: {proposal.note or 'its plan is to be approved first'}",
        f"approve: swiftbot task approve {record.id} --hash {proposal.hash[:12]}",
        f"reject:  swiftbot task reject {record.id}",
    ]
    if proposal.expires_s:
        left_s = max(0.0, proposal.expires_s - (record.elapsed_s - proposal.since_s))
        until = datetime.fromtimestamp(time.time() + left_s).astimezone()
        lines.append(f"deadline: {until:%H:%M:%S} (in {left_s:.0f} s); without approval it fails")
    return Group(plan_graph(proposal.plan), Text("\n".join(lines), style="bold yellow"))


def tell_held(record: TaskRecord, told: str) -> str:
    """Print a plan that has begun to wait for approval, unless its hash is `told`; return the last hash printed."""
    proposal = record.proposal
    if proposal is None or not proposal.waits or record.state.final or proposal.hash == told:
        return told
    err.print(held_text(record))
    return proposal.hash


def plan_answer(answer: PlanAnswer) -> Group:
    """A plan, where it came from, and what it asks for."""
    parts: list[Group | Text] = [plan_graph(answer.plan)]
    if answer.plan.provenance is not None:
        parts.append(provenance_text(answer.plan.provenance))
    if answer.analysis is not None:
        parts.append(analysis_text(answer.analysis))
    return Group(*parts)


def brief(record: SubtaskRecord) -> str:
    """A result or failure in a few words; of a subtask that has not ended what it does or waits for goes first."""
    if record.note and not record.state.final and record.failure is not None:
        return record.note if record.failure.message in record.note else f"{record.note} ({record.failure.message})"
    if record.failure is not None and record.state is not SubtaskState.SUCCEEDED:
        return record.failure.message
    if record.note and not record.state.final:
        return record.note
    if record.partial and not record.result and not record.state.final:
        return f"so far: {_values(record.partial)}"
    return _values(record.result or {})


def _values(result: dict[str, Any]) -> str:
    shown: list[str] = []
    for key, value in result.items():
        if isinstance(value, dict):
            if "artifact" in value:
                shown.append(f"{key}={value.get('name')} ({value.get('bytes')} B)")  # pyright: ignore[reportUnknownMemberType]
        elif isinstance(value, list):
            shown.append(f"{key}: {len(value)}")  # pyright: ignore[reportUnknownArgumentType]
        else:
            shown.append(f"{key}={' '.join(str(value).split())[:60]}")
    return " ".join(shown)[:160]


def task_table(record: TaskRecord) -> Group:
    """A task with its subtasks: where each ran, in which phase, how long; below, what came of each. Fits 80 columns."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("subtask", "skill", "robot", "state", "gateway", "phase", "startup", "took", "tries"):
        table.add_column(name, no_wrap=True)
    for each in record.subtasks:
        table.add_row(
            each.subtask.id,
            each.subtask.skill,
            ", ".join(each.robots) or "–",
            Text(str(each.state), style=_STYLES[each.state]),
            each.gateway or "–",
            str(each.phase or "–"),
            milliseconds(each.startup_ms),
            milliseconds(each.duration_ms),
            str(each.attempt),
        )
    head = Text.assemble(
        ("task ", "bold"),
        record.id,
        " ",
        (status(record), _TASK_STYLES.get(record.state, "yellow")),
        f"  coordinated by {record.coordinator}{_order_text(record)}\n{record.instruction}",
    )
    ways = [Text(f"  {each.subtask.id} {way}", style="dim") for each in record.subtasks if (way := _way_text(each))]
    told = [
        Text(f"  {each.subtask.id}: {text}", style="red" if each.failure and not each.result else "dim")
        for each in record.subtasks
        if (text := brief(each))
    ]
    if done := done_text(record):
        table = Text("\n".join([done, *([record.note] if record.note else [])]))
    parts: list[object] = [head, table, *ways, *told, *revision_lines(record)]
    if record.failure is not None:
        remedy = f" ({record.failure.remedy})" if record.failure.remedy else ""
        parts.append(Text(f"{record.failure.message}{remedy}", style="red"))
    return Group(*parts)  # pyright: ignore[reportArgumentType]


def _order_text(record: TaskRecord) -> str:
    """What sets a task apart in the order of things, and its group; empty for a plain one without."""
    told = "" if record.priority == PLAIN_PRIORITY else f", priority {record.priority}"
    if record.deadline_s:
        told += f", deadline {record.deadline_s:g} s"
        if not record.state.final:
            told += f" ({max(0.0, record.deadline_s - record.elapsed_s):.0f} s left)"
    if record.group is not None:
        told += f"\ngroup: {', '.join(record.group.members)}; root {record.group.root}"
    return told


def _way_text(record: SubtaskRecord) -> str:
    """How its container came to serve it, where that was not simply a ready one of the gateway that was asked."""
    choice = record.attempts[-1].choice if record.attempts else None
    if choice is None or choice.way is Way.HERE:
        return ""
    told = {
        Way.RUN_THERE: f"was passed on to {choice.gateway}",
        Way.BRING_HERE: f"had its state brought to {choice.gateway}",
        Way.NEW: f"got a new container on {choice.gateway}",
    }
    return f"{told[choice.way]} by {choice.by}: {choice.why}"


def progress_line(record: SubtaskRecord) -> str:
    """One line of live progress for logs and pipes."""
    where = f" on {record.gateway}" if record.gateway else ""
    share = f" {record.progress:.0%}" if record.state is SubtaskState.RUNNING and record.progress else ""
    told = brief(record)
    return (
        f"  {record.subtask.id:>4} {record.subtask.skill:<14} {record.state}{where}{share}{'  ' + told if told else ''}"
    )


def task_list(records: Sequence[TaskRecord]) -> Table:
    """Tasks, a line each."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    waits = {record.id: text for record in records if (text := waits_for(record))}
    for name in ("task", "state", "done", "coordinator", "instruction", *(["waits for"] if waits else [])):
        table.add_column(name, overflow="fold")
    for record in records:
        done = sum(each.state is SubtaskState.SUCCEEDED for each in record.subtasks)
        table.add_row(
            record.id,
            Text(status(record), style=_TASK_STYLES.get(record.state, "yellow")),
            f"{done}/{len(record.subtasks)}",
            record.coordinator,
            record.instruction,
            *([Text(waits.get(record.id, ""), style="yellow")] if waits else []),
        )
    return table


def fleet_view(gateways: Sequence[GatewayStatus], lost: Mapping[str, int] | None = None) -> Group:
    """Gateways, a line each, and below them what is wrong with the recorders.

    Args:
        gateways: those that answer.
        lost: those that do not, and since when, Unix nanoseconds.
    """
    notes = together(note for each in gateways for note in each.recorders)
    lines = [Text(f"! {text}", style="yellow") for note in notes if (text := recorder_text(note))]
    lines += [Text(f"! recorder {note.id}: {note.going}", style="yellow") for note in notes if note.going]
    if any(each.parts == DEVELOPMENT for each in gateways):
        lines.append(Text(DEVELOPMENT, style="dim"))
    return Group(gateway_table(gateways, lost), *lines)


def recorder_text(note: RecorderNote) -> str:
    """What is wrong with a recorder, with a hint; empty when nothing is."""
    problem = problem_of(note)
    name = f"recorder {note.id}".removesuffix(" recorder")
    return f"{name}: {problem} (hint: `swiftbot log info FILE` says when)" if problem else ""


def gateway_table(gateways: Sequence[GatewayStatus], lost: Mapping[str, int] | None = None) -> Table:
    """Gateways, a line each; `lost`: those that do not answer, and since when."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in (
        "gateway",
        "version",
        "load",
        "memory",
        "containers",
        "runs",
        "tasks",
        "robots",
        "plans with",
        "state",
    ):
        table.add_column(name, overflow="fold")
    for each in gateways:
        state = "draining" if each.draining else each.pool_problem or "up"
        if not each.limits_enforced:
            state += ", container limits not enforced"
        if each.site_problem:
            state += f", {each.site_problem}"
        if each.keys_problem:
            state += f", {each.keys_problem}"
        if each.parts_problem:
            state += f", {each.parts_problem}"
        table.add_row(
            each.id,
            each.version or "–",
            f"{each.load:.0%}",
            f"{each.memory_mb:.0f} MB",
            f"{each.ready} ready of {each.containers} (at most {each.capacity})",
            str(each.running),
            str(each.tasks),
            ", ".join(each.robots) or "–",
            ", ".join(each.models) or "–",
            state,
        )
    for name, since_ns in sorted((lost or {}).items()):
        state = Text(f"LOST since {time_of_day(since_ns)}", style="bold red")
        table.add_row(name, *("–" for _ in range(8)), state)
    return table


def container_table(containers: Sequence[ContainerInfo]) -> Table:
    """Pooled containers, a line each."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("gateway", "container", "image", "state", "runs", "cold start", "run"):
        table.add_column(name, overflow="fold")
    for each in containers:
        table.add_row(
            each.gateway,
            each.id[:12],
            each.image,
            str(each.state),
            str(each.runs),
            milliseconds(each.cold_ms),
            each.run,
        )
    return table


def evicted_text(found: Mapping[str, Evicted]) -> Text:
    """What pools gave up and what they kept, a line a gateway."""
    lines: list[str] = []
    for gateway, answer in sorted(found.items()):
        gone = f"gave up {', '.join(answer.containers)}" if answer.containers else "had none idle"
        kept = "".join(f"; kept {name}: {reason}" for name, reason in answer.kept.items())
        lines.append(f"{gateway} {gone}{kept}{f'; {answer.note}' if answer.note else ''}")
    return Text("\n".join(lines))


def decision_table(rows: Sequence[tuple[str, PoolDecision]]) -> Table:
    """What pools started and gave up, newest first; times of this machine's zone."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("at", "gateway", "what", "image", "container", "why"):
        table.add_column(name, overflow="fold")
    for gateway, each in rows:
        at = datetime.fromtimestamp(each.at_ns / 1e9).astimezone()
        table.add_row(f"{at:%H:%M:%S}", gateway, each.what, each.image, each.container[:12], each.why)
    return table


def robot_table(robots: Sequence[RobotInfo], held: Mapping[str, str] | None = None) -> Table:
    """Robots, a line each; `held`: by name, who has stopped a robot or taken it over."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("robot", "kind", "by", "has", "pose", "battery", "mode", "state"):
        table.add_column(name, overflow="fold")
    for each in robots:
        pose = f"{each.pose.x:.1f} {each.pose.y:.1f} {each.pose.z:.1f}" if each.pose else "–"
        battery = f"{each.battery_percent:.0f} %" if each.battery_percent is not None else "–"
        state = "online" if each.online else "offline"
        if told := (held or {}).get(each.id):
            state += f", {told}"
        if each.holding:
            state += f", holds {each.holding}"
        for words in (*each.estimator, *each.warnings):
            state += f", {words}"
        if each.seized:
            state += f", taken: {each.seized}"
        elif each.failsafe:
            state += f", {each.failsafe}"
        table.add_row(
            each.id, each.kind, each.gateway or "direct", ", ".join(each.uses), pose, battery, each.mode, state
        )
    return table


QUEUE_STATES = {
    "runs": "runs",
    "begun": "has begun, the robot is its own",
    "ready": "waits for its turn",
    "later": "waits for something else",
}
"""`RobotWork.state` in words."""


def queue_table(work: Sequence[RobotWork]) -> Table:
    """What tasks have for robots, a line each, in order."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("robot", "task", "state", "priority", "takes"):
        table.add_column(name, overflow="fold")
    for each in work:
        state = QUEUE_STATES.get(each.state, each.state)
        table.add_row(each.robot, each.task, state, str(each.priority), f"{each.takes_s:.0f} s")
    return table


def replay_summary(report: ReplayReport) -> Group:
    """Outcome of replaying a log."""
    lines = [Text(f"replay of {report.path}: {report.messages:,} messages, {len(report.tasks)} tasks", style="bold")]
    for task in report.tasks:
        verdict = "same end state" if task.same else "DIFFERS"
        lines.append(
            Text(
                f"  {task.task}  {verdict}: logged {task.logged}, replayed {task.replayed} "
                f"({task.transitions} transitions)",
                style="green" if task.same else "red",
            )
        )
        lines.extend(Text(f"      {difference}", style="red") for difference in task.differences)
    return Group(*lines)


def check_summary(report: CheckReport) -> Group:
    """What came of checking logs: the first difference whole, the others in a line."""
    made = ", ".join(f"{count:,} {what}" for what, count in sorted(report.checked.items())) or "none"
    lines = [
        Text(f"{report.messages:,} messages, {report.tasks:,} tasks", style="bold"),
        Text(f"  made again: {made}"),
    ]
    if report.unchecked:
        missing = ", ".join(f"{count:,} {why}" for why, count in sorted(report.unchecked.items()))
        lines.append(Text(f"  not checked: {missing}", style="dim"))
    lines.extend(Text(f"  ! {problem}", style="yellow") for problem in report.problems)
    if report.same:
        lines.append(Text("no decision comes out differently", style="green"))
        return Group(*lines)
    first, *others = report.divergences
    at = datetime.fromtimestamp(first.at_ns / 1e9, tz=UTC).isoformat(timespec="milliseconds")
    lines += [
        Text(
            f"{report.diverged:,} decisions come out differently; the first, {first.decider}, at {at} in {first.log}:",
            style="red",
        ),
        Text(f"  {first.what}"),
        Text(f"    logged  {first.logged}"),
        Text(f"    now     {first.now}", style="red"),
        *(Text(f"  {each.decider}: {each.what}", style="dim") for each in others[:10]),
    ]
    return Group(*lines)


def played_text(played: Played) -> Group:
    """What came of a replay."""
    how = "to the end" if played.ended else "stopped"
    lines = [Text(f"{played.messages:,} messages played in {played.took_s:.1f} s, {how}", style="bold")]
    if played.left_out:
        lines.append(Text(f"  {played.left_out:,} orders were left out (--orders plays them)", style="dim"))
    lines.extend(Text(f"  ! {problem}", style="yellow") for problem in played.problems)
    return Group(*lines)


def log_summary(found: LogInfo) -> Group:
    """What a log holds."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("channel", "messages", "encoding", "schema"):
        table.add_column(name, overflow="fold")
    for each in sorted(found.channels, key=lambda channel: -channel.messages):
        table.add_row(each.key, f"{each.messages:,}", each.encoding, each.schema or "–")
    head = Text(
        f"{found.path}: {found.messages:,} messages in {found.duration_s:.1f} s, {found.size_bytes:,} bytes",
        style="bold",
    )
    notes = [Text(f"! {problem}", style="yellow") for problem in found.problems]
    if found.dropped:
        notes.append(Text(f"! the recorder could not write {found.dropped:,} messages", style="yellow"))
    if found.not_heard:
        notes.append(
            Text(f"! {found.not_heard:,} messages never reached the recorder, by their numbers", style="yellow")
        )
    if found.missed:
        notes.append(Text(f"! missing by key: {kinds_text(found.missed, most=8)}", style="yellow"))
    if found.not_received:
        text = f"{found.not_received:,} frames of vehicles were received by no gateway (link, or the gateway was down)"
        notes.append(Text(f"· {text}", style="dim"))
    for each in found.incidents:
        at = datetime.fromtimestamp(each.at_ns / 1e9, tz=UTC).isoformat(timespec="milliseconds")
        notes.append(Text(f"incident {at} {each.reason} {each.detail} {each.key}".rstrip(), style="bold red"))
    if found.attachments:
        notes.append(Text(f"attached: {', '.join(found.attachments)}", style="dim"))
    return Group(head, *notes, table)


def image_table(images: Sequence[ImageState], *, gateways: bool = False) -> Table:
    """Images of the catalogue, a line each; with the gateways that have it where a fleet was asked."""
    table = Table(box=None, pad_edge=False, header_style="bold dim")
    for name in ("image", "reference", "state", "size", *(["gateways"] if gateways else [])):
        table.add_column(name, overflow="fold")
    for each in images:
        size = f"{each.size_bytes / 2**20:.0f} MiB" if each.size_bytes else "–"
        holders = [", ".join(each.gateways) or "none"] if gateways else []
        table.add_row(each.name, each.reference, "built" if each.present else "not built", size, *holders)
    return table


def brought_text(brought: Brought, target: str) -> str:
    """What a transfer did, in a line."""
    if not brought.gateway:
        return f"{brought.what} is on {target} already"
    moved = f"{brought.wire_bytes / 2**20:.1f} MiB over the network in {brought.duration_ms / 1e3:.1f} s"
    return f"{brought.what} came to {target} from {brought.gateway}: {moved}"


def check_table(checks: Sequence[Check]) -> Group:
    """Checks of this machine; a failed one with its remedy."""
    lines: list[Text] = []
    for check in checks:
        mark, style = ("ok", "green") if check.ok else ("FAIL", "red") if check.required else ("note", "yellow")
        lines.append(Text.assemble((f"{mark:>4}", style), f"  {check.name}: {check.detail}"))
        if not check.ok and check.remedy:
            lines.append(Text(f"      hint: {check.remedy}"))
    return Group(*lines)


def bench_table(result: Mapping[str, Any]) -> Table:
    """Figures of a benchmark, a line each; nested ones by their path."""
    table = Table(box=None, pad_edge=False, show_header=False)

    def add(prefix: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for key, each in value.items():  # pyright: ignore[reportUnknownVariableType]
                add(f"{prefix}.{key}" if prefix else str(key), each)  # pyright: ignore[reportUnknownArgumentType]
        else:
            table.add_row(prefix, f"{value:.3f}" if isinstance(value, float) else str(value))

    add("", result)
    return table
