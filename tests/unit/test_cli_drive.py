"""`robots drive`: what the bytes of a terminal mean, and what a robot is told while keys are held."""

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.cli import drive
from appliance.cli.drive import KEYS, Drive, Keys, other_speed
from appliance.client import FleetClient
from appliance.errors import ConflictError, RobotError
from appliance.jog import LASTS_S, SPEEDS
from appliance.model import Lease

pytestmark = pytest.mark.anyio
LEASE = Lease(id="l-1", robot="rover_1")


@given(st.lists(st.sampled_from(sorted(set(KEYS) - {b"\x1b"})), max_size=12), st.data())
def test_keys_are_the_same_however_their_bytes_come(pressed: list[bytes], data: st.DataObject) -> None:
    """A link may cut a key in two or bring several at once."""
    whole = b"".join(pressed)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=4)))
    keys, found = Keys(), list[str]()
    for start, end in zip([0, *cuts], [*cuts, len(whole)], strict=True):
        found += keys.read(whole[start:end], 0.0)
    assert found == [KEYS[each] for each in pressed]


@given(st.binary(max_size=200))
def test_no_bytes_break_it(data: bytes) -> None:
    """What is no key is dropped, and the next key is understood; nothing is kept without bound."""
    keys = Keys()
    keys.read(data, 0.0)
    assert keys.read(b"~\x00\x00\x00 ", 0.0)[-1] == "hold"


def test_a_lone_escape_releases() -> None:
    """An escape is the key itself once nothing has followed it for a moment."""
    keys = Keys()
    assert keys.read(b"\x1b", 1.0) == []
    assert keys.read(b"", 1.05) == []
    assert keys.read(b"", 1.2) == ["quit"]


class Orders:
    """A fleet that notes what it is told."""

    def __init__(self) -> None:
        self.moves: list[dict[str, Any]] = []
        self.error: Exception | None = None

    async def drive(self, lease: Lease, verb: str, *, timeout_s: float, **args: float) -> None:
        """Note a movement."""
        assert (lease, verb, timeout_s) == (LEASE, "velocity", 2.0)
        self.moves.append(args)
        if self.error is not None:
            raise self.error

    async def renew(self, lease: Lease) -> Lease:
        """Renew."""
        return lease

    def known_robots(self) -> dict[str, object]:
        """Return none."""
        return {}


@pytest.fixture
def orders(monkeypatch: pytest.MonkeyPatch) -> Orders:
    """Return a fleet, and have the terminal be 80 columns wide."""
    monkeypatch.setattr(drive, "os", SimpleNamespace(get_terminal_size=lambda _: SimpleNamespace(columns=80)))
    monkeypatch.setattr(drive.sys, "stdout", SimpleNamespace(fileno=lambda: 1, write=lambda _: 0, flush=lambda: None))
    return Orders()


async def test_a_held_key_moves_and_silence_stops(orders: Orders) -> None:
    """Each movement is bounded; when no more keys come there is one stop, and nothing after it."""
    driving = Drive(cast("FleetClient", orders), LEASE, 0.5)
    running = asyncio.create_task(driving.run())
    for _ in range(6):
        driving.hear(b"\x1b[A")
        await asyncio.sleep(0.1)
    async with asyncio.timeout(20):
        while not orders.moves or orders.moves[-1]["forward_mps"]:
            await asyncio.sleep(0.05)
    assert all(each["for_s"] == LASTS_S for each in orders.moves)
    assert [each["forward_mps"] for each in orders.moves] == [0.5] * (len(orders.moves) - 1) + [0.0]
    driving.hear(b"q")
    async with asyncio.timeout(20):
        assert await running == "released by key"


@pytest.mark.parametrize(
    ("data", "error", "ended"),
    [
        (b"", None, "the terminal is gone"),
        (b"\x1b[A", ConflictError("bob has taken it over"), "bob has taken it over"),
        (b"\x03", None, "released by key"),
    ],
)
async def test_what_ends_it(orders: Orders, data: bytes, error: Exception | None, ended: str) -> None:
    """A closed terminal, another operator, Ctrl-C: each ends it with the reason."""
    orders.error = error
    driving = Drive(cast("FleetClient", orders), LEASE, 0.5)
    driving.hear(data)
    async with asyncio.timeout(20):
        assert await driving.run() == ended


async def test_a_refused_movement_is_not_repeated(orders: Orders) -> None:
    """At the fence the robot says why; the key has to be pressed again."""
    orders.error = RobotError("the fence is there")
    driving = Drive(cast("FleetClient", orders), LEASE, 0.5)
    running = asyncio.create_task(driving.run())
    driving.hear(b"\x1b[A")
    async with asyncio.timeout(20):
        while not orders.moves or orders.moves[-1]["forward_mps"]:
            await asyncio.sleep(0.05)
    assert [each["forward_mps"] for each in orders.moves] == [0.5, 0.0]
    driving.hear(b"q")
    await running


def test_speeds_have_ends() -> None:
    """Faster and slower go through the speeds, also from one between them."""
    assert other_speed(0.5, faster=True) == 1.0
    assert other_speed(0.3, faster=False) == 0.2
    assert other_speed(SPEEDS[-1], faster=True) == SPEEDS[-1]
    assert other_speed(SPEEDS[0], faster=False) == SPEEDS[0]
