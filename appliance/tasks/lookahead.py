"""Looks ahead for the tasks of one gateway: what their plans will need, where it would go by now, which pools to tell.

A plan knows what comes: while the first subtasks run, the pools of the gateways that would be chosen for the others
can have containers ready. `hints` works out what a task's subtasks that are not ready yet will ask of which pool, and
about when, as a plain function; `Hinting` tells the gateways, best effort: nothing waits for it, what is lost costs a
cold start, and what has changed replaces what was told before. A hint belongs to its task: the same task and image at
the same gateway is one hint, and a count of 0 takes it back. `LookAhead` ties these to `placement` and to what is
measured (`durations`).
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping

import structlog
from msgspec import Struct

from appliance.background import Background
from appliance.errors import SwiftbotError
from appliance.model import Need, PoolHint, Subtask, SubtaskRecord, SubtaskState, TaskRecord, TaskState, keyspace
from appliance.model.pool_api import Hinted
from appliance.plane.node import Plane
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.durations import Durations
from appliance.tasks.orders import need_of

log = structlog.get_logger(__name__)

HORIZON_S = 300.0
"""What is needed later is announced later: expectations so far ahead are mostly wrong."""
KEEP_S = 30.0
"""How long beyond its time a container is worth keeping at least: subtasks ahead of it take longer than expected."""
MOST_KEEP_S = 600.0
SAME_S = 1.0
"""A change of the expected time by less is none, nor one by less than a fifth of what is left."""
AGAIN_S = 15.0
"""A hint is sent again after so long: the one before may have been met by a run of somebody else."""
MOST_AT_ONCE = 32
"""Hints on their way; more are left for the next change of their plans."""
TELL_S = 1.0


def expected_starts(
    record: TaskRecord, seconds: Mapping[str, float], running_s: Mapping[str, float]
) -> dict[str, float]:
    """Return in how many seconds each waiting subtask is expected to start, of those that may still start.

    Args:
        record: the task.
        seconds: subtask -> how long it is expected to take.
        running_s: subtask -> for how long it has been running or on its way.
    """
    by_id = {each.subtask.id: each for each in record.subtasks}
    ends: dict[str, float] = {}
    starts: dict[str, float] = {}
    left = list(record.subtasks)
    while left:
        later: list[SubtaskRecord] = []
        for each in left:
            name = each.subtask.id
            before = [parent for parent in each.subtask.after if parent in by_id]
            if each.state is SubtaskState.WAITING and not all(parent in ends for parent in before):
                later.append(each)
                continue
            if each.state.final:
                ends[name] = 0.0
            elif each.state is SubtaskState.WAITING:
                starts[name] = max((ends[parent] for parent in before), default=0.0)
                ends[name] = starts[name] + seconds.get(name, 0.0)
            else:
                ends[name] = max(0.0, seconds.get(name, 0.0) - running_s.get(name, 0.0))
        if len(later) == len(left):
            break  # a circle, which no valid plan has
        left = later
    return starts


def hints(
    record: TaskRecord,
    *,
    starts: Mapping[str, float],
    places: Mapping[str, str],
    needs: Mapping[str, Need],
    seconds: Mapping[str, float],
) -> dict[tuple[str, str], PoolHint]:
    """Return what to tell each gateway's pool, by gateway and image.

    Args:
        record: the task; one that is not running needs nothing any more.
        starts: subtask -> in how many seconds it is expected to start (`expected_starts`).
        places: subtask -> the gateway that would be chosen for it now; others are left out.
        needs: subtask -> what it asks of a container; others are left out.
        seconds: subtask -> how long it is expected to take.

    Returns:
        One hint each, its count the most of these subtasks that are expected to run at the same time.
    """
    if record.state is not TaskState.RUNNING:
        return {}
    grouped: dict[tuple[str, str], list[str]] = {}
    for name, start in starts.items():
        if start <= HORIZON_S and places.get(name) and name in needs:
            grouped.setdefault((places[name], needs[name].image), []).append(name)
    found: dict[tuple[str, str], PoolHint] = {}
    for key, names in grouped.items():
        spans = [(starts[name], starts[name] + seconds.get(name, 0.0)) for name in names]
        first = min(start for start, _ in spans)
        last = max(end for _, end in spans)
        found[key] = PoolHint(
            image=key[1],
            count=max(sum(start <= at < end or start == at for start, end in spans) for at, _ in spans),
            in_s=round(first, 2),
            # The further ahead, the less is known of when.
            keep_s=round(min(MOST_KEEP_S, KEEP_S + last - first + 0.5 * first), 2),
            task=record.id,
            need=max((needs[name] for name in names), key=lambda need: (need.memory_mb, need.cpu)),
        )
    return found


class _Told(Struct, frozen=True):
    count: int
    at: float
    """When it is needed, on our clock."""
    told_at: float
    until: float


class Hinting:
    """Tells gateways what plans will need of their pools.

    Args:
        tell: tells one gateway one hint.
        clock: seconds.
    """

    def __init__(
        self, tell: Callable[[str, PoolHint], Awaitable[Hinted]], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._tell = tell
        self._clock = clock
        self._told: dict[str, dict[tuple[str, str], _Told]] = {}
        self._sending = Background()

    def update(self, task: str, wanted: Mapping[tuple[str, str], PoolHint]) -> None:
        """Tell what has changed since the last time; nothing is waited for. An empty mapping takes all back."""
        now = self._clock()
        told = self._told.setdefault(task, {})
        for key in [key for key in told if key not in wanted]:
            if told.pop(key).until > now:
                self._send(key[0], PoolHint(image=key[1], count=0, task=task))
        for key, hint in wanted.items():
            before = told.get(key)
            if before is not None and _same(before, hint, now):
                continue
            if self._send(key[0], hint):
                told[key] = _Told(hint.count, now + hint.in_s, now, now + hint.in_s + hint.keep_s)
        if not told:
            del self._told[task]

    def _send(self, gateway: str, hint: PoolHint) -> bool:
        if self._sending.count >= MOST_AT_ONCE:
            return False
        self._sending.start(self._carry(gateway, hint), f"hint to {gateway}")
        return True

    async def _carry(self, gateway: str, hint: PoolHint) -> None:
        try:
            async with asyncio.timeout(TELL_S):
                answer = await self._tell(gateway, hint)
        except (SwiftbotError, TimeoutError) as error:
            log.debug("a hint was not heard", gateway=gateway, image=hint.image, reason=str(error))
        else:
            if not answer.taken:
                log.debug("a hint is not followed", gateway=gateway, image=hint.image, reason=answer.why)

    def close(self) -> None:
        """Tell nothing more."""
        self._sending.cancel()


def _same(before: _Told, hint: PoolHint, now: float) -> bool:
    moved = abs(before.at - (now + hint.in_s))
    return (
        before.count == hint.count
        and moved <= max(SAME_S, 0.2 * hint.in_s)
        and now - before.told_at < AGAIN_S
    )  # fmt: skip


MOST_AHEAD = 16
"""Subtasks of one task that pools get hints of, those expected first."""


class LookAhead:
    """What the plans driven here will need, told to the pools that would serve it.

    Args:
        plane: the fleet.
        manifests: by skill, of those known here.
        likely_place: the gateway that a subtask would be sent to now, or "".
        experience_s: skill, robot -> how long it takes there by what all gateways tell; None when that is not known.
    """

    def __init__(
        self,
        plane: Plane,
        manifests: Mapping[str, SkillManifest],
        *,
        likely_place: Callable[[TaskRecord, SubtaskRecord], str],
        experience_s: Callable[[str, str], float | None] = lambda _skill, _robot: None,
    ) -> None:
        self.durations = Durations(plane.store)
        self._plane = plane
        self._manifests = manifests
        self._likely_place = likely_place
        self._experience_s = experience_s
        self._hinting = Hinting(self._tell)

    def plan_moved(self, record: TaskRecord, running_s: Mapping[str, float]) -> None:
        """Tell pools what the subtasks that are not ready will need; `running_s`: how long each active one has."""
        manifests = {
            target.subtask.id: self._manifests[target.subtask.skill]
            for target in record.subtasks
            if target.subtask.skill in self._manifests  # else planned on a gateway that knows more skills
        }
        seconds = {
            each.subtask.id: self.expected_s(each.subtask, each.bound_robot or "")
            for each in record.subtasks
            if each.subtask.id in manifests
        }
        starts = expected_starts(record, seconds, running_s)
        soonest = sorted((each for each in starts if each in manifests), key=lambda each: starts[each])[:MOST_AHEAD]
        wanted = hints(
            record,
            starts=starts,
            places={name: self._likely_place(record, record.of(name)) for name in soonest},
            needs={name: need_of(manifests[name]) for name in soonest},
            seconds=seconds,
        )
        self._hinting.update(record.id, wanted)

    def expected_s(self, subtask: Subtask, robot: str = "") -> float:
        """Return how long a subtask is expected to take on a robot; never less than the duration asked for.

        What the whole fleet has told of it counts first, on that robot if it is known; then what was coordinated here.
        """
        experience_s = self._experience_s(subtask.skill, robot or subtask.robot or "")
        if experience_s is None:
            return self.durations.of(subtask.skill, subtask.params)
        asked = subtask.params.get("duration_s", 0.0)
        return max(experience_s, asked) if isinstance(asked, int | float) and 0 < asked < 86_400 else experience_s

    async def _tell(self, gateway: str, hint: PoolHint) -> Hinted:
        return await self._plane.rpc.call(gateway, keyspace.POOL_HINT, hint, timeout_s=TELL_S)

    async def close(self) -> None:
        """Tell nothing more; keep what was measured."""
        self._hinting.close()
        await self.durations.close()
