"""Replicated records: each key has an owner on the ring that orders its writes, and r-1 further replicas.

A write goes to the owner, which compares the version the writer saw with its own, stores, and has the replicas
store before it acknowledges. When the owner dies its successor on the ring, a replica, is the owner; `reconcile`
brings every gateway up to date before it answers for keys that have become its own. Two owners at once (views of
the membership differ for a moment, or a partition) make concurrent versions, which every gateway resolves alike.
"""

import asyncio
import random
import secrets
import time
from collections.abc import Callable
from functools import partial

import structlog

from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import VersionVector
from appliance.plane.absence import Absence
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, KeyAsk, RecordAsk, RecordChange, StoreAsk, Written
from appliance.plane.ordering import Ordering
from appliance.plane.pulse import Pulse
from appliance.plane.pushing import Pushing
from appliance.plane.rows import LeaveOut
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.settling import Settling
from appliance.plane.store import Store
from appliance.plane.versions import (
    Record,
    Resolver,
    Write,
    by_bytes,
    check_key,
    check_record,
    check_write,
    settle,
)

__all__ = ["Dht", "LeaveOut", "Record", "Resolver"]

log = structlog.get_logger(__name__)

_ATTEMPT_S = 1.5
"""One try at an owner: longer than it waits for its replicas, shorter than the whole write."""
_AGAIN_S = 0.03
"""Between tries while the membership settles."""
_APART_S = 1.0
"""How long a reader asks again when whom it takes for a key's owner is not there, or says that the key is another's."""
_MOST_NAMED = 5
"""Gateways named in an error."""


class Dht:
    """The replicated records as one gateway sees them."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        pulse: Pulse,
    ) -> None:
        self.resolver: Resolver | None = None
        self.on_ring_change: list[Callable[[], None]] = []
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._pulse = pulse
        self.settling = Settling(
            gateway=gateway, membership=membership, pulse=pulse, replicas=config.replicas,
            virtual_nodes=config.virtual_nodes,
        )  # fmt: skip
        self.absence = Absence(replicas=config.replicas)
        self._pushing = Pushing(config, gateway=gateway, store=store, rpc=rpc, membership=membership, keep=self.keep)
        self.ordering = Ordering(
            config, gateway=gateway, store=store, rpc=rpc, membership=membership, settling=self.settling, pulse=pulse,
            pushing=self._pushing, keep=self.keep,
        )  # fmt: skip
        rpc.register("dht_read", KeyAsk, self._on_read, exchange=False)
        rpc.register("dht_store", StoreAsk, self._on_store, exchange=False)
        rpc.register("record_read", RecordAsk, self._on_record_read, exchange=False)
        rpc.register("record_write", RecordChange, self._on_record_write, exchange=False)

    # --- the door ---------------------------------------------------------------------------------------------

    async def read(self, key: str, *, replica: bool = False) -> Record | None:
        """Return a record from its owner or, when that does not answer, the next replica; None: there is none.

        That there is none only the key's owner knows, and only when it has heard all that may have a copy: what a
        replica lacks the owner may have, which was slow to tell.

        `replica`: as this gateway has it if it holds a copy, else as any of those that do; it may be behind.

        Raises:
            UnreachableError: whoever answered has none, and others may have one.
        """
        check_key(key)
        loop = asyncio.get_running_loop()
        until = loop.time() + _APART_S
        while True:
            found, apart = await self._ask_holders(key, replica=replica)
            if found.record is not None or not found.unsure:
                return None if found.record is None or found.record.deleted else found.record
            if not apart or loop.time() > until:
                raise UnreachableError(
                    f"whether there is a record {key} is not known: {found.unsure}", remedy="try again in a second"
                )
            await asyncio.sleep(_AGAIN_S)

    async def _ask_holders(self, key: str, *, replica: bool) -> tuple[Found, bool]:
        """Ask the holders of a key one after the other, until one has it or knows that there is none.

        Returns:
            What was found, and whether that may be about to change: the owner says that the key is another's, or is not
            there or about to go, of which the membership will tell.
        """
        holders = list(self._membership.ring.successors(key, self._config.replicas))
        owner, problems, apart = holders[0], dict[str, str](), False
        if replica:
            random.shuffle(holders)
            holders.sort(key=lambda name: name != self._gateway)
        for gateway in holders:
            try:
                if gateway == self._gateway:
                    found = await (self._copy(key) if replica else self._on_read(KeyAsk(key)))
                else:
                    found = await self._rpc.call(
                        gateway, "dht_read", KeyAsk(key), Found, timeout_s=_ATTEMPT_S, direct=True
                    )
            except SwiftbotError as error:
                # Away, late, or with a disk that fails: the others have copies.
                problems[gateway] = str(error)
                apart = apart or (gateway == owner and isinstance(error, UnreachableError | RefusedError))
                continue
            if found.record is not None or not found.unsure:
                return found, False
            if gateway == owner:
                problems[gateway], apart = found.unsure, bool(found.owner)
        return Found(unsure=problems.get(owner) or "its owner was not asked"), apart

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, durable: bool = True
    ) -> VersionVector:
        """Compare and set: `expected` is the version that was read, None when there must be no record.

        Returns:
            The new version; by then the value is on the disk of the owner and of every reachable replica (not
            `durable`: written, but the last moments may be lost with the power of all of them).

        Raises:
            ConflictError: the record has moved on; read, decide again, retry.
            UnreachableError: no owner could be reached within `write_timeout_s`; it may or may not be written.
            PayloadError: the value or key is too large.
        """
        asked = Write(key=key, value=value, expected=expected, write=secrets.token_hex(16), durable=durable)
        return await self._write(asked)

    async def remove(self, key: str, *, expected: VersionVector) -> None:
        """Remove a record; errors as for `write`."""
        asked = Write(key=key, deleted=True, expected=expected, write=secrets.token_hex(16))
        await self._write(asked)

    def owns(self, key: str) -> bool:
        """Whether a key belongs to this gateway just now."""
        return self._membership.owns(key)

    async def local(self, prefix: str, *, leave_out: LeaveOut | None = None) -> list[Record]:
        """Return this gateway's shard: the records it holds, as owner or replica, without those removed.

        `leave_out`: nor those with such a value. Read page by page: it is no picture of one moment.
        """
        found: list[Record] = []
        after = ""
        while page := await self._store.page(prefix, after, leave_out):
            found += (record for record in page if not record.deleted)
            after = page[-1].key
        return found

    def watch(self, heed: Callable[[str], bool], tell: Callable[[Record], None]) -> Callable[[], None]:
        """Have `tell` hear of every change of a copy that this gateway holds (`Store.watch`); returns what ends it."""
        return self._store.watch(heed, tell)

    # --- writing ----------------------------------------------------------------------------------------------

    async def _write(self, asked: Write) -> VersionVector:
        check_write(asked, max_bytes=self._config.max_record_bytes)
        loop = asyncio.get_running_loop()
        until = loop.time() + self._config.write_timeout_s
        while True:
            try:
                owner = self._membership.ring.owner(asked.key)
                if owner == self._gateway:
                    return (await self.ordering.order(asked)).version
                answer = await self._rpc.call(owner, "dht_write", asked, Written, timeout_s=_ATTEMPT_S, direct=True)
            except (UnreachableError, DeadlineError, RefusedError) as error:
                # Dead, not yet known to be; or of another mind about who owns the key: both pass.
                if loop.time() > until:
                    raise UnreachableError(
                        f"{asked.key} could not be written: {error}", remedy="try again; it may have been written"
                    ) from error
                await asyncio.sleep(_AGAIN_S)
            else:
                return answer.version

    # --- answering --------------------------------------------------------------------------------------------

    async def _on_read(self, asked: KeyAsk) -> Found:
        key, unsure = check_key(asked.key), ""
        if self.owns(key) and not await self.settling.until_mine(key):
            unsure = f"{self._gateway} owns it and has not compared its copies with the others' yet"
        record = await self._store.record(key)
        if record is None and self.owns(key) and not self.settling.met():
            await self.settling.until_met()
            record = await self._store.record(key)
        if record is not None:
            return Found(record)
        if not self.owns(key):
            return Found(unsure=f"it is not {self._gateway}'s", owner=self._membership.ring.owner(key))
        if not unsure and (doubt := self.absence.doubt(key, time.monotonic())):
            unsure = f"{', '.join(doubt[:_MOST_NAMED])} may have it and did not answer"
        return Found(unsure=unsure)

    async def _copy(self, key: str) -> Found:
        """The copy that is here, whoever the owner is."""
        record = await self._store.record(key)
        return Found(record) if record is not None else await self._on_read(KeyAsk(key))

    async def _on_store(self, asked: StoreAsk) -> Found:
        check_record(asked.record, max_bytes=self._config.max_record_bytes)
        kept = await self.keep(asked.record)
        return Found(None if kept == asked.record else kept)

    async def keep(self, record: Record) -> Record:
        """Store what stands of a version from elsewhere and the one here; returns it."""
        resolver = self.resolver or by_bytes
        kept = await self._store.change(record.key, partial(_settle, record, resolver))
        return record if kept is None else kept

    async def _on_record_read(self, asked: RecordAsk) -> Found:
        return Found(await self.read(asked.key, replica=asked.replica))

    async def _on_record_write(self, asked: RecordChange) -> Written:
        write = Write(
            key=asked.key,
            value=asked.value,
            deleted=asked.deleted,
            expected=asked.expected,
            write=asked.write or secrets.token_hex(16),
        )
        check_write(write, max_bytes=self._config.max_record_bytes)
        return Written(await self._write(write))

    async def close(self) -> None:
        """Give up what is still being written and pushed."""
        await self._pushing.close()


def _settle(other: Record, resolver: Resolver, mine: Record | None) -> Record:
    return settle(mine, other, resolver)
