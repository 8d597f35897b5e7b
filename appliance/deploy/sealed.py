r"""Encrypted streams: what is written with a passphrase is read back with it, whole, or not at all.

    "swiftbot sealed 1\n"   magic
    4 bytes, header         JSON: scrypt's cost and salt, nonce, size of a part, the check of the passphrase
    parts                   AES-256-GCM, each with its tag of 16 bytes behind it

The key is made of the passphrase by scrypt. A part's nonce is 7 random bytes, its number (4 bytes) and whether it is
the last (1 byte), and magic and header are authenticated with each, so that parts cannot be changed, moved, left out or
cut off (the STREAM construction: Hoang, Reyhanitabar, Rogaway, Vizár, "Online authenticated-encryption and its
nonce-reuse misuse-resistance", 2015). The check is an empty part of a number of its own: it tells a wrong passphrase
from damage.
"""

import os
import struct
from typing import BinaryIO

import msgspec
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt
from msgspec import Struct

from appliance.errors import IdentityError, PayloadError

MAGIC = b"swiftbot sealed 1\n"
PART = 2**20
TAG = 16
COST_LOG2 = 17
"""128 MiB and half a second for each passphrase that is tried."""
MOST_COST_LOG2 = 20
"""A header that asks for more is refused: it would take all memory."""
MOST_HEADER = 4096
MOST_PARTS = 2**32 - 1
_CHECK = MOST_PARTS
_COPY_AGAIN = "copy it again, and compare its size with the original's"


class Header(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a stream was encrypted."""

    cost_log2: int
    salt: bytes
    nonce: bytes
    part: int
    check: bytes = b""


def _key(passphrase: str, header: Header) -> AESGCM:
    scrypt = Scrypt(salt=header.salt, length=32, n=2**header.cost_log2, r=8, p=1)
    return AESGCM(scrypt.derive(passphrase.encode()))


def _nonce(header: Header, number: int, *, last: bool) -> bytes:
    return header.nonce + struct.pack(">IB", number, last)


class Sealer:
    """A stream to write to. Close it: what lacks its last part cannot be read.

    Args:
        out: where it goes.
        passphrase: not empty.
        cost_log2: of scrypt; less only in tests.
    """

    def __init__(self, out: BinaryIO, passphrase: str, *, cost_log2: int = COST_LOG2) -> None:
        plain = Header(cost_log2=cost_log2, salt=os.urandom(16), nonce=os.urandom(7), part=PART)
        self._key = _key(passphrase, plain)
        check = self._key.encrypt(_nonce(plain, _CHECK, last=True), b"", MAGIC)
        self._header = msgspec.structs.replace(plain, check=check)
        text = msgspec.json.encode(self._header)
        self._said = MAGIC + struct.pack(">I", len(text)) + text
        self._out = out
        self._buffer = bytearray()
        self._number = 0
        out.write(self._said)

    def write(self, data: bytes) -> int:
        """Write bytes."""
        self._buffer += data
        while len(self._buffer) > PART:  # the last part is never empty but in an empty stream
            self._part(bytes(self._buffer[:PART]), last=False)
            del self._buffer[:PART]
        return len(data)

    def close(self) -> None:
        """Write the last part."""
        self._part(bytes(self._buffer), last=True)
        self._buffer.clear()

    def _part(self, data: bytes, *, last: bool) -> None:
        self._out.write(self._key.encrypt(_nonce(self._header, self._number, last=last), data, self._said))
        self._number += 1


class Opener:
    """A stream to read from; each part is believed only once its tag was checked.

    Raises:
        PayloadError: it is no such stream.
        IdentityError: the passphrase is another.
    """

    def __init__(self, source: BinaryIO, passphrase: str, *, name: str) -> None:
        self._source = source
        self._name = name
        self._header, self._said = self._read_header()
        self._key = _key(passphrase, self._header)
        try:
            self._key.decrypt(_nonce(self._header, _CHECK, last=True), self._header.check, MAGIC)
        except InvalidTag:
            raise IdentityError(f"{name}: wrong passphrase", remedy="give the one that it was written with") from None
        self._buffer = bytearray()
        self._next = self._source.read(self._header.part + TAG)
        self._number = 0
        self._ended = False

    def _read_header(self) -> tuple[Header, bytes]:
        begin = self._source.read(len(MAGIC) + 4)
        if not begin.startswith(MAGIC) or len(begin) < len(MAGIC) + 4:
            raise PayloadError(f"{self._name} is no backup", remedy="`swiftbot backup` writes one")
        size = struct.unpack(">I", begin[len(MAGIC) :])[0]
        text = self._source.read(min(size, MOST_HEADER))
        try:
            header = msgspec.json.decode(text, type=Header)
        except msgspec.MsgspecError as error:
            raise PayloadError(f"{self._name}: its header is damaged", remedy=_COPY_AGAIN) from error
        sound = header.part == PART and len(header.nonce) == 7 and len(header.salt) == 16
        if len(text) != size or not sound or not 1 <= header.cost_log2 <= MOST_COST_LOG2:
            raise PayloadError(f"{self._name}: its header is damaged", remedy=_COPY_AGAIN)
        return header, begin + text

    def read(self, size: int = -1) -> bytes:
        """Read so many bytes, fewer only at the end; PayloadError where it is cut off or damaged."""
        while not self._ended and (size < 0 or len(self._buffer) < size):
            self._buffer += self._part()
        end = len(self._buffer) if size < 0 else size
        data = bytes(self._buffer[:end])
        del self._buffer[:end]
        return data

    def _part(self) -> bytes:
        data, self._next = self._next, self._source.read(self._header.part + TAG)
        self._ended = not self._next
        try:
            plain = self._key.decrypt(_nonce(self._header, self._number, last=self._ended), data, self._said)
        except (InvalidTag, ValueError):
            at = len(self._said) + self._number * (PART + TAG)
            what = "cut off" if self._ended else "damaged"
            raise PayloadError(f"{self._name} is {what} behind byte {at:,}", remedy=_COPY_AGAIN) from None
        self._number += 1
        return plain
