"""Reads data laid out like LibriSpeech (Panayotov et al. 2015): recordings by speaker and chapter, with transcripts.

    LibriSpeech/SUBSET/SPEAKER/CHAPTER/SPEAKER-CHAPTER-UTTERANCE.flac
    LibriSpeech/SUBSET/SPEAKER/CHAPTER/SPEAKER-CHAPTER.trans.txt      "84-121123-0000 GO DO YOU HEAR"
    LibriSpeech/SPEAKERS.TXT                                          "84 | F | dev-clean | 8.02 | Christie Nowakowski"

16 kHz, one channel. Subsets are split by name: `train-…`, `dev-…`, `test-…`. Speakers of one subset are in no other, so
a test is always on voices that are not in the training part.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from .listings import Damage, DataError, Item, Listing

HOME = "LibriSpeech"
RATE = 16_000
Split = Literal["train", "dev", "test"]

_LAYOUT = f"it has {HOME}/train-…/SPEAKER/CHAPTER/SPEAKER-CHAPTER-0000.flac and SPEAKER-CHAPTER.trans.txt beside them"
_NUMBER = re.compile(r"\d+")
_STREAMINFO = 42
"""Bytes to the end of a FLAC file's STREAMINFO: `fLaC`, block header, 34 bytes."""


def is_here(folder: Path) -> bool:
    """Whether a folder is laid out so."""
    return (folder / HOME).is_dir() or folder.name == HOME


def read(folder: Path, split: Split = "train") -> Listing:
    """Return the recordings of all subsets of a split whose files are whole as far as their headers tell.

    Args:
        folder: `LibriSpeech`, or the one that holds it.
        split: which subsets, by the beginning of their names.

    Raises:
        DataError: the folder is not laid out so, or has no subset of that split.
    """
    home, subsets = _subsets(folder, split)
    known = _speakers(home / "SPEAKERS.TXT")
    items: list[Item] = []
    damaged: list[Damage] = []
    for subset in subsets:
        for chapter in sorted(subset.glob("*/*")):
            if chapter.is_dir() and _NUMBER.fullmatch(chapter.name) and _NUMBER.fullmatch(chapter.parent.name):
                _read_chapter(home, chapter, items, damaged)
    unknown = sorted({item.group for item in items} - known) if known else []
    notes = (f"{len(unknown)} speakers are not in SPEAKERS.TXT: {', '.join(unknown[:8])}",) if unknown else ()
    return Listing(home, tuple(sorted(items)), (), tuple(damaged), notes)


def count(folder: Path) -> int:
    """Return how many recordings have a transcript in the subsets for training; DataError as `read`."""
    _, subsets = _subsets(folder, "train")
    return sum(len(_transcripts(file)) for subset in subsets for file in subset.glob("*/*/*.trans.txt"))


def _subsets(folder: Path, split: str) -> tuple[Path, list[Path]]:
    """Return the folder of subsets, and those of a split; DataError where there is none."""
    home = folder / HOME if (folder / HOME).is_dir() else folder
    if not home.is_dir():
        raise DataError(f"{folder} is not laid out like LibriSpeech", _LAYOUT)
    subsets = sorted(each for each in home.iterdir() if each.is_dir() and each.name.split("-")[0] == split)
    if not subsets:
        raise DataError(f"{home} has no subset {split} or {split}-…", _LAYOUT)
    return home, subsets


def places(folder: Path) -> Iterator[Path]:
    """Yield the folders of chapters and their transcripts: their times change when something of them does."""
    home = folder / HOME if (folder / HOME).is_dir() else folder
    yield home / "SPEAKERS.TXT"
    for chapter in home.glob("*/*/*"):
        yield chapter
        yield chapter / f"{chapter.parent.name}-{chapter.name}.trans.txt"


def _speakers(file: Path) -> set[str]:
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return set()
    return {line.split("|")[0].strip() for line in lines if line.strip() and not line.startswith(";")}


def _read_chapter(home: Path, chapter: Path, items: list[Item], damaged: list[Damage]) -> None:
    speaker, stem = chapter.parent.name, f"{chapter.parent.name}-{chapter.name}"
    said = _transcripts(chapter / f"{stem}.trans.txt")
    files = {file.stem: file for file in sorted(chapter.glob("*.flac"))}
    for name in sorted(said.keys() | files.keys()):
        file = files.get(name, chapter / f"{name}.flac")
        path = file.relative_to(home).as_posix()
        text = said.get(name)
        reason = problem(file)
        if not reason and text is None:
            reason = f"no transcript in {stem}.trans.txt"
        elif not reason and not (name.startswith(f"{stem}-") and text):
            reason = "an empty transcript" if not text else f"not a recording of {stem}"
        if reason or text is None:
            damaged.append(Damage(path, reason))
        else:
            items.append(Item(path, text, speaker))


def _transcripts(file: Path) -> dict[str, str]:
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    pairs = (line.strip().partition(" ") for line in lines if line.strip())
    return {name: " ".join(text.upper().split()) for name, _, text in pairs}


def problem(file: Path) -> str:
    """Return what is wrong with a FLAC file by its header; empty when nothing is."""
    try:
        size = file.stat().st_size
        with file.open("rb") as data:
            header = data.read(_STREAMINFO)
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if size <= _STREAMINFO or header[:4] != b"fLaC" or header[4] & 0x7F:
        return "empty" if size == 0 else "no FLAC file"
    bits = int.from_bytes(header[18:26], "big")
    rate, channels, samples = bits >> 44, (bits >> 41 & 7) + 1, bits & (1 << 36) - 1
    if rate != RATE:
        return f"{rate:,} Hz, not {RATE:,}"
    if channels != 1:
        return f"{channels} channels, not one"
    return "it holds no sound" if not samples else ""
