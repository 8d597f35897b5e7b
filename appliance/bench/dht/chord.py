"""What was published for Chord, to stand beside what is simulated here.

Stoica, Morris, Liben-Nowell, Karger, Kaashoek, Dabek, Balakrishnan: "Chord: A Scalable Peer-to-Peer Lookup Protocol
for Internet Applications", IEEE/ACM Transactions on Networking 11(1), February 2003, pp. 17-32; first in SIGCOMM 2001.
The figures of the table were written down without a copy of the paper at hand: compare before citing them further.
"""

import math

from msgspec import Struct


class PublishedFailure(Struct, frozen=True):
    """A line of ToN 2003, table II: 1,000 nodes, successor list of 20, that share failed at once; all lookups end."""

    share: float
    mean_hops: float
    mean_timeouts: float


FAILURES = (
    PublishedFailure(0.0, 3.84, 0.0),
    PublishedFailure(0.1, 4.03, 0.60),
    PublishedFailure(0.2, 4.22, 1.17),
    PublishedFailure(0.3, 4.44, 2.02),
    PublishedFailure(0.4, 4.69, 3.23),
    PublishedFailure(0.5, 5.09, 5.10),
)
FAILURES_SOURCE = (
    "Stoica et al., IEEE/ACM ToN 11(1) 2003, table II (N = 1,000, r = 20); written down without the paper at hand, "
    "not compared with it"
)
FAILURES_THEOREM = (
    "What the same paper proves: with successor lists of length proportional to log N in a ring that was stable, and "
    "every node failing with probability 1/2, a lookup ends with high probability at the closest living successor, "
    "in expected time O(log N)"
)
HOPS_SOURCE = "Stoica et al., SIGCOMM 2001 and ToN 11(1) 2003, simulation of path length: mean about ½·log2 N"


def mean_hops(members: int) -> float:
    """Mean path length in a ring of that size."""
    return 0.5 * math.log2(members)
