"""Anti-entropy: every gateway fetches from the others what it should hold, and gives away what it should not.

Runs when the membership changes (a joiner gets the records it now owns, the next replica those of a dead one) and
every few seconds besides (`Reconciler`). What can wait never holds up what cannot: a round at rest, copies to be handed
over and a comparison with somebody who has come are given up when a member is lost, whose keys somebody waits for.

- `partners`: whom records are compared with, those who held what this gateway must hold now. A change of membership
  concerns only the stretches of the ring next to the points that came or went. Elsewhere the same gateways hold the
  same keys in the same order, and comparing would cost a large fleet N questions of every member for each gateway
  that comes or goes. Pure.
- `Steps`: for which ring records are compared next, with whom, and what must not wait for it. A change is taken in
  steps, losses before arrivals. What somebody who is gone has left is waited for, by tasks that nobody drives; what
  somebody brings who has come back is not, since keys only move to him. One that has just started may be slow to
  answer, and must not hold up the takeover from one that died meanwhile. Pure.
- `Comparing`: one hash of all that both hold, then digests, then what differs. Each side fetches for itself, so one
  rule serves joining, leaving, restart and repair.
- `HandOver`: copies that belong elsewhere are given to all their replicas, then dropped; and removals of long ago are
  forgotten.
"""

import asyncio
import contextlib
import random
import time
from bisect import bisect_left, bisect_right
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Sequence, Set
from enum import StrEnum
from typing import Any, NamedTuple

import structlog
from msgspec import Struct

from appliance.background import Background
from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.model import keyspace
from appliance.model.keys import check_name
from appliance.model.plane_api import DigestAsk, DigestList, FetchAsk, FetchList, Record, StoreAsk
from appliance.plane.dht import GONE_S, Dht
from appliance.plane.events import FleetEvent, FleetEvents, Joined, Lost, Relinked, RingChanged, Stage, Stalled
from appliance.plane.membership import Membership, StallDetector
from appliance.plane.records import MAX_KEY, check_record, summary
from appliance.plane.ring import Ring, point
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store


def partners(before: Ring, now: Ring, me: str, replicas: int) -> frozenset[str]:
    """The gateways to compare with before `me` answers for keys on the ring `now`.

    For every stretch that `me` has come to hold a copy of, or to own, since `before`: those that held or hold it, and
    the one after them, which held it when somebody has come since. They must be on the ring `now`.

    Args:
        before: the ring of the last comparison; an empty one: nothing is known, everything is compared.
        now: the ring as it is.
        me: this gateway.
        replicas: copies of a record.
    """
    if before.points and me in before.members and not _may_gain(before, now, me, replicas):
        return frozenset()
    found = set[str]()
    for places in _stretches(before, now, me, replicas):
        end = places[-1]
        holding = now.holders(end, replicas + 1)
        for place in places:
            held = before.holders(place, replicas + 1) if before.points else ()
            if me not in held[:replicas] or (holding[:1] == (me,) != held[:1]):
                found.update(holding, held)
    return frozenset((found & now.members) - {me})


def _may_gain(before: Ring, now: Ring, me: str, replicas: int) -> bool:
    """Whether `me`, which was there, can hold more than before: only if somebody went who stood just before it."""
    went = before.members - now.members
    reach = replicas + len(went)
    return any(
        me in before.holders(point(name, number), reach) for name in went for number in range(before.virtual_nodes)
    )


def sharing(ring: Ring, me: str, replicas: int) -> frozenset[str]:
    """The gateways that hold a copy of anything that `me` holds a copy of."""
    return partners(Ring((), virtual_nodes=ring.virtual_nodes), ring, me, replicas)


def _stretches(before: Ring, now: Ring, me: str, replicas: int) -> Iterator[list[int]]:
    """Stretches of `now` that `me` holds a copy of, each by the ends of the stretches of `before` in it, its own last.

    The end of a stretch is the point that owns it.
    """
    points, names = now.points, now.names
    size, seen = len(points), set[int]()
    for number in range(now.virtual_nodes if me in now.members else 0):
        at = names.index(me, bisect_left(points, point(me, number)))
        passed = set[str]()
        for step in range(size):
            index = (at - step) % size
            if names[index] != me:
                passed.add(names[index])
                if len(passed) >= replicas:
                    break
            if index not in seen:
                seen.add(index)
                yield [*_within(before, points[index - 1], points[index]), points[index]]


def _within(ring: Ring, start: int, end: int) -> tuple[int, ...]:
    """Points of a ring after `start` and before `end`, going clockwise."""
    points = ring.points
    if start < end:
        return points[bisect_right(points, start) : bisect_left(points, end)]
    return (*points[bisect_right(points, start) :], *points[: bisect_left(points, end)])


AT_REST = 8
"""Members compared with in a round while nothing changes: all of a small fleet, some of a large one in turn."""
FEW_MEMBERS = 32
"""A fleet of so many is small: a newcomer asks all it shares records with before it shows itself, and is asked."""
_MOST_MET = 4096


class StepKind(StrEnum):
    """Why something is compared."""

    FIRST = "first"
    """Nothing is known of the others' copies: at first, and after this process stood still."""
    LOSS = "loss"
    """Somebody has gone."""
    ARRIVAL = "arrival"
    """Somebody has come."""
    REST = "rest"
    """Nothing has changed."""


class Settled(Struct, frozen=True):
    """The ring, and the count of stalls, that the shard was last reconciled for."""

    ring: Ring
    stalls: int


class Step(Struct, frozen=True, kw_only=True):
    """One comparison; once it is done the shard is reconciled for `ring`."""

    kind: StepKind
    ring: Ring
    stalls: int
    asked: tuple[str, ...] = ()


class Steps:
    """Decides on the steps of one gateway. `me`: its id; `replicas`: copies of a record."""

    def __init__(self, me: str, *, replicas: int) -> None:
        self._me = me
        self._replicas = replicas
        self._near: tuple[Ring, frozenset[str]] | None = None
        self._turn = 0
        self._met: frozenset[str] = frozenset()
        """Gateways that this one has ever been on a ring with, since it started."""

    def settled(self, step: Step) -> Settled:
        """Note that a step is done."""
        members = step.ring.members
        self._met = members if len(self._met) > _MOST_MET else self._met | members
        return Settled(step.ring, step.stalls)

    def met(self, name: str) -> bool:
        """Whether a gateway was ever on a ring that was settled here: one that comes again was away."""
        return name in self._met

    def next(self, settled: Settled | None, ring: Ring, stalls: int) -> Step:
        """The next step towards a ring.

        One that was away may have ordered writes on the other side of a cut: those that share records with it ask. Of
        one never seen before that is assumed in a small fleet only: a large one would ask it a hundred times.
        At rest some are asked at a time, in turn: half of those that share records, half of all, since two that lost
        sight of each other learn of it by asking.
        """
        if settled is None or settled.stalls != stalls:
            return Step(kind=StepKind.FIRST, ring=ring, stalls=stalls, asked=tuple(sorted(self.sharing(ring))))
        before = settled.ring
        if before == ring:
            return Step(kind=StepKind.REST, ring=ring, stalls=stalls, asked=self._some_of(ring))
        stayed = before.members & ring.members
        if stayed != before.members:
            target = before.changed_to(stayed) if stayed else ring
            asked = partners(before, target, self._me, self._replicas)
            return Step(kind=StepKind.LOSS, ring=target, stalls=stalls, asked=tuple(sorted(asked)))
        came = ring.members - before.members
        back = came if len(ring.members) <= FEW_MEMBERS else came & self._met
        sharers = self.sharing(ring) & back if back else frozenset[str]()
        asked = partners(before, ring, self._me, self._replicas) | sharers
        return Step(kind=StepKind.ARRIVAL, ring=ring, stalls=stalls, asked=tuple(sorted(asked)))

    def urgent(self, step: Step, members: Set[str], stalls: int) -> bool:
        """Whether a step that is under way is to be given up for what has happened since."""
        lost = step.ring.members - members
        if stalls != step.stalls:
            return True
        return bool(lost) if step.kind in (StepKind.ARRIVAL, StepKind.REST) else not lost.isdisjoint(step.asked)

    def sharing(self, ring: Ring) -> frozenset[str]:
        """The members that hold copies of the same records; found once for each ring."""
        if self._near is None or self._near[0] is not ring:
            self._near = ring, sharing(ring, self._me, self._replicas)
        return self._near[1]

    def _some_of(self, ring: Ring) -> tuple[str, ...]:
        others = sorted(ring.members - {self._me})
        if len(others) <= AT_REST:
            return tuple(others)
        self._turn += 1
        near = sorted(self.sharing(ring))
        return tuple(sorted({*_some(near, self._turn), *_some(others, self._turn)}))


def _some(names: list[str], turn: int) -> list[str]:
    """Half of `AT_REST` names, others each turn until all have had theirs."""
    most = AT_REST // 2
    start = turn * most % max(1, len(names))
    return (names[start:] + names[:start])[:most]


log = structlog.get_logger(__name__)

COMPARE_S = 3.0
"""One question to a member, while it waits to see the token of the one that asks."""
BREATH = 500
"""Keys looked at before the loop gets a turn."""
_PAGE = 4000
"""Digests in one answer: at most about 2 MB."""
_FETCH_BYTES = 2 * 2**20
"""Values in one answer, unless a single one is larger."""
SEE_S = 0.7
"""How long a member waits to see the token of the one that asks: shorter than a question lasts, or one that is not seen
would never hear so, and show its token again. (After a loss nobody is waited for so long, `LOSS_S`; the one that was
silent is asked once more right after it.)"""


class Compared(NamedTuple):
    """What came of a comparison."""

    silent: frozenset[str] = frozenset()
    """Those of the members that did not answer, and are still there."""
    fetched: int = 0
    """Records that came."""


class Comparing:
    """Asks other members for what this one lacks, and answers those that ask. `keep` stores a record from elsewhere."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        events: FleetEvents,
        keep: Callable[[Record], Awaitable[Record]],
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._keep = keep
        self._seen = asyncio.Condition()
        self._waking = Background()
        rpc.register(keyspace.DHT_DIGEST, self._on_digest)
        rpc.register(keyspace.DHT_FETCH, self._on_fetch)
        events.subscribe(Stage.RECORDS, self._on_event)

    def _on_event(self, event: FleetEvent) -> None:
        if not isinstance(event, Joined | Lost):
            return
        self._waking.start(self._wake(), "compare: members have changed")

    async def _wake(self) -> None:
        async with self._seen:
            self._seen.notify_all()

    # --- asking -----------------------------------------------------------------------------------------------

    async def compare(
        self, ring: Ring, members: Sequence[str], *, joining: bool = False, within_s: float | None = None
    ) -> Compared:
        """Compare with these members, and fetch what they have; who has not told all `within_s` counts as silent."""
        if not members:
            return Compared()
        mine = dict(await self._store.digests())
        shared: dict[str, dict[str, str]] = {each: {} for each in members}
        for number, (key, digest) in enumerate(mine.items()):
            replicas = ring.successors(key, self._config.replicas)
            if self._gateway in replicas:
                for each in replicas:
                    if each in shared:
                        shared[each][key] = digest
            if number % BREATH == BREATH - 1:
                await asyncio.sleep(0)
        pulls = {asyncio.create_task(self._pull(each, mine, shared[each], joining=joining)): each for each in members}
        try:
            done, late = await asyncio.wait(pulls, timeout=within_s)
        finally:
            for pull in pulls:
                pull.cancel()
        for pull in late:
            log.warning("a member takes too long to compare with", member=pulls[pull], waited_s=within_s)
        results = {pulls[pull]: pull.result() for pull in done}
        silent = frozenset(each for each in members if results.get(each) is None)
        return Compared(silent & self._membership.members, sum(each or 0 for each in results.values()))

    async def sees(self, name: str) -> None:
        """Ask one that counts as lost whether it is there after all; one that does not see this gateway hears so.

        Two gateways that lost each other's tokens though they are linked would otherwise never ask each other.
        """
        with contextlib.suppress(SwiftbotError):  # nobody answers: it is gone indeed
            answer = await self._rpc.call(
                name, keyspace.DHT_DIGEST, DigestAsk(asker=self._gateway), timeout_s=COMPARE_S
            )
            if answer.unseen:
                self._membership.show_again()

    async def _pull(self, member: str, mine: dict[str, str], shared: dict[str, str], *, joining: bool) -> int | None:
        """Fetch what a member has and this gateway lacks; returns how many records, None when it did not answer."""
        try:
            fetched = await self._pull_from(member, mine, shared, joining=joining)
        except SwiftbotError as error:
            if member in self._membership.members:
                log.warning("could not compare with a member", member=member, reason=str(error))
                return None
            return 0
        if fetched:
            log.info("fetched records", member=member, records=fetched)
        return fetched

    async def _pull_from(self, member: str, mine: dict[str, str], shared: dict[str, str], *, joining: bool) -> int:
        asked = DigestAsk(asker=self._gateway, summary=summary(shared), joining=joining)
        fetched = 0
        while True:
            answer = await self._rpc.call(member, keyspace.DHT_DIGEST, asked, timeout_s=COMPARE_S)
            if answer.unseen:
                self._membership.show_again()
                raise RefusedError(f"{member} does not see {self._gateway}", remedy="are the two linked?")
            if answer.same:
                return fetched
            wanted = [key for key, each in answer.digests.items() if mine.get(key) != each]
            fetched += await self._fetch(member, wanted)
            # One that never comes to its end must not hold up the others' records.
            if not answer.more or (last := max(answer.digests, default="")) <= asked.after:
                return fetched
            asked = DigestAsk(asker=self._gateway, after=last, joining=joining)

    async def _fetch(self, member: str, keys: list[str]) -> int:
        done = 0
        while keys:
            page = keys[:_PAGE]
            answer = await self._rpc.call(member, keyspace.DHT_FETCH, FetchAsk(tuple(page)), timeout_s=COMPARE_S)
            good = [record for record in answer.records if self._may_keep(record, member)]
            await asyncio.gather(*(self._keep(record) for record in good))
            done += len(good)
            if answer.more and answer.records:
                last = answer.records[-1].key
                keys = keys[page.index(last) + 1 :] if last in page else []
            else:
                keys = keys[len(page) :]
        return done

    def _may_keep(self, record: Record, member: str) -> bool:
        """Whether a record from elsewhere may be stored; one that may not is counted, and the others are taken."""
        try:
            check_record(record, max_bytes=self._config.max_record_bytes)
        except PayloadError as error:
            self._rpc.refuse("record of a member", member=member, key=record.key[:MAX_KEY], reason=str(error))
            return False
        return True

    # --- answering --------------------------------------------------------------------------------------------

    async def _on_digest(self, asked: DigestAsk) -> DigestList:
        check_name(asked.asker, "gateway")
        if not asked.joining and not await self._is_seen(asked.asker):
            return DigestList(unseen=True)
        ring = self._membership.ring.with_member(asked.asker)
        found: dict[str, str] = {}
        for number, (key, each) in enumerate(await self._store.digests()):
            if asked.asker in ring.successors(key, self._config.replicas):
                found[key] = each
            if number % BREATH == BREATH - 1:
                await asyncio.sleep(0)
        if asked.summary and asked.summary == summary(found):
            return DigestList(same=True)
        rest = [(key, each) for key, each in found.items() if key > asked.after]
        return DigestList(digests=dict(rest[:_PAGE]), more=len(rest) > _PAGE)

    async def _is_seen(self, asker: str) -> bool:
        """Wait until the asker is seen: from then on this gateway orders no writes of keys that the asker owns."""
        try:
            async with asyncio.timeout(SEE_S), self._seen:
                await self._seen.wait_for(lambda: self._membership.sees(asker))
        except TimeoutError:
            return False
        return True

    async def _on_fetch(self, asked: FetchAsk) -> FetchList:
        if len(asked.keys) > _PAGE:
            raise PayloadError(f"{len(asked.keys)} records at once", remedy=f"at most {_PAGE}")
        records: list[Record] = []
        size = 0
        for key in asked.keys:
            record = await self._store.record(key)
            if record is None:
                continue
            size += len(record.value)
            if records and size > _FETCH_BYTES:
                return FetchList(tuple(records), more=True)
            records.append(record)
        return FetchList(tuple(records))

    async def close(self) -> None:
        """Give up what waits."""
        await self._waking.close()


_HAND_OVER_S = 2.0
_HANDED_AT_ONCE = 8
"""Copies on their way: more would hold up what people wait for."""


class HandOver:
    """Tidies one gateway's shard."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc, membership: Membership) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership

    async def run(self, ring: Ring) -> bool:
        """Hand over what belongs elsewhere on that ring; False when a replica did not take it, or the ring changed."""
        await self._store.forget_tombstones(time.time_ns() - int(self._config.tombstone_hours * 3.6e12))
        strangers: list[tuple[str, tuple[str, ...]]] = []
        for number, (key, _) in enumerate(await self._store.digests()):
            if number % BREATH == BREATH - 1:
                await asyncio.sleep(0)
            replicas = ring.successors(key, self._config.replicas)
            if self._gateway not in replicas:
                strangers.append((key, replicas))
        complete = True
        for start in range(0, len(strangers), _HANDED_AT_ONCE):
            if ring != self._membership.ring:
                return False
            page = strangers[start : start + _HANDED_AT_ONCE]
            complete &= all(await asyncio.gather(*(self._give(ring, key, replicas) for key, replicas in page)))
        return complete

    async def give_all(self) -> int:
        """Give a copy of everything here to those that would hold it without this gateway; returns how many were taken.

        For one that goes where nobody can ask it for what it has: another answers to its id.
        """
        ring = self._membership.ring.without_member(self._gateway)
        keys = [key for key, _ in await self._store.digests()] if ring.members else []
        taken = 0
        for start in range(0, len(keys), _HANDED_AT_ONCE):
            page = keys[start : start + _HANDED_AT_ONCE]
            gives = (self._offer(key, ring.successors(key, self._config.replicas)) for key in page)
            taken += sum(await asyncio.gather(*gives))
        return taken

    async def _offer(self, key: str, replicas: tuple[str, ...]) -> bool:
        record = await self._store.record(key)
        return record is not None and await self._stored(record, replicas)

    async def _give(self, ring: Ring, key: str, replicas: tuple[str, ...]) -> bool:
        record = await self._store.record(key)
        if record is None:
            return True
        if not await self._stored(record, replicas):
            return False
        if ring == self._membership.ring:
            await self._store.forget(record)
        return True

    async def _stored(self, record: Record, replicas: tuple[str, ...]) -> bool:
        """Have all these store a record; False when one did not."""
        ask = StoreAsk(record)
        try:
            await asyncio.gather(
                *(self._rpc.call(each, keyspace.DHT_STORE, ask, timeout_s=_HAND_OVER_S) for each in replicas)
            )
        except SwiftbotError as error:
            log.warning("a copy that belongs elsewhere is kept", key=record.key, reason=str(error))
            return False
        return True


LOSS_S = 0.5
"""How long a lost member's keys wait for all who may have something newer of them. With the writes that follow, which
wait `replica_timeout_s` for the same silent member, its tasks are taken over within a second of its loss being noticed.
The one that has not told by then is asked again at once, and what it has is news."""
_AGAIN_S = 1.0
"""After a member could not be compared with."""
_SOON_S = 0.1
"""The same while requests wait for the comparison."""
_TRIES = 3
"""Comparisons with a new ring before this gateway goes on without a member that is seen but does not answer."""
_ARRIVAL_S = (0.1, 0.3)
"""Before a newcomer is compared with, drawn: it is given to find its own records first, and the others do not all
ask it at one moment. Several that come at once are one step."""
_ARRIVALS = 500.0
"""And longer by one second for so many members: the more there are, the more come at once."""


class _Done(NamedTuple):
    heard: bool = True
    """Whether all that were asked have answered."""
    handed: bool = True
    """Whether nothing is here any more that belongs elsewhere."""
    fetched: int = 0


class Reconciler:
    """Keeps one gateway's shard in step with the others'; publishes `RingChanged` when it has compared it."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        dht: Dht,
        pulse: StallDetector,
        events: FleetEvents,
    ) -> None:
        self._config = config
        self._rpc = rpc
        self._membership = membership
        self._events = events
        self._dht = dht
        self._pulse = pulse
        self._steps = Steps(gateway, replicas=config.replicas)
        self._comparing = Comparing(
            config, gateway=gateway, store=store, rpc=rpc, membership=membership, events=events, keep=dht.keep
        )
        self._hand_over = HandOver(config, gateway=gateway, store=store, rpc=rpc, membership=membership)
        self._changed = asyncio.Event()
        self._hurry = asyncio.Event()
        """Something has happened that a round under way may have to be given up for."""
        self._lost: dict[str, float] = {}
        """Member that was lost -> until when it is asked whether it is there after all, for as long as that counts."""
        self._lost_at: float | None = None
        """When the first member was lost that the shard is not settled without."""
        self._running: asyncio.Task[None] | None = None
        events.subscribe(Stage.RECORDS, self._on_event)

    def start(self) -> None:
        """Reconcile now, at every change of membership, and every `anti_entropy_s`."""
        self._changed.set()
        self._running = asyncio.create_task(self._run(), name="reconcile")

    def _on_event(self, event: FleetEvent) -> None:
        match event:
            case Joined(name):
                self._on_joined(name)
            case Lost(name):
                self._on_lost(name)
            case Relinked():
                self._changed.set()
            case Stalled():
                self._changed.set()
                self._hurry.set()
            case _:
                pass

    def _on_joined(self, name: str) -> None:
        if self._steps.met(name):
            self._dht.settling.returned |= {name}
        self._changed.set()

    def _on_lost(self, name: str) -> None:
        self._dht.settling.returned -= {name}
        now = time.monotonic()
        self._lost[name] = now + GONE_S
        self._dht.absence.lost(name, now)
        self._lost_at = now if self._lost_at is None else self._lost_at
        self._changed.set()
        self._hurry.set()

    async def _run(self) -> None:
        while True:
            try:
                await self._step_by_step()
            except Exception as error:  # supervision boundary: a gateway that never compares again loses records
                log.exception("reconciling broke off and starts over")
                self._rpc.refuse("reconciling broke off", reason=f"{type(error).__name__}: {error}")
            await asyncio.sleep(_AGAIN_S)

    async def _step_by_step(self) -> None:
        settled: Settled | None = None
        tries, wait_s = 0, 0.0
        tidy, handed, waited = False, True, False
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._changed.wait()
            self._changed.clear()
            self._hurry.clear()
            if not self._dht.settling.returned:
                self._dht.settling.wanted.clear()
            step = self._steps.next(settled, self._membership.ring, self._pulse.stalls)
            if step.kind is StepKind.ARRIVAL and not waited:
                await self._let_arrive(step)
                waited, wait_s = True, 0.0
                continue
            waited = False
            if step.kind in (StepKind.LOSS, StepKind.ARRIVAL) and not step.asked:
                # Others' keys moved. What may have to be handed over waits until a burst of such news is over.
                settled = await self._settle(step, _Done())
                tries, tidy = 0, True
                wait_s = _AGAIN_S if step.ring == self._membership.ring else 0.0
                continue
            try:
                done = await self._unless_urgent(self._round(step, tidy=tidy), step)
            except Exception:  # supervision boundary: repair must go on whatever one round ran into
                log.exception("reconciling failed")
                done = _Done(heard=False, handed=False)
                if step.kind is not StepKind.REST:
                    self._dht.absence.asked(step.asked, self._membership.members & frozenset(step.asked))
            if done is None:
                tries, wait_s = 0, 0.0
                continue
            if step.kind is StepKind.REST:
                handed = done.handed
                # Spread, so that a fleet that settled at one moment does not compare at one moment ever after.
                rest_s = self._config.anti_entropy_s * random.uniform(0.75, 1.25)  # noqa: S311
                wait_s, tidy = rest_s if done.heard and handed else _AGAIN_S, False
                if done.fetched:
                    # A member that could not be asked when the ring changed was heard only now: same news.
                    self._events.publish(RingChanged())
                continue
            tries += 1
            if not done.heard and tries < _TRIES and step.kind is not StepKind.LOSS:
                wait_s = _SOON_S
                continue
            if step.stalls == self._pulse.stalls:
                settled = await self._settle(step, done)
            # What belongs elsewhere is handed over next: nobody waits for that.
            tries, tidy = 0, done.heard
            wait_s = _SOON_S if step.ring == self._membership.ring else 0.0

    async def _let_arrive(self, step: Step) -> None:
        """Wait a moment for more that come, unless somebody waits for what they bring, or is lost."""
        for_s = random.uniform(*_ARRIVAL_S) + len(step.ring.members) / _ARRIVALS  # noqa: S311 - spreads load
        waits = [asyncio.create_task(each.wait()) for each in (self._hurry, self._dht.settling.wanted)]
        try:
            await asyncio.wait(waits, timeout=for_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in waits:
                each.cancel()

    async def _round(self, step: Step, *, tidy: bool) -> _Done:
        absence = self._dht.absence
        if step.kind is not StepKind.REST:
            # A member that is silent already is not waited for again while somebody waits for a lost one's keys.
            loss = step.kind is StepKind.LOSS
            asked = [each for each in step.asked if not (loss and each in absence.silent)]
            compared = await self._comparing.compare(step.ring, asked, within_s=LOSS_S if loss else None)
            absence.asked(asked, compared.silent)
            return _Done(heard=absence.silent.isdisjoint(step.asked), fetched=compared.fetched)
        asked = sorted({*(() if tidy else step.asked), *(absence.silent & step.ring.members)})
        compared = await self._comparing.compare(step.ring, asked)
        absence.heard(set(asked) - compared.silent)
        now = time.monotonic()
        if not tidy and not compared.silent and step.ring == self._membership.ring:
            absence.calm(step.ring, now)
        handed = await self._hand_over.run(step.ring)
        members = self._membership.members
        self._lost = {name: until for name, until in self._lost.items() if until > now and name not in members}
        await asyncio.gather(*(self._comparing.sees(name) for name in self._lost))
        return _Done(not compared.silent, handed, compared.fetched)

    async def _unless_urgent(self, work: Coroutine[Any, Any, _Done], step: Step) -> _Done | None:
        """Do a round; None when it was given up for something that cannot wait for it."""
        task = asyncio.create_task(work)
        try:
            while not task.done():
                hurry = asyncio.create_task(self._hurry.wait())
                try:
                    await asyncio.wait({task, hurry}, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    hurry.cancel()
                self._hurry.clear()
                if not task.done() and self._steps.urgent(step, self._membership.members, self._pulse.stalls):
                    return None
            return task.result()
        finally:
            if not task.done():
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)

    async def _settle(self, step: Step, done: _Done) -> Settled:
        settled = self._steps.settled(step)
        self._dht.settling.returned -= step.ring.members
        self._dht.absence.settled(step.ring)
        await self._dht.settling.settled(step.ring, step.stalls)
        fields: dict[str, Any] = {}
        if step.kind is StepKind.LOSS and self._lost_at is not None:
            fields["after_loss_ms"] = round((time.monotonic() - self._lost_at) * 1e3, 1)
        if step.ring.members >= self._membership.members:
            self._lost_at = None
        log.info(
            "shard settled", why=str(step.kind), members=len(step.ring.members), asked=len(step.asked),
            heard=done.heard, fetched=done.fetched, **fields,
        )  # fmt: skip
        self._events.publish(RingChanged())
        return settled

    async def join(self) -> None:
        """Fetch what this gateway will own before it shows itself, so that its first requests wait less.

        In a large fleet each of many has little of it, and asking all twice takes longer than it saves.
        """
        ring = self._membership.ring
        near = sorted(self._steps.sharing(ring))
        if len(near) <= FEW_MEMBERS:
            await self._comparing.compare(ring, near, joining=True)

    async def give_all(self) -> None:
        """Give everything that is here to the others."""
        log.info("gave all records to the others", records=await self._hand_over.give_all())

    async def close(self) -> None:
        """Stop reconciling."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)
        await self._comparing.close()
