"""Questions that have to be signed: what becomes of those whose signature cannot be verified."""

import asyncio
from typing import cast
from unittest.mock import MagicMock

import pytest

from appliance.errors import IdentityError, SwiftbotError
from appliance.model import keyspace
from appliance.plane.session import Answering, Doors, Served, Wire

pytestmark = pytest.mark.anyio


async def answered(problem: Exception, *, urgent: bool) -> tuple[bytes | None, SwiftbotError | None]:
    """Have a question answered whose verification raises this; returns the answer and the error."""
    wire = MagicMock(loop=asyncio.get_running_loop())
    wire.config.max_payload_bytes = 1000
    wire.config.concurrent_queries = 2
    wire.credentials.verify.side_effect = problem
    answering = Answering(cast("Wire", wire), cast("Doors", MagicMock()))
    said: asyncio.Future[tuple[bytes | None, SwiftbotError | None]] = asyncio.get_running_loop().create_future()

    async def handler(_: str, payload: bytes) -> bytes:
        return b"done " + payload

    def reply(answer: bytes | None, error: SwiftbotError | None) -> None:
        said.set_result((answer, error))

    served = Served(answering, "k", handler, signers=keyspace.STOPPING, urgent=urgent)
    answering.begin(served, "k", b"it", reply, b"signature")
    async with asyncio.timeout(10):
        return await said


@pytest.mark.parametrize("problem", [IdentityError("revoked"), ValueError("a defect")])
async def test_a_stop_is_carried_out_whatever_its_signature_comes_to(problem: Exception) -> None:
    """Any other signed question is refused."""
    assert await answered(problem, urgent=True) == (b"done it", None)
    answer, error = await answered(problem, urgent=False)
    assert answer is None
    assert error is not None
