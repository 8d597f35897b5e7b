"""Whether a robot's own program keeps to docs/robot-contract.md: what `swiftbot robots check` runs on a live robot.

Each check is one question to the running robot and a judgement of what comes back; none moves it, but for `moves`. The
robot holds meanwhile: the checks that command it run under an operator's lease, so that no task commands it as well.
Judgements are functions of what was seen, below; asking is `Conformance`.
"""

import asyncio
import math
import secrets
import statistics
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Literal

import msgspec
from msgspec import Struct

from appliance.errors import DeadlineError, RobotError, SwiftbotError, UnreachableError
from appliance.model import Pose, RobotCommand, RobotInfo, RobotReply, encode, keyspace
from appliance.model.robots import plausible, read_robot
from appliance.plane.session import Session
from appliance.robots.executor import UNREADABLE
from appliance.robots.retry import FIRST_SILENCE_S, LONG_POLL_S

WATCH_S = 4.0
"""How long the robot's state is listened to."""
PRESENT_S = 3.0
LEAST_HZ = 1.0
"""How often a robot puts its state at least."""
AT_ONCE_S = 1.0
"""How soon `state`, `stop`, a refusal and a reply that is kept are answered at the latest."""
STATES = 20
"""Questions for the reply times."""
HOLD_S = 3.0
LONG_S = FIRST_SILENCE_S + 2.0
"""A command that takes longer than a question may be held."""
STEP_M = 1.0
NEAR_M = 0.75
"""How far from where it was sent a robot may be when it says that it has arrived."""
MALFORMED = (
    b"",
    b"{",
    b"\xff\xfe\x00",
    b"[1, 2]",
    b'{"id": "", "verb": "state"}',
    b'{"a":' * 2000 + b"1" + b"}" * 2000,
)
NO_VERB = "fly_to_the_moon"

Outcome = Literal["passed", "failed", "skipped"]


class Seen(Struct, frozen=True, kw_only=True):
    """What came of one check: in words, with a remedy where it failed."""

    check: str
    outcome: Outcome
    what: str
    remedy: str = ""
    took_s: float = 0.0


class ReplyTimes(Struct, frozen=True, kw_only=True):
    """Of `state`, milliseconds."""

    count: int
    p50_ms: float
    most_ms: float


class Report(Struct, frozen=True, kw_only=True):
    """All checks of one robot. `passed`: none failed."""

    robot: str
    passed: bool
    checks: tuple[Seen, ...]
    replies: ReplyTimes | None = None


class Answer(Struct, frozen=True, kw_only=True):
    """What came back for one question: a reply or an error; neither: it was no RobotReply."""

    reply: RobotReply | None = None
    error: SwiftbotError | None = None
    took_s: float = 0.0


class Fault(Exception):  # noqa: N818 - what a check found
    """The robot does not keep to the contract: what was seen, and what to change."""

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(what)
        self.what, self.remedy = what, remedy


class Skipped(Exception):  # noqa: N818 - as above
    """A check that does not apply, and why."""


# --- judgements: pure ------------------------------------------------------------------------------------------------


def judge_state(robot: str, told: Sequence[tuple[float, bytes]], watched_s: float) -> tuple[RobotInfo, str]:
    """Return the robot's last state, and in words how often it puts one.

    Args:
        robot: its name.
        told: when each state came, seconds, and its bytes.
        watched_s: how long it was listened to.

    Raises:
        Fault: there is none, it cannot be read, says impossible things, or comes too rarely.
    """
    if not told:
        raise Fault(
            f"no state came in {watched_s:g} s",
            f"put a RobotInfo as JSON on robot/{robot}/state, {LEAST_HZ:g}/s or more",
        )
    states: list[RobotInfo] = []
    for _, payload in told:
        try:
            states.append(read_robot(payload))
        except msgspec.DecodeError as error:
            raise Fault(f"its state is no RobotInfo: {error}", "see docs/schemas/RobotInfo.json") from error
    last = states[-1]
    names = {each.id for each in states}
    if names != {robot}:
        raise Fault(
            f"its state says id {', '.join(sorted(names - {robot}))!r}", f"put id {robot!r}, the name in the key"
        )
    if last.kind != "zenoh":
        raise Fault(f"its state says kind {last.kind[:40]!r}", "a robot that answers itself has kind zenoh")
    if dropped := sorted({name for each in states for name in plausible(each)[1]}):
        raise Fault(f"impossible values in {', '.join(dropped)}", "leave out what is not known; no NaN")
    if missing := [verb for verb in ("state", "stop") if verb not in last.verbs]:
        raise Fault(f"its verbs lack {' and '.join(missing)}", "every robot answers state and stop: name both")
    if "base" in last.uses and last.pose is None:
        raise Fault("it has a base and tells no pose", "put its pose, in metres of the site")
    rate = (len(told) - 1) / (told[-1][0] - told[0][0]) if len(told) > 1 and told[-1][0] > told[0][0] else 0.0
    if rate < LEAST_HZ * 0.9:
        raise Fault(f"its state comes {rate:.1f} times a second", f"put it at least {LEAST_HZ:g} time a second")
    return last, f"{rate:.1f}/s, {len(last.verbs)} verbs"


def judge_speaker(told: Sequence[bytes], answerers: int) -> str:
    """Return which instance speaks; Fault when none is named, or there are several."""
    speakers = Counter(read_robot(each).speaker for each in told)
    if answerers != 1 or len(speakers) > 1:
        raise Fault(
            f"{max(answerers, len(speakers))} programs go by this name",
            "stop all but one, or give each a name of its own",
        )
    if "" in speakers:
        raise Fault(
            "it does not say which instance it is, so those that answer are counted before each order",
            "put `speaker`: made at its start as {time_ns:020d}-{random hex}, the same in each state",
        )
    return f"speaker {next(iter(speakers))}"


def judge_refusal(answer: Answer, what: str) -> str:
    """Return how something that cannot be done is refused; Fault when it is not, or without a reason."""
    code, message = _failure(answer)
    if answer.took_s > AT_ONCE_S + 0.5 or isinstance(answer.error, DeadlineError | UnreachableError):
        raise Fault(f"{what} is not answered", "answer each question: with a failure where it cannot be done")
    if answer.reply is not None and answer.reply.failure is None:
        raise Fault(f"{what} is answered as done", "answer with failure code refused (or payload) and a message")
    if code not in ("refused", "payload") or not message:
        raise Fault(f"{what} is answered with {code or 'something'} {message[:80]!r}", "failure code refused, and why")
    return f"{code}: {message[:80]}"


def judge_repeated(answers: Sequence[Answer], again: Answer, lasts_s: float) -> str:
    """Judge a command that was asked for twice while it ran (`answers`) and once more when it was over (`again`).

    Returns:
        What was seen, in words.

    Raises:
        Fault: it was carried out more than once, or is answered differently.
    """
    remedy = "keep replies by command id: join a command that runs, answer one that has ended with its reply"
    for each in (*answers, again):
        if each.error is not None or each.reply is None or each.reply.failure is not None:
            code, message = _failure(each)
            raise Fault(f"asked again it is answered with {code or 'something else'} {message[:80]!r}", remedy)
    first = answers[0]
    if any(each.reply != first.reply for each in (*answers, again)):
        raise Fault("the same command id is answered with different replies", remedy)
    if max(each.took_s for each in answers) > lasts_s * 1.7:
        raise Fault(
            f"asked twice at once, {lasts_s:g} s took {max(each.took_s for each in answers):.1f} s: it was done twice",
            remedy,
        )
    if again.took_s > min(AT_ONCE_S, max(0.3, first.took_s * 0.7)):
        raise Fault(f"asked again when it was over, it took {again.took_s:.1f} s more: it was done again", remedy)
    if first.took_s < lasts_s * 0.5:
        return "answered alike; it ends too soon to see whether it is done again"
    return f"done once in {first.took_s:.1f} s, and answered three times alike"


def judge_long(first: Answer, last: Answer, lasts_s: float) -> str:
    """Judge a command longer than a question is held: `first` and `last` of its answers."""
    if isinstance(first.error, DeadlineError) and first.took_s < FIRST_SILENCE_S:
        if last.reply is None or last.reply.failure is not None:
            code, message = _failure(last)
            raise Fault(
                f"then it is answered with {code} {message[:80]!r}", "join the running command, and answer its end"
            )
        return f"says after {first.took_s:.1f} s that it is under way, and then what came of it"
    if first.reply is not None and first.took_s < lasts_s * 0.5:
        raise Skipped(f"a hold of {lasts_s:g} s ended after {first.took_s:.1f} s")
    raise Fault(
        f"nothing comes back for {FIRST_SILENCE_S:g} s",
        f"answer within {LONG_POLL_S:g} s, with an error of code deadline: the same id is then asked again",
    )


def judge_stopped(stop: Answer, ended: Answer) -> str:
    """Judge a command that was stopped."""
    if stop.reply is None or stop.reply.failure is not None or stop.took_s > AT_ONCE_S + 0.5:
        code, message = _failure(stop)
        raise Fault(
            f"stop is not done: {code} {message[:80]!r} after {stop.took_s:.1f} s", "always take `stop`, at once"
        )
    code, _ = _failure(ended)
    if code != "cancelled":
        raise Fault(
            f"the stopped command is answered with {code or 'a result'}", "end it at once, with failure code cancelled"
        )
    return f"stopped in {stop.took_s * 1e3:.0f} ms, and told as cancelled"


def judge_arrival(pose: Pose | None, goal: tuple[float, float]) -> str:
    """Judge where a robot is when it has answered a `goto`."""
    if pose is None:
        raise Fault("it tells no pose after a goto", "put its pose")
    away = math.hypot(pose.x - goal[0], pose.y - goal[1])
    if away > NEAR_M:
        raise Fault(f"it answers {away:.1f} m before its goal", "answer goto on arrival, not when it is taken")
    return f"answered {away:.2f} m from its goal"


def _failure(answer: Answer) -> tuple[str, str]:
    if answer.reply is not None and answer.reply.failure is not None:
        return answer.reply.failure.code, answer.reply.failure.message
    return (answer.error.code, answer.error.message) if answer.error is not None else ("", "")


async def is_present(session: Session, robot: str) -> bool:
    """Whether a robot holds its liveliness token.

    By a subscription: in a session that has just been opened a query for tokens has been seen to end without those that
    another subscription of the same session is being told of at that moment (Zenoh 1.10).
    """
    there = asyncio.Event()
    watch = session.watch_alive(
        session.keys(keyspace.ROBOT_ALIVE, robot), lambda _, alive: there.set() if alive else None
    )
    try:
        async with asyncio.timeout(PRESENT_S):
            await there.wait()
    except TimeoutError:
        return False
    else:
        return True
    finally:
        watch.close()


# --- asking ----------------------------------------------------------------------------------------------------------


class Operator(Struct, frozen=True):
    """What the fleet does for a check: `take` the robot over (returns the lease's id), keep it, drive it, give it back.

    `drive` goes to a point of the site, with all its limits looked at, and raises SwiftbotErrors. `give_back` is called
    once, whatever came before, if `take` returned.
    """

    take: Callable[[], Awaitable[str]]
    keep: Callable[[], Awaitable[object]]
    drive: Callable[[float, float], Awaitable[object]]
    give_back: Callable[[], Awaitable[object]]


class Conformance:
    """The checks of one robot.

    Args:
        session: of the fleet.
        robot: its name.
        operator: what the fleet does.
        on_begin: told each check before it runs, and about how long it takes, seconds.
        on_seen: told what came of it.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        operator: Operator,
        *,
        on_begin: Callable[[str, float], None] = lambda _, __: None,
        on_seen: Callable[[Seen], None] = lambda _: None,
    ) -> None:
        self._session, self._robot, self._operator = session, robot, operator
        self._on_begin, self._on_seen = on_begin, on_seen
        self._run = f"check-{secrets.token_hex(6)}"
        self._count = 0
        self._lease = ""
        self._info: RobotInfo | None = None
        self._told: list[tuple[float, bytes]] = []
        self._times: ReplyTimes | None = None
        self._seen: list[Seen] = []

    async def run(self, *, moves: bool = False) -> Report:
        """Run all checks; with `moves` the robot is driven a metre and back.

        Raises:
            SwiftbotError: the fleet does not let the robot be taken over.
        """
        told = self._session.subscribe(
            self._session.keys(keyspace.ROBOT, self._robot),
            lambda message: None if message.deleted else self._told.append((time.monotonic(), message.payload)),
        )
        try:
            await self._check("present", self._present)
            await self._check("state", self._state, WATCH_S)
            await self._check("identity", self._identity, AT_ONCE_S)
            answers = await self._check("answers", self._answers)
            if answers:
                await self._check("unknown verb", self._unknown)
                await self._check("malformed", self._malformed)
                await self._commanded(moves=moves)
            else:
                self._note(Seen(check="commands", outcome="skipped", what="it does not answer `state`"))
        finally:
            told.close()
        failed = any(each.outcome == "failed" for each in self._seen)
        return Report(robot=self._robot, passed=not failed, checks=tuple(self._seen), replies=self._times)

    async def _commanded(self, *, moves: bool) -> None:
        """What commands it, under a lease."""
        self._lease = await self._operator.take()
        try:
            await self._check("hold", self._hold, 1.0)
            await self._check("bad arguments", self._bad_arguments)
            await self._check("same id", self._same_id, 2 * HOLD_S)
            await self._check("old attempt", self._old_attempt)
            await self._check("stop", self._stop, 2.0)
            await self._operator.keep()
            await self._check("long command", self._long, LONG_S)
            if moves:
                await self._operator.keep()
                await self._check("goto", self._goto, 5.0)
        finally:
            # Also where this is cancelled: the robot is at rest, and its tasks go on.
            await self._ask("stop", timeout_s=2.0)
            await self._operator.give_back()

    async def _check(self, name: str, run: Callable[[], Awaitable[str]], about_s: float = 0.0) -> bool:
        self._on_begin(name, about_s)
        began = time.monotonic()
        remedy = ""
        outcome: Outcome
        try:
            outcome, what = "passed", await run()
        except Fault as fault:
            outcome, what, remedy = "failed", fault.what, fault.remedy
        except Skipped as skipped:
            outcome, what = "skipped", str(skipped)
        took_s = round(time.monotonic() - began, 2)
        self._note(Seen(check=name, outcome=outcome, what=what, remedy=remedy, took_s=took_s))
        return outcome == "passed"

    def _note(self, seen: Seen) -> None:
        self._seen.append(seen)
        self._on_seen(seen)

    async def _ask(self, verb: str, *, id_: str = "", timeout_s: float = 3.0, args: dict[str, Any] | None = None,
                   **more: Any) -> Answer:  # fmt: skip
        command = RobotCommand(id=id_ or self._id(), verb=verb, args=args or {}, lease=self._lease, **more)
        return await self._send(encode(command), timeout_s, command.id)

    async def _send(self, payload: bytes, timeout_s: float, id_: str = "") -> Answer:
        began = time.monotonic()
        reply: RobotReply | None = None
        error: SwiftbotError | None = None
        try:
            data = await self._session.query(
                self._session.keys(keyspace.COMMAND, self._robot), payload, timeout_s=timeout_s, sign=True
            )
            reply = msgspec.json.decode(data, type=RobotReply)
            if id_ and reply.id != id_:
                error = RobotError(f"a reply to {reply.id[:60]!r} came for {id_!r}")
        except SwiftbotError as refused:
            error = refused
        except UNREADABLE as unreadable:
            error = RobotError(f"the answer is no RobotReply: {unreadable}")
        return Answer(reply=reply if error is None else None, error=error, took_s=time.monotonic() - began)

    def _id(self) -> str:
        self._count += 1
        return f"{self._run}/{self._count}"

    def _needs(self, verb: str) -> None:
        if self._info is None or verb not in self._info.verbs:
            raise Skipped(f"{verb} is not among its verbs")

    # --- the checks --------------------------------------------------------------------------------------------

    async def _present(self) -> str:
        if not await is_present(self._session, self._robot):
            key = self._session.keys(keyspace.ROBOT_ALIVE, self._robot)
            raise Fault("it holds no liveliness token", f"declare one on {key} while it runs")
        return "holds its liveliness token"

    async def _state(self) -> str:
        await asyncio.sleep(WATCH_S)
        self._info, what = judge_state(self._robot, tuple(self._told), WATCH_S)
        return what

    async def _identity(self) -> str:
        if self._info is None:
            raise Skipped("it puts no state that can be read")
        asked = encode(RobotCommand(id=self._id(), verb="state"))
        count = await self._session.answerers(
            self._session.keys(keyspace.COMMAND, self._robot), asked, timeout_s=AT_ONCE_S
        )
        return judge_speaker([payload for _, payload in self._told], max(1, count))

    async def _answers(self) -> str:
        times: list[float] = []
        for _ in range(STATES):
            answer = await self._ask("state")
            if answer.reply is None or answer.reply.failure is not None:
                code, message = _failure(answer)
                raise Fault(f"`state` is not answered: {code} {message[:100]}", "answer each query on its command key")
            times.append(answer.took_s * 1e3)
            if self._info is not None and "base" in self._info.uses and "pose" not in answer.reply.result:
                raise Fault("the answer to `state` has no pose", "put the fields of its state in the result")
        self._times = ReplyTimes(
            count=len(times), p50_ms=round(statistics.median(times), 2), most_ms=round(max(times), 2)
        )
        if self._times.most_ms > AT_ONCE_S * 1e3:
            raise Fault(
                f"an answer to `state` took {self._times.most_ms:.0f} ms", "answer state at once, whatever it does"
            )
        return f"{STATES} times, p50 {self._times.p50_ms:.1f} ms, at most {self._times.most_ms:.1f} ms"

    async def _unknown(self) -> str:
        return judge_refusal(await self._ask(NO_VERB), "a verb that it does not have")

    async def _malformed(self) -> str:
        silent = 0
        for payload in MALFORMED:
            answer = await self._send(payload, AT_ONCE_S)
            silent += isinstance(answer.error, DeadlineError | UnreachableError)
            if answer.reply is not None and answer.reply.failure is None:
                raise Fault(f"{payload[:20]!r} is answered as done", "refuse what is no RobotCommand with code payload")
        answer = await self._ask("state")
        if answer.reply is None:
            raise Fault("it does not answer any more after malformed questions", "catch what decoding raises")
        return f"{len(MALFORMED)} survived" + (f", {silent} of them unanswered" if silent else ", each answered")

    async def _hold(self) -> str:
        if self._info is not None and "base" in self._info.uses and "hold" not in self._info.verbs:
            raise Fault(
                "it has a base and no verb hold", "every robot with a base answers hold: tasks are halted by it"
            )
        self._needs("hold")
        answer = await self._ask("hold", timeout_s=5.0)
        if answer.reply is None or answer.reply.failure is not None:
            code, message = _failure(answer)
            raise Fault(f"hold is not done: {code} {message[:100]}", "stop where it is, and answer")
        return f"answered in {answer.took_s * 1e3:.0f} ms"

    async def _bad_arguments(self) -> str:
        self._needs("hold")
        return judge_refusal(await self._ask("hold", args={"duration_s": "soon"}), "a duration that is no number")

    async def _same_id(self) -> str:
        self._needs("hold")
        id_, args = self._id(), {"duration_s": HOLD_S}
        patience = 3 * HOLD_S

        async def later() -> Answer:
            await asyncio.sleep(0.3)
            return await self._ask("hold", id_=id_, args=args, timeout_s=patience)

        answers = await asyncio.gather(self._ask("hold", id_=id_, args=args, timeout_s=patience), later())
        again = await self._ask("hold", id_=id_, args=args, timeout_s=patience)
        return judge_repeated(answers, again, HOLD_S)

    async def _old_attempt(self) -> str:
        self._needs("hold")
        of: dict[str, Any] = {"task": self._run, "subtask": "s1"}
        newer = await self._ask("hold", attempt=2, **of)
        if newer.reply is None or newer.reply.failure is not None:
            code, message = _failure(newer)
            raise Fault(f"a command of a task is not done: {code} {message[:100]}", "task and attempt are no obstacle")
        return judge_refusal(await self._ask("hold", attempt=1, **of), "attempt 1 after attempt 2 of the same subtask")

    async def _stop(self) -> str:
        self._needs("hold")
        id_ = self._id()
        holding = asyncio.create_task(self._ask("hold", id_=id_, args={"duration_s": 9.0}, timeout_s=LONG_POLL_S))
        try:
            await asyncio.sleep(0.5)
            if holding.done():
                raise Skipped("a hold of 9 s ended at once")
            stop = await self._ask("stop", args={"id": id_})
            await asyncio.wait({holding}, timeout=2 * AT_ONCE_S)
            if not holding.done():
                raise Fault("the stopped command is not answered", "end it at once, with failure code cancelled")
            return judge_stopped(stop, holding.result())
        finally:
            holding.cancel()

    async def _long(self) -> str:
        self._needs("hold")
        id_, args = self._id(), {"duration_s": LONG_S}
        first = last = await self._ask("hold", id_=id_, args=args, timeout_s=FIRST_SILENCE_S)
        if isinstance(first.error, DeadlineError) and first.took_s < FIRST_SILENCE_S - 0.1:
            last = await self._ask("hold", id_=id_, args=args, timeout_s=FIRST_SILENCE_S)
        return judge_long(first, last, LONG_S)

    async def _goto(self) -> str:
        self._needs("goto")
        start = await self._pose()
        if start is None:
            raise Fault("it tells no pose", "put its pose")
        refused: SwiftbotError | None = None
        for x, y in ((STEP_M, 0.0), (-STEP_M, 0.0), (0.0, STEP_M), (0.0, -STEP_M)):
            goal = (start.x + x, start.y + y)
            try:
                await self._operator.drive(*goal)
            except SwiftbotError as error:
                refused = error
                continue
            what = judge_arrival(await self._pose(), goal)
            await self._operator.drive(start.x, start.y)
            return what
        raise Fault(f"it does not go a metre in any direction: {refused}", "see the reason; put it where there is room")

    async def _pose(self) -> Pose | None:
        answer = await self._ask("state")
        told = answer.reply.result.get("pose") if answer.reply is not None else None
        try:
            return msgspec.convert(told, Pose)
        except msgspec.ValidationError:
            return None
