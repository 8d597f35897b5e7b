"""`swiftbot doctor` on the machine that runs the tests."""

from pathlib import Path

import msgspec
import pytest

from appliance.config import GatewayConfig
from appliance.doctor import run_checks
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.record.settings import RecordConfig

pytestmark = pytest.mark.anyio


@pytest.mark.podman
async def test_a_machine_that_was_set_up_passes(tmp_path: Path, free_port: int) -> None:
    """After setup every required check passes here, a started container and an open session among them."""
    config = GatewayConfig(
        id="gw-doctor",
        data_dir=str(tmp_path / "data"),
        plane=PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port}",)),
        record=RecordConfig(directory=str(tmp_path / "log")),
    )
    checks = await run_checks(config)
    wrong = [f"{each.name}: {each.detail}" for each in checks if each.required and not each.ok]
    assert wrong == []
    names = {each.name for each in checks}
    assert {"podman api", "storage", "container", "zenoh", f"port {free_port}"} <= names


async def test_an_absent_socket_is_told_with_its_remedy(tmp_path: Path) -> None:
    """A Podman socket that is not there fails the check, with the way to start it."""
    pool = PoolConfig(podman_url=f"unix://{tmp_path}/none.sock")
    checks = await run_checks(msgspec.structs.replace(GatewayConfig(id="gw-doctor"), pool=pool))
    found = next(each for each in checks if each.name == "podman api")
    assert not found.ok
    assert f"{tmp_path}/none.sock" in found.detail
    assert "podman.socket" in found.remedy
