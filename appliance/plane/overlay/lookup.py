"""Finding a key's owner by asking one's way there: greedy, iterative, and finite whatever is answered.

The gateway that looks up asks, itself, one member after the other (Chord's iterative style), so that a dead or
confused one costs a question and not the lookup. Towards the position it always goes to the nearest member before it
that it has heard of; once somebody names the owners, those are asked in ring order, and the first that answers is the
owner: everything between the position and it is gone. Nobody is asked twice, so a lookup never runs in a circle.
"""

from msgspec import Struct

from appliance.plane.overlay.view import Step, View
from appliance.plane.ring import RING_SIZE, point

MOST_ASKED = 128
"""Questions of one lookup, dead members included: twenty times what a ring of a million members needs."""


class NextAsk(Struct, frozen=True, omit_defaults=True):
    """`ring_next`: what do you know of this position?"""

    position: str
    """In hex: JSON numbers end at 64 bits."""
    named: bool = False
    """You were named as its owner."""


class Owners(Struct, frozen=True, kw_only=True):
    """A lookup's end: the owner, and the next members after it as far as the owner named them."""

    owner: str
    replicas: tuple[str, ...]


class Lookup:
    """One lookup: ask `next()`, tell `answered` or `failed`, until `result` is there or `next()` has nobody more."""

    def __init__(self, target: int, view: View) -> None:
        self.target = target
        self.result: Owners | None = None
        self.hops = 0
        """Members that answered, the owner among them: 0 when the position is one's own, 1 when the owner is known."""
        self.gone: dict[str, None] = {}
        """Members asked in vain, in that order."""
        self._asked: set[str] = {view.me}
        self._before: dict[str, int] = {}
        """Not yet asked: name -> distance from it on to the position."""
        self._owners: dict[str, int] = {}
        """Named as owners: name -> distance from the position on to it."""
        self._steps: dict[str, Step] = {}
        here = view.step(target)
        for name in view.nearest(target, MOST_ASKED):
            self._before[name] = (target - point(name)) % RING_SIZE
        self._take(view.me, here)

    def next(self) -> str | None:
        """Whom to ask now; None when the lookup is over, with or without a result."""
        if self.result is not None or len(self._asked) > MOST_ASKED:
            return None
        name = self._nearest_owner() or min(self._before, key=self._before.__getitem__, default=None)
        if name is not None:
            self._asked.add(name)
            self._before.pop(name, None)
        return name

    def named(self, name: str) -> bool:
        """Whether a member was named as the owner: the question says so."""
        return name in self._owners

    def answered(self, name: str, step: Step) -> None:
        """A member that was asked has answered."""
        self.hops += 1
        self._take(name, step)

    def failed(self, name: str) -> None:
        """A member that was asked is not there."""
        self.gone[name] = None
        self._owners.pop(name, None)
        self._end()

    def _take(self, name: str, step: Step) -> None:
        if step.mine:
            # A member says so only if it knows of nobody between the position and itself.
            self._owners[name] = (point(name) - self.target) % RING_SIZE
        self._steps[name] = step
        for each in step.owners:
            if each not in self.gone:
                self._owners[each] = (point(each) - self.target) % RING_SIZE
        for each in step.closer:
            if each not in self._asked:
                self._before[each] = (self.target - point(each)) % RING_SIZE
        self._end()

    def _nearest_owner(self) -> str | None:
        unasked = [name for name in self._owners if name not in self._asked]
        return min(unasked, key=self._owners.__getitem__, default=None)

    def _end(self) -> None:
        """The nearest owner named is the owner once it has answered: all that were named before it are gone."""
        if not self._owners:
            return
        nearest = min(self._owners, key=self._owners.__getitem__)
        step = self._steps.get(nearest)
        if step is None:
            return
        known = sorted((each for each in self._owners if each != nearest), key=self._owners.__getitem__)
        self.result = Owners(owner=nearest, replicas=tuple(known))
