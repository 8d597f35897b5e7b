"""One model's process as the gateway sees it: started, kept alive, asked, ended.

It loads in the background, so that a gateway is up before its model is, and is started again with growing pauses when
it dies; each instruction in the meantime is told why there is no answer. A request that nobody waits for any more is
broken off in the process; answers carry the number of their request, and late ones are dropped.
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

import structlog

from appliance.errors import PlanError, PrerequisiteError, SwiftbotError, UnreachableError, from_code
from appliance.llm import frames
from appliance.llm.embedded import remedy_of
from appliance.llm.settings import LlmConfig

log = structlog.get_logger(__name__)

_PAUSES_S = (0.2, 1.0, 5.0, 15.0, 60.0)
"""Between restarts: quick after one crash, slow where the cause stays."""
_STEADY_S = 60.0
"""A process that lived this long counts as recovered."""
_STOP_S = 3.0


class ModelProcess:
    """The process of one model folder.

    Args:
        folder: of an onnxruntime-genai model.
        config: threads, bounds and deadlines.
    """

    def __init__(self, folder: str, config: LlmConfig) -> None:
        self.folder = folder
        self._config = config
        self._process: asyncio.subprocess.Process | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._ready = asyncio.Event()
        self._settled = asyncio.Event()
        """Set while there is either a ready process or a reason why not."""
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._said: deque[str] = deque(maxlen=20)
        self.problem: SwiftbotError | None = None
        """Why there is no model just now."""
        self.restarts = 0
        """Times the process was started again."""
        self.broken_off = 0
        """Requests that were given up while the process worked on them."""
        self.speaks = False
        """Whether the model writes the plan language (`language`); any other is asked for JSON under a grammar."""

    @property
    def pid(self) -> int | None:
        """Process id, while it is ready."""
        return self._process.pid if self._process is not None and self._ready.is_set() else None

    async def start(self) -> None:
        """Begin to load the model in the background.

        Raises:
            PrerequisiteError: the folder is not there or cannot be a model; it is tried again later all the same.
        """
        if self._keeper is None:
            self._keeper = asyncio.create_task(self._keep(), name="local model")
        if not (Path(self.folder) / "genai_config.json").is_file():
            raise PrerequisiteError(
                f"{self.folder} is no model folder (genai_config.json is missing)",
                remedy=remedy_of(self.folder),
            )

    async def close(self) -> None:
        """End the process and its keeper."""
        if self._keeper is not None:
            self._keeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._keeper
            self._keeper = None

    async def ready(self) -> None:
        """Wait until it can be asked; raises why it cannot."""
        await self._settled.wait()
        if not self._ready.is_set():
            raise self.problem or UnreachableError("the local model is not ready", remedy="try again")

    async def exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        """Ask and wait for the answer; when the wait is cancelled the process is told to break off.

        Raises:
            UnreachableError: the process died, or is being restarted.
            SwiftbotError: what the process answers instead, such as PlanError or DeadlineError.
        """
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
            except (OSError, RuntimeError, ValueError) as error:  # the second: a pipe that was closed meanwhile
                raise UnreachableError(
                    f"the local model cannot be asked: {error}", remedy="it is being restarted"
                ) from error
            reply = await answer
        except asyncio.CancelledError:
            self.broken_off += 1
            with contextlib.suppress(OSError, RuntimeError):
                process.stdin.write(frames.pack({"cancel": number}))
            raise
        finally:
            self._waiting.pop(number, None)
        if error := reply.get("error"):
            raise _as_error(error)
        return reply

    # --- the process ------------------------------------------------------------------------------------------------

    async def _keep(self) -> None:
        """Start the process again and again, with growing pauses."""
        tries = 0
        while True:
            began = time.monotonic()
            try:
                await self._live()
            except OSError as error:  # no memory, no descriptors, no more processes: tried again like an end
                self.problem = UnreachableError(
                    f"the local model's process cannot be started: {error}",
                    remedy="look at memory, open files and processes; it is tried again",
                )
                self._settled.set()
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
            self.folder,
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
        self.speaks = bool(hello.get("speaks"))
        self._ready.set()
        self._settled.set()
        log.info("local model is ready", folder=self.folder, load_ms=round(float(hello.get("ms", 0))))
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
            async with asyncio.timeout(0 if self._waiting else _STOP_S):
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
    except (asyncio.IncompleteReadError, OSError, ValueError):
        return None


def _as_error(error: dict[str, Any]) -> SwiftbotError:
    message, remedy = str(error.get("message", "")), str(error.get("remedy", ""))
    if error.get("code") == "plan":
        return PlanError(message, remedy=remedy)
    return from_code(str(error.get("code", "")), message, remedy)
