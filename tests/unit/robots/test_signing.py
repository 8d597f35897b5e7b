"""MAVLink 2 signing: what is believed, and that nothing forged or old is."""

import hashlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega

from appliance.errors import ConfigError
from appliance.robots.mavlink.dialect import Codec, Damage, Frame, make
from appliance.robots.mavlink.signing import WINDOW, Memory, Signer, read_key, ticks

KEY = hashlib.sha256(b"a passphrase").digest()
NOW = ticks(1_800_000_000)
BEAT = {"type": 2, "autopilot": 3, "base_mode": 0, "custom_mode": 4, "system_status": 4, "mavlink_version": 3}


class Clock:
    """A clock that stands until it is moved."""

    now = NOW

    def __call__(self) -> int:
        """Return the time it stands at."""
        return self.now


def codec(key: bytes = KEY, *, system: int = 1, memory: Memory | None = None, clock: Clock | None = None) -> Codec:
    """Return a codec that signs."""
    return Codec(system, 1, signer=Signer(key, link_id=3, memory=memory), clock=clock or Clock())


def kind(reader: Codec, raw: bytes) -> str:
    """Return why a frame is refused, empty when it is taken."""
    (found,) = reader.read(raw)
    return found.kind if isinstance(found, Damage) else ""


def test_a_signed_frame_is_taken_once() -> None:
    """A frame signed with the key is read; the very same frame again is a replay; the next one is read."""
    sender, reader = codec(), codec(system=245)
    first, second = (sender.pack(make("HEARTBEAT", **BEAT)) for _ in range(2))
    assert [kind(reader, raw) for raw in (first, first, second, first)] == ["", "replayed", "", "replayed"]


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("heard"), st.integers(0, 1), st.integers(0, 7)),
            st.tuples(st.just("restarted"), st.just(0), st.just(0)),
        ),
        max_size=40,
    )
)
def test_no_frame_is_believed_twice(events: list[tuple[str, int, int]]) -> None:
    """Recorded, repeated, out of order, over restarts: of each stream only ever newer frames; its next one is heard."""
    senders = [codec(system=1), codec(system=2)]
    recorded = [[sender.pack(make("HEARTBEAT", **BEAT)) for _ in range(8)] for sender in senders]
    reader = codec(system=245)
    newest = [-1, -1]
    for what, stream, number in events:
        if what == "restarted":
            assert reader.signer is not None
            reader = codec(system=245, memory=reader.signer.memory)
        else:
            taken = kind(reader, recorded[stream][number]) == ""
            assert taken == (number > newest[stream])
            newest[stream] = max(newest[stream], number)
    assert all(kind(reader, sender.pack(make("HEARTBEAT", **BEAT))) == "" for sender in senders)


def test_pymavlink_agrees() -> None:
    """Pymavlink believes what is signed here, and what it signs is believed here."""
    theirs = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    theirs.signing.secret_key, theirs.signing.sign_outgoing = KEY, True  # pyright: ignore[reportAttributeAccessIssue]
    theirs.signing.timestamp = NOW
    raw = bytes(make("HEARTBEAT", **BEAT).pack(theirs))
    assert kind(codec(system=245), raw) == ""
    assert theirs.decode(bytearray(codec(system=245).pack(make("HEARTBEAT", **BEAT)))).get_type() == "HEARTBEAT"


def test_what_is_not_signed_with_the_key() -> None:
    """Unsigned frames and those of another key are refused, but a radio's own status needs no signature."""
    reader = codec(system=245)
    assert kind(reader, Codec(1, 1).pack(make("HEARTBEAT", **BEAT))) == "unsigned"
    assert kind(reader, codec(bytes(32)).pack(make("HEARTBEAT", **BEAT))) == "bad_signature"
    radio = make("RADIO_STATUS", rssi=1, remrssi=1, txbuf=1, noise=1, remnoise=1, rxerrors=0, fixed=0)
    assert kind(reader, Codec(51, 68).pack(radio)) == ""
    assert kind(Codec(245, 191), codec().pack(make("HEARTBEAT", **BEAT))) == "signed"


@given(place=st.integers(0, 33), flip=st.integers(1, 255))
def test_no_bit_may_change(place: int, flip: int) -> None:
    """A frame with any changed byte is no frame, and the sender's next one is taken as if nothing had been."""
    sender, reader = codec(), codec(system=245)
    raw = bytearray(sender.pack(make("HEARTBEAT", **BEAT)))
    raw[place] ^= flip
    assert not any(isinstance(each, Frame) for each in reader.read(bytes(raw)))
    assert kind(reader, sender.pack(make("HEARTBEAT", **BEAT))) == ""


def test_a_forged_time_silences_nobody() -> None:
    """A frame with a far future timestamp and a wrong signature leaves its stream's time as it was."""
    sender, reader = codec(), codec(system=245)
    forged = bytearray(sender.pack(make("HEARTBEAT", **BEAT)))
    forged[-12:-6] = b"\xff" * 6
    assert kind(reader, bytes(forged)) == "bad_signature"
    assert kind(reader, sender.pack(make("HEARTBEAT", **BEAT))) == ""


def test_old_frames_of_a_new_stream() -> None:
    """A stream not heard before may be a minute behind, not more; one that is ahead moves our own time."""
    late, very_late, early = Clock(), Clock(), Clock()
    late.now, very_late.now, early.now = NOW - WINDOW + 2, NOW - WINDOW - 2, NOW + 5 * WINDOW
    reader = codec(system=245)
    assert kind(reader, codec(system=1, clock=late).pack(make("HEARTBEAT", **BEAT))) == ""
    assert kind(reader, codec(system=2, clock=very_late).pack(make("HEARTBEAT", **BEAT))) == "replayed"
    assert kind(reader, codec(system=3, clock=early).pack(make("HEARTBEAT", **BEAT))) == ""
    assert reader.signer is not None
    assert reader.signer.memory.timestamp >= NOW + 5 * WINDOW
    assert kind(reader, codec(system=4).pack(make("HEARTBEAT", **BEAT))) == "replayed"


def test_nothing_is_forgotten_over_a_restart() -> None:
    """What was heard before a restart is a replay after it; no timestamp is used twice though the clock went back."""
    sender, reader = codec(), codec(system=245)
    raw, mine = sender.pack(make("HEARTBEAT", **BEAT)), reader.pack(make("HEARTBEAT", **BEAT))
    assert kind(reader, raw) == ""
    assert reader.signer is not None
    back = Clock()
    back.now = NOW - 1000
    again = codec(system=245, memory=reader.signer.memory, clock=back)
    assert kind(again, raw) == "replayed"
    assert again.pack(make("HEARTBEAT", **BEAT))[-12:-6][::-1] > mine[-12:-6][::-1]


@pytest.mark.parametrize("old", [False, True])
def test_frames_pass_between_signed_and_unsigned_links(old: bool) -> None:
    """A frame is signed with the key of the link it goes out on, or freed of its signature; the message is the same."""
    plain, signed, other = Codec(1, 1), codec(system=245), codec(bytes(32), system=245)
    theirs = ardupilotmega.MAVLink(None, srcSystem=1, srcComponent=1)
    message = make("STATUSTEXT", severity=3, text=b"low battery")
    raw = bytes(message.pack(theirs, force_mavlink1=True)) if old else plain.pack(message)
    (frame,) = Codec(245, 191).read(raw)
    assert isinstance(frame, Frame)
    assert Codec(245, 191).pass_on(frame) == raw
    (again,) = codec(system=9).read(signed.pass_on(frame))
    assert isinstance(again, Frame)
    (third,) = codec(bytes(32), system=9).read(other.pass_on(again))
    assert isinstance(third, Frame)
    (last,) = Codec(245, 191).read(plain.pass_on(third))
    assert isinstance(last, Frame)
    for each in (again, third, last):
        assert (each.system, each.component, each.sequence) == (1, 1, frame.sequence)
        assert each.message.text == frame.message.text


def test_keys(tmp_path: Path) -> None:
    """A passphrase is hashed as ground stations do, a hex key is taken as it is, anything else is refused."""
    path = tmp_path / "key"

    def write(text: bytes, mode: int = 0o600) -> str:
        path.unlink(missing_ok=True)
        path.write_bytes(text)
        path.chmod(mode)
        return str(path)

    assert read_key(write(b"a passphrase\n")) == KEY
    assert read_key(write(b"hex:" + b"0f" * 32)) == b"\x0f" * 32
    for text, mode, told in (
        (b"", 0o600, "empty"), (b"hex:12", 0o600, "64 digits"), (b"\xff\xfe", 0o600, "no text"), (b"x", 0o644, "chmod"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=told) as caught:
            read_key(write(text, mode))
        assert caught.value.remedy
    with pytest.raises(ConfigError, match="cannot be read"):
        read_key(str(tmp_path / "none"))


def test_a_key_from_systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`credential:NAME` is read from the folder that systemd makes for the service."""
    (tmp_path / "mavlink").write_text("a passphrase")
    (tmp_path / "mavlink").chmod(0o400)
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert read_key("credential:mavlink") == KEY


@given(seconds=st.integers(0, 4), crashes=st.integers(1, 5))
def test_a_crash_uses_no_time_twice(seconds: int, crashes: int) -> None:
    """What was kept up to five seconds ago is enough, with a clock that went back: own times rise, old frames are old.

    And a vehicle that is heard for the first time after all those crashes is not shut out.
    """
    sender, clock, memory, before = codec(), Clock(), Memory(), b""
    clock.now = NOW
    for _ in range(crashes):
        reader = codec(system=245, memory=memory, clock=clock)
        assert reader.signer is not None
        assert kind(reader, sender.pack(make("HEARTBEAT", **BEAT))) == ""
        memory = reader.signer.ahead
        clock.now += seconds * 100_000
        heard = sender.pack(make("HEARTBEAT", **BEAT))
        assert kind(reader, heard) == ""
        mine = reader.pack(make("HEARTBEAT", **BEAT))[-12:-6][::-1]
        assert mine > before
        before = mine
        clock.now = NOW - 1000
        again = codec(system=245, memory=memory, clock=clock)
        assert kind(again, heard) == "replayed"
        sender._clock.now += 10 * 100_000  # pyright: ignore[reportFunctionMemberAccess]
    assert kind(codec(system=245, memory=memory, clock=clock), codec(system=9).pack(make("HEARTBEAT", **BEAT))) == ""
