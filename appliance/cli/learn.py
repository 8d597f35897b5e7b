"""Federated learning: `swiftbot learn …`. Its orders are made from the registry of operations."""

import asyncio
import time
from contextlib import aclosing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, WORK, Json, Where, Why, json_line, show
from appliance.errors import ConfigError, Exit, NotFoundError, SwiftbotError

if TYPE_CHECKING:  # commands import their room when they run
    from appliance.client import FleetClient
    from appliance.model.learn_api import LearnShown
    from appliance.model.learning import Model, Recipe, RunRecord
    from appliance.skills.catalogue import Catalogue

learn_app = App(
    name="learn", help="Train models over the fleet: start, watch and steer runs, export models.", group=WORK
)
data_app = App(name="data", help="Check data sets, make stand-ins.")
learn_app.command(data_app)

AWAITED_ROUNDS = 5
"""A round's line is printed without its accuracy when so many more are closed."""
STAND_INS = ("clips", "words", "sentences")


def add_to(app: App) -> None:
    """Add this group."""
    app.command(learn_app)


@learn_app.command(name="start")
async def learn_start(
    recipe: str,
    /,
    *,
    name: Annotated[str, Parameter(help="Run ID; the recipe's model and the time if not given.")] = "",
    clients: Annotated[int | None, Parameter(help="Split the data set among so many clients.")] = None,
    robots: Annotated[
        str, Parameter(help="Robots as clients, commas between, or all; each with the data at its gateway.")
    ] = "",
    rounds: Annotated[int | None, Parameter(help="Rounds at most.")] = None,
    target: Annotated[float | None, Parameter(help="Accuracy at which the run has succeeded.")] = None,
    mode: Annotated[str, Parameter(help="auto, sync, buffered, partial or offload.")] = "",
    data: Annotated[str, Parameter(help="Data set in the gateways' folder `learning`.")] = "",
    share: Annotated[str, Parameter(help="Who else may train on a slow client's samples: never, gateway, fleet.")] = "",
    seed: Annotated[int | None, Parameter(help="Seed of everything that chance decides.")] = None,
    watch: Annotated[bool, Parameter(help="Follow the run to its end.")] = False,
    why: Why = "",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Start a run of a recipe: one of the product's, or a TOML file. Its clients train until the rounds are done.

    Args:
        recipe: clips, words, sentences, or a file (docs/learning.md).
    """
    from appliance.learn import recipe as recipes

    path = recipes.find(recipe)
    wanted = _with_options(
        recipes.load(path), clients=clients, rounds=rounds, target=target, mode=mode, data=data, share=share, seed=seed
    )
    if robots and clients is not None:
        raise ConfigError("both --clients and --robots are given", remedy="give one of them")
    recipes.check(wanted, str(path))
    if not where.connect:
        await _make_ready(where, wanted)
    run = name or f"{wanted.model}-{time.strftime('%m%d-%H%M%S')}"
    async with where.client() as client:
        if robots:
            wanted = recipes.for_robots(wanted, await _robots(client, robots), str(path))
        started = await client.learn_start(run, wanted, why=why)
        if not watch:
            show(started, as_json=as_json, table=f"run {started.id} started: swiftbot learn watch {started.id}")
            return Exit.DONE
        return await _follow(client, started.id, as_json=as_json)


async def _robots(client: "FleetClient", text: str) -> tuple[str, ...]:
    """Return the robots that are listed, or all that are there."""
    if text != "all":
        return tuple(name for name in text.split(",") if name)
    await client.gateway()
    return tuple(sorted(name for name, robot in client.plane.registry.robots.items() if robot.online))


async def _make_ready(where: Where, recipe: "Recipe") -> None:
    """Build the image and make the stand-in data that a run on this machine's fleet needs, where they are missing."""
    from appliance.learn.datasets.make import is_whole
    from appliance.pool.images import build

    await build("learn", await asyncio.to_thread(_catalogue, where), progress=console.err.print)
    wanted = recipe.data.folder or recipe.data.name or recipe.model
    if wanted in STAND_INS and not all(map(is_whole, _folders(where, wanted))):
        console.err.print(f"making the stand-in data set {wanted}: not all folders of the gateways have it")
        await asyncio.to_thread(_make, wanted, _folders(where, wanted))


def _catalogue(where: Where) -> "Catalogue":
    """The skills and images of the local fleet's gateways."""
    from appliance.config import load
    from appliance.connection import read_state
    from appliance.skills.catalogue import load_catalogue

    state = read_state(where.folder())
    config = load(Path(state.directory) / state.gateways[0] / "gateway.toml")
    return load_catalogue(tuple(Path(each).expanduser() for each in config.skills))


def _with_options(
    recipe: "Recipe",
    *,
    clients: int | None,
    rounds: int | None,
    target: float | None,
    mode: str,
    data: str,
    share: str,
    seed: int | None,
) -> "Recipe":
    """Return a recipe with what the command line says; ConfigError names the option."""
    import msgspec

    from appliance.learn.recipe import read_table

    table: dict[str, Any] = msgspec.to_builtins(recipe)

    def put(section: str, values: dict[str, Any]) -> None:
        given = {key: value for key, value in values.items() if value not in (None, "")}
        if given:
            table[section] = {**table.get(section, {}), **given}

    put("clients", {"partitions": clients})
    put("rounds", {"count": rounds, "target": target, "mode": mode})
    put("data", {"name": data, "share": share})
    if data:
        table["data"].pop("folder", None)
    if seed is not None:
        table["seed"] = seed
    return read_table(table, "options")


@learn_app.command(name="watch")
async def learn_watch(run: str, /, *, as_json: Json = False, where: Where = HERE) -> int:
    """Follow a run to its end: a line for each round; with --json the run's record in a line whenever it changes.

    Args:
        run: Run ID, as `swiftbot learn list` shows it.
    """
    async with where.client() as client:
        return await _follow(client, run, as_json=as_json)


async def _follow(client: "FleetClient", run: str, *, as_json: bool) -> int:
    """Print what happens to a run until it has ended; exit code 0 where it has succeeded."""
    from appliance.model.learning import RunState

    printed, waits, last = 0, "", ""
    async with aclosing(client.learn_watch(run)) as changes:
        async for found in changes:
            record = found.run
            if as_json:
                line = json_line(record)
                if line != last:
                    console.out.file.write(line + "\n")
                    console.out.file.flush()
                last = line
            else:
                printed = _print_rounds(record, printed, ended=record.state.final and _evaluated(record))
                waits = _print_waits(found, waits)
            if record.state.final and _evaluated(record):
                if not as_json:
                    console.out.print(f"run {run} {record.state}: {record.why}")
                return Exit.DONE if record.state is RunState.SUCCEEDED else Exit.FAILED
    return Exit.FAILED


def _evaluated(run: "RunRecord") -> bool:
    """Whether nothing more is awaited of a run that has ended: its last model's evaluation comes after it."""
    awaited = run.recipe.evaluation.every and run.model.digest and run.state == "succeeded"
    return not awaited or run.model.accuracy is not None or time.time_ns() - run.updated_ns > 60e9


def _print_rounds(run: "RunRecord", printed: int, *, ended: bool) -> int:
    """Print the rounds that are closed and evaluated since; returns the number of the last one printed.

    One whose model is evaluated while later rounds run is waited for so long, since lines are in order.
    """
    from appliance.learn.tables import number, seconds

    evaluated = run.recipe.evaluation.every and not ended
    for line in run.history:
        if line.number <= printed:
            continue
        if evaluated and line.accuracy is None and run.history[-1].number - line.number < AWAITED_ROUNDS:
            break
        printed = line.number
        console.out.print(
            f"round {line.number}/{run.recipe.rounds.count}: {line.clients} clients, {line.samples:,} samples, "
            f"{seconds(line.took_s)}, loss {number(line.loss)}, accuracy {number(line.accuracy)} ({line.why})"
        )
    return printed


def _print_waits(found: "LearnShown", before: str) -> str:
    """Print what a round waits for where that lasts; returns it."""
    waits = found.round.waits if found.round is not None and found.elapsed_s > 10 and not found.run.state.final else ""
    if waits and waits != before:
        console.out.print(f"round {found.run.round} waits for {waits}", style="dim")
    return waits


@learn_app.command(name="export")
async def learn_export(
    run: str,
    folder: Path,
    /,
    *,
    model: Annotated[int | None, Parameter(help="Model number; the newest if not given.")] = None,
    format: Annotated[  # noqa: A002 - the name of the option
        Literal["safetensors", "onnx"], Parameter(help="safetensors, or onnx: one file for onnxruntime.")
    ] = "safetensors",
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Write a model: safetensors shards with manifest and classes, for `pool.folders.learning`/models/NAME; or ONNX.

    The ONNX file is made in a container of image `learn`, and written once onnxruntime computes with it what PyTorch
    computes with the model.

    Args:
        run: Run ID.
        folder: Folder to write; made where there is none.
    """
    from appliance.learn.export import check_files, check_onnx, write_files, write_onnx

    async with where.client() as client:
        record = (await client.learn_show(run)).run
        wanted = _model(list(record.models), model, run)
        if wanted.manifest is None:
            raise NotFoundError(f"model {wanted.number} of run {run} has no files")
        value: dict[str, Any] = {"run": run, "model": wanted.number, "digest": wanted.digest, "format": format}
        if format == "onnx":
            console.err.print(f"writing model {wanted.number} as ONNX, in a container")
            made = await client.learn_export(run, model=wanted.number)
            data, checks = await client.artifact(made.file), await client.artifact(made.checks)
            value["difference"] = await asyncio.to_thread(check_onnx, data, checks)
            written = await asyncio.to_thread(write_onnx, folder, record.recipe.model, data, record.classes)
        else:
            manifest = await client.artifact(wanted.manifest)
            files: list[bytes] = []
            for number, reference in enumerate(wanted.shards, start=1):
                console.err.print(f"shard {number} of {len(wanted.shards)}, {reference.get('bytes', 0):,} bytes")
                files.append(await client.artifact(reference))
            check_files(manifest, files)
            written = await asyncio.to_thread(write_files, folder, manifest, files, record.classes)
    value["files"] = [str(path) for path in written]
    same = f", the same as PyTorch to {value['difference']:.1g}" if "difference" in value else ""
    show(value, as_json=as_json, table=f"model {wanted.number} of {run}: {', '.join(value['files'])}{same}")
    return Exit.DONE


def _model(found: "list[Model]", number: int | None, run: str) -> "Model":
    kept = [model for model in found if number is None or model.number == number]
    if not kept:
        what = "no model yet" if number is None else f"no model {number}"
        raise NotFoundError(f"run {run} keeps {what}", remedy=f"swiftbot learn models {run}")
    return kept[-1]


@learn_app.command(name="eval")
async def learn_eval(
    run: str,
    /,
    *,
    model: Annotated[int | None, Parameter(help="Model number; the newest if not given.")] = None,
    limit: Annotated[int | None, Parameter(help="Items at most.")] = None,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Evaluate a model that a run keeps on the test part of its data set.

    Args:
        run: Run ID.
    """
    async with where.client() as client:
        found = await client.learn_eval(run, model=model, limit=limit)
    loss = "" if found.loss is None else f", loss {found.loss:.3f}"
    text = f"model {found.model} of {run}: accuracy {found.accuracy:.4f}{loss}, {found.items:,} items"
    show(found, as_json=as_json, table=text)
    return Exit.DONE


@data_app.command(name="check")
async def data_check(folder: Path, /, *, as_json: Json = False) -> int:
    """Check a folder of data in the layout of UCF101 or LibriSpeech: classes, items, damaged files.

    Args:
        folder: The data set.
    """
    from appliance.learn.datasets.check import check

    report = await asyncio.to_thread(check, folder)
    lines = [f"{report.folder}: layout {report.layout}, {len(report.classes)} classes"]
    for split in report.splits:
        lines.append(f"{split.split}: {split.items:,} items of {split.groups} groups, {split.damaged} damaged")
        lines += [f"  {path}: {reason}" for path, reason in split.damaged_files[:10]]
        lines += [f"  {note}" for note in split.notes]
        lines += [f"  refused: {split.refused}"] if split.refused else []
    show(report, as_json=as_json, table="\n".join(lines))
    return Exit.FAILED if any(split.refused for split in report.splits) else Exit.DONE


@data_app.command(name="make")
async def data_make(
    kind: str,
    folder: Path | None = None,
    /,
    *,
    as_json: Json = False,
    where: Where = HERE,
) -> int:
    """Make a stand-in data set: drawn clips, or spoken words or sentences, in the layouts of the real ones.

    Args:
        kind: clips, words or sentences.
        folder: Where to; the folders `learning` of the local fleet's gateways if not given.
    """
    if kind not in STAND_INS:
        raise ConfigError(f"no stand-in {kind!r}", remedy=f"one of {', '.join(STAND_INS)}")
    targets = [folder] if folder is not None else _folders(where, kind)
    count = await asyncio.to_thread(_make, kind, targets)
    value = {"kind": kind, "files": count, "folders": [str(target) for target in targets]}
    show(value, as_json=as_json, table=f"{count:,} files in {', '.join(map(str, targets))}")
    return Exit.DONE


def _make(kind: str, targets: list[Path]) -> int:
    """Make a stand-in in the first of those folders, and the same in the others; returns how many files it has."""
    from appliance.learn.datasets import make

    last = 0.0

    def tell(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last > 1 or done == total:
            last = time.monotonic()
            console.err.print(f"{kind}: {done:,} of {total:,}")

    first = targets[0]
    try:
        if kind == "clips":
            count = make.make_clips(first, progress=tell)
        else:
            count = make.make_speech(first, make.Speech(kind=kind), progress=tell)
        for other in targets[1:]:
            _link_tree(first, other)
    except OSError as error:
        raise ConfigError(f"{first} cannot be written: {error}", remedy="give another folder") from error
    return count


def _folders(where: Where, kind: str) -> list[Path]:
    """Where the gateways of the local fleet look for a data set; ConfigError where there is no such fleet."""
    from appliance.config import load
    from appliance.connection import read_state

    try:
        state = read_state(where.folder())
    except SwiftbotError as error:
        raise ConfigError("there is no local fleet to make it for", remedy="give a folder") from error
    found: list[Path] = []
    for name in state.gateways:
        config = load(Path(state.directory) / name / "gateway.toml")
        home = config.pool.folders.get("learning") or f"{config.data_dir}/folders/learning"
        if (path := Path(home).expanduser() / kind) not in found:
            found.append(path)
    return found


def _link_tree(source: Path, target: Path) -> None:
    """Give another gateway the same files: as links where the file system can, else copied."""
    import os
    import shutil

    def link(one: str, other: str) -> None:
        try:
            os.link(one, other)
        except FileExistsError:
            pass
        except OSError:
            shutil.copyfile(one, other)

    shutil.copytree(source, target, copy_function=link, dirs_exist_ok=True)
