"""What the parts of a session share: the library's session, the queues to and from its threads, counts of bad input."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# The library's stubs leave out the return types of methods that return nothing.

import asyncio
import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import structlog
import zenoh

from appliance.plane import link
from appliance.plane.backlog import Backlog
from appliance.plane.keys import Keys
from appliance.plane.queues import Inbox, Outbox
from appliance.plane.settings import PlaneConfig

log = structlog.get_logger(__name__)


class Closer:
    """Ends a subscription, service or token; more than once does no harm."""

    def __init__(self, end: Callable[[], None]) -> None:
        self._end: Callable[[], None] | None = end

    @property
    def closed(self) -> bool:
        """Whether it was ended; what was under way to the loop then is not delivered any more."""
        return self._end is None

    def close(self) -> None:
        """End it."""
        end, self._end = self._end, None
        if end is not None:
            # An entity of a closed session is gone already.
            with contextlib.suppress(zenoh.ZError):
                end()


class Wire:
    """A Zenoh session with its queues; `plane.session` makes and closes it."""

    def __init__(self, config: PlaneConfig, fleet: str, raw: zenoh.Session, loop: asyncio.AbstractEventLoop) -> None:
        self.config = config
        self.keys = Keys(fleet)
        self.raw = raw
        self.source = zenoh.SourceInfo(raw.id, 0)
        """What questions of this session say of where they come from."""
        self.backlog = Backlog(payload_bytes=config.backlog_bytes, seconds=config.backlog_s)
        """What this session has put lately."""
        self.loop = loop
        self.refused: dict[str, int] = {}
        self.closed = False
        self.inbox = Inbox(
            loop,
            messages=config.queue_messages,
            payload_bytes=config.queue_bytes,
            on_dropped=lambda count: self.refuse("incoming queue full", count=count),
        )
        self.outbox = self._new_outbox()
        self._bulk: Outbox | None = None
        """Of its own, so that facts and orders never wait behind a volume on a slow link."""

    def _new_outbox(self) -> Outbox:
        return Outbox(messages=self.config.queue_messages, payload_bytes=self.config.queue_bytes)

    def send(self, key: str, send: Callable[[], None], size: int, *, bulk: bool = False) -> bool:
        """Have the sender's thread send; False when it does not fit into its queue, which is counted."""
        outbox = self.outbox
        if bulk:
            outbox = self._bulk = self._bulk or self._new_outbox()
        queued = outbox.send(partial(link.quietly, send, key), size)
        if not queued and not self.closed:
            self.refuse("outgoing queue full", key=key)
        return queued

    def refuse(self, what: str, *, count: int = 1, **fields: Any) -> None:
        """Count bad input; logged the first ten times, then at powers of two: a flood does not fill the log."""
        before = self.refused.get(what, 0)
        total = self.refused[what] = before + count
        if total <= 10 or before.bit_length() != total.bit_length():
            fields = {key: value[:300] if isinstance(value, str) else value for key, value in fields.items()}
            log.warning("refused", what=what, count=total, **fields)

    def name(self, expr: str) -> str:
        """A key without the fleet's root, for counts."""
        return expr.removeprefix(f"{self.keys.root}/")

    async def close(self, timeout_s: float) -> None:
        """Send what waits, for at most so long each queue, and close the library's session."""
        await asyncio.to_thread(self.outbox.close, timeout_s)
        if self._bulk is not None:
            await asyncio.to_thread(self._bulk.close, timeout_s)
        await asyncio.to_thread(self.raw.close)
