"""Whether a task is taken: what is wrong with a request, when to come back, and what one that is taken must expect."""

import contextlib
import math
import time
import uuid
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Collection, Generator, Mapping

from msgspec.structs import replace

from appliance.errors import PayloadError, RefusedError
from appliance.llm.preprocessing import stop_refused, training_refused
from appliance.llm.stop_words import stop_request
from appliance.llm.training_words import training_request
from appliance.model import (
    HIGHEST_PRIORITY,
    LONGEST_DEADLINE_S,
    PLAIN_PRIORITY,
    SPLIT,
    Plan,
    TaskRecord,
    TaskRequest,
    oversize,
)
from appliance.model.keys import check_name
from appliance.tasks.records import MAX_DEPTH, too_deep
from appliance.tasks.settings import TasksConfig

MAX_SUBMITTER = 120
ENDS = 32
"""Ends of tasks from which the rate is measured: enough for a mean, few enough to follow a change."""
LONGEST_RETRY_S = 600.0
"""Nobody is sent away for longer: so far ahead the rate says nothing."""
SLOW_S, SLOWER = 0.03, 2.0
"""Acceptances are slow that take longer on average, and so many times as long as the quickest one: on an idle machine
one takes 5 to 10 ms."""
LATE_S = 0.01
"""An event loop that is later has no processor left; on an idle machine it is 1 ms late."""
RECENT_S = 2.0
"""So long after the last acceptance it does not matter any more how long they took."""
SHORTEST_PAUSE_S, LONGEST_PAUSE_S = 0.05, 1.0
"""Within these one comes back that has come while too many others were being taken."""


def checked(request: TaskRequest, config: TasksConfig) -> TaskRequest:
    """Return a request with its text trimmed and an id; PayloadError says what is wrong with one that cannot be."""
    instruction = request.instruction.strip()
    if not instruction:
        raise PayloadError("the instruction is empty", remedy="say what is to be done")
    if len(instruction) > config.max_instruction_chars:
        raise PayloadError(
            f"the instruction has {len(instruction):,} characters, more than {config.max_instruction_chars:,}",
            remedy="split it, or raise tasks.max_instruction_chars",
        )
    if len(request.submitter) > MAX_SUBMITTER:
        raise PayloadError(
            f"the submitter's name has {len(request.submitter)} characters, at most {MAX_SUBMITTER} are possible",
            remedy="use a shorter one",
        )
    if request.plan is not None and (problem := oversize(len(request.plan.subtasks))):
        raise PayloadError(problem, remedy=SPLIT)
    if request.plan is not None and any(too_deep(each.params) for each in request.plan.subtasks):
        raise PayloadError(f"parameters are nested more than {MAX_DEPTH} deep", remedy="write them flat")
    if not 0 <= request.priority <= HIGHEST_PRIORITY:
        raise PayloadError(
            f"priority {request.priority} is none", remedy=f"0 to {HIGHEST_PRIORITY}, {PLAIN_PRIORITY} is plain"
        )
    if not 0 <= request.deadline_s <= LONGEST_DEADLINE_S:  # false for what is not a number
        raise PayloadError(
            f"a deadline of {request.deadline_s:g} s is none",
            remedy=f"seconds from now, up to {LONGEST_DEADLINE_S:g}; 0 for none",
        )
    for name in request.group:
        check_name(name, "gateway")
    task = request.id or f"t-{uuid.uuid4().hex[:10]}"
    return replace(request, instruction=instruction, id=check_name(task, "task"))


def refuse_commands(request: TaskRequest, robots: Collection[str]) -> None:
    """Refuse an instruction that is no task but another command: a soft stop, or a run of federated learning.

    An operator's tool carries them out, and nobody else may order them.

    Raises:
        RefusedError: it is one, with the command.
    """
    if request.plan is not None:
        return
    if (stop := stop_request(request.instruction, tuple(robots))) is not None:
        raise stop_refused(stop)
    if (training := training_request(request.instruction, tuple(robots))) is not None:
        raise training_refused(training)


class Ends:
    """When something ended here, from which is measured how fast that goes. The clock is passed in."""

    def __init__(self) -> None:
        self._at: deque[float] = deque(maxlen=ENDS)

    def ended(self, now: float) -> None:
        """Note that one has ended."""
        self._at.append(now)

    def rate(self, now: float) -> float:
        """Ends a second of late; 0 when fewer than two have ended. It falls while none ends."""
        if len(self._at) < 2:
            return 0.0
        return len(self._at) / max(1e-3, now - self._at[0])

    def retry_after_s(self, ends: int, now: float) -> float:
        """Seconds until so many more will have ended; 0: not known."""
        rate = self.rate(now)
        return min(LONGEST_RETRY_S, round(ends / rate, 1)) if rate else 0.0


class Admission:
    """Keeps the tasks of one gateway within their bound, those among them whose first record is only being written."""

    def __init__(self, gateway: str, most: int) -> None:
        self.ends = Ends()
        """Of tasks."""
        self._gateway = gateway
        self._most = most
        self._coming: Counter[str] = Counter()
        """As often as each is being asked for at this moment."""
        self._took_s = 0.0
        """How long acceptances take, a mean of the last ten or so."""
        self._quickest_s = math.inf
        self._last = -math.inf
        """When the last one ended."""

    def slow(self, now: float, late_s: float) -> bool:
        """Whether tasks are being accepted just now, and that takes long, or all here does.

        `late_s`: how late the event loop is of late.
        """
        slow = self._took_s > max(SLOW_S, SLOWER * self._quickest_s) or late_s > LATE_S
        return slow and (bool(self._coming) or now - self._last < RECENT_S)

    @contextlib.contextmanager
    def one_more(self, task: str, unfinished: int) -> Generator[None]:
        """Count a task in while it is being accepted; `unfinished`: those that were.

        Raises:
            RefusedError: the gateway has as many as it may have.
        """
        unfinished += len(self._coming)
        over = unfinished + 1 - self._most
        if over > 0 and task not in self._coming:
            raise full(self._gateway, unfinished, self.ends.retry_after_s(over, time.monotonic()))
        self._coming[task] += 1
        began = time.monotonic()
        try:
            yield
        finally:
            self._last = time.monotonic()
            took_s = self._last - began
            self._took_s += 0.1 * (took_s - self._took_s)
            self._quickest_s = min(self._quickest_s, took_s)
            self._coming[task] -= 1
            if not self._coming[task]:
                del self._coming[task]

    def paced(
        self, handler: Callable[[TaskRequest], Awaitable[TaskRecord]], *, most: int
    ) -> Callable[[TaskRequest], Awaitable[TaskRecord]]:
        """Return a handler of submissions that has at most so many under way at once, and tells others when to return.

        So submissions take neither the time nor the room of other questions, however many there are.
        """
        under_way, ends = 0, Ends()

        async def answer(request: TaskRequest) -> TaskRecord:
            nonlocal under_way
            if under_way >= most:
                rate = ends.rate(time.monotonic())
                pause_s = most / 2 / rate if rate else LONGEST_PAUSE_S
                raise busy(self._gateway, under_way, min(LONGEST_PAUSE_S, max(SHORTEST_PAUSE_S, pause_s)))
            under_way += 1
            try:
                return await handler(request)
            finally:
                under_way -= 1
                ends.ended(time.monotonic())

        return answer


def full(gateway: str, unfinished: int, retry_after_s: float) -> RefusedError:
    """Return the refusal of a coordinator that has as many tasks as it may have."""
    when = f"ask again in about {retry_after_s:g} s" if retry_after_s else "wait for some to end"
    return RefusedError(
        f"{gateway} already coordinates {unfinished} unfinished tasks",
        remedy=f"{when}, or cancel some",
        retry_after_s=retry_after_s,
    )


def busy(gateway: str, under_way: int, retry_after_s: float) -> RefusedError:
    """Return the refusal of a gateway that is taking as many tasks as it can at once."""
    return RefusedError(
        f"{gateway} is taking {under_way} other tasks just now",
        remedy=f"submit it again in {retry_after_s:.2g} s",
        retry_after_s=round(retry_after_s, 3),
    )


def longest_s(plan: Plan, seconds: Mapping[str, float]) -> float:
    """Return how long a plan takes when nothing waits: its longest chain of subtasks (`seconds` by id)."""
    ends: dict[str, float] = {}
    left = list(plan.subtasks)
    ids = {each.id for each in left}
    while left:
        later = [each for each in left if any(before in ids and before not in ends for before in each.after)]
        for each in left:
            if each not in later:
                start = max((ends[before] for before in each.after if before in ends), default=0.0)
                ends[each.id] = start + seconds.get(each.id, 0.0)
        if len(later) == len(left):
            break  # a circle, which no valid plan has
        left = later
    return max(ends.values(), default=0.0)


def expectation(
    *,
    waiting: int,
    wait_s: float | None,
    work_s: float | None,
    deadline_s: float,
    elapsed_s: float = 0.0,
    tasks_before: int = 0,
) -> str:
    """Return what a task must expect, in words; empty when it can start at once and has time enough.

    Args:
        waiting: subtasks that wait for room before it.
        wait_s: how long they are expected to; None: not known.
        work_s: how long its plan takes when nothing waits; None: there is no plan yet.
        deadline_s: from acceptance; 0: none.
        elapsed_s: since acceptance.
        tasks_before: tasks that wait for their turn at its coordinator.
    """
    told: list[str] = []
    if tasks_before:
        told.append(f"{tasks_before:,} tasks wait for their turn at its coordinator")
    if waiting:
        when = "" if wait_s is None else f", it is expected to start in about {max(0.1, wait_s):.1f} s"
        told.append(f"{waiting} subtasks wait for room before it{when}")
    needed_s = (wait_s or 0.0 if waiting else 0.0) + (work_s or 0.0)
    left_s = deadline_s - elapsed_s if deadline_s else math.inf
    if needed_s > left_s:
        told.append(f"its deadline can hardly be met: about {needed_s:.1f} s are needed, {max(0.0, left_s):.1f} s left")
    return "; ".join(told)
