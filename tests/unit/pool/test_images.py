"""Where images are made from, and what their names depend on."""

import os
from pathlib import Path

import pytest

from appliance.errors import NotFoundError, PrerequisiteError
from appliance.pool import engine, images
from appliance.pool.engine import ContainerSpec, PodmanEngine, create_arguments, socket_path
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue, load_catalogue

pytestmark = pytest.mark.anyio

DEB822 = """\
# the distribution
Types: deb deb-src
URIs: http://one.example/debian
 http://two.example/debian
Suites: bookworm bookworm-updates bookworm-backports
Components: main contrib
Signed-By: /usr/share/keyrings/debian-archive-keyring.gpg

Types: deb
URIs: https://vendor.example/apt
Suites: bookworm
Components: main
Signed-By: /etc/apt/keyrings/vendor.gpg

Types: deb
URIs: https://inline.example/apt
Suites: bookworm
Components: main
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----

Types: deb
Enabled: no
URIs: http://off.example/debian
Suites: bookworm
Components: main
"""
ONE_LINE = """\
deb http://one.example/debian bookworm main contrib  # comment
deb-src http://one.example/debian bookworm main
deb [arch=amd64 signed-by=/etc/apt/keyrings/vendor.gpg] https://vendor.example bookworm main
deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] http://s.example/security bookworm-security main
deb https://other.example bookworm stable
# deb http://off.example bookworm main
"""


def test_deb822_sources() -> None:
    """Of a deb822 file only the distribution's own main suites are taken, with their key."""
    key = "[signed-by=/usr/share/keyrings/debian-archive-keyring.gpg]"
    assert images.from_deb822(DEB822, "bookworm") == [
        f"deb {key} http://one.example/debian bookworm main",
        f"deb {key} http://one.example/debian bookworm-updates main",
        f"deb {key} http://two.example/debian bookworm main",
        f"deb {key} http://two.example/debian bookworm-updates main",
    ]


def test_one_line_sources() -> None:
    """The same of a one-line-style file."""
    assert images.from_list(ONE_LINE, "bookworm") == [
        "deb http://one.example/debian bookworm main",
        (
            "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg]"
            " http://s.example/security bookworm-security main"
        ),
    ]


def test_a_host_without_sources(tmp_path: Path) -> None:
    """A machine that is no Debian, or has no source of its own release, hears what to do instead."""
    with pytest.raises(PrerequisiteError, match="os-release"):
        images.host_sources(tmp_path)
    (tmp_path / "etc/apt/sources.list.d").mkdir(parents=True)
    (tmp_path / "etc/os-release").write_text('ID=x\nVERSION_ID="1"\n')
    with pytest.raises(PrerequisiteError, match="base_image"):
        images.host_sources(tmp_path)
    (tmp_path / "etc/os-release").write_text('VERSION_CODENAME="trixie"\n')
    (tmp_path / "etc/apt/sources.list").write_text(ONE_LINE)
    with pytest.raises(PrerequisiteError, match="trixie main"):
        images.host_sources(tmp_path)
    (tmp_path / "etc/os-release").write_text("VERSION_CODENAME=bookworm\n")
    (tmp_path / "etc/apt/sources.list.d/debian.sources").write_text(DEB822)
    assert len(images.host_sources(tmp_path)[1]) == 6


def test_names_depend_on_what_goes_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """An image's tag is the same each time, differs between images, and follows the base image."""
    monkeypatch.delenv("SWIFTBOT_BASE_IMAGE", raising=False)
    catalogue = load_catalogue()
    plain = {name: images.reference(spec, PoolConfig()) for name, spec in catalogue.images.items()}
    assert plain == {name: images.reference(spec, PoolConfig()) for name, spec in catalogue.images.items()}
    assert all(full.startswith(f"localhost/swiftbot/{name}:") for name, full in plain.items())
    on_base = images.reference(catalogue.images["base"], PoolConfig(base_image="registry.example/debian:12"))
    assert on_base != plain["base"]
    monkeypatch.setenv("SWIFTBOT_BASE_IMAGE", "registry.example/debian:12")
    assert images.reference(catalogue.images["base"], PoolConfig()) == on_base


async def test_unknown_image(catalogue: Catalogue) -> None:
    """An image that is not in the catalogue is refused with those that are."""
    with pytest.raises(NotFoundError, match="base, learn, vision"):
        await images.build("nonsense", catalogue)


def test_socket_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The API socket is the configured one, or the user's; where neither can be known, that is said."""
    assert socket_path("unix:///run/x.sock") == Path("/run/x.sock")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert socket_path() == Path("/run/user/7/podman/podman.sock")
    for url in ("tcp://host:1", "podman.sock", "unix://relative"):
        with pytest.raises(PrerequisiteError, match="podman_url"):
            socket_path(url)
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(engine, "RUNTIME_DIRS", tmp_path)
    with pytest.raises(PrerequisiteError, match="XDG_RUNTIME_DIR"):
        PodmanEngine()
    (tmp_path / str(os.getuid())).mkdir()
    assert socket_path() == tmp_path / str(os.getuid()) / "podman" / "podman.sock"


def test_containers_are_hardened() -> None:
    """A container is asked for read-only, without capabilities, privileges or network; limits where they hold."""
    spec = ContainerSpec(
        name="c", image="i", command=("true",), labels={"a": "b"},
        binds={"/host/run": "/run/swiftbot", "/s": "/skills"},
        writable=frozenset({"/host/run"}), volumes={"v": "/volumes/v"}, environment={}, cpu=0.5, memory_mb=64,
        pids=32, tmp_mb=8, limits=True,
    )  # fmt: skip
    arguments = create_arguments(spec)
    assert arguments["read_only"]
    assert arguments["cap_drop"] == ["all"]
    assert arguments["no_new_privileges"]
    assert arguments["network_mode"] == "none"
    assert {m["target"]: m.get("read_only") for m in arguments["mounts"]} == {
        "/run/swiftbot": False,
        "/skills": True,
        "/tmp": None,
    }
    assert arguments["mem_limit"] == arguments["memswap_limit"] == 64 * 2**20
    assert (arguments["pids_limit"], arguments["cpu_quota"]) == (32, 50_000)
    assert "mem_limit" not in create_arguments(
        ContainerSpec(**{f: getattr(spec, f) for f in spec.__struct_fields__} | {"limits": False})
    )
