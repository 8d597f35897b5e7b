"""Results of cells as files: each is written whole when its cell is done, and found again by its settings."""

import os
import time
from pathlib import Path
from typing import Any

import msgspec
import psutil
from msgspec import Struct

from workshop.bench.learning.cells import Cell


class Kept(Struct, frozen=True, kw_only=True):
    """A cell's file."""

    cell: str
    kind: str
    settings: dict[str, Any]
    result: dict[str, Any]
    finished: str
    """UTC."""
    took_s: float
    load: tuple[float, float]
    """Mean number of processes that ran or waited on this machine, of one minute, when the cell began and ended."""
    cores: int


def load_now() -> float:
    """Return how many processes run or wait on this machine, a mean of one minute."""
    return round(os.getloadavg()[0], 2)


def write(folder: Path, cell: Cell, result: dict[str, Any], *, took_s: float, load: tuple[float, float]) -> Kept:
    """Keep a cell's result; OSError where it cannot be written."""
    kept = Kept(
        cell=cell.name,
        kind=cell.kind,
        settings=cell.settings,
        result=result,
        finished=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        took_s=round(took_s, 1),
        load=load,
        cores=psutil.cpu_count() or 1,
    )
    folder.mkdir(parents=True, exist_ok=True)
    new = folder / f".{cell.name}.new"
    new.write_bytes(msgspec.json.format(msgspec.json.encode(kept)))
    new.replace(path_of(folder, cell))
    return kept


def path_of(folder: Path, cell: Cell) -> Path:
    """Return a cell's file."""
    return folder / f"{cell.name}.json"


def read(folder: Path, cell: Cell) -> Kept | None:
    """Return what is kept of a cell; None where nothing is, or of other settings, or the file is damaged."""
    try:
        kept = msgspec.json.decode(path_of(folder, cell).read_bytes(), type=Kept)
    except (OSError, msgspec.DecodeError):
        return None
    same = msgspec.json.encode(kept.settings, order="deterministic") == msgspec.json.encode(
        cell.settings, order="deterministic"
    )
    return kept if same and kept.kind == cell.kind else None
