"""The zygote: process 1 of a container. It loads once, then forks one child a run, the next one ahead of its order.

It exists because a process that is already there starts a run in less than a millisecond, where a container takes
a few hundred. It never runs a handler itself, so nothing a handler does stays; it watches its child (hang-up
of the gateway, deadline, death by a signal), ends it, and sweeps up after it. One run at a time.

The child that is forked ahead is as clean as one forked for its order: it is made after the run before was swept
up, and has run no line of a handler. Where there is none (the next order came at once, it was killed, the order is
long), the child is forked with the order in hand.
"""

import contextlib
import marshal
import os
import select
import shutil
import signal
import socket
import uuid
from pathlib import Path
from time import monotonic
from types import FrameType

from . import child, usage
from .disk import LOOK_S, Disk
from .frames import Decoder, FrameError, encode
from .link import Frame
from .preload import Loaded, explain, resident
from .process import Run, sweep_container

MAX_CONNECTIONS = 16
"""A gateway keeps two; a few more for one that restarts."""
GRACE_S = 2.0
"""From SIGTERM, in which a handler may clean up, to SIGKILL."""
ORPHAN_GRACE_S = 0.5
"""The same when the gateway is gone and there is nobody to clean up with."""
DISK_GRACE_S = 0.2
"""The same when it fills the disk: until it is killed it may write on."""


class Connection:
    """A gateway's connection, while the zygote still reads it."""

    def __init__(self, peer: socket.socket) -> None:
        self.peer = peer
        self.decoder = Decoder()


class Zygote:
    """Listens, forks, watches. `alone` when it is process 1 and may sweep the whole container."""

    def __init__(self, path: str, loaded: Loaded, *, scratch: Path, processes: int) -> None:
        self._path = path
        self._loaded = loaded
        self._scratch = scratch
        self._processes = processes
        self._alone = os.getpid() == 1
        self._disk = Disk(
            loaded.spec.volumes, loaded.spec.cache, beside=Path(path).parent, reserve_mb=loaded.spec.reserve_mb
        )
        self._own: frozenset[str] = frozenset()
        """What lies beside the socket and is to stay there."""
        self._connections: dict[int, Connection] = {}
        self._run: Run | None = None
        self._ahead: Run | None = None
        self._runs = 0
        self._fork_ms = 0.0
        self._stopping = False
        self._epoll = select.epoll()

    def serve(self) -> None:
        """Work until told to stop."""
        wake, waker = os.pipe()
        for end in (wake, waker):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, _woken)  # a handler of its own, or nothing would be written to `waker`
        signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # for the children, until they can heed it
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._asked_to_stop)
        # Under its name only when somebody listens: a client that sees it can connect.
        early = f"{self._path}.new"
        with contextlib.suppress(FileNotFoundError):
            Path(early).unlink()
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(early)
        listener.listen(MAX_CONNECTIONS)
        Path(early).rename(self._path)
        self._own = frozenset(each.name for each in Path(self._path).parent.iterdir())
        self._epoll.register(wake, select.EPOLLIN)
        self._epoll.register(listener, select.EPOLLIN)
        self._fork_ahead()
        while not (self._stopping and self._run is None):
            for fd, _ in self._epoll.poll(self._patience()):
                if fd == wake:
                    with contextlib.suppress(BlockingIOError):
                        os.read(wake, 512)
                elif fd == listener.fileno():
                    self._accept(listener)
                elif self._run is not None and self._run.peer is not None and fd == self._run.peer.fileno():
                    self._epoll.unregister(fd)  # a hang-up stays one: telling once is enough
                    self._run.end(3, ORPHAN_GRACE_S)
                elif fd in self._connections:
                    self._read(self._connections[fd])
            if self._stopping and self._run is not None:
                # Told to stop while an order was on its way to its child: the signal found no run to end.
                self._run.end(4, GRACE_S)
            self._watch()
            self._reap()
        if self._ahead is not None:
            self._ahead.discard()
        with contextlib.suppress(FileNotFoundError):
            Path(self._path).unlink()

    def _asked_to_stop(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._stopping = True
        if self._run is not None:
            # Nobody called the run off: its coordinator may repeat it elsewhere.
            self._run.end(4, GRACE_S)

    def _patience(self) -> float:
        """Seconds until something is due."""
        if self._run is None:
            return 60.0
        left_s = max(0.0, self._run.due() - monotonic()) + 0.001
        return min(left_s, LOOK_S)

    # --- connections ------------------------------------------------------------------------------------------

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
        data = encode(frame, lenient=True)
        try:
            return peer.send(data, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL) == len(data)
        except OSError:
            return False

    def _read(self, connection: Connection) -> None:
        try:
            data = connection.peer.recv(1 << 16, socket.MSG_DONTWAIT)
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
            case "hello":
                reply = {"ok": True, "code": self._loaded.code}
            case "cancel":
                run = self._run
                found = run is not None and run.id == frame.get("run")
                if run is not None and found:
                    run.end(2 if frame.get("reason") == "deadline" else 1, float(frame.get("grace_s", GRACE_S)))
                reply = {"ok": found}
            case "save":
                run = self._run
                found = run is not None and run.id == frame.get("run")
                if run is not None and found:
                    run.save()
                reply = {"ok": found}
            case "stop":
                self._asked_to_stop(0, None)
                reply = {"ok": True}
            case other:
                reply = {"ok": False, "error": f"unknown op {str(other)[:40]!r}"}
        if not self._send(connection.peer, reply):
            self._drop(connection)

    def _report(self) -> Frame:
        return {
            "ok": True,
            "run": self._run.id if self._run else "",
            "runs": self._runs,
            "fork_ms": round(self._fork_ms, 3),
            "rss_mb": round(resident() / 2**20, 1),
            "problems": self._loaded.problems,
        }

    # --- runs -------------------------------------------------------------------------------------------------

    def _begin(self, connection: Connection, order: Frame) -> None:
        peer = connection.peer
        refusal = self._refusal(order)
        if refusal is not None:
            self._send(peer, refusal)
            self._drop(connection)
            return
        timeout_s = float(order.get("timeout_s", 120.0))
        run, self._ahead = self._ahead, None
        if run is None or not run.hand_over(order, peer):
            if run is not None:
                run.discard()
            try:
                run = Run.fork(self._kit(), order, peer)
            except OSError as error:
                text = f"the run could not be set up: {explain(error)}"
                self._send(peer, {"ev": "error", "code": "pool", "message": text, "retryable": True})
                self._drop(connection)
                return
        run.begin(order, peer, timeout_s)
        del self._connections[peer.fileno()]
        # From here the child reads it; the zygote only wants to know when the other side hangs up.
        self._epoll.modify(peer, select.EPOLLRDHUP)
        self._run = run
        self._runs += 1
        self._disk.begin()

    def _refusal(self, order: Frame) -> Frame | None:
        skill = str(order.get("skill", ""))
        code, problem = "refused", ""
        if self._run is not None or self._stopping:
            problem = "busy: another run has not ended" if self._run else "stopping"
        elif skill not in self._loaded.spec.skills:
            code, problem = "not-found", f"skill {skill[:60]!r} is not in this container"
        else:
            try:
                for key, default in (("timeout_s", 120.0), ("memory_mb", 128.0)):
                    float(order.get(key, default))
            except (TypeError, ValueError) as error:
                code, problem = "payload", explain(error)
        if not problem:
            return None
        return {"ev": "error", "code": code, "message": problem, "retryable": code != "payload"}

    def _kit(self) -> child.Kit:
        return child.Kit(self._loaded, self._scratch / f"run-{uuid.uuid4().hex[:8]}", self._processes)

    def _fork_ahead(self) -> None:
        if not self._stopping:
            with contextlib.suppress(OSError):  # no further process now: it is forked with its order
                self._ahead = Run.fork(self._kit())
                self._fork_ms = self._ahead.fork_ms
        self._warm_up()

    def _fork_again(self, run: Run, order: Frame, peer: socket.socket) -> bool:
        """Give an order to another child: the one that waited had died, and nothing of it was begun."""
        with contextlib.suppress(OSError):
            self._run = Run.fork(self._kit(), order, peer)
            self._run.begin(order, peer, run.timeout_s)
            run.forget()
            return True
        return False

    def _warm_up(self) -> None:
        """Touch what the next order will touch: it is copied now that a child shares it, and not on the order's way."""
        decoder = Decoder()
        decoder.feed(encode({"op": "run", "skill": "", "params": {"a": [1.0, "b"]}, "timeout_s": 1.0}))
        order = decoder.next() or {}
        marshal.dumps(order)
        self._refusal(order)

    def _watch(self) -> None:
        run = self._run
        if run is None:
            return
        now = monotonic()
        if run.kill_at is not None and now >= run.kill_at:
            run.kill()
        elif run.kill_at is None and now >= run.deadline:
            run.end(2, GRACE_S)
        elif run.kill_at is None and self._disk.overrun(now):
            run.end(5, DISK_GRACE_S)

    def _reap(self) -> None:
        while True:
            try:
                pid, status, used = os.wait4(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if self._run is not None and pid == self._run.pid:
                run, self._run = self._run, None
                self._conclude(run, status, usage.of_reaped(used))
            elif self._ahead is not None and pid == self._ahead.pid:
                self._ahead.forget()
                self._ahead = None  # the next run is forked with its order

    def _conclude(self, run: Run, status: int, used: Frame) -> None:
        peer = run.peer
        assert peer is not None  # noqa: S101 - a run of the moment has one
        run.kill()
        order = run.untaken()
        if order is not None and self._fork_again(run, order, peer):
            return
        last = run.autopsy(status)
        if last is not None:
            self._send(peer, last | used)
        run.close()
        with contextlib.suppress(OSError, ValueError):
            self._epoll.unregister(peer)
        if self._alone:
            sweep_container(Path(self._path).parent, self._own)
        else:
            shutil.rmtree(run.kit.scratch, ignore_errors=True)
        peer.close()  # end of file tells the gateway that the container is free again
        self._fork_ahead()


def _woken(number: int, frame: FrameType | None) -> None:
    """Take a signal that is only to wake the loop."""
    del number, frame
