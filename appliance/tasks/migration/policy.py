"""Migration policy: which runs an overloaded gateway gives away and when, and which gateway takes a run. Pure.

Figures and the clock (seconds) in, decisions out.

**Overload.** A gateway is overloaded when a mark has been exceeded for `above_s` on end: its processors (`cpu_high`),
runs that wait for a container (`queue_high`), or memory (the pool is squeezed, which has marks and a calm of its own).
It stays so until all are below their low marks. So many runs are given away as bring it back between the marks: as many
as wait, or as many processors' worth as it is above the middle; for memory one at a time.

The cheapest go first: those that have not begun, then by what is lost or has to be carried (work since the last
checkpoint, state volumes). One is worth moving only if what it costs is less than what it still has before it. Never:
one that may not be moved, is nearly done by the experience with its skill, was moved within `rest_s` or `max_moves`
times.

That nothing is moved to and fro follows from four rules: a gateway that received a run gives none away for `settle_s`;
one that is overloaded, or gave a run away within `settle_s`, says so in its status and is no target (so two overloaded
ones never swap); a run rests after a move; and moves are rationed by a token bucket, for each gateway and, shared
between all that are overloaded, for the fleet.

**Closest node** (paper, step 3 of migration; `algorithms.md`).

    score(gateway) = w_w · warm + w_l · idle + w_d · near + w_h · history

with warm = 1 for a ready container of the image, 0.5 for a compatible one; idle = 1 − the larger of its processors' and
its containers' share in use; near = the share of the subtask's data that lies there, or 1 where its robot's link is;
history = the share of the last moves there that went well. A gateway that drains, is overloaded, gave runs away
lately, has no room, was tried for this move or may not serve the task is no candidate. Those that score within
`NEARLY` of the best are taken in an order that differs from run to run: many gateways that look for a place at the
same time must not all find the same one.
"""

import hashlib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence, Set

from msgspec import Struct

from appliance.model import ContainerInfo, ContainerState, GatewayStatus, Need, RunRequest
from appliance.model.task_api import Weighed
from appliance.tasks.bucket import Bucket
from appliance.tasks.settings import MigrationConfig

CARRY_MB_S = 50.0
"""What a state volume is carried with, MB/s: of the order of what was measured between two gateways."""
MOVE_S = 0.5
"""What any move costs a run that has begun: a checkpoint, the end here, the start there."""
LATE = 2.0
"""A run that takes so many times as long as others has shown that experience says nothing of it."""


class Load(Struct, frozen=True, kw_only=True):
    """What a gateway sees of itself."""

    cpu: float = 0.0
    """Part of its processors in use."""
    processors: float = 1.0
    squeeze: str = ""
    """Why its pool holds less memory than it may; empty when it does not."""
    queue: int = 0
    """Runs that wait for a container."""
    capacity: int = 1


class Candidate(Struct, frozen=True, kw_only=True):
    """A run here."""

    id: str
    mobile: bool = True
    """Whether it may be moved at all."""
    began: bool = True
    cpu: float = 0.5
    """Processors it asks for."""
    elapsed_s: float = 0.0
    expected_s: float = 0.0
    """How long runs of its skill take; 0: not known."""
    saved: bool = False
    """Whether there is a checkpoint from which it would go on."""
    state_mb: float = 0.0
    """State volumes that would go with it."""
    moves: int = 0


class Room(Struct, frozen=True, kw_only=True):
    """What is known of the others: places for runs on gateways that take any, and how many gateways are overloaded."""

    places: int = 0
    overloaded: int = 1


class Overload:
    """Decides for one gateway."""

    def __init__(self, config: MigrationConfig) -> None:
        self._config = config
        self._above_since: float | None = None
        self._reason = ""
        self._received_at = float("-inf")
        self._gave_at = float("-inf")
        self._bucket = Bucket(config.moves_per_s, burst=config.moves_per_s)
        self._refused: dict[str, float] = {}

    # --- what is known ----------------------------------------------------------------------------------------

    @property
    def overloaded(self) -> bool:
        """Whether it is, by the last look."""
        return bool(self._reason)

    def shown(self, now: float) -> str:
        """Why the gateway is no target: overloaded, or it gave runs away lately; empty when it is one."""
        if self._reason or now - self._gave_at >= self._config.settle_s:
            return self._reason
        return "it gave runs away lately"

    def received(self, now: float) -> None:
        """A run is about to come from elsewhere."""
        self._received_at = now

    def gave(self, now: float) -> None:
        """A run was given away."""
        self._gave_at = now

    def refused(self, run: str, now: float) -> None:
        """A run could not be moved: another look at it later."""
        self._refused[run] = now

    # --- deciding ---------------------------------------------------------------------------------------------

    def look(self, load: Load, now: float) -> str:
        """Take in what the gateway sees of itself; returns why it is overloaded, empty when it is not."""
        high = self._high(load)
        if not high:
            self._above_since = None
            if self._reason and self._low(load):
                self._reason = ""
        else:
            if self._above_since is None:
                self._above_since = now
            if self._reason or now - self._above_since >= self._config.above_s:
                self._reason = high
        return self._reason

    def _high(self, load: Load) -> str:
        config = self._config
        if config.queue_high and load.queue >= config.queue_high:
            return f"{load.queue} runs wait for a container"
        if config.cpu_high and load.cpu >= config.cpu_high:
            return f"its processors are {load.cpu:.0%} busy"
        return load.squeeze

    def _low(self, load: Load) -> bool:
        config = self._config
        return not (
            (config.queue_high and load.queue) or (config.cpu_high and load.cpu >= config.cpu_low) or load.squeeze
        )

    def choose(
        self, load: Load, runs: Sequence[Candidate], room: Room, *, under_way: Sequence[Candidate], now: float
    ) -> list[str]:
        """Return the runs to move now, cheapest first; none while it is not overloaded or must wait.

        Args:
            load: what the gateway sees of itself.
            runs: all runs here but those being moved.
            room: what is known of the others.
            under_way: runs that are being moved away; those that wait are still counted in the queue.
            now: monotonic seconds.
        """
        config = self._config
        gone = {each.id for each in runs}
        self._refused = {run: at for run, at in self._refused.items() if run in gone and now - at < config.settle_s}
        if not (config.overload and self._reason) or now - self._received_at < config.settle_s:
            return []
        able = sorted((each for each in runs if self._may(each)), key=lambda each: (cost_s(each), each.id))
        fair = config.fleet_moves_per_s / max(1, room.overloaded)
        self._bucket.limit(min(config.moves_per_s, fair))
        most = min(room.places, config.at_once - len(under_way), self._bucket.left(now))
        chosen = able[: max(0, min(most, self._wanted(load, able, under_way)))]
        for _ in chosen:
            self._bucket.take(now)
        return [each.id for each in chosen]

    def _wanted(self, load: Load, able: Sequence[Candidate], under_way: Sequence[Candidate]) -> int:
        """How many more must go to bring the gateway back between its marks."""
        config = self._config
        wanted = load.queue - sum(not each.began for each in under_way) if config.queue_high else 0
        if config.cpu_high and load.cpu >= config.cpu_high:
            excess = (load.cpu - (config.cpu_high + config.cpu_low) / 2) * load.processors
            gained = sum(each.cpu for each in under_way)
            for number, each in enumerate(able, 1):
                gained += each.cpu
                if gained >= excess:
                    wanted = max(wanted, number)
                    break
            else:
                wanted = max(wanted, len(able))
        return max(wanted, 1 if load.squeeze and not under_way else 0)

    def _may(self, run: Candidate) -> bool:
        config = self._config
        if not run.mobile or run.id in self._refused or run.moves >= config.max_moves:
            return False
        if run.moves and run.elapsed_s < config.rest_s:
            return False
        if not run.began:
            return True
        left_s = remaining_s(run)
        return left_s >= config.nearly_done_s and cost_s(run) < left_s


def may_leave(request: RunRequest, mobility: str, *, began: bool, others: Set[str]) -> bool:
    """Whether a run may be moved to any of the other gateways at all.

    Args:
        request: the order; one that no coordinator has sent is nobody's record and stays, and so does one whose
            submitter allows no gateway but this one: while it waits, what works before it has to go.
        mobility: of its skill, by the manifest.
        began: whether its handler has begun.
        others: the gateways that are there, without this one.
    """
    if not request.coordinator or (request.group and others.isdisjoint(request.group)):
        return False
    return mobility != "never" or not began


def remaining_s(run: Candidate) -> float:
    """How long a run is expected to go on: by experience with its skill, or as long again as it has by now."""
    if run.expected_s > 0 and run.elapsed_s < LATE * run.expected_s:
        return max(0.0, run.expected_s - run.elapsed_s)
    return run.elapsed_s


def cost_s(run: Candidate) -> float:
    """What moving a run costs it: work that is lost, state that is carried, and the move itself."""
    if not run.began:
        return 0.0
    return MOVE_S + (0.0 if run.saved else run.elapsed_s) + run.state_mb / CARRY_MB_S


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
