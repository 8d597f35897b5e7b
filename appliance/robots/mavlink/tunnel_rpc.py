"""Tasks asked for in words over MAVLink: JSON messages through TUNNEL frames (`tunnel`).

From a robot or ground station:

    {"op": "submit", "id": "r1-42", "instruction": "..."}   the sender chooses the id: sent again, it is the same task
    {"op": "submit", "id": "r1-42", "request": {...}}       the same as a TaskRequest (docs/schemas), with a plan, say;
                                                            its id and submitter are the sender's
    {"op": "follow", "id": "r1-42"}                         tell how a task goes on, after a restart of either end
    {"op": "cancel", "id": "r1-42"}

and back (`to`: the op that is answered):

    {"op": "accepted", "to", "id", "state"}                 durable on its replicas
    {"op": "rejected", "to", "id", "code", "message", "remedy", "retry"}
    {"op": "news", "id", "state", "done", "total", "message"}   how it stands now, on a change, until a final state;
                                                            then also "results", by subtask, as far as 8 KiB hold
                                                            them. What changes before the last news have arrived is
                                                            told as one
"""

import secrets
from collections import OrderedDict
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
import structlog
from msgspec import Meta, Struct, field

from appliance.background import Background
from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, TaskRequest, encode
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.command_server import STATION
from appliance.robots.mavlink.dialect import Frame, Message
from appliance.robots.mavlink.tunnel import MAX_PAYLOAD, PAYLOAD_TYPE, SILENT, Channel, NotDelivered
from appliance.robots.task_listener import Tasks, own

log = structlog.get_logger(__name__)

MAX_SENDERS = 64
"""Other ends with a conversation; the longest silent one is forgotten first."""
MAX_AT_WORK = 16
"""Messages being carried out at once."""
MAX_FOLLOWED = 1000
"""Tasks whose senders hear how they go on; the one asked for longest ago is forgotten first."""
MOST_RESULTS = 8 * 1024
"""Bytes of results that are sent; what is larger is looked up by the task's id."""
MOST_WORDS = 700
"""Characters of a reason: two of them fit into a message however they are written in JSON."""
MOST_NEWS = 256
"""Tasks whose news wait for one sender; beyond, the oldest are left to its asking."""
_PASSING = (RefusedError, UnreachableError, DeadlineError)


class TunnelMessage(Struct, frozen=True, kw_only=True):
    """What a sender wants. Fields of later versions are ignored."""

    op: Literal["submit", "follow", "cancel"]
    id: Annotated[str, Meta(max_length=MOST_WORDS)]
    instruction: str = ""
    request: TaskRequest | None = None


class Answer(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What it gets."""

    op: Literal["accepted", "rejected", "news"]
    id: str
    to: str = ""
    state: str = ""
    done: int = 0
    total: int = 0
    code: str = ""
    message: str = ""
    remedy: str = ""
    retry: bool = False
    results: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])


class _Sender:
    """One other end."""

    def __init__(self, key: tuple[int, int], reply: Callable[[Message], None]) -> None:
        self.key = key
        self.name = ""
        """Whose its tasks are: the vehicle that speaks, not one that it addresses."""
        self.reply = reply
        self.channel = Channel(lambda: secrets.randbits(32))
        self.news: OrderedDict[str, bytes] = OrderedDict()
        """Task -> what is to be told of it: the last, where more has changed since it could be told."""
        self._telling: dict[str, int] = {}
        """Task -> the message by which it is being told."""

    def tell(self, task: str, said: bytes, now: float) -> None:
        """Tell news of a task, now or as soon as there is room and the last ones have arrived."""
        self.news[task] = said
        if len(self.news) > MOST_NEWS:
            self.news.popitem(last=False)
        self.go_on(now)

    def go_on(self, now: float) -> None:
        """Send what can be sent of the news that wait."""
        self._telling = {task: number for task, number in self._telling.items() if self.channel.going(number)}
        for task in [task for task in self.news if task not in self._telling]:
            try:
                self._telling[task] = self.channel.send(self.news[task], now)
            except NotDelivered:
                return
            del self.news[task]

    def lost(self) -> dict[int, str]:
        """Take out what could not be delivered, and why. What waits for one that is not there goes too: it will ask."""
        failed = dict(self.channel.failed)
        self.channel.failed.clear()
        if SILENT in failed.values():
            self.news.clear()
        return failed


class TunnelServer:
    """Takes messages and answers them.

    Args:
        tasks: the fleet's tasks; None where this gateway takes none, which is answered so.
        refused: counters of bad input.
        clock: monotonic seconds.
    """

    def __init__(self, *, tasks: Tasks | None, refused: dict[str, int], clock: Callable[[], float]) -> None:
        self._tasks = tasks
        self._refused = refused
        self._clock = clock
        self._senders: OrderedDict[tuple[int, int], _Sender] = OrderedDict()
        self._followed: OrderedDict[str, dict[tuple[int, int], bytes]] = OrderedDict()
        """Task -> who follows it, and what they got last."""
        self._at_work = Background()

    async def close(self) -> None:
        """Stop; senders without an answer send again."""
        await self._at_work.close()

    def take(self, frame: Frame, *, asker: str = "", reply: Callable[[Message], None]) -> None:
        """Take a TUNNEL frame of this protocol that is for this gateway; arguments as `CommandServer.take`."""
        message = frame.message
        key = (frame.system, frame.component)
        sender = self._senders.get(key)
        if sender is None:
            sender = self._senders[key] = _Sender(key, reply)
            while len(self._senders) > MAX_SENDERS:
                self._senders.popitem(last=False)
        self._senders.move_to_end(key)
        sender.reply = reply
        sender.name = asker or f"{STATION}{frame.system}-{frame.component}"
        payload = bytes(message.payload[: min(message.payload_length, MAX_PAYLOAD)])
        before = sender.channel.malformed
        whole = sender.channel.take(payload, self._clock())
        if sender.channel.malformed > before:
            self._count("tunnel_malformed")
        if whole is not None:
            self._read(sender, whole)

    def tick(self) -> None:
        """Send what is due; to be called some twenty times a second."""
        now = self._clock()
        for (system, component), sender in self._senders.items():
            if sender.news:
                sender.go_on(now)
            for payload in sender.channel.due(now):
                sender.reply(
                    dialect.make(
                        "TUNNEL",
                        target_system=system,
                        target_component=component,
                        payload_type=PAYLOAD_TYPE,
                        payload_length=len(payload),
                        payload=list(payload.ljust(MAX_PAYLOAD, b"\0")),
                    )
                )
            for reason in sender.lost().values():
                log.info("an answer over MAVLink was not delivered", to=sender.name, reason=reason)

    def follows(self, task: str) -> bool:
        """Whether somebody follows this task."""
        return task in self._followed

    def news(self, record: TaskRecord) -> None:
        """Tell a task's senders how it goes on."""
        found = self._followed.get(record.id)
        if found is None:
            return
        said = encode(_news(record))
        for key, told in list(found.items()):
            sender = self._senders.get(key)
            if sender is None:
                del found[key]  # forgotten: when it speaks again it asks
            elif said != told:
                found[key] = said
                sender.tell(record.id, said, self._clock())
        if record.state.final or not found:
            del self._followed[record.id]

    # --- inside ------------------------------------------------------------------------------------------------

    def _read(self, sender: _Sender, data: bytes) -> None:
        try:
            letter = msgspec.json.decode(data, type=TunnelMessage)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            self._count("tunnel_malformed")
            self._say(
                sender, Answer(op="rejected", id="", code="payload", message=f"not understood: {error}"[:MOST_WORDS])
            )
            return
        if self._at_work.count >= MAX_AT_WORK:
            self._reject(sender, letter, RefusedError("too many messages are being carried out"))
            return
        self._at_work.start(self._carry_out(sender, letter), f"MAVLink letter of {sender.name}")

    async def _carry_out(self, sender: _Sender, letter: TunnelMessage) -> None:
        new = self._follow(letter.id, sender)
        try:
            if self._tasks is None:
                raise RefusedError("this gateway takes no tasks")
            if letter.op == "submit":
                request = letter.request or TaskRequest(instruction=letter.instruction)
                record = await self._tasks.submit(own(request, identity=letter.id, submitter=sender.name))
                log.info("task by MAVLink", task=record.id, sender=sender.name, instruction=request.instruction[:200])
            elif letter.op == "cancel":
                record = await self._tasks.cancel(letter.id, sender.name)
            else:
                record = await self._tasks.look(letter.id)
        except SwiftbotError as error:
            if new:
                self._unfollow(letter.id, sender)
            self._reject(sender, letter, error)
            return
        self._say(sender, Answer(op="accepted", to=letter.op, id=letter.id, state=record.state))
        if record.sequence > 1:
            self.news(record)

    def _follow(self, task: str, sender: _Sender) -> bool:
        """Tell a sender how a task goes on, from how it stands now; whether it was not told before."""
        found = self._followed.setdefault(task, {})
        new = sender.key not in found
        found[sender.key] = b""
        self._followed.move_to_end(task)
        while len(self._followed) > MAX_FOLLOWED:
            self._followed.popitem(last=False)
        return new

    def _unfollow(self, task: str, sender: _Sender) -> None:
        found = self._followed.get(task, {})
        found.pop(sender.key, None)
        if not found:
            self._followed.pop(task, None)

    def _reject(self, sender: _Sender, letter: TunnelMessage, error: SwiftbotError) -> None:
        passing = isinstance(error, _PASSING)
        self._count("mavlink_request_rejected" if passing else "mavlink_request_denied")
        log.warning(
            "what was asked by MAVLink is refused", sender=sender.name, op=letter.op, reason=str(error)[:MOST_WORDS]
        )
        answer = Answer(
            op="rejected",
            to=letter.op,
            id=letter.id,
            code=error.code,
            message=error.message[:MOST_WORDS],
            remedy=error.remedy[:MOST_WORDS],
            retry=passing,
        )
        self._say(sender, answer)

    def _say(self, sender: _Sender, answer: Answer) -> None:
        try:
            sender.channel.send(encode(answer), self._clock())
        except NotDelivered as error:
            log.warning("an answer over MAVLink was not sent", to=sender.name, reason=str(error))

    def _count(self, what: str) -> None:
        self._refused[what] = self._refused.get(what, 0) + 1


def _news(record: TaskRecord) -> Answer:
    results: dict[str, dict[str, Any]] = {}
    if record.state.final:
        left = MOST_RESULTS
        for each in record.subtasks:
            left -= len(encode({each.subtask.id: each.result})) if each.result else 0
            if each.result and left >= 0:
                results[each.subtask.id] = each.result
    return Answer(
        op="news",
        id=record.id,
        state=record.state,
        done=sum(each.state.final for each in record.subtasks),
        total=len(record.subtasks),
        message=record.failure.message[:MOST_WORDS] if record.failure else "",
        results=results,
    )
