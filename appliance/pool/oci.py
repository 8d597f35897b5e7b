"""Images as files: a layer that is the same wherever it is made, and the OCI archive that Podman loads.

An image's id is the SHA-256 of its configuration, which has the time of its making and the digests of its layers. So
that two machines make the same image of the same packages, members of a layer are sorted, have one time and no names
of owners, and what tells of the machine or the moment (host name, resolver, apt's sources, logs, caches, machine id)
is not in it.
"""

import copy
import hashlib
import io
import platform
import tarfile
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import PrerequisiteError
from appliance.model.transfer_api import ImageLayout

PACKAGES = "usr/share/swiftbot-packages"
"""File of an image that names the Debian packages in it: name, version, architecture, SHA-256 of the package."""
LEFT_OUT = (
    "etc/hostname",
    "etc/resolv.conf",
    "etc/machine-id",
    "etc/apt/apt.conf.d/99mmdebstrap",
    "etc/apt/sources.list",
    "etc/apt/sources.list.d/",
    "etc/dpkg/dpkg.cfg.d/99mmdebstrap",
    "run/",
    "tmp/",
    "var/cache/",
    "var/lib/apt/",
    "var/lib/dbus/machine-id",
    "var/log/",
    "var/tmp/",
)
"""Files that tell of the machine or the moment; of what ends with a slash, what is in the folder and not the folder."""

_ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "arm"}
_XATTR = "SCHILY.xattr."
_COPY = 2**20
_OCI = "application/vnd.oci.image"


class Package(Struct, frozen=True, order=True):
    """A Debian package."""

    name: str
    version: str
    architecture: str
    sha256: str = ""


def paragraphs(text: Iterable[str]) -> Iterator[dict[str, str]]:
    """Give the first lines of the fields of each paragraph of a Debian control file."""
    fields: dict[str, str] = {}
    for line in text:
        if not line.strip():
            if fields:
                yield fields
            fields = {}
        elif not line[0].isspace():
            key, _, value = line.partition(":")
            fields[key] = value.strip()
    if fields:
        yield fields


def packages(archive: Path, lists: Path) -> tuple[Package, ...]:
    """Return the packages of a Debian root filesystem's archive, sorted, each with its digest.

    Args:
        archive: the tar archive.
        lists: folder with apt's lists that it was made by.

    Raises:
        PrerequisiteError: it has none, or the lists do not know one.
    """
    with tarfile.open(archive) as tar:
        try:
            status = tar.extractfile("./var/lib/dpkg/status")
        except KeyError:
            status = None
        if status is None:
            raise PrerequisiteError("the root filesystem has no list of packages", remedy="see the log of the build")
        found = {
            _package(each)
            for each in paragraphs(io.TextIOWrapper(cast("BinaryIO", status), "utf-8", "replace"))
            if each.get("Status") == "install ok installed"
        }
    digests: dict[Package, str] = {}
    for file in sorted(lists.rglob("*_Packages")):
        with file.open(encoding="utf-8", errors="replace") as text:
            digests |= {
                _package(each): each["SHA256"]
                for each in paragraphs(text)
                if "SHA256" in each and _package(each) in found
            }
    if unknown := sorted(found - digests.keys()):
        names = ", ".join(f"{each.name} {each.version}" for each in unknown[:5])
        raise PrerequisiteError(
            f"apt's lists have no digest of {names}", remedy="apt-get update, and look at the machine's apt sources"
        )
    return tuple(sorted(replace(each, sha256=digests[each]) for each in found))


def _package(fields: Mapping[str, str]) -> Package:
    return Package(fields.get("Package", ""), fields.get("Version", ""), fields.get("Architecture", ""))


def listing(packages: Iterable[Package]) -> bytes:
    """Return the file that names packages: two images that differ are told apart by it."""
    return "".join(f"{each.name} {each.version} {each.architecture} {each.sha256}\n" for each in packages).encode()


def write_layer(archive: Path, layer: Path, *, made: int, extra: Mapping[str, bytes]) -> tuple[str, int]:
    """Write a root filesystem's archive as a layer that depends on its content only; returns its SHA-256 and size.

    Args:
        archive: the tar archive; of members of one name the last counts.
        layer: the file to write.
        made: the time that all members get, Unix seconds.
        extra: files of root to add, by their paths, in folders that are there.
    """
    with tarfile.open(archive) as tar, tarfile.open(layer, "w", format=tarfile.PAX_FORMAT) as out:
        members = {path: each for each in tar if not _left_out(path := _path(each.name))}
        first: dict[str, str] = {}
        """File that other names link to -> the first of all its names: that has the content, since it is read first."""
        for path in sorted(members.keys() | extra.keys(), key=lambda path: path.split("/")):
            if path in extra:
                info = tarfile.TarInfo(path)
                info.size, info.mtime = len(extra[path]), made
                out.addfile(info, io.BytesIO(extra[path]))
                continue
            target = _path(members[path].linkname) if members[path].islnk() else path
            member = members.get(target, members[path])
            info = copy.copy(member)
            info.name, info.mtime, info.uname, info.gname = path or ".", made, "", ""
            info.pax_headers = {
                key: value for key, value in sorted(member.pax_headers.items()) if key.startswith(_XATTR)
            }
            if not member.isreg():
                out.addfile(info)
            elif (name := first.setdefault(target, path)) == path:
                out.addfile(info, tar.extractfile(member))
            else:
                info.type, info.linkname, info.size = tarfile.LNKTYPE, name, 0
                out.addfile(info)
    with layer.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest(), layer.stat().st_size


def _path(name: str) -> str:
    """Return a member's path, empty for the root."""
    path = name.removeprefix("./").rstrip("/")
    return "" if path == "." else path


def _left_out(path: str) -> bool:
    return any(path.startswith(each) if each.endswith("/") else path == each for each in LEFT_OUT)


def configuration(layer: str, *, made: int) -> bytes:
    """Return the configuration of an image of one layer.

    Args:
        layer: SHA-256 of the layer.
        made: the image's time, Unix seconds.
    """
    created = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(made))
    machine = platform.machine()
    return msgspec.json.encode(
        {
            "created": created,
            "architecture": _ARCHITECTURES.get(machine, machine),
            "os": "linux",
            "config": {},
            "rootfs": {"type": "layers", "diff_ids": [f"sha256:{layer}"]},
            "history": [{"created": created, "comment": "made of Debian packages"}],
        }
    )


def oci_archive(
    layout: ImageLayout, config: bytes, blobs: Mapping[str, Path], sizes: Mapping[str, int]
) -> Iterator[bytes]:
    """An OCI archive, piece by piece, with those layers that are in `blobs`. Blocks while it reads them.

    Args:
        layout: what the image is made of.
        config: its configuration.
        blobs: the layers that are not in Podman's storage yet.
        sizes: of all layers that are known; of one that is in the storage it does not matter.
    """
    manifest = msgspec.json.encode(
        {
            "schemaVersion": 2,
            "mediaType": f"{_OCI}.manifest.v1+json",
            "config": _descriptor(f"{_OCI}.config.v1+json", layout.image_id, len(config)),
            "layers": [_descriptor(f"{_OCI}.layer.v1.tar", each, sizes.get(each, 0)) for each in layout.layers],
        }
    )
    digest = hashlib.sha256(manifest).hexdigest()
    named = _descriptor(f"{_OCI}.manifest.v1+json", digest, len(manifest))
    index = {
        "schemaVersion": 2,
        "manifests": [named | {"annotations": {"org.opencontainers.image.ref.name": layout.reference}}],
    }
    yield from _member("oci-layout", b'{"imageLayoutVersion":"1.0.0"}')
    yield from _member("index.json", msgspec.json.encode(index))
    yield from _member(f"blobs/sha256/{digest}", manifest)
    yield from _member(f"blobs/sha256/{layout.image_id}", config)
    for each, path in blobs.items():
        size = path.stat().st_size
        yield _header(f"blobs/sha256/{each}", size)
        with path.open("rb") as file:
            while data := file.read(_COPY):
                yield data
        yield bytes(-size % tarfile.BLOCKSIZE)
    yield bytes(2 * tarfile.BLOCKSIZE)


def _descriptor(media_type: str, digest: str, size: int) -> dict[str, Any]:
    return {"mediaType": media_type, "digest": f"sha256:{digest}", "size": size}


def _header(name: str, size: int) -> bytes:
    info = tarfile.TarInfo(name)
    info.size, info.mode = size, 0o644
    return info.tobuf(tarfile.GNU_FORMAT)


def _member(name: str, data: bytes) -> Iterator[bytes]:
    out = io.BytesIO()
    out.write(_header(name, len(data)))
    out.write(data)
    out.write(bytes(-len(data) % tarfile.BLOCKSIZE))
    yield out.getvalue()
