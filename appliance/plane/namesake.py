"""Another gateway with this one's id, met after both have joined: they began at one moment, or a cut has healed.

Who joins asks whether its name is free; that tells nothing of one that cannot be seen just then. Two of one name answer
the same questions and order writes of the same keys, so one of the two must go. Each hears what the other tells of
itself under their key and can tell it from its own by the process that tells it. What was put may have been put by a
program that plays a log, so before it counts the key is asked, and another process must answer.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable

import msgspec
import structlog

from appliance.errors import ConfigError, SwiftbotError
from appliance.model import GatewayStatus, encode
from appliance.plane.facts import Facts, FactsAsk
from appliance.plane.session import Session

log = structlog.get_logger(__name__)

HEARD = 3
"""Statuses of another process before it is asked: last words of one that has ended may still be on their way."""
HEARD_S = 3.0
"""The least time from the first of these to the last; a status comes every two seconds, whatever happens."""
_MOST = 8
"""Processes remembered: those heard of last."""
_ASK_S = 2.0

Process = tuple[int, int]


def process(status: GatewayStatus) -> Process:
    """What tells a process from all others: when it began, to the nanosecond, and its number."""
    return status.started_ns, status.pid


def goes(own: Process, others: Iterable[Process]) -> bool:
    """Whether of several processes of one id this one has to go: all but the one that says it began first.

    That needs no right clocks, only that all decide alike.
    """
    return own > min(others, default=own)


def displaced(gateway: str) -> ConfigError:
    """Return what is wrong, for the one that goes."""
    return ConfigError(
        f"another gateway named {gateway} is in the fleet, and began before this one",
        remedy="give each gateway an id of its own",
    )


class Suspicion:
    """Whether another process seems to put a gateway's status. Pure; time is passed in."""

    def __init__(self) -> None:
        self._others: dict[Process, tuple[float, int]] = {}
        """Processes heard under this gateway's key -> when first, and how often."""

    def heard(self, status: GatewayStatus, own: GatewayStatus | None, now: float) -> bool:
        """Take in a status put under this gateway's key; returns whether another process goes on putting them.

        Args:
            status: what was put.
            own: what this process has told of itself last; None: nothing yet.
            now: by the monotonic clock.
        """
        other = process(status)
        if own is None or not own.started_ns or not status.started_ns or other == process(own):
            return False
        since, count = self._others.pop(other, (now, 0))
        if len(self._others) >= _MOST:
            del self._others[next(iter(self._others))]
        self._others[other] = since, count + 1
        return count + 1 >= HEARD and now - since >= HEARD_S


class Namesakes:
    """Finds out whether other processes go by a gateway's id, and whether this one has to go.

    Args:
        session: of this gateway.
        gateway: its id.
        own: what it has told of itself last.
    """

    def __init__(self, session: Session, gateway: str, *, own: Callable[[], GatewayStatus | None]) -> None:
        self.displaced = asyncio.Event()
        """Another process goes by this gateway's id, and this one has to go."""
        self._session = session
        self._gateway = gateway
        self._own = own
        self._suspicion = Suspicion()
        self._asking: asyncio.Task[None] | None = None

    def heard(self, status: GatewayStatus) -> None:
        """Take in a status that was put under this gateway's key, by whomever."""
        if self._suspicion.heard(status, self._own(), time.monotonic()) and self._asking is None:
            self._asking = asyncio.create_task(self._ask(), name="namesakes")
            self._asking.add_done_callback(self._asked)

    def _asked(self, _: asyncio.Task[None]) -> None:
        self._asking = None

    async def _ask(self) -> None:
        key, ask = self._session.keys.rpc(self._gateway, "facts"), encode(FactsAsk())
        try:
            answers = await self._session.query_all(key, ask, timeout_s=_ASK_S)
        except SwiftbotError as error:
            log.info("who else goes by this id could not be asked", reason=str(error))
            return
        own = self._own()
        others: dict[Process, GatewayStatus] = {}
        for answer in answers:
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                status = msgspec.json.decode(answer.payload, type=Facts).status
                if status is not None and status.started_ns and own is not None and process(status) != process(own):
                    others[process(status)] = status
        for status in others.values():
            ends = ", ".join(status.endpoints) or "no endpoint"
            self._session.refuse("another gateway with this id", says=status.id, its_pid=status.pid, listens_on=ends)
        if own is not None and goes(process(own), others):
            self.displaced.set()

    async def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()
            await asyncio.gather(self._asking, return_exceptions=True)
