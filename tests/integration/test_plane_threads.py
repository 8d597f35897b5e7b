"""Zenoh's threads under real sessions: their state of Python's, reads while the owner writes, many sessions at once."""
# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from plane_fleet import Fleet, fleet_of, until

from appliance.errors import SwiftbotError
from appliance.plane import link, threads
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.versions import Record

pytestmark = pytest.mark.anyio


async def test_a_thread_of_zenohs_keeps_its_state(free_port: int) -> None:
    """What a callback leaves with its thread is there at the next; that of a session that was closed too."""
    here, seen = threading.local(), dict[int, list[bool]]()

    def take(_: object) -> None:
        seen.setdefault(threading.get_native_id(), []).append(hasattr(here, "been"))
        here.been = True

    listen = PlaneConfig(listen=(f"tcp/127.0.0.1:{free_port}",))
    one = await asyncio.to_thread(link.open_raw, listen)
    for _ in range(3):
        other = await asyncio.to_thread(link.open_raw, PlaneConfig(connect=listen.listen))
        came = sum(map(len, seen.values()))
        subscriber = one.declare_subscriber("probe", threads.callback(take))
        while sum(map(len, seen.values())) < came + 20:
            other.put("probe", b"x")
            await asyncio.sleep(0.001)
        subscriber.undeclare()
        await asyncio.to_thread(other.close)
    await asyncio.to_thread(one.close)
    for number, been in seen.items():
        assert been == [False] + [True] * (len(been) - 1)
        # One that has ended meanwhile is kept no more.
        assert number in threads._kept.states or not (threads._TASKS / str(number)).exists()


@pytest.fixture
async def fleet(tmp_path: Path, free_ports: Callable[..., list[int]]) -> AsyncIterator[Fleet]:
    """Three gateways that see each other."""
    async with fleet_of(tmp_path, free_ports(3)) as made:
        for number in range(3):
            await made.start(number)
        await made.settled()
        yield made


async def test_reads_are_answered_there_while_the_owner_writes_and_goes(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None misses the record or finds an older one than the last, from its owner or, once that has gone, a replica."""
    key, threads_of_answers = fleet.owned_by(1), set[int]()
    owner, reader = fleet.planes[1], fleet.planes[0]
    look = owner.store.look

    def spy(asked: str) -> tuple[bool, Record | None]:
        threads_of_answers.add(threading.get_ident())
        return look(asked)

    monkeypatch.setattr(owner.store, "look", spy)
    version = await owner.dht.write(key, b"0", expected=None)
    written, reading, found = 0, True, [0, 0]

    async def read(who: int) -> None:
        while reading:
            least = max(written, found[who])
            record = await reader.dht.read(key)
            assert record is not None
            found[who] = int(record.value)
            assert found[who] >= least
            await asyncio.sleep(0)  # one that is found here is read without a wait, and others run too

    readers = [asyncio.create_task(read(who)) for who in range(2)]
    for number in range(1, 100):
        version = await owner.dht.write(key, str(number).encode(), expected=version, durable=False)
        written = number
    await until(lambda: found == [99, 99] or any(each.done() for each in readers))
    assert threads_of_answers
    assert threading.get_ident() not in threads_of_answers
    await fleet.stop(1)
    await until(lambda: len(reader.members()) == 2)
    version = await fleet.planes[2].dht.write(key, b"100", expected=version)
    written = 100
    await until(lambda: found == [100, 100] or any(each.done() for each in readers))
    reading = False
    await asyncio.gather(*readers)


async def test_bad_reads_are_counted(fleet: Fleet) -> None:
    """What is no question for a record, or for one that cannot be, is refused by the handler as any."""
    owner, session = fleet.planes[1], fleet.planes[0].session
    asked = session.keys.rpc("g1", "dht_read")
    bad = (b"", b"{", b"[]", b'{"key": 1}', b'{"key": ""}', b'{"key": "' + b"x" * 5000 + b'"}')
    for number, payload in enumerate(bad):
        session._wire.raw.put(session.keys.direct("g1"), payload, attachment=f"{number} abc {asked}".encode())
    await until(lambda: owner.session.refused.get("malformed gw/g1/rpc/dht_read") == len(bad))


async def test_many_sessions_open_and_close_at_once(free_port: int) -> None:
    """None stands still: each answers another's questions while the next ones come and the last ones go."""

    async def echo(_: str, payload: bytes) -> bytes:
        return payload

    first = f"tcp/127.0.0.1:{free_port}"
    hub = await Session.open(PlaneConfig(listen=(first,)), "f")
    hub.serve("swiftbot/f/gw/hub/rpc/ask", echo, direct=True)

    async def live(number: int) -> None:
        session = await Session.open(PlaneConfig(connect=(first,)), "f")
        key = f"swiftbot/f/gw/g{number}/rpc/ask"
        session.serve(key, echo, direct=True)
        session.subscribe("swiftbot/f/**", lambda _: None)
        for asker, asked in ((session, "swiftbot/f/gw/hub/rpc/ask"), (hub, key)):
            answer = b""
            while not answer:
                with contextlib.suppress(SwiftbotError):
                    answer = await asker.query(asked, b"x", timeout_s=5, direct=True)
                await asyncio.sleep(0)
        await session.close()

    for turn in range(4):
        await asyncio.gather(*(live(10 * turn + number) for number in range(10)))
    await hub.close()
