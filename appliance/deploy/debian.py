"""Debian packages of a bundle: apt installs what a machine lacks from them, without a network.

The bundle's folder `packages` has them with all that they need; its file `wanted` names those that the program itself
needs. The bundle's signature was checked, and each file against it, so apt trusts the folder.
"""

import asyncio
import hashlib
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from appliance.deploy.command import command
from appliance.errors import PayloadError, RefusedError

WANTED = "wanted"
INDEX = "Packages"
INSTALL_S = 900.0


async def missing(folder: Path) -> tuple[str, ...]:
    """Return which of the packages that a bundle's folder of them wants are not installed here."""
    try:
        wanted = (folder / WANTED).read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError) as error:
        raise PayloadError(f"{folder} does not say which packages are wanted", remedy="make bundle") from error
    listed = await command("dpkg-query", "-W", "-f=${db:Status-Status} ${Package}\n", *wanted, codes=(0, 1))
    installed = {
        name for status, _, name in (line.partition(" ") for line in listed.splitlines()) if status == "installed"
    }
    return tuple(name for name in wanted if name not in installed)


async def install(
    folder: Path, names: Sequence[str], *, say: Callable[[str], None], options: Sequence[str] = ()
) -> None:
    """Install packages of a folder, with what they need of it; nothing is removed for them.

    Args:
        folder: with the packages.
        names: which.
        say: hears of it.
        options: more of apt-get's, for another root than this machine's.

    Raises:
        RefusedError: apt cannot install them; with the end of what it said.
    """
    say(f"install {', '.join(names)} from the bundle")
    await asyncio.to_thread(_index, folder)
    with tempfile.TemporaryDirectory(prefix="swiftbot-apt-") as scratch:
        sources = Path(scratch) / "sources.list"
        sources.write_text(f"deb [trusted=yes] file:{folder} ./\n", encoding="utf-8")
        for part in ("lists/partial", "cache/archives/partial"):
            (Path(scratch) / part).mkdir(parents=True)
        apt = [
            "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-q", "-y",
            "-o", f"Dir::Etc::SourceList={sources}", "-o", "Dir::Etc::SourceParts=-",
            "-o", f"Dir::State::Lists={scratch}/lists", "-o", f"Dir::Cache={scratch}/cache",
            "-o", "APT::Sandbox::User=root", "-o", "Acquire::Languages=none", "-o", "DPkg::Lock::Timeout=300",
            "-o", "DPkg::Options::=--force-confold", *options,
        ]  # fmt: skip
        try:
            await command(*apt, "update")
            await command(*apt, "--no-install-recommends", "--no-remove", "install", *names, timeout_s=INSTALL_S)
        except RefusedError as error:
            raise RefusedError(
                f"Debian packages of the bundle: {error.message}",
                remedy=f"apt-get install {' '.join(names)}, with a network or another bundle of this Debian release",
            ) from error


def _index(folder: Path) -> None:
    """Write the index by which apt knows the packages of a folder."""
    paragraphs: list[str] = []
    for file in sorted(folder.glob("*.deb")):
        fields = subprocess.run(["dpkg-deb", "--field", str(file)], capture_output=True, text=True, check=True).stdout
        with file.open("rb") as data:
            digest = hashlib.file_digest(data, "sha256").hexdigest()
        paragraphs.append(f"{fields.strip()}\nFilename: ./{file.name}\nSize: {file.stat().st_size}\nSHA256: {digest}\n")
    (folder / INDEX).write_text("\n".join(paragraphs), encoding="utf-8")
