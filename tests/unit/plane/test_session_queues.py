"""The queues between the event loop and Zenoh's threads."""

import asyncio
import threading
from functools import partial

import pytest

from appliance.plane.session import TELEMETRY_PART, Inbox, Outbox

pytestmark = pytest.mark.anyio


async def test_calls_arrive_in_order_on_the_loop() -> None:
    """What another thread posts runs on the loop's thread, in order, however many there are."""
    inbox = Inbox(asyncio.get_running_loop(), messages=10_000, payload_bytes=10**6)
    seen: list[tuple[int, int]] = []
    done = asyncio.Event()

    def flood() -> None:
        for n in range(2000):
            inbox.post(partial(note, n), 1)
        inbox.post(done.set)

    def note(n: int) -> None:
        seen.append((n, threading.get_ident()))

    thread = threading.Thread(target=flood)
    thread.start()
    await done.wait()
    thread.join()
    assert [n for n, _ in seen] == list(range(2000))
    assert {ident for _, ident in seen} == {threading.get_ident()}


async def test_a_full_inbox_drops_and_counts() -> None:
    """Beyond its bounds an inbox drops; what must arrive (ends of queries) still does."""
    told: list[int] = []
    inbox = Inbox(asyncio.get_running_loop(), messages=3, payload_bytes=100, on_dropped=told.append)
    seen: list[str] = []
    assert inbox.post(partial(seen.append, "a"), 60)
    assert not inbox.post(partial(seen.append, "too large"), 60)
    assert inbox.post(partial(seen.append, "b"), 10)
    assert inbox.post(partial(seen.append, "c"), 10)
    assert not inbox.post(partial(seen.append, "too many"), 1)
    assert inbox.post(partial(seen.append, "end"), must=True)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert seen == ["a", "b", "c", "end"]
    assert inbox.dropped == 2
    assert told == [2]
    assert inbox.post(partial(seen.append, "again"), 60)
    inbox.close()
    assert not inbox.post(partial(seen.append, "closed"))


async def test_a_failing_receiver_does_not_stop_the_others() -> None:
    """One receiver's exception is logged; the next delivery comes all the same."""
    inbox = Inbox(asyncio.get_running_loop(), messages=10, payload_bytes=100)
    done = asyncio.Event()

    def fail() -> None:
        raise ValueError("receiver")

    inbox.post(fail)
    inbox.post(done.set)
    await done.wait()


async def test_a_stuck_send_holds_up_nobody_but_later_sends() -> None:
    """While a send blocks, `send` returns at once; beyond the bound it drops; order is kept."""
    outbox = Outbox(messages=3, payload_bytes=1000)
    stuck, begun = threading.Event(), threading.Event()
    sent: list[int] = []

    def block() -> None:
        begun.set()
        stuck.wait()

    assert outbox.send(block, 1)
    await asyncio.to_thread(begun.wait)
    assert all(outbox.send(partial(sent.append, n), 1) for n in range(3))
    assert not outbox.send(partial(sent.append, 3), 1)
    assert outbox.dropped == 1
    stuck.set()
    await asyncio.to_thread(outbox.close, 10.0)
    assert sent == [0, 1, 2]
    assert not outbox.send(partial(sent.append, 4), 1)


async def test_telemetry_leaves_a_part_of_the_queue_to_everything_else() -> None:
    """What may fill a part of it is dropped from there on; an order still goes."""
    outbox = Outbox(messages=8, payload_bytes=1000)
    stuck, begun = threading.Event(), threading.Event()

    def block() -> None:
        begun.set()
        stuck.wait()

    assert outbox.send(block, 1)
    await asyncio.to_thread(begun.wait)
    frames = [outbox.send(partial(int, 1), 1, part=TELEMETRY_PART) for _ in range(10)]
    assert frames.count(True) == 6
    assert [outbox.send(partial(int, 1), 1) for _ in range(3)] == [True, True, False]
    assert not outbox.send(partial(int, 1), 900, part=TELEMETRY_PART)
    stuck.set()
    await asyncio.to_thread(outbox.close, 10.0)


async def test_a_failing_send_does_not_stop_the_others() -> None:
    """One send's exception is logged; the next is sent all the same."""
    outbox = Outbox(messages=10, payload_bytes=1000)
    sent: list[int] = []

    def fail() -> None:
        raise ValueError("send")

    outbox.send(fail, 1)
    outbox.send(partial(sent.append, 1), 1)
    await asyncio.to_thread(outbox.close, 10.0)
    assert sent == [1]
