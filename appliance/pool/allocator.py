"""The allocator: which containers there are, which run holds each, and which runs wait for one.

It exists apart from the manager because these few rules must hold at every step between two awaits: a container has
one holder, a hold that is not used ends, and runs that wait are served in their order (`fair_queue`). Nothing here
starts or ends a container, and nothing here is awaited but one's turn.
"""

import asyncio
import itertools
import math
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator

from msgspec.structs import replace

from appliance.errors import PoolError, RefusedError, SwiftbotError
from appliance.model import ContainerInfo, ContainerState, Need
from appliance.pool.container import PooledContainer
from appliance.pool.fair_queue import Turn, Turns
from appliance.pool.selection import best_local
from appliance.pool.settings import PoolConfig

FOR_A_RUN = "cold"
"""Reservation of a container that is started for one waiting run."""
IN_TURN = "queue"
"""Reservation of a container that is handed to somebody in the queue."""

FOR_STATE = "state"
"""Reservation of a container whose run waits for the newest state of its volumes."""


class WithdrawnError(SwiftbotError):
    """A run was taken out of the queue here, because it may go elsewhere. It has not begun."""

    code = "withdrawn"


class _Waiter:
    """Somebody in the queue; one who `has_own` has a container that is only starting, and is not counted."""

    def __init__(self, need: Need, turn: Turn, *, has_own: bool = False) -> None:
        self.need = need
        self.turn = turn
        self.has_own = has_own
        self.got: asyncio.Future[PooledContainer] = asyncio.get_running_loop().create_future()


class Allocator:
    """Who has which container.

    Args:
        config: lease, queue, weights, mode.
        begin: begins a start for a need and returns its container, None without room; raises when it would be in vain.
        on_change: told the facts of all containers after something changed, once per turn of the event loop.
        refused: counts what is declined.
        full: makes the refusal of a run for which there is no place in the queue.
    """

    def __init__(
        self,
        config: PoolConfig,
        *,
        begin: Callable[[Need], PooledContainer | None],
        on_change: Callable[[tuple[ContainerInfo, ...]], None],
        refused: Counter[str],
        full: Callable[[], RefusedError] = lambda: RefusedError("too many runs wait for a container"),
    ) -> None:
        self._config = config
        self._begin = begin
        self._on_change = on_change
        self._refused = refused
        self._held: dict[str, PooledContainer] = {}
        self._facts: tuple[ContainerInfo, ...] | None = ()
        self._waiting: dict[int, _Waiter] = {}
        """By the numbers of their turns."""
        self._turns = Turns()
        self._watchers: set[asyncio.Event] = set()
        self._telling = False
        self._numbers = itertools.count(1)
        self._full = full

    # --- what is --------------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[PooledContainer]:
        """Go through all containers held; the caller may change the books meanwhile."""
        return iter(tuple(self._held.values()))

    def __len__(self) -> int:
        """Return how many containers are held, whatever their state."""
        return len(self._held)

    def get(self, container_id: str) -> PooledContainer | None:
        """Return a container by its id."""
        return self._held.get(container_id)

    @property
    def queue(self) -> int:
        """Runs that wait for a container and have none that is starting for them."""
        return sum(not each.has_own for each in self._waiting.values())

    @property
    def memory_mb(self) -> int:
        """What all containers together are allowed."""
        return sum(each.info.memory_mb for each in self._held.values())

    def facts(self) -> tuple[ContainerInfo, ...]:
        """Return the facts of all containers held."""
        if self._facts is None:
            self._facts = tuple(each.info for each in self._held.values())
        return self._facts

    def count(self, image: str, *states: ContainerState) -> int:
        """Return how many containers of an image are in one of these states."""
        return sum(each.image == image and each.state in states for each in self.facts())

    # --- coming and going -------------------------------------------------------------------------------------

    def add(self, container: PooledContainer) -> None:
        """Take a container into the books."""
        self._held[container.id] = container
        self.changed()

    def drop(self, container: PooledContainer) -> bool:
        """Take a container out of the books; False when it was not in them."""
        if self._held.get(container.id) is not container:
            return False
        del self._held[container.id]
        self.changed()
        return True

    def send_away(self) -> None:
        """Let nobody wait any more; starts in progress are let come to their end."""
        for waiter in self._waiting.values():
            if not waiter.has_own:
                waiter.got.cancel()

    def clear(self) -> None:
        """Forget all containers, without a word to anybody: they are somebody else's now."""
        self._held.clear()
        self._facts = None

    def changed(self) -> None:
        """Note that facts have changed; all changes of one turn of the event loop are published at once."""
        self._facts = None
        if not self._telling:
            self._telling = True
            asyncio.get_running_loop().call_soon(self._tell)

    def _tell(self) -> None:
        self._telling = False
        for watcher in self._watchers:
            watcher.set()
        self._on_change(self.facts())

    async def until(self, true: Callable[[], bool]) -> None:
        """Wait until something holds of the books."""
        changed = asyncio.Event()
        self._watchers.add(changed)
        try:
            while not true():
                await changed.wait()
                changed.clear()
        finally:
            self._watchers.discard(changed)

    # --- handing out ------------------------------------------------------------------------------------------

    def reserve(self, container_id: str) -> str:
        """Hold a ready container for the lease and return the reservation's name."""
        container = self._held[container_id]
        self.hold(container, f"r{next(self._numbers)}")
        return container.reservation

    def hold(self, container: PooledContainer, reservation: str) -> None:
        """Hold a container for the lease under this name."""
        container.reservation = reservation
        container.busy_since = time.monotonic()
        container.lease_until = container.busy_since + self._config.lease_s
        container.become(ContainerState.RESERVED)
        self.changed()

    def keep(self, container: PooledContainer) -> None:
        """Hold a container until its run begins or gives it back: state is on its way."""
        self.hold(container, FOR_A_RUN if container.reservation == FOR_A_RUN else FOR_STATE)
        container.lease_until = math.inf

    def extend(self, container_id: str, reservation: str, lease_s: float) -> bool:
        """Hold a reserved container for so long from now; False when it is not held under that name any more."""
        held = self._held.get(container_id)
        if held is None or not reservation or held.reservation != reservation:
            return False
        held.lease_until = time.monotonic() + lease_s
        return True

    def release(self, container_id: str, reservation: str) -> None:
        """Let go of a reserved container that is not wanted any more."""
        held = self._held.get(container_id)
        if held is not None and reservation and held.reservation == reservation:
            self.give_back(held)

    def give_back(self, container: PooledContainer) -> None:
        """Let go of a container that was held or started for a run which does not want it any more."""
        container.reservation = ""
        if container.info.state is not ContainerState.STARTING:
            self.ready(container)

    def claim(self, need: Need, *, container_id: str, reservation: str) -> PooledContainer | None:
        """Return the container that is held under a reservation, or else another that is ready, or None."""
        held = self._held.get(container_id)
        if held is not None and reservation and held.reservation == reservation:
            return held
        return self._ready_for(need)

    def _ready_for(self, need: Need) -> PooledContainer | None:
        if self._config.mode == "cold":
            return None
        found = best_local(self.facts(), need, self._config.weights)
        return self._held[found[0].id] if found is not None else None

    def take(self, need: Need) -> PooledContainer | None:
        """Hold a container that is ready, for somebody who would otherwise wait or have one started."""
        container = self._ready_for(need)
        if container is not None:
            self.hold(container, IN_TURN)
        return container

    def busy(self, container: PooledContainer, run_id: str) -> None:
        """Note that a run has it."""
        container.reservation = ""
        container.busy_since = time.monotonic()
        container.become(ContainerState.BUSY, run=run_id)
        self.changed()

    def ready(self, container: PooledContainer) -> None:
        """Make a container ready for the next: the first in the queue, or else anybody."""
        if self._held.get(container.id) is not container:
            return
        container.reservation = ""
        container.idle_since = time.monotonic()
        container.become(ContainerState.READY)
        self.changed()
        self.serve()

    def expire(self, now: float) -> None:
        """Free the containers whose reservation was not used in time."""
        for container in self:
            if container.info.state is ContainerState.RESERVED and now >= container.lease_until:
                self._refused["lease expired"] += 1
                self.ready(container)

    # --- the queue --------------------------------------------------------------------------------------------

    def waiting(self) -> list[tuple[Turn, Need]]:
        """Return those who wait and have no container starting, in the order in which they will be served."""
        return [(turn, self._waiting[turn.number].need) for turn in self._in_turn(self._without())]

    def _without(self) -> list[_Waiter]:
        """Return who waits and has no container that is starting."""
        return [each for each in self._waiting.values() if not each.got.done() and not each.has_own]

    def _in_turn(self, waiting: Iterable[_Waiter]) -> list[Turn]:
        return self._turns.order((each.turn for each in waiting), time.monotonic())

    def would_be_last(self, turn: Turn) -> bool:
        """Whether all who wait would be served before one who comes now."""
        return not self.queue or self._last(replace(turn, number=sys.maxsize)).number == sys.maxsize

    def _last(self, turn: Turn) -> Turn:
        waiting = [each.turn for each in self._without()]
        return self._turns.order([*waiting, turn], time.monotonic())[-1]

    def withdraw(self, run_id: str) -> bool:
        """Take a run out of the queue, unless it has been served: its `wait` raises WithdrawnError."""
        for waiter in self._waiting.values():
            if waiter.turn.id == run_id and not waiter.got.done() and not waiter.has_own:
                waiter.got.set_exception(WithdrawnError(f"{run_id} was taken out of the queue"))
                return True
        return False

    def _take_a_place(self, need: Need, turn: Turn) -> _Waiter:
        """Join the queue; a full one turns away the run that would be served last, be it the newest."""
        waiting = self._without()
        if len(waiting) >= self._config.queue and waiting:
            last = self._last(turn)
            self._refused["queue full"] += 1
            if last.number == turn.number:
                raise self._full()
            self._waiting[last.number].got.set_exception(self._full())
        waiter = self._waiting[turn.number] = _Waiter(need, turn)
        return waiter

    async def wait(self, need: Need, turn: Turn | None = None) -> PooledContainer:
        """Wait in the queue for a container, which may be one that is only starting.

        Raises:
            PoolError: none came free in time.
            RefusedError: the queue is full of those who go before this one.
            WithdrawnError: `withdraw` was called.
            SwiftbotError: the start that was begun for it would be in vain.
        """
        turn = turn or Turn(id="", number=0, since=time.monotonic())
        waiter = self._take_a_place(need, replace(turn, number=next(self._numbers)))
        try:
            async with asyncio.timeout(self._config.queue_wait_s):
                try:
                    return await waiter.got
                except asyncio.CancelledError:
                    if waiter.got.done() and not waiter.got.cancelled() and waiter.got.exception() is None:
                        self.give_back(waiter.got.result())  # it was handed over at the very moment
                    raise
        except TimeoutError as error:
            self._refused["queue wait"] += 1
            raise PoolError(
                f"no container came free within {self._config.queue_wait_s:g} s", remedy="raise pool.capacity"
            ) from error
        finally:
            del self._waiting[waiter.turn.number]

    async def sooner(
        self, need: Need, turn: Turn | None, own: PooledContainer, started: Awaitable[SwiftbotError | None]
    ) -> PooledContainer:
        """Wait until `own`, which is starting for a run, has `started`, or another comes free before that.

        A start takes a hundred times as long as many a run, so a run that waits for one takes what comes free
        meanwhile, in turn with all who wait; its own is then for the next. What is not returned has been given back.

        Raises:
            SwiftbotError: it did not start.
        """
        turn = replace(turn or Turn(id="", since=time.monotonic()), number=next(self._numbers))
        waiter = self._waiting[turn.number] = _Waiter(need, turn, has_own=True)
        starting = asyncio.ensure_future(started)
        try:
            await asyncio.wait((starting, waiter.got), return_when=asyncio.FIRST_COMPLETED)
            if waiter.got.done():
                self.give_back(own)
                return waiter.got.result()
            if (error := await starting) is not None:
                raise error
        except asyncio.CancelledError:
            for container in (own, waiter.got.result()) if waiter.got.done() else (own,):
                self.give_back(container)
            raise
        else:
            return own
        finally:
            del self._waiting[turn.number]
            starting.cancel()

    def serve(self) -> None:
        """Hand what is ready, or a start that there is room for, to those who wait, in their turns."""
        if not self._waiting:
            return
        # Handing out only takes: what could not be had for one need cannot be had for another like it just after.
        in_vain: set[Need] = set()
        for turn in self._in_turn(each for each in self._waiting.values() if not each.got.done()):
            waiter = self._waiting[turn.number]
            if waiter.got.done() or waiter.need in in_vain:
                continue
            container = self.take(waiter.need)
            if container is None and not waiter.has_own:
                try:
                    container = self._begin(waiter.need)
                except SwiftbotError as error:
                    waiter.got.set_exception(error)
                    continue
            if container is None:
                if not waiter.has_own:
                    in_vain.add(waiter.need)
            else:
                if not waiter.has_own:
                    self._turns.served(turn)
                waiter.got.set_result(container)
