"""Measures cells one after the other, each kept as a file, and puts what they show beside what was demanded."""

import fcntl
import time
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import anyio
import anyio.to_thread

from appliance.errors import PrerequisiteError, RefusedError
from appliance.pool import images
from appliance.skills.catalogue import load_catalogue
from workshop.bench.learning import data, figures, flower, live, store, virtual
from workshop.bench.learning.cells import Cell, Size, Workload, cells, chosen
from workshop.bench.learning.hostile import attackers
from workshop.bench.training import IMAGE, Trainer, open_trainer

Progress = Callable[[str], None]
AT_ONCE = 2
"""Containers that train side by side in virtual time: as many as the machines of these measurements have cores."""


class Bench:
    """Measures cells.

    Args:
        out: folder of results; data sets and what was decoded of them are kept in it too.
        progress: told what is being done.
    """

    def __init__(self, out: Path, progress: Progress) -> None:
        self._out = out
        self._progress = progress
        self._trainer: Trainer | None = None
        self._lock: BinaryIO | None = None
        self._made: dict[tuple[str, int, int], Path] = {}

    @property
    def _results(self) -> Path:
        return self._out / "cells"

    async def measure(self, wanted: Sequence[Cell], *, again: bool) -> None:
        """Measure those cells whose files are not there; with `again` all."""
        missing = [cell for cell in wanted if again or store.read(self._results, cell) is None]
        self._progress(f"{len(wanted) - len(missing)} of {len(wanted)} cells are there already")
        try:
            for number, cell in enumerate(missing, start=1):
                self._progress(f"cell {number} of {len(missing)}: {cell.name}")
                await self._cell(cell)
        finally:
            await self._close()

    async def _cell(self, cell: Cell) -> None:
        before, began = store.load_now(), time.monotonic()
        folder = await self._data(cell)
        result = await self._measurements[cell.kind](cell, folder)
        took_s = time.monotonic() - began
        await anyio.to_thread.run_sync(
            partial(store.write, self._results, cell, result, took_s=took_s, load=(before, store.load_now()))
        )
        self._progress(f"{cell.name} took {took_s:.0f} s")

    async def _data(self, cell: Cell) -> Path:
        wanted = (cell.settings["workload"], cell.settings["train_items"], cell.settings["test_items"])
        if wanted not in self._made:
            self._made[wanted] = await anyio.to_thread.run_sync(data.make, self._out / "data", *wanted, self._progress)
        return self._made[wanted]

    @property
    def _measurements(self) -> dict[str, Callable[[Cell, Path], Awaitable[dict[str, Any]]]]:
        return {
            "decided": self._decided,
            "virtual": self._virtual,
            "hostile": self._virtual,
            "wall": self._fleet(live.wall),
            "costs": self._fleet(live.costs),
            "takeover": self._fleet(live.takeover),
            "restart": self._fleet(live.restart),
            "clients": self._fleet(live.clients_killed),
            "flower": self._flower,
        }

    async def _held(self, cell: Cell, folder: Path) -> list[int]:
        count = partial(
            data.samples, folder, by=virtual.BY, clients=cell.settings["clients"], seed=cell.settings.get("seed", 1)
        )
        return await anyio.to_thread.run_sync(count)

    async def _decided(self, cell: Cell, folder: Path) -> dict[str, Any]:
        given = cell.settings
        return virtual.decide(
            given["workload"], given["mode"], clients=given["clients"], count=given["rounds"],
            held=await self._held(cell, folder), stragglers=given["stragglers"],
        )  # fmt: skip

    async def _virtual(self, cell: Cell, folder: Path) -> dict[str, Any]:
        given = cell.settings
        hostile = cell.kind == "hostile"
        return await virtual.train(
            await self._training(folder.parent),
            workload=given["workload"],
            mode="sync" if hostile else given["mode"],
            clients=given["clients"],
            count=given["rounds"],
            every=given["every"],
            seed=given["seed"],
            data=folder,
            held=await self._held(cell, folder),
            at_once=AT_ONCE,
            rule=given.get("rule", "mean"),
            attacks=attackers(given["attack"], given["clients"]) if hostile else {},
            stragglers=not hostile,
            progress=self._progress,
        )

    def _fleet(self, measure: Callable[..., Awaitable[dict[str, Any]]]) -> Callable[[Cell, Path], Awaitable[Any]]:
        async def on_a_fleet(cell: Cell, folder: Path) -> dict[str, Any]:
            await self._close()  # its containers would take the fleet's time
            await _check_image()
            return await measure(cell.settings, folder, self._progress)

        return on_a_fleet

    async def _flower(self, cell: Cell, folder: Path) -> dict[str, Any]:
        await self._close()
        return await flower.run(cell.settings, folder, await self._held(cell, folder), self._progress)

    async def _training(self, folder: Path) -> Trainer:
        """Return containers that train; those of the cell before, where they are there."""
        if self._trainer is None:
            await _check_image()
            self._lock = await anyio.to_thread.run_sync(alone, self._out / "pool")
            self._trainer = await open_trainer(
                self._out / "pool", load_catalogue(), data=folder, containers=AT_ONCE, rest_s=0.0
            )
        self._trainer.files.clear()
        return self._trainer

    async def _close(self) -> None:
        trainer, self._trainer = self._trainer, None
        lock, self._lock = self._lock, None
        try:
            if trainer is not None:
                with anyio.CancelScope(shield=True):
                    await trainer.pool.stop(keep_containers=False)
        finally:
            if lock is not None:
                lock.close()


def alone(folder: Path) -> BinaryIO:
    """Return a file that is locked until it is closed: two pools in one folder remove each other's files.

    Raises:
        RefusedError: another bench has it.
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = (folder / "lock").open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise RefusedError(
            f"another bench trains in {folder.parent}", remedy="wait until it ends, or give another --out"
        ) from error
    return file


async def _check_image() -> None:
    state = {each.name: each for each in await images.list_images(load_catalogue())}[IMAGE]
    if not state.present:
        raise PrerequisiteError(f"{state.reference} is not there", remedy="swiftbot images build learn")


async def run(
    out: Path,
    workload: Workload,
    size: Size,
    wanted: Sequence[str],
    *,
    again: bool = False,
    only_read: bool = False,
    progress: Progress,
) -> dict[str, Any]:
    """Measure what is missing, and return what all cells of this size show.

    Args:
        out: folder of results.
        workload: what is trained.
        size: how large the measurements are.
        wanted: kinds or names of cells; all where none is named.
        again: measure those that are there, too.
        only_read: measure nothing.
        progress: told what is being done.

    Returns:
        `figures`: figure, goal, value, whether it is `met` (None: not measured, or no goal) and the cells it is of;
        `cells`: by name the files' results with their machine's load; `missing`: cells that are not measured.

    Raises:
        ConfigError, PrerequisiteError, PoolError, UnreachableError, DeadlineError: a cell cannot be measured.
    """
    every = cells(workload, size)
    picked = chosen(every, wanted)
    bench = Bench(out, progress)
    if not only_read:
        await bench.measure(picked, again=again)
    kept = {cell.name: store.read(out / "cells", cell) for cell in every}
    there = {name: each for name, each in kept.items() if each is not None}
    return {
        "workload": workload,
        "size": size,
        "figures": [figure._asdict() for figure in figures.judge(workload, list(there.values()))],
        "missing": [name for name, each in kept.items() if each is None],
        "cells": {
            name: {
                "finished": each.finished,
                "took_s": each.took_s,
                "load": list(each.load),
                "cores": each.cores,
                **each.result,
            }
            for name, each in there.items()
        },
    }
