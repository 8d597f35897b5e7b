"""Whether a gateway can serve a subtask at all, as a plain function of facts: one that cannot is never a candidate.

What a gateway told of itself decides. What it did not tell (an older version, a fact that has not come yet) speaks
for it: it refuses with the reason if it is asked in vain, and is then avoided.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence

from msgspec import Struct

from appliance.model import GatewayStatus, Need, RobotInfo


class Want(Struct, frozen=True, kw_only=True):
    """What a subtask asks of the gateway that serves it."""

    subtask: str
    skill: str
    need: Need
    image: str = ""
    """Full reference of the need's image; empty: not known here."""


def why_not(
    want: Want,
    status: GatewayStatus,
    *,
    ready: bool,
    skills: Collection[str] | None,
    holders: Collection[str] | None,
    within: Sequence[str],
) -> str:
    """Return why a gateway cannot serve a subtask, in words; empty when it can.

    Args:
        want: what is asked.
        status: what the gateway tells of itself.
        ready: whether a container there is ready for it, or may become so: one that runs.
        skills: skills that it knows; None: not told.
        holders: gateways that have the image, so that it can be fetched; None: nobody tells of images.
        within: gateways that the submitter allows; empty: any.
    """
    need = want.need
    if within and status.id not in within:
        return "the submitter does not allow it"
    if status.draining:
        return "is draining"
    if skills is not None and want.skill not in skills:
        return f"has no skill {want.skill}"
    if status.pool_memory_mb and need.memory_mb > status.pool_memory_mb:
        return f"{need.memory_mb} MB wanted, its containers have {status.pool_memory_mb} MB together"
    if status.cores and need.cpu > status.cores:
        return f"{need.cpu:g} cores wanted, it has {status.cores}"
    if status.pool_problem and not ready:
        return status.pool_problem
    if want.image and holders is not None and not ready and not holders:
        return f"has no image {need.image}, and no gateway has it to give"
    return ""


def lacks(robot: RobotInfo, uses: Iterable[str], verbs: Iterable[str]) -> str:
    """Return why a robot cannot do a subtask, in words; empty when it can, or does not tell what it can do."""
    without = sorted(set(uses) - set(robot.uses))
    if without and robot.uses:
        return f"{robot.id} has no {', '.join(without)}"
    unknown = sorted(set(verbs) - set(robot.verbs))
    return f"{robot.id} does not know {', '.join(unknown)}" if unknown and robot.verbs else ""


def image_holders(gateways: Mapping[str, GatewayStatus], image: str) -> frozenset[str] | None:
    """Return the gateways that have an image; None when nobody tells of any image."""
    if not any(status.images for status in gateways.values()):
        return None
    return frozenset(name for name, status in gateways.items() if image in status.images)
