"""What proposers ask voters, and what gateways ask proposers: the verbs `quorum_*` of docs/keyspace.md."""

from msgspec import Struct

from appliance.model import VersionVector
from appliance.plane.quorum.register import Ballot, Vote
from appliance.plane.versions import Record


class PrepareAsk(Struct, frozen=True, kw_only=True):
    """`quorum_prepare`: promise this ballot."""

    key: str
    ballot: Ballot
    voters: str
    """Digest of the voters as the proposer is configured."""


class AcceptAsk(Struct, frozen=True, kw_only=True):
    """`quorum_accept`: this is the register's value, unless you have promised a higher ballot."""

    key: str
    ballot: Ballot
    record: Record
    voters: str


class VoteAsk(Struct, frozen=True, kw_only=True):
    """`quorum_vote`: what have you promised and accepted?"""

    key: str
    voters: str


class Voted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A voter's answer: its vote as it is now, and the ordinary record of the key."""

    granted: bool = False
    vote: Vote = Vote()
    plain: Record | None = None


class SettleAsk(Struct, frozen=True):
    """`quorum_settle`: bring the voters to one value."""

    key: str


class Outcome(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What became of a change or a settling."""

    version: VersionVector = {}
    record: Record | None = None
    problem: str = ""
    unsure: bool = False
    """With a problem: it may be written all the same."""
