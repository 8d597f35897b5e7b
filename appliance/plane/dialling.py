"""Which of two gateways dials the other: always the same one, so that there is one link between them.

Where each dials the other there are two links, one made by either side, and both carry one Zenoh transport. When one
side stands still for a lease the other closes both and begins anew; the one that runs again notices the ends of its two
links one after the other, and in between takes the new link for a further one of the old transport. From then on the
two mean different keys by the same numbers (zenoh issue 1886): questions arrive at wrong doors or nowhere, for as long
as that link lives. In a fleet of eight with two links between each pair some gateway did not answer another after
fourteen of 23 standstills; with one link between each pair all did after each of 72 (docs/benchmarks.md).

With one link this cannot happen: Zenoh takes one incoming link of a transport and no more, so that whoever dials anew
is refused until the old link's end has been noticed, and with that link the old transport is gone.

So each gateway has a rank, and the higher one dials. A gateway that is named in the others' `plane.peers` has a rank by
its name; one that only names others (`plane.connect`) is above all of those. One with a table dials by nothing else.
Those without go by Zenoh's gossip too, in the same order: of two that hear of each other the one with the greater
session id dials, and the id ends with the rank. (Zenoh compares ids from their last byte on.)
"""

import secrets
from collections.abc import Mapping
from hashlib import blake2b

_RANK_BYTES = 4
_ID_BYTES = 16
_NAMED, _NAMING = 0x20, 0xE0
"""First byte of the rank, the class: of those that others name, and of those that only name others."""


def rank(gateway: str) -> bytes:
    """The rank of a gateway; by hash, which two tables agree on that have not all names in common."""
    return bytes([_NAMED]) + blake2b(gateway.encode(), digest_size=_RANK_BYTES - 1).digest()


def dialled(gateway: str, peers: Mapping[str, str]) -> tuple[str, ...]:
    """The endpoints of `peers` (name to endpoint, a gateway's own perhaps among them) that a gateway dials."""
    own = (rank(gateway), gateway)
    return tuple(endpoint for name, endpoint in peers.items() if (rank(name), name) < own)


def session_id(gateway: str, *, naming: bool) -> str:
    """A new session id, 32 hexadecimal digits; `naming`: it only names others. An unnamed peer's rank is any."""
    last = rank(gateway or secrets.token_hex(4))
    if naming:
        last = bytes([_NAMING]) + last[1:]
    # Zenoh takes no id whose first digit is a zero.
    first = bytes([secrets.randbelow(0xF0) + 0x10]) + secrets.token_bytes(_ID_BYTES - _RANK_BYTES - 1)
    return (first + last[::-1]).hex()
