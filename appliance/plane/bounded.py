"""Membership of a fleet too large for everybody to know everybody: the shell round `overlay`.

In place of a liveliness subscription to all gateways, each keeps the bounded view that `overlay.upkeep` decides on,
watches the tokens of just those members, and finds the owner of a key by asking its way there. For the rest of the
plane it is a `Membership`: the members are those known, and the ring is made of them.
"""

import asyncio
import contextlib
import random

import structlog
from msgspec import Struct

from appliance.errors import DeadlineError, PayloadError, RefusedError, SwiftbotError, UnreachableError
from appliance.plane.keys import check_name
from appliance.plane.membership import Membership
from appliance.plane.overlay.lookup import Lookup, NextAsk, Owners
from appliance.plane.overlay.upkeep import LeaveAsk, Meet, MeetAsk, Seek, Upkeep
from appliance.plane.overlay.view import Around, Step, View
from appliance.plane.ring import RING_BITS, RING_SIZE, position
from appliance.plane.rpc import Rpc
from appliance.plane.session import Closer, Session

log = structlog.get_logger(__name__)

_ASK_S = 1.0
"""One question of a lookup or a round; nobody there is told at once, so this is for the frozen."""
_JOIN_TRIES = 5
_MOST_CONTACTS = 8
"""Gateways that a joiner remembers of all whose tokens it sees: one would do."""
_ALONE_S = 2.0
"""How often one that knows of nobody looks who is there: those that start at one moment see no tokens yet."""
_STRANGERS_S = 60.0
"""How often one of a ring meets somebody whom it does not know, at least; of a large ring one each second. Two rings
that know nothing of each other, after a long cut or a start of many at one moment, become one by that."""

_TOKEN_S = 2.0
"""How long the token of a member that was heard of may take to come. One without is met at once: it may have gone while
whoever told of it did not know that yet, and then no news of it will ever come."""


class Heard(Struct, frozen=True):
    """Answer to who leaves."""


class BoundedMembership(Membership):
    """The gateways that this one knows of a larger fleet, at most `bound`."""

    def __init__(self, session: Session, rpc: Rpc, *, gateway: str, bound: int, replicas: int) -> None:
        super().__init__(session, gateway=gateway, virtual_nodes=1)
        self._me = gateway
        self._rpc = rpc
        self._replicas = replicas
        self._rng = random.Random()  # noqa: S311 - spreads load, protects nothing
        self._view = View.alone(gateway, bound=bound, replicas=replicas)
        self._upkeep = Upkeep(self._view, rng=self._rng, now=self._now())
        self._entered = False
        """Before that nothing it could say of the ring is true."""
        self._contacts: list[str] = []
        self._watched: dict[str, Closer] = {}
        self._held: dict[str, frozenset[str]] = {}
        """For whom -> gateways that stay members while their token is seen, whether the view keeps them or not."""
        self._shown: set[str] = set()
        """Of those watched, whose token is seen."""
        self._expected: dict[str, asyncio.TimerHandle] = {}
        """Member whose token is not seen yet -> when it should have come."""
        self._sooner = asyncio.Event()
        self._running: list[asyncio.Task[None]] = []
        rpc.register("ring_next", NextAsk, self._on_next, exchange=False)
        rpc.register("ring_meet", MeetAsk, self._on_meet, exchange=False)
        rpc.register("ring_leave", LeaveAsk, self._on_leave, exchange=False)

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

    # --- what the plane asks ----------------------------------------------------------------------------------

    def sees(self, name: str) -> bool:
        """Whoever asks is there: a bounded view need not know it."""
        del name
        return True

    def hold(self, who: str, names: frozenset[str]) -> None:
        """Stay aware of these as long as they are there, whether the view keeps them or not."""
        names -= {self._me}
        if names != self._held.get(who, frozenset()):
            self._held[who] = names
            if not names:
                del self._held[who]
            self._follow()

    def owns(self, key: str) -> bool:
        """Whether a key belongs to this gateway, as far as it knows without a gap."""
        return self._view.step(position(key)).mine

    async def holders(self, key: str, n: int) -> tuple[str, ...]:
        """The first `n` gateways from the key's position on, found by asking; UnreachableError when nobody knows."""
        found = await self._look_up(position(key))
        if found is None:
            raise UnreachableError(f"the owner of {key} was not found", remedy="try again in a second")
        return (found.owner, *found.replicas)[:n]

    # --- joining and leaving ----------------------------------------------------------------------------------

    def add(self, name: str) -> None:
        """Remember a gateway to join through."""
        if name != self._me:
            self._contacts = [*self._contacts, name][-_MOST_CONTACTS:]

    def start(self) -> None:
        """Nothing to watch yet: `enter` finds out whom."""

    async def enter(self) -> None:
        """Find this gateway's place on the ring and its neighbours; errors as for `Plane.open`."""
        if self._contacts:
            await self._find_place()
        self._entered = True
        self._running = [
            asyncio.create_task(self._keep_up(), name="ring"),
            asyncio.create_task(self._look_round(), name="strangers"),
        ]

    async def _find_place(self) -> None:
        before = self._view, self._upkeep
        for _ in range(_JOIN_TRIES):
            view = View(self._me, bound=self._view.bound, replicas=self._replicas)
            view.hear(self._contacts)
            self._view, self._upkeep = view, Upkeep(view, rng=self._rng, now=self._now())
            found = await self._look_up((view.origin + 1) % RING_SIZE)
            if found is None or found.owner == self._me:
                continue
            with contextlib.suppress(SwiftbotError):
                ask = MeetAsk(self._me, all=True)
                told = await self._rpc.call(found.owner, "ring_meet", ask, Around, timeout_s=_ASK_S)
                self._upkeep.joined(found.owner, _checked(told), self._now())
                self._follow()
                return
        self._view, self._upkeep = before
        raise UnreachableError("no member of the ring answers", remedy="is the fleet up, and linked?")

    async def leave(self) -> None:
        """Tell the neighbours, and stop."""
        if not self._running:
            return
        for each in self._running:
            each.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)
        self._running = []
        ask, near = self._upkeep.leaving()

        async def tell(name: str) -> None:
            with contextlib.suppress(SwiftbotError):
                await self._rpc.call(name, "ring_leave", ask, Heard, timeout_s=_ASK_S)

        await asyncio.gather(*(tell(name) for name in near))

    def close(self) -> None:
        """Take the token back and watch nobody any more."""
        super().close()
        for closer in self._watched.values():
            closer.close()
        self._watched.clear()
        for each in self._expected.values():
            each.cancel()
        self._expected.clear()

    # --- upkeep -----------------------------------------------------------------------------------------------

    async def _keep_up(self) -> None:
        while True:
            self._sooner.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout_at(self._upkeep.next_at):
                    await self._sooner.wait()
                    continue
            began = self._now()
            try:
                await self._round()
                now = self._now()
                self._upkeep.took(now - began, now)
            except Exception:  # supervision boundary: the ring must be kept up whatever one round ran into
                log.exception("a round of the ring failed")

    async def _round(self) -> None:
        match self._upkeep.due(self._now()):
            case Meet(member):
                try:
                    told = await self._rpc.call(member, "ring_meet", MeetAsk(self._me), Around, timeout_s=_ASK_S)
                except UnreachableError:
                    self._upkeep.unreachable(member, self._now())
                except DeadlineError:
                    self._upkeep.late(member, self._now())
                except SwiftbotError as error:
                    log.warning("a member does not meet", member=member, reason=str(error))
                else:
                    self._upkeep.met(member, _checked(told), self._now())
            case Seek(target):
                found = await self._look_up(target)
                if found is not None:
                    self._upkeep.found((found.owner, *found.replicas), self._now())
            case None:
                pass
        self._follow()

    async def _look_round(self) -> None:
        while True:
            alone = not len(self._view)
            often_s = _ALONE_S if alone else max(_STRANGERS_S, self._view.estimate())
            await asyncio.sleep(often_s * self._rng.uniform(0.5, 1.5))
            try:
                await self._meet_stranger()
            except SwiftbotError as error:
                log.info("somebody who is not known was not met", reason=str(error))
            except Exception:  # supervision boundary: the next one may be met
                log.exception("looking round the ring failed")

    async def _meet_stranger(self) -> None:
        """Meet somebody whose token is there and whom this gateway does not know; join, if it knows nobody."""
        tokens = await self._session.alive_now(self._session.keys.alive())
        names = {key.split("/")[-2] for key in tokens} - {self._me, *self._view.names}
        if not names:
            return
        if not len(self._view):
            self._contacts = self._rng.sample(sorted(names), min(len(names), _MOST_CONTACTS))
            await self._find_place()
            return
        name = self._rng.choice(sorted(names))
        told = await self._rpc.call(name, "ring_meet", MeetAsk(self._me), Around, timeout_s=_ASK_S)
        self._upkeep.met(name, _checked(told), self._now())
        self._follow()

    async def _look_up(self, target: int) -> Owners | None:
        lookup = Lookup(target, self._view)
        while (name := lookup.next()) is not None:
            ask = NextAsk(f"{target:040x}", named=lookup.named(name))
            try:
                step = await self._rpc.call(name, "ring_next", ask, Step, timeout_s=_ASK_S)
            except UnreachableError:
                lookup.failed(name)
                self._upkeep.unreachable(name, self._now(), in_round=False)
            except DeadlineError:
                lookup.failed(name)
                self._upkeep.late(name, self._now(), in_round=False)
            except (RefusedError, PayloadError):
                lookup.failed(name)
            else:
                lookup.answered(name, step)
        if lookup.gone:
            self._follow()
        return lookup.result

    def _follow(self) -> None:
        """Watch the tokens of those in the view and those held, and tell the rest of the plane who came and went."""
        view, held = frozenset(self._view.names), frozenset[str]().union(*self._held.values())
        known = view | (held & self._shown)
        before = self._members - {self._me}
        for name in self._watched.keys() - view - held:
            self._watched.pop(name).close()
            self._shown.discard(name)
        for name in (view | held) - self._watched.keys():
            self._watched[name] = self._session.watch_alive(self._session.keys.alive(name), self._on_token)
        if known == before:
            return
        self._members = known | {self._me}
        for name in before - known:
            if (expected := self._expected.pop(name, None)) is not None:
                expected.cancel()
        for name in known - before - self._shown:
            self._expected[name] = asyncio.get_running_loop().call_later(_TOKEN_S, self._miss, name)
        for name in sorted(known - before):
            self._tell(self.on_joined, name)
        for name in sorted(before - known):
            self._tell(self.on_lost, name)

    def _miss(self, name: str) -> None:
        """See whether a member is there whose token should have come."""
        del self._expected[name]
        if name not in self._shown:
            self._upkeep.doubt(name, self._now())
            self._sooner.set()

    def _on_token(self, key: str, alive: bool) -> None:
        name = key.split("/")[-2]
        if alive:
            self._shown.add(name)
        else:
            self._shown.discard(name)
        if name not in self._view:
            self._follow()
        elif not alive:
            self._upkeep.unreachable(name, self._now())
            self._upkeep.next_at = min(self._upkeep.next_at, self._now() + self._upkeep.interval_s)
            self._sooner.set()
            self._follow()

    # --- answering --------------------------------------------------------------------------------------------

    async def _on_next(self, asked: NextAsk) -> Step:
        self._check_entered()
        try:
            target = int(asked.position, 16)
        except ValueError:
            target = -1
        if not 0 <= target < 2**RING_BITS or len(asked.position) > RING_BITS // 4:
            raise PayloadError(f"{asked.position[:80]!r} is no position", remedy="40 hex digits")
        return self._view.step(target, named=asked.named)

    async def _on_meet(self, asked: MeetAsk) -> Around:
        self._check_entered()
        check_name(asked.asker, "gateway")
        before = self._upkeep.next_at
        told = self._upkeep.asked(asked, self._now())
        if self._upkeep.next_at < before:
            self._sooner.set()
        self._follow()
        return told

    def _check_entered(self) -> None:
        if not self._entered:
            raise RefusedError(f"{self._me} is only joining", remedy="ask another gateway")

    async def _on_leave(self, asked: LeaveAsk) -> Heard:
        check_name(asked.leaver, "gateway")
        _checked(asked.around)
        self._upkeep.left(asked, self._now())
        self._follow()
        return Heard()


def _checked(told: Around) -> Around:
    """Refuse names that are none: they would become keys."""
    for name in (*told.before, *told.after, *told.others):
        check_name(name, "gateway")
    return told
