"""How long runs take: expected durations by skill, and which runs are stuck or straggling.

**Expected durations.** Per skill the median of the last runs that this gateway coordinated. The manifest's time limit
says how long a run may take, which is far more than it does: too long to plan with. What was measured is kept in the
gateway's store and survives a restart. All times are seconds.

**Stuck**: no sign of life (progress, log line, partial result, checkpoint, or the heartbeat that stands for waiting on
the appliance) for longer than its skill promises (`silent_s` of its manifest), or, where it promises nothing, for much
longer than runs of it took altogether. Without either nothing is known, and the run's deadline is the only bound.

**Straggling**: running much longer than runs of the skill do, by this gateway's own experience or by its siblings
of the same skill in the same task; the thresholds are those of speculation in MapReduce and Spark (a quantile of the
finished ones, times a factor, never below a minimum). Detection is pure, with the clock passed in.
"""

import asyncio
import math
from collections import deque
from collections.abc import Mapping, Sequence
from enum import StrEnum
from statistics import median
from typing import Any, Protocol

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import SwiftbotError
from appliance.model import encode
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.settings import DetectionConfig

log = structlog.get_logger(__name__)

DEFAULT_S = 3.0
"""Expected of a skill that has not been seen here."""
WINDOW = 15
"""Runs remembered of each skill: an odd number, few enough to follow a change within a shift."""
MOST_SKILLS = 512
PREFIX = "duration/"
WRITE_S = 5.0
"""What was measured is written together, at most so often."""


class Store(Protocol):
    """Where it is kept: the gateway's store."""

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:
        """Write a value."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Read all values whose keys begin so."""
        ...


class Durations:
    """Expected durations of skills, seconds."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._seen: dict[str, deque[float]] = {}
        self._changed: set[str] = set()
        self._writer: asyncio.Task[None] | None = None

    async def load(self) -> None:
        """Read what was measured before; what cannot be read is measured again."""
        for key, value in await self._store.scan(PREFIX):
            try:
                seen = msgspec.json.decode(value, type=list[float])
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                log.warning("measured durations cannot be read", key=key, reason=str(error))
                continue
            self._seen[key.removeprefix(PREFIX)] = deque(seen, maxlen=WINDOW)

    def of(self, skill: str, params: Mapping[str, Any]) -> float:
        """Return how long a subtask of a skill is expected to take; never less than the duration asked for."""
        seen = self._seen.get(skill)
        expected = median(seen) if seen else DEFAULT_S
        asked = params.get("duration_s", 0.0)
        return max(expected, asked) if isinstance(asked, int | float) and 0 < asked < 86_400 else expected

    def seen(self, skill: str) -> tuple[float, ...]:
        """Return how long the last runs of a skill took, oldest first."""
        return tuple(self._seen.get(skill, ()))

    def add(self, skill: str, took_s: float) -> None:
        """Note a run that succeeded."""
        if not 0 <= took_s < 86_400 or (skill not in self._seen and len(self._seen) >= MOST_SKILLS):
            return
        self._seen.setdefault(skill, deque(maxlen=WINDOW)).append(round(took_s, 3))
        self._changed.add(skill)
        if self._writer is None or self._writer.done():
            self._writer = asyncio.create_task(self._write_soon(), name="durations")

    async def _write_soon(self) -> None:
        await asyncio.sleep(WRITE_S)
        await self.write()

    async def write(self) -> None:
        """Write what has changed."""
        changed, self._changed = self._changed, set()
        for skill in changed:
            try:
                await self._store.put(PREFIX + skill, encode(list(self._seen[skill])), durable=False)
            except SwiftbotError as error:
                log.info("measured durations are not kept", skill=skill, reason=str(error))

    async def close(self) -> None:
        """Write what has not been written yet."""
        if self._writer is not None:
            self._writer.cancel()
        await self.write()


class Condition(StrEnum):
    """What is wrong with a run."""

    STUCK = "stuck"
    STRAGGLING = "straggling"


class Finding(Struct, frozen=True, kw_only=True):
    """What is wrong with a run, in words for people, and the bound it has passed, in seconds."""

    condition: Condition
    bound_s: float
    note: str


class Known(Struct, frozen=True, kw_only=True):
    """Durations that are known of runs like this one, seconds."""

    learned: Sequence[float] = ()
    siblings: Sequence[float] = ()


def quantile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that at least a share of the values do not exceed; 0 when there are none."""
    if not values:
        return 0.0
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, max(0, math.ceil(share * len(ordered)) - 1))]


def usual_s(known: Known, config: DetectionConfig) -> float | None:
    """Return how long runs like this one take, seconds; None when too little is known."""
    found: list[float] = []
    if len(known.learned) >= config.samples:
        found.append(quantile(known.learned, config.quantile))
    if len(known.siblings) >= config.siblings:
        found.append(max(known.siblings))
    # Siblings do the same on the same day, experience is longer: the more patient of the two is believed.
    return max(found) if found else None


def stuck_after_s(manifest: SkillManifest, known: Known, asked_s: float, config: DetectionConfig) -> float | None:
    """Return how long a run may be silent, seconds; None when nothing is known but its deadline."""
    if manifest.silent_s > 0:
        return manifest.silent_s
    usual = usual_s(known, config)
    return None if usual is None else max(config.stuck_minimum_s, config.stuck_factor * max(usual, asked_s))


def straggles_after_s(known: Known, asked_s: float, config: DetectionConfig) -> float | None:
    """Return how long a run may take before it straggles, seconds; None when too little is known."""
    usual = usual_s(known, config)
    return None if usual is None else max(config.straggler_minimum_s, config.straggler_factor * max(usual, asked_s))


def judge(
    manifest: SkillManifest,
    *,
    running_s: float,
    silent_s: float,
    known: Known,
    asked_s: float,
    config: DetectionConfig,
) -> Finding | None:
    """Return what is wrong with a run that has started; stuck counts before straggling.

    Args:
        manifest: of its skill.
        running_s: since the first line of its handler.
        silent_s: since its last sign of life.
        known: durations of runs like it.
        asked_s: how long it was asked to take (`duration_s`), 0 when it was not.
        config: the thresholds.
    """
    bound = stuck_after_s(manifest, known, asked_s, config)
    if bound is not None and silent_s > bound:
        said = "its skill promises" if manifest.silent_s > 0 else f"{manifest.id} leads one to expect"
        note = f"stuck: no sign of life for {silent_s:.1f} s, {bound:.1f} s is what {said}"
        return Finding(condition=Condition.STUCK, bound_s=bound, note=note)
    bound = straggles_after_s(known, asked_s, config)
    if bound is not None and running_s > bound:
        usual = usual_s(known, config) or 0.0
        note = f"straggling: runs for {running_s:.1f} s, others took {usual:.1f} s"
        return Finding(condition=Condition.STRAGGLING, bound_s=bound, note=note)
    return None


def asked_s(params: dict[str, Any]) -> float:
    """Return how long a run was asked to take, seconds; 0 when it was not."""
    value = params.get("duration_s", 0.0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 86_400:
        return 0.0
    return float(value)
