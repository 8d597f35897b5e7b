"""Replicas that are too slow for a write: told once a minute, and offered the record again."""

from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog

from appliance.errors import DeadlineError, UnreachableError
from appliance.plane import dht
from appliance.plane.dht import Pushing, Record
from appliance.plane.settings import PlaneConfig

pytestmark = pytest.mark.anyio


async def test_thousands_of_slow_writes_are_one_warning_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first at once, then how many each replica had since; one that is gone is none."""
    now = 100.0
    monkeypatch.setattr(dht, "time", SimpleNamespace(monotonic=lambda: now))
    nothing = cast("Any", None)
    pushing = Pushing(
        PlaneConfig(), gateway="gw-1", store=nothing, rpc=nothing, membership=nothing, keep=cast("Any", nothing)
    )
    record = Record(key="task/t-1", value=b"{}", version={"gw-1": 1})
    with structlog.testing.capture_logs() as logs:
        for number in range(4000):
            pushing.failed(f"gw-{2 + number % 2}", record, DeadlineError("no answer within 0.3 s"))
            pushing.failed("gw-4", record, UnreachableError("gone"))
            now += 0.02
        now += 60.0
        pushing.failed("gw-2", record, DeadlineError("no answer within 0.3 s"))
    await pushing.close()
    told = [each["writes"] for each in logs if each["event"] == "replicas are slow"]
    assert told[0] == {"gw-2": 1}
    assert len(told) == 3
    assert sum(sum(each.values()) for each in told) == 4001
