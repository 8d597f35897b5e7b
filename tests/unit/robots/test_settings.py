"""Settings of the robots room."""

import pytest

from appliance.errors import ConfigError
from appliance.model.robot_api import MavlinkLink, read_remote
from appliance.robots.settings import RobotsConfig


@pytest.mark.parametrize("url", ["", "127.0.0.1:14550", "http://a:1", "udp://a", "udp://a:99999", "udp://a:1/x"])
def test_addresses_that_are_none(url: str) -> None:
    """Anything but udp:// or tcp://host:port is a ConfigError that says how to write it."""
    with pytest.raises(ConfigError, match="udp://host:port or tcp://host:port"):
        read_remote(url, listens=True)


def test_names_of_systems() -> None:
    """A system is called as configured, else by prefix and number, else it is not accepted."""
    link = MavlinkLink(names={"3": "survey_1"})
    assert link.name_of(3) == "survey_1"
    assert link.name_of(4) == "drone_4"
    assert MavlinkLink(prefix="").name_of(4) is None


@pytest.mark.parametrize(
    "config",
    [
        RobotsConfig(mavlink=(MavlinkLink(), MavlinkLink())),
        RobotsConfig(mavlink=(MavlinkLink(names={"0": "a"}),)),
        RobotsConfig(mavlink=(MavlinkLink(names={"x": "a"}),)),
        RobotsConfig(mavlink=(MavlinkLink(names={"1": "Not A Name"}),)),
        RobotsConfig(mavlink=(MavlinkLink(prefix="Drone "),)),
        RobotsConfig(mavlink=(MavlinkLink(), MavlinkLink(listen="udp://127.0.0.1:14550"))),
        RobotsConfig(mavlink=(MavlinkLink(listen="tcp://127.0.0.1:1", connect="tcp://127.0.0.1:2"),)),
        RobotsConfig(mavlink=(MavlinkLink(mavlink1=True, signing="/some/key"),)),
        RobotsConfig(system_id=0),
    ],
)
def test_settings_that_cannot_be(config: RobotsConfig) -> None:
    """Double ports, impossible system ids and names are ConfigErrors."""
    with pytest.raises(ConfigError):
        config.check()


def test_the_defaults_are_fine() -> None:
    """No link and the usual link are both accepted."""
    RobotsConfig().check()
    RobotsConfig(mavlink=(MavlinkLink(),)).check()
