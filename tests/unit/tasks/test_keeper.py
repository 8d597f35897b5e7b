"""What a driver knows must be written before its gateway goes."""

from types import SimpleNamespace
from typing import cast

from appliance.model import Plan, Subtask
from appliance.plane.node import Plane
from appliance.tasks import machine
from appliance.tasks.keeper import Keeper
from appliance.tasks.machine import Transition, TransitionKind


def test_a_run_of_this_gateway_unsettles_until_its_end_is_written() -> None:
    """Unwritten transitions and runs here are awaited; runs elsewhere are not."""
    plan = Plan(domain="navigation", subtasks=(Subtask(id="s1", skill="hold", robot="rover_1"),))
    record = None
    steps: list[tuple[TransitionKind, dict[str, object]]] = [
        (TransitionKind.ACCEPTED, {"instruction": "x"}),
        (TransitionKind.PLANNED, {"plan": plan}),
        (TransitionKind.DISPATCHED, {"subtask": "s1", "attempt": 1, "gateway": "gw-1"}),
    ]
    for number, (kind, fields) in enumerate(steps, start=1):
        event = Transition(task="t", sequence=number, kind=kind, at_ns=1, coordinator="gw-1", **fields)  # type: ignore[arg-type]
        record = machine.apply(record, event)
    assert record is not None
    for gateway, settled in (("gw-1", False), ("gw-2", True)):
        keeper = Keeper(cast("Plane", SimpleNamespace(gateway=gateway)), record, {}, lambda _: None)
        assert keeper.settled is settled
        end = Transition(
            task="t", sequence=4, kind=TransitionKind.SUCCEEDED, at_ns=2, coordinator=gateway, subtask="s1", attempt=1
        )
        assert keeper.take(end)
        assert not keeper.settled
