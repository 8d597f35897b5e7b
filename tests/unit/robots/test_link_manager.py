"""Links that come and go at run time: over real loopback sockets and pseudo-terminals, kept over a restart."""
# pyright: reportDeprecated=false, reportUnknownArgumentType=false, reportUnknownLambdaType=false

import asyncio
import os
import pty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from appliance.errors import ConfigError, NotFoundError, RefusedError
from appliance.model.robot_api import MavlinkLink, read_remote
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, make
from appliance.robots.mavlink.link_manager import KEY, LinkManager, message_names, rules_of
from appliance.robots.mavlink.links import Address
from appliance.robots.mavlink.routing import RoutingTable
from appliance.robots.settings import RobotsConfig
from tests.unit.robots.conftest import FakeStore

pytestmark = pytest.mark.anyio

BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}


class Bench:
    """A table and what it heard."""

    def __init__(self, store: FakeStore, config: RobotsConfig) -> None:
        self.heard: list[tuple[int, str, Address]] = []
        self.refused: dict[str, int] = {}
        self.busy = False
        self.table = LinkManager(config, store=store, routing=RoutingTable(own_system=245), refused=self.refused)

    def receive(self, link: int, frame: Frame, address: Address) -> None:
        """Take a frame."""
        entry = self.table.get(link)
        assert entry is not None
        entry.link.stats.sender(frame.system, frame.component).hear(frame.sequence, 0.0)
        self.heard.append((link, frame.name, address))

    @property
    def urls(self) -> list[str]:
        """Links that are open."""
        return [each.url for each in self.table.all_facts()]


@asynccontextmanager
async def opened(store: FakeStore, *links: MavlinkLink, **changes: float) -> AsyncIterator[Bench]:
    """Open a table of such a configuration."""
    bench = Bench(store, RobotsConfig(mavlink=links, **changes))  # pyright: ignore[reportArgumentType]
    await bench.table.open(bench)
    try:
        yield bench
    finally:
        await bench.table.close()


async def until(holds: Callable[[], object], act: Callable[[], object] = lambda: None) -> None:
    """Wait until something is so, doing something again and again meanwhile."""
    async with asyncio.timeout(30):
        while not holds():
            act()
            await asyncio.sleep(0.02)


async def test_added_and_removed_links_outlive_a_restart(
    store: FakeStore, free_ports: Callable[..., list[int]]
) -> None:
    """What operators changed is so after a restart: an added link is there, a removed one is not."""
    one, two, three = (f"udp://127.0.0.1:{port}" for port in free_ports(3, udp=True))
    configured = (MavlinkLink(listen=one), MavlinkLink(listen=two))
    async with opened(store, *configured) as bench:
        facts = await bench.table.add(MavlinkLink(listen=three, prefix="boat_"), by="a test")
        assert (facts.url, facts.added, facts.listens) == (three, True, True)
        assert await bench.table.add(MavlinkLink(listen=three, prefix="boat_"), by="a test") == facts
        with pytest.raises(RefusedError, match="other settings"):
            await bench.table.add(MavlinkLink(listen=three, prefix="car_"), by="a test")
        await bench.table.remove(one, by="a test")
        with pytest.raises(NotFoundError, match=two):
            await bench.table.remove(one, by="a test")
        assert bench.urls == [two, three]
    async with opened(store, *configured) as bench:
        assert bench.urls == [two, three]
        assert [each.setting.prefix for each in bench.table] == ["drone_", "boat_"]
        await bench.table.remove(three, by="a test")
        await bench.table.add(MavlinkLink(listen=one), by="a test")
    async with opened(store, *configured) as bench:
        assert sorted(bench.urls) == sorted([one, two])
        assert not any(each.added for each in bench.table.all_facts())


async def test_what_was_kept_cannot_stop_a_gateway(store: FakeStore, free_ports: Callable[..., list[int]]) -> None:
    """Kept links that cannot be read, or whose port is taken by now, are reported in the log; the others are open."""
    one, two = (f"tcp://127.0.0.1:{port}" for port in free_ports(2))
    async with opened(store) as bench:
        await bench.table.add(MavlinkLink(listen=one), by="a test")
        await bench.table.add(MavlinkLink(listen=two), by="a test")
        kept = store.values[KEY]
    remote = read_remote(one, listens=True)
    taken = await asyncio.start_server(lambda *_: None, remote.host, remote.port)
    async with opened(store) as bench:
        assert bench.urls == [two]
    assert store.values[KEY] == kept
    taken.close()
    await taken.wait_closed()
    store.values[KEY] = b"{"
    async with opened(store) as bench:
        assert bench.urls == []


async def test_a_link_that_cannot_be_is_not_kept(store: FakeStore, free_ports: Callable[..., list[int]]) -> None:
    """A taken port, an unknown message in a filter, a speed that no port has: an error, and nothing is kept."""
    (port,) = free_ports(1)
    taken = await asyncio.start_server(lambda *_: None, "127.0.0.1", port)
    async with opened(store) as bench:
        for link, told in (
            (MavlinkLink(listen=f"tcp://127.0.0.1:{port}"), "cannot listen"),
            (MavlinkLink(connect="udp://127.0.0.1:1", only_in=("ATTITUED",)), "no MAVLink message"),
            (MavlinkLink(connect="serial:/dev/null:1234567"), "baud"),
        ):
            with pytest.raises(ConfigError, match=told) as caught:
                await bench.table.add(link, by="a test")
            assert caught.value.remedy
        assert bench.urls == []
        assert KEY not in store.values
    taken.close()
    await taken.wait_closed()


def test_filters_by_name_and_number() -> None:
    """Messages are named as on mavlink.io, in either case, or by number."""
    rules = rules_of(MavlinkLink(listen="udp://127.0.0.1:1", only_in=("attitude", "0"), not_out=("33",)))
    assert rules.only_in == {"ATTITUDE", "HEARTBEAT"}
    assert rules.not_out == {"GLOBAL_POSITION_INT"}


async def test_a_serial_port(store: FakeStore) -> None:
    """Frames come and go over a serial port in pieces and between noise; an unplugged one is missed."""
    master, slave = pty.openpty()
    url = f"serial:{os.ttyname(slave)}:57600"
    codec = Codec(1, 1)
    async with opened(store, MavlinkLink(connect=url)) as bench:
        (entry,) = bench.table
        await until(lambda: entry.link.others)
        raw = codec.pack(make("HEARTBEAT", **BEAT))
        for piece in (b"\x00noise", raw[:5], raw[5:], raw):
            os.write(master, piece)
            await asyncio.sleep(0)
        await until(lambda: len(bench.heard) == 2)
        assert bench.heard[0][1:] == ("HEARTBEAT", (os.ttyname(slave), 0))
        assert bench.refused == {"noise": 1}
        sent = entry.link.send(make("HEARTBEAT", **BEAT), entry.link.others[0])
        os.set_blocking(master, False)
        back = bytearray()

        def read() -> None:
            try:
                back.extend(os.read(master, 4096))
            except BlockingIOError:
                return

        await until(lambda: bytes(back) == sent, read)
        (facts,) = bench.table.all_facts()
        assert (facts.frames_in, facts.frames_out, facts.url) == (2, 1, url)
        os.close(slave)
        os.close(master)
        await until(lambda: not entry.link.others)
        assert bench.table.all_facts()[0].problem


async def test_a_serial_port_that_nobody_reads(store: FakeStore) -> None:
    """What cannot be sent is dropped by whole frames and counted; memory does not grow."""
    master, slave = pty.openpty()
    async with opened(store, MavlinkLink(connect=f"serial:{os.ttyname(slave)}:115200")) as bench:
        (entry,) = bench.table
        await until(lambda: entry.link.others)
        message = make("STATUSTEXT", severity=6, text=b"x" * 50)
        for _ in range(2000):
            entry.link.send(message, entry.link.others[0])
        assert bench.refused["not_read"] > 0
        data, found = bytearray(), list[Frame | Damage]()
        async with asyncio.timeout(30):
            while len(found) < entry.link.stats.frames_out:
                data += await asyncio.to_thread(os.read, master, 65536)
                found = [each for each in Codec(9, 9).read(bytes(data)) if isinstance(each, Frame)]
        assert len(found) + bench.refused["not_read"] == 2000
    os.close(slave)
    os.close(master)


async def test_a_flood_from_one_sender(store: FakeStore, free_ports: Callable[..., list[int]]) -> None:
    """One that sends thousands of frames at once is cut off and counted; another's few frames all arrive."""
    (port,) = free_ports(1, udp=True)
    async with opened(store, MavlinkLink(listen=f"udp://127.0.0.1:{port}"), sender_hz=200.0) as bench:
        loop = asyncio.get_running_loop()
        flood, calm = [
            (await loop.create_datagram_endpoint(asyncio.DatagramProtocol, remote_addr=("127.0.0.1", port)))[0]
            for _ in range(2)
        ]
        loud, quiet = Codec(1, 1), Codec(2, 1)
        for number in range(20):
            for _ in range(200):
                flood.sendto(loud.pack(make("HEARTBEAT", **BEAT)))
            calm.sendto(quiet.pack(make("HEARTBEAT", **BEAT)))
            own = calm.get_extra_info("sockname")

            def heard(own: Address = own, number: int = number) -> bool:
                return sum(address == own for _, _, address in bench.heard) == number + 1

            await until(heard)
        assert bench.refused["flood"] > 1000
        assert len(bench.heard) < 2000
        flood.close()
        calm.close()


async def test_a_stream_is_slowed_not_cut(store: FakeStore, free_ports: Callable[..., list[int]]) -> None:
    """Over TCP a sender that is too fast is read more slowly: every frame arrives."""
    (port,) = free_ports(1)
    async with opened(store, MavlinkLink(listen=f"tcp://127.0.0.1:{port}"), sender_hz=500.0) as bench:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        codec = Codec(1, 1)
        for _ in range(1200):
            writer.write(codec.pack(make("HEARTBEAT", **BEAT)))
        await until(lambda: len(bench.heard) == 1200)
        assert bench.refused.get("slowed", 0) > 0
        assert bench.table.all_facts()[0].senders[0].lost == 0
        writer.close()
        await writer.wait_closed()


def test_a_message_that_vehicles_share_is_one() -> None:
    """Messages are named in either case or by number; a name that is none is an error that names the setting."""
    assert message_names("robots.vehicles_share", ("adsb_vehicle", "247")) == {"ADSB_VEHICLE", "COLLISION"}
    with pytest.raises(ConfigError, match=r"robots.vehicles_share: 'ADSB' is no MAVLink message"):
        message_names("robots.vehicles_share", ("ADSB",))


@pytest.mark.parametrize(
    ("link", "named"),
    [
        (MavlinkLink(listen="udp://0.0.0.0:14550"), "udp://0.0.0.0:14550"),
        (MavlinkLink(connect="tcp://10.0.0.7:5760"), "tcp://10.0.0.7:5760"),
        (MavlinkLink(listen="udp://drones.example:14550"), "drones.example"),
        (MavlinkLink(listen="udp://[::]:14550", mavlink1=True), "[::]"),
    ],
)
def test_a_gateway_with_keys_takes_no_unsigned_link_that_others_reach(link: MavlinkLink, named: str) -> None:
    """The error names the link and what to set."""
    with pytest.raises(ConfigError, match="is not signed") as told:
        link.check_keyed()
    assert named in told.value.message
    assert "signing" in told.value.remedy


@pytest.mark.parametrize(
    "link",
    [
        MavlinkLink(),
        MavlinkLink(listen="udp://127.0.0.1:14550"),
        MavlinkLink(connect="tcp://[::1]:5760"),
        MavlinkLink(connect="tcp://localhost:5760"),
        MavlinkLink(connect="serial:/dev/ttyUSB0:57600"),
        MavlinkLink(listen="udp://0.0.0.0:14550", signing="credential:mavlink"),
    ],
)
def test_signed_links_cables_and_the_loopback_need_no_more(link: MavlinkLink) -> None:
    """Nobody beyond the machine reaches them without the key."""
    link.check_keyed()


async def test_links_added_while_it_runs_are_held_to_it_too(
    store: FakeStore, free_ports: Callable[..., list[int]]
) -> None:
    """Also one that was added before the gateway had keys: it is left out, and the gateway comes up."""
    (port,) = free_ports(1, udp=True)
    link = MavlinkLink(listen=f"udp://0.0.0.0:{port}")
    async with opened(store) as bench:
        await bench.table.add(link, by="ann")
    routing = RoutingTable(own_system=245)
    keyed = LinkManager(RobotsConfig(), store=store, routing=routing, refused={}, keyed=True)
    await keyed.open(Bench(store, RobotsConfig()))
    assert len(keyed) == 0
    with pytest.raises(ConfigError, match="is not signed"):
        await keyed.add(link, by="ann")
    await keyed.close()
