"""Loopback ports for processes that are about to start on this machine.

Not those that the kernel picks when asked for any: from the same range it gives every outgoing connection its port, and
sixteen gateways that connect to each other make more than a hundred of those while the last still wait to listen.
"""

import random
import socket
from pathlib import Path

_LOWEST = 15_000
"""Below it are the ports that robots' autopilots and ground stations are used to (14540, 14550)."""
_TRIES = 1000
_EPHEMERAL = Path("/proc/sys/net/ipv4/ip_local_port_range")
_given: set[tuple[socket.SocketKind, int]] = set()


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A free loopback port for a process that will listen there; in one process never the same twice."""
    below = _first_ephemeral()
    for _ in range(_TRIES if below > _LOWEST else 0):
        port = random.randrange(_LOWEST, below)  # noqa: S311 - spreads ports
        if (kind, port) not in _given and _bind(kind, port):
            _given.add((kind, port))
            return port
    return _bind(kind, 0)


def _first_ephemeral() -> int:
    try:
        return int(_EPHEMERAL.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return 0


def _bind(kind: socket.SocketKind, port: int) -> int:
    """The port, if it could be had (0: any); else 0."""
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return 0
        return int(probe.getsockname()[1])
