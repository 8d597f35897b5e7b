"""The Zenoh client for robots: what it makes of records that are none."""

import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.robots.zenoh_client import ZenohTaskClient


class Wire:
    """A session on which every subscriber hears the same payloads at once."""

    def __init__(self, *payloads: bytes) -> None:
        self.payloads = payloads

    def declare_subscriber(self, key: str, take: Callable[[Any], None]) -> Any:
        """Deliver."""
        del key
        for each in self.payloads:
            take(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda each=each: each)))
        return SimpleNamespace(undeclare=lambda: None)


@pytest.mark.parametrize("noise", [b"", b"[]", b"{", b"{}", b"null", b"\xff", b"[" * 100_000])
def test_following_skips_what_is_no_record(noise: bytes) -> None:
    """Malformed and empty payloads between a task's records are passed over; old ones are not told again."""
    records = [
        json.dumps({"sequence": number, "state": state}).encode()
        for number, state in ((1, "running"), (2, "succeeded"))
    ]
    wire: Any = Wire(noise, records[0], noise, records[0], records[1])
    client = ZenohTaskClient(wire, fleet="f", robot="r")
    assert [each["sequence"] for each in client.follow("t", timeout_s=30)] == [1, 2]
