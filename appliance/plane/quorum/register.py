"""One register: what a voter remembers of it, and what a proposer may conclude from voters' answers. Pure.

A proposer has a majority promise its ballot and tell what they accepted before; the value of the highest ballot is
the register's. It changes that and has a majority accept the outcome, which is the register's value from then on. An
accepted ballot carries a promise for the proposer's next, so that whoever changes a register again and again asks
once for each change (CASPaxos, section 2.2.1, "one-round trip optimization").
"""

from collections.abc import Iterable

import msgspec
from msgspec import Struct

from appliance.errors import PayloadError
from appliance.plane.versions import Record, Resolver, check_record, descends, settle

_MOST_ROUND = 2**53


class Ballot(Struct, frozen=True, order=True, array_like=True):
    """The number of an attempt; no two proposers ever have the same."""

    round: int = 0
    proposer: str = ""
    """The gateway and what tells this run of it from its earlier ones."""

    def next(self) -> "Ballot":
        """The same proposer's next."""
        return Ballot(self.round + 1, self.proposer)


NONE = Ballot()


class Vote(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a voter remembers of a register, on its disk before it answers."""

    promised: Ballot = NONE
    """It accepts nothing of a lower ballot."""
    accepted: Ballot = NONE
    record: Record | None = None


def promise(vote: Vote, ballot: Ballot) -> Vote | None:
    """A voter's answer to `prepare`; None: it has promised that ballot or a higher one already."""
    return msgspec.structs.replace(vote, promised=ballot) if ballot > vote.promised else None


def accept(vote: Vote, ballot: Ballot, record: Record) -> Vote | None:
    """A voter's answer to `accept`; None: it has promised a higher ballot. Promises the proposer's next ballot too."""
    if ballot < vote.promised:
        return None
    return Vote(promised=ballot.next(), accepted=ballot, record=record)


def majority(voters: int) -> int:
    """How many voters decide: any two majorities have one in common."""
    return voters // 2 + 1


def current(votes: Iterable[Vote], plain: Iterable[Record], resolver: Resolver) -> Record | None:
    """The register's value as a majority's promises tell it.

    `plain`: the ordinary records of the same voters. They matter only where a key was written without a quorum too:
    one that descends from the register's value was written by somebody who had read it.
    """
    found = max(votes, key=lambda vote: vote.accepted, default=Vote()).record
    later: Record | None = None
    for record in plain:
        if found is None or (record.version != found.version and descends(record.version, found.version)):
            later = settle(later, record, resolver)
    return found if later is None else later


def agreed(votes: Iterable[Vote], voters: int) -> Ballot | None:
    """The ballot that a majority has accepted as its last, if there is one: its value was the register's meanwhile.

    A value chosen before the first of them was asked would have been accepted by one of them (two majorities meet),
    and a value that a majority has accepted is chosen; so one round of questions is a linearizable read.
    """
    counts: dict[Ballot, int] = {}
    for vote in votes:
        counts[vote.accepted] = counts.get(vote.accepted, 0) + 1
    return next((ballot for ballot, count in counts.items() if count >= majority(voters)), None)


def unknown(floor: Ballot) -> Vote:
    """A voter's vote on a register of which it remembers nothing; `floor`: the highest promise that it has forgotten.

    To promise more than one must is always safe. Whatever was sent while it still remembered is refused then.
    """
    return Vote(promised=floor)


def forgettable(vote: Vote, plain: Record | None, told: Iterable[tuple[Vote, Record | None]], voters: int) -> bool:
    """Whether a voter may forget a register that was removed.

    It may once no voter can ever tell of a value from before the removal: all have accepted the removal or something
    later, or have forgotten it already, and accept nothing older. What a voter tells of this stays true, so answers
    need not be of one moment. Ordinary copies count too where a register is forgotten, so none may hold a value.

    Args:
        vote: its own; its ballot is that of the removal.
        plain: its own ordinary record.
        told: the votes and ordinary records of all the other voters.
        voters: how many there are.
    """
    told = list(told)
    return (
        vote.record is not None
        and len(told) == voters - 1
        and all(_gone(each) for each in (vote.record, plain))
        and all(
            other.promised > vote.accepted
            and (other.accepted == NONE or other.accepted >= vote.accepted)
            and _gone(other.record)
            and _gone(copy)
            for other, copy in told
        )
    )


def _gone(record: Record | None) -> bool:
    return record is None or record.deleted


def check_ballot(ballot: Ballot) -> Ballot:
    """Return a ballot from elsewhere if it may be one; PayloadError otherwise."""
    if not 0 < ballot.round < _MOST_ROUND or not 1 <= len(ballot.proposer) <= 80 or not ballot.proposer.isprintable():
        raise PayloadError(f"{str(ballot)[:160]} is no ballot")
    return ballot


def check_vote(vote: Vote, *, max_bytes: int) -> Vote:
    """Return what another voter told if it may be so; PayloadError otherwise."""
    for ballot in (vote.promised, vote.accepted):
        if ballot != NONE:
            check_ballot(ballot)
    if vote.record is not None:
        check_record(vote.record, max_bytes=max_bytes)
    if (vote.record is None) != (vote.accepted == NONE):
        raise PayloadError("a vote with a record and no ballot, or the other way round")
    return vote
