"""The machine under an upgrade: systemd, the service user, and how a bundle becomes a release."""

import asyncio
import platform
import shutil
import sys
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from appliance import durable
from appliance.config import load
from appliance.deploy import debian
from appliance.deploy.bundle import Bundle
from appliance.deploy.command import command
from appliance.deploy.layout import Layout
from appliance.errors import RefusedError, SwiftbotError

CONFIG = Path("/etc/swiftbot/gateway.toml")
UNITS = (
    "swiftbot-gateway.service",
    "swiftbot-recorder.service",
    "swiftbot-router.service",
    "swiftbot-foxglove.service",
)
SETTLE_S = 15.0
"""A service that cannot work ends within that, and is started again 2 s later."""
STOP_S = 120.0
START_S = 240.0
DOCTOR_S = 120.0
LOAD_S = 900.0
BUILD_S = 1800.0
ROOM = {"wheels": 4.5, "packages": 5.0, "images": 2.5}
"""Room that members of a bundle take, in their sizes: themselves and what is in them. Wheels, with compiled
modules, 4.1 measured; Debian packages are unpacked, images are loaded into Podman."""
MEMBERS = ".bundle"
"""Folder of a release that is being laid out, for the members of its bundle."""


class Found(Struct, frozen=True):
    """A check of `swiftbot doctor --json`; other fields are ignored."""

    name: str
    ok: bool
    detail: str = ""
    required: bool = True


class Machine:
    """This machine: `Host` of an upgrade.

    Without systemd, as in a container, no service is stopped or started: releases are switched and checked, and the
    operator starts the daemons again.

    Args:
        config: the gateway's, for `swiftbot doctor`.
        settle_s: how long services have to stay up.
        services: whether the installation is that of this machine's services; those of another stay as they are.
    """

    def __init__(self, *, config: Path = CONFIG, settle_s: float = SETTLE_S, services: bool = True) -> None:
        self._config = config
        self._settle_s = settle_s
        self.systemd = services and Path("/run/systemd/system").is_dir()

    async def running(self) -> tuple[str, ...]:
        """Return the units of this product that run."""
        if not self.systemd:
            return ()
        # One that is about to be started again counts: the next release may be its remedy.
        return tuple(await self._shown(UNITS, ("active", "reloading", "activating")))

    async def processes(self, services: Sequence[str]) -> Mapping[str, int]:
        """Return the main process of each unit that runs."""
        return await self._shown(services) if services else {}

    async def _shown(self, services: Sequence[str], states: Sequence[str] = ("active", "reloading")) -> dict[str, int]:
        text = await command("systemctl", "show", "--property=Id,ActiveState,MainPID", *services)
        found: dict[str, int] = {}
        for block in text.split("\n\n"):
            said = {name: value for name, _, value in (line.partition("=") for line in block.splitlines())}
            if said.get("ActiveState") in states and said.get("MainPID", "0").isdigit():
                found[said.get("Id", "")] = int(said["MainPID"])
        return found

    async def stop(self, services: Sequence[str]) -> None:
        """Stop units; the gateway drains first, as at every SIGTERM."""
        if services:
            await command("systemctl", "stop", *services, timeout_s=STOP_S)

    async def start(self, services: Sequence[str]) -> None:
        """Start units, and return once they say that they are ready."""
        if services:
            await command("systemctl", "start", *services, timeout_s=START_S)

    async def reload(self) -> None:
        """Let systemd read the current release's units, users and folders."""
        if self.systemd:
            await command("systemd-sysusers", "swiftbot.conf")
            await command("systemd-tmpfiles", "--create", "swiftbot.conf")
            await command("systemctl", "daemon-reload")

    async def settle(self) -> None:
        """Wait as long as a service that cannot work takes to end."""
        if self.systemd:
            await asyncio.sleep(self._settle_s)

    async def wrong(self, program: Path) -> Mapping[str, str]:
        """Return what a release's `swiftbot doctor` finds wrong; all of it where it does not run at all."""
        words = [str(program), "doctor", "--json"]
        if self._config.exists():
            words += ["--config", str(self._config)]
        try:
            text = await command(*words, as_user=True, timeout_s=DOCTOR_S, codes=(0, 5))
            checks = msgspec.json.decode(text, type=list[Found])
        except (SwiftbotError, msgspec.MsgspecError) as error:
            return {"swiftbot doctor": str(error)}
        return {check.name: check.detail for check in checks if check.required and not check.ok}


def architecture() -> str:
    """Return this machine's, as `uname -m` says it."""
    return platform.machine()


def python() -> str:
    """Return the version of Python that environments are made with, such as 3.11."""
    return f"{sys.version_info.major}.{sys.version_info.minor}"


async def lay_out(bundle: Bundle, layout: Layout, *, config: Path, say: Callable[[str], None]) -> str:
    """Make a release of a bundle, beside those that are there; returns its id. No service is touched.

    Debian packages that this machine lacks are installed. A signed list of parts for the gateway's fleet counts from
    then on: it has to name those of the release that runs too.

    Args:
        bundle: what it is made of.
        layout: of the machine's releases.
        config: the gateway's.
        say: hears of each step.

    Raises:
        RefusedError: the disk has no room, the Debian packages cannot be installed, or the environment not be made.
        PayloadError: the bundle is cut off or damaged.
    """
    manifest = bundle.manifest
    durable.make_folder(layout.prefix, mode=0o755)
    free, need = shutil.disk_usage(layout.prefix).free, int(room(bundle))
    if free < need:
        raise RefusedError(
            f"{layout.prefix} has {free >> 20:,} MiB free, and the release needs {need >> 20:,} MiB",
            remedy="free some space (df -h); `swiftbot release list` shows old releases",
        )
    staged = layout.stage(manifest.release)
    try:
        members = staged / MEMBERS
        members.mkdir()
        say(f"take out {len(manifest.members)} files, {manifest.size / 2**20:.0f} MiB")
        await asyncio.to_thread(bundle.take_out, members)
        if (members / "packages").exists():
            await _packages(members / "packages", layout, say=say)
        say("make its environment")
        await _environment_of(members, staged / "venv")
        for part in ("systemd", "docs", "models", "LICENSE"):
            if (members / part).exists():
                (members / part).rename(staged / part)
        images = sorted(members.glob("images/*.tar"))
        for image in images:
            say(f"load image {image.stem}")
            # Through its standard input: Podman's user cannot read this folder.
            await command("podman", "load", as_user=True, timeout_s=LOAD_S, data=image)
        _take_parts(members / "parts", config, say=say)
        shutil.rmtree(members)
        try:
            await command(str(staged / "venv/bin/swiftbot"), "manual", str(staged / "man"))
        except SwiftbotError as error:
            say(f"without manual pages: {error.message}")  # an older release cannot write them
        release = await asyncio.to_thread(layout.finish, staged, manifest.release, manifest.version)
    finally:
        if staged.exists():
            shutil.rmtree(staged)
    if not images:
        say("build its images, those that are missing")
        try:
            program = layout.folder(release) / "venv/bin/swiftbot"
            await command(str(program), "images", "build", as_user=True, timeout_s=BUILD_S)
        except SwiftbotError as error:
            say(f"images: {error.message}")  # whether the gateway works without is for the check to say
    return release


def room(bundle: Bundle) -> float:
    """Bytes that laying a bundle out takes at most."""
    return sum(each.size * ROOM.get(each.name.partition("/")[0], 1.1) for each in bundle.manifest.members)


async def _packages(folder: Path, layout: Layout, *, say: Callable[[str], None]) -> None:
    """Install what this machine lacks of the Debian packages that the program needs."""
    if layout.root.absolute() != Path("/"):
        say(f"without Debian packages: {layout.root} is not this machine's root")
    elif names := await debian.missing(folder):
        await debian.install(folder, names, say=say)


def _take_parts(folder: Path, config: Path, *, say: Callable[[str], None]) -> None:
    """Put the newest list of parts that is for this gateway's fleet in place; those of other fleets are none of it."""
    from appliance.deploy import parts  # noqa: PLC0415 - with the pool, which few bundles need

    for file in sorted(folder.glob("*.json")):
        try:
            say(f"the list of parts is number {parts.install(load(config), file).number}")
        except SwiftbotError as error:
            say(f"without the list of parts {file.name}: {error.message}")  # what is not signed the check tells


async def _environment_of(members: Path, venv: Path) -> None:
    """Make the virtual environment from a bundle's wheels alone; it may be moved to where its release gets its name."""
    wheels = [str(each) for each in sorted((members / "wheels").glob("*.whl"))]
    tools = sorted((members / "tools").glob("uv-*.whl"))
    if not wheels or not tools:
        raise RefusedError("the bundle lacks wheels, or uv among its tools", remedy="make it again: make bundle")
    uv = members / "uv"
    with zipfile.ZipFile(tools[-1]) as wheel:
        name = next((each for each in wheel.namelist() if each.endswith(".data/scripts/uv")), "")
        if not name:
            raise RefusedError(f"{tools[-1].name} has no uv in it", remedy="make the bundle again: make bundle")
        uv.write_bytes(wheel.read(name))
    uv.chmod(0o755)
    cache = ["--offline", "--no-cache"]
    await command(str(uv), "venv", *cache, "--relocatable", "--python", "/usr/bin/python3", str(venv), folder=members)
    await command(
        str(uv), "pip", "install", *cache, "--no-index", "--no-deps", "--compile-bytecode",
        "--python", str(venv / "bin/python"), *wheels, timeout_s=900.0, folder=members,
    )  # fmt: skip
