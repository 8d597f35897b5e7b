"""The running fleet in Foxglove: what the recorder would write is served live, on the same channels.

Foxglove connects to a WebSocket server (its protocol is `foxglove.sdk.v1`; the server is the `foxglove-sdk` package, an
optional extra). Channels, schemas and derived messages are those of a log, by the same code, and secrets are taken out
as they are there. A slow client loses its oldest messages (the SDK's bounded backlog); the fleet never waits for it.
Pages of other sites are not served (`origin_gate`).
"""

import asyncio
import contextlib
import time
from collections import OrderedDict
from collections.abc import AsyncGenerator, Callable
from typing import Any

import structlog
from msgspec import Struct

from appliance.errors import ConfigError, PrerequisiteError
from appliance.model import keyspace
from appliance.plane.session import Closer, Session
from appliance.plane.settings import PlaneConfig
from appliance.record.channels import shared_for
from appliance.record.models import LoggedMessage, check_expression, compile_expression
from appliance.record.origin_gate import LOOPBACK, Gate, check_origin, make_certificate
from appliance.record.redact import Redactor
from appliance.record.schemas import ChannelKind, Derive, Foxglove, KeySchemas
from appliance.record.segments import JSON, LAST_NS, About

log = structlog.get_logger(__name__)

PORT = 8765
"""Foxglove's own default."""
NAME = "live"
"""In the place of a recorder's name, in the keys of derived messages."""
MOST_CHANNELS = 10_000
"""Beyond, the channel that was silent for longest is closed. Keys that nobody wants
count as well."""
BACKLOG = 1024
"""Messages that wait for one client; the oldest are dropped."""


class LiveOptions(Struct, frozen=True, kw_only=True):
    """Where the server listens."""

    host: str = "127.0.0.1"
    """Loopback: Foxglove's protocol knows no password. From elsewhere: an SSH tunnel."""
    port: int = PORT
    """0: any that is free."""
    origins: tuple[str, ...] = ()
    """Of web pages that are served besides those of this machine, such as https://app.foxglove.dev."""
    keys: tuple[str, ...] = ()
    """Key expressions; only keys that one of them includes. None: all."""

    def check(self) -> None:
        """Raise ConfigError for what cannot be."""
        if self.host not in LOOPBACK:
            raise ConfigError(
                f"--host {self.host[:60]!r}: every client that connects sees everything, without a password",
                remedy="listen on 127.0.0.1, and reach it through `ssh -L 8765:127.0.0.1:8765`",
            )
        for each in self.keys:
            check_expression(each)
        for each in self.origins:
            check_origin(each)
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--port {self.port}", remedy="give 0 (any) to 65535")


class _Channel:
    """A channel of the server, and what is made of its messages."""

    def __init__(self, base: Any, derive: Derive | None) -> None:
        self.base = base
        self.derive = derive


class LiveView:
    """Serves one fleet's messages to programs of this machine, over TLS; `viewing` puts a gate before it for pages.

    Args:
        session: on the fleet's plane.
        options: where it listens.
        about: site and secrets, as a recorder has them.

    Raises:
        PrerequisiteError: foxglove-sdk is not installed.
        ConfigError: it cannot listen.
    """

    def __init__(self, session: Session, options: LiveOptions, *, about: About | None = None) -> None:
        options.check()
        about = about or About()
        self._session = session
        self._foxglove = _sdk()
        self._context = self._foxglove.Context()
        self._schemas = KeySchemas(session.keys)
        self._views = Foxglove(session.keys, NAME, site=about.site)
        self._redactor = Redactor(about.secrets)
        keys = session.keys
        self._raw = tuple(
            map(compile_expression, (keys(keyspace.MAVLINK), keys(keyspace.LINK_FRAMES), keys(keyspace.CAMERA)))
        )
        self._wanted = [compile_expression(each) for each in options.keys]
        self._channels: OrderedDict[tuple[str, str], _Channel | None] = OrderedDict()
        """By key and encoding, the one that was silent for longest first; None: not wanted."""
        self._subscription: Closer | None = None
        self.messages = 0
        self.certificate = make_certificate()
        try:
            self._server: Any = self._foxglove.start_server(
                name=f"SwiftBot {session.keys.fleet}",
                host="127.0.0.1",
                port=0,
                tls_cert=self.certificate.pem,
                tls_key=self.certificate.key,
                context=self._context,
                message_backlog_size=BACKLOG,
                supported_encodings=["json"],
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise ConfigError(f"the live view cannot listen: {error}", remedy="see that the loopback is up") from error

    @property
    def port(self) -> int:
        """The port it listens on, behind the gate."""
        return int(self._server.port)

    @property
    def channels(self) -> int:
        """Channels offered."""
        return sum(each is not None for each in self._channels.values())

    def start(self) -> None:
        """Begin to hear the fleet. Blocks shortly."""
        self._subscription = self._session.flood(self._session.keys.everything, LoggedMessage, self._take)

    def stop(self) -> None:
        """Hear no more, and let the clients go. Blocks shortly."""
        if self._subscription is not None:
            self._subscription.close()
            self._subscription = None
        self._server.stop()

    def _take(self, messages: list[LoggedMessage]) -> None:
        for message in messages:
            self._show(message)

    def _show(self, message: LoggedMessage) -> None:
        if message.deleted:
            return
        shared = shared_for(message.key, message.payload) if message.encoding == JSON else None
        if shared is not None and not self._is_wanted(message.key):
            return
        which = (message.key if shared is None else shared.topic, message.encoding)
        if which in self._channels:
            channel = self._channels[which]
            self._channels.move_to_end(which)
        else:
            channel = self._open(which, message.key)
        if channel is None:
            return
        at_ns = message.at_ns if 0 < message.at_ns <= LAST_NS else time.time_ns()
        if channel.base.has_sinks() or channel.derive is not None:
            raw = any(each.fullmatch(message.key) for each in self._raw)
            clean = self._redactor.text(message.payload) if raw else self._redactor.json(message.payload)
            if clean is not message.payload:
                message = LoggedMessage(message.key, message.at_ns, clean, message.encoding)
            channel.base.log(clean, log_time=at_ns)
            self.messages += 1
            for made in channel.derive(message) if channel.derive else ():
                topic = (made.topic, JSON)
                other = self._channels.get(topic) or self._made(topic, made.kind, None)
                self._channels.move_to_end(topic)
                other.base.log(made.payload, log_time=at_ns)

    def _is_wanted(self, key: str) -> bool:
        return not self._wanted or any(each.fullmatch(key) for each in self._wanted)

    def _open(self, which: tuple[str, str], key: str) -> _Channel | None:
        if not self._is_wanted(key):
            self._make_room()
            self._channels[which] = None
            return None
        return self._made(which, self._schemas.kind_of(key, which[1]), self._views.deriving(key))

    def _make_room(self) -> None:
        while len(self._channels) >= MOST_CHANNELS:
            _, silent = self._channels.popitem(last=False)
            if silent is not None:
                silent.base.close()

    def _made(self, which: tuple[str, str], kind: ChannelKind, derive: Derive | None) -> _Channel:
        self._make_room()
        encoding = "jsonschema" if kind.schema else ""
        schema = self._foxglove.Schema(name=kind.schema, encoding=encoding, data=kind.schema_text)
        base = self._foxglove.Channel(
            which[0],
            schema=schema,
            message_encoding=kind.encoding,
            context=self._context,
            metadata={"encoding": which[1], **dict(kind.metadata)},
        )
        channel = self._channels[which] = _Channel(base, derive)
        return channel


def _sdk() -> Any:
    try:
        import foxglove  # noqa: PLC0415 - an optional extra, and 19 MB
    except ImportError as error:
        raise PrerequisiteError(
            "the live view needs the package foxglove-sdk",
            remedy="install the extra `foxglove`, as pinned in locks/foxglove.txt",
        ) from error
    return foxglove


@contextlib.asynccontextmanager
async def viewing(
    session: Session, options: LiveOptions, *, about: About | None = None
) -> AsyncGenerator[tuple[LiveView, Gate, int]]:
    """Serve a fleet's messages behind a gate; gives the view, the gate and the port that clients connect to.

    Raises:
        PrerequisiteError, ConfigError: as `LiveView`; the port cannot be listened on.
    """
    view = LiveView(session, options, about=about)
    gate = Gate(view.port, view.certificate, options.origins)
    try:
        port = await gate.start(options.host, options.port)
        await asyncio.to_thread(view.start)
        yield view, gate, port
    finally:
        await gate.close()
        await asyncio.to_thread(view.stop)


async def serve(
    options: LiveOptions,
    plane: PlaneConfig,
    fleet: str,
    stop: asyncio.Event,
    *,
    about: About | None = None,
    told: Callable[[LiveView], None] = lambda _view: None,
) -> int:
    """Serve the live view until `stop` is set; returns how many messages were shown.

    Args:
        options: where it listens.
        plane: how to reach the fleet.
        fleet: its name.
        stop: ends it.
        about: site and secrets.
        told: called with the view when it listens, and then every second.

    Raises:
        PrerequisiteError, ConfigError: as `LiveView`.
        UnreachableError: the network could not be joined.
    """
    session = await Session.open(plane, fleet)
    try:
        async with viewing(session, options, about=about) as (view, _, port):
            log.info("live view", address=f"ws://{options.host}:{port}", fleet=fleet)
            while not stop.is_set():
                told(view)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(1.0):
                        await stop.wait()
        return view.messages
    finally:
        await session.close()
