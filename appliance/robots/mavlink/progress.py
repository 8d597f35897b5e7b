"""How tasks that were asked for by MAVLink command go on: told to their senders by STATUSTEXT, over a restart too.

A gateway that was restarted knows from its store who asked for what last. As soon as such a sender is heard again it is
told how its task stands, and then how it goes on; what it was told of an end before, it is not told again.
"""

import asyncio
from collections import OrderedDict
from collections.abc import Callable

import structlog
from msgspec import Struct

from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, TaskState
from appliance.robots.doors import Tasks
from appliance.robots.mavlink import texts
from appliance.robots.mavlink.dialect import Message

log = structlog.get_logger(__name__)

MAX_FOLLOWED = 1000
"""Tasks whose senders are told how they go on; the oldest is forgotten first."""
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
        """Whether somebody is told how this task goes on."""
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
            severity = texts.ERROR if failed else texts.NOTICE if record.state.final else texts.INFO
            for each in texts.statustext(text, severity):
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
