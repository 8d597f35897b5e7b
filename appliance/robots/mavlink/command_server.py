"""Tasks asked for by MAVLink command: MAV_CMD_USER_1 with a template's number and arguments, and MAV_CMD_MISSION_START.

A ground station's button or a vehicle's script sends COMMAND_LONG (or COMMAND_INT) to component 191, of the gateway's
system or of a vehicle's: param1 is the template, param2 to param7 its arguments. The answers are COMMAND_ACKs:

    IN_PROGRESS             it is being handed in
    ACCEPTED                the task is durable on its replicas; result_param2 is its number (`task_number`)
    TEMPORARILY_REJECTED    the fleet takes none just now, or this sender's last one has not been answered yet
    DENIED                  it cannot be; a STATUSTEXT tells why
    UNSUPPORTED             another command
    CANCELLED               the task is being stopped, as COMMAND_CANCEL wanted

COMMAND_CANCEL stops the task that the sender asked for last by the command that it names, MAV_CMD_USER_2 whichever it
asked for last (for ground stations whose buttons can send commands only). COMMAND_ACK answers by command alone, so a
sender has one outstanding; a repetition of the last one gets the last answer, also from a gateway that was restarted in
between. A repetition is the same command, byte for byte, with `confirmation` above 0; COMMAND_INT has no such field, so
there it is what comes within `REPEAT_S` of the answer. While the first is being handed in the answer to either is
IN_PROGRESS.

A task's sender hears by STATUSTEXT how it goes on (`Progress`), over a restart too: a gateway that was restarted
knows from its store who asked for what last. As soon as such a sender is heard again it gets the state of its task,
and then how it goes on; what it was told of an end before, it is not told again.
"""

import asyncio
import math
import secrets
import struct
import time
import zlib
from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any

import msgspec
import structlog
from msgspec import Struct

from appliance.background import Background
from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import Plan, TaskRecord, TaskRequest, TaskState, encode
from appliance.robots.executor import KeyValues
from appliance.robots.mavlink import dialect, statustext
from appliance.robots.mavlink.dialect import Frame, Message
from appliance.robots.settings import Template
from appliance.robots.task_listener import Tasks

log = structlog.get_logger(__name__)

# --- progress of tasks -----------------------------------------------------------------------------------------------

MAX_FOLLOWED = 1000
"""Tasks whose senders hear how they go on; the oldest is forgotten first."""
_LOOK_S = 1.0
_PASSING = (RefusedError, UnreachableError, DeadlineError)

Reply = Callable[[Message], None]
Reach = Callable[[str, int], Reply | None]
"""A sender (`system-component`) and the system id as which it is spoken to -> how; None while it is not heard."""


class _Told(Struct):
    sender: str
    reply: Reply
    text: str = ""


class Progress:
    """Follows tasks for their senders.

    Args:
        tasks: the fleet's tasks; None where this gateway takes none.
        reach: finds senders of before a restart.
        ended: told each sender and task whose end it has been told.
    """

    def __init__(self, *, tasks: Tasks | None, reach: Reach, ended: Callable[[str, str], None]) -> None:
        self._tasks = tasks
        self._reach = reach
        self._ended = ended
        self._followed: OrderedDict[str, _Told] = OrderedDict()
        self._waiting: dict[str, tuple[str, int]] = {}
        """Tasks of before a restart -> sender, and the system id as which it is spoken to."""
        self._looking: asyncio.Task[None] | None = None
        self._look_at = 0.0

    async def close(self) -> None:
        """Stop."""
        if self._looking is not None:
            self._looking.cancel()
            await asyncio.gather(self._looking, return_exceptions=True)

    def follows(self, task: str) -> bool:
        """Whether somebody follows this task."""
        return task in self._followed

    def follow(self, task: str, sender: str, reply: Reply) -> None:
        """Tell a sender from now on."""
        self._followed[task] = _Told(sender, reply)
        while len(self._followed) > MAX_FOLLOWED:
            self._followed.popitem(last=False)

    def forget(self, task: str) -> None:
        """Tell nobody any more."""
        self._followed.pop(task, None)

    def resume(self, task: str, sender: str, system: int) -> None:
        """Tell a sender of before a restart, once it is heard again."""
        self._waiting[task] = (sender, system)

    def news(self, record: TaskRecord) -> None:
        """Tell a task's sender how it goes on: its state, how many subtasks are done, and in the end why."""
        found = self._followed.get(record.id)
        if found is None:
            return
        done = sum(each.state.final for each in record.subtasks)
        text = f"{record.id} {record.state}"
        if record.state is TaskState.RUNNING:
            text += f" {done}/{len(record.subtasks)}"
        if record.failure is not None:
            text += f": {record.failure.message}"
        if text != found.text:
            failed = record.state is TaskState.FAILED
            severity = statustext.ERROR if failed else statustext.NOTICE if record.state.final else statustext.INFO
            for each in statustext.statustext(text, severity):
                found.reply(each)
            found.text = text
        if record.state.final:
            del self._followed[record.id]
            self._ended(found.sender, record.id)

    def tick(self, now: float) -> None:
        """Look after senders of before a restart, once a second; to be called more often."""
        if not self._waiting or now < self._look_at or (self._looking is not None and not self._looking.done()):
            return
        self._look_at = now + _LOOK_S
        heard = {task: self._reach(*whose) for task, whose in self._waiting.items()}
        there = {task: reply for task, reply in heard.items() if reply is not None}
        if there:
            self._looking = asyncio.create_task(self._catch_up(there), name="MAVLink tasks of before a restart")

    async def _catch_up(self, there: dict[str, Reply]) -> None:
        for task, reply in there.items():
            if self._tasks is None:
                self._waiting.clear()
                return
            sender, _ = self._waiting[task]
            self.follow(task, sender, reply)
            try:
                record = await self._tasks.look(task)
            except SwiftbotError as error:
                self.forget(task)
                if not isinstance(error, _PASSING):
                    log.info("a task of before a restart is not told of", task=task, to=sender, reason=str(error))
                    del self._waiting[task]
                continue
            del self._waiting[task]
            self.news(record)


# --- server ----------------------------------------------------------------------------------------------------------

ASK, CANCEL = dialect.constant("MAV_CMD_USER_1"), dialect.constant("MAV_CMD_USER_2")
MISSION = dialect.MISSION_START
COMMAND_MESSAGES = frozenset(("COMMAND_LONG", "COMMAND_INT", "COMMAND_CANCEL"))
CANCELLED = 6
"""MAV_RESULT_CANCELLED, which pymavlink leaves out with COMMAND_CANCEL."""
STATION = "mavlink-"
"""Before system and component of who asks and is no vehicle of ours: the submitter of its tasks."""
PREFIX = "mavlink/request/"
"""Of the senders' last requests in the gateway's store."""
MAX_SENDERS = 64
"""Whose last request is remembered; the longest silent is forgotten first."""
REPEAT_S = 5.0
"""How long after its last answer a COMMAND_INT that comes again is a repetition. Stations that have not heard an answer
repeat after 0.5 s (MAVSDK) to 3 s (QGroundControl); a person who wants the same again does so later."""
MAX_AT_WORK = 16
"""Requests being carried out at once, of different senders."""
_NOTICE, _ERROR = statustext.NOTICE, statustext.ERROR

"""Errors after which it may be asked again."""


class Asked(Struct, kw_only=True):
    """A sender's last request, kept over a restart. `result` is None until it is answered."""

    parameters: tuple[float | str, ...]
    """In words where it is no finite number, which JSON does not have."""
    task: str
    code: str = ""
    """What came, by `code_of`."""
    at: float = 0.0
    """When it came, or was answered last: seconds of the wall clock, which goes on over a restart."""
    result: int | None = None
    why: str = ""
    command: int = ASK
    system: int = 0
    """The system id that it addressed, as which it is spoken to."""
    ended: bool = False
    """Whether it was told how the task ended."""


class _Work(Struct, frozen=True, kw_only=True):
    """What is being carried out for a sender."""

    code: str
    running: asyncio.Task[None]


def task_number(task: str) -> int:
    """Return the 31-bit number by which MAVLink names a task: the CRC-32 of its id, without the sign."""
    return zlib.crc32(task.encode()) & 0x7FFF_FFFF


def instruction(template: Template, parameters: tuple[float, ...], *, robot: str) -> str:
    """Return a template's text with `{robot}` and `{2}` to `{7}` filled in.

    Args:
        template: what is asked for.
        parameters: param1 to param7.
        robot: the vehicle that asks or is addressed; empty for a ground station that addresses the gateway itself.

    Raises:
        PayloadError: it needs a robot and there is none, or a number that is no number.
    """
    if "{robot}" in template.instruction and not robot:
        raise PayloadError(f"template {template.id} needs a vehicle", remedy="send it to component 191 of the vehicle")
    text = template.instruction.replace("{robot}", robot)
    for place in range(2, 8):
        if f"{{{place}}}" in text:
            value = parameters[place - 1]
            if not math.isfinite(value):
                raise PayloadError(f"template {template.id} needs a number as param{place}")
            text = text.replace(f"{{{place}}}", f"{value:.7f}".rstrip("0").rstrip("."))
    return text


def parameters_of(message: Message) -> tuple[float, ...]:
    """Return param1 to param7 of a COMMAND_LONG, or of a COMMAND_INT, whose x and y are degrees times 1e7."""
    if message.get_type() == "COMMAND_INT":
        place = (message.x / 1e7, message.y / 1e7, message.z)
        return (message.param1, message.param2, message.param3, message.param4, *place)
    return tuple(float(getattr(message, f"param{number}")) for number in range(1, 8))


def code_of(message: Message) -> str:
    """Return what a command says, by which a repetition is known: its bytes, but for the count of repetitions.

    Numbers are compared as they are sent: unused parameters are NaN, MAVLink's "not set", and NaN is not equal to NaN.
    """
    numbers = [getattr(message, f"param{number}") for number in range(1, 5)]
    if message.get_type() == "COMMAND_INT":
        raw = struct.pack("<HB4f2if", message.command, message.frame, *numbers, message.x, message.y, message.z)
    else:
        numbers += [message.param5, message.param6, message.param7]
        raw = struct.pack("<H7f", message.command, *numbers)
    return f"{message.get_type()} {message.target_system} {raw.hex()}"


class CommandServer:
    """Takes requests and answers them.

    Args:
        templates: what may be asked for.
        tasks: the fleet's tasks; None where this gateway takes none, which is answered so.
        store: keeps each sender's last request.
        refused: counters of bad input.
        mission: returns the instruction and plan of a vehicle's mission, by the parameters of MISSION_START; None:
            none are taken here.
        reach: finds senders of before a restart, who hear how their tasks go on.
        clock: seconds of the wall clock.
    """

    def __init__(
        self,
        templates: tuple[Template, ...],
        *,
        tasks: Tasks | None,
        store: KeyValues,
        refused: dict[str, int],
        mission: Callable[[str, tuple[float, ...]], tuple[str, Plan]] | None = None,
        reach: Reach = lambda _sender, _system: None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._clock = clock
        self._templates = {each.id: each for each in templates}
        self._tasks = tasks
        self._store = store
        self._refused = refused
        self._mission = mission
        self._cancelling: dict[str, asyncio.Task[None]] = {}
        self._last: OrderedDict[str, Asked] = OrderedDict()
        self._at_work: dict[str, _Work] = {}
        self._keeping = Background()
        self._progress = Progress(tasks=tasks, reach=reach, ended=self._ended)

    async def load(self) -> None:
        """Read what was asked for before a restart."""
        for key, value in await self._store.scan(PREFIX):
            try:
                sender = key.removeprefix(PREFIX)
                asked = self._last[sender] = msgspec.json.decode(value, type=Asked)
                if asked.result == dialect.ACCEPTED and not asked.ended:
                    self._progress.resume(asked.task, sender, asked.system)
            except msgspec.DecodeError as error:
                log.warning("a kept request cannot be read and is dropped", key=key, reason=str(error))
                await self._store.delete(key)

    async def close(self) -> None:
        """Stop; what is being handed in is asked again by its sender."""
        await self._progress.close()
        running = [*(each.running for each in self._at_work.values()), *self._cancelling.values()]
        for task in running:
            task.cancel()
        await asyncio.gather(*running, *self._keeping.tasks, return_exceptions=True)

    def take(self, frame: Frame, *, robot: str, asker: str = "", reply: Callable[[Message], None]) -> None:
        """Take a command that is for this gateway.

        Args:
            frame: COMMAND_LONG, COMMAND_INT or COMMAND_CANCEL.
            robot: the vehicle that sent it or is addressed by it, which it is about; empty for none.
            asker: the vehicle that sent it, whose the task is; empty for a ground station or another computer.
            reply: sends a message back to the sender, as the component it addressed.
        """
        message = frame.message
        sender = f"{frame.system}-{frame.component}"
        if frame.name == "COMMAND_CANCEL":
            self._take_cancel(sender, frame, reply, asker or f"{STATION}{sender}")
            return
        if message.command not in (ASK, CANCEL, MISSION) or (message.command == MISSION and self._mission is None):
            self._count("command_unsupported")
            self._answer(frame, reply, dialect.UNSUPPORTED)
            return
        code = code_of(message)
        at_work = self._at_work.get(sender)
        if at_work is not None:
            # A repetition while it is being carried out hears the same; anything else has to wait its turn.
            self._answer(frame, reply, dialect.IN_PROGRESS if at_work.code == code else dialect.TEMPORARILY_REJECTED)
            return
        last = self._last.get(sender)
        again = last if last is not None and last.code == code and self._repeated(message, last) else None
        if again is not None and again.result is not None:
            self._reply(frame, reply, again)
            return
        if len(self._at_work) >= MAX_AT_WORK:
            self._count("mavlink_request_rejected")
            self._say(reply, f"{MAX_AT_WORK} requests are being carried out: ask again", _NOTICE)
            self._answer(frame, reply, dialect.TEMPORARILY_REJECTED)
            return
        if again is not None:
            # A gateway before this one did not come to answer.
            work = self._hand_in(sender, frame, reply, again, robot, asker)
        elif message.command != CANCEL:
            work = self._begin(sender, frame, reply, robot, asker)
        else:
            work = self._cancel(sender, frame, reply, last, asker or f"{STATION}{sender}")
        running = asyncio.create_task(work, name=f"MAVLink request of {sender}")
        self._at_work[sender] = _Work(code=code, running=running)
        running.add_done_callback(partial(self._done, sender))

    def _done(self, sender: str, running: asyncio.Task[None] | None = None) -> None:
        """A sender's request has its answer: what it sends from now on is looked at by itself.

        Called before the answer is sent, since a repetition may come before this program's task has ended.
        """
        at_work = self._at_work.get(sender)
        if at_work is not None and running in (None, at_work.running):
            del self._at_work[sender]

    def _repeated(self, message: Message, last: Asked) -> bool:
        """Whether a command that says the same as the sender's last one is that again, and not another order."""
        if message.command == CANCEL:
            return False
        if message.get_type() == "COMMAND_LONG":
            return bool(message.confirmation)
        return 0.0 <= self._clock() - last.at <= REPEAT_S

    # --- asking ------------------------------------------------------------------------------------------------

    async def _begin(self, sender: str, frame: Frame, reply: Callable[[Message], None], robot: str, asker: str) -> None:
        asked = Asked(
            parameters=tuple(each if math.isfinite(each) else str(each) for each in parameters_of(frame.message)),
            task=f"m-{secrets.token_hex(6)}",
            code=code_of(frame.message),
            at=self._clock(),
            command=frame.message.command,
            system=frame.target_system,
        )
        self._last[sender] = asked
        self._last.move_to_end(sender)
        while len(self._last) > MAX_SENDERS:
            silent, _ = self._last.popitem(last=False)
            await self._store.delete(PREFIX + silent)
        await self._hand_in(sender, frame, reply, asked, robot, asker)

    async def _hand_in(
        self, sender: str, frame: Frame, reply: Callable[[Message], None], asked: Asked, robot: str, asker: str
    ) -> None:
        self._answer(frame, reply, dialect.IN_PROGRESS)
        try:
            request = self._request(asked, robot=robot, submitter=asker or f"{STATION}{sender}")
            # Kept before it is handed in: repeated after a crash here it is the same task.
            await self._store.put(PREFIX + sender, encode(asked))
            self._progress.follow(asked.task, sender, reply)
            if self._tasks is None:
                raise PayloadError("this gateway takes no tasks")
            await self._tasks.submit(request)
            asked.result = dialect.ACCEPTED
            log.info("task by MAVLink", task=asked.task, sender=sender, instruction=request.instruction)
        except SwiftbotError as error:
            passing = isinstance(error, _PASSING)
            asked.result = dialect.TEMPORARILY_REJECTED if passing else dialect.DENIED
            asked.why = str(error)
            self._progress.forget(asked.task)
            self._count("mavlink_request_rejected" if passing else "mavlink_request_denied")
            log.warning("task by MAVLink is refused", sender=sender, reason=str(error))
        asked.at = self._clock()
        try:
            if asked.result == dialect.TEMPORARILY_REJECTED:
                await self._store.delete(PREFIX + sender)
                self._last.pop(sender, None)  # a repetition is to be tried again
            else:
                await self._store.put(PREFIX + sender, encode(asked))
        except SwiftbotError as error:
            log.warning("the answer to a request could not be kept", sender=sender, reason=str(error))
        self._done(sender)
        self._reply(frame, reply, asked)

    def _request(self, asked: Asked, *, robot: str, submitter: str) -> TaskRequest:
        parameters = tuple(float(each) for each in asked.parameters)
        if asked.command == MISSION and self._mission is not None:
            text, plan = self._mission(robot, parameters)
            return TaskRequest(instruction=text, id=asked.task, submitter=submitter, plan=plan)
        number = parameters[0]
        template = self._templates.get(int(number)) if math.isfinite(number) else None
        if template is None:
            known = ", ".join(str(each) for each in sorted(self._templates)) or "none"
            raise PayloadError(f"no template {number:g}; known: {known}", remedy="add it to robots.templates")
        text = instruction(template, parameters, robot=robot)
        return TaskRequest(instruction=text, id=asked.task, submitter=submitter)

    async def _cancel(
        self, sender: str, frame: Frame, reply: Callable[[Message], None], last: Asked | None, by: str
    ) -> None:
        if last is None or self._tasks is None:
            self._say(reply, "no task of yours is known here", _ERROR)
            self._answer(frame, reply, dialect.DENIED)
            return
        self._answer(frame, reply, dialect.IN_PROGRESS)
        number = 0
        try:
            record = await self._tasks.cancel(last.task, by)
        except SwiftbotError as error:
            self._say(reply, error.message, _ERROR)
            result = dialect.DENIED if isinstance(error, NotFoundError) else dialect.TEMPORARILY_REJECTED
        else:
            number = task_number(last.task)
            ended = record.state.final and record.state is not TaskState.CANCELLED
            result = dialect.DENIED if ended else dialect.ACCEPTED
            if ended:
                self._say(reply, f"{last.task} had {record.state} already", _NOTICE)
        self._done(sender)
        self._answer(frame, reply, result, number=number)

    def _take_cancel(self, sender: str, frame: Frame, reply: Callable[[Message], None], by: str) -> None:
        """Take a COMMAND_CANCEL; its repetitions while it is carried out need no answer of their own."""
        if frame.message.command not in (ASK, MISSION):
            self._count("command_unsupported")
            self._say(reply, f"command {frame.message.command} is not cancelled here", _NOTICE)
            return
        if sender in self._cancelling:
            return
        if len(self._cancelling) >= MAX_AT_WORK:
            self._count("mavlink_request_rejected")
            return  # it is sent again until it is answered
        work = self._cancel_asked(sender, frame, reply, by)
        self._cancelling[sender] = asyncio.create_task(work, name=f"MAVLink cancel of {sender}")
        self._cancelling[sender].add_done_callback(lambda _: self._cancelling.pop(sender, None))

    async def _cancel_asked(self, sender: str, frame: Frame, reply: Callable[[Message], None], by: str) -> None:
        """Stop the sender's last task by that command, once it is known whether there is one."""
        at_work = self._at_work.get(sender)
        if at_work is not None:
            await asyncio.wait([at_work.running])
        last = self._last.get(sender)
        if last is None or last.command != frame.message.command or last.result != dialect.ACCEPTED or not self._tasks:
            self._say(reply, "no task of yours is known here", _ERROR)
            self._answer(frame, reply, dialect.DENIED)
            return
        try:
            record = await self._tasks.cancel(last.task, by)
        except SwiftbotError as error:
            self._say(reply, error.message, _ERROR)
            if isinstance(error, NotFoundError):
                self._answer(frame, reply, dialect.DENIED)
            return  # it is sent again until it is answered
        ended = record.state.final and record.state is not TaskState.CANCELLED
        if ended:
            self._say(reply, f"{last.task} had {record.state} already", _NOTICE)
        self._answer(frame, reply, dialect.ACCEPTED if ended else CANCELLED, number=task_number(last.task))

    # --- telling -----------------------------------------------------------------------------------------------

    def follows(self, task: str) -> bool:
        """Whether somebody follows this task."""
        return self._progress.follows(task)

    def news(self, record: TaskRecord) -> None:
        """Tell a task's sender how it goes on."""
        self._progress.news(record)

    def tick(self, now: float) -> None:
        """Tell senders of before a restart, once they are heard; to be called some twenty times a second."""
        self._progress.tick(now)

    def _ended(self, sender: str, task: str) -> None:
        """Keep that a sender knows its last task's end."""
        last = self._last.get(sender)
        if last is not None and last.task == task:
            last.ended = True
            self._keeping.start(self._keep(sender, last), f"end of {task}")

    async def _keep(self, sender: str, asked: Asked) -> None:
        try:
            await self._store.put(PREFIX + sender, encode(asked))
        except SwiftbotError as error:
            log.warning("the answer to a request could not be kept", sender=sender, reason=str(error))

    def _reply(self, frame: Frame, reply: Callable[[Message], None], asked: Asked) -> None:
        asked.at = self._clock()  # this answer may be lost as the one before
        if asked.why:
            self._say(reply, asked.why, _ERROR)
        self._answer(frame, reply, asked.result or dialect.ACCEPTED, number=task_number(asked.task))

    def _answer(self, frame: Frame, reply: Callable[[Message], None], result: int, *, number: int = 0) -> None:
        fields: dict[str, Any] = {
            "command": frame.message.command,
            "result": result,
            "progress": 255 if result == dialect.IN_PROGRESS else 0,
            "result_param2": number,
            "target_system": frame.system,
            "target_component": frame.component,
        }
        reply(dialect.make("COMMAND_ACK", **fields))

    def _say(self, reply: Callable[[Message], None], text: str, severity: int) -> None:
        """Send a STATUSTEXT."""
        for each in statustext.statustext(text, severity):
            reply(each)

    def _count(self, what: str) -> None:
        self._refused[what] = self._refused.get(what, 0) + 1
