"""A run's connection to its gateway, and the errors that can come over it.

It exists apart from `ctx` because the runner itself speaks over it too: that a run has started, what it printed,
how it ended.
"""

import errno
import select
import socket
import threading
from collections.abc import Callable
from typing import Any, cast

from .frames import MAX_FRAME, Decoder, FrameError, TooLongError, beyond, encode

Frame = dict[str, Any]
LARGE = "write large data into a volume of the skill, or keep it with ctx.put_artifact, and pass on where it is"
"""The remedy for whatever is too long."""


class Fail(Exception):  # noqa: N818 - the word skill writers use: raise ctx.Fail(...)
    """Raised by a handler: it could not do its task, and why.

    Args:
        message: What happened, for the operator.
        remedy: What to do about it.
        retryable: Whether another attempt may succeed.
    """

    def __init__(self, message: str, remedy: str = "", retryable: bool = False) -> None:
        super().__init__(message)
        self.message = str(message)
        self.remedy = str(remedy)
        self.retryable = bool(retryable)


class CallError(Fail):
    """The appliance could not do what the handler asked; it carries the error's code (`robot`, `deadline`, ...)."""

    def __init__(self, code: str, message: str, remedy: str = "", retryable: bool = False) -> None:
        super().__init__(message, remedy, retryable)
        self.code = code


class Cancelled(BaseException):
    """The run is to end now. Not an Exception, so that `except Exception` in a handler does not swallow it."""


def _encoded(what: str, frame: Frame, *, lenient: bool = False) -> bytes:
    """Return a frame's bytes; CallError with `what`, size and limit when it is too long."""
    try:
        return encode(frame, lenient=lenient)
    except TooLongError as error:
        raise CallError("payload", beyond(f"ctx.{what}", error.size, MAX_FRAME), LARGE) from error


class Link:
    """The run's connection to its gateway. A cancel never tears a frame: it is held back while one moves."""

    def __init__(self, mark: Callable[[bool], None]) -> None:
        self._socket: socket.socket
        self._mark = mark
        self._decoder = Decoder()
        self._sending = threading.Lock()
        self._asking = threading.Lock()
        self._held = 0
        self._cancelled = False
        self._count = 0
        self.saving_asked = False
        """Whether a checkpoint is wanted now."""

    @property
    def calls(self) -> int:
        """Calls made so far, in this attempt and, by its checkpoint, in those before."""
        return self._count

    def go_on_from(self, calls: int) -> None:
        """Number the calls after so many that were made before the checkpoint that this attempt goes on from."""
        self._count = calls

    def attach(self, connection: socket.socket) -> None:
        """Take the connection; until then nothing may be sent."""
        self._socket = connection

    def cancel(self) -> None:
        """Raise Cancelled in the handler, at once or as soon as the frame in transit is whole; only once."""
        if self._cancelled:
            return
        self._cancelled = True
        if not self._held:
            raise Cancelled

    def _enter(self) -> None:
        if threading.current_thread() is threading.main_thread():
            self._held += 1

    def _leave(self, before: bool) -> None:
        if threading.current_thread() is threading.main_thread():
            self._held -= 1
            if self._cancelled and not before:
                raise Cancelled

    def send(self, frame: Frame) -> None:
        """Send one frame whole, what is no Unicode in it replaced.

        Raises:
            CallError: it is longer than a frame may be.
            Cancelled: the gateway is gone.
        """
        self.send_encoded(_encoded(str(frame.get("ev")), frame, lenient=True))

    def send_encoded(self, data: bytes) -> None:
        """Send one frame that is encoded already."""
        before = self._cancelled
        self._enter()
        try:
            with self._sending:
                self._mark(True)
                try:
                    self._socket.sendall(data)
                except OSError as error:
                    if error.errno == errno.EBADF:  # the handler closed it: nothing has gone out
                        self._mark(False)
                    raise Cancelled from error
                self._mark(False)
        finally:
            self._leave(before)

    def ask(self, name: str, args: dict[str, Any]) -> Any:
        """Make one call and wait for its answer.

        Raises:
            CallError: the appliance says why not.
            Cancelled: the run is to end, or the gateway is gone.
        """
        with self._asking:
            self._count += 1
            number = self._count
            self.send_encoded(_encoded(name, {"ev": "call", "n": number, "name": name, "args": args}))
            while True:
                reply = self._receive()
                if reply.get("n") != number:
                    continue  # the answer to a call that a cancel interrupted
                if "error" in reply:
                    error = cast("dict[str, Any]", reply["error"] or {})
                    raise CallError(
                        str(error.get("code", "internal")),
                        str(error.get("message", "")),
                        str(error.get("remedy", "")),
                        bool(error.get("retryable", False)),
                    )
                return reply.get("ok")

    def _receive(self) -> Frame:
        while True:
            try:
                frame = self._decoder.next()
            except FrameError as error:
                raise Cancelled from error
            if frame is not None:
                return frame
            select.select([self._socket], [], [])  # a cancel may interrupt here, where nothing can be lost
            before = self._cancelled
            self._enter()
            try:
                data = self._socket.recv(65536)
                if not data:
                    raise Cancelled
                self._decoder.feed(data)
            except OSError as error:
                raise Cancelled from error
            finally:
                self._leave(before)
