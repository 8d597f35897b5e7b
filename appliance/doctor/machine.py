"""What the checks ask of the machine, in one class: the seam that tests replace.

It exists so that each check is a plain decision over plain facts, and a machine without subordinate ids, with a
full disk or a foreign owner of its runtime folder is a line in a test and not a machine.
"""

import locale
import os
import pwd
import shutil
import socket
import stat
import sys
import time
from collections.abc import Mapping
from ctypes import CDLL, byref, create_string_buffer
from pathlib import Path
from typing import Protocol

import psutil
from msgspec import Struct

_TIME_ERROR = 5
"""adjtimex's state of a clock that nothing keeps in time (adjtimex(2))."""
_TIMEX_BYTES = 256
"""More than struct timex has on any architecture; all zero asks and changes nothing."""


class FileFacts(Struct, frozen=True, kw_only=True):
    """Who owns a file, its permission bits, whether we may write it; `privileged`: setuid root or capabilities."""

    owner: int
    mode: int
    writable: bool
    privileged: bool = False


class Machine(Protocol):
    """The machine as the checks see it."""

    @property
    def python(self) -> tuple[int, ...]:
        """Version of Python."""
        ...

    @property
    def uid(self) -> int:
        """Whose process this is."""
        ...

    @property
    def user(self) -> str:
        """That user's name."""
        ...

    @property
    def home(self) -> Path:
        """That user's home."""
        ...

    @property
    def environ(self) -> Mapping[str, str]:
        """The environment."""
        ...

    @property
    def encoding(self) -> str:
        """Of text to and from the terminal."""
        ...

    def which(self, program: str) -> str | None:
        """Return a program's path, None when it is not installed."""
        ...

    def read(self, path: Path) -> str | None:
        """Return a text file, None when it cannot be read."""
        ...

    def stat(self, path: Path) -> FileFacts | None:
        """Return facts of a file or folder, None when there is none."""
        ...

    def free_mb(self, path: Path) -> float:
        """Return the free space where a folder is or would be made."""
        ...

    def bind_problem(self, host: str, port: int, *, udp: bool) -> str:
        """Return why a port cannot be taken; empty when it can."""
        ...

    def listener(self, port: int, *, udp: bool) -> str:
        """Return the command line of this user's process that has a port; empty when it is not ours to see."""
        ...

    def now(self) -> float:
        """Return Unix seconds."""
        ...

    def clock_synchronised(self) -> bool | None:
        """Return whether the kernel's clock is kept in time; None when the kernel does not tell."""
        ...


class ThisMachine:
    """The machine this runs on."""

    def __init__(self) -> None:
        self.python = tuple(sys.version_info[:3])
        self.uid = os.getuid()
        self.environ = os.environ
        self.encoding = locale.getpreferredencoding(do_setlocale=False)
        try:
            entry = pwd.getpwuid(self.uid)
            self.user, self.home = entry.pw_name, Path(entry.pw_dir)
        except KeyError:  # an id without a name, as in some containers
            self.user, self.home = str(self.uid), Path.home()

    def which(self, program: str) -> str | None:
        """Return a program's path; newuidmap and its like lie where an ordinary PATH does not look."""
        return shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/bin:/sbin:/bin")

    def read(self, path: Path) -> str | None:
        """Return a text file, None when it cannot be read."""
        try:
            return path.read_text(errors="replace")
        except OSError:
            return None

    def stat(self, path: Path) -> FileFacts | None:
        """Return facts of a file or folder, None when there is none."""
        try:
            found = path.stat()
        except OSError:
            return None
        try:
            capable = bool(os.getxattr(path, "security.capability"))
        except OSError:
            capable = False
        return FileFacts(
            owner=found.st_uid,
            mode=stat.S_IMODE(found.st_mode),
            writable=os.access(path, os.W_OK),
            privileged=capable or bool(found.st_mode & stat.S_ISUID and found.st_uid == 0),
        )

    def free_mb(self, path: Path) -> float:
        """Return the free space where a folder is or would be made."""
        while not path.exists() and path != path.parent:
            path = path.parent
        return shutil.disk_usage(path).free / 2**20

    def bind_problem(self, host: str, port: int, *, udp: bool) -> str:
        """Return why a port cannot be taken; empty when it can."""
        kind = socket.SOCK_DGRAM if udp else socket.SOCK_STREAM
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=kind)[0]
            with socket.socket(family, kind) as probe:
                if not udp:  # what a server does as well: a closed connection's rest is no hindrance
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
        except OSError as error:
            return error.strerror or str(error)
        return ""

    def listener(self, port: int, *, udp: bool) -> str:
        """Return the command line of this user's process that has a port; empty when it is not ours to see."""
        kind = "udp" if udp else "tcp"
        hidden = ""
        for process in psutil.process_iter():
            words = ""
            try:
                if process.uids().real != self.uid:
                    continue
                words = " ".join(process.cmdline())
                found = process.net_connections(kind=kind)
            except psutil.AccessDenied:
                # A hardened service does not show what it has open, even to its own user: its name must do.
                hidden = hidden or (words if "swiftbot gateway" in words else "")
                continue
            except psutil.Error:  # it has ended
                continue
            if any(each.laddr and each.laddr.port == port and not each.raddr for each in found):
                return words
        return hidden

    def now(self) -> float:
        """Return Unix seconds."""
        return time.time()

    def clock_synchronised(self) -> bool | None:
        """Return whether the kernel's clock is kept in time; None when the kernel does not tell."""
        try:
            state = CDLL(None, use_errno=True).adjtimex(byref(create_string_buffer(_TIMEX_BYTES)))
        except (OSError, AttributeError):
            return None
        return None if state < 0 else state != _TIME_ERROR
