"""What must hold of records without a quorum once all faults are over. Pure.

1. All replicas of a key hold the same version and value.
2. The value is one that somebody wrote, and not one whose write is known to have failed.
3. No acknowledged write is forgotten: the version that stands descends from every version that was acknowledged. Its
   value may be another's all the same, when two owners wrote at once and the resolution chose the other: that is
   counted as `replaced`, and is what a plain write does not promise against.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct

from appliance.model import VersionVector
from appliance.plane.versions import descends


class Write(Struct, frozen=True, kw_only=True):
    """A write of a client: acknowledged with a version, refused (`failed`), or of unknown outcome."""

    value: str
    after: str | None
    """The value that it was to replace; None where there was none."""
    version: VersionVector | None = None
    failed: bool = False


class Copy(Struct, frozen=True, kw_only=True):
    """A replica's record in the end."""

    gateway: str
    value: str | None
    version: VersionVector | None


def check(writes: Sequence[Write], copies: Sequence[Copy]) -> dict[str, Any]:
    """Check one key; returns `problems` in words and how many acknowledged writes were `replaced`."""
    problems: list[str] = []
    if len({(each.value, _text(each.version)) for each in copies}) > 1:
        problems.append(f"replicas differ: {', '.join(f'{each.gateway} {each.value}' for each in copies)}")
    by_value = {each.value: each for each in writes}
    for each in copies:
        if each.value is None:
            if any(write.version is not None for write in writes):
                problems.append(f"{each.gateway} holds nothing, though writes were acknowledged")
            continue
        write = by_value.get(each.value)
        if write is None:
            problems.append(f"{each.gateway} holds {each.value!r}, which nobody wrote")
        elif write.failed:
            problems.append(f"{each.gateway} holds {each.value!r}, whose writer was told that it was not written")
    for each in copies:
        forgotten = [
            write.value
            for write in writes
            if write.version is not None and each.version is not None and not _covers(each.version, write.version)
        ]
        if forgotten:
            problems.append(f"{each.gateway} knows nothing of acknowledged writes: {', '.join(forgotten[:5])}")
    chain = _chain(by_value, copies[0].value if copies else None)
    replaced = [each.value for each in writes if each.version is not None and each.value not in chain]
    return {"problems": problems, "replaced": len(replaced)}


def _covers(version: VersionVector, other: VersionVector) -> bool:
    return version == other or descends(version, other)


def _chain(by_value: Mapping[str, Write], value: str | None) -> set[str]:
    """The values that the last one came after."""
    found: set[str] = set()
    while value is not None and value not in found:
        found.add(value)
        value = by_value[value].after if value in by_value else None
    return found


def _text(version: VersionVector | None) -> str:
    return "" if version is None else str(sorted(version.items()))
