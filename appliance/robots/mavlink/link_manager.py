"""The links of one gateway: opened by the configuration, added and removed at run time, kept, counted.

What an operator adds or removes is written to the gateway's store before it is answered, so that a restart finds the
same links: those of the configuration without the removed ones, and those added. Each link has a number, by which
routing and signatures know it. What signed links know is kept in the store too: after a restart nothing old is believed
and no time used twice.
"""

import asyncio
import functools
import math
import time
from collections.abc import Collection, Iterable, Iterator

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import ConfigError, NotFoundError, RefusedError, SwiftbotError
from appliance.model import encode
from appliance.model.robot_api import LatencyFacts, LinkFacts, MavlinkLink, SenderFacts
from appliance.robots.executor import KeyValues
from appliance.robots.hub import ADDED_LINKS as KEY
from appliance.robots.mavlink.dialect import KINDS, NAMES, Codec, Frame, make
from appliance.robots.mavlink.links import Address, Link, Sink, open_link
from appliance.robots.mavlink.routing import Damper, End, RoutingTable, Rules
from appliance.robots.mavlink.signing import Memory, Signer, read_key
from appliance.robots.settings import RobotsConfig

log = structlog.get_logger(__name__)

REMEMBER_S = 5.0
"""How often it is kept; `signing.AHEAD` and `signing.SINCE` are longer."""


def _key(link: MavlinkLink) -> str:
    return f"mavlink/signing/{link.remote}"


async def load_signer(link: MavlinkLink, number: int, store: KeyValues) -> Signer | None:
    """Return the key of a link with what it knew before; None for a link that does not sign. ConfigError: no key.

    From then on the time kept is ahead of what is used, so that a crash at any moment makes none be used twice.
    """
    if not link.signing:
        return None
    key = await asyncio.to_thread(read_key, link.signing)
    kept = dict(await store.scan(_key(link))).get(_key(link))
    try:
        memory = msgspec.json.decode(kept, type=Memory) if kept else Memory()
    except msgspec.DecodeError as error:
        log.warning("what a signed link knew is lost", link=str(link.remote), reason=str(error))
        memory = Memory()
    signer = Signer(key, link_id=number % 256, memory=memory)
    await store.put(_key(link), encode(signer.ahead))
    return signer


async def remember(links: Iterable[tuple[MavlinkLink, Link]], store: KeyValues, *, last: bool = False) -> None:
    """Keep what the signed links know; `last`: nothing more is sent or heard, so it is exact."""
    for setting, link in links:
        signer = link.codec.signer
        if signer is not None:
            await store.put(_key(setting), encode(signer.memory if last else signer.ahead))


MAX_LINKS = 64
MOST_TOLD = 64
"""Senders of a link that are listed: those heard last."""


class KeptLinks(Struct, frozen=True, kw_only=True):
    """What operators have changed of the configuration's links."""

    added: tuple[MavlinkLink, ...] = ()
    removed: tuple[str, ...] = ()


class OpenLink(Struct, eq=False):
    """One link in use."""

    number: int
    setting: MavlinkLink
    link: Link
    added: bool
    damper: Damper
    ends: dict[Address, End] = msgspec.field(default_factory=dict[Address, End])
    """Ends by address, so that none is made for each frame."""

    def end(self, address: Address) -> End:
        """Return the end at an address."""
        found = self.ends.get(address)
        if found is None:
            if len(self.ends) > 4096:
                self.ends.clear()
            found = self.ends[address] = End(self.number, address)
        return found


async def kept_links(store: KeyValues) -> KeptLinks:
    """Return what operators have changed; nothing when that cannot be read, which is logged."""
    kept = dict(await store.scan(KEY)).get(KEY)
    try:
        return msgspec.json.decode(kept, type=KeptLinks) if kept else KeptLinks()
    except msgspec.DecodeError as error:
        log.warning("links added at run time cannot be read and are lost", reason=str(error))
        return KeptLinks()


def message_names(setting: str, wanted: Collection[str]) -> frozenset[str]:
    """Return the messages that a setting names, by name or number; ConfigError for one that is none."""
    found: set[str] = set()
    for text in wanted:
        kind = KINDS.get(int(text)) if text.isascii() and text.isdecimal() else None
        name = kind.name if kind is not None else text.upper()
        if name not in NAMES:
            raise ConfigError(
                f"{setting}: {text[:60]!r} is no MAVLink message",
                remedy="use names as on mavlink.io (ATTITUDE), or numbers",
            )
        found.add(name)
    return frozenset(found)


def rules_of(setting: MavlinkLink) -> Rules:
    """Return a link's filters, by names; ConfigError for a message that is none."""
    names = functools.partial(message_names, f"robots.mavlink {setting.remote}")
    return Rules(
        only_in=names(setting.only_in),
        not_in=names(setting.not_in),
        only_out=names(setting.only_out),
        not_out=names(setting.not_out),
    )


class LinkManager:
    """All links.

    Args:
        config: the links to begin with, and limits.
        store: keeps what is changed, and what signed links know.
        routing: knows the links by number.
        refused: counters of bad input by kind.
        keyed: whether the gateway has keys: then links that others may reach have to be signed.
    """

    def __init__(
        self,
        config: RobotsConfig,
        *,
        store: KeyValues,
        routing: RoutingTable,
        refused: dict[str, int],
        keyed: bool = False,
    ) -> None:
        self._keyed = keyed
        self._config = config
        self._store = store
        self._routing = routing
        self._refused = refused
        self._sink: Sink | None = None
        self._links: dict[int, OpenLink] = {}
        self._kept = KeptLinks()
        self._changing = asyncio.Lock()

    def __iter__(self) -> Iterator[OpenLink]:
        return iter(tuple(self._links.values()))

    def __len__(self) -> int:
        return len(self._links)

    def get(self, number: int) -> OpenLink | None:
        """Return a link by its number, None when it is closed."""
        return self._links.get(number)

    async def open(self, sink: Sink) -> None:
        """Open all, whose frames the sink takes; ConfigError with the remedy when a setting is wrong or a port taken.

        One added at run time that cannot be opened is logged and left out until the next start: the gateway must come
        up without a person.
        """
        self._sink = sink
        self._kept = await kept_links(self._store)
        for setting in self._config.mavlink:
            if str(setting.remote) in self._kept.removed:
                log.info("MAVLink link of the configuration was removed", link=str(setting.remote))
                continue
            await self._open(setting, added=False)
        for setting in self._kept.added:
            try:
                setting.check()
                if self._find(str(setting.remote)) is None:
                    await self._open(setting, added=True)
            except SwiftbotError as error:
                log.warning("a MAVLink link added at run time cannot be opened", reason=str(error))

    async def _open(self, setting: MavlinkLink, *, added: bool) -> OpenLink:
        if self._keyed:
            setting.check_keyed()
        rules = rules_of(setting)
        number = next(each for each in range(MAX_LINKS + 1) if each not in self._links)
        signer = await load_signer(setting, number, self._store)
        assert self._sink is not None  # noqa: S101 - `open` comes first
        codec = Codec(self._config.system_id, self._config.component_id, signer=signer, v1=setting.mavlink1)

        self._routing.add(number, rules)
        try:
            limit_hz, refused = self._config.sender_hz, self._refused
            link = await open_link(setting.remote, codec, self._sink, refused, number=number, limit_hz=limit_hz)
        except BaseException:
            self._routing.remove(number)
            raise
        entry = self._links[number] = OpenLink(number, setting, link, added, Damper(self._config.message_hz))
        log.info("MAVLink link open", link=str(setting.remote), listens=setting.remote.listens, signed=bool(signer))
        return entry

    async def close(self) -> None:
        """Close all and keep what they know."""
        for each in self:
            await each.link.close()
        await remember(((each.setting, each.link) for each in self), self._store, last=True)
        self._links.clear()

    # --- at run time -------------------------------------------------------------------------------------------

    async def add(self, setting: MavlinkLink, *, by: str) -> LinkFacts:
        """Open a link and keep it over restarts.

        Raises:
            ConfigError: it cannot be, or its port is taken.
            RefusedError: the address is in use by a link with other settings, or there are too many.
        """
        setting.check()
        async with self._changing:
            url = str(setting.remote)
            found = self._find(url)
            if found is None:
                if len(self._links) >= MAX_LINKS:
                    raise RefusedError(f"there are {MAX_LINKS} MAVLink links", remedy="remove one that is not needed")
                found = await self._open(setting, added=not self._configured(setting))
            elif found.setting != setting:
                raise RefusedError(f"{url} is a link with other settings", remedy="remove it first")
            others = tuple(each for each in self._kept.added if str(each.remote) != url)
            await self._keep(
                KeptLinks(
                    added=(*others, setting) if found.added else others,
                    removed=tuple(each for each in self._kept.removed if each != url),
                )
            )
            log.info("MAVLink link added", link=url, by=by[:120])
            return self.facts(found, self._now())

    async def remove(self, url: str, *, by: str) -> LinkFacts:
        """Close a link for good; NotFoundError when there is none of that name."""
        async with self._changing:
            found = self._find(url)
            if found is None:
                known = ", ".join(str(each.setting.remote) for each in self) or "none"
                raise NotFoundError(f"no MAVLink link {url[:120]!r}", remedy=f"there are: {known}")
            last = self.facts(found, self._now())
            url = str(found.setting.remote)
            configured = any(str(each.remote) == url for each in self._config.mavlink)
            await self._keep(
                KeptLinks(
                    added=tuple(each for each in self._kept.added if str(each.remote) != url),
                    removed=(*self._kept.removed, url) if configured else self._kept.removed,
                )
            )
            await found.link.close()
            await remember([(found.setting, found.link)], self._store, last=True)
            del self._links[found.number]
            self._routing.remove(found.number)
            log.info("MAVLink link removed", link=url, by=by[:120])
            return last

    async def _keep(self, kept: KeptLinks) -> None:
        await self._store.put(KEY, encode(kept))
        self._kept = kept

    def _configured(self, setting: MavlinkLink) -> bool:
        return setting in self._config.mavlink

    def _find(self, url: str) -> OpenLink | None:
        wanted = url.removesuffix("/")
        return next((each for each in self if str(each.setting.remote) == wanted), None)

    async def remember(self) -> None:
        """Keep what signed links know."""
        await remember(((each.setting, each.link) for each in self), self._store)

    # --- what is published ---------------------------------------------------------------------------------------

    def ask_time(self, ends: set[End]) -> list[tuple[End, bytes]]:
        """Send each end a TIMESYNC, whose answer tells the latency; returns what was sent."""
        sent: list[tuple[End, bytes]] = []
        for end in ends:
            entry = self._links.get(end.link)
            if entry is not None:
                stamp = time.monotonic_ns()
                entry.link.stats.asked(end.address, stamp, stamp)
                sent.append((end, entry.link.send(make("TIMESYNC", tc1=0, ts1=stamp), end.address)))
        return sent

    @staticmethod
    def timed(entry: OpenLink, frame: Frame, address: Address) -> bool:
        """Take the answer to a TIMESYNC of ours; whether it was one."""
        if frame.message.tc1 == 0:
            return False
        return entry.link.stats.answered(address, frame.message.ts1, time.monotonic_ns())

    def all_facts(self) -> tuple[LinkFacts, ...]:
        """All links as they are now."""
        now = self._now()
        return tuple(self.facts(each, now) for each in self)

    def facts(self, entry: OpenLink, now: float) -> LinkFacts:
        """One link as it is now."""
        stats, link = entry.link.stats, entry.link
        stats.look(now)
        entry.damper.look(now)
        in_hz, in_bytes_s, out_hz, out_bytes_s = stats.meter.rates
        heard = sorted(stats.senders.items(), key=lambda each: -each[1].heard_at)[:MOST_TOLD]
        return LinkFacts(
            number=entry.number,
            url=str(entry.setting.remote),
            listens=entry.setting.remote.listens,
            signed=link.codec.signer is not None,
            added=entry.added,
            ends=tuple(sorted(_shown(end.address) for end in self._routing.ends if end.link == entry.number)),
            frames_in=stats.frames_in,
            frames_out=stats.frames_out,
            bytes_in=stats.bytes_in,
            bytes_out=stats.bytes_out,
            in_hz=in_hz,
            out_hz=out_hz,
            in_bytes_s=in_bytes_s,
            out_bytes_s=out_bytes_s,
            refused=dict(link.damaged),
            passed={f"{system}/{component}": count for (system, component), count in sorted(stats.passed.items())},
            damped=tuple(f"{name} of {system}/{component}" for system, component, name in sorted(entry.damper.damped)),
            senders=tuple(
                SenderFacts(
                    system=system,
                    component=component,
                    received=each.received,
                    lost=each.lost,
                    loss=round(each.loss, 4),
                    late=each.late,
                    repeated=each.repeated,
                    silent_s=round(max(0.0, now - each.heard_at), 1),
                )
                for (system, component), each in sorted(heard)
            ),
            latency=tuple(
                LatencyFacts(
                    end=_shown(address),
                    last_ms=round(each.last_ms, 3),
                    least_ms=round(each.least_ms, 3),
                    mean_ms=round(each.mean_ms, 3),
                    count=each.count,
                )
                for address, each in stats.latency.items()
                if math.isfinite(each.last_ms)
            ),
            problem=link.problem,
        )

    def routes(self) -> dict[str, str]:
        """Where each sender was heard last."""
        found: dict[str, str] = {}
        for (system, component), end in sorted(self._routing.routes.items()):
            entry = self._links.get(end.link)
            if entry is not None:
                found[f"{system}/{component}"] = f"{entry.setting.remote} {_shown(end.address)}"
        return found

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()


def _shown(address: Address) -> str:
    return f"{address[0]}:{address[1]}" if address[1] else address[0]
