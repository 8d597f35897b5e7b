"""Ports for processes that are about to start."""

import socket
from pathlib import Path

import pytest

from appliance import ports
from appliance.ports import free_port


def test_no_port_is_given_twice_or_is_one_that_an_outgoing_connection_may_get() -> None:
    """Each of many is another, and below those that the kernel hands out by itself."""
    first_ephemeral = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    given = [free_port() for _ in range(200)]
    assert len(set(given)) == len(given)
    assert max(given) < first_ephemeral


@pytest.mark.parametrize("kind", [socket.SOCK_STREAM, socket.SOCK_DGRAM])
def test_a_port_that_is_taken_is_not_given(kind: socket.SocketKind, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where all but one port of the range are in use, it is that one."""
    with socket.socket(socket.AF_INET, kind) as taken:
        wanted = [free_port(kind), free_port(kind)]
        taken.bind(("127.0.0.1", wanted[0]))
        ports._given.difference_update((kind, each) for each in wanted)
        drawn = iter(wanted)
        monkeypatch.setattr(ports.random, "randrange", lambda *_: next(drawn))
        assert free_port(kind) == wanted[1]


def test_where_no_range_is_left_for_them_the_kernel_picks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing below the ports of outgoing connections, or no telling: a free one all the same."""
    told = tmp_path / "range"
    for text in ("1024\t65535\n", "", "no numbers"):
        told.write_text(text)
        monkeypatch.setattr(ports, "_EPHEMERAL", told)
        assert free_port() > 0
    monkeypatch.setattr(ports, "_EPHEMERAL", tmp_path / "missing")
    assert free_port() > 0
