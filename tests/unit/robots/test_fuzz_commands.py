"""Commands with any numbers and any repetitions: never two effects, and always an answer."""

import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import Struct

from appliance.robots.mavlink.command_server import REPEAT_S
from tests.unit.robots.conftest import FakeStore
from tests.unit.robots.test_command_server import ACCEPTED, DENIED, IN_PROGRESS
from tests.unit.robots.test_repetitions import Timed

pytestmark = pytest.mark.anyio


class Order(Struct, frozen=True):
    """What a station wants: by which message, for which system, with which numbers."""

    whole: bool
    system: int
    numbers: tuple[float, ...]
    x: int = 0

    def fields(self, confirmation: int) -> dict[str, Any]:
        """Return the fields of its message."""
        common: dict[str, Any] = {f"param{place}": value for place, value in enumerate(self.numbers[:4], start=1)}
        common["target_system"] = self.system
        if self.whole:
            return common | {"name": "COMMAND_INT", "x": self.x, "y": self.x, "z": self.numbers[6]}
        rest = {f"param{place}": value for place, value in enumerate(self.numbers[4:], start=5)}
        return common | rest | {"confirmation": confirmation}

    def key(self) -> tuple[bool, int, bytes, int]:
        """Return what distinguishes it from others: its bytes, NaN included."""
        used = (*self.numbers[:4], self.numbers[6]) if self.whole else self.numbers
        return (self.whole, self.system, struct.pack(f"<{len(used)}f", *used), self.x if self.whole else 0)


def _single(bits: int) -> float:
    return float(struct.unpack("<f", struct.pack("<I", bits))[0])


numbers = st.one_of(
    st.sampled_from([math.nan, -math.nan, math.inf, -math.inf, 0.0, -0.0, 1.0, 2.0, 3.4e38, -3.4e38, 1e-45, 2.0**31]),
    st.integers(0, 2**32 - 1).map(_single),
)
"""Quiet and signalling NaN of any payload, infinities, what no template and no whole number can be."""
templates = st.one_of(st.sampled_from([1.0, 2.0, 99.0]), numbers)
orders = st.builds(
    Order,
    st.booleans(),
    st.sampled_from([1, 2, 242]),
    st.tuples(templates, *([numbers] * 6)),
    st.sampled_from([0, 1, -(2**31), 2**31 - 1]),
)
steps = st.tuples(st.integers(0, 3), st.integers(0, 255), st.sampled_from([0.0, 0.5, REPEAT_S - 0.5, REPEAT_S + 1.0]))


@settings(max_examples=60)
@given(st.lists(orders, min_size=1, max_size=4), st.lists(steps, min_size=1, max_size=25))
async def test_no_repetition_has_two_effects(wanted: list[Order], steps: list[tuple[int, int, float]]) -> None:
    """One task for each order, however often it comes, by whatever message and with whatever numbers; one end each."""
    fleet = Timed(FakeStore())
    last: tuple[Any, float] | None = None
    answered = begun = 0
    for which, confirmation, pause in steps:
        order = wanted[which % len(wanted)]
        fleet.now += pause
        again = (
            last is not None
            and last[0] == order.key()
            and (fleet.now - last[1] <= REPEAT_S if order.whole else confirmation > 0)
        )
        fleet.send(robot="drone_1" if order.system != 242 else "", **order.fields(confirmation))
        answered += 1 if again else 2
        begun += not again
        await fleet.answered(answered)
        assert len(fleet.acks) == answered
        last = (order.key(), fleet.now)
    results = [result for result, _ in fleet.acks]
    assert set(results) <= {IN_PROGRESS, ACCEPTED, DENIED}
    assert results.count(IN_PROGRESS) == begun
    assert len(fleet.submitted) <= begun
    assert len({each.id for each in fleet.submitted}) == len(fleet.submitted)
    named = {number for result, number in fleet.acks if result == ACCEPTED}
    assert len(named) == len(fleet.submitted)
    assert all("nan" not in each.instruction and "inf" not in each.instruction for each in fleet.submitted)


@settings(max_examples=30)
@given(orders, st.lists(st.integers(0, 255), min_size=1, max_size=12))
async def test_a_burst_of_repetitions_is_one(order: Order, confirmations: list[int]) -> None:
    """All of it comes while the first is still being handed in: each is answered, and one has an effect."""
    fleet = Timed(FakeStore())
    fleet.gate.clear()
    for confirmation in confirmations:
        fleet.send(**order.fields(confirmation))
    fleet.gate.set()
    await fleet.answered(len(confirmations) + 1)
    results = [result for result, _ in fleet.acks]
    assert sorted(results) == sorted([IN_PROGRESS] * len(confirmations) + [results[-1]])
    assert results[-1] in (ACCEPTED, DENIED)
    assert len(fleet.submitted) == (results[-1] == ACCEPTED)
