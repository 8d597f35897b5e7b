"""Texts of any length: ended, cut with a sign, and shown as those of the vehicle that they are about."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from appliance.model.robot_api import MavlinkLink
from appliance.ports import free_port
from appliance.robots.mavlink import statustext
from appliance.robots.mavlink.dialect import Codec, Frame, make
from appliance.robots.mavlink.statustext import Said, Texts
from tests.unit.robots.links import BEAT, station, until
from tests.unit.robots.test_silent_stations import ear

pytestmark = pytest.mark.anyio
_ASCII = st.text(alphabet=st.characters(min_codepoint=32, max_codepoint=126), max_size=400)


def heard(*raws: bytes) -> list[Said]:
    """Return the texts that a station puts together of frames."""
    taken, found = Texts(), list[Said]()
    for raw in raws:
        (frame,) = Codec(9, 9).read(raw)
        assert isinstance(frame, Frame)
        message = frame.message
        said = taken.take(message.severity, message.text, message.id, message.chunk_seq, 0.0)
        found += [said] if said is not None else []
    return found


@given(_ASCII)
def test_any_text_is_ended_and_whole_or_ends_with_an_ellipsis(text: str) -> None:
    """A station that waits for a part that is not full has it at once, and sees that something was cut."""
    codec = Codec(242, 191)
    (said,) = heard(*(codec.pack(each) for each in statustext.statustext(text, statustext.ERROR)))
    if len(text) <= statustext.MOST:
        assert said.text == text.strip()
    else:
        assert said.text.endswith("...")
        assert text.startswith(said.text.removesuffix("...").rstrip()) or text.strip().startswith(
            said.text[:-3].strip()
        )
        assert len(said.text) <= statustext.MOST


@pytest.mark.parametrize("size", [1, 50, 51, 100, 150, 199, 200])
def test_a_text_whose_last_part_is_full_has_an_empty_one_behind(size: int) -> None:
    """But one of 50 characters, which is whole without an id."""
    sent = statustext.statustext("x" * size, statustext.INFO)
    sizes = [len(each.text.rstrip(b"\0") if isinstance(each.text, bytes) else each.text) for each in sent]
    assert sum(sizes) == size
    assert (sizes[-1] < 50) or (size == 50 and sent[0].id == 0)
    assert [each.chunk_seq for each in sent] == list(range(len(sent)))


def test_a_text_that_a_vehicle_does_not_end_is_told_after_a_while() -> None:
    """Full parts and no more: it is taken for whole when nothing more comes."""
    taken = Texts()
    for part in range(2):
        assert taken.take(3, b"x" * 50, 7, part, 0.0) is None
    assert taken.tick(0.5) == []
    assert [each.text for each in taken.tick(2.0)] == ["x" * 100]
    assert taken.tick(9.0) == []


def test_the_empty_part_has_no_form_in_mavlink_1() -> None:
    """There parts have no id: it would be shown as an empty text."""
    sizes = [len(Codec(9, 1, v1=True).pack(each)) for each in statustext.statustext("x" * 100, statustext.INFO)]
    assert sizes == [59, 59, 0]
    assert len(Codec(9, 1, v1=True).pack(make("STATUSTEXT", severity=1, text=b"", id=0, chunk_seq=0))) == 59
    assert ardupilotmega.MAVLINK_MSG_ID_STATUSTEXT == 253


@pytest.mark.parametrize("companion", [False, True])
async def test_what_is_said_of_a_vehicle_comes_from_its_system(companion: bool) -> None:
    """MAVSDK shows texts of its vehicle's system alone. A real companion computer keeps that address for itself."""
    one, two = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    async with (
        station(one, MavlinkLink(listen=f"udp://127.0.0.1:{two}")) as (made, _),
        ear(one) as (vehicle, at_vehicle),
        ear(two) as (ground, at_ground),
    ):
        codec, other, asker = Codec(7, 1), Codec(7, 191), Codec(255, 190)

        def act() -> None:
            vehicle(codec.pack(make("HEARTBEAT", **BEAT)))
            if companion:
                vehicle(other.pack(make("HEARTBEAT", **(BEAT | {"type": 18, "autopilot": 8}))))
            ground(asker.pack(make("HEARTBEAT", **(BEAT | {"type": 6, "autopilot": 8}))))

        ready = {(7, 1), (255, 190), *([(7, 191)] if companion else [])}
        await until(lambda: made.vehicles.attached and ready <= made.routing.routes.keys(), act)
        (each,) = made.vehicles._vehicles.values()
        for part in statustext.parts(b"y" * 60, statustext.NOTICE):
            each.vehicle.announce(part)
        for frames in (at_vehicle, at_ground):
            await until(lambda frames=frames: sum(each.name == "STATUSTEXT" for each in frames) == 2)
        shown = {(each.system, each.component) for each in at_ground if each.name == "STATUSTEXT"}
        assert shown == {(242 if companion else 7, 191)}
