"""Coordinates one round on the gateway that owns its record: carries out what `rounds.Decider` decides.

Everything that another coordinator would need is in the records before it takes effect: orders before they are sent, an
update before it counts, the model on enough gateways before the run's record names it. A driver that breaks, or whose
gateway goes, is followed by another one, which reads the records, asks after the orders and goes on.
"""

import asyncio
import contextlib
import hashlib
import random
import secrets
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import msgspec
import structlog
from msgspec.structs import replace

from appliance.errors import ConflictError, DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.learn import recipe as recipes
from appliance.learn import records, rounds, secagg
from appliance.learn.decisions import NAME, RoundCase, TracedDecider
from appliance.learn.rounds import Decider, Event, Instruction, Key
from appliance.learn.status import metric, statuses
from appliance.model import RunEvent, RunEventKind, RunRequest, VersionVector, encode, keyspace
from appliance.model.learn_api import (
    LearnHoldAsk,
    LearnKeysAsk,
    LearnShareAsk,
    LearnUnmaskAsk,
    LearnUnmasked,
    Working,
)
from appliance.model.learning import (
    ClientStatus,
    Cohort,
    Model,
    Order,
    PartialUpdate,
    PublicKeys,
    Recipe,
    Reference,
    RoundRecord,
    RunRecord,
    UpdateRecord,
)
from appliance.model.task_api import ArtifactKeep, RunAsk, RunStatus
from appliance.plane.node import Plane
from appliance.plane.records import Record
from appliance.skills._lib.learning import shards
from appliance.skills._lib.learning.masks import Seed
from appliance.skills._lib.learning.seeds import seed
from appliance.skills._lib.learning.weights import WEIGHT_UNIT
from appliance.skills.catalogue import SkillManifest
from appliance.tasks.artifacts import Artifacts
from appliance.tasks.checkpoints import Checkpoint, checkpoint_key
from appliance.tasks.orders import need_of

log = structlog.get_logger(__name__)

TRAIN, AGGREGATE, EVALUATE = "train_local", "aggregate", "evaluate"
CHECK_S = 2.0
"""How often gateways are asked after orders of which nothing was heard."""
CLIENT_NEWS_S = 1.0
ROUND_NEWS_S = 5.0
"""How often an open round is put again: the time that it takes has no other news."""
SEND_AGAIN_S = 0.5
LONGEST_SEND_S = 10.0
READ_AT_ONCE = WRITE_AT_ONCE = 32
KEEP_S = 60.0
"""How long a gateway may take to fetch a file of a model."""
PRIORITY = 0
"""Of its runs, where they wait for a container: tasks go first."""
DEADLINE_S = 86_400.0
"""Longest run of a client; the decider gives it up sooner."""
TRANSIENT = frozenset({"unreachable", "refused", "conflict", "orphaned", "stopped", "not-found"})
"""Codes of failures of what passes by itself: a gateway that restarts or has no room, a model that is out of reach."""
LEFT_OUT = frozenset({"krum", "lost"})
"""Reasons of `aggregate` for leaving out an update that are no fault of its client."""
MOST_CLASSES = 10_000
"""That an update's record takes in."""
FETCHED_AT_ONCE = 4
"""Files of updates that are copied here at once."""
SUPERSEDED = "the round is another coordinator's"


class SupersededError(Exception):
    """Another gateway coordinates the round, or it is closed."""


class Site(NamedTuple):
    """The parts of this gateway that a driver uses.

    Attributes:
        plane: the fleet.
        artifacts: files of this gateway.
        manifest: of a skill; NotFoundError when it is not known.
        copies: gateways that are to hold a model before it counts.
        refused: counts what was refused, by reason.
        tell_decisions: whether each step of a round's decider is put, for the log.
    """

    plane: Plane
    artifacts: Artifacts
    manifest: Callable[[str], SkillManifest]
    copies: int
    refused: Counter[str]
    tell_decisions: bool = False


class Sent(NamedTuple):
    """An order that was sent from here, or asked after."""

    order: Order
    at: float
    heard: float
    progress: float = 0.0
    note: str = ""
    queued: bool = False
    """Whether its gateway has taken it, and has no container for it yet."""


async def write(plane: Plane, key: str, value: Any, expected: VersionVector | None) -> VersionVector:
    """Write a record; errors as `Dht.write`."""
    return await plane.dht.write(key, encode(value), expected=expected)


async def change_run(plane: Plane, run: str, change: Callable[[RunRecord], RunRecord | None]) -> tuple[RunRecord, bool]:
    """Compare and set a run's record, and tell of it.

    Args:
        plane: the fleet.
        run: its id.
        change: returns the record as it is to be, None to leave it; called again when the record has moved on.

    Returns:
        The record as it stands, and whether it was changed.

    Raises:
        NotFoundError, PayloadError, UnreachableError: it cannot be read or written.
    """
    while True:
        record, version = await read_run(plane, run)
        wanted = change(record)
        if wanted is None or wanted == record:
            return record, False
        try:
            await write(plane, records.run_key(run), wanted, version)
        except ConflictError:
            continue
        plane.session.publish(keyspace.LEARN_RUN, wanted, run)
        return wanted, True


async def read_run(plane: Plane, run: str) -> tuple[RunRecord, VersionVector]:
    """Return a run's record with its version; NotFoundError where there is none."""
    stored = await plane.dht.read(records.run_key(run))
    if stored is None:
        raise records.no_run(run)
    return records.read(stored.value, RunRecord), stored.version


class RoundDriver:
    """One round. `drive` returns when it is closed, or another gateway's.

    Args:
        site: the parts of this gateway.
        run: id of the run.
        number: of the round.
        present: client -> gateway of those that are there, by the recipe.
        closed: told of the run's record after the round.
    """

    def __init__(
        self,
        site: Site,
        *,
        run: str,
        number: int,
        present: Callable[[Recipe], Mapping[str, str]],
        closed: Callable[[RunRecord], None],
    ) -> None:
        self._site, self._plane = site, site.plane
        self._run_id, self.number = run, number
        self._present = present
        self._closed = closed
        self._events: asyncio.Queue[Event] = asyncio.Queue()
        self._work: set[asyncio.Task[object]] = set()
        self._cancelling: set[asyncio.Task[object]] = set()
        self._sent: dict[Key, Sent] = {}
        self._aggregation_failed = False
        self._avoid: dict[Key, set[str]] = {}
        self._placed: dict[Key, str] = {}
        """Where each order was sent last, or is about to be."""
        self._fetching = asyncio.Semaphore(FETCHED_AT_ONCE)
        self._versions: dict[str, VersionVector | None] = {}
        """Of the records that this driver writes, by key."""
        self._there: dict[str, str] = {}
        self._looked = 0.0
        """The decider's time when it looked last."""
        self._run: RunRecord | None = None
        self._decider: Decider | None = None
        self._told: dict[str, ClientStatus] = {}
        """What was put last of each client."""
        self._published = 0.0
        """When the round's record was put last."""

    # --- what others ask ------------------------------------------------------------------------------------------

    def record(self) -> RoundRecord | None:
        """The round's record as it stands here."""
        return self._decider.record(time.monotonic()) if self._decider is not None else None

    def working(self) -> tuple[Working, ...]:
        """The orders that are under way."""
        now = time.monotonic()
        orders = self._decider.orders if self._decider is not None else ()
        found: list[Working] = []
        for order in orders:
            sent = self._sent.get((order.client, order.round, order.part))
            found.append(
                Working(
                    client=order.client,
                    part=order.part,
                    helper=order.helper,
                    gateway=order.gateway,
                    attempt=order.attempt,
                    round=order.round,
                    since_s=round(now - sent.at, 3) if sent else 0.0,
                    progress=sent.progress if sent else 0.0,
                    note=sent.note if sent else "",
                    queued=sent.queued if sent else False,
                )
            )
        return tuple(found)

    def clients(self) -> tuple[ClientStatus, ...]:
        """What each client is at."""
        if self._run is None or self._decider is None:
            return ()
        return statuses(self._run, self.record(), self.working(), accepted=self._decider.accepted, places=self._there)

    def put(self, event: Event) -> None:
        """Hand in an event."""
        self._events.put_nowait(event)

    def follow_presence(self) -> None:
        """Tell the decider which clients have come and gone."""
        if self._run is None:
            return
        now = dict(self._present(self._run.recipe))
        for client, gateway in now.items():
            if self._there.get(client) != gateway:
                self.put(rounds.Present(client, gateway))
        for client in self._there.keys() - now.keys():
            self.put(rounds.Lost(client))
        self._there = now

    def gateway_lost(self, gateway: str) -> None:
        """The orders that were there have failed; they are made again elsewhere."""
        if self._decider is None:
            return
        for order in self._decider.orders:
            if order.gateway == gateway:
                key = (order.client, order.round, order.part)
                self.put(rounds.Failed(key, order.attempt, f"{gateway} is gone", transient=True))

    def heard(self, event: RunEvent) -> None:
        """Take in news of a run of a client."""
        found = records.round_of(event.task)
        key = self._key_of(event.subtask, found[1]) if found is not None else None
        if key is None:
            return
        sent = self._sent.get(key)
        if sent is not None and sent.order.attempt == event.attempt:
            note = event.note if event.kind is RunEventKind.PROGRESS else sent.note
            progress = event.progress if event.kind is RunEventKind.PROGRESS else sent.progress
            if sent.queued:
                note = "" if note == sent.note else note
                self.put(rounds.Ordered(key, event.attempt, event.gateway))  # it waits no longer
            self._sent[key] = sent._replace(heard=time.monotonic(), note=note, progress=progress, queued=False)
        if event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            self._ended(key, event)

    def _key_of(self, subtask: str, number: int) -> Key | None:
        """Return the order of a run's subtask."""
        if self._decider is not None:
            for order in self._decider.orders:
                if order.round == number and order.subtask == subtask:
                    return (order.client, order.round, order.part)
        return None

    def _ended(self, key: Key, event: RunEvent) -> None:
        if event.kind is RunEventKind.FAILED:
            failure = event.failure
            reason = failure.message if failure is not None else "it failed without a reason"
            # Of a pool's failures that of a run which has not begun is none of its client: it had no container.
            waited = failure is not None and failure.code == "pool" and event.duration_ms is None
            transient = waited or (failure is not None and failure.code in TRANSIENT)
            self._avoid.setdefault(key, set()).add(event.gateway)
            reason = f"{event.gateway}: {reason}"
            sent = self._sent.get(key)
            if sent is not None and sent.order.attempt == event.attempt:
                self._sent[key] = sent._replace(note=reason, queued=False)  # until it is sent again
            self.put(rounds.Failed(key, event.attempt, reason, transient=transient))
            return
        order = self._decider.order(key) if self._decider is not None else None
        if order is None:
            return
        try:
            update = self._update(order, event)
        except PayloadError as error:
            self._site.refused["learn update"] += 1
            self.put(rounds.Failed(key, event.attempt, error.message, retryable=False))
            return
        self.put(rounds.Arrived(self._run_id, update))

    def _update(self, order: Order, event: RunEvent) -> PartialUpdate:
        """Return what a run's result says; PayloadError where it cannot be an update."""
        result = event.result or {}
        sent = self._sent.get((order.client, order.round, order.part))
        took = time.monotonic() - sent.at if sent is not None and sent.order.attempt == event.attempt else 0.0
        try:
            return PartialUpdate(
                client=order.client,
                round=order.round,
                part=order.part,
                attempt=event.attempt,
                gateway=event.gateway,
                manifest=msgspec.convert(result["manifest"], dict[str, Any]),
                shards=msgspec.convert(result["shards"], tuple[Reference, ...]),
                samples=msgspec.convert(result["samples"], int),
                coding=msgspec.convert(result.get("coding", "none"), Literal["none", "int8", "masked"]),
                residual=tuple(
                    {key: each[key] for key in ("artifact", "bytes", "gateway")}
                    for each in msgspec.convert(result.get("residual", ()), tuple[Reference, ...])
                ),
                steps=msgspec.convert(result["steps"], int),
                steps_whole=msgspec.convert(result["steps_of_epoch"], int) * self._recipe().training.epochs,
                loss=msgspec.convert(result.get("loss"), float | None),
                classes=self._other_classes(msgspec.convert(result.get("classes", ()), tuple[str, ...])),
                took_s=round(took or msgspec.convert(result.get("train_s", 0.0), float), 4),
                train_s=msgspec.convert(result.get("train_s"), float | None),
            )
        except (KeyError, msgspec.ValidationError) as error:
            raise PayloadError(f"the result of {order.client} is no update: {error}") from error

    def _other_classes(self, found: tuple[str, ...]) -> tuple[str, ...]:
        """Return the classes of a client's data where they are not those of the run, which are in its record."""
        return () if self._run is None or found == self._run.classes else found[:MOST_CLASSES]

    # --- the loop -------------------------------------------------------------------------------------------------

    async def drive(self) -> None:
        """Coordinate the round until it is closed here.

        Raises:
            SupersededError: it is another coordinator's, or closed.
            SwiftbotError: a record cannot be read or written; drive it anew.
        """
        try:
            await self._begin()
            await self._loop()
            if self._run is not None and self._run.state.final:
                self._publish_clients()
            if self._cancelling:  # of a stopped run: nothing else ends its clients' runs
                await asyncio.wait(self._cancelling)
        finally:
            for work in self._work:
                work.cancel()
            await asyncio.gather(*self._work, return_exceptions=True)

    async def _begin(self) -> None:
        run, _ = await read_run(self._plane, self._run_id)
        key = records.round_key(self._run_id, self.number)
        stored = await self._plane.dht.read(key)
        record = RoundRecord(run=self._run_id, number=self.number, base=run.model)
        if stored is not None:
            record = records.read(stored.value, RoundRecord)
            self._versions[key] = stored.version
        if run.state.final or run.round != self.number or record.closed:
            if stored is not None and not record.closed:
                await self._end(run, record)
            raise SupersededError(SUPERSEDED)
        updates = await self._updates(run) if record.target or run.apart else []
        if record.base.digest != run.model.digest:
            record, updates = await self._rebase(record, updates, run.model), []
        apart = await self._of_other_side(run) if run.apart and not record.target else []
        self._run = run
        self._there = dict(self._present(run.recipe))
        now = time.monotonic()
        if self._site.tell_decisions:
            self._decider = TracedDecider(
                run, record, updates=updates, apart=apart, present=self._there, now=now, put=self._tell_decision
            )
        else:
            self._decider = Decider(run, record, updates=updates, apart=apart, present=self._there, now=now)
        for part in (part for update in updates for part in update.parts):
            self._start(self._fetch(part))
        log.info("coordinating a round", run=self._run_id, round=self.number, orders=len(record.orders))
        self._looked = now
        await self._carry_out(self._decider.resume(now))

    def _tell_decision(self, case: RoundCase) -> None:
        """Put a step of the decider, so that `swiftbot log check` can make it again."""
        self._plane.session.put(self._plane.keys(keyspace.DECIDED, self._plane.gateway, NAME), encode(case))

    async def _end(self, run: RunRecord, record: RoundRecord) -> None:
        """Close a round that the run has left behind, or ended in: open, it would be taken up again and again."""
        if run.state.final:
            await asyncio.gather(*(self._cancel(order) for order in record.orders if not order.given_up))
        elif run.round < record.number:
            return
        why = run.why if run.state.final else f"the run is in round {run.round}"
        await self._write(replace(record, closed=True, closed_by=why, waits=""))

    async def _rebase(self, record: RoundRecord, updates: list[UpdateRecord], base: Model) -> RoundRecord:
        """Begin a round again with the model that counts; its updates go first: found later, they would count."""
        log.warning("a round begins again with the model that counts after a partition", run=self._run_id)
        following = rounds.rebased(record, updates, base)
        for update in updates:
            await self._accept(rounds.Accept(self.number, replace(update, parts=())))
        await self._write(following)
        return following

    async def _updates(self, run: RunRecord) -> list[UpdateRecord]:
        """Read what is accepted for the round already."""
        found: list[UpdateRecord] = []
        for key, stored in (await self._read_all(self._update_keys(run, self.number))).items():
            self._versions[key] = stored.version
            found.append(records.read(stored.value, UpdateRecord))
        return [update for update in found if update.parts]

    def _update_keys(self, run: RunRecord, number: int) -> list[str]:
        return [records.update_key(self._run_id, number, client.name) for client in run.clients]

    async def _read_all(self, keys: list[str]) -> dict[str, Record]:
        """Read records, some at once; those that there are, by key."""
        found: dict[str, Record] = {}
        for start in range(0, len(keys), READ_AT_ONCE):
            some = keys[start : start + READ_AT_ONCE]
            stored = await asyncio.gather(*map(self._plane.dht.read, some))
            found |= {key: record for key, record in zip(some, stored, strict=True) if record is not None}
        return found

    async def _of_other_side(self, run: RunRecord) -> list[UpdateRecord]:
        """Read the updates of rounds that another side of a partition has closed, and that count nowhere yet."""
        numbers = range(min(run.apart), run.round)
        keys = {records.round_key(self._run_id, number): number for number in numbers}
        closed = {
            keys[key]: records.read(stored.value, RoundRecord)
            for key, stored in (await self._read_all(list(keys))).items()
        }
        updates = await self._read_all([key for number in run.apart for key in self._update_keys(run, number)])
        found = [records.read(stored.value, UpdateRecord) for stored in updates.values()]
        apart = records.unclaimed(run, closed, found)
        log.info("updates of another side of a partition count late", run=self._run_id, updates=len(apart))
        return apart

    async def _loop(self) -> None:
        decider = self._decider
        assert decider is not None  # noqa: S101 - `_begin` made it
        self._start(self._check_orders())
        self._start(self._keep_publishing())
        while not decider.done:
            # By the time at which it looked last: what has become due since then would else be overlooked for ever.
            at = decider.next_at(self._looked)
            try:
                async with asyncio.timeout(None if at is None else max(0.0, at - time.monotonic())):
                    event = await self._events.get()
            except TimeoutError:
                self._looked = time.monotonic()
                await self._carry_out(decider.advance(self._looked))
                continue
            instructions: list[Instruction] = []
            while True:
                if isinstance(event, rounds.Changed):
                    self._run = event.run
                self._looked = time.monotonic()
                instructions += decider.handle(event, self._looked)
                if self._events.empty():
                    break
                event = self._events.get_nowait()
            await self._carry_out(instructions)

    async def _carry_out(self, instructions: list[Instruction]) -> None:
        accepts: dict[str, rounds.Accept] = {}
        """Of clients that answered together: their records are written side by side, before what follows them."""
        for instruction in instructions:
            if accepts and not (
                isinstance(instruction, rounds.Accept)
                and instruction.record.client not in accepts
                and len(accepts) < WRITE_AT_ONCE
            ):
                await self._accept_all(accepts)
            match instruction:
                case rounds.WriteRound():
                    await self._write(instruction.record)
                case rounds.MakeKeys():
                    self._start(self._make_keys(instruction))
                case rounds.Send():
                    self._start(self._send(instruction.order))
                case rounds.Ask():
                    self._start(self._ask(instruction.order))
                case rounds.Cancel():
                    cancelling = self._start(self._cancel(instruction.order))
                    self._cancelling.add(cancelling)
                    cancelling.add_done_callback(self._cancelling.discard)
                case rounds.Accept():
                    accepts[instruction.record.client] = instruction
                case rounds.Refuse():
                    self._site.refused["learn update"] += 1
                    log.warning(
                        "an update is refused", run=self._run_id, client=instruction.client, reason=instruction.reason
                    )
                case rounds.Exclude():
                    await self._exclude(instruction)
                case rounds.Aggregate():
                    self._start(self._aggregate(instruction))
                case rounds.Close():
                    await self._close(instruction.result)
        await self._accept_all(accepts)

    async def _accept_all(self, accepts: dict[str, rounds.Accept]) -> None:
        """Write what of some clients counts, and empty the list; the first error is raised when all have ended."""
        found = await asyncio.gather(*map(self._accept, accepts.values()), return_exceptions=True)
        accepts.clear()
        for error in found:
            if error is not None:
                raise error

    def _start(self, work: Coroutine[Any, Any, object]) -> asyncio.Task[object]:
        task = asyncio.create_task(work)
        self._work.add(task)
        task.add_done_callback(self._work_done)
        return task

    def _work_done(self, task: "asyncio.Task[object]") -> None:
        self._work.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            log.error("work for a round broke", run=self._run_id, round=self.number, exc_info=error)

    # --- records --------------------------------------------------------------------------------------------------

    async def _write(self, record: RoundRecord) -> None:
        key = records.round_key(self._run_id, self.number)
        record = self._signed(record)
        try:
            self._versions[key] = await write(self._plane, key, record, self._versions.get(key))
        except ConflictError:
            raise SupersededError(SUPERSEDED) from None
        self._publish(record)

    async def _accept(self, accept: rounds.Accept) -> None:
        """Write what of a client counts."""
        key = records.update_key(self._run_id, accept.number, accept.record.client)
        try:
            self._versions[key] = await write(self._plane, key, accept.record, self._versions.get(key))
        except ConflictError:
            raise SupersededError(SUPERSEDED) from None
        for part in accept.record.parts:
            self._start(self._fetch(part))

    async def _exclude(self, exclude: rounds.Exclude) -> None:
        """Have a client take part no more: in the run's record, as where a round closes or an operator excludes it."""
        now_ns = time.time_ns()
        run, changed = await change_run(
            self._plane, self._run_id, lambda record: rounds.excluded(record, exclude, now_ns=now_ns)
        )
        if not changed:
            return  # it is excluded already, or the run has gone on: its news says so
        self._run = run
        log.warning(
            "a client is excluded", run=self._run_id, round=self.number, client=exclude.client, reason=exclude.reason,
            remedy=f"correct its data, then: swiftbot learn include {self._run_id} {exclude.client}",
        )  # fmt: skip

    def _signed(self, record: RoundRecord) -> RoundRecord:
        """Return the round's record with who coordinates it, and who would."""
        successors = self._plane.ring.successors(records.round_key(self._run_id, self.number), 2)
        others = [name for name in successors if name != self._plane.gateway]
        return replace(record, coordinator=self._plane.gateway, successor=others[0] if others else "")

    # --- news -----------------------------------------------------------------------------------------------------

    def _publish(self, record: RoundRecord) -> None:
        self._published = time.monotonic()
        self._plane.session.publish(keyspace.LEARN_ROUND, record, self._run_id)

    def _publish_clients(self) -> None:
        """Put what clients are at, where that has changed."""
        for status in self.clients():
            if self._told.get(status.client) != status:
                self._told[status.client] = status
                self._plane.session.publish(keyspace.LEARN_CLIENT, status, self._run_id, status.client)

    async def _keep_publishing(self) -> None:
        while True:
            self._publish_clients()
            if time.monotonic() - self._published >= ROUND_NEWS_S and (record := self.record()) is not None:
                self._publish(self._signed(record))
            await asyncio.sleep(CLIENT_NEWS_S)

    async def _fetch(self, update: PartialUpdate) -> str:
        """Copy an update's files here: the gateway that made them may go before they are summed.

        Returns:
            Why they could not be copied; empty: they are here.
        """
        owner = records.round_key(self._run_id, update.round)
        here = self._plane.gateway
        async with self._fetching:
            for reference in update.shards:
                source = str(reference.get("gateway") or update.gateway)
                if source == here:
                    continue
                ask = ArtifactKeep(artifact=str(reference.get("artifact", "")), source=source, owner=owner)
                try:
                    await self._plane.rpc.call(here, keyspace.ARTIFACT_KEEP, ask, timeout_s=KEEP_S)
                except SwiftbotError as error:  # it is tried once more where it is summed
                    log.info("an update is not copied", client=update.client, reason=error.message)
                    return error.message
        return ""

    async def _close(self, result: rounds.Result) -> None:
        """Change the run's record, which closes the round; then write the round's and open the next."""
        now_ns = time.time_ns()
        run, changed = await change_run(
            self._plane, self._run_id, lambda record: rounds.closed(record, result, now_ns=now_ns)
        )
        if not changed:
            raise SupersededError(SUPERSEDED)
        log.info(
            "round closed", run=self._run_id, round=self.number, why=result.record.closed_by,
            clients=len(result.record.counted), took_s=round(result.took_s, 3), model=result.model.digest[:12],
        )  # fmt: skip
        if run.state.final:
            self._run = run
        if (numbers := metric(run, self.number)) is not None:
            self._plane.session.publish(keyspace.LEARN_METRIC, numbers, run.id)
        if not run.state.final:
            following = rounds.opened(result)
            with contextlib.suppress(ConflictError):
                await write(self._plane, records.round_key(self._run_id, following.number), following, None)
        self._closed(run)
        with contextlib.suppress(SupersededError):
            await self._write(result.record)

    # --- orders ---------------------------------------------------------------------------------------------------

    def _current(self, order: Order) -> bool:
        """Whether an attempt is still wanted."""
        key = (order.client, order.round, order.part)
        found = self._decider.order(key) if self._decider is not None else None
        return found is not None and found.attempt == order.attempt

    async def _send(self, order: Order) -> None:
        """Have a gateway begin an attempt; one that has no room is asked again, or another."""
        key = (order.client, order.round, order.part)
        wait_s = SEND_AGAIN_S
        while self._current(order):
            gateway = self._placed[key] = self._place(order)
            if not gateway:
                self._put_off(key, order, "no gateway that may train it is there")
            else:
                try:
                    accepted = await self._plane.rpc.call(gateway, keyspace.RUN, await self._request(order, gateway))
                except (UnreachableError, DeadlineError) as error:
                    self._avoid.setdefault(key, set()).add(gateway)
                    self.put(rounds.Failed(key, order.attempt, f"{gateway}: {error.message}", transient=True))
                    return
                except SwiftbotError as error:
                    self._put_off(key, order, f"{gateway}: {error.message}")
                else:
                    now = time.monotonic()
                    self._sent[key] = Sent(order, now, now)
                    self.put(rounds.Ordered(key, order.attempt, accepted.gateway))
                    return
            await asyncio.sleep(wait_s)
            wait_s = min(LONGEST_SEND_S, 2 * wait_s)

    def _put_off(self, key: Key, order: Order, reason: str) -> None:
        now = time.monotonic()
        self._sent[key] = Sent(order, now, now, note=reason)
        self.put(rounds.Waiting(key, order.attempt, reason))

    def _place(self, order: Order) -> str:
        """Choose the gateway of an order: the client's own; of a part of a data set the one with the most room."""
        recipe = self._recipe()
        there = self._there.get(order.helper or order.client, "")
        if order.helper and recipe.data.share == "gateway":
            there = self._there.get(order.client, "")
        if there or recipe.clients.robots:  # a robot's data are at its gateway and nowhere else
            return there if there in self._plane.members() else ""
        client = next((each for each in self._run.clients if each.name == order.client), None) if self._run else None
        files = client.residual[0] if client is not None and client.residual else ()
        prefer = str(files[0].get("gateway", "")) if files else ""
        return self.roomiest(self._avoid.get((order.client, order.round, order.part), set()), prefer=prefer)

    def roomiest(self, avoid: set[str], *, prefer: str = "") -> str:
        """The gateway with the most room, of those that take runs; one to avoid only where there is no other.

        Of equal ones the preferred one: what coding left over of the client's last update is there.
        """
        orders = self._decider.orders if self._decider is not None else ()
        given = Counter(self._placed.get((each.client, each.round, each.part), each.gateway) for each in orders)
        statuses = self._plane.registry.gateways
        members = [
            name for name in self._plane.members() if (status := statuses.get(name)) is None or not status.draining
        ]
        free = [name for name in members if name not in avoid] or members
        if not free:
            return ""

        def taken(name: str) -> tuple[float, bool, float]:
            status = statuses.get(name)
            capacity = max(1, status.capacity if status is not None else 1)
            return (given[name] / capacity, name != prefer, random.random())  # noqa: S311 - spreads load

        return min(free, key=taken)

    def _recipe(self) -> Recipe:
        assert self._run is not None  # noqa: S101 - `_begin` read it
        return self._run.recipe

    async def _request(self, order: Order, gateway: str) -> RunRequest:
        recipe = self._recipe()
        request = self._run_request(TRAIN, order.subtask, order.attempt, self._train_params(order))
        task, owner = records.task_of(self._run_id, order.round), records.round_key(self._run_id, order.round)
        request = replace(request, task=task, owner=owner)
        if recipe.clients.robots:  # passed on, it would train on what lies at another gateway
            request = replace(request, group=(gateway,))
        if order.attempt > 1:
            with contextlib.suppress(SwiftbotError, msgspec.DecodeError):
                stored = await self._plane.dht.read(checkpoint_key(request.task, request.subtask))
                if stored is not None:
                    kept = msgspec.json.decode(stored.value, type=Checkpoint)
                    request = replace(request, resume=kept.data, calls=kept.calls)
        return request

    def _run_request(self, skill: str, subtask: str, attempt: int, params: dict[str, Any]) -> RunRequest:
        manifest = self._site.manifest(skill)
        return RunRequest(
            task=records.task_of(self._run_id, self.number),
            subtask=subtask,
            attempt=attempt,
            skill=skill,
            need=need_of(manifest),
            params=params,
            coordinator=self._plane.gateway,
            deadline_s=min(DEADLINE_S, max(manifest.timeout_s, self._recipe().rounds.timeout_s)),
            priority=PRIORITY,
            submitter=f"learn {self._run_id}",
            owner=records.round_key(self._run_id, self.number),
        )

    def _train_params(self, order: Order) -> dict[str, Any]:
        recipe = self._recipe()
        training, emulation = recipe.training, recipe.emulation
        doer = order.helper or order.client
        client = next((each for each in self._run.clients if each.name == order.client), None) if self._run else None
        return {
            "run": self._run_id,
            "round": order.round,
            "client": order.client,
            "attempt": order.attempt,
            "model": recipe.model,
            "base": base_of(self._base(order)),
            "data": data_of(recipe, order.client),
            "part": part_of(recipe, order, samples=client.samples if client is not None else 0),
            "epochs": training.epochs,
            "batch": training.batch,
            "optimiser": None if training.optimiser is None else msgspec.structs.asdict(training.optimiser),
            "seed": recipe.seed,
            "stop_at_s": order.stop_at_s,
            "speed": emulation.speeds.get(doer, 1.0),
            "nominal_batch_s": emulation.nominal_batch_s,
            "every_steps": training.checkpoint_steps,
            "compression": recipe.update.compression,
            # What helpers' parts leave over is the client's: one of them adds all of it.
            "residual": [list(each) for each in client.residual] if client is not None and not order.part else [],
            "secure": self._epoch(),
            # Of a masked update nobody else can.
            "clip": recipe.update.dp.clip if recipe.update.dp is not None and recipe.update.secagg else None,
        }

    def _epoch(self) -> str:
        """The name of the masks that updates of this round are sent with; empty: they are sent without."""
        record = self.record()
        return record.cohort.epoch if record is not None and record.cohort is not None else ""

    def _base(self, order: Order) -> Model:
        """The model that an order begins with: that of its own round, which may be an earlier one."""
        if self._run is None or order.round == self.number:
            return self._record_base()
        return next((model for model in self._run.models if model.number == order.round - 1), self._record_base())

    def _record_base(self) -> Model:
        record = self.record()
        return record.base if record is not None else Model()

    async def _ask(self, order: Order) -> None:
        """Ask what became of an attempt."""
        key = (order.client, order.round, order.part)
        ask = RunAsk(task=records.task_of(self._run_id, order.round), subtask=order.subtask, attempt=order.attempt)
        now = time.monotonic()
        self._sent.setdefault(key, Sent(order, now, now))
        try:
            status = await self._plane.rpc.call(order.gateway, keyspace.RUN_STATUS, ask)
        except SwiftbotError as error:
            self.put(rounds.Failed(key, order.attempt, f"{order.gateway}: {error.message}", transient=True))
            return
        if status.last is not None and status.last.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            self._ended(key, status.last)
        elif not status.running:
            self.put(rounds.Failed(key, order.attempt, f"{order.gateway} knows nothing of it", transient=True))
        elif status.position:
            reason = f"waits for a container at {order.gateway}, {status.position} of {status.queue} in line"
            if (sent := self._sent[key]).order.attempt == order.attempt:
                self._sent[key] = sent._replace(note=reason, queued=True)
            self.put(rounds.Waiting(key, order.attempt, reason))
        elif problem := stuck(status, self._site.manifest(TRAIN)):
            self._avoid.setdefault(key, set()).add(order.gateway)
            await self._cancel(order)
            self.put(rounds.Failed(key, order.attempt, f"{order.gateway}: {problem}"))

    async def _check_orders(self) -> None:
        """Ask after the orders of which nothing was heard for a while: an event may have been lost."""
        while True:
            await asyncio.sleep(CHECK_S)
            now = time.monotonic()
            for order in self._decider.orders if self._decider is not None else ():
                sent = self._sent.get((order.client, order.round, order.part))
                if order.gateway and sent is not None and now - sent.heard > 2 * CHECK_S:
                    await self._ask(order)

    async def _cancel(self, order: Order) -> None:
        if order.gateway:
            ask = RunAsk(task=records.task_of(self._run_id, order.round), subtask=order.subtask, attempt=order.attempt)
            with contextlib.suppress(SwiftbotError):
                await self._plane.rpc.call(order.gateway, keyspace.RUN_CANCEL, ask)

    # --- secure aggregation ---------------------------------------------------------------------------------------

    async def _make_keys(self, make: rounds.MakeKeys) -> None:
        """Have the clients of a cohort agree on masks."""
        try:
            self.put(rounds.Keyed(await self._agree(make.clients)))
        except Exception as error:  # the round waits for this task alone: it must end in an event
            if not isinstance(error, SwiftbotError):
                log.exception("making keys broke", run=self._run_id, round=self.number)
            self.put(rounds.Unkeyed(getattr(error, "message", str(error))[:300]))

    async def _agree(self, clients: tuple[str, ...]) -> Cohort:
        """Return the cohort of those clients whose gateways answer; SwiftbotError where it cannot be."""
        epoch, members = secrets.token_hex(16), self._plane.members()
        here: dict[str, list[str]] = {}
        for client in clients:
            if (gateway := self._there.get(client, "")) in members:
                here.setdefault(gateway, []).append(client)
        asks = [self._keys_at(gateway, LearnKeysAsk(epoch=epoch, clients=tuple(here[gateway]))) for gateway in here]
        keys = [key for found in await asyncio.gather(*asks) for key in found]
        secagg.check_spread({key.client: key.gateway for key in keys})
        cohort = Cohort(epoch=epoch, clients=tuple(sorted(keys, key=lambda key: key.client)))
        places = {key.client: key.gateway for key in keys}
        gateways = sorted(set(places.values()))
        call, ask = self._plane.rpc.call, LearnShareAsk(cohort=cohort)
        shares = await asyncio.gather(*(call(gateway, keyspace.LEARN_SHARE, ask) for gateway in gateways))
        sealed = [each for found in shares for each in found.sealed]
        for_each = {
            gateway: LearnHoldAsk(cohort=cohort, sealed=tuple(s for s in sealed if places.get(s.to) == gateway))
            for gateway in gateways
        }
        await asyncio.gather(*(call(gateway, keyspace.LEARN_HOLD, ask) for gateway, ask in for_each.items()))
        return cohort

    async def _keys_at(self, gateway: str, ask: LearnKeysAsk) -> list[PublicKeys]:
        """Ask a gateway for keys of its clients; none where it does not answer."""
        try:
            found = await self._plane.rpc.call(gateway, keyspace.LEARN_KEYS, ask)
        except SwiftbotError as error:
            log.info("clients get no keys", run=self._run_id, gateway=gateway, reason=error.message)
            return []
        return [key for key in found.keys if key.gateway == gateway and key.client in ask.clients]

    async def _leftover(self, aggregate: rounds.Aggregate, cohort: Cohort) -> list[Seed] | rounds.TooFew:
        """Return the masks that are left in the sum of some updates, or why there is no such sum.

        Raises:
            UnreachableError: gateways that have shares of them do not answer.
        """
        lost: dict[str, str] = {}
        for share, gone in zip(
            aggregate.shares,
            await asyncio.gather(*(self._fetch(share.update) for share in aggregate.shares)),
            strict=True,
        ):
            if gone:  # as long as no share was given away, its client may still drop out
                lost[share.update.client] = f"lost: {gone}"
        if lost:
            return rounds.TooFew(1, {}, lost)
        summed = tuple(sorted(share.update.client for share in aggregate.shares))
        ask = LearnUnmaskAsk(epoch=cohort.epoch, summed=summed)
        gateways = sorted({each.gateway for each in cohort.clients} & self._plane.members())
        answers = await asyncio.gather(
            *(self._plane.rpc.call(gateway, keyspace.LEARN_UNMASK, ask) for gateway in gateways), return_exceptions=True
        )
        found = [share for each in answers if isinstance(each, LearnUnmasked) for share in each.revealed]
        try:
            return await asyncio.to_thread(secagg.leftover, cohort, summed, found)
        except (secagg.MissingSharesError, PayloadError) as error:
            silent = [each for each in answers if isinstance(each, UnreachableError | DeadlineError)]
            if silent:
                raise UnreachableError(f"{error}: {silent[0].message}") from error
            # All that can answer have: their keys went with a restart, or were used for other updates.
            refused = next((each.message for each in answers if isinstance(each, SwiftbotError)), str(error))
            return rounds.TooFew(1, {}, dict.fromkeys(summed, f"the masks cannot be taken off: {refused}"))

    # --- aggregation ----------------------------------------------------------------------------------------------

    async def _aggregate(self, aggregate: rounds.Aggregate) -> None:
        """Have the updates summed, and the model kept by enough gateways."""
        recipe = self._recipe()
        params: dict[str, Any] = {
            "run": self._run_id,
            "round": aggregate.number,
            "model": recipe.model,
            "base": base_of(aggregate.base),
            "updates": [
                {
                    "client": share.update.client,
                    "manifest": share.update.manifest,
                    "shards": list(share.update.shards),
                    "coding": share.update.coding,
                    "weight": share.weight,
                    "scale": 1 if share.scale[0] == share.scale[1] else {"num": share.scale[0], "den": share.scale[1]},
                }
                for share in aggregate.shares
            ],
            "rule": recipes.rule_of(recipe.update.rule),
            "seed": recipe.seed,
            "report": True,
        }
        if (dp := recipe.update.dp) is not None:
            unit = 1 if recipe.update.secagg else WEIGHT_UNIT
            params |= {"clip": dp.clip, "noise": dp.noise * dp.clip * unit}
        record = self.record()
        if record is not None and record.cohort is not None:
            left = await self._leftover_or_failed(aggregate, record.cohort)
            if left is None:
                return
            params["masks"] = [[each.seed.hex(), each.sign] for each in left]
        # Named by what is summed: asked again after a takeover it is the same run, and never that of other updates.
        # After a failure it is another run: gateways answer for one that they know with what became of it.
        name = f"aggregate-{hashlib.sha256(encode(params)).hexdigest()[:12]}"
        if self._aggregation_failed:
            name += f"-{time.time_ns()}"
        owner = f"{records.round_key(self._run_id, aggregate.number)}/model"
        try:
            result = await self.run_here(AGGREGATE, name, params, owner=owner)
            refused, left_out = _verdicts(result, {share.update.client for share in aggregate.shares})
            if (needed := result.get("needed")) is not None:
                self.put(rounds.TooFew(int(needed), refused, left_out))
                return
            model = await self._model_of(result, aggregate, owner)
        except Exception as error:  # the round waits for this task alone: it must end in an event
            if not isinstance(error, SwiftbotError):
                log.exception("aggregation broke", run=self._run_id, round=self.number)
            self._aggregation_failed = True
            self.put(rounds.AggregateFailed(getattr(error, "message", str(error))[:300]))
            return
        self.put(rounds.Aggregated(model, refused, left_out))

    async def _leftover_or_failed(self, aggregate: rounds.Aggregate, cohort: Cohort) -> list[Seed] | None:
        """Return the masks to take off a sum; None where there is none, which is told."""
        try:
            left = await self._leftover(aggregate, cohort)
        except Exception as error:  # as in `_aggregate`
            if not isinstance(error, SwiftbotError):
                log.exception("taking masks off broke", run=self._run_id, round=self.number)
            self.put(rounds.AggregateFailed(getattr(error, "message", str(error))[:300]))
            return None
        if isinstance(left, rounds.TooFew):
            self.put(left)
            return None
        return left

    async def _model_of(self, result: dict[str, Any], aggregate: rounds.Aggregate, owner: str) -> Model:
        manifest = shards.parse_manifest(result["manifest"])
        references = msgspec.convert(result["shards"], tuple[Reference, ...])
        found = [(reference.get("artifact"), reference.get("bytes")) for reference in references]
        if found != [(shard.digest, shard.bytes) for shard in manifest.shards]:
            raise PayloadError("the new model's files are not those of its manifest")
        text = msgspec.json.encode(manifest.to_json())
        kept = await self._site.artifacts.put("manifest.json", text, "application/json", owner=owner)
        listed = cast("Reference", msgspec.to_builtins(kept))
        gateways = await self._spread((listed, *references), owner)
        return Model(
            number=aggregate.number, digest=manifest.digest, manifest=listed, shards=references, gateways=gateways
        )

    async def _spread(self, references: tuple[Reference, ...], owner: str) -> tuple[str, ...]:
        """Have enough gateways keep files; returns those that keep all of them.

        Raises:
            UnreachableError: too few do.
        """
        members = self._plane.members()
        wanted = min(self._site.copies, len(members))
        places = list(self._plane.ring.successors(owner, len(members)))
        keeping: list[str] = []
        problem = ""
        while places and len(keeping) < wanted:
            some, places = places[: wanted - len(keeping)], places[wanted - len(keeping) :]
            found = await asyncio.gather(*(self._keep(place, references, owner) for place in some))
            for place, refused in zip(some, found, strict=True):
                if refused:
                    problem = f"{place}: {refused}"
                else:
                    keeping.append(place)
        if len(keeping) < wanted:
            raise UnreachableError(f"{len(keeping)} of {wanted} gateways keep the model; {problem}")
        return tuple(keeping)

    async def _keep(self, place: str, references: tuple[Reference, ...], owner: str) -> str:
        """Have a gateway keep files; returns why it does not, empty when it does."""
        try:
            for reference in references:
                if reference.get("gateway") == place == self._plane.gateway:
                    continue  # it was made here, for this owner
                digest, source = str(reference["artifact"]), str(reference["gateway"])
                ask = ArtifactKeep(artifact=digest, source=source, owner=owner)
                await self._plane.rpc.call(place, keyspace.ARTIFACT_KEEP, ask, timeout_s=KEEP_S)
        except SwiftbotError as error:
            return error.message
        return ""

    async def run_here(self, skill: str, name: str, params: dict[str, Any], *, owner: str) -> dict[str, Any]:
        """Run a skill, here or where this gateway passes it on, and return its result; SwiftbotError if it fails."""
        request = self._run_request(skill, name, 1, params)
        return await run_skill(self._plane, request, self._site.manifest(skill), owner=owner, attempts=1)


async def run_skill(
    plane: Plane, request: RunRequest, manifest: SkillManifest, *, owner: str, attempts: int = 3
) -> dict[str, Any]:
    """Have a skill run, and return its result.

    Args:
        plane: the fleet.
        request: what to run, here or where this gateway passes it on; its attempt is the first.
        manifest: of its skill.
        owner: record that its files go with.
        attempts: how often it is tried.

    Raises:
        SwiftbotError: it fails so many times.
    """
    problem: SwiftbotError | None = None
    for attempt in range(request.attempt, request.attempt + attempts):
        ended: asyncio.Future[RunEvent] = asyncio.get_running_loop().create_future()

        def hear(_: str, event: RunEvent | None, attempt: int = attempt, ended: Any = ended) -> None:
            final = event is not None and event.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED)
            if final and event is not None and event.attempt == attempt and not ended.done():
                ended.set_result(event)

        hearing = plane.session.subscribe_typed(keyspace.RUN_EVENT, hear, request.task, request.subtask)
        try:
            sent = replace(request, attempt=attempt, owner=owner)
            accepted = await _until_room(partial(plane.rpc.call, plane.gateway, keyspace.RUN, sent))
            event = await _end_of(plane, accepted.gateway, sent, manifest, ended)
        except SwiftbotError as error:
            problem = error
            continue
        finally:
            hearing.close()
        if event.kind is RunEventKind.SUCCEEDED:
            return event.result or {}
        message = event.failure.message if event.failure is not None else f"{request.skill} failed without a reason"
        problem = PayloadError(message)
    raise problem or PayloadError(f"{request.skill} was not tried")


async def _until_room(call: Callable[[], Awaitable[Any]]) -> Any:
    """Ask until there is room for a run: a busy pool is no failure."""
    wait_s = SEND_AGAIN_S
    while True:
        try:
            return await call()
        except (UnreachableError, DeadlineError, PayloadError):
            raise
        except SwiftbotError as error:
            log.info("a run for a round waits for room", reason=error.message)
            await asyncio.sleep(wait_s)
            wait_s = min(LONGEST_SEND_S, 2 * wait_s)


async def _end_of(
    plane: Plane, gateway: str, sent: RunRequest, manifest: SkillManifest, ended: "asyncio.Future[RunEvent]"
) -> RunEvent:
    """Wait for a run's end, which is told, or known to its gateway; one that is stuck is ended (DeadlineError)."""
    ask = RunAsk(task=sent.task, subtask=sent.subtask, attempt=sent.attempt)
    while True:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CHECK_S):
                return await asyncio.shield(ended)
        status = await plane.rpc.call(gateway, keyspace.RUN_STATUS, ask)
        if status.last is not None and status.last.kind in (RunEventKind.SUCCEEDED, RunEventKind.FAILED):
            return status.last
        if not status.running:
            raise UnreachableError(f"{gateway} knows nothing of {sent.run_id} any more")
        if problem := stuck(status, manifest):
            with contextlib.suppress(SwiftbotError):
                await plane.rpc.call(gateway, keyspace.RUN_CANCEL, ask)
            raise DeadlineError(f"{sent.skill} at {gateway}: {problem}")


def stuck(status: RunStatus, manifest: SkillManifest) -> str:
    """Why a run in progress is given up: it is silent for longer than its skill promises. Empty: it is not."""
    if not manifest.silent_s or status.silent_s is None or status.silent_s <= manifest.silent_s:
        return ""
    return f"no sign of life for {status.silent_s:.0f} s, {manifest.id} promises one every {manifest.silent_s:g} s"


def _verdicts(result: dict[str, Any], clients: set[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return of what `aggregate` says why updates are unfit, and why others are left out, by client."""
    refused: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for client, verdict in cast("dict[str, dict[str, Any]]", result.get("verdicts") or {}).items():
        if client in clients and not verdict.get("accepted"):
            reason = str(verdict.get("reason"))
            found = left_out if reason in LEFT_OUT else refused
            found[client] = f"{reason}: {verdict.get('message')}"[:200]
    return refused, left_out


# --- parameters of the handlers


def base_of(model: Model) -> dict[str, Any] | None:
    """Return a model as handlers take it; None: they draw it from the seed."""
    return None if model.manifest is None else {"manifest": model.manifest, "shards": list(model.shards)}


def data_of(recipe: Recipe, client: str = "") -> dict[str, str]:
    """Return where a client's samples are, as handlers take it; without a client, those that models are judged by."""
    if not client and recipe.evaluation.data:
        return {"name": recipe.evaluation.data}
    key = "folder" if recipe.data.folder else "name"
    return {key: recipes.data_path(recipe, client)}


def part_of(recipe: Recipe, order: Order, *, samples: int) -> dict[str, Any]:
    """Return which samples an order is about, as `train_local` takes it.

    Of a share of them the positions are drawn once for a client and round, so that the parts of several helpers are the
    whole, and none has one class alone.
    """
    if recipe.clients.robots:
        part: dict[str, Any] = {"by": "even", "index": 0, "of": 1}
    else:
        part = {"by": recipe.clients.by, "index": recipe.names.index(order.client), "of": recipe.clients.partitions}
    if order.share == (0.0, 1.0) or samples < 2:
        return part
    positions = list(range(samples))
    random.Random(seed(recipe.seed, order.round, order.client, "offload")).shuffle(positions)  # noqa: S311 - no secret
    low, high = (round(samples * cut) for cut in order.share)
    return part | {"indices": sorted(positions[low : max(low + 1, high)])}
