"""Many updates into one model, piece by piece; pure but for the two functions that fetch and keep files.

First each update is looked at whole: layout, values, norm. Then each shard of the new model is made: of a mean one
update after the other is added in 64-bit fixed point, so that memory holds one shard of sums and one of an update,
whatever the number of clients, and order makes no difference. Rules that bear hostile updates see all of a piece.

An update may cover only part of an epoch: `scale` makes it that of a whole one before its norm is compared (Wang et al.
2020, FedNova). `clip` scales updates with a longer norm down to it.
"""

import math
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import coding, robust, shards
from .orders import Rule
from .shards import Manifest, ModelFileError, Piece
from .sums import FixedSum, SumOverflowError

Floats = NDArray[np.float32]
Base = Callable[[int], Mapping[str, NDArray[Any]]]
"""Gives the model's own values of a shard, by the keys of its pieces."""
KEPT_BYTES = 64 << 20
"""Shards of updates that are kept for a second look, together."""


class File(NamedTuple):
    """An update as it came. `fetch` returns the bytes of a shard by its number; `coded`: its values are in 8 bits."""

    manifest: Manifest
    fetch: Callable[[int], bytes]
    coded: bool = False


class Update(NamedTuple):
    """One client's update. Of a client whose share others helped with it is the sum of several: `files`."""

    client: str
    files: tuple[File, ...]
    weight: int
    scale: tuple[int, int] = (1, 1)


class Verdict(NamedTuple):
    """Whether an update was summed; if not, why: one of `shards.REASONS`, or `overflow`, `krum`, `lost`.

    `krum` and `lost` are no fault of the client: others are nearer to each other; its files are on no gateway any more.
    """

    accepted: bool
    reason: str = ""
    message: str = ""
    norm: float | None = None


class Result(NamedTuple):
    """The shards of the new model as `keep` took them, and what became of each update. No `bound`: none was used."""

    manifest: Manifest
    verdicts: dict[str, Verdict]
    weight: int
    bound: float | None


class TooFewError(ValueError):
    """Fewer updates are fit than a model needs.

    Attributes:
        needed: how many are.
        verdicts: on those that are not fit.
    """

    def __init__(self, message: str, needed: int, verdicts: Mapping[str, Verdict]) -> None:
        super().__init__(message[:2000])
        self.needed = needed
        self.verdicts = dict(verdicts)


class Aggregator:
    """Makes one model of updates.

    Args:
        layout: pieces of the model, in their shards.
        base: returns the model's own values of a shard, by the keys of its pieces.
        keep: takes a new shard, by its number.
        alive: called after each file.
    """

    def __init__(
        self,
        layout: Sequence[Piece],
        base: Base,
        keep: Callable[[int, bytes], None],
        *,
        alive: Callable[[], None] = lambda: None,
    ) -> None:
        self._pieces = tuple(layout)
        self._count = 1 + max(piece.shard for piece in self._pieces)
        self._base = base
        self._keep = keep
        self._alive = alive
        self._kept: dict[tuple[str, int, int], dict[str, NDArray[Any]]] = {}
        self._kept_bytes = 0
        self._norms: dict[str, float] = {}
        self._verdicts: dict[str, Verdict] = {}

    def run(
        self, updates: Sequence[Update], rule: Rule, *, clip: float | None = None, noise: float | None = None
    ) -> Result:
        """Return the new model and the verdicts; each client has one update.

        Args:
            updates: what is summed.
            rule: how.
            clip: longest norm; longer updates are scaled down to it.
            noise: standard deviation of the noise that is added to the weighted sum. Norms are not compared then: what
                is summed of one client may not depend on others.

        Raises:
            TooFewError: no update is fit, or the rule needs more of them.
            ValueError: the rule cannot be.
        """
        self._verdicts = {}
        fit = self._examine(updates)
        bound = shards.norm_bound([self._norms[each.client] for each in fit]) if noise is None else math.inf
        fit = [each for each in fit if self._within(each, bound)]
        if not fit:
            reasons = "; ".join(f"{client}: {each.message}" for client, each in sorted(self._verdicts.items()))
            raise TooFewError(f"none of {len(updates)} updates is fit to be summed: {reasons}", 1, self._verdicts)
        while True:
            try:
                chosen = self._select(fit, rule)
                manifest = self._make(chosen, rule, clip, noise)
            except _UnfitError as error:
                self._refuse(error.client, error.reason, str(error))
                fit = [each for each in fit if each.client != error.client]
                if not fit:
                    raise TooFewError(f"no update is left to be summed: {error}", 1, self._verdicts) from error
            else:
                break
        for each in chosen:
            self._verdicts[each.client] = Verdict(accepted=True, norm=self._norms[each.client])
        told = bound if math.isfinite(bound) else None  # JSON has no infinity
        return Result(manifest, self._verdicts, sum(each.weight for each in chosen), told)

    # --- what is summed

    def _examine(self, updates: Sequence[Update]) -> list[Update]:
        fit: list[Update] = []
        for update in updates:
            try:
                self._norms[update.client] = self._norm(update)
                fit.append(update)
            except ModelFileError as error:
                self._refuse(update.client, error.reason, str(error))
        return fit

    def _norm(self, update: Update) -> float:
        """Check every value of an update; returns its norm as that of a whole epoch."""
        files = tuple(shards.Shard("", 0) for _ in range(self._count))
        plain, coded = Manifest(self._pieces, files), Manifest(coding.coded_pieces(self._pieces), files)
        for file in update.files:
            shards.check_same(file.manifest, coded if file.coded else plain)
        squares = 0.0
        for index in range(self._count):
            arrays = self._arrays(update, index)
            squares += shards.squared_norm(arrays[piece.key] for piece in self._of(index))
        return math.sqrt(squares) * update.scale[0] / update.scale[1]

    def _within(self, update: Update, bound: float) -> bool:
        try:
            shards.check_norm(self._norms[update.client], bound)
        except ModelFileError as error:
            self._refuse(update.client, error.reason, str(error))
            return False
        return True

    def _select(self, fit: list[Update], rule: Rule) -> list[Update]:
        """Return the updates that a rule takes: all, but of multi-Krum."""
        if rule.name == "trimmed":
            robust.trimmed_count(len(fit), rule.share)
        if rule.name != "multikrum":
            return fit
        try:
            robust.check_krum(len(fit), rule.hostile)
        except ValueError as error:
            raise TooFewError(str(error), robust.krum_needs(rule.hostile), self._verdicts) from error
        distances = robust.Distances(len(fit))
        for piece, stack in self._stacks(fit, None):
            del piece
            distances.add(stack)
        chosen = {fit[number].client for number in robust.multikrum(distances.squares, rule.hostile)}
        for each in fit:
            if each.client not in chosen:
                self._refuse(each.client, "krum", "farther from the others than the updates that are averaged")
        return [each for each in fit if each.client in chosen]

    def _refuse(self, client: str, reason: str, message: str) -> None:
        self._verdicts[client] = Verdict(accepted=False, reason=reason, message=message, norm=self._norms.get(client))

    # --- sums

    def _make(self, fit: Sequence[Update], rule: Rule, clip: float | None, noise: float | None) -> Manifest:
        deviation = 0.0 if noise is None else noise / sum(each.weight for each in fit)
        files: list[shards.Shard] = []
        squares = 0.0
        for index in range(self._count):
            mean = rule.name in ("mean", "multikrum")
            changes = self._mean(fit, index, clip) if mean else self._robust(fit, index, rule, clip)
            base = self._base(index)
            fresh: dict[str, NDArray[Any]] = {}
            for piece in self._of(index):
                change = noisy(changes.pop(piece.key), deviation)
                fresh[piece.key] = (base[piece.key] + change).astype(np.float32)
                squares += shards.squared_norm([fresh[piece.key]])
            data = shards.encode(fresh)
            self._keep(index, data)
            files.extend(shards.collect([(self._of(index), data)]).shards)
        return Manifest(self._pieces, tuple(files), math.sqrt(squares))

    def _mean(self, fit: Sequence[Update], index: int, clip: float | None) -> dict[str, Floats]:
        total = sum(each.weight for each in fit)
        sums = {piece.key: FixedSum(piece.shape, total_weight=total) for piece in self._of(index)}
        for update in fit:
            arrays = self._again(update, index)
            shrink = self._shrink(update, clip)
            for key, one in sums.items():
                values = arrays[key] if shrink == 1.0 else arrays[key] * np.float32(shrink)
                try:
                    one.add(values, update.weight, scale=update.scale)
                except SumOverflowError as error:
                    raise _UnfitError(update.client, "overflow", str(error)) from error
        return {key: one.mean() for key, one in sums.items()}

    def _robust(self, fit: Sequence[Update], index: int, rule: Rule, clip: float | None) -> dict[str, Floats]:
        changes: dict[str, Floats] = {}
        for piece, stack in self._stacks(fit, index, clip):
            changes[piece.key] = (
                robust.median(stack) if rule.name == "median" else robust.trimmed_mean(stack, rule.share)
            )
        return changes

    def _shrink(self, update: Update, clip: float | None) -> float:
        norm = self._norms[update.client]
        return 1.0 if clip is None or norm <= clip else clip / norm

    def _stacks(
        self, fit: Sequence[Update], only: int | None, clip: float | None = None
    ) -> Iterator[tuple[Piece, Floats]]:
        """Yield each piece with that of all updates, as of a whole epoch: (clients, …)."""
        for piece in self._pieces:
            if only is None or piece.shard == only:
                factors = [each.scale[0] / each.scale[1] * self._shrink(each, clip) for each in fit]
                rows = [
                    self._again(each, piece.shard)[piece.key] * np.float32(factor)
                    for each, factor in zip(fit, factors, strict=True)
                ]
                yield piece, np.stack(rows)

    # --- files

    def _of(self, index: int) -> tuple[Piece, ...]:
        return tuple(piece for piece in self._pieces if piece.shard == index)

    def _arrays(self, update: Update, index: int) -> dict[str, NDArray[Any]]:
        """Return an update's arrays of a shard, checked; several files are added in the order of their digests."""
        files = sorted(update.files, key=lambda file: file.manifest.digest)
        whole = self._decoded(update.client, 0, files[0], index)
        for number, file in enumerate(files[1:], start=1):
            more = self._decoded(update.client, number, file, index)
            whole = {key: values + more[key] for key, values in whole.items()}
        return whole

    def _again(self, update: Update, index: int) -> dict[str, NDArray[Any]]:
        """Return the arrays of an update that was fit; _UnfitError where its files are gone meanwhile."""
        try:
            return self._arrays(update, index)
        except ModelFileError as error:
            raise _UnfitError(update.client, error.reason, str(error)) from error

    def _decoded(self, client: str, number: int, file: File, index: int) -> dict[str, NDArray[Any]]:
        """Return the arrays of a shard of a file, checked; they are kept while there is room: they are needed twice."""
        key = (client, number, index)
        arrays = self._kept.get(key)
        if arrays is None:
            data = file.fetch(index)
            arrays = shards.decode(data, file.manifest, index)
            if self._kept_bytes + len(data) <= KEPT_BYTES:
                self._kept[key] = arrays
                self._kept_bytes += len(data)
            self._alive()
        return coding.decode_shard(arrays, self._of(index)) if file.coded else arrays


def noisy(values: Floats, deviation: float) -> NDArray[Any]:
    """Return values with Gaussian noise, which nobody can draw again: no seed of a run leads to it."""
    if not deviation:
        return values
    chance = np.random.Generator(np.random.Philox(secrets.randbits(128)))
    return values + chance.normal(0.0, deviation, values.shape)


class _UnfitError(ValueError):
    """A client's update, which was fit at first, cannot be summed: its values do not fit, or its files are gone."""

    def __init__(self, client: str, reason: str, message: str) -> None:
        super().__init__(message)
        self.client = client
        self.reason = reason
