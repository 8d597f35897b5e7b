"""Puts Python packages into an image that is being built: from wheels in a folder, by hash, without a network.

Wheels are unpacked here and not by pip: images have none, and a wheel is an archive whose files have known places.
Nothing of a wheel is run. Each file of the wheelhouse that is used has one of the hashes that `requirements.txt` pins,
and the very bytes that were hashed are unpacked.
"""

import contextlib
import hashlib
import platform
import re
import shutil
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from email.parser import HeaderParser
from io import BufferedReader
from pathlib import Path, PurePosixPath

from msgspec import Struct
from packaging import markers, tags
from packaging.requirements import InvalidRequirement
from packaging.requirements import Requirement as Parsed
from packaging.utils import InvalidWheelFilename, canonicalize_name, parse_wheel_filename
from packaging.version import Version

from appliance.errors import ConfigError, PrerequisiteError
from appliance.pool.snapshots import add_bytecode
from appliance.skills.catalogue import WHEELHOUSE
from appliance.skills.requirements import FILE, HASH_SIZES, Requirement

_PYTHON = re.compile(r"(?:.*/)?python3\.(\d+)$")


class Python(Struct, frozen=True, kw_only=True):
    """The Python of an image: its version, and where it looks for packages."""

    minor: int
    site: str
    """Absolute path of its folder of packages, such as /usr/local/lib/python3.11/dist-packages."""

    @property
    def environment(self) -> dict[str, str]:
        """Values of PEP 508's variables for it; its patch release does not matter to any sensible marker."""
        here = {name: str(value) for name, value in markers.default_environment().items()}
        return here | {
            "python_version": f"3.{self.minor}",
            "python_full_version": f"3.{self.minor}.0",
            "implementation_version": f"3.{self.minor}.0",
            "extra": "",
        }

    @property
    def tags(self) -> frozenset[tags.Tag]:
        """Tags of the wheels that it can have, on this machine's kind of processor and C library."""
        version, interpreter, platforms = (3, self.minor), f"cp3{self.minor}", list(tags.platform_tags())
        return frozenset(
            (
                *tags.cpython_tags(version, abis=[interpreter], platforms=platforms),
                *tags.compatible_tags(version, interpreter=interpreter, platforms=platforms),
            )
        )


class Wheel(Struct, frozen=True, kw_only=True):
    """A wheel in a wheelhouse, as its name tells."""

    file: Path
    name: str
    version: Version
    tags: frozenset[tags.Tag]


def wheels_in(folders: Sequence[Path]) -> tuple[Wheel, ...]:
    """Return the wheels in folders, those of the first before those of the next; other files are left out.

    Raises:
        ConfigError: a folder is not there, or cannot be read.
    """
    found: list[Wheel] = []
    for folder in folders:
        try:
            files = sorted(folder.iterdir())
        except OSError as error:
            raise ConfigError(
                f"{folder}: no readable wheelhouse: {error.strerror}", remedy="name a folder of wheels"
            ) from error
        for file in files:
            with contextlib.suppress(InvalidWheelFilename):
                name, version, _, kinds = parse_wheel_filename(file.name)
                found.append(Wheel(file=file, name=name, version=version, tags=kinds))
    return tuple(found)


def choose(
    requirement: Requirement, wheels: Sequence[Wheel], python: Python | None, *, file: Path, folders: Sequence[Path]
) -> Wheel:
    """Return the wheel to install for a requirement; `python` None: whichever has a right hash.

    Raises:
        PrerequisiteError: none is there, none has one of the hashes, or none is for this Python.
    """
    where = f"{file}:{requirement.line}: {requirement.pinned}"
    beside = file.parent / WHEELHOUSE
    looked = f"no wheel in {', '.join(map(str, folders))}"
    if not folders:
        looked = f"no wheelhouse: {beside} is not there and no --wheelhouse is given"
    options = "--no-deps --only-binary :all: --require-hashes"
    fetch = f"on a machine with a network: pip download {options} -r {file} -d {beside}"
    named = [w for w in wheels if w.name == requirement.name and w.version == Version(requirement.version)]
    if not named:
        others = sorted({str(each.version) for each in wheels if each.name == requirement.name})
        has = f", which has {requirement.name} {', '.join(others)}" if others else ""
        raise PrerequisiteError(f"{where}: {looked}{has}", remedy=f"put the wheel there; {fetch}")
    right = [each for each in named if _has_hash(each.file, requirement.hashes)]
    if not right:
        told = ", ".join(f"{each.file} has sha256:{_hash(each.file, 'sha256')}" for each in named)
        raise PrerequisiteError(
            f"{where}: wrong hash: {told}, and none of its --hash says so",
            remedy=f"fetch it again ({fetch}) or pin that hash if you know that file to be the right one",
        )
    fitting = [each for each in right if python is None or each.tags & python.tags]
    if python is not None and not fitting:
        names = ", ".join(each.file.name for each in right)
        raise PrerequisiteError(
            f"{where}: {names} is not for Python 3.{python.minor} on {platform.machine()}",
            remedy=f"put the wheel for it into the wheelhouse, and its hash into {file.name}",
        )
    return fitting[0]


def _hash(file: Path, algorithm: str) -> str:
    with file.open("rb") as data:
        return hashlib.file_digest(data, algorithm).hexdigest()


def _has_hash(file: Path, hashes: Sequence[str]) -> bool:
    return any(_hash(file, each.partition(":")[0]) == each.partition(":")[2] for each in hashes)


def check(requirements: Sequence[Requirement], folders: Sequence[Path], *, file: Path) -> None:
    """Check that there is a wheel with a right hash for each requirement, as far as that can be told without a Python.

    Raises:
        ConfigError: a wheelhouse cannot be read.
        PrerequisiteError: a wheel is missing, or has none of the hashes.
    """
    wheels = wheels_in(folders)
    for each in requirements:
        if not each.marker:
            choose(each, wheels, None, file=file, folders=folders)


def unpack(
    requirements: Sequence[Requirement],
    folders: Sequence[Path],
    root: Path,
    python: Python,
    *,
    file: Path,
    progress: Callable[[str], None],
) -> None:
    """Unpack the wheels of an image's requirements into a folder that will be laid over its root filesystem.

    Args:
        requirements: what `requirements.txt` names.
        folders: wheelhouses, the first before the next.
        root: the folder; what belongs at /usr/x is put at usr/x in it.
        python: the image's Python.
        file: the requirements file, for errors.
        progress: told each package, and what one needs that no requirement names.

    Raises:
        ConfigError, PrerequisiteError: see `check`; or a wheel is not for this Python, or damaged.
    """
    wheels = wheels_in(folders)
    wanted = [each for each in requirements if each.wanted(python.environment)]
    for each in wanted:
        wheel = choose(each, wheels, python, file=file, folders=folders)
        progress(f"installing {wheel.file.name}")
        try:
            with wheel.file.open("rb") as data:
                _verify(data, each, wheel.file)
                needs = _unpack(data, root, python)
        except (OSError, zipfile.BadZipFile, KeyError, ValueError) as error:
            raise PrerequisiteError(
                f"{file}:{each.line}: {each.pinned}: {wheel.file} cannot be unpacked: {error}",
                remedy="put a whole wheel into the wheelhouse",
            ) from error
        for need in _missing(needs, wanted, python):
            progress(f"{each.name} needs {need}, which {FILE} does not name: a Debian package must bring it")
    add_bytecode(root / python.site.lstrip("/"), inside=Path(python.site))
    for each in root.rglob("*"):
        if each.is_dir():
            each.chmod(0o755)  # whatever this user's umask


def _verify(data: BufferedReader, requirement: Requirement, file: Path) -> None:
    """Hash the open file that is then unpacked, which may have been replaced since it was chosen."""
    for algorithm in HASH_SIZES:
        data.seek(0)
        if f"{algorithm}:{hashlib.file_digest(data, algorithm).hexdigest()}" in requirement.hashes:
            return
    raise ValueError(f"{file.name} was replaced while the image was built")


def _unpack(data: BufferedReader, root: Path, python: Python) -> tuple[str, ...]:
    """Unpack one wheel; returns what its metadata says that it needs."""
    with zipfile.ZipFile(data) as archive:
        names = archive.namelist()
        metadata = next(name for name in names if re.fullmatch(r"[^/]+\.dist-info/METADATA", name))
        for info in archive.infolist():
            if info.is_dir():
                continue
            target = _place(PurePosixPath(info.filename), python)
            if target is None:
                continue
            place = root / target
            place.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(info) as source, place.open("wb") as copy:
                shutil.copyfileobj(source, copy)
            executable = bool(info.external_attr >> 16 & 0o111) or target.startswith("usr/local/bin/")
            if target.startswith("usr/local/bin/"):
                _name_python(place)
            place.chmod(0o755 if executable else 0o644)
        headers = HeaderParser().parsestr(archive.read(metadata).decode("utf-8", "replace"))
    return tuple(headers.get_all("Requires-Dist") or ())


def _place(path: PurePosixPath, python: Python) -> str | None:
    """Return where a file of a wheel belongs, below the root; None: nowhere. ValueError when it leads outside."""
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"it holds the path {str(path)[:80]!r}")
    site = python.site.lstrip("/")
    if len(path.parts) < 2 or not path.parts[0].endswith(".data"):
        return f"{site}/{path}"
    kind, rest = path.parts[1], "/".join(path.parts[2:])
    below = {"purelib": site, "platlib": site, "scripts": "usr/local/bin", "data": "usr/local"}.get(kind)
    return f"{below}/{rest}" if below and rest else None  # headers are of no use where nothing is compiled


def _name_python(script: Path) -> None:
    """Replace the interpreter that a wheel's script leaves open."""
    text = script.read_bytes()
    for begin in (b"#!pythonw", b"#!python"):
        if text.startswith(begin):
            script.write_bytes(b"#!/usr/bin/env python3" + text.removeprefix(begin))
            return


def _missing(needs: Sequence[str], wanted: Sequence[Requirement], python: Python) -> Iterator[str]:
    names = {each.name for each in wanted}
    for need in needs:
        try:
            parsed = Parsed(need)
        except InvalidRequirement:
            continue
        if (parsed.marker is None or parsed.marker.evaluate(python.environment)) and (
            canonicalize_name(parsed.name) not in names
        ):
            yield need


def python_of(archive: Path) -> Python:
    """Return the Python of a Debian root filesystem's archive.

    Raises:
        PrerequisiteError: it has none.
    """
    with tarfile.open(archive) as tar:
        for member in tar:
            if member.name.removeprefix("./") == "usr/bin/python3" and (found := _PYTHON.match(member.linkname)):
                minor = int(found[1])
                return Python(minor=minor, site=f"/usr/local/lib/python3.{minor}/dist-packages")
    raise PrerequisiteError("the image has no python3", remedy="add python3 to its packages")


def append(archive: Path, root: Path) -> None:
    """Add all files below a folder to a root filesystem's archive, as root's own."""

    def owned(member: tarfile.TarInfo) -> tarfile.TarInfo:
        member.uid = member.gid = 0
        member.uname = member.gname = "root"
        if member.isdir():
            member.mode = 0o755
        return member

    with tarfile.open(archive, "a") as tar:
        present = {member.name.removeprefix("./").rstrip("/") for member in tar if member.isdir()}
        for path in sorted(root.rglob("*")):
            name = path.relative_to(root).as_posix()
            if not (path.is_dir() and name in present):
                tar.add(path, f"./{name}", recursive=False, filter=owned)
