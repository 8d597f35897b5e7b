"""The gateway's look at the roster: what becomes of it where one of its steps breaks."""
# pyright: reportPrivateUsage=false

import asyncio
from typing import cast
from unittest.mock import AsyncMock, MagicMock, call

import pytest

from appliance.errors import UnreachableError
from appliance.identity.credentials import Credentials
from appliance.plane import node
from appliance.plane.node import Plane

pytestmark = pytest.mark.anyio


def a_plane() -> MagicMock:
    """Return what the look at the roster uses of a plane, with a session that is there."""
    plane = MagicMock(_roster_news=asyncio.Event(), on_revoked=AsyncMock())
    plane.session.gone = False
    plane._membership.prove_again = AsyncMock()
    plane._rosters.spread = AsyncMock()
    plane._reopener.reopen = AsyncMock()
    return plane


async def test_a_gateway_that_is_left_without_a_session_does_not_go_on() -> None:
    """Its process ends by this error and is started again: the same session is not tried twice."""
    plane, credentials = a_plane(), MagicMock(stale=True, barred=frozenset())

    def fail(_: str) -> None:
        plane.session.gone = True
        raise UnreachableError("the endpoint is taken")

    plane._reopener.reopen.side_effect = fail
    plane._roster_news.set()
    watching = asyncio.create_task(Plane._watch_roster(cast("Plane", plane), cast("Credentials", credentials)))
    plane._proving = watching
    async with asyncio.timeout(10):
        with pytest.raises(UnreachableError, match="taken"):
            await Plane.until_gone(cast("Plane", plane))
    assert watching.done()


async def test_a_roster_whose_taking_up_broke_is_taken_up_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its revoked robots are stopped and lost by the next look, and members prove who they are."""
    monkeypatch.setattr(node, "ROSTER_S", 0.001)
    plane, credentials = a_plane(), MagicMock(stale=False, barred=frozenset[str]())
    credentials.roster.number = 1
    proved = asyncio.Event()
    plane.on_revoked.side_effect = [RuntimeError("a defect"), None]
    plane._membership.prove_again.side_effect = proved.set
    watching = asyncio.create_task(Plane._watch_roster(cast("Plane", plane), cast("Credentials", credentials)))
    await asyncio.sleep(0)
    credentials.roster.number, credentials.barred = 2, frozenset({"r1"})
    async with asyncio.timeout(10):
        await proved.wait()
    watching.cancel()
    await asyncio.gather(watching, return_exceptions=True)
    assert plane.on_revoked.await_args_list == [call(frozenset({"r1"}))] * 2
    plane.registry.lose.assert_called_once_with("r1")
