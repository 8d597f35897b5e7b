"""Zenoh's threads keep their state of Python's between two callbacks.

A thread that is not Python's own is given a state when it calls Python, and loses it when it returns: with Python 3.11
that maps 16 KiB for its frames and unmaps them, for each message, and all processors that run the process are told of
it; together about a tenth of a question between two gateways. Here the first call on a thread holds the state once
more than the library lets go of it, so that it stays. What it takes is right:

- `PyGILState_Ensure` counts, and the library gives back no more than it took. The thread that is there calls it, and
  holds Python's lock. Only Zenoh's threads do, which are known by their names: Python's own keep theirs, and free it.
- A thread of Zenoh's may end (a pool that waits for something lends its place to a new one). Whoever comes next frees
  the states of those that have: nothing runs on them, and nothing will.
- A child made by `fork` has none of these threads, and Python has freed their states there.

Callbacks run on the threads that read from the links, so they must not wait; what they need of the event loop's they
look at as it is at one moment (records and rings are replaced, never changed), or hand over to it (`queues`).

Not done: to have Zenoh's threads that read look at the sockets themselves (`ZENOH_RUNTIME` with `acc` and `net` handed
over to `rx`). It saves a switch of threads for each message, a tenth of a question, but one that reads and waits for
room to send may then be the one that would have heard that there is room again: the link stands still until its lease
is over. Zenoh itself sends so (declarations, and all that a router passes on).
"""

import ctypes
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import zenoh

T = TypeVar("T")

_TASKS = Path("/proc/self/task")
_NAME = re.compile(r"(app|acc|net|rx|tx)-\d+\n")

_python = ctypes.pythonapi
_python.PyThreadState_Get.restype = ctypes.c_void_p
_python.PyThreadState_Clear.argtypes = [ctypes.c_void_p]
_python.PyThreadState_Clear.restype = None
_python.PyThreadState_Delete.argtypes = [ctypes.c_void_p]
_python.PyThreadState_Delete.restype = None


class _Here(threading.local):
    """Lives as long as the state of the thread it is looked at from."""

    kept = False


_here = _Here()


class _Kept:
    """The states that are held, and what frees them."""

    def __init__(self) -> None:
        self.states: dict[int, int] = {}
        """Thread, by the system's number -> its state's address."""
        self._lock = threading.Lock()

    def hold(self, number: int) -> None:
        """Hold the state of the thread that calls, and free those whose threads have ended."""
        with self._lock:
            # One of the same number has ended: it was given again.
            ended = [each for each in self.states if each == number or not (_TASKS / str(each)).exists()]
            states = [self.states.pop(each) for each in ended]
            _python.PyGILState_Ensure()
            self.states[number] = _python.PyThreadState_Get()
        for state in states:
            _python.PyThreadState_Clear(state)
            _python.PyThreadState_Delete(state)

    def forget(self) -> None:
        """In a child: none of them is there, and a thread that is not may have had the lock."""
        self.__init__()


_kept = _Kept()
os.register_at_fork(after_in_child=_kept.forget)


def callback(take: Callable[[T], None], *, drop: Callable[[], object] | None = None) -> "zenoh.handlers.Callback[T]":
    """A callback for Zenoh, which calls it on its own threads."""

    def call(what: T) -> None:
        if not _here.kept:
            keep()
        take(what)

    return zenoh.handlers.Callback(call, drop=drop, indirect=False)


def keep() -> None:
    """Have the thread that calls keep its state until it ends, if it is one of Zenoh's."""
    _here.kept = True
    number = threading.get_native_id()
    if _is_zenohs(number):
        _kept.hold(number)


def _is_zenohs(number: int) -> bool:
    try:
        return _NAME.fullmatch((_TASKS / str(number) / "comm").read_text()) is not None
    except OSError:
        return False
