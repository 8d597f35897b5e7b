"""Exchanges with a vehicle, by a fake one on the other side of its link: what is lost, late, refused, or not for us."""

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from appliance.model import Site
from appliance.robots.mavlink import dialect, protocols
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.mavlink.protocols import Item, RetryPolicy, ask, command, command_at, download, upload
from appliance.robots.mavlink.vehicle import Vehicle
from appliance.robots.verbs import RobotFailure

pytestmark = pytest.mark.anyio

PATIENCE = RetryPolicy(timeout_s=0.25, tries=4)
"""A loaded machine may stop this process for a tenth of a second: that must not look like silence."""
BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 3, "mavlink_version": 3}
Script = Callable[[Message], list[Message]]


class Fake:
    """A vehicle whose answers are the test's; what is sent to it is kept."""

    def __init__(self, script: Script) -> None:
        self.sent: list[Message] = []
        self._script = script
        self._codec = Codec(1, 1)
        self.vehicle = Vehicle("drone_1", site=Site(), send=self._send, own=242)
        self.say(make("HEARTBEAT", **BEAT))

    def _send(self, message: Message) -> None:
        self.sent.append(message)
        for answer in self._script(message):
            asyncio.get_running_loop().call_soon(self.say, answer)

    def say(self, message: Message, *, component: int = 1) -> None:
        """Let the vehicle say something."""
        codec = Codec(1, component)
        (frame,) = codec.read(codec.pack(message))
        assert isinstance(frame, Frame)
        try:
            now = asyncio.get_running_loop().time()
        except RuntimeError:
            now = 0.0
        self.vehicle.hear(frame, now)


def ack(result: int, *, number: int = 400, system: int = 242) -> Message:
    """Make an acknowledgement."""
    fields: dict[str, Any] = {"progress": 0, "result_param2": 7, "target_system": system, "target_component": 191}
    return make("COMMAND_ACK", command=number, result=result, **fields)


def text(words: str, *, part: int = 0, number: int = 0) -> Message:
    """Make a warning."""
    return make("STATUSTEXT", severity=4, text=words.encode(), id=number, chunk_seq=part)


async def test_a_command_is_sent_again_until_it_is_answered() -> None:
    """Two are lost, the third is answered; the repetitions count up, and the answer's number comes back."""
    fake = Fake(lambda sent: [ack(dialect.ACCEPTED)] if sent.confirmation == 2 else [])
    assert (await command(fake.vehicle, 400, 1.0, patience=PATIENCE)).number == 7
    assert [each.confirmation for each in fake.sent] == [0, 1, 2]


async def test_silence_has_an_end() -> None:
    """After all tries it is a failure that another attempt may cure."""
    fake = Fake(lambda _: [])
    with pytest.raises(RobotFailure, match="did not acknowledge MAV_CMD_COMPONENT_ARM_DISARM in 4 tries") as caught:
        await command(fake.vehicle, 400, patience=PATIENCE)
    assert caught.value.failure.retryable


async def test_in_progress_is_waited_for() -> None:
    """A command that is being carried out is not sent again."""
    fake = Fake(lambda _: [ack(dialect.IN_PROGRESS)])
    running = asyncio.create_task(command(fake.vehicle, 400, patience=PATIENCE))
    await asyncio.sleep(4 * PATIENCE.timeout_s)
    fake.say(ack(dialect.ACCEPTED))
    await running
    assert len(fake.sent) == 1


async def test_what_is_not_for_us_is_no_answer() -> None:
    """Another command's answer, another component's, and that to a ground station's same command are passed over."""
    fake = Fake(lambda _: [ack(dialect.ACCEPTED, number=22), ack(dialect.DENIED, system=255)])
    running = asyncio.create_task(ask(fake.vehicle, 400, patience=RetryPolicy(timeout_s=5.0, tries=1)))
    await asyncio.sleep(0.05)
    fake.say(ack(dialect.DENIED), component=100)
    await asyncio.sleep(0.05)
    assert not running.done()
    fake.say(ack(dialect.ACCEPTED))
    assert (await running).result == dialect.ACCEPTED


async def test_a_refusal_comes_with_the_words_around_it() -> None:
    """Texts before and after the refusal, also in parts, are in the failure; old ones and mere information are not."""
    fake = Fake(lambda _: [text("PreArm: battery low"), ack(dialect.FAILED)])
    fake.say(text("Hello"))
    await asyncio.sleep(0.01)
    with pytest.raises(RobotFailure) as caught:
        await command(fake.vehicle, 400, patience=PATIENCE)
    assert caught.value.failure.message.endswith("with FAILED: PreArm: battery low")

    def late(_: Message) -> list[Message]:
        asyncio.get_running_loop().call_later(0.05, fake.say, text("x" * 50, number=3))
        asyncio.get_running_loop().call_later(0.06, fake.say, text(" is the reason", number=3, part=1))
        return [ack(dialect.TEMPORARILY_REJECTED)]

    fake = Fake(late)
    with pytest.raises(RobotFailure) as caught:
        await command(fake.vehicle, 400, patience=PATIENCE)
    assert caught.value.failure.message.endswith("x is the reason")
    assert caught.value.failure.retryable


async def test_a_position_travels_whole() -> None:
    """COMMAND_INT carries degrees to seven places."""
    fake = Fake(lambda _: [ack(dialect.ACCEPTED, number=195)])
    await command_at(fake.vehicle, 195, at=(47.3977421, -8.5455942, 12.5), patience=PATIENCE)
    assert (fake.sent[0].x, fake.sent[0].y, fake.sent[0].z) == (473977421, -85455942, 12.5)


@pytest.mark.parametrize("positioned", [True, False])
async def test_nothing_is_sent_again_once_it_may_not_be(positioned: bool) -> None:
    """The first is lost, then a pilot takes over: no repetition, with or without a position, and no new order."""
    taken = False

    def check() -> None:
        if taken:
            raise RobotFailure("taken", "drone_1 is not commanded: a pilot has it")

    def lose(_: Message) -> list[Message]:
        nonlocal taken
        taken = True
        return []

    fake = Fake(lose)

    async def order() -> None:
        if positioned:
            await command_at(fake.vehicle, 195, at=(47.0, 8.0, 12.5), patience=PATIENCE, check=check)
        else:
            await command(fake.vehicle, 195, patience=PATIENCE, check=check)

    for sent in (1, 1):
        with pytest.raises(RobotFailure, match="a pilot has it") as caught:
            await order()
        assert caught.value.failure.code == "taken"
        assert len(fake.sent) == sent


async def test_a_mission_is_read_back_over_losses() -> None:
    """Each request is lost once; items come in order, once each, and the end is acknowledged."""
    seen: dict[str, int] = {}
    items = [Item(command=16, latitude_deg=1.0 + number, longitude_deg=2.0, relative_m=5.0) for number in range(3)]

    def script(sent: Message) -> list[Message]:
        name = f"{sent.get_type()} {getattr(sent, 'seq', '')}"
        seen[name] = seen.get(name, 0) + 1
        if seen[name] == 1:
            return []
        target = {"target_system": 242, "target_component": 191, "mission_type": 0}
        if sent.get_type() == "MISSION_REQUEST_LIST":
            return [make("MISSION_COUNT", count=3, **target)]
        if sent.get_type() != "MISSION_REQUEST_INT":
            return []
        item = items[sent.seq]
        fields = {"param1": 0.0, "param2": 0.0, "param3": 0.0, "param4": 0.0, "current": 0, "autocontinue": 1}
        told = make(
            "MISSION_ITEM_INT",
            seq=sent.seq,
            frame=6,
            command=item.command,
            x=round(item.latitude_deg * 1e7),
            y=round(item.longitude_deg * 1e7),
            z=item.relative_m,
            **fields,
            **target,
        )
        return [told, told]

    fake = Fake(script)
    board = await download(fake.vehicle, patience=PATIENCE)
    assert all(one.same(other) for one, other in zip(board, items, strict=True))
    assert fake.sent[-1].get_type() == "MISSION_ACK"
    silent = Fake(lambda _: [])
    with pytest.raises(RobotFailure, match="did not tell its mission"):
        await download(silent.vehicle, patience=PATIENCE)


async def test_counts_and_numbers_that_cannot_be_end_in_time() -> None:
    """A mission of 65,535 items that never come, and requests for items that there are not: asked a few times each."""
    target = {"target_system": 242, "target_component": 191, "mission_type": 0}

    def boasts(sent: Message) -> list[Message]:
        told = sent.get_type() == "MISSION_REQUEST_LIST"
        return [make("MISSION_COUNT", count=65_535, **target)] * 300 if told else []

    fake = Fake(boasts)
    async with asyncio.timeout(20):
        with pytest.raises(RobotFailure, match="did not tell its mission"):
            await download(fake.vehicle, patience=PATIENCE)
    assert len(fake.sent) <= 1 + 2 * PATIENCE.tries

    def wants(sent: Message) -> list[Message]:
        asks = sent.get_type() in ("MISSION_COUNT", "MISSION_ITEM_INT")
        return [make("MISSION_REQUEST_INT", seq=9_999, **target)] * 300 if asks else []

    fake = Fake(wants)
    async with asyncio.timeout(20):
        with pytest.raises(RobotFailure, match="did not take its mission"):
            await upload(fake.vehicle, [Item(command=16)] * 3, patience=PATIENCE)
    assert len(fake.sent) <= 1 + PATIENCE.tries


async def test_parameters_are_read_and_written() -> None:
    """A write is checked by the value that holds; what keeps the vehicle safe is not written; silence is reported."""
    values = {"WPNAV_SPEED": 500.0, "STUBBORN": 1.0}

    def script(sent: Message) -> list[Message]:
        name = sent.param_id.split("\0")[0] if isinstance(sent.param_id, str) else sent.param_id.decode()
        if name not in values:
            return []
        if sent.get_type() == "PARAM_SET" and name != "STUBBORN":
            values[name] = sent.param_value
        told = {"param_value": values[name], "param_type": 9, "param_count": 2, "param_index": 0}
        return [make("PARAM_VALUE", param_id=name.encode(), **told)]

    fake = Fake(script)
    assert await protocols.read_parameter(fake.vehicle, "WPNAV_SPEED", patience=PATIENCE) == 500.0
    assert await protocols.write_parameter(fake.vehicle, "WPNAV_SPEED", 0.1, patience=PATIENCE) == pytest.approx(0.1)
    with pytest.raises(RobotFailure, match="keeps STUBBORN at 1 instead of 2"):
        await protocols.write_parameter(fake.vehicle, "STUBBORN", 2.0, patience=PATIENCE)
    with pytest.raises(RobotFailure, match="keeps the vehicle safe"):
        await protocols.write_parameter(fake.vehicle, "FENCE_ENABLE", 0.0, patience=PATIENCE)
    with pytest.raises(RobotFailure, match="does not tell NOTHING"):
        await protocols.read_parameter(fake.vehicle, "NOTHING", patience=PATIENCE)
    for wrong in ("", "no spaces", "WAY_TOO_LONG_A_NAME", "Ä"):
        with pytest.raises(RobotFailure, match="is no name"):
            protocols.check_name(wrong)
