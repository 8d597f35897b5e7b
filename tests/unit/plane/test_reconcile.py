"""What a gateway does at rest about members that it does not see any more."""

from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest

from appliance.plane.absence import Absence
from appliance.plane.comparing import DigestAsk
from appliance.plane.dht import Dht
from appliance.plane.membership import Membership
from appliance.plane.pulse import Pulse
from appliance.plane.reconcile import Reconciler
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.steps import Kind, Step
from appliance.plane.store import Store

pytestmark = pytest.mark.anyio
RING = Ring({"gw-1"}, virtual_nodes=1)


class Bench:
    """A gateway that is alone now, with nothing on its disk."""

    def __init__(self, view: Literal["full"] | int) -> None:
        self.asked: list[str] = []
        config = PlaneConfig(view=view)
        self.absence = Absence(replicas=config.replicas, whole=view == "full")
        self.returned: frozenset[str] = frozenset()
        self.membership = SimpleNamespace(members=RING.members, ring=RING, on_joined=[], on_lost=[])
        self.reconciler = Reconciler(
            config,
            gateway="gw-1",
            store=cast("Store", self),
            rpc=cast("Rpc", self),
            membership=cast("Membership", self.membership),
            dht=cast("Dht", self),
            pulse=cast("Pulse", SimpleNamespace(on_stalled=[], stalls=0)),
        )

    def register(self, *_: object, **__: object) -> None:
        """Answer nobody."""

    async def keep(self, record: Any) -> Any:
        """Take a record."""
        return record

    async def digests(self) -> list[tuple[str, str]]:
        """Nothing is here."""
        return []

    async def forget_tombstones(self, _: int) -> None:
        """Nothing is here."""

    async def call(self, gateway: str, verb: str, ask: DigestAsk, reply: type[Any], **_: object) -> Any:
        """Answer that there is nothing."""
        assert (verb, ask.asker) == ("dht_digest", "gw-1")
        self.asked.append(gateway)
        return reply()


@pytest.mark.parametrize(("view", "asked"), [("full", ["gw-2", "gw-3"]), (16, [])])
async def test_those_that_were_lost_are_asked_where_that_can_tell_anything(
    view: Literal["full"] | int, asked: list[str]
) -> None:
    """A bounded view drops members all the time that are there: asking each of them for ten minutes is for nothing."""
    bench = Bench(view)
    for name in ("gw-2", "gw-3"):
        for lost in bench.membership.on_lost:
            lost(name)
    await bench.reconciler._round(Step(kind=Kind.REST, ring=RING, stalls=0), tidy=False)
    assert sorted(bench.asked) == asked
