"""One run, in a process forked for it: limits, captured output, the handler, and its outcome as the last frame.

A fork per run is what keeps subtasks apart: modules are shared with the zygote copy-on-write, everything a
handler changes dies with it.
"""

import contextlib
import importlib.util
import math
import mmap
import os
import resource
import signal
import socket
import sys
import threading
import time
import traceback
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn

from .context import CallError, Cancelled, Context, Fail, Frame, Link
from .frames import FrameError, encode

MAX_RESULT = 4 * 2**20
"""Longest result in bytes of JSON; larger things are artifacts."""
MAX_OUTPUT = 256 * 1024
"""Bytes of a handler's own stdout and stderr that are kept as log lines."""
MAX_LINE = 4096
HEADROOM = 512 * 2**20
"""Address space on top of `memory_mb`: thread stacks and allocator arenas are reserved, hardly ever touched."""

# Bytes of the memory shared with the zygote.
IN_TRANSIT, DONE, REASON = 0, 1, 2
REASONS = {1: "cancelled", 2: "deadline", 3: "orphaned"}


def load_handler(skill: str, folder: str) -> ModuleType:
    """Import `handler.py` of a skill's folder.

    Raises:
        ImportError: there is none, or it has no `run`. Whatever it raises itself while being imported.
    """
    path = Path(folder) / "handler.py"
    spec = importlib.util.spec_from_file_location(f"skill_{skill}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise ImportError(f"{path} does not exist")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickle look their module up
    spec.loader.exec_module(module)
    if not callable(getattr(module, "run", None)):
        raise ImportError(f"{path} has no function run(ctx)")  # noqa: TRY004 - what cannot be imported as a handler
    return module


def explain(error: BaseException) -> str:
    """Return an error as one line, with its type where the text alone would say little."""
    return f"{type(error).__name__}: {error}"[:2000]


def _limit(order: Frame, processes: int) -> None:
    def cap(which: int, value: int) -> None:
        hard = resource.getrlimit(which)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        with contextlib.suppress(ValueError, OSError):  # a stricter limit is already in force
            resource.setrlimit(which, (value, value))

    memory_mb = int(order.get("memory_mb", 128))
    size = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    cap(resource.RLIMIT_AS, size + memory_mb * 2**20 + HEADROOM)
    cap(resource.RLIMIT_NOFILE, 256)
    cap(resource.RLIMIT_CORE, 0)
    if processes:
        cap(resource.RLIMIT_NPROC, processes)
    # A busy loop that blocks signals still ends: CPU seconds of all cores over the whole time allowed.
    cap(resource.RLIMIT_CPU, math.ceil(float(order.get("timeout_s", 120.0)) * (os.cpu_count() or 1)) + 5)
    with contextlib.suppress(OSError):
        # Out of memory, the kernel takes the run and leaves the zygote.
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


class _Output:
    """Sends what the handler prints as log frames, from a thread of its own."""

    def __init__(self, read_end: int, link: Link) -> None:
        self._read_end = read_end
        self._link = link
        self._thread = threading.Thread(target=self._follow, name="output", daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        left = MAX_OUTPUT
        rest = b""
        with contextlib.suppress(Cancelled, OSError):
            while data := os.read(self._read_end, 65536):
                if left <= 0:
                    continue  # keep the pipe flowing, or the handler would block in print
                left -= len(data)
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    self._tell(line)
                if len(rest) > MAX_LINE:
                    self._tell(rest)
                    rest = b""
                if left <= 0:
                    self._link.send({"ev": "log", "text": f"more output than {MAX_OUTPUT} bytes: the rest is dropped"})
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


def _outcome(  # noqa: PLR0911 - one line for each way a handler can end
    order: Frame, link: Link, handler: ModuleType | str, folder: str, scratch: Path, shared: mmap.mmap
) -> Frame:
    skill = str(order.get("skill", ""))
    try:
        if isinstance(handler, str):
            handler = load_handler(skill, folder)
        ctx = Context(link, order, scratch)
        link.send({"ev": "started", "at": time.monotonic_ns()})
        result: Any = handler.run(ctx)
        if result is None:
            result = {}
        if not isinstance(result, dict):
            return _error("skill", f"{skill} returned {type(result).__name__}, not a dict")
        body = len(encode({"ev": "result", "result": result}))
    except Cancelled:
        reason = REASONS.get(shared[REASON], "orphaned")
        return _error(reason, f"{skill} was ended: {reason}", retryable=reason != "cancelled")
    except CallError as error:
        return _error(error.code, error.message, remedy=error.remedy, retryable=error.retryable)
    except Fail as error:
        return _error("skill", error.message, remedy=error.remedy, retryable=error.retryable)
    except (FrameError, TypeError) as error:
        return _error("payload" if isinstance(error, FrameError) else "skill", explain(error), trace=_trace(error))
    except MemoryError as error:
        text = f"{skill} ran out of its memory ({order.get('memory_mb')} MB and headroom)"
        return _error("memory", text, remedy="raise memory_mb in its skill.toml", retryable=True, trace=_trace(error))
    except BaseException as error:  # noqa: BLE001 - supervision boundary: whatever a handler raises is the run's outcome
        return _error("skill", explain(error), retryable=isinstance(error, OSError), trace=_trace(error))
    if body > MAX_RESULT:
        remedy = "put large things with ctx.put_artifact and return the reference"
        return _error("payload", f"result of {body} bytes, {MAX_RESULT} allowed", remedy=remedy)
    return {"ev": "result", "result": result}


def _trace(error: BaseException) -> list[str]:
    lines = "".join(traceback.format_exception(error)).rstrip().splitlines()
    return [line[:300] for line in lines[-8:]]


def main(
    connection: socket.socket,
    order: Frame,
    *,
    handler: ModuleType | str,
    folder: str,
    scratch: Path,
    shared: mmap.mmap,
    pipe: tuple[int, int],
    processes: int,
) -> NoReturn:
    """Carry out one run and end the process; SIGTERM is blocked when this begins."""

    def mark(moving: bool) -> None:
        shared[IN_TRANSIT] = 1 if moving else 0

    os.setsid()
    link = Link(connection, mark)

    def asked_to_end(number: int, frame: FrameType | None) -> None:
        del number, frame
        link.cancel()

    signal.signal(signal.SIGTERM, asked_to_end)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    read_end, write_end = pipe
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.dup2(write_end, 1)
    os.dup2(write_end, 2)
    keep = sorted({connection.fileno(), read_end})
    low = 3
    for kept in [*keep, 1 << 16]:
        os.closerange(low, kept)
        low = kept + 1
    frame: Frame
    try:
        scratch.mkdir(parents=True)
        os.chdir(scratch)
        os.environ["HOME"] = os.environ["TMPDIR"] = str(scratch)
        reconfigure = getattr(sys.stdout, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(line_buffering=True)
        numpy: Any = sys.modules.get("numpy")
        if numpy is not None:
            numpy.random.seed()  # or every run would draw the zygote's numbers again
        _limit(order, processes)
        output = _Output(read_end, link)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        frame = _outcome(order, link, handler, folder, scratch, shared)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        output.finish()
    except Cancelled:
        # Asked to end before the handler began, or between its end and here.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        frame = _error(REASONS.get(shared[REASON], "orphaned"), "ended before it began", retryable=True)
    except OSError as error:
        frame = _error("pool", f"the run could not be set up: {explain(error)}", retryable=True)
    with contextlib.suppress(Cancelled):
        link.send(frame)
        shared[DONE] = 1
    os._exit(0)
