"""Run orders: what a coordinator asks of the gateway that a subtask is sent to, from the record and the manifest."""

from collections.abc import Sequence
from typing import Any

from appliance.model import Need, RunRequest, SubtaskRecord, TaskRecord
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.records import MAX_RUN_S

LEAVE_S = 8.0
"""How long a run that is left may take to end before the next attempt begins elsewhere: its handler's grace, and
what it changed in volumes being noted. Beyond that it is fenced off by its attempt number alone."""


def need_of(manifest: SkillManifest) -> Need:
    """What a skill asks of a container."""
    return Need(image=manifest.image, cpu=manifest.cpu, memory_mb=manifest.memory_mb, volumes=manifest.volumes)


def deadline_s(manifest: SkillManifest, params: dict[str, Any]) -> float:
    """Time a run may take: the skill's own, beyond the duration that was asked for (within bounds)."""
    asked = params.get("duration_s", 0.0)
    # Compared before it becomes a float: an integer of a plan may be too large for one.
    extra = min(MAX_RUN_S, max(0.0, asked)) if isinstance(asked, int | float) and asked == asked else 0.0  # noqa: PLR0124 - not a number
    return manifest.timeout_s + float(extra)


def request_for(
    record: TaskRecord,
    target: SubtaskRecord,
    manifest: SkillManifest,
    *,
    robots: Sequence[str],
    coordinator: str,
    elapsed_s: float = 0.0,
) -> RunRequest:
    """Return the order for the next attempt at a subtask by `robots`; `elapsed_s`: since its task was accepted."""
    subtask = target.subtask
    return RunRequest(
        task=record.id,
        subtask=subtask.id,
        attempt=target.next_attempt,
        skill=subtask.skill,
        need=need_of(manifest),
        robot=robots[0] if robots else None,
        others=tuple(robots[1:]),
        params=subtask.params,
        inputs=_inputs(record, target),
        coordinator=coordinator,
        deadline_s=deadline_s(manifest, subtask.params),
        priority=record.priority,
        due_s=max(0.001, record.deadline_s - elapsed_s) if record.deadline_s else 0.0,
        submitter=record.submitter,
        group=record.within,
        moves=sum(bool(each.left) for each in target.attempts),
        avoid=tuple(sorted({each.gateway for each in target.attempts if each.failure and each.gateway})),
    )


def _inputs(record: TaskRecord, target: SubtaskRecord) -> dict[str, dict[str, Any]]:
    """Results of the subtasks it comes after, directly or not: a report needs the picture two steps back."""
    found: dict[str, dict[str, Any]] = {}
    open_ids = list(target.subtask.after)
    while open_ids:
        before = record.of(open_ids.pop(0))
        if before.subtask.id not in found:
            found[before.subtask.id] = {"skill": before.subtask.skill, **(before.result or {})}
            open_ids.extend(before.subtask.after)
    return found
