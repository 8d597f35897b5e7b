"""A gateway in one encrypted file, and a gateway made of it on another box: `swiftbot backup`, `swiftbot restore`.

The file is a tar in an encrypted stream (`sealed`). First comes `manifest.json`, then

    files/PATH        configuration, keys, data and models, by their absolute paths
    volumes/NAME      state volumes, as `podman volume export` writes them

Records are copied by SQLite's own backup, consistent also while the gateway runs. What a restored gateway must not do:

- *Grant what it has granted already.* Grants of leases made since the backup are not in it. A restored store has a
  fence far above its own, so that it is silent for as long as the longest lease and grants nothing twice.
- *Take back what was removed.* The store's file keeps the time of the backup, from which the plane sees for how long
  this gateway was away, and whether its copies may be older than tombstones are kept.

A restore reads the whole file before it writes anything: a wrong passphrase, a cut-off or damaged file changes nothing.
"""

import asyncio
import contextlib
import fcntl
import filecmp
import grp
import os
import pwd
import shutil
import sqlite3
import stat
import tarfile
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import BinaryIO, cast

import msgspec
from msgspec import Struct

from appliance import durable
from appliance.config import GatewayConfig, load
from appliance.deploy.command import command
from appliance.deploy.sealed import COST_LOG2, Opener, Sealer
from appliance.errors import ConfigError, ConflictError, PayloadError, RefusedError, SwiftbotError
from appliance.plane.leases import FENCE
from appliance.plane.node import STORE_FILE
from appliance.pool.engine import LABEL_FLEET, LABEL_GATEWAY

MANIFEST = "manifest.json"
LEFT_OUT = ("transfer", "cache", "snapshots")
"""Folders of data_dir that are made again."""
FENCE_JUMP = 2**20
"""More grants than a gateway makes between a backup and its loss."""
LEAST_PASSPHRASE = 12
"""Characters: the file holds private keys, and passphrases can be tried on a copy without limit."""
EXPORT_S = 3600.0
SHARED = frozenset(
    Path(each) for each in ("/", "/etc", "/home", "/opt", "/root", "/srv", "/usr/local/etc", "/var", "/var/lib")
)
"""Folders with more than a gateway in them: a restore replaces the configuration's folder and data_dir whole."""
_SPARE = ("-wal", "-shm", ".lock")
"""What lies beside the store's file, and belongs to one that is open."""


class VolumeFound(Struct, frozen=True):
    """A volume as Podman lists it; other fields are ignored."""

    name: str = msgspec.field(name="Name")
    labels: dict[str, str] | None = msgspec.field(name="Labels", default=None)


class Manifest(Struct, frozen=True, kw_only=True):
    """What a backup says of itself. Fields that a later version adds are ignored."""

    format: int = 1
    gateway: str
    fleet: str
    version: str
    made: float
    """Unix seconds."""
    config: str
    """Absolute path of the configuration; its whole folder is in it."""
    data_dir: str
    volumes: dict[str, dict[str, str]]
    """Labels of each state volume, by its name."""


class Contents(Struct, frozen=True, kw_only=True):
    """What was written, or read."""

    file: str
    gateway: str
    fleet: str
    version: str
    made: float
    """Unix seconds."""
    files: int
    bytes: int
    """Of what is in it."""
    volumes: tuple[str, ...]
    aside: tuple[str, ...] = ()
    """Where what a restore has replaced was moved."""


def check_passphrase(passphrase: str) -> None:
    """Raise ConfigError for one that is too short to protect keys."""
    if len(passphrase) < LEAST_PASSPHRASE:
        raise ConfigError(
            f"the passphrase has {len(passphrase)} characters",
            remedy=f"take at least {LEAST_PASSPHRASE}; the file has keys",
        )


# --- backup ----------------------------------------------------------------------------------------------------------


async def back_up(
    file: Path,
    config_file: Path,
    passphrase: str,
    *,
    version: str,
    volumes: bool = True,
    say: Callable[[str], None],
    cost_log2: int = COST_LOG2,
) -> Contents:
    """Write a backup of a gateway.

    Args:
        file: to write; not there yet.
        config_file: the gateway's.
        passphrase: protects it.
        version: of the program.
        volumes: also its state volumes, which Podman gives.
        say: hears of each part.
        cost_log2: of scrypt; less only in tests.

    Raises:
        ConfigError: the configuration cannot be read, the passphrase is too short, the file is there already.
        RefusedError: its folders are not the gateway's alone, something of it cannot be read, or Podman does not give a
            volume.
    """
    check_passphrase(passphrase)
    config = load(config_file)
    config_file, data_dir = _places(file, config_file, config)
    found = await _volumes(config) if volumes else {}
    manifest = Manifest(
        gateway=config.id,
        fleet=config.fleet,
        version=version,
        made=time.time(),
        config=str(config_file),
        data_dir=str(data_dir),
        volumes=found,
    )
    temporary = durable.beside(file)
    try:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as out, tempfile.TemporaryDirectory(dir=file.parent, prefix=".backup-") as spool:
            sealer = Sealer(out, passphrase, cost_log2=cost_log2)
            with tarfile.open(fileobj=cast("BinaryIO", sealer), mode="w|", format=tarfile.PAX_FORMAT) as tar:
                writing = _Writing(tar, Path(spool))
                writing.text(MANIFEST, msgspec.json.encode(manifest))
                say("configuration, keys, records, models")
                await asyncio.to_thread(writing.files, config_file, config, data_dir)
                for name in found:
                    say(f"volume {name}")
                    exported = Path(spool) / "volume"
                    await command("podman", "volume", "export", name, as_user=True, timeout_s=EXPORT_S, out=exported)
                    writing.add(exported, f"volumes/{name}")
            sealer.close()
        durable.sync_file(temporary)
        _check_free(file)  # another backup may have written it meanwhile
        durable.rename(temporary, file)
    except OSError as error:
        raise RefusedError(
            f"{error.filename or file}: {error.strerror}", remedy="run it as root, on a disk with room for all of it"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return _contents(file, manifest, writing.count, writing.bytes)


def _places(file: Path, config_file: Path, config: GatewayConfig) -> tuple[Path, Path]:
    _check_free(file)
    config_file, data_dir = config_file.resolve(), Path(config.data_dir).expanduser().resolve()
    check_folders(config_file.parent, data_dir)
    return config_file, data_dir


def _check_free(file: Path) -> None:
    if file.exists():
        raise ConfigError(f"{file} exists", remedy="name another file")


def check_folders(*folders: Path) -> None:
    """Raise RefusedError for a folder that holds more than a gateway: a restore would move all of it aside."""
    for folder in folders:
        if folder in SHARED or folder.parent == Path("/home"):
            raise RefusedError(
                f"{folder} is not the gateway's alone, and a restore replaces it whole",
                remedy="move configuration and data to folders of their own, such as /etc/swiftbot",
            )


class _Writing:
    """Adds members to a tar."""

    def __init__(self, tar: tarfile.TarFile, spool: Path) -> None:
        self._tar = tar
        self._spool = spool
        self._added = set[Path]()
        self.count = 0
        self.bytes = 0

    def text(self, name: str, data: bytes) -> None:
        """Add a text."""
        path = self._spool / "text"
        path.write_bytes(data)
        self.add(path, name)

    def add(self, path: Path, name: str) -> None:
        """Add a file, link or folder under a name; nothing where the gateway has just removed it."""
        try:
            entry = self._tar.gettarinfo(path, name)
        except FileNotFoundError:
            return
        if entry.islnk():  # another name of a file that is in already: a file of its own, as it is after a restore
            entry.type, entry.linkname, entry.size = tarfile.REGTYPE, "", path.lstat().st_size
        if entry.isreg():
            with path.open("rb") as data:
                self._tar.addfile(entry, data)
            self.count += 1
            self.bytes += entry.size
        elif entry.isdir() or entry.issym():
            self._tar.addfile(entry)

    def files(self, config_file: Path, config: GatewayConfig, data_dir: Path) -> None:
        """Add all that belongs to a gateway and lies in files."""
        self._tree(config_file.parent, skip=())
        self._tree(data_dir, skip=tuple(data_dir / each for each in LEFT_OUT))
        for path in named_in(config):
            self._tree(path.resolve(), skip=())

    def _tree(self, path: Path, *, skip: tuple[Path, ...]) -> None:
        if path in skip or path in self._added or not (path.exists() or path.is_symlink()):
            return
        self._added.add(path)
        if path.name == STORE_FILE:
            copy = self._spool / STORE_FILE
            copy_store(path, copy)
            shutil.copystat(path, copy)
            self.add(copy, f"files{path}")
            copy.unlink()
            return
        if path.name.startswith(STORE_FILE) and path.name.endswith(_SPARE):
            return
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode) or stat.S_ISLNK(mode) or stat.S_ISDIR(mode):
            self.add(path, f"files{path}")
        if stat.S_ISDIR(mode):
            for each in sorted(path.iterdir()):
                self._tree(each, skip=skip)


def named_in(config: GatewayConfig) -> Iterator[Path]:
    """Yield what a configuration names of its own: keys, rosters, site, skills, a local model."""
    named = [
        config.plane.keys,
        config.plane.roster,
        config.plane.parts,
        config.record.keys,
        config.site,
        *config.skills,
    ]
    named += [config.llm.local_model, config.llm.upstream_key_file, config.alerts.urls_file]
    named += [link.signing for link in config.robots.mavlink]
    for each in named:
        if each and "/" in each and not each.startswith("credential:"):
            yield Path(each).expanduser()


def copy_store(source: Path, target: Path) -> None:
    """Copy a gateway's records while it may write; RefusedError where SQLite cannot."""
    try:
        with (
            contextlib.closing(sqlite3.connect(f"file:{source}?mode=ro", uri=True)) as old,
            contextlib.closing(sqlite3.connect(target)) as new,
        ):
            old.backup(new)
    except sqlite3.Error as error:
        raise RefusedError(f"{source} cannot be copied: {error}", remedy="swiftbot doctor; a full disk?") from error


async def _volumes(config: GatewayConfig) -> dict[str, dict[str, str]]:
    """Return the labels of this gateway's state volumes, by name. Podman 4.3 lists those with any of several labels."""
    try:
        text = await command("podman", "volume", "ls", "--format", "json", as_user=True)
        found = msgspec.json.decode(text or "[]", type=list[VolumeFound])
    except (SwiftbotError, msgspec.MsgspecError) as error:
        raise RefusedError(
            f"Podman does not list volumes: {error}", remedy="--without-volumes leaves them out"
        ) from error
    ours = {LABEL_FLEET: config.fleet, LABEL_GATEWAY: config.id}.items()
    return {each.name: each.labels for each in found if each.labels and ours <= each.labels.items()}


# --- restore ---------------------------------------------------------------------------------------------------------


async def restore(
    file: Path,
    passphrase: str,
    *,
    root: Path = Path("/"),
    replace: bool = False,
    volumes: bool = True,
    say: Callable[[str], None],
) -> Contents:
    """Make this box the gateway of a backup.

    What is there is moved aside, beside its place. Killed or without power in between, it is simply done again.

    Args:
        file: backup.
        passphrase: its own.
        root: where paths begin; not / in tests.
        replace: replace a gateway that is here already.
        volumes: also the state volumes.
        say: hears of each part.

    Raises:
        IdentityError: the passphrase is another.
        PayloadError: the file is no backup, cut off or damaged.
        ConflictError: a gateway runs here, or its records are here and `replace` was not given.
        RefusedError: its folders are not the gateway's alone, or the disk has no room.
    """
    say("reading all of it, before anything is written")
    manifest, count, size = await asyncio.to_thread(_read_through, file, passphrase)
    check_folders(Path(manifest.data_dir), Path(manifest.config).parent)
    data_dir, config_dir = _below(root, manifest.data_dir), _below(root, manifest.config).parent
    with _stopped(data_dir / STORE_FILE):
        if (data_dir / STORE_FILE).exists() and not replace:
            raise ConflictError(
                f"{data_dir} has the records of a gateway",
                remedy="--replace moves them aside; or restore on another box",
            )
        here = await _volumes_here(manifest.volumes, replace=replace) if volumes and manifest.volumes else []
        free = shutil.disk_usage(_there(data_dir)).free
        if free < size:
            raise RefusedError(
                f"{_there(data_dir)} has {free >> 20:,} MiB free, and the backup needs {size >> 20:,} MiB",
                remedy="free some space (df -h)",
            )
        say(f"gateway {manifest.gateway} of fleet {manifest.fleet}, {time.ctime(manifest.made)}: {count} files")
        reading = _Restoring(file, passphrase, root=root, folders=(config_dir, data_dir))
        # Beside the folder and not in it: that is moved aside.
        with tempfile.TemporaryDirectory(dir=_there(reading.folder_of(data_dir).parent), prefix=".restore-") as spool:
            exported = await asyncio.to_thread(reading.take_out, Path(spool), volumes=volumes)
            _settle_store(reading.staged(data_dir) / STORE_FILE, manifest.made)
            if here:  # only now: what is in them is lost with them
                await command("podman", "volume", "rm", *here, as_user=True)
            if volumes:
                for name, path in exported.items():
                    say(f"volume {name}")
                    await _restore_volume(name, manifest.volumes.get(name, {}), path)
            aside = await asyncio.to_thread(reading.put_in_place)
    return msgspec.structs.replace(_contents(file, manifest, count, size), aside=aside)


def _below(root: Path, path: str) -> Path:
    if not path.startswith("/") or ".." in Path(path).parts:
        raise PayloadError(f"the backup names {path[:80]!r}", remedy="it was not written by `swiftbot backup`")
    return root / path.lstrip("/")


def _there(path: Path) -> Path:
    """Return the folder itself, or the one above that is there."""
    while not path.is_dir():
        path = path.parent
    return path


@contextlib.contextmanager
def _stopped(store: Path) -> Generator[None]:
    """Keep a gateway from starting on these records meanwhile; ConflictError where one runs."""
    if not store.parent.is_dir():
        yield
        return
    handle = os.open(f"{store}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConflictError(
                f"a gateway runs on {store.parent}", remedy="systemctl stop swiftbot-gateway swiftbot-recorder"
            ) from None
        yield
    finally:
        os.close(handle)


def _entries(file: Path, passphrase: str) -> Iterator[tuple[tarfile.TarInfo, tarfile.TarFile]]:
    try:
        with file.open("rb") as source:
            opener = Opener(source, passphrase, name=str(file))
            with tarfile.open(fileobj=cast("BinaryIO", opener), mode="r|") as tar:
                for entry in tar:
                    yield entry, tar
            while opener.read(2**20):  # to the last part: a file that was cut off behind the tar's end is damaged too
                pass
    except tarfile.TarError as error:
        raise PayloadError(f"{file} holds no backup: {error}", remedy="`swiftbot backup` writes one") from error
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error.strerror}", remedy="name a backup's file") from error


def _read_through(file: Path, passphrase: str) -> tuple[Manifest, int, int]:
    """Check every part of a backup; returns its manifest, how many files it has, and their bytes."""
    manifest: Manifest | None = None
    count = size = 0
    for entry, tar in _entries(file, passphrase):
        if manifest is None:
            manifest = _manifest(file, entry, tar)
        elif not entry.name.startswith(("files/", "volumes/")) or ".." in Path(entry.name).parts:
            raise PayloadError(f"{file} names {entry.name[:80]!r}", remedy="it was not written by `swiftbot backup`")
        count += entry.isreg()
        size += entry.size
    if manifest is None:
        raise PayloadError(f"{file} is empty", remedy="`swiftbot backup` writes one")
    return manifest, count, size


def _manifest(file: Path, entry: tarfile.TarInfo, tar: tarfile.TarFile) -> Manifest:
    data = tar.extractfile(entry) if entry.name == MANIFEST and entry.size < 2**24 else None
    try:
        found = msgspec.json.decode(data.read() if data is not None else b"", type=Manifest)
    except msgspec.MsgspecError as error:
        raise PayloadError(f"{file} has no manifest: {error}", remedy="`swiftbot backup` writes one") from error
    if found.format != 1:
        raise PayloadError(f"{file} is of format {found.format}", remedy="restore it with the version that wrote it")
    return found


class _Restoring:
    """Takes files out beside their places, then puts all in place.

    Folders of the gateway are replaced whole; single files outside of them one by one.
    """

    def __init__(self, file: Path, passphrase: str, *, root: Path, folders: tuple[Path, ...]) -> None:
        self._file = file
        self._passphrase = passphrase
        self._root = root
        # A folder in another one goes where that goes.
        self._folders = tuple(
            dict.fromkeys(each for each in folders if not any(other in each.parents for other in folders))
        )
        self._single: list[tuple[Path, Path]] = []

    def folder_of(self, place: Path) -> Path:
        """Return the folder that is replaced whole and has a place in it; the place itself where there is none."""
        return next((each for each in self._folders if place.is_relative_to(each)), place)

    def staged(self, place: Path) -> Path:
        """Where what is to be at a place in one of the folders is until then."""
        folder = self.folder_of(place)
        return folder.with_name(f".{folder.name}.restoring") / place.relative_to(folder)

    def take_out(self, spool: Path, *, volumes: bool) -> dict[str, Path]:
        """Write all beside its place; returns the exports of volumes by their names."""
        exports: dict[str, Path] = {}
        for folder in self._folders:
            shutil.rmtree(self.staged(folder), ignore_errors=True)
            self.staged(folder).mkdir(parents=True, mode=0o700)
        for entry, tar in _entries(self._file, self._passphrase):
            if entry.name.startswith("volumes/"):
                if volumes:
                    exports[entry.name.partition("/")[2]] = path = spool / str(len(exports))
                    _write(tar, entry, path)
            elif entry.name.startswith("files/"):
                self._take(tar, entry, _below(self._root, entry.name.removeprefix("files")))
        for folder in self._folders:
            durable.sync_tree(self.staged(folder))
        return exports

    def _take(self, tar: tarfile.TarFile, entry: tarfile.TarInfo, place: Path) -> None:
        if self.folder_of(place) in self._folders:
            _write(tar, entry, self.staged(place))
            return
        if not entry.isdir():
            place.parent.mkdir(parents=True, exist_ok=True)
            staged = place.with_name(f".{place.name}.restoring")
            staged.unlink(missing_ok=True)
            _write(tar, entry, staged)
            self._single.append((staged, place))

    def put_in_place(self) -> tuple[str, ...]:
        """Move aside what is there, and what was taken out to where it belongs; returns what was moved where."""
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        aside: list[str] = []
        for staged, place in self._single:
            if not staged.is_symlink():
                durable.sync_file(staged)
            if place.is_symlink() or (place.exists() and not _alike(staged, place)):
                old = place.with_name(f"{place.name}.before-restore-{stamp}")
                durable.rename(place, old)
                aside.append(str(old))
            durable.rename(staged, place)
        for folder in self._folders:
            if folder.exists():
                old = folder.with_name(f"{folder.name}.before-restore-{stamp}")
                durable.rename(folder, old)
                aside.append(str(old))
            durable.rename(self.staged(folder), folder)
        return tuple(aside)


def _alike(one: Path, other: Path) -> bool:
    return not one.is_symlink() and other.is_file() and filecmp.cmp(one, other, shallow=False)


def _write(tar: tarfile.TarFile, entry: tarfile.TarInfo, path: Path) -> None:
    """Write a member, with its mode, time and, as root, its owner by name; closed to others until it is whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if entry.issym():
        path.symlink_to(entry.linkname)
    elif entry.isdir():
        path.mkdir(exist_ok=True)
    elif (data := tar.extractfile(entry)) is not None:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
            shutil.copyfileobj(data, out, 2**20)
    else:
        return
    if os.getuid() == 0:
        with contextlib.suppress(LookupError):  # no such user here
            user = pwd.getpwnam(entry.uname).pw_uid if entry.uname else entry.uid
            group = grp.getgrnam(entry.gname).gr_gid if entry.gname else entry.gid
            os.chown(path, user, group, follow_symlinks=False)  # the link, not what it leads to
    if not entry.issym():
        path.chmod(stat.S_IMODE(entry.mode))
        os.utime(path, (entry.mtime, entry.mtime))


def _settle_store(store: Path, made: float) -> None:
    """Keep a restored gateway from granting what it has granted since; its file keeps the time of the backup."""
    if not store.exists():
        return
    with contextlib.closing(sqlite3.connect(store)) as db:
        row = db.execute("SELECT value FROM kept WHERE key = ?", (FENCE,)).fetchone()
        fence = (int(row[0]) if row else 0) + FENCE_JUMP
        db.execute("INSERT OR REPLACE INTO kept VALUES (?, ?)", (FENCE, str(fence).encode()))
        db.commit()
    durable.sync_file(store)
    os.utime(store, (made, made))


async def _volumes_here(wanted: dict[str, dict[str, str]], *, replace: bool) -> list[str]:
    """Return the volumes that are here and are to be replaced; ConflictError where they are not to be."""
    present = (await command("podman", "volume", "ls", "--quiet", as_user=True)).split()
    here = [name for name in wanted if name in present]
    if here and not replace:
        raise ConflictError(f"volumes are here already: {', '.join(here)}", remedy="--replace replaces them")
    return here


async def _restore_volume(name: str, labels: dict[str, str], export: Path) -> None:
    options = [word for each in labels.items() for word in ("--label", "=".join(each))]
    await command("podman", "volume", "create", *options, name, as_user=True)
    await command("podman", "volume", "import", name, "-", as_user=True, timeout_s=EXPORT_S, data=export)


def _contents(file: Path, manifest: Manifest, count: int, size: int) -> Contents:
    return Contents(
        file=str(file),
        gateway=manifest.gateway,
        fleet=manifest.fleet,
        version=manifest.version,
        made=manifest.made,
        files=count,
        bytes=size,
        volumes=tuple(manifest.volumes),
    )
