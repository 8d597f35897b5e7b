"""The local tier: puts instructions to the model's process, one at a time, and changes the model under way.

A bounded number of instructions may wait; one more is refused with the time after which to ask again, so that the next
tier is asked at once. Another model is loaded beside the one that serves, has to pass a self-test, and takes its place
between two instructions; if it does not pass, nothing has changed.
"""

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import psutil
import structlog

from appliance.errors import DeadlineError, PlanError, RefusedError, SwiftbotError, UnreachableError
from appliance.llm.checks.schema import validate
from appliance.llm.embedded import folder_of
from appliance.llm.language.codec import Answer, read
from appliance.llm.language.guide import shapes
from appliance.llm.language.words import words_of
from appliance.llm.process import ModelProcess
from appliance.llm.prompt import messages
from appliance.llm.review import INTRINSIC, Facts, review
from appliance.llm.safety.settings import SafetyConfig
from appliance.llm.schema import plan_grammar, read_plan, robot_names
from appliance.llm.settings import LlmConfig, PlanContext
from appliance.llm.speaking import Question, Said
from appliance.llm.tier import Proposal
from appliance.model import Plan, RobotInfo, Severity, SlotStatus, Tier
from appliance.skills.catalogue import Catalogue

log = structlog.get_logger(__name__)

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

    def __init__(self, config: LlmConfig, catalogue: Catalogue, safety: SafetyConfig | None = None) -> None:
        self._config = config
        self._safety = safety or SafetyConfig()
        self._catalogue = catalogue
        self._process = ModelProcess(folder_of(config.local_model), config)
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
        other = ModelProcess(folder_of(folder), self._config)
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
        robots = None if context.robots is None else tuple(robot.id for robot in context.robots)
        question = Question(
            text=context.instruction, robots=robots, skills=self._shapes, deadline_s=self._config.local_deadline_s
        )
        began = time.monotonic()
        proposals = self._read(await self._asked(process, question), context, process)
        best, held = self._best(proposals, context)
        # What breaks a rule of plans was not meant; the next likely answer that breaks none was. Where all do, others
        # are looked for once, in the time that is left.
        left_s = question.deadline_s - (time.monotonic() - began)
        if held and left_s > 0:
            thorough = msgspec.structs.replace(question, thorough=True, deadline_s=left_s)
            with contextlib.suppress(PlanError, DeadlineError, UnreachableError):
                more = self._read(await self._asked(process, thorough), context, process)
                best, _ = self._best([best, *more], context)
        return best

    async def _asked(self, process: ModelProcess, question: Question) -> Said:
        said = _said(await process.exchange({"question": msgspec.to_builtins(question)}))
        self._note(said.tokens, said.ms, 0)
        log.debug("local model answered", symbols=" ".join(said.symbols), confidence=said.confidence, ms=said.ms)
        return said

    def _read(self, said: Said, context: PlanContext, process: ModelProcess) -> list[Proposal]:
        """Return the answers as plans, likelier ones first; PlanError when the likeliest is none, or a refusal."""
        words = words_of(context.instruction, [robot.id for robot in context.robots or ()])
        answer = read(said.symbols, words, self._catalogue)
        if answer.refused:
            raise PlanError(f"there is nothing to do: {_NO_PLAN.get(answer.refused, answer.refused)}")
        found = [_proposed(answer, said.confidence, process)]
        for other in said.others:
            with contextlib.suppress(PlanError):
                found.append(_proposed(read(other.symbols, words, self._catalogue), other.confidence, process))
        return found

    def _best(self, proposals: Sequence[Proposal], context: PlanContext) -> tuple[Proposal, bool]:
        """Return the likeliest by its own confidence and by the review, and whether a check spoke against it.

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
        return proposals[best], ranks[best][0] > 0

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
