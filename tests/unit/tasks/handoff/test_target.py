# ruff: noqa: ARG002 - fakes take what the real ones take
"""A run that comes: a container is held for it, or the reason why not is given."""

from typing import Any, cast

import pytest
from msgspec.structs import replace

from appliance.errors import RefusedError
from appliance.model import Need, Phase, RunRequest
from appliance.model.pool_api import WarmAsk, Warmed
from appliance.model.task_api import RunAsk, RunStatus
from appliance.pool.selection import Decision
from appliance.tasks.handoff import Reservations, Target
from appliance.tasks.settings import MigrationConfig

pytestmark = pytest.mark.anyio

REQUEST = RunRequest(task="t-1", subtask="s1", attempt=2, skill="work", need=Need(image="base"))
WARM = Decision(phase=Phase.LOCAL_WARM, gateway="gw-2", container="c1", reservation="r1")
COLD = Decision(phase=Phase.COLD, gateway="gw-2")


class Gateway:
    """A pool that decides as the test says, and an executor that may refuse."""

    def __init__(self, *decisions: Decision, **settings: Any) -> None:
        self.decisions = list(decisions)
        self.warmed: list[WarmAsk] = []
        self.released: list[Decision] = []
        self.problem = ""
        self.overload = ""
        self.reservations = Reservations("gw-2", cast("Any", self))
        self.target = Target(
            "gw-2",
            cast("Any", self),
            reservations=self.reservations,
            warm=self.warm,
            config=MigrationConfig(**settings),
            refuses=lambda: self.overload,
            on_taken=lambda: None,
        )

    async def select(self, need: Need, *, allow_remote: bool, inputs: Any, turn: Any) -> Decision:
        """Decide."""
        assert not allow_remote
        return self.decisions.pop(0)

    def keep(self, decision: Decision, lease_s: float) -> bool:
        """Hold it."""
        return True

    def release(self, decision: Decision) -> None:
        """Let go."""
        self.released.append(decision)

    def check(self, request: RunRequest) -> None:
        """Refuse."""
        if self.problem:
            raise RefusedError(self.problem)

    async def status(self, ask: RunAsk) -> RunStatus:
        """Nothing runs."""
        return RunStatus(running=False)

    async def warm(self, ask: WarmAsk) -> Warmed:
        """Start one."""
        self.warmed.append(ask)
        return Warmed(image=ask.image, ready=1, starting=0)


async def test_a_ready_container_is_held_for_the_very_attempt_once() -> None:
    """An order of another attempt does not get it, and a second order of this one has to look for its own."""
    gateway = Gateway(WARM)
    assert (await gateway.target.reserve(REQUEST)).container == "c1"
    assert gateway.reservations.take(replace(REQUEST, attempt=3)) is None
    assert gateway.reservations.take(REQUEST) == WARM
    assert gateway.reservations.take(REQUEST) is None


async def test_one_is_started_where_none_is_ready() -> None:
    """Before the run is ended where it is."""
    gateway = Gateway(COLD, WARM)
    assert (await gateway.target.reserve(REQUEST)).container == "c1"
    assert [each.image for each in gateway.warmed] == ["base"]
    with pytest.raises(RefusedError, match="no ready container"):
        await Gateway(COLD, COLD).target.reserve(REQUEST)


async def test_what_does_not_come_is_let_go_of() -> None:
    """And the container is anybody's again."""
    gateway = Gateway(WARM)
    await gateway.target.reserve(REQUEST)
    await gateway.target.unreserve(RunAsk(task="t-1", subtask="s1", attempt=2))
    assert gateway.released == [WARM]
    assert gateway.reservations.take(REQUEST) is None


async def test_a_gateway_that_drains_is_overloaded_or_has_taken_enough_refuses() -> None:
    """With the reason, and nothing is held."""
    gateway = Gateway(*[WARM] * 9, moves_per_s=1.0)
    gateway.problem = "gw-2 is draining"
    with pytest.raises(RefusedError, match="draining"):
        await gateway.target.reserve(REQUEST)
    gateway.problem = ""
    gateway.overload = "3 runs wait for a container"
    with pytest.raises(RefusedError, match="takes no runs: 3 runs wait"):
        await gateway.target.reserve(REQUEST)
    gateway.overload = ""
    for number in (1, 2):
        await gateway.target.reserve(replace(REQUEST, subtask=f"s{number}"))
    with pytest.raises(RefusedError, match="as many runs as it may"):
        await gateway.target.reserve(replace(REQUEST, subtask="s3"))
