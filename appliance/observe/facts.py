"""What metrics are made of: a gateway's account of itself at one moment."""

from msgspec import Struct

from appliance.model import ContainerInfo, GatewayStatus
from appliance.model.alerts import Alert
from appliance.model.robot_api import LinkFacts


class Facts(Struct, frozen=True, kw_only=True):
    """As the gateway knows it; read on its event loop, and never changed."""

    status: GatewayStatus
    containers: tuple[ContainerInfo, ...] = ()
    """Of its pool."""
    alerts: tuple[Alert, ...] = ()
    """Those whose records are this gateway's: over all gateways each alert counts once."""
    links: tuple[LinkFacts, ...] = ()
    """MAVLink links."""
    robots: dict[str, bool] = {}
    """Robots of the fleet that it knows, and whether each is online."""
    gateways: int = 1
    """Members of the fleet that it sees, itself included."""
    tasks: dict[str, int] = {}
    """Unfinished tasks that it coordinates, by the state that people see."""
    ended: dict[str, int] = {}
    """Tasks that ended under its coordination since it started, by final state."""
