"""Decisions of the pool, recorded: a bounded list that people can ask for, and traces that can be decided again.

`Decisions` keeps what was started and given up lately and why, and counts it since the start.

A selection and an eviction are plain functions of facts (`selection`, `policies`). The facts are gone a moment later;
so a trace for the log (`SelectionCase`, `EvictionCase`) has them with the decision, as far as it depends on them:
containers that are no candidates are left out, and what moving bytes costs is a table of the prices that were asked.
`select_again` and `evict_again` replay a trace with the same code.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import msgspec
import structlog
from msgspec import Struct

from appliance.model import ContainerInfo, Need, Phase, VolumeInfo, Way
from appliance.pool.api import DecisionList, PoolDecision
from appliance.pool.policies import Idle
from appliance.pool.policies.planner import Weighed, victims
from appliance.pool.selection import Candidate, Decision, Facts, score, select
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
"""Idle containers that are told of one eviction: a gateway holds fewer."""


class Price(Struct, frozen=True):
    """What moving so many bytes between here and a gateway was said to take, milliseconds."""

    size_bytes: int
    gateway: str
    ms: float


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
    inputs: dict[str, int] = {}
    volumes: dict[str, tuple[VolumeInfo, ...]] = {}
    files: tuple[Price, ...] = ()
    state: tuple[Price, ...] = ()
    avoid: dict[str, str] = {}
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


class PriceList:
    """Notes the prices that a selection asks for."""

    def __init__(self, ask: Callable[[int, str], float]) -> None:
        self._ask = ask
        self._asked: dict[tuple[int, str], float] = {}

    def __call__(self, size_bytes: int, gateway: str) -> float:
        """Return what the real list says."""
        ms = self._asked[size_bytes, gateway] = self._ask(size_bytes, gateway)
        return ms

    def prices(self) -> tuple[Price, ...]:
        """Return what was asked."""
        return tuple(Price(size, gateway, ms) for (size, gateway), ms in self._asked.items())


def watched(facts: Facts) -> Facts:
    """Return the facts with price lists that note what is asked of them."""
    return msgspec.structs.replace(facts, files_ms=PriceList(facts.files_ms), state_ms=PriceList(facts.state_ms))


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
    """Return a selection with all that it rested on; the price lists of `facts` are those of `watched`."""
    files, state = facts.files_ms, facts.state_ms
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
        inputs=dict(facts.inputs),
        volumes=dict(facts.volumes),
        files=files.prices() if isinstance(files, PriceList) else (),
        state=state.prices() if isinstance(state, PriceList) else (),
        avoid=dict(facts.avoid),
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
    facts = Facts(
        inputs=case.inputs,
        volumes=case.volumes,
        files_ms=_listed(case.files),
        state_ms=_listed(case.state),
        avoid=case.avoid,
    )
    decision = select(case.need, case.local, case.remote, case.cold_ms, config, gateway=case.gateway, facts=facts)
    return {
        "phase": decision.phase,
        "way": decision.way,
        "chosen": decision.gateway,
        "container": decision.container or "",
        "score": decision.score,
        "cost_ms": decision.cost_ms,
    }


def _listed(prices: Sequence[Price]) -> Callable[[int, str], float]:
    table = {(each.size_bytes, each.gateway): each.ms for each in prices}
    # A price that was not asked then is asked only by another decision: any figure shows that.
    return lambda size, gateway: table.get((size, gateway), 0.0)


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
