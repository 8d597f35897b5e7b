"""What a bounded view keeps: one that is known and as good as others stays."""

import random

import pytest

from appliance.plane.overlay import View, bound_for
from appliance.plane.ring import Ring

SIZE = 200


def settled(seed: int) -> tuple[View, list[str]]:
    """The view of one of many members, and all the others."""
    names = [f"m{number}" for number in range(SIZE)]
    ring = Ring(names, virtual_nodes=1)
    view = View.settled("m0", ring, bound=bound_for(SIZE), replicas=3, rng=random.Random(seed))  # noqa: S311
    return view, names[1:]


@pytest.mark.parametrize("seed", range(5))
def test_what_is_heard_of_others_replaces_nobody_as_good(seed: int) -> None:
    """Its neighbours and fingers are known: of the others none comes or goes, however often they are heard of."""
    view, others = settled(seed)
    rng = random.Random(seed)  # noqa: S311
    kept = view.names
    for name in rng.sample(others, len(others)):
        view.hear((name,))
        view.trim(rng)
        assert view.names == kept
    view.hear(others)
    view.trim(rng)
    assert view.names == kept


@pytest.mark.parametrize("seed", range(5))
def test_the_place_of_one_that_is_gone_is_taken(seed: int) -> None:
    """By somebody who is heard of then."""
    view, others = settled(seed)
    rng = random.Random(seed)  # noqa: S311
    full = len(view)
    for gone in list(view.names):
        view.lose(gone)
        view.hear(name for name in others if name != gone)
        view.trim(rng)
        assert len(view) == full
        assert gone not in view
