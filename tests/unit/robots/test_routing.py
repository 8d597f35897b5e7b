"""MAVLink routing: frames go where they are meant to go, once, and never back."""

from hypothesis import given
from hypothesis import strategies as st
from msgspec import Struct

from appliance.robots.mavlink.routing import BROADCAST, End, RoutingTable, Rules

GCS, DRONE, CAMERA = End(0, ("gcs", 1)), End(1, ("drone", 1)), End(2, ("camera", 1))
OWN = 245


class Passage(Struct, frozen=True, kw_only=True):
    """A frame as routing sees it. Targets are 0 where a message has none, or means all."""

    system: int
    component: int
    name: str
    raw: bytes
    target_system: int = BROADCAST
    target_component: int = BROADCAST


def passage(system: int, component: int = 1, *, to: int = 0, part: int = 0, name: str = "COMMAND_LONG") -> Passage:
    """Return a frame as routing sees it."""
    raw = bytes((system, component, to, part))
    return Passage(system=system, component=component, name=name, raw=raw, target_system=to, target_component=part)


def router(*rules: Rules) -> RoutingTable:
    """Return a router that has heard a ground station, a drone and its camera on a link of its own."""
    made = RoutingTable(rules or (Rules(), Rules(), Rules()), own_system=OWN)
    for end, (system, component) in ((GCS, (255, 190)), (DRONE, (1, 1)), (CAMERA, (1, 100))):
        made.hear(passage(system, component), end, 0.0)
    return made


def test_a_broadcast_goes_to_all_others() -> None:
    """A heartbeat goes to every other end and not back."""
    assert router().destinations(passage(1, name="HEARTBEAT"), DRONE) == (GCS, CAMERA)


def test_a_target_gets_it_alone() -> None:
    """A command for a component goes to its end, one for a system to all its ends, one for a stranger nowhere."""
    made = router()
    assert made.destinations(passage(255, to=1, part=1), GCS) == (DRONE,)
    assert made.destinations(passage(255, to=1, part=100), GCS) == (CAMERA,)
    assert made.destinations(passage(255, to=1), GCS) == (DRONE, CAMERA)
    assert made.destinations(passage(255, to=1, part=7), GCS) == (DRONE, CAMERA)
    assert made.destinations(passage(255, to=9), GCS) == ()


def test_what_is_for_the_gateway_stays_here() -> None:
    """A frame for the gateway's own system is not sent on."""
    assert router().destinations(passage(255, to=OWN, part=191), GCS) == ()


def test_rules_of_both_links_hold() -> None:
    """A message passes only when its own link lets it in and the other lets it out."""
    made = router(Rules(), Rules(not_in=frozenset({"ATTITUDE"})), Rules(only_out=frozenset({"HEARTBEAT"})))
    assert made.destinations(passage(1, name="ATTITUDE"), DRONE) == ()
    assert made.destinations(passage(1, name="GPS_RAW_INT"), DRONE) == (GCS,)
    assert made.destinations(passage(1, name="HEARTBEAT"), DRONE) == (GCS, CAMERA)


def test_a_sender_that_moves_is_followed() -> None:
    """A vehicle heard at another end is reached there from then on."""
    made, other = router(), End(1, ("drone", 2))
    made.hear(passage(1, 1), other, 1.0)
    assert made.destinations(passage(255, to=1, part=1), GCS) == (other,)


def test_silent_ends_are_forgotten() -> None:
    """An end that was silent for a minute gets nothing more, and routes to it are gone."""
    made = router()
    made.hear(passage(255, 190), GCS, 61.0)
    assert made.ends == (GCS,)
    assert made.destinations(passage(255, to=1, part=1), GCS) == ()


def fleet(*, shared: tuple[str, ...] = ()) -> tuple[RoutingTable, list[End]]:
    """Return a router with a ground station, three vehicles on links of their own, and the first one's camera."""
    ends = [End(number, ("", number)) for number in range(5)]
    made = RoutingTable([Rules()] * 5, own_system=OWN, shared=shared)
    senders = ((255, 190), (1, 1), (2, 1), (3, 1), (1, 100))
    for end, (system, component) in zip(ends, senders, strict=True):
        made.hear(passage(system, component), end, 0.0, autopilot=component == 1)
    return made, ends


def test_vehicles_do_not_get_each_others_telemetry() -> None:
    """A vehicle's word to all goes to the station and to its own camera; vehicles get what is shared."""
    made, (ground, one, two, three, camera) = fleet(shared=("ADSB_VEHICLE",))
    assert made.destinations(passage(1, name="ATTITUDE"), one) == (ground, camera)
    assert made.destinations(passage(2, name="ATTITUDE"), two) == (ground,)
    assert made.destinations(passage(1, name="ADSB_VEHICLE"), one) == (ground, two, three, camera)
    assert made.destinations(passage(1, to=2, part=1), one) == (two,)
    assert made.destinations(passage(255, 190, name="HEARTBEAT"), ground) == (one, two, three, camera)
    made.hear(passage(1, 191), one, 0.0)
    assert made.destinations(passage(1, 191, name="STATUSTEXT"), one) == (ground, two, three, camera)


def test_an_end_where_more_than_vehicles_is_heard_gets_all() -> None:
    """A station behind the same radio as a vehicle sees the whole fleet; when it is gone the vehicle does not."""
    made, (ground, one, two, three, camera) = fleet()
    made.hear(passage(254, 190), two, 1.0)
    assert made.destinations(passage(1, name="ATTITUDE"), one) == (ground, two, camera)
    for end, system in ((ground, 255), (one, 1), (two, 2), (three, 3)):
        made.hear(passage(system), end, 61.5, autopilot=system != 255)
    assert made.destinations(passage(1, name="ATTITUDE"), one) == (ground,)


def test_a_station_with_two_links_gets_telemetry_on_both() -> None:
    """The link on which its last frame was late stays a station's; a vehicle's second link stays a vehicle's."""
    made, (ground, one, _, _, camera) = fleet()
    second, spare = End(0, ("", 10)), End(2, ("", 20))
    made.hear(passage(255, 190), second, 1.0)
    made.hear(passage(2, 1), spare, 1.0, autopilot=True)
    assert set(made.destinations(passage(1, name="ATTITUDE"), one)) == {ground, second, camera}
    assert made.destinations(passage(255, to=2, part=1), ground) == (spare,)


def test_what_is_no_vehicle_any_more_is_heard_by_all() -> None:
    """A system of which nobody has been heard for a minute is no vehicle: its next sender may be a station."""
    made, (_, one, two, _, _) = fleet()
    made.hear(passage(2), two, 61.5)
    made.hear(passage(1, 190), one, 62.0)
    assert made.destinations(passage(1, 190, name="HEARTBEAT"), one) == (two,)


@given(
    st.lists(
        st.tuples(st.integers(1, 4), st.sampled_from((1, 100, 191)), st.integers(0, 3), st.booleans()), max_size=12
    )
)
def test_only_vehicles_are_passed_over(heard: list[tuple[int, int, int, bool]]) -> None:
    """Of all other ends exactly those are left out where nobody but other vehicles was heard."""
    made = RoutingTable([Rules()] * 4, own_system=OWN)
    where: dict[tuple[int, int], int] = {}
    vehicles: set[int] = set()
    for system, component, link, autopilot in heard:
        made.hear(passage(system, component), End(link, ("", 0)), 0.0, autopilot=autopilot)
        where[system, component] = link
        vehicles |= {system} if autopilot else set()
    for (system, component), link in where.items():
        at = {number: {each for each, _, link, _ in heard if link == number} for number in range(4)}
        telemetry = system in vehicles and component != 191
        expected = {
            number
            for number in {link for _, _, link, _ in heard} - {link}
            if not (telemetry and at[number] <= vehicles - {system})
        }
        found = made.destinations(passage(system, component, name="ATTITUDE"), End(link, ("", 0)))
        assert {end.link for end in found} == expected


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=2), st.floats(0, 3)), max_size=40))
def test_repetitions_within_the_time_and_no_others(frames: list[tuple[bytes, float]]) -> None:
    """The same bytes are dropped exactly when they were last let through less than half a second before."""
    made = RoutingTable((Rules(),), own_system=OWN)
    passed: dict[bytes, float] = {}
    for raw, now in sorted(frames, key=lambda each: each[1]):
        expected = raw in passed and now - passed[raw] <= 0.5
        assert made.repeated(raw, now) == expected
        if not expected:
            passed[raw] = now


@given(st.lists(st.integers(0, 5), min_size=1, max_size=30), st.integers(0, 5))
def test_in_a_ring_of_routers_a_frame_ends(path: list[int], start: int) -> None:
    """Whatever way copies of a frame take between six routers in a ring, each router sends it on at most once."""
    routers = [RoutingTable((Rules(), Rules()), own_system=OWN + index) for index in range(6)]
    for made in routers:
        for side in (0, 1):
            made.hear(passage(100 + side), End(side, ("neighbour", side)), 0.0)
    frame, on_the_way, sent = passage(1, name="HEARTBEAT"), [(start, 0)], [0] * 6
    while on_the_way:
        at, side = on_the_way.pop(path[sum(sent) % len(path)] % len(on_the_way))
        if routers[at].repeated(frame.raw, 0.1):
            continue
        for end in routers[at].destinations(frame, End(side, ("neighbour", side))):
            sent[at] += 1
            on_the_way.append(((at + (1 if end.link else -1)) % 6, 1 - end.link))
        assert sum(sent) <= 12


def test_senders_age_apart_from_their_end() -> None:
    """A vehicle that fell silent behind a router that still speaks is forgotten; the router's others are not."""
    made = router()
    made.hear(passage(2, 1), DRONE, 10.0)
    for now in (30.0, 59.0, 69.0):
        made.hear(passage(1, 1), DRONE, now)
        made.hear(passage(255, 190), GCS, now)
    made.hear(passage(1, 1), DRONE, 70.5)
    assert made.destinations(passage(255, to=2, part=1), GCS) == ()
    assert made.destinations(passage(255, to=1, part=1), GCS) == (DRONE,)


def test_a_fast_sender_may_say_the_same_again() -> None:
    """The same bytes after 128 frames of their sender are news, as its numbers wrapped; before they are not."""
    made = RoutingTable((Rules(),), own_system=OWN)
    assert not made.repeated(b"beat", 0.0, sender=(1, 1))
    for number in range(127):
        assert not made.repeated(b"%d" % number, 0.001, sender=(1, 1))
    assert made.repeated(b"beat", 0.002, sender=(1, 1)) is False
    assert made.repeated(b"beat", 0.003, sender=(1, 1)) is True


def test_links_come_and_go() -> None:
    """Frames reach a link that was added, by its rules, and no end of one that was removed."""
    made, late = router(), End(7, ("late", 1))
    made.add(7, Rules(not_out=frozenset({"ATTITUDE"})))
    made.hear(passage(3, 1), late, 1.0)
    assert late in made.destinations(passage(1, name="HEARTBEAT"), DRONE)
    assert late not in made.destinations(passage(1, name="ATTITUDE"), DRONE)
    made.remove(7)
    assert late not in made.destinations(passage(1, name="HEARTBEAT"), DRONE)
    assert made.destinations(passage(255, to=3, part=1), GCS) == ()
    assert made.destinations(passage(3, name="HEARTBEAT"), late) == ()


def test_invented_ids_cost_no_memory() -> None:
    """However many senders somebody makes up, routes stay bounded."""
    made = router()
    for number in range(10_000):
        made.hear(passage(number % 256, number // 256), DRONE, 0.0)
    assert len(made.routes) <= 2048
