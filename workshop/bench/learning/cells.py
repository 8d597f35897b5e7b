"""Which measurements there are, and how large each is. Pure.

A cell's settings are all that its result depends on, apart from the machine: a file of other settings is measured
again.
"""

from collections.abc import Callable, Iterable
from typing import Any, Literal

from msgspec import Struct

from appliance.errors import ConfigError

Workload = Literal["clips", "words"]
Size = Literal["quick", "short", "full"]

SLOW = ((5.0, 8), (3.0, 8))
"""How many times slower than nominal devices are, and one in how many clients is so slow."""
NOMINAL_BATCH_S = 0.25
"""Of a nominal device, in virtual time: an epoch of a shipped data set then takes it about 2 s."""
BUSY = 0.7
"""Of a nominal device's time that this machine may need for all clients together, so that emulation holds."""
MODES = ("sync", "partial", "offload", "buffered", "drop")
"""What is compared; `sync` is FedAvg, `drop` is `buffered` of which late updates are thrown away."""
KINDS = ("virtual", "decided", "hostile", "wall", "takeover", "restart", "clients", "costs", "flower")


class Cell(Struct, frozen=True, kw_only=True):
    """One measurement. `name` is its file's."""

    kind: str
    name: str
    settings: dict[str, Any]


class Sizes(Struct, frozen=True, kw_only=True):
    """How large the measurements are."""

    virtual_clients: int
    virtual_rounds: int
    every: int
    """Rounds between two evaluations."""
    seeds: tuple[int, ...]
    virtual_modes: tuple[str, ...]
    train_items: int
    """About so many samples for each of `virtual_clients`."""
    test_items: int
    """At least so many."""
    hostile_rounds: int
    hostile_rules: tuple[str, ...]
    decided_clients: tuple[int, ...]
    decided_rounds: int
    wall_clients: tuple[int, ...]
    wall_rounds: int
    wall_modes: tuple[str, ...]
    kills: int
    """Of the coordinator, in each phase of a round."""
    killed_at: tuple[int, ...]
    """Rounds at which a quarter of the clients are killed."""
    clients: int
    """Of the fleets on which gateways and clients are killed."""
    cost_clients: tuple[int, ...]
    cost_rounds: int
    flower_clients: tuple[int, ...]
    flower_ways: tuple[str, ...]
    flower_rounds: int
    gateways: int


SIZES: dict[str, Sizes] = {
    "quick": Sizes(
        virtual_clients=4, virtual_rounds=2, every=2, seeds=(1,), virtual_modes=("sync", "partial"), train_items=20,
        test_items=40, hostile_rounds=1, hostile_rules=("trimmed",), decided_clients=(8,), decided_rounds=10,
        wall_clients=(4,), wall_rounds=4, wall_modes=("sync", "partial"), kills=1, killed_at=(2,), clients=4,
        cost_clients=(4,), cost_rounds=3, flower_clients=(4,), flower_ways=("simulation",), flower_rounds=2, gateways=2,
    ),
    "short": Sizes(
        virtual_clients=16, virtual_rounds=60, every=10, seeds=(1, 2), virtual_modes=MODES, train_items=120,
        test_items=7_200, hostile_rounds=20, hostile_rules=("mean", "trimmed", "multikrum"),
        decided_clients=(8, 16, 24, 32), decided_rounds=100, wall_clients=(8, 16), wall_rounds=8,
        wall_modes=("sync", "partial", "offload"), kills=2, killed_at=(2, 4, 8), clients=8, cost_clients=(8, 16),
        cost_rounds=10, flower_clients=(8,), flower_ways=("simulation", "deployment"), flower_rounds=3, gateways=4,
    ),
    "full": Sizes(
        virtual_clients=16, virtual_rounds=100, every=10, seeds=(1, 2, 3), virtual_modes=MODES, train_items=120,
        test_items=7_200, hostile_rounds=60, hostile_rules=("mean", "trimmed", "multikrum"),
        decided_clients=(8, 16, 24, 32), decided_rounds=100, wall_clients=(8, 16, 24, 32), wall_rounds=15,
        wall_modes=("sync", "partial", "offload"), kills=10, killed_at=(2, 4, 8, 16), clients=16,
        cost_clients=(8, 16, 32), cost_rounds=20, flower_clients=(8, 16), flower_ways=("simulation", "deployment"),
        flower_rounds=3, gateways=4,
    ),
}  # fmt: skip


def speeds(clients: int, *, stragglers: bool = True) -> dict[str, float]:
    """Return the slow clients and how many times slower they are: 1/8 of all 5 times, 1/8 3 times."""
    if not stragglers:
        return {}
    found: dict[str, float] = {}
    for speed, one_in in SLOW:
        for _ in range(max(1, clients // one_in)):
            found[client_name(len(found))] = speed
    return found


def client_name(number: int) -> str:
    """Return a client's name, as recipes name the parts of a data set."""
    return f"part-{number:03d}"


def cells(workload: Workload, size: Size) -> list[Cell]:
    """Return all cells of a workload, the quick ones first."""
    s = SIZES[size]
    found: list[Cell] = []

    def add(kind: str, name: str, **settings: Any) -> None:
        found.append(Cell(kind=kind, name=f"{workload}-{name}", settings={"workload": workload, **settings}))

    items = {"train_items": s.train_items * s.virtual_clients, "test_items": s.test_items}
    for clients in s.decided_clients:
        for mode in MODES:
            add("decided", f"decided-{mode}-{clients}", mode=mode, clients=clients, rounds=s.decided_rounds,
                stragglers=True, seed=1, **items)  # fmt: skip
        add("decided", f"decided-partial-{clients}-even", mode="partial", clients=clients, rounds=s.decided_rounds,
            stragglers=False, seed=1, **items)  # fmt: skip
        add("decided", f"decided-sync-{clients}-even", mode="sync", clients=clients, rounds=s.decided_rounds,
            stragglers=False, seed=1, **items)  # fmt: skip
    common = {"clients": s.virtual_clients, "every": s.every, **items}
    for seed in s.seeds:
        for mode in s.virtual_modes:
            add("virtual", f"virtual-{mode}-seed{seed}", mode=mode, seed=seed, rounds=s.virtual_rounds, **common)
    for attack in ("mixed", "hidden"):
        for rule in s.hostile_rules:
            add("hostile", f"hostile-{attack}-{rule}", attack=attack, rule=rule, seed=1, rounds=s.hostile_rounds,
                **common)  # fmt: skip
    add("hostile", "hostile-none-mean", attack="none", rule="mean", seed=1, rounds=s.hostile_rounds, **common)
    fleet = {"gateways": s.gateways, **items}
    for clients in s.cost_clients:
        add("costs", f"costs-{clients}", clients=clients, rounds=s.cost_rounds, **fleet)
    for clients in s.wall_clients:
        add("wall", f"wall-{clients}", modes=list(s.wall_modes), clients=clients, rounds=s.wall_rounds, **fleet)
    for phase in ("before", "during", "after"):
        add("takeover", f"takeover-{phase}", phase=phase, kills=s.kills, clients=s.clients, **fleet)
    add("restart", "restart", clients=s.clients, round=min(10, s.wall_rounds), **fleet)
    add("clients", "clients-killed", clients=s.clients, rounds=2 * max(s.killed_at), killed_at=list(s.killed_at),
        **fleet)  # fmt: skip
    for clients in s.flower_clients if workload == "clips" else ():  # Flower's environment decodes no recordings
        for way in s.flower_ways:
            add("flower", f"flower-{way}-{clients}", way=way, clients=clients, rounds=s.flower_rounds, **items)
    return found


def chosen(found: Iterable[Cell], wanted: Iterable[str]) -> list[Cell]:
    """Return the cells that are asked for, by kind, name, or the beginning of a name; all where nothing is.

    Raises:
        ConfigError: there is none of that name.
    """
    every, names = list(found), list(wanted)
    if not names:
        return every

    def asked(name: str) -> Callable[[Cell], bool]:
        return lambda cell: (
            name == cell.kind or any(each.startswith(name) for each in (cell.name, cell.name.partition("-")[2]))
        )

    for name in names:
        if not any(map(asked(name), every)):
            kinds = ", ".join(dict.fromkeys(cell.kind for cell in every))
            raise ConfigError(f"no cell {name[:60]!r}", remedy=f"a kind ({kinds}), or the beginning of a cell's name")
    return [cell for cell in every if any(asked(name)(cell) for name in names)]
