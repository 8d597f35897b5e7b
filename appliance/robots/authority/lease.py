"""Leases: which operator has taken which robot over, and until when.

Who takes a robot over is decided by compare-and-set on `lease/{robot}`; the rest is published. `Leases` is one
gateway's view, by its own clock (pure, the clock is passed in): a lease that is heard of counts from then, whatever its
giver's clock says; so it may hold a little longer than its operator thinks, never shorter than its renewals allow.

A lease that is not renewed ends by each gateway's own clock; the one that owns the robot's key then has it hold, and
says so. Commands under a lease go through the gateway that the operator's tool asks, which checks it first.
"""

import asyncio
import itertools
import time
import uuid
from collections.abc import Callable, Iterable

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.background import Background
from appliance.errors import ConflictError, NotFoundError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import Lease, RobotCommand, RobotReply, encode, keyspace
from appliance.model.robot_api import DriveAsk, GiveAsk, RenewAsk, TakeAsk
from appliance.plane.dht import Record
from appliance.plane.node import Plane
from appliance.plane.session import Closer
from appliance.robots.sender import send_command, tell_to_hold

MOST = 1024
"""Robots taken over at once, and leases remembered that have ended."""
GIVEN_BACK = "given back"
EXPIRED = "expired"


class _Held(Struct):
    lease: Lease
    until: float
    over: bool = False
    """Found due: no command under it counts any more."""
    ending: bool = False
    """Its end is on its way from here: a renewal that is heard now comes too late."""


class Leases:
    """The leases as one gateway knows them; `now` is monotonic seconds."""

    def __init__(self) -> None:
        self._held: dict[str, _Held] = {}
        self._ended: dict[str, None] = {}
        """Ids of leases that have ended: a late renewal must not bring one back."""

    @property
    def all(self) -> tuple[Lease, ...]:
        """Those in force, by robot."""
        return tuple(self._held[each].lease for each in sorted(self._held))

    def of(self, robot: str) -> Lease | None:
        """The lease of a robot, or None."""
        held = self._held.get(robot)
        return held.lease if held is not None else None

    def left_s(self, robot: str, now: float) -> float:
        """For how long it holds yet if it is not renewed."""
        held = self._held.get(robot)
        return max(0.0, held.until - now) if held is not None else 0.0

    def over(self, robot: str) -> bool:
        """Whether the lease of a robot was found due; the robot is nobody's until its end is published."""
        held = self._held.get(robot)
        return held is not None and held.over

    def due(self, now: float) -> tuple[Lease, ...]:
        """Those that were not renewed in time, and whose end is not on its way."""
        found: list[Lease] = []
        for each in self._held.values():
            each.over = now >= each.until
            if each.over and not each.ending:
                found.append(each.lease)
        return tuple(found)

    def end(self, lease: Lease) -> Lease:
        """Its end is on its way: no renewal keeps it; returns how it will be told when the robot holds."""
        held = self._held.get(lease.robot)
        if held is not None and held.lease.id == lease.id:
            held.over = held.ending = True
        return replace(lease, ended=EXPIRED)

    def hear(self, lease: Lease, now: float) -> bool:
        """Take in a lease, a renewal or an end; returns whether who has the robot has changed.

        Of two leases of one robot (two sides of a partition) the lower id stands, everywhere.
        """
        held = self._held.get(lease.robot)
        if lease.ended:
            self._end(lease.id)
            if held is not None and held.lease.id == lease.id:
                del self._held[lease.robot]
                return True
            return False
        if lease.id in self._ended:
            return False
        if held is not None and held.lease.id == lease.id:
            if lease.renewal <= held.lease.renewal or held.ending:
                return False
            held.lease, held.until, held.over = lease, now + lease.lease_s, False
            return False
        if held is not None and held.lease.id < lease.id:
            return False
        if not self.room(lease.robot):
            return False
        self._held[lease.robot] = _Held(lease, now + lease.lease_s)
        return True

    def room(self, robot: str) -> bool:
        """Whether a lease of a robot can be remembered."""
        return robot in self._held or len(self._held) < MOST

    def merge(self, leases: Iterable[Lease], now: float) -> bool:
        """Take in what another knows; returns whether anything has changed."""
        return sum(self.hear(each, now) for each in leases) > 0

    def expire(self, now: float, grace_s: float = 0.0) -> tuple[Lease, ...]:
        """End those that were not renewed in time, nor told to have ended in a grace after it, and return them."""
        over = [each.lease for each in self._held.values() if now >= each.until + grace_s]
        for each in over:
            del self._held[each.robot]
            self._end(each.id)
        return tuple(replace(each, ended=EXPIRED) for each in over)

    def next_s(self, now: float) -> float | None:
        """Seconds until one may be over; None when there is none."""
        return min((max(0.0, each.until - now) for each in self._held.values()), default=None)

    def _end(self, lease: str) -> None:
        self._ended[lease] = None
        while len(self._ended) > MOST:
            del self._ended[next(iter(self._ended))]


log = structlog.get_logger(__name__)

TICK_S = 0.2
"""How often leases are looked at; a robot that is not commanded any more has held by itself long before."""
GRACE_S = 3.0
"""How long tasks wait to be told of the end of a lease that is over: longer than a robot may take to hold (`TELL_S`).
Then the gateway that should tell it is gone, and the robot is free."""


class Leasing:
    """The leases as this gateway knows them. `changed` is called when who has a robot is another.

    `refuses` says why a command may not be carried out just now: robots that speak Zenoh themselves do not know it.
    `orders` holds it to the limits of its robot (`limits`).
    """

    def __init__(
        self,
        plane: Plane,
        *,
        changed: Callable[[], None],
        refuses: Callable[[str, RobotCommand], str],
        orders: Callable[[str, RobotCommand], RobotCommand] = lambda _, command: command,
    ) -> None:
        self._orders = orders
        self._plane = plane
        self._changed = changed
        self._refuses = refuses
        self.leases = Leases()
        self._numbers = itertools.count(1)
        self._closer: Closer | None = None
        self._ticking: asyncio.Task[None] | None = None
        self._ending = Background()

    def start(self) -> None:
        """Listen, and look at the clock."""
        self._closer = self._plane.session.subscribe_typed(keyspace.LEASE, self._on_lease)
        self._ticking = asyncio.create_task(self._tick(), name="leases of robots")

    async def close(self) -> None:
        """Listen no more."""
        if self._closer is not None:
            self._closer.close()
        if self._ticking is not None:
            self._ticking.cancel()
            await asyncio.gather(self._ticking, return_exceptions=True)
        await self._ending.close()

    def merge(self, leases: tuple[Lease, ...]) -> None:
        """Take in what another gateway knows."""
        if self.leases.merge(leases, time.monotonic()):
            self._changed()

    async def take(self, ask: TakeAsk) -> Lease:
        """Answer `control_take`.

        Raises:
            NotFoundError: no such robot is in the roster.
            ConflictError: somebody has it; the message says who.
            RefusedError: as many robots are taken over as are remembered.
        """
        if ask.robot not in self._plane.registry.robots:
            known = ", ".join(sorted(self._plane.registry.robots)) or "none"
            raise NotFoundError(f"no robot {ask.robot[:60]!r} is in the roster", remedy=f"there are: {known}")
        lease = Lease(
            id=ask.act or f"o-{uuid.uuid4().hex[:16]}",
            robot=ask.robot,
            by=ask.by,
            why=ask.why,
            lease_s=ask.lease_s,
            at_ns=time.time_ns(),
        )
        if (held := self.leases.of(ask.robot)) is not None:
            if held.id == lease.id:
                return held
            raise self._taken(held)
        if not self.leases.room(ask.robot):
            raise RefusedError(f"{MOST} robots are taken over already", remedy="give some of them back")
        try:
            stored = await self._plane.dht.read(_key(ask.robot))
        except UnreachableError as error:
            # The gateway that may have it does not answer: an operator must not wait for that. Where it turns up, it
            # conflicts.
            log.warning("robot taken over unread", robot=ask.robot, reason=str(error))
            stored = None
        known = _read(stored.value) if stored is not None and not stored.deleted else None
        if known is not None and not known.ended and known.id != lease.id:
            # Not heard of here yet, or lost with the gateway that was asked: it holds as long as it says from now on.
            self._hear(known)
            if (held := self.leases.of(ask.robot)) is not None:
                raise self._taken(held)
        if known is None or known.id != lease.id:
            await self._write_taken(lease, stored)
        self._hear(lease)
        self._plane.session.publish(keyspace.LEASE, lease, lease.robot)
        log.warning("robot taken over", robot=lease.robot, by=lease.by, why=lease.why, lease_s=lease.lease_s)
        await self._have_hold(lease.robot, lease.id)
        return lease

    async def _write_taken(self, lease: Lease, stored: Record | None) -> None:
        """Write a lease over what was read; ConflictError says who was faster."""
        for again in (True, False):
            try:
                await self._plane.dht.write(
                    _key(lease.robot), encode(lease), expected=stored.version if stored is not None else None
                )
            except ConflictError:
                stored = await self._plane.dht.read(_key(lease.robot))
                winner = _read(stored.value) if stored is not None else None
                if winner is not None and winner.id == lease.id:
                    return
                if winner is not None and not winner.ended:
                    self._hear(winner)
                    raise self._taken(winner) from None
                if not again:
                    raise
            else:
                return

    async def renew(self, ask: RenewAsk) -> Lease:
        """Answer `control_renew`; ConflictError when the lease has ended, or is about to since its time is over."""
        held = await self._held(ask.robot, ask.lease)
        if self.leases.left_s(ask.robot, time.monotonic()) <= 0:
            raise _over(ask.robot)
        renewed = replace(held, renewal=held.renewal + 1)
        self._hear(renewed)
        self._plane.session.publish(keyspace.LEASE, renewed, renewed.robot)
        return renewed

    async def give(self, ask: GiveAsk) -> Lease:
        """Answer `control_give`: the robot holds first, then it is the tasks' again; given twice is given once."""
        try:
            held = await self._held(ask.robot, ask.lease)
        except ConflictError:
            now = self.leases.of(ask.robot)
            if now is not None:
                raise
            return Lease(id=ask.lease, robot=ask.robot, by=ask.by, ended=GIVEN_BACK)
        await self._have_hold(held.robot, f"{held.id}~back")
        return await self._end(replace(held, ended=GIVEN_BACK, why=ask.why or held.why))

    async def move(self, ask: DriveAsk) -> RobotReply:
        """Answer `control_move`; what the robot cannot is in its reply.

        Raises:
            ConflictError: the lease has ended.
            RefusedError: a soft stop holds the robot, or it is above a limit.
        """
        held = await self._held(ask.robot, ask.lease)
        command = RobotCommand(
            id=f"{held.id}~{self._plane.gateway}~{time.time_ns()}~{next(self._numbers)}"[:200],
            verb=ask.verb,
            args=ask.args,
            lease=held.id,
        )
        if why := self._refuses(ask.robot, command):
            raise RefusedError(f"{ask.robot} is {why}", remedy="it moves when that is lifted: `swiftbot resume`")
        command = self._orders(ask.robot, command)
        doubtful = self._plane.registry.doubtful(ask.robot)
        return await send_command(self._plane.session, ask.robot, command, timeout_s=ask.timeout_s, doubtful=doubtful)

    async def _held(self, robot: str, lease: str) -> Lease:
        held = self.leases.of(robot)
        if held is None:
            stored = await self._plane.dht.read(_key(robot))
            known = _read(stored.value) if stored is not None and not stored.deleted else None
            if known is not None and known.id == lease and not known.ended:
                self._hear(known)
                held = self.leases.of(robot)
        if held is None:
            raise _over(robot)
        if held.id != lease:
            raise self._taken(held)
        return held

    def _taken(self, held: Lease) -> ConflictError:
        left_s = self.leases.left_s(held.robot, time.monotonic())
        return ConflictError(
            f"{held.robot} is {held.text}",
            remedy=f"ask them to give it back; without a renewal it is free in {left_s:.0f} s",
        )

    def _hear(self, lease: Lease) -> None:
        if not lease.ended and not self.leases.room(lease.robot):
            self._plane.session.refuse("no room for a lease", robot=lease.robot, by=lease.by)
        if self.leases.hear(lease, time.monotonic()):
            self._changed()

    def _on_lease(self, key: str, lease: Lease | None) -> None:
        if lease is None:
            return
        if not key.endswith(f"/{lease.robot}"):
            self._plane.session.refuse("misplaced operator/lease/*", key=key, says=lease.robot)
            return
        self._hear(lease)

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            try:
                self._look(time.monotonic())
            except Exception:  # supervision boundary: leases that never end would keep robots from their tasks
                log.exception("looking at the leases broke; it goes on")

    def _look(self, now: float) -> None:
        """Have robots hold whose lease is over; tasks have them back once that is published, or after a grace."""
        for each in self.leases.due(now):
            if self._plane.dht.owns(f"robot/{each.robot}"):
                log.warning("a lease was not renewed: the robot holds", robot=each.robot, by=each.by)
                self._ending.start(self._end_over(self.leases.end(each)), f"lease of {each.robot}")
        if gone := self.leases.expire(now, GRACE_S):
            for each in gone:
                log.warning("a lease is over, and nobody told its end: the robot is free", robot=each.robot, by=each.by)
            self._changed()

    async def _end_over(self, ended: Lease) -> None:
        try:
            await self._have_hold(ended.robot, f"{ended.id}~over")
            await self._end(ended)
        except SwiftbotError as error:
            log.warning("the end of a lease is not written", robot=ended.robot, reason=str(error))
        except Exception:  # supervision boundary: it ends by the grace all the same
            log.exception("ending a lease broke", robot=ended.robot)

    async def _end(self, ended: Lease) -> Lease:
        self._hear(ended)
        self._plane.session.publish(keyspace.LEASE, ended, ended.robot)
        stored = await self._plane.dht.read(_key(ended.robot))
        known = _read(stored.value) if stored is not None and not stored.deleted else None
        if stored is not None and known is not None and known.id == ended.id:
            try:
                await self._plane.dht.write(_key(ended.robot), encode(ended), expected=stored.version)
            except ConflictError:
                log.info("somebody has taken the robot meanwhile", robot=ended.robot)
        log.warning("robot given back", robot=ended.robot, by=ended.by, how=ended.ended)
        return ended

    async def _have_hold(self, robot: str, act: str) -> None:
        _, problems = await tell_to_hold(self._plane.session, (robot,), act=act)
        for reason in problems.values():
            log.warning("a robot does not confirm that it holds", robot=robot, reason=reason)


def _over(robot: str) -> ConflictError:
    return ConflictError(f"the lease of {robot[:60]} has ended", remedy="take it over again")


def _key(robot: str) -> str:
    return keyspace.LEASE_RECORD.prefix + robot


def _read(value: bytes) -> Lease | None:
    try:
        return msgspec.json.decode(value, type=Lease)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
