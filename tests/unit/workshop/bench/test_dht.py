"""The DHT's simulation at small sizes: the promises hold, counts add up, and a seed gives the same again."""

import asyncio
import sys

import pytest

from appliance.errors import SwiftbotError
from workshop.bench.dht import live, simulation
from workshop.bench.dht.simulation import Fleet

pytestmark = pytest.mark.anyio


def test_the_promised_hops() -> None:
    """One hop while the ring is known whole, at most half the logarithm with bounded views, never a wrong owner."""
    found = simulation.hops(256, lookups=300, seed=1)
    assert found["wrong"] == 0
    assert found["full_view"]["max"] == 1
    assert found["bounded_view"]["mean"] <= found["half_log2"] == 4.0


def test_a_join_moves_about_a_share() -> None:
    """The keys that move go to the joiner only, and are about r·K/N."""
    found = simulation.joins(64, seed=1, keys=20_000)
    many = found["virtual_nodes_32"]
    assert many["to_others"] == found["virtual_nodes_1"]["to_others"] == 0
    assert 0.5 * found["share"] < many["owned_mean"] < 1.5 * found["share"]
    assert 1.5 * found["share"] < many["copied_mean"] < 4.5 * found["share"]


def test_failures_at_once() -> None:
    """With the successor list as long as it grows no lookup fails at 30 %; longer lists fail less."""
    found = simulation.failures(200, lookups=150, seed=1)
    grown = found[f"successors_{found['grown_successors']}"]
    assert grown["30%"]["failed_percent"] == 0
    assert found["successors_3"]["50%"]["failed_percent"] > grown["50%"]["failed_percent"]


def test_traffic_is_counted_and_repeatable() -> None:
    """Churn costs more than rest, lookups end at the owner under it, and the same seed gives the same figures."""
    found = simulation.bytes_sent(60, seconds=10.0, lookups=40, seed=1)
    assert 0 < found["rest"] < found["churn"]
    assert found["lookups_failed_percent"] < 5
    assert found == simulation.bytes_sent(60, seconds=10.0, lookups=40, seed=1)


def test_all_parts_on_several_processes() -> None:
    """Every size has its figures, in order, and they are those that each part counts by itself."""
    told: list[str] = []
    found = simulation.run((16, 40), lookups=40, seconds=3.0, seed=2, progress=told.append)
    for part in ("hops", "join", "traffic"):
        assert list(found[part]) == ["16", "40"]
    grown = simulation.failures(16, lookups=40, seed=2, lengths=(simulation.successor_count(16, 16),))
    assert found["failures"] == {"16": grown, "40": simulation.failures(40, lookups=40, seed=2)}
    assert found["hops"]["40"] == simulation.hops(40, lookups=40, seed=2)
    assert len(told) == 7 + len(simulation.successor_lengths(40))


def test_parts_can_be_chosen() -> None:
    """Only what was asked for is counted, and it is the same as among all parts."""
    found = simulation.run((16, 40), lookups=40, seconds=3.0, seed=2, parts=("hops",), progress=lambda _: None)
    assert {"join", "failures", "traffic"}.isdisjoint(found)
    assert found["hops"]["40"] == simulation.hops(40, lookups=40, seed=2)


def test_what_was_published_of_failures_is_the_share_of_lost_owners() -> None:
    """Without replicas a share p of dead members loses a share p of the keys, here as in the paper; with three, p^3."""
    found = simulation.failures(200, lookups=1500, seed=1, lengths=(16,))["successors_16"]
    for share in (0.1, 0.3, 0.5):
        row = found[f"{share:.0%}"]
        assert abs(row["owner_dead_percent"] - 100 * share) < 6
        assert row["all_replicas_dead_percent"] < row["owner_dead_percent"]


def test_a_fleet_can_be_run_down_to_one() -> None:
    """When all others have died the last gateway finds out, and owns every position."""
    fleet = Fleet(bound=16).settled(f"gw-{n}" for n in range(10))
    for name in list(fleet.members)[1:]:
        del fleet.members[name]
    fleet.run(300.0)
    (last,) = fleet.members.values()
    assert len(last.view) == 0
    assert last.view.step(5).mine


async def test_a_side_that_breaks_is_told_as_it_is() -> None:
    """When the other side cannot start, its own words are in the error."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", "raise SystemExit('no such module')",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    with pytest.raises(SwiftbotError, match="no such module"):
        await live.line_of(process, "ready")
    await process.wait()


def test_a_python_with_kademlia_can_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """SWIFTBOT_KADEMLIA_PYTHON says which Python runs the other side."""
    monkeypatch.setenv("SWIFTBOT_KADEMLIA_PYTHON", "/opt/python")
    assert str(live.find_python()) == "/opt/python"


def test_traffic_that_is_counted_for_less_time_has_settled_as_long() -> None:
    """Intervals adapt slowly: what is counted right after the start is no rest, however long the count."""

    def rest(seconds: float, settle_s: float) -> float:
        return float(simulation.bytes_sent(64, seconds=seconds, settle_s=settle_s, lookups=1, seed=1)["rest"])

    whole = rest(20.0, 20.0)
    assert rest(10.0, 20.0) < 1.3 * whole
    assert rest(10.0, 0.0) > 1.6 * whole
