"""The local tier: keeps the model's process alive and puts instructions to it, one at a time.

The process loads in the background, so that a gateway is up before its model is; it is started again with growing
pauses when it dies, and each instruction in the meantime is told why there is no answer. An instruction given up by
the cascade leaves an answer on the way; answers carry the number of their request, and late ones are dropped.
"""

import asyncio
import contextlib
import itertools
import os
import signal
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import msgspec
import structlog

from appliance.errors import PlanError, PrerequisiteError, SwiftbotError, UnreachableError, from_code
from appliance.llm import frames
from appliance.llm.language.codec import read
from appliance.llm.language.guide import shapes
from appliance.llm.language.words import words_of
from appliance.llm.prompt import messages
from appliance.llm.schema import plan_grammar, read_plan, robot_names
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.llm.speaking import Question, Said
from appliance.llm.tier import Proposal
from appliance.model import Plan, Tier
from appliance.skills.catalogue import Catalogue

log = structlog.get_logger(__name__)

_PAUSES_S = (0.2, 1.0, 5.0, 15.0, 60.0)
"""Between restarts: quick after one crash, slow where the cause stays."""
_STEADY_S = 60.0
"""A process that lived this long counts as recovered."""
_STOP_S = 3.0
_NO_PLAN = {
    "chatter": "it holds no order",
    "question": "it asks what no robot can find out",
    "impossible": "no skill does what it asks for",
    "unclear": "it does not say what to do, or with what",
    "language": "only English is understood",
}


class LocalTier:
    """Plans by a model folder on this machine."""

    name = Tier.LOCAL

    def __init__(self, config: LlmConfig, catalogue: Catalogue) -> None:
        self._config = config
        self._catalogue = catalogue
        self._process: asyncio.subprocess.Process | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._ready = asyncio.Event()
        self._settled = asyncio.Event()
        """Set while there is either a ready process or a reason why not."""
        self._turn = asyncio.Lock()
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._said: deque[str] = deque(maxlen=20)
        self.problem: SwiftbotError | None = None
        """Why there is no model just now."""
        self.restarts = 0
        """Times the process was started again."""
        self._speaks = False
        """Whether the model writes the plan language (`language`); any other is asked for JSON under a grammar."""
        self._shapes = shapes(catalogue)

    @property
    def repairs(self) -> bool:
        """Whether asking again with what is wrong can help: a model of the plan language would say the same again."""
        return not self._speaks

    @property
    def pid(self) -> int | None:
        """Process id of the model's process, while it is ready."""
        return self._process.pid if self._process is not None and self._ready.is_set() else None

    async def start(self) -> None:
        """Begin to load the model in the background.

        Raises:
            PrerequisiteError: the folder is not there or cannot be a model; it is tried again later all the same.
        """
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep(), name="local model")
        folder = Path(self._config.local_model)
        if not (folder / "genai_config.json").is_file():
            raise PrerequisiteError(
                f"{folder} is no model folder (genai_config.json is missing)",
                remedy="set llm.local_model to an onnxruntime-genai folder, or leave it empty",
            )

    async def close(self) -> None:
        """End the process and its keeper."""
        if self._keeper is not None:
            self._keeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._keeper
            self._keeper = None

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Ask the model; waits while it loads and while others are served.

        Raises:
            PrerequisiteError: the folder is absent or damaged.
            UnreachableError: the process died or is being restarted.
            DeadlineError: it did not end in time.
            PlanError: its answer is no plan, or the prompt is too long for it.
        """
        async with self._turn:
            await self._settled.wait()
            if not self._ready.is_set():
                raise self.problem or UnreachableError("the local model is not ready", remedy="try again")
            if self._speaks:
                return await self._spoken(context)
            names = robot_names(context.robots, context.instruction)
            reply = await self._exchange(
                {
                    "messages": messages(context, self._catalogue, previous=previous, problems=problems),
                    "grammar": plan_grammar(self._catalogue, names),
                    "choices": {"skill": list(self._catalogue.skills), "robot": list(names) if names else None},
                    "deadline_s": self._config.local_deadline_s,
                }
            )
        if error := reply.get("error"):
            raise _as_error(error)
        plan = read_plan(str(reply.get("text", "")), tier=Tier.LOCAL)
        log.debug("local model answered", tokens=reply.get("tokens"), reused=reply.get("reused"), ms=reply.get("ms"))
        return Proposal(plan=plan, confidence=float(reply.get("confidence", 0.0)))

    async def _spoken(self, context: PlanContext) -> Proposal:
        """Ask a model that writes the plan language."""
        if context.so_far:
            raise PlanError("the embedded model cannot continue a task that has begun", remedy="another tier is asked")
        robots = None if context.robots is None else tuple(robot.id for robot in context.robots)
        question = Question(
            text=context.instruction, robots=robots, skills=self._shapes, deadline_s=self._config.local_deadline_s
        )
        reply = await self._exchange({"question": msgspec.to_builtins(question)})
        if error := reply.get("error"):
            raise _as_error(error)
        said = msgspec.convert({name: reply.get(name) for name in Said.__struct_fields__}, Said)
        log.debug("local model answered", symbols=" ".join(said.symbols), confidence=said.confidence, ms=said.ms)
        answer = read(said.symbols, words_of(context.instruction, robots or ()), self._catalogue)
        if answer.refused:
            raise PlanError(f"there is nothing to do: {_NO_PLAN.get(answer.refused, answer.refused)}")
        plan = Plan(domain=answer.domain, subtasks=answer.subtasks, tier=Tier.LOCAL)
        return Proposal(plan=plan, confidence=said.confidence)

    async def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        process = self._process
        if process is None or process.stdin is None:
            raise UnreachableError("the local model is not running", remedy="it is being restarted; try again")
        number = next(self._numbers)
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            try:
                process.stdin.write(frames.pack(request | {"id": number}))
                await process.stdin.drain()
            except (ConnectionError, ValueError) as error:
                raise UnreachableError(
                    f"the local model cannot be asked: {error}", remedy="it is being restarted"
                ) from error
            return await answer
        finally:
            self._waiting.pop(number, None)

    # --- the process ------------------------------------------------------------------------------------------------

    async def _keep(self) -> None:
        """Start the process again and again, with growing pauses."""
        tries = 0
        while True:
            began = time.monotonic()
            await self._live()
            if time.monotonic() - began > _STEADY_S:
                tries = 0
            pause = _PAUSES_S[min(tries, len(_PAUSES_S) - 1)]
            tries += 1
            log.warning("local model is down", why=str(self.problem), again_in_s=pause)
            await asyncio.sleep(pause)
            self.restarts += 1

    async def _live(self) -> None:
        """Run one process from start to end; leaves the reason of its end in `problem`."""
        config = self._config
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "appliance.llm.slot",
            config.local_model,
            str(config.local_threads),
            str(config.local_max_tokens),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(each for each in sys.path if each)},
            limit=2**16,
        )
        self._process = process
        listener = asyncio.create_task(self._listen(process), name="local model stderr")
        try:
            self.problem = await self._serve(process)
        finally:
            self._ready.clear()
            self._process = None
            await self._end(process)
            listener.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await listener
            down = self.problem or UnreachableError("the local model was stopped")
            for waiting in self._waiting.values():
                if not waiting.done():
                    waiting.set_exception(down)
            self._settled.set()

    async def _serve(self, process: asyncio.subprocess.Process) -> SwiftbotError:
        """Read the process's frames until it ends; return why it ended."""
        limit = self._config.local_start_s
        try:
            async with asyncio.timeout(limit):
                hello = await _frame(process)
        except TimeoutError:
            return UnreachableError(
                f"the local model did not load within {limit:g} s", remedy="raise llm.local_start_s"
            )
        if hello is not None and (error := hello.get("error")):
            return _as_error(error)
        if hello is None:
            return await self._death(process)
        self.problem = None
        self._speaks = bool(hello.get("speaks"))
        self._ready.set()
        self._settled.set()
        log.info("local model is ready", folder=self._config.local_model, load_ms=round(float(hello.get("ms", 0))))
        while (reply := await _frame(process)) is not None:
            answer = self._waiting.get(int(reply.get("id") or 0))
            if answer is not None and not answer.done():
                answer.set_result(reply)
        return await self._death(process)

    async def _death(self, process: asyncio.subprocess.Process) -> SwiftbotError:
        # Its output has ended, so it is dead or about to be; what it ended with is the reason.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_STOP_S):
                await process.wait()
        await self._end(process)
        status = process.returncode or 0
        how = f"by signal {-status}" if status < 0 else f"with status {status}"
        last = next((line for line in reversed(self._said) if line), "")
        return UnreachableError(
            f"the local model's process ended {how}{f': {last[:200]}' if last else ''}",
            remedy="it is restarted by itself; if it happens again, look at its memory and its model folder",
        )

    async def _listen(self, process: asyncio.subprocess.Process) -> None:
        """Keep the last lines of what the process prints, so that its end can be explained."""
        if process.stderr is None:
            return
        while chunk := await process.stderr.read(4096):
            for line in chunk.decode(errors="replace").splitlines():
                self._said.append(line.strip()[:300])

    async def _end(self, process: asyncio.subprocess.Process) -> None:
        """End a process: by the end of its input, then by force."""
        if process.returncode is not None:
            return
        if process.stdin is not None:
            process.stdin.close()
        try:
            async with asyncio.timeout(0 if self._turn.locked() else _STOP_S):
                await process.wait()
        except TimeoutError:
            # Not process.kill(): that polls, which takes the exit status away from the loop's own watcher.
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)
            await process.wait()


async def _frame(process: asyncio.subprocess.Process) -> dict[str, Any] | None:
    """Read a frame; None at the end, or when what comes is no frame."""
    if process.stdout is None:
        return None
    try:
        return frames.unpack(await process.stdout.readexactly(frames.size_of(await process.stdout.readexactly(4))))
    except (asyncio.IncompleteReadError, ConnectionError, ValueError):
        return None


def _as_error(error: dict[str, Any]) -> SwiftbotError:
    message, remedy = str(error.get("message", "")), str(error.get("remedy", ""))
    if error.get("code") == "plan":
        return PlanError(message, remedy=remedy)
    return from_code(str(error.get("code", "")), message, remedy)
