"""Many gateways that give runs away by the same deciders as the daemon's, in simulated time: pure, seeded.

It shows what no test on one machine can: a hundred gateways with thousands of runs that arrive unevenly, each seeing
the others as they were a second ago. A gateway has `places` containers; a run waits for one, works for its time, and
may be moved meanwhile, which takes `MOVE_S` and, if it had begun, the work since its last checkpoint.
"""

import random
from collections.abc import Sequence

from msgspec import Struct

from appliance.model import GatewayStatus, Need
from appliance.tasks.bucket import Bucket
from appliance.tasks.migration.gateway import free_places
from appliance.tasks.migration.policy import Candidate, History, Load, Overload, Place, Room, closest
from appliance.tasks.settings import MigrationConfig

STEP_S = 0.1
STATUS_S = 1.0
"""How old what is known of others may be."""
MOVE_S = 0.3
"""From the request to the start elsewhere."""
NEED = Need(image="base")


class Moved(Struct, frozen=True, kw_only=True):
    """One move that was made."""

    at: float
    run: str
    source: str
    target: str


class Outcome(Struct, kw_only=True):
    """What became of all runs."""

    ended: dict[str, float]
    """Run -> when it ended, seconds after it had come."""
    moves: list[Moved]
    queues: list[tuple[int, int]]
    """At each look: the longest queue and the number of free containers in the fleet."""
    lost: int
    elapsed_s: float


class _Run:
    def __init__(self, name: str, at: float, work_s: float) -> None:
        self.name, self.at, self.work_s = name, at, work_s
        self.done_s = self.saved_s = 0.0
        self.moves = 0
        self.came = at
        self.arrives: float | None = None


class _Gateway:
    def __init__(self, name: str, places: int, config: MigrationConfig) -> None:
        self.name, self.places = name, places
        self.running: list[_Run] = []
        self.waiting: list[_Run] = []
        self.coming: list[_Run] = []
        self.overload = Overload(config)
        self.intake = Bucket(config.moves_per_s, burst=2 * config.moves_per_s)
        self.history = History()

    def status(self, now: float) -> GatewayStatus:
        """What it says of itself."""
        return GatewayStatus(
            id=self.name,
            fleet="f",
            capacity=self.places,
            containers=self.places,
            ready=max(0, self.places - len(self.running) - len(self.coming)),
            running=len(self.running) + len(self.coming),
            queue=len(self.waiting),
            overloaded=self.overload.shown(now),
        )

    def reserve(self, now: float) -> bool:
        """Whether it takes a run, by what is so here and now."""
        free = self.places - len(self.running) - len(self.waiting) - len(self.coming)
        if free <= 0 or self.overload.shown(now) or not self.intake.take(now):
            return False
        self.overload.received(now)
        return True


def simulate(
    arrivals: Sequence[tuple[float, int, float]],
    *,
    gateways: int,
    places: int = 4,
    config: MigrationConfig | None = None,
    checkpoint_every_s: float = 1.0,
    limit_s: float = 3600.0,
) -> Outcome:
    """Run the fleet until all that came has ended, or for `limit_s`.

    Args:
        arrivals: when a run comes (seconds), at which gateway, and how long it works.
        gateways: how many.
        places: containers of each.
        config: marks and rations; `overload` False moves nothing.
        checkpoint_every_s: how much work a move may lose at most.
        limit_s: longest time.
    """
    config = config or MigrationConfig(cpu_high=0.0)
    fleet = [_Gateway(f"g{number:03d}", places, config) for number in range(gateways)]
    outcome = Outcome(ended={}, moves=[], queues=[], lost=0, elapsed_s=0.0)
    pending = sorted(
        ((at, _Run(f"r{number}", at, work), where) for number, (at, where, work) in enumerate(arrivals)),
        key=lambda each: (each[0], each[1].name),
    )
    total, step = len(pending), 0
    seen: dict[str, GatewayStatus] = {}
    while len(outcome.ended) < total and step * STEP_S < limit_s:
        now = step * STEP_S
        if step % round(STATUS_S / STEP_S) == 0:
            seen = {each.name: each.status(now) for each in fleet}
        while pending and pending[0][0] <= now:
            _, run, where = pending.pop(0)
            fleet[where].waiting.append(run)
        for gateway in fleet:
            if gateway.running or gateway.waiting or gateway.coming:
                _work(gateway, now, checkpoint_every_s, outcome)
        if step % round(config.every_s / STEP_S) == 0:
            for gateway in fleet:
                _shed(gateway, fleet, seen, now, config, outcome)
            longest = max(len(each.waiting) for each in fleet)
            free = sum(max(0, each.places - len(each.running)) for each in fleet)
            outcome.queues.append((longest, free))
        step += 1
    outcome.elapsed_s = step * STEP_S
    outcome.lost = total - len(outcome.ended)
    return outcome


def uneven(seed: int, *, runs: int, gateways: int, over_s: float, work_s: float) -> list[tuple[float, int, float]]:
    """Arrivals that crowd on a few gateways: a gateway's share falls with its rank (Zipf), work is exponential."""
    rng = random.Random(seed)  # noqa: S311 - a simulation
    order = list(range(gateways))
    rng.shuffle(order)
    weights = [1.0 / (rank + 1) for rank in range(gateways)]
    return [
        (rng.uniform(0.0, over_s), rng.choices(order, weights)[0], rng.expovariate(1.0 / work_s)) for _ in range(runs)
    ]


def _work(gateway: _Gateway, now: float, checkpoint_every_s: float, outcome: Outcome) -> None:
    for run in [each for each in gateway.coming if each.arrives is not None and each.arrives <= now]:
        gateway.coming.remove(run)
        gateway.running.append(run)
    for run in list(gateway.running):
        run.done_s += STEP_S
        run.saved_s = run.done_s // checkpoint_every_s * checkpoint_every_s
        if run.done_s >= run.work_s:
            gateway.running.remove(run)
            if run.name in outcome.ended:
                raise AssertionError(f"{run.name} ended twice")
            outcome.ended[run.name] = now - run.at
    while gateway.waiting and len(gateway.running) + len(gateway.coming) < gateway.places:
        gateway.running.append(gateway.waiting.pop(0))


def _shed(
    gateway: _Gateway,
    fleet: Sequence[_Gateway],
    seen: dict[str, GatewayStatus],
    now: float,
    config: MigrationConfig,
    outcome: Outcome,
) -> None:
    load = Load(queue=len(gateway.waiting), capacity=gateway.places)
    if not gateway.overload.look(load, now):
        return
    here = {run.name: run for run in (*gateway.waiting, *gateway.running)}
    waiting = {run.name for run in gateway.waiting}
    others = [status for name, status in seen.items() if name != gateway.name]
    room = Room(
        places=sum(free_places(each, config) for each in others),
        overloaded=1 + sum(bool(each.overloaded) for each in others),
    )
    candidates = [
        Candidate(
            id=name, began=name not in waiting, elapsed_s=now - run.came, expected_s=run.work_s,
            saved=run.saved_s > 0, moves=run.moves,
        )
        for name, run in here.items()
    ]  # fmt: skip
    by_name = {each.name: each for each in fleet}
    for name in gateway.overload.choose(load, candidates, room, under_way=(), now=now):
        run, tried = here[name], dict[str, str]()
        places = {each: Place(status=status) for each, status in seen.items()}
        for _ in range(4):
            weighed = closest(
                NEED, name, places, source=gateway.name, config=config, history=gateway.history, tried=tried
            )
            if not weighed or weighed[0].verdict:
                gateway.overload.refused(name, now)
                break
            target = by_name[weighed[0].gateway]
            if not target.reserve(now):
                tried[target.name] = "no room"
                gateway.history.went(target.name, well=False)
                continue
            (gateway.waiting if name in waiting else gateway.running).remove(run)
            run.done_s, run.moves, run.came, run.arrives = run.saved_s, run.moves + 1, now, now + MOVE_S
            target.coming.append(run)
            gateway.overload.gave(now)
            gateway.history.went(target.name, well=True)
            outcome.moves.append(Moved(at=now, run=name, source=gateway.name, target=target.name))
            break
