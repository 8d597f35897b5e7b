"""Encrypted streams: what went in comes out with its passphrase; nothing else does."""

import io
import struct

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.deploy import sealed
from appliance.deploy.sealed import MAGIC, PART, TAG, Opener, Sealer
from appliance.errors import IdentityError, PayloadError, SwiftbotError

WORDS = "correct horse battery staple"


def seal(*parts: bytes) -> bytes:
    """Encrypt."""
    out = io.BytesIO()
    sealer = Sealer(out, WORDS, cost_log2=2)
    for part in parts:
        sealer.write(part)
    sealer.close()
    return out.getvalue()


def unseal(data: bytes, words: str = WORDS) -> bytes:
    """Decrypt."""
    return Opener(io.BytesIO(data), words, name="file").read()


@settings(deadline=None)
@given(st.lists(st.sampled_from([0, 1, 1000, PART - 1, PART, PART + 1, 2 * PART]), max_size=4), st.data())
def test_what_goes_in_comes_out(sizes: list[int], data: st.DataObject) -> None:
    """However it is cut when it is written and when it is read."""
    parts = [bytes([number]) * size for number, size in enumerate(sizes, start=1)]
    whole = b"".join(parts)
    opener = Opener(io.BytesIO(seal(*parts)), WORDS, name="file")
    got = bytearray()
    while part := opener.read(data.draw(st.sampled_from([7, 4096, PART, 3 * PART])) if len(got) < PART else PART):
        got += part
    assert bytes(got) == whole


def test_another_passphrase_is_refused_as_such() -> None:
    """Not as damage, and before anything is read."""
    with pytest.raises(IdentityError, match="wrong passphrase"):
        unseal(seal(b"secret"), "another")


def test_cut_off_anywhere_is_refused() -> None:
    """In the header, within a part, between two parts, and with the last part away."""
    whole = seal(b"x" * (2 * PART + 5))
    header = len(whole) - 2 * (PART + TAG) - 5 - TAG
    places = [0, 5, len(MAGIC), len(MAGIC) + 4, header - 1, header, header + 1, header + PART + TAG]
    for cut in [*places, header + 2 * (PART + TAG), len(whole) - 1]:
        with pytest.raises(PayloadError, match=r"no backup|header is damaged|cut off"):
            unseal(whole[:cut])


@settings(deadline=None)
@given(st.data())
def test_changed_anywhere_is_refused(data: st.DataObject) -> None:
    """One bit of it, two parts exchanged, bytes behind it."""
    whole = seal(b"a" * PART, b"b" * PART, b"c")
    at = data.draw(st.integers(0, len(whole) - 1))
    changed = whole[:at] + bytes([whole[at] ^ (1 << data.draw(st.integers(0, 7)))]) + whole[at + 1 :]
    with pytest.raises(SwiftbotError):
        unseal(changed)
    with pytest.raises(PayloadError):
        unseal(whole + b"x")
    begin = len(whole) - 2 * (PART + TAG) - 1 - TAG
    one, two = whole[begin : begin + PART + TAG], whole[begin + PART + TAG : begin + 2 * (PART + TAG)]
    with pytest.raises(PayloadError, match="damaged"):
        unseal(whole[:begin] + two + one + whole[begin + 2 * (PART + TAG) :])


def test_a_header_that_asks_for_too_much_is_refused() -> None:
    """A cost that would take all memory is not tried."""
    header = sealed.Header(cost_log2=40, salt=bytes(16), nonce=bytes(7), part=PART)
    text = msgspec.json.encode(header)
    with pytest.raises(PayloadError, match="header is damaged"):
        unseal(MAGIC + struct.pack(">I", len(text)) + text)


def test_the_plain_text_is_nowhere() -> None:
    """Neither the content nor the passphrase stands in the file, and two files of one content differ."""
    one, two = seal(b"private key" * 100), seal(b"private key" * 100)
    assert b"private key" not in one
    assert WORDS.encode() not in one
    assert one[-50:] != two[-50:]
    assert sealed.COST_LOG2 >= 17
