"""Replays a log: do the logged inputs give the logged states, and would today's code make the logged decisions again?

`replay` goes through the task state machine. The log holds every transition a coordinator applied and every record it
wrote. Folding the former over nothing with the same `machine.apply` must give the latter; a difference is a bug in the
machine, a gap in the log, or a log of another version. Recorded logs thereby become regression tests.

`check` makes the decisions of a log again and compares. These deciders leave what they rest on in the log: the task
state machine (each transition; the records show what came of it), the retry policy (on a failed attempt), the choice of
a gateway (`gw/*/decided/placement`), the pool's selection and eviction (`gw/*/decided/selection`, `eviction`), the
floor's (`way`: which way a robot asked for or what it waited for; `grant`: what a grantor answered, and that it granted
no ground to two robots), and the rounds of federated learning (`gw/*/decided/round`, by `learn.decisions`). The first
difference is shown with both sides. What the log does not have cannot be checked, and is counted instead: a gateway
that is killed takes its last transitions with it, and a recorder may be started in the middle of a task. From the next
record on, such a task is followed again.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import RecordError
from appliance.floor.decisions import WayCase, way_again
from appliance.model import Failure, SubtaskRecord, TaskRecord, keyspace
from appliance.model.transitions import TAKES_OVER, fingerprint
from appliance.plane.leases import GrantCase, grant_again
from appliance.pool.decisions import EvictionCase, SelectionCase, evict_again, select_again
from appliance.record.models import LoggedMessage
from appliance.record.reader import read
from appliance.tasks import machine
from appliance.tasks.machine import StaleTransitionError, Transition, TransitionKind
from appliance.tasks.placement import PlacementCase, place_again


class TaskReplay(Struct, frozen=True, kw_only=True):
    """One task of a log: the state it was logged in last, the state that its transitions give, what differs."""

    task: str
    instruction: str
    logged: str
    replayed: str
    transitions: int
    stale: int = 0
    """Transitions that did not fit: of a coordinator that had been superseded."""
    differences: tuple[str, ...] = ()

    @property
    def same(self) -> bool:
        """Whether the replay agrees with the log."""
        return not self.differences


class ReplayReport(Struct, frozen=True, kw_only=True):
    """All tasks of a log. `same` is true only if there is one and every one agrees."""

    path: str
    messages: int
    tasks: tuple[TaskReplay, ...]
    unreadable: int = 0
    same: bool = False


class _Folding:
    """One task while the log is read."""

    def __init__(self) -> None:
        self.record: TaskRecord | None = None
        self.history: dict[int, TaskRecord] = {}
        self.versions: dict[str, TaskRecord] = {}
        """By fingerprint: what a takeover may go on from."""
        self.logged: TaskRecord | None = None
        self.transitions = 0
        self.stale = 0
        self.gaps: list[str] = []

    def take(self, event: Transition) -> None:
        self.transitions += 1
        base = self.record
        if base is not None and event.coordinator != base.coordinator and event.kind not in TAKES_OVER:
            # Of the other side of a partition, or of one that was succeeded and does not know it yet.
            self.stale += 1
            return
        if event.base in self.versions:
            base = self.versions[event.base]
        elif event.kind is TransitionKind.ADOPTED and base is not None:
            # The new coordinator goes on from the last *written* record; progress since then is not in it.
            base = self.history.get(event.sequence - 1, base)
        try:
            self.record = machine.apply(base, event)
        except StaleTransitionError as error:
            self.stale += 1
            if base is None or event.sequence > base.sequence + 1:
                self.gaps.append(f"gap before transition {event.sequence} ({event.kind}): {error.message}")
            return
        self.history[event.sequence] = self.record
        self.versions[fingerprint(self.record)] = self.record


def replay(path: Path) -> ReplayReport:
    """Fold the transitions of an MCAP log and compare with the records logged last.

    Raises:
        RecordError: the file cannot be read, or holds no task.
    """
    tasks: dict[str, _Folding] = {}
    counts: Counter[str] = Counter()
    for message in read(path):
        counts["messages"] += 1
        topic = keyspace.topic_of(message.key)
        if topic is not keyspace.TRANSITION and topic is not keyspace.TASK_UPDATE:
            continue
        try:
            if topic is keyspace.TRANSITION:
                event = msgspec.json.decode(message.payload, type=Transition)
                tasks.setdefault(event.task, _Folding()).take(event)
            else:
                record = msgspec.json.decode(message.payload, type=TaskRecord)
                tasks.setdefault(record.id, _Folding()).logged = record
        except msgspec.DecodeError:
            counts["unreadable"] += 1
    if not tasks:
        raise RecordError(f"{path} holds no task", remedy="record while tasks run, with `swiftbot record`")
    outcomes = tuple(_outcome(task, folding) for task, folding in sorted(tasks.items()))
    return ReplayReport(
        path=str(path),
        messages=counts["messages"],
        tasks=outcomes,
        unreadable=counts["unreadable"],
        same=all(outcome.same for outcome in outcomes),
    )


def _outcome(task: str, folding: _Folding) -> TaskReplay:
    logged, replayed = folding.logged, folding.record
    differences = list(folding.gaps)
    if logged is None:
        differences.append("no record of it was logged")
    elif replayed is None:
        differences.append("its transitions were not logged")
    else:
        differences.extend(compare(logged, replayed))
    shown = logged or replayed
    return TaskReplay(
        task=task,
        instruction=shown.instruction if shown else "",
        logged=str(logged.state) if logged else "",
        replayed=str(replayed.state) if replayed else "",
        transitions=folding.transitions,
        stale=folding.stale,
        differences=tuple(differences),
    )


def compare(logged: TaskRecord, replayed: TaskRecord) -> tuple[str, ...]:
    """What differs between two records of a task, a sentence each; empty when they tell the same."""
    found: list[str] = []
    if logged.state is not replayed.state:
        found.append(f"task: logged {logged.state}, replayed {replayed.state}")
    if logged.revised != replayed.revised:
        found.append(f"task: logged {logged.revised} revisions of its plan, replayed {replayed.revised}")
    ids = [each.subtask.id for each in logged.subtasks]
    if ids != [each.subtask.id for each in replayed.subtasks]:
        return (*found, "the subtasks are not the same")
    for one, other in zip(logged.subtasks, replayed.subtasks, strict=True):
        found.extend(_compare_subtask(one, other))
    return tuple(found)


def _compare_subtask(logged: SubtaskRecord, replayed: SubtaskRecord) -> list[str]:
    name = logged.subtask.id
    found = [
        f"{name}: logged {what} {a}, replayed {b}"
        for what, a, b in (
            ("state", logged.state, replayed.state),
            ("attempt", logged.attempt, replayed.attempt),
            ("gateway", logged.gateway, replayed.gateway),
            ("robot", logged.bound_robot, replayed.bound_robot),
            ("further robots", logged.others, replayed.others),
        )
        if a != b
    ]
    if logged.result != replayed.result:
        found.append(f"{name}: the results differ")
    if logged.failure != replayed.failure:
        found.append(f"{name}: the failures differ")
    return found


MOST_SHOWN = 100
"""Differences kept; the first is what matters, the others mostly follow from it."""
MOST_HISTORY = 2_000
"""Records of a task kept to go on from: a new coordinator goes on from one that was written before it came."""
MOST_VERSIONS = 8
"""Versions of a task that its new coordinator may have taken over."""
_MALFORMED = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


class Divergence(Struct, frozen=True, kw_only=True):
    """A decision that comes out differently now."""

    decider: str
    """`machine`, `retry`, `placement`, `selection`, `eviction`, `way`, `grant` or `round`."""
    log: str
    at_ns: int
    what: str
    """Which decision: task, subtask, attempt, transition."""
    logged: str
    now: str


class CheckReport(Struct, frozen=True, kw_only=True):
    """What came of checking some logs."""

    logs: tuple[str, ...]
    messages: int
    checked: dict[str, int]
    """Decisions made again, by decider."""
    unchecked: dict[str, int]
    """Those whose inputs are not in the log, or not of this version, by reason."""
    tasks: int
    divergences: tuple[Divergence, ...]
    diverged: int
    """All of them; at most 100 are listed."""
    problems: tuple[str, ...] = ()
    """What is damaged in the logs."""

    @property
    def same(self) -> bool:
        """Whether every decision that could be made again came out as it was."""
        return not self.diverged


class Traced(Struct, frozen=True):
    """A decider that puts each decision with all that it rests on, so that it can be made again from that alone.

    A further one needs a line in `TRACED`, or in what `check` is given beside it, and a put of its `case` under
    `gw/{gateway}/decided/{its name}`.
    """

    case: type[Struct]
    """The inputs, and the decision in fields of its own."""
    again: Callable[[Any], dict[str, Any] | None]
    """Decides again; returns the decision by the names of the case's fields, None where cases before it are missing."""
    what: Callable[[Any], str]
    """Which decision a case is of, for people."""


TRACED = {
    "placement": Traced(
        PlacementCase, place_again, lambda case: f"gateway for {case.task} {case.subtask}, attempt {case.attempt}"
    ),
    "selection": Traced(
        SelectionCase, select_again, lambda case: f"container for {case.need.image} by {case.gateway}"
    ),
    "eviction": Traced(EvictionCase, evict_again, lambda case: f"room for a run on {case.gateway}"),
    "way": Traced(WayCase, way_again, lambda case: f"way of {case.trip.robot} for {case.trip.command}"),
    "grant": Traced(GrantCase, grant_again, lambda case: f"ground for {case.asked.holder} by {case.gateway}"),
}  # fmt: skip


class _Task:
    """One task while the log is read. In a partition two coordinators drive it: each has a line of its own."""

    def __init__(self) -> None:
        self.lines: dict[str, list[TaskRecord]] = {}
        """Coordinator -> the record as it follows; several while it is open which version it has taken over."""
        self.history: dict[int, dict[str, TaskRecord]] = {}
        """Sequence -> the versions with that many transitions, by their fingerprint."""
        self.guessed: set[str] = set()
        """Coordinators whose line goes on from a version that may be another than theirs."""

    def remember(self, records: list[TaskRecord]) -> None:
        """Note where a line stands."""
        for record in records[:MOST_VERSIONS]:
            self.history.setdefault(record.sequence, {})[fingerprint(record)] = record
        self.lines[records[0].coordinator] = records[:MOST_VERSIONS]
        if len(self.history) > MOST_HISTORY:
            del self.history[next(iter(self.history))]

    def bases(self, event: Transition) -> list[TaskRecord]:
        """Return the records that a transition may have been applied to; none when that is not in the log."""
        own = [each for each in self.lines.get(event.coordinator, ()) if each.sequence == event.sequence - 1]
        if event.kind not in TAKES_OVER:
            return own
        if event.base:
            exact = self.history.get(event.sequence - 1, {}).get(event.base)
            return [] if exact is None else [exact]
        line = self.lines.get(event.coordinator, ())
        if not own and line and all(each.sequence < event.sequence - 1 for each in line):
            # It had a line of its own, of which something is not in the log: others that are as long may not be its.
            self.guessed.add(event.coordinator)
        # A new coordinator goes on from the last *written* record, of whichever side; its own line may be another.
        written = self.history.get(event.sequence - 1, {}).values()
        return own + [each for each in written if each not in own]


class Checker:
    """Takes the messages of one fleet's log in order.

    Args:
        traced: the deciders that put what they rest on, by name.
    """

    def __init__(self, traced: Mapping[str, Traced] = TRACED) -> None:
        self._traced = traced
        self.checked: Counter[str] = Counter()
        self.unchecked: Counter[str] = Counter()
        self.divergences: list[Divergence] = []
        self.diverged = 0
        self.tasks: dict[str, _Task] = {}
        self._log = ""

    def take(self, message: LoggedMessage, log: str = "") -> None:
        """Make the decisions again that a message tells of."""
        self._log = log
        if message.deleted:
            return
        topic = keyspace.topic_of(message.key)
        try:
            if topic is keyspace.TRANSITION:
                self._transition(message)
            elif topic is keyspace.TASK_UPDATE:
                self._record(message)
            elif topic is keyspace.DECIDED and (what := keyspace.DECIDED.names(message.key)[1]) in self._traced:
                self._decided(what, message)
        except _MALFORMED:
            self.unchecked["malformed"] += 1

    # --- tasks ------------------------------------------------------------------------------------------------

    def _transition(self, message: LoggedMessage) -> None:
        event = msgspec.json.decode(message.payload, type=Transition)
        task = self.tasks.setdefault(event.task, _Task())
        first = event.kind is TransitionKind.ACCEPTED and event.sequence == 1
        bases: list[TaskRecord | None] = [None] if first else [*task.bases(event)]
        if not bases:
            line = task.lines.get(event.coordinator, ())
            again = any(event.sequence <= each.sequence for each in line) and event.kind not in TAKES_OVER
            self.unchecked["told again" if again else "after what is not in the log"] += 1
            if not again:
                task.lines.pop(event.coordinator, None)
            return
        self._retry(bases[0], event, message)
        problem = ""
        after: list[TaskRecord] = []
        for base in bases:
            try:
                after.append(machine.apply(base, event))
            except StaleTransitionError as error:
                problem = problem or error.message
        if not after:
            self._differs("machine", message, _which(event), f"{event.kind} was applied", f"it does not fit: {problem}")
            task.lines.pop(event.coordinator, None)
            return
        self.checked["machine"] += 1
        task.remember(after)

    def _retry(self, base: TaskRecord | None, event: Transition, message: LoggedMessage) -> None:
        """Ask the retry policy again, where the transition says what it was asked."""
        if event.kind is not TransitionKind.ATTEMPT_FAILED or base is None:
            return
        if event.retries is None or event.failure is None:
            self.unchecked["retry policy was not asked"] += 1
            return
        try:
            target = base.of(event.subtask)
        except KeyError:
            return
        now = machine.gives_up(_failed(target, event.failure), event.failure, retries=event.retries + 1)
        self.checked["retry"] += 1
        if now != event.give_up:
            self._differs("retry", message, _which(event), _given_up(event.give_up), _given_up(now))

    def _record(self, message: LoggedMessage) -> None:
        logged = msgspec.json.decode(message.payload, type=TaskRecord)
        task = self.tasks.setdefault(logged.id, _Task())
        line = [each for each in task.lines.get(logged.coordinator, ()) if each.sequence == logged.sequence]
        if not line:
            # Followed from here on: what led to it is not in the log.
            self.unchecked["record after what is not in the log"] += 1
            task.remember([logged])
            return
        self.checked["record"] += 1
        differences = [compare(logged, each) for each in line]
        guessed = logged.coordinator in task.guessed
        task.guessed.discard(logged.coordinator)
        if not all(differences):
            task.remember([each for each, found in zip(line, differences, strict=True) if not found])
            return
        if guessed:
            self.checked["record"] -= 1
            self.unchecked["record after what is not in the log"] += 1
            task.remember([logged])
            return
        for difference in differences[0]:
            what = f"task {logged.id}, after transition {logged.sequence}"
            before, separator, now = difference.partition(", replayed ")
            if not separator:
                before, now = f"the record says otherwise: {difference}", "as its transitions have it"
            self._differs("machine", message, what, before, now)
        task.remember([logged])

    # --- deciders that put what they rest on --------------------------------------------------------------------

    def _decided(self, name: str, message: LoggedMessage) -> None:
        traced = self._traced[name]
        case = msgspec.json.decode(message.payload, type=traced.case)
        now = traced.again(case)
        if now is None:
            self.unchecked["after what is not in the log"] += 1
            return
        self.checked[name] += 1
        logged = {field: getattr(case, field) for field in now}
        if any(_unequal(logged[field], now[field]) for field in now):
            self._differs(name, message, traced.what(case), _shown(logged), _shown(now))

    def _differs(self, decider: str, message: LoggedMessage, what: str, logged: str, now: str) -> None:
        self.diverged += 1
        if len(self.divergences) < MOST_SHOWN:
            self.divergences.append(
                Divergence(decider=decider, log=self._log, at_ns=message.at_ns, what=what, logged=logged, now=now)
            )


def check(
    paths: Sequence[Path],
    *,
    traced: Mapping[str, Traced] = TRACED,
    progress: Callable[[int], None] = lambda _: None,
) -> CheckReport:
    """Make the decisions of some logs again, one log after the other as one recorder wrote them.

    Args:
        paths: the logs.
        traced: the deciders that put what they rest on, by name.
        progress: told how many messages were read.

    Raises:
        NotFoundError: no such file.
        RecordError: one is no MCAP file, or there is no decision in any.
    """
    checker, messages = Checker(traced), 0
    problems: list[str] = []
    for path in paths:
        found: list[str] = []
        for message in read(path, problems=found):
            messages += 1
            checker.take(message, path.name)
            if messages % 5_000 == 0:
                progress(messages)
        problems += [f"{path.name}: {each}" for each in found]
    if not checker.checked and not checker.unchecked:
        raise RecordError(
            f"there is no decision in {_names(paths)}", remedy="record while tasks run, with `swiftbot record`"
        )
    return CheckReport(
        logs=tuple(str(path) for path in paths),
        messages=messages,
        checked=dict(checker.checked),
        unchecked=dict(checker.unchecked),
        tasks=len(checker.tasks),
        divergences=tuple(checker.divergences),
        diverged=checker.diverged,
        problems=tuple(problems),
    )


def _names(paths: Iterable[Path]) -> str:
    return ", ".join(path.name for path in paths)


def _which(event: Transition) -> str:
    where = f" of {event.subtask}, attempt {event.attempt}" if event.subtask else ""
    return f"task {event.task}, transition {event.sequence}: {event.kind}{where}"


def _failed(target: SubtaskRecord, failure: Failure) -> SubtaskRecord:
    """The subtask with this failure of its last attempt, as the policy is shown it."""
    if not target.attempts or target.state is machine.SubtaskState.READY:
        return target
    return replace(target, attempts=(*target.attempts[:-1], replace(target.attempts[-1], failure=failure)))


def _given_up(give_up: bool) -> str:
    return "given up" if give_up else "is repeated"


def _unequal(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) > 1e-6 * max(1.0, abs(one))
    return one != other


def _shown(decision: dict[str, Any]) -> str:
    return ", ".join(f"{name} {_told(value)}" for name, value in decision.items())


def _told(value: Any) -> str:
    match value:
        case None:
            return "nothing"
        case float():
            return f"{value:.3f}"
        case tuple():
            return ", ".join(map(str, cast("tuple[object, ...]", value))) or "nobody"
        case dict():
            return _shown(cast("dict[str, Any]", value))
        case _:
            return str(value)
