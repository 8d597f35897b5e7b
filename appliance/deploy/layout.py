"""Releases side by side below one prefix, and the rename that switches from one to another.

A release is laid out in a folder of its own, synced, and only then renamed to its name. What systemd and people look
for elsewhere (units, generator, `swiftbot`) are links into `current`. They are made before the switch where a release
brings new ones and removed after it where it has them no more, so that at no moment a unit that was there is gone.

Standard library only: `make install` runs it by the machine's own Python, before there is an environment:

    python3 -m appliance.deploy.layout --root / --tree . [--venv FOLDER]
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from appliance import durable
from appliance.errors import ConfigError, NotFoundError, SwiftbotError

PREFIX = "opt/swiftbot"
LOCAL = "usr/local"
UNIT_FOLDER = "lib/systemd/system"
PLACES = {
    UNIT_FOLDER: "systemd/*.*",
    "lib/systemd/system-generators": "systemd/system-generators/*",
    "lib/sysusers.d": "systemd/sysusers.d/*.conf",
    "lib/tmpfiles.d": "systemd/tmpfiles.d/*.conf",
    "share/man/man1": "man/*.1",
}
"""Folder below LOCAL: which files of a release are linked there."""
UNITS = (".service", ".socket", ".mount", ".timer", ".target")
COMMAND = "usr/local/bin/swiftbot"
KEPT = 3
"""Releases that stay: the one that runs, the one before, and one more."""
EXECUTABLE = ("systemd/system-generators/",)
_NAME = re.compile(r"[0-9A-Za-z][0-9A-Za-z.+_-]{0,99}")


@dataclass(frozen=True)
class Release:
    """What `release.json` says of a release."""

    id: str
    version: str
    made: float
    """Unix seconds."""


class Layout:
    """Releases below `root`, which is / but for packages and tests."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root
        self.prefix = root / PREFIX
        self.releases = self.prefix / "releases"
        self.current = self.prefix / "current"
        self.previous = self.prefix / "previous"

    def running(self) -> str:
        """Return the id of the release that `current` points to; empty where there is none."""
        return self._pointed(self.current)

    def before(self) -> str:
        """Return the id of the release to go back to; empty where there is none."""
        return self._pointed(self.previous)

    def _pointed(self, link: Path) -> str:
        if not link.is_symlink() or not link.is_dir():
            return ""
        return link.readlink().name

    def folder(self, release: str) -> Path:
        """Return the folder of a release; ConfigError for a name that is none."""
        if not _NAME.fullmatch(release):
            raise ConfigError(f"{release!r} is no release", remedy="swiftbot release list")
        return self.releases / release

    def installed(self) -> list[Release]:
        """Return the releases that are whole, the oldest first."""
        found = [about(each) for each in self.releases.glob("[!.]*")] if self.releases.is_dir() else []
        return sorted((each for each in found if each is not None), key=lambda each: each.made)

    def stage(self, release: str) -> Path:
        """Make an empty folder for a release that is being laid out; what a cut-off one has left goes first."""
        self.folder(release)  # a name that may be one
        durable.make_folder(self.releases, mode=0o755)
        durable.clear(self.releases)
        folder = durable.beside(self.releases / release)
        folder.mkdir(mode=0o755)
        return folder

    def finish(self, staged: Path, release: str, version: str) -> str:
        """Give a release that is laid out its name; returns it: one that is there already gets a number behind it."""
        name, number = release, 1
        while self.folder(name).exists():
            number += 1
            name = f"{release}.{number}"
        said = json.dumps(asdict(Release(id=name, version=version, made=time.time())), indent=1)
        (staged / "release.json").write_text(said + "\n", encoding="utf-8")
        durable.sync_tree(staged)
        durable.rename(staged, self.folder(name))
        return name

    def switch(self, release: str, *, before: str | None = None) -> None:
        """Let `current` be a release, and link what systemd looks for; to be repeated after a cut, with no harm.

        Args:
            release: its id.
            before: what `previous` is to be; empty: none; by default the one that runs.

        Raises:
            NotFoundError: there is no such release, or it is not whole.
        """
        if about(self.folder(release)) is None:
            raise NotFoundError(f"there is no whole release {release}", remedy="swiftbot release list")
        durable.clear(self.prefix)
        running = self.running()
        if running and running != release:
            self._link(release)  # new ones lead nowhere until the rename, those that were there stay as they are
            if before is None:
                durable.link(self.previous, f"releases/{running}")
        if before:
            durable.link(self.previous, f"releases/{before}")
        elif before is not None:
            durable.remove(self.previous)
        durable.link(self.current, f"releases/{release}")
        self._link(release)
        self._unlink(release)

    def wanted(self, release: str) -> Iterator[tuple[Path, Path]]:
        """Yield each link that a release needs, and where in `current` it leads to."""
        folder = self.folder(release)
        for place, pattern in PLACES.items():
            for file in sorted(folder.glob(pattern)):
                if file.is_file() and (place != UNIT_FOLDER or file.suffix in UNITS):
                    yield self.root / LOCAL / place / file.name, self.current / file.relative_to(folder)
        if (folder / "venv/bin/swiftbot").exists():
            yield self.root / COMMAND, self.current / "venv/bin/swiftbot"

    def _link(self, release: str) -> None:
        for link, target in self.wanted(release):
            durable.make_folder(link.parent, mode=0o755)
            durable.clear(link.parent, link.name)
            durable.link(link, os.path.relpath(target, link.parent.resolve()))

    def _unlink(self, release: str) -> None:
        wanted = {link for link, _ in self.wanted(release)}
        for link in self.links():
            if link not in wanted:
                durable.remove(link)

    def links(self) -> list[Path]:
        """Return the links into `current` that there are."""
        folders = (*(self.root / LOCAL / place for place in PLACES), (self.root / COMMAND).parent)
        at = self.prefix.resolve() / self.current.name
        return [
            link
            for folder in folders
            for link in (folder.iterdir() if folder.is_dir() else ())
            if link.is_symlink()
            and not link.name.startswith(".")
            and Path(os.path.normpath(folder.resolve() / link.readlink())).is_relative_to(at)
        ]

    def prune(self) -> list[str]:
        """Remove old releases beyond `KEPT`, never the one that runs nor the one before; returns their ids."""
        kept = {self.running(), self.before()}
        others = [each.id for each in self.installed() if each.id not in kept]
        gone = others[: max(0, len(others) + len(kept - {""}) - KEPT)]
        for release in gone:
            away = durable.beside(self.folder(release))  # its name goes first: what has one is whole
            durable.rename(self.folder(release), away)
            shutil.rmtree(away)
        return gone


def about(folder: Path) -> Release | None:
    """Return what a release says of itself; None where it is not whole."""
    try:
        said = json.loads((folder / "release.json").read_text(encoding="utf-8"))
        found = Release(id=said["id"], version=said["version"], made=float(said["made"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if found.id == folder.name else None


def add_files(staged: Path, tree: Path) -> None:
    """Put units, page and licence of a source tree into a release that is being laid out."""
    for file in sorted((tree / "systemd").rglob("*")):
        name = file.relative_to(tree)
        if file.is_file():
            (staged / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, staged / name)
            (staged / name).chmod(0o755 if str(name).startswith(EXECUTABLE) else 0o644)
    (staged / "docs").mkdir(exist_ok=True)
    for name in ("docs/operations.md", "LICENSE"):
        shutil.copyfile(tree / name, staged / name)


def version_of(tree: Path) -> str:
    """Return the version of a source tree; ConfigError where it is none."""
    file = tree / "pyproject.toml"
    try:
        return str(tomllib.loads(file.read_text(encoding="utf-8"))["project"]["version"])
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error.strerror}", remedy="name a source tree") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{file} names no version of a project", remedy="name a source tree") from error


def id_of(tree: Path) -> str:
    """Return the name of the release that a source tree makes: its version, and what tells one build from another.

    Raises:
        ConfigError: it is no source tree.
    """
    version = version_of(tree)
    digest = hashlib.sha256()
    files = [tree / "pyproject.toml", *(tree / "locks").glob("*.txt")]
    files += [*(tree / "systemd").rglob("*"), *(tree / "appliance").rglob("*"), *(tree / "models").rglob("*")]
    for file in sorted(files):
        if file.is_file() and "__pycache__" not in file.parts:
            digest.update(f"{file.relative_to(tree)}\0".encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return f"{version}+{digest.hexdigest()[:8]}"


def configure(root: Path, template: Path, name: str) -> bool:
    """Write the configuration where there is none; returns whether it was written."""
    path = root / "etc/swiftbot/gateway.toml"
    durable.make_folder(path.parent, mode=0o750)
    durable.clear(path.parent, path.name)
    if path.exists():
        return False
    durable.write(path, template.read_text(encoding="utf-8").replace("@ID@", name).encode(), mode=0o644)
    return True


def main(arguments: list[str] | None = None) -> int:
    """Lay a source tree out as a release and switch to it: the part of `make install` that writes files."""
    parser = argparse.ArgumentParser(prog="appliance.deploy.layout", description=main.__doc__)
    parser.add_argument("--root", type=Path, default=Path("/"), help="folder to lay the files out in")
    parser.add_argument("--tree", type=Path, required=True, help="source tree")
    parser.add_argument("--staged", type=Path, help="folder of --stage, with what the caller has put into it")
    parser.add_argument("--stage", action="store_true", help="only make that folder, and print its path")
    parser.add_argument("--prune", action="store_true", help="only remove old releases")
    parser.add_argument("--name", default="gateway", help="id of the gateway in a new configuration")
    options = parser.parse_args(arguments)
    layout = Layout(options.root)
    try:
        if options.prune:
            layout.prune()
            return 0
        release = id_of(options.tree)
        staged = options.staged or layout.stage(release)
        if options.stage:
            print(staged)
            return 0
        add_files(staged, options.tree)
        name = layout.finish(staged, release, version_of(options.tree))
        written = configure(options.root, options.tree / "systemd/gateway.toml", options.name)
        layout.switch(name)
        if options.staged is None:  # otherwise services still run: the caller starts them again, then prunes
            layout.prune()
    except (SwiftbotError, OSError) as error:
        print(f"[install] FAILED: {error}", file=sys.stderr)
        print("    remedy: free some space (df -h), see who owns the folders, then run it again", file=sys.stderr)
        return 1
    at = options.root / "etc/swiftbot/gateway.toml"
    print(f"[install] configuration: {at}, gateway '{options.name}'" if written else f"[install] {at} is kept")
    print(f"[install] release {name}; before it: {layout.before() or 'none'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
