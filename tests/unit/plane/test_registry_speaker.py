"""Own facts on their way out: what is news, what goes out together, and what a message says of its age."""

import asyncio
from typing import Any

import msgspec
import pytest

from appliance.model import ContainerInfo, ContainerState, GatewayStatus, encode
from appliance.model.keys import Keys, Topic
from appliance.plane.registry import LOAD_STEP, Speaker, tells_more, told_demand

pytestmark = pytest.mark.anyio


class Sent:
    """In place of a session: what was put and deleted."""

    def __init__(self) -> None:
        self.keys = Keys("f")
        self.log: list[tuple[str, bytes | None]] = []

    def publish(self, topic: Topic[Any], value: Any, *names: str) -> None:
        """Put a fact."""
        self.put(self.keys(topic, *names), encode(value))

    def put(self, key: str, payload: bytes) -> None:
        """Note a put."""
        self.log.append((key.removeprefix("swiftbot/f/gw/g0/"), payload))

    def delete(self, key: str) -> None:
        """Note a delete."""
        self.log.append((key.removeprefix("swiftbot/f/gw/g0/"), None))

    def statuses(self) -> list[GatewayStatus]:
        """The statuses put so far."""
        return [msgspec.json.decode(data, type=GatewayStatus) for key, data in self.log if key == "status" and data]


def _speaker(sent: Sent, *, most_s: float = 0.05, elsewhere: float = 0.0) -> Speaker:
    return Speaker(
        sent,  # pyright: ignore[reportArgumentType]
        "g0", least_s=0.01, most_s=most_s, listeners=lambda: 3, elsewhere=lambda _: elsewhere,
    )  # fmt: skip


def _container(name: str, image: str = "base", state: ContainerState = ContainerState.READY) -> ContainerInfo:
    return ContainerInfo(id=name, gateway="g0", image=image, state=state)


def test_figures_are_no_news() -> None:
    """Slightly other CPU, memory and load change nothing; a load that moved, a drain or a volume does."""
    before = GatewayStatus(id="g0", fleet="f", load=0.1, cpu_percent=3, memory_mb=90)
    same = GatewayStatus(id="g0", fleet="f", load=0.1 + LOAD_STEP / 2, cpu_percent=5, memory_mb=91, age_ms=100)
    assert not tells_more(before, same)
    assert tells_more(before, msgspec.structs.replace(before, load=0.1 + 2 * LOAD_STEP))
    assert tells_more(before, msgspec.structs.replace(before, draining=True))
    assert tells_more(before, msgspec.structs.replace(before, models=("local:m",)))


def test_demand_is_told_coarsely() -> None:
    """What is asked for most, to the next power of two, without what is hardly asked for."""
    assert told_demand({"a": 3.0, "b": 0.01, "c": 0.06}) == {"a": 3.2, "c": 0.1}
    assert told_demand({"a": 2.9}) == told_demand({"a": 3.1})
    assert len(told_demand({f"i{number}": 1.0 for number in range(100)})) == 16


async def test_a_burst_goes_out_once_and_removals_with_it() -> None:
    """Of many changes the last stands; what is left out is deleted; unchanged containers are not repeated."""
    sent = Sent()
    it = _speaker(sent)
    for number in range(20):
        it.containers(
            (_container("a"), _container("b", state=ContainerState.BUSY if number % 2 else ContainerState.READY))
        )
    while len(sent.log) < 2:
        await asyncio.sleep(0.01)
    assert sorted(key for key, _ in sent.log) == ["pool/a", "pool/b"]
    it.containers((_container("b", state=ContainerState.BUSY),))
    while len(sent.log) < 3:
        await asyncio.sleep(0.01)
    assert sent.log[2] == ("pool/a", None)


async def test_a_status_says_its_age_and_when_it_comes_again() -> None:
    """Figures read a while ago say so, and unchanged ones are not repeated before the heartbeat is due."""
    sent = Sent()
    it = _speaker(sent)
    status = GatewayStatus(id="g0", fleet="f", load=0.1, age_ms=300)
    it.asked("base", here=True)
    it.asked("base", here=True)
    it.status(status)
    while not sent.log:
        await asyncio.sleep(0.01)
    (told,) = sent.statuses()
    assert told.age_ms >= 300
    assert told.again_ms == 2000
    assert told.asked == {"base": 0.2}
    for _ in range(10):
        it.status(status)
        await asyncio.sleep(0.01)
    assert len(sent.log) == 1


async def test_what_is_untold_is_admitted_and_told_at_the_end() -> None:
    """A status put before changed containers are says for how long they have changed; closing tells them."""
    sent = Sent()
    it = _speaker(sent, most_s=1000.0)
    it.containers((_container("a"),))
    while not sent.log:
        await asyncio.sleep(0.01)
    it.containers((_container("a", state=ContainerState.BUSY),))
    await asyncio.sleep(0.02)
    assert it.now(GatewayStatus(id="g0", fleet="f")).untold_ms >= 10
    it.close()
    assert len(sent.log) == 2
    assert it.untold_s == 0
