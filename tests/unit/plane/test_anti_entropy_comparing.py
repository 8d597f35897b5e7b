"""Comparing copies with a member that answers what it should not."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.model.keys import Verb
from appliance.model.plane_api import DigestAsk, DigestList, FetchAsk, FetchList, Record
from appliance.plane.anti_entropy import Compared, Comparing
from appliance.plane.events import FleetEvents
from appliance.plane.membership import Membership
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store

pytestmark = pytest.mark.anyio
RING = Ring({"gw-1", "gw-2"}, virtual_nodes=4)


class Bench:
    """One gateway with nothing of its own; `tell` and `give` answer for gw-2."""

    def __init__(self, tell: Callable[[DigestAsk], DigestList], give: Callable[[FetchAsk], FetchList]) -> None:
        self.kept: list[Record] = []
        self.refused: list[str] = []
        self.asked: list[Any] = []
        self._tell, self._give = tell, give
        membership = SimpleNamespace(members=RING.members, ring=RING)
        self.comparing = Comparing(
            PlaneConfig(),
            gateway="gw-1",
            store=cast("Store", self),
            rpc=cast("Rpc", self),
            membership=cast("Membership", membership),
            events=FleetEvents(),
            keep=self.keep,
        )

    def register(self, *_: object, **__: object) -> None:
        """Answer nobody."""

    def refuse(self, what: str, **_: object) -> None:
        """Count."""
        self.refused.append(what)

    async def digests(self) -> list[tuple[str, str]]:
        """Nothing is here."""
        return []

    async def keep(self, record: Record) -> Record:
        """Take a record."""
        self.kept.append(record)
        return record

    async def call(self, gateway: str, verb: Verb[Any, Any], ask: Any, *, timeout_s: float) -> Any:
        """Ask gw-2."""
        assert gateway == "gw-2"
        assert timeout_s > 0
        assert len(self.asked) < 50, "it never comes to an end"
        self.asked.append(ask)
        return self._tell(ask) if verb.name == "dht_digest" else self._give(ask)


async def test_a_record_that_cannot_be_does_not_keep_the_others_out() -> None:
    """It is counted; the member has answered all the same, so that nothing is in doubt for its sake."""
    good = Record(key="b", value=b"v", version={"gw-2": 1})
    bad = (Record(key="a", value=b"v"), Record(key="c", value=b"v", version={"../x": 1}))
    bench = Bench(lambda _: DigestList({"a": "1", "b": "2", "c": "3"}), lambda _: FetchList((bad[0], good, bad[1])))
    assert await bench.comparing.compare(RING, ["gw-2"]) == Compared(fetched=1)
    assert bench.kept == [good]
    assert bench.refused == ["record of a member"] * 2


@pytest.mark.parametrize("digests", [{}, {"a": "1"}])
async def test_a_member_that_always_has_more_comes_to_an_end(digests: dict[str, str]) -> None:
    """The same page again and again, or an empty one, is the last."""
    record = Record(key="a", value=b"v", version={"gw-2": 1})
    bench = Bench(lambda _: DigestList(digests, more=True), lambda _: FetchList((record,)))
    compared = await bench.comparing.compare(RING, ["gw-2"])
    assert not compared.silent
    assert {each.key for each in bench.kept} == set(digests)
