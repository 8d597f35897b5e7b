"""A real vehicle's log through the endpoint's parser."""

import struct
from collections import Counter
from pathlib import Path

from appliance.model import Site
from appliance.model.robot_api import Remote
from appliance.robots.mavlink.dialect import Codec, Frame, frame_length
from appliance.robots.mavlink.links import UdpServer
from appliance.robots.mavlink.vehicle import Vehicle


def test_a_real_dive_is_read_whole(data: Path) -> None:
    """All 35,916 frames of a real ArduSub dive are read or counted as damaged (4), and the vehicle's state follows."""
    log = (data / "mavlink/ardusub-4.1.1-small.tlog").read_bytes()
    names: Counter[str] = Counter()
    vehicle = Vehicle("sub", site=Site(), send=lambda _: None)
    modes: set[bool] = set()

    class Ears:
        busy = False

        def receive(self, link: int, frame: Frame, address: tuple[str, int]) -> None:
            del link, address
            names[frame.name] += 1
            if frame.system == 1:
                vehicle.hear(frame, 0.0)
                modes.add(vehicle.armed)

    link = UdpServer(Remote("udp", "127.0.0.1", 0, True), Codec(245, 191), Ears())
    at = records = 0
    while at < len(log):
        (stamp,) = struct.unpack_from(">Q", log, at)
        length = frame_length(log, at + 8)
        assert length is not None
        assert 1_600_000_000 < stamp / 1e6 < 1_800_000_000
        link.feed(log[at + 8 : at + 8 + length], ("127.0.0.1", 14550))
        records += 1
        at += 8 + length
    assert records == 35_916
    assert link.received == 35_912
    assert link.refused == {"checksum": 4}
    assert names["HEARTBEAT"] == 1056
    assert vehicle.kind == 12  # MAV_TYPE_SUBMARINE
    assert not vehicle.commandable
    assert modes == {False, True}


def test_the_same_bytes_as_one_stream(data: Path) -> None:
    """Read as one run of bytes, time stamps between the frames are noise and nearly every frame is found."""
    log = (data / "mavlink/ardusub-4.1.1-small.tlog").read_bytes()
    found = list(Codec(245, 191).read(log))
    frames = [each for each in found if isinstance(each, Frame)]
    assert len(frames) > 0.99 * 35_912
