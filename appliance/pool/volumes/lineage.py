"""Which state of a volume is newer than which, and which of two stands. Pure.

A state has a version vector: for each gateway, how many of its runs changed the volume on the way to this state.
One state is newer than another when it has seen everything the other has; otherwise two gateways changed a common
ancestor without knowing of each other (a partition), and a total order that every gateway computes alike decides.
"""

import enum

import msgspec
from msgspec import Struct

from appliance.errors import PayloadError
from appliance.model import VersionVector
from appliance.plane.records import descends

KEY = "volume/"
"""Prefix of the states that this gateway keeps in its own store."""


class VolumeRecord(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The newest state of a volume in the fleet, as the record `volume/{name}` has it."""

    name: str
    version: VersionVector
    gateway: str
    """Whose run made it."""
    size_bytes: int = 0


class Relation(enum.Enum):
    """How this gateway's state stands to another."""

    SAME = "same"
    NEWER = "newer"
    OLDER = "older"
    WINS = "wins"
    """Both changed, ours stands."""
    LOSES = "loses"
    """Both changed, the other stands; ours is to be kept aside."""


def generation(version: VersionVector) -> int:
    """How many runs changed the volume on the way to a state."""
    return sum(version.values())


def relation(mine: VersionVector, my_writer: str, other: VersionVector, other_writer: str) -> Relation:
    """How a state stands to another: by descent, then by generation, then by the lower id of its writer."""
    newer, older = descends(mine, other), descends(other, mine)
    if newer and older:
        return Relation.SAME
    if newer:
        return Relation.NEWER
    if older:
        return Relation.OLDER
    return Relation.WINS if _rank(mine, my_writer) > _rank(other, other_writer) else Relation.LOSES


def _rank(version: VersionVector, writer: str) -> tuple[int, tuple[int, ...], tuple[tuple[str, int], ...]]:
    # A lower id wins, so it must rank higher; the end of the shorter id highest.
    return generation(version), (*(-ord(char) for char in writer), 1), tuple(sorted(version.items()))


def read(value: bytes) -> VolumeRecord:
    """Decode a record; PayloadError when it is none."""
    try:
        record = msgspec.json.decode(value, type=VolumeRecord)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(
            f"a record of a volume is damaged: {error}", remedy="the next run that changes it writes it again"
        ) from error
    if not all(count > 0 for count in record.version.values()):
        raise PayloadError(f"a record of volume {record.name[:80]} has an impossible version")
    return record


def stronger(one: bytes, other: bytes) -> bytes:
    """Which of two concurrent values of a volume's record stands; one that cannot be read is weaker than any."""
    return max(one, other, key=_value_rank)


def _value_rank(value: bytes) -> tuple[int, tuple[int, ...], tuple[tuple[str, int], ...], bytes]:
    try:
        record = read(value)
    except PayloadError:
        return (-1, (), (), value)
    return (*_rank(record.version, record.gateway), value)
