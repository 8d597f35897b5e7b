"""Members that were never lost though this process stood still: links are made anew, by nobody's word."""

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest

from appliance.plane.comparing import SEE_S
from appliance.plane.keys import Keys
from appliance.plane.membership import Membership
from appliance.plane.outlived import TRIES, Outlived
from appliance.plane.pulse import Pulse, Standstill
from appliance.plane.reconcile import LOSS_ASK_S

pytestmark = pytest.mark.anyio
LEASE_S = 1.0


class Bench:
    """A pulse and a membership in the test's hands; `after` happens in each pause."""

    def __init__(self, *tokens: tuple[str, float]) -> None:
        self.on_stalled: list[Callable[[], None]] = []
        self.last_standstill = Standstill(0.0, 0.0)
        self.tokens = dict(tokens)
        self.renewed: list[str] = []
        self.pauses: list[float] = []
        self.after: list[Callable[[], None]] = []
        self.now = 0.0
        self.done = asyncio.Event()
        self.outlived = Outlived(
            cast("Pulse", self),
            lease_s=LEASE_S,
            members=self,
            renew=self.renewed.append,
            now=lambda: self.now,
            pause=self.pause,
        )

    def seen_since(self, moment: float) -> frozenset[str]:
        """Whose token has been there since then."""
        return frozenset(name for name, at in self.tokens.items() if at <= moment)

    async def pause(self, seconds: float) -> None:
        """Let what the test wants happen; the look is over when nothing more is to."""
        self.pauses.append(seconds)
        if self.after:
            self.after.pop(0)()
        await asyncio.sleep(0)

    async def stand_still(self, since: float, lasted_s: float) -> None:
        """Stand still, and wait until all is looked at."""
        self.last_standstill, self.now = Standstill(since, lasted_s), since + lasted_s
        for tell in self.on_stalled:
            tell()
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
        self.watching[0](f"{self.keys.alive(name)}{number}", alive)


async def test_links_of_a_member_that_was_never_lost_are_made_anew() -> None:
    """The others went and came again; of the one whose token stayed nothing that is known can be right."""
    bench = Bench(("gw-2", 5.0), ("gw-3", 5.0))
    bench.after = [lambda: bench.tokens.update({"gw-2": 12.0}), lambda: bench.tokens.update({"gw-3": 13.0})]
    await bench.stand_still(10.0, 1.1)
    assert len(bench.renewed) == 1
    assert bench.pauses == [LEASE_S / 2] * 2


async def test_it_is_not_tried_for_ever() -> None:
    """A token that goes on being there whatever is done is no reason to break links again and again."""
    bench = Bench(("gw-2", 5.0))
    await bench.stand_still(10.0, 1.1)
    assert len(bench.renewed) == TRIES


async def test_nothing_is_broken_when_all_were_lost_or_nobody_can_have_noticed() -> None:
    """Members that came again, or that are gone, are well; a short standstill may have escaped the others."""
    bench = Bench(("gw-2", 5.0), ("gw-3", 5.0))
    await bench.stand_still(10.0, 0.8)
    assert bench.pauses == []
    bench.after = [lambda: bench.tokens.update({"gw-2": 11.2}), bench.tokens.clear]
    bench.tokens = {"gw-2": 11.15}
    await bench.stand_still(10.0, 1.1)
    assert bench.renewed == []
    await bench.outlived.close()


def test_membership_knows_since_when_a_token_was_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A further token of a member changes nothing; one that went and came is seen since it came."""
    now = 10.0
    monkeypatch.setattr("appliance.plane.membership.clock", lambda: now)

    session = FakeSession()
    membership = Membership(cast("Any", session), gateway="gw-1", virtual_nodes=1)
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
    """Otherwise a token that was forgotten is never shown again while somebody waits for a lost member's keys."""
    assert SEE_S < LOSS_ASK_S
