"""Coarse scheduling without I/O: which gateways can serve a task, which should a subtask be sent to, why, and when.

**Capability** (`why_not`): a gateway that cannot serve a subtask at all is never a candidate. What a gateway told of
itself decides. What it did not tell (an older version, a fact that has not come yet) speaks for it: it refuses with
the reason if it is asked in vain, and is then avoided.

**Groups** (`form`; paper, Dynamic Groups). A group is a set of gateways that can serve the task, at most `limit` of
them. Its root is the gateway that owns the task's key on the ring, so every gateway with the same view of the ring
names the same one, without asking anybody, and when it goes the next one on the ring is the root. The root is a member
whatever it can serve itself: it coordinates.

    score(member) = w_l * (1 - load) + w_d * proximity + w_w * warm

A group is formed once and then kept. It is formed again when a member can serve nothing any more, when the root has
changed, or when nobody in it can serve a subtask that somebody else can; what can be kept is kept. Now and then it is
looked at as a whole: it takes in others while it has room, and exchanges a member for another gateway that is better by
more than `HYSTERESIS`, so that gateways whose loads go up and down together do not take turns in it.

**Placement** (`place`; paper, two-level scheduling; `algorithms.md`).

    score(gateway) = w_l · (1 − load) + w_d · proximity + w_w · warm

with proximity = share of the bytes of its input files and state volumes held there, or 1 where its robot's link
is and there are none, and warm = 1 if a ready container of the image is there, 0.5 for a compatible one. Of a gateway
that has been silent for longer than it promised, load and warmth count less the longer ago they were so. A gateway
that is draining, cannot start containers and has none ready, or failed this subtask before while others remain, is
no candidate. Ties go to the gateway that asks: it is a network hop nearer.

**Queue** (`Line`): the ready subtasks that one gateway coordinates and that wait for room, in their turns. Without it
every task would push its subtasks at gateways as soon as they are ready: the one that asks most often gets most,
priorities count only where a queue happens to be, and what a full gateway refuses uses up attempts. Here a subtask is
sent only when a gateway that can serve it has room, and when several could be, `pool.turns` says whose turn it is. Room
is what a gateway may hold, containers and some who wait for one (so that none stands idle until its coordinator hears
of it), less what runs there: by its own word, or by what was sent there and has not ended, whichever is more.

**Decision trace** (`PlacementCase`): all that a placement rested on, put for the log, so that it can be made again.
Only of subtasks that were sent: one that waits is placed several times a second. Gateways that were no candidates
are left out, since they have no part in the order; so are containers that were not ready.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, cast

from msgspec import Struct
from msgspec.structs import replace

from appliance.llm.checks.schema import assign
from appliance.model import (
    ContainerInfo,
    ContainerState,
    GatewayStatus,
    Group,
    Need,
    RobotInfo,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    encode,
    keyspace,
)
from appliance.plane.node import Plane
from appliance.pool.fair_queue import Completions, Turn, Turns
from appliance.tasks import machine
from appliance.tasks.settings import TasksConfig


class Want(Struct, frozen=True, kw_only=True):
    """What a subtask asks of the gateway that serves it."""

    subtask: str
    skill: str
    need: Need
    image: str = ""
    """Full reference of the need's image; empty: not known here."""


def why_not(
    want: Want,
    status: GatewayStatus,
    *,
    ready: bool,
    skills: Collection[str] | None,
    holders: Collection[str] | None,
    within: Sequence[str],
) -> str:
    """Return why a gateway cannot serve a subtask, in words; empty when it can.

    Args:
        want: what is asked.
        status: what the gateway tells of itself.
        ready: whether a container there is ready for it, or may become so: one that runs.
        skills: skills that it knows; None: not told.
        holders: gateways that have the image, so that it can be fetched; None: nobody tells of images.
        within: gateways that the submitter allows; empty: any.
    """
    need = want.need
    if within and status.id not in within:
        return "the submitter does not allow it"
    if status.draining:
        return "is draining"
    if skills is not None and want.skill not in skills:
        return f"has no skill {want.skill}"
    if status.pool_memory_mb and need.memory_mb > status.pool_memory_mb:
        return f"{need.memory_mb} MB wanted, its containers have {status.pool_memory_mb} MB together"
    if status.cores and need.cpu > status.cores:
        return f"{need.cpu:g} cores wanted, it has {status.cores}"
    if status.pool_problem and not ready:
        return status.pool_problem
    if want.image and holders is not None and not ready and not holders:
        return f"has no image {need.image}, and no gateway has it to give"
    return ""


def lacks(robot: RobotInfo, uses: Iterable[str], verbs: Iterable[str]) -> str:
    """Return why a robot cannot do a subtask, in words; empty when it can, or does not tell what it can do."""
    without = sorted(set(uses) - set(robot.uses))
    if without and robot.uses:
        return f"{robot.id} has no {', '.join(without)}"
    unknown = sorted(set(verbs) - set(robot.verbs))
    return f"{robot.id} does not know {', '.join(unknown)}" if unknown and robot.verbs else ""


def image_holders(gateways: Mapping[str, GatewayStatus], image: str) -> frozenset[str] | None:
    """Return the gateways that have an image; None when nobody tells of any image."""
    if not any(status.images for status in gateways.values()):
        return None
    return frozenset(name for name, status in gateways.items() if image in status.images)


HYSTERESIS = 0.15
"""How much better another gateway must be to take a member's place, of at most 1. With the weight of load at 0.4 two
gateways may change by 0.18 in opposite directions before that is so."""


class Standing(Struct, frozen=True, kw_only=True):
    """What is known of a gateway with regard to one task. The figures are 0 to 1."""

    gateway: str
    load: float = 0.0
    near: float = 0.0
    """Share of the data, or the robot's link."""
    warm: float = 0.0
    """Whether containers for what is ready now are ready there."""
    serves: frozenset[str] = frozenset()
    """The unfinished subtasks that it can serve."""
    why_not: str = ""
    """Why it can serve none."""


class Weights(Struct, frozen=True, kw_only=True):
    """Weights of the score."""

    load: float = 0.4
    data: float = 0.3
    warm: float = 0.3


def score(standing: Standing, weights: Weights) -> float:
    """Return how well a gateway suits a task."""
    return (
        weights.load * (1.0 - min(1.0, max(0.0, standing.load)))
        + weights.data * standing.near
        + weights.warm * standing.warm
    )


def root_of(members: Collection[str], order: Sequence[str]) -> str:
    """Return the root: the member that comes first on the ring from the task's key on; "" when none does."""
    return next((each for each in order if each in members), "")


def must_form(group: Group | None, standings: Mapping[str, Standing], *, root: str, ready: Iterable[str]) -> str:
    """Return why a group must be formed at once, in words; empty when it may stay as it is.

    Args:
        group: the present one; None: there is none yet.
        standings: the gateways that are there.
        root: the gateway that owns the task's key.
        ready: the subtasks that could start now.
    """
    if group is None:
        return "formed"
    if group.root != root:
        return f"{root} took over from {group.root}"
    for member in group.members:
        standing = standings.get(member)
        if standing is None and member != root:
            return f"{member} is gone"
        if standing is not None and not standing.serves and member != root:
            return f"{member} {standing.why_not or 'can serve nothing any more'}"
    for subtask in ready:
        if any(subtask in standings[each].serves for each in group.members if each in standings):
            continue
        able = sorted(each.gateway for each in standings.values() if subtask in each.serves)
        if able:
            return f"nobody in it could serve {subtask}, {able[0]} can"
    return ""


def form(
    standings: Iterable[Standing],
    *,
    root: str,
    previous: Group | None,
    limit: int,
    weights: Weights,
    why: str,
) -> Group:
    """Form a group, keeping of the previous one what can be kept.

    Args:
        standings: the gateways that are there.
        root: the gateway that owns the task's key: a member in any case.
        previous: the group so far.
        limit: members at most, at least 1.
        weights: of the score.
        why: what it is formed for, in words.

    Returns:
        A group whose members but the root can all serve something, and which together can serve all that any `limit`
        gateways chosen greedily can. The previous one itself, if nothing about it changes.
    """
    known = {each.gateway: each for each in standings}
    scores = {name: score(each, weights) for name, each in known.items()}
    able = {name: each.serves for name, each in known.items() if each.serves}
    members = [root]
    if previous is not None:
        members += [each for each in previous.members if each in able and each != root]
    members = members[: max(1, limit)]
    _cover(members, able, scores, root=root, limit=limit)
    outside = sorted((each for each in able if each not in members), key=lambda each: (-scores[each], each))
    while outside and len(members) < limit:
        members.append(outside.pop(0))
    _exchange(members, outside, able, scores, root=root)
    members.sort(key=lambda each: (-scores.get(each, 0.0), each))
    if previous is not None and set(previous.members) == set(members) and previous.root == root:
        return previous
    told = ", ".join(f"{each} {scores[each]:.2f}" if each in scores else each for each in members)
    if root not in able:
        told += f"; {root} coordinates only: {known[root].why_not if root in known else 'nothing is known of it'}"
    return Group(
        members=tuple(members),
        root=root,
        number=previous.number + 1 if previous is not None else 1,
        why=f"{why}: {told}",
    )


def _cover(
    members: list[str], able: Mapping[str, frozenset[str]], scores: Mapping[str, float], *, root: str, limit: int
) -> None:
    """Add those who can serve what no member can; one that others can do without makes room for them."""
    every = frozenset[str]().union(*able.values())
    while True:
        covered = _served(members, able)
        missing = every - covered
        others = [each for each in able if each not in members]
        best = max(others, key=lambda each: (len(able[each] & missing), scores[each], each), default="")
        if not best or not able[best] & missing:
            return
        if len(members) >= limit:
            spare = [
                each for each in members if each != root and _served([m for m in members if m != each], able) == covered
            ]
            if not spare:
                return
            members.remove(min(spare, key=lambda each: (scores[each], each)))
        members.append(best)


def _exchange(
    members: list[str],
    outside: list[str],
    able: Mapping[str, frozenset[str]],
    scores: Mapping[str, float],
    *,
    root: str,
) -> None:
    """Exchange members for clearly better ones, as long as nothing is lost that the group can serve."""
    for best in outside:
        covered = _served(members, able)
        spare = [
            each
            for each in members
            if each != root
            and scores[best] > scores[each] + HYSTERESIS
            and _served([*(m for m in members if m != each), best], able) >= covered
        ]
        if not spare:
            return
        members.remove(min(spare, key=lambda each: (scores[each], each)))
        members.append(best)


def _served(members: Iterable[str], able: Mapping[str, frozenset[str]]) -> frozenset[str]:
    return frozenset[str]().union(*(able[each] for each in members if each in able))


def without(group: Group, gateway: str, order: Sequence[str]) -> Group:
    """Return the group as it is once a member is gone, with the root that follows; the same if it was none."""
    members = tuple(each for each in group.members if each != gateway)
    if len(members) == len(group.members) or not members:
        return group
    root = group.root if group.root in members else root_of(members, order) or members[0]
    return replace(group, members=members, root=root, number=group.number + 1, why=f"{gateway} is gone")


Choose = Callable[
    [Sequence[RobotInfo], Sequence[Subtask], Mapping[str, tuple[bool, bool]], Mapping[str, str]], tuple[list[str], str]
]
"""Robots that can do it, what is to be done, whether each has something else to do in the task and keeps failing at it,
and why others may not be commanded -> the robots, best first, and why; or none and the reason for the wait."""
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


def bytes_by_gateway(value: object) -> dict[str, int]:
    """Bytes of the files that references anywhere in results name, by the gateway where each was made.

    The same file is counted once. What is not a good reference is left out: results are handlers' doing.
    """
    found: dict[str, int] = {}
    seen: set[str] = set()
    level: list[object] = [value]
    while level:
        each = level.pop()
        if isinstance(each, dict):
            table = cast("dict[str, object]", each)
            digest, gateway, size = table.get("artifact"), table.get("gateway"), table.get("bytes", 0)
            if not isinstance(digest, str):
                level.extend(table.values())
            elif isinstance(gateway, str) and isinstance(size, int) and size >= 0 and digest not in seen:
                seen.add(digest)
                found[gateway] = found.get(gateway, 0) + size
        elif isinstance(each, list | tuple):
            level.extend(cast("list[object]", each))
    return found


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


def bind(labels: Sequence[str], choose: Callable[[str], tuple[Sequence[str], str]]) -> tuple[tuple[str, ...], str]:
    """Choose the robots of a subtask, all different: all of them or none.

    Args:
        labels: the plan's robots, one unless its skill is joint.
        choose: the robots that one may be, best first, or none and the reason for the wait: `candidates`.

    Returns:
        The robots in the order of the labels, and why where there is one; or none and the reason for the wait.
    """
    fits: dict[str, Sequence[str]] = {}
    reason = ""
    for label in labels:
        fits[label], reason = choose(label)
        if not fits[label]:
            return (), reason
    taken: dict[str, str] = {}
    for label in labels:
        if not assign(label, fits, taken):
            able = sorted({robot for robots in fits.values() for robot in robots})
            return (), f"waits for {len(labels)} different robots: there is {', '.join(able)}"
    robots = {label: robot for robot, label in taken.items()}
    return tuple(robots[label] for label in labels), reason if len(labels) == 1 else ""


def candidates(
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
    choose: Choose | None = None,
) -> tuple[list[str], str]:
    """Return the robots that `any`, `any1`, ... may be, best first; for a named or bound one that one alone.

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
        choose: takes one of several by what they would cost; None: one that is free, by name.

    Returns:
        The robots and, where they were chosen by their cost, why; or none and the reason for the wait.
    """
    mine = [each for each in records if label in each.subtask.robots]
    # What is not done yet counts first: another robot may have taken over from the one that did the rest.
    first = sorted(mine, key=lambda each: each.state is SubtaskState.SUCCEEDED)
    bound = next((each.bound[label] for each in first if label in each.bound), None)
    if bound is None and not _ANY.fullmatch(label):
        bound = label
    if bound is not None:
        robot = robots.get(bound)
        if robot is None or not robot.online:
            return [], waits_for_lost(bound, robot, (lost_ns or {}).get(bound))
        for each in mine:
            if not each.state.final:
                asked = (uses.get(each.subtask.id, ()), verbs.get(each.subtask.id, ()))
                if reason := lacks(robot, *asked):
                    return [], f"waits for {bound}: {reason}"
        if reason := hindrance(bound):
            return [], f"waits for {bound}: {reason}"
        return [bound], ""
    taken = {robot for each in records for robot in each.bound.values()}
    named = {robot for each in records for robot in each.subtask.robots}
    able = [
        robot
        for robot in robots.values()
        if robot.online
        and all(set(uses.get(each.subtask.id, ())) <= set(robot.uses) for each in mine)
        and all(set(verbs.get(each.subtask.id, ())) <= set(robot.verbs) for each in mine)
    ]
    if not able:
        wanted = sorted({use for each in mine for use in uses.get(each.subtask.id, ())})
        return [], f"waits for a robot with {', '.join(wanted) or 'the needed skills'}"
    hindered = {each.id: reason for each in able if (reason := hindrance(each.id))}
    if len(hindered) == len(able):
        return [], "waits for a robot: " + "; ".join(f"{name} is {reason}" for name, reason in sorted(hindered.items()))
    able = [each for each in able if each.id not in hindered]
    shunned = {robot.id: any(shuns(each, robot.id) for each in mine if not each.state.final) for robot in able}
    # One that is busy becomes free; one that keeps failing goes on failing.
    if choose is None:
        able.sort(key=lambda robot: (robot.id in taken | named, shunned[robot.id], robot.id in busy, robot.id))
        return [each.id for each in able], ""
    open_ones = [each.subtask for each in mine if not each.state.final]
    return choose(able, open_ones, {each.id: (each.id in taken | named, shunned[each.id]) for each in able}, hindered)


Key = tuple[str, str]
"""Task and subtask."""


class Place(Struct, frozen=True, kw_only=True):
    """Where a subtask may go now, or its place among those that wait."""

    gateway: str = ""
    """Empty: it waits."""
    position: int = 0
    """From 1; 0: it does not wait."""
    waiting: int = 0
    expected_s: float | None = None
    """In how many seconds it may go; None: nothing was measured yet."""


class _Waiting(Struct):
    turn: Turn
    candidates: tuple[str, ...]


class Line:
    """Whose turn it is.

    Args:
        gateways: what gateways tell of themselves, those that are there.
        backlog: runs that may be at a gateway beyond its containers, as a part of these.
        wake: told the task whose subtask may go now.
    """

    def __init__(
        self, gateways: Callable[[], Mapping[str, GatewayStatus]], *, backlog: float, wake: Callable[[str], None]
    ) -> None:
        self._gateways = gateways
        self._backlog = backlog
        self._wake = wake
        self._turns = Turns()
        self._numbers = 0
        self._waiting: dict[Key, _Waiting] = {}
        self._granted: dict[Key, str] = {}
        """Places given to subtasks that have not been sent there yet."""
        self._active: dict[str, dict[str, str]] = {}
        """Task -> subtask -> the gateway where it is."""
        self._at: Counter[str] = Counter()
        """Gateway -> subtasks of this coordinator there."""
        self.completions = Completions()

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def ask(
        self, record: TaskRecord, target: SubtaskRecord, candidates: Sequence[str], now: float, *, left_s: float
    ) -> Place:
        """Return where a ready subtask may go, or its place in the line.

        Args:
            record: its task.
            target: the subtask.
            candidates: the gateways that can serve it, the best first.
            now: by the monotonic clock.
            left_s: seconds until its task's deadline; infinite without one.
        """
        key = (record.id, target.subtask.id)
        granted = self._granted.pop(key, None)
        if granted is not None:
            self._at[granted] -= 1
            if granted in candidates:
                return self._go(key, granted)
        waiting = self._waiting.get(key)
        if waiting is None:
            if not self._waiting and (free := next((each for each in candidates if self._room(each) > 0), "")):
                return self._go(key, free)
            self._numbers += 1
            waiting = _Waiting(
                Turn(
                    id="/".join(key),
                    number=self._numbers,
                    submitter=record.submitter,
                    priority=record.priority,
                    due_at=now + left_s,
                    since=now,
                ),
                (),
            )
            self._waiting[key] = waiting
        waiting.candidates = tuple(candidates)
        self.serve(now, but=key)
        if (granted := self._granted.pop(key, None)) is not None:
            self._at[granted] -= 1
            return self._go(key, granted)
        return self.place_of(key, now)

    def _go(self, key: Key, gateway: str) -> Place:
        """It is sent now: counted at once, and put right when its task's record says where it is."""
        self._active.setdefault(key[0], {})[key[1]] = gateway
        self._at[gateway] += 1
        return Place(gateway=gateway)

    def place_of(self, key: Key, now: float) -> Place:
        """Return the place of a subtask in the line."""
        if key not in self._waiting:
            return Place()
        name = "/".join(key)
        order = [each.id for each in self._turns.order((each.turn for each in self._waiting.values()), now)]
        position = order.index(name) + 1
        return Place(position=position, waiting=len(order), expected_s=self.expected_s(position))

    def expected_s(self, position: int) -> float | None:
        """In how many seconds one at this place may go; None: nothing was measured yet."""
        at_once = sum(status.capacity for status in self._gateways().values() if not status.draining)
        return self.completions.expected_s(position, at_once)

    def _room(self, gateway: str) -> float:
        status = self._gateways().get(gateway)
        if status is None:
            return 0.0
        if not status.capacity:
            return math.inf  # it does not tell; its own queue is bounded
        return status.capacity * (1 + self._backlog) - max(status.running, self._at[gateway])

    def serve(self, now: float, *, but: Key | None = None) -> None:
        """Give the room that there is to those who wait, in their turns; all but one are woken."""
        if not self._waiting:
            return
        by_id = {each.turn.id: key for key, each in self._waiting.items()}
        wanted = {each for waiting in self._waiting.values() for each in waiting.candidates}
        room = {each: left for each in wanted if (left := self._room(each)) > 0}
        if not room:
            return
        for turn in self._turns.order((each.turn for each in self._waiting.values()), now):
            key = by_id[turn.id]
            gateway = next((each for each in self._waiting[key].candidates if room.get(each, 0) > 0), "")
            if not gateway:
                continue
            del self._waiting[key]
            self._turns.served(turn)
            self._granted[key] = gateway
            self._at[gateway] += 1
            room[gateway] -= 1
            if key != but:
                self._wake(key[0])
            if not any(left > 0 for left in room.values()):
                return

    def moved(self, record: TaskRecord, now: float) -> None:
        """Note where the subtasks of a task are now."""
        active = {each.subtask.id: each.gateway for each in machine.active(record)}
        before = self._active.get(record.id, {})
        if active == before:
            return
        self._at.subtract(before.values())
        self._at.update(active.values())
        self._active[record.id] = active
        if before.keys() - active.keys():
            self.serve(now)

    def forget(self, task: str, now: float) -> None:
        """Note that a task is not driven here any more."""
        self._at.subtract(self._active.pop(task, {}).values())
        for key in [each for each in self._granted if each[0] == task]:
            self._at[self._granted.pop(key)] -= 1
        for key in [each for each in self._waiting if each[0] == task]:
            del self._waiting[key]
        self._at = Counter({gateway: count for gateway, count in self._at.items() if count > 0})
        self.serve(now)

    def left(self, task: str, subtask: str) -> None:
        """Note that a subtask does not wait for room any more: it waits for something else, or has ended."""
        self._waiting.pop((task, subtask), None)
        if (granted := self._granted.pop((task, subtask), None)) is not None:
            self._at[granted] -= 1


MOST_GATEWAYS = 64
"""Candidates that are kept of one placement; a group has eight."""


class Seen(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A candidate as its coordinator knew it."""

    id: str
    load: float = 0.0
    overloaded: bool = False
    problem: str = ""
    ready: tuple[tuple[str, ...], ...] = ()
    """Its ready containers: the image of each, and those it is compatible with."""


class PlacementCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One placement, put as `gw/{gateway}/decided/placement` when the subtask is sent."""

    task: str
    subtask: str
    attempt: int
    need: Need
    here: str
    gateways: tuple[Seen, ...]
    holds: dict[str, float] = {}
    robot_at: str | None = None
    """Gateway of the robot's link; None: it commands no robot."""
    avoid: tuple[str, ...] = ()
    stale_s: dict[str, float] = {}
    load_weight: float
    data_weight: float
    warm_weight: float
    order: tuple[str, ...]
    scores: dict[str, float]


class Asked(Struct, frozen=True, kw_only=True):
    """What a placement was made from, by reference: looked at only if the subtask is sent, before anything moves."""

    need: Need
    here: str
    gateways: Mapping[str, GatewayStatus]
    containers: Mapping[str, Mapping[str, ContainerInfo]]
    holds: Mapping[str, float]
    robot: RobotInfo | None
    avoid: frozenset[str]
    stale_s: Mapping[str, float]
    config: TasksConfig


def placement_case(
    placement: Placement, asked: Asked, record: TaskRecord, target: SubtaskRecord
) -> PlacementCase | None:
    """Return a placement with all that it rested on; None when there are too many candidates to tell."""
    if len(placement.order) > MOST_GATEWAYS:
        return None
    return PlacementCase(
        task=record.id,
        subtask=target.subtask.id,
        attempt=target.next_attempt,
        need=asked.need,
        here=asked.here,
        gateways=tuple(
            Seen(
                id=name,
                load=asked.gateways[name].load,
                overloaded=bool(asked.gateways[name].overloaded),
                problem=asked.gateways[name].pool_problem,
                ready=_ready(asked.containers.get(name, {}).values()),
            )
            for name in sorted(placement.order)
        ),
        holds=dict(asked.holds),
        robot_at=None if asked.robot is None else asked.robot.gateway,
        avoid=tuple(sorted(asked.avoid)),
        stale_s={name: late_s for name, late_s in asked.stale_s.items() if name in placement.scores},
        load_weight=asked.config.load_weight,
        data_weight=asked.config.data_weight,
        warm_weight=asked.config.warm_weight,
        order=placement.order,
        scores=placement.scores,
    )


def _ready(containers: Iterable[ContainerInfo]) -> tuple[tuple[str, ...], ...]:
    kinds = {(each.image, *each.compatible) for each in containers if each.state is ContainerState.READY}
    return tuple(sorted(kinds))


def tell(plane: Plane, case: PlacementCase | None) -> None:
    """Put a placement, for the log."""
    if case is not None:
        plane.session.put(plane.keys(keyspace.DECIDED, plane.gateway, "placement"), encode(case))


def place_again(case: PlacementCase) -> dict[str, Any]:
    """Return what the placement is now, by the names of the case's fields."""
    containers = {
        each.id: {
            str(number): ContainerInfo(
                id=str(number), gateway=each.id, image=kind[0], compatible=kind[1:], state=ContainerState.READY
            )
            for number, kind in enumerate(each.ready)
        }
        for each in case.gateways
    }
    placement = place(
        case.need,
        here=case.here,
        gateways={
            each.id: GatewayStatus(
                id=each.id,
                fleet="",
                load=each.load,
                overloaded="is overloaded" if each.overloaded else "",
                pool_problem=each.problem,
            )
            for each in case.gateways
        },
        containers=containers,
        holds=case.holds,
        robot=None if case.robot_at is None else RobotInfo(id="robot", kind="", gateway=case.robot_at),
        avoid=frozenset(case.avoid),
        config=TasksConfig(load_weight=case.load_weight, data_weight=case.data_weight, warm_weight=case.warm_weight),
        stale_s=case.stale_s,
    )
    return {"order": placement.order, "scores": placement.scores}
