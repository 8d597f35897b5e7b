"""What goes into each log file beside the messages: the configuration without its secrets, and the versions."""

import platform
import sys
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, cast

import msgspec
from msgspec import Struct

from appliance.model import Site
from appliance.record.openlog import Attached
from appliance.record.redact import LEAST_SECRET, Redactor, known_secrets, without_secrets
from appliance.record.writer import VERSION

PACKAGES = ("eclipse-zenoh", "mcap", "msgspec", "onnxruntime-genai", "podman", "pymavlink", "textual", "zstandard")
MOST_SECRET_FILE_BYTES = 4096


class About(Struct, frozen=True, kw_only=True):
    """What a recorder is told beside its settings: what logs are understood by, and what must not be in them."""

    site: Site | None = None
    """Where the fleet is on the globe."""
    attached: tuple[Attached, ...] = ()
    """Goes into each file: the configuration, without its secrets, and the versions."""
    secrets: tuple[str, ...] = ()
    """Values that are taken out of every message (`redact.known_secrets`)."""


def about(configuration: Mapping[str, Any], environment: Mapping[str, str], *, site: Site | None = None) -> About:
    """Return what a recorder puts into its files, and what it keeps out of them.

    Args:
        configuration: the gateway's, as plain data; empty when there is none.
        environment: of this process: what its variables hold whose names say so is kept out of every message.
        site: where the fleet is.
    """
    secrets = known_secrets(environment, configuration) + _of_files(configuration)
    attached = [Attached("versions.json", "application/json", msgspec.json.format(msgspec.json.encode(versions())))]
    if configuration:
        plain = Redactor(secrets).json(msgspec.json.encode(without_secrets(configuration)))
        attached.append(Attached("configuration.json", "application/json", msgspec.json.format(plain)))
    return About(site=site, attached=tuple(attached), secrets=secrets)


def versions() -> dict[str, str]:
    """Return the versions of what runs here."""
    found = {"swiftbot": VERSION, "python": sys.version.split()[0], "system": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _secret_files(configuration: Mapping[str, Any]) -> list[Path]:
    """Return the files that hold secrets: the key of the upstream model, those that sign MAVLink links."""
    llm = cast("dict[str, Any]", configuration.get("llm") or {})
    robots = cast("dict[str, Any]", configuration.get("robots") or {})
    links = cast("list[dict[str, Any]]", robots.get("mavlink") or [])
    named = [llm.get("upstream_key_file"), *(each.get("signing") for each in links)]
    return [
        Path(each).expanduser()
        for each in named
        if isinstance(each, str) and each and not each.startswith("credential:")
    ]


def _of_files(configuration: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what is in the files that hold secrets, as far as this process may read them."""
    found: list[str] = []
    for path in _secret_files(configuration):
        try:
            with path.open(encoding="utf-8") as file:
                text = file.read(MOST_SECRET_FILE_BYTES).strip()
        except (OSError, UnicodeDecodeError):
            continue  # the gateway says what is wrong with it; what cannot be read here cannot be leaked from here
        found += [each for each in (text, text.removeprefix("hex:")) if len(each) >= LEAST_SECRET]
    return tuple(dict.fromkeys(found))
