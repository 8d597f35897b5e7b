"""A gateway gives all its runs away: before it stops, or because an operator wants it empty.

Runs that have not begun are moved at once, the others with a checkpoint. What cannot be moved (yet) is asked for
again now and then and waited for, with the reason in the status; past the deadline it is cancelled, and its
coordinator repeats it elsewhere.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable

import structlog

from appliance.errors import PayloadError, SwiftbotError
from appliance.tasks.api import RunAsk
from appliance.tasks.executor import Executor, Here
from appliance.tasks.migration.api import DrainAsk, DrainState, DrainStateAsk, Reason, Remaining, UndrainAsk
from appliance.tasks.migration.leaving import Leaving
from appliance.tasks.migration.requesting import Requesting
from appliance.tasks.migration.settings import MigrationConfig

log = structlog.get_logger(__name__)

TICK_S = 0.1
CANCEL_S = 5.0
"""How long runs that are cancelled past the deadline may take to end."""
AGAIN_S = (0.5, 1.0, 2.0, 4.0)
"""Pauses before a run that could not be moved is asked for again; the last one from then on."""
LONGEST_S = 7 * 86_400.0
SHOWN = 3
"""Runs named in the status; all are in the drain's state."""
MOST_WHY = 160


class _Left:
    """A run that is still here."""

    def __init__(self, skill: str) -> None:
        self.skill = skill
        self.why = "about to be moved"
        self.tries = 0
        self.again_at = 0.0


class Draining:
    """Empties this gateway.

    Args:
        gateway: this gateway.
        executor: the runs here; takes none while it drains.
        leaving: which of them may be moved.
        requesting: asks for it.
        config: section `[tasks.migration]`.
        on_change: called when there is something to show.
    """

    def __init__(
        self,
        gateway: str,
        *,
        executor: Executor,
        leaving: Leaving,
        requesting: Requesting,
        config: MigrationConfig,
        on_change: Callable[[], None],
    ) -> None:
        self._gateway = gateway
        self._executor = executor
        self._leaving = leaving
        self._requesting = requesting
        self._at_once = 2 * config.at_once
        self._on_change = on_change
        self._left: dict[str, _Left] = {}
        self._moving: dict[str, asyncio.Task[None]] = {}
        self._working: asyncio.Task[None] | None = None
        self._began = 0.0
        self._deadline_s = 0.0
        self._moved = self._ended = 0
        self._stopping = False

    @property
    def text(self) -> str:
        """How far it is, in a sentence for the status; empty while it does not drain."""
        if not self._executor.draining:
            return ""
        left = [f"{run} ({each.skill}): {each.why}" for run, each in list(self._left.items())[:SHOWN]]
        more = f"; and {len(self._left) - SHOWN} more" if len(self._left) > SHOWN else ""
        done = f"{self._moved} runs moved away, {self._ended} ended here"
        return f"{done}; {len(self._left)} left: {'; '.join(left)}{more}" if self._left else f"{done}; it is empty"

    def state(self) -> DrainState:
        """How far it is."""
        draining = self._executor.draining
        return DrainState(
            gateway=self._gateway,
            draining=draining,
            done=draining and not self._executor.here(),
            moved=self._moved,
            ended=self._ended,
            left=tuple(Remaining(run=run, skill=each.skill, why=each.why) for run, each in self._left.items()),
            elapsed_s=round(time.monotonic() - self._began, 3) if draining else 0.0,
            deadline_s=self._deadline_s,
        )

    # --- verbs ------------------------------------------------------------------------------------------------

    async def drain(self, ask: DrainAsk) -> DrainState:
        """Begin to give all runs away and take no more; answers at once. Asked again it goes by the new deadline.

        Raises:
            PayloadError: a deadline that cannot be.
        """
        if not 0 <= ask.deadline_s <= LONGEST_S:
            raise PayloadError(f"a deadline of {ask.deadline_s:g} s", remedy=f"0 (none) to {LONGEST_S:g}")
        self.begin(ask.deadline_s)
        return self.state()

    async def undrain(self, ask: UndrainAsk) -> DrainState:
        """Take runs again; those being moved just now go all the same."""
        del ask
        if not self._stopping:
            await self._halt()
            self._executor.draining = False
            self._left.clear()
            log.info("gateway takes runs again", gateway=self._gateway)
            self._on_change()
        return self.state()

    async def ask_state(self, ask: DrainStateAsk) -> DrainState:
        """Tell how far it is."""
        del ask
        return self.state()

    # --- draining ---------------------------------------------------------------------------------------------

    def begin(self, deadline_s: float, *, stopping: bool = False) -> None:
        """Begin to drain; `stopping`: for good, since the gateway is about to end."""
        self._stopping = self._stopping or stopping
        if not self._executor.draining or self._working is None:
            self._moved = self._ended = 0
        self._began, self._deadline_s = time.monotonic(), deadline_s
        self._executor.draining = True
        log.info("gateway drains", gateway=self._gateway, runs=self._executor.running, deadline_s=deadline_s)
        if self._working is None or self._working.done():
            self._working = asyncio.create_task(self._work(), name="drain")
        self._on_change()

    async def until_empty(self) -> None:
        """Wait until no run is left, or the deadline has passed and what was left is cancelled."""
        if self._working is not None:
            await asyncio.shield(self._working)

    async def _work(self) -> None:
        while self._executor.here() or self._moving:
            now = time.monotonic()
            if self._deadline_s and now - self._began >= self._deadline_s:
                await self._cancel_rest()
                break
            self._look(now)
            await asyncio.sleep(TICK_S)
        self._look(time.monotonic())
        log.info("gateway is drained", gateway=self._gateway, moved=self._moved, ended=self._ended)
        self._on_change()

    def _look(self, now: float) -> None:
        """Note what has gone, and have moved what is due: first what has not begun."""
        here = self._executor.here()
        for run in [each for each in self._left if each not in here and each not in self._moving]:
            del self._left[run]
            self._ended += 1
            self._on_change()
        due: list[tuple[str, Here]] = []
        for run, each in sorted(here.items(), key=lambda item: (item[1].began, item[1].since)):
            left = self._left.setdefault(run, _Left(each.request.skill))
            if run in self._moving or left.again_at > now:
                continue
            if each.began and self._leaving.mobility(each.request) == "never":
                left.why = "commands a robot and may not be moved: its end is waited for"
            elif not each.request.coordinator:
                left.why = "no coordinator has sent it: its end is waited for"
            else:
                due.append((run, each))
        due = due[: max(0, self._at_once - len(self._moving))]
        if any(not self._left[run].tries for run, _ in due):
            self._requesting.put([each for _, each in due], Reason.DRAIN, f"{self._gateway} drains")
        for run, each in due:
            work = asyncio.create_task(self._move(run, each), name=f"drain {run}")
            self._moving[run] = work
            work.add_done_callback(lambda _, run=run: self._moving.pop(run, None))

    async def _move(self, run: str, here: Here) -> None:
        left = self._left[run]
        left.why = "is being moved"
        try:
            await self._requesting.move(here, Reason.DRAIN, f"{self._gateway} drains")
        except SwiftbotError as error:
            left.why = f"waited for: {error.message}"[:MOST_WHY]
            left.again_at = time.monotonic() + AGAIN_S[min(left.tries, len(AGAIN_S) - 1)]
            left.tries += 1
            log.info("a run stays on a draining gateway for now", run=run, reason=error.message)
        else:
            self._left.pop(run, None)
            self._moved += 1
        self._on_change()

    async def _cancel_rest(self) -> None:
        """The deadline has passed: end what is left; it is repeated elsewhere."""
        for run, each in self._executor.here().items():
            log.warning("a run is cancelled: the drain's deadline has passed", run=run)
            request = each.request
            ask = RunAsk(task=request.task, subtask=request.subtask, attempt=request.attempt)
            with contextlib.suppress(SwiftbotError):
                await self._executor.cancel(ask)
        for _ in range(int(CANCEL_S / TICK_S)):
            if not self._executor.here():
                return
            await asyncio.sleep(TICK_S)

    async def _halt(self) -> None:
        if self._working is not None:
            self._working.cancel()
            await asyncio.gather(self._working, return_exceptions=True)
            self._working = None

    async def close(self) -> None:
        """Stop asking."""
        await self._halt()
        works = list(self._moving.values())
        for work in works:
            work.cancel()
        await asyncio.gather(*works, return_exceptions=True)
