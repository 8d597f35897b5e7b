"""What ties the rest of a robot's work to that robot, and what another would have to do first.

A skill's manifest says what state it leaves its robot in: `ties` what no other robot has (a load in the gripper),
`prepares` what another can be brought into by doing the same (a position, being airborne), `frees` what it ends. A
robot's work since the last point at which nothing was left, the last neutral point, is what counts.
"""

from collections.abc import Mapping, Sequence

from msgspec import Struct

from appliance.model import SubtaskRecord
from appliance.skills.catalogue import SkillManifest


class Left(Struct, frozen=True):
    """State a robot's finished work leaves it in: by word, the id of the subtask that left it."""

    tied: Mapping[str, str]
    prepared: Mapping[str, str]


def left(finished: Sequence[SubtaskRecord], manifests: Mapping[str, SkillManifest]) -> Left:
    """Return what finished subtasks of one robot, in order, leave it in.

    Args:
        finished: the robot's own, in the order in which they were done.
        manifests: by skill; one that is not known leaves nothing, since nothing is known of it.
    """
    tied: dict[str, str] = {}
    prepared: dict[str, str] = {}
    for each in finished:
        manifest = manifests.get(each.subtask.skill)
        if manifest is None:
            continue
        for word in manifest.frees:
            tied.pop(word, None)
            prepared.pop(word, None)
        for word in manifest.ties:
            tied[word] = each.subtask.id
        for word in manifest.prepares:
            # Kept in the order of the last preparation: a place is reached after taking off, not before.
            prepared.pop(word, None)
            prepared[word] = each.subtask.id
    return Left(tied, prepared)
