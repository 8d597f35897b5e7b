"""What support needs of a machine, in one file without secrets: `swiftbot support`.

Checks, versions, the configuration, releases, disks, the services' states and last log lines, the gateways' accounts
of themselves, names and sizes of logs. What cannot be had (no systemd, a gateway that is down) is named in
`missing.json` and ends nothing: support is asked when something does not work.

Everything goes through the redactor that logs go through, with the secrets of this machine (configuration, key files,
environment), and besides loses what looks like a private key, a password in an address, or an environment's secret.
"""

import asyncio
import io
import os
import platform
import re
import shutil
import tarfile
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance import durable
from appliance.config import GatewayConfig, load
from appliance.deploy.backup import named_in
from appliance.deploy.command import command
from appliance.deploy.host import UNITS
from appliance.deploy.layout import Layout
from appliance.deploy.upgrade import LAST
from appliance.errors import ConfigError, SwiftbotError
from appliance.record.redact import REDACTED, Redactor
from appliance.record.segments import about, versions

LINES = 2000
"""Of each service's journal."""
MOST_FILES = 1000
"""Logs that are listed."""
DOCTOR_S = 120.0
_PRIVATE = re.compile(rb"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|\Z)", re.DOTALL)
_ADDRESS = re.compile(rb"(?<=://)[^/\s:@\"']+:[^/\s@\"']+(?=@)")
_ASSIGNED = re.compile(
    rb"(?i)\b([a-z_]*(?:password|passphrase|passwd|secret|token|api_?key)[a-z_]*\s*[=:]\s*)(\"[^\"]*\"|'[^']*'|[^\s,;&]+)"
)


class Collected(Struct, frozen=True, kw_only=True):
    """What was written."""

    file: str
    bytes: int
    parts: tuple[str, ...]
    missing: dict[str, str]
    """Why a part is not in it."""


class Cleaner:
    """Takes secrets out of whatever text: by value, by name, by their looks."""

    def __init__(self, secrets: tuple[str, ...]) -> None:
        self._redactor = Redactor(secrets)

    def clean(self, data: bytes) -> bytes:
        """Return text without secrets; JSON is looked into line by line where it is not one value."""
        data = _PRIVATE.sub(REDACTED.encode(), data)
        try:
            msgspec.json.decode(data)
            data = self._redactor.json(data)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            data = b"\n".join(self._redactor.json(line) for line in data.split(b"\n"))
            data = _ASSIGNED.sub(rb"\1" + REDACTED.encode(), data)
        return _ADDRESS.sub(REDACTED.encode(), data)


def secrets_of(config: GatewayConfig | None, environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the secrets that this machine knows: by names, and the texts of key files as far as they can be read."""
    found = list(about(msgspec.to_builtins(config) if config is not None else {}, environment).secrets)
    for path in named_in(config) if config is not None else ():
        try:
            text = path.read_text(encoding="ascii") if path.is_file() and path.stat().st_size < 2**16 else ""
        except (OSError, UnicodeDecodeError):
            continue
        # Of a private key in PEM each line is one: the log may hold any of them.
        found += [line for line in text.splitlines() if len(line) >= 40 and "-----" not in line]
    return tuple(dict.fromkeys(found))


async def collect(
    file: Path,
    config_file: Path,
    *,
    doctor: Callable[[GatewayConfig | None], Awaitable[object]],
    fleet: Callable[[GatewayConfig], Awaitable[object]],
    layout: Layout,
    say: Callable[[str], None],
) -> Collected:
    """Write what support needs.

    Args:
        file: to write; not there yet.
        config_file: the gateway's; where it cannot be read, that is one of the findings.
        doctor: gives the checks of this machine.
        fleet: gives the gateways' accounts of themselves.
        layout: of the releases.
        say: hears of each part.

    Raises:
        ConfigError: the file is there, or cannot be written.
    """
    missing: dict[str, str] = {}
    config: GatewayConfig | None = None
    try:
        config = await asyncio.to_thread(load, config_file)
    except SwiftbotError as error:
        missing["configuration.json"] = str(error)
    sources: dict[str, Callable[[], Awaitable[bytes]]] = {
        "versions.json": lambda: asyncio.to_thread(_versions),
        "machine.json": lambda: asyncio.to_thread(_machine, config),
        "releases.json": lambda: asyncio.to_thread(_releases, layout),
        "doctor.json": lambda: _encoded(doctor(config)),
        "services.txt": lambda: _printed("systemctl", "status", "--no-pager", "--lines=0", *UNITS, codes=(0, 3, 4)),
        **{f"journal/{unit}.txt": _journal(unit) for unit in UNITS},
    }
    if config is not None:
        known = config
        sources["configuration.json"] = lambda: asyncio.to_thread(lambda: msgspec.json.encode(known))
        sources["fleet.json"] = lambda: _encoded(fleet(known))
        sources["logs.json"] = lambda: asyncio.to_thread(_logs, Path(known.record.directory or "."))
    cleaner = Cleaner(secrets_of(config, os.environ))
    parts: dict[str, bytes] = {}
    for name, source in sources.items():
        say(name)
        try:
            async with asyncio.timeout(DOCTOR_S):
                parts[name] = cleaner.clean(await source())
        except (SwiftbotError, OSError, TimeoutError) as error:
            missing[name] = cleaner.clean(str(error).encode() or b"no answer in time").decode(errors="replace")
    parts["missing.json"] = msgspec.json.format(msgspec.json.encode(missing))
    await asyncio.to_thread(_write, file, parts)
    return Collected(file=str(file), bytes=await asyncio.to_thread(lambda: file.stat().st_size), parts=tuple(parts),
                     missing=missing)  # fmt: skip


def _write(file: Path, parts: Mapping[str, bytes]) -> None:
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as tar:
        for name, data in parts.items():
            entry = tarfile.TarInfo(f"support/{name}")
            entry.size, entry.mtime, entry.mode = len(data), int(time.time()), 0o600
            tar.addfile(entry, io.BytesIO(data))
    try:
        durable.write(file, out.getvalue(), mode=0o600, replace=False)
    except FileExistsError:
        raise ConfigError(f"{file} exists", remedy="name another file") from None
    except OSError as error:
        raise ConfigError(f"{file} cannot be written: {error.strerror}", remedy="name another file") from error


async def _encoded(answer: Awaitable[object]) -> bytes:
    return msgspec.json.format(msgspec.json.encode(await answer))


async def _printed(*words: str, codes: tuple[int, ...] = (0,)) -> bytes:
    return (await command(*words, codes=codes)).encode()


def _journal(unit: str) -> Callable[[], Awaitable[bytes]]:
    return lambda: _printed("journalctl", "--no-pager", "--output=short-iso", f"--lines={LINES}", f"--unit={unit}")


def _versions() -> bytes:
    found = versions() | {"machine": platform.machine(), "kernel": platform.release()}
    for path in (Path("/etc/os-release"), Path("/etc/debian_version")):
        if path.is_file():
            found[path.name] = path.read_text(errors="replace").strip()
    return msgspec.json.format(msgspec.json.encode(found))


def _machine(config: GatewayConfig | None) -> bytes:
    places = {"/": Path("/"), "/run": Path("/run"), "/var": Path("/var")}
    if config is not None:
        places |= {"data_dir": Path(config.data_dir).expanduser(), "record": Path(config.record.directory or ".")}
    disks = {name: shutil.disk_usage(path)._asdict() for name, path in places.items() if path.is_dir()}
    found = {"processors": os.cpu_count(), "load": os.getloadavg(), "disks": disks, "at": time.time()}
    memory = Path("/proc/meminfo").read_text(errors="replace").splitlines()[:5]
    return msgspec.json.format(msgspec.json.encode(found | {"memory": memory}))


def _releases(layout: Layout) -> bytes:
    last = layout.prefix / LAST
    found = {
        "current": layout.running(),
        "previous": layout.before(),
        "installed": [each.id for each in layout.installed()],
        "last": msgspec.Raw(last.read_bytes()) if last.is_file() else None,
    }
    return msgspec.json.format(msgspec.json.encode(found))


def _logs(folder: Path) -> bytes:
    files = sorted((each for each in folder.glob("*.mcap") if each.is_file()), key=lambda each: each.stat().st_mtime)
    found = [{"name": each.name, "bytes": each.stat().st_size, "at": each.stat().st_mtime} for each in files]
    return msgspec.json.format(msgspec.json.encode(found[-MOST_FILES:]))
