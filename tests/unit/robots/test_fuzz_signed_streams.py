"""Streams of signed and unsigned frames of both versions, cut anywhere, with damage, as pymavlink reads them too."""

import itertools
from collections import Counter
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from appliance.robots.mavlink.dialect import Codec, Damage, Frame, Stream, make
from appliance.robots.mavlink.signing import Signer
from tests.unit.robots.links import BEAT, KEY

NOW = 10_000_000_000
"""Ticks of 10 µs since 2015, at which all is signed."""
COUNT = 12
"""Frames of each kind: their times of signing grow from one to the next, as their sequence numbers do."""


def _made(version: str) -> list[bytes]:
    stamps = itertools.count(NOW)
    key = {"signed": KEY, "forged": b"x" * 32}.get(version)
    signer = None if key is None else Signer(key, link_id=1)
    codec = Codec({"v1": 3, "v2": 4, "signed": 5, "forged": 6}[version], 1, signer=signer, clock=lambda: next(stamps),
                  v1=version == "v1")  # fmt: skip
    messages = (
        make("HEARTBEAT", **BEAT),
        make("PARAM_VALUE", param_id=b"X", param_value=1.0, param_type=9, param_count=1, param_index=0),
        make("STATUSTEXT", severity=4, text=b"\xfd\xfe\xfd\x09", id=0, chunk_seq=0),
    )
    return [codec.pack(messages[number % 3]) for number in range(COUNT)]


KINDS = {version: _made(version) for version in ("v1", "v2", "signed", "forged")}


@st.composite
def undamaged(draw: st.DrawFn) -> list[bytes]:
    """Draw frames of all kinds, each kind's in its own order."""
    next_of = dict.fromkeys(KINDS, 0)
    found: list[bytes] = []
    for version in draw(st.lists(st.sampled_from(list(KINDS)), max_size=COUNT)):
        found.append(KINDS[version][next_of[version]])
        next_of[version] += 1
    return found


@st.composite
def streams(draw: st.DrawFn) -> bytes:
    """Draw a stream: some of its frames with a byte changed, lost or inserted, cut, doubled, or behind noise."""
    whole = bytearray()
    for raw in draw(undamaged()):
        piece = bytearray(raw)
        place = draw(st.integers(0, len(piece) - 1))
        match draw(st.sampled_from(["good", "good", "good", "flip", "lose", "insert", "cut", "double", "noise"])):
            case "flip":
                piece[place] ^= draw(st.integers(1, 255))
            case "lose":
                del piece[place]
            case "insert":
                piece.insert(place, draw(st.sampled_from([0, 1, 0xFD, 0xFE])))
            case "cut":
                del piece[place:]
            case "double":
                piece += raw
            case "noise":
                piece = bytearray(draw(st.binary(max_size=9))) + piece
            case _:
                pass
        whole += piece
    return bytes(whole)


def read(pieces: list[bytes], *, signed: bool, end: bool = True) -> tuple[list[bytes], Counter[str]]:
    """Return frames and counters of a stream in pieces, on a link with a key or without."""
    codec = Codec(245, 191, signer=Signer(KEY, link_id=0) if signed else None, clock=lambda: NOW)
    stream = Stream(codec)
    found = [each for piece in pieces for each in stream.feed(piece)]
    if end:
        found += stream.end()
        assert stream.pending == 0
    counted = Counter(each.kind for each in found if isinstance(each, Damage) and each.counted)
    return [each.raw for each in found if isinstance(each, Frame)], counted


@given(streams(), st.lists(st.integers(0, 900), max_size=10), st.booleans())
def test_no_cut_changes_what_a_stream_tells(whole: bytes, cuts: list[int], signed: bool) -> None:
    """The same frames and counters, with a key and without, at once and when the end has come."""
    places = [0, *sorted(each for each in cuts if each < len(whole)), len(whole)]
    pieces = [whole[one:two] for one, two in itertools.pairwise(places)]
    singly = [whole[at : at + 1] for at in range(len(whole))]
    for end in (False, True):
        told = read([whole], signed=signed, end=end)
        assert told == read(pieces, signed=signed, end=end) == read(singly, signed=signed, end=end)
    frames, _ = told
    sent = {raw for kind in KINDS.values() for raw in kind}
    assert all(raw in sent for raw in frames), "nothing that was not sent"
    if signed:
        assert len(frames) == len(set(frames)), "nothing that is signed is believed twice"
        assert set(frames) <= set(KINDS["signed"])
    else:
        assert not set(frames) & {*KINDS["signed"], *KINDS["forged"]}


def _pymavlink(whole: bytes, *, signed: bool) -> list[bytes]:
    """Return the frames that pymavlink finds and believes."""
    parser: Any = ardupilotmega.MAVLink(None)
    parser.robust_parsing = True
    if signed:
        parser.signing.secret_key = KEY
        parser.signing.timestamp = NOW
        parser.signing.link_id = 0
        parser.signing.sign_outgoing = True
        parser.signing.allow_unsigned_callback = lambda *_: False
    found: list[Any] = parser.parse_buffer(bytearray(whole)) or []
    return [bytes(each.get_msgbuf()) for each in found if not each.get_type().startswith(("BAD_DATA", "UNKNOWN"))]


@given(undamaged(), st.integers(1, 300), st.booleans())
def test_undamaged_frames_are_all_found_as_pymavlink_finds_them(sent: list[bytes], size: int, signed: bool) -> None:
    """The same ones in the same order; what lacks is counted by why it is not believed."""
    whole = b"".join(sent)
    frames, counted = read([whole[at : at + size] for at in range(0, len(whole), size)], signed=signed)
    theirs = _pymavlink(whole, signed=signed)
    if signed:
        assert frames == theirs == [raw for raw in sent if raw in KINDS["signed"]]
        assert counted["unsigned"] == sum(raw in KINDS["v1"] + KINDS["v2"] for raw in sent)
        assert counted["bad_signature"] == sum(raw in KINDS["forged"] for raw in sent)
    else:
        # pymavlink passes a signature that it cannot look at; a gateway without a key believes none.
        assert theirs == sent
        assert frames == [raw for raw in sent if raw in KINDS["v1"] + KINDS["v2"]]
        assert counted["signed"] == len(sent) - len(frames)
    assert counted.total() == len(sent) - len(frames)
