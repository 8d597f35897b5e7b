"""Signed files between gateways: the newest reaches all, whatever is handed on besides and in whatever order."""

from collections.abc import Awaitable, Callable
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import IdentityError, RefusedError, UnreachableError
from appliance.model import keyspace
from appliance.model.plane_api import SealedAsk, SealedTold
from appliance.plane.handing import Handing
from appliance.plane.rpc import Rpc

pytestmark = pytest.mark.anyio


class File:
    """A signed file: `good 3` is one of number 3 that the authority has signed."""

    def __init__(self, number: int) -> None:
        self.number, self.kept = number, 0

    @property
    def sealed(self) -> bytes:
        """Its bytes."""
        return b"good %d" % self.number

    def take(self, sealed: bytes, /) -> None:
        """Go by another one."""
        word, _, number = sealed.decode().partition(" ")
        if word != "good" or int(number) < self.number:
            raise IdentityError(f"{word} {number} is not taken")
        self.number = int(number)

    def keep(self) -> None:
        """Keep it."""
        self.kept = self.number


class Wire:
    """Gateways that call each other; those in `gone` do not answer."""

    def __init__(self) -> None:
        self.gone: set[str] = set()
        self.calls = 0
        self.refused: list[str] = []
        self.ends: dict[str, Callable[[SealedAsk], Awaitable[SealedTold]]] = {}
        self.handings: dict[str, Handing] = {}
        self.files: dict[str, File] = {}

    def add(self, name: str, file: File | None) -> None:
        """Add a gateway."""
        wire = self

        class End:
            def register(self, _verb: object, handler: Callable[[SealedAsk], Awaitable[SealedTold]]) -> None:
                wire.ends[name] = handler

            def deny(self, what: str, *_: str) -> None:
                wire.refused.append(what)

            async def call(self, gateway: str, _verb: object, ask: SealedAsk) -> SealedTold:
                wire.calls += 1
                if {gateway, name} & wire.gone:
                    raise UnreachableError(f"{gateway} does not answer")
                return await wire.ends[gateway](ask)

        if file is not None:
            self.files[name] = file
        members = self.ends.keys
        self.handings[name] = Handing(
            file, keyspace.PARTS, gateway=name, rpc=cast("Rpc", End()), members=lambda: set(members())
        )

    async def round(self) -> None:
        """Have each gateway that is there spread once."""
        for name, handing in self.handings.items():
            if name not in self.gone:
                await handing.spread()


@given(numbers=st.lists(st.integers(0, 9), min_size=1, max_size=6), away=st.sets(st.integers(0, 5)))
async def test_the_newest_reaches_all(numbers: list[int], away: set[int]) -> None:
    """Also those that were away, and once all have it nobody asks any more."""
    wire = Wire()
    for place, number in enumerate(numbers):
        wire.add(f"g{place}", File(number))
    wire.gone = {f"g{place}" for place in away}
    await wire.round()
    there = [file for name, file in wire.files.items() if name not in wire.gone]
    assert len({file.number for file in there}) <= 1
    wire.gone = set()
    await wire.round()
    await wire.round()
    assert {file.number for file in wire.files.values()} == {max(numbers)}
    assert {file.kept for file in wire.files.values()} == {max(numbers)}
    wire.calls = 0
    await wire.round()
    assert (wire.calls, wire.refused) == (0, [])


async def test_what_is_not_signed_is_refused_and_counted() -> None:
    """Pushed or given in answer it changes nothing, and the others still hear of the good one."""
    wire = Wire()
    wire.add("g0", File(2))
    with pytest.raises(IdentityError):
        await wire.ends["g0"](SealedAsk(number=7, sealed=b"forged 7"))
    with pytest.raises(IdentityError):
        await wire.ends["g0"](SealedAsk(number=7, sealed=b"good 1"))  # says that it is newer than it is

    async def lie(_: SealedAsk) -> SealedTold:
        return SealedTold(number=9, sealed=b"forged 9")

    wire.ends["evil"] = lie
    wire.add("g1", File(1))
    await wire.round()
    assert {name: file.number for name, file in wire.files.items()} == {"g0": 2, "g1": 2}
    assert wire.refused == ["bad parts"] * 4


async def test_a_gateway_without_keys_takes_none() -> None:
    """It says so, and asks nobody."""
    wire = Wire()
    wire.add("g0", None)
    with pytest.raises(RefusedError, match="has no keys"):
        await wire.ends["g0"](SealedAsk(number=1, sealed=b"good 1"))
    wire.add("g1", File(1))
    await wire.handings["g0"].spread()
    assert wire.calls == 0
