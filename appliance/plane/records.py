"""Records and their version vectors, and what becomes of a record when versions meet.

A write names the version it saw. Versions that do not descend from one another were written without knowledge of
each other (two owners during a change of membership, or a partition); every gateway picks the same one, and the
result descends from both, so replicas end up equal in whatever order they hear (design/algorithms, Versions). Pure.
"""

import hashlib
from collections.abc import Callable, Mapping

import msgspec

from appliance.errors import ConflictError, PayloadError
from appliance.model import VersionVector
from appliance.model.keys import check_name
from appliance.model.plane_api import Record, Write

MAX_KEY = 512
"""Characters in a record's key."""
_MAX_WRITERS = 256
_MAX_COUNT = 2**53


Resolver = Callable[[str, Record, Record], Record]


class Behind(Exception):  # noqa: N818 - not an error: news for the owner
    """The writer has seen a version newer than what is here: this copy must be brought up to date first."""


def descends(one: VersionVector, other: VersionVector) -> bool:
    """Whether `one` has seen everything `other` has (equal versions descend from each other)."""
    return all(one.get(gateway, 0) >= count for gateway, count in other.items())


def concurrent(one: VersionVector, other: VersionVector) -> bool:
    """Whether neither has seen the other."""
    return not descends(one, other) and not descends(other, one)


def merge(one: VersionVector, other: VersionVector) -> VersionVector:
    """The smallest version that descends from both."""
    return {gateway: max(one.get(gateway, 0), other.get(gateway, 0)) for gateway in sorted({*one, *other})}


def increment(version: VersionVector, gateway: str) -> VersionVector:
    """The version after one more write by a gateway."""
    return version | {gateway: version.get(gateway, 0) + 1}


def follows_here(later: Record, record: Record, gateway: str) -> bool:
    """Whether `later` was decided by `gateway` upon `record`, and upon nothing that anybody else ordered meanwhile.

    Then their versions differ in that gateway's own count alone; what `settle` makes of two has the counts of both.
    """
    counts = later.version.get(gateway, 0), record.version.get(gateway, 0)
    return counts[0] > counts[1] and later.version == {**record.version, gateway: counts[0]}


def by_bytes(key: str, one: Record, other: Record) -> Record:  # noqa: ARG001 - a resolver's signature
    """The default resolver: a total order on content, a removal above any value."""
    return max(one, other, key=lambda record: (record.deleted, record.value, record.write))


def settle(mine: Record | None, other: Record, resolver: Resolver) -> Record:
    """What stands when a copy hears of another; the same on every gateway, in whatever order they hear."""
    if mine is None:
        return other
    mine_newer, other_newer = descends(mine.version, other.version), descends(other.version, mine.version)
    if mine_newer and other_newer:
        # One version, two contents: a gateway that lost its file counted on from older copies.
        return mine if mine == other else resolver(mine.key, mine, other)
    if mine_newer:
        return mine
    if other_newer:
        return other
    winner = resolver(mine.key, mine, other)
    return msgspec.structs.replace(winner, version=merge(mine.version, other.version))


def decide(current: Record | None, asked: Write, gateway: str) -> Record:
    """Compare and set at the owner `gateway`.

    Returns:
        The record to store; `current` itself when this very write is done already.

    Raises:
        ConflictError: the record has moved on since the writer read it.
        Behind: the writer has seen a newer version than the owner has.
        PayloadError: its version has no room for one more write (a forged one, since nobody writes so often): the
            replicas would refuse it, and the write stand on one disk alone.
    """
    if current is not None and asked.write and current.write == asked.write:
        return current
    version = current.version if current is not None else {}
    absent = current is None or current.deleted
    if asked.expected is None:
        if not absent:
            raise ConflictError(f"{asked.key} exists already", remedy="read it and decide again")
    elif asked.expected != version:
        if descends(asked.expected, version):
            raise Behind
        raise ConflictError(f"{asked.key} has moved on to {version}", remedy="read it and decide again")
    version = increment(version, gateway)
    try:
        check_version(version)
    except PayloadError as error:
        raise PayloadError(
            f"{asked.key} cannot be changed any more: {error.message}", remedy="write what it held under another key"
        ) from None
    return Record(
        key=asked.key,
        value=b"" if asked.deleted else asked.value,
        version=version,
        deleted=asked.deleted,
        write=asked.write,
    )


def digest(record: Record) -> str:
    """16 hexadecimal digits that differ when version or content do; compared between replicas."""
    version = msgspec.json.encode(sorted(record.version.items()))
    content = hashlib.blake2b(version, digest_size=8, person=b"D" if record.deleted else b"V")
    content.update(record.value)
    return content.hexdigest()


def summary(digests: Mapping[str, str]) -> str:
    """One short text for digests by key; equal only where every key has the same digest.

    The keys are hashed too: many records are alike but for their key, and would cancel out in a mere sum of digests.
    """
    lines = "\n".join(sorted(f"{key} {each}" for key, each in digests.items()))
    return f"{len(digests)}:{hashlib.blake2b(lines.encode(), digest_size=16).hexdigest()}"


def check_key(key: str) -> str:
    """Return a record's key if it may be one; PayloadError otherwise."""
    if not 1 <= len(key) <= MAX_KEY or not key.isprintable():
        raise PayloadError(f"{key[:80]!r} is not a record's key", remedy=f"1 to {MAX_KEY} printable characters")
    return key


def check_version(version: VersionVector) -> None:
    """Raise PayloadError when a version from elsewhere cannot be one."""
    if len(version) > _MAX_WRITERS:
        raise PayloadError(f"a version of {len(version)} writers", remedy=f"at most {_MAX_WRITERS}")
    for gateway, count in version.items():
        check_name(gateway, "gateway")
        if not 1 <= count < _MAX_COUNT:
            raise PayloadError(f"a version counts {count} writes of {gateway}")


def check_record(record: Record, *, max_bytes: int) -> Record:
    """Return a record from elsewhere if it may be stored; PayloadError otherwise."""
    check_key(record.key)
    check_version(record.version)
    _check_size(record.key, record.value, max_bytes)
    if not record.version:
        raise PayloadError(f"{record.key} has no version")
    return record


def check_write(asked: Write, *, max_bytes: int) -> Write:
    """Return a write if it may be done; PayloadError otherwise."""
    check_key(asked.key)
    _check_size(asked.key, asked.value, max_bytes)
    if asked.expected is not None:
        check_version(asked.expected)
    return asked


def _check_size(key: str, value: bytes, most: int) -> None:
    if len(value) > most:
        raise PayloadError(f"the value of {key} has {len(value):,} bytes", remedy=f"at most {most:,}")
