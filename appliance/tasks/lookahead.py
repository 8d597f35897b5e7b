"""Looks ahead for the tasks of one gateway: what comes, where it would go by now, and which pools to tell.

It ties the plain functions together (`placement`, `hints`) with what is measured (`durations`).
"""

from collections.abc import Awaitable, Callable, Mapping

from appliance.errors import NotFoundError
from appliance.model import PoolHint, Subtask, SubtaskRecord, TaskRecord
from appliance.plane.node import Plane
from appliance.pool.api import Hinted
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.durations import Durations
from appliance.tasks.hints import TELL_S, Hinting, expected_starts, hints
from appliance.tasks.surroundings import need_of

MOST_AHEAD = 16
"""Subtasks of one task that pools are told of, those expected first."""


class LookAhead:
    """What the plans driven here will need, told to the pools that would serve it.

    Args:
        plane: the fleet.
        manifest: a skill's manifest; NotFoundError when it is not known.
        likely_place: the gateway that a subtask would be sent to now, or "".
        tell_here: tells this gateway's own pool.
        experience_s: skill, robot -> how long it takes there by what all gateways tell; None when that is not known.
    """

    def __init__(
        self,
        plane: Plane,
        *,
        manifest: Callable[[str], SkillManifest],
        likely_place: Callable[[TaskRecord, SubtaskRecord], str],
        tell_here: Callable[[PoolHint], Awaitable[Hinted]],
        experience_s: Callable[[str, str], float | None] = lambda _skill, _robot: None,
    ) -> None:
        self.durations = Durations(plane.store)
        self._plane = plane
        self._manifest = manifest
        self._likely_place = likely_place
        self._tell_here = tell_here
        self._experience_s = experience_s
        self._hinting = Hinting(self._tell)

    def plan_moved(self, record: TaskRecord, running_s: Mapping[str, float]) -> None:
        """Tell pools what the subtasks that are not ready will need; `running_s`: how long each active one has."""
        manifests: dict[str, SkillManifest] = {}
        for each in record.subtasks:
            try:
                manifests[each.subtask.id] = self._manifest(each.subtask.skill)
            except NotFoundError:
                continue  # planned on a gateway that knows more skills
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
        if gateway == self._plane.gateway:
            return await self._tell_here(hint)
        return await self._plane.rpc.call(gateway, "pool_hint", hint, Hinted, timeout_s=TELL_S)

    async def close(self) -> None:
        """Tell nothing more; keep what was measured."""
        self._hinting.close()
        await self.durations.close()
