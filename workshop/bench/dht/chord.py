"""What was published for Chord, to stand beside what is simulated here.

Stoica, Morris, Karger, Kaashoek, Balakrishnan: "Chord: A Scalable Peer-to-peer Lookup Service for Internet
Applications", SIGCOMM 2001. Quoted is only what was compared with a transcription of that paper's text: sections 5.2
(theorems 7 and 8), 6.3 (figure 10a) and 6.4 (figure 11). The journal version (IEEE/ACM Transactions on Networking
11(1), 2003) counts hops and timeouts before stabilisation as well; it was not at hand, so it is not quoted.
"""

import math

FAILURES_SOURCE = (
    "Stoica et al., SIGCOMM 2001, section 6.4, figure 11: 10,000 nodes, 1,000,000 keys without replicas; a share p of "
    "the nodes fails at once, and after the ring has stabilised the share of lookups that do not find the node "
    "which had the key is almost exactly p, that of the keys whose node is gone"
)
FAILURES_THEOREM = (
    "Theorems 7 and 8 of the same paper: with successor lists of length O(log N) in a network that is initially "
    "stable, and every node failing with probability 1/2, find_successor returns with high probability the closest "
    "living successor, in expected time O(log N)"
)
HOPS_SOURCE = "Stoica et al., SIGCOMM 2001, section 6.3, figure 10(a): the mean path length is about 1/2 log2 N"


def mean_hops(members: int) -> float:
    """Mean path length in a ring of that size."""
    return 0.5 * math.log2(members)


def failed_percent(share: float) -> float:
    """Lookups that do not find the node which had the key, in percent, after a share of all nodes failed."""
    return 100 * share
