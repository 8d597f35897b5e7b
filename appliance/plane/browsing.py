"""Looking at records: which there are, where their copies lie, and whether these agree."""

import asyncio
from typing import Annotated

from msgspec import Meta, Struct

from appliance.errors import PayloadError, SwiftbotError
from appliance.model import VersionVector
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, KeyAsk
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import MAX_KEY, Record, check_key, digest

MOST_LISTED = 1000
_ASK_S = 1.0


class RecordsAsk(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`records`: which records does this gateway hold copies of, in order of keys after `after`?"""

    prefix: str = ""
    after: str = ""
    limit: Annotated[int, Meta(ge=1, le=MOST_LISTED)] = MOST_LISTED


class Copy(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A copy of a record as one gateway has it; `problem`: why that is not known."""

    gateway: str
    version: VersionVector = {}
    """Empty: it has none."""
    deleted: bool = False
    size_bytes: int = 0
    digest: str = ""
    """Of version and value; equal copies have equal ones."""
    problem: str = ""


class Listed(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A record and the copy of it that a gateway holds, with where it belongs as that gateway sees the ring."""

    key: str
    copy: Copy
    owner: str = ""
    replicas: tuple[str, ...] = ()


class RecordList(Struct, frozen=True, omit_defaults=True):
    """Answer: in order of keys; `more` when it was cut."""

    records: tuple[Listed, ...] = ()
    more: bool = False


class RecordPlace(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Answer of `record_place`: where a record belongs, and what lies there."""

    key: str
    owner: str
    replicas: tuple[str, ...]
    copies: tuple[Copy, ...] = ()

    @property
    def agree(self) -> bool:
        """Whether all replicas answer and hold the same."""
        return len({each.digest for each in self.copies}) == 1 and not any(each.problem for each in self.copies)


class Browsing:
    """Answers questions about records on one gateway."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc, membership: Membership) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        rpc.register("records", RecordsAsk, self._on_records, exchange=False)
        rpc.register("record_place", KeyAsk, self._on_place, exchange=False)

    async def _on_records(self, asked: RecordsAsk) -> RecordList:
        if len(asked.prefix) > MAX_KEY or len(asked.after) > MAX_KEY:
            raise PayloadError("a prefix longer than any key", remedy=f"at most {MAX_KEY} characters")
        keys = [key for key, _ in await self._store.digests() if key.startswith(asked.prefix) and key > asked.after]
        listed: list[Listed] = []
        for key in keys[: asked.limit]:
            record = await self._store.record(key)
            if record is not None:
                holders = self._membership.ring.successors(key, self._config.replicas)
                copy = copy_of(self._gateway, record)
                listed.append(Listed(key=key, copy=copy, owner=holders[0], replicas=holders))
        return RecordList(tuple(listed), more=len(keys) > asked.limit)

    async def _on_place(self, asked: KeyAsk) -> RecordPlace:
        holders = self._membership.ring.successors(check_key(asked.key), self._config.replicas)
        copies = await asyncio.gather(*(self._copy(each, asked) for each in holders))
        return RecordPlace(key=asked.key, owner=holders[0], replicas=holders, copies=tuple(copies))

    async def _copy(self, gateway: str, asked: KeyAsk) -> Copy:
        try:
            if gateway == self._gateway:
                record = await self._store.record(asked.key)
            else:
                record = (await self._rpc.call(gateway, "dht_read", asked, Found, timeout_s=_ASK_S)).record
        except SwiftbotError as error:
            return Copy(gateway=gateway, problem=error.message)
        return copy_of(gateway, record)


def copy_of(gateway: str, record: Record | None) -> Copy:
    """What is told of a gateway's copy of a record."""
    if record is None:
        return Copy(gateway=gateway)
    return Copy(
        gateway=gateway, version=record.version, deleted=record.deleted, size_bytes=len(record.value),
        digest=digest(record),
    )  # fmt: skip
