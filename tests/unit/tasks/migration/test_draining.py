# ruff: noqa: ARG002 - fakes take what the real ones take
"""Emptying a gateway: what has not begun goes first, what cannot go is waited for with the reason, to the deadline."""

import asyncio
import time
from typing import Any, cast

import pytest

from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.model import Need, RunRequest
from appliance.model.task_api import DrainAsk, DrainStateAsk, Reason, RunAsk, RunStatus, UndrainAsk
from appliance.tasks.handoff import Here
from appliance.tasks.migration import gateway as module
from appliance.tasks.migration.gateway import Draining
from appliance.tasks.settings import MigrationConfig

pytestmark = pytest.mark.anyio


def here(name: str, *, began: bool = True, coordinator: str = "gw-2", skill: str = "work") -> Here:
    """A run."""
    need = Need(image="base")
    request = RunRequest(task="t-1", subtask=name, attempt=1, skill=skill, need=need, coordinator=coordinator)
    return Here(request, time.monotonic(), began)


class Gateway:
    """An executor, what may leave it, and who moves runs away: all as the test says."""

    def __init__(self, *runs: Here) -> None:
        self.runs = {each.request.run_id: each for each in runs}
        self.draining = False
        self.problems: dict[str, list[SwiftbotError]] = {}
        self.order: list[str] = []
        self.put_for: list[int] = []
        self.cancelled: list[str] = []
        self.it = Draining(
            "gw-1",
            executor=cast("Any", self),
            source=cast("Any", self),
            requesting=cast("Any", self),
            config=MigrationConfig(),
            on_change=lambda: None,
        )

    @property
    def running(self) -> int:
        """How many."""
        return len(self.runs)

    def here(self) -> dict[str, Here]:
        """The runs."""
        return dict(self.runs)

    def mobility(self, request: RunRequest) -> str:
        """A skill called `fly` commands a robot."""
        return "never" if request.skill == "fly" else "anytime"

    def put(self, runs: list[Here], reason: Reason, why: str) -> None:
        """The request."""
        assert reason is Reason.DRAIN
        self.put_for.append(len(runs))

    async def move(self, run: Here, reason: Reason, why: str) -> None:
        """Move it, or say why not."""
        name = run.request.subtask
        self.order.append(name)
        await asyncio.sleep(0)
        if problems := self.problems.get(name):
            raise problems.pop(0)
        del self.runs[run.request.run_id]

    async def cancel(self, ask: RunAsk) -> RunStatus:
        """End it."""
        self.cancelled.append(ask.subtask)
        del self.runs[ask.run_id]
        return RunStatus(running=False)

    async def empty(self) -> None:
        """Wait until it is."""
        async with asyncio.timeout(60):
            await self.it.until_empty()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short pauses."""
    monkeypatch.setattr(module, "TICK_S", 0.005)
    monkeypatch.setattr(module, "AGAIN_S", (0.01,))


async def test_runs_that_have_not_begun_go_first_and_all_are_gone_then() -> None:
    """The request names them, the state counts them, and the sentence for people says that it is empty."""
    gateway = Gateway(here("s1"), here("s2"), here("s3", began=False))
    state = await gateway.it.drain(DrainAsk())
    assert (state.draining, state.done, gateway.draining) == (True, False, True)
    await gateway.empty()
    assert gateway.order[0] == "s3"
    state = await gateway.it.ask_state(DrainStateAsk())
    assert (state.done, state.moved, state.ended, state.left) == (True, 3, 0, ())
    assert "it is empty" in gateway.it.text
    assert gateway.put_for == [3]


async def test_what_cannot_be_moved_yet_is_asked_for_again() -> None:
    """With the reason meanwhile, and the request is put once."""
    gateway = Gateway(here("s1"))
    gateway.problems["s1"] = [RefusedError("no gateway takes s1: gw-2: it drains") for _ in range(3)]
    await gateway.it.drain(DrainAsk())
    async with asyncio.timeout(60):
        while "no gateway takes s1" not in gateway.it.text:
            await asyncio.sleep(0.001)
    await gateway.empty()
    assert gateway.order == ["s1"] * 4
    assert gateway.put_for == [1]
    assert gateway.it.state().moved == 1


async def test_a_run_that_may_not_move_is_waited_for() -> None:
    """It is not even asked for; its end is counted."""
    gateway = Gateway(here("s1", skill="fly"), here("s2", coordinator=""))
    await gateway.it.drain(DrainAsk())
    await asyncio.sleep(0.05)
    assert not gateway.order
    reasons = {each.run: each.why for each in gateway.it.state().left}
    assert "may not be moved" in reasons["t-1/s1/1"]
    assert "no coordinator" in reasons["t-1/s2/1"]
    gateway.runs.clear()
    await gateway.empty()
    assert gateway.it.state().ended == 2


async def test_past_the_deadline_what_is_left_is_cancelled() -> None:
    """Its coordinator repeats it elsewhere."""
    gateway = Gateway(here("s1", skill="fly"))
    await gateway.it.drain(DrainAsk(deadline_s=0.05))
    await gateway.empty()
    assert gateway.cancelled == ["s1"]
    with pytest.raises(PayloadError):
        await gateway.it.drain(DrainAsk(deadline_s=-1.0))


async def test_undrained_it_takes_runs_again_unless_it_is_about_to_stop() -> None:
    """Those that are left stay."""
    gateway = Gateway(here("s1", skill="fly"))
    await gateway.it.drain(DrainAsk())
    state = await gateway.it.undrain(UndrainAsk())
    assert (state.draining, gateway.draining, gateway.it.text) == (False, False, "")
    assert gateway.runs
    gateway.it.begin(5.0, stopping=True)
    assert (await gateway.it.undrain(UndrainAsk())).draining
    await gateway.it.close()
