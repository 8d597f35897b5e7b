"""Every TCP socket of the process gets the time limit, however it came about; other sockets are left alone."""

import os
import socket
from pathlib import Path

import pytest

from appliance.plane.link import SocketWatch, address_of


def limit(handle: socket.socket) -> int:
    """Return the limit of a socket, milliseconds; 0 is the kernel's own."""
    return handle.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)


def test_new_tcp_sockets_get_the_limit_once() -> None:
    """Connected, accepted and listening sockets have it; what is accepted later inherits it; then there is no more."""
    watch = SocketWatch(1500)
    watch.look()
    one, other = socket.socketpair()
    with one, other, socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as caller, server.accept()[0] as accepted:
            assert limit(caller) == 0
            assert watch.look() == 3
            assert {limit(each) for each in (server, caller, accepted)} == {1500}
            assert watch.look() == 0
        with socket.create_connection(server.getsockname()) as caller, server.accept()[0] as accepted:
            assert limit(accepted) == 1500
            watch.look()
            assert limit(caller) == 1500


def test_only_the_connections_with_the_named_ends_are_broken() -> None:
    """Both ends of the one that is named see its end; others of the same process, and what listens, go on."""
    watch = SocketWatch(1500)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = server.getsockname()
        with (
            socket.create_connection(address) as caller,
            server.accept()[0] as accepted,
            socket.create_connection(address) as vehicle,
            server.accept()[0] as other_end,
        ):
            assert watch.shut(set()) == 0
            assert watch.shut({(caller.getsockname(), address)}) == 1
            assert caller.recv(1) == accepted.recv(1) == b""
            vehicle.sendall(b"x")
            assert other_end.recv(1) == b"x"
        with socket.create_connection(address) as caller, server.accept()[0] as accepted:
            caller.sendall(b"y")
            assert accepted.recv(1) == b"y"


@pytest.mark.anyio
async def test_sessions_share_a_watch() -> None:
    """All of a loop have one, with the shortest lease of theirs, until the last has ended."""
    one = SocketWatch.shared(1500)
    with socket.create_server(("127.0.0.1", 0)) as server:
        other = SocketWatch.shared(800)
        assert other is one
        assert limit(server) == 800
        other.close()
        assert SocketWatch.shared(2000) is one
    one.close()
    one.close()
    another = SocketWatch.shared(1500)
    assert another is not one
    another.close()


def test_ends_are_read_from_locators() -> None:
    """IPv4, IPv6 and IPv4 in IPv6 are written as sockets write them; what is no address is none."""
    assert address_of("tcp/127.0.0.1:7447") == ("127.0.0.1", 7447)
    assert address_of("tls/127.0.0.1:7447?rel=1#iface=lo") == ("127.0.0.1", 7447)
    assert address_of("tcp/[::1]:80") == ("::1", 80)
    assert address_of("tcp/[::ffff:10.0.0.1]:80") == ("10.0.0.1", 80)
    for wrong in ("", "tcp", "tcp/127.0.0.1", "unixsock-stream//run/x.sock", "tcp/host:1", "tcp/[::1"):
        assert address_of(wrong) is None


def test_a_number_that_is_a_file_by_now_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A socket that another thread closes between two looks at its number, which a file has then, harms nobody."""
    watch = SocketWatch(1500)
    with (tmp_path / "file").open("wb") as file, socket.create_server(("127.0.0.1", 0)) as server:
        real = os.dup
        before = len(list(Path("/proc/self/fd").iterdir()))
        monkeypatch.setattr(os, "dup", lambda number: real(file.fileno() if number == server.fileno() else number))
        watch.look()
        watch.shut({(("127.0.0.1", 1), ("127.0.0.1", 2))})
        assert len(list(Path("/proc/self/fd").iterdir())) == before
