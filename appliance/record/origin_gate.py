"""Lets only some web pages at a WebSocket server on this machine.

A browser lets every page connect to every port of the loopback, and says in `Origin` which page it is. The live view's
server (foxglove-sdk) does not look at that. So it listens behind this gate, on a port of its own with TLS and a
certificate that no browser trusts: no page gets past the gate, and programs could connect to either.
"""

import asyncio
import contextlib
import ssl
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from urllib.parse import urlsplit

import structlog
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from msgspec import Struct

from appliance.errors import ConfigError

log = structlog.get_logger(__name__)

LOOPBACK = ("127.0.0.1", "::1", "localhost")
MOST_HEAD = 16 * 1024
"""Bytes of a request's head."""
HEAD_S = 5.0
"""How long a client may take for it."""
MOST_CLIENTS = 64
_PART = 64 * 1024
_DAY = timedelta(days=1)


class Certificate(Struct, frozen=True):
    """A certificate that nobody else trusts, and its private key; PEM, and DER to know it by."""

    pem: bytes
    key: bytes
    der: bytes


def make_certificate() -> Certificate:
    """Make one for this process; it is kept nowhere."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "live view")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - _DAY)
        .not_valid_after(now + 3650 * _DAY)
        .sign(key, hashes.SHA256())
    )
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return Certificate(
        made.public_bytes(serialization.Encoding.PEM), text, made.public_bytes(serialization.Encoding.DER)
    )


def check_origin(origin: str) -> str:
    """Return an origin as a browser writes it; ConfigError where it is none, such as `null` or one with a path."""
    parts = urlsplit(origin)
    if not parts.scheme or not parts.netloc or origin != f"{parts.scheme}://{parts.netloc}":
        raise ConfigError(
            f"{origin[:100]!r} is no origin of a page", remedy="give scheme and host, such as https://app.foxglove.dev"
        )
    return origin.lower()


def admits(head: bytes, origins: Sequence[str]) -> str:
    """Why a request does not get through; empty when it does.

    A program sends no origin. A page does, always: one of this machine gets through, or one that is named.

    Args:
        head: of the request, up to the empty line.
        origins: of pages that get through, lower case.
    """
    headers: dict[str, list[str]] = {}
    for line in head.decode("latin-1").split("\r\n")[1:]:
        name, _, value = line.partition(":")
        headers.setdefault(name.strip().lower(), []).append(value.strip().lower())
    if headers.get("upgrade") != ["websocket"]:
        return "only WebSocket clients are served"
    found = headers.get("origin", [])
    if not found:
        return ""
    origin = found[0]
    local = urlsplit(origin).hostname in LOOPBACK if origin.startswith(("http://", "https://")) else False
    if len(found) > 1 or not (local or origin in origins):
        return f"pages of {origin[:100]} are not served"
    return ""


class Gate:
    """A gate on the loopback; `start` and `close` it.

    Args:
        inner: the port of the server behind it, on 127.0.0.1.
        certificate: the server's.
        origins: of pages that get through besides those of this machine.
    """

    def __init__(self, inner: int, certificate: Certificate, origins: Sequence[str]) -> None:
        self.refused: Counter[str] = Counter()
        """Requests that did not get through, by reason."""
        self._inner, self._certificate = inner, certificate
        self._origins = tuple(map(check_origin, origins))
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        self._context.check_hostname = False
        self._context.verify_mode = ssl.CERT_NONE  # it is compared instead
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()

    async def start(self, host: str, port: int) -> int:
        """Listen; returns the port. ConfigError where it cannot be listened on."""
        try:
            self._server = await asyncio.start_server(self._take, host, port, limit=MOST_HEAD)
        except OSError as error:
            raise ConfigError(
                f"the live view cannot listen on {host}:{port}: {error}", remedy="choose another --port"
            ) from error
        return int(self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Listen no more, and let the clients go."""
        if self._server is not None:
            self._server.close()
        for task in tuple(self._clients):
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)

    async def _take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - asyncio makes one for each client
        self._clients.add(task)
        try:
            await self._serve(reader, writer)
        except (OSError, TimeoutError, EOFError, asyncio.LimitOverrunError, asyncio.CancelledError) as error:
            # The client is gone, is none of HTTP, or the view is closed.
            log.debug("a client is gone", reason=str(error))
        finally:
            self._clients.discard(task)
            writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async with asyncio.timeout(HEAD_S):
            head = await reader.readuntil(b"\r\n\r\n")
        why = admits(head, self._origins) or ("too many clients" if len(self._clients) > MOST_CLIENTS else "")
        if why:
            self.refused[why if len(self.refused) < MOST_CLIENTS else "others"] += 1
            log.warning("not served", reason=why, remedy="`swiftbot foxglove --origin ORIGIN` serves pages of another")
            text = f"{why}\n".encode()
            writer.write(
                b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: %d\r\n\r\n" % len(text) + text
            )
            await writer.drain()
            return
        inner, outer = await asyncio.open_connection("127.0.0.1", self._inner, ssl=self._context)
        try:
            channel = outer.get_extra_info("ssl_object")
            if channel is None or channel.getpeercert(binary_form=True) != self._certificate.der:
                raise OSError("another server has taken the view's port")
            outer.write(head)
            ways = [asyncio.create_task(_pump(reader, outer)), asyncio.create_task(_pump(inner, writer))]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            outer.close()


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    """Hand bytes on until either end is gone; a slow end slows the other down."""
    with contextlib.suppress(OSError):
        while data := await source.read(_PART):
            sink.write(data)
            await sink.drain()
