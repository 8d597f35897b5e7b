"""Opening a Zenoh session as configured, and the forms of its answers and errors: the library's rough edges.

Split from `session` so that what is particular to the library's version stands in one place.
"""
# pyright: reportUnknownMemberType=false
# The library's stubs leave out the return types of methods that return nothing.

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import structlog
import zenoh

from appliance.errors import ConfigError, DeadlineError, SwiftbotError, UnreachableError, from_code
from appliance.model import ErrorReply, encode
from appliance.plane import dialling
from appliance.plane.settings import PlaneConfig

log = structlog.get_logger(__name__)

T = TypeVar("T")

_WIRE_HEADROOM = 8
"""Zenoh itself drops messages of more than so many times the largest payload, before they are whole in memory."""


def open_raw(config: PlaneConfig, gateway: str = "") -> zenoh.Session:
    """Open a session, that of a gateway where it is named; blocks. Errors as `Session.open`."""
    try:
        return zenoh.open(_zenoh_config(config, gateway))
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


def mark(key: str, *, direct: bool) -> bytes:
    """The attachment of a question: for which key it is."""
    return (MARK if direct else b"") + key.encode()


def read_mark(query: zenoh.Query) -> tuple[bool, bytes]:
    """Whether a question is direct, and the key it is for; empty where it does not say."""
    raw = query.attachment.to_bytes() if query.attachment is not None else b""
    return raw.startswith(MARK), raw.removeprefix(MARK)


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


def _zenoh_config(config: PlaneConfig, gateway: str) -> zenoh.Config:
    """Zenoh's own configuration; design/platform has the measurements behind it."""
    client = config.mode == "client"
    settings: dict[str, Any] = {
        "mode": config.mode,
        "listen/endpoints": list(config.listen),
        "listen/exit_on_failure": True,
        "listen/timeout_ms": 0,
        "connect/endpoints": [*config.connect, *dialling.dialled(gateway, config.peers)],
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
        # holds up whoever sends one for so long at most, in microseconds.
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
        settings["id"] = dialling.session_id(gateway, naming=bool(config.connect) and not table)
        # Nobody can dial a peer that does not listen: that one dials all.
        settings["scouting/gossip/autoconnect_strategy"] = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
        if table:
            # Gossip names addresses where the table may have host names: a gateway would dial by both, and, linked by
            # one, be refused by the other again and again for as long as the link lives.
            settings["scouting/gossip/autoconnect"] = {"router": [], "peer": [], "client": []}
    made = zenoh.Config()
    for key, value in settings.items():
        made.insert_json5(key, msgspec.json.encode(value).decode())
    return made


def _open_error(config: PlaneConfig, text: str) -> SwiftbotError:
    for endpoint in config.listen:
        if f"bound to {endpoint}" in text or endpoint in text:
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
        return UnreachableError(
            f"nothing answers at {', '.join(config.connect)}",
            remedy="start a gateway (`swiftbot gateway`), or name the endpoint of one with --connect",
        )
    return ConfigError(
        f"the Zenoh session cannot be opened: {_first(text)}", remedy="check plane.listen, plane.connect, plane.peers"
    )


def _first(text: str) -> str:
    """The message without the library's source locations."""
    return text.partition(" at /")[0].replace(str(Path.home()), "~")
