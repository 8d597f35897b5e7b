"""Decisions of the pool, recorded: a bounded list that people can ask for, and traces that can be decided again.

`Decisions` keeps what was started and given up lately and why, and counts it since the start.

A selection and an eviction are plain functions of facts (`selection`, `policies`). The facts are gone a moment later;
so a trace for the log (`SelectionCase`, `EvictionCase`) has them with the decision, as far as it depends on them:
containers that are no candidates are left out, and links that were not measured.
`select_again` and `evict_again` replay a trace with the same code.
"""

import time
from collections import Counter, deque
from collections.abc import Iterable
from typing import Any

import msgspec
import structlog
from msgspec import Struct

from appliance.model import ContainerInfo, Need, Phase, Way
from appliance.model.pool_api import DecisionList, PoolDecision
from appliance.pool.policies import Idle
from appliance.pool.policies.planner import Weighed, victims
from appliance.pool.selection import UNMEASURED, Candidate, Decision, Facts, score, select
from appliance.pool.settings import PoolConfig, Weights

log = structlog.get_logger(__name__)

KEPT = 500
"""Decisions kept: some hours of a quiet gateway, a minute of the busiest."""


class Decisions:
    """Notes, logs and tells the starts and ends of containers."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._kept: deque[PoolDecision] = deque(maxlen=KEPT)

    def note(self, what: str, *, image: str, container: str, why: str) -> None:
        """Note a decision: `what` is start, adopt, retire or fail."""
        self.counts[what] += 1
        self._kept.append(
            PoolDecision(at_ns=time.time_ns(), what=what, image=image, container=container, why=why[:600])
        )
        log.info(f"container {what}", container=container, image=image, reason=why)

    def recent(self, limit: int) -> DecisionList:
        """Return the newest decisions first."""
        newest = tuple(reversed(self._kept))[: max(0, limit)]
        return DecisionList(decisions=newest, counts=dict(self.counts))


MOST_IDLE = 256
"""Idle containers recorded of one eviction: a gateway holds fewer."""


class SelectionCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One selection, put as `gw/{gateway}/decided/selection`."""

    gateway: str
    need: Need
    local: tuple[ContainerInfo, ...] = ()
    """The containers here that could run it."""
    remote: tuple[Candidate, ...] = ()
    """What others offered."""
    cold_ms: float
    mode: str
    gamma: float
    theta_match: float
    weights: Weights
    facts: Facts = Facts()
    phase: Phase
    way: Way
    chosen: str
    """The gateway."""
    container: str = ""
    score: float = 0.0
    cost_ms: float = 0.0


class EvictionCase(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Whom the pool gave up for a run, put as `gw/{gateway}/decided/eviction`. Worths are inputs: policies learn."""

    gateway: str
    idle: tuple[Idle, ...]
    worths: tuple[float, ...]
    slots: int
    memory_mb: int
    chosen: tuple[str, ...]


def selection_case(
    decision: Decision,
    *,
    need: Need,
    local: Iterable[ContainerInfo],
    remote: Iterable[Candidate],
    cold_ms: float,
    config: PoolConfig,
    gateway: str,
    facts: Facts,
) -> SelectionCase:
    """Return a selection with all that it rested on."""
    links = {at: link for at, link in facts.links.items() if link != UNMEASURED and (facts.inputs or facts.volumes)}
    return SelectionCase(
        gateway=gateway,
        need=need,
        local=tuple(each for each in local if score(each, need, config.weights) is not None),
        remote=tuple(each for each in remote if score(each.container, need, config.weights) is not None),
        cold_ms=cold_ms,
        mode=config.mode,
        gamma=config.gamma,
        theta_match=config.theta_match,
        weights=config.weights,
        facts=msgspec.structs.replace(facts, links=links),
        phase=decision.phase,
        way=decision.way,
        chosen=decision.gateway,
        container=decision.container or "",
        score=decision.score,
        cost_ms=decision.cost_ms,
    )


def select_again(case: SelectionCase) -> dict[str, Any]:
    """Return what the selection decides now, by the names of the case's fields."""
    config = msgspec.convert(
        {
            "mode": case.mode,
            "gamma": case.gamma,
            "theta_match": case.theta_match,
            "weights": msgspec.to_builtins(case.weights),
        },
        PoolConfig,
    )
    decision = select(case.need, case.local, case.remote, case.cold_ms, config, gateway=case.gateway, facts=case.facts)
    return {
        "phase": decision.phase,
        "way": decision.way,
        "chosen": decision.gateway,
        "container": decision.container or "",
        "score": decision.score,
        "cost_ms": decision.cost_ms,
    }


def eviction_case(weighed: Weighed, *, gateway: str) -> EvictionCase:
    """Return an eviction with all that it rested on."""
    return EvictionCase(
        gateway=gateway,
        idle=weighed.idle[:MOST_IDLE],
        worths=weighed.worths[:MOST_IDLE],
        slots=weighed.slots,
        memory_mb=weighed.memory_mb,
        chosen=tuple(each.id for each in weighed.chosen),
    )


def evict_again(case: EvictionCase) -> dict[str, Any]:
    """Return whom the pool gives up now, worth least first, by the name of the case's field; none: it finds no room."""
    chosen = victims(case.idle, case.worths, slots=case.slots, memory_mb=case.memory_mb, spare={})
    return {"chosen": None if chosen is None else tuple(each.id for each in chosen)}
