"""What is loaded before the first run: modules, handlers, and what handlers' `preload(ctx)` reads.

It runs in the zygote, which is process 1 of its container and holds what every run will share; and it is others'
code, which may hang, crash or eat memory. So what is loaded for the first time is rehearsed in a child, where
whatever does not end in time or dies can be killed and left out; then it is loaded for good. A gateway that has
seen a container of the same make come up well says so (`Spec.proven`), and the rehearsal is saved. Whatever could
not be loaded is a problem that `ping` tells; it stops nothing, and a run may try it again within its own limits.
"""

import contextlib
import gc
import hashlib
import importlib
import importlib.machinery
import importlib.util
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable, Generator, Iterator
from functools import partial
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

from .context import Surroundings
from .limits import HEADROOM, address_space
from .link import CallError
from .spec import Skill, Spec

FIRST_S = 10.0
"""Longest that a rehearsal takes to begin with its first item."""
HUGE = 2 * 2**20
"""A huge page of x86-64 and of arm64 with 4 KiB pages."""
WORTH_MB = 24
"""From this size on the pages are made huge: it takes some 2 ms a MB once, and saves 20 us a MB at each fork."""
MADV_COLLAPSE = 25
ENDED = "ended: "
"""Begins the reason of a problem that no run should meet again: it hung, crashed or ate memory."""

Item = tuple[str, float, Callable[[], None]]


class Overrun(BaseException):
    """What is being loaded takes too long. Not an Exception, so that it is not swallowed."""


def explain(error: BaseException) -> str:
    """Return an error as one line, with its type where the text alone would say little."""
    return f"{type(error).__name__}: {error}"[:2000]


class _Hashing(importlib.machinery.SourceFileLoader):
    """A loader that notes the digest of the source it runs, or that its bytecode was checked against."""

    digest = ""

    def get_data(self, path: str) -> bytes:
        data = super().get_data(path)
        if path == self.path:
            self.digest = hashlib.sha256(data).hexdigest()
        return data


def load_handler(skill: Skill) -> ModuleType:
    """Import `handler.py` of a skill's folder.

    Raises:
        ImportError: there is none, or it has no `run`. Whatever it raises itself while being imported.
    """
    path = skill.folder / "handler.py"
    name = f"skill_{skill.name}"
    spec = importlib.util.spec_from_file_location(name, path, loader=_Hashing(name, str(path)))
    if spec is None or spec.loader is None or not path.is_file():
        raise ImportError(f"{path} does not exist")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickle look their module up
    spec.loader.exec_module(module)
    if not callable(getattr(module, "run", None)):
        raise ImportError(f"{path} has no function run(ctx)")  # noqa: TRY004 - what cannot be imported as a handler
    return module


def call_preload(module: ModuleType, skill: Skill, spec: Spec) -> Any:
    """Return what a handler's `preload(ctx)` returns; FileNotFoundError where a file of its manifest is missing."""
    around = Surroundings(skill, spec)
    for name in skill.loads:
        volume, _, inside = name.rpartition(":")
        path = around.volume(volume) / inside if volume else skill.folder / inside
        if not path.exists():
            raise FileNotFoundError(f"{name} is not there")
    return module.preload(around)


class Loaded:
    """What a zygote holds for its runs."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self.handlers: dict[str, ModuleType] = {}
        self.values: dict[str, Any] = {}
        self.problems: dict[str, str] = {}
        """By item: `module NAME`, the skill's name for its handler, `preload NAME`, `threads of ITEM`."""
        self.code: dict[str, str] = {}
        """SHA-256 digests of the source files that were loaded, by `ROOT/path`; the gateway compares them."""
        self._until = time.monotonic() + spec.patience_s

    def handler(self, skill: Skill) -> tuple[ModuleType, Any]:
        """Return a skill's handler and what it has loaded, loading now what could not be before.

        Raises:
            CallError: loading it had to be ended before. Whatever loading it raises.
        """
        for item in (skill.name, f"preload {skill.name}"):
            if (reason := self.problems.get(item, "")).startswith(ENDED):
                remedy = "mend its handler, or raise preload_s and preload_mb in its skill.toml"
                raise CallError("preload", f"{skill.name} could not be loaded: {reason.removeprefix(ENDED)}", remedy)
        module = self.handlers.get(skill.name) or load_handler(skill)
        if skill.preload_mb and skill.name not in self.values and hasattr(module, "preload"):
            return module, call_preload(module, skill, self.spec)
        return module, self.values.get(skill.name)

    def load(self) -> None:
        """Load everything; what was not, and why, is in `problems` afterwards."""
        if not self.spec.proven:
            self.problems = _rehearse(self)
        self._until = time.monotonic() + self.spec.patience_s
        self.load_items(lambda _: None)
        self.code = self._code()
        gc.collect()
        make_pages_huge()
        gc.freeze()  # children share these pages as long as nobody touches their reference counts' neighbours

    def _code(self) -> dict[str, str]:
        """Return the digests of what was loaded from the folders of code: handlers, what they share, the runner."""
        code: dict[str, str] = {}
        for module in tuple(sys.modules.values()):
            file = getattr(module, "__file__", None)
            path = self._path(Path(file)) if isinstance(file, str) and file.endswith(".py") else ""
            if not path:
                continue
            loader = getattr(module, "__loader__", None)
            digest = loader.digest if isinstance(loader, _Hashing) else ""
            try:
                code[path] = digest or hashlib.sha256(Path(str(file)).read_bytes()).hexdigest()
            except OSError as error:
                code[path] = explain(error)
        return code

    def _path(self, file: Path) -> str:
        for name, root in self.spec.roots.items():
            if file.is_relative_to(root):
                return f"{name}/{file.relative_to(root).as_posix()}"
        return ""

    def load_items(self, tell: Callable[[str], None]) -> None:
        """Load what is no problem yet, one by one, telling which is begun and which became a problem."""
        threads = _threads()
        for name, limit_s, work in self._items():
            if name in self.problems:
                continue
            limit_s = min(limit_s, self._until - time.monotonic())  # noqa: PLW2901 - what is left of it
            problem = f"not loaded: all else took the {self.spec.patience_s:g} s there are"
            if limit_s > 0:
                tell(f"begin\t{name}\t{limit_s}")
                problem = _attempt(work, limit_s)
            if problem:
                self.problems[name] = problem
                tell(f"problem\t{name}\t{problem}")
            now = _threads()
            if started := now - threads:
                self.problems[f"threads of {name}"] = (
                    f"it started {len(started)} threads, which do not live through a fork and may hold locks for ever"
                )
            threads = now

    def _items(self) -> Iterator[Item]:
        for module in self.spec.modules:
            yield f"module {module}", self.spec.import_s, lambda module=module: _import(module)
        for skill in self.spec.skills.values():
            yield skill.name, self.spec.import_s, lambda skill=skill: self._import_handler(skill)
        for skill in self.spec.skills.values():
            handler = self.handlers.get(skill.name)
            if handler is None or not callable(getattr(handler, "preload", None)):
                continue
            yield f"preload {skill.name}", skill.preload_s, lambda skill=skill: self._preload(skill)

    def _import_handler(self, skill: Skill) -> None:
        self.handlers[skill.name] = load_handler(skill)

    def _preload(self, skill: Skill) -> None:
        if not skill.preload_mb:
            raise MemoryError("its manifest allows it no memory: set preload_mb")
        before = resident()
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        resource.setrlimit(resource.RLIMIT_AS, (address_space() + skill.preload_mb * 2**20 + HEADROOM, hard))
        try:
            value = call_preload(self.handlers[skill.name], skill, self.spec)
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        grown_mb = (resident() - before) / 2**20
        if grown_mb > skill.preload_mb:
            del value
            raise MemoryError(f"it took {grown_mb:.0f} MB, preload_mb allows {skill.preload_mb}")
        self.values[skill.name] = value


def _import(name: str) -> None:
    importlib.import_module(name)


def _too_long(limit_s: float) -> str:
    return f"{ENDED}did not end within {limit_s:.3g} s"


@contextlib.contextmanager
def _in_time(limit_s: float) -> Generator[None]:
    """Raise Overrun in what takes too long; what hangs in C never comes back to notice: see `_rehearse`."""

    def ring(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise Overrun

    before = signal.signal(signal.SIGALRM, ring)
    timer = signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, *timer)


def _attempt(work: Callable[[], None], limit_s: float) -> str:
    """Do it; returns why it could not be done, empty when it was."""
    try:
        with _in_time(limit_s):
            work()
    except Overrun:
        return _too_long(limit_s)
    except MemoryError as error:
        return ENDED + explain(error)
    except BaseException as error:  # noqa: BLE001 - supervision boundary: others' code; reported by `ping`
        return explain(error)
    return ""


def _rehearse(loaded: Loaded) -> dict[str, str]:
    """Load everything in a child; returns what must be left out, by item, with the reason."""
    while True:
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            try:
                loaded.load_items(partial(_tell, writing))
                os._exit(0)
            finally:
                os._exit(70)
        os.close(writing)
        item, reason = _attend(reading, pid, loaded.problems)
        os.close(reading)
        known = item in loaded.problems
        if reason:
            loaded.problems[item or "rehearsal"] = reason
        if not reason or known or not item:
            return loaded.problems


def _tell(fd: int, line: str) -> None:
    os.write(fd, line.replace("\n", " ").encode(errors="replace")[:2000] + b"\n")


def _attend(fd: int, pid: int, problems: dict[str, str]) -> tuple[str, str]:
    """Follow a rehearsal and note its problems; returns the item that it did not survive and why, or no reason."""
    item, rest = "", b""
    limit_s, until = FIRST_S, time.monotonic() + FIRST_S
    while True:
        # A little more than it has itself, so that what can end by itself does.
        if not select.select([fd], [], [], max(0.0, until + 0.5 - time.monotonic()))[0]:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return item, _too_long(limit_s)
        data = os.read(fd, 65536)
        if not data:
            break
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            kind, name, text = line.decode("utf-8", "replace").split("\t", 2)
            if kind == "problem":
                problems[name] = text
            else:
                item, limit_s = name, float(text)
                until = time.monotonic() + limit_s
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if code == 0:
        return "", ""
    return item, ENDED + (f"killed by {signal.Signals(-code).name}" if code < 0 else f"left with status {code}")


def _threads() -> set[str]:
    """Return the ids of this process's threads: by their number alone, one that ends would hide one that starts."""
    return set(os.listdir("/proc/self/task"))  # noqa: PTH208 - names are all that is wanted


def resident() -> int:
    """Return this process's resident memory, bytes."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()


def make_pages_huge() -> None:
    """Gather a large heap into huge pages: a fork copies the table of pages, 512 entries for each that is not huge.

    Kernels before 6.1 cannot, and say so; all then stays as it was.
    """
    if resident() < WORTH_MB * 2**20:
        return
    try:
        import ctypes  # noqa: PLC0415 - a megabyte that small zygotes are spared
    except ImportError:
        return
    madvise = ctypes.CDLL(None).madvise
    for line in Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines():
        span, rights, _, _, inode, *name = line.split(maxsplit=5)
        if inode != "0" or not rights.startswith("rw-p") or (name and name[0] != "[heap]"):
            continue
        low, high = (int(each, 16) for each in span.split("-"))
        low, high = -(-low // HUGE) * HUGE, high // HUGE * HUGE
        if high > low:
            madvise(ctypes.c_void_p(low), ctypes.c_size_t(high - low), MADV_COLLAPSE)
