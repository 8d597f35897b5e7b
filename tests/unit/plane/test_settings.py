"""The plane's configuration."""

import pytest

from appliance.errors import ConfigError
from appliance.plane.settings import PlaneConfig


def test_the_defaults_are_valid() -> None:
    """An empty configuration works."""
    PlaneConfig().check()


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (PlaneConfig(listen=("127.0.0.1:7447",)), "plane.listen"),
        (PlaneConfig(listen=("tcp/127.0.0.1",)), "no valid port"),
        (PlaneConfig(connect=("tcp/host:99999",)), "no valid port"),
        (PlaneConfig(connect=("http/host:80",)), "plane.connect"),
        (PlaneConfig(mode="client"), "plane.connect is empty"),
        (PlaneConfig(listen=("tcp/h:1",), peers={"gw-1": "h:1"}), "plane.peers: 'h:1' is not an endpoint"),
        (PlaneConfig(listen=("tcp/h:1",), peers={"gw/1": "tcp/h:1"}), "plane.peers"),
        (PlaneConfig(listen=("tcp/h:1",), peers={"a": "tcp/h:1", "b": "tcp/h:1"}), "an endpoint twice"),
        (PlaneConfig(peers={"a": "tcp/h:1"}), "plane.listen is empty"),
        (PlaneConfig(listen=("tcp/h:1",), peers={"a": "tcp/0.0.0.0:1"}), "nothing that can be dialled"),
        (PlaneConfig(listen=("tcp/h:1",), peers={"a": "tcp/[::]:1"}), "nothing that can be dialled"),
        (PlaneConfig(listen=("tcp/h:1",), peers={"a": "tcp/h:0"}), "nothing that can be dialled"),
        (
            PlaneConfig(listen=("tcp/h:1",), connect=("tcp/i:1",), peers={"a": "tcp/h:1", "b": "tcp/i:1"}),
            "plane.connect names tcp/i:1, which b has in plane.peers",
        ),
        (PlaneConfig(mode="client", connect=("tcp/h:1",), peers={"a": "tcp/h:1"}), "plane.mode is client"),
        (PlaneConfig(mode="client", connect=("tcp/h:1",), listen=("tcp/h:2",)), "accepts no links"),
        (PlaneConfig(replicas=0), "plane.replicas"),
        (PlaneConfig(lease_ms=1), "plane.lease_ms"),
        (PlaneConfig(max_record_bytes=8 * 2**20), "max_record_bytes"),
    ],
)
def test_what_cannot_work_is_named(config: PlaneConfig, says: str) -> None:
    """A setting that cannot work is an error that names it, with a remedy."""
    with pytest.raises(ConfigError, match=says) as caught:
        config.check()
    assert caught.value.remedy


def test_a_table_may_have_endpoints_without_ports() -> None:
    """A socket in the file system is dialled by its path."""
    listen = "unixsock-stream//run/swiftbot/a.sock"
    PlaneConfig(listen=(listen,), peers={"a": listen, "b": "unixsock-stream//run/swiftbot/b.sock"}).check()


def test_a_gateway_is_in_its_own_table() -> None:
    """Otherwise it and the others would decide by different names which of two dials."""
    config = PlaneConfig(listen=("tcp/h:1",), peers={"gw-1": "tcp/h:1", "gw-2": "tcp/i:1"})
    config.check_own("gw-1")
    PlaneConfig().check_own("gw-1")
    with pytest.raises(ConfigError, match="lacks this gateway, berth-1; it has gw-1, gw-2") as caught:
        config.check_own("berth-1")
    assert caught.value.remedy
