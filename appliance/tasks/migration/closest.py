"""Step 3 of migration, finding the closest node: which gateway takes a run that is to be moved. Pure.

score(gateway) = w_w · warm + w_l · idle + w_d · near + w_h · history (paper, step 3; `algorithms.md`), with
warm = 1 for a ready container of the image, 0.5 for a compatible one; idle = 1 − the larger of its processors' and its
containers' share in use; near = the share of the subtask's data that lies there, or 1 where its robot's link is;
history = the share of the last moves there that went well. A gateway that drains, is overloaded, gave runs away
lately, has no room, was tried for this move or may not serve the task is no candidate. Those that score within
`NEARLY` of the best are taken in an order that differs from run to run: many gateways that look for a place at the
same time must not all find the same one.
"""

import hashlib
from collections import deque
from collections.abc import Iterable, Mapping

from msgspec import Struct

from appliance.model import ContainerInfo, ContainerState, GatewayStatus, Need
from appliance.tasks.migration.api import Weighed
from appliance.tasks.migration.settings import MigrationConfig

NEARLY = 0.05
"""Scores closer together than this say nothing: loads are a second old."""
REMEMBERED = 8
"""Moves remembered of each gateway."""


class Place(Struct, frozen=True, kw_only=True):
    """A gateway as it is known here."""

    status: GatewayStatus
    containers: tuple[ContainerInfo, ...] = ()
    near: float = 0.0
    """Share (0 to 1) of the subtask's data it holds; 1 where its robot's link is and there is no data."""


class History:
    """How moves to other gateways went, as this coordinator saw them."""

    def __init__(self) -> None:
        self._moves: dict[str, deque[bool]] = {}

    def went(self, gateway: str, *, well: bool) -> None:
        """Note how a move to a gateway went."""
        self._moves.setdefault(gateway, deque(maxlen=REMEMBERED)).append(well)

    def share(self, gateway: str) -> float:
        """Return the share of moves that went well; of a gateway that is not known, half of a first one."""
        moves = self._moves.get(gateway, ())
        return (sum(moves) + 1.0) / (len(moves) + 1.0)

    def forget(self, gateway: str) -> None:
        """It is gone."""
        self._moves.pop(gateway, None)


def closest(
    need: Need,
    run_id: str,
    places: Mapping[str, Place],
    *,
    source: str,
    config: MigrationConfig,
    history: History,
    tried: Mapping[str, str],
    to: str = "",
    may: frozenset[str] = frozenset(),
    lenient: bool = False,
) -> list[Weighed]:
    """Weigh all gateways for a run; candidates first, best first, then the others with the reason.

    Args:
        need: what it asks of a container.
        run_id: the run, by which near-equal candidates are ordered.
        places: the gateways that are there.
        source: where it runs now.
        config: the weights and marks.
        history: how earlier moves went.
        tried: gateways that have refused this move, with the reason.
        to: the only gateway that is wanted.
        may: gateways that may serve the task; empty: any.
        lenient: whether a gateway of average load will do, as for a drain or an operator's order.
    """
    found: list[Weighed] = []
    out: list[Weighed] = []
    for gateway, place in sorted(places.items()):
        why = _why_not(gateway, place, need, source=source, config=config, lenient=lenient)
        if not why and to and gateway != to:
            why = f"{to} is wanted"
        if not why and may and gateway not in may:
            why = "it may not serve this task"
        why = tried.get(gateway, "") or why
        if why:
            out.append(Weighed(gateway=gateway, verdict=why))
            continue
        score = (
            config.warm_weight * warm(need, place.containers)
            + config.load_weight * (1.0 - min(1.0, busy(place.status, config)))
            + config.near_weight * min(1.0, max(0.0, place.near))
            + config.history_weight * history.share(gateway)
        )
        found.append(Weighed(gateway=gateway, score=round(score, 3)))
    best = max((each.score for each in found), default=0.0)

    def rank(each: Weighed) -> tuple[float, float, str]:
        near_best = each.score >= best - NEARLY
        return (-best, _lot(run_id, each.gateway), "") if near_best else (-each.score, 0.0, each.gateway)

    found.sort(key=rank)
    return [*found, *out]


def _why_not(gateway: str, place: Place, need: Need, *, source: str, config: MigrationConfig, lenient: bool) -> str:
    """Return why a gateway is no candidate; empty when it is one."""
    status = place.status
    if gateway == source:
        return "it is there now"
    if status.draining:
        return "it drains"
    if status.overloaded:
        return f"it is overloaded: {status.overloaded}"
    is_warm = warm(need, place.containers) > 0
    if status.pool_problem and not is_warm:
        return status.pool_problem
    if status.queue > 0 and not is_warm:
        return f"{status.queue} runs wait for a container there"
    if not is_warm and status.capacity and status.containers - status.ready >= status.capacity:
        return "all its containers are in use"
    if not lenient and config.cpu_high and status.cpu_percent / 100 > config.cpu_low:
        return f"its processors are {status.cpu_percent:.0f} % busy"
    return ""


def warm(need: Need, containers: Iterable[ContainerInfo]) -> float:
    """1 with a ready container of the image, 0.5 with one of a compatible image, else 0."""
    best = 0.0
    for container in containers:
        if container.state is ContainerState.READY:
            best = max(best, 1.0 if container.image == need.image else 0.5 * (need.image in container.compatible))
    return best


def busy(status: GatewayStatus, config: MigrationConfig) -> float:
    """The larger of its processors' and its containers' share in use, 0 to 1 and above."""
    used = (status.running + status.queue) / max(1, status.capacity)
    return max(used, status.cpu_percent / 100 if config.cpu_high else 0.0)


def _lot(run_id: str, gateway: str) -> float:
    """A number between 0 and 1 that a run and a gateway always have (rendezvous hashing)."""
    digest = hashlib.blake2b(f"{run_id} {gateway}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") / 2**64
