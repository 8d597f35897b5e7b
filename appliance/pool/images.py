"""Builds and lists the images that skills run in.

It exists because a gateway often has no image registry in reach: the root filesystem is made of the host's own
Debian packages by `mmdebstrap` in a user namespace (no root needed) and loaded through the Podman API; the same
packages make the same image on every machine (`oci`). Where a base image is configured, the image's Containerfile is
built on it instead. Python packages that its `requirements.txt` pins are laid over either from a folder of wheels
(`wheels`). An image's tag is a hash of its recipe, so building again is a look at the list.

Which Debian packages the host trusts is read from its own apt sources (`host_sources`), cut down to the distribution's
main suites: images are made of exactly what the machine itself would install, with the machine's mirrors and keys, and
no mirror's name is ever written in this product.
"""

import asyncio
import hashlib
import os
import re
import shlex
import shutil
import tempfile
import time
import tomllib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import structlog
from msgspec import Struct

from appliance.errors import NotFoundError, PrerequisiteError
from appliance.model.transfer_api import ImageLayout
from appliance.pool import oci, wheels
from appliance.pool.engine import PodmanEngine
from appliance.pool.settings import PoolConfig
from appliance.pool.wheels import Python
from appliance.skills.catalogue import SKILLS, WHEELHOUSE, Catalogue, ImageSpec, image_reference
from appliance.skills.requirements import FILE, Requirement, read_requirements

_ONE_LINE = re.compile(r"^deb\s+(?:\[(?P<options>[^\]]*)\]\s+)?(?P<uri>\S+)\s+(?P<suite>\S+)\s+(?P<components>.+)$")


def codename(os_release: str) -> str:
    """Return VERSION_CODENAME of an os-release file's text; PrerequisiteError when it names none."""
    found = re.search(r'^VERSION_CODENAME="?([a-z]+)"?$', os_release, re.MULTILINE)
    if not found:
        raise PrerequisiteError("this is no Debian release with a code name", remedy="set pool.base_image instead")
    return found.group(1)


def _ours(suite: str, release: str) -> bool:
    return suite in {release, f"{release}-updates", f"{release}-security", f"{release}/updates"}


def _trusted(signed_by: str) -> bool:
    """Whether a repository is the distribution's own: signed by its archive key, or by apt's common ring."""
    name = Path(signed_by.split(",", maxsplit=1)[0].strip()).name
    return not name or name.startswith(("debian-archive", "ubuntu-archive"))


def _line(uri: str, suite: str, signed_by: str) -> str:
    options = f"[signed-by={signed_by}] " if signed_by else ""
    return f"deb {options}{uri} {suite} main"


def from_list(text: str, release: str) -> list[str]:
    """Return the release's main entries of a one-line-style file."""
    lines: list[str] = []
    for raw in text.splitlines():
        found = _ONE_LINE.match(raw.split("#", 1)[0].strip())
        if found is None or "main" not in found["components"].split() or not _ours(found["suite"], release):
            continue
        signed = re.search(r"signed-by=(\S+)", found["options"] or "", re.IGNORECASE)
        if _trusted(signed.group(1) if signed else ""):
            lines.append(_line(found["uri"], found["suite"], signed.group(1) if signed else ""))
    return lines


def from_deb822(text: str, release: str) -> list[str]:
    """Return the release's main entries of a deb822-style file, as one-line entries."""
    lines: list[str] = []
    for stanza in re.split(r"\n\s*\n", "\n".join(line for line in text.splitlines() if not line.startswith("#"))):
        fields: dict[str, str] = {}
        key = ""
        for line in stanza.splitlines():
            if line[:1].isspace() and key:
                fields[key] += "\n" + line.strip()
            elif ":" in line:
                key, _, value = line.partition(":")
                key = key.strip().lower()
                fields[key] = value.strip()
        signed_by = fields.get("signed-by", "")
        if (
            "deb" not in fields.get("types", "").split()
            or fields.get("enabled", "yes").lower() in ("no", "false", "0")
            or "main" not in fields.get("components", "").split()
            or "\n" in signed_by  # a key written out in the file is never the archive's own
            or not _trusted(signed_by)
        ):
            continue
        lines += [
            _line(uri, suite, signed_by)
            for uri in fields.get("uris", "").split()
            for suite in fields.get("suites", "").split()
            if _ours(suite, release)
        ]
    return lines


def host_sources(root: Path = Path("/")) -> tuple[str, list[str]]:
    """Return the host's code name and its own main apt entries, in one-line form.

    Raises:
        PrerequisiteError: it is no Debian, or has no such entry.
    """
    try:
        release = codename((root / "etc/os-release").read_text(encoding="utf-8"))
    except OSError as error:
        raise PrerequisiteError(f"/etc/os-release cannot be read: {error}") from error
    apt = root / "etc/apt"
    lines: list[str] = []
    single = apt / "sources.list"
    files = ([single] if single.is_file() else []) + sorted((apt / "sources.list.d").glob("*"))
    for file in files:
        if file.suffix == ".list":
            lines += from_list(file.read_text(encoding="utf-8"), release)
        elif file.suffix == ".sources":
            lines += from_deb822(file.read_text(encoding="utf-8"), release)
    if not lines:
        raise PrerequisiteError(
            f"no apt source of {release} main on this machine, so no image can be made of its packages",
            remedy=f"add a source of {release} main to /etc/apt, or set pool.base_image to an image of a registry",
        )
    return release, list(dict.fromkeys(lines))


log = structlog.get_logger(__name__)

RECIPE = SKILLS / "images" / "recipe.toml"
BUILD_TIMEOUT_S = 900.0
"""A slow mirror needs minutes; beyond this it hangs."""
Progress = Callable[[str], None]


class ImageState(Struct, frozen=True, kw_only=True):
    """An image of the catalogue as it stands on this machine."""

    name: str
    reference: str
    present: bool
    size_bytes: int = 0
    gateways: tuple[str, ...] = ()
    """Gateways of a fleet that have it, where the fleet was asked."""


def base_image(config: PoolConfig) -> str:
    """Return the registry's base image: $SWIFTBOT_BASE_IMAGE before the configuration; empty for none."""
    return os.environ.get("SWIFTBOT_BASE_IMAGE", "") or config.base_image


def reference(spec: ImageSpec, config: PoolConfig) -> str:
    """Return the full name of an image: `localhost/swiftbot/<name>:<hash of what goes into it>`."""
    name = image_reference(spec.name, folder=spec.folder)
    base = base_image(config)
    if not base:
        return name
    repository, _, tag = name.rpartition(":")
    return f"{repository}:{hashlib.sha256(f'{tag} on {base}'.encode()).hexdigest()[:12]}"


def build_command(spec: ImageSpec) -> str:
    """Return the command that builds an image, with the folder of skills that it is in unless it is built in."""
    root = spec.folder.parent.parent
    named = f" {spec.name}" if spec.on_demand else ""
    return f"swiftbot images build{named}" if root == SKILLS else f"swiftbot images build {spec.name} --skills {root}"


def _spec(name: str, catalogue: Catalogue) -> ImageSpec:
    spec = catalogue.images.get(name)
    if spec is None:
        raise NotFoundError(f"no image {name!r}", remedy=f"known: {', '.join(sorted(catalogue.images))}")
    return spec


async def _sizes(engine: PodmanEngine) -> dict[str, int]:
    return {tag: each.size_bytes for each in await engine.images() for tag in each.tags}


async def list_images(catalogue: Catalogue, config: PoolConfig | None = None) -> list[ImageState]:
    """Return every image of the catalogue and whether it is there.

    Raises:
        UnreachableError: Podman does not answer.
    """
    config = config or PoolConfig()
    engine = PodmanEngine(config.podman_url, threads=1)
    try:
        sizes = await _sizes(engine)
    finally:
        engine.close()
    return [
        ImageState(name=name, reference=full, present=full in sizes, size_bytes=sizes.get(full, 0))
        for name, spec in catalogue.images.items()
        for full in (reference(spec, config),)
    ]


def _ignore(line: str) -> None:
    del line


async def build(
    name: str,
    catalogue: Catalogue,
    config: PoolConfig | None = None,
    *,
    progress: Progress = _ignore,
    force: bool = False,
    wheelhouses: Sequence[Path] = (),
) -> str:
    """Build one image unless it is there; returns its reference.

    Args:
        name: image of the catalogue.
        catalogue: where its packages are listed.
        config: names Podman's socket and, perhaps, a base image.
        progress: called with each line of the build's log.
        force: build it again even so.
        wheelhouses: folders of wheels for its `requirements.txt`, looked at before `wheelhouse/` beside that file.

    Raises:
        NotFoundError: no such image.
        ConfigError: its `requirements.txt` is wrong, or a wheelhouse cannot be read.
        PrerequisiteError: it cannot be built; the message ends with the end of the log. Or a wheel is missing, or
            is none of those that are pinned.
        UnreachableError: Podman does not answer.
    """
    config = config or PoolConfig()
    spec = _spec(name, catalogue)
    full = reference(spec, config)
    begun = time.monotonic()
    engine = PodmanEngine(config.podman_url, threads=1)
    try:
        if full in await _sizes(engine) and not force:
            progress(f"{full} is there")
            return full
        progress(f"building {full}")
        needed = await asyncio.to_thread(_needed, spec, wheelhouses)
        base = base_image(config)
        if base:
            await _from_registry(spec, full, base, needed, progress)
        else:
            await _from_packages(spec, full, engine, needed, progress)
        sizes = await _sizes(engine)
    finally:
        engine.close()
    if full not in sizes:
        raise PrerequisiteError(f"{full} was built but is not there", remedy="see what removes images of this user")
    progress(f"{full}: {sizes[full] / 2**20:.0f} MiB in {time.monotonic() - begun:.0f} s")
    return full


class _Needed(Struct, frozen=True):
    """The Python packages of an image, and where their wheels are."""

    file: Path
    requirements: tuple[Requirement, ...] = ()
    folders: tuple[Path, ...] = ()

    def unpack(self, root: Path, python: Python, progress: Progress) -> None:
        """Unpack them into a folder that is laid over the image's root filesystem; see `wheels.unpack`."""
        wheels.unpack(self.requirements, self.folders, root, python, file=self.file, progress=progress)


def _needed(spec: ImageSpec, wheelhouses: Sequence[Path]) -> _Needed:
    """Return the Python packages of an image, checked as far as can be before there is a Python to check for."""
    file, beside = spec.folder / FILE, spec.folder / WHEELHOUSE
    if not file.is_file():
        return _Needed(file)
    folders = (*wheelhouses, *((beside,) if beside.is_dir() else ()))
    requirements = read_requirements(file)
    wheels.check(requirements, folders, file=file)
    return _Needed(file, requirements, folders)


async def _run(
    what: str, command: Sequence[str], progress: Progress, *, remedy: str, variables: Mapping[str, str] | None = None
) -> None:
    """Run a build step; PrerequisiteError with the log's tail when it fails."""
    if shutil.which(command[0]) is None:
        raise PrerequisiteError(f"{what}: {command[0]} is not installed", remedy=f"apt-get install {command[0]}")
    tail: deque[str] = deque(maxlen=15)
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env=os.environ | (variables or {}),
    )

    async def follow() -> int:
        assert process.stdout is not None  # noqa: S101 - it was asked for above
        async for raw in process.stdout:
            line = raw.decode("utf-8", "replace").rstrip()[:500]
            tail.append(line)
            progress(line)
        return await process.wait()

    try:
        async with asyncio.timeout(BUILD_TIMEOUT_S):
            status = await follow()
    except (TimeoutError, asyncio.CancelledError) as error:
        process.terminate()
        try:
            async with asyncio.timeout(10.0):
                await process.wait()
        except TimeoutError:
            process.kill()
        if isinstance(error, asyncio.CancelledError):
            raise
        raise PrerequisiteError(f"{what} did not end within {BUILD_TIMEOUT_S:.0f} s", remedy=remedy) from error
    if status:
        text = "\n".join(tail)
        raise PrerequisiteError(f"{what} failed with status {status}; the end of its log:\n{text}\n", remedy=remedy)


async def _from_registry(spec: ImageSpec, full: str, base: str, needed: _Needed, progress: Progress) -> None:
    file = spec.folder / "Containerfile"
    if not file.is_file():
        raise PrerequisiteError(
            f"{file} is missing, so {spec.name} cannot be built on {base}", remedy="write it with ARG BASE"
        )
    # What has not all that it should have gets another name, or it would pass for the image.
    built = f"{full}-without-wheels" if needed.requirements else full
    arguments = ("--build-arg", f"BASE={base}", "--build-arg", f"PACKAGES={' '.join(spec.packages)}")
    command = ("podman", "build", "--tag", built, *arguments, "--file", str(file), str(spec.folder))
    remedy = f"check that {base} can be pulled and that its packages include {', '.join(spec.packages)}"
    await _run(f"building {spec.name} on {base}", command, progress, remedy=remedy)
    if needed.requirements:
        await _lay_over(built, full, needed, progress)


async def _lay_over(built: str, full: str, needed: _Needed, progress: Progress) -> None:
    """Make an image of one that was built and of what its wheels hold."""
    python = await _python_in(built)
    with tempfile.TemporaryDirectory(prefix="swiftbot-image-") as folder:
        root = Path(folder) / "root"
        root.mkdir()
        await asyncio.to_thread(needed.unpack, root, python, progress)
        file = Path(folder) / "Containerfile"
        file.write_text(f"FROM {built}\nCOPY root/ /\n", encoding="utf-8")
        command = ("podman", "build", "--pull=never", "--tag", full, "--file", str(file), folder)
        await _run(f"adding wheels to {full}", command, progress, remedy="see what the log says")
    await _run(f"forgetting {built}", ("podman", "untag", built), _ignore, remedy=f"podman untag {built}")


async def _python_in(built: str) -> Python:
    """Ask an image's own Python for its version and where it looks for packages."""
    program = "import sys, sysconfig; print('python', sys.version_info[1], sysconfig.get_path('purelib'))"
    lines: list[str] = []
    command = ("podman", "run", "--rm", "--network=none", "--pull=never", "--entrypoint=python3", built, "-c", program)
    remedy = "its Containerfile must install python3"
    await _run(f"asking {built} for its Python", command, lines.append, remedy=remedy)
    for line in lines:
        match line.split():
            case ["python", minor, site] if minor.isdecimal():
                return Python(minor=int(minor), site=site)
            case _:
                continue
    raise PrerequisiteError(f"{built} does not tell its Python: {lines[-1:]}", remedy=remedy)


async def _from_packages(spec: ImageSpec, full: str, engine: PodmanEngine, needed: _Needed, progress: Progress) -> None:
    recipe = tomllib.loads(RECIPE.read_text(encoding="utf-8"))
    release, sources = await asyncio.to_thread(host_sources)
    with tempfile.TemporaryDirectory(prefix="swiftbot-image-") as folder:
        list_file = Path(folder) / "sources.list"
        list_file.write_text("\n".join(sources) + "\n", encoding="utf-8")
        archive, lists = Path(folder) / "root.tar", Path(folder) / "lists"
        lists.mkdir()
        command = [
            "mmdebstrap",
            "--mode=unshare",
            "--format=tar",
            f"--variant={recipe['variant']}",
            f"--include={','.join(spec.packages)}",
            *(f"--dpkgopt=path-exclude={pattern}" for pattern in recipe["exclude"]),
            f"--customize-hook=copy-out /var/lib/apt/lists {shlex.quote(str(lists))}",
            *await _proxies(),
            release,
            str(archive),
            str(list_file),
        ]
        remedy = (
            f"check that each of {', '.join(spec.packages)} is a package of {release}, that the machine's apt sources"
            " answer, and that the user has a range in /etc/subuid and /etc/subgid"
        )
        # Maintainer scripts go by both: days in /etc/shadow, hashes in place of times in bytecode, the order of sets.
        variables = {"SOURCE_DATE_EPOCH": str(recipe["made"]), "PYTHONHASHSEED": "0"}
        what = f"building {spec.name} from Debian packages"
        await _run(what, command, progress, remedy=remedy, variables=variables)
        if needed.requirements:
            root = Path(folder) / "root"
            root.mkdir()
            python = await asyncio.to_thread(wheels.python_of, archive)
            await asyncio.to_thread(needed.unpack, root, python, progress)
            await asyncio.to_thread(wheels.append, archive, root)
        await _load(full, engine, archive, lists, made=recipe["made"], progress=progress)


async def _load(full: str, engine: PodmanEngine, archive: Path, lists: Path, *, made: int, progress: Progress) -> None:
    """Make an image of a root filesystem's archive: the same one wherever its content is the same."""
    packages = await asyncio.to_thread(oci.packages, archive, lists)
    layer = archive.with_name("layer.tar")
    extra = {oci.PACKAGES: oci.listing(packages)}
    digest, size = await asyncio.to_thread(oci.write_layer, archive, layer, made=made, extra=extra)
    config = oci.configuration(digest, made=made)
    image_id = hashlib.sha256(config).hexdigest()
    progress(f"loading {size / 2**20:.0f} MiB of {len(packages)} packages as {image_id[:12]}")
    layout = ImageLayout(reference=full, image_id=image_id, layers=(digest,))
    await engine.load_image(partial(oci.oci_archive, layout, config, {digest: layer}, {digest: size}))
    if (found := (await engine.image(full)).id) != image_id:
        await engine.remove_image(full)  # else it would be taken for a good one when it is built again
        raise PrerequisiteError(
            f"Podman loaded {full} as {found[:12]}, not as {image_id[:12]}", remedy="take Podman 4.3 or newer"
        )


async def _proxies() -> list[str]:
    """Return the host's apt proxy settings: mmdebstrap starts from none of the host's configuration."""
    if shutil.which("apt-config") is None:
        return []
    process = await asyncio.create_subprocess_exec(
        "apt-config", "dump", "Acquire::http::Proxy", "Acquire::https::Proxy", stdout=asyncio.subprocess.PIPE
    )
    output, _ = await process.communicate()
    lines = (line.strip() for line in output.decode("utf-8", "replace").splitlines())
    return [f"--aptopt={line}" for line in lines if line.startswith("Acquire::http") and '""' not in line]
