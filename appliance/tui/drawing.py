"""Text out of facts: rows of the tables and the drawing of a plan. Pure, so that tests read what a person reads.

State is told by a sign and a word, never by colour alone.
"""

from collections.abc import Iterable, Sequence
from datetime import datetime

from rich.text import Text

from appliance.model import (
    ContainerState,
    Failure,
    GatewayStatus,
    Plan,
    Pose,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskState,
)
from appliance.record.facts import RecorderStatus
from appliance.tasks.api import PlanAnswer
from appliance.tui.board import SILENT, Entry, Snapshot

Row = tuple[Text, ...]
Rows = dict[str, Row]
"""Rows of a table by key, in order."""

GATEWAYS = ("gateway", "load", "cpu", "mem", "ready/all", "runs", "tasks", "state", "robots")
ROBOTS = ("robot", "kind", "at", "mode", "batt", "place x y z", "state")
TASKS = ("task", "state", "done", "instruction")
CONTAINERS = ("container", "gateway", "image", "state", "runs", "cold", "cpu/mem", "running now")

_SUBTASK = {
    SubtaskState.WAITING: ("·", "dim"),
    SubtaskState.READY: ("○", "cyan"),
    SubtaskState.DISPATCHED: ("◔", "cyan"),
    SubtaskState.RUNNING: ("●", "yellow"),
    SubtaskState.SUCCEEDED: ("✔", "green"),
    SubtaskState.FAILED: ("✘", "red"),
    SubtaskState.CANCELLED: ("⊘", "magenta"),
}
_TASK = {
    TaskState.ACCEPTED: ("○", "cyan"),
    TaskState.RUNNING: ("●", "yellow"),
    TaskState.CANCELLING: ("◌", "magenta"),
    TaskState.SUCCEEDED: ("✔", "green"),
    TaskState.FAILED: ("✘", "red"),
    TaskState.CANCELLED: ("⊘", "magenta"),
}
_CONTAINER = {
    ContainerState.STARTING: "cyan",
    ContainerState.READY: "green",
    ContainerState.RESERVED: "cyan",
    ContainerState.BUSY: "yellow",
    ContainerState.DRAINING: "magenta",
    ContainerState.DEAD: "red",
}
_LEVELS = {"debug": "dim", "warning": "yellow", "error": "red", "exception": "red", "critical": "bold red"}
_BAR_WIDTH = 12
_ID_WIDTH = 12


def milliseconds(value: float | None) -> str:
    """Return a duration for people, empty for none."""
    if value is None:
        return ""
    return f"{value:.1f} ms" if value < 1000 else f"{value / 1000:.1f} s"


def bar(fraction: float, width: int = _BAR_WIDTH) -> str:
    """Return a progress bar of `width` cells and the percentage; `fraction` outside 0 to 1 is cut."""
    share = min(1.0, max(0.0, fraction))
    full = round(share * width)
    return f"{'█' * full}{'░' * (width - full)} {share:.0%}"


def told(failure: Failure | None) -> str:
    """Return a failure with its remedy in one line."""
    if failure is None:
        return ""
    return f"{failure.message} → {failure.remedy}" if failure.remedy else failure.message


# --- tables ------------------------------------------------------------------------------------------------


def _row(*cells: str | Text) -> Row:
    return tuple(cell if isinstance(cell, Text) else Text(cell) for cell in cells)


def gateway_state(status: GatewayStatus) -> Text:
    """Return a gateway's state in few words; `gateway_notes` has the whole story."""
    if status.draining:
        return Text("draining", "magenta")
    if status.pool_problem:
        return Text("✘ pool", "red")
    if not status.limits_enforced:
        return Text("▲ no limits", "yellow")
    return Text("✔ up", "green")


def gateway_rows(snapshot: Snapshot) -> Rows:
    """Return one row per gateway."""
    return {
        each.id: _row(
            Text(each.id, "bold"),
            f"{each.load:.0%}",
            f"{each.cpu_percent:.0f}%",
            f"{each.memory_mb:.0f}M",
            f"{each.ready}/{each.containers}",
            f"{each.running}+{each.queue}" if each.queue else str(each.running),
            str(each.tasks),
            gateway_state(each),
            ", ".join(each.robots),
        )
        for each in snapshot.gateways
    }


def gateway_notes(gateways: Iterable[GatewayStatus]) -> Text:
    """Return what is wrong with gateways in whole sentences, a line each."""
    lines: list[Text] = []
    for each in gateways:
        if each.pool_problem:
            lines.append(Text(f"✘ {each.id}: {each.pool_problem}", "red"))
        if not each.limits_enforced:
            lines.append(
                Text(
                    f"▲ {each.id}: container CPU and memory limits are not enforced (the kernel delegates no cgroups)",
                    "yellow",
                )
            )
        refused = sum(each.refused.values())
        if refused:
            kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(each.refused.items()))
            lines.append(Text(f"· {each.id}: {refused} bad inputs refused ({kinds})", "dim"))
    return Text("\n").join(lines)


def recorder_notes(recorders: Iterable[RecorderStatus]) -> Text:
    """Return how the recorders are, a line each."""
    lines: list[Text] = []
    for each in recorders:
        dropped = sum(each.dropped.values())
        lost = f", {dropped} lost ({', '.join(sorted(each.dropped))})" if dropped else ""
        if each.problem:
            lines.append(Text(f"✘ recorder {each.id}: {each.problem}{lost}", "red"))
        elif each.state == SILENT:
            lines.append(Text(f"▲ recorder {each.id}: not heard any more; is `swiftbot record` running?", "yellow"))
        else:
            style = "yellow" if dropped else "dim"
            lines.append(Text(f"✔ recorder {each.id}: {each.messages} messages in {each.file}{lost}", style))
    return Text("\n").join(lines)


def _place(pose: Pose | None) -> str:
    return "" if pose is None else f"{pose.x:.1f} {pose.y:.1f} {pose.z:.1f}"


def robot_rows(snapshot: Snapshot) -> Rows:
    """Return one row per robot."""
    return {
        each.id: _row(
            Text(each.id, "bold"),
            each.kind,
            each.gateway or "itself",
            f"{each.mode}{' armed' if each.armed else ''}".strip(),
            "" if each.battery_percent is None else f"{each.battery_percent:.0f}%",
            _place(each.pose),
            _robot_state(online=each.online, holding=each.holding, note=each.note),
        )
        for each in snapshot.robots
    }


def _robot_state(*, online: bool, holding: str, note: str) -> Text:
    words = " ".join(part for part in (f"holds {holding}" if holding else "", note) if part)
    if not online:
        return Text(f"✘ offline {words}".rstrip(), "red")
    return Text(f"✔ {words}".rstrip(), "green")


def task_state(record: TaskRecord) -> Text:
    """Return a task's state with its sign."""
    sign, style = _TASK[record.state]
    return Text(f"{sign} {record.state}", style)


def task_rows(snapshot: Snapshot) -> Rows:
    """Return one row per task, newest first."""
    return {
        each.id: _row(
            Text(each.id if len(each.id) <= _ID_WIDTH else f"{each.id[: _ID_WIDTH - 1]}…", "bold"),
            task_state(each),
            f"{sum(part.state is SubtaskState.SUCCEEDED for part in each.subtasks)}/{len(each.subtasks)}",
            each.instruction,
        )
        for each in snapshot.tasks
    }


def container_rows(snapshot: Snapshot) -> Rows:
    """Return one row per container of the fleet."""
    return {
        f"{each.gateway}/{each.id}": _row(
            Text(each.id[:_ID_WIDTH], "bold"),
            each.gateway,
            each.image.rsplit("/", 1)[-1],
            Text(str(each.state), _CONTAINER[each.state]),
            str(each.runs),
            milliseconds(each.cold_ms),
            f"{each.cpu:g}/{each.memory_mb}M",
            each.run,
        )
        for each in snapshot.containers
    }


def entry_line(entry: Entry) -> Text:
    """Return a line of the log screen."""
    clock = datetime.fromtimestamp(entry.at_ns / 1e9).astimezone().strftime("%H:%M:%S") if entry.at_ns > 0 else "-" * 8
    style = _LEVELS.get(entry.level, "green" if entry.kind == "notice" else "")
    return Text.assemble(
        (clock, "dim"),
        " ",
        (f"{entry.kind:<6}", "bold"),
        " ",
        (f"{entry.source[:14]:<14}", "cyan"),
        " ",
        (entry.text, style),
    )


def contains(row: Iterable[Text], wanted: str) -> bool:
    """Whether any cell contains a text, case ignored; every row contains nothing."""
    return not wanted or any(wanted.lower() in cell.plain.lower() for cell in row)


# --- plans and tasks ---------------------------------------------------------------------------------------


def depths(plan: Plan) -> dict[str, int]:
    """Return the length of the longest chain before each subtask: how far it is indented."""
    after = {each.id: each.after for each in plan.subtasks}
    found: dict[str, int] = {}

    def depth(node: str) -> int:
        if node not in found:
            found[node] = 0  # a cycle, which the validator refuses, ends here
            found[node] = max((depth(parent) + 1 for parent in after[node] if parent in after), default=0)
        return found[node]

    for node in after:
        depth(node)
    return found


def _ordered(plan: Plan) -> list[str]:
    """Return ids so that each subtask stands below all it comes after, and right below the last of them."""
    ids = {each.id for each in plan.subtasks}
    missing = {each.id: len(set(each.after) & ids) for each in plan.subtasks}
    children: dict[str, list[str]] = {}
    for each in plan.subtasks:
        for parent in set(each.after) & ids:
            children.setdefault(parent, []).append(each.id)
    out: list[str] = []
    waiting = [name for name in missing if not missing[name]][::-1]
    while waiting:
        node = waiting.pop()
        out.append(node)
        for child in children.get(node, ())[::-1]:
            missing[child] -= 1
            if not missing[child]:
                waiting.append(child)
    return out + [each.id for each in plan.subtasks if each.id not in out]  # a cycle, which the validator refuses


def _branch(level: int) -> str:
    return f"{'   ' * (level - 1)}└─▶ " if level else ""


def _params(params: dict[str, object]) -> str:
    return " ".join(f"{key}={value}" for key, value in params.items())


def plan_text(plan: Plan) -> Text:
    """Draw a plan that is not running yet: one line per subtask under what it comes after."""
    level = depths(plan)
    by_id = {each.id: each for each in plan.subtasks}
    first = sum(depth == 0 for depth in level.values())
    out = Text()
    out.append(
        f"{plan.domain}: {len(plan.subtasks)} subtask{'s' if len(plan.subtasks) != 1 else ''}, "
        f"{first} at once · {plan.tier} tier, {plan.confidence:.0%} sure, {plan.latency_ms:.0f} ms\n",
        "bold",
    )
    for name in _ordered(plan):
        each = by_id[name]
        out.append(f"{_branch(level[name])}")
        out.append(f"{name} ", "bold")
        out.append(each.skill, "cyan")
        out.append(f" {each.robot or 'on a gateway'}")
        if each.params:
            out.append(f"  {_params(each.params)}", "dim")
        if len(each.after) > 1:
            out.append(f"  after {', '.join(each.after)}", "dim")
        out.append("\n")
    return out


def answer_text(answer: PlanAnswer) -> Text:
    """Draw the answer to a question for a plan: the plan, and what each tier that was asked made of it."""
    out = plan_text(answer.plan)
    for attempt in answer.attempts:
        if not attempt.ok:
            out.append(f"{attempt.tier} tier declined: {'; '.join(attempt.problems)}\n", "dim")
    return out


def task_text(record: TaskRecord) -> Text:
    """Draw a task: what was asked, its plan as a graph, and what became of each subtask."""
    out = Text.assemble((record.id, "bold"), " ", task_state(record))
    if record.coordinator:
        out.append(f" · coordinated by {record.coordinator}")
    if record.submitter:
        out.append(f" · from {record.submitter}")
    out.append(f"\n{record.instruction}\n")
    if record.failure is not None:
        out.append(f"✘ {told(record.failure)}\n", "red")
    if record.plan is None:
        if not record.state.final:
            out.append("being planned …\n", "dim")
        return out
    level = depths(record.plan)
    by_id = {each.subtask.id: each for each in record.subtasks}
    for name in _ordered(record.plan):
        each = by_id.get(name)
        if each is not None:
            out.append_text(subtask_text(each, level[name]))
    return out


def subtask_text(record: SubtaskRecord, level: int) -> Text:
    """Draw one subtask: a line of what it is and how it stands, one of where and how long, one of why it failed."""
    sign, style = _SUBTASK[record.state]
    subtask = record.subtask
    out = Text(_branch(level), "dim")
    out.append(f"{sign} {subtask.id} ", f"bold {style}")
    out.append(subtask.skill, "cyan")
    robot = record.bound_robot or subtask.robot
    out.append(f" {robot}" if robot else " on a gateway")
    if len(subtask.after) > 1:
        out.append(f" after {', '.join(subtask.after)}", "dim")
    out.append(f"  {record.state}", style)
    if record.state is SubtaskState.RUNNING:
        out.append(f" {bar(record.progress)}", style)
    out.append("\n")
    margin = " " * (len(_branch(level)) + 2)
    facts = _facts(record)
    if facts:
        out.append(f"{margin}{' · '.join(facts)}\n", "dim")
    if record.failure is not None and record.state is not SubtaskState.SUCCEEDED:
        out.append(f"{margin}✘ {told(record.failure)}\n", "red")
    return out


def _facts(record: SubtaskRecord) -> Sequence[str]:
    facts = [
        record.gateway,
        str(record.phase or ""),
        f"start {milliseconds(record.startup_ms)}" if record.startup_ms is not None else "",
        f"took {milliseconds(record.duration_ms)}" if record.duration_ms is not None else "",
        f"attempt {record.attempt}" if record.attempt > 1 else "",
        record.note if not record.state.final else "",
        _result(record.result) if record.state is SubtaskState.SUCCEEDED else "",
    ]
    return [fact for fact in facts if fact]


def _result(result: dict[str, object] | None) -> str:
    """Return a result in few words: files by name, lists by length."""
    parts: list[str] = []
    for key, value in (result or {}).items():
        if isinstance(value, dict):
            name = value.get("name")  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
            parts.append(f"{key}={name}" if name else key)
        elif isinstance(value, list):
            parts.append(f"{key}: {len(value)}")  # pyright: ignore[reportUnknownArgumentType]
        else:
            parts.append(f"{key}={str(value)[:40]}")
    return " ".join(parts)[:160]
