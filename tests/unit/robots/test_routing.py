"""MAVLink routing: frames go where they are meant to go, once, and never back."""

from hypothesis import given
from hypothesis import strategies as st

from appliance.robots.mavlink.routing import End, Passage, RoutingTable, Rules

GCS, DRONE, CAMERA = End(0, ("gcs", 1)), End(1, ("drone", 1)), End(2, ("camera", 1))
OWN = 245


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
