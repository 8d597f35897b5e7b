"""Copies of a record on their way to its replicas: with a write, and again to one that was too slow."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Coroutine
from functools import partial
from typing import Any

import structlog

from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, StoreAsk
from appliance.plane.rpc import Call, Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import Record

log = structlog.get_logger(__name__)

_ASK_S = 1.5
_AGAIN_S = (0.5, 2.0)
"""When a replica that was too slow for a write is offered the record again."""
_MOST = 256


class Push:
    """A record on its way to a replica."""

    def __init__(self, call: Call[Found], heard: Callable[[Call[Found]], Awaitable[Record | None]]) -> None:
        self._call = call
        self._heard = heard

    async def done(self) -> Record | None:
        """Wait until the replica has stored it, or is away, slow or failing; returns what it holds instead."""
        return await self._heard(self._call)

    def end(self) -> None:
        """Wait for it no more."""
        self._call.end()


class Pushing:
    """The copies that one gateway gives to others. `keep` stores here what a replica holds instead."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        keep: Callable[[Record], Awaitable[Record]],
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._keep = keep
        self._pushes: set[asyncio.Task[None]] = set()

    def begin(self, gateway: str, record: Record, *, durable: bool = True) -> "Push":
        """Send a replica a record to store; what comes of it is awaited afterwards."""
        ask, timeout_s = StoreAsk(record, durable), self._config.replica_timeout_s
        call = self._rpc.begin(gateway, "dht_store", ask, Found, timeout_s=timeout_s, direct=True)
        return Push(call, partial(self._heard, gateway, record))

    async def push(self, gateway: str, record: Record, *, durable: bool = True) -> Record | None:
        """Have a replica store a record; returns what it holds if that is something else."""
        return await self.begin(gateway, record, durable=durable).done()

    async def _heard(self, gateway: str, record: Record, call: Call[Found]) -> Record | None:
        try:
            answer = await call.answer()
        except SwiftbotError as error:
            self.failed(gateway, record, error)
            return None
        return answer.record

    def failed(self, gateway: str, record: Record, error: SwiftbotError) -> None:
        """A replica has not said that it stored a record: it is offered it again, unless it is gone or cannot."""
        if isinstance(error, UnreachableError):
            return  # gone: its successor in the replica set takes the record when it reconciles
        if isinstance(error, DeadlineError | RefusedError):
            log.warning("a replica is slow", replica=gateway, key=record.key, reason=str(error))
            self._later(self._push_again(gateway, record.key))
        else:
            log.error("a replica cannot store", replica=gateway, key=record.key, reason=str(error))

    def _later(self, push: Coroutine[Any, Any, None]) -> None:
        if len(self._pushes) >= _MOST:
            push.close()  # anti-entropy will find it
            return
        task = asyncio.create_task(push)
        self._pushes.add(task)
        task.add_done_callback(self._pushes.discard)

    async def _push_again(self, gateway: str, key: str) -> None:
        for wait_s in _AGAIN_S:
            await asyncio.sleep(wait_s)
            record = await self._store.record(key)
            if record is None or gateway not in self._membership.members:
                return
            with contextlib.suppress(SwiftbotError):
                answer = await self._rpc.call(gateway, "dht_store", StoreAsk(record), Found, timeout_s=_ASK_S)
                if answer.record is not None:
                    await self._keep(answer.record)
                return

    async def close(self) -> None:
        """Give up what is on its way."""
        for task in self._pushes:
            task.cancel()
        await asyncio.gather(*self._pushes, return_exceptions=True)
