"""The states of threads that are not Python's own: which are kept, and that they are freed once their threads end."""

import ctypes
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from appliance.plane import threads

_PR_SET_NAME = 15


def _on_another_thread(name: str, run: Callable[[], None]) -> int:
    """Run something on a thread that Python has not made, of that name; returns the system's number of it."""
    libc, numbers, problems = ctypes.CDLL(None), list[int](), list[BaseException]()
    start = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)

    def body(_: object) -> None:
        numbers.append(threading.get_native_id())
        try:
            libc.prctl(_PR_SET_NAME, name.encode())
            run()
        except BaseException as problem:  # noqa: BLE001 - the test looks at it on its own thread
            problems.append(problem)

    entry, thread = start(body), ctypes.c_ulong()
    assert libc.pthread_create(ctypes.byref(thread), None, entry, None) == 0
    assert libc.pthread_join(thread, None) == 0
    assert not problems
    return numbers[0]


def test_the_state_of_a_thread_that_has_ended_is_freed() -> None:
    """Whoever is kept next frees it; the number of its thread may have been given again."""
    first = _on_another_thread("rx-70", threads.keep)
    assert first in threads._kept.states
    state = threads._kept.states[first]
    second = first
    # The system may still show a thread for a moment after it was waited for.
    while first in threads._kept.states and threads._kept.states[first] == state:
        second = _on_another_thread("net-1", threads.keep)
    assert second in threads._kept.states
    for _ in range(200):
        _on_another_thread("rx-71", threads.keep)
    ended = [each for each in threads._kept.states if not (threads._TASKS / str(each)).exists()]
    assert len(ended) < 100


def test_only_zenohs_threads_are_kept() -> None:
    """Python frees the states of its own threads; of any other nothing is known."""
    for name in ("python", "rx", "rx-", "rx-a", "xrx-1", "rx-1x"):
        assert _on_another_thread(name, threads.keep) not in threads._kept.states
    numbers = list[int]()

    def own() -> None:
        threads.keep()
        numbers.append(threading.get_native_id())

    thread = threading.Thread(target=own)
    thread.start()
    thread.join()
    threads.keep()
    assert not {*numbers, threading.get_native_id()} & threads._kept.states.keys()


def test_a_child_has_none_of_them() -> None:
    """After a fork nothing is freed twice: the child has none of the threads, and keeps those it gets itself."""
    script = f"""
import os, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_threads
from appliance.plane import threads
test_threads._on_another_thread("rx-1", threads.keep)
assert len(threads._kept.states) == 1
child = os.fork()
if child == 0:
    assert not threads._kept.states
    number = test_threads._on_another_thread("rx-2", threads.keep)
    os._exit(0 if number in threads._kept.states else 1)
assert os.waitpid(child, 0)[1] == 0
"""
    subprocess.run([sys.executable, "-c", script], check=True)
