"""The shell of a round: what it sends to gateways and writes, with a fleet of one gateway that is played here."""

import asyncio
import sys
import time
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest
from msgspec.structs import replace

from appliance.errors import ConflictError, UnreachableError
from appliance.learn import records, round_driver, rounds, secagg
from appliance.learn.round_driver import RoundDriver, Site, SupersededError
from appliance.model import (
    Failure,
    Phase,
    RunAccepted,
    RunEvent,
    RunEventKind,
    RunRequest,
    VersionVector,
    encode,
    keyspace,
)
from appliance.model.learn_api import (
    LearnHeld,
    LearnHoldAsk,
    LearnKeys,
    LearnKeysAsk,
    LearnShareAsk,
    LearnShares,
    LearnUnmaskAsk,
    LearnUnmasked,
)
from appliance.model.learning import (
    Clients,
    ClientState,
    Closed,
    Cohort,
    Counted,
    Data,
    Mode,
    Model,
    Order,
    PartialUpdate,
    Recipe,
    RoundRecord,
    Rounds,
    RunRecord,
    RunState,
    Side,
    Training,
    Update,
    UpdateRecord,
)
from appliance.model.plane_api import Record
from appliance.model.task_api import ArtifactKeep, ArtifactKept, RunAsk, RunStatus
from appliance.tasks.artifacts import Artifacts

pytestmark = pytest.mark.anyio

RECIPE = Recipe(model="clips", clients=Clients(partitions=2))
RUN = RunRecord(id="r", recipe=RECIPE, clients=tuple(ClientState(name=name) for name in RECIPE.names))


class Fleet:
    """A fleet of one gateway: its records, and the runs that it was asked for."""

    def __init__(
        self,
        run: RunRecord,
        *,
        answers: Callable[[RunRequest], RunEvent | None] = lambda _: None,
        present: dict[str, str] | None = None,
        kept: Callable[[ArtifactKeep], None] = lambda _: None,
    ) -> None:
        self.stored: dict[str, Record] = {}
        self.asked: list[RunRequest] = []
        self.cancelled: list[str] = []
        self.news: list[tuple[object, Any]] = []
        self.gateway = "gw-1"
        self.status = RunStatus(running=True)
        """What is answered of each run."""
        self.dht = self.rpc = self.session = self.ring = self
        self.registry = SimpleNamespace(gateways={}, robots={})
        self._answers, self._kept = answers, kept
        self._listeners: list[Callable[[str, RunEvent], None]] = []
        self.put(records.run_key(run.id), run)
        self.driver = RoundDriver(
            Site(cast("Any", self), cast("Artifacts", None), self._manifest, 1, Counter()),
            run=run.id, number=run.round, present=lambda recipe: present or dict.fromkeys(recipe.names, ""),
            closed=print,
        )  # fmt: skip

    def _manifest(self, skill: str) -> Any:
        return SimpleNamespace(
            image="learn", cpu=1.0, memory_mb=256, volumes=(), timeout_s=60.0, silent_s=120.0, id=skill
        )

    def members(self) -> frozenset[str]:
        """Return the one gateway."""
        return frozenset({self.gateway})

    def successors(self, _: str, count: int) -> tuple[str, ...]:
        """Return the one gateway."""
        return (self.gateway,)[:count]

    def put(self, key: str, value: Any) -> VersionVector:
        """Write a record whatever is there."""
        before = self.stored[key].version if key in self.stored else {}
        self.stored[key] = Record(key=key, value=encode(value), version={"gw-1": before.get("gw-1", 0) + 1})
        return self.stored[key].version

    async def read(self, key: str) -> Record | None:
        """Return a record."""
        return self.stored.get(key)

    async def write(self, key: str, value: bytes, *, expected: VersionVector | None) -> VersionVector:
        """Write a record that is as expected."""
        before = self.stored.get(key)
        if (before.version if before is not None else None) != expected:
            raise ConflictError(f"{key} has moved on")
        version = {"gw-1": (expected or {}).get("gw-1", 0) + 1}
        self.stored[key] = Record(key=key, value=value, version=version)
        return version

    def publish(self, topic: object, value: object, *_: str) -> None:
        """Note what is told."""
        self.news.append((topic, value))

    def subscribe_typed(self, _: object, hear: Callable[[str, RunEvent], None], *__: str) -> Any:
        """Tell of the ends of runs."""
        self._listeners.append(hear)
        return SimpleNamespace(close=lambda: self._listeners.remove(hear))

    async def call(self, gateway: str, verb: object, ask: Any, **_: object) -> Any:
        """Take a run, or call one off."""
        await asyncio.sleep(0)
        if verb is keyspace.RUN:
            self.asked.append(ask)
            if (event := self._answers(ask)) is not None:
                asyncio.get_running_loop().call_soon(self._tell, event)
            return RunAccepted(gateway=gateway, container="c", phase=Phase.LOCAL_WARM)
        if isinstance(ask, ArtifactKeep):
            self._kept(ask)
            return ArtifactKept(artifact=ask.artifact, gateway=gateway)
        assert isinstance(ask, RunAsk)
        if verb is keyspace.RUN_CANCEL:
            self.cancelled.append(ask.run_id)
        return self.status

    def _tell(self, event: RunEvent) -> None:
        self.driver.heard(event)
        for hear in list(self._listeners):
            hear("", event)

    def round(self) -> RoundRecord:
        """Return the record of the first round."""
        return records.read(self.stored[records.round_key("r", 1)].value, RoundRecord)


async def until(there: Callable[[], bool]) -> None:
    """Wait until something is so."""
    async with asyncio.timeout(10):
        while not there():
            await asyncio.sleep(0.005)


async def test_a_stopped_run_ends_the_runs_of_its_clients() -> None:
    """The gateways are asked to end them before the driver is gone."""
    fleet = Fleet(RUN)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) == 2 and all(order.gateway for order in fleet.driver.working()))
    fleet.driver.put(rounds.Changed(replace(RUN, state=RunState.STOPPED, why="stopped by anna")))
    await driving
    assert sorted(fleet.cancelled) == ["r.1/part-000/1", "r.1/part-001/1"]


async def test_what_clients_are_at_is_put_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is told once as it trains, again with its progress, and as done once its update is accepted."""
    monkeypatch.setattr(round_driver, "CLIENT_NEWS_S", 0.005)
    fleet = Fleet(RUN)

    def told(client: str) -> list[tuple[str, float]]:
        found = (value for topic, value in fleet.news if topic is keyspace.LEARN_CLIENT)
        return [(each.state, each.progress) for each in found if each.client == client]

    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: told("part-000")[-1:] == [("training", 0.0)] and told("part-001")[-1:] == [("training", 0.0)])
    first = next(request for request in fleet.asked if request.subtask == "part-000")
    fleet.driver.heard(ended(first, kind=RunEventKind.PROGRESS, progress=0.5, note="step 1/2"))
    await until(lambda: told("part-000")[-1] == ("training", 0.5))
    fleet.driver.heard(trained(first))
    await until(lambda: told("part-000")[-1] == ("done", 0.0))
    assert told("part-001").count(("training", 0.0)) == 1
    rounds_told = [value for topic, value in fleet.news if topic is keyspace.LEARN_ROUND]
    assert {(each.coordinator, each.successor) for each in rounds_told} == {("gw-1", "")}
    fleet.driver.put(rounds.Changed(replace(RUN, state=RunState.STOPPED)))
    await driving
    assert told("part-001")[-1] == ("ended", 0.0)


async def test_tasks_go_first_where_both_wait_for_a_container() -> None:
    """Runs of clients wait at the lowest priority, from which waiting raises them."""
    fleet = Fleet(RUN)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) == 2)
    driving.cancel()
    assert {request.priority for request in fleet.asked} == {0}


async def test_the_open_round_of_a_run_that_has_ended_is_closed() -> None:
    """A coordinator that comes to it after the stop ends its clients' runs and closes it, and does so once."""
    fleet = Fleet(replace(RUN, state=RunState.STOPPED, why="stopped by anna"))
    orders = (Order(client="part-000", round=1, gateway="gw-1"), Order(client="part-001", round=1, given_up="late"))
    fleet.put(records.round_key("r", 1), RoundRecord(run="r", number=1, target=2, orders=orders))
    with pytest.raises(SupersededError):
        await fleet.driver.drive()
    assert fleet.cancelled == ["r.1/part-000/1"]
    assert (fleet.round().closed, fleet.round().closed_by) == (True, "stopped by anna")


async def test_a_round_that_the_run_has_left_behind_is_closed_and_its_late_clients_go_on() -> None:
    """Its coordinator went before it wrote that it had closed it; the next round awaits what is late."""
    fleet = Fleet(replace(RUN, round=1))
    fleet.put(records.run_key("r"), replace(RUN, round=2))
    late = Order(client="part-000", round=1, gateway="gw-1")
    fleet.put(records.round_key("r", 1), RoundRecord(run="r", number=1, target=2, orders=(late,)))
    with pytest.raises(SupersededError):
        await fleet.driver.drive()
    assert (fleet.round().closed, fleet.cancelled) == (True, [])


def ended(request: RunRequest, **values: Any) -> RunEvent:
    """News of a run's end."""
    return RunEvent(task=request.task, subtask=request.subtask, attempt=request.attempt, gateway="gw-1", **values)


def trained(request: RunRequest) -> RunEvent:
    """News of a client's update."""
    result: dict[str, Any] = {"manifest": {}, "shards": [], "samples": 9, "steps": 1, "steps_of_epoch": 1, "loss": 1.0}
    return ended(request, kind=RunEventKind.SUCCEEDED, result=result)


async def test_an_aggregation_that_failed_is_run_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gateways answer for a run that they know with what became of it: the next try is another run."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)

    def answer(request: RunRequest) -> RunEvent:
        if request.skill != round_driver.AGGREGATE:
            return trained(request)
        full = Failure(code="refused", message="the disk is full")
        return ended(request, kind=RunEventKind.FAILED, failure=full)

    fleet = Fleet(RUN, answers=answer)
    driving = asyncio.create_task(fleet.driver.drive())

    def sums() -> list[str]:
        return [request.run_id for request in fleet.asked if request.skill == round_driver.AGGREGATE]

    await until(lambda: len(sums()) >= 5)
    driving.cancel()
    assert len(set(sums())) == len(sums())


async def test_an_aggregation_that_breaks_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error of any kind is a failure; without it the round would wait for ever."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)

    def answer(request: RunRequest) -> RunEvent:
        if request.skill != round_driver.AGGREGATE:
            return trained(request)
        return ended(request, kind=RunEventKind.SUCCEEDED, result={"manifest": 7})

    fleet = Fleet(RUN, answers=answer)

    def broken(_: object) -> None:
        raise AttributeError("a defect")

    monkeypatch.setattr(round_driver.shards, "parse_manifest", broken)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: sum(request.skill == round_driver.AGGREGATE for request in fleet.asked) >= 2)
    driving.cancel()


@pytest.mark.parametrize("share", ["never", "gateway"])
async def test_a_robot_is_trained_for_at_its_own_gateway_only(share: Literal["never", "gateway"]) -> None:
    """Elsewhere lie the data of others: an order is not passed on, and not placed where the robot is not."""
    recipe = Recipe(model="clips", clients=Clients(robots=("rover_1", "rover_2")), data=Data(share=share))
    run = replace(RUN, recipe=recipe, clients=tuple(ClientState(name=name) for name in recipe.names))
    there = {"rover_1": "gw-1", "rover_2": "gw-9"}
    fleet = Fleet(run, present=there)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) == 1)
    assert [(request.subtask, request.group) for request in fleet.asked] == [("rover_1", ("gw-1",))]
    there.pop("rover_2")
    fleet.driver.follow_presence()
    assert fleet.driver._place(Order(client="rover_2", round=1)) == ""  # pyright: ignore[reportPrivateUsage]
    driving.cancel()


async def test_a_round_of_the_side_that_does_not_stand_begins_anew() -> None:
    """Both sides of a partition closed a round: what was trained on the other side's model does not count."""
    ours, theirs = Model(number=1, digest="ours"), Model(number=1, digest="theirs")
    fleet = Fleet(replace(RUN, round=2, model=ours))
    late = Order(client="part-001", round=1, gateway="gw-1")
    order = Order(client="part-001", round=2, attempt=2, gateway="gw-1")
    key = records.round_key("r", 2)
    fleet.put(key, RoundRecord(run="r", number=2, base=theirs, target=2, orders=(late, order)))
    of_theirs = PartialUpdate(client="part-000", round=2, samples=9, steps=1, steps_whole=1)
    fleet.put(records.update_key("r", 2, "part-000"), UpdateRecord(client="part-000", parts=(of_theirs,)))
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) == 2)
    driving.cancel()
    assert sorted(request.run_id for request in fleet.asked) == ["r.2/part-000/2", "r.2/part-001/3"]
    assert records.read(fleet.stored[key].value, RoundRecord).base == ours
    kept = fleet.stored[records.update_key("r", 2, "part-000")]
    assert records.read(kept.value, UpdateRecord).parts == ()


async def test_a_gateway_that_does_not_answer_uses_up_no_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is restarted, which takes longer than three tries: the client is ordered until it is there again."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)
    asked: list[str] = []

    def answer(request: RunRequest) -> RunEvent | None:
        asked.append(request.run_id)
        if request.subtask == "part-000" and len(asked) < 9:
            raise UnreachableError("gw-1 does not answer")
        return trained(request)

    fleet = Fleet(RUN, answers=answer)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: any(request.skill == round_driver.AGGREGATE for request in fleet.asked))
    driving.cancel()
    (summed,) = (request for request in fleet.asked if request.skill == round_driver.AGGREGATE)
    assert [each["client"] for each in summed.params["updates"]] == ["part-000", "part-001"]


async def test_where_all_updates_are_lost_the_clients_train_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their files were on a gateway that is gone: their records are emptied, and they are asked again."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)
    lost = {"accepted": False, "reason": "lost", "message": "it is on no gateway", "norm": None}

    def answer(request: RunRequest) -> RunEvent:
        if request.skill != round_driver.AGGREGATE:
            return trained(request)
        assert request.params["report"]
        verdicts = {each["client"]: lost for each in request.params["updates"]}
        return ended(request, kind=RunEventKind.SUCCEEDED, result={"needed": 1, "verdicts": verdicts})

    fleet = Fleet(RUN, answers=answer)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: {"r.1/part-000/2", "r.1/part-001/2"} <= {request.run_id for request in fleet.asked})
    driving.cancel()
    assert not fleet.driver.record() or not fleet.round().closed


async def test_where_all_updates_are_refused_twice_their_clients_are_excluded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run's record says so before the round closes, and nobody trains a third time."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)

    def answer(request: RunRequest) -> RunEvent:
        if request.skill != round_driver.AGGREGATE:
            return trained(request)
        unfit = {"accepted": False, "reason": "nan", "message": "NaN or infinite values"}
        verdicts = {each["client"]: unfit for each in request.params["updates"]}
        return ended(request, kind=RunEventKind.SUCCEEDED, result={"needed": 1, "verdicts": verdicts})

    fleet = Fleet(RUN, answers=answer)
    driving = asyncio.create_task(fleet.driver.drive())

    def excluded() -> list[str]:
        run = records.read(fleet.stored[records.run_key("r")].value, RunRecord)
        return [client.excluded for client in run.clients]

    reason = "2 updates refused in a row, the last: nan: NaN or infinite values"
    await until(lambda: excluded() == [reason, reason])
    await until(lambda: [status.state for status in fleet.driver.clients()] == ["excluded", "excluded"])
    driving.cancel()
    trainings = [request.run_id for request in fleet.asked if request.skill != round_driver.AGGREGATE]
    assert sorted(trainings) == ["r.1/part-000/1", "r.1/part-000/2", "r.1/part-001/1", "r.1/part-001/2"]


async def test_an_accepted_update_is_copied_to_the_coordinator() -> None:
    """The gateway that made it may go before it is summed."""
    kept: list[ArtifactKeep] = []

    def answer(request: RunRequest) -> RunEvent:
        event = trained(request)
        assert event.result is not None
        shard = {"artifact": f"{request.subtask:x<64}", "bytes": 7, "gateway": "gw-9"}
        return replace(event, result={**event.result, "shards": [shard]})

    fleet = Fleet(RUN, answers=answer, kept=kept.append)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(kept) == 2)
    driving.cancel()
    assert {(each.source, each.owner) for each in kept} == {("gw-9", "learn/r/1")}


async def test_updates_that_come_together_are_written_side_by_side() -> None:
    """While the first is written three more come: they do not wait for each other, and are there before the sum."""
    writing: list[int] = []
    open_now = 0
    recipe = Recipe(model="clips", clients=Clients(partitions=4))
    run = replace(RUN, recipe=recipe, clients=tuple(ClientState(name=name) for name in recipe.names))
    fleet = Fleet(run, answers=lambda request: None if request.skill == round_driver.AGGREGATE else trained(request))
    write = fleet.write

    async def slow(key: str, value: bytes, *, expected: VersionVector | None = None) -> VersionVector:
        nonlocal open_now
        if key.count("/") == 3:
            open_now += 1
            writing.append(open_now)
            await asyncio.sleep(0.02)
            open_now -= 1
        return await write(key, value, expected=expected)

    fleet.write = slow  # pyright: ignore[reportAttributeAccessIssue]
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: any(request.skill == round_driver.AGGREGATE for request in fleet.asked))
    driving.cancel()
    assert max(writing) == 3
    assert sum(key.count("/") == 3 for key in fleet.stored) == 4


async def test_what_the_other_side_of_a_partition_has_trained_is_taken_in() -> None:
    """Both sides closed round 1; of the updates that only the other one has counted each counts in round 2."""
    ours = Model(number=1, digest="ours")
    line = Closed(number=1, took_s=1.0, digest="ours")
    fleet = Fleet(replace(RUN, round=2, model=ours, history=(line,), apart=(1,)), answers=trained)
    sides = (
        Side(model="ours", counted=(Counted(client="part-000", samples=9),)),
        Side(model="theirs", counted=(Counted(client="part-001", samples=9),)),
    )
    fleet.put(
        records.round_key("r", 1),
        RoundRecord(run="r", number=1, closed=True, model="theirs", counted=sides[1].counted, sides=sides),
    )
    for client in RECIPE.names:
        part = PartialUpdate(client=client, round=1, samples=9, steps=1, steps_whole=1)
        fleet.put(records.update_key("r", 1, client), UpdateRecord(client=client, parts=(part,)))
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: any(request.skill == round_driver.AGGREGATE for request in fleet.asked))
    driving.cancel()
    summed = next(request for request in fleet.asked if request.skill == round_driver.AGGREGATE)
    assert [(each["client"], each["weight"]) for each in summed.params["updates"]] == [
        ("part-000", 9 * 1024),
        ("part-001", 6516),
    ]
    assert [request.run_id for request in fleet.asked if request.skill == round_driver.TRAIN] == ["r.2/part-000/1"]


async def test_a_client_is_given_what_coding_left_over_of_its_last_update() -> None:
    """Whichever gateway it trains at, after a restart too: the run's record names the files. Helpers are not."""
    recipe = replace(RECIPE, update=Update(compression="int8"))
    left = ({"artifact": "a" * 64, "bytes": 9, "gateway": "gw-1"},)
    clients = (ClientState(name="part-000", residual=(left,), residual_round=3), ClientState(name="part-001"))
    fleet = Fleet(replace(RUN, recipe=recipe, clients=clients))
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) == 2)
    driving.cancel()
    params = {request.subtask: request.params for request in fleet.asked}
    assert params["part-000"]["compression"] == "int8"
    assert params["part-000"]["residual"] == [list(left)]
    assert params["part-001"]["residual"] == []
    helped = fleet.driver._train_params(Order(client="part-000", round=1, part=1))  # pyright: ignore[reportPrivateUsage]
    assert helped["residual"] == []


async def test_a_client_without_a_sign_of_life_is_tried_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its gateway says that it runs and was silent for longer than its skill promises: ended, and ordered again."""
    monkeypatch.setattr(round_driver, "CHECK_S", 0.01)
    fleet = Fleet(RUN)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) == 2)
    fleet.status = RunStatus(running=True, silent_s=119.0)
    await asyncio.sleep(0.1)
    assert len(fleet.asked) == 2
    fleet.status = RunStatus(running=True, silent_s=121.0)
    await until(lambda: any(request.attempt == 3 for request in fleet.asked))
    driving.cancel()
    assert {"r.1/part-000/1", "r.1/part-001/1"} <= set(fleet.cancelled)
    assert all(order.failures for order in fleet.round().orders)


async def test_an_aggregation_without_a_sign_of_life_is_run_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is ended, and another run of it begins: the round does not wait for the end of its time."""
    monkeypatch.setattr(round_driver, "CHECK_S", 0.01)
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)
    fleet = Fleet(RUN, answers=lambda request: None if request.skill == round_driver.AGGREGATE else trained(request))
    fleet.status = RunStatus(running=True, silent_s=300.0)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: sum(request.skill == round_driver.AGGREGATE for request in fleet.asked) >= 2)
    driving.cancel()
    first = next(request for request in fleet.asked if request.skill == round_driver.AGGREGATE)
    assert first.run_id in fleet.cancelled


async def test_a_client_that_waits_for_a_container_says_so_until_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Taken by its gateway it is second in line there: it waits, with the reason, and trains once its run begins."""
    monkeypatch.setattr(round_driver, "CHECK_S", 0.01)
    fleet = Fleet(RUN)
    fleet.status = RunStatus(running=True, position=2, queue=3)
    driving = asyncio.create_task(fleet.driver.drive())
    reason = "waits for a container at gw-1, 2 of 3 in line"
    await until(lambda: [(each.state, each.why) for each in fleet.driver.clients()] == [("waiting", reason)] * 2)
    record = fleet.driver.record()
    assert record is not None
    assert f"part-000 ({reason})" in record.waits
    fleet.status = RunStatus(running=True)
    for request in fleet.asked:
        fleet.driver.heard(ended(request, kind=RunEventKind.STARTED))
    await until(lambda: reason not in (fleet.driver.record() or record).waits)
    assert [(each.state, each.why) for each in fleet.driver.clients()] == [("training", "")] * 2
    driving.cancel()


async def test_what_becomes_due_between_two_looks_is_not_overlooked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A timer that is a hair early looks just before a client's time is over: the round closes without it all the same.

    The loop's first look at the clock after that time is 0.1 ms before it here, as an early timer's is.
    """
    recipe = Recipe(model="clips", clients=Clients(partitions=2), rounds=Rounds(mode=Mode.SYNC, timeout_s=0.2))
    fleet = Fleet(replace(RUN, recipe=recipe), answers=lambda ask: trained(ask) if ask.subtask == "part-000" else None)
    early: list[float] = []

    def clock() -> float:
        now = time.monotonic()
        record, loop = fleet.driver._decider, sys._getframe(1).f_code.co_name == "_loop"
        if record is not None and loop and not early and now >= record._opened + 0.2:
            early.append(record._opened + 0.1999)
            return early[0]
        return now

    monkeypatch.setattr(round_driver, "time", SimpleNamespace(monotonic=clock, time_ns=time.time_ns))
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: any(request.skill == round_driver.AGGREGATE for request in fleet.asked))
    driving.cancel()
    assert early


@pytest.mark.parametrize(("took_ms", "attempts"), [(None, 0), (50.0, 1)])
async def test_to_stand_in_line_in_vain_uses_up_no_attempt(took_ms: float | None, attempts: int) -> None:
    """Half a minute without a free container is no fault of the client; a container that dies under its run may be."""
    failure = Failure(code="pool", message="no container came free within 30 s")
    fleet = Fleet(RUN, answers=lambda ask: ended(ask, kind=RunEventKind.FAILED, failure=failure, duration_ms=took_ms))
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: len(fleet.asked) >= 4)
    driving.cancel()
    assert all(order.failures >= attempts if attempts else not order.failures for order in fleet.round().orders)
    record = fleet.driver.record()
    assert record is not None
    if not attempts:
        assert "part-000 (gw-1: no container came free within 30 s)" in record.waits
        assert {each.why for each in fleet.driver.clients()} == {"gw-1: no container came free within 30 s"}


class Secure(Fleet):
    """A fleet of three gateways with a robot each, whose updates are masked. `silent`: gateways that do not answer."""

    def __init__(self, **more: Any) -> None:
        names = ("gw-1", "gw-2", "gw-3")
        self.holders = {name: secagg.Holder(name) for name in names}
        self.silent: set[str] = set()
        self.unmasked: list[tuple[str, ...]] = []
        robots = tuple(f"r{number}" for number in range(1, 4))
        recipe = Recipe(model="clips", clients=Clients(robots=robots), update=Update(secagg=True))
        run = replace(RUN, recipe=recipe, clients=tuple(ClientState(name=name) for name in robots))
        super().__init__(run, present=dict(zip(robots, names, strict=True)), answers=self._train, **more)

    def members(self) -> frozenset[str]:
        """Return the three gateways."""
        return frozenset(self.holders)

    @staticmethod
    def _train(request: RunRequest) -> RunEvent:
        event = trained(request)
        return replace(event, result={**(event.result or {}), "coding": "masked"})

    async def call(self, gateway: str, verb: object, ask: Any, **more: object) -> Any:
        """Answer for the keys of clients too."""
        holder = self.holders[gateway]
        if gateway in self.silent and verb not in (keyspace.RUN, keyspace.RUN_CANCEL):
            raise UnreachableError(f"{gateway} does not answer")
        match ask:
            case LearnKeysAsk():
                return LearnKeys(keys=holder.advertise(ask.epoch, ask.clients))
            case LearnShareAsk():
                return LearnShares(sealed=holder.share(ask.cohort))
            case LearnHoldAsk():
                return LearnHeld(clients=holder.hold(ask.cohort, ask.sealed))
            case LearnUnmaskAsk():
                self.unmasked.append(ask.summed)
                return LearnUnmasked(revealed=holder.unmask(ask.epoch, ask.summed))
            case _:
                return await super().call(gateway, verb, ask, **more)

    def sums(self) -> list[RunRequest]:
        """The aggregations that were asked for."""
        return [request for request in self.asked if request.skill == round_driver.AGGREGATE]


async def test_clients_are_ordered_with_masks_and_the_sum_is_asked_for_without() -> None:
    """Each order names the cohort's masks, which gateways have; what is left of them goes with the aggregation."""
    fleet = Secure()
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: bool(fleet.sums()))
    driving.cancel()
    cohort = fleet.round().cohort
    assert cohort is not None
    orders = [request for request in fleet.asked if request.skill == round_driver.TRAIN]
    assert {request.params["secure"] for request in orders} == {cohort.epoch}
    assert [each.gateway for each in cohort.clients] == ["gw-1", "gw-2", "gw-3"]
    asked = fleet.sums()[0].params
    assert [each[1] for each in asked["masks"]] == [1, 1, 1]
    assert {each["coding"] for each in asked["updates"]} == {"masked"}
    assert [each["weight"] for each in asked["updates"]] == [9, 9, 9]


async def test_without_enough_shares_a_round_waits_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three gateways are out of reach when masks are to be taken off: tried again, until they answer."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.05)
    fleet = Secure()
    back: list[bool] = []

    def heard(event: RunEvent, heard: Callable[[RunEvent], None] = fleet.driver.heard) -> None:
        fleet.silent = set() if back else {"gw-2", "gw-3"}
        heard(event)

    monkeypatch.setattr(fleet.driver, "heard", heard)
    driving = asyncio.create_task(fleet.driver.drive())
    reason = "aggregation is tried again: 1 of 2 shares of r1: gw-2 does not answer"
    await until(lambda: (record := fleet.driver.record()) is not None and record.waits == reason)
    assert not fleet.sums()
    back.append(True)
    fleet.silent.clear()
    await until(lambda: bool(fleet.sums()))
    driving.cancel()


async def test_where_keys_are_lost_the_clients_train_anew_with_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three gateways restarted before masks were taken off: what came is dropped, and another cohort agrees."""
    monkeypatch.setattr(rounds, "RETRY_S", 0.01)
    fleet = Secure()
    first: list[Cohort] = []

    def heard(event: RunEvent, heard: Callable[[RunEvent], None] = fleet.driver.heard) -> None:
        if not first and (cohort := fleet.round().cohort) is not None:
            first.append(cohort)
            fleet.holders |= {name: secagg.Holder(name) for name in ("gw-2", "gw-3")}
        heard(event)

    monkeypatch.setattr(fleet.driver, "heard", heard)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: bool(fleet.sums()))
    driving.cancel()
    second = fleet.round().cohort
    assert second is not None
    assert first[0].epoch != second.epoch
    orders = [request for request in fleet.asked if request.skill == round_driver.TRAIN]
    assert {request.attempt for request in orders if request.params["secure"] == second.epoch} == {2}


async def test_the_steps_of_several_epochs_are_a_whole_update() -> None:
    """A client says the steps of one epoch; ordered three, it makes three times as many, and that is no fault."""
    recipe = replace(RECIPE, training=Training(epochs=3))

    def answer(request: RunRequest) -> RunEvent:
        event = trained(request)
        return replace(event, result={**(event.result or {}), "steps": 6, "steps_of_epoch": 2})

    fleet = Fleet(replace(RUN, recipe=recipe), answers=answer)
    driving = asyncio.create_task(fleet.driver.drive())
    await until(lambda: any(request.skill == round_driver.AGGREGATE for request in fleet.asked))
    driving.cancel()
    sums = next(request.params for request in fleet.asked if request.skill == round_driver.AGGREGATE)
    assert [each["scale"] for each in sums["updates"]] == [1, 1]
