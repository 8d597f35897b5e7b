"""How people of the simulated world answer what a skill asks through a robot (`ask`): they hear it when they are near.

The question is put by the gateway that runs the skill, for operators and all others who can answer. A simulated robot
hears those that are asked through it, and hands in what the person beside it says, as an operator would. The first
answer counts.
"""

import asyncio
import hashlib

import msgspec
import structlog

from appliance.errors import SwiftbotError
from appliance.model import Enquiry, encode, keyspace
from appliance.plane.session import Closer, Session
from appliance.robots.verbs import AskArgs, RobotFailure
from workshop.robots.around import Around

log = structlog.get_logger(__name__)

MAX_ASKED = 8
"""Questions being put to people at once."""
_KEPT = 256
_TIMEOUT_S = 10.0
_TRIES = 3


class _Answer(msgspec.Struct, frozen=True, kw_only=True):
    """What the verb `answer` takes (`tasks.steering.api.AnswerAsk`, which this room does not know)."""

    id: str
    answer: str
    by: str
    why: str = ""
    act: str = ""


class Ears:
    """Of one simulated robot."""

    def __init__(self, robot: str, around: Around, session: Session) -> None:
        self._robot = robot
        self._around = around
        self._session = session
        self._heard: dict[str, None] = {}
        self._asking: set[asyncio.Task[None]] = set()
        self._gateways: set[str] = set()
        self._closers: list[Closer] = []

    def listen(self) -> None:
        """Begin to listen."""
        session, keys = self._session, self._session.keys
        self._closers = [
            session.subscribe_typed(keyspace.ENQUIRY, self._take),
            session.watch_alive(keys(keyspace.GATEWAY_ALIVE), self._seen),
        ]

    async def close(self) -> None:
        """Listen no more, and stop asking."""
        for closer in self._closers:
            closer.close()
        for task in self._asking:
            task.cancel()
        await asyncio.gather(*self._asking, return_exceptions=True)

    def _seen(self, key: str, alive: bool) -> None:
        (gateway,) = keyspace.GATEWAY_ALIVE.names(key)
        if alive:
            self._gateways.add(gateway)
        else:
            self._gateways.discard(gateway)

    def _take(self, key: str, enquiry: Enquiry | None) -> None:
        del key
        if enquiry is None or enquiry.robot != self._robot or not enquiry.open or enquiry.id in self._heard:
            return
        if len(self._asking) >= MAX_ASKED:
            return
        self._heard[enquiry.id] = None
        while len(self._heard) > _KEPT:
            del self._heard[next(iter(self._heard))]
        task = asyncio.create_task(self._ask(enquiry), name=f"{self._robot} asks")
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)

    async def _ask(self, enquiry: Enquiry) -> None:
        try:
            said = (await self._around.ask(AskArgs(question=enquiry.question, to=_person(enquiry.to)))).result
        except RobotFailure as error:
            log.info("nobody near answers", robot=self._robot, question=enquiry.question, why=error.failure.message)
            return
        act = hashlib.sha256(f"{self._robot}/{enquiry.id}".encode()).hexdigest()[:16]
        answer = _Answer(id=enquiry.id, answer=str(said["answer"]), by=str(said["by"]), act=act)
        # The same order at the next gateway is the same order.
        for gateway in sorted(self._gateways)[:_TRIES]:
            try:
                key = self._session.keys(keyspace.RPC, gateway, "answer")
                await self._session.query(key, encode(answer), timeout_s=_TIMEOUT_S, sign=True)
            except SwiftbotError as error:
                log.info("the answer was not taken", robot=self._robot, gateway=gateway, reason=str(error))
            else:
                return


def _person(to: str) -> str:
    """The person near, for a question to operators in general."""
    return "" if to in ("", "operator", "anybody", "somebody") else to
