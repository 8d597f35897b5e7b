"""What holds the orders of a gateway's tasks and operators to their limits, made of its configuration."""

from collections.abc import Callable, Mapping

from appliance.config import GatewayConfig
from appliance.llm.checks.policy import strictest
from appliance.model import RobotInfo, Site
from appliance.robots.limits import Bounds, Orders, Usual


def orders_of(config: GatewayConfig, site: Site, *, roster: Callable[[], Mapping[str, RobotInfo]]) -> Orders:
    """Return it; `roster` gives the robots as they are known when an order is given."""
    robots, limits = config.robots, config.safety.limits

    def configured(robot: str) -> Bounds:
        return Bounds(
            whose=f"the limits of {robot} in [safety]",
            speed_mps=strictest(limits, robot, "speed_mps"),
            altitude_m=strictest(limits, robot, "altitude_m"),
        )

    def vehicles(flies: bool) -> Usual:
        return Usual(speed_mps=robots.cruise_mps if flies else robots.drive_mps, takeoff_m=robots.takeoff_altitude_m)

    return Orders(site, roster=roster, configured=configured, vehicles=vehicles)
