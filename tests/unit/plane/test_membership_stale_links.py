"""Members that were never lost though this process stood still: links are made again, by nobody's word."""

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.plane.anti_entropy import COMPARE_S, LOSS_S, SEE_S
from appliance.plane.dht import RETURNED_S
from appliance.plane.events import FleetEvents, Stall, Stalled
from appliance.plane.membership import MOST_ASKED, RELINK_REST_S, RELINK_TRIES, Membership, Outlived
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio
LEASE_S = 1.0


class Bench:
    """A pulse and a membership in the test's hands; `after` happens in each pause."""

    def __init__(self, *tokens: tuple[str, float]) -> None:
        self.events = FleetEvents()
        self.tokens = dict(tokens)
        self.answering: set[str] = set()
        self.gone: dict[str, float] = {}
        self.seen: set[tuple[str, str]] = set()
        """Who sees whom."""
        self.witnesses: list[tuple[str, str]] = []
        self.asked: list[str] = []
        self.renewed: list[str] = []
        self.heals = True
        """Whether links that were made again are right."""
        self.pauses: list[float] = []
        self.after: list[Callable[[], None]] = []
        self.now = 0.0
        self.done = asyncio.Event()
        self.outlived = Outlived(
            self.events,
            lease_s=LEASE_S,
            members=self,
            answers=self.answers,
            sees=self.sees,
            renew=self.renew,
            now=lambda: self.now,
            pause=self.pause,
        )

    def seen_since(self, moment: float) -> frozenset[str]:
        """Whose token has been there since then."""
        return frozenset(name for name, at in self.tokens.items() if at <= moment)

    def lost_since(self, moment: float) -> frozenset[str]:
        """Who went since then."""
        return frozenset(name for name, at in self.gone.items() if at >= moment)

    def renew(self, why: str) -> None:
        """Links are made again."""
        self.renewed.append(why)
        if self.heals:
            self.answering |= self.tokens.keys()

    async def sees(self, name: str, other: str, timeout_s: float) -> bool:
        """Whether that one sees another."""
        assert timeout_s > 0
        self.witnesses.append((name, other))
        return (name, other) in self.seen

    @property
    def members(self) -> frozenset[str]:
        """Who is there."""
        return frozenset({"gw-1", *self.tokens})

    async def answers(self, name: str, timeout_s: float) -> bool:
        """Whether that one answers."""
        assert timeout_s > 0
        self.asked.append(name)
        return name in self.answering

    async def pause(self, seconds: float) -> None:
        """Let what the test wants happen; the look is over when nothing more is to."""
        self.pauses.append(seconds)
        if self.after:
            self.after.pop(0)()
        await asyncio.sleep(0)

    async def stand_still(self, since: float, lasted_s: float) -> None:
        """Stand still, and wait until all is looked at."""
        self.now = since + lasted_s
        self.events.publish(Stalled(Stall(since, lasted_s)))
        others = asyncio.all_tasks() - {cast("Any", asyncio.current_task())}
        await asyncio.gather(*(each for each in others if each.get_name() == "links after a standstill"))


class FakeSession:
    """Tokens in the test's hands."""

    def __init__(self) -> None:
        self.keys = Keys("f")
        self.watching: list[Callable[[str, bool], None]] = []

    def watch_alive(self, _: str, callback: Callable[[str, bool], None]) -> None:
        """Tell it of tokens."""
        self.watching.append(callback)

    def tell(self, name: str, number: str = "", *, alive: bool = True) -> None:
        """A token is seen, or gone."""
        self.watching[0](f"{self.keys(keyspace.GATEWAY_ALIVE, name)}{number}", alive)


async def test_links_are_made_anew_for_one_that_was_never_lost_and_is_silent() -> None:
    """The other went and came again; of one whose token stayed, and that says nothing, nothing known can be right."""
    bench = Bench(("gw-2", 5.0), ("gw-3", 5.0))
    bench.after = [lambda: bench.tokens.update({"gw-2": 12.0})]
    await bench.stand_still(10.0, 1.1)
    assert (bench.asked, len(bench.renewed)) == (["gw-3", "gw-3"], 1), "it is asked again whether that was enough"
    assert bench.pauses == [LEASE_S / 2, LEASE_S * 2, LEASE_S * 2]


async def test_in_a_fleet_of_two_silence_is_enough() -> None:
    """There is nobody else who could have noticed."""
    bench = Bench(("gw-2", 5.0))
    await bench.stand_still(10.0, 1.1)
    assert len(bench.renewed) == 1
    bench.answering = {"gw-2"}
    await bench.stand_still(10.0 + 2 * RELINK_REST_S, 1.1)
    assert (bench.asked, len(bench.renewed)) == (["gw-2"] * 3, 1)


async def test_all_that_stood_still_together_are_left_alone() -> None:
    """On a machine that was suspended, or starves, nobody loses anybody: no link is broken, and nobody is asked."""
    bench = Bench(("gw-2", 5.0), ("gw-3", 5.0))
    await bench.stand_still(10.0, 60.0)
    assert (bench.asked, bench.renewed) == ([], [])


async def test_one_that_answers_or_has_gone_meanwhile_is_well() -> None:
    """A busy machine's gateways are late, and are lost a moment later than others: that is no mix-up."""
    bench = Bench(("gw-2", 11.2), ("gw-3", 5.0), ("gw-4", 5.0))
    bench.answering = {"gw-3"}
    asked = bench.answers

    async def gone(name: str, timeout_s: float) -> bool:
        bench.tokens.pop("gw-4", None)
        return await asked(name, timeout_s)

    await bench.outlived.close()
    bench.outlived = Outlived(
        bench.events, lease_s=LEASE_S, members=bench, answers=gone, sees=bench.sees, renew=bench.renew,
        now=lambda: bench.now, pause=bench.pause,
    )  # fmt: skip
    await bench.stand_still(10.0, 1.1)
    assert (bench.asked, bench.renewed) == (["gw-3", "gw-4"], [])


async def test_a_look_that_is_under_way_is_not_begun_again() -> None:
    """With long leases it lasts longer than the rest after it; there is one at a time, which the end gives up."""
    bench = Bench(("gw-2", 5.0))
    asked, goes_on = asyncio.Event(), asyncio.Event()

    async def slow(name: str, timeout_s: float) -> bool:
        asked.set()
        await goes_on.wait()
        return await bench.answers(name, timeout_s)

    await bench.outlived.close()
    outlived = Outlived(
        bench.events, lease_s=LEASE_S, members=bench, answers=slow, sees=bench.sees, renew=bench.renew,
        now=lambda: bench.now, pause=bench.pause,
    )  # fmt: skip
    bench.now = 20.0
    bench.events.publish(Stalled(Stall(10.0, 1.1)))
    await asked.wait()
    asked.clear()
    bench.now = 20.0 + 2 * RELINK_REST_S
    bench.events.publish(Stalled(Stall(bench.now, 1.1)))
    goes_on.set()
    await asyncio.gather(*(each for each in asyncio.all_tasks() if each.get_name() == "links after a standstill"))
    assert (len(bench.asked), len(bench.renewed)) == (2, 1)
    await outlived.close()


async def test_a_large_fleet_is_counted_whole() -> None:
    """Only so many are asked, but with 40 that nobody lost one that is slow breaks no link; with one lost it does."""
    bench = Bench(*((f"gw-{number:02}", 5.0) for number in range(2, 42)))
    bench.answering = set(bench.tokens) - {"gw-07"}
    await bench.stand_still(10.0, 1.1)
    assert (bench.asked, bench.renewed) == ([], [])
    bench.tokens["gw-03"] = 99.0
    await bench.stand_still(98.0, 1.1)
    assert (len(bench.asked), len(bench.renewed)) == (2 * MOST_ASKED, 1)


async def test_nothing_is_looked_at_after_the_end() -> None:
    """The pulse is closed last: a standstill meanwhile begins no look, and closing twice does no harm."""
    bench = Bench(("gw-2", 5.0))
    await bench.outlived.close()
    await bench.outlived.close()
    await bench.stand_still(10.0, 1.1)
    assert (bench.pauses, bench.asked, bench.renewed) == ([], [], [])


async def test_it_is_not_done_again_at_once() -> None:
    """Where a machine starves one standstill follows the other: the next is looked at after a rest."""
    bench = Bench(("gw-2", 11.2), ("gw-3", 5.0))
    await bench.stand_still(10.0, 1.1)
    assert len(bench.renewed) == 1
    bench.pauses.clear()
    bench.answering.clear()
    bench.tokens = {"gw-2": 13.2, "gw-3": 5.0}
    await bench.stand_still(12.0, 1.1)
    assert bench.pauses[0] == pytest.approx(RELINK_REST_S - 2.0)
    assert len(bench.renewed) == 2


async def test_one_that_does_not_come_back_is_dialled_through_the_others() -> None:
    """It was lost in the standstill and others see it: links are made again; one that nobody sees is gone."""
    bench = Bench(("gw-2", 11.05), ("gw-3", 11.05))
    bench.answering = {"gw-2", "gw-3"}
    bench.gone = {"gw-4": 11.1, "gw-5": 11.1, "gw-6": 3.0}
    bench.seen = {("gw-3", "gw-4"), ("gw-3", "gw-6")}

    def back() -> None:
        bench.gone.pop("gw-4", None)

    bench.after = [lambda: None, lambda: None, back]
    await bench.stand_still(10.0, 1.1)
    assert bench.renewed == ["others see members that did not come back"]
    assert {other for _, other in bench.witnesses} == {"gw-4", "gw-5"}, "gw-6 was lost before"


async def test_links_that_are_mixed_up_again_are_made_anew_again() -> None:
    """After the first time all that are there are asked, whenever they came; no more than a few times."""
    bench = Bench(("gw-2", 11.05), ("gw-3", 5.0))
    bench.answering, bench.heals = {"gw-2"}, False
    await bench.stand_still(10.0, 1.1)
    assert bench.asked == ["gw-3", *["gw-2", "gw-3"] * (RELINK_TRIES - 1)]
    assert len(bench.renewed) == RELINK_TRIES


async def test_nothing_is_done_when_all_were_lost_or_nobody_can_have_noticed() -> None:
    """Members that came again, or that are gone, are well; a short standstill may have escaped the others."""
    bench = Bench(("gw-2", 5.0), ("gw-3", 5.0))
    await bench.stand_still(10.0, 0.8)
    assert bench.pauses == []
    bench.tokens = {"gw-2": 11.15}
    await bench.stand_still(10.0, 1.1)
    assert (bench.asked, bench.renewed) == ([], [])
    await bench.outlived.close()


def test_membership_knows_since_when_a_token_was_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A further token of a member changes nothing; one that went and came is seen since it came."""
    now = 10.0
    monkeypatch.setattr("appliance.plane.membership.clock", lambda: now)

    session = FakeSession()
    membership = Membership(cast("Any", session), gateway="gw-1", virtual_nodes=1, events=FleetEvents())
    membership.start()
    session.tell("gw-2")
    session.tell("gw-3")
    now = 20.0
    session.tell("gw-2", "/1")
    session.tell("gw-3", alive=False)
    assert membership.seen_since(10.0) == {"gw-2"}
    session.tell("gw-3")
    assert membership.seen_since(15.0) == {"gw-2"}
    assert membership.seen_since(20.0) == {"gw-2", "gw-3"}


def test_whoever_is_not_seen_hears_so_before_its_question_ends() -> None:
    """Otherwise a token that was forgotten is never shown again."""
    assert SEE_S < COMPARE_S


def test_a_silent_member_leaves_a_takeover_its_second() -> None:
    """Who takes over waits for it twice: when it compares its copies, and when it writes that it has taken over."""
    assert LOSS_S + PlaneConfig().replica_timeout_s < 1.0
    assert RETURNED_S + PlaneConfig().replica_timeout_s < 1.0
