"""What the command line prints of plans: where they came from, what they ask for, what was learned from them."""

from rich.console import Group
from rich.table import Table
from rich.text import Text

from appliance.llm.analysis import Analysis
from appliance.model import Provenance
from appliance.tasks.api import ExperienceList


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
        lines.append(f"{each.label}: {', '.join(each.robots) or 'no robot that is known'} can do it{last}")
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
    head = Text(f"expected to take {found.expected_s:.0f} s when nothing waits; containers it will need:", style="bold")
    return Group(*(Text(line) for line in lines), head, table)


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
    tail = Text(f"plans run unasked from: {moved or '–'}")
    return Group(Text(f"as {found.gateway} has heard", style="bold"), table, tail)
