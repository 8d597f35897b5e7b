"""`ctx`: everything a skill handler can ask of the appliance.

Each method that needs an answer is one frame out and one frame in on the run's own connection, so a handler is
plain blocking code and needs nothing installed. Calls are numbered in the order they are made; the number is
part of the effect's identity, so a handler that makes the same calls again in a later attempt doubles nothing.
"""

import select
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from .frames import Decoder, FrameError, encode

Frame = dict[str, Any]


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


class Link:
    """The run's connection to its gateway. A cancel never tears a frame: it is held back while one moves."""

    def __init__(self, connection: socket.socket, mark: Callable[[bool], None]) -> None:
        self._socket = connection
        self._mark = mark
        self._decoder = Decoder()
        self._sending = threading.Lock()
        self._asking = threading.Lock()
        self._held = 0
        self._cancelled = False
        self._count = 0

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
        """Send one frame whole; Cancelled when the gateway is gone."""
        data = encode(frame)
        before = self._cancelled
        self._enter()
        try:
            with self._sending:
                self._mark(True)
                try:
                    self._socket.sendall(data)
                except OSError as error:
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
            self.send({"ev": "call", "n": number, "name": name, "args": args})
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


class Context:
    """What a handler's `run(ctx)` gets.

    Attributes:
        params: The subtask's parameters.
        robot: The robot it is bound to, or None.
        inputs: Results of the subtasks it comes after, by subtask id.
        attempt: 1 for the first try.
        site: The site's map, as a plain dict.
        scratch: A folder of this run alone, gone afterwards.
    """

    Fail = Fail
    CallError = CallError
    Cancelled = Cancelled

    def __init__(self, link: Link, order: Frame, scratch: Path) -> None:
        self._link = link
        self.params: dict[str, Any] = order.get("params") or {}
        self.robot: str | None = order.get("robot")
        self.inputs: dict[str, dict[str, Any]] = order.get("inputs") or {}
        self.attempt: int = int(order.get("attempt", 1))
        self.site: dict[str, Any] = order.get("site") or {}
        self.scratch = scratch

    def command(self, verb: str, timeout_s: float = 60, **args: Any) -> dict[str, Any]:
        """Have the robot do `verb` and return its answer; files come as bytes in `answer["blobs"][name]`.

        Raises:
            CallError: the robot did not, with the reason.
        """
        return self._dict(self._link.ask("command", {"verb": verb, "timeout_s": timeout_s, "args": args}))

    def notify(self, to: str, text: str) -> dict[str, Any]:
        """Send a message to a person."""
        return self._dict(self._link.ask("notify", {"to": to, "text": text}))

    def put_artifact(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> dict[str, Any]:
        """Keep a file and return a reference to it, fit for a result. At most 11 MiB."""
        args = {"name": name, "data": bytes(data), "media_type": media_type}
        return self._dict(self._link.ask("put_artifact", args))

    def get_artifact(self, ref: dict[str, Any]) -> bytes:
        """Return the bytes of a file that a result refers to, from whichever gateway has it."""
        data: Any = self._dict(self._link.ask("get_artifact", {"ref": ref})).get("data", b"")
        return data if isinstance(data, bytes) else b""

    def progress(self, fraction: float, note: str = "") -> None:
        """Tell how far it is, 0 to 1, and what it does."""
        self._link.send({"ev": "progress", "fraction": min(1.0, max(0.0, float(fraction))), "note": str(note)[:500]})

    def log(self, text: str, **fields: Any) -> None:
        """Write a line to the fleet's log."""
        self._link.send({"ev": "log", "text": str(text)[:4000], "fields": fields})

    def partial(self, result: dict[str, Any]) -> None:
        """Publish what is known so far of the result."""
        self._link.send({"ev": "partial", "result": result})

    def checkpoint(self, data: dict[str, Any]) -> None:
        """Keep data from which a later attempt could go on."""
        self._link.send({"ev": "checkpoint", "data": data})

    @staticmethod
    def _dict(value: Any) -> dict[str, Any]:
        return cast("dict[str, Any]", value) if isinstance(value, dict) else {}
