"""Where there are keys, a token makes a member once its gateway has proved who it is."""

import asyncio
from collections.abc import AsyncIterator
from typing import cast
from unittest.mock import MagicMock

import pytest

from appliance.errors import DeadlineError, IdentityError, SwiftbotError
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.plane import membership as module
from appliance.plane.events import FleetEvent, FleetEvents, Joined, Lost, Stage
from appliance.plane.membership import MOST_MEMBERS, Membership
from appliance.plane.session import Session

pytestmark = pytest.mark.anyio
KEYS = Keys("fleet")


class Here:
    """The membership of gw-1; `answers` says what each other's proof comes to (None: it is good)."""

    def __init__(self) -> None:
        self.answers: dict[str, SwiftbotError | None] = {}
        self.asked: list[str] = []
        self.events: list[FleetEvent] = []
        self.hold: asyncio.Event | None = None
        events = FleetEvents()
        events.subscribe(Stage.WATCHERS, self.events.append)
        self.session = MagicMock(keys=KEYS)
        self.it = Membership(
            cast("Session", self.session), gateway="gw-1", virtual_nodes=4, events=events, prove=self._prove
        )

    async def _prove(self, name: str) -> None:
        self.asked.append(name)
        if self.hold is not None:
            await self.hold.wait()
        await asyncio.sleep(0)
        error = self.answers.get(name, IdentityError("nobody"))
        if error is not None:
            raise error

    def token(self, name: str, alive: bool = True) -> None:
        """Have a token come or go."""
        self.it._seen(KEYS(keyspace.GATEWAY_ALIVE, name), alive=alive)


@pytest.fixture
async def here(anyio_backend: str, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Here]:
    """Return one that asks again at once."""
    monkeypatch.setattr(module, "PROVE_AGAIN_S", (0.0, 0.0))
    made = Here()
    yield made
    made.it.close()


async def test_a_token_alone_makes_no_member(here: Here) -> None:
    """Nor does it change the ring; one that proves itself joins, and others hear of it once."""
    here.answers = {"gw-2": None}
    here.token("gw-2")
    here.token("evil")
    assert here.it.members == {"gw-1"}
    await here.it.proved(0.2)
    assert here.it.members == {"gw-1", "gw-2"}
    assert here.it.ring.members == {"gw-1", "gw-2"}
    assert here.events == [Joined("gw-2")]
    assert {call.args[0] for call in here.session.deny.call_args_list} == {"token without a gateway"}


async def test_one_that_does_not_answer_at_once_joins_when_it_does(here: Here) -> None:
    """It is asked again while its token is there."""
    here.answers = {"gw-2": DeadlineError("busy")}
    here.token("gw-2")
    await asyncio.sleep(0.01)
    here.answers = {"gw-2": None}
    await here.it.proved(1.0)
    assert here.it.members == {"gw-1", "gw-2"}


async def test_one_that_goes_before_its_proof_never_was_there(here: Here) -> None:
    """Nobody is told that it came or went, and it is asked no more."""
    here.hold = asyncio.Event()
    here.answers = {"gw-2": None}
    here.token("gw-2")
    await asyncio.sleep(0)
    here.token("gw-2", alive=False)
    here.hold.set()
    await asyncio.sleep(0.01)
    assert here.it.members == {"gw-1"}
    assert here.events == []


async def test_one_that_comes_back_proves_itself_again(here: Here) -> None:
    """What it was before says nothing of who it is now."""
    here.answers = {"gw-2": None}
    here.token("gw-2")
    await here.it.proved(1.0)
    here.token("gw-2", alive=False)
    here.answers = {}
    here.token("gw-2")
    await asyncio.sleep(0.01)
    assert here.it.members == {"gw-1"}
    assert here.events == [Joined("gw-2"), Lost("gw-2")]


async def test_a_member_that_is_revoked_is_lost(here: Here) -> None:
    """When all prove themselves again; one that does not answer just then stays."""
    here.answers = {"gw-2": None, "gw-3": None}
    here.token("gw-2")
    here.token("gw-3")
    await here.it.proved(1.0)
    here.answers = {"gw-2": IdentityError("revoked"), "gw-3": DeadlineError("busy")}
    await here.it.prove_again()
    assert here.it.members == {"gw-1", "gw-3"}
    assert here.events[-1] == Lost("gw-2")
    here.answers["gw-2"] = None
    await here.it.proved(1.0)
    assert here.it.members == {"gw-1", "gw-2", "gw-3"}


async def test_candidates_are_bounded(here: Here) -> None:
    """However many tokens a stranger shows; the rest is counted."""
    here.hold = asyncio.Event()
    for number in range(MOST_MEMBERS + 3):
        here.token(f"evil-{number}")
    refused = [call.args[0] for call in here.session.refuse.call_args_list]
    assert refused == ["too many gateways"] * 3
    assert here.it.members == {"gw-1"}


async def test_one_that_was_busy_for_long_joins_soon_after(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pauses after proofs that are late stay short, where those after wrong ones double."""
    monkeypatch.setattr(module, "PROVE_AGAIN_S", (0.001, 3600.0))
    monkeypatch.setattr(module, "LATE_S", 0.001)
    here.answers = {"gw-2": DeadlineError("busy")}
    here.token("gw-2")
    async with asyncio.timeout(10):
        while len(here.asked) < 30:
            await asyncio.sleep(0.001)
    here.answers = {"gw-2": None}
    await here.it.proved(10.0)
    assert here.it.members == {"gw-1", "gw-2"}


async def test_a_silent_member_does_not_delay_that_a_revoked_one_is_lost(
    here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All are asked at once, whatever their names."""
    here.answers = {"gw-2": None, "gw-3": None}
    here.token("gw-2")
    here.token("gw-3")
    await here.it.proved(1.0)
    silent = asyncio.Event()

    async def prove(name: str) -> None:
        if name == "gw-2":
            await silent.wait()
            raise DeadlineError("busy")
        raise IdentityError("revoked")

    monkeypatch.setattr(here.it, "_prove", prove)
    again = asyncio.create_task(here.it.prove_again())
    async with asyncio.timeout(10):
        while Lost("gw-3") not in here.events:
            await asyncio.sleep(0.001)
    silent.set()
    await again
    assert here.it.members == {"gw-1", "gw-2"}
