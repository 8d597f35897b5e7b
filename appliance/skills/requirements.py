"""Reads an image's `requirements.txt`: Python packages, each pinned to one version and to the hashes of its wheels.

Pure. It exists because an image is built without a network and without trust in a folder of files: what goes into
it is what the file names, byte for byte. Everything that would need an index, or would let anything else in, is
refused with the number of its line.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from msgspec import Struct
from packaging.markers import Marker
from packaging.requirements import InvalidRequirement
from packaging.requirements import Requirement as Parsed
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

from appliance.errors import ConfigError

FILE = "requirements.txt"
"""Beside an `image.toml`."""
HASH_SIZES = {"sha256": 64, "sha384": 96, "sha512": 128}
"""Hash algorithms that pip knows as strong, with their length in hexadecimal digits."""
_HASH = re.compile(r"\s--hash=(\S*)")
_COMMENT = re.compile(r"(^|\s)#.*$")
_REMEDY = (
    "write each line as `name==version --hash=sha256:…`; `pip-compile --generate-hashes` and"
    " `uv pip compile --generate-hashes` do, docs/skills.md shows how"
)


class Requirement(Struct, frozen=True, kw_only=True):
    """One package of one version."""

    name: str
    """Normalized: lower case, `-` for `_` and `.`."""
    version: str
    marker: str = ""
    """Where it is wanted (PEP 508), such as `python_version < "3.12"`; empty: everywhere."""
    hashes: tuple[str, ...]
    """Of the wheels that may be installed, as `algorithm:hexadecimal digits`."""
    line: int
    """Its first line in the file."""

    @property
    def pinned(self) -> str:
        """As it is written in the file."""
        return f"{self.name}=={self.version}"

    def wanted(self, environment: Mapping[str, str]) -> bool:
        """Whether it is wanted on a Python with these values of PEP 508's variables."""
        return not self.marker or Marker(self.marker).evaluate(dict(environment))


def read_requirements(file: Path) -> tuple[Requirement, ...]:
    """Read a requirements file.

    Raises:
        ConfigError: it cannot be read, or names something that is not pinned to a version and to hashes.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}", remedy="make it a text file in UTF-8") from error
    return parse_requirements(text, file)


def parse_requirements(text: str, file: Path) -> tuple[Requirement, ...]:
    """Return the requirements in a file's text; `file` is named in errors.

    Raises:
        ConfigError: a line is not pinned to a version and to hashes, or a package is there twice.
    """
    found: dict[str, Requirement] = {}
    for number, line in _lines(text):
        requirement = _requirement(line, number, file)
        before = found.setdefault(f"{requirement.name};{requirement.marker}", requirement)
        if before is not requirement:
            raise _wrong(file, number, f"{requirement.name} is in line {before.line} too")
    return tuple(found.values())


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Go through the lines without comments, continued ones joined, each with the number of its first."""
    begun, parts = 0, list[str]()
    for number, raw in enumerate([*text.splitlines(), ""], start=1):
        # As in pip, a comment ends a line's text, and a backslash before it continues nothing.
        line = _COMMENT.sub("", raw)
        begun = begun or number
        parts.append(line.removesuffix("\\"))
        if line.endswith("\\"):
            continue
        whole = " ".join(parts).strip()
        if whole:
            yield begun, whole
        begun, parts = 0, []


def _requirement(line: str, number: int, file: Path) -> Requirement:
    what = line.split(maxsplit=1)[0]
    if line.startswith("-"):
        raise _wrong(file, number, f"{what}: options have no place here: wheels come from the wheelhouse alone")
    hashes = tuple(_HASH.findall(f" {line}"))
    specification = _HASH.sub("", f" {line}").strip()
    try:
        parsed = Parsed(specification)
    except InvalidRequirement as error:
        raise _wrong(file, number, f"{specification[:80]!r} is no requirement: {str(error).splitlines()[0]}") from error
    if parsed.url:
        raise _wrong(file, number, f"{parsed.name}: a URL is not fetched: wheels come from the wheelhouse alone")
    versions = [each.version for each in parsed.specifier if each.operator == "=="]
    try:
        version = str(Version(versions[0])) if len(versions) == len(parsed.specifier) == 1 else ""
    except InvalidVersion:  # such as 1.*
        version = ""
    if not version:
        raise _wrong(file, number, f"{parsed.name}: not pinned to one version with `==`")
    if not hashes:
        raise _wrong(file, number, f"{parsed.name}=={version}: no --hash")
    for each in hashes:
        algorithm, _, digits = each.partition(":")
        if len(digits) != HASH_SIZES.get(algorithm) or not re.fullmatch(r"[0-9a-f]+", digits):
            known = ", ".join(HASH_SIZES)
            raise _wrong(file, number, f"{parsed.name}: --hash={each[:80]}: not a whole hash of {known}")
    return Requirement(
        name=canonicalize_name(parsed.name),
        version=version,
        marker=str(parsed.marker or ""),
        hashes=hashes,
        line=number,
    )


def _wrong(file: Path, number: int, what: str) -> ConfigError:
    return ConfigError(f"{file}:{number}: {what}", remedy=_REMEDY)
