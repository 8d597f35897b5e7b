"""One run, in a process forked for it: limits, captured output, the handler, and its outcome as the last frame.

A fork per run is what keeps subtasks apart: modules are shared with the zygote copy-on-write, everything a
handler changes dies with it. A child that is forked ahead has done all that does not depend on its order before it
comes: a run then begins with one message.
"""

import contextlib
import errno
import marshal
import mmap
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, cast

from . import usage
from .context import Context
from .frames import beyond, size_of
from .limits import address_space, limit_ahead, limit_run
from .link import LARGE, CallError, Cancelled, Fail, Frame, Link
from .preload import Loaded, explain

MAX_OUTPUT = 256 * 1024
"""Bytes of a handler's own stdout and stderr that are kept as log lines."""
MAX_LINES = 1900
"""Lines of it that are kept: a gateway passes on 2,000, its last words among them."""
MAX_LINE = 4096
MAX_ORDER = 64 * 1024
"""Longest order in bytes that is handed to a child forked ahead: it fits into a socket's buffer, so nobody waits."""

# Bytes of the memory shared with the zygote.
IN_TRANSIT, DONE, REASON, TAKEN = 0, 1, 2, 3
REASONS = {1: "cancelled", 2: "deadline", 3: "orphaned", 4: "stopped", 5: "disk"}
SLOW = "raise timeout_s in its skill.toml, or find out what it waits for"
FULL = "remove from its volumes what is not needed any more, have it write less, or make room on the disk"
REMEDIES = {"deadline": SLOW, "disk": FULL}
TEXTS = {"disk": "it had written much into its volumes, whose disk is nearly full, or beside its runner's socket"}
BROKEN = "its last lines are in the log: mend its handler"


class Kit:
    """What a child is forked with. `channel` is where its order comes from when it is forked ahead."""

    def __init__(self, loaded: Loaded, scratch: Path, processes: int) -> None:
        self.loaded = loaded
        self.scratch = scratch
        self.processes = processes
        self.shared = mmap.mmap(-1, 4)
        self.pipe = os.pipe()


class _Output:
    """Sends what the handler prints as log frames, from a thread of its own."""

    def __init__(self, read_end: int, link: Link) -> None:
        self._read_end = read_end
        self._link = link
        self._thread = threading.Thread(target=self._follow, name="output", daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        left, lines_left = MAX_OUTPUT, MAX_LINES
        rest = b""
        with contextlib.suppress(Cancelled, OSError):
            while data := os.read(self._read_end, 65536):
                if left <= 0 or lines_left <= 0:
                    continue  # keep the pipe flowing, or the handler would block in print
                left -= len(data)
                *lines, rest = (rest + data).split(b"\n")
                for line in lines[:lines_left]:
                    self._tell(line)
                lines_left -= len(lines)
                if len(rest) > MAX_LINE:
                    self._tell(rest)
                    rest = b""
                if left <= 0 or lines_left <= 0:
                    text = f"more output than {MAX_LINES} lines or {MAX_OUTPUT} bytes: the rest is dropped"
                    self._link.send({"ev": "log", "text": text})
            if rest:
                self._tell(rest)

    def _tell(self, line: bytes) -> None:
        if text := line[:MAX_LINE].decode("utf-8", "replace").rstrip():
            self._link.send({"ev": "log", "text": text, "stream": True})

    def finish(self) -> None:
        """Flush and wait a moment for the last lines."""
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(ValueError, OSError):
                stream.flush()
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        self._thread.join(0.2)


def _error(
    code: str, message: str, *, remedy: str = "", retryable: bool = False, trace: list[str] | None = None
) -> Frame:
    frame: Frame = {"ev": "error", "code": code, "message": message[:4000], "remedy": remedy[:1000]}
    return frame | {"retryable": retryable, "trace": trace or []}


def _outcome(order: Frame, link: Link, kit: Kit) -> Frame:  # noqa: PLR0911 - one line for each way a handler can end
    name = str(order.get("skill", ""))
    skill, spec = kit.loaded.spec.skills[name], kit.loaded.spec
    try:
        handler, value = kit.loaded.handler(skill)
        ctx = Context(link, order, skill=skill, spec=spec, preloaded=value, scratch=kit.scratch)
        link.send({"ev": "started", "at": time.monotonic_ns()})
        result: Any = handler.run(ctx)
        if result is None:
            result = {}
        if not isinstance(result, dict):
            return _error("skill", f"{name} returned {type(result).__name__}, not a dict", remedy="return a dict")
        if problem := _unfit(name, cast("Frame", result), spec.max_result_bytes):
            return problem
    except Cancelled:
        return _cancelled(kit, name)
    except CallError as error:
        return _error(error.code, error.message, remedy=error.remedy, retryable=error.retryable)
    except Fail as error:
        return _error("skill", error.message, remedy=error.remedy, retryable=error.retryable)
    except MemoryError as error:
        text = f"{name} ran out of its memory ({order.get('memory_mb')} MB and headroom)"
        return _error("memory", text, remedy="raise memory_mb in its skill.toml", retryable=True, trace=_trace(error))
    except OSError as error:
        remedy = BROKEN
        if error.errno == errno.EFBIG:
            remedy = f"no file may be longer than {skill.file_mb} MB: raise file_mb in its skill.toml"
        elif error.errno == errno.ENOSPC:
            remedy = "its scratch folder holds pool.tmp_mb; a volume what the disk does: write less, or make room"
        retryable = error.errno != errno.EFBIG
        return _error("skill", explain(error), remedy=remedy, retryable=retryable, trace=_trace(error))
    except BaseException as error:  # noqa: BLE001 - supervision boundary: whatever a handler raises is the run's outcome
        return _error("skill", explain(error), remedy=BROKEN, trace=_trace(error))
    return {"ev": "result", "result": result}


def _unfit(name: str, result: Frame, most: int) -> Frame | None:
    """Return the error of a result that cannot be kept, of `most` bytes; None for one that can."""
    try:
        size = size_of(result)
    except (TypeError, ValueError, RecursionError) as error:
        text = f"the result of {name} cannot be written as JSON: {explain(error)}"
        return _error(
            "skill", text, remedy="return dicts with text keys, lists, texts, finite numbers, bool, None, bytes"
        )
    if size > most:
        return _error("payload", beyond(f"the result of {name}", size, most), remedy=LARGE)
    return None


def _cancelled(kit: Kit, what: str) -> Frame:
    reason = REASONS.get(kit.shared[REASON], "orphaned")
    text = f"{what} was ended: {TEXTS.get(reason, reason)}"
    return _error(reason, text, remedy=REMEDIES.get(reason, ""), retryable=reason != "cancelled")


def _trace(error: BaseException) -> list[str]:
    lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
    return [line[:300] for line in lines[-8:]]


def _settle(kit: Kit, keep: int) -> None:
    """Become a process of its own, with nothing of the zygote's but what it needs."""
    os.setsid()
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    read_end, write_end = kit.pipe
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(write_end, 1)
    os.dup2(write_end, 2)
    low = 3
    for kept in (*sorted({keep, read_end}), 1 << 16):
        os.closerange(low, kept)
        low = kept + 1
    kit.scratch.mkdir(parents=True)
    os.chdir(kit.scratch)
    os.environ["HOME"] = os.environ["TMPDIR"] = str(kit.scratch)
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(line_buffering=True)
    numpy: Any = sys.modules.get("numpy")
    if numpy is not None:
        numpy.random.seed()  # or every run would draw the zygote's numbers again
    limit_ahead(kit.processes)


class _Child:
    """A child that is ready: on its own, its output followed, without an order yet."""

    def __init__(self, kit: Kit, keep: int) -> None:
        self.kit = kit
        self.link = Link(self._mark)
        _settle(kit, keep)
        self._output = _Output(kit.pipe[0], self.link)
        self._base = address_space()

    def _mark(self, moving: bool) -> None:
        self.kit.shared[IN_TRANSIT] = 1 if moving else 0

    def _asked_to_end(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.link.cancel()

    def _asked_to_save(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.link.saving_asked = True

    def warm_up(self) -> None:
        """Touch what the first lines of a run touch.

        Pages shared with the zygote are copied when they are first written to, if only to count references: that
        takes several times as long as the lines themselves.
        """
        ours, theirs = socket.socketpair()
        order: Frame = marshal.loads(marshal.dumps({"params": {"a": [1.0, "b"]}, "inputs": {}, "timeout_s": 1.0}))  # noqa: S302 - its own
        for name, skill in self.kit.loaded.spec.skills.items():
            link = Link(lambda _: None)
            link.attach(ours)
            if name in self.kit.loaded.handlers:
                value = self.kit.loaded.values.get(name)
                spec = self.kit.loaded.spec
                Context(link, order, skill=skill, spec=spec, preloaded=value, scratch=self.kit.scratch)
                link.send({"ev": "started", "at": time.monotonic_ns()})
                break
        ours.close()
        theirs.close()

    def carry_out(self, order: Frame, connection: socket.socket) -> NoReturn:
        """Run the handler, tell the outcome, end the process; SIGTERM is blocked when this begins."""
        kit, shared = self.kit, self.kit.shared
        began_s = usage.cpu_s()
        self.link.attach(connection)
        signal.signal(signal.SIGTERM, self._asked_to_end)
        signal.signal(signal.SIGUSR1, self._asked_to_save)
        frame: Frame
        try:
            limit_run(
                base=self._base,
                memory_mb=int(order.get("memory_mb", 128)),
                file_mb=kit.loaded.spec.skills[str(order["skill"])].file_mb,
                timeout_s=float(order.get("timeout_s", 120.0)),
            )
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
            frame = _outcome(order, self.link, kit)
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            self._output.finish()
        except Cancelled:
            # Asked to end before the handler began, or between its end and here.
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            frame = _cancelled(kit, "a run that had not begun")
        except OSError as error:
            frame = _error("pool", f"the run could not be set up: {explain(error)}", retryable=True)
        with contextlib.suppress(Cancelled):
            self.link.send(frame | usage.own(began_s))
            shared[DONE] = 1
        os._exit(0)


def wait(kit: Kit, channel: socket.socket) -> NoReturn:
    """Get ready, wait for an order on `channel`, carry it out; ends when the other side of it is closed."""
    child = _Child(kit, channel.fileno())
    if not select.select([channel], [], [], 0)[0]:  # no order is there yet
        child.warm_up()
    message, handles, _, _ = socket.recv_fds(channel, MAX_ORDER, 1)
    if not message or not handles:
        os._exit(0)
    kit.shared[TAKEN] = 1
    channel.close()
    child.carry_out(marshal.loads(message), socket.socket(fileno=handles[0]))  # noqa: S302 - of our own zygote


def run(kit: Kit, order: Frame, connection: socket.socket) -> NoReturn:
    """Get ready and carry out one order; SIGTERM is blocked when this begins."""
    try:
        child = _Child(kit, connection.fileno())
    except (OSError, RuntimeError) as error:  # RuntimeError: no further thread can be started
        frame = _error("pool", f"the run could not be set up: {explain(error)}", retryable=True)
        link = Link(lambda _: None)
        link.attach(connection)
        with contextlib.suppress(Cancelled):
            link.send(frame)
            kit.shared[DONE] = 1
        os._exit(0)
    child.carry_out(order, connection)
