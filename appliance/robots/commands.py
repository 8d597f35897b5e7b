"""Commands to robots: the caller's side (`send_command`) and the side that executes them (`CommandDesk`).

A command may take a minute and a query may be lost, so neither side trusts the other to be there the whole time:
the caller asks again with the same id until its deadline, and the desk joins it to the command under way or
answers from the ledger. A desk holds a query for at most `LONG_POLL_S`, so repeated queries do not pile up.

The desk is the same for a MAVLink vehicle (in its gateway) and a Zenoh robot (in the robot): it knows ids,
attempts, actuators and stopping, and nothing of how a verb is done.
"""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import msgspec
import structlog
from msgspec import Struct, field

from appliance.errors import DeadlineError, PayloadError, RobotError, SwiftbotError, UnreachableError
from appliance.model import Failure, RobotCommand, RobotReply, encode
from appliance.plane.session import Session
from appliance.robots.ledger import Ledger, Verdict
from appliance.robots.verbs import RobotFailure, StopArgs, args_of, parse_args

log = structlog.get_logger(__name__)

UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What comes of bytes that are no JSON of the kind; the last: nested a thousand deep."""
LONG_POLL_S = 10.0
"""Longest that a query is held before its caller is told to ask again."""
GRACE_S = 2.0
"""How much longer than that the caller waits for the answer."""
UNREACHABLE_S = 8.0
"""A robot that nobody has answered for so long is given up: a restarting gateway is back sooner."""
_COUNT_S = 1.0
"""How long those that go by a name have to say that they are there."""
_ASK_AGAIN_S = 0.2
_STOP_TIMEOUT_S = 3.0
_MAX_ID = 200
_MAX_WHY = 300


class Done(Struct, frozen=True):
    """A verb's outcome: what the reply's `result` and `blobs` will be."""

    result: dict[str, Any] = field(default_factory=dict[str, Any])
    blobs: dict[str, bytes] = field(default_factory=dict[str, bytes])


class Verb(Struct, frozen=True, kw_only=True):
    """How a robot does one verb. `run` gets the checked arguments and raises RobotFailure when it cannot.

    Cancelling `run` must leave the actuators it uses at rest or let the desk's `halt` do so.
    """

    run: Callable[[Any], Awaitable[Done]]
    uses: tuple[str, ...] = ()
    """Actuators; each does one command at a time."""
    resumable: bool = False
    """A goal that may be taken up again after a restart; not an act that may have happened already."""
    preempts: bool = False
    """Ends what its actuators do instead of being refused as busy."""


class _Running:
    """A command under way. `why` is the failure it will be answered with if its task is cancelled."""

    def __init__(self, command: RobotCommand, uses: tuple[str, ...]) -> None:
        self.command = command
        self.uses = uses
        self.reply: asyncio.Future[RobotReply | None] = asyncio.get_running_loop().create_future()
        self.task: asyncio.Task[None] | None = None
        self.why: Failure | None = None

    def end(self, why: Failure | None) -> None:
        if self.task is not None and self.why is None:
            self.why = why
            self.task.cancel()


class CommandDesk:
    """Takes commands for one robot: each id once, each actuator one at a time.

    `verbs` may be replaced while it runs (a vehicle's type is known by its heartbeat alone). `ready` raises
    RobotFailure while the robot cannot be commanded; `halt` brings the base to rest after a `stop`; `gate` says why a
    command may not be carried out just now (a soft stop, an operator who has the robot), empty when it may.
    """

    def __init__(
        self,
        robot: str,
        *,
        session: Session,
        ledger: Ledger,
        verbs: Mapping[str, Verb],
        ready: Callable[[], None],
        halt: Callable[[], Awaitable[None]],
        refused: dict[str, int],
        gate: Callable[[str, RobotCommand], str] = lambda _, __: "",
    ) -> None:
        self.robot = robot
        self._gate = gate
        self.verbs = verbs
        self._session = session
        self._ledger = ledger
        self._ready = ready
        self._halt = halt
        self._refused = refused
        self._running: dict[str, _Running] = {}
        self._closing = False

    @property
    def busy(self) -> tuple[str, ...]:
        """Verbs under way, oldest first."""
        return tuple(each.command.verb for each in self._running.values())

    async def handle(self, key: str, payload: bytes) -> bytes:
        """Answer one query of the command key; PayloadError when it is no RobotCommand."""
        try:
            command = msgspec.json.decode(payload, type=RobotCommand)
        except UNREADABLE as error:
            self._count("command_malformed")
            raise PayloadError(f"{key}: not a RobotCommand: {error}", remedy="send RobotCommand as JSON") from error
        if not 1 <= len(command.id) <= _MAX_ID:
            self._count("command_malformed")
            raise PayloadError(f"{key}: a command id has 1 to {_MAX_ID} characters")
        return encode(await self.execute(command))

    async def execute(self, command: RobotCommand) -> RobotReply:
        """Do the command, join it, or answer from the ledger; DeadlineError when it takes longer than a long poll."""
        try:
            return await self._decide(command)
        except RobotFailure as error:
            self._count(f"command_{error.failure.code}")
            return RobotReply(id=command.id, failure=error.failure)

    async def _decide(self, command: RobotCommand) -> RobotReply:
        if self._closing:
            raise UnreachableError(f"whoever serves {self.robot} is stopping", remedy="ask again")
        kind = args_of(command.verb)
        verb = self.verbs.get(command.verb)
        if kind is None or (verb is None and command.verb != "stop"):
            known = ", ".join(sorted({*self.verbs, "stop"}))
            raise RobotFailure(
                "refused", f"{self.robot} does not know {command.verb[:40]!r}", remedy=f"it can: {known}"
            )
        verdict, stored = self._ledger.decide(command)
        if verdict is Verdict.STALE:
            raise RobotFailure(
                "refused",
                f"attempt {command.attempt} of {command.task}/{command.subtask} has been overtaken by attempt "
                f"{self._ledger.attempt_of(command)}",
            )
        if command.verb == "stop":
            return await self._stop(command)
        if verb is not None and command.verb == "state":
            return _reply(command, await verb.run(parse_args("state", command.args, kind)))
        running = self._running.get(command.id)
        if running is not None:
            self._ledger.see(command)
            return await self._join(running)
        if verdict is Verdict.ANSWER and stored is not None:
            return stored
        if verb is None:  # cannot be: narrowed above
            raise RobotFailure("refused", f"{self.robot} does not know {command.verb!r}")
        if verdict is Verdict.INTERRUPTED and not verb.resumable:
            raise RobotFailure(
                "robot",
                f"{command.verb} was under way when whoever serves {self.robot} restarted; its outcome is unknown",
                remedy="look at the robot, then give a new command",
            )
        return await self._start(command, verb, kind, announce=verdict is Verdict.NEW)

    async def _start(self, command: RobotCommand, verb: Verb, kind: type[Struct], *, announce: bool) -> RobotReply:
        args = parse_args(command.verb, command.args, kind)
        if why := self._gate(self.robot, command):
            # As busy, since it may be carried out later: handlers wait, and say for what.
            raise RobotFailure("busy", f"{self.robot} is {why}", remedy="wait, or ask them", retryable=True)
        self._ready()
        rivals = [each for each in self._running.values() if set(each.uses) & set(verb.uses)]
        if rivals and not verb.preempts:
            rival = rivals[0]
            shared = " and ".join(sorted(set(rival.uses) & set(verb.uses)))
            raise RobotFailure(
                "busy",
                f"{self.robot}'s {shared} is busy with {rival.command.verb} ({rival.command.id})",
                remedy="wait for it, or stop it",
                retryable=True,
            )
        self._ledger.see(command)
        running = _Running(command, verb.uses)
        self._running[command.id] = running
        running.task = asyncio.create_task(
            self._perform(running, verb, args, rivals=rivals, announce=announce), name=f"{self.robot} {command.verb}"
        )
        running.task.add_done_callback(lambda _: self._ended(running))
        return await self._join(running)

    async def _perform(
        self, running: _Running, verb: Verb, args: Struct, *, rivals: list[_Running], announce: bool
    ) -> None:
        command = running.command
        reply: RobotReply | None = None
        try:
            await self._end(rivals, Failure(code="cancelled", message=f"ended by {_named(command)}"))
            await self._ledger.take(command)
            if announce:
                self._announce(command)
            reply = _reply(command, await verb.run(args))
        except RobotFailure as error:
            reply = RobotReply(id=command.id, failure=error.failure)
        except SwiftbotError as error:
            reply = RobotReply(
                id=command.id, failure=Failure(code=error.code, message=error.message, remedy=error.remedy)
            )
        except asyncio.CancelledError:
            # Without a reason this process is stopping: the entry stays open and is resumed by the next one.
            if running.why is not None:
                reply = RobotReply(id=command.id, failure=running.why)
        except Exception as error:  # supervision boundary: one command's defect must not silence the robot
            log.exception("command failed unexpectedly", robot=self.robot, verb=command.verb, id=command.id)
            reply = RobotReply(id=command.id, failure=Failure(code="internal", message=f"{command.verb}: {error!r}"))
        finally:
            if reply is not None:
                await self._write(command, reply)
                if not running.reply.done():
                    running.reply.set_result(reply)

    def _ended(self, running: _Running) -> None:
        """Clean up; also for a task that was cancelled before its first step."""
        self._running.pop(running.command.id, None)
        if not running.reply.done():
            running.reply.set_result(
                None if running.why is None else RobotReply(id=running.command.id, failure=running.why)
            )

    async def _write(self, command: RobotCommand, reply: RobotReply) -> None:
        try:
            await self._ledger.finish(command, reply)
        except SwiftbotError:
            log.exception("outcome not written to the ledger", robot=self.robot, id=command.id)

    async def _join(self, running: _Running) -> RobotReply:
        try:
            async with asyncio.timeout(LONG_POLL_S):
                reply = await asyncio.shield(running.reply)
        except TimeoutError:
            raise DeadlineError(f"{running.command.verb} is still under way", remedy="ask again, same id") from None
        if reply is None:
            raise UnreachableError(f"whoever serves {self.robot} is stopping", remedy="ask again, same id")
        return reply

    async def _stop(self, command: RobotCommand) -> RobotReply:
        args = parse_args("stop", command.args, StopArgs)
        self._announce(command)
        chosen = [each for each in self._running.values() if args.id is None or each.command.id == args.id]
        moved = args.id is None or any("base" in each.uses for each in chosen)
        why = f": {args.why}" if args.why else ""
        await self._end(chosen, Failure(code="cancelled", message=f"stopped on request{why}"))
        if moved:
            await self._halt()
        return _reply(command, Done({"stopped": [each.command.id for each in chosen]}))

    async def fail_all(self, failure: Failure) -> None:
        """End every command with that failure: the robot is lost."""
        await self._end(list(self._running.values()), failure)

    async def close(self) -> None:
        """End every command without an outcome; callers are told to ask again, and the ledger keeps them open."""
        self._closing = True
        await self._end(list(self._running.values()), None)

    async def _end(self, chosen: list[_Running], why: Failure | None) -> None:
        tasks = [each.task for each in chosen if each.task is not None]
        for each in chosen:
            each.end(why)
        if tasks:
            await asyncio.wait(tasks)

    def _announce(self, command: RobotCommand) -> None:
        self._session.put(self._session.keys.commanded(self.robot), encode(command))

    def _count(self, what: str) -> None:
        self._refused[what] = self._refused.get(what, 0) + 1


def _reply(command: RobotCommand, done: Done) -> RobotReply:
    return RobotReply(id=command.id, result=done.result, blobs=done.blobs)


def _named(command: RobotCommand) -> str:
    """What ended another command, with its reason where it gives one."""
    why = command.args.get("why")
    return f"{command.verb} ({command.id})" + (f": {why}" if isinstance(why, str) and why else "")


_stopping: set[asyncio.Task[None]] = set()
"""Stops on their way, kept from the garbage collector."""


async def send_command(
    session: Session, robot: str, command: RobotCommand, *, timeout_s: float, doubtful: bool = False
) -> RobotReply:
    """Give a robot a command and wait for what comes of it.

    The same id is sent again while the deadline allows, so a lost query, a restarting gateway and a second caller
    with the same command do no harm. Cancelled, or at its deadline, it tells the robot to stop that command.

    `doubtful`: more than one may go by that name, and each would carry it out. Those that answer are counted first.

    Returns:
        The robot's reply; what the robot could not do is in its `failure` and raises nothing.

    Raises:
        UnreachableError: nobody answers for the robot.
        DeadlineError: the command did not end in `timeout_s` seconds.
        RobotError: the answer is no RobotReply.
        SwiftbotError: what else the answering side refused, such as PayloadError.
    """
    if doubtful and (namesakes := await _namesakes(session, robot, command)) is not None:
        return namesakes
    try:
        return await _ask_until(session, robot, command, timeout_s)
    except (asyncio.CancelledError, DeadlineError):
        task = asyncio.get_running_loop().create_task(_send_stop(session, robot, command))
        _stopping.add(task)
        task.add_done_callback(_stopping.discard)
        raise


async def _namesakes(session: Session, robot: str, command: RobotCommand) -> RobotReply | None:
    """Return the refusal of a command that several robots of one name would carry out; None where there is one."""
    if command.verb in ("state", "stop"):
        return None
    asked = RobotCommand(id=f"{command.id[:150]}~who", verb="state")
    count = await session.answerers(session.keys.command(robot), encode(asked), timeout_s=_COUNT_S)
    if count <= 1:
        return None
    session.refuse("namesake robot/*/command", robot=robot, answer=count)
    failure = Failure(
        code="refused",
        message=f"{count} robots answer to the name {robot}, and each would do it",
        remedy="give each a name of its own",
    )
    return RobotReply(id=command.id, failure=failure)


async def _ask_until(session: Session, robot: str, command: RobotCommand, timeout_s: float) -> RobotReply:
    loop = asyncio.get_running_loop()
    heard = loop.time()
    deadline = heard + timeout_s
    key, payload = session.keys.command(robot), encode(command)
    silent: UnreachableError | None = None
    while (remaining := deadline - loop.time()) > 0:
        try:
            answer = await session.query(key, payload, timeout_s=min(remaining, LONG_POLL_S + GRACE_S))
        except DeadlineError:
            heard, silent = loop.time(), None
            continue
        except UnreachableError as error:
            silent = error
            if loop.time() - heard >= UNREACHABLE_S:
                break
            await asyncio.sleep(min(_ASK_AGAIN_S, max(deadline - loop.time(), 0.0)))
            continue
        try:
            return msgspec.json.decode(answer, type=RobotReply)
        except UNREADABLE as error:
            raise RobotError(f"{robot} answered {command.verb} with something else: {error}") from error
    if silent is not None:
        raise UnreachableError(
            f"no answer from robot {robot}: {silent.message}",
            remedy="`swiftbot robots` shows who is online; is its gateway up?",
        ) from silent
    raise DeadlineError(f"{robot} did not end {command.verb} within {timeout_s:g} s", remedy="allow more time")


async def hold_robot(session: Session, robot: str, *, why: str, identity: str, timeout_s: float = 10.0) -> RobotReply:
    """Make a robot hold where it is: what its base does ends with `why`, and it stays until the next command.

    A vehicle in the air hovers, one on the ground stands. A robot that a pilot or a failsafe has is left to them, and
    the reply says so. Same `identity`: same hold.

    Raises:
        UnreachableError, DeadlineError, RobotError: as `send_command`.
    """
    command = RobotCommand(id=identity, verb="hold", args={"why": why[:_MAX_WHY]})
    return await send_command(session, robot, command, timeout_s=timeout_s)


async def _send_stop(session: Session, robot: str, command: RobotCommand) -> None:
    """Best effort: a robot that cannot be reached now will be told by the operator."""
    stop = msgspec.structs.replace(
        command, id=f"{command.id[:150]}~stop{command.attempt}", verb="stop", args={"id": command.id}
    )
    try:
        await session.query(session.keys.command(robot), encode(stop), timeout_s=_STOP_TIMEOUT_S)
    except SwiftbotError as error:
        log.warning("stop not delivered", robot=robot, id=command.id, error=str(error))
