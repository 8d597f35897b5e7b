"""The signed list of parts: `swiftbot parts …`. They are files; no gateway is asked."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from rich.table import Table
from rich.text import Text

from appliance import console
from appliance.cli.common import TOOLS, Json, complete, show
from appliance.cli.keys import KEPT, REACH, Kept, Reach
from appliance.errors import ConfigError, ConflictError, Exit, IdentityError

if TYPE_CHECKING:
    from appliance.config import GatewayConfig
    from appliance.identity.parts import Parts

parts_app = App(
    name="parts", help="List and sign the images, skills and models that gateways may fetch, load and run.", group=TOOLS
)

ConfigFile = Annotated[Path | None, Parameter(name="--config", help="The gateway's TOML file; else the defaults.")]


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(parts_app)


def _config(file: Path | None) -> "GatewayConfig":
    from appliance import config

    return config.load(file) if file is not None else config.GatewayConfig(id="here")


@parts_app.command(name="list")
async def list_(
    *,
    config: ConfigFile = None,
    without_images: Annotated[
        bool, Parameter(help="Leave out the images that are built here; needs no Podman.")
    ] = False,
    out: Annotated[Path | None, Parameter(help="File to write the list to, for `swiftbot parts sign`.")] = None,
    as_json: Json = False,
) -> int:
    """List the parts that this machine has, with their digests: what a gateway of this configuration would load."""
    import msgspec

    from appliance.deploy.parts import collect
    from appliance.identity import files

    found = await collect(_config(config), with_images=not without_images)
    if out is not None:
        files.write(out, msgspec.json.format(msgspec.json.encode(found)), mode=files.PUBLIC)
        console.err.print(f"wrote {out}; next, at the authority: swiftbot parts sign {out}", markup=False)
    show(found, as_json=as_json, table=_table(found))
    return Exit.DONE


@parts_app.command
async def sign(
    lists: tuple[Path, ...],
    /,
    *,
    out: Annotated[Path | None, Parameter(help="File to write as well as the authority's parts.json.")] = None,
    as_json: Json = False,
    kept: Kept = KEPT,
) -> int:
    """Sign the lists of one or more machines as the fleet's next list of parts, in place of the one before.

    Args:
        lists: Files that `swiftbot parts list --out` has written.
    """
    from appliance.deploy.parts import sign as sign_parts
    from appliance.identity.parts import FILE

    if not lists:
        raise ConfigError("no list is named", remedy="swiftbot parts list --out FILE makes one on a gateway")
    authority = kept.load()
    signed = sign_parts(authority, [_unsigned(file) for file in lists], out)
    text = Text(
        f"signed {_counts(signed)} as number {signed.number} of fleet {signed.fleet}\n"
        "next: swiftbot parts publish --connect ENDPOINT; without a link, copy "
        f"{out or authority.folder / FILE} to a gateway, and there: swiftbot parts install FILE"
    )
    show(signed, as_json=as_json, table=text)
    return Exit.DONE


def _unsigned(file: Path) -> "Parts":
    """Read a list that a machine has made."""
    import msgspec

    from appliance.identity import files
    from appliance.identity.parts import MOST_BYTES, Parts

    remedy = "swiftbot parts list --out FILE makes one on a gateway"
    try:
        found = msgspec.json.decode(
            files.read(file, private=False, absent=remedy, most=MOST_BYTES), type=Parts, strict=True
        )
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{file} is no list of parts: {error}", remedy=remedy) from None
    if not (found.image or found.skill or found.model):
        raise ConfigError(f"{file} names no part", remedy=remedy)
    return found


@parts_app.command
async def publish(*, as_json: Json = False, kept: Kept = KEPT, reach: Reach = REACH) -> int:
    """Give a running fleet the authority's signed list: every gateway has it within seconds, and checks it itself."""
    from appliance.identity import certificates, parts

    authority = kept.load()
    sealed = parts.read(authority.folder / parts.FILE)
    number = parts.unseal(sealed, certificates.ed25519_of(authority.certificate), authority.fleet).number
    async with reach.client(authority.fleet) as client:
        told = await client.hand_parts(number, sealed)
    if told.number > number:
        raise ConflictError(
            f"the fleet has list {told.number}, and this authority is at {number}",
            remedy="this folder is an old copy: use the newest one",
        )
    show({"parts": told.number}, as_json=as_json, table=Text(f"the fleet has list of parts {told.number}"))
    return Exit.DONE


@parts_app.command(name="show")
async def show_(
    file: Path | None = None,
    /,
    *,
    keys: Annotated[
        Path | None,
        Parameter(env_var="SWIFTBOT_KEYS", help="File of keys, for the authority's certificate; else its folder."),
    ] = None,
    as_json: Json = False,
    kept: Kept = KEPT,
) -> int:
    """Show what a signed list names: exit code 9 if it is damaged, of another fleet or of another authority.

    Args:
        file: A list that `swiftbot parts sign` has written; by default the authority's.
    """
    from appliance.identity import certificates, parts
    from appliance.identity.bundle import Bundle

    if keys is not None:
        bundle = Bundle.load(keys)
        certificate, fleet = bundle.authority, bundle.identity.fleet
    else:
        authority = kept.load()
        certificate, fleet = authority.certificate, authority.fleet
    path = file or kept.folder() / parts.FILE
    found = parts.unseal(parts.read(path), certificates.ed25519_of(certificate), fleet)
    day = time.strftime("%Y-%m-%d %H:%M", time.gmtime(found.signed))
    console.err.print(f"number {found.number} of fleet {found.fleet}, signed {day} UTC: {_counts(found)}", markup=False)
    show(found, as_json=as_json, table=_table(found))
    return Exit.DONE


@parts_app.command
async def check(
    *,
    config: ConfigFile = None,
    without_images: Annotated[
        bool, Parameter(help="Leave out the images that are built here; needs no Podman.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Compare what is on this gateway with its signed list of parts: exit code 9 if anything is not named there."""
    from appliance.deploy.parts import collect, in_force
    from appliance.identity.parts import unnamed

    read = _config(config)
    counts = in_force(read)
    listed = counts.parts
    if counts.checked and not listed.number:
        raise IdentityError(counts.problem, remedy="docs/security.md, Signed parts")
    found = await collect(read, with_images=not without_images)
    missing = unnamed(found, counts)
    rows = [{"kind": str(kind), "name": name, "digest": digest} for kind, name, digest in missing]
    facts = {"checked": counts.checked, "number": listed.number, "unsigned": rows, "problem": counts.problem}
    lines = [f"{kind} {name} is not signed ({digest[:12]})" for kind, name, digest in missing]
    lines.append(counts.text if not counts.checked or missing else f"{counts.text} names all: {_counts(found)}")
    show(complete(facts), as_json=as_json, table=Text("\n".join(lines)))
    return Exit.DENIED if missing else Exit.DONE


@parts_app.command
async def install(
    file: Path,
    /,
    *,
    config: Annotated[Path, Parameter(name="--config", help="The gateway's TOML file.")] = Path(
        "/etc/swiftbot/gateway.toml"
    ),
    as_json: Json = False,
) -> int:
    """Put a signed list in place on this gateway, checked; others get it from it. Skills go by it after a restart.

    Args:
        file: The list, as `swiftbot parts sign` has written it.
    """
    from appliance.deploy.parts import install as install_parts

    read = _config(config)
    found = install_parts(read, file)
    text = Text(
        f"{read.plane.parts_file} is number {found.number}: {_counts(found)}\n"
        "next: restart the gateway if skills changed"
    )
    show(found, as_json=as_json, table=text)
    return Exit.DONE


def _counts(found: "Parts") -> str:
    counts = (("image", len(found.image)), ("skill folder", len(found.skill)), ("model", len(found.model)))
    return ", ".join(f"{count} {name}{'' if count == 1 else 's'}" for name, count in counts)


def _table(found: "Parts") -> Table:
    from appliance.identity.parts import Kind

    table = Table()
    for column in ("kind", "name", "digest"):
        table.add_column(column)
    for kind in Kind:
        for name, digests in sorted(found.of(kind).items()):
            table.add_row(kind, name, ", ".join(each[:12] for each in digests))
    return table
