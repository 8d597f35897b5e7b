"""Which runs an overloaded gateway gives away, and when. Pure: figures and the clock (seconds) in, decisions out.

A gateway is overloaded when a mark has been exceeded for `above_s` on end: its processors (`cpu_high`), runs that wait
for a container (`queue_high`), or memory (the pool is squeezed, which has marks and a calm of its own). It stays so
until all are below their low marks. So many runs are given away as bring it back between the marks: as many as wait,
or as many processors' worth as it is above the middle; for memory one at a time.

The cheapest go first: those that have not begun, then by what is lost or has to be carried (work since the last
checkpoint, state volumes). One is worth moving only if what it costs is less than what it still has before it. Never:
one that may not be moved, is nearly done by the experience with its skill, was moved within `rest_s` or `max_moves`
times.

That nothing is moved to and fro follows from four rules: a gateway that received a run gives none away for `settle_s`;
one that is overloaded, or gave a run away within `settle_s`, says so in its status and is no target (so two overloaded
ones never swap); a run rests after a move; and moves are rationed, for each gateway and, shared between all that are
overloaded, for the fleet.
"""

from collections.abc import Sequence, Set

from msgspec import Struct

from appliance.model import RunRequest
from appliance.tasks.migration.budget import Bucket
from appliance.tasks.migration.settings import MigrationConfig

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
