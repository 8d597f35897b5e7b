"""Facts that are put for whoever listens, and listening to those of others; bad ones are counted and dropped."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
# The library's stubs leave out the return types of methods that return nothing.

import time
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import msgspec
import zenoh
from msgspec import Struct

from appliance.plane import link
from appliance.plane.flood import Flood
from appliance.plane.wire import Closer, Wire

T = TypeVar("T")


class Message(Struct, frozen=True):
    """A put or delete as it arrived. `at_ns` is the sender's hybrid logical clock, Unix nanoseconds."""

    key: str
    payload: bytes
    deleted: bool
    at_ns: int
    encoding: str


class Publishing:
    """Facts out and in of one session."""

    def __init__(self, wire: Wire, on_first: Callable[[], None] = lambda: None) -> None:
        """`on_first` is called on the sender's thread before the first put."""
        self._wire = wire
        self._on_first = on_first
        self._recorded = f"{wire.keys.root}/"

    def put(self, key: str, payload: bytes, *, encoding: str = "application/json", express: bool = False) -> None:
        """Publish; returns at once. What cannot be sent (too large, queue full) is counted and logged.

        `express`: at once, and what waits before it with it. Others may wait for a millisecond on each link for more
        to go in one packet, where something was sent just before.
        """
        if len(payload) > self._wire.config.max_payload_bytes:
            self._wire.refuse("oversize put", key=key, size=len(payload))
            return
        self._send(key, payload, encoding=encoding, express=express)

    def delete(self, key: str) -> None:
        """Publish that a key's fact is gone."""
        self._send(key, None)

    def _send(self, key: str, payload: bytes | None, *, encoding: str = "", express: bool = False) -> None:
        say = partial(self._say, key, payload, encoding, express)
        if not self._wire.send(key, say, len(payload or b"")) and self._is_recorded(key):
            self._wire.backlog.not_sent(key)

    def _is_recorded(self, key: str) -> bool:
        """Whether recorders subscribe to a key: they cannot miss what no wildcard matches."""
        return key.startswith(self._recorded) and "/@" not in key

    def _say(self, key: str, payload: bytes | None, encoding: str, express: bool) -> None:
        """Put, or delete where there is no payload, with number and time of its own; on the sender's thread."""
        raw, backlog = self._wire.raw, self._wire.backlog
        stamp, source = raw.new_timestamp(), None
        if self._is_recorded(key):
            if not backlog.last:
                self._on_first()
            at_ns = stamp.get_time_as_ntp64().as_nanos()
            number = backlog.say(key, at_ns, payload or b"", encoding, deleted=payload is None)
            source = zenoh.SourceInfo(self._wire.source.source_id, number)
        block = zenoh.CongestionControl.BLOCK
        if payload is None:
            raw.delete(key, congestion_control=block, timestamp=stamp, source_info=source)
        else:
            raw.put(
                key,
                payload,
                encoding=encoding,
                congestion_control=block,
                express=express,
                timestamp=stamp,
                source_info=source,
            )

    def subscribe(
        self, expr: str, callback: Callable[[Message], None], *, heed: Callable[[str], bool] = lambda _: True
    ) -> Closer:
        """Have every put and delete under `expr` delivered, as bytes; oversize ones are counted and dropped.

        `heed` is asked first, on a thread of Zenoh's, whether a key is anybody's business here: what is not does not
        wake the event loop. It must neither block nor go through what the event loop changes meanwhile.
        """
        name, limit = self._wire.name(expr), self._wire.config.max_payload_bytes

        def take(sample: zenoh.Sample) -> None:
            key, size = str(sample.key_expr), len(sample.payload)
            if not heed(key):
                return
            if size > limit:
                self._wire.inbox.post(partial(self._wire.refuse, f"oversize {name}", key=key, size=size))
                return
            stamp = sample.timestamp
            message = Message(
                key,
                sample.payload.to_bytes(),
                sample.kind == zenoh.SampleKind.DELETE,
                stamp.get_time_as_ntp64().as_nanos() if stamp else time.time_ns(),
                str(sample.encoding),
            )
            self._wire.inbox.post(partial(deliver, message), size)

        def deliver(message: Message) -> None:
            if not closer.closed:
                callback(message)

        subscriber = self._wire.raw.declare_subscriber(expr, link.callback(take))
        closer = Closer(subscriber.undeclare)
        return closer

    def flood(
        self, expr: str, make: Callable[[str, int, bytes, str, bool, str, int], T], take: Callable[[list[T]], None]
    ) -> Closer:
        """Have everything under `expr` delivered in batches, past the event loop, on a thread of its own (`Flood`).

        Oversize messages are counted as those of a subscription are.
        """
        wire, name = self._wire, self._wire.name(expr)

        def oversize(key: str, size: int) -> None:
            wire.inbox.post(partial(wire.refuse, f"oversize {name}", key=key, size=size))

        limit = wire.config.max_payload_bytes
        return Closer(Flood(wire.raw, expr, make=make, take=take, limit=limit, on_oversize=oversize).close)

    def subscribe_typed(
        self,
        expr: str,
        kind: type[T],
        callback: Callable[[str, T | None], None],
        *,
        wanted: Callable[[str], bool] = lambda _: True,
        heed: Callable[[str], bool] = lambda _: True,
    ) -> Closer:
        """Have facts delivered decoded, None when one is deleted; malformed ones are counted, logged, dropped.

        Those whose key is not `wanted` are not even decoded; `heed` as of `subscribe`.
        """
        decoder, name = msgspec.json.Decoder(kind), self._wire.name(expr)

        def take(message: Message) -> None:
            if not wanted(message.key):
                return
            if message.deleted:
                callback(message.key, None)
                return
            try:
                value = decoder.decode(message.payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
                self._wire.refuse(f"malformed {name}", key=message.key, reason=str(error))
                return
            callback(message.key, value)

        return self.subscribe(expr, take, heed=heed)
