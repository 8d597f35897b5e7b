"""Messages through TUNNEL frames: delivered once, whole, in spite of the link; hostile payloads cost nothing."""

import itertools
import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from appliance.robots.mavlink.tunnel import (
    GIVE_UP_S,
    MAX_BYTES,
    MAX_COMING,
    MAX_GOING,
    MAX_PAYLOAD,
    MOST_WINDOW,
    PART,
    PART_BYTES,
    Channel,
    NotDelivered,
)


class Radio:
    """Two ends and a link that loses, doubles and reorders; time passes in steps."""

    def __init__(self, *, loss: float, seed: int) -> None:
        self.chance = random.Random(seed)  # noqa: S311 - a bad radio, no secret
        self.loss = loss
        self.now = 0.0
        numbers = itertools.count(seed << 8)
        self.ends = (Channel(lambda: next(numbers)), Channel(lambda: next(numbers)))
        self.got: tuple[list[bytes], list[bytes]] = ([], [])
        self.air: list[tuple[float, int, bytes]] = []
        self.frames = 0

    def step(self) -> None:
        """Let 50 ms pass."""
        self.now += 0.05
        for side in (0, 1):
            for payload in self.ends[side].due(self.now):
                assert len(payload) <= MAX_PAYLOAD
                self.frames += 1
                while self.chance.random() >= self.loss:
                    self.air.append((self.now + self.chance.uniform(0, 0.4), 1 - side, payload))
                    if self.chance.random() >= self.loss:
                        break
        landed = [each for each in self.air if each[0] <= self.now]
        self.air = [each for each in self.air if each[0] > self.now]
        self.chance.shuffle(landed)
        for _, side, payload in landed:
            whole = self.ends[side].take(payload, self.now)
            if whole is not None:
                self.got[side].append(whole)


letters = st.lists(st.binary(max_size=2000), max_size=6)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.binary(max_size=2000), max_size=6), st.lists(st.binary(max_size=2000), max_size=6), st.integers(0, 999)
)
def test_everything_arrives_once_over_a_bad_link(one: list[bytes], two: list[bytes], seed: int) -> None:
    """With a fifth of all frames lost, doubled and out of order, both ways, each message arrives once and whole."""
    radio = Radio(loss=0.2, seed=seed)
    sent = [(side, radio.ends[side].send(data, 0.0)) for side, some in ((0, one), (1, two)) for data in some]
    while any(radio.ends[side].going(number) for side, number in sent):
        radio.step()
        assert radio.now < 300
    assert not radio.ends[0].failed
    assert not radio.ends[1].failed
    assert sorted(radio.got[1]) == sorted(one)
    assert sorted(radio.got[0]) == sorted(two)


def test_a_good_link_wastes_nothing() -> None:
    """Without loss each part is sent once, and a message of many parts is acknowledged in a few frames."""
    radio = Radio(loss=0.0, seed=1)
    number = radio.ends[0].send(bytes(5000), 0.0)
    while radio.ends[0].going(number):
        radio.step()
    assert radio.got[1] == [bytes(5000)]
    assert radio.frames <= 45 + 45


def test_nobody_there() -> None:
    """A message that nobody acknowledges fails after a minute, with the reason, and is sent ever more seldom."""
    radio = Radio(loss=1.0, seed=1)
    number = radio.ends[0].send(b"hello", 0.0)
    while radio.ends[0].going(number):
        radio.step()
    assert radio.ends[0].failed == {number: "nothing was heard for 60 s"}
    assert radio.frames < 25


def _sent_parts(radio: Radio, *, until_s: float) -> int:
    """Let time pass, and count the parts that the first end sends."""
    before = radio.frames
    while radio.now < until_s:
        radio.step()
    return radio.frames - before


@pytest.mark.parametrize("outage_s", [5.0, 0.9 * GIVE_UP_S])
def test_after_an_outage_it_goes_on_where_it_was(outage_s: float) -> None:
    """A link that is cut in the middle of a message: what had arrived before is not sent again."""
    radio = Radio(loss=0.0, seed=6)
    data = random.Random(6).randbytes(MAX_BYTES)  # noqa: S311 - no secret
    number = radio.ends[0].send(data, 0.0)
    while len(radio.ends[0]._going[number].missing) > 60:
        radio.step()
    radio.loss, cut_at = 1.0, radio.now
    radio.air.clear()
    _sent_parts(radio, until_s=cut_at + outage_s)
    (coming,) = radio.ends[1]._coming.values()
    there = set(coming.parts)
    assert len(there) > 60
    radio.loss = 0.0
    again = set[int]()
    while radio.ends[0].going(number):
        radio.step()
        again |= {struct.unpack_from("<H", payload, 8)[0] for _, side, payload in radio.air if side == 1}
    assert radio.got[1] == [data]
    # The account of the last of them may have been lost with the link.
    assert len(again & there) <= 20, "at most a window of parts is sent again"


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 999), st.floats(0.1, 6.0), st.sampled_from([0.0, 0.2]))
def test_an_end_that_is_restarted_gets_the_whole_message(seed: int, after_s: float, loss: float) -> None:
    """Whenever it forgets what it had: the message arrives whole, and is not taken for delivered before."""
    radio = Radio(loss=loss, seed=seed)
    data = random.Random(seed).randbytes(6000)  # noqa: S311 - no secret
    number = radio.ends[0].send(data, 0.0)
    while radio.now < after_s and radio.ends[0].going(number):
        radio.step()
    before = list(radio.got[1])
    fresh = itertools.count()
    radio.ends = (radio.ends[0], Channel(lambda: next(fresh)))
    while radio.ends[0].going(number):
        radio.step()
        assert radio.now < 300
    assert not radio.ends[0].failed
    # Where it had been delivered, and the news of that was lost, the new end takes it as well.
    assert radio.got[1] in ([data], [*before, data])


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_more_long_messages_than_are_taken_at_once(loss: float) -> None:
    """As many as may wait, each far longer than a window: all arrive, some at a time, and none is given up."""
    radio = Radio(loss=loss, seed=8)
    chance = random.Random(8)  # noqa: S311 - no secret
    wanted = [chance.randbytes(4000) for _ in range(MAX_GOING)]
    sent = [radio.ends[0].send(data, 0.0) for data in wanted]
    most = 0
    while any(radio.ends[0].going(number) for number in sent):
        radio.step()
        most = max(most, len(radio.ends[1]._coming))
        assert radio.now < 600
    assert radio.now > GIVE_UP_S / 10
    assert sorted(radio.got[1]) == sorted(wanted)
    assert not radio.ends[0].failed
    assert most <= MAX_COMING


def test_an_end_that_must_make_room_is_sent_it_again() -> None:
    """Somebody begins messages and leaves them: one that was pushed out arrives whole all the same."""
    radio = Radio(loss=0.0, seed=9)
    data = random.Random(9).randbytes(5000)  # noqa: S311 - no secret
    number = radio.ends[0].send(data, 0.0)
    strange = itertools.count(1 << 30)
    for step in range(4000):
        radio.step()
        if step < 40:
            for _ in range(MAX_COMING):
                head = struct.pack("<2sBBIHHI", b"SB", 1, PART, next(strange), 0, 9, 1)
                radio.ends[1].take(head + bytes(112), radio.now)
        if not radio.ends[0].going(number):
            break
    assert radio.got[1] == [data]
    assert not radio.ends[0].failed


def test_nobody_there_for_those_that_wait() -> None:
    """With nobody at the other end those that wait for others are given up with them, not a minute later each."""
    radio = Radio(loss=1.0, seed=1)
    sent = [radio.ends[0].send(bytes(500), 0.0) for _ in range(3 * MAX_COMING)]
    while any(radio.ends[0].going(number) for number in sent):
        radio.step()
    assert set(radio.ends[0].failed) == set(sent)
    assert radio.now < GIVE_UP_S + 2.0


def test_what_is_not_sent() -> None:
    """Too long a message, and one too many, are refused before anything is sent."""
    end = Channel(itertools.count().__next__)
    with pytest.raises(NotDelivered, match="at most"):
        end.send(bytes(MAX_BYTES + 1), 0.0)
    for _ in range(MAX_GOING):
        end.send(b"", 0.0)
    with pytest.raises(NotDelivered, match="wait"):
        end.send(b"", 0.0)


def test_an_end_that_takes_less() -> None:
    """A message that is too long for the other end fails with its reason, at once."""
    radio = Radio(loss=0.0, seed=1)
    small = Channel(itertools.count().__next__, max_bytes=500)
    radio.ends = (radio.ends[0], small)
    number = radio.ends[0].send(bytes(1000), 0.0)
    for _ in range(20):
        radio.step()
    assert radio.ends[0].failed == {number: "at most 500 bytes are taken"}


@given(st.lists(st.binary(max_size=200) | st.binary(max_size=120).map(lambda data: b"SB\x01\x01" + data), max_size=40))
def test_no_payload_does_harm(payloads: list[bytes]) -> None:
    """Whatever comes, nothing is raised, memory is bounded, and a real message still gets through."""
    radio = Radio(loss=0.0, seed=3)
    for payload in payloads:
        radio.ends[1].take(payload, 0.0)
    number = radio.ends[0].send(b"still here", 0.0)
    for _ in range(20):
        radio.step()
    assert not radio.ends[0].going(number)
    assert b"still here" in radio.got[1]


def test_parts_that_are_cut_anywhere_cost_nothing() -> None:
    """Each part of a message, cut at every byte, comes before it comes whole: counted, and the message arrives."""
    radio = Radio(loss=0.0, seed=5)
    data = bytes(range(256)) * 2
    number = radio.ends[0].send(data, 0.0)
    *parts, last = radio.ends[0].due(0.0)
    cuts = [part[:cut] for part in parts for cut in range(len(part))] + [last[:cut] for cut in range(16)]
    for part in cuts:
        assert radio.ends[1].take(part, 0.0) is None
    assert radio.ends[1].malformed == len(cuts)
    assert [radio.ends[1].take(part, 0.0) for part in (*parts, last)] == [*([None] * len(parts)), data]
    while radio.ends[0].going(number):
        radio.step()
    assert not radio.ends[0].failed


def test_a_count_that_no_message_has_is_refused_and_kept_nowhere() -> None:
    """Sixty-five thousand parts announced, again and again: the sender hears so, and memory stays."""
    end = Channel(itertools.count().__next__)
    for number in range(1000):
        head = struct.pack("<2sBBIHHI", b"SB", 1, PART, number, number % 65_535, 65_535, 0)
        assert end.take(head + bytes(112), 0.0) is None
    assert not end._coming
    told = end.due(1.0)
    assert 0 < len(told) <= MAX_GOING
    assert all(b"at most" in each for each in told)


def test_a_changed_message_is_not_taken() -> None:
    """Parts that do not make the announced checksum are refused, and the sender hears so."""
    radio = Radio(loss=0.0, seed=4)
    number = radio.ends[0].send(bytes(150), 0.0)
    first, second = radio.ends[0].due(0.0)
    radio.ends[1].take(first[:-1] + b"x", 0.0)
    assert radio.ends[1].take(second, 0.0) is None
    for payload in radio.ends[1].due(1.0):
        radio.ends[0].take(payload, 1.0)
    assert radio.ends[0].failed == {number: "its checksum is wrong"}


class Slow:
    """Two ends and a radio of so many bytes a second, which keeps all that it is given until it has sent it."""

    def __init__(self, bytes_per_s: float) -> None:
        self.bytes_per_s = bytes_per_s
        self.now = 0.0
        numbers = itertools.count(1)
        self.ends = (Channel(lambda: next(numbers)), Channel(lambda: next(numbers)))
        self.free_at = [0.0, 0.0]
        self.air: list[tuple[float, int, bytes]] = []
        self.got: list[bytes] = []
        self.parts = 0
        self.most_waiting = 0

    def step(self) -> None:
        """Let 50 ms pass."""
        self.now += 0.05
        for side in (0, 1):
            for payload in self.ends[side].due(self.now):
                self.parts += side == 0
                # MAVLink 2 puts 12 bytes around a frame, and TUNNEL 5 before its payload.
                self.free_at[side] = max(self.now, self.free_at[side]) + (17 + len(payload)) / self.bytes_per_s
                self.air.append((self.free_at[side] + 0.1, 1 - side, payload))
        landed = [each for each in self.air if each[0] <= self.now]
        self.air = [each for each in self.air if each[0] > self.now]
        self.most_waiting = max(self.most_waiting, sum(side == 1 for _, side, _ in self.air))
        for _, side, payload in landed:
            whole = self.ends[side].take(payload, self.now)
            if whole is not None and side == 1:
                self.got.append(whole)


@pytest.mark.parametrize("baud", [57_600, 9_600, 4_800, 1_200])
def test_a_slow_radio_is_not_buried(baud: int) -> None:
    """However slow it is, and however many messages wait: each arrives, and repetitions do not fill the radio."""
    radio = Slow(baud / 10)
    chance = random.Random(3)  # noqa: S311 - no secret
    size = 4000 if baud > 2_000 else 1000
    wanted = [chance.randbytes(size) for _ in range(2 * MAX_COMING)]
    sent = [radio.ends[0].send(data, 0.0) for data in wanted]
    needed = len(wanted) * -(-size // PART_BYTES)
    ideal_s = needed * 145 / radio.bytes_per_s
    while any(radio.ends[0].going(number) for number in sent):
        radio.step()
        assert radio.now < 3 * ideal_s + 10.0
    assert not radio.ends[0].failed
    assert sorted(radio.got) == sorted(wanted)
    assert radio.parts <= 3 * needed
    assert radio.most_waiting <= 2 * MOST_WINDOW


def test_a_short_message_does_not_wait_for_a_long_one() -> None:
    """Messages share what may be under way: a word is there before a long text that was begun earlier."""
    radio = Slow(576.0)
    long = radio.ends[0].send(bytes(MAX_BYTES), 0.0)
    radio.step()
    short = radio.ends[0].send(b"stop", radio.now)
    while radio.ends[0].going(short):
        radio.step()
        assert radio.now < 20.0
    assert radio.got == [b"stop"]
    assert radio.ends[0].going(long)
