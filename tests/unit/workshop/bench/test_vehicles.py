"""What a ground station of the benchmark of many vehicles counts, and how its figures are judged."""

import asyncio
from typing import Any

import pytest

from appliance.robots.mavlink.dialect import Codec, constant, make
from workshop.bench.vehicles import STORM, Station, targets

pytestmark = pytest.mark.anyio


def attitude(codec: Codec) -> bytes:
    """Return a frame of telemetry."""
    names = ("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed")
    return codec.pack(make("ATTITUDE", time_boot_ms=1, **dict.fromkeys(names, 0.0)))


def test_a_station_counts_frames_and_those_that_are_missing() -> None:
    """However the stream is cut into pieces; what the one that storms loses does not count."""
    station, good, bad = Station(0), Codec(7, 1), Codec(STORM, 1)
    frames = [attitude(good) for _ in range(300)]
    del frames[10:13]
    stormed = [attitude(bad) for _ in range(50)][::5]
    stream = b"".join(frames + stormed)
    for at in range(0, len(stream), 7):
        station.data_received(stream[at : at + 7])
    assert (station.frames, station.missing) == (len(frames) + len(stormed), 3)


async def test_a_command_is_answered_by_its_vehicle() -> None:
    """By system and command; another vehicle's acknowledgement is none of its own."""
    station = Station(0)
    asking = asyncio.create_task(station.ask(7))
    await asyncio.sleep(0)
    for system in (8, 7):
        ack = make("COMMAND_ACK", command=constant("MAV_CMD_REQUEST_MESSAGE"), result=0)
        station.data_received(Codec(system, 1).pack(ack))
        await asyncio.sleep(0)
    took = await asking
    assert took is not None
    assert took >= 0


def test_targets_are_missed_where_something_was_lost_or_is_not_known() -> None:
    """No figure is no success."""
    phase: dict[str, Any] = {
        "cores": 0.3, "log_mb_per_minute": 5.0, "ack": {"p99": 20.0}, "stop_ms": 100.0, "unanswered": 0,
        "lost": {"gateway": 0, "stations": 0},
    }  # fmt: skip
    assert all(each["kept"] for each in targets({"calm": phase, "storm": phase}).values())
    worse = phase | {"ack": {}, "lost": {"gateway": 1, "stations": 0}}
    found = targets({"calm": worse, "storm": phase})
    assert not found["lost"]["kept"]
    assert not found["ack_p99_ms"]["kept"]
