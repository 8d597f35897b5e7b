"""The measurement of MAVLink through the gateway, with a short generated log and real processes."""

from pathlib import Path

import pytest

from appliance.errors import ConfigError, PrerequisiteError
from workshop.bench.mavlink import others, tlog
from workshop.bench.mavlink.run import Options, run

pytestmark = pytest.mark.anyio


@pytest.mark.long
async def test_a_log_through_the_router() -> None:
    """Every frame comes out at the other side and stands in the recorder's file, byte for byte; commands are paired."""
    options = Options(frames=1500, rounds=1, real_s=1.0, beside="mavproxy", profile=False)
    result = await run(options, progress=lambda _: None)
    assert result["commands"] == {"sent": 6, "acknowledged": 6}
    for part in ("real_time", "full_speed", "full_speed_recorded"):
        found = result[part]
        assert found["byte_for_byte"], found
        assert found["delivered"] + found["repetitions_left_out"] == found["to_be_delivered"], found
    # MAVProxy takes the vehicle's frames for its own, too, and says something of its own: what it delivers is printed.
    assert result["beside"]["mavproxy"]["delivered"] > 0
    assert result["beside"]["mavproxy"]["ours_to_its"] > 0
    for part in ("real_time", "full_speed_recorded"):
        assert result[part]["recorded"]["byte_for_byte"], result[part]


def test_logs_that_are_none(tmp_path: Path) -> None:
    """A log that is missing or is none is an error with a remedy."""
    with pytest.raises(ConfigError, match="cannot be read") as told:
        tlog.read(tmp_path / "none.tlog")
    assert told.value.remedy
    for data in (b"", b"no log at all, and long enough", b"\0" * 8 + b"\xfd\xff\0"):
        (tmp_path / "some.tlog").write_bytes(data)
        with pytest.raises(ConfigError):
            tlog.read(tmp_path / "some.tlog")


def test_routers_of_others_are_named_or_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is named and not there is an error with a remedy, and so is no router's name; `auto` tells who lacks."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(others.sys, "executable", str(tmp_path / "python"))
    with pytest.raises(PrerequisiteError, match="mavp2p") as missing:
        others.find("mavp2p")
    assert "go install" in missing.value.remedy
    with pytest.raises(ConfigError, match="no router 'mavp3p'"):
        others.find("mavp3p")
    assert others.find("none") == ([], {})
    found, lacking = others.find("auto")
    assert (found, set(lacking)) == ([], {"mavp2p", "mavrouter", "mavproxy"})
    (tmp_path / "mavrouter").write_text("#!/bin/sh\n")
    (tmp_path / "mavrouter").chmod(0o755)
    (there,), lacking = others.find("auto")
    assert (there.other.name, set(lacking)) == ("mavrouter", {"mavp2p", "mavproxy"})
