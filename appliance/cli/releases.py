"""Releases of the program on this machine: `swiftbot upgrade`, `rollback`, `release …`."""

import os
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from msgspec import Struct
from rich.table import Table
from rich.text import Text

from appliance import console
from appliance.cli.common import TOOLS, Json, show
from appliance.errors import ConfigError, Exit, RefusedError

if TYPE_CHECKING:
    from appliance.client import FleetClient
    from appliance.deploy.layout import Layout
    from appliance.deploy.upgrade import Ended, Upgrade
    from appliance.model import GatewayStatus

release_app = App(name="release", help="List, check and make releases of the program.", group=TOOLS)

Root = Annotated[Path, Parameter(help="Installation to change, instead of that of this machine.")]
ConfigFile = Annotated[Path, Parameter(help="The gateway's TOML file, for the check.")]
HERE = Path("/")
CONFIG = Path("/etc/swiftbot/gateway.toml")


class ReleaseShown(Struct, frozen=True, kw_only=True):
    """A release that is installed."""

    id: str
    version: str
    made: float
    """Unix seconds."""
    current: bool
    previous: bool


class BundleShown(Struct, frozen=True, kw_only=True):
    """A bundle whose signature and files are good."""

    release: str
    version: str
    architecture: str
    python: str
    made: float
    """Unix seconds."""
    files: int
    bytes: int
    images: tuple[str, ...]
    packages: int = 0
    """Debian packages."""
    models: tuple[str, ...] = ()
    parts: int = 0
    """Signed lists of parts."""


@Parameter(name="*")
@dataclass(frozen=True)
class Whole:
    """A whole fleet that is upgraded from one machine."""

    fleet: Annotated[str, Parameter(help="Upgrade all gateways of this fleet, over ssh, one after the other.")] = ""
    ssh: Annotated[
        tuple[str, ...],
        Parameter(help="GATEWAY=[USER@]HOST: machine of a gateway, for ssh; one for each. As root, or with sudo -n."),
    ] = ()
    connect: Annotated[
        tuple[str, ...],
        Parameter(env_var="SWIFTBOT_CONNECT", help="Endpoint of a gateway; name several, since each is restarted."),
    ] = ()
    keys: Annotated[
        Path | None, Parameter(env_var="SWIFTBOT_KEYS", help="File with your keys, those of an engineer.")
    ] = None

    def targets(self) -> dict[str, str]:
        """The machine of each gateway; ConfigError where one is named twice or not as it should be."""
        found: dict[str, str] = {}
        for each in self.ssh:
            name, _, destination = each.partition("=")
            if not name or not destination or destination.startswith("-") or name in found:
                raise ConfigError(f"--ssh {each[:80]!r}", remedy="--ssh GATEWAY=root@HOST, once for each gateway")
            found[name] = destination
        return found


WHOLE = Whole()


def add_to(app: App) -> None:
    """Add these commands."""
    for command in (upgrade, rollback):
        app.command(command, group=TOOLS)
    app.command(release_app)


async def upgrade(
    file: Path | None = None,
    /,
    *,
    resume: bool = False,
    older: bool = False,
    root: Root = HERE,
    config: ConfigFile = CONFIG,
    whole: Whole = WHOLE,
    as_json: Json = False,
) -> int:
    """Install a signed bundle beside the release that runs, switch to it, and go back if it does not work.

    Services drain, stop, and start with the new release; then they must stay up, and `swiftbot doctor` must find
    nothing that it did not find before. Run as root. With --fleet all gateways of a fleet, over ssh, one after the
    other; the first that fails ends it.

    Args:
        file: Bundle, as `make bundle` writes it.
        resume: Finish an upgrade that was interrupted, as the system does at boot.
        older: Install an older version than the one that runs.
    """
    from appliance.deploy import bundle as bundles
    from appliance.deploy import host
    from appliance.deploy.upgrade import Ended

    if whole.fleet:
        if file is None:
            raise ConfigError("no bundle is named", remedy="swiftbot upgrade FILE --fleet NAME --ssh GATEWAY=HOST")
        return await _roll(file, whole, older=older, as_json=as_json)
    upgrading = _upgrading(root, config)
    layout = _layout(root)
    if resume:
        with upgrading.alone(make=False):
            ended = await upgrading.resume()
            if ended is None:
                ended = Ended(release=layout.running(), before=layout.before())
                show(ended, as_json=as_json, table=Text("no upgrade was interrupted"))
                return Exit.DONE
            return _show_ended(ended, as_json=as_json)
    if file is None:
        raise ConfigError("no bundle is named", remedy="swiftbot upgrade FILE; --resume finishes an interrupted one")
    # The signature comes before the lock, whose folder is made: below a mistyped --root no key is trusted.
    with bundles.opened(file, bundles.load_trusted(root / bundles.TRUSTED)) as bundle, upgrading.alone():
        upgrading.check_none()
        running = next((each.version for each in layout.installed() if each.id == layout.running()), "")
        bundle.check_for(architecture=host.architecture(), python=host.python(), running=running, older=older)
        _say(f"{file}: {bundle.manifest.release}, signature good; {running or 'nothing'} runs")
        try:
            release = await host.lay_out(bundle, layout, config=config, say=_say)
        except (OSError, subprocess.CalledProcessError) as error:
            raise RefusedError(
                f"{file} cannot be laid out: {getattr(error, 'strerror', None) or error}; what runs was not changed",
                remedy="make room on the disk, or take another copy of the bundle, and try again",
            ) from error
        return _show_ended(await upgrading.to(release), as_json=as_json)


class _Fleet:
    """A fleet's gateways, by a client."""

    def __init__(self, client: "FleetClient") -> None:
        self._client = client

    def gateways(self) -> dict[str, "GatewayStatus"]:
        members = self._client.plane.members()
        return {name: each for name, each in self._client.plane.registry.gateways.items() if name in members}

    async def drain(self, gateway: str) -> bool:
        state = await self._client.drain_state(gateway)
        if not state.draining:
            state = await self._client.drain(gateway, 0.0, why="upgrade of the fleet")
        return state.done

    async def undrain(self, gateway: str) -> None:
        await self._client.undrain(gateway, why="upgrade of the fleet")


async def _roll(file: Path, whole: Whole, *, older: bool, as_json: bool) -> int:
    from appliance.client import Endpoint, FleetClient
    from appliance.deploy.bundle import release_in
    from appliance.deploy.rolling import Ssh, roll

    targets, release = whole.targets(), release_in(file)
    if not whole.connect:
        raise ConfigError("no gateway is named", remedy="--connect tls/ADDRESS:7447, several")
    endpoint = Endpoint(fleet=whole.fleet, connect=whole.connect, keys=str(whole.keys or ""))
    async with FleetClient(endpoint) as client:
        await client.gateway()
        rolled = await roll(_Fleet(client), Ssh(), targets, file, release=release, older=older, say=_say)
    table = Table()
    for column in ("gateway", "state", "release", "problem"):
        table.add_column(column, overflow="fold")
    for each in rolled:
        table.add_row(each.gateway, each.state, each.release, each.problem)
    show(rolled, as_json=as_json, table=table)
    return Exit.FAILED if any(each.state != "upgraded" for each in rolled) else Exit.DONE


async def rollback(*, root: Root = HERE, config: ConfigFile = CONFIG, as_json: Json = False) -> int:
    """Go back to the release before. Run as root."""
    upgrading = _upgrading(root, config)
    with upgrading.alone(make=False):
        return _show_ended(await upgrading.rollback(), as_json=as_json)


@release_app.command(name="list")
async def list_(*, root: Root = HERE, as_json: Json = False) -> int:
    """List the releases that are installed, the newest first."""
    layout = _layout(root)
    try:
        rows = [
            ReleaseShown(
                id=each.id,
                version=each.version,
                made=each.made,
                current=each.id == layout.running(),
                previous=each.id == layout.before(),
            )
            for each in reversed(layout.installed())
        ]
    except OSError as error:
        raise ConfigError(
            f"{layout.prefix} cannot be read: {error.strerror}", remedy="check --root and its owner (ls -ld)"
        ) from error
    table = Table()
    for column in ("release", "installed", ""):
        table.add_column(column)
    for row in rows:
        mark = "current" if row.current else "previous" if row.previous else ""
        table.add_row(row.id, time.strftime("%Y-%m-%d %H:%M", time.localtime(row.made)), mark)
    show(rows, as_json=as_json, table=table)
    return Exit.DONE


@release_app.command(name="show")
async def show_(
    file: Path,
    /,
    *,
    trusted: Annotated[
        Path | None, Parameter(help="File of public keys, instead of /etc/swiftbot/release.pub.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Check signature and files of a bundle, and show what is in it.

    Args:
        file: Bundle, as `make bundle` writes it.
    """
    from appliance.deploy import bundle as bundles

    with bundles.opened(file, bundles.load_trusted(trusted or HERE / bundles.TRUSTED)) as bundle:
        bundle.check()
    manifest = bundle.manifest
    shown = BundleShown(
        release=manifest.release,
        version=manifest.version,
        architecture=manifest.architecture,
        python=manifest.python,
        made=manifest.made,
        files=len(manifest.members),
        bytes=manifest.size,
        images=tuple(Path(each.name).stem for each in manifest.members if each.name.startswith("images/")),
        packages=sum(each.name.endswith(".deb") for each in manifest.members),
        models=tuple(
            sorted({Path(each.name).parts[1] for each in manifest.members if each.name.startswith("models/")})
        ),
        parts=sum(each.name.startswith("parts/") for each in manifest.members),
    )
    text = Text(
        f"{manifest.release} for {manifest.architecture}, Python {manifest.python}\n"
        f"  made     {time.strftime('%Y-%m-%d %H:%M', time.localtime(manifest.made))}\n"
        f"  files    {shown.files}, {shown.bytes / 2**20:.0f} MiB, all as the manifest says\n"
        f"  images   {', '.join(shown.images) or 'none: built on the gateway'}\n"
        f"  Debian   {f'{shown.packages} packages' if shown.packages else 'no packages'}\n"
        f"  models   {', '.join(shown.models) or 'none but what comes with the program'}\n"
        f"  parts    {f'{shown.parts} signed lists' if shown.parts else 'no signed list'}\n"
        "  signed by a key that is trusted"
    )
    show(shown, as_json=as_json, table=text)
    return Exit.DONE


@release_app.command(name="key")
async def key_(file: Path, /, *, as_json: Json = False) -> int:
    """Make the key that signs bundles, and its public half, FILE.pub, which every gateway needs.

    Args:
        file: File to write.
    """
    from appliance.deploy import bundle as bundles

    public = bundles.make_key(file)
    text = Text(
        f"made {file} (keep it off the gateways) and {public}\n"
        f"next: copy {public} to /{bundles.TRUSTED} on every gateway"
    )
    show({"private": str(file), "public": str(public)}, as_json=as_json, table=text)
    return Exit.DONE


@release_app.command(name="pack")
async def pack_(
    folder: Path,
    /,
    *,
    key: Annotated[Path, Parameter(help="Key that signs it, made by `swiftbot release key`.")],
    out: Annotated[Path, Parameter(help="File to write.")],
    tree: Annotated[Path, Parameter(help="Source tree that it was made of.")],
    as_json: Json = False,
) -> int:
    """Pack and sign what `make bundle` has gathered in a folder.

    Args:
        folder: With wheels, tools, units, pages and images.
    """
    from appliance.deploy import bundle as bundles
    from appliance.deploy import host
    from appliance.deploy.layout import id_of, version_of

    manifest = bundles.pack(
        folder,
        out,
        bundles.load_key(key),
        release=id_of(tree),
        version=version_of(tree),
        architecture=host.architecture(),
        made=float(os.environ.get("SOURCE_DATE_EPOCH") or int(time.time())),
    )
    size = out.stat().st_size
    text = Text(f"{out}: {manifest.release}, {len(manifest.members)} files, {size / 2**20:.0f} MiB")
    show({"file": str(out), "release": manifest.release, "bytes": size}, as_json=as_json, table=text)
    return Exit.DONE


def _layout(root: Path) -> "Layout":
    from appliance.deploy.layout import Layout

    return Layout(root)


def _upgrading(root: Path, config: Path) -> "Upgrade":
    from appliance.deploy.host import Machine
    from appliance.deploy.upgrade import Upgrade

    here = root.resolve() == HERE
    if here and os.getuid() != 0:
        raise ConfigError("this needs root: it changes /opt/swiftbot and restarts services", remedy="sudo swiftbot …")
    machine = Machine(config=config, services=here)
    if not here:
        _say(f"the services of this machine do not run from {root}: they stay as they are")
    elif not machine.systemd:
        _say("systemd does not run here: start the daemons again yourself after the switch")
    return Upgrade(_layout(root), machine, say=_say)


def _say(text: str) -> None:
    console.err.print(f"[{time.strftime('%H:%M:%S')}] {text}", markup=False, highlight=False)


def _show_ended(ended: "Ended", *, as_json: bool) -> int:
    if ended.problem:
        now = f"{ended.release} runs again" if ended.rolled_back else f"{ended.release} is current"
        text = Text(f"not upgraded: {ended.problem}\n{now}")
        if ended.problem_back:
            text.append(
                f"\nbut it does not work either: {ended.problem_back}\n  hint: journalctl -u swiftbot-gateway -n 50"
            )
    else:
        text = Text(f"{ended.release} runs; `swiftbot rollback` goes back to {ended.before or 'nothing'}")
        if ended.removed:
            text.append(f"\nremoved: {', '.join(ended.removed)}")
    show(ended, as_json=as_json, table=text)
    return Exit.FAILED if ended.problem else Exit.DONE
