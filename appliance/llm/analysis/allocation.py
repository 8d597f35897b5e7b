"""Allocation hints: which containers a plan will need, how many at once, and about when. Pure.

The paper's hint is (image, cpu, memory, volumes); here it comes from the manifests, and from what runs of the same
skills took: how long, so that it is known when the next begin, and how much memory.
"""

from collections.abc import Callable, Mapping

from msgspec import Struct

from appliance.model import Plan, Subtask
from appliance.skills.catalogue import SkillManifest


class Allocation(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a plan asks of pools, for one image and set of volumes."""

    image: str
    cpu: float
    memory_mb: int
    volumes: tuple[str, ...] = ()
    count: int = 1
    """Containers that are needed at the same time."""
    start_s: float = 0.0
    """Expected from the plan's beginning until the first is needed."""
    busy_s: float = 0.0
    """Expected from then until the last is done."""
    subtasks: tuple[str, ...] = ()
    seen_mb: float = 0.0
    """Most memory that runs of these skills took lately; 0: not known."""


def starts(plan: Plan, seconds: Mapping[str, float]) -> dict[str, float]:
    """Return when each subtask is expected to begin, seconds from the plan's beginning, when nothing waits."""
    begins: dict[str, float] = {}
    left = list(plan.subtasks)
    ids = {each.id for each in left}
    while left:
        later: list[Subtask] = []
        for each in left:
            before = [name for name in each.after if name in ids]
            if all(name in begins for name in before):
                begins[each.id] = max((begins[name] + seconds.get(name, 0.0) for name in before), default=0.0)
            else:
                later.append(each)
        if len(later) == len(left):
            break  # a circle, which no valid plan has
        left = later
    return begins


def allocations(
    plan: Plan,
    manifests: Mapping[str, SkillManifest],
    *,
    expected_s: Callable[[Subtask], float],
    peak_mb: Callable[[str], float],
) -> tuple[Allocation, ...]:
    """Return what a plan asks of pools, the first needed first.

    Args:
        plan: a valid one.
        manifests: by skill; a skill without asks for nothing.
        expected_s: how long a subtask is expected to take.
        peak_mb: most memory that runs of a skill took lately.
    """
    seconds = {each.id: max(0.0, expected_s(each)) for each in plan.subtasks}
    begins = starts(plan, seconds)
    grouped: dict[tuple[str, tuple[str, ...]], list[Subtask]] = {}
    for each in plan.subtasks:
        manifest = manifests.get(each.skill)
        if manifest is not None and each.id in begins:
            grouped.setdefault((manifest.image, manifest.volumes), []).append(each)
    found: list[Allocation] = []
    for (image, volumes), subtasks in grouped.items():
        spans = [(begins[each.id], begins[each.id] + seconds[each.id]) for each in subtasks]
        first = min(start for start, _ in spans)
        used = [manifests[each.skill] for each in subtasks]
        found.append(
            Allocation(
                image=image,
                cpu=max(each.cpu for each in used),
                memory_mb=max(each.memory_mb for each in used),
                volumes=volumes,
                count=max(sum(start <= at < end or start == at for start, end in spans) for at, _ in spans),
                start_s=round(first, 2),
                busy_s=round(max(end for _, end in spans) - first, 2),
                subtasks=tuple(each.id for each in subtasks),
                seen_mb=round(max((peak_mb(each.id) for each in used), default=0.0), 1),
            )
        )
    return tuple(sorted(found, key=lambda each: (each.start_s, each.image, each.volumes)))
