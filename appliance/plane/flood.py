"""Everything that is put under an expression, for whoever must keep up with all of it: the recorder.

An ordinary subscription has each message delivered by a turn of the event loop, on the way through two threads and
two locks. That costs more than a message may at tens of thousands a second. Here Zenoh queues natively, without
Python, and one thread takes what is there in batches. While that thread does not come round, the queue fills and Zenoh
holds back whoever sends: so it must do nothing but hand over.
"""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import structlog
import zenoh

log = structlog.get_logger(__name__)

T = TypeVar("T")

QUEUED = 16_384
"""Messages that Zenoh queues: a third of a second at 50,000 a second."""
_BATCH = 2_048
_REST_S = (0.001, 0.02)
"""After nothing was there: first so long, doubled up to that. A log may be so late, a decision might not."""
_END_S = 5.0


class Flood(Generic[T]):
    """A subscription that is drained by a thread of its own.

    Args:
        raw: the Zenoh session.
        expr: what to hear.
        make: makes a message of key, time (Unix nanoseconds of the sender's clock, or of arrival without one), payload,
            Zenoh encoding, whether it is a deletion, and the session and number it has there (`plane.backlog`; "" and 0
            where the sender does not say).
        take: gets batches, in order, on the draining thread; must not block.
        limit: payload bytes beyond which a message is not taken.
        on_oversize: told key and size of such a one, on the draining thread.
    """

    def __init__(
        self,
        raw: zenoh.Session,
        expr: str,
        *,
        make: Callable[[str, int, bytes, str, bool, str, int], T],
        take: Callable[[list[T]], None],
        limit: int,
        on_oversize: Callable[[str, int], None],
    ) -> None:
        self._make, self._take = make, take
        self._limit, self._on_oversize = limit, on_oversize
        self._ending = threading.Event()
        self._encodings: dict[Any, str] = {}
        self._subscriber = raw.declare_subscriber(expr, zenoh.handlers.FifoChannel(QUEUED))
        self._thread = threading.Thread(target=self._run, name="flood", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hand over what is there and end."""
        self._ending.set()
        self._thread.join(_END_S)
        with contextlib.suppress(zenoh.ZError):  # gone with its session
            self._subscriber.undeclare()

    def _run(self) -> None:
        receive, rest_s = self._subscriber.handler.try_recv, _REST_S[0]
        while True:
            ending = self._ending.is_set()
            batch: list[T] = []
            try:
                while len(batch) < _BATCH and (sample := receive()) is not None:
                    self._add(sample, batch)
            except zenoh.ZError:  # the session was closed under it
                ending = True
            if batch:
                try:
                    self._take(batch)
                except Exception:  # supervision boundary: one receiver's defect must not stop the queue
                    log.exception("a receiver failed")
                rest_s = _REST_S[0]
            elif ending:
                return
            else:
                self._ending.wait(rest_s)
                rest_s = min(_REST_S[1], rest_s * 2)

    def _add(self, sample: zenoh.Sample, batch: list[T]) -> None:
        payload, stamp = sample.payload, sample.timestamp
        key = str(sample.key_expr)
        if len(payload) > self._limit:
            self._on_oversize(key, len(payload))
            return
        at_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else time.time_ns()
        deleted = sample.kind == zenoh.SampleKind.DELETE
        info = sample.source_info
        source, number = (f"{info.source_id.zid}/{info.source_id.eid}", info.source_sn) if info is not None else ("", 0)
        batch.append(self._make(key, at_ns, payload.to_bytes(), str(sample.encoding), deleted, source, number))
