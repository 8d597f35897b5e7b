"""The measurement of MAVLink through the gateway, with a short generated log and real processes."""

from pathlib import Path

import pytest

from appliance.bench.mavlink import tlog
from appliance.bench.mavlink.run import Options, find_mavp2p, run
from appliance.errors import ConfigError, PrerequisiteError

pytestmark = pytest.mark.anyio


async def test_a_log_through_the_router() -> None:
    """Every frame comes out at the other side and stands in the recorder's file, byte for byte; commands are paired."""
    options = Options(frames=1500, rounds=1, real_s=1.0, mavp2p="none", profile=False)
    result = await run(options, progress=lambda _: None)
    assert result["commands"] == {"sent": 6, "acknowledged": 6}
    for part in ("real_time", "full_speed", "full_speed_recorded"):
        found = result[part]
        assert found["byte_for_byte"], found
        assert found["delivered"] + found["repetitions_left_out"] == found["to_be_delivered"], found
    for part in ("real_time", "full_speed_recorded"):
        assert result[part]["recorded"]["byte_for_byte"], result[part]


def test_logs_that_are_none(tmp_path: Path) -> None:
    """A log that is missing or is none, and a router that is not there, are errors with a remedy."""
    with pytest.raises(ConfigError, match="cannot be read") as told:
        tlog.read(tmp_path / "none.tlog")
    assert told.value.remedy
    for data in (b"", b"no log at all, and long enough", b"\0" * 8 + b"\xfd\xff\0"):
        (tmp_path / "some.tlog").write_bytes(data)
        with pytest.raises(ConfigError):
            tlog.read(tmp_path / "some.tlog")
    with pytest.raises(PrerequisiteError, match="mavp2p") as missing:
        find_mavp2p(str(tmp_path / "mavp2p"))
    assert "go install" in missing.value.remedy
