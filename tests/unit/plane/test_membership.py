"""The members that one gateway sees, and the ring made of them while others look."""

from typing import cast
from unittest.mock import MagicMock

import pytest

from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.plane.events import FleetEvents
from appliance.plane.membership import Membership
from appliance.plane.ring import Ring
from appliance.plane.session import Session

KEYS = Keys("fleet")


def membership() -> Membership:
    """One of gw-1 that has seen gw-2."""
    made = Membership(cast("Session", MagicMock(keys=KEYS)), gateway="gw-1", virtual_nodes=4, events=FleetEvents())
    made.add(KEYS(keyspace.GATEWAY_ALIVE, "gw-2"))
    return made


@pytest.mark.parametrize(
    ("name", "alive", "then"), [("gw-3", True, {"gw-1", "gw-2", "gw-3"}), ("gw-2", False, {"gw-1"})]
)
def test_news_while_the_ring_is_made_elsewhere_is_kept(
    monkeypatch: pytest.MonkeyPatch, name: str, alive: bool, then: set[str]
) -> None:
    """A member that comes or goes while another thread makes the ring is there, or gone, when that is done."""
    here = membership()
    change, news = Ring.changed_to, [(name, alive)]

    def slowly(ring: Ring, members: frozenset[str]) -> Ring:
        made = change(ring, members)
        if news:  # the event loop hears of it just now
            said, is_there = news.pop()
            here._seen(KEYS(keyspace.GATEWAY_ALIVE, said), alive=is_there)
        return made

    monkeypatch.setattr(Ring, "changed_to", slowly)
    assert here.ring.members == {"gw-1", "gw-2"}, "as it was when the question came"
    assert here.members == then
    assert here.ring.members == then


def test_one_that_was_lost_while_the_ring_was_made_can_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its token is counted from one, as of somebody who was not there."""
    here = membership()
    change, lost = Ring.changed_to, [KEYS(keyspace.GATEWAY_ALIVE, "gw-2")]

    def slowly(ring: Ring, members: frozenset[str]) -> Ring:
        made = change(ring, members)
        if lost:
            here._seen(lost.pop(), alive=False)
        return made

    monkeypatch.setattr(Ring, "changed_to", slowly)
    assert here.ring.members
    here._seen(KEYS(keyspace.GATEWAY_ALIVE, "gw-2"), alive=True)
    assert here.members == {"gw-1", "gw-2"}
    assert here.ring.members == {"gw-1", "gw-2"}


def test_the_ring_is_made_once_for_the_same_members() -> None:
    """Who asks again gets the same ring, without a comparison of members."""
    here = membership()
    assert here.ring is here.ring


@pytest.mark.parametrize("below", ["**", "*/alive", "a\nb/alive", "x$*/alive"])
def test_a_token_whose_key_names_no_gateway_is_refused(below: str) -> None:
    """A stranger's token keeps no process from joining, and makes no member."""
    here = membership()
    key = f"swiftbot/fleet/gw/{below}"
    here.add(key)
    here._seen(key, alive=False)
    assert here.members == {"gw-1", "gw-2"}
    assert cast("MagicMock", here._session).refuse.call_count == 1
