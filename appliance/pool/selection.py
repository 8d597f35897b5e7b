"""Container selection in three phases (paper, Algorithm 1), as plain functions of facts.

It exists apart from the pool so that it can be property-tested and simulated: no clock, no I/O, no state. The
pool asks it with the ready containers it has, then with those others offer, and carries out what it says.

Worked example, weights 0.5 / 0.3 / 0.2: a vision container (1 core, 256 MB) for a base skill that needs half a
core and 512 MB and no volume: 0.5 * 0.5 + 0.3 * min(1, 2, 0.5) + 0.2 * 1 = 0.25 + 0.15 + 0.2 = 0.6.
"""

from collections.abc import Sequence

from msgspec import Struct

from appliance.model import ContainerInfo, ContainerState, Need, Phase
from appliance.pool.settings import PoolConfig, Weights

COMPATIBLE_SCORE = 0.5
"""s_img of an image that can run the skill but is another (paper)."""


class Candidate(Struct, frozen=True, kw_only=True):
    """A ready container of another gateway and what using it costs: round trip and transfer, milliseconds."""

    container: ContainerInfo
    cost_ms: float


class Decision(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Where a subtask runs. `container` is None for a cold start; `why` explains it to people.

    `reservation` names the hold on a local container, so that a decision whose lease has run out is noticed.
    """

    phase: Phase
    gateway: str
    container: str | None = None
    score: float = 0.0
    cost_ms: float = 0.0
    why: str = ""
    reservation: str = ""


def score(container: ContainerInfo, need: Need, weights: Weights) -> float | None:
    """Return Score(c, T) in [0, 1], or None when c is no candidate for T."""
    if container.image == need.image:
        image = 1.0
    elif need.image in container.compatible:
        image = COMPATIBLE_SCORE
    else:
        return None
    resources = min(container.cpu / need.cpu, container.memory_mb / need.memory_mb, 1.0)
    wanted = frozenset(need.volumes)
    volumes = len(wanted.intersection(container.volumes)) / len(wanted) if wanted else 1.0
    return weights.image * image + weights.resources * resources + weights.volumes * volumes


def best_local(containers: Sequence[ContainerInfo], need: Need, weights: Weights) -> tuple[ContainerInfo, float] | None:
    """Return the ready container with the best score, and that; the id settles ties, so that all decide alike."""
    found: tuple[ContainerInfo, float] | None = None
    for container in containers:
        if container.state is not ContainerState.READY:
            continue
        value = score(container, need, weights)
        if value is None:
            continue
        if found is None or (value, container.id) > (found[1], found[0].id):
            found = (container, value)
    return found


def best_remote(
    candidates: Sequence[Candidate], need: Need, *, cold_ms: float, config: PoolConfig
) -> tuple[Candidate, float] | None:
    """Return the candidate with Score >= theta_match and cost < gamma * ColdCost(T): best score, then least cost."""
    found: tuple[Candidate, float] | None = None
    for candidate in candidates:
        if candidate.container.state is not ContainerState.READY:
            continue
        value = score(candidate.container, need, config.weights)
        if value is None or value < config.theta_match or not candidate.cost_ms < config.gamma * cold_ms:
            continue
        rank = (value, -candidate.cost_ms, candidate.container.gateway, candidate.container.id)
        if found is None or rank > (found[1], -found[0].cost_ms, found[0].container.gateway, found[0].container.id):
            found = (candidate, value)
    return found


def select(
    need: Need,
    local: Sequence[ContainerInfo],
    remote: Sequence[Candidate],
    cold_ms: float,
    config: PoolConfig,
    *,
    gateway: str = "",
) -> Decision:
    """Decide where a subtask runs.

    Args:
        need: T = (image, cpu, mem, volumes).
        local: this gateway's containers in any state (phase 1 takes the ready ones).
        remote: offers of others (phase 2).
        cold_ms: ColdCost(T), measured here.
        config: weights, theta_match, gamma, mode.
        gateway: this gateway's id.

    Returns:
        Phase 1, 2 or 3 with the container, its score and cost, and why.
    """
    if config.mode == "cold":
        return Decision(phase=Phase.COLD, gateway=gateway, cost_ms=cold_ms, why="mode is cold: always a new container")
    here = best_local(local, need, config.weights)
    if here is not None:
        container, value = here
        return Decision(
            phase=Phase.LOCAL_WARM,
            gateway=gateway,
            container=container.id,
            score=value,
            why=f"best of this gateway's ready containers, score {value:.2f}",
        )
    there = best_remote(remote, need, cold_ms=cold_ms, config=config) if config.mode == "federated" else None
    if there is not None:
        candidate, value = there
        return Decision(
            phase=Phase.REMOTE_WARM,
            gateway=candidate.container.gateway,
            container=candidate.container.id,
            score=value,
            cost_ms=candidate.cost_ms,
            why=f"none ready here; score {value:.2f} for {candidate.cost_ms:.1f} ms, cold would be {cold_ms:.0f} ms",
        )
    offers = f", none of {len(remote)} elsewhere good enough" if remote else ""
    return Decision(
        phase=Phase.COLD,
        gateway=gateway,
        cost_ms=cold_ms,
        why=f"no {need.image} container ready here{offers}: a new one, about {cold_ms:.0f} ms",
    )
