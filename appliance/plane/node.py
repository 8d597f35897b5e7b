"""What takes part in the plane: a gateway (`Plane`) and a router (`run_router`); a client's part is in `client`.

A gateway's part is session, RPC, membership, records, leases and registry put together.

A router is what a large fleet's gateways are clients of, so that they need no links with each other. A few gateways
link as peers, each with each. Beyond some thirty that costs too much memory and descriptors; there, three to five
routers are linked sparsely (a line or a star: link state does not scale in dense graphs), and every gateway is a
client of those near it (`plane.mode = "client"`). A router holds no records and no place on the ring: gateways are
addressed by key and the routers find the way, so any of them can be restarted at any time. Eclipse Zenoh's own
`zenohd` does the same; this one needs nothing that a gateway does not have.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING

import structlog
from msgspec.structs import replace

from appliance.errors import ConfigError, DeadlineError, IdentityError, SwiftbotError, UnreachableError
from appliance.model import keyspace
from appliance.model.keys import Keys, Verb, check_name
from appliance.model.plane_api import Member, MemberAsk, SealedAsk, SealedTold
from appliance.model.roles import Role
from appliance.plane.anti_entropy import Reconciler
from appliance.plane.dht import Browsing, Dht
from appliance.plane.events import FleetEvent, FleetEvents, RingChanged, Stage
from appliance.plane.handing import Handing, Held
from appliance.plane.leases import Leases
from appliance.plane.link import dialled
from appliance.plane.membership import Membership, Outlived, StallDetector, displaced
from appliance.plane.proofs import Proofs
from appliance.plane.records import Resolver, by_bytes
from appliance.plane.registry import Registry
from appliance.plane.reopening import Reopener
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.session import Session
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store

if TYPE_CHECKING:
    from appliance.identity.credentials import Credentials

log = structlog.get_logger(__name__)

STORE_FILE = "gateway.sqlite"
ROSTER_FILE = "roster.json"
"""The roster that counts, beside the store."""


AWAY_S = 60.0
"""A gateway that was away for longer may have missed much, and fetches it before the others hand it requests; one that
was restarted has nearly all, and is back sooner without."""
BACK_S = 0.25
"""How long the rest of a gateway's start waits for its shard to be compared: several times what that takes among few.
Somebody who is seen and does not answer must not hold it up."""
GIVE_S = 10.0
"""How long one that has to go gives its records away: thousands, where the others answer."""
UNSEEN_S = 10.0
"""After so long those that `plane.peers` names and that have not come are reported, once."""
ROSTER_S = 5.0
"""How often it is looked whether the roster has changed."""
MOST_ASKED = 3
ASK_TIMEOUT_S = 0.5
"""One that is busy for longer is no help: what is linked directly counts then."""


class Plane:
    """A gateway's membership in the fleet; made by `open`, ended by `close`."""

    def __init__(
        self, config: PlaneConfig, *, session: Session, store: Store, gateway: str, resolver: Resolver = by_bytes
    ) -> None:
        self.config = config
        self.gateway = gateway
        self.session = session
        self.store = store
        self.keys: Keys = session.keys
        self.rpc = Rpc(session, gateway)
        self.events = FleetEvents()
        proofs = self._proofs = (
            None
            if session.credentials is None
            else Proofs(
                session.credentials, rpc=self.rpc, keys=self.keys, gateway=gateway, within_s=config.lease_ms / 1e3
            )
        )
        self._membership = Membership(
            session,
            gateway=gateway,
            virtual_nodes=config.virtual_nodes,
            events=self.events,
            prove=None if proofs is None else proofs.prove,
        )
        self._proving: asyncio.Task[None] | None = None
        self.registry = Registry(
            config, session=session, rpc=self.rpc, membership=self._membership, events=self.events, gateway=gateway
        )
        self._pulse = StallDetector(config.lease_ms / 1e3, events=self.events)
        self._outlived = Outlived(
            self.events,
            lease_s=config.lease_ms / 1e3,
            members=self._membership,
            answers=self._answers,
            sees=self._sees,
            renew=session.renew_links,
        )
        self.leases = Leases(config, gateway=gateway, store=store, rpc=self.rpc)
        self.dht = Dht(
            config,
            gateway=gateway,
            store=store,
            rpc=self.rpc,
            membership=self._membership,
            pulse=self._pulse,
            resolver=resolver,
        )
        Browsing(config, gateway=gateway, store=store, rpc=self.rpc, membership=self._membership)
        self._reconciler = Reconciler(
            config,
            gateway=gateway,
            store=store,
            rpc=self.rpc,
            membership=self._membership,
            dht=self.dht,
            pulse=self._pulse,
            events=self.events,
        )
        self.rpc.register(keyspace.MEMBER, self._on_member)
        self._roster_news = asyncio.Event()
        self._rosters = Handing(
            session.credentials,
            keyspace.ROSTER,
            gateway=gateway,
            rpc=self.rpc,
            members=self.members,
            on_taken=self._roster_news.set,
        )
        self._handed: list[Handing] = []
        """What else of the authority is handed on."""
        self.on_revoked: Callable[[frozenset[str]], Awaitable[None]] | None = None
        """Called with the robots whose certificates a new roster has revoked, before their links are closed."""
        self._reopener = Reopener(session, gateway=gateway, rpc=self.rpc, members=self.members, events=self.events)
        self.milestones: dict[str, float] = {}
        """When, on this machine's monotonic clock, `session` and `store` were open; `linked` to somebody; `present`: it
        knew who is there; `fetched` what it will own; `joined`: the others can see it; `reconciled`: it answers for its
        keys with its shard compared."""
        self._unseen: asyncio.TimerHandle | None = None
        self._back = asyncio.Event()
        self._away_s = 0.0
        """For how long nothing was written here before."""
        self.events.subscribe(Stage.RECORDS, self._on_event)

    def _on_event(self, event: FleetEvent) -> None:
        if isinstance(event, RingChanged):
            self._reached("reconciled")

    def _reached(self, milestone: str) -> None:
        if milestone in self.milestones:
            return
        self.milestones[milestone] = now = time.monotonic()
        if milestone == "reconciled":
            self._back.set()
            opened = self.milestones.get("session", now)
            after_ms = {
                f"{name}_ms": round((at - opened) * 1e3, 2) for name, at in self.milestones.items() if at > opened
            }
            opened_s, members = round(opened, 6), len(self._membership.members)
            log.info("back in the ring", gateway=self.gateway, members=members, session_opened_s=opened_s, **after_ms)

    @classmethod
    async def open(
        cls, config: PlaneConfig, *, fleet: str, gateway: str, data_dir: Path, resolver: Resolver = by_bytes
    ) -> "Plane":
        """Open the session and the store, fetch what this gateway will own, and join.

        `resolver` merges versions of a record that were made apart; by default one of them stands.

        Raises:
            ConfigError: a setting is wrong, an endpoint or the store is in use, the id is taken.
            PrerequisiteError: the disk is full or fails.
        """
        check_name(gateway, "gateway")
        config.check_own(gateway)
        away_s = _unwritten_s(data_dir / STORE_FILE)
        session, opened, store = await _open_both(config, fleet, gateway, data_dir / STORE_FILE)
        plane: Plane | None = None
        try:
            plane = cls(config, session=session, store=store, gateway=gateway, resolver=resolver)
            plane._away_s = away_s
            plane.milestones["session"] = opened
            plane._reached("store")
            await plane._join()
        except BaseException:
            if plane is not None:
                await plane.close()
            else:
                await store.close()
                await session.close()
            raise
        return plane

    async def until_back(self, timeout_s: float = BACK_S) -> bool:
        """Wait until this gateway answers for its keys with its shard compared; False when that takes longer.

        Whatever else a gateway starts competes with that for the event loop, and nobody asks for it before.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._back.wait()
        return self._back.is_set()

    async def displaced(self) -> ConfigError:
        """Wait until another gateway is there because of which this one has to go; returns what is wrong.

        It has this one's id, or this one does not work beside its version.

        Two of one name can meet although each found it free: they began at one moment, or on two sides of a cut. By
        then a copy of each record that is here is with the others, who can ask only one of the two for what it has.
        """
        finders = [each for each in (self.registry.namesakes, self.registry.versions) if each is not None]
        waits = [asyncio.create_task(each.displaced.wait()) for each in finders]
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in waits:
                each.cancel()
        try:
            async with asyncio.timeout(GIVE_S):
                await self._reconciler.give_all()
        except (TimeoutError, SwiftbotError) as error:
            log.warning("not all records could be given to the others", reason=str(error))
        versions = self.registry.versions
        return (versions.problem if versions is not None else None) or displaced(self.gateway)

    async def _join(self) -> None:
        membership = self._membership
        await self.leases.start(lost=self.store.set_aside is not None)
        if self.config.connect or set(self.config.peers) - {self.gateway}:
            await self._first_link()
        self._reached("linked")
        present = await self._present()
        self._reached("present")
        # Nobody hears of this gateway before its token shows: it may look for its records meanwhile.
        checking = asyncio.create_task(self._check_free(present), name="is the name free")
        try:
            for key in present:
                membership.add(key)
            membership.start()
            self._pulse.start()
            self.registry.start()
            # Otherwise this gateway would take itself for the first one up.
            await membership.proved(self.config.lease_ms / 1e3)
            if self._away_s > AWAY_S:
                await self._reconciler.join()
            self._reached("fetched")
            await checking
        finally:
            checking.cancel()
        membership.join()
        self._reached("joined")
        self._reconciler.start()
        log.info("joined", gateway=self.gateway, members=sorted(membership.members))
        self._unseen = asyncio.get_running_loop().call_later(UNSEEN_S, self._tell_unseen)
        if self.session.credentials is not None:
            self._proving = asyncio.create_task(self._watch_roster(self.session.credentials), name="roster")

    async def _watch_roster(self, credentials: "Credentials") -> None:
        """Have members prove again who they are whenever the roster changes, and go by what is new of it.

        Ends with the error of a reopening that leaves the gateway without a session; after any other error it goes on.
        """
        number, barred = credentials.roster.number, credentials.barred
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ROSTER_S):
                    await self._roster_news.wait()
            self._roster_news.clear()
            try:
                credentials.refresh()
                if (found := credentials.roster.number) != number:
                    log.info("the roster is new", number=found)
                    # Before the links of a robot are closed: it may be moving.
                    if (revoked := credentials.barred - barred) and self.on_revoked is not None:
                        await self.on_revoked(revoked)
                    barred = credentials.barred
                    for robot in barred:
                        self.registry.lose(robot)
                    await self._membership.prove_again()
                    # Last: where one of these steps breaks, all are done again.
                    number = found
                for each in (self._rosters, *self._handed):
                    await each.spread()
                if credentials.stale:
                    await self._reopener.reopen("other keys, or other robots")
            except Exception:
                if self.session.gone:
                    raise
                log.exception("looking at the roster broke; it goes on")

    async def hand_on(self, held: Held | None, verb: Verb[SealedAsk, SealedTold]) -> None:
        """Hand another signed file on from now on, and see first whether a member has a newer one.

        Args:
            held: the file; None without keys: the verb is answered, and refused.
            verb: by which gateways compare.
        """
        handing = Handing(held, verb, gateway=self.gateway, rpc=self.rpc, members=self.members)
        await handing.spread()
        self._handed.append(handing)

    async def until_gone(self) -> None:
        """Wait until the session was closed to be reopened and could not be; raises why. Without keys it returns."""
        if self._proving is not None:
            await asyncio.shield(self._proving)

    def _tell_unseen(self) -> None:
        """Say which gateways of the table have not come: two that each wait for the other's call are two fleets."""
        unseen = sorted(set(self.config.peers) - self._membership.members - {self.gateway})
        if unseen:
            ours = dialled(self.gateway, self.config.peers)
            log.warning(
                "gateways named in plane.peers are not seen",
                unseen=unseen,
                dialled=[name for name in unseen if self.config.peers[name] in ours],
                remedy="are they up, with this gateway in their plane.peers? all but `dialled` are to dial this one",
            )

    async def _first_link(self) -> None:
        """Wait a moment for the first link: only then is it known who is there already."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self.config.join_wait_s):
                while not self.session.linked:  # noqa: ASYNC110 - the library has no event for it
                    await asyncio.sleep(0.001)

    async def _check_free(self, present: list[str]) -> None:
        """Raise ConfigError when another process shows our token; one that was killed may do so for a lease."""
        until = asyncio.get_running_loop().time() + 2 * self.config.lease_ms / 1e3
        own = self.keys(keyspace.GATEWAY_ALIVE, self.gateway)
        while own in present or await self._known_to(present):
            if asyncio.get_running_loop().time() > until:
                raise ConfigError(
                    f"a gateway named {self.gateway} is already in fleet {self.keys.fleet}",
                    remedy="give each gateway an id of its own",
                )
            await asyncio.sleep(0.02)
            present = await self._present()

    async def _known_to(self, present: list[str]) -> bool:
        """Whether gateways that are linked already see one of our name to which we have no link yet."""
        names = [name for key in present for name in keyspace.GATEWAY_ALIVE.match(key) or ()]
        others = [name for name in names if name != self.gateway][:MOST_ASKED]
        ask = MemberAsk(gateway=self.gateway)
        answers = await asyncio.gather(
            *(self.rpc.call(name, keyspace.MEMBER, ask, timeout_s=ASK_TIMEOUT_S) for name in others),
            return_exceptions=True,
        )
        return any(isinstance(answer, Member) and answer.here for answer in answers)

    async def _answers(self, name: str, timeout_s: float) -> bool:
        """Whether a member answers a question in time, whatever it says."""
        ask = MemberAsk(gateway=self.gateway)
        try:
            await self.rpc.call(name, keyspace.MEMBER, ask, timeout_s=timeout_s)
        except SwiftbotError as error:
            return not isinstance(error, UnreachableError | DeadlineError)
        return True

    async def _sees(self, name: str, other: str, timeout_s: float) -> bool:
        """Whether a member says in time that it sees another."""
        ask = MemberAsk(gateway=other)
        with contextlib.suppress(SwiftbotError):
            return (await self.rpc.call(name, keyspace.MEMBER, ask, timeout_s=timeout_s)).here
        return False

    async def _on_member(self, ask: MemberAsk) -> Member:
        here = check_name(ask.gateway, "gateway") in self._membership.members
        proof = self._proofs.proof(ask.challenge) if self._proofs is not None and ask.challenge else b""
        return Member(here=here, proof=proof)

    async def _present(self) -> list[str]:
        """Return the keys of all gateways' tokens."""
        return await self.session.alive_now(self.keys(keyspace.GATEWAY_ALIVE))

    @property
    def ring(self) -> Ring:
        """The ring of the gateways that are there just now."""
        return self._membership.ring

    async def owner_of(self, key: str) -> str:
        """The gateway that a key belongs to."""
        return self._membership.ring.owner(key)

    def members(self) -> frozenset[str]:
        """Ids of the gateways that are there, this one among them."""
        return self._membership.members

    def sees(self, name: str) -> bool:
        """Whether a gateway is there, as far as this one can tell."""
        return self._membership.sees(name)

    async def close(self) -> None:
        """Leave the fleet and close the store; more than once does no harm."""
        if self._unseen is not None:
            self._unseen.cancel()
        if self._proving is not None:
            self._proving.cancel()
            await asyncio.gather(self._proving, return_exceptions=True)
        await self._outlived.close()
        self._membership.close()
        await self._reconciler.close()
        await self.dht.close()
        await self.registry.close()
        self.rpc.close()
        await self.session.close()
        await self.store.close()
        self._pulse.close()


def _unwritten_s(path: Path) -> float:
    """For how long a store has not been written to, by this machine's clock; endless where there is none."""
    written = [each.stat().st_mtime for each in (path, path.with_name(f"{path.name}-wal")) if each.exists()]
    return max(0.0, time.time() - max(written)) if written else math.inf


async def _open_both(config: PlaneConfig, fleet: str, gateway: str, path: Path) -> tuple[Session, float, Store]:
    """Open session and store at the same time; returns when the session was open too. Errors as `Plane.open`."""
    storing = asyncio.create_task(Store.open(path), name="open the store")
    try:
        session = await Session.open(config, fleet, gateway, roster=path.with_name(ROSTER_FILE))
    except BaseException:
        with contextlib.suppress(SwiftbotError):
            await (await storing).close()
        raise
    opened = time.monotonic()
    try:
        return session, opened, await storing
    except BaseException:
        await session.close()
        raise


_ROUTER_FLEET = "router"
"""A session belongs to a fleet by the keys it uses; a router uses none, and routes for all fleets."""
_ROUTER_LOOK_S = 1.0


def _fleet_of(keys: str) -> str:
    """The fleet whose router one with these keys is; IdentityError unless they are for a gateway or router."""
    from appliance.identity.bundle import Bundle  # noqa: PLC0415 - only those that have keys pay for it

    identity = Bundle.load(Path(keys).expanduser()).identity
    if identity.role is not Role.GATEWAY:
        raise IdentityError(
            f"{keys} is of {identity.text}, and a router accepts links",
            remedy="swiftbot keys issue gateway NAME --host ADDRESS",
        )
    return identity.fleet


async def run_router(
    config: PlaneConfig, *, stop: asyncio.Event, ready: Callable[[Session], None], alive: Callable[[], None]
) -> None:
    """Route until `stop`. `ready` is called once it listens, `alive` about every second after that.

    Raises:
        ConfigError: there is nothing to listen on, or it is in use.
        IdentityError: its keys are not good, or not those of a gateway.
    """
    if not config.listen:
        raise ConfigError("a router has nothing to listen on", remedy="give --listen, such as tls/0.0.0.0:7447")
    fleet = _ROUTER_FLEET
    if config.keys:
        fleet = await asyncio.to_thread(_fleet_of, config.keys)
    session = await Session.open(replace(config, mode="router"), fleet)
    try:
        log.info("routing", listen=config.listen, connect=config.connect)
        ready(session)
        linked = -1
        while not stop.is_set():
            alive()
            if session.linked != linked:
                linked = session.linked
                log.info("linked", routers_and_peers=linked)
            try:
                async with asyncio.timeout(_ROUTER_LOOK_S):
                    await stop.wait()
            except TimeoutError:
                continue
    finally:
        await session.close()
    log.info("stopped")
