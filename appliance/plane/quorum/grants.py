"""What a grantor grants, and what answers amount to. Pure: the time is passed in, and nothing is stored or sent.

A grantor holds one live grant for each key. It numbers grants by fences that only increase, over all its keys, so that
what was sent before a grant cannot replace it however late it arrives, and a resource that remembers the highest fence
it has seen can refuse a holder that was frozen while its lease ended.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta, Struct

from appliance.errors import PayloadError, RefusedError

LONGEST_S = 30.0
"""Longest lease, seconds; for so long a restarted grantor grants nothing, since it has forgotten its grants."""
MOST_GRANTS = 10_000
"""Live grants of one grantor."""
_MOST_JUMP = 2**32
"""A fence further ahead than that is no asker's: it would use up the numbers."""

Fence = Annotated[int, Meta(ge=1, le=2**53)]


class LeaseAsk(Struct, frozen=True, kw_only=True):
    """`lease_grant`: grant the holder this key for so long, under this fence."""

    key: str
    holder: Annotated[str, Meta(min_length=1, max_length=120)]
    """One acquisition, not one gateway: two tasks of one gateway exclude each other too."""
    fence: Fence
    ttl_s: Annotated[float, Meta(gt=0, le=LONGEST_S)]
    voters: str
    """Digest of the grantors as the asker is configured."""


class LeaseEnd(Struct, frozen=True, kw_only=True):
    """`lease_release`: the holder needs the grant of this fence no longer."""

    key: str
    holder: Annotated[str, Meta(min_length=1, max_length=120)]
    fence: Fence
    voters: str


class Granted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A grantor's answer."""

    granted: bool = False
    fence: Annotated[int, Meta(ge=0, le=2**53)] = 0
    """The highest fence that it has granted, for any key; only a higher one is granted."""
    holder: str = ""
    """Where not granted: who has the grant; empty: nobody, the fence was too low."""
    left_s: float = 0.0
    """For how much longer."""


class Released(Struct, frozen=True):
    """Answer of `lease_release`: the grant is gone, or was no more."""


class Grant(Struct, frozen=True):
    """A key granted to a holder until a time on the grantor's clock."""

    holder: str
    fence: int
    until: float


class Grantor:
    """The grants of one gateway.

    Args:
        fence: the highest fence that it granted before its last restart; 0: it never granted any.
        now: seconds, on a clock that does not jump; may stand still while the machine is suspended.
    """

    def __init__(self, *, fence: int, now: float) -> None:
        self.fence = fence
        """Must be on the disk before the answer that made it is sent."""
        self._quiet_until = now + LONGEST_S if fence else now
        self._grants: dict[str, Grant] = {}

    def grant(self, asked: LeaseAsk, now: float) -> Granted:
        """Grant a key, anew or again to its holder, unless another has it or the fence is not higher than any before.

        Raises:
            RefusedError: it was restarted less than the longest lease ago, or holds too many grants.
            PayloadError: the fence is absurd.
        """
        if now < self._quiet_until:
            left_s = self._quiet_until - now
            raise RefusedError(
                f"grants nothing for another {left_s:.1f} s: grants from before its restart may be live",
                remedy="ask again then",
            )
        if asked.fence > self.fence + _MOST_JUMP:
            raise PayloadError(f"a fence of {asked.fence:,} after {self.fence:,}")
        held = self._grants.get(asked.key)
        if held is not None and held.until <= now:
            del self._grants[asked.key]
            held = None
        if held is not None and held.holder != asked.holder:
            return Granted(fence=self.fence, holder=held.holder, left_s=held.until - now)
        if asked.fence <= self.fence:
            return Granted(fence=self.fence)
        if held is None:
            self._make_room(now)
        # Never shorter than what the holder was told before: it may not hear this answer.
        until = max(now + asked.ttl_s, now if held is None else held.until)
        self._grants[asked.key] = Grant(asked.holder, asked.fence, until)
        self.fence = asked.fence
        return Granted(granted=True, fence=asked.fence)

    def _make_room(self, now: float) -> None:
        if len(self._grants) < MOST_GRANTS:
            return
        self._grants = {key: held for key, held in self._grants.items() if held.until > now}
        if len(self._grants) >= MOST_GRANTS:
            raise RefusedError(f"holds {MOST_GRANTS:,} grants", remedy="release leases, or ask for shorter ones")

    def release(self, ended: LeaseEnd) -> None:
        """Drop a grant, if it is still the one of that fence: a renewal that overtook the release stays."""
        held = self._grants.get(ended.key)
        if held is not None and (held.holder, held.fence) == (ended.holder, ended.fence):
            del self._grants[ended.key]


def majority(grantors: int) -> int:
    """How many grantors decide: any two majorities have one in common."""
    return grantors // 2 + 1


def granted(answers: Sequence[Granted], grantors: int) -> bool:
    """Whether a majority has granted it."""
    return sum(answer.granted for answer in answers) >= majority(grantors)


def highest(fence: int, answers: Sequence[Granted]) -> int:
    """The highest fence heard of, an asker's own among them; one that is absurd is not believed."""
    return max(fence, *(answer.fence for answer in answers if answer.fence <= fence + _MOST_JUMP), 0)


def holder(answers: Sequence[Granted], grantors: int) -> tuple[str, float] | None:
    """Who else has the lease, as a majority says, and for how many seconds more; None: nobody is known to."""
    counts = Counter(answer.holder for answer in answers if answer.holder)
    for name, count in counts.most_common(1):
        if count >= majority(grantors):
            left = sorted((answer.left_s for answer in answers if answer.holder == name), reverse=True)
            # It has it for as long as a majority says so.
            return name, left[majority(grantors) - 1]
    return None
