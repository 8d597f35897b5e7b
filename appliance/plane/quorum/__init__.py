"""Leases that a majority grants: mutual exclusion for whoever must not be two, in a fleet that may be cut in two.

Each key has r grantors, the first on the ring of all gateways that `plane.voters` names, whether they are there or
not; a lease needs the grant of a majority of them, and any two majorities have one in common. `grants` is the pure part
(what a grantor grants, what an asker may conclude), `leases` the shell between gateways.

Sources: Gray, Cheriton, "Leases: an efficient fault-tolerant mechanism for distributed file cache consistency", 1989
(a lease ends by itself, each side by its own clock; a grantor that was restarted is silent for the longest lease);
Lamport, "Paxos made simple", 2001 (majorities, and numbers that only increase).
"""

from appliance.plane.leases import Lease, Leases

__all__ = ["Lease", "Leases"]
