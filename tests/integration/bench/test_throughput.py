"""The throughput benchmark, in short: subtasks end, the profile is taken, a killed worker's subtask ends elsewhere."""

import pytest

from workshop.bench.throughput.run import Options, run

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(300), pytest.mark.long]


async def test_throughput_and_recovery(built: None) -> None:
    """Two gateways: what is counted has succeeded, each gateway tells its profile, a killed container is survived."""
    options = Options(gateways=2, containers=2, parallel=(1, 4), seconds=2.0, kills=1, ray=False)
    result = await run(options, progress=print)
    assert set(result["throughput"]) == {"1", "4"}
    assert all(each["subtasks_per_s"] > 0 for each in result["throughput"].values())
    assert result["recovery"]["count"] == 1
    assert set(result["profile"]) == {"gw-1", "gw-2"}
    assert all(each["with_callees"] for each in result["profile"].values())
