"""The arguments of `train_local`, `aggregate` and `evaluate`, read and checked: a run's parameters are JSON of others.

    train_local  run, round, client, attempt, model, base, data, part, epochs, batch, optimiser, seed, stop_at_s,
                 most_steps, speed, nominal_batch_s, every_steps, compression, residual, secure, clip
    aggregate    run, round, model, base, updates, rule, clip, seed, classes, report, masks, noise
    evaluate     model, base, data, part, split, limit, seed, export

A subtask of a plan gives `model` alone, or with `epochs`: all else has a usual value.

`part` is `{"by", "index", "of", "indices"}`: the client's share (`partition.split`), and of it only those positions,
where `indices` is a list: what is left of a slow client's share for a helper.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any, Literal, NamedTuple, cast

from .masks import Seed, read_seeds

MOST_EPOCHS = 1000
MOST_BATCH = 4096
MOST_UPDATES = 10_000
MOST_WEIGHT = 1 << 40
"""Weight of an update at most: 2^30 samples in units of 1/1024."""
_DEFAULT_PART = {"by": "even", "index": 0, "of": 1}

Table = dict[str, Any]
Coding = Literal["none", "int8", "masked"]
"""How an update's values are written: as they are, in 8 bits (`coding`), or so that their sum alone says something."""


class OrderError(ValueError):
    """A parameter cannot be; the message names it, `remedy` what it may be."""

    def __init__(self, name: str, value: object, remedy: str) -> None:
        super().__init__(f"{name} is {repr(value)[:80]}")
        self.remedy = f"{name}: {remedy}"


class Part(NamedTuple):
    """A client's share of a data set: that of client `number` of `of`."""

    by: str
    number: int
    of: int
    indices: tuple[int, ...] | None


class Optimiser(NamedTuple):
    """How steps are made."""

    name: Literal["sgd", "adam"]
    lr: float
    momentum: float


class Base(NamedTuple):
    """A model as artifacts: its manifest (a table, or a reference to one) and references to its shards."""

    manifest: Table
    shards: tuple[Table, ...]


class Training(NamedTuple):
    """What `train_local` is asked for."""

    run: str
    round: int
    client: str
    model: str
    base: Base | None
    data: str
    part: Part
    epochs: int
    batch: int | None
    optimiser: Optimiser | None
    seed: int
    stop_at_s: float | None
    most_steps: int | None
    speed: float
    nominal_batch_s: float | None
    every_steps: int
    compression: Coding
    residual: tuple[tuple[Table, ...], ...]
    """What coding left over of the client's last update, to be added to this one: files of one or several parts of it,
    each as a list of references."""
    secure: str
    """Names the masks that the update is sent with; empty: none."""
    clip: float | None
    """Of a masked update: its longest norm. Its weight is 1 then, whatever its samples."""


class Update(NamedTuple):
    """A client's update; several of one client are parts of one whole, and have one weight and scale.

    `scale` is numerator and denominator, for work that was done in part.
    """

    client: str
    manifest: Table
    shards: tuple[Table, ...]
    weight: int
    scale: tuple[int, int]
    coding: Coding


class Rule(NamedTuple):
    """How updates become one: `mean`, `median`, `trimmed` (`share`), `multikrum` (`hostile`)."""

    name: Literal["mean", "median", "trimmed", "multikrum"]
    share: float
    hostile: int


class Aggregation(NamedTuple):
    """What `aggregate` is asked for."""

    model: str
    base: Base | None
    updates: tuple[Update, ...]
    rule: Rule
    clip: float | None
    seed: int
    classes: int | None
    report: bool
    """Whether too few fit updates are a result and no failure."""
    noise: float | None
    """Standard deviation of the noise that is added to the weighted sum; None: none is."""
    masks: tuple[Seed, ...] | None
    """Those that are left in the sum of masked updates; None: they are not masked."""


class Evaluation(NamedTuple):
    """What `evaluate` is asked for."""

    model: str
    base: Base | None
    data: str
    part: Part
    split: Literal["train", "test"]
    limit: int | None
    seed: int
    export: Literal["", "onnx"]
    """Write the model in this format in place of judging it."""


def training(params: Mapping[str, Any], *, robot: str | None) -> Training:
    """Read the arguments of `train_local`; OrderError where one cannot be."""
    table = dict(params)
    model = _text(table, "model")
    return Training(
        run=_text(table, "run", ""),
        round=_whole(table, "round", 0, low=0, high=1 << 31),
        client=_text(table, "client", robot or ""),
        model=model,
        base=_base(table.get("base"), "base"),
        data=_data(table, model),
        part=_part(table),
        epochs=_whole(table, "epochs", 1, low=1, high=MOST_EPOCHS),
        batch=None if table.get("batch") is None else _whole(table, "batch", 16, low=1, high=MOST_BATCH),
        optimiser=_optimiser(table.get("optimiser")),
        seed=_whole(table, "seed", 0, low=0, high=1 << 63),
        stop_at_s=_optional(table, "stop_at_s"),
        most_steps=None if table.get("most_steps") is None else _whole(table, "most_steps", 1, low=1, high=1 << 31),
        speed=_number(table, "speed", 1.0, low=0.01, high=1000.0),
        nominal_batch_s=_optional(table, "nominal_batch_s"),
        every_steps=_whole(table, "every_steps", 0, low=0, high=1 << 31),
        compression=_coding(table.get("compression", "none"), "compression"),
        residual=tuple(
            _references(row, f"residual[{number}]")
            for number, row in enumerate(_rows(table.get("residual") or (), "residual"))
        ),
        secure=_text(table, "secure", ""),
        clip=_optional(table, "clip"),
    )


def aggregation(params: Mapping[str, Any]) -> Aggregation:
    """Read the arguments of `aggregate`; OrderError where one cannot be."""
    table = dict(params)
    updates = _rows(table.get("updates"), "updates")
    if not 0 < len(updates) <= MOST_UPDATES:
        raise OrderError("updates", len(updates), f"1 to {MOST_UPDATES:,}")
    found = tuple(_update(row, number) for number, row in enumerate(updates))
    whole = {each.client: each for each in reversed(found)}
    for number, each in enumerate(found):
        first = whole[each.client]
        if (each.weight, each.scale) != (first.weight, first.scale):
            raise OrderError(
                f"updates[{number}].weight", each.weight, f"that of the other parts of {each.client}, scale too"
            )
    return Aggregation(
        model=_text(table, "model"),
        base=_base(table.get("base"), "base"),
        updates=found,
        rule=_rule(table.get("rule")),
        clip=_optional(table, "clip"),
        seed=_whole(table, "seed", 0, low=0, high=1 << 63),
        classes=None if table.get("classes") is None else _whole(table, "classes", 1, low=1, high=100_000),
        report=_flag(table, "report"),
        noise=_optional(table, "noise"),
        masks=_masks(table.get("masks"), found),
    )


def _masks(value: object, updates: Sequence[Update]) -> tuple[Seed, ...] | None:
    given, coded = value is not None, {each.coding == "masked" for each in updates}
    if coded != {given} or (given and len({each.client for each in updates}) < len(updates)):
        raise OrderError("masks", "given" if given else None, "given with masked updates, one a client, and only then")
    try:
        return None if value is None else read_seeds(value)
    except ValueError as error:
        raise OrderError("masks", "a list", str(error)) from error


def evaluation(params: Mapping[str, Any]) -> Evaluation:
    """Read the arguments of `evaluate`; OrderError where one cannot be."""
    table = dict(params)
    model = _text(table, "model")
    split = table.get("split", "test")
    if split not in ("train", "test"):
        raise OrderError("split", split, "train or test")
    export = table.get("export") or ""
    if export not in ("", "onnx"):
        raise OrderError("export", export, "onnx, or nothing")
    return Evaluation(
        model=model,
        base=_base(table.get("base"), "base"),
        data=_data(table, model),
        part=_part(table),
        split=split,
        limit=None if table.get("limit") is None else _whole(table, "limit", 1, low=1, high=1 << 31),
        seed=_whole(table, "seed", 0, low=0, high=1 << 63),
        export=export,
    )


def _text(table: Table, name: str, default: str | None = None) -> str:
    value = table.get(name, default)
    if not isinstance(value, str) or len(value) > 200 or (not value and default is None) or "/" in value:
        raise OrderError(name, value, "a name without '/'")
    return value


def _whole(table: Table, name: str, default: int, *, low: int, high: int) -> int:
    value = table.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise OrderError(name, value, f"a whole number from {low:,} to {high:,}")
    return value


def _flag(table: Table, name: str) -> bool:
    value = table.get(name, False)
    if not isinstance(value, bool):
        raise OrderError(name, value, "true or false")
    return value


def _number(table: Table, name: str, default: float, *, low: float, high: float) -> float:
    value = table.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise OrderError(name, value, f"a number from {low:g} to {high:g}")
    return float(value)


def _optional(table: Table, name: str) -> float | None:
    if table.get(name) is None:
        return None
    value = _number(table, name, 0.0, low=0.0, high=1e9)
    if not value > 0 or not math.isfinite(value):
        raise OrderError(name, value, "a number above 0, or null")
    return value


def _table(value: object, name: str) -> Table:
    if not isinstance(value, dict):
        raise OrderError(name, value, "a table")
    return cast("Table", value)


def _rows(value: object, name: str) -> list[Any]:
    if not isinstance(value, list | tuple):
        raise OrderError(name, value, "a list")
    return list(cast("Sequence[Any]", value))


def _references(value: object, name: str) -> tuple[Table, ...]:
    rows = tuple(_table(row, f"{name}[{number}]") for number, row in enumerate(_rows(value, name)))
    for number, row in enumerate(rows):
        if not isinstance(row.get("artifact"), str):
            raise OrderError(f"{name}[{number}]", row, "a reference to an artifact")
    return rows


def _base(value: object, name: str) -> Base | None:
    if value is None:
        return None
    table = _table(value, name)
    return Base(_table(table.get("manifest"), f"{name}.manifest"), _references(table.get("shards"), f"{name}.shards"))


def _data(table: Table, model: str) -> str:
    """Return the path of the data set within the folder of data sets."""
    value = _table(table.get("data") or {"name": model}, "data")
    found = value.get("name", value.get("folder"))
    parts = PurePosixPath(found).parts if isinstance(found, str) else ()
    if not parts or ".." in parts or parts[0] == "/":
        raise OrderError(
            "data", found, "a name or path within the gateway's folder of data sets; set pool.folders.learning to that"
        )
    return str(PurePosixPath(*parts))


def _part(table: Table) -> Part:
    value = _table(table.get("part") or _DEFAULT_PART, "part")
    of = _whole(value, "of", 1, low=1, high=1 << 20)
    indices = value.get("indices")
    if indices is not None:
        rows = _rows(indices, "part.indices")
        if not rows or any(isinstance(row, bool) or not isinstance(row, int) or row < 0 for row in rows):
            raise OrderError("part.indices", indices, "a list of positions in the client's share, or null")
        if len(set(rows)) != len(rows):
            raise OrderError("part.indices", indices, "each position once")
        indices = tuple(rows)
    by = value.get("by", "even")
    if not isinstance(by, str):
        raise OrderError("part.by", by, "speaker, site, dirichlet:A or even")
    return Part(by, _whole(value, "index", 0, low=0, high=of - 1), of, indices)


def _optimiser(value: object) -> Optimiser | None:
    if value is None:
        return None
    table = _table(value, "optimiser")
    name = table.get("name", "sgd")
    if name not in ("sgd", "adam"):
        raise OrderError("optimiser.name", name, "sgd or adam")
    return Optimiser(
        name,
        _number(table, "lr", 0.05 if name == "sgd" else 0.001, low=1e-8, high=10.0),
        _number(table, "momentum", 0.0, low=0.0, high=0.9999),
    )


def optimiser_of(model: Mapping[str, Any]) -> Optimiser:
    """Return the optimiser that a `model.toml` names; plain SGD where it names none."""
    return _optimiser(dict(model) or {"name": "sgd"}) or Optimiser("sgd", 0.05, 0.0)


def _update(value: object, number: int) -> Update:
    where = f"updates[{number}]"
    table = _table(value, where)
    scale = table.get("scale", 1)
    if isinstance(scale, dict):
        both = cast("Table", scale)
        pair = (_whole(both, "num", 1, low=1, high=1 << 31), _whole(both, "den", 1, low=1, high=1 << 31))
    elif scale == 1:
        pair = (1, 1)
    else:
        raise OrderError(f"{where}.scale", scale, "1, or {num, den}")
    return Update(
        client=_text(table, "client"),
        manifest=_table(table.get("manifest"), f"{where}.manifest"),
        shards=_references(table.get("shards"), f"{where}.shards"),
        weight=_whole(table, "weight", 0, low=1, high=MOST_WEIGHT),
        scale=pair,
        coding=_coding(table.get("coding", "none"), f"{where}.coding"),
    )


def _coding(value: object, name: str) -> Coding:
    if value not in ("none", "int8", "masked"):
        raise OrderError(name, value, "none, int8 or masked")
    return value


def _rule(value: object) -> Rule:
    table = _table({"name": "mean"} if value is None else value, "rule")
    name = table.get("name")
    if name not in ("mean", "median", "trimmed", "multikrum"):
        raise OrderError("rule.name", name, "mean, median, trimmed or multikrum")
    return Rule(
        name, _number(table, "share", 0.2, low=0.0, high=0.4999), _whole(table, "hostile", 1, low=0, high=MOST_UPDATES)
    )
