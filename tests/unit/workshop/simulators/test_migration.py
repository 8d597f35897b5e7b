"""A hundred gateways and thousands of runs in simulated time: balanced, bounded, nothing lost, no to and fro."""

from collections import Counter, defaultdict
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.tasks.settings import MigrationConfig
from workshop.simulators.migration import Moved, Outcome, simulate, uneven

CONFIG = MigrationConfig(cpu_high=0.0)
OFF = MigrationConfig(cpu_high=0.0, overload=False)


def check(outcome: Outcome, config: MigrationConfig = CONFIG) -> None:
    """What holds of every fleet: nothing lost, nothing passed on or swapped, all rations kept."""
    assert not outcome.lost
    moves: dict[str, list[Moved]] = defaultdict(list)
    for move in outcome.moves:
        moves[move.run].append(move)
    for each in moves.values():
        assert len(each) <= config.max_moves
        for one, other in pairwise(each):
            assert other.at - one.at >= config.rest_s or other.source == one.target
            assert other.at - one.at >= config.settle_s
    received, gave = dict[str, float](), dict[str, float]()
    for move in outcome.moves:
        assert move.at - received.get(move.source, -1e9) >= config.settle_s, f"{move} passes on"
        assert move.at - gave.get(move.target, -1e9) >= config.settle_s, f"{move} comes back"
        received[move.target], gave[move.source] = move.at, move.at
    per_second = Counter(int(each.at) for each in outcome.moves)
    assert all(count <= 2 * config.fleet_moves_per_s for count in per_second.values()), per_second.most_common(3)


def p(outcome: Outcome, part: float) -> float:
    """A quantile of the times to the end."""
    ordered = sorted(outcome.ended.values())
    return ordered[int(part * (len(ordered) - 1))]


@pytest.mark.thorough
def test_a_hundred_gateways_with_thousands_of_uneven_runs_become_balanced() -> None:
    """Those that crowd on few gateways end sooner with moves than without, and the last ones much sooner."""
    arrivals = uneven(1, runs=3000, gateways=100, over_s=60.0, work_s=4.0)
    moved, stayed = (simulate(arrivals, gateways=100, config=config) for config in (CONFIG, OFF))
    check(moved)
    assert not stayed.moves
    assert not stayed.lost
    assert p(moved, 0.99) < p(stayed, 0.99) / 2
    assert moved.elapsed_s < stayed.elapsed_s / 2
    # At the end no gateway has a queue while others stand idle for long.
    bad = sum(longest > 4 and free > 100 for longest, free in moved.queues)
    assert bad < sum(longest > 4 and free > 100 for longest, free in stayed.queues)


def test_a_fleet_that_is_full_everywhere_moves_next_to_nothing() -> None:
    """Two or many overloaded gateways do not swap: there is no room anywhere, so nothing goes."""
    arrivals = [(0.0, gateway, 20.0) for gateway in range(20) for _ in range(12)]
    outcome = simulate(arrivals, gateways=20)
    check(outcome)
    assert len(outcome.moves) < len(arrivals) / 10


def test_one_crowded_gateway_is_relieved_by_many() -> None:
    """All runs come to one of ten: its queue goes to the others, at the pace that is allowed, each run once."""
    outcome = simulate([(0.0, 0, 30.0)] * 40, gateways=10)
    check(outcome)
    assert max(Counter(each.run for each in outcome.moves).values()) == 1
    assert outcome.elapsed_s < 30.0 * 40 / 4 / 2


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.tuples(st.floats(0.0, 40.0), st.integers(0, 7), st.floats(0.1, 60.0)), min_size=1, max_size=150),
    st.integers(1, 4),
)
def test_whatever_comes_ends_once_and_is_not_moved_to_and_fro(
    arrivals: list[tuple[float, int, float]], places: int
) -> None:
    """Any arrivals at eight gateways."""
    check(simulate(arrivals, gateways=8, places=places))
