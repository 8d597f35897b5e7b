"""Debian packages of a bundle: real packages, apt and dpkg, a root of the test's own, no network."""

import subprocess
from pathlib import Path

import pytest

from appliance.deploy import debian
from appliance.errors import PayloadError, RefusedError

pytestmark = pytest.mark.anyio


def package(folder: Path, name: str, *, needs: str = "", version: str = "1") -> None:
    """Make a package with one file."""
    tree = folder.parent / f"{name}-tree"
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "usr/share").mkdir(parents=True)
    (tree / "usr/share" / name).write_text(version)
    fields = f"Package: {name}\nVersion: {version}\nArchitecture: all\nMaintainer: nobody\nDescription: {name}\n"
    (tree / "DEBIAN/control").write_text(fields + (f"Depends: {needs}\n" if needs else ""))
    made = ["dpkg-deb", "--root-owner-group", "--build", str(tree), str(folder / f"{name}_{version}_all.deb")]
    subprocess.run(made, check=True, capture_output=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bundle's folder of packages: one that is wanted, and what it needs."""
    folder = tmp_path / "packages"
    folder.mkdir()
    package(folder, "swb-wanted", needs="swb-needed (>= 2)")
    package(folder, "swb-needed", version="2")
    package(folder, "swb-other")
    (folder / debian.WANTED).write_text("dpkg\nswb-wanted\n")
    return folder


def root(tmp_path: Path) -> tuple[Path, list[str]]:
    """Return a root without packages, and apt's options for it."""
    made = tmp_path / "root"
    (made / "var/lib/dpkg/updates").mkdir(parents=True)
    (made / "var/lib/dpkg/info").mkdir()
    (made / "var/lib/dpkg/status").touch()
    (made / "var/lib/dpkg/triggers").mkdir()
    options = [f"Dir::State::status={made}/var/lib/dpkg/status", f"DPkg::Options::=--root={made}"]
    options += ["DPkg::Options::=--force-not-root", f"DPkg::Options::=--log={made}/log", "Debug::NoLocking=1"]
    options += [f"Dir::State::extended_states={made}/extended_states", f"Dir::Log={made}/apt"]
    return made, [word for option in options for word in ("-o", option)]


async def test_what_is_missing_is_told(folder: Path) -> None:
    """Of those that are wanted; others of the folder are there for whoever needs them."""
    assert await debian.missing(folder) == ("swb-wanted",)
    (folder / debian.WANTED).unlink()
    with pytest.raises(PayloadError, match="does not say which packages are wanted"):
        await debian.missing(folder)


async def test_a_package_and_what_it_needs_are_installed(folder: Path, tmp_path: Path) -> None:
    """Out of the folder alone, by apt."""
    made, options = root(tmp_path)
    said: list[str] = []
    await debian.install(folder, ["swb-wanted"], say=said.append, options=options)
    assert sorted(each.name for each in (made / "usr/share").iterdir()) == ["swb-needed", "swb-wanted"]
    assert said == ["install swb-wanted from the bundle"]


async def test_a_package_whose_needs_are_not_there_is_refused(folder: Path, tmp_path: Path) -> None:
    """Nothing is installed, and the message has what apt says and the remedy."""
    made, options = root(tmp_path)
    (folder / "swb-needed_2_all.deb").unlink()
    with pytest.raises(RefusedError, match="swb-needed") as refused:
        await debian.install(folder, ["swb-wanted"], say=lambda _: None, options=options)
    assert "apt-get install swb-wanted" in refused.value.remedy
    assert not (made / "usr").exists()
