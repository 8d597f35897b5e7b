"""What gateways tell each other of themselves and of others when they are asked: the verb `facts`."""

from msgspec import Struct

from appliance.model import ContainerInfo, GatewayStatus, RobotInfo


class FactsAsk(Struct, frozen=True, omit_defaults=True):
    """`facts`: what do you know? `all`: of the other gateways too, of those whose ids come after `after`."""

    all: bool = False
    after: str = ""


class Known(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a gateway knows of another, and how old that is."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    age_ms: int = 0


class Facts(Struct, frozen=True, omit_defaults=True):
    """A gateway's own facts, the robots it knows of, and, if asked, what it knows of other gateways."""

    gateway: str
    status: GatewayStatus | None = None
    containers: tuple[ContainerInfo, ...] = ()
    robots: tuple[RobotInfo, ...] = ()
    others: tuple[Known, ...] = ()
    more: bool = False
    """There are further others."""
