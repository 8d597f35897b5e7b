"""What is measured, by the benchmarks that there are; a cell whose file is there is not measured again."""

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct

from appliance.llm.settings import LlmConfig
from workshop.bench import federated, rate
from workshop.bench.learning.cells import Cell
from workshop.bench.learning.run import Bench
from workshop.bench.paper.published import CLIENTS, KILLED_AT
from workshop.bench.plan import run as plan

Size = Literal["smoke", "short", "full"]
WORKLOADS = ("clips", "words")
OWN = ("table", "startup", "rate")
"""Kinds of cells that are not those of `bench learn`."""
TIERS = {"rules": LlmConfig(tiers=("rules",)), "embedded": LlmConfig(tiers=("local",), local_model="embedded")}
"""Rows of Table I that need nothing beside this machine."""


class Extent(Struct, frozen=True, kw_only=True):
    """How large the measurements are."""

    workloads: tuple[str, ...]
    cases: int
    """Instructions of Table I; 0: all."""
    clients: tuple[int, ...]
    rounds: int
    every: int
    """Rounds between two evaluations."""
    items: tuple[int, int]
    """Samples for each client, and at least so many to judge by."""
    decided_rounds: int
    killed_at: tuple[int, ...]
    failing: int
    """Clients of the fleet of which some are killed; 0: none is measured."""
    warm: int
    cold: int
    rates: tuple[float, ...]
    rate_s: float


EXTENTS: dict[str, Extent] = {
    "smoke": Extent(
        workloads=("clips",), cases=20, clients=(4,), rounds=2, every=1, items=(20, 40), decided_rounds=10,
        killed_at=(2,), failing=0, warm=10, cold=2, rates=(2.0,), rate_s=2.0,
    ),
    "short": Extent(
        workloads=WORKLOADS, cases=0, clients=CLIENTS, rounds=20, every=2, items=(60, 1_000), decided_rounds=100,
        killed_at=KILLED_AT, failing=8, warm=100, cold=5, rates=(1.0, 5.0, 20.0), rate_s=6.0,
    ),
    "full": Extent(
        workloads=WORKLOADS, cases=0, clients=CLIENTS, rounds=100, every=5, items=(120, 7_200), decided_rounds=100,
        killed_at=KILLED_AT, failing=16, warm=300, cold=20, rates=(1.0, 2.0, 5.0, 10.0, 20.0, 40.0), rate_s=30.0,
    ),
}  # fmt: skip


def cells(size: Size) -> list[Cell]:
    """Return what is measured, the short ones first."""
    e = EXTENTS[size]
    found = [Cell(kind="table", name=f"table-{tier}", settings={"tier": tier, "cases": e.cases}) for tier in TIERS]
    found.append(Cell(kind="startup", name="startup", settings={"warm": e.warm, "cold": e.cold}))
    found.append(Cell(kind="rate", name="rate", settings={"rates": list(e.rates), "seconds": e.rate_s}))
    for workload in e.workloads:
        common = {"workload": workload, "train_items": e.items[0] * max(e.clients), "test_items": e.items[1]}

        def add(kind: str, name: str, common: dict[str, Any] = common, **settings: Any) -> None:
            found.append(Cell(kind=kind, name=f"{common['workload']}-{name}", settings={**common, **settings}))

        for clients in e.clients:
            for mode in ("sync", "partial", "offload"):
                add("decided", f"decided-{mode}-{clients}", mode=mode, clients=clients, rounds=e.decided_rounds,
                    stragglers=True, seed=1)  # fmt: skip
            for mode in ("sync", "partial"):
                add("virtual", f"curve-{mode}-{clients}", mode=mode, clients=clients, rounds=e.rounds, every=e.every,
                    seed=1)  # fmt: skip
        if e.failing:
            add("clients", "clients-killed", clients=e.failing, rounds=2 * max(e.killed_at),
                killed_at=list(e.killed_at), gateways=4)  # fmt: skip
    return found


class PaperBench(Bench):
    """Measures these cells; arguments as of `Bench`."""

    async def _data(self, cell: Cell) -> Path:
        return self._out if cell.kind in OWN else await super()._data(cell)

    @property
    def _measurements(self) -> dict[str, Callable[[Cell, Path], Awaitable[dict[str, Any]]]]:
        return super()._measurements | {"table": self._table, "startup": self._startup, "rate": self._rate}

    async def _table(self, cell: Cell, _: Path) -> dict[str, Any]:
        config, limit = TIERS[cell.settings["tier"]], cell.settings["cases"]
        found = await plan(config=config, limit=limit, upstream=False)
        return {"all": found["all"], "latency_ms": found["latency_ms"]}

    async def _startup(self, cell: Cell, _: Path) -> dict[str, Any]:
        await self._close()  # containers that train would take its time
        given = cell.settings
        return await federated.run_all(given["warm"], given["cold"], image="base", ray=False, progress=self._progress)

    async def _rate(self, cell: Cell, _: Path) -> dict[str, Any]:
        await self._close()
        options = rate.Options(
            modes=("cold", "local", "federated"), spreads=("even",), rates=tuple(cell.settings["rates"]),
            services_ms=(0.0,), seconds=cell.settings["seconds"],
        )  # fmt: skip
        return await rate.run(options, progress=self._progress)
