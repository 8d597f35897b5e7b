"""Which skills may run: those whose folders, and the shared code beside them, are in the signed list of parts.

A skill that may not is known to the planner as one that is not implemented, and its folder is in no snapshot.
"""

from collections.abc import Callable
from pathlib import Path

from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.identity.parts import InForce, Kind, file_digest, regular_files
from appliance.pool.snapshots import NOT_LOADED, part_digests
from appliance.skills.catalogue import SKILLS, Catalogue

SHARED = (".", "_lib", "models")
"""Parts of a folder of skills that each skill in it may load."""


def skill_parts(root: Path) -> dict[str, str]:
    """Return the digest of each part of a folder of skills, as it is on the disk; ConfigError if unreadable."""
    try:
        return part_digests({path: file_digest(file) for file, path in regular_files(root, left_out=NOT_LOADED)})
    except OSError as error:
        raise ConfigError(
            f"{error.filename or root} cannot be read: {error.strerror}", remedy="make the skill folders readable"
        ) from error


def without_unsigned(catalogue: Catalogue, in_force: InForce) -> Catalogue:
    """Return a catalogue in which skills that may not run are not implemented; blocks while their folders are read."""
    if not in_force.checked:
        return catalogue
    roots = {each.folder.parent for each in catalogue.skills.values()} | {SKILLS}
    refused = {
        (root, part)
        for root in roots
        for part, digest in skill_parts(root).items()
        if not in_force.has(Kind.SKILL, part, digest)
    }

    def may(folder: Path) -> bool:
        needed = {(root, part) for root in (SKILLS, folder.parent) for part in SHARED} | {(folder.parent, folder.name)}
        return not needed & refused

    skills = {
        name: each if may(each.folder) else replace(each, implemented=False) for name, each in catalogue.skills.items()
    }
    return Catalogue(catalogue.domains, skills, catalogue.images)


def may_be_in(in_force: InForce) -> Callable[[str, str, str], bool]:
    """Return whether a part of a folder may be in a snapshot; the runner is of the program itself."""
    return lambda root, part, digest: root == "runner" or in_force.has(Kind.SKILL, part, digest)
