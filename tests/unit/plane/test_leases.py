"""Grants under partitions, lost and late messages, restarts and time that passes: at most one holder, ever."""

import contextlib
import random

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from appliance.errors import PayloadError, RefusedError
from appliance.model.plane_api import LONGEST_S, Granted, LeaseAsk, LeaseEnd
from appliance.plane.leases import (
    GrantCase,
    Grantor,
    answered,
    case_of,
    grant_again,
    granted,
    highest,
    holder_of,
)

KEY = "reservation/aisle-3"
GRANTORS = 3
ASKERS = ("a", "b", "c")


def ask(name: str, fence: int, ttl_s: float = 10.0, key: str = KEY) -> LeaseAsk:
    """A request of an asker."""
    return LeaseAsk(key=key, holder=name, fence=fence, ttl_s=ttl_s, voters="")


def end(name: str, fence: int) -> LeaseEnd:
    """A release."""
    return LeaseEnd(key=KEY, holder=name, fence=fence, voters="")


class Fleet:
    """Three grantors and three askers on a network that is cut again and again, driven by chance.

    An asker counts its lease from before it asked, as `leases` does, and asks under a fence above all it has heard of.
    """

    def __init__(self, generator: random.Random) -> None:
        self.generator = generator
        self.now = 0.0
        self.grantors = [Grantor(fence=0, now=0.0) for _ in range(GRANTORS)]
        self.heard = dict.fromkeys(ASKERS, 0)
        self.leases: dict[str, tuple[int, float]] = {}
        """By asker: fence and end of the lease it has."""
        self.ids: dict[str, str] = {}
        self.late: list[tuple[int, LeaseAsk | LeaseEnd]] = []
        """Requests that are still on their way, to a grantor each."""
        self.fences: list[int] = []
        self.acquired = self.renewed = 0

    def has(self, name: str) -> bool:
        """Whether an asker has a lease now, as it sees it."""
        return name in self.leases and self.now < self.leases[name][1]

    def step(self) -> None:
        """Something happens."""
        steps = [self.ask, self.release, self.late_arrival, self.restart, self.time_passes]
        self.generator.choices(steps, [10, 2, 3, 1, 4])[0]()
        assert sum(self.has(name) for name in ASKERS) <= 1, "two holders"
        assert self.fences == sorted(set(self.fences)), "a fence that is not higher than those before"

    def side(self) -> set[int]:
        """The grantors that are reached just now."""
        return {number for number in range(GRANTORS) if self.generator.random() < 0.6}

    def ask(self) -> None:
        """Acquire or renew; of the grantors reached some answers are lost, the others may get the request late."""
        name = self.generator.choice(ASKERS)
        renewal, ttl_s = self.has(name), self.generator.choice((1.0, 5.0, LONGEST_S))
        if not renewal:
            self.ids[name] = (
                f"{name}:{len(self.fences)}:{self.generator.random()}"  # each acquisition is another holder
            )
        self.heard[name] += 1
        asked = ask(self.ids[name], self.heard[name], ttl_s)
        reached, answers = self.side(), list[Granted]()
        for number, grantor in enumerate(self.grantors):
            if number not in reached:
                self.late.append((number, asked))
                continue
            with contextlib.suppress(RefusedError):
                answer = grantor.grant(asked, self.now)
                if self.generator.random() < 0.8:
                    answers.append(answer)
        self.heard[name] = max([self.heard[name], *(answer.fence for answer in answers)])
        if granted(answers, GRANTORS):
            assert len(reached) >= 2, "a minority granted it"
            self.fences.append(asked.fence)
            self.leases[name] = (asked.fence, self.now + ttl_s)
            self.acquired += not renewal
            self.renewed += renewal
        elif not renewal:
            for number in reached:
                self.grantors[number].release(end(self.ids[name], asked.fence))

    def release(self) -> None:
        """Give a lease back; grantors that are not reached hear of it late."""
        name = self.generator.choice(ASKERS)
        if self.has(name):
            ended, reached = end(self.ids[name], self.leases.pop(name)[0]), self.side()
            self.late += [(number, ended) for number in range(GRANTORS) if number not in reached]
            for number in reached:
                self.grantors[number].release(ended)

    def late_arrival(self) -> None:
        """A request arrives that nobody waits for."""
        if self.late:
            number, asked = self.late.pop(self.generator.randrange(len(self.late)))
            if isinstance(asked, LeaseEnd):
                self.grantors[number].release(asked)
            else:
                with contextlib.suppress(RefusedError):
                    self.grantors[number].grant(asked, self.now)

    def restart(self) -> None:
        """A grantor keeps its fence and forgets its grants."""
        number = self.generator.randrange(GRANTORS)
        self.grantors[number] = Grantor(fence=self.grantors[number].fence, now=self.now)

    def time_passes(self) -> None:
        """Leases end."""
        self.now += self.generator.choice((0.5, 1.0, 5.0, LONGEST_S))


def test_never_two_holders() -> None:
    """Whatever is cut, lost, late or restarted, and however time passes: one holder at most, under rising fences."""
    acquired = renewed = 0
    for seed in range(1500):
        fleet = Fleet(random.Random(seed))  # noqa: S311 - a simulation
        for _ in range(60):
            fleet.step()
        acquired, renewed = acquired + fleet.acquired, renewed + fleet.renewed
    assert acquired > 1500
    assert renewed > 500


def test_two_sides_of_a_cut_never_both_have_it() -> None:
    """The side with two of three grantors gets the lease, the other nothing; after it has ended the other may."""
    one, two, three = (Grantor(fence=0, now=0.0) for _ in range(3))
    assert not granted([three.grant(ask("b", 1), 0.0)], 3)
    assert granted([one.grant(ask("a", 1), 0.0), two.grant(ask("a", 1), 0.0)], 3)
    # Healed while the lease lasts: still refused, with who has it and for how long.
    answers = [each.grant(ask("b", 2), 4.0) for each in (one, two, three)]
    assert not granted(answers, 3)
    assert holder_of(answers, 3) == ("a", 6.0)
    assert granted([each.grant(ask("b", 3), 10.0) for each in (one, two, three)], 3)


def test_a_minority_grants_nothing() -> None:
    """Of five grantors two are not enough, three are."""
    answers = [Grantor(fence=0, now=0.0).grant(ask("a", 1), 0.0) for _ in range(3)]
    assert not granted(answers[:2], 5)
    assert granted(answers, 5)


def test_a_lease_ends_by_itself() -> None:
    """Until its time has passed nobody else is granted the key; from then on anybody is."""
    grantor = Grantor(fence=0, now=0.0)
    assert grantor.grant(ask("a", 1, ttl_s=2.0), 0.0).granted
    assert grantor.grant(ask("b", 2), 1.5) == Granted(fence=1, holder="a", left_s=0.5)
    assert grantor.grant(ask("b", 2), 2.0).granted


def test_a_renewal_never_shortens_what_was_granted() -> None:
    """A shorter renewal whose answer is lost leaves the holder with the lease it was told of."""
    grantor = Grantor(fence=0, now=0.0)
    grantor.grant(ask("a", 1, ttl_s=10.0), 0.0)
    assert grantor.grant(ask("a", 2, ttl_s=1.0), 0.0).granted
    assert not grantor.grant(ask("b", 3), 9.0).granted


def test_what_was_sent_before_a_grant_cannot_replace_it() -> None:
    """A request or a release with an older fence does nothing, however late it comes and however the key has moved."""
    grantor = Grantor(fence=0, now=0.0)
    grantor.grant(ask("a", 1), 0.0)
    grantor.grant(ask("a", 2), 0.0)
    grantor.release(end("a", 1))
    assert not grantor.grant(ask("b", 3), 1.0).granted
    grantor.release(end("a", 2))
    assert not grantor.grant(ask("b", 2), 1.0).granted
    assert grantor.grant(ask("b", 3), 1.0).granted


def test_a_restarted_grantor_is_silent_for_the_longest_lease() -> None:
    """It has forgotten what it granted, not how far its fences were; one that never granted anything grants at once."""
    grantor = Grantor(fence=7, now=100.0)
    with pytest.raises(RefusedError, match="restart"):
        grantor.grant(ask("a", 8), 100.0 + LONGEST_S - 0.1)
    assert grantor.grant(ask("a", 7), 100.0 + LONGEST_S) == Granted(fence=7)
    assert grantor.grant(ask("a", 8), 100.0 + LONGEST_S).granted
    assert Grantor(fence=0, now=0.0).grant(ask("a", 1), 0.0).granted


def test_absurd_fences_and_too_many_grants_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither uses up the numbers or the memory; what has ended makes room."""
    monkeypatch.setattr("appliance.plane.leases.MOST_GRANTS", 2)
    grantor = Grantor(fence=0, now=0.0)
    with pytest.raises(PayloadError):
        grantor.grant(ask("a", 2**50), 0.0)
    assert highest(3, [Granted(fence=7), Granted(fence=2**50)]) == 7
    assert highest(3, []) == 3
    for number in (1, 2):
        assert grantor.grant(ask("a", number, key=f"k{number}"), 0.0).granted
    with pytest.raises(RefusedError):
        grantor.grant(ask("a", 3, key="k3"), 1.0)
    assert grantor.grant(ask("a", 3, key="k3"), 10.0).granted


def part(
    name: str, fence: int, *parts: str, ttl_s: float = 10.0, after: int = 0, cleared: tuple[str, ...] = ()
) -> LeaseAsk:
    """A request for parts."""
    return LeaseAsk(
        key=KEY, holder=name, fence=fence, ttl_s=ttl_s, voters="", parts=parts, after=after, cleared=cleared
    )


def test_parts_exclude_one_another() -> None:
    """Holders of one key have different parts; the refusal names one that another has."""
    grantor = Grantor(fence=0, now=0.0)
    assert grantor.grant(part("a", 1, "1", "2"), 0.0).granted
    assert grantor.grant(part("b", 2, "3"), 0.0).granted
    refused = grantor.grant(part("c", 3, "2", "4"), 0.0)
    assert (refused.granted, refused.holder, refused.part) == (False, "a", "2")
    assert not grantor.grant(ask("c", 4), 0.0).granted, "all of a key of which others have parts"


def test_parts_outlast_their_lease() -> None:
    """What held them may still be there: they are free once an asker says that it has left."""
    grantor = Grantor(fence=0, now=0.0)
    assert grantor.grant(part("a", 1, "1"), 0.0).granted
    refused = grantor.grant(part("b", 2, "1"), 11.0)
    assert (refused.granted, refused.holder, refused.left_s) == (False, "a", 0.0)
    assert not grantor.grant(part("b", 3, "1", cleared=("a",)), 9.0).granted, "a lease that lasts is not cleared"
    assert grantor.grant(part("b", 4, "1", cleared=("a",)), 11.0).granted


def test_parts_are_given_up_by_asking_for_fewer() -> None:
    """More are added to what is held until it is renewed; a release takes back the last addition alone."""
    grantor = Grantor(fence=0, now=0.0)
    assert grantor.grant(part("a", 1, "1", "2"), 0.0).granted
    assert grantor.grant(part("a", 2, "2", "3"), 0.0).granted
    assert not grantor.grant(part("b", 3, "1"), 0.0).granted, "given up before a majority has granted the new ones"
    grantor.release(end("a", 2))
    assert grantor.grant(part("b", 4, "3"), 0.0).granted
    assert grantor.grant(part("a", 5, "2"), 0.0).granted
    assert not grantor.grant(part("b", 6, "1"), 0.0).granted
    assert grantor.grant(part("a", 7, "2", after=5), 0.0).granted
    assert grantor.grant(part("b", 8, "1", "3"), 0.0).granted


def test_a_late_renewal_takes_nothing_from_a_later_asker() -> None:
    """Two gateways ask for one robot: what the earlier one renews afterwards is refused in the robot's own name."""
    grantor = Grantor(fence=0, now=0.0)
    assert grantor.grant(part("a", 1, "1", "2"), 0.0).granted
    assert grantor.grant(part("a", 2, "2", "3"), 0.0).granted
    refused = grantor.grant(part("a", 3, "2", after=1), 0.0)
    assert (refused.granted, refused.holder) == (False, "a")
    assert not grantor.grant(part("b", 4, "3"), 0.0).granted


@pytest.mark.parametrize("seed", range(20))
def test_no_part_has_two_holders(seed: int) -> None:
    """Three grantors on a network that is cut at random: those granted by a majority never share a part."""
    generator = random.Random(seed)  # noqa: S311 - no secret
    grantors = [Grantor(fence=0, now=0.0) for _ in range(GRANTORS)]
    now, fence = 0.0, 0
    held: dict[str, tuple[frozenset[str], float]] = {}
    fences: dict[str, int] = {}
    for _ in range(400):
        now += generator.choice((0.0, 0.5, 4.0))
        name, fence = generator.choice(ASKERS), fence + 1
        parts = tuple(sorted(generator.sample("12345678", generator.randint(1, 4))))
        # Its own clock has ended a lease before its grantors' have, and only who is gone is cleared.
        live = {each for each, (_, until) in held.items() if until > now}
        after = 0
        if name in live and generator.random() < 0.5:
            # Renews with a part of what it has, and needs no more from now on.
            before, until = held[name]
            parts, after = tuple(sorted(before))[: generator.randint(1, len(before))], fences[name]
            held[name] = frozenset(parts), until
        asked = part(name, fence, *parts, after=after, cleared=tuple(set(ASKERS) - live))
        answers: list[Granted] = []
        for grantor in grantors:
            if generator.random() < 0.6:
                answer = grantor.grant(asked, now)
                if generator.random() < 0.8:
                    answers.append(answer)
        if granted(answers, GRANTORS):
            held[name], fences[name] = (frozenset(parts), now + asked.ttl_s), fence
            for other, (theirs, until) in held.items():
                assert other == name or until <= now or theirs.isdisjoint(parts)


Asks = list[tuple[str, int, int, bool, float]]


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(ASKERS), st.integers(0, 6), st.integers(1, 4), st.booleans(), st.floats(0.0, 8.0)),
        max_size=12,
    )
)
def test_an_answer_on_parts_is_made_again_from_its_case(asks: Asks) -> None:
    """Whatever was granted before: the same answer, and no part is granted twice at a time."""
    grantor, now = Grantor(fence=0, now=0.0), 0.0
    for fence, (name, first, count, cleared, passed) in enumerate(asks, start=1):
        now += passed
        parts = tuple(f"p{number}" for number in range(first, first + count))
        asked = replace(ask(name, fence), parts=parts, cleared=ASKERS if cleared else ())
        case = case_of(grantor, "gw-1", asked, now)
        told = answered(case, grantor.grant(asked, now))
        read = msgspec.json.decode(msgspec.json.encode(told), type=GrantCase)
        again = grant_again(read)
        assert again == {field: getattr(read, field) for field in again}
        assert not read.twice


def test_ground_that_was_granted_twice_is_a_difference() -> None:
    """A grantor that forgets to look at others: its own case tells on it."""
    grantor = Grantor(fence=0, now=0.0)
    grantor.grant(replace(ask("a", 1), parts=("p1", "p2")), 0.0)
    asked = replace(ask("b", 2), parts=("p2", "p3"))
    told = answered(case_of(grantor, "gw-1", asked, 1.0), Granted(granted=True, fence=2))
    assert told.twice == "a"
    again = grant_again(told)
    assert (again["granted"], again["holder"], again["part"], again["twice"]) == (False, "a", "p2", "")
