"""Network namespaces for a fleet without being root: a user namespace in which this process may make them.

`swiftbot bench … --faults` runs itself again by `enter` inside a user and network namespace of its own (`unshare`),
in which it may make interfaces and further namespaces; nobody else on the machine sees any of it. Each gateway gets a
namespace with one interface, whose other end is a port of the wire; this process has one too. Podman's API is a Unix
socket and is reached from any network namespace.
"""

import array
import asyncio
import contextlib
import fcntl
import os
import shutil
import socket
import struct
import subprocess
import sys
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager

import msgspec

from appliance.errors import PrerequisiteError
from workshop.bench.chaos.arena import Site
from workshop.bench.net.faults import Phase, Table

INSIDE = "SWIFTBOT_BENCH_NAMESPACE"
"""Set in the environment of a process that has been run again inside."""
PORT = 7447
HERE = "here"
"""The port of this process, whose frames no fault touches."""
_ETHTOOL = 0x8946
_OFF = {"tx checksums": 0x17, "scatter-gather": 0x19, "TSO": 0x1F, "GSO": 0x24}
"""Offloads that would leave checksums and cutting into frames to a device that does not exist."""
_UNSHARE = ("unshare", "--user", "--map-current-user", "--keep-caps", "--net", "--")


def problem() -> str:
    """Return why namespaces cannot be made here; nothing when they can."""
    for tool in ("unshare", "nsenter", "ip"):
        if shutil.which(tool, path=_path()) is None:
            return f"there is no {tool} command (packages util-linux and iproute2)"
    tried = subprocess.run(
        [*_UNSHARE, "ip", "link", "add", "probe0", "type", "veth", "peer", "name", "probe1"],
        capture_output=True, text=True, timeout=20, check=False, env=os.environ | {"PATH": _path()},
    )  # fmt: skip
    if tried.returncode:
        return f"this user may not make network namespaces: {tried.stderr.strip()[:200]}"
    return ""


def _path() -> str:
    return f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


def enter(arguments: Sequence[str]) -> None:
    """Run this command again inside namespaces of its own, and do not come back; nothing when it is inside already.

    Raises:
        PrerequisiteError: this user may not make them.
    """
    if os.environ.get(INSIDE):
        return
    if reason := problem():
        raise PrerequisiteError(
            f"network faults need namespaces, and {reason}",
            remedy="allow unprivileged user namespaces (sysctl user.max_user_namespaces, and where it exists "
            "kernel.unprivileged_userns_clone), or leave --faults out",
        )
    command = (*_UNSHARE, sys.executable, "-m", "appliance.cli", *arguments)
    os.execvpe(command[0], command, os.environ | {INSIDE: "1", "PATH": _path()})  # noqa: S606 - no shell is wanted


class Net:
    """The wire of a fleet and who is on it."""

    def __init__(self, sites: dict[str, Site], wire: asyncio.subprocess.Process) -> None:
        self.sites = sites
        self._wire = wire

    async def set(self, table: Table) -> dict[str, int]:
        """Make the wire as bad as that; an empty table makes it good. Returns what it has counted so far."""
        if self._wire.stdin is None or self._wire.stdout is None:
            raise PrerequisiteError("the wire has no pipes")
        self._wire.stdin.write(msgspec.json.encode(table) + b"\n")
        line = await self._wire.stdout.readline()
        if not line:
            raise PrerequisiteError("the wire has broken", remedy="its reason stands above")
        return msgspec.json.decode(line, type=dict[str, int])


async def disturb(
    it: Net,
    planned: Sequence[Phase],
    began: float,
    progress: Callable[[str], None],
    *,
    noted: Callable[[Phase], Callable[[], None]] = lambda _: lambda: None,
) -> dict[str, int]:
    """Make the wire bad as planned, from `began` (monotonic) on; returns what became of the frames meanwhile.

    `noted` is called as a fault begins; what it returns, when the wire is good again.
    """
    before = await it.set({})
    for phase in planned:
        await asyncio.sleep(max(0.0, began + phase.at_s - time.monotonic()))
        progress(f"{phase.name} for {phase.until_s - phase.at_s:g} s")
        await it.set(phase.table)
        over = noted(phase)
        await asyncio.sleep(max(0.0, began + phase.until_s - time.monotonic()))
        await it.set({})
        over()
    after = await it.set({})
    return {each: after[each] - before.get(each, 0) for each in after}


@asynccontextmanager
async def net(gateways: Sequence[str], *, seed: int) -> AsyncGenerator[Net]:
    """Namespaces for these gateways and a clean wire between them; this process must be inside (`enter`)."""
    if not os.environ.get(INSIDE):
        raise PrerequisiteError("not inside a namespace of its own", remedy="this is done by `enter`")
    holders: list[subprocess.Popen[bytes]] = []
    try:
        _ip("link", "set", "lo", "up")
        sites: dict[str, Site] = {}
        for number, name in enumerate(gateways, start=1):
            holder = _hold()
            holders.append(holder)
            inside = ("nsenter", "--target", str(holder.pid), "--net", "--")
            _veth(f"w{number}", f"g{number}")
            _ip("link", "set", f"g{number}", "netns", str(holder.pid))
            for command in (
                ("ip", "link", "set", "lo", "up"),
                ("ip", "address", "add", f"10.77.0.{number}/24", "dev", f"g{number}"),
                ("ip", "link", "set", f"g{number}", "up"),
            ):
                _run(*inside, *command)
            sites[name] = Site(endpoint=f"tls/10.77.0.{number}:{PORT}", enter=inside)
        _veth("w0", "me0")
        _ip("address", "add", "10.77.0.254/24", "dev", "me0")
        _ip("link", "set", "me0", "up")
        ports = [f"{HERE}=w0", *(f"{name}=w{number}" for number, name in enumerate(gateways, start=1))]
        wire = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "workshop.bench.net.wire", str(seed), *ports,
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            it = Net(sites, wire)
            await it.set({})
            yield it
        finally:
            if wire.stdin is not None:
                wire.stdin.close()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(3.0):
                    await wire.wait()
            if wire.returncode is None:
                wire.kill()
                await wire.wait()
    finally:
        for holder in holders:
            holder.kill()
            holder.wait()


def _hold() -> "subprocess.Popen[bytes]":
    """Start a process that does nothing but keep a network namespace; returns once it is in it."""
    holder = subprocess.Popen(
        ["unshare", "--net", "--", "sh", "-c", "echo; exec sleep infinity"], stdout=subprocess.PIPE
    )
    if holder.stdout is None or not holder.stdout.readline():
        raise PrerequisiteError("a network namespace could not be made", remedy="its reason stands above")
    return holder


def _veth(one: str, other: str) -> None:
    _ip("link", "add", one, "type", "veth", "peer", "name", other)
    for name in (one, other):
        for value in _OFF.values():
            _offload(name, value)
    _ip("link", "set", one, "up")


def _offload(interface: str, command: int) -> None:
    """Switch an offload of an interface off (struct ethtool_value behind struct ifreq, ethtool(8) does the same)."""
    value = array.array("B", struct.pack("II", command, 0))
    request = struct.pack("16sP", interface.encode(), value.buffer_info()[0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle, contextlib.suppress(OSError):
        fcntl.ioctl(handle.fileno(), _ETHTOOL, request)


def _ip(*arguments: str) -> None:
    _run("ip", *arguments)


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode:
        raise PrerequisiteError(f"{' '.join(command)}: {done.stderr.strip()[:300]}")
