"""The product under failure, in short: gateways are killed and stopped while tasks with counted effects run."""

from pathlib import Path

import pytest

from workshop.bench.chaos.run import Options, run

pytestmark = [pytest.mark.anyio, pytest.mark.podman, pytest.mark.timeout(600), pytest.mark.long]


async def test_nothing_is_lost_or_doubled_while_gateways_are_killed(built: None, tmp_path: Path) -> None:
    """Four gateways, of which up to two are down at once: every accepted task succeeds, each effect is there once."""
    options = Options(gateways=4, tasks=20, seconds=40.0, every_s=3.0, seed=7, keep=str(tmp_path / "chaos"))
    result = await run(options, progress=print)
    assert result["broken"] == [], result
    assert result["decisions"]["diverged"] == 0, result
    assert set(result["decisions"]["checked"]) >= {"machine", "record", "placement"}, "and there were some"
    assert result["tasks"]["accepted"] == result["tasks"]["states"]["succeeded"] == 20
    assert result["effects"]["lines"] == result["effects"]["wanted"]
    assert result["downtime"]["outages"]["kill"] >= 3
    assert result["downtime"]["most_down_at_once"] <= 2
