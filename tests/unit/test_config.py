"""Configuration files: strict, complete in the documentation, the same when written and read again."""

import subprocess
import sys
from pathlib import Path

import pytest

from appliance import config
from appliance.config import GatewayConfig
from appliance.errors import ConfigError
from appliance.model.robot_api import MavlinkLink
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.robots.settings import RobotsConfig
from appliance.tasks.settings import BatteryConfig, TasksConfig


def write(path: Path, text: str) -> Path:
    """Write a file and return its path."""
    path.write_text(text)
    return path


def test_only_the_id_must_be_given(tmp_path: Path) -> None:
    """Everything else has a default."""
    assert config.load(write(tmp_path / "g.toml", 'id = "gw-1"\n')) == GatewayConfig(id="gw-1")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('id = "gw-1"\nfleat = "x"', "fleat"),
        ('id = "gw-1"\n[pool]\ncapacity = "many"', "pool.capacity"),
        ('id = "gw-1"\n[plane]\nlissen = []', "lissen"),
        ('id = "GW 1"', "GW 1"),
        ('id = "gw-1"\nlog_level = "loud"', "loud"),
        ("id = ", "not TOML"),
        ("", "id"),
        ('id = "gw-1"\n[[robots.mavlink]]\nlisten = "tcp://x"', "tcp://x"),
    ],
)
def test_a_mistake_names_file_and_key(tmp_path: Path, text: str, named: str) -> None:
    """An unknown key, wrong type or impossible value is an error with exit code 2, not a silent default."""
    path = write(tmp_path / "g.toml", text)
    with pytest.raises(ConfigError) as caught:
        config.load(path)
    assert named in str(caught.value)
    assert str(path) in str(caught.value)
    assert caught.value.exit_code == 2


def test_an_absent_file_is_an_error_with_a_remedy(tmp_path: Path) -> None:
    """The message says which file, and what to do."""
    with pytest.raises(ConfigError, match=r"absent\.toml") as caught:
        config.load(tmp_path / "absent.toml")
    assert caught.value.remedy


def test_what_is_written_reads_back_the_same(tmp_path: Path) -> None:
    """`dump` writes what differs from the defaults, as TOML that `load` takes."""
    made = GatewayConfig(
        id="gw-7",
        fleet="yard",
        data_dir='/tmp/with "quotes" and \\ backslash',
        skills=("/a", "/b"),
        plane=PlaneConfig(
            listen=("tls/127.0.0.1:7447",),
            keys="/etc/keys.pem",
            peers={"gw-7": "tls/10.0.0.7:7447", "gw-8.west": "tls/10.0.0.8:7447"},
        ),
        pool=PoolConfig(floor={"base": 3}, mode="local"),
        robots=RobotsConfig(mavlink=(MavlinkLink(names={"1": "drone_1"}),)),
    )
    assert config.load(write(tmp_path / "g.toml", config.dump(made))) == made


def test_endpoints_are_this_gateways_and_the_others_each_once() -> None:
    """A recorder dials what the gateway listens on, what it names, and the others of its table."""
    made = GatewayConfig(
        id="gw-7",
        plane=PlaneConfig(
            listen=("tcp/0.0.0.0:7447",),
            connect=("tcp/10.0.0.1:7447",),
            peers={"gw-7": "tcp/10.0.0.7:7447", "gw-8": "tcp/10.0.0.8:7447"},
        ),
    )
    assert made.endpoints() == ("tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "tcp/10.0.0.8:7447")
    assert GatewayConfig(id="gw-7").endpoints() == ()


def test_a_wrong_table_of_gateways_is_told_with_the_file(tmp_path: Path) -> None:
    """The message names file and key, before anything is started."""
    path = write(tmp_path / "g.toml", 'id = "gw-7"\n[plane]\nlisten = ["tcp/h:1"]\npeers = {gw-8 = "tcp/h:1"}\n')
    with pytest.raises(ConfigError, match=r"g\.toml: plane\.peers lacks this gateway, gw-7"):
        config.load(path)


def test_the_documentation_lists_every_key(project_root: Path) -> None:
    """docs/configuration.md is what the sources say; `scripts/write_configuration.py` makes it."""
    done = subprocess.run(
        [sys.executable, str(project_root / "scripts" / "write_configuration.py"), "--check"], check=False
    )
    assert done.returncode == 0, "run scripts/write_configuration.py"


def test_with_keys_mavlink_links_that_others_reach_are_signed(tmp_path: Path) -> None:
    """A file that leaves one open is refused with the link's address; the same without keys is not."""
    keys = '[plane]\nkeys = "/etc/swiftbot/keys/gateway-gw-1.pem"\n'
    robots = '[robots]\nmavlink = [{ listen = "udp://0.0.0.0:14550" }]\n'
    with pytest.raises(ConfigError, match=r"udp://0.0.0.0:14550 is not signed"):
        config.load(write(tmp_path / "g.toml", f'id = "gw-1"\n{keys}{robots}'))
    config.load(write(tmp_path / "g.toml", f'id = "gw-1"\n{robots}'))


@pytest.mark.parametrize(
    ("battery", "voters", "problem"),
    [
        (BatteryConfig(auto_charge=True), (), "not reserved"),
        (BatteryConfig(auto_charge=True, reserve_percent=0.0), ("gw-1",), "a reserve of 0 %"),
        (BatteryConfig(auto_charge=True, charged_percent=20.0), ("gw-1",), "charged at 20 %"),
    ],
)
def test_robots_charge_by_themselves_only_where_the_floor_is_reserved(
    battery: BatteryConfig, voters: tuple[str, ...], problem: str
) -> None:
    """And from a reserve up to a charge above it; with voters and the usual figures all is well."""
    made = GatewayConfig(id="gw-1", plane=PlaneConfig(voters=voters), tasks=TasksConfig(battery=battery))
    with pytest.raises(ConfigError, match=problem):
        config.check(made, "gateway.toml")
    tasks = TasksConfig(battery=BatteryConfig(auto_charge=True))
    config.check(GatewayConfig(id="gw-1", plane=PlaneConfig(voters=("gw-1",)), tasks=tasks), "gateway.toml")
