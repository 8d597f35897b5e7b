"""Commands that come again since their answer was lost: one task, whatever their unused parameters say."""

import math
from typing import Any

import pytest

from appliance.errors import RefusedError, SwiftbotError
from appliance.robots.mavlink.command_server import REPEAT_S, task_number
from tests.unit.robots.conftest import FakeStore
from tests.unit.robots.test_command_server import ACCEPTED, DENIED, IN_PROGRESS, TEMPORARILY_REJECTED, Fleet

pytestmark = pytest.mark.anyio
UNSET: dict[str, Any] = {f"param{number}": math.nan for number in range(2, 8)}
"""What MAVSDK sends in unused parameters."""


class Timed(Fleet):
    """A fleet whose wall clock the test moves."""

    now = 1_000.0

    def new_desk(self) -> Any:
        """Return a desk with that clock."""
        desk = super().new_desk()
        desk._clock = lambda: self.now
        return desk


@pytest.fixture
def fleet(store: FakeStore) -> Timed:
    """Return a fleet."""
    return Timed(store)


async def test_a_repetition_with_unset_parameters_is_one(fleet: Timed) -> None:
    """NaN is not equal to NaN, and is the same parameter: at work, when answered, and over a restart."""
    fleet.gate.clear()
    fleet.send(param1=1.0, **UNSET)
    fleet.send(param1=1.0, confirmation=1, **UNSET)
    await fleet.answered(2)
    fleet.gate.set()
    await fleet.answered(3)
    fleet.send(param1=1.0, confirmation=2, **UNSET)
    await fleet.answered(4)
    await fleet.desk.close()
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    fleet.send(param1=1.0, confirmation=3, **UNSET)
    await fleet.answered(5)
    (request,) = fleet.submitted
    number = task_number(request.id)
    assert fleet.acks == [(IN_PROGRESS, 0), (IN_PROGRESS, 0), *[(ACCEPTED, number)] * 3]


async def test_a_crash_before_the_answer_with_unset_parameters(fleet: Timed) -> None:
    """What was kept with unset parameters can be read again: the repetition is the very same task."""
    fleet.gate.clear()
    fleet.send(param1=1.0, **UNSET)
    await fleet.answered(1)
    await fleet.desk.close()
    fleet.gate.set()
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    (kept,) = fleet.desk._last.values()
    fleet.send(param1=1.0, confirmation=1, **UNSET)
    await fleet.answered(3)
    assert [each.id for each in fleet.submitted] == [kept.task]


async def test_a_command_int_has_no_confirmation(fleet: Timed) -> None:
    """It is a repetition while its answer may still be lost, also after a restart; later it is another order."""
    order: dict[str, Any] = {"name": "COMMAND_INT", "param1": 1.0, "param2": math.nan, "z": math.nan}
    fleet.gate.clear()
    fleet.send(**order)
    fleet.send(**order)
    other: dict[str, Any] = order | {"param1": 2.0}
    fleet.send(**other)
    await fleet.answered(3)
    assert [result for result, _ in fleet.acks] == [IN_PROGRESS, TEMPORARILY_REJECTED, IN_PROGRESS]
    fleet.gate.set()
    await fleet.answered(4)
    for count in range(3):
        fleet.now += REPEAT_S - 1.0  # each answer may be lost as the one before
        fleet.send(**order)
        await fleet.answered(5 + count)
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    fleet.now -= 2 * (REPEAT_S - 1.0)
    fleet.send(**order)
    await fleet.answered(8)
    assert len(fleet.submitted) == 1
    assert {number for _, number in fleet.acks[3:]} == {task_number(fleet.submitted[0].id)}
    fleet.now += REPEAT_S + 1.0
    fleet.send(**order)
    await fleet.answered(10)
    assert len({each.id for each in fleet.submitted}) == 2


async def test_the_same_command_for_another_vehicle_is_another(fleet: Timed) -> None:
    """So is the same with another argument, however soon, and with the same ones in the other message."""
    orders: tuple[dict[str, Any], ...] = (
        {"name": "COMMAND_INT", "target_system": 1},
        {"name": "COMMAND_INT", "target_system": 2},
        {"name": "COMMAND_INT", "target_system": 2, "x": 1},
        {"name": "COMMAND_LONG", "target_system": 2, "confirmation": 1},
    )
    for number, order in enumerate(orders, start=1):
        fleet.send(param1=1.0, **order)
        await fleet.answered(2 * number)
        assert len(fleet.submitted) == number


async def test_a_refusal_is_repeated_alike(fleet: Timed) -> None:
    """A COMMAND_INT that cannot be is denied again with its reason, and counted once."""
    for _ in range(3):
        fleet.send(name="COMMAND_INT", param1=9.0)
        await fleet.answered(2)
        fleet.now += 0.5
    await fleet.answered(4)
    assert [result for result, _ in fleet.acks] == [IN_PROGRESS, DENIED, DENIED, DENIED]
    assert fleet.refused == {"mavlink_request_denied": 1}


@pytest.mark.parametrize("error", [None, RefusedError("busy")])
async def test_a_repetition_in_the_moment_of_the_answer_is_answered(fleet: Timed, error: SwiftbotError | None) -> None:
    """It crosses the final answer: it hears that one again (or is tried again), and not merely that work goes on."""
    fleet.error = error
    fleet.on_answer.append(lambda: fleet.send(param1=1.0, confirmation=1))
    fleet.send(param1=1.0)
    await fleet.answered(3 if error is None else 4)
    results = [result for result, _ in fleet.acks]
    assert results == ([IN_PROGRESS, ACCEPTED, ACCEPTED] if error is None else [IN_PROGRESS, TEMPORARILY_REJECTED] * 2)
    assert len(fleet.submitted) == (1 if error is None else 0)


async def test_a_cancel_repeated_in_the_moment_of_its_answer_is_answered(fleet: Timed) -> None:
    """USER_2 likewise."""
    fleet.send(param1=1.0)
    await fleet.answered(2)
    fleet.on_answer.append(lambda: fleet.send(command=31011))
    fleet.send(command=31011)
    await fleet.answered(6)
    assert [result for result, _ in fleet.acks[2:]] == [IN_PROGRESS, ACCEPTED] * 2
