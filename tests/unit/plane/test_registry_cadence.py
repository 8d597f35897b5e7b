"""How often things are published: at once after quiet, never too often, never too late, sooner what is asked for."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.plane.registry import RATE_MEMORY_S, Cadence, Rate, bounds, heartbeat_s, interval_s

rates = st.floats(0, 1000)
listeners = st.integers(0, 1000)
LEAST, MOST = 0.02, 0.5


def interval(volatility: float, demand: float, others: int) -> float:
    """The interval with the defaults."""
    return interval_s(volatility=volatility, demand=demand, listeners=others, least_s=LEAST, most_s=MOST)


@settings(deadline=None)
@given(rates, rates, listeners, st.floats(1, 10))
def test_more_volatile_or_more_asked_for_is_sooner_and_more_listeners_later(
    volatility: float, demand: float, others: int, factor: float
) -> None:
    """The interval falls with volatility and demand, rises with listeners, and stays within its bounds."""
    found = interval(volatility, demand, others)
    least, most = bounds(others, least_s=LEAST, most_s=MOST)
    assert LEAST <= least <= found <= most
    assert interval(volatility * factor, demand, others) <= found
    assert interval(volatility, demand * factor, others) <= found
    assert interval(volatility, demand, others + 10) >= found


def test_the_interval_costs_least() -> None:
    """Between the bounds, no other interval makes stale decisions and messages together cheaper."""
    from appliance.plane.registry import DELIVERY_PRICE  # noqa: PLC0415 - only here

    def cost(interval_s: float) -> float:
        return DELIVERY_PRICE * 3 / interval_s + 4.0 * 1.5 * interval_s / 2

    best = interval(4.0, 1.5, 3)
    assert LEAST < best < MOST
    assert all(cost(best) <= cost(best * other) for other in (0.5, 0.8, 0.99, 1.01, 1.25, 2))


@settings(deadline=None)
@given(st.lists(st.floats(0.001, 3), max_size=60), st.floats(0, 50), st.integers(0, 300))
def test_every_change_is_told_in_time_and_messages_stay_apart(gaps: list[float], elsewhere: float, others: int) -> None:
    """Changes are published within the bounds, those that wait together, and two messages are never too close."""
    least, most = bounds(others, least_s=LEAST, most_s=MOST)
    cadence = Cadence(least_s=LEAST, most_s=MOST)
    told: list[float] = []
    now = 0.0

    def tell_until(end: float) -> None:
        """Tell when it is due, as a timer would."""
        due = cadence.due(now, listeners=others, elsewhere=elsewhere)
        if due is not None and due <= end:
            since = cadence.since
            assert since is not None
            assert since + least - 1e-9 <= due <= since + most + 1e-9
            told.append(due)
            cadence.told(due)
            assert cadence.due(due, listeners=others) is None

    for gap in gaps:
        tell_until(now + gap)
        now += gap
        cadence.asked(now)
        cadence.changed(now)
    tell_until(float("inf"))
    assert cadence.since is None
    assert bool(told) == bool(gaps)
    assert all(later - before >= least - 1e-9 for before, later in pairwise(told))


def test_a_quiet_thing_is_told_at_once() -> None:
    """After a long silence a change waits only for what changes with it, however large the fleet."""
    for others in (1, 10, 30):
        cadence = Cadence(least_s=LEAST, most_s=MOST)
        cadence.changed(0.0)
        cadence.told(0.1)
        cadence.changed(100.0)
        assert cadence.due(100.0, listeners=others) == 100.0 + bounds(others, least_s=LEAST, most_s=MOST)[0]


@settings(deadline=None)
@given(st.floats(0.1, 50), st.integers(10, 60))
def test_a_rate_is_learned_and_forgotten(rate: float, seconds: int) -> None:
    """Steady events are counted at about their rate, and after a few memories of silence as none."""
    it = Rate()
    for number in range(int(rate * (seconds + 3 * RATE_MEMORY_S))):
        it.add(number / rate)
    end = int(rate * (seconds + 3 * RATE_MEMORY_S)) / rate
    assert it.read(end) <= rate + 1 / RATE_MEMORY_S
    assert it.read(end) >= rate * 0.8 - 1 / RATE_MEMORY_S
    assert it.read(end + 10 * RATE_MEMORY_S) < 0.01 * rate


@settings(deadline=None)
@given(listeners)
def test_idle_fleets_stay_quiet(others: int) -> None:
    """At rest nobody hears more than ten repetitions a second, and a small fleet repeats every two seconds."""
    again = heartbeat_s(others, 2.0)
    assert others / again <= 10 + 1e-9
    assert again == 2.0 or others > 20
