"""What a pool has learned survives a restart, and damage to it costs only what was learned."""

import math

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.errors import RefusedError
from appliance.model import encode
from appliance.pool.manager import EXPERIENCE_KEY, Experience, Keepsake
from appliance.pool.policies import ColdCosts, Planner, PlannerState
from appliance.pool.policies.forecast import Histogram, Level
from appliance.pool.settings import PoolConfig

pytestmark = pytest.mark.anyio


class Shelf:
    """A store in memory that may refuse to write."""

    def __init__(self, **values: bytes) -> None:
        self.values = values
        self.full = False

    async def put(self, key: str, value: bytes, *, durable: bool = True) -> None:  # noqa: ARG002
        """Write."""
        if self.full:
            raise RefusedError("the disk is full")
        self.values[key] = value

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Read."""
        return [(key, value) for key, value in self.values.items() if key.startswith(prefix)]


def planner() -> Planner:
    """A planner with the default policies."""
    return Planner(PoolConfig(), ColdCosts(500.0), lambda _: 256)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(("base", "vision")), st.floats(0.01, 500)), max_size=40))
def test_a_restarted_planner_knows_what_the_first_did(story: list[tuple[str, float]]) -> None:
    """Histograms, rates and the learned policy are the same after a round trip through the store's form."""
    first, now = planner(), 0.0
    for image, gap_s in story:
        now += gap_s
        first.arrived(image, now)
        first.ended(image, 0.005, now + 0.005)
    kept = msgspec.json.decode(encode(first.state()), type=PlannerState)
    second = planner()
    second.restore(kept, 0.0)
    assert encode(second.state()) == encode(first.state())


def test_a_timer_is_known_again_after_its_first_run() -> None:
    """An image that comes every 20 s is expected 20 s after the first run that follows a restart."""
    first = planner()
    for number in range(20):
        first.arrived("base", 20.0 * number)
        first.ended("base", 0.01, 20.0 * number + 0.01)
    second = planner()
    second.restore(msgspec.json.decode(encode(first.state()), type=PlannerState), 1000.0)
    second.arrived("base", 1005.0)
    second.ended("base", 0.01, 1005.01)
    forecast = Histogram(second._demand)
    level = Level("base", 1, 0, 1.0)
    assert not forecast.wants(level, 1010.0)
    assert forecast.wants(level, 1024.5)


def test_costs_are_known_again() -> None:
    """The moving quantile of cold starts goes on from what was measured."""
    first, second = ColdCosts(500.0), ColdCosts(500.0)
    for took_ms in (100.0, 120.0, 900.0, 110.0):
        first.add("base", took_ms)
    second.restore(msgspec.json.decode(encode(first.state()), type=dict[str, tuple[float, ...]]))
    assert second.of("base") == first.of("base")
    assert second.of("vision") == 500.0


async def test_kept_and_recalled() -> None:
    """What is saved at the end is recalled at the next start; a full disk costs only that."""
    shelf = Shelf()
    told = Experience(cold_ms={"base": (1.0, 2.0)})
    recalled: list[Experience] = []
    keepsake = Keepsake(shelf, recall=recalled.append, tell=lambda: told)
    await keepsake.start()
    await keepsake.stop()
    assert recalled == []
    keepsake = Keepsake(shelf, recall=recalled.append, tell=Experience)
    await keepsake.start()
    shelf.full = True
    await keepsake.stop()
    assert recalled == [told]
    assert msgspec.json.decode(shelf.values[EXPERIENCE_KEY], type=Experience) == told


@pytest.mark.parametrize(
    "value", [b"", b"{", b"[1]", b'{"cold_ms": 3}', b'{"planner": {"demand": {"base": {"arrivals": "x"}}}}']
)
async def test_what_cannot_be_read_is_learned_anew(value: bytes) -> None:
    """Damaged experience is dropped with a warning; the pool starts all the same."""
    recalled: list[Experience] = []
    keepsake = Keepsake(Shelf(**{EXPERIENCE_KEY: value}), recall=recalled.append, tell=Experience)
    await keepsake.start()
    await keepsake.stop()
    assert recalled == []


def test_hostile_numbers_do_no_harm() -> None:
    """Counts and costs that cannot be are left out or bounded, and the planner still answers."""
    state = msgspec.json.decode(
        b'{"demand": {"base": {"arrivals": -5, "service_s": -1, "gap_s": -2,'
        b' "levels": [{"-1": 3, "9999": 2, "3": -7}]}},'
        b' "learned": {"weights": [1], "covariance": [[2]], "seen": 1, "balance": 0}}',
        type=PlannerState,
    )
    made = planner()
    made.restore(state, 10.0)
    made.arrived("base", 11.0)
    made.ended("base", 0.1, 11.1)
    kept = made.state().demand["base"]
    assert kept.arrivals == 1
    assert math.isfinite(kept.gap_s)
    assert kept.levels[0] == {}
