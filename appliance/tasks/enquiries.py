"""Questions of handlers to people: kept in the DHT until they are answered, published; first answer wins.

A question has the id of its effect (`task:subtask:n`), the same in a repeated attempt: a gateway that dies while
somebody thinks takes nothing along, and what was answered meanwhile is there for the next attempt.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable

import msgspec
import structlog
from msgspec.structs import replace

from appliance.background import Background
from appliance.errors import (
    ConflictError,
    DeadlineError,
    NotFoundError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import Enquiry, encode, keyspace
from appliance.model.task_api import AnswerAsk, EnquiriesAsk, EnquiryList
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.plane.session import Closer
from appliance.tasks.audit import Audit
from appliance.tasks.records import clean

log = structlog.get_logger(__name__)

MAX_QUESTION = 1000
MAX_CHOICES = 20
MAX_CHOICE = 100
LOOK_S = 2.0
"""How often the record is looked at while nothing is heard: a put may be lost when a gateway dies."""
LIST_S = 1.5
EXPIRED = "expired"
WITHDRAWN = "withdrawn"


class Enquiries:
    """The questions of one gateway's runs, and the verbs `answer` and `enquiries`."""

    def __init__(self, plane: Plane) -> None:
        self._plane = plane
        self._heard: dict[str, asyncio.Event] = {}
        self._closer: Closer | None = None
        self._closing = Background()

    def start(self, audit: Audit) -> None:
        """Listen, and answer the verbs."""
        self._closer = self._plane.session.subscribe_typed(keyspace.ENQUIRY, self._on_enquiry)
        self._plane.rpc.register(keyspace.ANSWER, audit.signed("answer", self.answer))
        self._plane.rpc.register(keyspace.ENQUIRIES, self.enquiries)

    async def close(self) -> None:
        """Listen no more."""
        if self._closer is not None:
            self._closer.close()
        await self._closing.close()

    async def ask(self, enquiry: Enquiry, *, on_wait: Callable[[str], None]) -> Enquiry:
        """Ask people and wait for the answer.

        Args:
            enquiry: the question, with the id of its effect; `expires_s` is how long it is waited for.
            on_wait: told what is waited for.

        Returns:
            The question with its answer; at once when an earlier attempt has had it answered.

        Raises:
            DeadlineError: nobody answered in time.
        """
        heard = self._heard.setdefault(enquiry.id, asyncio.Event())
        until = time.monotonic() + enquiry.expires_s
        try:
            now = await self._open(enquiry)
            while now.answer is None:
                left_s = until - time.monotonic()
                if left_s <= 0:
                    now = await self._shut(enquiry.id, EXPIRED)
                    if now is not None and now.answer is not None:
                        break
                    raise DeadlineError(
                        f"nobody answered within {enquiry.expires_s:.0f} s: {enquiry.question}",
                        remedy="`swiftbot questions` lists what waits for an answer",
                    )
                on_wait(f"waits for an answer: {enquiry.question}")
                heard.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(min(LOOK_S, left_s)):
                        await heard.wait()
                with contextlib.suppress(UnreachableError):  # its owner may be back before the time is over
                    now = await self._read(enquiry.id) or now
        except asyncio.CancelledError:
            self._closing.start(self._withdraw(enquiry.id), f"withdraw {enquiry.id}")
            raise
        else:
            return now
        finally:
            self._heard.pop(enquiry.id, None)

    async def answer(self, ask: AnswerAsk) -> Enquiry:
        """Answer `answer`.

        Raises:
            NotFoundError: no such question.
            ConflictError: somebody has answered already; the message says who, and what.
            RefusedError: it is not waited for any more.
            PayloadError: the answer is none of its choices.
        """
        for _ in range(3):
            stored = await self._stored(ask.id)
            enquiry = _decoded(stored)
            if stored is None or enquiry is None:
                raise NotFoundError(f"there is no question {ask.id[:80]!r}", remedy="`swiftbot questions` lists them")
            if enquiry.answer is not None:
                if (enquiry.by, enquiry.answer) == (ask.by, clean(ask.answer, len(ask.answer))):
                    return enquiry
                raise ConflictError(f"{enquiry.by or 'somebody'} has answered {enquiry.answer[:80]!r} already")
            if enquiry.closed:
                raise RefusedError(f"the question is not waited for any more: it is {enquiry.closed}")
            answered = replace(enquiry, answer=_chosen(enquiry, ask.answer), by=ask.by, answered_ns=time.time_ns())
            try:
                await self._plane.dht.write(_key(ask.id), encode(answered), expected=stored.version)
            except ConflictError:
                continue
            self._plane.session.publish(keyspace.ENQUIRY, answered, answered.id)
            return answered
        raise ConflictError(f"the question {ask.id} changes just now", remedy="ask again")

    async def enquiries(self, ask: EnquiriesAsk) -> EnquiryList:
        """Answer `enquiries`."""
        found: dict[str, Enquiry] = {}
        for record in await self._plane.dht.local(keyspace.ENQUIRY_RECORD.prefix):
            enquiry = _decoded(record) if self._plane.dht.owns(record.key) else None
            if enquiry is not None and enquiry.open:
                found[enquiry.id] = enquiry
        silent: list[str] = []
        if not ask.local:
            others = sorted(self._plane.members() - {self._plane.gateway})
            for member, answer in zip(others, await asyncio.gather(*map(self._local_of, others)), strict=True):
                if answer is None:
                    silent.append(member)
                else:
                    found |= {each.id: each for each in answer.enquiries}
        ordered = sorted(found.values(), key=lambda each: (each.at_ns, each.id))
        return EnquiryList(enquiries=tuple(ordered), unreachable=tuple(silent))

    async def _local_of(self, member: str) -> EnquiryList | None:
        try:
            return await self._plane.rpc.call(member, keyspace.ENQUIRIES, EnquiriesAsk(local=True), timeout_s=LIST_S)
        except SwiftbotError:
            return None

    async def _open(self, enquiry: Enquiry) -> Enquiry:
        """Write the question, or take up what an earlier attempt has asked."""
        version = None
        for _ in range(3):
            try:
                await self._plane.dht.write(_key(enquiry.id), encode(enquiry), expected=version)
            except ConflictError:
                stored = await self._stored(enquiry.id)
                known = _decoded(stored)
                if known is not None and known.answer is not None:
                    return known
                if known is not None and known.open:
                    break
                version = stored.version if stored is not None else None  # asked in vain before: it is open again
            else:
                break
        self._plane.session.publish(keyspace.ENQUIRY, enquiry, enquiry.id)
        log.info("people are asked", enquiry=enquiry.id, question=enquiry.question, robot=enquiry.robot)
        return enquiry

    async def _withdraw(self, enquiry: str) -> None:
        try:
            await self._shut(enquiry, WITHDRAWN)
        except SwiftbotError as error:
            log.info("a question could not be withdrawn", enquiry=enquiry, reason=str(error))

    async def _shut(self, name: str, why: str) -> Enquiry | None:
        """Note that it needs no answer any more; returns it as it stands then, perhaps answered after all."""
        stored = await self._stored(name)
        enquiry = _decoded(stored)
        if stored is None or enquiry is None or not enquiry.open:
            return enquiry
        shut = replace(enquiry, closed=why)
        try:
            await self._plane.dht.write(_key(name), encode(shut), expected=stored.version)
        except ConflictError:
            return await self._read(name)
        self._plane.session.publish(keyspace.ENQUIRY, shut, name)
        return shut

    async def _read(self, name: str) -> Enquiry | None:
        return _decoded(await self._stored(name))

    async def _stored(self, name: str) -> Record | None:
        stored = await self._plane.dht.read(_key(name))
        return stored if stored is not None and not stored.deleted else None

    def _on_enquiry(self, key: str, enquiry: Enquiry | None) -> None:
        del key
        if enquiry is not None and (heard := self._heard.get(enquiry.id)) is not None:
            heard.set()


def enquiry_of(effect: str, *, question: object, choices: object, to: object, expires_s: float) -> Enquiry:
    """Make a question of what a handler says; PayloadError says what is wrong with it."""
    text = clean(str(question or "").strip(), MAX_QUESTION)
    if not text:
        raise PayloadError("ask needs a question")
    if not isinstance(choices, list | tuple) or len(choices) > MAX_CHOICES:  # pyright: ignore[reportUnknownArgumentType]
        raise PayloadError(f"ask: choices is a list of at most {MAX_CHOICES} words")
    words = tuple(clean(str(each), MAX_CHOICE) for each in choices)  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    task, subtask, _ = effect.split("/")
    return Enquiry(
        id=effect.replace("/", ":"),
        question=text,
        choices=words,
        to=clean(str(to or ""), MAX_CHOICE),
        task=task,
        subtask=subtask,
        expires_s=expires_s,
        at_ns=time.time_ns(),
    )


def _chosen(enquiry: Enquiry, answer: str) -> str:
    text = clean(answer.strip(), len(answer))
    if not text:
        raise PayloadError("an answer needs words")
    if not enquiry.choices:
        return text
    for each in enquiry.choices:
        if each.lower() == text.lower():
            return each
    raise PayloadError(f"{text[:60]!r} is none of the answers", remedy=f"one of: {', '.join(enquiry.choices)}")


def stronger(one: bytes, other: bytes) -> bytes:
    """Return the version of a question that stands after a partition: one that is answered; the same on both sides."""

    def rank(value: bytes) -> tuple[bool, bytes]:
        try:
            return msgspec.json.decode(value, type=Enquiry).answer is not None, value
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return False, value

    return max(one, other, key=rank)


def _key(name: str) -> str:
    return keyspace.ENQUIRY_RECORD.prefix + name.replace(":", "/")


def _decoded(stored: Record | None) -> Enquiry | None:
    if stored is None or stored.deleted:
        return None
    try:
        return msgspec.json.decode(stored.value, type=Enquiry)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
