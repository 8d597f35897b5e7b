"""What is out of use, as one gateway knows it: asked for every plan, before each subtask and each command.

A closure is a record of the DHT, so that it outlives gateways, and a put, so that all hear of it at once. What was put
while a gateway did not hear it learns from the others: when it starts, when the ring changes, and now and then.
"""

import asyncio
import contextlib
import random
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any
from zoneinfo import ZoneInfo

import msgspec
import structlog
from msgspec.structs import replace

from appliance.errors import ConflictError, NotFoundError, PayloadError, RefusedError, SwiftbotError
from appliance.model import Site, Word, encode, keyspace
from appliance.model.closures import CloseAsk, Closure, ClosureList, ClosuresAsk, ReopenAsk, Rule, closure_id
from appliance.plane.dht import Record
from appliance.plane.events import AuthorityChanged, FleetEvent, Joined, RingChanged, Stage
from appliance.plane.node import Plane

log = structlog.get_logger(__name__)

LOOK_S = 1.0
"""How often is looked for what is over by the clock."""
RESYNC_S = 30.0
SETTLE_S = 0.25
"""Shortest time between a change of the fleet and asking all gateways; one that joins has asked for itself before."""
ANSWER_S = 1.5
MOST = 1000
TRIES = 5


class Closures:
    """Closures of one gateway.

    Args:
        plane: the fleet.
        site: the map, whose places may be closed.
        now_ns: the wall clock, Unix nanoseconds.
    """

    def __init__(self, plane: Plane, site: Site, *, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._plane = plane
        self._site = site
        self._now_ns = now_ns
        self._kept: dict[str, Closure] = {}
        self._in_force: frozenset[str] = frozenset()
        self._doubtful = asyncio.Event()
        self._whole = False
        """Whether all other gateways have answered once: before that, something may be out of use that is not known."""
        self._closers: list[Callable[[], None]] = []
        self._work: asyncio.Task[None] | None = None

    async def start(self, signed: Callable[[str, Any], Any]) -> None:
        """Learn what is out of use, listen, answer the verbs.

        Args:
            signed: puts an audit around the handler of an operator's verb.
        """
        plane = self._plane
        self._closers = [
            plane.session.subscribe_typed(keyspace.CLOSURE, self._on_closure).close,
            plane.events.subscribe(Stage.ROBOTS, self._on_event),
        ]
        plane.rpc.register(keyspace.CLOSURES, self.closures)
        closing = {kind: signed(f"{verb}", self.close_ask) for kind, verb in _CLOSING.items()}
        opening = {kind: signed(f"{verb}", self.reopen) for kind, verb in _OPENING.items()}

        async def close(ask: CloseAsk) -> Closure:
            return await closing[ask.kind](ask)

        async def reopen(ask: ReopenAsk) -> Closure:
            return await opening[ask.kind](ask)

        plane.rpc.register(keyspace.CLOSE, close)
        plane.rpc.register(keyspace.REOPEN, reopen)
        await self.sync()
        self._work = asyncio.create_task(self._keep(), name="closures")

    async def close(self) -> None:
        """Listen no more; the records stay."""
        for close in self._closers:
            close()
        if self._work is not None:
            self._work.cancel()
            await asyncio.gather(self._work, return_exceptions=True)

    # --- questions ----------------------------------------------------------------------------------------------

    @property
    def places(self) -> dict[str, str]:
        """Closed places, and why."""
        return self._of("place")

    @property
    def robots(self) -> dict[str, str]:
        """Robots in maintenance, and why."""
        return self._of("robot")

    @property
    def rules(self) -> tuple[Closure, ...]:
        """Standing rules that hold now."""
        now_ns = self._now_ns()
        return tuple(each for each in self._kept.values() if each.kind == "rule" and each.in_force(now_ns))

    def robot(self, name: str) -> str:
        """Why a robot is out of use; empty when it is not."""
        found = self._kept.get(closure_id("robot", name))
        return found.text if found is not None and found.name == name and found.holds(self._now_ns()) else ""

    def _of(self, kind: str) -> dict[str, str]:
        now_ns = self._now_ns()
        return {each.name: each.text for each in self._kept.values() if each.kind == kind and each.holds(now_ns)}

    # --- keeping up ---------------------------------------------------------------------------------------------

    def _on_closure(self, _key: str, closure: Closure | None) -> None:
        if closure is not None:
            self._take(closure)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, Joined | RingChanged):
            self._doubtful.set()

    def _take(self, closure: Closure) -> None:
        known = self._kept.get(closure.id)
        if known is not None and known.by.at_ns > max(closure.by.at_ns, closure.ended_ns):
            return  # an older word that was under way
        if closure.ended_ns:
            self._kept.pop(closure.id, None)
        elif known is not None or len(self._kept) < 2 * MOST:  # of both parts of a partitioned fleet
            self._kept[closure.id] = closure
        else:
            self._plane.session.refuse("no room for what is out of use", name=closure.id)
        self._look()

    def _look(self) -> None:
        """Tell the parts of this gateway when what is in force has changed."""
        now_ns = self._now_ns()
        in_force = frozenset(name for name, each in self._kept.items() if each.in_force(now_ns))
        if in_force != self._in_force:
            self._in_force = in_force
            self._plane.events.publish(AuthorityChanged())

    async def _keep(self) -> None:
        synced_at = time.monotonic()
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LOOK_S):
                    await self._doubtful.wait()
                # Not at once: all gateways would ask one another just when one that joins fetches what it owns.
                await asyncio.sleep(random.uniform(1.0, 2.0) * SETTLE_S)  # noqa: S311 - spreads load
            try:
                self._look()
                await self._remove_old()
                resync_s = RESYNC_S if self._whole else LOOK_S
                if self._doubtful.is_set() or time.monotonic() - synced_at >= resync_s:
                    self._doubtful.clear()
                    synced_at = time.monotonic()
                    await self.sync()
            except SwiftbotError as error:
                log.info("what is out of use is looked at again", reason=str(error))
            except Exception:  # supervision boundary: closed places must be known
                log.exception("what is out of use could not be looked at")
            await asyncio.sleep(0.05)

    async def sync(self) -> None:
        """Learn from all gateways what is out of use; what none of them has any more is over."""
        before = dict(self._kept)
        found = {each.id: each for each in await self._shard()}
        others = sorted(self._plane.members() - {self._plane.gateway})
        answers = await asyncio.gather(*(self._ask(other) for other in others))
        for answer in answers:
            for each in answer or ():
                known = found.get(each.id)
                if known is None or known.by.at_ns < each.by.at_ns:
                    found[each.id] = each
        for each in found.values():
            self._take(each)
        if all(answer is not None for answer in answers):
            self._whole = True
            await self._drop({name: each for name, each in before.items() if name not in found})
        self._look()

    async def _drop(self, unowned: Mapping[str, Closure]) -> None:
        """Drop closures that no gateway owns, once their records are known to be gone.

        While keys move between gateways the former owner does not count a record as its own any more, and the next
        one may not have it yet.
        """
        for name, closure in unowned.items():
            try:
                known = _decoded(await self._plane.dht.read(keyspace.CLOSURE_RECORD.key(name)))
            except SwiftbotError as error:
                log.info("a closure stays: its record cannot be read", closure=name, reason=str(error))
                return  # others would take as long; all are asked about again
            if known is not None:
                self._take(known)
            elif self._kept.get(name) == closure:
                del self._kept[name]

    async def _ask(self, member: str) -> tuple[Closure, ...] | None:
        try:
            ask = ClosuresAsk(local=True)
            answer = await self._plane.rpc.call(member, keyspace.CLOSURES, ask, timeout_s=ANSWER_S)
        except SwiftbotError:
            return None
        return (*answer.closures, *answer.rules)

    async def _shard(self) -> list[Closure]:
        """Return the closures whose records this gateway owns."""
        records = await self._plane.dht.local(keyspace.CLOSURE_RECORD.prefix)
        owned = [_decoded(each) for each in records if self._plane.dht.owns(each.key)]
        return [each for each in owned if each is not None]

    async def _remove_old(self) -> None:
        """Remove the records of what is over by the clock, where they are this gateway's."""
        for each in [each for each in self._kept.values() if not each.holds(self._now_ns())]:
            key = keyspace.CLOSURE_RECORD.key(each.id)
            if not self._plane.dht.owns(key):
                continue
            stored = await self._plane.dht.read(key)
            known = _decoded(stored)
            if stored is None or known is None:
                self._kept.pop(each.id, None)
            elif not known.holds(self._now_ns()):
                with contextlib.suppress(ConflictError):
                    await self._plane.dht.remove(key, expected=stored.version)
                    self._tell(replace(known, ended_ns=self._now_ns()))

    # --- verbs --------------------------------------------------------------------------------------------------

    async def closures(self, ask: ClosuresAsk) -> ClosureList:
        """Answer `closures`."""
        now_ns = self._now_ns()
        found: Iterable[Closure] = await self._shard() if ask.local else self._kept.values()
        kept = sorted((each for each in found if each.holds(now_ns)), key=lambda each: each.id)
        return ClosureList(
            closures=tuple(each for each in kept if each.kind != "rule"),
            rules=tuple(each for each in kept if each.kind == "rule"),
        )

    async def close_ask(self, ask: CloseAsk) -> Closure:
        """Answer `close`: take a place or robot out of use, or add a rule; what is there already is as asked now.

        Raises:
            NotFoundError: there is no such place or robot.
            PayloadError: the time is over, or it is no rule.
        """
        now_ns = self._now_ns()
        if 0 < ask.until_ns <= now_ns:
            raise PayloadError("the time until which it is out of use is over", remedy="give one that is to come")
        rule = self._ruled(ask)
        name = self._named(ask) if rule is None else rule.id
        name_id = closure_id(ask.kind, name)
        if name_id not in self._kept and len(self._kept) >= MOST:
            raise RefusedError(f"{MOST} closures and rules are kept already", remedy="open or remove some of them")
        key = keyspace.CLOSURE_RECORD.key(name_id)
        for _ in range(TRIES):
            stored = await self._plane.dht.read(key)
            # The later word counts on all gateways: this one is later than the one that it replaces, by any clock.
            after_ns = max(
                (each.by.at_ns + 1 for each in (_decoded(stored), self._kept.get(name_id)) if each), default=0
            )
            word = Word(by=ask.by or "unsigned", why=ask.why, act=ask.act, at_ns=max(now_ns, after_ns))
            closure = Closure(kind=ask.kind, name=name, by=word, rule=rule, until_ns=ask.until_ns)
            try:
                await self._plane.dht.write(
                    key, encode(closure), expected=stored.version if stored is not None else None
                )
            except ConflictError:
                continue
            self._tell(closure)
            return closure
        raise ConflictError(f"{name} changes just now", remedy="try again")

    async def reopen(self, ask: ReopenAsk) -> Closure:
        """Answer `reopen`: with what it was.

        Raises:
            NotFoundError: it is not out of use.
        """
        key = keyspace.CLOSURE_RECORD.key(closure_id(ask.kind, self._canonical(ask.kind, ask.name)))
        for _ in range(TRIES):
            stored = await self._plane.dht.read(key)
            known = _decoded(stored)
            if stored is None or known is None or not known.holds(self._now_ns()):
                state, lists = _STATES[ask.kind]
                raise NotFoundError(f"{ask.name[:80]} is not {state}", remedy=f"`{lists}` lists what is")
            try:
                await self._plane.dht.remove(key, expected=stored.version)
            except ConflictError:
                continue
            self._tell(replace(known, ended_ns=self._now_ns()))
            return known
        raise ConflictError(f"{ask.name[:80]} changes just now", remedy="try again")

    def _tell(self, closure: Closure) -> None:
        self._take(closure)
        self._plane.session.publish(keyspace.CLOSURE, closure, closure.id)

    def _canonical(self, kind: str, name: str) -> str:
        """Return the name of a place on the site for one of its aliases."""
        place = self._site.find(name) if kind == "place" else None
        return next((key for key, each in self._site.places.items() if each is place), name)

    def _named(self, ask: CloseAsk) -> str:
        return self._robot(ask.name) if ask.kind == "robot" else self._place(ask.name)

    def _robot(self, name: str) -> str:
        if name not in self._plane.registry.robots:
            raise NotFoundError(f"unknown robot {name[:80]!r}", remedy="`swiftbot robots` lists them")
        return name

    def _place(self, asked: str) -> str:
        name = self._canonical("place", asked)
        if name not in self._site.places:
            known = ", ".join(sorted(self._site.places)[:12]) or "none"
            raise NotFoundError(f"no place {asked[:80]!r} on the site", remedy=f"places: {known}")
        return name

    def _ruled(self, ask: CloseAsk) -> Rule | None:
        """Return the rule that is asked for, in the one form that it has however it is written."""
        if (ask.kind == "rule") != (ask.rule is not None):
            raise PayloadError("a rule is asked for by what it says", remedy="swiftbot rules add --help")
        if ask.rule is None:
            return None
        rule = ask.rule
        try:
            ZoneInfo(rule.zone)
        except (OSError, ValueError, KeyError) as error:
            remedy = "give an IANA name, such as Europe/Zurich or UTC"
            raise PayloadError(f"no time zone {rule.zone[:60]!r}", remedy=remedy) from error
        return replace(
            rule,
            robots=tuple(sorted({self._robot(each) for each in rule.robots})),
            group="all" if rule.robots else rule.group,
            places=tuple(sorted({self._place(each) for each in rule.places})),
            things=tuple(sorted({" ".join(each.casefold().split()) for each in rule.things})),
            days=tuple(sorted(set(rule.days))),
            zone=rule.zone if rule.timed else "UTC",
        )


_CLOSING = {"place": "place_close", "robot": "robot_maintain", "rule": "rule_add"}
_OPENING = {"place": "place_open", "robot": "robot_maintain_end", "rule": "rule_remove"}
"""Verbs of the audit."""
_STATES = {
    "place": ("closed", "swiftbot place list"),
    "robot": ("in maintenance", "swiftbot robots"),
    "rule": ("a standing rule", "swiftbot rules list"),
}


def _decoded(stored: Record | None) -> Closure | None:
    if stored is None or stored.deleted:
        return None
    try:
        return msgspec.json.decode(stored.value, type=Closure)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def stronger(one: bytes, other: bytes) -> bytes:
    """Return the version of a closure's record that stands after a partition: the later word; alike on both sides."""

    def rank(value: bytes) -> tuple[int, bytes]:
        try:
            return msgspec.json.decode(value, type=Closure).by.at_ns, value
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return -1, value

    return max(one, other, key=rank)


def resolve(one: Record, other: Record) -> Record:
    """Return which of two concurrent versions stands: out of use before in use, since that moves nothing."""
    if one.deleted != other.deleted:
        return other if one.deleted else one
    value = stronger(one.value, other.value)
    return max(one, other, key=lambda record: (record.value == value, record.value, record.write))
