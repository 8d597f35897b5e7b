"""What must not be forgotten: one SQLite file, one thread."""

import asyncio
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

import pytest

from appliance.errors import ConfigError, ConflictError, PrerequisiteError, RefusedError
from appliance.model.plane_api import Record, Write
from appliance.plane.records import decide
from appliance.plane.store import Store

pytestmark = pytest.mark.anyio


def _record(key: str, value: bytes = b"v", count: int = 1, *, deleted: bool = False) -> Record:
    return Record(key=key, value=value, version={"a": count}, deleted=deleted, write=f"w{count}")


async def test_plain_keys(tmp_path: Path) -> None:
    """Values are kept, replaced, listed by prefix in order, and deleted; absent keys are None."""
    store = await Store.open(tmp_path / "s.sqlite")
    await store.put("run/b", b"2")
    await store.put("run/a", b"1", durable=False)
    await store.put("run/a", b"3")
    await store.put("runs", b"x")
    await store.put("run/\U0010fffe", b"last")
    assert await store.get("run/a") == b"3"
    assert await store.get("nothing") is None
    assert await store.scan("run/") == [("run/a", b"3"), ("run/b", b"2"), ("run/\U0010fffe", b"last")]
    await store.delete("run/a")
    await store.delete("run/a")
    assert len(await store.scan("")) == 3
    await store.close()


async def test_everything_is_there_after_closing(tmp_path: Path) -> None:
    """Records, tombstones and plain keys are the same after the file is closed and opened."""
    store = await Store.open(tmp_path / "s.sqlite")
    await store.put("k", b"\x00\xff")
    one, gone = _record("task/1", b"\x00" * 5000), _record("task/2", b"", 2, deleted=True)
    for record in (one, gone):
        assert await store.change(record.key, lambda _, record=record: record) == record
    await store.close()
    store = await Store.open(tmp_path / "s.sqlite")
    assert await store.get("k") == b"\x00\xff"
    assert await store.records("task/") == [one, gone]
    assert [key for key, _ in await store.digests()] == ["task/1", "task/2"]
    await store.forget_tombstones(2**62)
    assert await store.records("") == [one]
    await store.forget(_record("task/1", b"another", 9))
    assert await store.record("task/1") == one
    await store.forget(one)
    assert await store.record("task/1") is None
    await store.close()


async def test_one_of_many_writers_wins(tmp_path: Path) -> None:
    """Of 50 writers that saw the same version exactly one succeeds; the others conflict, and nobody else fails."""
    store = await Store.open(tmp_path / "s.sqlite")
    asks = [Write(key="k", value=str(n).encode(), write=f"w{n}") for n in range(50)]
    results = await asyncio.gather(
        *(store.change("k", lambda now, ask=ask: decide(now, ask, "a")) for ask in asks),
        *(store.put(f"other/{n}", b"x") for n in range(50)),
        return_exceptions=True,
    )
    won = [each for each in results[:50] if isinstance(each, Record)]
    assert len(won) == 1
    assert sum(isinstance(each, ConflictError) for each in results[:50]) == 49
    assert results[50:] == [None] * 50
    assert await store.record("k") == won[0]
    assert len(await store.scan("other/")) == 50
    await store.close()


async def test_a_decision_may_change_nothing(tmp_path: Path) -> None:
    """A decision that keeps what is there writes nothing, and an error of any kind is its caller's alone."""
    store = await Store.open(tmp_path / "s.sqlite")
    assert await store.change("k", lambda _: None) is None
    assert await store.record("k") is None

    def fail(_: Record | None) -> Record:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await store.change("k", fail)
    await store.put("still", b"works")
    await store.close()


WRITER = """
import asyncio, sys
from pathlib import Path
from appliance.plane.store import Store
async def main():
    store = await Store.open(Path(sys.argv[1]))
    for n in range(100000):
        await store.put(f"{n:06}", b"x" * 500)
        print(n, flush=True)
asyncio.run(main())
"""


def _write_until_killed(path: Path) -> int:
    """Write in a process of its own, kill it in the midst; returns the number of values it was told are kept."""
    child = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    acknowledged = 0
    for acknowledged, _ in enumerate(child.stdout, start=1):
        if acknowledged == 200:
            break
    child.send_signal(signal.SIGKILL)
    acknowledged += len(child.stdout.read().splitlines())
    child.stdout.close()
    child.wait()
    return acknowledged


async def test_what_was_acknowledged_survives_sigkill(tmp_path: Path) -> None:
    """A process killed in the midst of writing leaves a sound file with every acknowledged value."""
    path = tmp_path / "s.sqlite"
    acknowledged = await asyncio.to_thread(_write_until_killed, path)
    assert acknowledged >= 200
    store = await Store.open(path)
    assert store.set_aside is None
    assert [key for key, _ in await store.scan("")][:acknowledged] == [f"{n:06}" for n in range(acknowledged)]
    await store.close()


@pytest.mark.parametrize("damage", ["garbage", "middle", "truncated"])
async def test_a_damaged_file_is_moved_aside(tmp_path: Path, damage: str) -> None:
    """A file that cannot be read is moved aside with its bytes, and the store starts empty and works."""
    path = tmp_path / "s.sqlite"
    store = await Store.open(path)
    for n in range(200):
        await store.put(f"{n}", b"x" * 1000)
    await store.close()
    whole = path.read_bytes()
    damaged = {
        "garbage": os.urandom(10_000),
        "middle": whole[:4096] + os.urandom(len(whole) - 4096),
        "truncated": whole[: len(whole) // 2],
    }[damage]
    path.write_bytes(damaged)
    store = await Store.open(path)
    assert store.set_aside is not None
    assert store.set_aside.read_bytes() == damaged
    assert await store.scan("") == []
    await store.put("k", b"v")
    await store.close()


async def test_a_second_gateway_on_the_same_file_is_refused(tmp_path: Path) -> None:
    """Two gateways with one data_dir: the second gets an error that says so."""
    store = await Store.open(tmp_path / "s.sqlite")
    with pytest.raises(ConfigError, match="in use by another gateway"):
        await Store.open(tmp_path / "s.sqlite")
    await store.close()
    await (await Store.open(tmp_path / "s.sqlite")).close()


async def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    """A data_dir that cannot be made is a configuration error naming the path."""
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="data_dir"):
        await Store.open(tmp_path / "file" / "s.sqlite")


async def test_a_newer_schema_is_refused(tmp_path: Path) -> None:
    """A file of a newer version is left alone, with an error that says what to install."""
    path = tmp_path / "s.sqlite"
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    with pytest.raises(ConfigError, match="newer version"):
        await Store.open(path)
    assert path.exists()


async def test_a_full_disk_is_said_so_and_loses_nothing(tmp_path: Path) -> None:
    """When no more fits, the write fails with the cause; what was there stays, and writing goes on when it fits."""
    store = await Store.open(tmp_path / "s.sqlite")
    await store.put("before", b"x")
    pages = (await store._read("PRAGMA page_count"))[0][0]
    await store._read(f"PRAGMA max_page_count = {pages + 2}")
    with pytest.raises(PrerequisiteError, match="full"):
        await store.put("large", b"x" * 1_000_000)
    # A small write queued together with one that does not fit is not failed by it.
    results = await asyncio.gather(
        store.put("large", b"x" * 1_000_000), store.put("small", b"y"), return_exceptions=True
    )
    assert isinstance(results[0], PrerequisiteError)
    assert results[1] is None
    await store._read("PRAGMA max_page_count = 1000000")
    await store.put("large", b"x" * 1_000_000)
    assert sorted(key for key, _ in await store.scan("")) == ["before", "large", "small"]
    await store.close()


async def test_a_closed_store_refuses(tmp_path: Path) -> None:
    """Using a closed store is an error, not a wait for ever; closing does what was asked before."""
    store = await Store.open(tmp_path / "s.sqlite")
    writing = asyncio.gather(*(store.put(f"{n}", b"x") for n in range(300)))
    await asyncio.sleep(0)
    await store.close()
    await writing
    with pytest.raises(RefusedError):
        await store.get("k")
    store = await Store.open(tmp_path / "s.sqlite")
    assert len(await store.scan("")) == 300
    await store.close()


async def test_a_decision_is_known_before_it_is_committed(tmp_path: Path) -> None:
    """`change_soon` tells the decision and then its commit; one that fails fails both, and leaves nothing behind."""
    store = await Store.open(tmp_path / "s.sqlite")
    decided, committed = store.change_soon("k", lambda _: _record("k"))
    assert await decided == _record("k")
    assert await committed == _record("k")
    assert await store.record("k") == _record("k")

    def refuse(_: Record | None) -> Record:
        raise ConflictError("moved on")

    decided, committed = store.change_soon("k", refuse)
    with pytest.raises(ConflictError):
        await decided
    assert await store.record("k") == _record("k")
    await store.close()
    with pytest.raises(RefusedError):
        store.change_soon("k", lambda _: _record("k"))


async def test_what_a_conflict_is_with_can_be_read(tmp_path: Path) -> None:
    """A decision that fails for a record on its way to the disk fails when that record can be read."""
    store = await Store.open(tmp_path / "s.sqlite")

    def only_new(now: Record | None) -> Record:
        if now is not None:
            raise ConflictError("exists already")
        return _record("k")

    _, first = store.change_soon("k", only_new)
    again, _ = store.change_soon("k", only_new)
    with pytest.raises(ConflictError):
        await again
    assert await store.record("k") == _record("k")
    assert await first == _record("k")
    await store.close()


async def test_decisions_on_all_ways_follow_one_another(tmp_path: Path) -> None:
    """Counting up by decisions told of before their commit and after it: none rests on an old state."""
    store = await Store.open(tmp_path / "s.sqlite")

    def up(now: Record | None) -> Record:
        count = 1 if now is None else int(now.value) + 1
        return _record("k", str(count).encode(), count)

    waits: list[Awaitable[Any]] = []
    for number in range(120):
        if number % 2 == 0:
            waits += store.change_soon("k", up, durable=number % 8 == 0)
        else:
            waits.append(asyncio.create_task(store.change("k", up)))
        if number % 20 == 0:
            await asyncio.sleep(0.01)
    await asyncio.gather(*waits)
    assert await store.record("k") == _record("k", b"120", 120)
    decided, committed = store.change_soon("k", up)
    # The same again finds it done, and is answered only when it is on the disk.
    again, kept = store.change_soon("k", lambda now: now)
    assert (await again, await kept) == (await decided, await committed)
    await store.close()


async def test_what_is_not_in_memory_is_read_from_the_file(tmp_path: Path) -> None:
    """After a restart records are found in the file, and are in memory from then on; those dropped are gone at once."""
    store = await Store.open(tmp_path / "s.sqlite")
    await store.change("k", lambda _: _record("k"))
    await store.close()
    store = await Store.open(tmp_path / "s.sqlite")
    assert store._commits.picture.look("k") == (False, None)
    assert store._commits.picture.look("none") == (True, None)
    assert await store.record("k") == _record("k")
    assert store._commits.picture.look("k") == (True, _record("k"))
    await store.forget(_record("k"))
    assert store._commits.picture.look("k") == (True, None)
    await store.close()


async def test_whoever_watches_a_key_hears_of_each_commit_of_it_in_order(tmp_path: Path) -> None:
    """By whichever way it is written, removals too; of other keys nothing, and nothing once it is ended."""
    store = await Store.open(tmp_path / "s.sqlite")
    heard: asyncio.Queue[Record] = asyncio.Queue()
    ended = store.watch(lambda key: key == "task/1", heard.put_nowait)
    written = [_record("task/1", b"a"), _record("task/1", b"b", 2), _record("task/1", b"", 3, deleted=True)]
    await store.change("task/2", lambda _: _record("task/2"))
    await store.change("task/1", lambda _: written[0])
    decided, committed = store.change_soon("task/1", lambda _: written[1])
    await decided
    await committed
    await store.change("task/1", lambda current: current)  # nothing changes
    await asyncio.gather(*(store.change(f"task/{each}", lambda _: written[2]) for each in (1,)), store.put("k", b"v"))
    async with asyncio.timeout(60):
        assert [await heard.get() for _ in written] == written
    ended()
    await store.change("task/1", lambda _: _record("task/1", b"c", 4))
    await store.close()
    assert heard.empty()


async def test_records_are_read_page_by_page(tmp_path: Path) -> None:
    """All with the prefix, each once and in order, however many there are and however long; others stay out."""
    store = await Store.open(tmp_path / "s.sqlite")
    wanted = [_record(f"task/{number:05}", b"x" * (number % 7)) for number in range(1200)]
    beside = [_record("tas"), _record("task0"), _record("tasl/1")]
    await asyncio.gather(*(store.change(each.key, lambda _, each=each: each) for each in (*wanted, *beside)))
    found: list[Record] = []
    pages = 0
    while page := await store.page("task/", found[-1].key if found else ""):
        found += page
        pages += 1
    assert found == wanted
    assert pages > 1
    await store.close()
