"""What all commands share: groups of the help, the fleet they speak to, how they print."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Group, Parameter

from appliance import console
from appliance.client import Endpoint

DAEMONS = Group("Daemons", sort_key=3)
FLEET = Group("A fleet on this machine", sort_key=1)
WORK = Group("Work", sort_key=2)
TOOLS = Group("Logs, images, checks", sort_key=4)

Json = Annotated[bool, Parameter(name="--json", negative="", help="Print JSON.")]

Skills = Annotated[
    tuple[Path, ...], Parameter(negative="", help="Folder with further skills and images; may be given more than once.")
]

Why = Annotated[str, Parameter(help="Why, for the audit and for those who wonder.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """Which fleet a command speaks to."""

    fleet: Annotated[str, Parameter(env_var="SWIFTBOT_FLEET", help="Name of the fleet.")] = "local"
    directory: Annotated[
        Path | None, Parameter(name="--dir", env_var="SWIFTBOT_DIR", help="Directory of a local fleet.")
    ] = None
    connect: Annotated[
        tuple[str, ...],
        Parameter(env_var="SWIFTBOT_CONNECT", negative="", help="Endpoint of a gateway, such as tcp/10.0.0.1:7447."),
    ] = ()

    def folder(self) -> Path:
        """Directory of the local fleet of that name."""
        from appliance.connection import default_directory

        return self.directory or default_directory(self.fleet)

    def endpoint(self) -> Endpoint:
        """Where to connect: as told, or what the local fleet's state file says."""
        if self.connect:
            return Endpoint(fleet=self.fleet, connect=self.connect)
        from appliance.connection import read_state

        return read_state(self.folder()).endpoint


HERE = Where()


def show(value: Any, *, as_json: bool, table: Any = None) -> None:
    """Print a value as JSON, or its table."""
    if as_json:
        sys.stdout.write(msgspec.json.format(msgspec.json.encode(value), indent=2).decode() + "\n")
    else:
        console.out.print(table)
