"""MAVLink 2 message signing: one link's key, its clock, and what it has heard (pure but for reading the key's file).

Source: MAVLink guide, "Message Signing". A signature is the first 48 bits of SHA-256(key, frame up to the
signature); timestamps count 10 µs since 2015-01-01 UTC and must rise within each stream (link id, system,
component). pymavlink's own check is not used: it moves a stream's time forward before it has verified the
signature, so that one forged frame silences a vehicle.
"""

import hashlib
import hmac
import os
import struct
import time
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance.errors import ConfigError

SIGNED_FLAG = 0x01
SIGNATURE_BYTES = 13
"""Link id, timestamp (6 bytes), signature (6 bytes)."""
EPOCH_S = 1_420_070_400
"""2015-01-01T00:00:00Z, Unix seconds."""
TICKS_PER_S = 100_000
WINDOW = 60 * TICKS_PER_S
"""A new stream may be this far behind the link's own time (guide: one minute)."""
MAX_STREAMS = 1024
"""Streams remembered of one link; only holders of the key can make new ones."""
AHEAD = 15 * TICKS_PER_S
"""What is kept of a running link's own timestamps is so far ahead of them: three times as far as they get until it is
kept again. So after a crash none is used twice, whatever this machine's clock then shows."""
SINCE = 6 * TICKS_PER_S
"""What streams may have gone on since they were kept: nothing so old is believed after a crash."""
KEY_FILE_BYTES = 4096
_HEX_KEY = 64


class Memory(Struct, frozen=True, kw_only=True):
    """What a link must not forget over a restart.

    Its time, the newest timestamp that it used itself, and the newest of each stream as [link id, system, component,
    timestamp]. What is kept while the link runs is not `exact`: `used` is ahead of what was, and the streams may have
    gone on since.
    """

    timestamp: int = 0
    used: int = 0
    streams: tuple[tuple[int, int, int, int], ...] = ()
    exact: bool = True


def ticks(unix_s: float) -> int:
    """Return a wall-clock time as signatures count it."""
    return max(0, round((unix_s - EPOCH_S) * TICKS_PER_S))


class Signer:
    """Key and times of one link."""

    def __init__(self, key: bytes, *, link_id: int, memory: Memory | None = None) -> None:
        memory = memory or Memory()
        self._key = key
        self.link_id = link_id
        self._timestamp = memory.timestamp
        self._used = max(memory.used, memory.timestamp)
        since = 0 if memory.exact else SINCE
        self._streams = {(link, system, component): at + since for link, system, component, at in memory.streams}

    @property
    def memory(self) -> Memory:
        """What to keep over a restart."""
        streams = tuple((*stream, at) for stream, at in self._streams.items())
        return Memory(timestamp=self._timestamp, used=self._used, streams=streams)

    @property
    def ahead(self) -> Memory:
        """What to keep while the link runs: after a crash it is on the safe side."""
        return msgspec.structs.replace(self.memory, used=max(self._used, self._timestamp) + AHEAD, exact=False)

    def stamp(self, now: int) -> int:
        """Return the timestamp of the next frame: this one's own time, never one used before (a clock may go back)."""
        self._timestamp = max(self._timestamp, now)
        self._used = max(self._used + 1, self._timestamp)
        return self._used

    def signature(self, frame: bytes, timestamp: int) -> bytes:
        """Return the 13 bytes that sign a frame whose header says that it is signed."""
        block = struct.pack("<BQ", self.link_id, timestamp)[:7]
        return block + hashlib.sha256(self._key + frame + block).digest()[:6]

    def problem(self, raw: bytes, *, system: int, component: int, now: int) -> str:
        """Return why a frame is refused: `unsigned`, `bad_signature` or `replayed`; empty when it is good.

        A good one moves its stream's and the link's time forward; a refused one moves nothing.

        Args:
            raw: the whole frame.
            system: its sender's system id.
            component: its sender's component id.
            now: wall clock in ticks, for a stream not heard before.
        """
        if raw[0] != 0xFD or not raw[2] & SIGNED_FLAG:
            return "unsigned"
        if not hmac.compare_digest(hashlib.sha256(self._key + raw[:-6]).digest()[:6], raw[-6:]):
            return "bad_signature"
        link = raw[-SIGNATURE_BYTES]
        at = int.from_bytes(raw[-12:-6], "little")
        stream = (link, system, component)
        newest = self._streams.get(stream)
        if newest is None:
            if at + WINDOW < max(self._timestamp, now) or len(self._streams) >= MAX_STREAMS:
                return "replayed"
        elif at <= newest:
            return "replayed"
        self._streams[stream] = at
        self._timestamp = max(self._timestamp, at)
        return ""


def wall_ticks() -> int:
    """Return this machine's time as signatures count it."""
    return ticks(time.time())


def read_key(source: str) -> bytes:
    """Return the 32 bytes of a key.

    Args:
        source: path of a file that nobody else may read, or `credential:NAME` for one that systemd hands over. Its
            text is `hex:` and 64 digits, or a passphrase (the key is its SHA-256, as ground stations make it).

    Raises:
        ConfigError: it cannot be read, is open to others, or holds no key.
    """
    name = source.removeprefix("credential:")
    if name != source:
        path = Path(os.environ.get("CREDENTIALS_DIRECTORY", "/nonexistent")) / Path(name).name
    else:
        path = Path(source).expanduser()
    try:
        mode = path.stat().st_mode
        with path.open("rb") as file:
            text = file.read(KEY_FILE_BYTES).decode().strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise ConfigError(
            f"signing key {source} cannot be read: {reason}", remedy="write the passphrase there"
        ) from error
    if mode & 0o077:
        raise ConfigError(f"signing key {path} can be read by others", remedy=f"chmod 600 {path}")
    if text.startswith("hex:"):
        try:
            key = bytes.fromhex(text.removeprefix("hex:"))
        except ValueError:
            key = b""
        if len(key) * 2 != _HEX_KEY:
            raise ConfigError(f"signing key {path} is not hex: and 64 digits", remedy="openssl rand -hex 32 makes one")
        return key
    if not text:
        raise ConfigError(f"signing key {path} is empty", remedy="write a passphrase into it, or hex: and 64 digits")
    return hashlib.sha256(text.encode()).digest()
