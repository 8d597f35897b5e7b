"""Plans that were carried out with success, by key: the first tier of the cascade. Pure.

A plan comes in only when a task with it has succeeded without a revision, and goes for good when one with it fails: a
cache of plans that were never carried out would repeat mistakes at full confidence. It is bounded; the plan that was
used longest ago goes first. Whoever takes a plan out checks it again as any other.
"""

from collections import OrderedDict

from msgspec import Struct
from msgspec.structs import replace

from appliance.model import CacheFigures, Plan

MOST = 512
"""Plans; at 3 kB each a megabyte and a half. The orders of a shift repeat within far fewer."""
MOST_BYTES = 32 * 1024
"""A larger plan is not kept: it repeats rarely, and a few would take the room of hundreds."""


class Kept(Struct, frozen=True, kw_only=True):
    """A plan and what became of it."""

    plan: Plan
    good: int = 1
    """Tasks that succeeded with it."""
    sure: float = 0.0
    """How sure the tier was that made it."""

    @property
    def confidence(self) -> float:
        """The tier's own confidence counts as one task, each success as another."""
        return (self.good + self.sure) / (self.good + 1)

    @property
    def told(self) -> str:
        """How it got here, in words."""
        first = self.plan.provenance
        by = first.tier.value if first is not None else self.plan.tier.value
        model = f" ({first.model})" if first is not None and first.model else ""
        times = "once" if self.good == 1 else f"{self.good} times"
        return f"the same instruction, fleet and rules: planned by {by}{model}, carried out with success {times}"


class PlanCache:
    """Plans by key.

    Args:
        most: plans that are kept.
    """

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._kept: OrderedDict[str, Kept] = OrderedDict()
        self._hits = 0
        self._misses = 0
        self._dropped = 0

    def find(self, key: str) -> Kept | None:
        """Return the plan of a key, if there is one."""
        found = self._kept.get(key) if key else None
        if found is None:
            self._misses += 1
            return None
        self._hits += 1
        self._kept.move_to_end(key)
        return found

    def succeeded(self, key: str, plan: Plan) -> Kept | None:
        """Note that a task with a plan has succeeded; returns what is kept from now on, None when nothing is."""
        if not key or self._most <= 0:
            return None
        known = self._kept.get(key)
        if known is not None and known.plan.subtasks == plan.subtasks:
            kept = replace(known, good=min(known.good + 1, 1_000_000))
        else:
            kept = Kept(plan=plan, sure=plan.provenance.confidence if plan.provenance else plan.confidence)
        self._kept[key] = kept
        self._kept.move_to_end(key)
        return kept

    def failed(self, key: str) -> bool:
        """Forget the plan of a key, since a task with it has failed; whether there was one."""
        gone = self._kept.pop(key, None) is not None
        self._dropped += gone
        return gone

    def surplus(self) -> list[str]:
        """Forget what is beyond the bound, and return its keys."""
        gone = list[str]()
        while len(self._kept) > self._most:
            gone.append(self._kept.popitem(last=False)[0])
        return gone

    def load(self, key: str, kept: Kept) -> None:
        """Take in what was kept before."""
        self._kept[key] = kept

    @property
    def figures(self) -> CacheFigures:
        """How it does since the start."""
        return CacheFigures(entries=len(self._kept), hits=self._hits, misses=self._misses, dropped=self._dropped)
