"""What a gateway does at rest about members that it does not see any more."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.model.keys import Verb
from appliance.model.plane_api import DigestAsk
from appliance.plane import anti_entropy
from appliance.plane.anti_entropy import Reconciler, Step, StepKind
from appliance.plane.dht import Absence, Dht
from appliance.plane.events import FleetEvents, Joined, Lost
from appliance.plane.membership import Membership, StallDetector
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store

pytestmark = pytest.mark.anyio
RING = Ring({"gw-1"}, virtual_nodes=1)


class Bench:
    """A gateway that is alone now, with nothing on its disk."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.failures = 0
        self.done = asyncio.Event()
        self.refused: list[str] = []
        self.events = FleetEvents()
        config = PlaneConfig()
        self.absence = Absence(replicas=config.replicas)
        self.settling = SimpleNamespace(returned=frozenset(), settled=self.settled, wanted=asyncio.Event())
        self.membership = SimpleNamespace(members=RING.members, ring=RING)
        self.reconciler = Reconciler(
            config,
            gateway="gw-1",
            store=cast("Store", self),
            rpc=cast("Rpc", self),
            membership=cast("Membership", self.membership),
            dht=cast("Dht", self),
            pulse=cast("StallDetector", SimpleNamespace(stalls=0)),
            events=self.events,
        )

    def register(self, *_: object, **__: object) -> None:
        """Answer nobody."""

    async def keep(self, record: Any) -> Any:
        """Take a record."""
        return record

    async def digests(self) -> list[tuple[str, str]]:
        """Nothing is here."""
        return []

    async def settled(self, _: Ring, __: int) -> None:
        """The shard is compared; fails as often as the test wants."""
        if self.failures:
            self.failures -= 1
            raise RuntimeError("a defect")
        self.done.set()

    def refuse(self, what: str, **_: object) -> None:
        """Count."""
        self.refused.append(what)

    async def forget_tombstones(self, _: int) -> None:
        """Nothing is here."""

    async def call(self, gateway: str, verb: Verb[Any, Any], ask: DigestAsk, **_: object) -> Any:
        """Answer that there is nothing."""
        assert (verb.name, ask.asker) == ("dht_digest", "gw-1")
        self.asked.append(gateway)
        return verb.reply()


async def test_those_that_were_lost_are_asked_whether_they_are_there() -> None:
    """A lost member may be there after all, on the other side of a cut that has healed."""
    bench = Bench()
    for name in ("gw-2", "gw-3"):
        bench.events.publish(Lost(name))
    await bench.reconciler._round(Step(kind=StepKind.REST, ring=RING, stalls=0), tidy=False)
    assert sorted(bench.asked) == ["gw-2", "gw-3"]


async def test_what_goes_wrong_with_settling_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A defect met when a comparison is done is counted, and the comparison is done again until it is settled."""
    monkeypatch.setattr(anti_entropy, "_AGAIN_S", 0.0)
    bench = Bench()
    bench.failures = 3
    bench.reconciler.start()
    async with asyncio.timeout(60):
        await bench.done.wait()
    assert bench.refused == ["reconciling broke off"] * 3
    # And goes on: the next change is heard of.
    bench.done.clear()
    bench.failures = 1
    bench.membership.ring = bench.membership.ring.changed_to(frozenset({"gw-1", "gw-4"}))
    bench.membership.members = bench.membership.ring.members
    bench.events.publish(Joined("gw-4"))
    async with asyncio.timeout(60):
        await bench.done.wait()
    assert bench.refused == ["reconciling broke off"] * 4
    await bench.reconciler.close()
