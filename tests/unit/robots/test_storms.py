"""Storms of one message: vehicles do not answer answers, and a gateway cuts what explodes all the same."""

import socket
from itertools import pairwise
from typing import Any, cast

import msgspec
import pytest

from appliance.model import Notice, Site
from appliance.ports import free_port
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.mavlink.routing import BURST_S, MAX_KINDS, TRICKLE, WINDOW_S, Damper
from tests.unit.robots.links import BEAT, Wire, sender, station, until
from workshop.robots.copter import SimCopter
from workshop.robots.rover import SimRover

pytestmark = pytest.mark.anyio
KIND = (1, 1, "PARAM_VALUE")


def frame_of(message: Message, system: int, component: int = 1) -> Frame:
    """Return a message as one that is heard of that sender."""
    (frame,) = Codec(9, 9).read(Codec(system, component).pack(message))
    assert isinstance(frame, Frame)
    return frame


@pytest.mark.parametrize("kinds", [(SimCopter, SimCopter), (SimCopter, SimRover, SimCopter)])
def test_simulated_vehicles_do_not_answer_answers(kinds: tuple[Any, ...]) -> None:
    """On one link, where each hears all: the list that was asked for comes once, and then nobody says more."""
    vehicles = [kind(system=number + 1, site=Site(), home=(0.0, 0.0)) for number, kind in enumerate(kinds)]
    asked = make("PARAM_REQUEST_LIST", target_system=0, target_component=0)
    heard = [frame_of(asked, 255, 190)]
    sent = 0
    for tick in range(40):
        now = tick / 10
        said: list[Frame] = []
        for vehicle in vehicles:
            answers = [each for frame in heard if frame.system != vehicle.system for each in vehicle.handle(frame, now)]
            answers += vehicle.parameters.step()
            said += [frame_of(each, vehicle.system) for each in answers if each.get_type() == "PARAM_VALUE"]
        sent += len(said)
        heard = said
    assert sent == sum(len(each.parameters.values) for each in vehicles)


@pytest.mark.parametrize(
    ("message", "fields"),
    [
        ("PARAM_REQUEST_LIST", {}),
        ("PARAM_REQUEST_READ", {"param_id": b"RTL_ALT", "param_index": -1}),
        ("PARAM_SET", {"param_id": b"RTL_ALT", "param_value": 5.0, "param_type": 9}),
    ],
)
def test_a_simulated_vehicle_answers_for_itself_alone(message: str, fields: dict[str, Any]) -> None:
    """What is for another vehicle, or comes from its own id, is not answered and changes nothing."""
    vehicle = SimCopter(system=1, site=Site(), home=(0.0, 0.0))
    for system, source in ((2, 255), (1, 1)):
        frame = frame_of(make(message, target_system=system, target_component=1, **fields), source)
        assert [each for each in vehicle.handle(frame, 0.0) if each.get_type() == "PARAM_VALUE"] == []
        assert vehicle.parameters.step() == []
    assert vehicle.parameters["RTL_ALT"] == 800
    frame = frame_of(make(message, target_system=1, target_component=1, **fields), 255)
    assert [*vehicle.handle(frame, 0.0), *vehicle.parameters.step()]


def _run(damper: Damper, hz: float, seconds: float, start: float = 0.0, kind: tuple[int, int, str] = KIND) -> int:
    """Return how many frames pass."""
    return sum(damper.passes(*kind, start + number / hz) for number in range(round(hz * seconds)))


def test_what_is_usual_passes() -> None:
    """Streams up to the limit for ever, and a long list of parameters at once."""
    damper = Damper(500.0)
    assert _run(damper, 400.0, 60.0) == 400 * 60
    assert _run(damper, 1e5, 0.019, start=100.0) == 1900
    assert _run(damper, 5000.0, 10.0, kind=(1, 1, "LOG_DATA")) == 50_000
    assert not damper.damped


def test_a_storm_is_cut_to_a_trickle_and_reported_once() -> None:
    """Of 15,000 a second so many pass as may come at once, then 4 % of the limit; other messages are not concerned."""
    damper = Damper(500.0)
    passed = _run(damper, 15_000.0, 20.0)
    assert passed <= 500 * BURST_S + 500 * 0.2 + 500 * TRICKLE * 21
    assert list(damper.damped) == [KIND]
    assert [damper.news(KIND) for _ in range(3)] == [True, False, False]
    assert _run(damper, 50.0, 10.0, kind=(1, 1, "ATTITUDE")) == 500
    assert _run(damper, 50.0, 10.0, kind=(2, 1, "PARAM_VALUE")) == 500


def test_a_storm_that_is_over_is_forgotten() -> None:
    """What comes seldom passes whole again, what is silent too; a second storm is reported again."""
    damper = Damper(500.0)
    for start, silent in ((0.0, False), (100.0, True)):
        _run(damper, 5000.0, 3.0, start=start)
        assert damper.news(KIND)
        if silent:
            for second in range(3, 20):
                damper.look(start + second)
        else:
            _run(damper, 1.0, 3 * WINDOW_S, start=start + 5.0)
        assert not damper.damped
        assert _run(damper, 100.0, 2.0, start=start + 30.0) == 200


def test_ever_other_senders_cost_no_memory() -> None:
    """So many are followed and no more; without a limit nobody is."""
    damper = Damper(1.0)
    for number in range(2 * MAX_KINDS):
        for _ in range(6):
            damper.passes(number % 255 + 1, number // 255, "PARAM_VALUE", 0.0)
    assert len(damper._flows) == MAX_KINDS == len(damper.damped)
    assert _run(Damper(0.0), 1e5, 1.0) == 1e5


async def test_a_storm_over_the_routing_dies_down() -> None:
    """Two ends answer each other's answers through the gateway: what passes becomes a trickle, and people hear once."""
    one = free_port(socket.SOCK_DGRAM)
    share = ("PARAM_VALUE",)  # as of two programs that are no vehicles: those do not hear each other
    async with station(one, message_hz=100.0, vehicles_share=share) as (made, refused), sender(one) as vehicle:
        (entry,) = tuple(made.links)
        out: list[bytes] = []
        cast("Any", entry.link)._write = lambda raw, _: out.append(raw) or True
        codecs = {system: Codec(system, 1) for system in (1, 2)}
        fields = {"param_id": b"X", "param_value": 1.0, "param_type": 9, "param_count": 1, "param_index": 0}
        for system, codec in codecs.items():
            entry.link.feed(codec.pack(make("HEARTBEAT", **BEAT)), ("10.0.0.1", system))
        value = make("PARAM_VALUE", **fields)
        counts = [0]
        entry.link.feed(codecs[1].pack(value), ("10.0.0.1", 1))
        for turn in range(2000):
            answered, out[:] = [raw for raw in out if raw[7:10] == b"\x16\0\0"], []
            for raw in answered:
                system = 3 - raw[5]
                for _ in range(2):  # each answer is answered twice, as by two programs
                    entry.link.feed(codecs[system].pack(value), ("10.0.0.1", system))
            counts.append(counts[-1] + len(answered))
            if turn and not answered:
                break
        assert refused["damped"] > 100
        assert counts[-1] < 2 * 100 * (BURST_S + 2)
        assert all(two - one <= 2 * 100 * BURST_S for one, two in pairwise(counts))
        assert set(made.link_list().links[0].damped) <= {"PARAM_VALUE of 1/1", "PARAM_VALUE of 2/1"}
        session = cast("Wire", made._session)
        notices = [msgspec.json.decode(payload, type=Notice) for key, payload in session.puts if "/notice/" in key]
        assert 1 <= len(notices) <= 2
        assert "a storm of PARAM_VALUE from" in notices[0].text
        # The vehicle elsewhere is served all the same.
        other = Codec(7, 1)
        await until(lambda: "drone_7" in made.vehicles.attached, lambda: vehicle(other.pack(make("HEARTBEAT", **BEAT))))
