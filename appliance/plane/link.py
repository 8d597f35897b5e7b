"""The links of a Zenoh session: how it is opened, which side dials, when a socket is given up.

`open_raw` opens a session as configured; `callback`, `reply` and the functions of errors are the forms that its
callbacks, answers and errors have. What Zenoh 1.10 does not do right, or has no setting for, is worked round here:

**Which of two gateways dials.** Where each dials the other there are two links, one made by either side, and both carry
one Zenoh transport. When one side stands still for a lease the other closes both and starts over; the one that runs
again notices the ends of its two links one after the other, and in between takes the new link for a further one of the
old transport. From then on the two mean different keys by the same numbers (zenoh issue 1886): questions arrive at
wrong doors or nowhere, for as long as that link lives. In a fleet of eight with two links between each pair some
gateway did not answer another after fourteen of 23 standstills; with one link between each pair all did after each of
72 (docs/benchmarks.md). With one link this cannot happen: Zenoh takes one incoming link of a transport and no more, so
that a new dial is refused until the old link's end has been noticed, and with that link the old transport is
gone.

So each gateway has a rank, and the higher one dials. A gateway that is named in the others' `plane.peers` has a rank by
its name; one that only names others (`plane.connect`) is above all of those. One with a table dials by nothing else.
Those without go by Zenoh's gossip too, in the same order: of two that hear of each other the one with the greater
session id dials, and the id ends with the rank. (Zenoh compares ids from their last byte on.)

**When a socket is given up.** When a link breaks while its send buffer is full, Zenoh waits for the kernel to give the
socket up before it forgets what it knew of the other side; by default that takes the kernel a quarter of an hour. If
the two meet again before, one side goes on with what it knew and the other starts over, with the same end. With
TCP_USER_TIMEOUT (tcp(7)), which `SocketWatch` sets from outside, the kernel gives up after the lease, when Zenoh takes
the other side for dead as well.
"""
# pyright: reportUnknownMemberType=false

import asyncio
import base64
import contextlib
import ipaddress
import os
import secrets
import socket
import stat
import time
from collections.abc import Callable, Mapping, Set
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar, cast
from urllib.parse import urlsplit

import msgspec
import structlog
import zenoh

from appliance.errors import ConfigError, DeadlineError, SwiftbotError, UnreachableError, from_code
from appliance.model import ErrorReply, encode
from appliance.plane.settings import AUTHENTICATED, PlaneConfig

if TYPE_CHECKING:
    from appliance.identity.credentials import Credentials

_RANK_BYTES = 4
_ID_BYTES = 16
_NAMED, _NAMING = 0x20, 0xE0
"""First byte of the rank, the class: of those that others name, and of those that only name others."""


def rank(gateway: str) -> bytes:
    """The rank of a gateway; by hash, which two tables agree on that have not all names in common."""
    return bytes([_NAMED]) + blake2b(gateway.encode(), digest_size=_RANK_BYTES - 1).digest()


def dialled(gateway: str, peers: Mapping[str, str]) -> tuple[str, ...]:
    """The endpoints of `peers` (name to endpoint, a gateway's own perhaps among them) that a gateway dials."""
    own = (rank(gateway), gateway)
    return tuple(endpoint for name, endpoint in peers.items() if (rank(name), name) < own)


def session_id(gateway: str, *, naming: bool) -> str:
    """A new session id, 32 hexadecimal digits; `naming`: it only names others. An unnamed peer's rank is any."""
    last = rank(gateway or secrets.token_hex(4))
    if naming:
        last = bytes([_NAMING]) + last[1:]
    # Zenoh takes no id whose first digit is a zero.
    first = bytes([secrets.randbelow(0xF0) + 0x10]) + secrets.token_bytes(_ID_BYTES - _RANK_BYTES - 1)
    return (first + last[::-1]).hex()


SOCKETS_EVERY_S = 0.5
"""How often new sockets are looked for, half a lease: a link that hangs at once is let go before it is missed. A look
takes 0.1 to 0.3 ms."""

CALM_S = 10.0
"""Least time before a link is broken again: where once does not help, a second time at once would only do harm."""

Address = tuple[str, int]
"""IP address and port."""


class SocketWatch:
    """Sets the time limit on every TCP socket of this process. `lease_ms`: after which unacknowledged data ends it."""

    _running: ClassVar[dict[asyncio.AbstractEventLoop, "SocketWatch"]] = {}
    """One for all sessions of a loop: each look is at the sockets of the whole process."""

    def __init__(self, lease_ms: int) -> None:
        self._users = 0
        self._lease_ms = lease_ms
        self._known: dict[int, int] = {}
        """Descriptor -> inode of the sockets that have been looked at."""
        self._task: asyncio.Task[None] | None = None

    @classmethod
    def shared(cls, lease_ms: int) -> "SocketWatch":
        """The watch of the running loop's sessions, the shortest lease of theirs; each closes it when it ends."""
        loop = asyncio.get_running_loop()
        watch = cls._running.get(loop)
        if watch is None:
            watch = cls._running[loop] = cls(lease_ms)
            watch._task = asyncio.create_task(watch._keep_looking(), name="socket watch")
        elif lease_ms < watch._lease_ms:
            watch._lease_ms, watch._known = lease_ms, {}
        watch._users += 1
        # Also at listening sockets, from which accepted ones inherit it.
        with contextlib.suppress(OSError):
            watch.look()
        return watch

    async def _keep_looking(self) -> None:
        while True:
            await asyncio.sleep(SOCKETS_EVERY_S)
            with contextlib.suppress(OSError):  # no descriptor is left to list them with: next time
                self.look()

    def look(self) -> int:
        """Set it on the sockets that are new; returns on how many."""
        found: dict[int, int] = {}
        changed = 0
        for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names are all that is wanted
            number = int(name)
            try:
                about = os.fstat(number)
            except OSError:  # closed meanwhile
                continue
            if not stat.S_ISSOCK(about.st_mode):
                continue
            found[number] = about.st_ino
            if self._known.get(number) != about.st_ino:
                changed += self._set(number)
        self._known = found
        return changed

    def _set(self, number: int) -> bool:
        handle = _taken(number)
        if handle is None:
            return False
        with handle:
            if handle.family not in (socket.AF_INET, socket.AF_INET6) or handle.type != socket.SOCK_STREAM:
                return False
            try:
                handle.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, self._lease_ms)
            except OSError:
                return False
        return True

    def shut(self, ends: Set[tuple[Address, Address]]) -> int:
        """Break the TCP connections with these (local, remote) ends and no others; returns how many.

        Zenoh reopens its links at once.
        """
        with contextlib.suppress(OSError):
            self.look()
        broken = 0
        for number in self._known:
            handle = _taken(number)
            if handle is None:
                continue
            with contextlib.suppress(OSError), handle:
                if handle.family not in (socket.AF_INET, socket.AF_INET6) or handle.type != socket.SOCK_STREAM:
                    continue
                # A listening socket has no other end: the question for it raises.
                if (_address(handle.getsockname()), _address(handle.getpeername())) in ends:
                    handle.shutdown(socket.SHUT_RDWR)
                    broken += 1
        return broken

    def close(self) -> None:
        """One session less; look no more once there is none."""
        self._users -= 1
        if self._users == 0 and self._task is not None:
            self._task.cancel()
            self._running.pop(self._task.get_loop(), None)


def _taken(number: int) -> socket.socket | None:
    """A descriptor's socket, by a copy of the descriptor; None when it is none any more.

    Zenoh's threads close sockets at any time, and the number may be a file's by now.
    """
    try:
        copy = os.dup(number)
    except OSError:
        return None
    try:
        return socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        return None


def address_of(locator: str) -> Address | None:
    """The address in a Zenoh locator such as `tcp/127.0.0.1:7447`; None for one that is no address."""
    try:
        parts = urlsplit(f"//{locator.partition('/')[2].partition('?')[0].partition('#')[0]}")
        return None if parts.hostname is None or parts.port is None else _address((parts.hostname, parts.port))
    except ValueError:
        return None


def _address(name: Any) -> Address:
    """A socket's name as an address; IPv4 in an IPv6 socket is IPv4. ValueError when it is none."""
    host = ipaddress.ip_address(str(name[0]).partition("%")[0])
    mapped = host.ipv4_mapped if isinstance(host, ipaddress.IPv6Address) else None
    return str(mapped or host), int(name[1])


# The library's stubs leave out the return types of methods that return nothing.


log = structlog.get_logger(__name__)

T = TypeVar("T")

_WIRE_HEADROOM = 8
"""Zenoh itself drops messages of more than so many times the largest payload, before they are whole in memory."""


def open_raw(config: PlaneConfig, gateway: str = "", credentials: "Credentials | None" = None) -> zenoh.Session:
    """Open a session, that of a gateway where it is named; blocks. Errors as `Session.open`."""
    try:
        return zenoh.open(_zenoh_config(config, gateway, credentials))
    except zenoh.ZError as error:
        raise _open_error(config, str(error)) from error


def callback(take: Callable[[T], None], *, drop: Callable[[], object] | None = None) -> "zenoh.handlers.Callback[T]":
    """A callback that Zenoh calls where it reads, without a thread between: it must only hand over."""
    return zenoh.handlers.Callback(take, drop=drop, indirect=False)


def reply(
    query: zenoh.Query, expr: str, answer: bytes | None, error: SwiftbotError | None, *, bulk: bool = False
) -> None:
    """Answer and end a query; the asking side may be gone, which is no concern of ours. `bulk`: raw bytes."""
    key = str(query.key_expr) if "*" in expr else expr
    with contextlib.suppress(zenoh.ZError), query:
        if error is not None or answer is None:
            query.reply_err(error_body(error or SwiftbotError("no answer")), encoding="application/json")
        elif bulk:
            query.reply(key, answer, encoding="application/octet-stream")
        else:
            query.reply(key, answer, encoding="application/json", express=True)


def error_body(error: SwiftbotError) -> bytes:
    """An error as it is sent."""
    problems = cast("tuple[str, ...]", getattr(error, "problems", ()))
    return encode(
        ErrorReply(
            code=error.code,
            message=error.message,
            remedy=error.remedy,
            problems=problems,
            retry_after_s=error.retry_after_s,
        )
    )


MARK = b"direct "
"""Before the key in the attachment of a direct question: it is dropped rather than waited for when a link is full, and
so is its answer (Zenoh gives an answer the question's congestion control), so that both may be sent from any thread."""
MOST_DIRECT = 32 * 1024
"""Larger messages are sent in fragments, and one that is dropped loses all."""


MOST_ERROR = 65_536
"""Bytes that are read of an error."""
WRONG_DOOR = "the question is not for this"
NOBODY_REMEDY = "is that gateway or robot up and linked?"


SIGNED = b"\0"
"""Between the key in an attachment and the signature: no key has such a byte."""


class Mark(NamedTuple):
    """What a question says of itself in its attachment."""

    direct: bool
    meant: bytes
    """The key it is for; empty where it does not say."""
    signature: bytes
    """Who asks (`identity.signing`); empty where it is not signed."""


def mark(key: str, *, direct: bool, signature: bytes = b"") -> bytes:
    """The attachment of a question: for which key it is, and by whom."""
    return (MARK if direct else b"") + key.encode() + (SIGNED + signature if signature else b"")


def read_mark(query: zenoh.Query) -> Mark:
    """What a question says of itself."""
    raw = query.attachment.to_bytes() if query.attachment is not None else b""
    meant, _, signature = raw.removeprefix(MARK).partition(SIGNED)
    return Mark(raw.startswith(MARK), meant, signature)


def asker_of(query: zenoh.Query) -> str:
    """The session that a question says it is of; "" where it does not say."""
    source = query.source_info
    return str(source.source_id.zid) if source is not None else ""


def reply_direct(query: zenoh.Query, expr: str, answer: bytes | None, error: SwiftbotError | None) -> None:
    """Answer a direct question, on whatever thread; an answer too large for it is empty: ask the other way."""
    reply(query, expr, b"" if answer is not None and len(answer) > MOST_DIRECT else answer, error)


def quietly(send: Callable[[], None], key: str) -> None:
    """Send; a failure (the session is closing, the key is no key) is logged."""
    try:
        send()
    except zenoh.ZError as error:
        not_sent(key, error)


def not_sent(key: str, error: zenoh.ZError) -> None:
    """Log that something could not be sent."""
    log.warning("not sent", key=key, reason=str(error))


def error_of(error: zenoh.ReplyError | None) -> SwiftbotError:
    """Rebuild the error that the answering side raised."""
    return error_from(error.payload.to_bytes()[:MOST_ERROR] if error is not None else b"")


def error_from(text: bytes) -> SwiftbotError:
    """Rebuild an error from what was sent."""
    if text == b"Timeout":  # Zenoh's own way of saying so
        return DeadlineError("no answer in time")
    try:
        body = msgspec.json.decode(text, type=ErrorReply)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return SwiftbotError(f"answered with an error that cannot be read: {text[:200]!r}")
    rebuilt = from_code(body.code, body.message, body.remedy, body.retry_after_s)
    if body.problems and hasattr(rebuilt, "problems"):
        rebuilt.problems = body.problems  # pyright: ignore[reportAttributeAccessIssue]
    return rebuilt


def read_credentials(config: PlaneConfig, fleet: str, kept: Path | None = None) -> "Credentials | None":
    """The keys of a process as configured, None without; blocks. IdentityError where they are not good."""
    if not config.keys:
        return None
    # Imported by those that have keys only: it takes 60 ms.
    from appliance.identity.credentials import Credentials  # noqa: PLC0415

    keys = Path(config.keys).expanduser()
    return Credentials.load(keys, config.roster_file, fleet=fleet, now=time.time(), kept=kept)


def _security(config: PlaneConfig, credentials: "Credentials") -> dict[str, Any]:
    """Zenoh's settings for links on which both sides prove who they are, and are held to their roles."""
    from appliance.identity import access  # noqa: PLC0415 - as above

    opened = credentials.open()
    bundle, fleet = opened.bundle, credentials.identity.fleet
    made = (
        access.rules(fleet, robots=opened.robots, barred=opened.barred)
        if config.listen
        else access.dialling_rules(fleet)
    )
    # Not the file: it may be another's by the time that Zenoh reads it, and each certificate in a file of authorities
    # is taken for one.
    key, certificate, authority = (base64.b64encode(each).decode() for each in bundle.parts())
    return {
        "transport/link/protocols": sorted(AUTHENTICATED),
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/root_ca_certificate_base64": authority,
        "transport/link/tls/listen_certificate_base64": certificate,
        "transport/link/tls/listen_private_key_base64": key,
        "transport/link/tls/connect_certificate_base64": certificate,
        "transport/link/tls/connect_private_key_base64": key,
        "transport/link/tls/verify_name_on_connect": True,
        "transport/link/tls/close_link_on_expiration": True,
        "access_control": access.zenoh_settings(made),
    }


def _zenoh_config(config: PlaneConfig, gateway: str, credentials: "Credentials | None" = None) -> zenoh.Config:
    """Zenoh's own configuration; design/platform has the measurements behind it."""
    client = config.mode == "client"
    settings: dict[str, Any] = {
        "mode": config.mode,
        "listen/endpoints": list(config.listen),
        "listen/exit_on_failure": True,
        "listen/timeout_ms": 0,
        "connect/endpoints": [*config.connect, *dialled(gateway, config.peers)],
        # Peers look for each other for ever in the background, so gateways may start in any order.
        "connect/timeout_ms": int(config.connect_timeout_s * 1e3) if client else -1,
        "connect/exit_on_failure": client,
        # One that is restarted waits to be dialled by those above it, and a recorder misses what it says meanwhile: so
        # each pause is 5 ms and a fiftieth of the time that it has been away, up to 0.2 s. (An attempt that nothing
        # answers at all, as when its machine was off, takes up to `open_timeout` besides.)
        "connect/retry": {
            "period_init_ms": 50 if client else 5,
            "period_max_ms": 1000 if client else 200,
            "period_increase_factor": 1.5 if client else 1.02,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "scouting/delay": 0,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": config.lease_ms,
        "transport/link/tx/keep_alive": 4,
        # A peer that takes nothing for a lease is as good as dead: its link is closed and the sender goes on.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": config.lease_ms * 1000,
        # Direct questions and their answers have a priority of their own, and room for a burst of them; a full link
        # holds up the one that sends one for so long at most, in microseconds.
        "transport/link/tx/queue/size/data_high": 16,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 20_000,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": config.lease_ms * 1000,
        # Zenoh's own 1,000 is less than a large fleet with its robots and clients on one router.
        "transport/unicast/max_sessions": 10_000 if config.mode == "router" else 1000,
        "transport/link/rx/max_message_size": config.max_payload_bytes * _WIRE_HEADROOM,
        "transport/unicast/open_timeout": 3000,
        "transport/unicast/accept_timeout": 3000,
    }
    if config.mode == "peer" and config.listen:
        table = bool(set(config.peers) - {gateway})
        settings["id"] = session_id(gateway, naming=bool(config.connect) and not table)
        # Nobody can dial a peer that does not listen: that one dials all.
        settings["scouting/gossip/autoconnect_strategy"] = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
        if table:
            # Gossip names addresses where the table may have host names: a gateway would dial by both, and, linked by
            # one, be refused by the other again and again for as long as the link lives.
            settings["scouting/gossip/autoconnect"] = {"router": [], "peer": [], "client": []}
    if credentials is not None:
        settings |= _security(config, credentials)
    made = zenoh.Config()
    for key, value in settings.items():
        made.insert_json5(key, msgspec.json.encode(value).decode())
    return made


def _open_error(config: PlaneConfig, text: str) -> SwiftbotError:
    for endpoint in config.listen:
        if endpoint.partition("/")[2] in text:
            if "in use" in text:
                return ConfigError(
                    f"cannot listen on {endpoint}: the port is in use",
                    remedy="another gateway may be running; stop it (`swiftbot down`) or change plane.listen",
                )
            if "assign requested address" in text:
                return ConfigError(
                    f"cannot listen on {endpoint}: this machine has no such address",
                    remedy="set plane.listen to an address of this machine, or 0.0.0.0",
                )
            if "ermission denied" in text:
                return ConfigError(f"cannot listen on {endpoint}: not permitted", remedy="use a port above 1023")
            return ConfigError(f"cannot listen on {endpoint}: {_first(text)}", remedy="correct plane.listen")
    if config.mode == "client":
        remedy = "start a gateway (`swiftbot gateway`), or name the endpoint of one with --connect"
        if config.keys:
            remedy += "; that gateway's certificate must name the host that is dialled (`swiftbot keys show FILE`)"
        elif any(each.partition("/")[0] == "tcp" for each in config.connect):
            remedy += "; one with keys answers on tls/ and asks for yours (--keys)"
        return UnreachableError(f"nothing answers at {', '.join(config.connect)}", remedy=remedy)
    return ConfigError(
        f"the Zenoh session cannot be opened: {_first(text)}", remedy="check plane.listen, plane.connect, plane.peers"
    )


def _first(text: str) -> str:
    """The message without the library's source locations."""
    return text.partition(" at /")[0].replace(str(Path.home()), "~")
