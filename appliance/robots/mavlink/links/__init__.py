"""MAVLink links: UDP and TCP, listening and connecting, and serial ports, behind one door.

`open_link` makes the link that a setting names. Frames are checked and counted in it, once, before anybody acts on
them: what is damaged, of an unknown dialect or signed is counted by kind and dropped, and the stream goes on. Who a
frame is from is for the caller to judge.
"""

from collections.abc import Callable

from appliance.robots.mavlink.address import Address
from appliance.robots.mavlink.dialect import Codec, Frame
from appliance.robots.mavlink.links.base import Link
from appliance.robots.mavlink.links.serial import SerialLink
from appliance.robots.mavlink.links.tcp import TcpClient, TcpServer
from appliance.robots.mavlink.links.udp import UdpClient, UdpServer
from appliance.robots.settings import Remote

__all__ = ["Address", "Link", "open_link"]

_KINDS: dict[tuple[str, bool], type[Link]] = {
    ("udp", True): UdpServer,
    ("udp", False): UdpClient,
    ("tcp", True): TcpServer,
    ("tcp", False): TcpClient,
    ("serial", False): SerialLink,
}


async def open_link(
    remote: Remote,
    codec: Codec,
    on_frame: Callable[[Frame, Address], None],
    refused: dict[str, int] | None = None,
    *,
    limit_hz: float = 0.0,
    busy: Callable[[], bool] = lambda: False,
) -> Link:
    """Open the link that a setting names.

    Args:
        remote: scheme, host and port, and whether to listen there or to connect.
        codec: decoder and encoder of this link alone.
        on_frame: told each good frame and who sent it, on the event loop.
        refused: counters of bad input by kind.
        limit_hz: most frames a second from one end: more of a datagram link are dropped and counted as `flood`, of a
            stream they are read later. 0 for no limit.
        busy: whether no more can be taken just now; streams are then read later.

    Raises:
        ConfigError: the port to listen on is taken or not this machine's. A link that connects does not raise: it
            tries for as long as it is open.
    """
    link = _KINDS[remote.scheme, remote.listens](remote, codec, on_frame, refused, limit_hz=limit_hz, busy=busy)
    await link.open()
    return link
