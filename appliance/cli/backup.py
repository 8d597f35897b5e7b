"""A gateway in one file: `swiftbot backup`, `restore`; for support: `swiftbot support`."""

import getpass
import os
import stat
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from rich.text import Text

from appliance import console
from appliance.cli.common import TOOLS, Json, show
from appliance.errors import ConfigError, Exit

if TYPE_CHECKING:
    from appliance.config import GatewayConfig
    from appliance.deploy.backup import Contents

VARIABLE = "SWIFTBOT_PASSPHRASE"
CONFIG = Path("/etc/swiftbot/gateway.toml")

PassphraseFile = Annotated[
    Path | None,
    Parameter(help=f"File with the passphrase, mode 0600; by default ${VARIABLE}, or it is asked for."),
]
WithoutVolumes = Annotated[bool, Parameter(help="Leave out the state volumes of skills.")]


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (backup, restore, support):
        app.command(command, group=TOOLS)


async def backup(
    file: Path,
    /,
    *,
    config: Path = CONFIG,
    passphrase_file: PassphraseFile = None,
    without_volumes: WithoutVolumes = False,
    as_json: Json = False,
) -> int:
    """Write configuration, keys, records, state volumes and models of a gateway to one encrypted file. Run as root.

    The gateway may run. MCAP logs, images and what comes from other gateways are not in it.

    Args:
        file: File to write.
        config: The gateway's TOML file.
    """
    from appliance.deploy.backup import back_up, check_passphrase
    from appliance.record.segments import VERSION

    passphrase = _passphrase(passphrase_file, twice=True)
    check_passphrase(passphrase)
    found = await back_up(file, config, passphrase, version=VERSION, volumes=not without_volumes, say=_say)
    show(found, as_json=as_json, table=_text("wrote", found))
    return Exit.DONE


async def restore(
    file: Path,
    /,
    *,
    passphrase_file: PassphraseFile = None,
    replace: Annotated[bool, Parameter(help="Move aside the gateway that is here already.")] = False,
    without_volumes: WithoutVolumes = False,
    root: Annotated[Path, Parameter(help="Folder to restore into, instead of this machine's own places.")] = Path("/"),
    as_json: Json = False,
) -> int:
    """Make this machine the gateway of a backup, under its id. Run as root, with the services stopped.

    The whole file is checked before anything is written.

    Args:
        file: File that `swiftbot backup` wrote.
    """
    from appliance.deploy import backup as backups

    passphrase = _passphrase(passphrase_file, twice=False)
    found = await backups.restore(file, passphrase, root=root, replace=replace, volumes=not without_volumes, say=_say)
    text = _text("restored", found)
    for each in found.aside:
        text.append(f"\nmoved aside: {each}")
    text.append("\nnext: systemctl start swiftbot-gateway swiftbot-recorder; the box it was made on must stay off")
    show(found, as_json=as_json, table=text)
    return Exit.DONE


async def support(file: Path, /, *, config: Path = CONFIG, as_json: Json = False) -> int:
    """Write what support needs to one file, without secrets: checks, versions, configuration, figures, last log lines.

    What cannot be had is named in it. Run as root, or as the service user.

    Args:
        file: File to write, such as support.tar.gz.
        config: The gateway's TOML file.
    """
    from appliance.client import Endpoint, FleetClient
    from appliance.deploy.layout import Layout
    from appliance.deploy.support import collect
    from appliance.doctor import run_checks

    async def fleet(config: "GatewayConfig") -> object:
        endpoint = Endpoint(fleet=config.fleet, connect=config.dialling().connect, keys=config.plane.keys)
        async with FleetClient(endpoint) as client:
            await client.gateway()
            return sorted(client.plane.registry.gateways.values(), key=lambda gateway: gateway.id)

    found = await collect(file, config, doctor=run_checks, fleet=fleet, layout=Layout(), say=_say)
    text = Text(f"wrote {found.file}: {len(found.parts)} parts, {found.bytes / 2**10:.0f} KiB")
    for name, why in found.missing.items():
        text.append(f"\nnot in it: {name}: {why[:200]}")
    show(found, as_json=as_json, table=text)
    return Exit.DONE


def _text(done: str, found: "Contents") -> Text:
    volumes = f", {len(found.volumes)} state volume{'s' if len(found.volumes) > 1 else ''}" if found.volumes else ""
    size = f"{found.files} files, {found.bytes / 2**20:.1f} MiB{volumes}"
    return Text(f"{done} gateway {found.gateway} of fleet {found.fleet}: {size}")


def _passphrase(file: Path | None, *, twice: bool) -> str:
    """Return the passphrase: of a file, of the environment, or as it is typed."""
    if file is not None:
        try:
            if stat.S_IMODE(file.stat().st_mode) & 0o077:
                raise ConfigError(f"{file} may be read by others", remedy=f"chmod 600 {file}")
            return file.read_text(encoding="utf-8").rstrip("\n")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{file} cannot be read: {error}", remedy="name a file with the passphrase") from error
    if given := os.environ.get(VARIABLE, ""):
        return given
    if not sys.stdin.isatty():
        raise ConfigError("no passphrase is given", remedy=f"--passphrase-file FILE, or {VARIABLE} in the environment")
    typed = getpass.getpass("Passphrase: ")
    if twice and getpass.getpass("Once more: ") != typed:
        raise ConfigError("the two passphrases differ", remedy="type the same twice")
    return typed


def _say(text: str) -> None:
    console.err.print(text, markup=False, highlight=False)
