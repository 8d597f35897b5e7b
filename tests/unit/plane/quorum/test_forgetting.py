"""Votes on removed registers are forgotten only when nothing that is lost, late or doubled can bring a value back."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.plane.quorum.register import (
    NONE,
    Ballot,
    Vote,
    accept,
    current,
    forgettable,
    majority,
    promise,
    unknown,
)
from appliance.plane.versions import Record, Write, by_bytes, decide

VOTERS = 3
Message = tuple[Ballot, Record | None]
"""A question to a voter, which may arrive at any time, again and again, or never: an accept, or a prepare (None)."""


class _Registers:
    """Voters of one register, proposers, and everything that was ever sent.

    Times of forgetting are left to chance: a voter may look at the others at any time and act on it much later.
    """

    def __init__(self) -> None:
        self.votes: list[Vote | None] = [None] * VOTERS
        self.floors = [NONE] * VOTERS
        self.sent: list[Message] = []
        self.granted: dict[Ballot, dict[int, Vote]] = {}
        """By ballot: who promised, with what it had accepted."""
        self.accepted: dict[Ballot, set[int]] = {}
        self.records: dict[Ballot, Record] = {}
        self.told: list[dict[int, Vote]] = [{} for _ in range(VOTERS)]
        """What each voter has been told by the others since it last looked."""
        self.forgotten: list[Ballot] = []
        self.round = 0

    def vote(self, number: int) -> Vote:
        found = self.votes[number]
        return unknown(self.floors[number]) if found is None else found

    def prepare(self) -> None:
        self.round += 1
        self.sent.append((Ballot(self.round, f"p{self.round}"), None))

    def arrive(self, message: Message, number: int) -> None:
        ballot, record = message
        before = self.vote(number)
        after = promise(before, ballot) if record is None else accept(before, ballot, record)
        if after is None:
            return
        self.votes[number] = after
        if record is None:
            self.granted.setdefault(ballot, {})[number] = before
        else:
            self.accepted.setdefault(ballot, set()).add(number)

    def propose(self, ballot: Ballot, remove: bool) -> None:
        """Go on with a ballot that a majority has promised; a second time with the same is nobody's."""
        promised = self.granted.get(ballot, {})
        if len(promised) < majority(VOTERS) or ballot in self.records:
            return
        found = current(promised.values(), [], by_bytes)
        asked = Write(
            key="k", value=str(ballot).encode(), deleted=remove, write=str(ballot), expected=found and found.version
        )
        if found is None or found.deleted:
            asked = Write(key="k", value=str(ballot).encode(), write=str(ballot), expected=None)
        record = decide(found, asked, ballot.proposer)
        self.records[ballot] = record
        self.sent.append((ballot, record))

    def check(self) -> None:
        """No majority tells of a value from before a removal that somebody has forgotten."""
        for gone in self.forgotten:
            for pair in ((0, 1), (0, 2), (1, 2)):
                last = max(self.vote(number).accepted for number in pair)
                assert last == NONE or last >= gone

    def look(self, number: int, other: int) -> None:
        if other != number:
            self.told[number][other] = self.vote(other)

    def forget(self, number: int) -> None:
        vote = self.votes[number]
        told = [(each, None) for each in self.told[number].values()]
        if vote is not None and forgettable(vote, None, told, VOTERS):
            self.forgotten.append(vote.accepted)
            self.floors[number] = max(self.floors[number], vote.promised)
            self.votes[number] = None


_steps = st.lists(
    st.tuples(
        st.sampled_from(("prepare", "arrive", "arrive", "arrive", "propose", "propose", "look", "look", "forget")),
        st.integers(0, 30),
        st.integers(0, VOTERS - 1),
        st.booleans(),
    ),
    max_size=120,
)


def _step(registers: _Registers, what: str, which: int, number: int, remove: bool) -> None:
    match what:
        case "prepare":
            registers.prepare()
        case "arrive" if registers.sent:
            registers.arrive(registers.sent[which % len(registers.sent)], number)
        case "propose" if registers.granted:
            registers.propose(sorted(registers.granted)[which % len(registers.granted)], remove)
        case "look":
            registers.look(number, which % VOTERS)
        case "forget":
            registers.forget(number)
        case _:
            pass


_several = st.sampled_from([(0, 1, 2), (0, 1), (0, 2), (1, 2)])


@given(_steps, _steps, _several, _several, _several, st.sampled_from([0, 1, 2, 3]))
def test_what_was_removed_does_not_come_back(
    before: list[tuple[str, int, int, bool]],
    after: list[tuple[str, int, int, bool]],
    first: tuple[int, ...],
    promised: tuple[int, ...],
    accepted: tuple[int, ...],
    silent: int,
) -> None:
    """However messages are lost, doubled and delayed, also beyond the forgetting, and whoever forgets when.

    In between a value is accepted by some voters, its removal promised by some and accepted by some, and each voter
    tries to forget it, with one of them perhaps silent.
    """
    registers = _Registers()
    for step in before:
        _step(registers, *step)
        registers.check()
    for remove, asked, told in ((False, first, first), (True, promised, accepted)):
        registers.prepare()
        ballot = registers.sent[-1][0]
        for number in asked:
            registers.arrive((ballot, None), number)
        registers.propose(ballot, remove)
        for number in told:
            registers.arrive((ballot, registers.records[ballot]), number)
    removed = registers.records[ballot].deleted and len(accepted) == VOTERS and silent == VOTERS
    registers.told = [{} for _ in range(VOTERS)]
    for number in range(VOTERS):
        for other in range(VOTERS):
            if other != silent:
                registers.look(number, other)
        registers.forget(number)
        assert (registers.votes[number] is None) >= removed
        registers.check()
    for step in after:
        _step(registers, *step)
        registers.check()


def _vote(accepted: int, *, deleted: bool, promised: int = 0) -> Vote:
    record = Record(key="k", value=b"", version={"a": accepted}, deleted=deleted)
    ballot = Ballot(accepted, "p")
    return Vote(promised=Ballot(promised, "p") if promised else ballot.next(), accepted=ballot, record=record)


def test_one_who_is_silent_or_lags_keeps_all_from_forgetting() -> None:
    """All others must have told, accepted the removal or later, or promised what keeps older values out."""
    gone = _vote(5, deleted=True)
    fine = [(gone, None), (unknown(Ballot(6, "p")), None)]
    assert forgettable(gone, None, fine, VOTERS)
    assert forgettable(gone, Record(key="k", version={"a": 1}, deleted=True), fine, VOTERS)
    assert not forgettable(gone, None, fine[:1], VOTERS)
    assert not forgettable(gone, Record(key="k", version={"a": 1}), fine, VOTERS)
    for lagging in (Vote(), unknown(Ballot(4, "p")), _vote(3, deleted=False), _vote(3, deleted=True)):
        assert not forgettable(gone, None, [fine[0], (lagging, None)], VOTERS)
    assert not forgettable(gone, None, [fine[0], (gone, Record(key="k", version={"a": 1}))], VOTERS)
    assert not forgettable(_vote(5, deleted=False), None, fine, VOTERS)
    assert not forgettable(Vote(), None, fine, VOTERS)
    assert not forgettable(gone, None, [fine[0], (_vote(7, deleted=False), None)], VOTERS)
