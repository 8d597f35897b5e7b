"""Telemetry logs (.tlog): each frame after its time, as MAVProxy, Mission Planner and QGroundControl write them. Pure.

A log is heard at one place, so frames of the vehicle and of the ground station are in it. To be played through a router
they are parted again: those of ground stations come from one end, all others from the other.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

from msgspec import Struct

from appliance.errors import ConfigError
from appliance.robots.mavlink.dialect import MARKER_V1, MARKER_V2, Codec, Frame, check, frame_length, make

GROUND_SYSTEMS = range(200, 256)
"""System ids of ground stations: they count from 255 downward."""
GENERATED_HZ = 250
_STAMP = struct.Struct(">Q")


class Record(Struct, frozen=True, gc=False):
    """What a log holds at one time: a frame, good or damaged, and seconds since the log began."""

    at_s: float
    raw: bytes
    frame: Frame | None


def read(path: Path) -> list[Record]:
    """Return all records of a log; ConfigError with the remedy when it cannot be read or is none."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror}", remedy="name a .tlog with --log, or leave it out"
        ) from error
    found: list[Record] = []
    at, began = 0, 0
    while at + _STAMP.size < len(data):
        (stamp,) = _STAMP.unpack_from(data, at)
        at += _STAMP.size
        length = frame_length(data, at) if data[at] in (MARKER_V1, MARKER_V2) else None
        if length is None or at + length > len(data):
            if not found:
                raise ConfigError(f"{path} is no telemetry log", remedy="a .tlog has a time before each MAVLink frame")
            break
        began = began or stamp
        raw = data[at : at + length]
        frame = check(raw)
        found.append(Record(max(0.0, (stamp - began) / 1e6), raw, frame if isinstance(frame, Frame) else None))
        at += length
    if not found:
        raise ConfigError(f"{path} holds no frame", remedy="name another .tlog with --log")
    return found


def generate(count: int) -> list[Record]:
    """Return a log of a vehicle that flies and a ground station that beats and commands now and then."""
    vehicle, camera, ground = Codec(1, 1), Codec(1, 100), Codec(255, 190)
    found: list[Record] = []
    for number in range(count):
        at_s, turn = number / GENERATED_HZ, number % GENERATED_HZ
        if turn == 0:
            raw = vehicle.pack(_beat(2, 3))
        elif turn == 1:
            raw = ground.pack(_beat(6, 8))
        elif turn == 2:
            raw = camera.pack(_beat(30, 8))
        elif turn == 3:
            params = {f"param{place}": 0.0 for place in range(1, 8)}
            raw = ground.pack(
                make("COMMAND_LONG", target_system=1, target_component=1, command=512, confirmation=0, **params)
            )
        elif turn == 4:
            ends = {"target_system": 255, "target_component": 190}
            raw = vehicle.pack(make("COMMAND_ACK", command=512, result=0, progress=0, result_param2=0, **ends))
        else:
            angle = number / 1000.0
            rates = {"rollspeed": 0.1, "pitchspeed": 0.2, "yawspeed": angle}
            raw = vehicle.pack(
                make("ATTITUDE", time_boot_ms=number * 4, roll=angle, pitch=-angle, yaw=angle / 2, **rates)
            )
        frame = check(raw)
        assert isinstance(frame, Frame)  # noqa: S101 - made here
        found.append(Record(at_s, raw, frame))
    return found


def _beat(kind: int, autopilot: int) -> object:
    return make(
        "HEARTBEAT", type=kind, autopilot=autopilot, base_mode=0, custom_mode=4, system_status=4, mavlink_version=3
    )


def is_ground(record: Record) -> bool:
    """Whether a record is a ground station's; damaged ones count as the vehicle's."""
    return record.frame is not None and record.frame.system in GROUND_SYSTEMS


def crossing(records: Sequence[Record], *, ground: bool) -> list[bytes]:
    """Return the good frames of one side that are for the other: for everybody, or for a system there."""
    others = {each.frame.system for each in records if each.frame is not None and is_ground(each) != ground}
    return [
        each.raw
        for each in records
        if each.frame is not None
        and is_ground(each) == ground
        and (each.frame.target_system == 0 or each.frame.target_system in others)
    ]
