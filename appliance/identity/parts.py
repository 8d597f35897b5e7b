"""The signed list of parts: which images, skills and models the gateways of a fleet may fetch, load and run.

The authority signs it, as it signs the roster, and each version has a higher number than the last. A gateway with keys
goes by the newest of the file beside them (`parts.json`), of what other gateways hand on (`plane.handing`) and of what
counted before, which is kept with its data; it refuses what is not named there, and runs nothing without a list.
A gateway without keys is in development mode: nothing is checked, and its status says so.

A part is named with a digest of its content: of an image its id (the SHA-256 of its configuration, which names its
layers), of a skill's or a model's folder the SHA-256 of its listing. There may be several for one name: two versions
during an upgrade, or an image that two machines have built.
"""

import hashlib
import os
import re
import threading
from collections.abc import Collection, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import ConfigError, IdentityError
from appliance.identity import files

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

    from appliance.identity.bundle import Bundle

log = structlog.get_logger(__name__)

FILE = "parts.json"
MOST_BYTES = 4 * 2**20
DEVELOPMENT = "development mode: without keys nothing checks images, skills and models"
LEFT_OUT = frozenset({"__pycache__", ".git", ".hg", ".svn"})
"""Names that are no part of a folder wherever they are."""
_MOST_REFUSED = 32
_NAME = "list of parts"
_DIGEST = re.compile(r"[0-9a-f]{64}")
_SIGN = "`swiftbot parts list`, then `swiftbot parts sign` and `publish` at the authority"
SIGN_AGAIN = "to go back sign the older one again, as the next: `swiftbot parts show OLD --json`, `swiftbot parts sign`"

Digests = dict[str, tuple[str, ...]]


class Kind(StrEnum):
    """What a part is."""

    IMAGE = "image"
    SKILL = "skill"
    MODEL = "model"


class Parts(Struct, frozen=True, kw_only=True):
    """The digests of parts, by name: hexadecimal SHA-256. A model counts by its digest, under whatever name it lies."""

    fleet: str = ""
    number: int = 0
    """One higher with each version; 0: of no fleet yet, a list of what one machine has."""
    signed: float = 0.0
    """When it was, Unix seconds."""
    image: Digests = {}
    """By the image's full reference."""
    skill: Digests = {}
    """By the folder's name; `_lib` and the like are shared code, `.` the files beside the folders."""
    model: Digests = {}

    def of(self, kind: Kind) -> Digests:
        """The digests of a kind."""
        return {Kind.IMAGE: self.image, Kind.SKILL: self.skill, Kind.MODEL: self.model}[kind]

    def names(self, kind: Kind, name: str, digest: str) -> bool:
        """Whether a part is named."""
        found = self.of(kind)
        return any(digest in each for each in found.values()) if kind is Kind.MODEL else digest in found.get(name, ())

    def check(self) -> None:
        """Raise ConfigError where a digest is none."""
        for kind in Kind:
            for name, digests in self.of(kind).items():
                if not digests or not all(_DIGEST.fullmatch(each) for each in digests):
                    raise ConfigError(
                        f"{kind} {name[:100]!r} has what is no SHA-256",
                        remedy="make the list with `swiftbot parts list`",
                    )


def together(lists: Collection[Parts]) -> Parts:
    """Return one list of all that several machines have."""

    def joined(kind: Kind) -> Digests:
        found: dict[str, set[str]] = {}
        for each in lists:
            for name, digests in each.of(kind).items():
                found.setdefault(name, set()).update(digests)
        return {name: tuple(sorted(digests)) for name, digests in sorted(found.items())}

    return Parts(image=joined(Kind.IMAGE), skill=joined(Kind.SKILL), model=joined(Kind.MODEL))


def seal(parts: Parts, key: "Ed25519PrivateKey") -> bytes:
    """Sign a list with the authority's key; what comes out is its file."""
    from appliance.identity import sealed  # noqa: PLC0415 - a gateway without keys loads no cryptography

    return sealed.seal(_NAME, msgspec.json.encode(parts), key)


def unseal(data: bytes, authority: "Ed25519PublicKey", fleet: str) -> Parts:
    """Read a list's file.

    Raises:
        IdentityError: it is damaged, of another fleet, or another authority signed it.
    """
    from appliance.identity import sealed  # noqa: PLC0415 - as above

    text = sealed.unseal(_NAME, data, authority, most=MOST_BYTES)
    try:
        parts = msgspec.json.decode(text, type=Parts)
        parts.check()
    except (msgspec.DecodeError, RecursionError, ConfigError) as error:
        raise sealed.damaged(_NAME, error) from None
    if parts.fleet != fleet:
        raise IdentityError(f"the {_NAME} is of fleet {parts.fleet}, not {fleet}", remedy="copy the right one")
    return parts


def read(path: Path) -> bytes:
    """Read a list's file; IdentityError where it is absent, too large or cannot be read."""
    return files.read(path, private=False, absent=f"nothing is run without it: {_SIGN}", most=MOST_BYTES)


class InForce:
    """What a gateway may fetch, load and run now. The file may change meanwhile; each check looks at it.

    Args:
        file: the signed list; None: development mode, in which everything is allowed.
        authority: whose signature counts.
        fleet: whose list counts.
        kept: where the list is kept that counted last: an older one is refused, also after a restart.
    """

    def __init__(
        self,
        file: Path | None = None,
        *,
        authority: "Ed25519PublicKey | None" = None,
        fleet: str = "",
        kept: Path | None = None,
    ) -> None:
        self._file, self._authority, self._fleet, self._kept = file, authority, fleet, kept
        self._parts = Parts()
        self._sealed = b""
        self._kept_number = -1
        """Of the list in `kept`; -1: that has not been read."""
        self._stamp: tuple[int, int, int] | None = None
        self._why = "" if file is None else f"{file} has not been read"
        self._refused: dict[tuple[Kind, str], str] = {}
        self._unkept = ""
        """Why the list that counts is not on the disk: an older one would count after a restart."""
        self._looking = threading.Lock()

    @classmethod
    def beside(cls, bundle: "Bundle", file: Path, kept: Path | None = None) -> "InForce":
        """Return what counts for the holder of a file of keys."""
        from appliance.identity import certificates  # noqa: PLC0415 - a gateway without keys loads no cryptography

        authority = certificates.ed25519_of(bundle.authority)
        return cls(file, authority=authority, fleet=bundle.identity.fleet, kept=kept)

    @property
    def checked(self) -> bool:
        """Whether anything is checked: not in development mode."""
        return self._file is not None

    @property
    def parts(self) -> Parts:
        """The list that counts; an empty one where none does."""
        self._look()
        return self._parts

    @property
    def number(self) -> int:
        """Of the list that counts; 0: none does."""
        return self.parts.number

    @property
    def sealed(self) -> bytes:
        """The list that counts, as its file has it."""
        self._look()
        return self._sealed

    @property
    def problem(self) -> str:
        """Why no list, or not the one in the file, counts, and what was refused lately; empty when all is well."""
        self._look()
        refused = [f"{kind} {name}" for kind, name in self._refused]
        more = f" and {len(refused) - 3} more" if len(refused) > 3 else ""
        unnamed = f"not in the {_NAME}: {', '.join(refused[:3])}{more}" if refused else ""
        return "; ".join(filter(None, (self._why, unnamed, self._unkept)))

    @property
    def text(self) -> str:
        """What counts, in words: the list's number, or that nothing is checked."""
        return f"parts {self.parts.number}" if self.checked else DEVELOPMENT

    def check(self, kind: Kind, name: str, digest: str) -> None:
        """Raise IdentityError unless a part is named, or this is development mode."""
        if not self.checked:
            return
        parts = self.parts
        if parts.names(kind, name, digest):
            self._refused.pop((kind, name), None)
            return
        if len(self._refused) < _MOST_REFUSED:
            self._refused[kind, name] = digest
        known = name in parts.of(kind)
        why = self._why or (
            f"it is {digest[:12]}, and the list of parts {parts.number} names "
            + (", ".join(each[:12] for each in parts.of(kind)[name]) if known else "none of that name")
        )
        raise IdentityError(f"{kind} {name[:100]} is not signed: {why}", remedy=f"if it is to be used: {_SIGN}")

    def has(self, kind: Kind, name: str, digest: str) -> bool:
        """Whether a part is named; True in development mode."""
        try:
            self.check(kind, name, digest)
        except IdentityError as error:
            log.warning("not signed", kind=kind, name=name, reason=error.message)
            return False
        return True

    def check_folder(self, kind: Kind, folder: Path) -> None:
        """Check a folder as it is on the disk; blocks while it is read.

        Raises:
            IdentityError: it is not named.
            ConfigError: it cannot be read.
        """
        if self.checked:
            self.check(kind, folder.name, folder_digest(folder))

    def take(self, sealed: bytes, /) -> None:
        """Go by a list that another gateway or an engineer hands on.

        Raises:
            IdentityError: it is damaged, of another fleet, another authority signed it, or it is older.
        """
        assert self._authority is not None  # noqa: S101 - who has no keys is handed nothing
        self._look()
        found = unseal(sealed, self._authority, self._fleet)
        with self._looking:
            self._check_new(found)
            self._count(found, sealed)

    def keep(self) -> None:
        """Have the list that counts on the disk, where it is to be kept; blocks."""
        self._look()
        with self._looking:
            if self._kept is None or self._parts.number <= max(self._kept_number, 0):
                return
            try:
                files.write(self._kept, self._sealed, mode=files.PUBLIC)
                self._kept_number = self._parts.number
                self._unkept = ""
            except IdentityError as error:
                self._unkept = f"list {self._parts.number} counts until a restart alone: {error.message}"
                log.warning("the list of parts cannot be kept", file=str(self._kept), reason=error.message)

    def _look(self) -> None:
        """Take up a newer list, where the file has one."""
        if self._file is None or self._authority is None:
            return
        with self._looking:
            if self._kept_number < 0:
                self._kept_number = self._take_kept(self._authority)
            try:
                about = self._file.stat()
                stamp = about.st_ino, about.st_mtime_ns, about.st_size
                if stamp == self._stamp:
                    return
            except OSError:
                stamp = None
            try:
                data = read(self._file)
                found = unseal(data, self._authority, self._fleet)
                if older := found.number < self._parts.number:
                    log.info("a newer list of parts counts", number=self._parts.number, file=str(self._file))
                else:
                    self._check_new(found)
            except IdentityError as error:
                # Where others handed it on, there need be none beside the keys.
                why = "" if stamp is None and self._parts.number else f"{self._file}: {error.message}"
                if why and why != self._why:
                    log.warning("the list of parts is not taken", file=str(self._file), reason=error.message)
                self._why, self._stamp = why, stamp
                return
            self._stamp, self._why = stamp, ""
            if not older:
                self._count(found, data)

    def _check_new(self, found: Parts) -> None:
        """Raise IdentityError where a list is older than the one that counts, or another of the same number."""
        number = self._parts.number
        if found.number < number or (found.number == number and found != self._parts):
            another = "another of its number" if found.number == number else str(number)
            raise IdentityError(
                f"the {_NAME} is number {found.number}, and {another} counts here already", remedy=SIGN_AGAIN
            )

    def _count(self, found: Parts, sealed: bytes) -> None:
        """Go by a list; the lock is held."""
        if found.number == self._parts.number:
            return
        self._parts, self._sealed = found, sealed
        self._refused.clear()
        log.info("the list of parts counts", number=found.number)

    def _take_kept(self, authority: "Ed25519PublicKey") -> int:
        """Go by the list that counted before; returns its number, 0 where there is none."""
        if self._kept is None or not self._kept.exists():
            return 0
        try:
            data = read(self._kept)
            found = unseal(data, authority, self._fleet)
        except IdentityError as error:
            log.warning("the list of parts that was kept is not good", file=str(self._kept), reason=error.message)
            return 0
        self._count(found, data)
        return found.number


ALL = InForce()
"""Development mode: everything is allowed."""


def unnamed(found: Parts, by: InForce) -> list[tuple[Kind, str, str]]:
    """Return the parts of a machine that may not be used: kind, name, digest."""
    return [
        (kind, name, digest)
        for kind in Kind
        for name, digests in found.of(kind).items()
        for digest in digests
        if by.checked and not by.parts.names(kind, name, digest)
    ]


def regular_files(root: Path, *, left_out: Collection[str] = ()) -> Iterator[tuple[Path, str]]:
    """Go through the regular files of a folder, sorted, each with its path below it; links are followed.

    Args:
        root: the folder.
        left_out: folders directly in it that are not gone through; those of `LEFT_OUT` are nowhere.
    """

    def below(folder: Path, path: str, above: tuple[Path, ...]) -> Iterator[tuple[Path, str]]:
        for each in sorted(folder.iterdir()):
            if each.name in LEFT_OUT or (not path and each.name in left_out):
                continue
            if each.is_dir():
                real = each.resolve()
                if real not in above:  # a link to a folder around it would never end
                    yield from below(each, f"{path}{each.name}/", (*above, real))
            elif each.is_file():
                yield each, f"{path}{each.name}"

    return below(root, "", (root.resolve(),))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, with an `x` behind it where its owner may execute it."""
    with path.open("rb") as file:
        suffix = "x" if os.fstat(file.fileno()).st_mode & 0o100 else ""
        return hashlib.file_digest(file, "sha256").hexdigest() + suffix


def listing_digest(digests: Mapping[str, str]) -> str:
    """Return the digest of a folder, of the digests of its files by their paths in it."""
    listing = "".join(f"{path}\0{digest}\n" for path, digest in sorted(digests.items()))
    return hashlib.sha256(os.fsencode(listing)).hexdigest()


def folder_digest(folder: Path) -> str:
    """Return the digest of a folder as it is on the disk; ConfigError where it cannot be read."""
    try:
        return listing_digest({path: file_digest(file) for file, path in regular_files(folder)})
    except OSError as error:
        raise ConfigError(
            f"{error.filename or folder} cannot be read: {error.strerror}", remedy="name a folder that can be read"
        ) from error
