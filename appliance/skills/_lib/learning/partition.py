"""Shares a data set out to clients: by group (speaker, scene), by class skew (Dirichlet), or evenly.

Pure: the same items, rule and seed give the same parts on each machine, so a client's part need not be sent. Parts are
disjoint and together hold each item once.
"""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .listings import DataError, Item

Indices = NDArray[np.int64]

_DIRICHLET = re.compile(r"dirichlet:(\d+(?:\.\d+)?)")
RULES = "'speaker', 'site' (or 'group'), 'dirichlet:0.5', 'even'"


def split(items: Sequence[Item], *, by: str, of: int, seed: int) -> tuple[Indices, ...]:
    """Return the items' indices of each client, ascending.

    Args:
        items: of a listing.
        by: `speaker`, `site` or `group`: whole groups, dealt so that sizes are close; `dirichlet:A`: each class shared
            out in proportions drawn from Dirichlet(A, …, A), the smaller A the more uneven (Hsu et al. 2019); `even`:
            shuffled and dealt.
        of: clients.
        seed: of the run, for its partition.

    Raises:
        DataError: another rule, or fewer groups or items than clients.
    """
    if of < 1:
        raise DataError(f"{of} clients: there is at least one", "name the number of clients")
    if len(items) < of:
        raise DataError(f"{len(items)} items for {of} clients", "take fewer clients, or more data")
    dirichlet = _DIRICHLET.fullmatch(by)
    if by in ("speaker", "site", "group"):
        return _by_group(items, of, by)
    if dirichlet is not None and float(dirichlet[1]) > 0:
        return _by_dirichlet([item.label for item in items], float(dirichlet[1]), of, seed)
    if by == "even":
        order = np.random.Generator(np.random.Philox(seed)).permutation(len(items))
        return tuple(np.sort(order[client::of]) for client in range(of))
    raise DataError(f"no partition by {by[:40]!r}", f"possible: {RULES}")


def _by_group(items: Sequence[Item], of: int, by: str) -> tuple[Indices, ...]:
    """Deal groups, the largest first, each to the client that has least."""
    members: dict[str, list[int]] = {}
    for index, item in enumerate(items):
        members.setdefault(item.group, []).append(index)
    if len(members) < of:
        raise DataError(f"{len(members)} groups for {of} clients by {by}", "take fewer clients, or 'dirichlet:0.5'")
    held: list[list[int]] = [[] for _ in range(of)]
    for group in sorted(members, key=lambda group: (-len(members[group]), group)):
        min(held, key=len).extend(members[group])
    return tuple(np.array(sorted(indices), dtype=np.int64) for indices in held)


def _by_dirichlet(labels: Sequence[str], alpha: float, of: int, seed: int) -> tuple[Indices, ...]:
    """Share out each class in drawn proportions; a client that got nothing gets one item of the one that has most."""
    rng = np.random.Generator(np.random.Philox(seed))
    held: list[list[int]] = [[] for _ in range(of)]
    members: dict[str, list[int]] = {}
    for index, label in enumerate(labels):
        members.setdefault(label, []).append(index)
    for label in sorted(members):
        of_class = rng.permutation(members[label])
        cuts = np.cumsum(rng.dirichlet([alpha] * of)[:-1]) * len(of_class)
        for client, part in enumerate(np.split(of_class, cuts.astype(np.int64))):
            held[client].extend(int(index) for index in part)
    while (poorest := min(held, key=len)) == []:
        richest = max(held, key=len)
        poorest.append(richest.pop())
    return tuple(np.array(sorted(indices), dtype=np.int64) for indices in held)
