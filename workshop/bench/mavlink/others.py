"""Routers of others, which are measured beside the gateway's where they are installed: each with two TCP servers."""

import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from msgspec import Struct

from appliance.errors import ConfigError, PrerequisiteError

Ports = tuple[int, int]
AUTO, NONE = "auto", "none"


class Other(Struct, frozen=True):
    """A router: its program, how it is installed, and what it is started with for two ports in a folder of its own."""

    name: str
    program: str
    install: str
    arguments: Callable[[Path, Ports], list[str]]


class Found(Struct, frozen=True):
    """One that is installed."""

    other: Other
    path: str


def _mavp2p(_: Path, ports: Ports) -> list[str]:
    return ["--hb-disable", *(f"tcps:127.0.0.1:{port}" for port in ports)]


def _mavrouter(folder: Path, ports: Ports) -> list[str]:
    # As many frames as its own stress test lets wait: with fewer it drops what comes at full speed.
    general = f"[general]\nlog = {json.dumps(str(folder))}\nlog_telemetry = false\nbus_capacity = 20000\n"
    ends = "".join(f'\n[[endpoint]]\ntype = "tcp"\naddress = "127.0.0.1:{port}"\nmode = "server"\n' for port in ports)
    config = folder / "mavrouter.toml"
    config.write_text(general + ends)
    return ["--config", str(config)]


def _mavproxy(folder: Path, ports: Ports) -> list[str]:
    master, out = (f"tcpin:127.0.0.1:{port}" for port in ports)
    state = ["--state-basedir", str(folder), "--logfile", str(folder / "mav.tlog")]
    return [
        "--master",
        master,
        "--out",
        out,
        "--daemon",
        "--nowait",
        "--default-modules",
        "",
        "--streamrate",
        "-1",
        *state,
    ]


OTHERS = (
    Other("mavp2p", "mavp2p", "GOBIN=$PWD/build/bin go install github.com/bluenviron/mavp2p@latest", _mavp2p),
    Other("mavrouter", "mavrouter", "cargo install mavrouter --locked --root build", _mavrouter),
    Other("mavproxy", "mavproxy.py", "pip install MAVProxy (the development environment has it)", _mavproxy),
)


def find(wanted: str) -> tuple[list[Found], dict[str, str]]:
    """Return the routers that are measured too, and how the others are installed.

    Args:
        wanted: names, separated by commas; `auto` is all that are there (build/bin, PATH, beside Python), `none` none.

    Raises:
        ConfigError: a name that is none of them.
        PrerequisiteError: one that is named is not there.
    """
    if wanted == NONE:
        return [], {}
    names = [each.name for each in OTHERS] if wanted == AUTO else [each.strip() for each in wanted.split(",")]
    known = {each.name: each for each in OTHERS}
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"no router {unknown[0]!r}", remedy=f"name some of {', '.join(known)}, or auto, or none")
    places = os.pathsep.join(
        (str(Path("build/bin").absolute()), os.environ.get("PATH", ""), str(Path(sys.executable).parent))
    )
    found: list[Found] = []
    missing: dict[str, str] = {}
    for name in names:
        path = shutil.which(known[name].program, path=places)
        if path is not None:
            found.append(Found(known[name], path))
        elif wanted == AUTO:
            missing[name] = known[name].install
        else:
            raise PrerequisiteError(
                f"{name}, which is to be measured beside the router, is not there", remedy=known[name].install
            )
    return found, missing
