"""Arrivals, and the verdict on how a load was taken."""

import itertools
import statistics
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import settings as few
from hypothesis import strategies as st

from workshop.bench.load import Outcome, Sampled, account, arrivals, breaking, verdict, window_s

GATEWAYS = ("a", "b", "c", "d")


@few(max_examples=50)
@given(st.floats(min_value=0.5, max_value=100), st.floats(min_value=0.1, max_value=20), st.integers(0, 1000))
def test_arrivals_are_in_order_within_the_window_and_repeatable(rate: float, seconds: float, seed: int) -> None:
    """Times rise and stay within the window; the same seed gives the same arrivals."""
    found = arrivals(rate, seconds, GATEWAYS, spread="uneven", seed=seed)
    times = [each.at_s for each in found]
    assert times == sorted(times)
    assert all(0 < each < seconds for each in times)
    assert found == arrivals(rate, seconds, GATEWAYS, spread="uneven", seed=seed)


def test_arrivals_are_a_poisson_process() -> None:
    """Gaps are exponential: mean and standard deviation are both 1 / rate."""
    times = [each.at_s for each in arrivals(50.0, 400.0, GATEWAYS, spread="even", seed=1)]
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert statistics.mean(gaps) == pytest.approx(0.02, rel=0.03)
    assert statistics.stdev(gaps) == pytest.approx(0.02, rel=0.05)


def test_spreads() -> None:
    """Even arrivals give each gateway its quarter, uneven ones the first of them three fifths."""
    even = Counter(each.gateway for each in arrivals(50.0, 400.0, GATEWAYS, spread="even", seed=1))
    uneven = Counter(each.gateway for each in arrivals(50.0, 400.0, GATEWAYS, spread="uneven", seed=1))
    assert all(count / even.total() == pytest.approx(0.25, abs=0.02) for count in even.values())
    assert uneven["a"] / uneven.total() == pytest.approx(0.6, abs=0.02)
    assert uneven["a"] > uneven["b"] > uneven["c"] > uneven["d"] > 0


def test_windows() -> None:
    """A slow rate is offered longer until enough runs are expected, but not for ever."""
    assert window_s(20.0, seconds=6.0, least=12, most_s=12.0) == 6.0
    assert window_s(1.5, seconds=6.0, least=12, most_s=12.0) == 8.0
    assert window_s(0.1, seconds=6.0, least=12, most_s=12.0) == 12.0
    assert window_s(0.1, seconds=30.0, least=12, most_s=12.0) == 30.0


def served(count: int, ms: float = 10.0, phase: str = "local warm", sent_ms: float = 0.1) -> list[Outcome]:
    """Return runs that were served."""
    return [Outcome(sent_ms=sent_ms, started_ms=ms, ended_ms=ms + 1, gateway="a", phase=phase) for _ in range(count)]


def test_a_load_that_is_carried() -> None:
    """Fast starts and one failure in a hundred are no break, whatever the machine was doing."""
    runs = [*served(99), Outcome(problem="refused")]
    assert verdict(runs, Sampled(cpu=0.99), limit_ms=1000) == []
    assert verdict([], Sampled(), limit_ms=1000) == []


def test_refusals_break_and_are_told_first() -> None:
    """Two refusals in a hundred break; the queue that caused them is named, longest first."""
    runs = [*served(98), *(Outcome(problem="refused") for _ in range(2))]
    found = verdict(runs, Sampled(cpu=0.5, queue={"a": 32, "b": 0, "c": 3}), limit_ms=1000)
    assert found[0] == "not served: 2 refused of 100"
    assert found[1] == "queue: up to 32 at a, 3 at c waited for a container"


def test_slow_starts_break_with_their_cause() -> None:
    """A p99 beyond the limit breaks: full cores with who used them, a full daemon, cold starts, the sender's lag."""
    found = verdict(served(100, 1500.0), Sampled(cpu=0.97, daemons={"gw-1": 0.2, "gw-2": 0.7}), limit_ms=1000)
    assert found[0].startswith("p99 of the start is 1500 ms")
    assert found[1] == "CPU: all cores 97% busy (gw-2 0.70 cores, gw-1 0.20 cores)"
    found = verdict(served(100, 1500.0), Sampled(cpu=0.6, daemons={"gw-1": 0.95}), limit_ms=1000)
    assert found[1] == "CPU: gw-1 fills its one core"
    found = verdict(served(100, 1500.0, "cold", sent_ms=50.0), Sampled(), limit_ms=1000)
    assert found[1:] == ["cold starts: 100 of 100", "the sender itself was 50 ms late at p99"]
    assert "no cause was seen" in verdict(served(100, 1500.0), Sampled(), limit_ms=1000)[1]


def test_nothing_served() -> None:
    """A load of which nothing is served is reported once, without a p99 that does not exist."""
    found = verdict([Outcome(problem="lost")] * 5, Sampled(), limit_ms=1000)
    assert found[0] == "not served: 5 lost of 5"
    assert not any("p99" in each for each in found)


def test_where_a_ladder_breaks() -> None:
    """The first rate that is too much, whatever order they came in, and the one below that held."""
    assert breaking({20.0: ["full"], 5.0: [], 10.0: []}) == {"holds": 10.0, "breaks": 20.0, "why": ["full"]}
    assert breaking({5.0: []}) == {"holds": 5.0, "breaks": None, "why": []}
    assert breaking({5.0: ["full"]}) == {"holds": None, "breaks": 5.0, "why": ["full"]}


def test_the_account_of_a_rate() -> None:
    """Figures are those of all runs; a run that was not served is in the counts and makes the tail unknown."""
    found = account([*served(9), Outcome(problem="refused")], Sampled(cpu=0.5, queue={"a": 0, "b": 2}))
    assert (found["start"]["count"], found["start"]["p50"], found["start"]["p99"]) == (10, 10.0, None)
    assert (found["unserved"], found["phases"], found["queue"]) == ({"refused": 1}, {"local warm": 9}, {"b": 2})


def test_what_the_tail_is_made_of() -> None:
    """Each phase has its own figures, and the slowest starts are reported one by one with what their gateway took."""
    slow = Outcome(started_ms=80.0, within_ms=75.0, ended_ms=90.0, asked="a", gateway="b", phase="remote warm")
    found = account([*served(99), slow], Sampled())
    assert found["ways"]["remote warm"]["within"]["max"] == 75.0
    assert found["ways"]["local warm"]["start"]["count"] == 99
    first = found["slowest"][0]
    assert (first["start"], first["within"], first["asked"], first["ran_on"]) == (80.0, 75.0, "a", "b")
    assert len(found["slowest"]) == 12
