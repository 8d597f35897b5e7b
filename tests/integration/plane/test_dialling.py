"""Who dials whom between real sessions, by gossip and by the table."""

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from plane_fleet import until
from structlog.testing import capture_logs

from appliance.errors import ConfigError
from appliance.plane import link
from appliance.plane.link import rank
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


def _links(session: zenoh.Session, other: zenoh.Session) -> list[tuple[str, str]]:
    found = session.info.links()
    return [(str(each.src), str(each.dst)) for each in found if str(each.zid) == str(other.info.zid())]


async def test_of_two_that_hear_of_each_other_the_higher_dials(free_ports: Callable[..., list[int]]) -> None:
    """Zenoh compares session ids as the ranks in them mean it, whatever digits they begin with."""
    with contextlib.ExitStack() as stack:
        hub, one, other = (f"tcp/127.0.0.1:{port}" for port in free_ports(3))
        stack.enter_context(await asyncio.to_thread(link.open_raw, PlaneConfig(listen=(hub,)), "hub"))
        low, high = sorted(("gw-1", "gw-2"), key=rank)
        for _ in range(5):  # each time with other digits before
            with contextlib.ExitStack() as pair:
                lower = await asyncio.to_thread(link.open_raw, PlaneConfig(listen=(one,), connect=(hub,)), low)
                pair.enter_context(lower)
                higher = await asyncio.to_thread(link.open_raw, PlaneConfig(listen=(other,), connect=(hub,)), high)
                pair.enter_context(higher)
                await until(lambda: _links(lower, higher))  # noqa: B023 - waited for at once
                await asyncio.sleep(0.3)  # a second link would come now
                assert [dst for _, dst in _links(higher, lower)] == [one], "the higher dialled the lower"


async def test_host_names_in_the_table_are_not_dialled_beside_addresses(free_ports: Callable[..., list[int]]) -> None:
    """Gossip tells of addresses: dialled too, they would be refused as second links, and dialled again, without end."""
    ports = free_ports(3)
    peers = {f"gw-{number}": f"tcp/localhost:{port}" for number, port in enumerate(ports)}
    with contextlib.ExitStack() as stack:
        sessions: list[zenoh.Session] = []
        for name, endpoint in peers.items():
            config = PlaneConfig(listen=(endpoint.replace("localhost", "127.0.0.1"),), peers=peers)
            sessions.append(stack.enter_context(await asyncio.to_thread(link.open_raw, config, name)))
        await until(lambda: all(len(list(each.info.links())) == 2 for each in sessions))
        before = _ended(ports)
        await asyncio.sleep(1.0)
        assert _ended(ports) - before < 10, "each pair would dial some forty times in that second"


def _ended(ports: list[int]) -> int:
    """Connections with these ports that have ended lately: TIME_WAIT, state 06 in proc(5)."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    ends = ((int(own[-4:], 16), int(other[-4:], 16)) for _, own, other, state, *_ in lines if state == "06")
    return sum(1 for pair in ends if set(pair) & set(ports))


async def test_gateways_of_the_table_that_do_not_come_are_told_of(
    tmp_path: Path, free_ports: Callable[..., list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two that wait for each other's call would be two fleets and not know it: the log names who is missing."""
    monkeypatch.setattr("appliance.plane.node.UNSEEN_S", 0.2)
    low, high = sorted(("gw-1", "gw-2"), key=rank)
    peers = {name: f"tcp/127.0.0.1:{port}" for name, port in zip((low, high), free_ports(2), strict=True)}
    with capture_logs() as logs:
        for own, other in ((low, high), (high, low)):
            config = PlaneConfig(listen=(peers[own],), peers=peers, join_wait_s=0.0)
            plane = await Plane.open(config, fleet="f", gateway=own, data_dir=tmp_path / own)
            await asyncio.sleep(0.4)
            await plane.close()
            told = [each for each in logs if each["event"] == "gateways named in plane.peers are not seen"]
            assert told[-1]["unseen"] == [other]
            assert told[-1]["dialled"] == ([other] if own == high else [])
    assert len(told) == 2


async def test_a_gateway_that_its_table_lacks_does_not_start(tmp_path: Path) -> None:
    """It would dial by another name than the one by which the others expect it to."""
    config = PlaneConfig(listen=("tcp/127.0.0.1:0",), peers={"gw-2": "tcp/127.0.0.1:1"})
    with pytest.raises(ConfigError, match="lacks this gateway, gw-1"):
        await Plane.open(config, fleet="f", gateway="gw-1", data_dir=tmp_path)
