"""Bundles: a release in one signed file, which installs without a network.

A bundle is a plain tar. First comes `bundle.json`, the manifest: version, architecture, Python, and name, size and
SHA-256 of every other member; then `bundle.sig`, its Ed25519 signature; then the members, in the manifest's order:

    wheels/*.whl      the program and its packages
    tools/*.whl       what fills the virtual environment (uv)
    systemd/, docs/   as in the source tree
    source/*.tar.gz   the source of the program
    images/*.tar      container images, as `podman save` writes them
    packages/*.deb    Debian packages that the program needs, with all that those need, and `wanted`: their names
    models/*/         models for the planner
    parts/*.json      lists of parts, signed by the authorities of fleets

The signature is checked before anything else of the file is believed, each member as it is taken out. The keys that a
machine trusts are in /etc/swiftbot/release.pub, public keys in PEM, one or more: the next one can be added before the
last is taken away.
"""

import contextlib
import hashlib
import io
import re
import stat
import sys
import tarfile
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import msgspec
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Struct
from packaging.version import InvalidVersion, Version

from appliance import durable
from appliance.errors import ConfigError, ConflictError, IdentityError, PayloadError, RefusedError

MANIFEST, SIGNATURE = "bundle.json", "bundle.sig"
SIGNED_AS = b"swiftbot bundle 1\n"
"""Before the manifest in what is signed, so that the key's signature of anything else is none of a bundle."""
MOST_MANIFEST = 4 * 2**20
SIGNATURE_BYTES = 64
MOST_FILES = 10_000
PART = 2**20
TRUSTED = "etc/swiftbot/release.pub"
KINDS = ("wheels", "tools", "systemd", "docs", "source", "images", "packages", "models", "parts", "LICENSE")
"""First parts of members' names."""
_PEM = re.compile(rb"-----BEGIN PUBLIC KEY-----.+?-----END PUBLIC KEY-----\n?", re.DOTALL)
_COPY_AGAIN = "copy the bundle again, and compare its size with the original's"


class Member(Struct, frozen=True, forbid_unknown_fields=True):
    """A file of a bundle; `sha256` in hexadecimal."""

    name: str
    size: int
    sha256: str
    executable: bool = False


class Manifest(Struct, frozen=True, kw_only=True):
    """What a bundle says of itself. Fields that a later version adds are ignored."""

    format: int = 1
    release: str
    """Name of the folder that it becomes."""
    version: str
    architecture: str
    """As `uname -m` says it."""
    python: str
    """Version of the machine's Python that its wheels are for, such as 3.11."""
    made: float
    """Unix seconds."""
    members: tuple[Member, ...]

    @property
    def size(self) -> int:
        """Bytes of all members."""
        return sum(member.size for member in self.members)


def make_key(path: Path) -> Path:
    """Make a key that signs bundles; returns the file of its public half, `path`.pub.

    Raises:
        ConflictError: there is one already.
        ConfigError: it cannot be written.
    """
    key = Ed25519PrivateKey.generate()
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    try:
        durable.write(path, private, mode=0o600, replace=False)
        public = path.with_name(f"{path.name}.pub")
        durable.write(public, public_text(key.public_key()), mode=0o644)
    except FileExistsError:
        raise ConflictError(f"{path} exists", remedy="bundles that it signed need it: name another file") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}", remedy="name another file") from error
    return public


def public_text(key: Ed25519PublicKey) -> bytes:
    """Return a public key in PEM."""
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


def load_key(path: Path) -> Ed25519PrivateKey:
    """Read a key that signs bundles; IdentityError where it is none or others may read it."""
    try:
        if stat.S_IMODE(path.stat().st_mode) & 0o077:
            raise IdentityError(f"{path} may be read by others", remedy=f"chmod 600 {path}")
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        raise IdentityError(
            f"{path} cannot be read: {error.strerror}", remedy=f"make one: swiftbot release key {path}"
        ) from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise IdentityError(f"{path} is no private key in PEM", remedy="swiftbot release key makes one") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise IdentityError(f"{path} is not an Ed25519 key", remedy="swiftbot release key makes one")
    return key


def load_trusted(path: Path) -> tuple[Ed25519PublicKey, ...]:
    """Read the keys that a machine trusts; IdentityError where there is none, or one is no Ed25519 key."""
    remedy = f"put the public key of who signs your bundles into {path} (mode 0644)"
    try:
        text = path.read_bytes()
    except OSError as error:
        raise IdentityError(f"no key of bundles is trusted: {path}: {error.strerror}", remedy=remedy) from error
    found: list[Ed25519PublicKey] = []
    for block in _PEM.findall(text):
        with contextlib.suppress(ValueError, UnsupportedAlgorithm):
            key = serialization.load_pem_public_key(block)
            if isinstance(key, Ed25519PublicKey):
                found.append(key)
    if not found or len(found) != text.count(b"-----BEGIN"):
        raise IdentityError(f"{path} holds what is no Ed25519 public key", remedy=remedy)
    return tuple(found)


def pack(
    folder: Path, out: Path, key: Ed25519PrivateKey, *, release: str, version: str, architecture: str, made: float
) -> Manifest:
    """Write a bundle of all that is in a folder; the same folder and time make the same file.

    Raises:
        ConfigError: the folder has no program in it, or what belongs in no bundle; it cannot be read, or `out` not
            written.
    """
    try:
        members = list(_members_of(folder))
    except OSError as error:
        raise ConfigError(
            f"{error.filename or folder} cannot be read: {error.strerror}", remedy="name a folder that you may read"
        ) from error
    if not any(member.name.startswith("wheels/swiftbot-") for member in members):
        raise ConfigError(f"{folder} has no wheel of the program", remedy="make bundle")
    manifest = Manifest(
        release=release,
        version=version,
        architecture=architecture,
        python=f"{sys.version_info.major}.{sys.version_info.minor}",
        made=made,
        members=tuple(members),
    )
    text = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
    try:
        temporary = durable.beside(out)
        try:
            with tarfile.open(temporary, "w", format=tarfile.PAX_FORMAT) as tar:
                for name, content in ((MANIFEST, text), (SIGNATURE, key.sign(SIGNED_AS + text))):
                    tar.addfile(_entry(name, len(content), made), io.BytesIO(content))
                for member in members:
                    with (folder / member.name).open("rb") as data:
                        tar.addfile(_entry(member.name, member.size, made), data)
            durable.sync_file(temporary)
            durable.rename(temporary, out)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink()
    except OSError as error:
        raise ConfigError(
            f"{out} cannot be written: {error.strerror}", remedy="name another file, or free some space (df -h)"
        ) from error
    return manifest


def _members_of(folder: Path) -> Iterator[Member]:
    """Yield what the manifest says of each file of a folder, by name."""
    for file in sorted(each for each in folder.rglob("*") if not each.is_dir()):
        name = str(file.relative_to(folder))
        if file.is_symlink() or not file.is_file() or file.relative_to(folder).parts[0] not in KINDS:
            raise ConfigError(f"{file} belongs in no bundle", remedy=f"a bundle has {', '.join(KINDS)}")
        with file.open("rb") as data:
            digest = hashlib.file_digest(data, "sha256").hexdigest()
        executable = bool(file.stat().st_mode & stat.S_IXUSR)
        yield Member(name=name, size=file.stat().st_size, sha256=digest, executable=executable)


def _entry(name: str, size: int, made: float) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.size, entry.mtime, entry.mode = size, int(made), 0o644
    return entry


class Bundle:
    """A bundle whose manifest was signed by a trusted key; its members are checked as they are taken out."""

    def __init__(self, path: Path, manifest: Manifest, tar: tarfile.TarFile) -> None:
        self.path = path
        self.manifest = manifest
        self._tar = tar

    def check_for(self, *, architecture: str, python: str, running: str, older: bool) -> None:
        """Check that a bundle is for this machine.

        Args:
            architecture: of this machine.
            python: its Python, such as 3.11.
            running: the version that runs; empty: none.
            older: whether an older version is wanted.

        Raises:
            RefusedError: another architecture or Python; an older version that was not asked for.
        """
        manifest = self.manifest
        if manifest.architecture != architecture:
            raise RefusedError(
                f"{self.path} is for {manifest.architecture}, and this machine is {architecture}",
                remedy=f"take the bundle that was made on {architecture}",
            )
        if manifest.python != python:
            raise RefusedError(
                f"{self.path} is for Python {manifest.python}, and this machine has {python}",
                remedy="make the bundle on the same release of Debian as this machine",
            )
        if running and not older and is_older(manifest.version, running):
            raise RefusedError(
                f"{self.path} is version {manifest.version}, older than {running}, which runs",
                remedy="`swiftbot rollback` goes back to the release before; --older installs this one",
            )

    def members(self) -> Iterator[tuple[Member, IO[bytes]]]:
        """Yield each member with its data, in order; read it to its end before the next.

        Raises:
            PayloadError: the file is cut off, or a member is not what the manifest says.
        """
        for member in self.manifest.members:
            entry = _next(self._tar, self.path)
            if entry is None or entry.name != member.name or entry.size != member.size or not entry.isreg():
                found = "ends before it" if entry is None else f"has {entry.name[:80]} of {entry.size:,} bytes"
                raise PayloadError(
                    f"{self.path}: the manifest says {member.name} of {member.size:,} bytes, and the file {found}",
                    remedy=_COPY_AGAIN,
                )
            data = self._tar.extractfile(entry)
            assert data is not None  # noqa: S101 - a regular file has data
            yield member, data
        if _next(self._tar, self.path) is not None:
            raise PayloadError(f"{self.path} has more in it than its manifest says", remedy=_COPY_AGAIN)

    def take_out(self, folder: Path, *, progress: Callable[[int], None] = lambda _: None) -> None:
        """Write all members below a folder, each checked.

        Args:
            folder: an empty one.
            progress: called with the bytes written so far.

        Raises:
            PayloadError: the file is cut off or damaged; what was written is of no use.
        """
        done = 0
        for member, data in self.members():
            path = folder / member.name
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as out:
                for part in self._checked(member, data):
                    out.write(part)
                    done += len(part)
                    progress(done)
            path.chmod(0o755 if member.executable else 0o644)

    def check(self) -> None:
        """Read all members; PayloadError where the file is cut off or damaged."""
        for member, data in self.members():
            for _ in self._checked(member, data):
                pass

    def _checked(self, member: Member, data: IO[bytes]) -> Iterator[bytes]:
        digest, size = hashlib.sha256(), 0
        while part := _read(data, PART, self.path):
            digest.update(part)
            size += len(part)
            yield part
        if size != member.size:
            raise _cut_off(self.path, f"{member.name} has {size:,} of its {member.size:,} bytes")
        if digest.hexdigest() != member.sha256:
            raise PayloadError(f"{self.path}: {member.name} is damaged: another SHA-256", remedy=_COPY_AGAIN)


def release_in(path: Path) -> str:
    """Return the release that a bundle is of, as it says itself: its signature is not looked at.

    Raises:
        ConfigError: there is no such file, or it cannot be read.
        PayloadError: it is no bundle.
    """
    try:
        with tarfile.open(path, mode="r:") as tar:
            return _manifest(path, _first(tar, path, MANIFEST, MOST_MANIFEST)).release
    except (tarfile.TarError, EOFError) as error:
        raise PayloadError(f"{path} is no bundle ({error})", remedy="`make bundle` makes one") from error
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}", remedy="name a bundle's file") from error


@contextmanager
def opened(path: Path, trusted: tuple[Ed25519PublicKey, ...]) -> Generator[Bundle]:
    """Open a bundle, its signature checked.

    Raises:
        ConfigError: there is no such file, or it cannot be read.
        PayloadError: it is no bundle, or is cut off.
        IdentityError: no trusted key has signed it.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}", remedy="name a bundle's file") from error
    with file:
        try:
            tar = tarfile.open(fileobj=file, mode="r:")  # noqa: SIM115 - closed with its file
        except (tarfile.TarError, EOFError) as error:
            raise PayloadError(f"{path} is no bundle ({error})", remedy="`make bundle` makes one") from error
        text = _first(tar, path, MANIFEST, MOST_MANIFEST)
        signature = _first(tar, path, SIGNATURE, SIGNATURE_BYTES)
        if not any(_signed(key, signature, text) for key in trusted):
            raise IdentityError(
                f"{path} is not signed by a key that this machine trusts",
                remedy=f"take it from who makes your bundles, or add their public key to /{TRUSTED}",
            )
        yield Bundle(path, _manifest(path, text), tar)


def _signed(key: Ed25519PublicKey, signature: bytes, text: bytes) -> bool:
    try:
        key.verify(signature, SIGNED_AS + text)
    except InvalidSignature:
        return False
    return True


def _manifest(path: Path, text: bytes) -> Manifest:
    try:
        found = msgspec.json.decode(text, type=Manifest)
        Version(found.version)
    except (msgspec.MsgspecError, InvalidVersion) as error:
        raise PayloadError(f"{path}: the manifest cannot be read: {error}", remedy="make it again") from error
    names = [member.name for member in found.members]
    if found.format != 1 or len(names) > MOST_FILES:
        raise PayloadError(f"{path} is of format {found.format}", remedy="take a bundle of this format, 1")
    for name in names:
        parts = Path(name).parts
        if not parts or parts[0] not in KINDS or ".." in parts or str(Path(name)) != name:
            raise PayloadError(f"{path}: {name[:80]!r} belongs in no bundle", remedy="make it again")
    if len(set(names)) != len(names):
        raise PayloadError(f"{path}: the manifest names a file twice", remedy="make it again")
    return found


def _first(tar: tarfile.TarFile, path: Path, name: str, most: int) -> bytes:
    entry = _next(tar, path)
    if entry is None or entry.name != name or not entry.isreg() or entry.size > most:
        raise PayloadError(f"{path} is no bundle: {name} is not where it belongs", remedy="`make bundle` makes one")
    data = tar.extractfile(entry)
    assert data is not None  # noqa: S101 - a regular file has data
    text = _read(data, entry.size, path)
    if len(text) != entry.size:
        raise _cut_off(path, f"{name} has {len(text):,} of its {entry.size:,} bytes")
    return text


def _next(tar: tarfile.TarFile, path: Path) -> tarfile.TarInfo | None:
    try:
        return tar.next()
    except (tarfile.TarError, EOFError, OSError) as error:
        raise _cut_off(path, str(error)) from error


def _read(data: IO[bytes], most: int, path: Path) -> bytes:
    try:
        return data.read(most)
    except (tarfile.TarError, EOFError, OSError) as error:
        raise _cut_off(path, str(error)) from error


def _cut_off(path: Path, why: str) -> PayloadError:
    return PayloadError(f"{path} is cut off or damaged: {why}", remedy=_COPY_AGAIN)


def is_older(version: str, than: str) -> bool:
    """Whether a version comes before another; builds of one version are equally old."""
    return Version(Version(version).public) < Version(Version(than).public)
