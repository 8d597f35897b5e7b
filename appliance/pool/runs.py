"""Runs in progress in this gateway's containers: each gets a container, is sent to it, and ends with one event.

`Conversation` is one run over one connection: the runner's frames become events, the handler's calls are carried out.
It knows nothing of containers: a connection in, the final event out.

`Runs` exists apart from the door (`pool.py`), which chooses and refuses, and from the manager, which knows containers
and no runs: here a run that loses its container, is cancelled or does not end is brought to its end all the same.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any, cast

import structlog
from msgspec import Struct

from appliance.background import Background
from appliance.errors import (
    CancelledByOperatorError,
    ContractError,
    DeadlineError,
    PayloadError,
    PoolError,
    RefusedError,
    RobotError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import Failure, Need, Phase, RunEvent, RunEventKind, RunRequest
from appliance.pool.allocator import FOR_A_RUN, FOR_STATE, IN_TURN
from appliance.pool.container import Connection, Ending, Frame, PooledContainer
from appliance.pool.fair_queue import Turn
from appliance.pool.manager import ContainerManager
from appliance.pool.selection import Decision
from appliance.pool.settings import PoolConfig
from appliance.pool.volumes import State

log = structlog.get_logger(__name__)

NEWS_INTERVAL_S = 0.05
"""A handler may tell its progress, partial results and checkpoints as often as it likes; of more than 20 a second the
newest is passed on."""
FRAMES_PER_S = 2000.0
"""Frames of one run that are read; a handler that sends more waits for its socket, and the event loop for nobody."""
BURST = 4000.0
"""Frames that may come at once."""
MAX_LINES = 2000
"""Log lines of one run that are passed on."""
MAX_FIGURE = 1e12
"""Beyond it a figure of CPU time or memory is none."""
MOST_CALLS = 10**9
"""Beyond it the number of calls before a checkpoint is none."""
MAX_CALLS = 8
"""Calls of one run in progress at once: a handler's threads may each make one."""
ALIVE_S = 2.0
"""How often a run that waits for an answer of the appliance counts as alive: that wait has a deadline of its own."""
_TRANSIENT = (UnreachableError, DeadlineError, RobotError, PoolError)
_LASTING = ContractError
"""Though it is a RobotError: another attempt would wait as long again, for nothing."""


class Call(Struct, frozen=True, kw_only=True):
    """What a handler asks of the appliance; `number` counts its calls from 1, the same in every attempt.

    `name` and `args`: `command` {verb, timeout_s, args}; `command_all` {verb, timeout_s, robots: args by robot};
    `notify` {to, text}; `put_artifact` {name, data: bytes, media_type}; `get_artifact` {ref}. Answers may hold bytes
    anywhere.
    """

    run: RunRequest
    number: int
    name: str
    args: dict[str, Any]


def order(request: RunRequest) -> Frame:
    """Return the frame that starts a run."""
    return {
        "op": "run",
        "run": request.run_id,
        "skill": request.skill,
        "robot": request.robot,
        "others": request.others,
        "params": request.params,
        "inputs": request.inputs,
        "attempt": request.attempt,
        "resume": request.resume,
        "calls": request.calls,
        "timeout_s": request.deadline_s,
        "memory_mb": request.need.memory_mb,
    }


def _number(value: Any) -> float:
    """Return what a handler may have written in a number's place as one; 0 for what is none, or beyond all bounds."""
    try:
        return float(value) if isinstance(value, int | float) else 0.0
    except OverflowError:
        return 0.0


def _table(value: Any) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


_NAMES: dict[type, str] = {dict: "a table", float: "a number", int: "a whole number"}


def _named(value: object) -> str:
    """Return what a value is, in words."""
    match value:
        case None:
            return "nothing"
        case bool():
            return "true or false"
        case int() | float():
            return "a number"
        case str() | bytes():
            return "a text" if isinstance(value, str) else "bytes"
        case list():
            return "a list"
        case dict():
            return "a table"
        case _:
            return f"a {type(value).__name__}"


class Conversation:
    """Listens to one run to its end."""

    def __init__(
        self,
        connection: Connection,
        request: RunRequest,
        *,
        gateway: str,
        container: str,
        phase: Phase,
        entered_ns: int,
        on_event: Callable[[RunEvent], None],
        on_call: Callable[[Call], Awaitable[dict[str, Any]]],
        refused: Counter[str],
        ending: Callable[[], Awaitable[Ending]],
    ) -> None:
        self._connection = connection
        self._ending = ending
        self._request = request
        self._where = {"gateway": gateway, "container": container, "phase": phase}
        self._entered_ns = entered_ns
        self._started_ns = 0
        self._used: dict[str, float] = {}
        """CPU time and memory, as the last frame tells them."""
        self._on_event = on_event
        self._on_call = on_call
        self._refused = refused
        self._calls = Background()
        self._lines = 0
        self._news: dict[RunEventKind, RunEvent] = {}
        self._told: dict[RunEventKind, float] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._allowance = BURST
        self._allowed_at = time.monotonic()
        self.broken = False
        """Whether the runner broke its protocol, so that nothing it may still say can be trusted."""

    def event(self, kind: RunEventKind, **more: Any) -> RunEvent:
        """Return an event of this run."""
        request = self._request
        return RunEvent(
            task=request.task, subtask=request.subtask, attempt=request.attempt, kind=kind, **self._where, **more
        )

    def failed(self, code: str, message: str, *, remedy: str = "", retryable: bool = True) -> RunEvent:
        """Return the final event of a run that did not work."""
        failure = Failure(code=code, message=message, remedy=remedy, retryable=retryable)
        return self.event(RunEventKind.FAILED, failure=failure, duration_ms=self._duration_ms(), **self._used)

    def _duration_ms(self) -> float | None:
        return (time.monotonic_ns() - self._started_ns) / 1e6 if self._started_ns else None

    async def listen(self) -> RunEvent:
        """Pass on what the run tells until it ends; returns its final event, which is not passed on."""
        try:
            while (frame := await self._connection.receive()) is not None:
                final = await self._take(frame)
                if final is not None:
                    return final
                await self._pace()
        except PayloadError as error:
            self._refused["runner frame"] += 1
            self.broken = True
            return self.failed(error.code, error.message, remedy="another container takes its place; see its handler")
        finally:
            self._flush()
            self._calls.cancel()
        ending = await self._ending()
        return self.failed(ending.code, ending.message, remedy=ending.remedy)

    async def _pace(self) -> None:
        """Let a run that floods its gateway wait."""
        self._allowance -= 1.0
        if self._allowance <= 0.0:
            now = time.monotonic()
            self._allowance += min(BURST, (now - self._allowed_at) * FRAMES_PER_S)
            self._allowed_at = now
            if self._allowance <= 0.0:
                self._refused["flood"] += 1
                await asyncio.sleep(NEWS_INTERVAL_S)

    async def gone(self) -> None:
        """Wait until the runner has swept up, which it tells by hanging up."""
        while await self._connection.receive() is not None:
            pass

    async def _take(self, frame: Frame) -> RunEvent | None:
        match frame.get("ev"):
            case "started":
                at_ns, now_ns = int(_number(frame.get("at"))), time.monotonic_ns()
                # One clock for all on this machine; a handler could say anything.
                self._started_ns = at_ns if self._entered_ns <= at_ns <= now_ns else now_ns
                startup_ms = (self._started_ns - self._entered_ns) / 1e6
                self._on_event(self.event(RunEventKind.STARTED, startup_ms=startup_ms))
            case "progress":
                self._progress(frame)
            case "log":
                self._line(frame)
            case "alive":
                self._tell(self.event(RunEventKind.ALIVE))
            case "partial":
                if self._fits("partial result", frame.get("result"), dict):
                    self._tell(self.event(RunEventKind.PARTIAL, result=_table(frame.get("result"))))
            case "checkpoint":
                self._checkpoint(frame)
            case "call":
                await self._call(frame)
            case "result":
                self._note_usage(frame)
                if not isinstance(frame.get("result"), dict):
                    return self._no_result(frame.get("result"))
                return self.event(
                    RunEventKind.SUCCEEDED,
                    result=_table(frame.get("result")),
                    progress=1.0,
                    duration_ms=self._duration_ms(),
                    **self._used,
                )
            case "error":
                return self._error(frame)
            case other:
                raise PayloadError(f"the runner sent an unknown event {str(other)[:40]!r}")
        return None

    def _checkpoint(self, frame: Frame) -> None:
        """Pass a checkpoint on; one without a number of calls is none, since the next attempt counts on from it."""
        calls = frame.get("calls", 0)
        if not self._fits("checkpoint", frame.get("data"), dict) or not self._fits("checkpoint's calls", calls, int):
            return
        if not 0 <= calls <= MOST_CALLS:
            self._refused["run news"] += 1
            self._line({"text": "a checkpoint was left out: its number of calls is out of range"})
            return
        self._tell(self.event(RunEventKind.CHECKPOINT, result=_table(frame.get("data")), calls=calls))

    def _fits(self, what: str, value: object, *kinds: type) -> bool:
        """Whether news is of the type it should be; what is not is counted, left out, and told in the run's lines."""
        if isinstance(value, kinds) and not isinstance(value, bool):
            return True
        self._refused["run news"] += 1
        self._line({"text": f"a {what} was left out: it is {_named(value)}, not {_NAMES[kinds[0]]}"})
        return False

    def _no_result(self, value: object) -> RunEvent:
        """Return the end of a run whose result is no table: what it did is not known."""
        self._refused["result"] += 1
        text = f"the result of {self._request.skill} is {_named(value)}, not a table"
        return self.failed("payload", text, remedy="return a dict from run(ctx)", retryable=False)

    def _progress(self, frame: Frame) -> None:
        if not self._fits("progress", frame.get("fraction", 0.0), float, int):
            return
        fraction, note = _number(frame.get("fraction")), str(frame.get("note", ""))
        self._tell(self.event(RunEventKind.PROGRESS, progress=fraction, note=note))

    def _tell(self, event: RunEvent) -> None:
        """Pass news on, or hold it until its kind may be told again; newer news takes its place."""
        now = time.monotonic()
        due = self._told.get(event.kind, 0.0) + NEWS_INTERVAL_S
        if now >= due and event.kind not in self._news:
            self._told[event.kind] = now
            self._on_event(event)
            return
        self._news[event.kind] = event
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, due - now), self._flush)

    def _flush(self) -> None:
        """Pass on all that is held."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        news, self._news = self._news, {}
        for kind, event in news.items():
            self._told[kind] = time.monotonic()
            self._on_event(event)

    def _line(self, frame: Frame) -> None:
        self._lines += 1
        if self._lines > MAX_LINES:
            self._refused["run output"] += 1
            return
        given = frame.get("fields")
        fields = _table(given)
        if given is not None and not isinstance(given, dict):
            self._refused["run news"] += 1  # its text is passed on without them
        self._on_event(self.event(RunEventKind.LOG, note=str(frame.get("text", "")), result=fields or None))

    def _note_usage(self, frame: Frame) -> None:
        for key in ("cpu_ms", "peak_mb"):
            value = frame.get(key)
            if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < MAX_FIGURE:
                self._used[key] = float(value)

    def _error(self, frame: Frame) -> RunEvent:
        self._note_usage(frame)
        trace = frame.get("trace")
        for line in cast("list[object]", trace) if isinstance(trace, list) else ():
            self._line({"text": str(line)})
        return self.failed(
            str(frame.get("code") or "internal"),
            str(frame.get("message") or "the handler failed and gave no reason"),
            remedy=str(frame.get("remedy", "")),
            retryable=bool(frame.get("retryable", False)),
        )

    async def _call(self, frame: Frame) -> None:
        number = int(_number(frame.get("n")))
        if self._calls.count >= MAX_CALLS:
            self._refused["call"] += 1
            error = {"code": "refused", "message": f"{MAX_CALLS} calls are in progress already", "retryable": True}
            await self._reply({"n": number, "error": error})
            return
        if not isinstance(frame.get("args", {}), dict):
            self._refused["call"] += 1
            text = f"the arguments of {str(frame.get('name'))[:40]!r} are {_named(frame.get('args'))}, not a table"
            await self._reply(self._refusal(number, PayloadError(text), retryable=False))
            return
        call = Call(run=self._request, number=number, name=str(frame.get("name", "")), args=_table(frame.get("args")))
        self._calls.start(self._carry_out(call), f"call {self._request.run_id}/{number}")

    async def _carry_out(self, call: Call) -> None:
        reply: Frame
        try:
            reply = {"n": call.number, "ok": await self._answer(call)}
        except SwiftbotError as error:
            reply = self._refusal(
                call.number, error, retryable=isinstance(error, _TRANSIENT) and not isinstance(error, _LASTING)
            )
        except Exception as error:
            log.exception("call broke", run=call.run.run_id, call=call.name)
            reply = self._refusal(call.number, SwiftbotError(f"{type(error).__name__}: {error}"), retryable=True)
        try:
            await self._reply(reply)
        except PayloadError as error:
            self._refused["call"] += 1
            await self._reply(self._refusal(call.number, error, retryable=False))

    async def _answer(self, call: Call) -> dict[str, Any]:
        """Have a call carried out; until then the run is alive, however little it says."""
        answering = asyncio.ensure_future(self._on_call(call))
        try:
            while not (await asyncio.wait({answering}, timeout=ALIVE_S))[0]:
                self._on_event(self.event(RunEventKind.ALIVE))
            return answering.result()
        finally:
            answering.cancel()

    @staticmethod
    def _refusal(number: int, error: SwiftbotError, *, retryable: bool) -> Frame:
        told = {"code": error.code, "message": error.message, "remedy": error.remedy, "retryable": retryable}
        return {"n": number, "error": told}

    async def _reply(self, frame: Frame) -> None:
        try:
            await self._connection.send(frame)
        except OSError:
            log.info("run ended before its answer came", run=self._request.run_id)


BACKSTOP_S = 3.0
"""How much longer than the runner itself the pool waits for a run to end, before it ends the container."""
ENDING_S = 3.0
"""How long it is waited for Podman to say how a container ended, before its run counts as lost."""
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
        keeper: ContainerManager,
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
        """Use the volumes until the run's end is published, so that what follows elsewhere finds what it left."""
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
                self._keeper.background.start(
                    self._wind_up(container, connection, conversation), f"wind up {container.id}"
                )
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
