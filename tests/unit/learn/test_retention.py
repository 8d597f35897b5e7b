"""What is removed of runs, and what stays."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from appliance.errors import RefusedError, UnreachableError
from appliance.learn import records
from appliance.learn.manager import LearnManager
from appliance.model import encode
from appliance.model.learn_api import LearnSteerAsk
from appliance.model.learning import Clients, ClientState, Model, Recipe, RunRecord, RunState
from appliance.model.plane_api import Record
from appliance.tasks.artifacts import Artifacts

pytestmark = pytest.mark.anyio

RECIPE = Recipe(model="clips", clients=Clients(partitions=2))
RUN = RunRecord(id="good", recipe=RECIPE, round=9, models=(Model(number=8),))
NEWER = b'{"id": "newer", "recipe": {"model": "clips", "key_of_a_later_version": 1}}'


class Records:
    """The records of a fleet, of which one run's cannot be had."""

    def __init__(self) -> None:
        kept = {"good": encode(RUN), "newer": NEWER}
        self.stored = {records.run_key(run): Record(key=records.run_key(run), value=kept[run]) for run in kept}
        for key in (records.round_key("newer", 1), records.round_key("apart", 1)):
            self.stored[key] = Record(key=key)
        self.taken: list[str] = []

    async def read(self, key: str) -> Record | None:
        """Return a record."""
        if key == records.run_key("apart"):
            raise UnreachableError("its holders do not answer")
        return self.stored.get(key)

    async def removed(self, key: str) -> bool:
        """Whether it was removed."""
        return key == records.run_key("gone")

    async def local(self, _: str) -> list[Record]:
        """Return all."""
        return list(self.stored.values())

    def owns(self, _: str) -> bool:
        """All are this gateway's."""
        return True

    async def remove(self, key: str, **_: object) -> None:
        """Note it."""
        self.taken.append(key)


async def test_of_a_run_whose_record_cannot_be_read_everything_stays(tmp_path: Path) -> None:
    """It may be of a later version, or its holders out of reach; files of other runs go all the same."""
    artifacts = Artifacts(tmp_path / "artifacts", gateway="gw-1", max_bytes=1 << 20)
    owners = [f"{records.round_key(run, number)}/model" for run in ("apart", "newer", "gone") for number in (1, 8)]
    owners += [f"{records.round_key('good', number)}/model" for number in (7, 8)]
    for owner in owners:
        await artifacts.put("model", owner.encode(), "text/plain", owner=owner)
    held = Records()
    plane = cast("Any", SimpleNamespace(dht=held, gateway="gw-1"))
    manager = LearnManager(plane, artifacts, manifest=cast("Any", None), copies=1, folder=tmp_path, keep_ended=2)
    await manager._forget()  # pyright: ignore[reportPrivateUsage]
    left = {owner.removeprefix(records.PREFIX) for owner in await artifacts.owners()}
    assert left == {f"{run}/{number}/model" for run in ("apart", "newer") for number in (1, 8)} | {"good/8/model"}
    assert held.taken == []


async def test_files_of_a_run_without_a_record_stay_for_a_day_unless_it_was_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the small side of a partition there is no record of a run that goes on elsewhere."""
    artifacts = Artifacts(tmp_path / "artifacts", gateway="gw-1", max_bytes=1 << 20)
    for run in ("gone", "elsewhere"):
        await artifacts.put("model", run.encode(), "text/plain", owner=f"{records.round_key(run, 1)}/model")
    plane = cast("Any", SimpleNamespace(dht=Records(), gateway="gw-1"))
    manager = LearnManager(plane, artifacts, manifest=cast("Any", None), copies=1, folder=tmp_path, keep_ended=2)
    await manager._forget()  # pyright: ignore[reportPrivateUsage]
    assert await artifacts.owners() == ("learn/elsewhere/1/model",)
    monkeypatch.setattr("appliance.learn.manager.ABSENT_S", 0.0)
    await manager._forget()  # pyright: ignore[reportPrivateUsage]
    assert await artifacts.owners() == ()


async def test_the_oldest_ended_runs_are_removed_but_those_with_a_marked_model(tmp_path: Path) -> None:
    """Two are kept beside what runs; the rounds of one that has ended are kept no longer than its last three."""
    held = Records()
    held.stored.clear()
    ended = replace(RUN, state=RunState.SUCCEEDED)
    runs = [replace(ended, id=f"r{number}", updated_ns=number) for number in range(5)]
    runs[0] = replace(runs[0], models=(Model(number=8, marked=True),))
    runs.append(replace(RUN, id="open"))
    for run in runs:
        held.stored[records.run_key(run.id)] = Record(key=records.run_key(run.id), value=encode(run))
    for key in (records.round_key("r4", 6), records.round_key("r4", 7), records.round_key("open", 6)):
        held.stored[key] = Record(key=key)
    artifacts = Artifacts(tmp_path / "artifacts", gateway="gw-1", max_bytes=1 << 20)
    plane = cast("Any", SimpleNamespace(dht=held, gateway="gw-1"))
    manager = LearnManager(plane, artifacts, manifest=cast("Any", None), copies=1, folder=tmp_path, keep_ended=2)
    await manager._forget()  # pyright: ignore[reportPrivateUsage]
    assert held.taken == ["learn/r4/6", "learn/r1", "learn/r2"]


async def test_a_run_is_removed_when_it_has_ended(tmp_path: Path) -> None:
    """With the records of its rounds and clients; one that runs is refused with the remedy."""
    held = Records()
    ended = replace(RUN, id="done", state=RunState.STOPPED, clients=(ClientState(name="part-000"),))
    for key in ("learn/done/9", "learn/done/9/part-000", "learn/done/10"):
        held.stored[key] = Record(key=key)
    held.stored["learn/done"] = Record(key="learn/done", value=encode(ended))
    artifacts = Artifacts(tmp_path / "artifacts", gateway="gw-1", max_bytes=1 << 20)
    plane = cast("Any", SimpleNamespace(dht=held, gateway="gw-1"))
    manager = LearnManager(plane, artifacts, manifest=cast("Any", None), copies=1, folder=tmp_path, keep_ended=2)
    assert await manager.steer(LearnSteerAsk(run="done", do="remove")) == ended
    assert sorted(held.taken) == ["learn/done", "learn/done/10", "learn/done/9", "learn/done/9/part-000"]
    assert held.taken[-1] == "learn/done"
    with pytest.raises(RefusedError, match="run good is running") as caught:
        await manager.steer(LearnSteerAsk(run="good", do="remove"))
    assert caught.value.remedy == "swiftbot learn stop good"
