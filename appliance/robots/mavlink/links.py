"""MAVLink links: UDP and TCP, listening and connecting, and serial ports, behind one door.

`open_link` makes the link that a setting names. Frames are checked and counted in it, once, before anybody acts on
them: what is damaged, of an unknown dialect or signed is counted by kind and dropped, and the stream goes on. Who a
frame is from is for the caller to judge.

UDP: a datagram holds whole frames. TCP: a stream, in which a frame may come in pieces. Serial: a stream without ends,
whose device may be unplugged and plugged in again; the port is set up by POSIX terminal settings (termios): eight bits,
no parity, one stop bit, no flow control, nothing translated, which is what flight controllers and telemetry radios
speak.

Statistics (pure, the clock passed in): loss is counted by sequence numbers, which each sender (system and component)
raises by one for every frame, wrapping after 255 (MAVLink guide, "Packet Loss"). What comes late was not lost after
all. Latency is the time of a TIMESYNC there and back (guide, "Time Synchronization Protocol").
"""

import abc
import asyncio
import contextlib
import math
import os
import socket
import termios
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any, Protocol, cast

import structlog
from msgspec import Struct

from appliance.errors import ConfigError
from appliance.model.robot_api import Remote
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Message, Stream

Address = tuple[str, int]
"""Host and port of the other end; of a serial link its device and 0."""


# --- statistics: pure ------------------------------------------------------------------------------------------------

MAX_SENDERS = 256
"""Of one link; the longest silent is forgotten first."""
MAX_ASKED = 8
"""TIMESYNC questions to one end that may still be answered."""
_LATE = 128
"""A sequence number further ahead than this is one that comes late."""
_RESTARTED = 3
"""So many late ones in a row, each following the other, are a sender that began again."""
_SMOOTH = 0.25


class Sender(Struct):
    """What one sender's sequence numbers have told."""

    received: int = 0
    lost: int = 0
    late: int = 0
    repeated: int = 0
    heard_at: float = 0.0
    expected: int = -1
    """Sequence number of its next frame; below 0 before the first."""
    behind: int = 0
    """Late ones in a row, each following the other."""
    last_late: int = -1

    def hear(self, sequence: int, now: float) -> None:
        """Count a frame that is no repetition."""
        self.received += 1
        self.heard_at = now
        gap = 0 if self.expected < 0 else (sequence - self.expected) & 0xFF
        if gap >= _LATE:
            self.behind = self.behind + 1 if sequence == (self.last_late + 1) & 0xFF else 1
            self.last_late = sequence
            if self.behind < _RESTARTED:
                self.late += 1
                self.lost -= self.lost > 0
                return
            gap = 0  # it has begun again
        self.lost += gap
        self.behind, self.last_late = 0, -1
        self.expected = (sequence + 1) & 0xFF

    @property
    def loss(self) -> float:
        """Share of its frames that did not arrive."""
        sent = self.received + self.lost
        return self.lost / sent if sent else 0.0


class Latency(Struct):
    """Round trips to one end, milliseconds."""

    last_ms: float = math.nan
    least_ms: float = math.inf
    mean_ms: float = math.nan
    count: int = 0

    def add(self, milliseconds: float) -> None:
        """Take in a round trip."""
        self.last_ms = milliseconds
        self.least_ms = min(self.least_ms, milliseconds)
        self.mean_ms = milliseconds if not self.count else self.mean_ms + _SMOOTH * (milliseconds - self.mean_ms)
        self.count += 1


class Meter:
    """Frames and bytes a second, between two looks."""

    def __init__(self, now: float) -> None:
        self._at = now
        self._before = (0, 0, 0, 0)
        self.rates = (0.0, 0.0, 0.0, 0.0)

    def look(self, totals: tuple[int, int, int, int], now: float) -> None:
        """Work out the rates since the last look; one that comes too early changes nothing."""
        passed = now - self._at
        if passed < 0.5:
            return
        one, two, three, four = (
            round((total - before) / passed, 1) for total, before in zip(totals, self._before, strict=True)
        )
        self.rates = (one, two, three, four)
        self._at, self._before = now, totals


class LinkStats:
    """Counters of one link."""

    def __init__(self, now: float) -> None:
        self.frames_in = self.bytes_in = self.frames_out = self.bytes_out = 0
        self.repeated = 0
        self.senders: OrderedDict[tuple[int, int], Sender] = OrderedDict()
        self.passed: OrderedDict[tuple[int, int], int] = OrderedDict()
        """Frames for everybody that went out here, by their sender; of few senders, the one silent for longest goes."""
        self.latency: OrderedDict[Address, Latency] = OrderedDict()
        self.meter = Meter(now)
        self._asked: OrderedDict[tuple[Address, int], int] = OrderedDict()

    def sender(self, system: int, component: int) -> Sender:
        """Return a sender's counters."""
        found = self.senders.get((system, component))
        if found is None:
            while len(self.senders) >= MAX_SENDERS:
                del self.senders[min(self.senders, key=lambda each: self.senders[each].heard_at)]
            found = self.senders[system, component] = Sender()
        return found

    def passed_on(self, system: int, component: int) -> None:
        """Note that a frame for everybody went out here, as its sender sent it."""
        self.passed[system, component] = self.passed.pop((system, component), 0) + 1
        if len(self.passed) > MAX_SENDERS:
            self.passed.popitem(last=False)

    def look(self, now: float) -> None:
        """Bring the rates up to date."""
        self.meter.look((self.frames_in, self.bytes_in, self.frames_out, self.bytes_out), now)

    # --- latency -----------------------------------------------------------------------------------------------

    def asked(self, end: Address, stamp: int, now_ns: int) -> None:
        """Note that an end was asked for its time, with that stamp."""
        self._asked[end, stamp] = now_ns
        while len(self._asked) > MAX_ASKED * max(1, len(self.latency) + 1):
            self._asked.popitem(last=False)

    def answered(self, end: Address, stamp: int, now_ns: int) -> bool:
        """Take in an answer; whether it was one to a question of ours."""
        at = self._asked.pop((end, stamp), None)
        if at is None:
            return False
        found = self.latency.setdefault(end, Latency())
        found.add((now_ns - at) / 1e6)
        while len(self.latency) > MAX_SENDERS:
            self.latency.popitem(last=False)
        return True


class Bucket(Struct):
    """How much more one end may send just now."""

    level: float
    at: float


class Limiter:
    """Lets each end send so many frames a second, and a burst of as many; who sends more harms nobody else.

    Args:
        per_s: frames a second; 0 for no limit.
        most: ends remembered; the longest silent is forgotten first.
    """

    def __init__(self, per_s: float, *, most: int = 1024) -> None:
        self._per_s = per_s
        self._most = most
        self._ends: OrderedDict[Address, Bucket] = OrderedDict()

    def wait_s(self, end: Address, now: float) -> float:
        """Return for how long an end has to be silent before it is heard again; 0: not at all."""
        if not self._per_s:
            return 0.0
        bucket = self._bucket(end, now)
        bucket.level = min(self._per_s, bucket.level + (now - bucket.at) * self._per_s)
        bucket.at = now
        self._ends.move_to_end(end)
        return 0.0 if bucket.level > 0 else max(1e-3, -bucket.level / self._per_s)

    def spent(self, end: Address, frames: int, now: float) -> None:
        """Count what an end has sent, good or damaged."""
        if self._per_s:
            # One datagram or piece of a stream may overdraw, and is waited for.
            self._bucket(end, now).level -= frames

    def _bucket(self, end: Address, now: float) -> Bucket:
        found = self._ends.get(end)
        if found is None:
            found = self._ends[end] = Bucket(self._per_s, now)
            while len(self._ends) > self._most:
                self._ends.popitem(last=False)
        return found


# --- links -----------------------------------------------------------------------------------------------------------

_BUSY_S = 0.005


class Sink(Protocol):
    """Where the good frames of links go, on the event loop."""

    @property
    def busy(self) -> bool:
        """Whether no more can be taken just now, so that streams are not read; datagrams cannot wait."""
        ...

    def receive(self, link: int, frame: Frame, address: Address) -> None:
        """Take a frame of the link with that number, from that address."""
        ...


class Link(abc.ABC):
    """One link.

    Args:
        remote: where it is.
        codec: decoder and encoder of this link alone.
        sink: takes each good frame.
        refused: counters of bad input by kind, of all links together; its own are `damaged`.
        number: by which the sink knows the link.
        limit_hz: most frames a second from one end; 0 for no limit.
    """

    def __init__(
        self,
        remote: Remote,
        codec: Codec,
        sink: Sink,
        refused: dict[str, int] | None = None,
        *,
        number: int = 0,
        limit_hz: float = 0.0,
    ) -> None:
        self.remote = remote
        self.codec = codec
        self.refused: dict[str, int] = {} if refused is None else refused
        self.damaged: dict[str, int] = {}
        self.stats = LinkStats(self.now())
        self.problem = ""
        """Why nothing is heard just now, where that is known."""
        self._sink = sink
        self._number = number
        self._limiter = Limiter(limit_hz)

    @staticmethod
    def now() -> float:
        """Monotonic seconds, as the event loop counts them."""
        try:
            return asyncio.get_running_loop().time()
        except RuntimeError:
            return 0.0

    @property
    def received(self) -> int:
        """Good frames so far."""
        return self.stats.frames_in

    @abc.abstractmethod
    async def open(self) -> None:
        """Listen, or begin to connect; ConfigError with the remedy when a port cannot be listened on."""

    @property
    @abc.abstractmethod
    def address(self) -> Address:
        """Host and port of this end when it listens (port 0 becomes the one given by the system), else of the other."""

    @property
    @abc.abstractmethod
    def others(self) -> tuple[Address, ...]:
        """Other ends that are known before they have been heard: they are sent heartbeats, so that they know us."""

    @abc.abstractmethod
    def _write(self, raw: bytes, to: Address) -> bool:
        """Send bytes; False when they were dropped."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Close everything; a port is free when it returns."""

    def transmit(self, raw: bytes, to: Address) -> None:
        """Send a frame as it is; links lose frames, so nothing is raised for one that cannot be sent.

        One that has no form in the link's version of MAVLink is empty, and counted.
        """
        if not raw:
            self.count("no_mavlink_1")
        elif self._write(raw, to):
            self.stats.frames_out += 1
            self.stats.bytes_out += len(raw)

    def send(self, message: Message, to: Address, *, system: int | None = None) -> bytes:
        """Send one message and return its frame; `system` as in `Codec.pack`."""
        raw = self.codec.pack(message, system=system)
        self.transmit(raw, to)
        return raw

    def count(self, kind: str) -> None:
        """Count one piece of bad input."""
        self.damaged[kind] = self.damaged.get(kind, 0) + 1
        self.refused[kind] = self.refused.get(kind, 0) + 1

    def take(self, found: Iterable[Frame | Damage], address: Address) -> int:
        """Pass on frames, count what is none; return how many pieces there were of both."""
        pieces, stats, receive, number = 0, self.stats, self._sink.receive, self._number
        for piece in found:
            if isinstance(piece, Frame):
                stats.frames_in += 1
                stats.bytes_in += len(piece.raw)
                receive(number, piece, address)
            elif piece.counted:
                self.count(piece.kind)
            else:
                continue
            pieces += 1
        return pieces

    def feed(self, data: bytes, address: Address) -> None:
        """Take in a datagram; those of an end that sends more than it may are dropped and counted."""
        now = self.now()
        if self._limiter.wait_s(address, now):
            self.count("flood")
            return
        self._limiter.spent(address, self.take(self.codec.read(data), address), now)

    async def pace(self, address: Address, frames: int) -> None:
        """Wait until an end of a stream may be read again: its own system then slows it down, and nothing is lost."""
        now = self.now()
        self._limiter.spent(address, frames, now)
        wait_s = self._limiter.wait_s(address, now)
        if wait_s:
            self.count("slowed")
            await asyncio.sleep(wait_s)
        while self._sink.busy:  # noqa: ASYNC110 - what it waits for is a thread's queue, which tells nobody
            await asyncio.sleep(_BUSY_S)

    def taken(self, error: OSError) -> ConfigError:
        """The error for a port that cannot be listened on."""
        return ConfigError(
            f"MAVLink cannot listen on {self.remote}: {error.strerror or error}",
            remedy="another ground station or gateway has the port: stop it, or set another robots.mavlink listen",
        )


log = structlog.get_logger(__name__)

# --- UDP -------------------------------------------------------------------------------------------------------------

UDP_MAX_UNSENT = 256 * 1024
"""Bytes of datagrams that may wait for the system to take them; more are dropped, as on a radio link."""
UDP_RECEIVE_BYTES = 4 * 2**20
"""Asked of the system for datagrams that wait to be read: half a second of 100,000 frames. It gives what it allows."""


def _full(transport: asyncio.DatagramTransport) -> bool:
    """Whether as much waits to be sent as may."""
    waiting: int = cast("Any", transport).get_write_buffer_size()  # both loops have it
    return waiting > UDP_MAX_UNSENT


def _widen(transport: asyncio.DatagramTransport) -> None:
    """Ask for room for a burst; the system's own is 200 kB, which 800 small datagrams fill."""
    sock = transport.get_extra_info("socket")
    if sock is not None:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, UDP_RECEIVE_BYTES)


class _Datagrams(asyncio.DatagramProtocol):
    """asyncio's side of a UDP link."""

    def __init__(self, link: Link) -> None:
        self.closed = asyncio.Event()
        self._link = link

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self.closed.set()

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self._link.feed(data, (addr[0], addr[1]))

    def error_received(self, exc: Exception) -> None:
        # An ICMP refusal: the other end is gone, which its missing heartbeat will tell.
        self._link.count("unreachable")
        log.debug("MAVLink peer refuses datagrams", error=str(exc))


class UdpServer(Link):
    """Listens; a sender is answered where it sent from."""

    _transport: asyncio.DatagramTransport | None = None
    _datagrams: _Datagrams | None = None

    async def open(self) -> None:
        """Bind the port."""
        loop = asyncio.get_running_loop()
        try:
            sock = await self._bound(loop)
        except OSError as error:
            raise self.taken(error) from error
        self._transport, self._datagrams = await loop.create_datagram_endpoint(lambda: _Datagrams(self), sock=sock)
        _widen(self._transport)

    async def _bound(self, loop: asyncio.AbstractEventLoop) -> socket.socket:
        """A socket at the port: bound here, since an event loop may leave behind one that it could not bind."""
        found = await loop.getaddrinfo(self.remote.host, self.remote.port, type=socket.SOCK_DGRAM)
        family, kind, protocol, _, address = found[0]
        sock = socket.socket(family, kind, protocol)
        try:
            sock.setblocking(False)
            sock.bind(address)
        except OSError:
            sock.close()
            raise
        return sock

    @property
    def address(self) -> Address:
        """Host and port bound."""
        if self._transport is None:
            raise ConfigError("the MAVLink port is closed")
        return cast("Address", self._transport.get_extra_info("sockname")[:2])

    @property
    def others(self) -> tuple[Address, ...]:
        """Nobody is known before it was heard."""
        return ()

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send a datagram."""
        if self._transport is None or _full(self._transport):
            return False
        self._transport.sendto(raw, to)
        return True

    async def close(self) -> None:
        """Close the socket."""
        if self._transport is not None and self._datagrams is not None:
            self._transport.abort()
            self._transport = None
            await self._datagrams.closed.wait()


class UdpClient(Link):
    """Sends to one address from a port of the system's choice; only that address is heard.

    A new socket is made after an error: an interface may come up later than the gateway, or change its address.
    """

    RETRY_S = 2.0

    _transport: asyncio.DatagramTransport | None = None
    _other: Address | None = None
    _keeping: "asyncio.Task[None] | None" = None

    async def open(self) -> None:
        """Begin; the other end need not be there."""
        self._keeping = asyncio.create_task(self._keep(), name=f"MAVLink {self.remote}")

    async def _keep(self) -> None:
        loop = asyncio.get_running_loop()
        told = ""
        while True:
            try:
                transport, datagrams = await loop.create_datagram_endpoint(
                    lambda: _Datagrams(self), remote_addr=(self.remote.host, self.remote.port)
                )
            except OSError as error:
                self.problem = str(error)
                if str(error) != told:
                    told = str(error)
                    log.warning("MAVLink address cannot be reached", connect=str(self.remote), reason=told)
                await asyncio.sleep(self.RETRY_S)
                continue
            self._transport, told, self.problem = transport, "", ""
            _widen(transport)
            self._other = cast("Address", transport.get_extra_info("peername")[:2])
            try:
                await datagrams.closed.wait()
            finally:
                self._transport = self._other = None
                transport.abort()
            await asyncio.sleep(self.RETRY_S)

    @property
    def address(self) -> Address:
        """Where it sends."""
        return self.remote.host, self.remote.port

    @property
    def others(self) -> tuple[Address, ...]:
        """The address it sends to, as the system resolved it."""
        return () if self._other is None else (self._other,)

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send a datagram."""
        if self._transport is None or to != self._other or _full(self._transport):
            return False
        self._transport.sendto(raw)
        return True

    async def close(self) -> None:
        """Close the socket."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
            self._keeping = None


# --- TCP -------------------------------------------------------------------------------------------------------------

TCP_MAX_CONNECTIONS = 64
"""Of one listening port; more are refused and counted."""
TCP_MAX_UNSENT = 256 * 1024
"""Bytes that may wait for an end that does not read; beyond it frames are dropped and counted, as on a radio link."""
TCP_MAX_READ = 16 * 1024
"""Bytes taken from one connection before the others have their turn: some 300 frames."""
TCP_FIRST_RETRY_S = 0.5
TCP_LAST_RETRY_S = 10.0


class _TcpLink(Link):
    """Connections by the address of their other end."""

    def _begin(self) -> None:
        self._writers: dict[Address, asyncio.StreamWriter] = {}
        self._unsent: dict[Address, bytearray] = {}
        """Frames that go out together at the end of this turn of the loop: a system call costs more than a frame."""

    @property
    def others(self) -> tuple[Address, ...]:
        """The other ends of all connections: none of them speaks by accident."""
        return tuple(self._writers)

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send a frame on its connection, unless that is gone or stuck."""
        writer = self._writers.get(to)
        if writer is None or writer.is_closing():
            return False
        unsent = self._unsent.get(to)
        if writer.transport.get_write_buffer_size() + (len(unsent) if unsent else 0) > TCP_MAX_UNSENT:
            self.count("not_read")
            return False
        if not self._unsent:
            asyncio.get_running_loop().call_soon(self._flush)
        if unsent is None:
            unsent = self._unsent[to] = bytearray()
        unsent += raw
        return True

    def _flush(self) -> None:
        """Send what was written in this turn of the loop."""
        unsent, self._unsent = self._unsent, {}
        for to, frames in unsent.items():
            writer = self._writers.get(to)
            if writer is not None and not writer.is_closing():
                writer.write(frames)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read one connection to its end."""
        peer = writer.get_extra_info("peername")
        if peer is None:  # gone before it was looked at
            writer.transport.abort()
            return
        address = cast("Address", peer[:2])
        stream = Stream(self.codec)
        self._writers[address] = writer
        log.info("MAVLink connection", link=str(self.remote), peer=f"{address[0]}:{address[1]}")
        try:
            while data := await reader.read(TCP_MAX_READ):
                await self.pace(address, self.take(stream.feed(data), address))
        except OSError as error:
            log.info("MAVLink connection broke", link=str(self.remote), reason=str(error))
        finally:
            del self._writers[address]
            self.take(stream.end(), address)
            writer.transport.abort()


class TcpServer(_TcpLink):
    """Listens for connections."""

    _server: asyncio.Server | None = None
    _serving: "set[asyncio.Task[None]]"

    async def open(self) -> None:
        """Bind the port."""
        self._begin()
        self._serving = set()
        try:
            self._server = await asyncio.start_server(self._connected, self.remote.host, self.remote.port)
        except OSError as error:
            raise self.taken(error) from error

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._writers) >= TCP_MAX_CONNECTIONS:
            self.count("too_many_connections")
            writer.transport.abort()
            return
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - asyncio calls this in a task of its own
        self._serving.add(task)
        try:
            await self._serve(reader, writer)
        finally:
            self._serving.discard(task)

    @property
    def address(self) -> Address:
        """Host and port bound."""
        if self._server is None:
            raise ConfigError("the MAVLink port is closed")
        return cast("Address", self._server.sockets[0].getsockname()[:2])

    async def close(self) -> None:
        """Close the port and all connections."""
        if self._server is not None:
            self._server.close()
            for writer in list(self._writers.values()):
                writer.transport.abort()
            await asyncio.gather(*self._serving, return_exceptions=True)
            await self._server.wait_closed()
            self._server = None


class TcpClient(_TcpLink):
    """Connects, and connects again for as long as it is open."""

    _keeping: "asyncio.Task[None] | None" = None

    async def open(self) -> None:
        """Begin; the other end need not be there."""
        self._begin()
        self._keeping = asyncio.create_task(self._keep(), name=f"MAVLink {self.remote}")

    async def _keep(self) -> None:
        pause_s, told = TCP_FIRST_RETRY_S, ""
        while True:
            try:
                reader, writer = await asyncio.open_connection(self.remote.host, self.remote.port)
            except OSError as error:
                self.problem = str(error)
                if str(error) != told:
                    told = str(error)
                    log.warning("MAVLink address cannot be reached", connect=str(self.remote), reason=told)
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, TCP_LAST_RETRY_S)
                continue
            pause_s, told, self.problem = TCP_FIRST_RETRY_S, "", ""
            await self._serve(reader, writer)
            await asyncio.sleep(pause_s)

    @property
    def address(self) -> Address:
        """Where it connects to."""
        return self.remote.host, self.remote.port

    async def close(self) -> None:
        """Close the connection."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
            self._keeping = None


# --- serial ----------------------------------------------------------------------------------------------------------

SERIAL_RETRY_S = 1.0
"""How often a device that is not there is looked for: it is seen within a second of being plugged in."""
SERIAL_MAX_READ = 4096
SERIAL_MAX_UNSENT = 16 * 1024
"""Bytes that may wait for the port: three seconds of a 57,600 baud radio. More are dropped and counted."""
SERIAL_SPEEDS = {
    int(name[1:]): int(getattr(termios, name)) for name in dir(termios) if name.startswith("B") and name[1:].isdecimal()
}
"""Speeds that the system knows, by baud."""


class SerialLink(Link):
    """One serial port. Whatever is at its other end is one end, called by the device."""

    _fd: int | None = None
    _keeping: "asyncio.Task[None] | None" = None

    async def open(self) -> None:
        """Begin; the device need not be there. ConfigError for a speed that the system does not know."""
        if self.remote.port not in SERIAL_SPEEDS:
            known = ", ".join(str(each) for each in sorted(SERIAL_SPEEDS) if each >= 9600)
            raise ConfigError(
                f"{self.remote}: no serial port has {self.remote.port} baud", remedy=f"use one of {known}"
            )
        self._unsent = bytearray()
        self._broken = asyncio.Event()
        self._keeping = asyncio.create_task(self._keep(), name=f"MAVLink {self.remote}")

    async def _keep(self) -> None:
        told = ""
        while True:
            try:
                self._fd = _open_serial(self.remote.host, self.remote.port)
            except (OSError, termios.error) as error:
                self.problem = str(error)
                if self.problem != told:
                    told = self.problem
                    log.warning("MAVLink serial port cannot be opened", port=str(self.remote), reason=told)
                await asyncio.sleep(SERIAL_RETRY_S)
                continue
            told = self.problem = ""
            log.info("MAVLink serial port open", port=str(self.remote))
            try:
                await self._read(self._fd)
            finally:
                self._shut()
            await asyncio.sleep(SERIAL_RETRY_S)

    async def _read(self, fd: int) -> None:
        """Read until the device is gone."""
        loop = asyncio.get_running_loop()
        stream, ready = Stream(self.codec), asyncio.Event()
        self._broken.clear()
        while True:
            try:
                data = os.read(fd, SERIAL_MAX_READ)
            except BlockingIOError:
                ready.clear()
                loop.add_reader(fd, ready.set)
                try:
                    await ready.wait()
                finally:
                    loop.remove_reader(fd)
                continue
            except OSError as error:
                data, self.problem = b"", str(error)
            if not data or self._broken.is_set():
                self.problem = self.problem or "end of file"
                log.warning("MAVLink serial port is gone", port=str(self.remote), reason=self.problem)
                self.take(stream.end(), self.address)
                return
            await self.pace(self.address, self.take(stream.feed(data), self.address))
            await asyncio.sleep(0)  # a fast port must not keep the others waiting

    @property
    def address(self) -> Address:
        """The device."""
        return self.remote.host, 0

    @property
    def others(self) -> tuple[Address, ...]:
        """Whatever is at the other end, while the port is open."""
        return () if self._fd is None else (self.address,)

    def _write(self, raw: bytes, to: Address) -> bool:
        """Send bytes as the port takes them; a frame goes whole or not at all."""
        if self._fd is None or to != self.address:
            return False
        if len(self._unsent) + len(raw) > SERIAL_MAX_UNSENT:
            self.count("not_read")
            return False
        idle = not self._unsent
        self._unsent += raw
        if idle:
            self._flush()
        return True

    def _flush(self) -> None:
        if self._fd is None:
            return
        loop = asyncio.get_running_loop()
        try:
            sent = os.write(self._fd, self._unsent)
            del self._unsent[:sent]
        except BlockingIOError:
            pass
        except OSError as error:
            self.problem = str(error)
            self._broken.set()  # the reader sees it too, and opens it again
            self._unsent.clear()
        if self._unsent:
            loop.add_writer(self._fd, self._flush)
        else:
            loop.remove_writer(self._fd)

    def _shut(self) -> None:
        if self._fd is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(self._fd)
            loop.remove_writer(self._fd)
            with contextlib.suppress(OSError):
                os.close(self._fd)
            self._fd = None
            self._unsent.clear()

    async def close(self) -> None:
        """Close the port."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
            self._keeping = None
        self._shut()


def _open_serial(path: str, baud: int) -> int:
    """Open and set up a port; OSError or termios.error when it is none, or not ours."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        settings = termios.tcgetattr(fd)
        settings[0] = settings[1] = settings[3] = 0  # input, output and line discipline: nothing is translated
        settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        settings[4] = settings[5] = SERIAL_SPEEDS[baud]
        settings[6][termios.VMIN] = 1
        settings[6][termios.VTIME] = 0
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except BaseException:
        os.close(fd)
        raise
    return fd


# --- open ------------------------------------------------------------------------------------------------------------

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
    sink: Sink,
    refused: dict[str, int] | None = None,
    *,
    number: int = 0,
    limit_hz: float = 0.0,
) -> Link:
    """Open the link that a setting names.

    Args:
        remote: scheme, host and port, and whether to listen there or to connect.
        codec: decoder and encoder of this link alone.
        sink: takes each good frame.
        refused: counters of bad input by kind.
        number: by which the sink knows the link.
        limit_hz: most frames a second from one end: more of a datagram link are dropped and counted as `flood`, of a
            stream they are read later. 0 for no limit.

    Raises:
        ConfigError: the port to listen on is taken or not this machine's. A link that connects does not raise: it
            tries for as long as it is open.
    """
    link = _KINDS[remote.scheme, remote.listens](remote, codec, sink, refused, number=number, limit_hz=limit_hz)
    await link.open()
    return link
