"""Anti-entropy: every gateway fetches from the others what it should hold and does not.

Runs when the membership changes (a joiner gets the records it now owns, the next replica those of a dead one) and
every few seconds besides. Two gateways compare one hash of all the records they share; only if it differs, digests
key by key; only what differs is sent. Each side fetches for itself, so one rule serves joining, leaving, restart
and repair. Copies that belong elsewhere are handed over, and dropped when every replica has them.
"""

import asyncio
import contextlib
import random
import time
from collections.abc import Callable

import structlog
from msgspec import Struct

from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.plane.dht import Dht
from appliance.plane.keys import check_name
from appliance.plane.membership import Membership
from appliance.plane.messages import Found, StoreAsk
from appliance.plane.partners import partners, sharing
from appliance.plane.pulse import Pulse
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import Record, check_record, summary

log = structlog.get_logger(__name__)

_PAGE = 4000
"""Digests in one answer: at most about 2 MB."""
_FETCH_BYTES = 2 * 2**20
"""Values in one answer, unless a single one is larger."""
_ASK_S = 2.0
_SEE_S = 1.0
"""How long a member waits to see the token of the one that asks."""
_AGAIN_S = 1.0
"""After a member could not be compared with."""
_SOON_S = 0.1
"""The same while requests wait for the comparison."""
_TRIES = 3
"""Comparisons with a new ring before this gateway goes on without a member that is seen but does not answer."""
_LOST_S = 600.0
"""How long a member that was lost is asked whether it is there after all."""
_AT_REST = 8
"""Members compared with in a round while nothing changes: all of a small fleet, some of a large one in turn."""
_FEW = 32
"""A fleet of so many is small: whoever comes asks all it shares records with before it shows itself, and is asked."""
_MOST_MET = 4096
_BREATH = 500
"""Keys looked at before the loop gets a turn."""


class DigestAsk(Struct, frozen=True, omit_defaults=True):
    """`dht_digest`: which records that I (`asker`) should hold have you? `joining`: my token is not up yet."""

    asker: str
    summary: str = ""
    """Of the asker's copies; when the other's is the same, there is nothing to tell."""
    after: str = ""
    joining: bool = False


class DigestList(Struct, frozen=True, omit_defaults=True):
    """Key -> digest, in order of keys; `more` when it was cut."""

    digests: dict[str, str] = {}
    same: bool = False
    more: bool = False
    unseen: bool = False
    """The asker's token is not seen here, so nothing is told."""


class FetchAsk(Struct, frozen=True):
    """`dht_fetch`: these records, or as many of the first as fit."""

    keys: tuple[str, ...]


class FetchList(Struct, frozen=True):
    """The records; keys that are gone are left out."""

    records: tuple[Record, ...]
    more: bool = False


class Reconciler:
    """Keeps one gateway's shard in step with the others'."""

    def __init__(
        self,
        config: PlaneConfig,
        *,
        gateway: str,
        store: Store,
        rpc: Rpc,
        membership: Membership,
        dht: Dht,
        pulse: Pulse,
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._dht = dht
        self._pulse = pulse
        self._changed = asyncio.Event()
        self._seen = asyncio.Condition()
        self._near: tuple[Ring, frozenset[str]] | None = None
        self._turn = 0
        self._met: frozenset[str] = frozenset()
        """Gateways that this one has ever been on a ring with, since it started."""
        self._running: asyncio.Task[None] | None = None
        self._waking: set[asyncio.Task[None]] = set()
        rpc.register("dht_digest", DigestAsk, self._on_digest, exchange=False)
        rpc.register("dht_fetch", FetchAsk, self._on_fetch, exchange=False)
        membership.on_joined.append(self._on_member)
        membership.on_lost.append(self._on_member)
        self._lost: dict[str, float] = {}
        membership.on_lost.append(self._note_lost)
        pulse.on_stalled.append(self._changed.set)

    def start(self) -> None:
        """Reconcile now, at every change of membership, and every `anti_entropy_s`."""
        self._changed.set()
        self._running = asyncio.create_task(self._run(), name="reconcile")

    def _on_member(self, _: str) -> None:
        self._changed.set()
        task = asyncio.create_task(self._wake())
        self._waking.add(task)
        task.add_done_callback(self._waking.discard)

    async def _wake(self) -> None:
        async with self._seen:
            self._seen.notify_all()

    async def _run(self) -> None:
        settled: tuple[Ring, int] | None = None
        tries = 0
        wait_s = 0.0
        tidy, handed = False, True
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._changed.wait()
            self._changed.clear()
            now = ring, stalls = self._membership.ring, self._pulse.stalls
            if settled is not None and now != settled and not self._to_compare(settled, ring, stalls):
                # Others' keys moved. What may have to be handed over waits until a burst of such news is over.
                settled, tries, wait_s, tidy = now, 0, _AGAIN_S, True
                await self._settle(ring, stalls)
                continue
            try:
                members = [] if tidy and now == settled else self._to_compare(settled, ring, stalls)
                heard, fetched = await self._compare(ring, members)
                if now == settled:
                    handed = await self._hand_over(ring)
            except Exception:  # supervision boundary: repair must go on whatever one round ran into
                log.exception("reconciling failed")
                heard, handed, fetched = False, False, 0
            # Spread, so that a fleet that settled at one moment does not compare at one moment ever after.
            rest_s = self._config.anti_entropy_s * random.uniform(0.75, 1.25)  # noqa: S311
            wait_s, tidy = rest_s if heard and handed else _AGAIN_S, False
            if now != (self._membership.ring, self._pulse.stalls):
                tries, wait_s = 0, 0.0
                continue
            if now != settled:
                tries += 1
                if not heard and tries < _TRIES:
                    wait_s = _SOON_S
                    continue
                # What belongs elsewhere is handed over next: nobody waits for that.
                settled, tries, wait_s, tidy = now, 0, _SOON_S, heard
                await self._settle(ring, stalls)
                continue
            if fetched:
                # A member that could not be asked when the ring changed was heard only now: same news.
                self._tell(self._dht.on_ring_change)
            await self._ask_lost()

    async def _settle(self, ring: Ring, stalls: int) -> None:
        self._met = ring.members if len(self._met) > _MOST_MET else self._met | ring.members
        await self._dht.settled(ring, stalls)
        self._tell(self._dht.on_ring_change)

    def _note_lost(self, name: str) -> None:
        self._lost[name] = time.monotonic() + _LOST_S

    async def _ask_lost(self) -> None:
        """Two gateways that lost each other's tokens though they are linked would otherwise never ask each other."""
        now, members = time.monotonic(), self._membership.members
        self._lost = {name: until for name, until in self._lost.items() if until > now and name not in members}

        async def ask(name: str) -> None:
            with contextlib.suppress(SwiftbotError):  # nobody answers: it is gone indeed
                asked = DigestAsk(asker=self._gateway)
                answer = await self._rpc.call(name, "dht_digest", asked, DigestList, timeout_s=_ASK_S + _SEE_S)
                if answer.unseen:
                    self._membership.show_again()

        await asyncio.gather(*(ask(name) for name in self._lost))

    def _tell(self, callbacks: list[Callable[[], None]]) -> None:
        for callback in tuple(callbacks):
            try:
                callback()
            except Exception:  # supervision boundary: one listener's defect must not stop the repair
                log.exception("a listener to the ring failed")

    def _to_compare(self, settled: tuple[Ring, int] | None, ring: Ring, stalls: int) -> list[str]:
        """With whom: those whom a change of the ring concerns; all that share records after a stall or at first.

        One that was away may have ordered writes on the other side of a cut: whoever shares records with it asks. Of
        one never seen before that is assumed in a small fleet only: a large one would ask it a hundred times.
        At rest some at a time, in turn: half of those that share records, half of all, since two that lost sight of
        each other learn of it by asking.
        """
        replicas = self._config.replicas
        if settled is None or settled[1] != stalls:
            return sorted(self._sharing(ring))
        if settled[0] != ring:
            came = ring.members - settled[0].members
            back = came if len(ring.members) <= _FEW else came & self._met
            sharers = self._sharing(ring) & back if back else frozenset[str]()
            return sorted(partners(settled[0], ring, self._gateway, replicas) | sharers)
        others = sorted(ring.members - {self._gateway})
        if len(others) <= _AT_REST:
            return others
        self._turn += 1
        near = sorted(self._sharing(ring))
        return sorted({*_some(near, self._turn), *_some(others, self._turn)})

    def _sharing(self, ring: Ring) -> frozenset[str]:
        """The members that hold copies of the same records; found once for each ring."""
        if self._near is None or self._near[0] is not ring:
            self._near = ring, sharing(ring, self._gateway, self._config.replicas)
        return self._near[1]

    async def _compare(self, ring: Ring, members: list[str], *, joining: bool = False) -> tuple[bool, int]:
        """Compare with these members, and fetch what they have; returns whether all answered, how many records came."""
        if not members:
            return True, 0
        mine = dict(await self._store.digests())
        shared: dict[str, dict[str, str]] = {each: {} for each in members}
        for number, (key, digest) in enumerate(mine.items()):
            replicas = ring.successors(key, self._config.replicas)
            if self._gateway in replicas:
                for each in replicas:
                    if each in shared:
                        shared[each][key] = digest
            if number % _BREATH == _BREATH - 1:
                await asyncio.sleep(0)
        results = await asyncio.gather(*(self._pull(each, mine, shared[each], joining=joining) for each in members))
        return all(fetched is not None for fetched in results), sum(fetched or 0 for fetched in results)

    async def join(self) -> None:
        """Fetch what this gateway will own before it shows itself, so that its first requests wait less.

        In a large fleet each of many has little of it, and asking all twice takes longer than it saves.
        """
        ring = self._membership.ring
        near = sorted(self._sharing(ring))
        if len(near) <= _FEW:
            await self._compare(ring, near, joining=True)

    # --- fetching ---------------------------------------------------------------------------------------------

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
            answer = await self._rpc.call(member, "dht_digest", asked, DigestList, timeout_s=_ASK_S + _SEE_S)
            if answer.unseen:
                self._membership.show_again()
                raise RefusedError(f"{member} does not see {self._gateway}", remedy="are the two linked?")
            if answer.same:
                return fetched
            wanted = [key for key, each in answer.digests.items() if mine.get(key) != each]
            fetched += await self._fetch(member, wanted)
            if not answer.more or not answer.digests:
                return fetched
            asked = DigestAsk(asker=self._gateway, after=max(answer.digests), joining=joining)

    async def _fetch(self, member: str, keys: list[str]) -> int:
        done = 0
        while keys:
            page = keys[:_PAGE]
            answer = await self._rpc.call(member, "dht_fetch", FetchAsk(tuple(page)), FetchList, timeout_s=_ASK_S)
            for record in answer.records:
                check_record(record, max_bytes=self._config.max_record_bytes)
            await asyncio.gather(*(self._dht.keep(record) for record in answer.records))
            done += len(answer.records)
            if answer.more and answer.records:
                last = answer.records[-1].key
                keys = keys[page.index(last) + 1 :] if last in page else []
            else:
                keys = keys[len(page) :]
        return done

    async def _hand_over(self, ring: Ring) -> bool:
        """Give copies that belong elsewhere to all their replicas, then drop them; False when one did not take it.

        Removals of long ago are forgotten by the way.
        """
        complete = True
        await self._store.forget_tombstones(time.time_ns() - int(self._config.tombstone_hours * 3.6e12))
        for number, (key, _) in enumerate(await self._store.digests()):
            if number % _BREATH == _BREATH - 1:
                await asyncio.sleep(0)
            replicas = ring.successors(key, self._config.replicas)
            if self._gateway in replicas:
                continue
            record = await self._store.record(key)
            if record is None:
                continue
            ask = StoreAsk(record)
            try:
                for each in replicas:
                    await self._rpc.call(each, "dht_store", ask, Found, timeout_s=_ASK_S)
            except SwiftbotError as error:
                log.warning("a copy that belongs elsewhere is kept", key=key, reason=str(error))
                complete = False
                continue
            if ring == self._membership.ring:
                await self._store.forget(record)
        return complete

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
            if number % _BREATH == _BREATH - 1:
                await asyncio.sleep(0)
        if asked.summary and asked.summary == summary(found):
            return DigestList(same=True)
        rest = [(key, each) for key, each in found.items() if key > asked.after]
        return DigestList(digests=dict(rest[:_PAGE]), more=len(rest) > _PAGE)

    async def _is_seen(self, asker: str) -> bool:
        """Wait until the asker is seen: from then on this gateway orders no writes of keys that the asker owns."""
        try:
            async with asyncio.timeout(_SEE_S), self._seen:
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
        """Stop reconciling."""
        tasks = [task for task in (self._running, *self._waking) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _some(names: list[str], turn: int) -> list[str]:
    """Half of `_AT_REST` names, others each turn until all have had theirs."""
    most = _AT_REST // 2
    start = turn * most % max(1, len(names))
    return (names[start:] + names[:start])[:most]
