"""The runner's protocol, against the real zygote as a plain process."""

import asyncio
import contextlib
import os
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from appliance.pool.runner.frames import MAX_FRAME, Decoder, FrameError, encode

pytestmark = pytest.mark.anyio

Zygote = Callable[[], Awaitable[Any]]


async def _finish(connection: Any) -> list[dict[str, Any]]:
    """All frames of a run to the end of file."""
    frames = []
    async with asyncio.timeout(60):
        while (frame := await connection.receive()) is not None:
            frames.append(frame)
    return frames


async def _run(zygote: Zygote, do: str, **more: Any) -> list[dict[str, Any]]:
    connection = await zygote()
    params = {"do": do, **more.pop("params", {})}
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": params, "timeout_s": 10.0} | more)
    return await _finish(connection)


def children_of(parent: int) -> list[int]:
    """Return the processes that a process has started itself."""
    return [int(each) for each in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def _gone(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return "State:\tZ" in Path(f"/proc/{pid}/status").read_text()
    return True


async def _wait_for(path: Path) -> str:
    async with asyncio.timeout(60):
        while not path.exists() or not path.read_text():
            await asyncio.sleep(0.005)
    return path.read_text()


async def _wait_gone(pid: int) -> None:
    async with asyncio.timeout(60):
        while not _gone(pid):
            await asyncio.sleep(0.005)


async def _wait_free(zygote: Zygote) -> None:
    control = await zygote()
    async with asyncio.timeout(60):
        while True:
            await control.send({"op": "ping"})
            if not (await control.receive())["run"]:
                return


async def test_frames_of_a_run(zygote: Zygote) -> None:
    """A run tells that it started, its progress, logs, output and partial result, and ends with its result."""
    frames = await _run(zygote, "echo", inputs={"a": {"b": 1}}, robot="r2")
    assert frames[0]["ev"] == "started"
    assert isinstance(frames[0]["at"], int)
    kinds = [frame["ev"] for frame in frames]
    assert kinds[-1] == "result"
    assert {"progress", "log", "partial"} < set(kinds)
    assert {frame["text"] for frame in frames if frame["ev"] == "log"} == {"hello", "printed"}
    result = frames[-1]["result"]
    assert (result["inputs"], result["robot"], result["site"]) == ({"a": {"b": 1}}, "r2", "yard")
    assert result["here"] == result["scratch"]
    assert not Path(result["scratch"]).exists()


async def test_the_last_frame_tells_what_the_run_used(zygote: Zygote) -> None:
    """CPU time and memory at the most come with the result, and from the zygote for a run that was killed."""
    for do in ("echo", "segv"):
        last = (await _run(zygote, do))[-1]
        assert last["cpu_ms"] >= 0
        assert 1 < last["peak_mb"] < 4096
        await _wait_free(zygote)


async def test_runs_do_not_see_each_other(zygote: Zygote) -> None:
    """What a handler keeps in its module is gone with its child."""
    results = [(await _run(zygote, "echo"))[-1]["result"] for _ in range(3)]
    assert [result["runs"] for result in results] == [1, 1, 1]
    assert len({result["scratch"] for result in results}) == 3


async def test_call_round_trip(zygote: Zygote) -> None:
    """A call goes out numbered, and bytes come back as bytes."""
    connection = await zygote()
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": {"do": "call"}})
    answers = {
        "command": {"x": 1, "blobs": {"p": b"abc"}},
        "put_artifact": {"artifact": "s"},
        "get_artifact": {"data": b"\x00\xff"},
    }
    numbers, data = [], b""
    while (frame := await connection.receive())["ev"] not in ("result", "error"):
        if frame["ev"] == "call":
            numbers.append(frame["n"])
            data = frame["args"].get("data", data)
            await connection.send({"n": frame["n"] - 1, "ok": {"stale": True}})
            await connection.send({"n": frame["n"], "ok": answers[frame["name"]]})
    assert numbers == [1, 2, 3]
    assert data == b"\x00\xff"
    assert frame["result"] == {"answer": {"x": 1, "blobs": {"p": 3}}, "reference": {"artifact": "s"}, "back": True}


@pytest.mark.parametrize(
    ("do", "code", "text", "retryable"),
    [
        ("fail", "skill", "no light", True),
        ("raise", "skill", "ValueError: bad value", False),
        ("segv", "crashed", "killed by SIGSEGV", True),
        ("exit", "crashed", "ended by itself with status 3", True),
        ("sys.exit", "skill", "SystemExit: 4", False),
        ("large", "payload", "at most 4,194,304 (4 MiB)", False),
        ("vast", "payload", "52,428,808 bytes of JSON, at most 4,194,304 (4 MiB)", False),
        ("vast log", "payload", "ctx.log has 17,8", False),
        ("vast partial", "payload", "at most 1,048,576 (1 MiB)", False),
        ("vast notice", "payload", "ctx.notify has 17,8", False),
        ("huge call", "payload", "at most 11,534,336 (11 MiB)", False),
        ("memory", "memory", "ran out of its memory", True),
        ("list", "skill", "returned list, not a dict", False),
        ("class", "skill", "object cannot be sent", False),
        ("nan", "skill", "Out of range float", False),
    ],
)
async def test_bad_handlers(zygote: Zygote, do: str, code: str, text: str, retryable: bool) -> None:
    """Whatever a handler does wrong, its run ends with one error that says what, and the runner lives on."""
    frames = await _run(zygote, do)
    error = frames[-1]
    assert [frame["ev"] for frame in frames].count("error") == 1
    assert (error["ev"], error["code"], error["retryable"]) == ("error", code, retryable)
    assert text in error["message"]
    if code == "payload":
        assert "volume" in error["remedy"], "where large data goes instead"
    if do in ("raise", "memory"):
        assert any("handler.py" in line for line in error["trace"])
    assert (await _run(zygote, "echo"))[-1]["ev"] == "result"


@pytest.mark.parametrize(
    ("where", "code", "text"),
    [
        ("result", "skill", "surrogates not allowed"),
        ("checkpoint", "skill", "surrogates not allowed"),
        ("call", "skill", "surrogates not allowed"),
        ("error", "skill", "No such file: 'caf"),
    ],
)
async def test_text_that_is_none(zygote: Zygote, where: str, code: str, text: str) -> None:
    """The name of a file that is not UTF-8 is refused where it counts, and for people it is made readable."""
    frames = await _run(zygote, "no text", params={"where": where})
    assert [frame["ev"] for frame in frames] == ["started", "error"]
    assert frames[-1]["code"] == code
    assert text in frames[-1]["message"]
    frames = await _run(zygote, "no text", params={"where": "people"})
    assert [frame.get("note") or frame.get("text") for frame in frames[1:-1]] == ["caf?", "caf?"]
    assert frames[-1]["result"] == {"whole": 2**70, "text": "café"}


async def test_cancel_lets_the_handler_clean_up(zygote: Zygote) -> None:
    """A cancelled handler sees Cancelled, may still talk, and its run ends as cancelled."""
    connection, control = await zygote(), await zygote()
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": {"do": "clean up"}})
    assert (await connection.receive())["ev"] == "started"
    assert (await connection.receive())["ev"] == "progress"
    await control.send({"op": "cancel", "run": "other"})
    assert await control.receive() == {"ok": False}
    await control.send({"op": "cancel", "run": "r1"})
    assert await control.receive() == {"ok": True}
    frames = await _finish(connection)
    assert frames[0]["text"] == "cleaned"
    assert (frames[-1]["code"], frames[-1]["retryable"]) == ("cancelled", False)


async def test_cancel_of_a_stubborn_handler(zygote: Zygote, tmp_path: Path) -> None:
    """A handler that ignores SIGTERM is killed after the grace, and its run ends as cancelled."""
    connection, control = await zygote(), await zygote()
    order = {"do": "stubborn", "pid": str(tmp_path / "pid")}
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": order})
    pid = int(await _wait_for(tmp_path / "pid"))
    await control.send({"op": "cancel", "run": "r1", "grace_s": 0.1})
    frames = await _finish(connection)
    assert frames[-1]["code"] == "cancelled"
    assert _gone(pid)


async def test_deadline(zygote: Zygote, tmp_path: Path) -> None:
    """A run that takes too long is ended, and says so."""
    frames = await _run(zygote, "sleep", params={"pid": str(tmp_path / "pid")}, timeout_s=0.2)
    assert frames[-1]["code"] == "deadline"
    assert frames[-1]["retryable"]


async def test_hang_up_ends_the_child(zygote: Zygote, tmp_path: Path) -> None:
    """When its gateway goes away a run is ended, even one that ignores SIGTERM, and the runner is free again."""
    for do in ("sleep", "stubborn"):
        file = tmp_path / do
        connection = await zygote()
        order = {"op": "run", "run": "r1", "skill": "probe", "params": {"do": do, "pid": str(file)}}
        await connection.send(order)
        pid = int(await _wait_for(file))
        connection.close()
        await _wait_gone(pid)
        await _wait_free(zygote)
    assert (await _run(zygote, "echo"))[-1]["ev"] == "result"


async def test_what_a_handler_started_ends_with_it(zygote: Zygote, tmp_path: Path) -> None:
    """A process that a handler left behind is gone when the container is free again."""
    frames = await _run(zygote, "grandchild", params={"pid": str(tmp_path / "pid")})
    assert frames[-1]["ev"] == "result"
    await _wait_gone(int((tmp_path / "pid").read_text()))


async def test_death_within_a_frame(zygote: Zygote) -> None:
    """A child that dies within a frame gets no other frame behind it: the connection just ends."""
    connection = await zygote()
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": {"do": "half frame"}})
    with pytest.raises(Exception, match="cut off"):
        await _finish(connection)


async def test_one_run_at_a_time(zygote: Zygote, tmp_path: Path) -> None:
    """A second run is refused while one is in progress."""
    first, second = await zygote(), await zygote()
    order = {"op": "run", "run": "r1", "skill": "probe", "params": {"do": "sleep", "pid": str(tmp_path / "pid")}}
    await first.send(order)
    await _wait_for(tmp_path / "pid")
    await second.send(order | {"run": "r2"})
    assert (await _finish(second))[-1]["code"] == "refused"


async def test_skills_that_are_not_there_or_broken(zygote: Zygote) -> None:
    """A skill that cannot be imported fails alone and is named by ping; one that is not there is refused."""
    control = await zygote()
    await control.send({"op": "ping"})
    reply = await control.receive()
    assert set(reply["problems"]) == {"broken", "module nowhere"}
    assert "no_such_module" in reply["problems"]["broken"]
    assert "no_such_module" in (await _run(zygote, "", skill="broken"))[-1]["message"]
    assert (await _run(zygote, "", skill="unheard"))[-1]["code"] == "not-found"


@pytest.mark.parametrize(
    "data", [b"\xff\xff\xff\xff", b"\x00\x00\x00\x03abc", b"\x00\x00\x00\x02[]", b"\x00\x00\x00\x02\xff\xff"]
)
async def test_garbage_is_refused(zygote: Zygote, data: bytes) -> None:
    """An oversize or malformed frame is answered with the reason and its connection closed; the runner lives on."""
    connection = await zygote()
    connection._writer.write(data)
    reply = await connection.receive()
    assert reply["ok"] is False
    assert reply["error"].startswith("refused: ")
    assert await connection.receive() is None
    assert (await _run(zygote, "echo"))[-1]["ev"] == "result"


async def test_bad_orders_are_refused(zygote: Zygote) -> None:
    """An unknown operation and a run with a deadline that is no number are answered with the reason."""
    connection = await zygote()
    await connection.send({"op": "dance"})
    assert "dance" in (await connection.receive())["error"]
    await connection.send({"op": "run", "skill": "probe", "timeout_s": "soon"})
    assert (await _finish(connection))[-1]["code"] == "payload"
    assert (await _run(zygote, "echo"))[-1]["ev"] == "result"


async def test_output_is_bounded(zygote: Zygote) -> None:
    """A handler that prints without end is not stopped, but only so much is kept."""
    frames = await _run(zygote, "flood")
    lines = [frame["text"] for frame in frames if frame["ev"] == "log"]
    assert frames[-1]["ev"] == "result"
    assert lines[0] == "line 0"
    assert any("the rest is dropped" in line for line in lines)


async def test_stop_ends_the_run_and_the_runner(zygote: Zygote, tmp_path: Path) -> None:
    """Told to stop, the runner ends its run first and then itself; the run was not called off and may be repeated."""
    connection, control = await zygote(), await zygote()
    order = {"op": "run", "run": "r1", "skill": "probe", "params": {"do": "sleep", "pid": str(tmp_path / "pid")}}
    await connection.send(order)
    pid = int(await _wait_for(tmp_path / "pid"))
    await control.send({"op": "stop"})
    last = (await _finish(connection))[-1]
    assert (last["code"], last["retryable"]) == ("stopped", True)
    assert _gone(pid)
    process = zygote.process  # type: ignore[attr-defined]
    assert await asyncio.wait_for(process.wait(), 60) == 0


async def test_a_stopped_container_ends_its_run_for_another_try(zygote: Zygote, tmp_path: Path) -> None:
    """SIGTERM of the runner, as Podman stops a container, is nobody's cancel."""
    connection = await zygote()
    await connection.send(
        {"op": "run", "run": "r1", "skill": "probe", "params": {"do": "sleep", "pid": str(tmp_path / "pid")}}
    )
    await _wait_for(tmp_path / "pid")
    zygote.process.terminate()  # type: ignore[attr-defined]
    last = (await _finish(connection))[-1]
    assert (last["code"], last["retryable"]) == ("stopped", True)


async def _waiting(zygote: Zygote) -> int:
    """The child that is forked ahead, once it is there."""
    pid = zygote.process.pid  # type: ignore[attr-defined]
    async with asyncio.timeout(60):
        while not (found := [each for each in children_of(pid) if not _gone(each)]):
            await asyncio.sleep(0.005)
    return found[0]


async def test_a_run_begins_in_the_child_that_waits(zygote: Zygote) -> None:
    """A run's process was forked ahead of its order, and has its own scratch folder; the next has another."""
    await zygote()
    for _ in range(2):
        waiting = await _waiting(zygote)
        result = (await _run(zygote, "echo"))[-1]["result"]
        assert result["pid"] == waiting
        assert result["runs"] == 1
        await _wait_gone(waiting)


async def test_without_a_child_that_waits(zygote: Zygote) -> None:
    """Where the child that waits was killed, or the order is long, one is forked for the order."""
    await zygote()
    waiting = await _waiting(zygote)
    os.kill(waiting, signal.SIGKILL)
    assert (await _run(zygote, "echo"))[-1]["ev"] == "result"
    waiting = await _waiting(zygote)
    result = (await _run(zygote, "echo", inputs={"long": {"text": "x" * 2**20}}))[-1]["result"]
    assert len(result["inputs"]["long"]["text"]) == 2**20
    assert result["pid"] != waiting
    await _wait_gone(waiting)


async def test_a_cancel_before_the_handler_begins(zygote: Zygote) -> None:
    """A cancel that comes with the order, before the child has looked at it, ends the run as cancelled."""
    connection, control = await zygote(), await zygote()
    waiting = await _waiting(zygote)
    os.kill(waiting, signal.SIGSTOP)
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": {"do": "echo"}})
    async with asyncio.timeout(60):
        while True:
            await control.send({"op": "cancel", "run": "r1"})
            if (await control.receive())["ok"]:
                break
    os.kill(waiting, signal.SIGCONT)
    last = (await _finish(connection))[-1]
    assert (last["code"], last["retryable"]) == ("cancelled", False)
    assert (await _run(zygote, "echo"))[-1]["ev"] == "result"


async def test_news_that_are_too_long(zygote: Zygote) -> None:
    """A checkpoint beyond its bound, or that is no dict, is an error in the handler, with what to do instead."""
    for do in ("long checkpoint", "list checkpoint"):
        error = (await _run(zygote, do))[-1]
        assert error["code"] == "payload"
    assert (await _run(zygote, "resume", resume={"step": 3}))[-1]["result"] == {"step": 3}


async def test_calls_after_a_checkpoint_keep_their_numbers(zygote: Zygote) -> None:
    """An attempt that goes on from a checkpoint numbers its calls on from there: an effect's id is the same again."""

    async def calls(resume: dict[str, Any] | None, made: int) -> tuple[list[tuple[int, str]], list[int]]:
        connection = await zygote()
        order = {"op": "run", "run": "r1", "skill": "probe", "params": {"do": "calls in steps"}, "timeout_s": 10.0}
        await connection.send(order | {"resume": resume, "calls": made})
        numbers: list[tuple[int, str]] = []
        kept: list[int] = []
        # To the end of file: only then is the runner free for the next.
        while (frame := await connection.receive()) is not None:
            if frame["ev"] == "call":
                numbers.append((frame["n"], frame["args"]["text"]))
                await connection.send({"n": frame["n"], "ok": {}})
            elif frame["ev"] == "checkpoint":
                kept.append(frame["calls"])
        return numbers, kept

    whole, kept = await calls(None, 0)
    assert whole == [(1, "step 0"), (2, "step 1"), (3, "step 2")]
    assert kept == [1, 2, 3]
    assert await calls({"done": 2}, kept[1]) == (whole[2:], [3])


def test_frames_round_trip() -> None:
    """Bytes anywhere in a value come back as bytes, whatever pieces the frame arrives in."""
    value = {"a": [b"\x00", {"b": b""}], "c": "ü", "d": None}
    decoder = Decoder()
    for byte in encode(value):
        assert decoder.next() is None
        decoder.feed(bytes([byte]))
    assert decoder.next() == value
    assert decoder.pending == 0


def test_frames_are_bounded() -> None:
    """A frame that would be too long is not made."""
    with pytest.raises(FrameError, match="allowed"):
        encode({"x": "y" * MAX_FRAME})


def test_environment_is_clean() -> None:
    """The runner needs nothing of the appliance: its folder imports only the standard library and itself."""
    folder = Path(__file__).resolve().parents[3] / "appliance" / "pool" / "runner"
    text = "".join(file.read_text() for file in folder.glob("*.py"))
    assert "appliance." not in text.replace("the appliance.", "")
    assert (folder / "main.py").exists()


async def test_a_handler_that_asks_is_told_when_a_checkpoint_is_wanted(zygote: Zygote, tmp_path: Path) -> None:
    """`save` reaches the run of that id alone; having saved it is wanted no more; others are not disturbed by it."""
    control, connection = await zygote(), await zygote()
    params = {"do": "save when due", "pid": str(tmp_path / "pid")}
    await connection.send({"op": "run", "run": "r1", "skill": "probe", "params": params, "timeout_s": 20.0})
    await _wait_for(tmp_path / "pid")
    await control.send({"op": "save", "run": "r9"})
    assert (await control.receive())["ok"] is False
    await control.send({"op": "save", "run": "r1"})
    assert (await control.receive())["ok"] is True
    frames = await _finish(connection)
    assert [frame["data"] for frame in frames if frame["ev"] == "checkpoint"] == [{"first": 1}, {"last": 2}]
    assert frames[-1]["result"] == {"due": False}
    await _wait_free(zygote)
    asleep = await zygote()
    params = {"do": "sleep", "pid": str(tmp_path / "other")}
    await asleep.send({"op": "run", "run": "r2", "skill": "probe", "params": params, "timeout_s": 20.0})
    pid = int(await _wait_for(tmp_path / "other"))
    await control.send({"op": "save", "run": "r2"})
    assert (await control.receive())["ok"] is True
    await control.send({"op": "ping"})
    assert (await control.receive())["run"] == "r2"
    assert not _gone(pid), "a handler that does not ask goes on"
    await control.send({"op": "cancel", "run": "r2", "reason": "cancelled", "grace_s": 0.1})
    await _finish(asleep)
