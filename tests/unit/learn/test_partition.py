"""Shares of clients: together all of it, each item once, the same everywhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.skills._lib.learning.listings import DataError, Item
from appliance.skills._lib.learning.partition import split

items_lists = st.lists(
    st.tuples(st.sampled_from("ABCDE"), st.integers(1, 12)).map(lambda pair: Item("x", pair[0], f"g{pair[1]:02d}")),
    min_size=1,
    max_size=200,
)
rules = st.sampled_from(("even", "dirichlet:0.1", "dirichlet:0.5", "dirichlet:100", "site", "speaker"))


@given(items_lists, rules, st.integers(1, 16), st.integers(0, 2**63))
def test_parts_hold_each_item_once(items: list[Item], by: str, of: int, seed: int) -> None:
    """Whatever the rule, no item is lost, none is in two parts, and no client is without; else it is refused."""
    groups = {item.group for item in items}
    if len(items) < of or (by in ("site", "speaker") and len(groups) < of):
        with pytest.raises(DataError):
            split(items, by=by, of=of, seed=seed)
        return
    parts = split(items, by=by, of=of, seed=seed)
    assert len(parts) == of
    assert sorted(np.concatenate(parts).tolist()) == list(range(len(items)))
    assert all(len(part) for part in parts)
    assert all(np.array_equal(part, np.sort(part)) for part in parts)
    again = split(items, by=by, of=of, seed=seed)
    assert all(np.array_equal(one, other) for one, other in zip(parts, again, strict=True))


@given(items_lists, st.integers(1, 6))
def test_groups_stay_whole(items: list[Item], of: int) -> None:
    """A speaker's or site's items are all with one client."""
    if len({item.group for item in items}) < of:
        return
    held = [{items[index].group for index in part} for part in split(items, by="speaker", of=of, seed=0)]
    assert sum(len(groups) for groups in held) == len(set().union(*held))


def test_a_small_alpha_is_uneven() -> None:
    """With Dirichlet 0.1 most of a client's items are of few classes, with 100 they are as in the whole."""
    items = [Item("x", label, "g") for label in "ABCDEFGHIJ" for _ in range(60)]

    def largest(by: str) -> float:
        shares: list[float] = []
        for part in split(items, by=by, of=10, seed=4):
            labels = [items[index].label for index in part]
            shares.append(max(labels.count(label) for label in set(labels)) / len(labels))
        return float(np.mean(shares))

    assert largest("dirichlet:0.1") > 0.4
    assert largest("dirichlet:100") < 0.2


@pytest.mark.parametrize("by", ["random", "dirichlet:", "dirichlet:-1", "dirichlet:0", "dirichlet:nan", ""])
def test_other_rules_are_refused(by: str) -> None:
    """A rule that there is not is refused with those that there are."""
    with pytest.raises(DataError, match="no partition by") as caught:
        split([Item("x", "A", "g")], by=by, of=1, seed=0)
    assert "dirichlet:0.5" in caught.value.remedy


def test_no_clients_is_refused() -> None:
    """Nothing can be shared out among nobody."""
    with pytest.raises(DataError, match="0 clients"):
        split([Item("x", "A", "g")], by="even", of=0, seed=0)
