"""Which tasks are driven on this gateway: those of its shard that it owns and that have not ended.

When the ring changes, and now and then, the shard is looked through: an unfinished task whose key this gateway now owns
gets a driver, one that it owns no longer loses it. A driver that breaks is followed by another, later each time.

A driver follows its record, never the other way round: where this gateway's copy changes by another hand (a healed
partition, a coordinator elsewhere), the driver steps down at once, and the record as it stands now gets a new one, or
is told to those who listen when it is final.
"""

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Callable

import structlog

from appliance.errors import DeadlineError, PayloadError, SwiftbotError, UnreachableError
from appliance.model import Failure, TaskRecord, VersionVector
from appliance.plane.dht import Record
from appliance.tasks.bounds import MAX_TEXT, clean, read_record
from appliance.tasks.deadline import Ages
from appliance.tasks.driver import Driver
from appliance.tasks.healing import heal
from appliance.tasks.keeper import Keeper
from appliance.tasks.remembering import TRIMMED
from appliance.tasks.soundness import unsound
from appliance.tasks.surroundings import PREFIX, Surroundings, task_key
from appliance.tasks.unknown import unknown

log = structlog.get_logger(__name__)

SWEEP_S = 15.0
"""How often the shard is looked through when the ring stands still."""
MAX_BREAKS = 6
"""Drivers of one task that may break before it is ended with the reason; with the pauses, half a minute."""
SETTLED_S = 1.0
"""A driver overtaken after less than this is not followed at once: two gateways that both take a key for theirs, as
while the membership settles, would overtake each other as fast as they can write."""
AGAIN_S = (0.5, 1.5, 4.0)
"""When the shard is looked through again after the ring has changed."""


class Driving:
    """The drivers of one gateway.

    Args:
        around: what drivers need.
        ages: of the tasks that are heard of.
        moved: told each record that a driver has written.
        ended: told each driver that has come to its end.
        changed: told when the drivers are other ones.
    """

    def __init__(
        self,
        around: Surroundings,
        *,
        ages: Ages,
        moved: Callable[[TaskRecord], None],
        ended: Callable[[Driver], None],
        changed: Callable[[], None],
    ) -> None:
        self.drivers: dict[str, Driver] = {}
        self.sweep = asyncio.Event()
        """Set to have the shard looked through at once."""
        self._around = around
        self._plane = around.plane
        self._ages = ages
        self._moved = moved
        self._ended = ended
        self._changed = changed
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._breaks: Counter[str] = Counter()
        """How often a task's driver has broken; each time it is left alone for longer, in the end given up."""
        self._why: dict[str, Failure] = {}
        """Why the last driver of a task broke."""
        self._healing: dict[str, asyncio.Task[None]] = {}
        self._final: dict[str, VersionVector] = {}
        """Records of the shard known to be final, which need not be decoded at every sweep."""
        self._let_go: set[str] = set()
        """Tasks that were driven here, have not ended so, and whose record was not looked at since."""
        self._since: dict[str, float] = {}
        """Since when each task is driven here, on the monotonic clock."""
        self._sweeper: asyncio.Task[None] | None = None
        self._unwatch: Callable[[], None] = lambda: None
        self._stopping = False

    def start(self) -> None:
        """Take up what is owned here, now and whenever the ring changes."""
        self._plane.dht.on_ring_change.append(self.sweep.set)
        self._plane.dht.on_ring_change.append(self._sweep_soon)
        # Asked on the store's thread, of every record: a look into a dict, which threads may share.
        self._unwatch = self._plane.dht.watch(
            lambda key: key.startswith(PREFIX) and key[len(PREFIX) :] in self.drivers, self._changed_here
        )
        self._sweeper = asyncio.create_task(self._keep_sweeping(), name="task takeover")
        self.sweep.set()

    def drive(self, record: TaskRecord, version: VersionVector, value: bytes = b"") -> None:
        """Drive a task from its record on, unless that is done; `value`: the record as it was stored."""
        if record.id in self.drivers or self._stopping:
            return
        give_up = self._why.get(record.id) if self._breaks[record.id] >= MAX_BREAKS else unsound(record)
        if give_up is not None and value and self._breaks[record.id] < MAX_BREAKS:
            self._plane.session.refuse("unsound task record", task=record.id, reason=give_up.message)
        driver = Driver(
            self._around,
            record,
            version,
            on_change=self._moved,
            give_up=give_up,
            elapsed_s=self._ages.elapsed_s(record),
            unknown=unknown(value) if value else None,
        )
        self.drivers[record.id] = driver
        self._since[record.id] = time.monotonic()
        task = asyncio.create_task(driver.run(), name=f"drive {record.id}")
        self._tasks[record.id] = task
        task.add_done_callback(lambda done: self._driven(driver, done))
        self._changed()

    def _changed_here(self, stored: Record) -> None:
        """This gateway's copy of the record of a task that is driven here has changed."""
        driver = self.drivers.get(stored.key[len(PREFIX) :])
        if driver is not None and driver.heard(stored.version):
            self._step_down(driver)

    def _step_down(self, driver: Driver) -> None:
        """End a driver whose record has moved on; nothing more follows from what it holds in memory."""
        log.info("task record has changed, its driver steps down", task=driver.record.id, state=str(driver.told.state))
        self._tasks[driver.record.id].cancel()

    def _driven(self, driver: Driver, done: asyncio.Task[None]) -> None:
        self.drivers.pop(driver.record.id, None)
        self._ended(driver)
        self._tasks.pop(driver.record.id, None)
        task = driver.record.id
        driven_s = time.monotonic() - self._since.pop(task)
        if not done.cancelled() and (error := done.exception()) is not None:
            # The record stands as it was last written: a new driver takes it up from there.
            log.error("driver broke", task=task, exc_info=error)
            if not isinstance(error, UnreachableError | DeadlineError):
                self._breaks[task] += 1
                what = error.message if isinstance(error, SwiftbotError) else f"{type(error).__name__}: {error}"
                self._why[task] = Failure(code="internal", message=clean(f"driving it broke: {what}", MAX_TEXT))
        if driver.ended or self._stopping:
            self._breaks.pop(task, None)
            self._why.pop(task, None)
            log.info("task ended" if driver.ended else "task is handed over", task=task, state=str(driver.record.state))
        else:
            pause_s = min(30.0, 0.5 * 2 ** self._breaks[task])
            if driver.overtaken and driven_s > SETTLED_S and not self._breaks[task]:
                pause_s = 0.0
            self._let_go.add(task)
            asyncio.get_running_loop().call_later(pause_s, self.sweep.set)
        self._changed()

    async def _keep_sweeping(self) -> None:
        """Take up what is ours when the ring changes, and now and then in any case.

        A task can be accepted by a gateway that learns a moment later that the key is another's: without the
        regular look its owner, who has swept before the record came, would never drive it.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(SWEEP_S):
                    await self.sweep.wait()
            self.sweep.clear()
            try:
                await self._take_up()
            except Exception as error:  # without takeover a lost gateway's tasks would hang: it must not die
                log.exception("takeover is tried again", reason=str(error))
                asyncio.get_running_loop().call_later(1.0, self.sweep.set)

    async def _take_up(self) -> None:
        """Drive the unfinished tasks of the shard that are owned here; let go of those that are not."""
        for task_id, driving in list(self._tasks.items()):
            if not self._plane.dht.owns(task_key(task_id)):
                driving.cancel()
        final: dict[str, VersionVector] = {}
        for stored in await self._plane.dht.local(PREFIX, leave_out=TRIMMED):
            if self._final.get(stored.key) == stored.version:  # the most by far
                final[stored.key] = stored.version
                continue
            if stored.deleted or not self._plane.dht.owns(stored.key):
                continue
            try:
                record = read_record(stored.value)
            except PayloadError as error:
                log.warning("task record cannot be read", key=stored.key, reason=str(error))
                continue
            if task_key(record.id) != stored.key:
                # Driven under the name it gives itself it would be written over another task's record.
                reason = f"it is of {record.id[:80]!r}"
                self._plane.session.refuse("misplaced task record", key=stored.key, reason=reason)
                final[stored.key] = stored.version
                continue
            if record.state.final:
                final[stored.key] = stored.version
                if (driver := self.drivers.get(record.id)) is not None and driver.heard(stored.version):
                    self._step_down(driver)
                self._heal_ended(record, stored.version, stored.value)
            elif record.id not in self.drivers:
                self.drive(record, stored.version, stored.value)
            elif self.drivers[record.id].heard(stored.version):
                self._step_down(self.drivers[record.id])
        self._final = final
        await self._tell_ends()

    async def _tell_ends(self) -> None:
        """Publish the ends of tasks that another gateway has coordinated to it while this one went on by its own copy.

        Those who listen on this side of a healed partition have heard of nothing but that copy.
        """
        for task in tuple(self._let_go):
            if task not in self.drivers:
                try:
                    stored = await self._plane.dht.read(task_key(task))
                except UnreachableError:
                    continue  # looked at again with the next sweep
                if stored is not None and _is_final(stored.value):
                    self._plane.session.put(self._plane.keys.task(task), stored.value)
            self._let_go.discard(task)

    def _heal_ended(self, record: TaskRecord, version: VersionVector, value: bytes) -> None:
        """Tell what became of a task that had been ended on one side of a partition and went on on the other."""
        healing = heal(record)
        if healing is None or record.id in self._healing or self._stopping:
            return
        keeper = Keeper(self._plane, record, version, lambda _: None)
        keeper.unknown = unknown(value)
        work = asyncio.create_task(healing.settle(self._plane, keeper), name=f"heal {record.id}")
        self._healing[record.id] = work
        work.add_done_callback(lambda done: self._healed(record.id, done))

    def _healed(self, task: str, done: asyncio.Task[None]) -> None:
        self._healing.pop(task, None)
        if not done.cancelled() and (error := done.exception()) is not None:
            log.info("what a partition left is settled later", task=task, reason=str(error))
            self._final.pop(task_key(task), None)  # looked at again with the next sweep

    def _sweep_soon(self) -> None:
        """Look through the shard again a few times: records of the other side of a partition come bit by bit."""
        for pause_s in AGAIN_S:
            asyncio.get_running_loop().call_later(pause_s, self.sweep.set)

    async def close(self) -> None:
        """Stop all drivers; the records stay."""
        self._stopping = True
        self._unwatch()
        tasks = [each for each in (self._sweeper, *self._tasks.values(), *self._healing.values()) if each]
        for each in tasks:
            each.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _is_final(value: bytes) -> bool:
    """Whether a stored record is of a task that has ended; not one that cannot be read."""
    try:
        return read_record(value).state.final
    except PayloadError:
        return False
