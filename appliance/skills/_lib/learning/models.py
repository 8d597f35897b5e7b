"""What a model is before any of its code runs: `model.toml` in its folder, read with the standard library alone.

    name = "clips"
    task = "classify"                     # or "transcribe"
    input = "clip"                        # "word", "sentence": what items become (`loading`)
    classes = ["Walk", "Wave", …]         # of a model whose data set names none itself
    optimiser = { name = "sgd", lr = 0.05, momentum = 0.9 }
    [[tensors]]
    name = "head.weight"
    shape = ["classes", 64]               # "classes" stands for how many there are

`model.py` beside it has `build(classes)`; it is run in containers only. The tensors listed here are those that travel
between clients, so what a file must hold is known without running anybody's code.
"""

import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from .seeds import seed

FOLDER = Path(__file__).resolve().parents[2] / "models"
"""The models that come with the product."""
TASKS = ("classify", "transcribe")
INPUTS = ("clip", "word", "sentence")

_NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")


class ModelError(ValueError):
    """A model's folder is not as it should be: names file and key."""


class Tensor(NamedTuple):
    """A tensor that clients train; all are float32."""

    name: str
    shape: tuple[int, ...]


class Model(NamedTuple):
    """A model as `model.toml` describes it."""

    name: str
    folder: Path
    task: Literal["classify", "transcribe"]
    input: Literal["clip", "word", "sentence"]
    classes: tuple[str, ...]
    optimiser: Mapping[str, Any]
    batch: int
    shapes: tuple[tuple[str, tuple[int | str, ...]], ...]

    def tensors(self, classes: int) -> tuple[Tensor, ...]:
        """Return its tensors for so many classes, sorted by name."""
        return tuple(
            Tensor(name, tuple(classes if size == "classes" else int(size) for size in shape))
            for name, shape in sorted(self.shapes)
        )

    def classes_of(self, shapes: Mapping[str, tuple[int, ...]]) -> int:
        """Return for how many classes tensors of these shapes are; its own number where no shape depends on it.

        Raises:
            ValueError: the shapes are not those of this model, for any number of classes.
        """
        found = {
            shapes[name][at]
            for name, shape in self.shapes
            for at, size in enumerate(shape)
            if size == "classes" and len(shapes.get(name, ())) == len(shape)
        }
        if len(found) > 1:
            raise ValueError(f"tensors of {self.name} are for {' and '.join(map(str, sorted(found)))} classes at once")
        return found.pop() if found else len(self.classes)


def names(folders: Iterable[Path] = (FOLDER,)) -> tuple[str, ...]:
    """Return the names of the models in folders of models, sorted."""
    return tuple(sorted({file.parent.name for folder in folders for file in folder.glob("*/model.toml")}))


def read(name: str, folders: Iterable[Path] = (FOLDER,)) -> Model:
    """Return a model by its name, from the first folder that has it.

    Raises:
        ModelError: there is none, or its file is wrong.
    """
    searched = tuple(folders)
    for folder in searched:
        if _NAME.fullmatch(name) and (folder / name / "model.toml").is_file():
            return _read(folder / name / "model.toml")
    raise ModelError(f"no model {name[:60]!r}; known: {', '.join(names(searched)) or 'none'}")


def _read(file: Path) -> Model:
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ModelError(f"{file}: cannot be read: {error}") from error
    name, task = table.get("name"), table.get("task")
    if name != file.parent.name:
        raise ModelError(f"{file}: name: {str(name)[:60]!r} is not the folder's name {file.parent.name!r}")
    if task not in TASKS:
        raise ModelError(f"{file}: task: {str(task)[:40]!r}; possible: {', '.join(TASKS)}")
    kind = table.get("input")
    if kind not in INPUTS:
        raise ModelError(f"{file}: input: {str(kind)[:40]!r}; possible: {', '.join(INPUTS)}")
    classes = table.get("classes", [])
    named = tuple(str(each) for each in cast("list[Any]", classes)) if isinstance(classes, list) else ()
    if not isinstance(classes, list) or len(set(named)) != len(named):
        raise ModelError(f"{file}: classes: a list of names, each once")
    batch = table.get("batch", 16)
    if not isinstance(batch, int) or isinstance(batch, bool) or not 1 <= batch <= 4096:
        raise ModelError(f"{file}: batch: a whole number from 1 to 4096")
    shapes = tuple(_shape(file, number, entry) for number, entry in enumerate(table.get("tensors", [])))
    if not shapes or len({each for each, _ in shapes}) != len(shapes):
        raise ModelError(f"{file}: tensors: at least one, each name once")
    return Model(str(name), file.parent, task, kind, named, table.get("optimiser", {}), batch, shapes)


def _shape(file: Path, number: int, entry: Any) -> tuple[str, tuple[int | str, ...]]:
    table: dict[str, Any] = cast("dict[str, Any]", entry) if isinstance(entry, dict) else {}
    name, shape = table.get("name"), table.get("shape")
    if not isinstance(name, str) or not isinstance(shape, list) or not shape:
        raise ModelError(f"{file}: tensors[{number}]: name and shape are needed")
    sizes = cast("list[Any]", shape)
    for size in sizes:
        if size != "classes" and not (isinstance(size, int) and not isinstance(size, bool) and size > 0):
            raise ModelError(f"{file}: tensors[{number}].shape: {size!r} is no size")
    return name, tuple(sizes)


def initial(tensors: Iterable[Tensor], run_seed: int) -> dict[str, NDArray[np.float32]]:
    """Return the values that a run begins with, by name: drawn with numpy, so each gateway has the same.

    Weights are normal with variance 2 / fan-in (He et al. 2015), the scales of normalisations 1, biases 0. A tensor of
    one dimension is a scale where its name ends in `weight`.
    """
    values: dict[str, NDArray[np.float32]] = {}
    for tensor in tensors:
        if len(tensor.shape) == 1:
            fill = 1.0 if tensor.name.endswith("weight") else 0.0
            values[tensor.name] = np.full(tensor.shape, fill, dtype=np.float32)
            continue
        rng = np.random.Generator(np.random.Philox(seed(run_seed, 0, tensor.name.replace("/", "."), "init")))
        spread = math.sqrt(2.0 / math.prod(tensor.shape[1:]))
        values[tensor.name] = (rng.standard_normal(tensor.shape) * spread).astype(np.float32)
    return values
