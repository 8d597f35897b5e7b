"""Section `[floor]` of the configuration."""

import math

from msgspec import Struct, field

from appliance.errors import ConfigError


class SizeConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Section `[floor.robots.NAME]`: the size of one robot, instead of what it says of itself."""

    radius_m: float
    """Of the circle on the ground that holds it and what it carries, metres."""
    height_m: float = 2.0
    """Metres."""


class FloorConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keeps the robots that runs move apart: the same at every gateway. Needs `plane.voters`."""

    enabled: bool = True
    """Reserve places and ways. Without `plane.voters` nothing is reserved, and the gateway's status says so."""
    radius_m: float = 0.4
    """Of a robot that drives or walks and says nothing of its size, metres."""
    drone_radius_m: float = 0.5
    """The same of one that flies."""
    margin_m: float = 0.15
    """What the position of a robot on the ground, and how it follows a way, may be off, metres."""
    drone_margin_m: float = 0.5
    """The same of one that flies."""
    robots: dict[str, SizeConfig] = field(default_factory=dict[str, SizeConfig])
    """Sizes of single robots, by name."""
    wait_s: float = 300.0
    """A command waits so long for a place or a way, then it fails with the reason."""
    tell_decisions: bool = True
    """Put each way that is reserved, each new reason to wait and each grant with all that it rested on, so that
    `swiftbot log check` can make it again: some 10 kB for each stretch of a way, more with many robots."""

    def check(self) -> None:
        """Raise ConfigError for sizes and times that cannot be."""
        sizes = {
            "radius_m": self.radius_m,
            "drone_radius_m": self.drone_radius_m,
            **{f"robots.{name}.radius_m": each.radius_m for name, each in self.robots.items()},
            **{f"robots.{name}.height_m": each.height_m for name, each in self.robots.items()},
        }
        for key, value in sizes.items():
            if not (math.isfinite(value) and 0.0 < value <= 20.0):
                raise ConfigError(f"floor.{key} = {value:g}", remedy="more than 0, at most 20 m")
        for key, value in (("margin_m", self.margin_m), ("drone_margin_m", self.drone_margin_m)):
            if not (math.isfinite(value) and 0.0 <= value <= 20.0):
                raise ConfigError(f"floor.{key} = {value:g}", remedy="0 to 20 m")
        if not (math.isfinite(self.wait_s) and self.wait_s > 0.0):
            raise ConfigError(f"floor.wait_s = {self.wait_s:g}", remedy="more than 0 s")
