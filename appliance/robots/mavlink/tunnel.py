"""Messages of any length through MAVLink's TUNNEL frames: parts, checksums, acknowledgement, retransmission.

TUNNEL carries at most 128 bytes and acknowledges nothing. Each payload here is a part of a message or the account of
what has arrived of one:

    "SB"  version  kind    message id  index   count   CRC-32 of the whole message
    2     1        1       4           2       2       4        16 bytes, little endian, then at most 112 of data

    PART      the data of part `index` of `count`
    ACK       `index` parts from the first on have arrived; the data is a bitmap of those after them (bit 0 first)
    REFUSED   the message will not be taken; the data says why

A message is delivered once, whole and unchanged, or its sender learns that it was not. Each ACK is the whole account
of what the other end has, and the sender goes by the last one: after an outage what has arrived is not sent again, and
an end that has forgotten its parts (it was restarted, or had to make room) is sent them again. It is delivered when an
ACK says that it is whole. Only an end that forgets a whole message may take it twice: what is asked for has an id.

Plain code for both ends, the clock passed in; the standard library alone, since robots' companion computers run it too
(`appliance.robots.client`).
"""

import itertools
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable

PAYLOAD_TYPE = 0x9B42
"""Of the TUNNEL frames; above 32767 are private ones."""
PART_BYTES = 112
MAX_PAYLOAD = 128
_HEADER = struct.Struct("<2sBBIHHI")
_MAGIC, _VERSION = b"SB", 1
PART, ACK, REFUSED = 1, 2, 3

MAX_BYTES = 16 * 1024
"""Longest message."""
WINDOW = 16
"""Parts under way at once, of all messages together, on a link that is not known yet: what a radio of 57,600 baud
carries in half a second."""
LEAST_WINDOW, MOST_WINDOW = 2, 64
"""Of a link that needs seconds for each part, and of one that acknowledges fast."""
QUEUE_S = 1.0
"""An acknowledgement that takes longer has waited in a radio."""
RESEND_S = 0.6
"""First pause before a part is sent again; longer where the link is known to be slower (`_Pace`)."""
LAST_RESEND_S = 4.0
SLOWEST_S = 20.0
"""Longest pause that a slow link is given."""
GIVE_UP_S = 60.0
"""Without any news of a message for so long, it is not delivered: an outage may last so long."""
SILENT = f"nothing was heard for {GIVE_UP_S:g} s"
"""Why it was not."""
ACK_WAIT_S = 0.05
"""Parts that come together are acknowledged together."""
MAX_COMING = 4
"""Messages of one other end that may be incomplete at once; so many are under way at once, the others wait."""
MAX_GOING = 32
"""Messages that may wait to be delivered to one other end."""
REMEMBERED = 256
"""Delivered messages whose late parts are acknowledged again instead of being taken for new."""


class NotDelivered(Exception):  # noqa: N818 - what it says
    """A message could not be delivered, and why."""


class _Pace:
    """How long the other end takes to acknowledge, and what may be under way to it meanwhile.

    A part that is merely still on its way must not be sent again: a radio that is slower than what it is given keeps it
    waiting, and each repetition makes that worse. The time is estimated as TCP does (RFC 6298, with a smaller margin),
    from parts that were sent once: of others nobody knows which was acknowledged. While there are none, each repetition
    makes the pause longer, and the second one what is under way less.
    """

    def __init__(self) -> None:
        self.pause_s = RESEND_S
        """How long a part is waited for."""
        self._window = float(WINDOW)
        self._mean_s: float | None = None
        self._spread_s = 0.0
        self._longer_at = float("-inf")
        self._guessing = False

    @property
    def window(self) -> int:
        """How many parts may be under way."""
        return int(self._window)

    def again(self, now: float) -> None:
        """Note that something was sent again: once for all that was sent together."""
        if now < self._longer_at:
            return
        self._longer_at = now + self.pause_s
        self.pause_s = max(self.pause_s, min(1.3 * self.pause_s, LAST_RESEND_S))
        if self._guessing:
            self._window = max(LEAST_WINDOW, self._window / 2)
        self._guessing = True

    def took(self, seconds: float) -> None:
        """Take in how long one acknowledgement took."""
        if self._mean_s is None:
            self._mean_s, self._spread_s = seconds, seconds / 2
        else:
            self._spread_s += (abs(seconds - self._mean_s) - self._spread_s) / 4
            self._mean_s += (seconds - self._mean_s) / 8
        self.pause_s = min(SLOWEST_S, max(RESEND_S, self._mean_s + 2 * self._spread_s))
        self._guessing = False
        if self._mean_s < QUEUE_S:
            self._window = min(MOST_WINDOW, self._window + 4 / self._window)
        elif self._window > WINDOW:
            self._window -= 1


class _Going:
    """A message on its way out."""

    def __init__(self, number: int, data: bytes, now: float, pace: _Pace) -> None:
        self.number = number
        self._pace = pace
        self.crc = zlib.crc32(data)
        self.parts = [data[at : at + PART_BYTES] for at in range(0, len(data), PART_BYTES)] or [b""]
        self.missing = dict.fromkeys(range(len(self.parts)), now)
        """Index of each part not known to have arrived -> when it is to be sent (again)."""
        self._sent: dict[int, float | None] = {}
        """When a part was sent, None when more than once."""
        self.heard_at = now
        self.begun = False

    def due(self, now: float, window: int) -> list[bytes]:
        """Return the payloads to send now, of the first `window` parts that are missing."""
        found: list[bytes] = []
        again = False
        for index, at in itertools.islice(self.missing.items(), window):
            if at <= now:
                again = again or index in self._sent
                self._sent[index] = None if index in self._sent else now
                self.missing[index] = now + self._pace.pause_s
                found.append(_pack(PART, self.number, index, len(self.parts), self.crc, self.parts[index]))
        if again:
            self._pace.again(now)
        return found

    def acknowledged(self, first: int, bitmap: bytes, now: float) -> bool:
        """Take in what the other end has; whether that is all."""
        latest: float | None = None
        """When the last of those that have arrived was sent, as far as that is known."""
        for index in range(min(len(self.parts), first + 8 * len(bitmap))):
            place = index - first
            if place < 0 or bitmap[place // 8] >> place % 8 & 1:
                if self.missing.pop(index, None) is not None and (at := self._sent.get(index)) is not None:
                    latest = at if latest is None else max(latest, at)
            else:
                # It may have had it and forgotten. Where this account was merely overtaken by a later one nothing is
                # sent in vain: that takes it out again, or the next one does before the part is due.
                self.missing.setdefault(index, now + self._pace.pause_s)
        self.heard_at = now
        if latest is not None:
            self._pace.took(now - latest)
        return first >= len(self.parts)


class _Coming:
    """A message that is arriving."""

    def __init__(self, count: int, crc: int) -> None:
        self.count = count
        self.crc = crc
        self.parts: dict[int, bytes] = {}
        self.heard_at = 0.0


class Channel:
    """One end of a conversation with one other end.

    Args:
        new_number: makes message ids, different from all used lately; random, so that a restart repeats none.
        max_bytes: longest message taken or sent.
    """

    def __init__(self, new_number: Callable[[], int], *, max_bytes: int = MAX_BYTES) -> None:
        self._new_number = new_number
        self._max_bytes = max_bytes
        self._pace = _Pace()
        self._going: OrderedDict[int, _Going] = OrderedDict()
        self._coming: OrderedDict[int, _Coming] = OrderedDict()
        self._done: OrderedDict[int, tuple[int, int]] = OrderedDict()
        """Messages taken: id -> (count, CRC)."""
        self._acks: dict[int, float] = {}
        self._heard_at = float("-inf")
        self._refusals: list[bytes] = []
        self.failed: dict[int, str] = {}
        """Messages that were not delivered, and why; their sender takes them out."""
        self.malformed = 0
        """Payloads that were none of this protocol, or contradicted others."""

    # --- sending -----------------------------------------------------------------------------------------------

    def send(self, data: bytes, now: float) -> int:
        """Begin to send a message; returns its id. NotDelivered when it is too long or too many wait."""
        if len(data) > self._max_bytes:
            raise NotDelivered(f"a message of {len(data)} bytes; at most {self._max_bytes} are sent")
        if len(self._going) >= MAX_GOING:
            raise NotDelivered(f"{MAX_GOING} messages wait to be delivered already")
        number = self._new_number() & 0xFFFF_FFFF
        self._going[number] = _Going(number, data, now, self._pace)
        return number

    def going(self, number: int) -> bool:
        """Whether a message is still on its way; when not, it has arrived unless it is in `failed`."""
        return number in self._going

    def due(self, now: float) -> list[bytes]:
        """Return the payloads to transmit now."""
        found, self._refusals = self._refusals, []
        for number in [number for number, at in self._acks.items() if at <= now]:
            del self._acks[number]
            found += self._account(number)
        under_way: list[_Going] = []
        for number, message in list(self._going.items()):
            # Those that wait for others are not given up while the other end takes these.
            heard_at = message.heard_at if message.begun else max(message.heard_at, self._heard_at)
            if now - heard_at > GIVE_UP_S:
                del self._going[number]
                self._fail(number, SILENT)
            elif len(under_way) < MAX_COMING:
                under_way.append(message)
                if not message.begun:
                    message.begun, message.heard_at = True, now
        # Each has its share of the window; what a short one does not need is for the longer ones.
        left = self._pace.window
        for others, message in zip(
            range(len(under_way), 0, -1), sorted(under_way, key=lambda each: len(each.missing)), strict=True
        ):
            share = left // others
            found += message.due(now, share)
            left -= min(share, len(message.missing))
        for number, coming in list(self._coming.items()):
            if now - coming.heard_at > GIVE_UP_S:
                del self._coming[number]
        return found

    # --- receiving ---------------------------------------------------------------------------------------------

    def take(self, payload: bytes, now: float) -> bytes | None:
        """Take in a payload; returns the message that it completes, if it does. Never raises."""
        try:
            magic, version, kind, number, index, count, crc = _HEADER.unpack_from(payload)
        except struct.error:
            self.malformed += 1
            return None
        data = payload[_HEADER.size :]
        if magic != _MAGIC or version != _VERSION or len(payload) > MAX_PAYLOAD:
            self.malformed += 1
            return None
        if kind == PART:
            return self._part(number, index, count, crc, data, now)
        message = self._going.get(number)
        if message is None or message.crc != crc:
            return None  # late news of what is done
        self._heard_at = now
        if kind == ACK:
            if message.acknowledged(index, data, now):
                del self._going[number]
        elif kind == REFUSED:
            del self._going[number]
            self._fail(number, data.decode("utf-8", "replace") or "it was refused")
        else:
            self.malformed += 1
        return None

    def _part(self, number: int, index: int, count: int, crc: int, data: bytes, now: float) -> bytes | None:
        if number in self._done:
            self._acks.setdefault(number, now + ACK_WAIT_S)
            return None
        last = index == count - 1
        if index >= count or len(data) > PART_BYTES or (len(data) < PART_BYTES and not last):
            self.malformed += 1
            return None
        if count > -(-self._max_bytes // PART_BYTES):
            self._refuse(number, crc, f"at most {self._max_bytes} bytes are taken")
            return None
        coming = self._coming.get(number)
        if coming is None:
            if len(self._coming) >= MAX_COMING:
                self._coming.popitem(last=False)  # the oldest: by the next account its sender begins again
            coming = self._coming[number] = _Coming(count, crc)
        if (coming.count, coming.crc) != (count, crc):
            self.malformed += 1
            return None
        coming.parts[index] = data
        coming.heard_at = now
        self._acks.setdefault(number, now + ACK_WAIT_S)
        if len(coming.parts) < count:
            return None
        del self._coming[number]
        whole = b"".join(coming.parts[place] for place in range(count))
        if zlib.crc32(whole) != crc:
            self.malformed += 1
            del self._acks[number]
            self._refuse(number, crc, "its checksum is wrong")
            return None
        self._done[number] = (count, crc)
        while len(self._done) > REMEMBERED:
            self._done.popitem(last=False)
        return whole

    def _account(self, number: int) -> list[bytes]:
        """Return the ACK of a message; none of one of which nothing is left."""
        if number in self._done:
            count, crc = self._done[number]
            return [_pack(ACK, number, count, count, crc, b"")]
        coming = self._coming.get(number)
        if coming is None:
            return []
        first = 0
        while first in coming.parts:
            first += 1
        bits = bytearray(min(PART_BYTES, (coming.count - first + 7) // 8))
        for index in coming.parts:
            place = index - first
            if 0 <= place < 8 * len(bits):
                bits[place // 8] |= 1 << place % 8
        return [_pack(ACK, number, first, coming.count, coming.crc, bytes(bits))]

    def _refuse(self, number: int, crc: int, why: str) -> None:
        if len(self._refusals) < MAX_GOING:
            self._refusals.append(_pack(REFUSED, number, 0, 0, crc, why.encode()[:PART_BYTES]))

    def _fail(self, number: int, why: str) -> None:
        self.failed[number] = why
        while len(self.failed) > REMEMBERED:
            del self.failed[next(iter(self.failed))]


def _pack(kind: int, number: int, index: int, count: int, crc: int, data: bytes) -> bytes:
    return _HEADER.pack(_MAGIC, _VERSION, kind, number, index, count, crc) + data
