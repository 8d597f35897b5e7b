"""The runs of federated learning on one gateway: answers for them, coordinates the rounds whose records it owns.

A round's coordinator is the owner of `learn/{run}/{n}`, so the role moves with every round and goes to the next gateway
on the ring when its own goes. Each gateway looks at the copies it holds: of a run whose open round it owns it has a
driver (`round_driver`). Nothing else starts one, so a round that was just opened, one whose coordinator has gone and
one that a restart has left are taken up alike.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, get_args

import msgspec
import structlog
from msgspec.structs import replace

from appliance.errors import (
    ConfigError,
    ConflictError,
    NotFoundError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.learn import recipe as recipes
from appliance.learn import records, rounds, secagg
from appliance.learn.round_driver import (
    EVALUATE,
    PRIORITY,
    READ_AT_ONCE,
    RoundDriver,
    Site,
    SupersededError,
    base_of,
    change_run,
    data_of,
    read_run,
    run_skill,
    write,
)
from appliance.learn.status import metric, statuses
from appliance.model import RunEvent, RunRequest, keyspace
from appliance.model.learn_api import (
    DataFound,
    LearnData,
    LearnDataAsk,
    LearnEvalAsk,
    LearnEvaluated,
    LearnExportAsk,
    LearnExported,
    LearnHeld,
    LearnHoldAsk,
    LearnKeys,
    LearnKeysAsk,
    LearnRuns,
    LearnRunsAsk,
    LearnShareAsk,
    LearnShares,
    LearnShowAsk,
    LearnShown,
    LearnStartAsk,
    LearnSteerAsk,
    LearnUnmaskAsk,
    LearnUnmasked,
    Steering,
)
from appliance.model.learning import (
    MOST_CLIENTS,
    ClientState,
    Model,
    Recipe,
    Reference,
    RoundRecord,
    RunRecord,
    RunState,
)
from appliance.plane.events import FactsChanged, FleetEvent, Joined, Lost, Relinked, RingChanged, Stage
from appliance.plane.node import Plane
from appliance.plane.session import Closer
from appliance.pool.pool import Call
from appliance.skills._lib.learning import loading, models
from appliance.skills._lib.learning.listings import DataError
from appliance.skills._lib.learning.models import ModelError
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.audit import Audit
from appliance.tasks.orders import need_of

log = structlog.get_logger(__name__)

SWEEP_S = 2.0
"""How often copies are looked through, in case news was lost."""
AGAIN_S = 1.0
RETENTION_S = 30.0
KEPT_ROUNDS = 2
"""Closed rounds whose records are kept beyond those in which late updates may still come."""
ABSENT_S = 86_400.0
"""How long a run has no record before its files go, unless it was removed: in a partition the others may have it."""
REMOVED_AT_ONCE = 20
"""Ended runs removed for their number in one look."""


class LearnManager:
    """Drives and answers for runs.

    Args:
        plane: the fleet.
        artifacts: files of this gateway.
        manifest: of a skill; NotFoundError when it is not known.
        copies: gateways that are to hold a model before it counts.
        folder: this gateway's folder of data sets; in `models/` of it are models beside those of the product.
        keep_ended: runs that have ended which are kept in this gateway's shard, the newest.
        tell_decisions: whether each step of a round's decider is put, for the log.
    """

    def __init__(
        self,
        plane: Plane,
        artifacts: Artifacts,
        *,
        manifest: Callable[[str], SkillManifest],
        copies: int,
        folder: Path,
        keep_ended: int,
        tell_decisions: bool = True,
    ) -> None:
        self._folder, self._keep_ended = folder, keep_ended
        self._absent: dict[str, float] = {}
        """Run with files here that has no record -> since when, on this machine's monotonic clock."""
        self._forgetting = asyncio.Event()
        self._plane = plane
        self._artifacts = artifacts
        self.refused = Counter[str]()
        self._site = Site(plane, artifacts, manifest, copies, self.refused, tell_decisions)
        self._keys = secagg.Holder(plane.gateway)
        self._drivers: dict[str, RoundDriver] = {}
        """Run -> the driver of its open round, where that is this gateway's."""
        self._driving: dict[str, asyncio.Task[None]] = {}
        self._not_before: dict[str, float] = {}
        self._work: set[asyncio.Task[None]] = set()
        self._sweep = asyncio.Event()
        self._closers: list[Callable[[], None]] = []

    async def start(self, audit: Audit) -> None:
        """Answer, and take up the rounds that are this gateway's."""
        rpc, session = self._plane.rpc, self._plane.session
        rpc.register(keyspace.LEARN_START, audit.signed("learn_start", self.begin))
        rpc.register(keyspace.LEARN_DATA, self.data)
        rpc.register(keyspace.LEARN_RUNS, self.runs)
        rpc.register(keyspace.LEARN_SHOW, self.show)
        rpc.register(keyspace.LEARN_EVAL, self.evaluate)
        rpc.register(keyspace.LEARN_EXPORT, self.export)
        rpc.register(keyspace.LEARN_KEYS, self.keys)
        rpc.register(keyspace.LEARN_SHARE, self.share)
        rpc.register(keyspace.LEARN_HOLD, self.hold)
        rpc.register(keyspace.LEARN_UNMASK, self.unmask)
        signed = {do: audit.signed(f"learn_{do}", self.steer) for do in get_args(Steering)}

        async def steer(ask: LearnSteerAsk) -> RunRecord:
            return await signed[ask.do](ask)

        rpc.register(keyspace.LEARN_STEER, steer)
        news = session.subscribe_typed(keyspace.RUN_EVENT, self._on_run_event, heed=self._is_ours)
        changes = session.subscribe_typed(keyspace.LEARN_RUN, self._on_run_changed)
        self._keep(news, changes)
        self._closers.append(self._plane.events.subscribe(Stage.TASKS, self._on_fleet_event))
        self._closers.append(self._plane.dht.watch(_opens, lambda _: self._sweep.set()))
        self._start(self._keep_sweeping(), "learn sweep")
        self._start(self._keep_forgetting(), "learn retention")

    def _keep(self, *closers: Closer) -> None:
        self._closers += [closer.close for closer in closers]

    def _start(self, work: Any, name: str) -> None:
        task = asyncio.create_task(work, name=name)
        self._work.add(task)
        task.add_done_callback(self._work_done)

    def _work_done(self, task: "asyncio.Task[None]") -> None:
        self._work.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("work for a run broke", work=task.get_name(), exc_info=error)

    async def stop(self) -> None:
        """Coordinate no more; the records stay, and the next owner of each round goes on."""
        for close in self._closers:
            close()
        tasks = [*self._driving.values(), *self._work]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # --- taking rounds up -----------------------------------------------------------------------------------------

    async def _keep_sweeping(self) -> None:
        while True:
            try:
                async with asyncio.timeout(SWEEP_S):
                    await self._sweep.wait()
            except TimeoutError:
                pass
            self._sweep.clear()
            try:
                await self._take_up()
            except SwiftbotError as error:
                log.warning("runs are looked through again", reason=str(error))
            except Exception:  # without this a lost gateway's rounds would hang: it must not die
                log.exception("runs are looked through again")
            await asyncio.sleep(0.005)  # many copies change together when a round opens

    async def _take_up(self) -> None:
        """Drive what is this gateway's: rounds whose records are here, and those that are not opened yet."""
        open_rounds: dict[str, int] = {}
        runs: dict[str, RunRecord] = {}
        for stored in await self._plane.dht.local(records.PREFIX):
            try:
                run, number, client = records.taken_apart(stored.key)
                if client:
                    continue
                if number is None:
                    record = records.read(stored.value, RunRecord)
                    if not record.state.final and self._plane.dht.owns(stored.key):
                        runs[run] = record
                elif not records.read(stored.value, RoundRecord).closed and self._plane.dht.owns(stored.key):
                    open_rounds[run] = max(number, open_rounds.get(run, 0))
            except PayloadError as error:
                self.refused["learn record"] += 1
                log.warning("a record of a run cannot be read", key=stored.key, reason=error.message)
        for run, record in runs.items():
            if not self._plane.dht.owns(records.round_key(run, record.round)):
                await self._open(record)
            elif run not in open_rounds:
                open_rounds[run] = record.round
        for run, number in open_rounds.items():
            self._drive(run, number)
        for run, driver in list(self._drivers.items()):
            if not self._plane.dht.owns(records.round_key(run, driver.number)):
                self._driving[run].cancel()

    async def _open(self, record: RunRecord) -> None:
        """Write the record of a run's open round where there is none: its owner takes it up."""
        key = records.round_key(record.id, record.round)
        if await self._plane.dht.read(key) is None:
            opening = RoundRecord(run=record.id, number=record.round, base=record.model)
            try:
                await write(self._plane, key, opening, None)
            except ConflictError:
                return

    def _drive(self, run: str, number: int) -> None:
        if run in self._driving or self._not_before.get(run, 0.0) > time.monotonic():
            return
        driver = RoundDriver(self._site, run=run, number=number, present=self._present, closed=self._has_closed)
        self._drivers[run] = driver
        task = asyncio.create_task(driver.drive(), name=f"round {number} of {run}")
        self._driving[run] = task
        task.add_done_callback(lambda done: self._driven(run, done))

    def _driven(self, run: str, done: "asyncio.Task[None]") -> None:
        self._driving.pop(run, None)
        self._drivers.pop(run, None)
        if done.cancelled():
            return
        error = done.exception()
        if isinstance(error, SupersededError | NotFoundError):
            log.info("a round is not this gateway's any more", run=run, reason=str(error))
        elif isinstance(error, SwiftbotError):
            log.warning("a round is taken up again", run=run, reason=str(error))
        elif error is not None:
            log.error("a round is taken up again", run=run, exc_info=error)
        if error is not None:
            self._not_before[run] = time.monotonic() + AGAIN_S
            asyncio.get_running_loop().call_later(AGAIN_S, self._sweep.set)
        else:
            self._sweep.set()

    def _has_closed(self, run: RunRecord) -> None:
        """A round was closed here: its model is evaluated, while the next round runs."""
        every, rounds_ = run.recipe.evaluation.every, run.recipe.rounds
        number = run.model.number
        if every and (number % every == 0 or number >= rounds_.count):
            self._start(self._evaluate(run, run.model), f"evaluate {run.id} {number}")

    async def evaluate(self, ask: LearnEvalAsk) -> LearnEvaluated:
        """Answer `learn_eval`."""
        run, _ = await read_run(self._plane, ask.run)
        model = _kept(run, ask.model)
        name = f"evaluate-{time.time_ns()}"
        result = await self._judged(run, model, subtask=name, limit=ask.limit)
        return LearnEvaluated(
            run=run.id,
            model=model.number,
            accuracy=float(result["accuracy"]),
            loss=result.get("loss"),
            items=int(result["items"]),
        )

    async def export(self, ask: LearnExportAsk) -> LearnExported:
        """Answer `learn_export`."""
        run, _ = await read_run(self._plane, ask.run)
        model = _kept(run, ask.model)
        if model.manifest is None:
            raise NotFoundError(f"model {model.number} of run {run.id} has no files")
        params = {"model": run.recipe.model, "base": base_of(model), "export": ask.format}
        owner = f"{records.round_key(run.id, model.number)}/model"
        result = await self._run_evaluate(run, model, f"export-{time.time_ns()}", params, owner=owner)
        try:
            file, checks = (msgspec.convert(result[name], Reference) for name in ("file", "checks"))
        except (KeyError, msgspec.ValidationError) as error:
            raise PayloadError(f"the export of {run.id} has no file: {error}") from error
        return LearnExported(run=run.id, model=model.number, file=file, checks=checks)

    async def _judged(self, run: RunRecord, model: Model, *, subtask: str, limit: int | None) -> dict[str, Any]:
        """Evaluate a model in a container and return the result; SwiftbotError where that fails."""
        params = {
            "model": run.recipe.model,
            "base": base_of(model),
            "data": data_of(run.recipe),
            "part": {"by": "even", "index": 0, "of": 1},
            "limit": limit,
            "seed": run.recipe.seed,
        }
        return await self._run_evaluate(run, model, subtask, params, owner=records.round_key(run.id, model.number))

    async def _run_evaluate(
        self, run: RunRecord, model: Model, subtask: str, params: dict[str, Any], *, owner: str
    ) -> dict[str, Any]:
        manifest = self._site.manifest(EVALUATE)
        request = RunRequest(
            task=records.task_of(run.id, model.number), subtask=subtask, attempt=1, skill=EVALUATE,
            need=need_of(manifest), params=params, coordinator=self._plane.gateway, deadline_s=manifest.timeout_s,
            submitter=f"learn {run.id}", priority=PRIORITY,
        )  # fmt: skip
        return await run_skill(self._plane, request, manifest, owner=owner)

    async def _evaluate(self, run: RunRecord, model: Model) -> None:
        """Evaluate the model of a round that was just closed, and note it in the run's record."""
        try:
            result = await self._judged(run, model, subtask="evaluate", limit=run.recipe.evaluation.limit)
            accuracy, loss = float(result["accuracy"]), result.get("loss")
            changed = await change_run(
                self._plane,
                run.id,
                lambda record: rounds.evaluated(
                    record, model.number, accuracy=accuracy, loss=loss, now_ns=time.time_ns()
                ),
            )
        except (SwiftbotError, KeyError, TypeError, ValueError) as error:
            log.warning("a model was not evaluated", run=run.id, model=model.number, reason=str(error))
            return
        if changed[1] and (numbers := metric(changed[0], model.number)) is not None:
            self._plane.session.publish(keyspace.LEARN_METRIC, numbers, run.id)
        log.info("model evaluated", run=run.id, model=model.number, accuracy=accuracy, state=str(changed[0].state))

    # --- what happens to the fleet --------------------------------------------------------------------------------

    def _present(self, recipe: Recipe) -> Mapping[str, str]:
        """The clients that are there: robots with their gateways, parts of a data set wherever there is room."""
        if not recipe.clients.robots:
            return dict.fromkeys(recipe.names, "")
        robots = self._plane.registry.robots
        there = {
            name: robot.gateway or self._plane.ring.owner(f"robot/{name}")
            for name in recipe.clients.robots
            if (robot := robots.get(name)) is not None and robot.online
        }
        shared = recipes.shared_data(recipe, there)  # robots move: the same data must not count for two of them
        return {name: gateway for name, gateway in there.items() if name not in shared}

    def _is_ours(self, key: str) -> bool:
        found = records.round_of(keyspace.RUN_EVENT.names(key)[0])
        return found is not None and found[0] in self._drivers

    def _on_run_event(self, _: str, event: RunEvent | None) -> None:
        if event is None or (found := records.round_of(event.task)) is None:
            return
        driver = self._drivers.get(found[0])
        if driver is None:
            return
        if not self._plane.sees(event.gateway):
            self._plane.session.deny("forged run event", event.task, f"from {event.gateway[:80]!r}")
            return
        driver.heard(event)

    def _on_run_changed(self, _: str, record: RunRecord | None) -> None:
        if record is not None and (driver := self._drivers.get(record.id)) is not None:
            driver.put(rounds.Changed(record))

    def _on_fleet_event(self, event: FleetEvent) -> None:
        match event:
            case Lost(gateway):
                for driver in self._drivers.values():
                    driver.follow_presence()
                    driver.gateway_lost(gateway)
                self._sweep.set()
            case RingChanged() | Joined() | Relinked():
                self._sweep.set()
            case FactsChanged("robot"):
                for driver in self._drivers.values():
                    driver.follow_presence()
            case _:
                pass

    # --- answers --------------------------------------------------------------------------------------------------

    async def begin(self, ask: LearnStartAsk) -> RunRecord:
        """Answer `learn_start`."""
        recipes.check(ask.recipe, "recipe")
        known = self._plane.registry.robots
        recipes.check_robots(ask.recipe, known)
        recipes.check_shared(ask.recipe, {name: known[name].gateway or "" for name in ask.recipe.clients.robots})
        try:
            await asyncio.to_thread(models.read, ask.recipe.model, (models.FOLDER, self._folder / "models"))
        except ModelError as error:
            raise ConfigError(f"recipe: model: {error}", remedy="see docs/learning.md for the models") from error
        most_samples = await self._check_data(ask.recipe)
        recipes.check_secure(ask.recipe, self._present(ask.recipe), most_samples)
        run = RunRecord(
            id=ask.id,
            recipe=ask.recipe,
            clients=tuple(ClientState(name=name) for name in ask.recipe.names),
            most_samples=most_samples,
            by=ask.by,
            started_ns=time.time_ns(),
            updated_ns=time.time_ns(),
        )
        try:
            await write(self._plane, records.run_key(run.id), run, None)
        except ConflictError:
            known, _ = await read_run(self._plane, run.id)
            if known.recipe != ask.recipe:
                raise RefusedError(f"there is a run {run.id} of another recipe", remedy="give another name") from None
            return known
        self._plane.session.publish(keyspace.LEARN_RUN, run, run.id)
        await self._open(run)
        return run

    async def _check_data(self, recipe: Recipe) -> int:
        """Ask gateways what they have of the data; returns how many items the largest data set has.

        Raises:
            ConfigError: no gateway has it, a robot's gateway does not, or the classes are not the same everywhere.
        """
        wanted = self._wanted(recipe)
        answers = await asyncio.gather(*(self._data_at(gateway, paths) for gateway, paths in wanted.items()))
        found = {(gateway, each.path): each for gateway, answer in zip(wanted, answers, strict=True) for each in answer}
        return recipes.check_data(recipe, found)

    def _wanted(self, recipe: Recipe) -> dict[str, tuple[str, ...]]:
        """Return which data are looked for at which gateway."""
        if not recipe.clients.robots:
            return {gateway: (recipes.data_path(recipe, ""),) for gateway in sorted(self._plane.members())}
        wanted: dict[str, list[str]] = {}
        for name, gateway in self._present(recipe).items():
            wanted.setdefault(gateway, []).append(recipes.data_path(recipe, name))
        return {gateway: tuple(paths) for gateway, paths in wanted.items()}

    async def _data_at(self, gateway: str, paths: tuple[str, ...]) -> tuple[DataFound, ...]:
        """Ask a gateway what it has; empty where it does not answer: clients there will fail with the reason."""
        try:
            return (await self._plane.rpc.call(gateway, keyspace.LEARN_DATA, LearnDataAsk(paths=paths))).found
        except SwiftbotError as error:
            log.warning("a gateway's data are not checked", gateway=gateway, reason=error.message)
            return ()

    async def data(self, ask: LearnDataAsk) -> LearnData:
        """Answer `learn_data`."""
        return LearnData(
            found=tuple(await asyncio.to_thread(lambda: [_found(self._folder, each) for each in ask.paths]))
        )

    async def keys(self, ask: LearnKeysAsk) -> LearnKeys:
        """Answer `learn_keys`."""
        return LearnKeys(keys=self._keys.advertise(ask.epoch, ask.clients[:MOST_CLIENTS]))

    async def share(self, ask: LearnShareAsk) -> LearnShares:
        """Answer `learn_share`."""
        return LearnShares(sealed=await asyncio.to_thread(self._keys.share, ask.cohort))

    async def hold(self, ask: LearnHoldAsk) -> LearnHeld:
        """Answer `learn_hold`."""
        return LearnHeld(clients=await asyncio.to_thread(self._keys.hold, ask.cohort, ask.sealed))

    async def unmask(self, ask: LearnUnmaskAsk) -> LearnUnmasked:
        """Answer `learn_unmask`."""
        return LearnUnmasked(revealed=self._keys.unmask(ask.epoch, ask.summed))

    async def masks(self, call: Call) -> dict[str, Any]:
        """Answer a handler that trains for a client here: `{"masks": [[seed in hex, 1 or -1], …]}`."""
        seeds = await asyncio.to_thread(self._keys.masks, str(call.args.get("epoch", "")), call.run.subtask)
        return {"masks": [[each.seed.hex(), each.sign] for each in seeds]}

    async def runs(self, _: LearnRunsAsk) -> LearnRuns:
        """Answer `learn_runs`."""
        found: list[RunRecord] = []
        for stored in await self._plane.dht.local(records.PREFIX):
            if "/" not in stored.key.removeprefix(records.PREFIX):
                try:
                    found.append(records.read(stored.value, RunRecord))
                except PayloadError:
                    continue
        return LearnRuns(runs=tuple(sorted(found, key=lambda run: (-run.started_ns, run.id))))

    async def show(self, ask: LearnShowAsk) -> LearnShown:
        """Answer `learn_show`: what the coordinator of the round says, or where it does not answer, the records."""
        run, _ = await read_run(self._plane, ask.run)
        first, *rest = self._plane.ring.successors(records.round_key(run.id, run.round), 2)
        driver = self._drivers.get(run.id)
        if driver is not None and (record := driver.record()) is not None:
            return LearnShown(
                run=run, round=record, coordinator=self._plane.gateway, successor=rest[0] if rest else "",
                working=driver.working(), clients=driver.clients(), elapsed_s=record.elapsed_s,
            )  # fmt: skip
        if first != self._plane.gateway and not ask.here:
            try:
                return await self._plane.rpc.call(first, keyspace.LEARN_SHOW, replace(ask, here=True))
            except SwiftbotError as error:
                log.info("the coordinator of a round does not answer", gateway=first, reason=str(error))
        stored = await self._plane.dht.read(records.round_key(run.id, run.round))
        kept = records.read(stored.value, RoundRecord) if stored is not None else None
        return LearnShown(
            run=run, round=kept, coordinator=first, successor=rest[0] if rest else "",
            clients=statuses(run, kept, ()), elapsed_s=kept.elapsed_s if kept is not None else 0.0,
        )  # fmt: skip

    async def steer(self, ask: LearnSteerAsk) -> RunRecord:
        """Answer `learn_steer`."""
        if ask.do == "remove":
            return await self._remove(ask)
        record, _ = await change_run(self._plane, ask.run, lambda run: steered(run, ask, now_ns=time.time_ns()))
        return record

    async def _remove(self, ask: LearnSteerAsk) -> RunRecord:
        """Remove a run that has ended; its rounds and files follow on every gateway."""
        while True:
            run, version = await read_run(self._plane, ask.run)
            if not run.state.final:
                raise RefusedError(f"run {run.id} is {run.state}", remedy=f"swiftbot learn stop {run.id}")
            await self._remove_rounds(run)
            try:
                await self._plane.dht.remove(records.run_key(run.id), expected=version)
            except ConflictError:
                continue
            self._forgetting.set()
            return run

    async def _remove_rounds(self, run: RunRecord) -> None:
        """Remove the records of a run's rounds: a later run of the same name must not find them."""
        numbers = range(max(1, run.round - run.recipe.rounds.max_staleness - KEPT_ROUNDS - 1), run.round + 2)
        keys = [records.round_key(run.id, number) for number in numbers]
        keys += [records.update_key(run.id, number, client.name) for number in numbers for client in run.clients]

        async def remove(key: str) -> None:
            stored = await self._plane.dht.read(key)
            if stored is not None:
                with contextlib.suppress(ConflictError):
                    await self._plane.dht.remove(key, expected=stored.version)

        for start in range(0, len(keys), READ_AT_ONCE):
            await asyncio.gather(*map(remove, keys[start : start + READ_AT_ONCE]))

    # --- retention ------------------------------------------------------------------------------------------------

    async def needed(self, task: str) -> bool:
        """Whether what belongs to the run of a client, such as its checkpoint, is still needed."""
        found = records.round_of(task)
        if found is None:
            return False
        try:
            run, _ = await read_run(self._plane, found[0])
        except NotFoundError:
            return False
        except (UnreachableError, PayloadError):
            return True
        return not run.state.final and found[1] >= run.round - run.recipe.rounds.max_staleness

    async def _keep_forgetting(self) -> None:
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(RETENTION_S):
                    await self._forgetting.wait()
            self._forgetting.clear()
            try:
                await self._forget()
            except (SwiftbotError, OSError) as error:
                log.warning("old rounds are removed later", reason=str(error))

    async def _forget(self) -> None:
        """Remove files and records of rounds that are no longer needed."""
        runs: dict[str, RunRecord | None] = {}
        unknown: set[str] = set()

        async def run_of(name: str) -> RunRecord | None:
            if name not in runs and name not in unknown:
                try:
                    runs[name] = (await read_run(self._plane, name))[0]
                    self._absent.pop(name, None)
                except NotFoundError:
                    if await self._is_gone(name):
                        runs[name] = None
                    else:
                        unknown.add(name)
                except SwiftbotError as error:
                    unknown.add(name)
                    log.warning("files of a run are kept, its record cannot be read", run=name, reason=error.message)
            return runs.get(name)

        for owner in await self._artifacts.owners():
            if owner.startswith(records.PREFIX):
                name, number, what = _owner(owner)
                run = await run_of(name)
                gone = run is None or not keeps_files(run, number, model=what == "model")
                if gone and name not in unknown:
                    await self._artifacts.forget(owner)
        for stored in await self._plane.dht.local(records.PREFIX):
            try:
                name, number, _ = records.taken_apart(stored.key)
            except PayloadError:
                continue
            if number is None or not self._plane.dht.owns(stored.key):
                continue
            run = await run_of(name)
            if name in unknown:
                continue
            if run is None or not keeps_round(run, number):
                with contextlib.suppress(ConflictError):
                    await self._plane.dht.remove(stored.key, expected=stored.version)
        self._absent = {name: since for name, since in self._absent.items() if name in unknown}
        await self._forget_ended()

    async def _is_gone(self, run: str) -> bool:
        """Whether a run without a record was removed, or has had none for so long that no gateway has it."""
        key = records.run_key(run)
        if await self._plane.dht.removed(key):
            return True
        now = time.monotonic()
        return now - self._absent.setdefault(run, now) >= ABSENT_S

    async def _forget_ended(self) -> None:
        """Remove the oldest of the runs that have ended where there are more than are kept."""
        owned = [
            (stored, run)
            for stored in await self._plane.dht.local(records.PREFIX)
            if "/" not in stored.key.removeprefix(records.PREFIX)
            and self._plane.dht.owns(stored.key)
            and (run := _read_run(stored.value)) is not None
        ]
        due = {run.id for run in surplus([run for _, run in owned], self._keep_ended)[:REMOVED_AT_ONCE]}
        for stored, run in owned:
            if run.id in due:
                log.info("a run that has ended is removed", run=run.id, remedy="raise tasks.keep_runs to keep more")
                with contextlib.suppress(ConflictError):
                    await self._plane.dht.remove(stored.key, expected=stored.version)


def _found(folder: Path, path: str) -> DataFound:
    """Look at the lists of a data set."""
    parts = PurePosixPath(path).parts
    if not parts or ".." in parts or parts[0] == "/":
        return DataFound(path=path, missing="it is no path within the folder of data sets")
    try:
        outline = loading.outline(folder.joinpath(*parts))
    except (DataError, OSError, ValueError) as error:
        return DataFound(path=path, missing=str(error)[:300])
    return DataFound(path=path, classes=outline.classes, items=outline.items)


def _read_run(value: bytes) -> RunRecord | None:
    try:
        return records.read(value, RunRecord)
    except PayloadError:
        return None


def surplus(runs: Iterable[RunRecord], keep: int) -> list[RunRecord]:
    """Return the runs that have ended beyond so many, the oldest first; one with a marked model is none of them."""
    ended = [run for run in runs if run.state.final and not any(model.marked for model in run.models)]
    return sorted(ended, key=lambda run: (run.updated_ns, run.id))[: max(0, len(ended) - keep)]


def keeps_round(run: RunRecord, number: int) -> bool:
    """Whether the records of a round are still needed: of a run that has ended only the last ones'."""
    staleness = 0 if run.state.final else run.recipe.rounds.max_staleness
    return number >= run.round - staleness - KEPT_ROUNDS


def _kept(run: RunRecord, number: int | None) -> Model:
    """Return a model that a run keeps, None: the newest; NotFoundError where it keeps none of that number."""
    kept = {model.number: model for model in (*run.models, run.model)}
    wanted = run.model.number if number is None else number
    if wanted not in kept:
        raise NotFoundError(f"run {run.id} keeps no model {wanted}", remedy="`swiftbot learn models` lists them")
    return kept[wanted]


def _opens(key: str) -> bool:
    """Whether a key is that of a run or a round, by which a round may be this gateway's; updates come by the dozen."""
    return key.startswith(records.PREFIX) and key.count("/") < 3


def _owner(owner: str) -> tuple[str, int, str]:
    """Return run, round and what else stands in the key of an owner of files."""
    run, *rest = owner.removeprefix(records.PREFIX).split("/")
    number = int(rest[0]) if rest and rest[0].isdecimal() else 0
    return run, number, rest[1] if len(rest) > 1 else ""


def keeps_files(run: RunRecord, number: int, *, model: bool) -> bool:
    """Whether files of a round are still needed: its model, or its updates and checkpoints."""
    if model:
        # The one that was just made is not in the record yet.
        return number >= run.round or any(kept.number == number for kept in run.models)
    if run.state.final:
        return False
    residual = any(client.residual and client.residual_round == number for client in run.clients)
    return residual or number >= run.round - run.recipe.rounds.max_staleness


def steered(run: RunRecord, ask: LearnSteerAsk, *, now_ns: int) -> RunRecord | None:
    """Return a run's record after an operator's word; None where that changes nothing.

    Raises:
        RefusedError: not as the run stands.
        NotFoundError: no such client or model.
    """
    by = f"by {ask.by or 'an unknown operator'}{f': {ask.why}' if ask.why else ''}"
    if run.state.final and ask.do not in ("mark", "unmark"):
        raise RefusedError(f"run {run.id} {run.state}: {run.why}", remedy="start another run")
    match ask.do:
        case "remove":
            raise RefusedError(f"run {run.id} is removed, not changed")
        case "pause":
            return replace(run, state=RunState.PAUSED, why=f"paused {by}", updated_ns=now_ns)
        case "resume":
            if run.state is not RunState.PAUSED:
                raise RefusedError(f"run {run.id} is not paused")
            return replace(run, state=RunState.RUNNING, why="", updated_ns=now_ns)
        case "stop":
            return replace(run, state=RunState.STOPPED, why=f"stopped {by}", updated_ns=now_ns)
        case "exclude" | "include":
            if ask.client not in {client.name for client in run.clients}:
                raise NotFoundError(
                    f"no client {ask.client[:60]!r} in run {run.id}",
                    remedy=f"there are {', '.join(client.name for client in run.clients[:8])}",
                )
            excluded = f"excluded {by}" if ask.do == "exclude" else ""
            clients = tuple(
                replace(client, excluded=excluded, refused=0) if client.name == ask.client else client
                for client in run.clients
            )
            return replace(run, clients=clients, updated_ns=now_ns)
        case "mark" | "unmark":
            if ask.model not in {model.number for model in run.models}:
                raise NotFoundError(
                    f"run {run.id} keeps no model {ask.model}", remedy="`swiftbot learn models` lists them"
                )
            marked = tuple(
                replace(model, marked=ask.do == "mark") if model.number == ask.model else model for model in run.models
            )
            return replace(run, models=marked, updated_ns=now_ns)
