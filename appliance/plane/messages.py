"""What gateways ask each other of records, and what programs ask any gateway: verbs of docs/keyspace.md."""

from msgspec import Struct

from appliance.model import VersionVector
from appliance.plane.versions import Record


class KeyAsk(Struct, frozen=True):
    """`dht_read`: the record of a key, from this gateway's shard."""

    key: str


class Found(Struct, frozen=True, omit_defaults=True):
    """Answer with a record, or that there is none here."""

    record: Record | None = None
    unsure: str = ""
    """Where there is none: why there may be one elsewhere. Empty: there is none."""
    owner: str = ""
    """Where there is none and the key is another's, as the asked one sees the ring: whose."""


class StoreAsk(Struct, frozen=True, omit_defaults=True):
    """`dht_store`: keep this version, unless a newer one is here."""

    record: Record
    durable: bool = True
    """On the disk before the answer; otherwise the last moments may be lost with the power."""


class Written(Struct, frozen=True):
    """`dht_write` done: the version it made."""

    version: VersionVector


class RecordAsk(Struct, frozen=True, omit_defaults=True):
    """`record_read`: a record, from whoever holds it; the answer of `read`, tombstones left out."""

    key: str
    replica: bool = False
    """From whichever replica answers first, which may be behind its owner; one that is asked here if it is one."""


class RecordChange(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`record_write`: compare and set, through any gateway."""

    key: str
    value: bytes = b""
    deleted: bool = False
    expected: VersionVector | None = None
    write: str = ""
    """An id of the caller's own makes asking again safe; empty: one is made."""
