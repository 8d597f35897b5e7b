"""Commands to robots: the side that executes them, each at most once. The caller's side is in `sender`.

A command may take a minute and a query may be lost, so neither side trusts the other to be there the whole time:
the caller asks again with the same id until its deadline, and the executor joins it to the command under way or
answers from the idempotency log. It holds a query for at most `LONG_POLL_S`, so repeated queries do not pile up.

The executor is the same for a MAVLink vehicle (in its gateway) and a Zenoh robot (in the robot): it knows ids,
attempts, actuators and stopping, and nothing of how a verb is done.

The idempotency log says which commands a robot has taken up and what came of them, so that none is done twice. A
handler that is run again, a query that is repeated after a lost reply, a gateway that died between the two: all repeat
the same command id. An entry is written before the robot moves and completed before the reply is sent.

Rules (pure, `IdempotencyLog.decide`):
1. a lower attempt than was seen of that task and subtask is refused: its coordinator has given up on it;
2. an id under way is joined, an id that succeeded is answered with the stored reply;
3. an id that failed is answered the same to the same attempt, and done again for a higher one;
4. an id taken up before a restart of the process that serves the robot, without an outcome, is resumed where the verb
   is a goal (going somewhere, being landed) and answered as unknown where it is an act (picking, recording).
"""

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from enum import Enum, auto
from typing import Any, Protocol, TypeVar

import msgspec
import structlog
from msgspec import Struct, field

from appliance.errors import DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import Failure, RobotCommand, RobotReply, encode, keyspace
from appliance.plane.session import Session
from appliance.robots.retry import LONG_POLL_S
from appliance.robots.verbs import RobotFailure, StopArgs, args_of, parse_args

log = structlog.get_logger(__name__)

# --- idempotency log -------------------------------------------------------------------------------------------------

MAX_BLOB_BYTES = 64 * 2**20
"""Of all remembered replies of one robot; pictures of the oldest are forgotten first."""


class KeyValues(Protocol):
    """What the log needs of the plane's Store."""

    async def put(self, key: str, value: bytes) -> None:
        """Write durably."""
        ...

    async def delete(self, key: str) -> object:
        """Remove."""
        ...

    async def scan(self, prefix: str) -> list[tuple[str, bytes]]:
        """Return keys and values under a prefix."""
        ...


class Entry(Struct, frozen=True, kw_only=True):
    """A command taken up; `reply` is None while it is under way. `number` orders entries by age."""

    number: int
    command: RobotCommand
    reply: RobotReply | None = None


class Verdict(Enum):
    """What to do with a command."""

    NEW = auto()
    """Take it up."""
    ANSWER = auto()
    """Answer with the stored reply."""
    INTERRUPTED = auto()
    """Taken up before a restart, outcome unknown."""
    STALE = auto()
    """A higher attempt has been seen."""


class IdempotencyLog:
    """Idempotency log of one robot: in memory, and in `store` where there is one."""

    def __init__(self, robot: str, store: KeyValues | None = None, *, limit: int = 1000) -> None:
        self._store = store
        self._prefix = f"robots/ledger/{robot}/"
        self._limit = limit
        self._entries: OrderedDict[str, Entry] = OrderedDict()
        self._attempts: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._blob_bytes = 0
        self._next = 0

    def __len__(self) -> int:
        return len(self._entries)

    async def load(self) -> None:
        """Read what an earlier process wrote; an entry that cannot be read is logged and dropped."""
        if self._store is None:
            return
        found: list[Entry] = []
        for key, value in await self._store.scan(self._prefix):
            try:
                found.append(msgspec.json.decode(value, type=Entry))
            except msgspec.DecodeError as error:
                log.warning("ledger entry unreadable, dropped", key=key, error=str(error))
                await self._store.delete(key)
        for entry in sorted(found, key=lambda each: each.number):
            self._remember(entry)
        for identity in self._overflow():
            await self._store.delete(self._prefix + identity)

    def decide(self, command: RobotCommand) -> tuple[Verdict, RobotReply | None]:
        """Say what to do with a command that is not under way; ANSWER comes with the reply."""
        if command.attempt < self.attempt_of(command):
            return Verdict.STALE, None
        entry = self._entries.get(command.id)
        if entry is None:
            return Verdict.NEW, None
        if entry.reply is None:
            return Verdict.INTERRUPTED, None
        if entry.reply.failure is not None and command.attempt > entry.command.attempt:
            return Verdict.NEW, None
        return Verdict.ANSWER, entry.reply

    def attempt_of(self, command: RobotCommand) -> int:
        """Return the highest attempt seen of the command's task and subtask, 0 when none."""
        return self._attempts.get((command.task, command.subtask), 0) if command.task else 0

    def see(self, command: RobotCommand) -> None:
        """Fence off lower attempts from now on, before anything is awaited."""
        if not command.task:
            return
        key = (command.task, command.subtask)
        self._attempts[key] = max(self._attempts.get(key, 0), command.attempt)
        self._attempts.move_to_end(key)
        while len(self._attempts) > self._limit:
            self._attempts.popitem(last=False)

    async def take(self, command: RobotCommand) -> None:
        """Write that the command is taken up; durable when it returns."""
        await self._write(Entry(number=self._next, command=command))

    async def finish(self, command: RobotCommand, reply: RobotReply) -> None:
        """Write the command's outcome; durable when it returns."""
        await self._write(Entry(number=self._next, command=command, reply=reply))

    async def _write(self, entry: Entry) -> None:
        self._remember(entry)
        dropped = self._overflow()
        if self._store is not None:
            await self._store.put(self._prefix + entry.command.id, msgspec.json.encode(entry))
            for identity in dropped:
                await self._store.delete(self._prefix + identity)

    def _remember(self, entry: Entry) -> None:
        self._next = max(self._next, entry.number) + 1
        self._forget(entry.command.id)
        self._entries[entry.command.id] = entry
        self._blob_bytes += _size(entry)
        self.see(entry.command)

    def _forget(self, identity: str) -> None:
        entry = self._entries.pop(identity, None)
        if entry is not None:
            self._blob_bytes -= _size(entry)

    def _overflow(self) -> list[str]:
        """Drop the oldest entries over the bounds, never the newest; return their ids.

        One that is still under way may go too: its executor knows it, and its outcome makes a new entry.
        """
        dropped: list[str] = []
        while len(self._entries) > 1 and (len(self._entries) > self._limit or self._blob_bytes > MAX_BLOB_BYTES):
            identity = next(iter(self._entries))
            self._forget(identity)
            dropped.append(identity)
        return dropped


def _size(entry: Entry) -> int:
    return 0 if entry.reply is None else sum(len(blob) for blob in entry.reply.blobs.values())


# --- executor --------------------------------------------------------------------------------------------------------

UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What comes of bytes that are no JSON of the kind; the last: nested a thousand deep."""
MAX_ID = 200


class Done(Struct, frozen=True):
    """A verb's outcome: what the reply's `result` and `blobs` will be."""

    result: dict[str, Any] = field(default_factory=dict[str, Any])
    blobs: dict[str, bytes] = field(default_factory=dict[str, bytes])


class Verb(Struct, frozen=True, kw_only=True):
    """How a robot does one verb. `run` gets the checked arguments and raises RobotFailure when it cannot.

    Cancelling `run` must leave the actuators it uses at rest or let the executor's `halt` do so.
    """

    run: Callable[[Any], Awaitable[Done]]
    uses: tuple[str, ...] = ()
    """Actuators; each does one command at a time."""
    resumable: bool = False
    """A goal that may be taken up again after a restart; not an act that may have happened already."""
    preempts: bool = False
    """Ends what its actuators do instead of being refused as busy."""


M = TypeVar("M", bound=Callable[..., Awaitable[Done]])


class Terms(Struct, frozen=True, kw_only=True):
    """How the method that bears its name carries out a verb; the rest as of `Verb`."""

    uses: tuple[str, ...] = ("base",)
    resumable: bool = True
    preempts: bool = False
    guarded: bool = True
    """Refused while somebody else has the robot."""
    safe: bool = False
    """Not refused while a failsafe has it, being what a failsafe would do."""
    flying: bool = False
    """For robots that fly alone."""


_TERMS: dict[object, Terms] = {}


def verb(terms: Terms = Terms()) -> Callable[[M], M]:  # noqa: B008 - frozen
    """Make a method `(args) -> Done` what carries out the verb of its name (`verbs_of` finds it)."""

    def register(method: M) -> M:
        _TERMS[method] = terms
        return method

    return register


def verbs_of(*parts: object, check: Callable[[bool], None], flies: bool) -> dict[str, Verb]:
    """Return the verbs that the methods of some parts of a robot carry out.

    Args:
        parts: objects with methods that are marked by `verb`.
        check: raises RobotFailure while somebody else has the robot; gets whether the verb is a safe one.
        flies: whether it flies.
    """
    found: dict[str, Verb] = {}
    for part in parts:
        for name, method in vars(type(part)).items():
            terms = _TERMS.get(method)
            if terms is not None and (flies or not terms.flying):
                found[name] = _verb(getattr(part, name), terms, check)
    return found


def _verb(run: Callable[[Any], Awaitable[Done]], terms: Terms, check: Callable[[bool], None]) -> Verb:
    async def guarded(args: object) -> Done:
        check(terms.safe)
        return await run(args)

    return Verb(
        run=guarded if terms.guarded else run, uses=terms.uses, resumable=terms.resumable, preempts=terms.preempts
    )


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


class CommandExecutor:
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
        ledger: IdempotencyLog,
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
        """Do the command, join it, or answer from the log; DeadlineError when it takes longer than a long poll."""
        try:
            return await self._decide(command)
        except RobotFailure as error:
            self._count(f"command_{error.failure.code}")
            return RobotReply(id=command.id, failure=error.failure)

    async def _decide(self, command: RobotCommand) -> RobotReply:
        if self._closing:
            raise UnreachableError(f"the server of {self.robot} is stopping", remedy="ask again")
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
                f"{command.verb} was under way when the server of {self.robot} restarted; its outcome is unknown",
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
            raise UnreachableError(f"the server of {self.robot} is stopping", remedy="ask again, same id")
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
        """End every command without an outcome; callers have to ask again, and the log keeps them open."""
        self._closing = True
        await self._end(list(self._running.values()), None)

    async def _end(self, chosen: list[_Running], why: Failure | None) -> None:
        tasks = [each.task for each in chosen if each.task is not None]
        for each in chosen:
            each.end(why)
        if tasks:
            await asyncio.wait(tasks)

    def _announce(self, command: RobotCommand) -> None:
        self._session.publish(keyspace.COMMANDED, command, self.robot)

    def _count(self, what: str) -> None:
        self._refused[what] = self._refused.get(what, 0) + 1


def _reply(command: RobotCommand, done: Done) -> RobotReply:
    return RobotReply(id=command.id, result=done.result, blobs=done.blobs)


def _named(command: RobotCommand) -> str:
    """What ended another command, with its reason where it gives one."""
    why = command.args.get("why")
    return f"{command.verb} ({command.id})" + (f": {why}" if isinstance(why, str) and why else "")
