"""Comparing one gateway's copies with another's: one hash of all that both hold, then digests, then what differs.

Each side fetches for itself, so one rule serves joining, leaving, restart and repair.
"""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Sequence
from typing import NamedTuple

import structlog
from msgspec import Struct

from appliance.errors import PayloadError, RefusedError, SwiftbotError
from appliance.plane.keys import check_name
from appliance.plane.membership import Membership
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import MAX_KEY, Record, check_record, summary

log = structlog.get_logger(__name__)

ASK_S = 3.0
"""One question to a member, while it waits to see the token of the one that asks."""
BREATH = 500
"""Keys looked at before the loop gets a turn."""
_PAGE = 4000
"""Digests in one answer: at most about 2 MB."""
_FETCH_BYTES = 2 * 2**20
"""Values in one answer, unless a single one is larger."""
SEE_S = 0.7
"""How long a member waits to see the token of the one that asks: shorter than a question lasts, or whoever is not seen
would never hear so, and show its token again. (After a loss nobody is waited for so long, `reconcile`; whoever was
silent is asked once more right after it.)"""


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
        keep: Callable[[Record], Awaitable[Record]],
    ) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._keep = keep
        self._seen = asyncio.Condition()
        self._waking: set[asyncio.Task[None]] = set()
        rpc.register("dht_digest", DigestAsk, self._on_digest, exchange=False)
        rpc.register("dht_fetch", FetchAsk, self._on_fetch, exchange=False)
        membership.on_joined.append(self._on_member)
        membership.on_lost.append(self._on_member)

    def _on_member(self, _: str) -> None:
        task = asyncio.create_task(self._wake())
        self._waking.add(task)
        task.add_done_callback(self._waking.discard)

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
        """Ask one that counts as lost whether it is there after all; one that does not see this gateway is told.

        Two gateways that lost each other's tokens though they are linked would otherwise never ask each other.
        """
        with contextlib.suppress(SwiftbotError):  # nobody answers: it is gone indeed
            answer = await self._rpc.call(
                name, "dht_digest", DigestAsk(asker=self._gateway), DigestList, timeout_s=ASK_S
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
            answer = await self._rpc.call(member, "dht_digest", asked, DigestList, timeout_s=ASK_S)
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
            answer = await self._rpc.call(member, "dht_fetch", FetchAsk(tuple(page)), FetchList, timeout_s=ASK_S)
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
        tasks = tuple(self._waking)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
