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
        (PlaneConfig(mode="client", connect=("tcp/h:1",), peers={"a": "tcp/h:1"}), "plane.mode is client"),
        (PlaneConfig(mode="client", connect=("tcp/h:1",), listen=("tcp/h:2",)), "accepts no links"),
        (PlaneConfig(view=5), "plane.view is 5"),
        (PlaneConfig(view=16, replicas=5), "plane.view is 16"),
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
