"""The client of a fleet: whom it asks, and whom next."""

from types import SimpleNamespace
from typing import Any

import pytest

from appliance.client import Endpoint, FleetClient
from appliance.errors import DeadlineError, UnreachableError
from appliance.model import TaskRecord, TaskRequest
from appliance.model.keys import Verb
from appliance.model.roles import Role
from appliance.model.steering import MAX_BY

pytestmark = pytest.mark.anyio


class Wire:
    """A plane on which some gateways say nothing, or are gone."""

    def __init__(self, *, silent: tuple[str, ...] = (), gone: tuple[str, ...] = ()) -> None:
        self.rpc = self
        self.silent = silent
        self.gone = gone
        self.asked: list[tuple[str, str]] = []

        self.ring = SimpleNamespace(owner=lambda _: "gw-1")

    def members(self) -> frozenset[str]:
        """Who is there."""
        return frozenset({"gw-1", "gw-2", "gw-3"} - (set(self.gone) if self.asked else set()))

    async def any_gateway(self, *, avoid: frozenset[str] = frozenset()) -> str:
        """The first that is not to be avoided."""
        return (sorted(self.members() - avoid) or sorted(self.members()))[0]

    async def call(self, gateway: str, verb: Verb[Any, Any], request: Any, *, timeout_s: float | None) -> Any:
        """Answer, or not."""
        del timeout_s
        self.asked.append((gateway, request.id))
        if gateway in self.silent:
            raise DeadlineError(f"{gateway} did not answer {verb.name}")
        if gateway in self.gone:
            raise UnreachableError(f"{gateway} is gone")
        return TaskRecord(id=request.id, instruction=request.instruction)


def client(wire: Any) -> FleetClient:
    """A client on that plane."""
    made = FleetClient(Endpoint(fleet="f", connect=()))
    made._plane = wire
    return made


async def test_a_silent_gateway_is_passed_over() -> None:
    """A task goes to another gateway under the same id when the first is frozen or gone."""
    for wire in (Wire(silent=("gw-1",)), Wire(gone=("gw-1",))):
        record = await client(wire).submit(TaskRequest(instruction="go home"))
        assert [gateway for gateway, _ in wire.asked] == ["gw-1", "gw-2"]
        assert {task for _, task in wire.asked} == {record.id}


async def test_when_all_are_silent_it_is_said() -> None:
    """Each is asked once; then the last one's error is the answer."""
    wire = Wire(silent=("gw-1", "gw-2", "gw-3"))
    with pytest.raises(DeadlineError, match="gw-3"):
        await client(wire).submit(TaskRequest(instruction="go home"))
    assert len(wire.asked) == 3


def test_a_connection_acts_under_another_name_only_without_keys() -> None:
    """With keys the name is the certificate's; the connection itself keeps its own name in any case."""
    ann = FleetClient(Endpoint(fleet="f", connect=()), operator="ann")
    assert ann.acting("mcp:claude").operator == "mcp:claude"
    assert len(ann.acting("x" * 500).operator) == MAX_BY
    assert ann.operator == "ann"
    ann.role = Role.OPERATOR
    assert ann.acting("mcp:claude").operator == "ann"
