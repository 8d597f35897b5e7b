"""Commands to robots: the side that executes them (`CommandDesk`); the caller's is in `sending`.

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

from appliance.errors import DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import Failure, RobotCommand, RobotReply, encode
from appliance.plane.session import Session
from appliance.robots.ledger import Ledger, Verdict
from appliance.robots.patience import LONG_POLL_S
from appliance.robots.verbs import RobotFailure, StopArgs, args_of, parse_args

log = structlog.get_logger(__name__)

UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What comes of bytes that are no JSON of the kind; the last: nested a thousand deep."""
MAX_ID = 200


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
        if not 1 <= len(command.id) <= MAX_ID:
            self._count("command_malformed")
            raise PayloadError(f"{key}: a command id has 1 to {MAX_ID} characters")
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
