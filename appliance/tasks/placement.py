"""Coarse scheduling as a pure function: which gateway should a subtask be sent to, and why.

score(gateway) = w_l · (1 − load) + w_d · proximity + w_w · warm (paper, two-level scheduling; `algorithms.md`),
with proximity = share of the bytes of its input files and state volumes held there, or 1 where its robot's link
is and there are none, and warm = 1 if a ready container of the image is there, 0.5 for a compatible one. Of a gateway
that has been silent for longer than it promised, load and warmth count less the longer ago they were so. A gateway
that is draining, cannot start containers and has none ready, or failed this subtask before while others remain, is
no candidate. Ties go to the gateway that asks: it is a network hop nearer.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime

from msgspec import Struct

from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Need,
    RobotInfo,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
)
from appliance.tasks.artifacts import bytes_by_gateway
from appliance.tasks.groups.capability import lacks
from appliance.tasks.settings import TasksConfig

_ANY = re.compile(r"any\d{0,2}")
"""Labels for a robot to be chosen; a robot may be called `anymal_1`."""


STALE_HALF_S = 5.0
"""After so long beyond its promise, half of what a gateway said of its load and containers is believed."""
UNKNOWN_LOAD = 0.5
"""What is expected of a gateway of which nothing is known."""


class Placement(Struct, frozen=True, kw_only=True):
    """The gateways in order of preference, and a sentence for people on how that came about."""

    order: tuple[str, ...]
    why: str
    scores: dict[str, float] = {}
    """Of those in the order."""
    excluded: dict[str, str] = {}
    """Gateways that are no candidates, with the reason."""


def place(
    need: Need,
    *,
    here: str,
    gateways: Mapping[str, GatewayStatus],
    containers: Mapping[str, Mapping[str, ContainerInfo]],
    holds: Mapping[str, float],
    robot: RobotInfo | None,
    avoid: frozenset[str],
    config: TasksConfig,
    stale_s: Mapping[str, float] | None = None,
    excluded: Mapping[str, str] | None = None,
) -> Placement:
    """Order the gateways a subtask could be sent to, best first.

    Args:
        need: what it asks of a container.
        here: the asking gateway.
        gateways: present gateways by id.
        containers: their pooled containers by gateway and id.
        holds: gateway -> share (0 to 1) of the subtask's data it holds (function `holds`).
        robot: the robot it commands, if any.
        avoid: gateways where an attempt at it failed; used only when nothing else is left.
        config: the weights.
        stale_s: for how long a gateway has been silent beyond what it promised, where it has.
        excluded: gateways that cannot serve it (`groups.capability`), with the reason.
    """
    scored: list[tuple[float, bool, str, str]] = []
    without: dict[str, str] = {}
    for gateway, status in gateways.items():
        warm = warmth(need, containers.get(gateway, {}).values())
        if status.draining:
            without[gateway] = "is draining"
        elif reason := (excluded or {}).get(gateway, ""):
            without[gateway] = reason
        elif status.pool_problem and not warm:
            without[gateway] = status.pool_problem
        if gateway in without:
            continue
        near = holds.get(gateway, 0.0)
        if not holds and robot is not None:
            near = float(robot.gateway == gateway)
        silent_s = (stale_s or {}).get(gateway, 0.0)
        counts = trust(silent_s)
        score = (
            config.load_weight * (1 - settled_load(status.load, silent_s))
            + config.data_weight * near
            + config.warm_weight * warm * counts
        )
        silent = f" (silent for {silent_s:.0f} s too long)" if silent_s >= 0.5 else ""
        scored.append((score, gateway == here, gateway, f"{gateway} {score:.2f}{silent}"))
    # One that gives runs away for want of room is given one only when nobody else is left.
    scored.sort(key=lambda row: (row[2] in avoid, bool(gateways[row[2]].overloaded), -row[0], not row[1], row[2]))
    reasons = [f"{name} {text}" if text == "is draining" else f"{name}: {text}" for name, text in without.items()]
    if not scored:
        return Placement(order=(), why="; ".join(reasons) or "no gateway is present", excluded=without)
    return Placement(
        order=tuple(row[2] for row in scored),
        why=", ".join([row[3] for row in scored] + reasons),
        scores={row[2]: round(row[0], 3) for row in scored},
        excluded=without,
    )


def trust(silent_s: float) -> float:
    """How far facts of a gateway count that has been silent for so long beyond what it promised, 1 to 0."""
    return 0.5 ** (silent_s / STALE_HALF_S)


def settled_load(load: float, silent_s: float) -> float:
    """Return a load as it may be by now: the longer the silence, the nearer to what is thought of the unknown."""
    return UNKNOWN_LOAD + (min(1.0, max(0.0, load)) - UNKNOWN_LOAD) * trust(silent_s)


def holds(
    record: TaskRecord, target: SubtaskRecord, volumes: Iterable[str], gateways: Mapping[str, GatewayStatus]
) -> dict[str, float]:
    """Share of a subtask's data that each gateway holds: input files of direct predecessors, and its state volumes.

    By bytes, so that a video counts for more than the report on it.
    """
    held = bytes_by_gateway([record.of(before).result for before in target.subtask.after])
    wanted = frozenset(volumes)
    for gateway, status in gateways.items():
        for each in status.volumes:
            if each.name in wanted and each.gateway == gateway:
                held[gateway] = held.get(gateway, 0) + each.size_bytes
    total = sum(held.values())
    if not total:
        return {gateway: 1 / len(held) for gateway in held}
    return {gateway: size / total for gateway, size in held.items()}


def warmth(need: Need, containers: Iterable[ContainerInfo]) -> float:
    """Return how warm a gateway is for a need: 1 with a ready container of its image, 0.5 with a compatible one."""
    best = 0.0
    for container in containers:
        if container.state is ContainerState.READY:
            best = max(best, 1.0 if container.image == need.image else 0.5 * (need.image in container.compatible))
    return best


def waits_for_lost(name: str, robot: RobotInfo | None, lost_ns: int | None) -> str:
    """Return what waits for a robot that is offline, in words: since when, and what it holds."""
    if lost_ns is None:
        return f"waits for {name}: {'offline' if robot else 'not in the roster'}"
    since = datetime.fromtimestamp(lost_ns / 1e9, UTC)
    holds = f", while it held the {robot.holding}" if robot is not None and robot.holding else ""
    return f"waits for robot {name}, lost since {since:%H:%M:%S} UTC{holds}"


def bind(
    label: str,
    records: Sequence[SubtaskRecord],
    *,
    robots: Mapping[str, RobotInfo],
    uses: Mapping[str, Sequence[str]],
    verbs: Mapping[str, Sequence[str]],
    busy: frozenset[str],
    hindrance: Callable[[str], str] = lambda _: "",
    shuns: Callable[[SubtaskRecord, str], str] = lambda _subtask, _robot: "",
    lost_ns: Mapping[str, int] | None = None,
) -> tuple[str | None, str]:
    """Choose the robot behind `any`, `any1`, ... or confirm a named one.

    Args:
        label: the plan's robot.
        records: all subtasks of the task (a label means one robot throughout).
        robots: the roster.
        uses: subtask id -> actuators it needs.
        verbs: subtask id -> commands it needs.
        busy: robots with a run in progress, chosen last; those of other labels of this task are not chosen.
        hindrance: why tasks may not command a robot just now: a soft stop, a lease; "" when they may.
        lost_ns: when robots that are offline were lost, Unix nanoseconds, as far as that is known.
        shuns: why a robot should not be given a subtask while another can do it, by experience; "" if nothing is.

    Returns:
        The robot and "", or None and the reason for the wait.
    """
    mine = [each for each in records if each.subtask.robot == label]
    # What is not done yet counts first: another robot may have taken over from the one that did the rest.
    first = sorted(mine, key=lambda each: each.state is SubtaskState.SUCCEEDED)
    bound = next((each.bound_robot for each in first if each.bound_robot), None)
    if bound is None and not _ANY.fullmatch(label):
        bound = label
    if bound is not None:
        robot = robots.get(bound)
        if robot is None or not robot.online:
            return None, waits_for_lost(bound, robot, (lost_ns or {}).get(bound))
        for each in mine:
            if not each.state.final:
                asked = (uses.get(each.subtask.id, ()), verbs.get(each.subtask.id, ()))
                if reason := lacks(robot, *asked):
                    return None, f"waits for {bound}: {reason}"
        if reason := hindrance(bound):
            return None, f"waits for {bound}: {reason}"
        return bound, ""
    taken = {each.bound_robot for each in records if each.bound_robot}
    named = {each.subtask.robot for each in records if each.subtask.robot}
    able = [
        robot
        for robot in robots.values()
        if robot.online
        and all(set(uses.get(each.subtask.id, ())) <= set(robot.uses) for each in mine)
        and all(set(verbs.get(each.subtask.id, ())) <= set(robot.verbs) for each in mine)
    ]
    if not able:
        wanted = sorted({use for each in mine for use in uses.get(each.subtask.id, ())})
        return None, f"waits for a robot with {', '.join(wanted) or 'the needed skills'}"
    hindered = {each.id: reason for each in able if (reason := hindrance(each.id))}
    if len(hindered) == len(able):
        return None, "waits for a robot: " + "; ".join(
            f"{name} is {reason}" for name, reason in sorted(hindered.items())
        )
    able = [each for each in able if each.id not in hindered]
    shunned = {robot.id: any(shuns(each, robot.id) for each in mine if not each.state.final) for robot in able}
    # One that is busy becomes free; one that keeps failing goes on failing.
    able.sort(key=lambda robot: (robot.id in taken | named, shunned[robot.id], robot.id in busy, robot.id))
    return able[0].id, ""
