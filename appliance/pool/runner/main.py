"""The zygote: process 1 of a container. It imports once, then forks one child a run.

It exists because a process that is already there starts a run in about a millisecond, where a container takes
a few hundred. It never runs a handler itself, so nothing a handler does stays; it watches its child (hang-up
of the gateway, deadline, death by a signal), ends it, and sweeps up after it. One run at a time.

    python3 -m runner.main --socket /run/swiftbot/runner.sock --spec '{"skills": {...}, "modules": [...]}'
"""

import argparse
import contextlib
import gc
import importlib
import json
import mmap
import os
import select
import shutil
import signal
import socket
import sys
import time
import uuid
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, cast

from . import child
from .context import Frame
from .frames import Decoder, FrameError, encode

MAX_CONNECTIONS = 16
"""A gateway keeps two; a few more for one that restarts."""
GRACE_S = 2.0
"""From SIGTERM, in which a handler may clean up, to SIGKILL."""
ORPHAN_GRACE_S = 0.5
"""The same when the gateway is gone and there is nobody to clean up with."""


class Connection:
    """A gateway's connection, while the zygote still reads it."""

    def __init__(self, peer: socket.socket) -> None:
        self.peer = peer
        self.decoder = Decoder()


class Run:
    """The child of the moment, as seen from the zygote."""

    def __init__(self, order: Frame, peer: socket.socket, scratch: Path) -> None:
        self.id = str(order.get("run", ""))
        self.peer = peer
        self.scratch = scratch
        self.shared = mmap.mmap(-1, 4)
        self.pid = 0
        self.output = -1
        self.timeout_s = float(order.get("timeout_s", 120.0))
        self.deadline = time.monotonic() + self.timeout_s
        self.kill_at: float | None = None

    def end(self, reason: int, grace_s: float) -> None:
        """Ask the child to end, and set when it will be made to."""
        if self.kill_at is None:
            self.shared[child.REASON] = reason
            self.kill_at = time.monotonic() + grace_s
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
        else:
            self.kill_at = min(self.kill_at, time.monotonic() + grace_s)

    def kill(self) -> None:
        """End the child and everything it started."""
        for kill in (os.killpg, os.kill):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                kill(self.pid, signal.SIGKILL)


class Zygote:
    """Listens, forks, watches. `alone` when it is process 1 and may sweep the whole container."""

    def __init__(self, path: str, spec: dict[str, Any], *, scratch: Path, processes: int) -> None:
        self._path = path
        self._folders = cast("dict[str, str]", spec.get("skills") or {})
        self._modules = [str(each) for each in spec.get("modules") or ()]
        self._scratch = scratch
        self._processes = processes
        self._alone = os.getpid() == 1
        self._handlers: dict[str, ModuleType] = {}
        self._problems: dict[str, str] = {}
        self._connections: dict[int, Connection] = {}
        self._run: Run | None = None
        self._runs = 0
        self._stopping = False
        self._epoll = select.epoll()

    def preload(self) -> None:
        """Import what runs will need; what cannot be imported is reported and stops nothing."""
        for name in self._modules:
            try:
                importlib.import_module(name)
            except BaseException as error:  # noqa: BLE001 - supervision boundary: others' code; reported by `ping`
                self._problems[f"module {name}"] = child.explain(error)
        for skill, folder in self._folders.items():
            try:
                self._handlers[skill] = child.load_handler(skill, folder)
            except BaseException as error:  # noqa: BLE001 - supervision boundary: others' code; reported by `ping`
                self._problems[skill] = child.explain(error)
        gc.collect()
        gc.freeze()  # children share these pages as long as nobody touches their reference counts' neighbours

    def serve(self) -> None:
        """Work until told to stop."""
        wake, waker = os.pipe()
        for end in (wake, waker):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, _woken)  # a handler of its own, or nothing would be written to `waker`
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._asked_to_stop)
        # Under its name only when somebody listens: whoever sees it can connect.
        early = f"{self._path}.new"
        with contextlib.suppress(FileNotFoundError):
            Path(early).unlink()
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(early)
        listener.listen(MAX_CONNECTIONS)
        Path(early).rename(self._path)
        self._epoll.register(wake, select.EPOLLIN)
        self._epoll.register(listener, select.EPOLLIN)
        while not (self._stopping and self._run is None):
            for fd, _ in self._epoll.poll(self._patience()):
                if fd == wake:
                    with contextlib.suppress(BlockingIOError):
                        os.read(wake, 512)
                elif fd == listener.fileno():
                    self._accept(listener)
                elif self._run is not None and fd == self._run.peer.fileno():
                    self._epoll.unregister(fd)  # a hang-up stays one: telling once is enough
                    self._run.end(3, ORPHAN_GRACE_S)
                elif fd in self._connections:
                    self._read(self._connections[fd])
            self._watch()
            self._reap()
        with contextlib.suppress(FileNotFoundError):
            Path(self._path).unlink()

    def _asked_to_stop(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._stopping = True
        if self._run is not None:
            self._run.end(1, GRACE_S)

    def _patience(self) -> float:
        """Seconds until something is due."""
        if self._run is None:
            return 60.0
        due = self._run.deadline if self._run.kill_at is None else self._run.kill_at
        return max(0.0, due - time.monotonic()) + 0.001

    def _accept(self, listener: socket.socket) -> None:
        peer = listener.accept()[0]
        if len(self._connections) >= MAX_CONNECTIONS:
            peer.close()
            return
        self._connections[peer.fileno()] = Connection(peer)
        self._epoll.register(peer, select.EPOLLIN)

    def _drop(self, connection: Connection) -> None:
        fd = connection.peer.fileno()
        self._connections.pop(fd, None)
        with contextlib.suppress(OSError, ValueError):
            self._epoll.unregister(fd)
        connection.peer.close()

    def _send(self, peer: socket.socket, frame: Frame) -> bool:
        """Send without ever waiting: a gateway that does not read its few replies has lost them."""
        data = encode(frame)
        try:
            return peer.send(data, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL) == len(data)
        except OSError:
            return False

    def _read(self, connection: Connection) -> None:
        try:
            data = connection.peer.recv(1 << 20, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(connection)
            return
        connection.decoder.feed(data)
        try:
            while connection.peer.fileno() in self._connections and (frame := connection.decoder.next()) is not None:
                self._obey(connection, frame)
        except FrameError as error:
            self._send(connection.peer, {"ok": False, "error": f"refused: {error}"})
            self._drop(connection)

    def _obey(self, connection: Connection, frame: Frame) -> None:
        match frame.get("op"):
            case "run":
                self._begin(connection, frame)
                return
            case "ping":
                reply = self._report()
            case "cancel":
                run = self._run
                found = run is not None and run.id == frame.get("run")
                if run is not None and found:
                    run.end(2 if frame.get("reason") == "deadline" else 1, float(frame.get("grace_s", GRACE_S)))
                reply = {"ok": found}
            case "stop":
                self._asked_to_stop(0, None)
                reply = {"ok": True}
            case other:
                reply = {"ok": False, "error": f"unknown op {str(other)[:40]!r}"}
        if not self._send(connection.peer, reply):
            self._drop(connection)

    def _report(self) -> Frame:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return {
            "ok": True,
            "run": self._run.id if self._run else "",
            "runs": self._runs,
            "rss_mb": round(pages * mmap.PAGESIZE / 2**20, 1),
            "problems": self._problems,
        }

    def _begin(self, connection: Connection, order: Frame) -> None:
        skill = str(order.get("skill", ""))
        problem = ""
        if self._run is not None or self._stopping:
            problem = "busy: another run has not ended" if self._run else "stopping"
        elif skill not in self._folders:
            problem = f"skill {skill[:60]!r} is not in this container"
        if problem:
            code = "refused" if skill in self._folders else "not-found"
            self._send(connection.peer, {"ev": "error", "code": code, "message": problem, "retryable": True})
            self._drop(connection)
            return
        peer = connection.peer
        del self._connections[peer.fileno()]
        try:
            run = Run(order, peer, self._scratch / f"run-{uuid.uuid4().hex[:8]}")
        except (TypeError, ValueError) as error:
            self._send(peer, {"ev": "error", "code": "payload", "message": child.explain(error), "retryable": False})
            self._epoll.unregister(peer)
            peer.close()
            return
        pipe = os.pipe()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        run.pid = os.fork()
        if run.pid == 0:
            try:
                signal.set_wakeup_fd(-1)
                child.main(
                    peer,
                    order,
                    handler=self._handlers.get(skill, self._problems.get(skill, "")),
                    folder=self._folders[skill],
                    scratch=run.scratch,
                    shared=run.shared,
                    pipe=pipe,
                    processes=self._processes,
                )
            finally:
                os._exit(70)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        os.close(pipe[1])
        run.output = pipe[0]
        # From here the child reads it; the zygote only wants to know when the other side hangs up.
        self._epoll.modify(peer, select.EPOLLRDHUP)
        self._run = run
        self._runs += 1

    def _watch(self) -> None:
        run = self._run
        if run is None:
            return
        now = time.monotonic()
        if run.kill_at is not None and now >= run.kill_at:
            run.kill()
        elif run.kill_at is None and now >= run.deadline:
            run.end(2, GRACE_S)

    def _reap(self) -> None:
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if self._run is not None and pid == self._run.pid:
                run, self._run = self._run, None
                self._conclude(run, status)

    def _conclude(self, run: Run, status: int) -> None:
        run.kill()
        if not run.shared[child.DONE] and not run.shared[child.IN_TRANSIT]:
            self._send(run.peer, self._autopsy(run, status))
        os.close(run.output)
        with contextlib.suppress(OSError, ValueError):
            self._epoll.unregister(run.peer)
        self._sweep(run)
        run.peer.close()  # end of file tells the gateway that the container is free again
        run.shared.close()

    def _autopsy(self, run: Run, status: int) -> Frame:
        code = os.waitstatus_to_exitcode(status)
        reason = child.REASONS.get(run.shared[child.REASON], "")
        if reason == "deadline":
            text = f"did not end within {run.timeout_s:g} s"
        elif reason:
            text = f"was ended: {reason}"
        elif code < 0:
            text = f"was killed by {signal.Signals(-code).name}"
            if -code == signal.SIGKILL:
                text += ", as the kernel does when memory runs out"
            elif -code == signal.SIGXCPU:
                text += ": it used more CPU time than its deadline allows"
        else:
            text = f"ended by itself with status {code} and no result"
        left = b""
        if select.select([run.output], [], [], 0)[0]:  # what it wrote last and its own thread no longer passed on
            left = os.read(run.output, 4096)
        trace = left.decode("utf-8", "replace").strip().splitlines()[-8:]
        return {
            "ev": "error",
            "code": reason or "crashed",
            "message": f"the handler {text}",
            "retryable": reason != "cancelled",
            "trace": trace,
        }

    def _sweep(self, run: Run) -> None:
        if not self._alone:
            shutil.rmtree(run.scratch, ignore_errors=True)
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(-1, signal.SIGKILL)  # what left its process group; process 1 itself is spared
        for folder in ("/tmp", "/dev/shm"):  # noqa: S108 - this container's own
            for entry in Path(folder).iterdir():
                if entry.is_dir() and not entry.is_symlink():
                    shutil.rmtree(entry, ignore_errors=True)
                else:
                    with contextlib.suppress(OSError):
                        entry.unlink()


def _woken(number: int, frame: FrameType | None) -> None:
    """Take a signal that is only to wake the loop."""
    del number, frame


def main() -> None:
    """Parse, preload, serve."""
    parser = argparse.ArgumentParser(prog="runner")
    parser.add_argument("--socket", required=True)
    parser.add_argument("--spec", required=True, help="JSON: skills (id -> folder), modules to import")
    parser.add_argument("--scratch", default="/tmp")  # noqa: S108 - a tmpfs of this container alone
    parser.add_argument("--processes", type=int, default=0, help="most processes of the user; 0: not limited here")
    options = parser.parse_args()
    zygote = Zygote(
        options.socket, json.loads(options.spec), scratch=Path(options.scratch), processes=options.processes
    )
    zygote.preload()
    zygote.serve()
    sys.exit(0)


if __name__ == "__main__":
    main()
