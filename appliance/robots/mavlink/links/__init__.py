"""MAVLink links: UDP and TCP, listening and connecting, behind one door.

`open_link` makes the link that a setting names. Frames are checked and counted in it, once, before anybody acts on
them: what is damaged, of an unknown dialect or signed is counted by kind and dropped, and the stream goes on. Who a
frame is from is for the caller to judge.
"""

from collections.abc import Callable

from appliance.robots.mavlink.dialect import Codec, Frame
from appliance.robots.mavlink.links.base import Address, Link
from appliance.robots.mavlink.links.tcp import TcpClient, TcpServer
from appliance.robots.mavlink.links.udp import UdpClient, UdpServer
from appliance.robots.settings import Remote

__all__ = ["Address", "Link", "open_link"]

_KINDS: dict[tuple[str, bool], type[Link]] = {
    ("udp", True): UdpServer,
    ("udp", False): UdpClient,
    ("tcp", True): TcpServer,
    ("tcp", False): TcpClient,
}


async def open_link(
    remote: Remote,
    codec: Codec,
    on_frame: Callable[[Frame, Address], None],
    refused: dict[str, int] | None = None,
) -> Link:
    """Open the link that a setting names.

    Args:
        remote: scheme, host and port, and whether to listen there or to connect.
        codec: decoder and encoder of this link alone.
        on_frame: told each good frame and who sent it, on the event loop.
        refused: counters of bad input by kind.

    Raises:
        ConfigError: the port to listen on is taken or not this machine's. A link that connects does not raise: it
            tries for as long as it is open.
    """
    link = _KINDS[remote.scheme, remote.listens](remote, codec, on_frame, refused)
    await link.open()
    return link
