"""Two linked Zenoh sessions in this process, for tests."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from plane_fleet import until

from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig

LIMIT = 2 * 2**20
"""The largest payload of theirs, bytes."""


@asynccontextmanager
async def linked_pair(port: int) -> AsyncIterator[tuple[Session, Session]]:
    """Two linked peers."""
    endpoint = f"tcp/127.0.0.1:{port}"
    limits = {"max_payload_bytes": LIMIT, "max_record_bytes": 2**20}
    one = await Session.open(PlaneConfig(listen=(endpoint,), **limits), "f")
    other = await Session.open(PlaneConfig(connect=(endpoint,), **limits), "f")
    await until(lambda: one.linked and other.linked)
    yield one, other
    await one.close()
    await other.close()


async def heard(speaker: Session, listener: Session) -> None:
    """Wait until the speaker's puts reach the listener's subscriptions."""
    came = asyncio.Event()
    closer = listener.subscribe("swiftbot/f/probe", lambda _: came.set())
    while not came.is_set():
        speaker.put("swiftbot/f/probe", b"")
        await asyncio.sleep(0.01)
    closer.close()
