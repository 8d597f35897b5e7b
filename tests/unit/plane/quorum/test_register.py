"""A register agreed on by a majority: whatever is lost, doubled or overtaken, its changes form one chain."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConflictError, PayloadError
from appliance.plane.quorum.register import (
    NONE,
    Ballot,
    Vote,
    accept,
    agreed,
    check_ballot,
    check_vote,
    current,
    majority,
    promise,
)
from appliance.plane.versions import Record, Write, by_bytes, decide, descends


def _record(count: int, value: bytes = b"") -> Record:
    return Record(key="k", value=value, version={"a": count}, write=f"w{count}")


def test_any_two_majorities_meet() -> None:
    """Twice a majority is more than there are."""
    assert [majority(n) for n in (1, 2, 3, 4, 5)] == [1, 2, 2, 3, 3]
    assert all(2 * majority(n) > n for n in range(1, 20))


def test_a_promise_keeps_lower_ballots_out() -> None:
    """A voter promises only higher ballots, and accepts none below its promise."""
    vote = promise(Vote(), Ballot(2, "a"))
    assert vote == Vote(promised=Ballot(2, "a"))
    assert promise(vote, Ballot(2, "a")) is None
    assert promise(vote, Ballot(1, "z")) is None
    assert accept(vote, Ballot(1, "z"), _record(1)) is None
    accepted = accept(vote, Ballot(2, "a"), _record(1))
    assert accepted == Vote(promised=Ballot(3, "a"), accepted=Ballot(2, "a"), record=_record(1))
    assert accept(accepted, Ballot(2, "b"), _record(2)) is None
    assert promise(accepted, Ballot(3, "b")) is not None


def test_the_highest_ballot_tells_the_value() -> None:
    """A majority's value is that of its highest ballot; an ordinary record counts only if it descends from that."""
    one = Vote(promised=Ballot(1, "a"), accepted=Ballot(1, "a"), record=_record(1))
    two = Vote(promised=Ballot(4, "a"), accepted=Ballot(3, "a"), record=_record(2))
    aside = Record(key="k", version={"b": 9})
    assert current([one, two], [], by_bytes) == _record(2)
    assert current([one, two], [_record(1), _record(2), aside], by_bytes) == _record(2)
    assert current([one, two], [_record(3)], by_bytes) == _record(3)
    assert current([Vote(), Vote()], [_record(1), _record(3)], by_bytes) == _record(3)
    assert current([Vote()], [], by_bytes) is None


def test_agreed_needs_a_majority_of_all_voters() -> None:
    """Two of three with the same ballot are enough, also for having accepted nothing; one with one and one are not."""
    one = Vote(promised=Ballot(1, "a"), accepted=Ballot(1, "a"), record=_record(1))
    assert agreed([one, Vote(), one], 3) == Ballot(1, "a")
    assert agreed([Vote(promised=Ballot(7, "z")), Vote()], 3) == NONE
    assert agreed([one, Vote()], 3) is None
    assert agreed([], 3) is None


@pytest.mark.parametrize(
    "ballot", [Ballot(0, "a"), Ballot(-1, "a"), Ballot(2**53, "a"), Ballot(1, ""), Ballot(1, "x" * 81), Ballot(1, "\n")]
)
def test_what_is_no_ballot(ballot: Ballot) -> None:
    """Numbers and names that no proposer uses are refused, alone and within a vote."""
    with pytest.raises(PayloadError):
        check_ballot(ballot)
    with pytest.raises(PayloadError):
        check_vote(Vote(promised=ballot, accepted=ballot, record=_record(1)), max_bytes=1000)


def test_what_is_no_vote() -> None:
    """A vote has a record just when it has accepted one, and the record must be one."""
    for vote in (Vote(record=_record(1)), Vote(accepted=Ballot(1, "a"))):
        with pytest.raises(PayloadError):
            check_vote(vote, max_bytes=1000)
    big = Vote(promised=Ballot(1, "a"), accepted=Ballot(1, "a"), record=_record(1, b"x" * 2000))
    with pytest.raises(PayloadError):
        check_vote(big, max_bytes=1000)


class _Network:
    """Three voters and proposers whose steps a test interleaves; a step reaches the voters that are drawn for it."""

    def __init__(self) -> None:
        self.votes = [Vote() for _ in range(3)]
        self.round = 0
        self.chain: list[Record] = []
        """What was acknowledged, in the order of acknowledgement."""

    def prepare(self, name: str, reached: frozenset[int]) -> tuple[Ballot, Record | None] | None:
        self.round += 1
        ballot = Ballot(self.round, name)
        granted: list[Vote] = []
        for number in reached:
            vote = promise(self.votes[number], ballot)
            if vote is not None:
                self.votes[number] = vote
                granted.append(vote)
        return (ballot, current(granted, [], by_bytes)) if len(granted) >= 2 else None

    def accept(self, ballot: Ballot, record: Record, reached: frozenset[int]) -> bool:
        granted = 0
        for number in reached:
            vote = accept(self.votes[number], ballot, record)
            if vote is not None:
                self.votes[number] = vote
                granted += 1
        return granted >= 2


_reached = st.frozensets(st.integers(0, 2))


@given(st.lists(st.tuples(st.sampled_from("abc"), _reached, _reached, st.booleans()), max_size=40))
def test_acknowledged_changes_form_a_chain(steps: list[tuple[str, frozenset[int], frozenset[int], bool]]) -> None:
    """Three proposers, each keeping its lead or preparing anew, with any voters out of reach: nobody forks the chain.

    Each change is a compare-and-set on what its proposer was told. One that a majority accepted descends from all
    acknowledged before it, and a read by one round of questions sees the last of them.
    """
    network = _Network()
    leads: dict[str, tuple[Ballot, Record | None]] = {}
    for number, (name, first, second, delayed) in enumerate(steps):
        lead = leads.pop(name, None) or network.prepare(name, first)
        if lead is None:
            continue
        if delayed:  # between its promise and its proposal the others go on
            leads[name] = lead
            continue
        ballot, found = lead
        asked = Write(key="k", value=b"%d" % number, expected=found and found.version, write=f"{name}{number}")
        new = decide(found, asked, name)
        if network.accept(ballot, new, second):
            for before in network.chain:
                assert descends(new.version, before.version)
                assert new.version != before.version
            network.chain.append(new)
            leads[name] = (ballot.next(), new)
            for pair in ((0, 1), (0, 2), (1, 2)):
                votes = [network.votes[each] for each in pair]
                seen = agreed(votes, 3)
                if seen is not None:
                    assert current([each for each in votes if each.accepted == seen], [], by_bytes) == new


def test_a_change_of_what_moved_on_conflicts() -> None:
    """Who expects another version than the register's is told so by the decision itself."""
    with pytest.raises(ConflictError):
        decide(_record(2), Write(key="k", expected=None), "a")
