"""The runs in progress in this gateway's containers: each gets a container, is sent to it, and ends with one event.

It exists apart from the door (`pool.py`), which chooses and refuses, and from the keeper, which knows containers and
no runs: here a run that loses its container, is cancelled or does not end is brought to its end all the same.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

from appliance.errors import CancelledByOperatorError, PoolError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import Failure, Need, Phase, RunEvent, RunEventKind, RunRequest
from appliance.pool.books import FOR_A_RUN, FOR_STATE, IN_TURN
from appliance.pool.container import Connection, PooledContainer
from appliance.pool.conversation import Call, Conversation, order
from appliance.pool.keeper import Keeper
from appliance.pool.selection import Decision
from appliance.pool.settings import PoolConfig
from appliance.pool.state import State
from appliance.pool.turns import Turn

BACKSTOP_S = 3.0
"""How much longer than the runner itself the pool waits for a run to end, before it ends the container."""
ENDING_S = 3.0
"""How long it is waited for Podman to say how a container ended, before its run is told as lost."""
TRIES = 3
"""Containers that may be found dead at the moment a run is sent to them, before the run is given back."""


class _Run:
    """A run in progress here."""

    def __init__(self, turn: Turn) -> None:
        self.turn = turn
        self.cancelled = False
        self.acquiring: asyncio.Task[PooledContainer] | None = None
        self.container: PooledContainer | None = None
        self.patience: asyncio.Timeout | None = None
        self.began = 0.0


class Runs:
    """Carries runs out in the keeper's containers."""

    def __init__(
        self,
        config: PoolConfig,
        keeper: Keeper,
        *,
        gateway: str,
        on_call: Callable[[Call], Awaitable[dict[str, Any]]],
        state: State,
        refused: Counter[str],
    ) -> None:
        self._config = config
        self._state = state
        self._keeper = keeper
        self._gateway = gateway
        self._on_call = on_call
        self._refused = refused
        self._runs: dict[str, _Run] = {}
        self._idle = asyncio.Event()
        self._idle.set()

    @property
    def patience_s(self) -> float:
        """How long a run that was told to end may take to."""
        return self._config.cancel_grace_s + 2 * BACKSTOP_S

    async def run(
        self, request: RunRequest, decision: Decision, on_event: Callable[[RunEvent], None], turn: Turn
    ) -> RunEvent:
        """Carry out one attempt to its end; see `Pool.run`."""
        entered_ns = time.monotonic_ns()
        if request.run_id in self._runs:
            raise RefusedError(f"run {request.run_id} is in progress here")
        run = self._runs[request.run_id] = _Run(turn)
        self._idle.clear()
        self._keeper.planning.arrived(request.need.image)
        try:
            async with contextlib.AsyncExitStack() as stack:
                container, connection, phase = await self._place(request, decision, run, stack)
                conversation = Conversation(
                    connection,
                    request,
                    gateway=self._gateway,
                    container=container.id,
                    phase=phase,
                    entered_ns=entered_ns,
                    on_event=on_event,
                    on_call=self._on_call,
                    refused=self._refused,
                    ending=lambda: container.ending(ENDING_S),
                )
                return await self._listen(request, run, container, connection, conversation)
        except CancelledByOperatorError as error:
            return RunEvent(
                task=request.task,
                subtask=request.subtask,
                attempt=request.attempt,
                kind=RunEventKind.FAILED,
                gateway=self._gateway,
                failure=Failure(code=error.code, message=error.message),
            )
        finally:
            del self._runs[request.run_id]
            if not self._runs:
                self._idle.set()
            held_s = time.monotonic() - run.began if run.container is not None else 0.0
            self._keeper.planning.ended(request.need.image, held_s)

    async def _place(
        self, request: RunRequest, decision: Decision, run: _Run, stack: contextlib.AsyncExitStack
    ) -> tuple[PooledContainer, Connection, Phase]:
        """Get a container and send the run to it; one that turns out to be dead is replaced by another.

        What the run has beyond its container, the use of its volumes, is put on `stack`.
        """
        keeper, need = self._keeper, request.need
        for _ in range(TRIES):
            container = keeper.books.claim(
                need, container_id=decision.container or "", reservation=decision.reservation
            )
            if container is None or need.volumes:
                container = await self._prepare(request, container, run)
                if container.reservation not in (FOR_A_RUN, FOR_STATE, IN_TURN):
                    continue  # its lease ran out while the gateway stood still
                await self._use(need, container, stack)
            phase = Phase.COLD if container.reservation == FOR_A_RUN else Phase.LOCAL_WARM
            run.container = container
            run.began = time.monotonic()
            keeper.taken(container, request.run_id)
            try:
                return container, await container.begin(order(request)), phase
            except UnreachableError:
                keeper.retire(container, "it was found dead")  # nothing has run
            except SwiftbotError:
                keeper.books.ready(container)
                raise
            except asyncio.CancelledError:
                keeper.retire(container, "its run was given up while it was sent")
                raise
        raise PoolError(f"{TRIES} containers in a row were found dead", remedy="see the gateway's log")

    async def _prepare(self, request: RunRequest, claimed: PooledContainer | None, run: _Run) -> PooledContainer:
        """Wait for a container and for the newest state of the volumes; an operator may cancel that."""
        run.acquiring = asyncio.create_task(
            self._have(request.need, claimed, run.turn), name=f"prepare {request.run_id}"
        )
        try:
            return await run.acquiring
        except asyncio.CancelledError:
            acquiring = run.acquiring
            if acquiring.done() and not acquiring.cancelled() and acquiring.exception() is None:
                self._keeper.books.give_back(acquiring.result())  # it came at the very moment
            acquiring.cancel()
            if not run.cancelled:
                raise
            raise CancelledByOperatorError(f"{request.run_id} was cancelled before it began") from None

    async def _have(self, need: Need, claimed: PooledContainer | None, turn: Turn) -> PooledContainer:
        if not need.volumes:
            return claimed or await self._keeper.acquire(need, turn)
        if claimed is not None:
            self._keeper.books.keep(claimed)
        # State comes while the container starts; both may take seconds.
        bringing = asyncio.ensure_future(self._state.bring(need.volumes))
        try:
            container = claimed = claimed or await self._keeper.acquire(need, turn)
            self._keeper.books.keep(container)
            await bringing
        except BaseException:
            bringing.cancel()
            await asyncio.gather(bringing, return_exceptions=True)
            if claimed is not None:
                self._keeper.books.give_back(claimed)
            raise
        return container

    async def _use(self, need: Need, container: PooledContainer, stack: contextlib.AsyncExitStack) -> None:
        """Use the volumes from now until the run's end is told, so that what follows elsewhere finds what it left."""
        if need.volumes:
            await stack.aclose()  # of an earlier try
            try:
                await stack.enter_async_context(self._state.use(need.volumes))
            except BaseException:
                self._keeper.books.give_back(container)
                raise

    async def _listen(
        self,
        request: RunRequest,
        run: _Run,
        container: PooledContainer,
        connection: Connection,
        conversation: Conversation,
    ) -> RunEvent:
        ended = False
        try:
            if run.cancelled:
                await self.cancel(request.run_id)
            limit_s = request.deadline_s + self._config.cancel_grace_s + BACKSTOP_S
            async with asyncio.timeout(limit_s) as run.patience:
                final = await conversation.listen()
                ended = not conversation.broken
                return final
        except TimeoutError:
            return self._given_up(request, run, conversation)
        finally:
            if ended and request.need.volumes:
                # What it left running may still write: swept first, so that what is noted of its state is the end.
                await self._wind_up(container, connection, conversation)
            elif ended:
                self._keeper.spawn(self._wind_up(container, connection, conversation), f"wind up {container.id}")
            else:
                connection.close()
                self._keeper.retire(container, "its run did not end as it should")

    def _given_up(self, request: RunRequest, run: _Run, conversation: Conversation) -> RunEvent:
        """Return the end of a run whose runner does not end it: the pool ends its container."""
        grace_s = self._config.cancel_grace_s + BACKSTOP_S
        if run.cancelled:
            text = f"the handler did not answer for {grace_s:g} s after the cancel; the watchdog ended its container"
            return conversation.failed("cancelled", text, retryable=False)
        silent_s = request.deadline_s + grace_s
        text = (
            f"the handler did not answer for {silent_s:g} s (it was given {request.deadline_s:g} s, and its runner did "
            "not end it either); the watchdog ended its container"
        )
        remedy = "raise timeout_s in its skill.toml, or find out what stopped or starved its processes"
        return conversation.failed("deadline", text, remedy=remedy)

    async def _wind_up(self, container: PooledContainer, connection: Connection, conversation: Conversation) -> None:
        """After a run: wait until the runner has swept up, then give the container to the next."""
        try:
            async with asyncio.timeout(self._config.cancel_grace_s + BACKSTOP_S):
                await conversation.gone()
            await container.refill()
        except (TimeoutError, SwiftbotError) as error:
            self._keeper.retire(container, f"did not come back from its run: {error}")
        else:
            self._keeper.ran(container)
        finally:
            connection.close()

    async def save(self, run_id: str) -> bool:
        """Ask a run's handler for a checkpoint; False when there is no such run in a container, or it is deaf."""
        run = self._runs.get(run_id)
        if run is None or run.container is None or run.cancelled:
            return False
        try:
            return await run.container.save(run_id)
        except SwiftbotError:
            return False

    async def cancel(self, run_id: str) -> bool:
        """Ask a run to end; its last event follows from `run`. False when there is none of that id."""
        run = self._runs.get(run_id)
        if run is None:
            return False
        run.cancelled = True
        if run.container is None:
            if run.acquiring is not None:
                run.acquiring.cancel()
            return True
        grace_s = self._config.cancel_grace_s
        with contextlib.suppress(SwiftbotError):  # dead, or deaf: the backstop ends it
            await run.container.cancel(run_id, reason="cancelled", grace_s=grace_s)
        if run.patience is not None and not run.patience.expired():
            with contextlib.suppress(RuntimeError):  # it has ended meanwhile
                run.patience.reschedule(asyncio.get_running_loop().time() + grace_s + BACKSTOP_S)
        return True

    async def drain(self, deadline_s: float) -> None:
        """Wait for the runs in progress; what is left after `deadline_s` is cancelled."""
        for wait_s in (deadline_s, self.patience_s):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._idle.wait()
            for run_id in list(self._runs):
                await self.cancel(run_id)
