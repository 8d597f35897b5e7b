"""Moves the robots of one gateway's runs over a floor that all share: the shell around `mover`.

Every reservation is a lease on parts of the key `floor` (`plane.leases`): a majority of the key's holders grants it, so
two sides of a partition never grant the same ground. Its holder is the robot: a gateway that takes a run over has what
the robot has. Reservations end when nobody renews them, and stand in the way until the robot is seen standing.
"""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable

import structlog
from msgspec.structs import replace

from appliance.background import Background
from appliance.errors import RobotError, SwiftbotError
from appliance.floor import geometry
from appliance.floor.decide import PLACE_M, Body, Floor, Go, Trip, Wait, remedy_of_lost
from appliance.floor.decisions import NAME, Refusal, WayCase, begun, decided, map_of
from appliance.floor.mover import Mover
from appliance.floor.settings import FloorConfig
from appliance.floor.sight import Sight
from appliance.floor.trips import follow_mps, goto_args, trip_of
from appliance.model import RobotCommand, RobotInfo, RobotReply, Site, encode, keyspace
from appliance.model.floor import FloorState, Point
from appliance.model.plane_api import MOST_PARTS
from appliance.plane.leases import Claim, GrantCase, Lease
from appliance.plane.node import Plane

log = structlog.get_logger(__name__)

KEY = "floor"
"""What all reservations are parts of."""
TTL_S = 10.0
RENEW_S = 1.0
WATCH_S = 0.2
"""How often positions are looked at."""
RETRY_S = 0.5
"""How often a robot that waits asks again."""
SAY_S = 2.0
"""How often what is said of a robot is said again."""
NOTE_S = 5.0
"""How often a run says again what it waits for."""
STOP_S = 15.0
"""How long a robot may take to stand once it was stopped."""
AT_M = 0.15
"""A robot that is seen so near to the end of a stretch has arrived there."""
_LEAST_S = 0.1
"""What is left to follow at least."""
_LAST_S = 1.5
"""A robot is stopped so long before its reservation ends."""

Send = Callable[[RobotCommand], Awaitable[RobotReply]]


class FloorKeeper:
    """The floor as one gateway sees it, and the robots that it moves there.

    Args:
        plane: the fleet.
        site: the map.
        config: section `[floor]`.
        voters: whether gateways are named that grant leases; without, nothing is reserved.
        takeoff_m: how high a robot takes off where nothing says it.
        hindrance: why a robot may not be commanded just now, "" when it may.
    """

    def __init__(
        self,
        plane: Plane,
        site: Site,
        config: FloorConfig,
        *,
        voters: bool,
        takeoff_m: float,
        hindrance: Callable[[str], str] = lambda _: "",
    ) -> None:
        self._plane = plane
        self._site = site
        self._config = config
        self._voters = voters
        self._takeoff_m = takeoff_m
        self._hindrance = hindrance
        self.floor = Floor(site)
        self.map = map_of(site)
        self.sight = Sight(config)
        self._seen: dict[str, object] = {}
        """What was observed last of each robot, to tell news from what is known."""
        self._moving: dict[str, tuple[Mover, str]] = {}
        """The commands in progress here by robot, with the id of what was sent."""
        self._told: dict[str, tuple[object, ...]] = {}
        """What was put last of each robot's refusals and waits: the same is not put again."""
        self._said_at = 0.0
        self._background = Background()
        self._work: asyncio.Task[None] | None = None
        self._closers: list[Callable[[], None]] = []

    @property
    def problem(self) -> str:
        """Why nothing is reserved; "" when all is well."""
        if self._config.enabled and not self._voters:
            return "robots are not kept apart: plane.voters names nobody"
        return ""

    def start(self) -> None:
        """Listen and look."""
        if self._config.enabled and not self._voters:
            log.warning(
                "robots are not kept apart: plane.voters names nobody",
                remedy="name the gateways that grant ways in plane.voters, the same at every gateway",
            )
        if self._config.enabled:
            for problem in self.floor.problems(self._config.radius_m):
                log.warning("the site's map", problem=problem, remedy="correct the places in the site's file")
        session = self._plane.session
        if self._config.tell_decisions and self._voters:
            self._plane.leases.tell(self._tell_grant)

        def gone(message_key: str, deleted: bool) -> None:
            if deleted:
                self.sight.forget(*keyspace.ROBOT.names(message_key))

        removed = session.subscribe(session.keys(keyspace.ROBOT), lambda each: gone(each.key, each.deleted))
        heard = session.subscribe_typed(keyspace.FLOOR, self._on_state)
        self._closers = [removed.close, heard.close]
        self._work = asyncio.create_task(self._look_on(), name="floor")

    async def close(self) -> None:
        """Listen no more; what is reserved ends by itself."""
        for close in self._closers:
            close()
        self._background.cancel()
        if self._work is not None:
            self._work.cancel()
            await asyncio.gather(self._work, return_exceptions=True)

    # --- what is seen -----------------------------------------------------------------------------------------

    def _on_state(self, key: str, state: FloorState | None) -> None:
        if state is None or keyspace.FLOOR.names(key) != (state.robot,):
            return
        if state.robot not in self._moving or self._moving[state.robot][0].go is None:
            self.sight.hear(state, time.monotonic())

    async def _look_on(self) -> None:
        while True:
            try:
                self._look()
                if time.monotonic() - self._said_at >= SAY_S:
                    self._said_at = time.monotonic()
                    for robot in list(self._moving):
                        self._say(robot)
            except Exception:  # supervision boundary: positions must go on being seen
                log.exception("the floor could not be looked at")
            await asyncio.sleep(WATCH_S)

    def _look(self) -> None:
        now = time.monotonic()
        robots = self._plane.registry.robots
        for robot, info in robots.items():
            if self._seen.get(robot) is not info:
                self._seen[robot] = info
                self.sight.observe(info, now)
        for robot in [each for each in self._seen if each not in robots]:
            del self._seen[robot]  # its row is gone; where it stood it may still stand
            self.sight.lost(robot)

    def bodies(self) -> dict[str, Body]:
        """Return all robots as they are seen now."""
        self._look()
        return self.sight.bodies(time.monotonic())

    def _say(self, robot: str) -> None:
        mover, command = self._moving[robot]
        state = mover.state(self._plane.gateway, command, time.monotonic())
        self.sight.hear(state, time.monotonic())
        self._plane.session.publish(keyspace.FLOOR, state, robot)

    def tell_way(self, case: WayCase) -> None:
        """Put a decision for the log, unless it is to wait for the same as before."""
        news = (case.waits_for, case.why, case.way[-1:])
        if self._config.tell_decisions and not (case.why and self._told.get(case.trip.robot) == news):
            self._tell(NAME, case)
        self._told[case.trip.robot] = news

    def _tell_grant(self, case: GrantCase) -> None:
        name, news = f"grant/{case.asked.holder}", (case.holder, case.part)
        if case.asked.key == KEY and (case.granted or self._told.get(name) != news):
            self._tell("grant", case)
        self._told[name] = news

    def _tell(self, what: str, case: WayCase | GrantCase) -> None:
        session = self._plane.session
        session.put(session.keys(keyspace.DECIDED, self._plane.gateway, what), encode(case))

    # --- one command ------------------------------------------------------------------------------------------

    async def drive(
        self,
        robot: str,
        command: RobotCommand,
        *,
        send: Send,
        on_wait: Callable[[str], None],
        on_waited: Callable[[float], None],
    ) -> RobotReply:
        """Carry a command out once its robot has a way; returns the robot's answer.

        Args:
            robot: whose.
            command: as it may be sent.
            send: sends a command and waits for its answer; cancelled, it stops the robot.
            on_wait: told what it waits for.
            on_waited: told for how many seconds it waited, so that they are not counted against the command.

        Raises:
            RobotError: it waited longer than `floor.wait_s`.
            SwiftbotError: as `send`.
        """
        info, body = self._plane.registry.robots.get(robot), self.bodies().get(robot)
        if not self._config.enabled or not self._voters or info is None or body is None:
            return await send(command)
        trip = trip_of(command, info, self._site, task=command.task, takeoff_m=self._takeoff_m)
        if trip is None:
            return await send(command)
        if len(geometry.cells((body.at, *trip.points), body.size)) > MOST_PARTS:
            log.warning("a way is too long to be reserved", robot=robot, command=command.id)
            return await send(command)
        return await _Drive(self, trip, command, send, on_wait, on_waited).run()

    async def claim(self, robot: str, parts: frozenset[str], *, after: int = 0) -> Claim:
        """Reserve parts for a robot; as `Leases.claim`."""
        cleared = self.sight.cleared(time.monotonic()) - {robot}
        return await self._plane.leases.claim(KEY, robot, parts, ttl_s=TTL_S, after=after, cleared=cleared)

    def hinders(self, robot: str) -> str:
        """Return why a robot may not be commanded just now; "" when it may."""
        return self._hindrance(robot)

    def info(self, robot: str) -> RobotInfo | None:
        """Return what a robot says of itself."""
        return self._plane.registry.robots.get(robot)

    @property
    def wait_s(self) -> float:
        """How long a command waits at most."""
        return self._config.wait_s

    def moving(self, robot: str) -> Mover | None:
        """Return the command that moves a robot here, or wants to."""
        found = self._moving.get(robot)
        return found[0] if found is not None else None

    def tell(self, mover: Mover, command: str) -> None:
        """Tell all of a robot; it is told again and again until `ended`."""
        self._moving[mover.trip.robot] = mover, command
        self._say(mover.trip.robot)

    def ended(self, mover: Mover, lease: Lease | None) -> None:
        """A command is over: its robot gives up what it has not reached, once it stands."""
        robot = mover.trip.robot
        mover.go = mover.wait = None
        if self.moving(robot) is mover:
            mover.trip = replace(mover.trip, ticket=0)
            self._say(robot)
            del self._moving[robot]
        if lease is not None:
            self._background.start(self._settle(robot, mover.place, lease), f"{robot} stands")

    async def _settle(self, robot: str, place: str, lease: Lease) -> None:
        give_up = time.monotonic() + STOP_S
        while time.monotonic() < give_up:
            body = self.bodies().get(robot)
            if body is not None and body.fresh and body.stands:
                await self.stand(body, place, lease)
                return
            await asyncio.sleep(WATCH_S)
        log.info("a robot is not seen to stand: its way stays reserved", robot=robot)

    async def stand(self, body: Body, place: str, lease: Lease) -> None:
        """Reserve the ground alone that a robot stands on, until its position speaks for it."""
        parts = geometry.cells((body.at,), body.size)
        if self.floor.capacity.get(place) == 1 and self.floor.is_at(body, place):
            parts |= {f"place/{place}"}
        try:
            await self.claim(body.robot, parts, after=lease.fence)
        except SwiftbotError as error:
            log.info("a way is given up when its time is over", robot=body.robot, reason=str(error))


class _Drive:
    """One command on its way."""

    def __init__(
        self,
        keeper: FloorKeeper,
        trip: Trip,
        command: RobotCommand,
        send: Send,
        on_wait: Callable[[str], None],
        on_waited: Callable[[float], None],
    ) -> None:
        self._keeper = keeper
        self._robot = trip.robot
        self._command = command
        self._send = send
        self._on_wait, self._on_waited = on_wait, on_waited
        self._mover = Mover(keeper.floor, trip)
        self._lease: Lease | None = None
        self._trip = trip
        self._sent = self._yields = self._stretches = 0
        self._joins: str | None = None
        """Id of the command that its robot was on already."""
        self._waited_s = 0.0
        self._followed_s = 0.0
        self._noted, self._noted_at = "", 0.0

    async def run(self) -> RobotReply:
        """Wait for a way, go, and again until the command has ended."""
        try:
            while True:
                step = self._joined()
                step = await self._take_over(step) if step is not None else self._hindered() or await self._reserve()
                if isinstance(step, Wait):
                    await self._pause(step)
                    continue
                if self._noted:
                    self._note("goes on its way")
                reply = await self._go(step)
                if reply is None or (not step.ends and reply.failure is None):
                    continue
                if self._command.verb != "return_home" or self._mover.trip.fixed or reply.failure is not None:
                    return reply
                return await self._send(self._command)
        finally:
            self._keeper.ended(self._mover, self._lease)

    # --- waiting ----------------------------------------------------------------------------------------------

    async def _pause(self, wait: Wait) -> None:
        self._mover.wait = wait
        self._note(wait.why)
        self._keeper.tell(self._mover, self._command.id)
        if self._waited_s >= self._keeper.wait_s:
            other = self._keeper.bodies().get(wait.robot)
            elsewhere = f"order {wait.robot or 'what is in the way'} elsewhere, or raise floor.wait_s"
            raise RobotError(
                f"{self._robot} waited {self._waited_s:.0f} s and did not get its way: it {wait.why}",
                remedy=remedy_of_lost(wait.robot) if other is not None and other.lost else elsewhere,
            )
        began = time.monotonic()
        await asyncio.sleep(RETRY_S)
        passed = time.monotonic() - began
        self._waited_s += passed
        self._on_waited(passed)

    def _note(self, text: str) -> None:
        now = time.monotonic()
        if text != self._noted:
            log.info("robot on the floor", robot=self._robot, task=self._command.task, note=text)
        elif now - self._noted_at < NOTE_S:
            return
        self._noted, self._noted_at = text, now
        self._on_wait(text)

    def _hindered(self) -> Wait | None:
        """Return what keeps it from asking for a way at all."""
        robot, keeper = self._robot, self._keeper
        if why := keeper.hinders(robot):
            return Wait(robot="", why=f"waits for {robot}: {why}")
        body = self._body()
        other = keeper.moving(robot)
        if other is not None and other is not self._mover:
            return Wait(robot="", why=f"waits for {robot}: it does {other.trip.command}")
        if body.moved and body.state is not None and not self._same(body.state):
            return Wait(robot="", why=f"waits for {robot}: it does {body.state.command}")
        if self._command.attempt > 1 and not self._begun and not self._joins and not body.stands:
            return Wait(robot="", why=f"waits for {robot} to stand still")
        return None

    def _same(self, state: FloorState) -> bool:
        return state.command.partition("~")[0] == self._command.id.partition("~")[0]

    async def _reserve(self) -> Go | Wait:
        mover, keeper = self._mover, self._keeper
        mover.begin()
        bodies, now = keeper.bodies(), time.monotonic()
        case, refusals = begun(mover, keeper.map, bodies.values(), now), list[Refusal]()
        step: Go | Wait = mover.ask(bodies, now)
        while isinstance(step, Go):
            try:
                claim = await keeper.claim(self._robot, step.parts)
            except SwiftbotError as error:
                return Wait(robot="", why=f"waits for the gateways that grant ways: {error.message}", way=step.way)
            if claim.lease is not None:
                self._lease = claim.lease
                break
            refusals.append(Refusal(claim.holder, claim.part, claim.ended))
            after = mover.refused(step, claim.holder, claim.part, bodies, now, ended=claim.ended)
            step = after or mover.ask(bodies, now)
        keeper.tell_way(decided(case, step, refusals))
        return step

    def _body(self) -> Body:
        """Return the robot as it is seen; RobotError when an operator has it forgotten meanwhile."""
        body = self._keeper.bodies().get(self._robot)
        if body is None:
            raise RobotError(f"{self._robot} is not known any more", remedy="`swiftbot robots` lists who is")
        return body

    # --- going ------------------------------------------------------------------------------------------------

    @property
    def _begun(self) -> bool:
        """Whether this run has moved the robot."""
        return bool(self._sent or self._yields or self._stretches)

    def _joined(self) -> Go | None:
        """Return the way of a robot that is on it already: another gateway's run, or this one's before a restart."""
        if self._joins is not None or self._begun or self._command.attempt <= 1:
            return None
        floor, body = self._keeper.floor, self._body()
        state = body.state
        if state is None or not self._same(state) or not state.way:
            return None
        joins = body.moved and not body.stands
        if self._trip.reach_m and joins:
            self._joins = state.command  # it is joined once what it can reach is reserved anew
        if len(state.way) < 2:
            return None
        if state.wants and not self._trip.fixed and (joins or math.dist(body.at, state.way[-1]) <= PLACE_M):
            self._mover.goes_on(state.wants)
        if not joins:
            return None
        self._joins = state.command
        way = (body.at, *geometry.still_to_go(state.way, body.at[:2]))
        sweep = geometry.sweep(way, body.size)
        parts = frozenset[str]().union(*(cells for _, cells in sweep))
        if floor.capacity.get(state.place) == 1:
            parts |= {f"place/{state.place}"}
        yields = "~y" in state.command
        return Go(way=way, parts=parts, sweep=sweep, place=state.place, yields=yields, wants=state.wants)

    async def _take_over(self, go: Go) -> Go | Wait:
        """Keep the way of a robot that is on it."""
        try:
            claim = await self._keeper.claim(self._robot, go.parts)
        except SwiftbotError as error:
            log.warning("the way of a robot that moves is not renewed", robot=self._robot, reason=str(error))
            return go
        if claim.lease is None:  # it was silent for long, and another has got its way
            why = f"waits for {claim.holder}, which has its way"
            await self._send(replace(self._command, id=f"{self._command.id}~hold", verb="hold", args={"why": why}))
            return Wait(robot=claim.holder, why=why)
        self._lease = claim.lease
        return go

    def _next(self, go: Go) -> RobotCommand:
        """Return the command for a way; one that does not end where the command ends has an id of its own."""
        command, joins = self._command, self._joins
        if command.verb in ("push", "follow"):
            return self._once_more(command, joins or "")
        if self._trip.fixed:
            return command
        args = goto_args(command, self._trip, go.way)
        goto = replace(command, verb="goto", args=args)
        if joins:
            self._joins = ""
            return replace(goto, id=joins) if joins != command.id else command
        if go.yields:
            self._yields += 1
            return replace(goto, id=f"{command.id}~y{self._yields}")
        if go.wants:
            self._stretches += 1
            return replace(goto, id=f"{command.id}~p{command.attempt}.{self._stretches}")
        self._sent += 1
        if command.verb == "return_home":
            return replace(goto, id=f"{command.id}~h{self._sent}")
        return goto if self._sent == 1 else replace(goto, id=f"{command.id}~{self._sent}")

    def _once_more(self, command: RobotCommand, joins: str) -> RobotCommand:
        """Return a command that begins anew where the robot stands when it was stopped before its end."""
        self._joins, self._sent = "", self._sent + 1
        name = joins or (command.id if self._sent == 1 else f"{command.id}~{self._sent}")
        info = self._keeper.info(self._robot)
        if command.verb == "push" or info is None:
            return replace(command, id=name)
        left = max(_LEAST_S, float(command.args["duration_s"]) - self._followed_s)
        speed = follow_mps(command.args.get("speed_mps"), info)
        return replace(command, id=name, args=command.args | {"duration_s": left, "speed_mps": speed})

    async def _go(self, go: Go) -> RobotReply | None:
        """Go a way that is reserved; None: it was stopped, or the way was not the whole one."""
        keeper, mover = self._keeper, self._mover
        command, began = self._next(go), time.monotonic()
        mover.started(go)
        keeper.tell(mover, command.id)
        sending = asyncio.ensure_future(self._send(command))
        keeping = asyncio.create_task(self._keep(), name=f"floor {self._robot}")
        try:
            while True:
                await asyncio.wait({sending, keeping}, timeout=WATCH_S, return_when=asyncio.FIRST_COMPLETED)
                if sending.done():
                    reply = sending.result()
                    if not go.ends and reply.failure is None:
                        await self._until_it_is_at(go.way[-1])
                    mover.arrived()
                    await self._stand()
                    return reply
                threat = mover.threat(self._body(), keeper.bodies())
                if threat is not None or keeping.done():
                    why = f"{threat.robot}, which is in its way" if threat is not None else keeping.result()
                    mover.wait = Wait(robot=threat.robot if threat is not None else "", why=f"waits for {why}")
                    self._note(mover.wait.why)
                    break
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await self._until_it_stands()
            mover.stopped(self._body().at)
            await self._stand()
            return None
        finally:
            self._followed_s += time.monotonic() - began
            sending.cancel()
            keeping.cancel()
            await asyncio.gather(sending, keeping, return_exceptions=True)

    async def _stand(self) -> None:
        """Give up what is not needed any more; `_keep` is on its way no longer, or has nothing to do."""
        if self._lease is not None:
            await self._keeper.stand(self._body(), self._mover.place, self._lease)

    async def _until_it_is_at(self, end: Point) -> None:
        """Wait until a robot is seen where it says it is: its next way begins where it is seen."""
        for _ in range(round(STOP_S / WATCH_S)):
            body = self._body()
            if body.stands or math.dist(body.at[:2], end[:2]) <= AT_M:
                return
            await asyncio.sleep(WATCH_S)

    async def _until_it_stands(self) -> None:
        for _ in range(round(STOP_S / WATCH_S)):
            if self._body().stands:
                return
            await asyncio.sleep(WATCH_S)

    async def _keep(self) -> str:
        """Renew the reservation and free what is behind; returns, in words, why it cannot be kept."""
        while True:
            await asyncio.sleep(RENEW_S)
            lease, body = self._lease, self._body()
            if lease is None or self._mover.go is None:
                continue
            if self._trip.reach_m:
                if why := await self._keep_around(lease):
                    return why
                continue
            try:
                claim = await self._keeper.claim(self._robot, self._mover.parts(body), after=lease.fence)
            except SwiftbotError as error:
                if lease.left_s <= _LAST_S:
                    return f"the gateways that grant ways: {error.message}"
                continue
            if claim.lease is not None:
                self._lease = claim.lease
            elif claim.holder == self._robot:
                # Another gateway drives it by now: the way is that one's to keep, and the robot heeds it alone.
                self._lease = None
            elif lease.left_s <= _LAST_S:
                return f"{claim.holder}, which has its way"

    async def _keep_around(self, lease: Lease) -> str:
        """Reserve what a robot without a goal can reach now; returns why it must stop, "" when it need not.

        It is stopped at once: what was reserved before is what it can reach until it stands.
        """
        keeper, mover = self._keeper, self._mover
        step = keeper.floor.decide(mover.trip, keeper.bodies())
        if isinstance(step, Wait):
            return step.why.removeprefix("waits for ")
        try:
            claim = await keeper.claim(self._robot, step.parts, after=lease.fence)
            if claim.lease is not None:  # it has what it had as well: that is given up by the next
                mover.go, self._lease = step, claim.lease
                claim = await keeper.claim(self._robot, step.parts, after=claim.lease.fence)
        except SwiftbotError as error:
            return f"the gateways that grant ways: {error.message}"
        if claim.lease is None:
            return f"{claim.holder}, which has its way"
        self._lease = claim.lease
        return ""
