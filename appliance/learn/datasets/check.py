"""What a folder of data holds, before anything is trained on it: `swiftbot learn data check`.

Names, lists and headers of files alone: no decoder is needed. A client that trains refuses what this refuses.
"""

from pathlib import Path
from typing import Literal

from msgspec import Struct

from appliance.errors import PayloadError
from appliance.skills._lib.learning import librispeech, listings, loading, partition, ucf101
from appliance.skills._lib.learning.listings import DataError, Listing

MOST_SHOWN = 200
"""Damaged files that are listed."""


class SplitReport(Struct, frozen=True, kw_only=True):
    """A split of a data set: how many items, groups (sites, speakers), and what is damaged."""

    split: str
    items: int
    groups: int
    damaged: int
    damaged_files: tuple[tuple[str, str], ...]
    """Path and reason, the first 200."""
    per_class: dict[str, int]
    notes: tuple[str, ...]
    refused: str
    """Why a client would not train on it; empty: it would."""


class DataReport(Struct, frozen=True, kw_only=True):
    """A data set."""

    folder: str
    layout: Literal["UCF101", "LibriSpeech"]
    classes: tuple[str, ...]
    splits: tuple[SplitReport, ...]


def check(folder: Path) -> DataReport:
    """Return what a folder holds; PayloadError where it has neither layout."""
    try:
        folder.stat()
    except (OSError, ValueError) as error:
        text = f"there is no folder {str(folder)[:200]!r}: {getattr(error, 'strerror', None) or error}"
        raise PayloadError(text, remedy="name a folder that holds UCF-101 or LibriSpeech") from error
    layout: Literal["UCF101", "LibriSpeech"] = "UCF101" if ucf101.is_here(folder) else "LibriSpeech"
    classes: tuple[str, ...] = ()
    reports: list[SplitReport] = []
    if not ucf101.is_here(folder) and not librispeech.is_here(folder):
        try:
            loading.read(folder, "train")
        except DataError as error:
            raise PayloadError(error.message, remedy=error.remedy) from error
    for split in ("train", "test"):
        try:
            listing = loading.read(folder, split)
        except DataError as error:
            reports.append(_none(split, error))
            continue
        classes = listing.classes or classes
        reports.append(_report(split, listing))
    return DataReport(folder=str(folder), layout=layout, classes=classes, splits=tuple(reports))


def _none(split: str, error: DataError) -> SplitReport:
    refused = f"{error.message}; {error.remedy}" if error.remedy else error.message
    return SplitReport(
        split=split, items=0, groups=0, damaged=0, damaged_files=(), per_class={}, notes=(), refused=refused
    )


def _report(split: str, listing: Listing) -> SplitReport:
    refused = ""
    try:
        listings.refuse_if_damaged(listing.damaged, len(listing.items), what=str(listing.folder))
    except DataError as error:
        refused = error.message
    labels = [item.label for item in listing.items]
    return SplitReport(
        split=split,
        items=len(listing.items),
        groups=len(listing.groups),
        damaged=len(listing.damaged),
        damaged_files=tuple((damage.path, damage.reason) for damage in listing.damaged[:MOST_SHOWN]),
        per_class={name: labels.count(name) for name in listing.classes},
        notes=listing.notes,
        refused=refused,
    )


def sizes(folder: Path, *, by: str, of: int, seed: int) -> tuple[int, ...]:
    """Return how many items each client of a partition has; PayloadError where the data cannot be shared out so.

    Args:
        folder: of the data set.
        by: `speaker`, `site`, `dirichlet:A` or `even`.
        of: clients.
        seed: of the partition: `seeds.seed(run_seed, 0, "", "partition")`.
    """
    try:
        listing = loading.read(folder, "train")
        return tuple(len(part) for part in partition.split(listing.items, by=by, of=of, seed=seed))
    except DataError as error:
        raise PayloadError(error.message, remedy=error.remedy) from error
