"""Operators' words to a run, what is kept of it, how it is read, and a model's files as they are taken away."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console, RenderableType

from appliance.cli.learn import _with_options  # pyright: ignore[reportPrivateUsage]
from appliance.errors import ConfigError, NotFoundError, PayloadError, RefusedError
from appliance.learn import export, records, tables
from appliance.learn import recipe as recipes
from appliance.learn.manager import keeps_files, steered
from appliance.learn.round_driver import base_of, data_of, part_of
from appliance.model.learn_api import LearnShown, LearnSteerAsk, Working
from appliance.model.learning import (
    Clients,
    ClientState,
    Closed,
    Data,
    Evaluation,
    Mode,
    Model,
    Order,
    Recipe,
    RoundRecord,
    RunRecord,
    RunState,
)
from appliance.skills._lib.learning import shards

RECIPE = Recipe(model="clips", clients=Clients(partitions=3, by="even"))
RUN = RunRecord(
    id="r",
    recipe=RECIPE,
    round=7,
    model=Model(number=6, digest="d" * 64),
    models=(Model(number=2, marked=True), Model(number=5), Model(number=6)),
    clients=tuple(ClientState(name=name, samples=40, epoch_s=1.5) for name in RECIPE.names),
    history=(Closed(number=6, took_s=1.2, all_s=5.0, clients=3, samples=120, loss=0.5, accuracy=0.8, why="deadline"),),
)


def asked(do: str, run: RunRecord = RUN, **more: object) -> RunRecord | None:
    """What becomes of a run when an operator says so."""
    return steered(run, LearnSteerAsk(run="r", do=do, by="anna", why="test", **more), now_ns=5)  # pyright: ignore[reportArgumentType]


def test_a_run_is_paused_resumed_and_stopped_with_who_and_why() -> None:
    """The reason stands in the record; what has ended takes no word any more."""
    paused = asked("pause")
    assert paused is not None
    assert (paused.state, paused.why) == (RunState.PAUSED, "paused by anna: test")
    resumed = asked("resume", paused)
    assert resumed is not None
    assert (resumed.state, resumed.why) == (RunState.RUNNING, "")
    stopped = asked("stop", paused)
    assert stopped is not None
    assert stopped.state is RunState.STOPPED
    with pytest.raises(RefusedError, match="stopped by anna"):
        asked("resume", stopped)
    with pytest.raises(RefusedError, match="not paused"):
        asked("resume")


def test_a_client_is_excluded_and_included_again() -> None:
    """By name; one that there is not is refused with those there are."""
    without = asked("exclude", client="part-001")
    assert without is not None
    assert [bool(each.excluded) for each in without.clients] == [False, True, False]
    again = asked("include", without, client="part-001")
    assert again is not None
    assert not any(each.excluded for each in again.clients)
    with pytest.raises(NotFoundError, match="no client 'part-009'"):
        asked("exclude", client="part-009")


def test_a_model_is_marked_of_a_run_that_has_ended_too() -> None:
    """Only one that is kept."""
    marked = asked("mark", replace(RUN, state=RunState.STOPPED), model=5)
    assert marked is not None
    assert [model.marked for model in marked.models] == [True, True, False]
    with pytest.raises(NotFoundError, match="no model 4"):
        asked("mark", model=4)


@pytest.mark.parametrize(("number", "model", "kept"), [
    (1, True, False), (2, True, True), (4, True, False), (5, True, True), (7, True, True),
    (1, False, False), (2, False, True), (7, False, True),
])  # fmt: skip
def test_files_go_with_their_rounds(number: int, model: bool, kept: bool) -> None:
    """Models that are kept or marked stay, and updates while one of their round may still count."""
    assert keeps_files(RUN, number, model=model) == kept


def test_files_that_a_client_needs_for_its_next_update_stay() -> None:
    """It was not chosen for many rounds: what coding left over of its last update is added when it is."""
    client = replace(RUN.clients[0], residual=(({"artifact": "a"},),), residual_round=1)
    run = replace(RUN, clients=(client, *RUN.clients[1:]))
    assert keeps_files(run, 1, model=False)
    assert not keeps_files(replace(run, state=RunState.STOPPED), 1, model=False)


def test_of_a_run_that_has_ended_no_update_is_kept() -> None:
    """Its models are."""
    ended = replace(RUN, state=RunState.SUCCEEDED)
    assert not keeps_files(ended, 7, model=False)
    assert keeps_files(ended, 6, model=True)


def test_parts_of_a_shard_are_the_whole_without_overlap() -> None:
    """The client's own share and its helpers' are each other's complement, drawn alike by every coordinator."""
    cuts = (0.0, 0.26, 0.63, 1.0)
    found: list[int] = []
    for number in range(3):
        order = Order(client="part-001", round=4, part=number, share=(cuts[number], cuts[number + 1]))
        part = part_of(RECIPE, order, samples=41)
        assert (part["by"], part["index"], part["of"]) == ("even", 1, 3)
        found += part["indices"]
    assert sorted(found) == list(range(41))
    assert "indices" not in part_of(RECIPE, Order(client="part-001", round=4), samples=41)


def test_what_handlers_are_told_of_model_and_data() -> None:
    """Of the first round no base; the data set is the model's, unless the recipe names one or a folder."""
    assert base_of(Model()) is None
    assert data_of(RECIPE) == {"name": "clips"}
    assert data_of(replace(RECIPE, data=Data(folder="UCF-101"))) == {"folder": "UCF-101"}
    robots = replace(RECIPE, clients=Clients(robots=("rover_1",)), data=Data(folder="{robot}/clips"))
    assert data_of(robots, "rover_1") == {"folder": "rover_1/clips"}
    assert data_of(replace(robots, evaluation=Evaluation(data="clips"))) == {"name": "clips"}
    assert part_of(robots, Order(client="rover_1", round=1), samples=9) == {"by": "even", "index": 0, "of": 1}


def test_options_change_a_recipe_and_are_checked() -> None:
    """What is not given stays; what cannot be is refused with the key."""
    nothing = {"clients": None, "rounds": None, "target": None, "mode": "", "data": "", "share": "", "seed": None}
    assert _with_options(RECIPE, **nothing) == RECIPE  # pyright: ignore[reportArgumentType]
    made = _with_options(RECIPE, **(nothing | {"clients": 5, "rounds": 9, "share": "fleet", "seed": 4}))  # pyright: ignore[reportArgumentType]
    assert (made.clients.partitions, made.clients.by, made.rounds.count, made.seed) == (5, "even", 9, 4)
    assert made.mode is Mode.OFFLOAD
    with pytest.raises(ConfigError, match=r"rounds\.mode"):
        _with_options(RECIPE, **(nothing | {"mode": "fast"}))  # pyright: ignore[reportArgumentType]
    recipes.check(made, "options")


def text_of(shown: RenderableType) -> str:
    """What a person reads."""
    console = Console(file=io.StringIO(), width=160)
    console.print(shown)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_what_people_read_names_what_is_waited_for_and_why() -> None:
    """Runs, one run with its round, a client's reasons, models."""
    clients = (
        RUN.clients[0],
        replace(RUN.clients[1], excluded="2 updates refused in a row, the last: nan"),
        RUN.clients[2],
    )
    order = Order(client="part-002", round=7, given_up="no answer within 60 s")
    record = RoundRecord(run="r", number=7, target=2, waits="1 of 2 clients: part-000", orders=(order,), deadline_s=1.9)
    working = (
        Working(client="part-000", gateway="gw-2", round=7, since_s=0.4, progress=0.5, note="step 3/6"),
        Working(client="part-000", part=1, helper="part-002", gateway="gw-1", round=7, progress=0.2),
    )
    shown = LearnShown(
        run=replace(RUN, clients=clients), round=record, coordinator="gw-1", successor="gw-3", working=working
    )
    text = text_of(tables.shown(shown))
    for expected in (
        "coordinator gw-1, next gw-3",
        "1 of 2 clients",
        "step 3/6",
        "excluded",
        "left out",
        "part of part-000",
    ):
        assert expected in text
    assert "attempt 1 at gw-2" in text_of(tables.why(shown, clients[0]))
    assert "refused in a row" in text_of(tables.why(shown, clients[1]))
    assert "no answer within 60 s" in text_of(tables.why(shown, clients[2]))
    assert "deadline" in text_of(tables.runs([RUN])) or "0.800" in text_of(tables.runs([RUN]))
    assert "marked" in text_of(tables.models(RUN.models))
    assert text_of(tables.runs([])).strip() == "no runs"


def test_a_models_files_are_checked_before_they_are_written(tmp_path: Path) -> None:
    """Whole and right they lie in the folder under the names that others look for; damaged ones are refused."""
    made = list(shards.split({"w": np.arange(9, dtype=np.float32)}))
    manifest = json.dumps(shards.collect(made).to_json()).encode()
    files = [data for _, data in made]
    export.check_files(manifest, files)
    written = export.write_files(tmp_path / "model", manifest, files, ("Run", "Walk"))
    assert written.pop().read_text() == "Run\nWalk\n"
    symbols = export.write_files(tmp_path / "symbols", manifest, files, ("", " ", "A"))
    assert "classes.txt" not in {path.name for path in symbols}
    assert sorted(path.name for path in written) == ["manifest.json", "model-00000.safetensors"]
    names = ["classes.txt", "manifest.json", "model-00000.safetensors"]
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == names
    damaged: list[tuple[list[bytes], bytes]] = [([files[0][:-1]], manifest), ([], manifest), (files, b"no")]
    for wrong in damaged:
        with pytest.raises(PayloadError):
            export.check_files(wrong[1], wrong[0])
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        export.write_files(tmp_path / "file", manifest, files)


def test_a_records_key_has_its_owner() -> None:
    """Files of a round's model have an owner of their own, which outlives that of its updates."""
    assert records.round_key("r", 3) == "learn/r/3"
