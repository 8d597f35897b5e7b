"""The parts that a machine has, for the list that the authority signs (`identity.parts`); and its installation."""

import asyncio
import contextlib
from pathlib import Path

from appliance.config import GatewayConfig
from appliance.errors import ConflictError, IdentityError, NotFoundError
from appliance.identity import certificates, files, parts
from appliance.identity.authority import Authority
from appliance.identity.bundle import Bundle
from appliance.identity.parts import Digests, InForce, Parts
from appliance.llm.settings import folder_of
from appliance.pool import images
from appliance.pool.engine import PodmanEngine
from appliance.pool.signed import skill_parts
from appliance.skills.catalogue import SKILLS, Catalogue, load_catalogue


async def collect(config: GatewayConfig, *, with_images: bool = True) -> Parts:
    """List what a gateway of this configuration would load here: skills, its model, the images that are built.

    Raises:
        ConfigError: a folder cannot be read.
        UnreachableError: Podman does not answer.
    """
    catalogue, found = await asyncio.to_thread(_folders, config)
    return parts.together([found, Parts(image=await _images(config, catalogue) if with_images else {})])


def _folders(config: GatewayConfig) -> tuple[Catalogue, Parts]:
    catalogue = load_catalogue(tuple(Path(each).expanduser() for each in config.skills))
    roots = {SKILLS, *(each.folder.parent for each in catalogue.skills.values())}
    skills = parts.together(
        [Parts(skill={name: (digest,)}) for root in roots for name, digest in skill_parts(root).items()]
    )
    model = folder_of(config.llm.local_model)
    models: Digests = {Path(model).name: (parts.folder_digest(Path(model)),)} if model else {}
    return catalogue, Parts(skill=skills.skill, model=models)


async def _images(config: GatewayConfig, catalogue: Catalogue) -> Digests:
    found: Digests = {}
    engine = PodmanEngine(config.pool.podman_url, threads=1)
    try:
        for spec in catalogue.images.values():
            reference = images.reference(spec, config.pool)
            with contextlib.suppress(NotFoundError):
                found[reference] = ((await engine.image(reference)).id,)
    finally:
        engine.close()
    return found


def sign(authority: Authority, lists: list[Parts], out: Path | None = None) -> Parts:
    """Sign the parts of several machines as the fleet's next list, in place of the one before.

    Raises:
        ConfigError: a list has what is no digest.
        IdentityError: the file cannot be written, or the one before is damaged.
    """
    for each in lists:
        each.check()
    return authority.sign_parts(parts.together(lists), out)


def in_force(config: GatewayConfig) -> InForce:
    """Return what counts on this machine by a gateway's configuration; nothing is written."""
    if not config.plane.keys:
        return parts.ALL
    return InForce.beside(Bundle.load(Path(config.plane.keys).expanduser()), config.plane.parts_file, _kept(config))


def _kept(config: GatewayConfig) -> Path:
    return Path(config.data_dir).expanduser() / parts.FILE


def install(config: GatewayConfig, file: Path) -> Parts:
    """Put a signed list where a gateway looks for it, checked; it counts at the next look, and other gateways get it.

    Args:
        config: the gateway's.
        file: the list.

    Raises:
        IdentityError: the gateway has no keys; the list is damaged, of another fleet or authority.
        ConflictError: it is older than the one that counts.
    """
    if not config.plane.keys:
        raise IdentityError(parts.DEVELOPMENT, remedy="set plane.keys: docs/security.md")
    bundle = Bundle.load(Path(config.plane.keys).expanduser())
    authority, fleet = certificates.ed25519_of(bundle.authority), bundle.identity.fleet
    data = parts.read(file)
    found = parts.unseal(data, authority, fleet)
    for path in (_kept(config), config.plane.parts_file):
        with contextlib.suppress(IdentityError):  # absent or damaged: this one is better
            before = parts.unseal(parts.read(path), authority, fleet)
            if found.number < before.number:
                raise ConflictError(
                    f"{file} is number {found.number}, and {before.number} counts here", remedy=parts.SIGN_AGAIN
                )
    files.write(config.plane.parts_file, data, mode=files.PUBLIC)
    return found
