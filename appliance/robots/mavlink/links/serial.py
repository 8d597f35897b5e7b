"""MAVLink over a serial port: a stream without ends, whose device may be unplugged and plugged in again.

The port is set up by POSIX terminal settings (termios): eight bits, no parity, one stop bit, no flow control, nothing
translated, which is what flight controllers and telemetry radios speak.
"""

import asyncio
import contextlib
import os
import termios

import structlog

from appliance.errors import ConfigError
from appliance.robots.mavlink.dialect import Stream
from appliance.robots.mavlink.links.base import Address, Link

log = structlog.get_logger(__name__)

RETRY_S = 1.0
"""How often a device that is not there is looked for: it is seen within a second of being plugged in."""
MAX_READ = 4096
MAX_UNSENT = 16 * 1024
"""Bytes that may wait for the port: three seconds of a 57,600 baud radio. More are dropped and counted."""
SPEEDS = {
    int(name[1:]): int(getattr(termios, name)) for name in dir(termios) if name.startswith("B") and name[1:].isdecimal()
}
"""Speeds that the system knows, by baud."""


class SerialLink(Link):
    """One serial port. Whatever is at its other end is one end, called by the device."""

    _fd: int | None = None
    _keeping: "asyncio.Task[None] | None" = None

    async def open(self) -> None:
        """Begin; the device need not be there. ConfigError for a speed that the system does not know."""
        if self.remote.port not in SPEEDS:
            known = ", ".join(str(each) for each in sorted(SPEEDS) if each >= 9600)
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
                self._fd = _open(self.remote.host, self.remote.port)
            except (OSError, termios.error) as error:
                self.problem = str(error)
                if self.problem != told:
                    told = self.problem
                    log.warning("MAVLink serial port cannot be opened", port=str(self.remote), reason=told)
                await asyncio.sleep(RETRY_S)
                continue
            told = self.problem = ""
            log.info("MAVLink serial port open", port=str(self.remote))
            try:
                await self._read(self._fd)
            finally:
                self._shut()
            await asyncio.sleep(RETRY_S)

    async def _read(self, fd: int) -> None:
        """Read until the device is gone."""
        loop = asyncio.get_running_loop()
        stream, ready = Stream(self.codec), asyncio.Event()
        self._broken.clear()
        while True:
            try:
                data = os.read(fd, MAX_READ)
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
        if len(self._unsent) + len(raw) > MAX_UNSENT:
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
            self._broken.set()  # the reader sees it too, and opens anew
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


def _open(path: str, baud: int) -> int:
    """Open and set up a port; OSError or termios.error when it is none, or not ours."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        settings = termios.tcgetattr(fd)
        settings[0] = settings[1] = settings[3] = 0  # input, output and line discipline: nothing is translated
        settings[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        settings[4] = settings[5] = SPEEDS[baud]
        settings[6][termios.VMIN] = 1
        settings[6][termios.VTIME] = 0
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except BaseException:
        os.close(fd)
        raise
    return fd
