"""The positions that a vehicle has told, and the time between them by its own clock."""

from appliance.model import Pose, Site
from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Codec, Frame
from appliance.robots.mavlink.vehicle import Report, Track, Vehicle, apart_s


def _report(boot_ms: int, heard_at: float = 0.0) -> Report:
    return Report(Pose(), boot_ms, heard_at)


def test_the_vehicles_own_time_counts() -> None:
    """Two reports that a radio kept and delivered together are as far apart as the vehicle says."""
    assert apart_s(_report(1000, 5.0), _report(1800, 5.0)) == 0.8
    assert apart_s(_report(1000, 5.0), _report(1200, 9.0)) == 0.2


def test_a_clock_that_stands_is_replaced_by_ours() -> None:
    """Some bridges leave the time out: then that of hearing is all there is."""
    assert apart_s(_report(0, 5.0), _report(0, 8.0)) == 3.0


def test_a_clock_that_overflows_goes_on_and_one_that_went_back_tells_nothing() -> None:
    """After 49.7 days it begins again; a restarted vehicle, or a report overtaken, is far from what was before."""
    assert apart_s(_report(2**32 - 100), _report(100)) == 0.2
    assert apart_s(_report(60_000), _report(1_000)) > 1e6


def test_reports_since_a_look() -> None:
    """Those that are new, behind the one before them; of many that nobody looked at the last ones are left."""
    track = Track()
    assert track.since(0) == []
    reports = [_report(number) for number in range(200)]
    track.take(reports[0])
    assert track.since(0) == reports[:1]
    assert track.since(track.count) == reports[:1]
    seen = track.count
    for each in reports[1:4]:
        track.take(each)
    assert track.since(seen) == reports[:4]
    assert track.since(3) == reports[2:4]
    for each in reports[4:]:
        track.take(each)
    kept = track.since(seen)
    assert kept == reports[-len(kept) :]
    assert len(kept) > 30


def test_a_vehicle_keeps_what_it_told_and_no_position_that_it_does_not_know() -> None:
    """0, 0 is no position: it is not kept as one, nor is anything between it and the next."""
    vehicle = Vehicle("drone_1", site=Site(), send=lambda _: None)
    vehicle.component = 1
    codec = Codec(1, 1)
    for boot_ms, degrees in ((1000, 0), (1200, 10), (1400, 11)):
        message = dialect.make(
            "GLOBAL_POSITION_INT",
            time_boot_ms=boot_ms,
            lat=degrees,
            lon=degrees,
            alt=0,
            relative_alt=0,
            vx=0,
            vy=0,
            vz=0,
            hdg=0,
        )
        (frame,) = codec.read(codec.pack(message))
        assert isinstance(frame, Frame)
        vehicle.hear(frame, 5.0)
    assert [(each.boot_ms, each.heard_at) for each in vehicle.track.since(0)] == [(1200, 5.0), (1400, 5.0)]
    assert vehicle.track.since(0)[-1].pose == vehicle.pose
