# ruff: noqa: ARG002 - fakes take what the real ones take
"""A pool in memory: selections and runs end as the test says."""

import asyncio
from collections.abc import Callable, Mapping

from appliance.model import Need, Phase, RunEvent, RunEventKind, RunRequest
from appliance.pool.allocator import WithdrawnError
from appliance.pool.fair_queue import Turn
from appliance.pool.selection import Decision
from tests.unit.tasks.sample_records import event


class FakePool:
    """Selects at once or when `gate` opens; runs end when the test says how."""

    def __init__(self) -> None:
        self.decision = Decision(phase=Phase.LOCAL_WARM, gateway="gw-1", container="c1", why="warm")
        self.decisions: list[Decision] = []
        self.gate: asyncio.Event | None = None
        self.asked: list[tuple[bool, dict[str, int], dict[str, str]]] = []
        self.cancelled: list[str] = []
        self.tells: dict[str, Callable[[RunEvent], None]] = {}
        self.runs: dict[str, asyncio.Future[RunEvent]] = {}
        self.line: list[tuple[Turn, Need]] = []
        self.full = False
        self.room = True
        self.federated = True

    async def select(
        self,
        need: Need,
        *,
        allow_remote: bool,
        inputs: Mapping[str, int],
        avoid: Mapping[str, str] | None = None,
        turn: Turn | None = None,
    ) -> Decision:
        """Return the prepared decision."""
        self.asked.append((allow_remote, dict(inputs), dict(avoid or {})))
        if self.gate is not None:
            await self.gate.wait()
        return self.decisions.pop(0) if self.decisions else self.decision

    def keep(self, decision: Decision, lease_s: float) -> bool:
        """Hold it."""
        return True

    def waiting(self) -> list[tuple[Turn, Need]]:
        """Return those whom the test has wait."""
        return self.line

    @property
    def queue(self) -> int:
        """How many wait."""
        return len(self.line)

    def withdraw(self, run_id: str) -> bool:
        """Take a run out of the line."""
        before = len(self.line)
        self.line = [each for each in self.line if each[0].id != run_id]
        if len(self.line) == before:
            return False
        self.runs[run_id].set_exception(WithdrawnError("withdrawn"))
        return True

    def expected_s(self, position: int) -> float | None:
        """Return a second for each place."""
        return float(position)

    def cold_ms(self, image: str) -> float:
        """Return what a cold start takes."""
        return 500.0

    def has_room(self, need: Need) -> bool:
        """Return what the test says."""
        return self.room

    async def run(
        self,
        request: RunRequest,
        decision: Decision,
        on_event: Callable[[RunEvent], None],
        *,
        turn: Turn | None = None,
    ) -> RunEvent:
        """Wait for the test."""
        if self.full and turn is not None:
            self.runs[request.run_id] = asyncio.get_running_loop().create_future()
            self.line.append((turn, request.need))
            return await self.runs[request.run_id]
        self.tells[request.run_id] = on_event
        future = self.runs[request.run_id] = asyncio.get_running_loop().create_future()
        on_event(event(request, RunEventKind.STARTED, startup_ms=1.0))
        return await future

    async def cancel(self, run_id: str) -> bool:
        """Remember."""
        self.cancelled.append(run_id)
        return True
