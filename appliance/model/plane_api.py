"""Verbs of the plane: records and their copies, leases, facts, membership; what an answered request is published as."""

from typing import Annotated

from msgspec import Meta, Raw, Struct

from appliance.model import ContainerInfo, ErrorReply, GatewayStatus, RobotInfo, VersionVector


class Record(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A replicated record. `deleted` is a tombstone; `write` identifies the write that made it."""

    key: str
    value: bytes = b""
    version: VersionVector = {}
    deleted: bool = False
    write: str = ""
    """Id of the last write: a writer that lost the answer and asks again finds its own write done."""


class Write(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A wish to change a record, given the version its writer saw (`None`: there must be none)."""

    key: str
    value: bytes = b""
    deleted: bool = False
    expected: VersionVector | None = None
    write: str = ""
    durable: bool = True


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
    """`record_read`: a record, from any gateway that holds it; the answer of `read`, tombstones left out."""

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


MOST_LISTED = 1000


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


class DigestAsk(Struct, frozen=True, omit_defaults=True):
    """`dht_digest`: which records that I (`asker`) should hold have you? `joining`: my token is not up yet."""

    asker: str
    summary: str = ""
    """Of the asker's copies; when the other's is the same, there is nothing to tell."""
    after: str = ""
    joining: bool = False


class DigestList(Struct, frozen=True, omit_defaults=True):
    """Key -> digest, in order of keys; `more` when it was cut."""

    digests: dict[str, str] = {}
    same: bool = False
    more: bool = False
    unseen: bool = False
    """The asker's token is not seen here, so nothing is answered."""


class FetchAsk(Struct, frozen=True):
    """`dht_fetch`: these records, or as many of the first as fit."""

    keys: tuple[str, ...]


class FetchList(Struct, frozen=True):
    """The records; keys that are gone are left out."""

    records: tuple[Record, ...]
    more: bool = False


LONGEST_S = 30.0
"""Longest lease, seconds; for so long a restarted grantor grants nothing, since it has forgotten its grants."""

Fence = Annotated[int, Meta(ge=1, le=2**53)]
MOST_PARTS = 8192
"""Parts of one key that one holder has at most."""
Part = Annotated[str, Meta(min_length=1, max_length=120)]


class LeaseAsk(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """`lease_grant`: grant the holder this key for so long, under this fence."""

    key: str
    holder: Annotated[str, Meta(min_length=1, max_length=120)]
    """One acquisition, not one gateway: two tasks of one gateway exclude each other too."""
    fence: Fence
    ttl_s: Annotated[float, Meta(gt=0, le=LONGEST_S)]
    voters: str
    """Digest of the grantors as the asker is configured."""
    parts: Annotated[tuple[Part, ...], Meta(max_length=MOST_PARTS)] = ()
    """What of the key: two holders may have parts that are different. None: all of it."""
    after: Annotated[int, Meta(ge=0, le=2**53)] = 0
    """Refuse it when the holder has a grant of a higher fence than this: somebody else asks for it by now. 0: whatever
    it has."""
    cleared: Annotated[tuple[str, ...], Meta(max_length=MOST_PARTS)] = ()
    """Holders whose parts are free once their lease has ended: the asker knows that they have left them."""


class LeaseEnd(Struct, frozen=True, kw_only=True):
    """`lease_release`: the holder needs the grant of this fence no longer."""

    key: str
    holder: Annotated[str, Meta(min_length=1, max_length=120)]
    fence: Fence
    voters: str


class Granted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A grantor's answer."""

    granted: bool = False
    fence: Annotated[int, Meta(ge=0, le=2**53)] = 0
    """The highest fence that it has granted, for any key; only a higher one is granted."""
    holder: str = ""
    """Where not granted: who has the grant; empty: nobody, the fence was too low."""
    left_s: float = 0.0
    """For how much longer; 0: its lease on these parts has ended, and nobody has said that it left them."""
    part: str = ""
    """One of the parts that it has, where parts were asked for."""


class Released(Struct, frozen=True):
    """Answer of `lease_release`: the grant is gone, or was no more."""


class FactsAsk(Struct, frozen=True, omit_defaults=True):
    """`facts`: what do you know? `all`: of the other gateways too, of those whose ids come after `after`."""

    all: bool = False
    after: str = ""


class Known(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a gateway knows of another, and how old that is."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    age_ms: int = 0


class Facts(Struct, frozen=True, omit_defaults=True):
    """A gateway's own facts, the robots it knows of, and, if asked, what it knows of other gateways."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    robots: tuple[RobotInfo, ...] = ()
    others: tuple[Known, ...] = ()
    more: bool = False
    """There are further others."""


class MemberAsk(Struct, frozen=True):
    """`member`: do you see a gateway of this name?"""

    gateway: str
    challenge: Annotated[str, Meta(max_length=64)] = ""
    """Where there are keys: something new, for the asked gateway to sign."""


class Member(Struct, frozen=True):
    """The answer."""

    here: bool
    proof: bytes = b""
    """The challenge, signed as a request for this verb (`identity.signing`): it is the gateway of that id."""


class SealedAsk(Struct, frozen=True):
    """`roster`, `parts`: which one have you? With `sealed`: take this one, unless you have a newer."""

    number: int
    """Of the one that the asking member has."""
    sealed: bytes = b""
    """The file, which the authority has signed."""


class SealedTold(Struct, frozen=True):
    """The answer: what counts there now."""

    number: int
    sealed: bytes = b""
    """Where it is newer than what was asked with."""


class ReopeningAsk(Struct, frozen=True):
    """`reopening`: the asking gateway closes its session and opens another; count it as there meanwhile."""

    gateway: str
    done: bool = False
    """It has done so, or does not after all."""


class Reopening(Struct, frozen=True):
    """The answer."""


class Exchange(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What was asked of a gateway and what it answered; published after the answer."""

    verb: str
    gateway: str
    request: Raw
    duration_ms: float
    reply: Raw = Raw(b"null")
    """JSON null where there is an `error` (a union with None would not be decoded as raw JSON)."""
    error: ErrorReply | None = None
