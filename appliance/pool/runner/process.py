"""One child as the zygote sees it: forked ahead of its order or with it, ended, and what is swept up after it."""

import contextlib
import marshal
import mmap
import os
import select
import shutil
import signal
import socket
import time
from collections.abc import Collection
from pathlib import Path

from . import child
from .link import Frame

SWEEP_S = 1.0
"""How long the last processes of a run may take to be gone after SIGKILL."""


class Run:
    """A child. It waits for its order until `begin`, then it is the run of the moment."""

    def __init__(self, kit: child.Kit) -> None:
        self.id = ""
        self.peer: socket.socket | None = None
        self.kit = kit
        self.shared: mmap.mmap = kit.shared
        self.pid = 0
        self.fork_ms = 0.0
        """What the fork itself took, which grows with the zygote's memory."""
        self.timeout_s = 0.0
        self.deadline = 0.0
        self.kill_at: float | None = None
        self.order: Frame | None = None
        """What it was handed, for another child if this one dies before it takes it."""
        self._channel: socket.socket | None = None

    @classmethod
    def fork(cls, kit: child.Kit, order: Frame | None = None, peer: socket.socket | None = None) -> "Run":
        """Fork a child: for an order, or ahead of any; OSError when there can be no further process."""
        run = cls(kit)
        ours: socket.socket | None = None
        theirs: socket.socket | None = None
        if order is None:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        began = time.monotonic()
        try:
            run.pid = os.fork()
            if run.pid == 0:
                try:
                    if theirs is not None:
                        child.wait(kit, theirs)
                    elif order is not None and peer is not None:
                        child.run(kit, order, peer)
                finally:
                    os._exit(70)
        except OSError:
            os.close(kit.pipe[0])
            kit.shared.close()
            raise
        finally:
            run.fork_ms = (time.monotonic() - began) * 1e3
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
            os.close(kit.pipe[1])
            if theirs is not None:
                theirs.close()
        run._channel = ours
        return run

    def hand_over(self, order: Frame, peer: socket.socket) -> bool:
        """Give a waiting child its order, without ever waiting; False when it cannot be had that way."""
        channel = self._channel
        if channel is None:
            return False
        message = marshal.dumps(order)
        if len(message) > child.MAX_ORDER:
            return False
        try:
            socket.send_fds(channel, [message], [peer.fileno()], socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            return False
        channel.close()
        self._channel = None
        self.order = order
        return True

    def untaken(self) -> Frame | None:
        """Return the order that a child has died without having looked at, unless it was told to end."""
        return None if self.shared[child.TAKEN] or self.kill_at is not None else self.order

    def begin(self, order: Frame, peer: socket.socket, timeout_s: float) -> None:
        """Note what it runs and until when."""
        self.id = str(order.get("run", ""))
        self.peer = peer
        self.timeout_s = timeout_s
        self.deadline = time.monotonic() + timeout_s

    def end(self, reason: int, grace_s: float) -> None:
        """Ask the child to end, and set when it will be made to."""
        if self.kill_at is None:
            self.shared[child.REASON] = reason
            self.kill_at = time.monotonic() + grace_s
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)
        else:
            self.kill_at = min(self.kill_at, time.monotonic() + grace_s)

    def save(self) -> None:
        """Tell the child that a checkpoint is wanted; one that has not begun yet does not hear it."""
        if self.kill_at is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGUSR1)

    def kill(self) -> None:
        """End the child and everything it started."""
        for kill in (os.killpg, os.kill):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                kill(self.pid, signal.SIGKILL)

    def due(self) -> float:
        """Return when something is to be done about it, monotonic seconds."""
        return self.deadline if self.kill_at is None else self.kill_at

    def discard(self) -> None:
        """End a child that waits; its process is left to be reaped."""
        self.kill()
        self.forget()

    def forget(self) -> None:
        """Let go of all that was a waiting child's own."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None
        self.close()
        shutil.rmtree(self.kit.scratch, ignore_errors=True)

    def close(self) -> None:
        """Let go of what the zygote holds of it."""
        os.close(self.kit.pipe[0])
        self.shared.close()

    def autopsy(self, status: int) -> Frame | None:
        """Return the last frame of a child that died without one; None when it said all itself, or broke off."""
        if self.shared[child.DONE] or self.shared[child.IN_TRANSIT]:
            return None
        code = os.waitstatus_to_exitcode(status)
        reason = child.REASONS.get(self.shared[child.REASON], "")
        remedy = ""
        if reason == "deadline":
            text = f"did not end within {self.timeout_s:g} s, nor when it was asked to, and was ended by the watchdog"
            remedy = child.SLOW
        elif reason:
            text = f"was ended: {child.TEXTS.get(reason, reason)}"
            remedy = child.REMEDIES.get(reason, "")
        elif code < 0:
            text = f"was killed by {signal.Signals(-code).name}"
            remedy = "look at its last lines and at what it calls that is not Python"
            if -code == signal.SIGKILL:
                text += ", as the kernel does when memory runs out"
                remedy = "raise memory_mb in its skill.toml"
            elif -code == signal.SIGXCPU:
                text += ": it used more CPU time than its deadline allows"
                remedy = "raise timeout_s in its skill.toml"
        else:
            text = f"ended by itself with status {code} and no result"
            remedy = "return from run(ctx), or raise ctx.Fail with the reason"
        return {
            "ev": "error",
            "code": reason or "crashed",
            "message": f"the handler {text}",
            "remedy": remedy,
            "retryable": reason != "cancelled",
            "trace": self._last_words(),
        }

    def _last_words(self) -> list[str]:
        """Return what it wrote last and its own thread no longer passed on."""
        left = b""
        if select.select([self.kit.pipe[0]], [], [], 0)[0]:
            left = os.read(self.kit.pipe[0], 4096)
        return left.decode("utf-8", "replace").strip().splitlines()[-8:]


def sweep_container(beside: Path, own: Collection[str]) -> None:
    """Remove every process and every file that a run has left in this container; for its process 1 only.

    Args:
        beside: the folder of the socket, which is the gateway's.
        own: what is to stay there.
    """
    until = time.monotonic() + SWEEP_S
    while _others() and time.monotonic() < until:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(-1, signal.SIGKILL)  # what left its process group; process 1 itself is spared
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                """What a run leaves behind comes to process 1."""
        if _others():
            time.sleep(0.001)
    for folder in (Path("/tmp"), Path("/dev/shm"), beside):  # noqa: S108 - this container's own
        for entry in folder.iterdir():
            if folder == beside and entry.name in own:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    entry.unlink()


def _others() -> bool:
    return any(name.isdigit() and name != "1" for name in os.listdir("/proc"))  # noqa: PTH208 - a list of names
