"""Rules that bear hostile or broken updates: coordinate-wise median, trimmed mean, multi-Krum.

All take deltas of the same shape, stacked along the first axis, one client each, and work on a shard at a time:
`stack` is (clients, values of a piece). Multi-Krum needs distances between whole updates first, which add up over
shards. Sources: Yin et al. 2018 (median, trimmed mean), Blanchard et al. 2017 (Krum).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_BLOCK = 1 << 16


def median(stack: NDArray[Any]) -> Floats:
    """Return the median of each value over the clients: bears fewer than half of them hostile."""

    def middle(block: NDArray[Any]) -> NDArray[Any]:
        return np.median(block.astype(np.float64), axis=0)

    return _by_blocks(stack, middle)


def trimmed_count(clients: int, share: float) -> int:
    """Return how many clients a trimmed mean leaves out at each end.

    Raises:
        ValueError: nothing would be left.
    """
    if not 0.0 <= share < 0.5:
        raise ValueError(f"trimmed:{share:g}: between 0 and 0.5, the share left out at each end")
    cut = int(share * clients)
    if clients - 2 * cut < 1:
        raise ValueError(f"trimmed:{share:g} of {clients} updates leaves none")
    return cut


def trimmed_mean(stack: NDArray[Any], share: float) -> Floats:
    """Return the mean of each value without the `share` largest and the `share` smallest: bears that share hostile."""
    cut = trimmed_count(len(stack), share)

    def mean(block: NDArray[Any]) -> NDArray[Any]:
        ordered = np.sort(block.astype(np.float64), axis=0)
        return ordered[cut : len(ordered) - cut].mean(axis=0)

    return _by_blocks(stack, mean)


def _by_blocks(stack: NDArray[Any], rule: Callable[[NDArray[Any]], NDArray[Any]]) -> Floats:
    """Apply a rule to some values at a time: sorting takes twice the memory of what is sorted."""
    flat = stack.reshape(len(stack), -1)
    result = np.empty(flat.shape[1], dtype=np.float32)
    for at in range(0, flat.shape[1], _BLOCK):
        result[at : at + _BLOCK] = rule(flat[:, at : at + _BLOCK])
    return result.reshape(stack.shape[1:])


class Distances:
    """Squared distances between the updates of a round, added up shard by shard."""

    def __init__(self, clients: int) -> None:
        self._squares = np.zeros((clients, clients), dtype=np.float64)

    def add(self, stack: NDArray[Any]) -> None:
        """Add what a piece of each update contributes."""
        flat = stack.reshape(len(stack), -1)
        for at in range(0, flat.shape[1], _BLOCK):
            block = flat[:, at : at + _BLOCK].astype(np.float64)
            for client in range(len(block) - 1):
                difference = block[client + 1 :] - block[client]
                squares = np.einsum("ij,ij->i", difference, difference)
                self._squares[client, client + 1 :] += squares
                self._squares[client + 1 :, client] += squares

    @property
    def squares(self) -> NDArray[np.float64]:
        """The matrix, (clients, clients)."""
        return self._squares


def krum_needs(hostile: int) -> int:
    """Return how many updates Krum needs with so many hostile ones: 2f + 3."""
    return 2 * max(0, hostile) + 3


def check_krum(clients: int, hostile: int) -> None:
    """Raise ValueError where Krum's bound n >= 2f + 3 does not hold."""
    if hostile < 0 or clients < krum_needs(hostile):
        raise ValueError(
            f"multikrum:{hostile} needs at least {krum_needs(hostile)} updates a round, there are {clients}"
        )


def multikrum(squares: NDArray[np.float64], hostile: int) -> tuple[int, ...]:
    """Return which clients' updates are averaged: the n - f that are nearest to their n - f - 2 nearest others.

    Of equal scores the client that comes first is taken, so the same updates in the same order give the same choice.

    Raises:
        ValueError: fewer than 2f + 3 clients.
    """
    clients = len(squares)
    check_krum(clients, hostile)
    scores: list[float] = []
    for client in range(clients):
        others: Sequence[float] = np.sort(np.delete(squares[client], client)).tolist()
        scores.append(sum(others[: clients - hostile - 2]))
    best = sorted(range(clients), key=lambda client: (scores[client], client))
    return tuple(sorted(best[: clients - hostile]))
