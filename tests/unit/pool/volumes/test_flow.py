"""How many chunks may be on their way, what moving costs, and what follows from failures."""

import math

from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import DeadlineError, NotFoundError, PayloadError, RefusedError, UnreachableError
from appliance.pool.selection import Link
from appliance.pool.volumes.protocol import FAILURES, TRUST, Next, Window, after_failure, updated_link

CHUNK = 2**20


@given(
    most=st.integers(1, 64),
    events=st.lists(st.tuples(st.booleans(), st.integers(0, CHUNK), st.floats(0, 5)), max_size=60),
    known=st.none() | st.floats(1e3, 1e10),
)
def test_window_is_bounded(most: int, events: list[tuple[bool, int, float]], known: float | None) -> None:
    """Whatever arrives or is lost, at least one and at most the set number of chunks may be on their way."""
    window = Window(most=most, in_flight_s=0.2, chunk_bytes=CHUNK, bytes_per_s=known)
    now = 0.0
    for arrived, size, passed in events:
        now += passed
        if arrived:
            window.arrived(size, now)
        else:
            window.lost()
        assert 1 <= window.size <= most
        assert 0 < window.timeout_s(5.0) < math.inf


@given(rate=st.floats(1e4, 1e9))
def test_window_settles_at_what_the_link_carries(rate: float) -> None:
    """After some chunks no more is on its way than the link carries in the set time, and one chunk."""
    window, now = Window(most=64, in_flight_s=0.2, chunk_bytes=CHUNK), 0.0
    for _ in range(200):
        now += CHUNK / rate
        window.arrived(CHUNK, now)
    assert window.size * CHUNK <= max(CHUNK, rate * 0.2 * 1.05 + CHUNK)
    assert window.size == min(64, max(1, window.size))


def test_slow_link_carries_one_chunk() -> None:
    """On 1 Mbit/s a single chunk of 1 MiB is on its way, and it is given the time it takes."""
    window = Window(most=16, in_flight_s=0.2, chunk_bytes=CHUNK, bytes_per_s=125_000)
    assert window.size == 1
    assert window.timeout_s(5.0) > CHUNK / 125_000


@given(samples=st.lists(st.tuples(st.integers(1, 10**10), st.floats(1e-6, 1e4)), max_size=10))
def test_what_is_measured_of_a_link_is_finite(samples: list[tuple[int, float]]) -> None:
    """Rates are positive and finite, whatever was measured."""
    link = Link()
    for bytes_, took_s in samples:
        link = updated_link(link, size_bytes=bytes_, move_s=took_s, pack_s=took_s, unpack_s=took_s)
        for rate in (link.bandwidth, link.pack_bytes_per_s, link.unpack_bytes_per_s):
            assert rate is not None
            assert 0 < rate < math.inf


def test_a_link_after_its_first_transfer() -> None:
    """100 MB in 1 s, packed in 0.2 and unpacked in 0.4 s."""
    link = updated_link(Link(), size_bytes=100_000_000, move_s=1.0, pack_s=0.2, unpack_s=0.4)
    assert link == Link(bytes_per_s=100e6, pack_bytes_per_s=500e6, unpack_bytes_per_s=250e6)


def test_what_follows_from_failures() -> None:
    """A liar is left after three bad chunks, one that is gone at once, a slow or busy one after six in a row."""
    assert after_failure(PayloadError("x"), in_a_row=1, bad=1).next is Next.AGAIN
    assert after_failure(PayloadError("x"), in_a_row=1, bad=TRUST).next is Next.OTHER
    assert after_failure(UnreachableError("x"), in_a_row=1, bad=0).next is Next.OTHER
    assert after_failure(NotFoundError("x"), in_a_row=1, bad=0).next is Next.REFRESH
    for error in (DeadlineError("x"), RefusedError("x")):
        waits = [after_failure(error, in_a_row=count, bad=0) for count in range(1, FAILURES)]
        assert all(each.next is Next.AGAIN and 0 < each.wait_s <= 2 for each in waits)
        assert after_failure(error, in_a_row=FAILURES, bad=0).next is Next.OTHER
