"""The local tier: the gateway's end of the model's process (`worker`), its queue, and the change of models.

The process loads in the background, so that a gateway is up before its model is, and is started again with growing
pauses when it dies; each instruction in the meantime gets the reason why there is no answer. A request that nobody
waits for any more is broken off in the process; answers carry the number of their request, and late ones are dropped.

Instructions are put to it one at a time. A bounded number may wait; one more is refused with the time after which to
ask again, so that the next tier is asked at once. Another model is loaded beside the one that serves, has to pass a
self-test, and takes its place between two instructions; if it does not pass, nothing has changed. `swap` does that for
a running gateway, also for one that has had no model so far.
"""

import asyncio
import contextlib
import itertools
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import psutil
import structlog
from msgspec.structs import replace

from appliance.errors import (
    ConfigError,
    DeadlineError,
    IdentityError,
    PlanError,
    PrerequisiteError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
    from_code,
)
from appliance.llm import frames
from appliance.llm.checks.schema import validate
from appliance.llm.decoder import Question, Said
from appliance.llm.language import Answer, read, shapes
from appliance.llm.prompt import messages, plan_grammar, read_plan, robot_names
from appliance.llm.review import INTRINSIC, Facts, review
from appliance.llm.settings import KNOWN_TIERS, LlmConfig, PlanContext, SafetyConfig, folder_of, remedy_of
from appliance.llm.shortlist import shortlist
from appliance.llm.tier import Proposal
from appliance.llm.tiers import Slot, local
from appliance.llm.words import words_of
from appliance.model import Plan, RobotInfo, Severity, SlotStatus, Tier
from appliance.model.planner_api import Swapped
from appliance.skills.catalogue import Catalogue

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
        check: raises IdentityError where the folder may not be loaded; asked before each start.
    """

    def __init__(self, folder: str, config: LlmConfig, check: Callable[[Path], None] = lambda _: None) -> None:
        self.folder = folder
        self._check = check
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
        """Ask and wait for the answer; when the wait is cancelled, so is the request in the process.

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
                await asyncio.to_thread(self._check, Path(self.folder))
                await self._live()
            except (IdentityError, ConfigError) as error:
                self.problem = error
                self._settled.set()
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
            "appliance.llm.worker",
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


_NO_PLAN = {
    "chatter": "it holds no order",
    "question": "it asks what no robot can find out",
    "impossible": "no skill does what it asks for",
    "unclear": "it does not say what to do, or with what",
    "language": "only English is understood",
}
_DOUBTFUL = 1
"""The rank of a plan that leaves out a robot, a figure or an order which the words have."""
_FAR = 0.05
"""Times the confidence of such a plan, which another one must have at least that is to be taken instead."""
_ODD = 0.5
"""The same for a plan that only leaves a word over."""
_TELLING = frozenset(("idle_robot", "quantity", "sequence", "assignment", "negation", "repeated", "unnamed_robot"))
_TYPED = 3.0
"""Times as sure another wording has to be than the typed one that its plan is taken instead, where the two differ."""
_LATEST = 32
"""Answers from which the rates are taken."""
_SELF_TEST = (
    "Rover_1: go to dock 1",
    "Drone_1 takes off, then it photographs the shelf",
    "Rover_1 goes to dock 2 while Drone_1 films the aisle for one minute",
)


class LocalTier:
    """Plans by a model folder on this machine."""

    name = Tier.LOCAL

    def __init__(
        self,
        config: LlmConfig,
        catalogue: Catalogue,
        safety: SafetyConfig | None = None,
        check_model: Callable[[Path], None] = lambda _: None,
    ) -> None:
        self._config = config
        self._check_model = check_model
        self._safety = safety or SafetyConfig()
        self._catalogue = catalogue
        self._process = ModelProcess(folder_of(config.local_model), config, check_model)
        self._turn = asyncio.Lock()
        self._shapes = shapes(catalogue)
        self._inside = 0
        self._refused = 0
        self._swapping = False
        self._answers: deque[tuple[int, float]] = deque(maxlen=_LATEST)
        """Tokens and milliseconds of the latest."""
        self._answered = 0
        self._reused = 0

    @property
    def repairs(self) -> bool:
        """Whether asking again with what is wrong can help: a model of the plan language would say the same again."""
        return not self._process.speaks

    @property
    def pid(self) -> int | None:
        """Process id of the model's process, while it is ready."""
        return self._process.pid

    @property
    def problem(self) -> SwiftbotError | None:
        """Why there is no model just now."""
        return self._process.problem

    @property
    def restarts(self) -> int:
        """Times the process was started again."""
        return self._process.restarts

    @property
    def model(self) -> str:
        """Name of the model's folder."""
        return Path(self._process.folder).name

    @property
    def status(self) -> SlotStatus:
        """How it does, for GatewayStatus."""
        process = self._process
        ready = process.pid is not None
        state = "ready" if ready else "loading" if process.problem is None else "down"
        tokens, spent = sum(each for each, _ in self._answers), sum(ms for _, ms in self._answers)
        return SlotStatus(
            model=self.model,
            state="swapping" if self._swapping and ready else state,
            problem="" if ready or process.problem is None else str(process.problem)[:300],
            tokens_s=round(1000 * tokens / spent, 1) if spent else 0.0,
            queue=self._inside,
            queue_most=self._config.local_queue,
            memory_mb=_memory_mb(process.pid),
            threads=self._config.local_threads,
            restarts=process.restarts,
            answered=self._answered,
            refused=self._refused,
            cancelled=process.broken_off,
            reused_tokens=self._reused,
        )

    async def start(self) -> None:
        """Begin to load the model in the background.

        Raises:
            PrerequisiteError: the folder is not there or cannot be a model; it is tried again later all the same.
        """
        await self._process.start()

    async def close(self) -> None:
        """End the process and its keeper."""
        await self._process.close()

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Ask the model; waits while it loads and while others are served.

        Raises:
            RefusedError: too many wait already.
            PrerequisiteError: the folder is absent or damaged.
            UnreachableError: the process died or is being restarted.
            DeadlineError: it did not end in time.
            PlanError: its answer is no plan, or the prompt is too long for it.
        """
        if self._inside >= self._config.local_queue:
            self._refused += 1
            raise RefusedError(
                f"{self._inside} instructions wait for the local model already",
                remedy="ask again a little later, or raise llm.local_queue",
                retry_after_s=self._retry_after_s(),
            )
        self._inside += 1
        try:
            async with self._turn:
                return await self._ask(self._process, context, previous, problems)
        finally:
            self._inside -= 1

    async def swap(self, folder: str) -> tuple[str, ...]:
        """Use another model from now on; instructions are served by the one before until it has passed its self-test.

        Args:
            folder: of an onnxruntime-genai model, or `embedded`.

        Returns:
            What it made of each instruction of the self-test, in words.

        Raises:
            RefusedError: another swap is under way.
            PrerequisiteError, UnreachableError, DeadlineError: it cannot be loaded; nothing has changed.
            PlanError: it fails its self-test; nothing has changed.
        """
        if self._swapping:
            raise RefusedError("another model is being loaded already", remedy="wait until that is done")
        self._swapping = True
        other = ModelProcess(folder_of(folder), self._config, self._check_model)
        try:
            told = await self._tried(other)
            async with self._turn:
                before, self._process = self._process, other
        except BaseException:
            await other.close()
            raise
        finally:
            self._swapping = False
        self._answers.clear()
        await before.close()
        log.info("the local model is another one", before=before.folder, after=folder)
        return told

    async def self_test(self) -> tuple[str, ...]:
        """Have the model that is there plan a few plain orders; raises as `swap`."""
        async with self._turn:
            return await self._tested(self._process)

    async def _tried(self, process: ModelProcess) -> tuple[str, ...]:
        """Load a model and test it."""
        await process.start()
        try:
            async with asyncio.timeout(self._config.local_start_s):
                await process.ready()
        except TimeoutError as error:
            raise DeadlineError(
                f"the local model did not load within {self._config.local_start_s:g} s",
                remedy="raise llm.local_start_s",
            ) from error
        return await self._tested(process)

    async def _tested(self, process: ModelProcess) -> tuple[str, ...]:
        """Have a model plan the self-test; PlanError when it gives no valid plan to any of it, or no answer to one."""
        everything = tuple(sorted({use for each in self._catalogue.skills.values() for use in each.uses}))
        verbs = tuple(sorted({verb for each in self._catalogue.skills.values() for verb in each.verbs}))
        robots = tuple(
            RobotInfo(id=name, kind="zenoh", uses=everything, verbs=verbs, flies=True)
            for name in ("rover_1", "drone_1")
        )
        told: list[str] = []
        valid = 0
        for instruction in _SELF_TEST:
            context = PlanContext(instruction=instruction, robots=robots)
            try:
                async with asyncio.timeout(self._config.local_deadline_s + 5.0):
                    proposal = await self._ask(process, context, None, ())
            except PlanError as error:
                told.append(f"{instruction!r}: no plan: {error.message}")
                continue
            except TimeoutError as error:
                raise DeadlineError(f"no answer to {instruction!r} within its deadline") from error
            problems = validate(proposal.plan, self._catalogue, robots=robots)
            valid += not problems
            skills = ", ".join(each.skill for each in proposal.plan.subtasks)
            told.append(f"{instruction!r}: {f'not valid: {problems[0]}' if problems else skills}")
        if not valid:
            raise PlanError(
                f"the model in {process.folder} fails its self-test: no valid plan for any plain order",
                problems=tuple(told),
                remedy="use a model that was trained for plans, or one with a chat template",
            )
        return tuple(told)

    # --- one question -----------------------------------------------------------------------------------------------

    async def _ask(
        self, process: ModelProcess, context: PlanContext, previous: Plan | None, problems: tuple[str, ...]
    ) -> Proposal:
        await process.ready()
        if process.speaks:
            return await self._spoken(process, context)
        names = robot_names(context.robots, context.instruction, context.site)
        reply = await process.exchange(
            {
                "messages": messages(context, self._catalogue, previous=previous, problems=problems),
                "grammar": plan_grammar(self._catalogue, names),
                "choices": {"skill": list(self._catalogue.skills), "robot": list(names) if names else None},
                "deadline_s": self._config.local_deadline_s,
            }
        )
        plan = read_plan(str(reply.get("text", "")), tier=Tier.LOCAL)
        self._note(int(reply.get("tokens") or 0), float(reply.get("ms") or 0.0), int(reply.get("reused") or 0))
        log.debug("local model answered", tokens=reply.get("tokens"), reused=reply.get("reused"), ms=reply.get("ms"))
        return Proposal(plan=plan, confidence=float(reply.get("confidence", 0.0)), model=Path(process.folder).name)

    async def _spoken(self, process: ModelProcess, context: PlanContext) -> Proposal:
        """Ask a model that writes the plan language."""
        if context.so_far:
            raise PlanError("the embedded model cannot continue a task that has begun", remedy="another tier is asked")
        shown = shortlist(context)
        best = await self._likeliest(process, shown.names, shown.forms(context))
        return msgspec.structs.replace(best, plan=shown.whole(best.plan, context.robots, self._catalogue))

    async def _likeliest(
        self, process: ModelProcess, names: tuple[str, ...] | None, forms: Sequence[PlanContext]
    ) -> Proposal:
        """Return the likeliest answer that breaks no rule of plans; where all do, the best of what can be had in time.

        Args:
            process: the model's.
            names: the roster of its prompt.
            forms: the instruction in one or two wordings. A model errs in one where it is right in the other, and is
                less sure then.

        Raises:
            PlanError, DeadlineError, UnreachableError: there is no answer to any.
        """
        until = time.monotonic() + self._config.local_deadline_s
        found: list[tuple[tuple[int, int], Proposal, PlanContext]] = []
        problem: SwiftbotError | None = None

        async def ask(context: PlanContext, known: Sequence[Proposal] = (), *, thorough: bool = False) -> None:
            question = Question(
                text=context.instruction,
                robots=names,
                skills=self._shapes,
                deadline_s=until - time.monotonic(),
                thorough=thorough,
            )
            answers = self._read(await self._asked(process, question), question, process)
            best, rank = self._best([*known, *answers], context)
            found.append((rank, best, context))

        def preference(each: tuple[tuple[int, int], Proposal, PlanContext]) -> tuple[tuple[int, int], float]:
            rank, proposal, context = each
            typed = len(forms) > 1 and context is forms[-1]
            same = all(proposal.plan.subtasks == other.plan.subtasks for _, other, _ in found)
            return rank, -proposal.confidence * (_TYPED if typed and not same else 1.0)

        for context in forms:
            try:
                await ask(context)
            except (PlanError, DeadlineError, UnreachableError) as error:
                problem = problem or error
        if not found:
            raise problem or UnreachableError("the local model gave no answer")
        rank, best, context = min(found, key=preference)
        # What breaks a rule of plans was not meant; the next likely answer that breaks none was. Where all do, others
        # are looked for once, in the time that is left.
        if rank[0] and time.monotonic() < until:
            with contextlib.suppress(PlanError, DeadlineError, UnreachableError):
                await ask(context, [best], thorough=True)
                best = found[-1][1]
        return best

    async def _asked(self, process: ModelProcess, question: Question) -> Said:
        said = _said(await process.exchange({"question": msgspec.to_builtins(question)}))
        self._note(said.tokens, said.ms, 0)
        log.debug("local model answered", symbols=" ".join(said.symbols), confidence=said.confidence, ms=said.ms)
        return said

    def _read(self, said: Said, question: Question, process: ModelProcess) -> list[Proposal]:
        """Return the answers as plans, likelier ones first; PlanError when the likeliest is none, or a refusal."""
        words = words_of(question.text, question.robots or ())
        answer = read(said.symbols, words, self._catalogue)
        if answer.refused:
            raise PlanError(f"there is nothing to do: {_NO_PLAN.get(answer.refused, answer.refused)}")
        found = [_proposed(answer, said.confidence, process)]
        for other in said.others:
            with contextlib.suppress(PlanError):
                found.append(_proposed(read(other.symbols, words, self._catalogue), other.confidence, process))
        return found

    def _best(self, proposals: Sequence[Proposal], context: PlanContext) -> tuple[Proposal, tuple[int, int]]:
        """Return the likeliest by its own confidence and by the review, and its rank (`_rank`).

        One that a check holds is not given up for one that is far less likely.
        """
        ranks = [self._rank(each.plan, context) for each in proposals]
        best = ranks.index(min(ranks))
        for number, (rank, _) in enumerate(ranks[:best]):
            # The likelier one stands before: it is given up for one that is not far less likely.
            least = _FAR if rank == _DOUBTFUL else _ODD if rank == 0 else 0.0
            if least and proposals[best].confidence < least * proposals[number].confidence:
                best = number
                break
        return proposals[best], ranks[best]

    def _rank(self, plan: Plan, context: PlanContext) -> tuple[int, int]:
        """Return how little a plan can be what was meant, and whether a check holds it that is less telling.

        0: no check speaks against its parts; 1: it leaves out what the words have; 2: it is refused; 3: it is empty
        or breaks a rule of plans. The operator's policy has no say: what is forbidden is refused, and nothing else is
        done in its place.
        """
        if not plan.subtasks:
            return 3, 0
        found = review(Facts(plan, context, self._catalogue, self._safety)).findings
        telling = [each for each in found if each.check not in ("policy", *INTRINSIC)]
        if any(each.check in ("consistency", "contradiction") for each in telling):
            return 3, 0
        if any(each.severity is Severity.REFUSE for each in telling):
            return 2, 0
        held = {each.check for each in telling if each.severity is Severity.HOLD}
        return (_DOUBTFUL, 0) if held & _TELLING else (0, int(bool(held)))

    def _note(self, tokens: int, ms: float, reused: int) -> None:
        self._answered += 1
        self._reused = reused
        self._answers.append((tokens, ms))

    def _retry_after_s(self) -> float:
        taken = [ms for _, ms in self._answers] or [1000.0]
        return min(60.0, max(0.1, round(self._inside * sum(taken) / len(taken) / 1000, 1)))


def _proposed(answer: Answer, confidence: float, process: ModelProcess) -> Proposal:
    plan = Plan(domain=answer.domain, subtasks=answer.subtasks, tier=Tier.LOCAL)
    return Proposal(plan=plan, confidence=confidence, model=Path(process.folder).name)


def _said(reply: dict[str, Any]) -> Said:
    try:
        return msgspec.convert({name: reply.get(name) for name in Said.__struct_fields__}, Said)
    except msgspec.ValidationError as error:
        raise UnreachableError(f"the local model's answer is damaged: {error}") from error


def _memory_mb(pid: int | None) -> float:
    if pid is None:
        return 0.0
    try:
        return round(psutil.Process(pid).memory_info().rss / 2**20, 1)
    except psutil.Error:
        return 0.0


async def swap(
    slots: Sequence[Slot],
    folder: str,
    config: LlmConfig,
    catalogue: Catalogue,
    check_model: Callable[[Path], None] = lambda _: None,
) -> tuple[tuple[Slot, ...], Swapped]:
    """Have the local tier use another model; returns the tiers from then on.

    Raises:
        ConfigError: `llm.tiers` has no local tier.
        SwiftbotError: as `LocalTier.swap`; nothing has changed then.
    """
    began = time.monotonic()
    if Tier.LOCAL not in config.tiers:
        raise ConfigError("llm.tiers has no local tier", remedy='add "local" to llm.tiers and restart')
    here = next((slot.planner for slot in slots if isinstance(slot.planner, LocalTier)), None)
    if here is not None:
        before = here.model
        tests = await here.swap(folder)
        after = tuple(slots)
    else:
        before, slot = "", local(replace(config, local_model=folder), catalogue, check_model=check_model)
        planner = slot.planner
        assert isinstance(planner, LocalTier)  # noqa: S101 - `local` makes nothing else
        try:
            await planner.start()
            tests = await planner.self_test()
        except BaseException:
            await planner.close()
            raise
        after = tuple(sorted((*slots, slot), key=lambda each: _place(each, config)))
    ms = round(1000 * (time.monotonic() - began), 1)
    return after, Swapped(before=before, after=Path(folder_of(folder)).name, ms=ms, tests=tests)


def _place(slot: Slot, config: LlmConfig) -> int:
    order = [*config.tiers, *KNOWN_TIERS]
    return order.index(slot.planner.name.value) if slot.planner.name.value in order else len(order)
