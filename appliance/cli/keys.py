"""Keys and certificates of the fleet's members: `swiftbot keys …`. They are files; no gateway is asked."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter
from cyclopts.validators import Number
from rich.table import Table
from rich.text import Text

from appliance import console
from appliance.cli.common import TOOLS, Json, complete, show
from appliance.errors import ConfigError, ConflictError, Exit, IdentityError, SwiftbotError
from appliance.model.roles import Role

if TYPE_CHECKING:
    from appliance.client import FleetClient
    from appliance.identity.authority import Authority
    from appliance.identity.bundle import Bundle
    from appliance.identity.member import Identity

keys_app = App(name="keys", help="Issue, renew and revoke certificates of gateways, robots and people.", group=TOOLS)

Member = Annotated[Role, Parameter(help="What it is.")]
Name = Annotated[str, Parameter(help="Its name, unique within its role.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Wanted:
    """How a certificate is made."""

    host: Annotated[
        tuple[str, ...], Parameter(help="Host name or address under which a gateway is dialled; repeatable.")
    ] = ()
    days: Annotated[
        int,
        Parameter(
            help="Days until it expires; by default 365 for machines, 90 for people.",
            validator=Number(gte=0, lte=3650),
        ),
    ] = 0
    out: Annotated[
        Path | None, Parameter(help="File to write; by default ROLE-NAME.pem in the authority's folder.")
    ] = None


WANTED = Wanted()


@Parameter(name="*")
@dataclass(frozen=True)
class Kept:
    """Where an authority is kept."""

    fleet: Annotated[str, Parameter(env_var="SWIFTBOT_FLEET", help="Name of the fleet.")] = "local"
    authority: Annotated[
        Path | None,
        Parameter(env_var="SWIFTBOT_AUTHORITY", help="Folder of the authority; by default below ~/.config/swiftbot."),
    ] = None

    def folder(self) -> Path:
        """The folder of the authority."""
        from appliance.identity.authority import default_folder

        return self.authority or default_folder(self.fleet)

    def load(self) -> "Authority":
        """The authority."""
        from appliance.identity.authority import Authority

        return Authority.load(self.folder())


KEPT = Kept()


@Parameter(name="*")
@dataclass(frozen=True)
class Reach:
    """A running fleet that is to hear of what changes."""

    connect: Annotated[
        tuple[str, ...],
        Parameter(env_var="SWIFTBOT_CONNECT", help="Endpoint of a gateway that gets it, such as tls/10.0.0.1:7447."),
    ] = ()
    keys: Annotated[
        Path | None,
        Parameter(env_var="SWIFTBOT_KEYS", help="File with your own keys, those of an operator or engineer."),
    ] = None

    def client(self, fleet: str) -> "FleetClient":
        """A client of the fleet, which is connected by `async with`."""
        from appliance.client import Endpoint, FleetClient

        if not self.connect:
            raise ConfigError("no gateway is named", remedy="--connect tls/ADDRESS:7447")
        return FleetClient(Endpoint(fleet=fleet, connect=self.connect, keys=str(self.keys or "")))


REACH = Reach()


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(keys_app)


@keys_app.command
async def init(*, as_json: Json = False, kept: Kept = KEPT) -> int:
    """Make the fleet's authority: the key that signs all certificates, and an empty roster."""
    from appliance.identity.authority import Authority

    made = Authority.create(kept.folder(), kept.fleet, datetime.now(UTC))
    facts = {"fleet": made.fleet, "authority": str(made.folder), "roster": str(made.roster_file)}
    text = Text(
        f"made the authority of fleet {made.fleet} in {made.folder}\n"
        "Keep that folder off the gateways, and a copy of it: who has it can issue any certificate, and a lost one "
        "means that all have to be issued again.\n"
        "next: swiftbot keys issue gateway NAME --host ADDRESS"
    )
    show(facts, as_json=as_json, table=text)
    return Exit.DONE


@keys_app.command
async def issue(
    role: Member,
    name: Name,
    /,
    *,
    wanted: Wanted = WANTED,
    as_json: Json = False,
    kept: Kept = KEPT,
) -> int:
    """Issue a private key and certificate, as one file to be copied to the member's machine."""
    authority = kept.load()
    out = _file(authority, role, name, wanted.out)
    bundle = authority.issue(role, name, out=out, hosts=wanted.host, days=wanted.days)
    _show_issued(bundle, as_json=as_json)
    return Exit.DONE


@keys_app.command
async def renew(
    role: Member,
    name: Name,
    /,
    *,
    wanted: Wanted = WANTED,
    as_json: Json = False,
    kept: Kept = KEPT,
) -> int:
    """Issue a member's next private key and certificate; the one before stays good until it expires."""
    authority = kept.load()
    out = _file(authority, role, name, wanted.out)
    bundle = authority.renew(role, name, out=out, hosts=wanted.host, days=wanted.days)
    _show_issued(bundle, as_json=as_json)
    return Exit.DONE


@keys_app.command
async def revoke(
    role: Member,
    name: Name,
    /,
    *,
    why: Annotated[str, Parameter(help="Reason, kept in the roster.")] = "",
    as_json: Json = False,
    kept: Kept = KEPT,
    reach: Reach = REACH,
) -> int:
    """Revoke all certificates of a member; gateways refuse it once they have the new roster.

    With --connect it takes effect in the fleet: a robot is stopped first, then its certificates are revoked and every
    gateway has the roster within seconds. They are revoked also where the fleet does not answer: exit code 1.
    """
    from appliance.client import Stopped

    authority = kept.load()
    if not authority.roster.valid(role, name, time.time()):
        authority.revoke(role, name, why=why)  # says what is wrong
    problems: list[str] = []
    stopped: Stopped | None = None
    if role is Role.ROBOT and reach.connect:
        try:
            async with reach.client(authority.fleet) as client:
                stopped = await Stopped.carry_out(client, (name,), why=why or "its certificate is revoked")
            if not stopped.confirmed:
                problems.append(f"{name} did not confirm that it holds: use its switch if it moves")
        except SwiftbotError as error:
            problems.append(f"{name} was not told to hold: {error}; use its switch if it moves")
    gone = authority.revoke(role, name, why=why)
    number: int | None = None
    if reach.connect:
        try:
            number = await _hand_out(authority, reach)
        except SwiftbotError as error:
            problems.append(f"the fleet does not have the roster: {error}")
    many = "certificate" if len(gone) == 1 else "certificates"
    lines = [f"revoked {len(gone)} {many} of {role} {name}", *problems]
    if stopped is not None and stopped.confirmed:
        lines.append(f"{name} holds; `swiftbot resume {name}` lifts the stop")
    if number is None:
        lines.append(f"next: swiftbot keys publish --connect ENDPOINT, or copy {authority.roster_file} to a gateway")
    else:
        lines.append(f"the fleet has roster {number}")
    facts = {
        "revoked": complete(gone),
        "roster": str(authority.roster_file),
        "published": number,
        "stopped": stopped.as_json() if stopped is not None else None,
        "problems": problems,
    }
    show(facts, as_json=as_json, table=Text("\n".join(lines)))
    return Exit.FAILED if problems else Exit.DONE


@keys_app.command
async def publish(*, as_json: Json = False, kept: Kept = KEPT, reach: Reach = REACH) -> int:
    """Give a running fleet the roster: every gateway has it within seconds, and lets new robots in."""
    authority = kept.load()
    number = await _hand_out(authority, reach)
    show({"roster": number}, as_json=as_json, table=Text(f"the fleet has roster {number}"))
    return Exit.DONE


async def _hand_out(authority: "Authority", reach: Reach) -> int:
    """Give a gateway the roster; returns the number of the one that counts there. Gateways hand it on by themselves."""
    from appliance.identity import files, roster

    sealed = files.read(
        authority.roster_file, private=False, absent="copy it back from a backup", most=roster.MOST_BYTES
    )
    async with reach.client(authority.fleet) as client:
        told = await client.hand_roster(authority.roster.number, sealed)
    if told.number > authority.roster.number:
        raise ConflictError(
            f"the fleet has roster {told.number}, and this authority is at {authority.roster.number}",
            remedy="this folder is an old copy: use the newest; what was issued since would be forgotten",
        )
    return told.number


@keys_app.command(name="list")
async def list_(
    *,
    every: Annotated[bool, Parameter(name="--all", help="Also expired and revoked ones.")] = False,
    as_json: Json = False,
    kept: Kept = KEPT,
) -> int:
    """List the certificates that the authority has issued, those that expire first at the top."""
    roster, now = kept.load().roster, time.time()
    issued = [each for each in roster.issued if every or each.state(now) == "valid"]
    issued.sort(key=lambda each: each.not_after)
    rows = [
        {**complete(each), "state": each.state(now), "days_left": round((each.not_after - now) / 86_400, 1)}
        for each in issued
    ]
    table = Table()
    for column in ("role", "name", "state", "expires", "days", "hosts", "serial"):
        table.add_column(column)
    for each, row in zip(issued, rows, strict=True):
        end, days, hosts = _day(each.not_after), f"{row['days_left']:.0f}", ", ".join(each.hosts)
        table.add_row(each.role, each.name, each.state(now), end, days, hosts, each.serial[-8:])
    show(rows, as_json=as_json, table=table)
    return Exit.DONE


@keys_app.command(name="show")
async def show_(file: Path, /, *, as_json: Json = False, kept: Kept = KEPT) -> int:
    """Show what a file of keys says, and whether it is good: exit code 9 if it is expired, revoked or damaged.

    Args:
        file: A file that `keys issue` has written.
    """
    from appliance.identity.bundle import Bundle
    from appliance.identity.certificates import WARN_DAYS, hosts_of

    bundle, now = Bundle.load(file), time.time()
    identity = bundle.identity
    problem, remedy, listed = _problem(bundle, kept, now)
    facts: dict[str, Any] = {
        **complete(identity),
        "hosts": hosts_of(bundle.certificate),
        "days_left": round(identity.days_left(now), 1),
        "expiring": identity.days_left(now) < WARN_DAYS,
        "roster": listed,
        "problem": problem,
    }
    lines = [
        f"{identity.text} of fleet {identity.fleet}",
        f"  good     {_day(identity.not_before)} to {_day(identity.not_after)} ({facts['days_left']:.0f} days left)",
        f"  serial   {identity.serial}",
    ]
    if facts["hosts"]:
        lines.append(f"  dialled  {', '.join(facts['hosts'])}")
    lines.append("  roster   " + ("checked" if listed else "not checked: no authority here (--authority)"))
    lines.append(f"  problem  {problem}; {remedy}" if problem else "  it is good")
    show(facts, as_json=as_json, table=Text("\n".join(lines)))
    return Exit.DENIED if problem else Exit.DONE


def _problem(bundle: "Bundle", kept: Kept, now: float) -> tuple[str, str, bool]:
    """What is wrong with a certificate, its remedy, and whether the roster was looked at."""
    listed = False
    try:
        bundle.identity.check_time(now)
        if kept.folder().exists():
            authority = kept.load()
            if authority.certificate == bundle.authority:
                listed = True
                authority.roster.check(bundle.identity)
    except IdentityError as error:
        return error.message, error.remedy, listed
    return "", "", listed


def _file(authority: "Authority", role: Role, name: str, out: Path | None) -> Path:
    """Where a bundle is written."""
    from appliance.identity import files
    from appliance.identity.certificates import check_member

    if out is not None:
        return out
    check_member(role, name)
    folder = authority.folder / "issued"
    files.make_folder(folder)
    return folder / f"{role}-{name}.pem"


def _show_issued(bundle: "Bundle", *, as_json: bool) -> None:
    from appliance.identity.certificates import hosts_of

    identity: Identity = bundle.identity
    hosts = hosts_of(bundle.certificate)
    facts = {**complete(identity), "hosts": hosts, "file": str(bundle.path)}
    lines = [f"issued {bundle.path} for {identity.text}, good until {_day(identity.not_after)}"]
    if identity.role is Role.GATEWAY and not hosts:
        lines.append("It is dialled on the loopback only; for other machines give --host.")
    if identity.role is Role.GATEWAY:
        lines.append("It runs only skills, images and models that are signed: swiftbot parts list, sign, publish.")
    if identity.role in (Role.GATEWAY, Role.ROBOT):
        lines.append(
            "next: copy it to its machine, and give the fleet the roster: swiftbot keys publish --connect ENDPOINT"
        )
    else:
        lines.append("next: copy it to its machine")
    show(facts, as_json=as_json, table=Text("\n".join(lines)))
    if not as_json and identity.days_left(time.time()) < 0:
        console.err.print("that certificate has expired already", markup=False)


def _day(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d")
