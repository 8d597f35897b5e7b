"""Every TCP socket of the process gets the time limit, however it came about; other sockets are left alone."""

import socket

from appliance.plane.sockets import SocketWatch


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


def test_a_reset_breaks_connections_and_leaves_listening() -> None:
    """Both ends see the end of their connection, the listening socket goes on; soon after there is no second reset."""
    watch = SocketWatch(1500)
    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as caller, server.accept()[0] as accepted:
            watch.look()
            assert watch.reset() >= 2
            assert caller.recv(1) == accepted.recv(1) == b""
            assert watch.reset() == 0
        with socket.create_connection(server.getsockname()) as caller, server.accept()[0] as accepted:
            caller.sendall(b"x")
            assert accepted.recv(1) == b"x"
