"""What the bad wire does to frames, and which faults come when."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError
from workshop.bench.net.faults import CLEAN, FAULTS, Rule, due_s, phases

NAMES = ("gw-1", "gw-2", "gw-3", "gw-4", "gw-5")


@given(seed=st.integers(0, 1000), delay=st.floats(0, 500), jitter=st.floats(0, 100))
def test_frames_are_due_within_their_bounds(seed: int, delay: float, jitter: float) -> None:
    """A frame is never due before now, and at most delay plus jitter later."""
    due = due_s(Rule(delay_ms=delay, jitter_ms=jitter), 10.0, random.Random(seed))  # noqa: S311 - a simulation
    assert due is not None
    assert 10.0 <= due <= 10.0 + (delay + jitter) / 1e3 + 1e-9


def test_shares_are_those_of_the_rule() -> None:
    """Of many frames as many are lost, or sent at once, as the rule says; a cut passes none, a clean wire all."""
    generator = random.Random(1)  # noqa: S311 - a simulation
    lost = sum(due_s(Rule(loss=0.05), 0.0, generator) is None for _ in range(20_000))
    assert 800 < lost < 1200
    at_once = sum(due_s(Rule(delay_ms=20, reorder=0.25), 0.0, generator) == 0.0 for _ in range(20_000))
    assert 4600 < at_once < 5400
    assert due_s(Rule(cut=True), 0.0, generator) is None
    assert due_s(CLEAN, 1.0, generator) == 1.0


@given(seed=st.integers(0, 1000))
def test_faults_come_one_after_the_other(seed: int) -> None:
    """Each named fault once, with rests; a partition cuts exactly the two sides, a one-way cut one sender."""
    found = phases(FAULTS, NAMES, fault_s=5.0, rest_s=2.0, seed=seed)
    assert [each.name for each in found] == list(FAULTS)
    assert [each.at_s for each in found] == [2.0, 9.0, 16.0, 23.0, 30.0]
    assert len(found[3].table) == 1
    one, other = found[4].sides
    assert sorted((*one, *other)) == list(NAMES)
    for sender, receivers in found[4].table.items():
        assert set(receivers) == set(other if sender in one else one)
        assert all(rule.cut for rule in receivers.values())


def test_an_unknown_fault_is_named() -> None:
    """It is refused with those that there are."""
    with pytest.raises(ConfigError, match="no fault 'gremlins'"):
        phases(["gremlins"], NAMES, fault_s=1.0, rest_s=1.0, seed=1)
