"""Linearizable compare-and-set: a register for each key, agreed on by a majority of its voters.

A plain write is ordered by the key's owner, and two parts of a fleet that are cut off from each other may each have
one. Who asks for a quorum gets a register that only one part can change: each key has r voters, chosen on the ring of
all gateways that `plane.voters` names, whether they are there or not, and every step needs a majority of them. No
clock and no lease has a part in it, so frozen gateways and wrong clocks cannot break it. `register` is the pure part
(what a voter promises and accepts, what a proposer may conclude), `voting` carries it out.

Source: Rystsov, "CASPaxos: Replicated State Machines without logs", arXiv:1802.07000, 2018; single-decree Paxos of
Lamport, "Paxos made simple", 2001, whose state is rewritten in place.
"""
