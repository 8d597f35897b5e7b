"""Robots on one floor, reserved as the product does it, beside one at a time and beside no coordination.

Virtual time: the decider, the grantors and the sight are the product's, the rovers are simulated, and the network is
not. Figures depend on the seed alone, but for `took_s`. With `down_s` one of the three grantors is down for so long in
each minute.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
from msgspec import Struct

from appliance.errors import ConfigError
from appliance.skills.sites import load_site
from workshop.robots.shared_floor import Mode, run

MODES: tuple[Mode, ...] = ("reserved", "alone", "none")
MOST = 64


class Options(Struct, frozen=True, kw_only=True):
    """What is measured."""

    robots: tuple[int, ...] = (4, 8, 16, 32)
    seconds: float = 600.0
    """Simulated, of each."""
    site: str = "warehouse"
    seed: int = 1
    down_s: float = 10.0

    def check(self) -> None:
        """Raise ConfigError for what cannot be simulated."""
        if not self.robots or not all(1 <= count <= MOST for count in self.robots):
            raise ConfigError(f"{self.robots} robots", remedy=f"1 to {MOST} each")
        if not 1.0 <= self.seconds <= 36_000.0:
            raise ConfigError(f"{self.seconds:g} s", remedy="1 to 36,000 simulated seconds")
        if not 0.0 <= self.down_s <= 20.0:
            raise ConfigError(f"a grantor down for {self.down_s:g} s", remedy="0 to 20 s of each minute")


def measure(options: Options, *, progress: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Return the figures of every number of robots in every mode, and the ratios."""
    options.check()
    site = load_site(options.site)
    rows: list[dict[str, Any]] = []
    ratios: list[dict[str, Any]] = []
    for robots in options.robots:
        per_hour: dict[str, float] = {}
        for mode in MODES:
            progress(f"{robots} robots, {mode}")
            began = time.monotonic()
            outcome = run(
                site, robots=robots, mode=mode, seconds=options.seconds, seed=options.seed, down_s=options.down_s
            )
            per_hour[mode] = outcome.per_hour
            row: dict[str, Any] = msgspec.to_builtins(outcome)
            rows.append(row | {"per_hour": round(outcome.per_hour), "took_s": round(time.monotonic() - began, 1)})
        ratios.append(
            {
                "robots": robots,
                "to_alone": round(per_hour["reserved"] / max(1.0, per_hour["alone"]), 2),
                "to_none": round(per_hour["reserved"] / max(1.0, per_hour["none"]), 2),
            }
        )
    return {"options": msgspec.to_builtins(options), "runs": rows, "ratios": ratios, "kept": kept(rows)}


def kept(rows: Sequence[dict[str, Any]]) -> bool:
    """Whether no two robots under reservations came too near, and none wait for one another for ever."""
    return not any(row["collisions"] or row["deadlocks"] for row in rows if row["mode"] == "reserved")
