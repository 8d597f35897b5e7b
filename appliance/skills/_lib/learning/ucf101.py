"""Reads data laid out like UCF101 (Soomro et al. 2012): action clips in folders by class, split by official lists.

    UCF-101/CLASS/v_CLASS_gGG_cCC.avi
    ucfTrainTestlist/classInd.txt               "1 ApplyEyeMakeup"
    ucfTrainTestlist/trainlist01.txt … 03       "ApplyEyeMakeup/v_ApplyEyeMakeup_g08_c01.avi 1"
    ucfTrainTestlist/testlist01.txt … 03        "ApplyEyeMakeup/v_ApplyEyeMakeup_g01_c01.avi"

Clips of one group `gGG` show the same scene and person, so a random split would test on what was trained on: the lists
are the split. In file names HandstandPushups is written HandStandPushups; a clip's class is its folder.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from .listings import Damage, DataError, Item, Listing

VIDEOS, LISTS = "UCF-101", "ucfTrainTestlist"
Split = Literal["train", "test"]

_CLIP = re.compile(r"v_(?P<name>[A-Za-z0-9]+)_g(?P<group>\d{2,4})_c\d{2,4}\.avi")
_LAYOUT = f"it has {VIDEOS}/CLASS/v_CLASS_g01_c01.avi and {LISTS}/classInd.txt, trainlist01.txt, testlist01.txt"
_HEADER = 12
"""Bytes of a RIFF header: `RIFF`, length of what follows, `AVI `."""


def is_here(folder: Path) -> bool:
    """Whether a folder is laid out so."""
    return (folder / VIDEOS).is_dir() or (folder.name == VIDEOS and (folder.parent / LISTS).is_dir())


def read(folder: Path, split: Split = "train", *, number: int = 1) -> Listing:
    """Return the clips of an official list whose files are whole as far as their headers tell.

    Args:
        folder: the one that holds `UCF-101` and `ucfTrainTestlist`, or `UCF-101` beside `ucfTrainTestlist`.
        split: which list.
        number: of the three splits.

    Raises:
        DataError: the folder is not laid out so, or a list cannot be read.
    """
    root = _root(folder)
    classes = _classes(root / LISTS / "classInd.txt")
    items: list[Item] = []
    damaged: list[Damage] = []
    seen: set[str] = set()
    for path, label in _lines(root / LISTS / f"{split}list{number:02d}.txt"):
        if path in seen:
            damaged.append(Damage(path, "listed twice"))
            continue
        seen.add(path)
        item = _item(path, label, classes)
        if isinstance(item, Item) and (reason := problem(root / VIDEOS / path)):
            item = Damage(path, reason)
        if isinstance(item, Item):
            items.append(item._replace(path=f"{VIDEOS}/{path}"))
        else:
            damaged.append(item._replace(path=f"{VIDEOS}/{path}"))
    empty = sorted(set(classes) - {item.label for item in items})
    notes = (
        (f"{len(empty)} classes without a clip in {split}list{number:02d}: {', '.join(empty[:8])}",) if empty else ()
    )
    return Listing(root, tuple(sorted(items)), classes, tuple(damaged), notes)


def outline(folder: Path) -> tuple[tuple[str, ...], int]:
    """Return the classes, and how many clips are listed for training; DataError as `read`."""
    root = _root(folder)
    return _classes(root / LISTS / "classInd.txt"), sum(1 for _ in _lines(root / LISTS / "trainlist01.txt"))


def _root(folder: Path) -> Path:
    """Return the folder that holds videos and lists; DataError where it is not laid out so."""
    root = folder.parent if folder.name == VIDEOS and not (folder / VIDEOS).is_dir() else folder
    if not (root / VIDEOS).is_dir() or not (root / LISTS).is_dir():
        raise DataError(f"{folder} is not laid out like UCF101", _LAYOUT)
    return root


def places(folder: Path) -> Iterator[Path]:
    """Yield the lists and the folders of classes: their times change when a file comes, goes or is replaced."""
    root = folder.parent if folder.name == VIDEOS and not (folder / VIDEOS).is_dir() else folder
    yield from (root / LISTS).glob("*.txt")
    yield from (root / VIDEOS).iterdir()


def _classes(file: Path) -> tuple[str, ...]:
    names: list[str] = []
    for number, line in enumerate(_text(file), start=1):
        parts = line.split()
        if len(parts) != 2 or parts[0] != str(len(names) + 1) or parts[1] in names:
            raise DataError(
                f"{file}:{number}: {line[:80]!r} is not '{len(names) + 1} CLASS'",
                "number the classes from 1, each once",
            )
        names.append(parts[1])
    if not names:
        raise DataError(f"{file} names no class", _LAYOUT)
    return tuple(names)


def _lines(file: Path) -> Iterator[tuple[str, str]]:
    """Yield path and number of the class, which is empty in lists for testing."""
    for line in _text(file):
        path, _, label = line.partition(" ")
        yield path, label.strip()


def _text(file: Path) -> list[str]:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{file} cannot be read: {error}", _LAYOUT) from error
    return [line.strip() for line in text.splitlines() if line.strip()]


def _item(path: str, label: str, classes: tuple[str, ...]) -> Item | Damage:
    """Return what a line of a list names, without a look at the file."""
    parts = path.split("/")
    clip = _CLIP.fullmatch(parts[-1])
    if len(parts) != 2 or clip is None:
        return Damage(path, "not CLASS/v_CLASS_gGG_cCC.avi")
    name = parts[0]
    if name not in classes:
        return Damage(path, f"class {name} is not in classInd.txt")
    if clip["name"].lower() != name.lower():
        return Damage(path, f"a clip of {clip['name']} in the folder of {name}")
    if label and label != str(classes.index(name) + 1):
        return Damage(path, f"label {label[:20]} of {len(classes)}, {name} is {classes.index(name) + 1}")
    return Item(path, name, f"g{clip['group']}")


def problem(file: Path) -> str:
    """Return what is wrong with an AVI file by its header; empty when nothing is."""
    try:
        size = file.stat().st_size
        with file.open("rb") as data:
            header = data.read(_HEADER)
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if size < _HEADER or header[:4] != b"RIFF" or header[8:12] != b"AVI ":
        return "empty" if size == 0 else "no AVI file"
    announced = int.from_bytes(header[4:8], "little") + 8
    return f"truncated: {size:,} of {announced:,} bytes" if announced > size else ""
