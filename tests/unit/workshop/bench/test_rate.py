"""The promises about p99 beside what was reached."""

from typing import Any

from msgspec.structs import replace

from appliance.model import GatewayStatus
from workshop.bench.rate import MODES, pool_of, quiet, targets


def ladder(mode: str, spread: str, service_ms: float, p99: dict[str, float | None]) -> dict[str, Any]:
    """Return what a ladder of rates tells."""
    cells = {rate: {"start": {"p99": each}} for rate, each in p99.items()}
    return {"mode": mode, "spread": spread, "service_ms": service_ms, "cells": cells}


def test_promises_that_were_measured() -> None:
    """p99 at 20/s is compared with 60 ms, and with the baseline where arrivals are uneven and runs take time."""
    found = targets(
        [
            ladder("federated", "even", 0.0, {"10": 5.0, "20": 50.0}),
            ladder("federated", "uneven", 0.0, {"20": 70.0}),
            ladder("federated", "uneven", 150.0, {"20": 80.0}),
            ladder("local", "uneven", 0.0, {"20": 70.0}),
            ladder("local", "uneven", 150.0, {"20": 160.0, "40": 900.0}),
        ]
    )
    assert found["p99_at_20_even"] == {"promised_ms": 60.0, "reached_ms": 50.0, "kept": True}
    assert found["p99_at_20_uneven"]["kept"] is False
    assert found["uneven_local_over_federated_p99_at_20_of_150_ms"] == {"promised": 1.5, "reached": 2.0, "kept": True}
    assert len(found) == 3


def test_a_baseline_that_broke_earlier_is_compared_where_it_broke() -> None:
    """Its last rate counts; without the same rate of the other, and for endless p99, nothing is said."""
    local = ladder("local", "uneven", 150.0, {"5": 30.0, "10": 3000.0})
    found = targets([local, ladder("federated", "uneven", 150.0, {"5": 20.0, "10": 30.0})])
    assert found == {
        "uneven_local_over_federated_p99_at_10_of_150_ms": {"promised": 1.5, "reached": 100.0, "kept": True}
    }
    assert targets([local]) == {}
    assert targets([local, ladder("federated", "uneven", 150.0, {"10": None})]) == {}


def test_modes_differ_only_in_how_they_use_their_containers() -> None:
    """Capacity, memory and queue are the same in all modes; the baseline starts nothing ahead but its one."""
    pools = {mode: pool_of(mode, "base") for mode in MODES}
    assert len({(each.capacity, each.memory_mb, each.queue) for each in pools.values()}) == 1
    assert (pools["local"].prewarm, pools["local"].idle_s, pools["local"].keep) == ((), 600.0, "fixed")
    assert pools["cold"].floor == {}
    assert pools["local"].floor == pools["federated"].floor


def test_what_the_next_rate_waits_for() -> None:
    """A gateway with a run, one that waits, or a container that is only starting is not quiet; silence is."""
    calm = GatewayStatus(id="a", fleet="f", containers=3, ready=3)
    assert quiet({})
    assert quiet({"a": calm})
    for more in ({"running": 1}, {"queue": 1}, {"containers": 4}):
        assert not quiet({"a": calm, "b": replace(calm, **more)})
