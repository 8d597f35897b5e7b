"""Which Debian packages the host trusts: its own apt sources, cut down to the distribution's main suites.

It exists so that images are made of exactly what the machine itself would install, with the machine's mirrors
and keys, and no mirror's name is ever written in this product. Pure but for reading the files.
"""

import re
from pathlib import Path

from appliance.errors import PrerequisiteError

_ONE_LINE = re.compile(r"^deb\s+(?:\[(?P<options>[^\]]*)\]\s+)?(?P<uri>\S+)\s+(?P<suite>\S+)\s+(?P<components>.+)$")


def codename(os_release: str) -> str:
    """Return VERSION_CODENAME of an os-release file's text; PrerequisiteError when it names none."""
    found = re.search(r'^VERSION_CODENAME="?([a-z]+)"?$', os_release, re.MULTILINE)
    if not found:
        raise PrerequisiteError("this is no Debian release with a code name", remedy="set pool.base_image instead")
    return found.group(1)


def _ours(suite: str, release: str) -> bool:
    return suite in {release, f"{release}-updates", f"{release}-security", f"{release}/updates"}


def _trusted(signed_by: str) -> bool:
    """Whether a repository is the distribution's own: signed by its archive key, or by apt's common ring."""
    name = Path(signed_by.split(",", maxsplit=1)[0].strip()).name
    return not name or name.startswith(("debian-archive", "ubuntu-archive"))


def _line(uri: str, suite: str, signed_by: str) -> str:
    options = f"[signed-by={signed_by}] " if signed_by else ""
    return f"deb {options}{uri} {suite} main"


def from_list(text: str, release: str) -> list[str]:
    """Return the release's main entries of a one-line-style file."""
    lines: list[str] = []
    for raw in text.splitlines():
        found = _ONE_LINE.match(raw.split("#", 1)[0].strip())
        if found is None or "main" not in found["components"].split() or not _ours(found["suite"], release):
            continue
        signed = re.search(r"signed-by=(\S+)", found["options"] or "", re.IGNORECASE)
        if _trusted(signed.group(1) if signed else ""):
            lines.append(_line(found["uri"], found["suite"], signed.group(1) if signed else ""))
    return lines


def from_deb822(text: str, release: str) -> list[str]:
    """Return the release's main entries of a deb822-style file, as one-line entries."""
    lines: list[str] = []
    for stanza in re.split(r"\n\s*\n", "\n".join(line for line in text.splitlines() if not line.startswith("#"))):
        fields: dict[str, str] = {}
        key = ""
        for line in stanza.splitlines():
            if line[:1].isspace() and key:
                fields[key] += "\n" + line.strip()
            elif ":" in line:
                key, _, value = line.partition(":")
                key = key.strip().lower()
                fields[key] = value.strip()
        signed_by = fields.get("signed-by", "")
        if (
            "deb" not in fields.get("types", "").split()
            or fields.get("enabled", "yes").lower() in ("no", "false", "0")
            or "main" not in fields.get("components", "").split()
            or "\n" in signed_by  # a key written out in the file is never the archive's own
            or not _trusted(signed_by)
        ):
            continue
        lines += [
            _line(uri, suite, signed_by)
            for uri in fields.get("uris", "").split()
            for suite in fields.get("suites", "").split()
            if _ours(suite, release)
        ]
    return lines


def host_sources(root: Path = Path("/")) -> tuple[str, list[str]]:
    """Return the host's code name and its own main apt entries, in one-line form.

    Raises:
        PrerequisiteError: it is no Debian, or has no such entry.
    """
    try:
        release = codename((root / "etc/os-release").read_text(encoding="utf-8"))
    except OSError as error:
        raise PrerequisiteError(f"/etc/os-release cannot be read: {error}") from error
    apt = root / "etc/apt"
    lines: list[str] = []
    single = apt / "sources.list"
    files = ([single] if single.is_file() else []) + sorted((apt / "sources.list.d").glob("*"))
    for file in files:
        if file.suffix == ".list":
            lines += from_list(file.read_text(encoding="utf-8"), release)
        elif file.suffix == ".sources":
            lines += from_deb822(file.read_text(encoding="utf-8"), release)
    if not lines:
        raise PrerequisiteError(
            f"no apt source of {release} main on this machine, so no image can be made of its packages",
            remedy=f"add a source of {release} main to /etc/apt, or set pool.base_image to an image of a registry",
        )
    return release, list(dict.fromkeys(lines))
