"""Missions that are uploaded to the gateway instead of an autopilot: they become plans, and MISSION_START a task.

A ground station uploads to component 191 of a vehicle's system; the mission is then that vehicle's, held by the
gateway, in its store before it is acknowledged. Uploading moves nothing: MAV_CMD_MISSION_START (param1 first item,
param2 last, both 0 for all) hands the plan in as a task, and is accepted when that is durable on its replicas. Items
are asked for one after the other and again while they do not come; what comes late or twice is recognised.

The plan is of the appliance's skills, each item by what it means, none by a model (`plan_of`, pure):

    NAV_WAYPOINT                         goto, or follow_path for several in a row; param1 > 0: and hold so long
    NAV_TAKEOFF, NAV_LAND, NAV_RETURN…   takeoff, land (goto first, where a place is given), return_home
    NAV_LOITER_UNLIM, NAV_LOITER_TIME    goto and hold
    NAV_LOITER_TURNS                     orbit: param1 laps, param3 radius
    NAV_DELAY, CONDITION_DELAY           hold
    DO_CHANGE_SPEED                      speed of the movements after it
    IMAGE_START_CAPTURE                  photograph: param3 pictures, of the place flown to last

Subtasks follow one another in the order of the items. What an item asks and no skill does is refused with the number of
MAVLink's MAV_MISSION_RESULT and a sentence, before anything is flown. Source: MAVLink guide, "Mission Protocol",
"MAV_CMD".
"""

import asyncio
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import PayloadError, SwiftbotError
from appliance.model import Place, Plan, Site, Subtask, Tier, encode, oversize
from appliance.model.site import MAX_EXTENT_M, inside, off_height, off_site, to_site
from appliance.robots.executor import KeyValues
from appliance.robots.mavlink import dialect, statustext
from appliance.robots.mavlink.dialect import Frame, Message, constant, label, make
from appliance.robots.settings import RobotsConfig

# --- plans of missions: pure -----------------------------------------------------------------------------------------

MAX_PICTURES = 10
MAX_LAPS = 20
MAX_HOLD_S = 3600.0
MAX_PATH = 480
"""Characters of one path's text, within what a plan's parameter may have; a longer way is several subtasks."""
DATUM_M = 1.0
"""A point so little under the ground is on it: heights of the map and of satellites differ by as much."""

_WAYPOINT, _TAKEOFF, _LAND, _RETURN = (
    constant(f"MAV_CMD_NAV_{name}") for name in ("WAYPOINT", "TAKEOFF", "LAND", "RETURN_TO_LAUNCH")
)
_LOITER, _LOITER_TURNS, _LOITER_TIME, _DELAY = (
    constant(f"MAV_CMD_NAV_{name}") for name in ("LOITER_UNLIM", "LOITER_TURNS", "LOITER_TIME", "DELAY")
)
_WAIT, _SPEED, _PICTURE = (
    constant(f"MAV_CMD_{name}") for name in ("CONDITION_DELAY", "DO_CHANGE_SPEED", "IMAGE_START_CAPTURE")
)
_SOMEWHERE = frozenset((_WAYPOINT, _LOITER, _LOITER_TURNS, _LOITER_TIME))
_GLOBAL = frozenset(constant(f"MAV_FRAME_{name}") for name in ("GLOBAL", "GLOBAL_INT"))
_RELATIVE = frozenset(constant(f"MAV_FRAME_{name}") for name in ("GLOBAL_RELATIVE_ALT", "GLOBAL_RELATIVE_ALT_INT"))

UNSUPPORTED_FRAME = constant("MAV_MISSION_UNSUPPORTED_FRAME")
UNSUPPORTED = constant("MAV_MISSION_UNSUPPORTED")
INVALID = constant("MAV_MISSION_INVALID")
DENIED = constant("MAV_MISSION_DENIED")
NO_SPACE = constant("MAV_MISSION_NO_SPACE")
_FIRST_PARAM = constant("MAV_MISSION_INVALID_PARAM1")
"""Of param1; those of the other parameters follow."""
_X, _Y, _Z = (constant(f"MAV_MISSION_INVALID_{name}") for name in ("PARAM5_X", "PARAM6_Y", "PARAM7"))
"""Of latitude, longitude and altitude: MAVLink's x is the latitude, which is the site's y."""
_UNSET = 2**31 - 1
"""A latitude or longitude that is not given, in MISSION_ITEM_INT."""


class Item(Struct, frozen=True, kw_only=True):
    """One mission item as it came. `params` are param1 to param4, None for NaN; x and y are degrees times 1e7."""

    command: int
    frame: int
    params: tuple[float | None, float | None, float | None, float | None] = (None, None, None, None)
    x: int = 0
    y: int = 0
    z: float | None = None
    current: int = 0
    autocontinue: int = 1


class UnfitItem(Exception):  # noqa: N818 - what it says
    """A mission cannot be done: `result` is a MAV_MISSION_RESULT."""

    def __init__(self, result: int, message: str) -> None:
        super().__init__(message)
        self.result = result


class _Maker:
    """Collects subtasks, each after the one before."""

    def __init__(self, robot: str, site: Site) -> None:
        self._robot = robot
        self.site = site
        self.subtasks: list[Subtask] = []
        self.here = ""
        """The place flown to last."""
        self.speed: float | None = None
        self._way: list[str] = []

    def add(self, skill: str, **params: object) -> None:
        """Add a subtask."""
        self._go()
        self._append(skill, params)

    def hold(self, seconds: float) -> None:
        """Add a stay; 0: until the next subtask begins."""
        self.add("hold", **({"duration_s": seconds} if seconds > 0 else {}))

    def pass_by(self, place: str) -> None:
        """Add a waypoint; several in a row are one way."""
        if self.speed is not None:
            self._go()
        self._way.append(place)
        self.here = place

    def _go(self) -> None:
        way, self._way = self._way, []
        while way:
            count = _fitting(way)
            leg, way = way[:count], way[count:]
            if len(leg) > 1:
                self._append("follow_path", {"path": "; ".join(leg)})
            else:
                speed = {} if self.speed is None else {"speed_mps": self.speed}
                self._append("goto", {"place": leg[0], **speed})

    def _append(self, skill: str, params: dict[str, object]) -> None:
        after = (self.subtasks[-1].id,) if self.subtasks else ()
        name = f"m{len(self.subtasks) + 1}"
        self.subtasks.append(Subtask(id=name, skill=skill, robot=self._robot, params=params, after=after))

    def done(self) -> tuple[Subtask, ...]:
        """Return all."""
        self._go()
        return tuple(self.subtasks)

    def place(self, number: int, item: Item) -> str:
        """Return an item's position as places are written; UnfitItem when it is none a robot may be sent to."""
        what = f"item {number}"
        z = self.height(number, item)
        x, y, _ = to_site(self.site, item.x / 1e7, item.y / 1e7, 0.0)
        # What latitude and longitude cannot be first: 91 degrees north is no point of any map.
        if abs(item.x) > 90 * 10**7 or max(abs(x), abs(y)) > MAX_EXTENT_M:
            which = _X if abs(item.x) > 90 * 10**7 or abs(y) > MAX_EXTENT_M else _Y
            raise UnfitItem(which, f"{what}: more than {MAX_EXTENT_M / 1e3:g} km from the site")
        spot = Place(x=round(x, 1), y=round(y, 1), z=z)  # satellites are no better
        if (off := off_site(self.site, spot)) is not None:
            which = {"x": _Y, "y": _X, "z": _Z}[off.axis]
            raise UnfitItem(which, f"{what}: ({spot.x:g}, {spot.y:g}) {off.why}")
        for box in self.site.forbidden:
            if inside(box, spot.x, spot.y):
                raise UnfitItem(DENIED, f"{what}: it lies in {box.name}, which is forbidden")
        for box in self.site.obstacles:
            if inside(box, spot.x, spot.y):
                raise UnfitItem(DENIED, f"{what}: it lies inside {box.name}, an obstacle")
        return f"({spot.x:.1f}, {spot.y:.1f}, {spot.z:.1f})"

    def check_circle(self, number: int, item: Item, radius_m: float) -> None:
        """Raise UnfitItem for a circle around an item's position that leaves the site."""
        x, y, _ = to_site(self.site, item.x / 1e7, item.y / 1e7, 0.0)
        for east, north in ((radius_m, 0.0), (0.0, radius_m), (-radius_m, 0.0), (0.0, -radius_m)):
            # To decimetres, as the plan says its middle.
            edge = Place(x=round(x, 1) + east, y=round(y, 1) + north)
            if (off := off_site(self.site, edge)) is not None:
                raise UnfitItem(_FIRST_PARAM + 2, f"item {number}: a circle of {radius_m:g} m {off.why}")

    def height(self, number: int, item: Item, low: float = 0.0) -> float:
        """Return an item's height over the site's ground, metres, at least `low`; UnfitItem when there is none."""
        if item.frame not in _GLOBAL | _RELATIVE:
            name = label("MAV_FRAME", item.frame).removeprefix("MAV_FRAME_")
            raise UnfitItem(UNSUPPORTED_FRAME, f"item {number}: frame {name} is not supported, use GLOBAL_RELATIVE_ALT")
        if item.z is None:
            raise UnfitItem(_Z, f"item {number}: no altitude")
        z = round(item.z if item.frame in _RELATIVE else item.z - self.site.altitude_m, 1)
        if -DATUM_M <= z < 0:
            z = 0.0
        if why := off_height(self.site, z):
            raise UnfitItem(_Z, f"item {number}: it {why}")
        if z < low:
            raise UnfitItem(_Z, f"item {number}: {z:g} m is too low, use at least {low:g} m")
        return z


def _fitting(way: Sequence[str]) -> int:
    """Return how many places of a way fit one subtask's text, at least one."""
    size = count = 0
    for place in way:
        size += len(place) + 2
        if count and size > MAX_PATH:
            break
        count += 1
    return count


def plan_of(items: Sequence[Item], *, robot: str, site: Site, first: int = 0, last: int | None = None) -> Plan:
    """Return the plan that a mission means.

    Args:
        items: in order.
        robot: the vehicle that is to do it.
        site: where it is.
        first: the item to begin with, from 0.
        last: the last one to do; None: to the end.

    Raises:
        UnfitItem: it cannot be done, and why; the first item that cannot be is named.
    """
    if not items:
        raise UnfitItem(INVALID, "the mission is empty")
    last = len(items) - 1 if last is None else last
    if not 0 <= first <= last < len(items):
        raise UnfitItem(INVALID, f"items {first} to {last} of {len(items)} are none")
    maker = _Maker(robot, site)
    for number in range(first, last + 1):
        _take(maker, number, items[number])
    subtasks = maker.done()
    if not subtasks:
        raise UnfitItem(INVALID, "the mission asks for nothing")
    if problem := oversize(len(subtasks)):
        raise UnfitItem(NO_SPACE, f"{problem}: split the mission")
    return Plan(domain="navigation", subtasks=subtasks, tier=Tier.RULES, confidence=1.0)


def _take(maker: _Maker, number: int, item: Item) -> None:
    """Add what one item asks for."""
    if item.command in _SOMEWHERE:
        _go(maker, number, item)
    elif item.command == _TAKEOFF:
        maker.add("takeoff", altitude_m=maker.height(number, item, low=0.5))
    elif item.command == _LAND:
        if (item.x or item.y) and _UNSET not in (item.x, item.y):
            # NaN is the ground, wherever that is.
            ground = item if item.z is not None else replace(item, frame=min(_RELATIVE), z=0.0)
            maker.pass_by(maker.place(number, ground))
        maker.add("land")
    elif item.command == _RETURN:
        maker.add("return_home")
    elif item.command in (_DELAY, _WAIT):
        maker.hold(_number(number, item, 1, low=0.0, high=MAX_HOLD_S))
    elif item.command == _SPEED:
        maker.speed = _number(number, item, 2, low=0.1, high=maker.site.speed_limit_mps)
    elif item.command == _PICTURE:
        if not maker.here:
            raise UnfitItem(UNSUPPORTED, f"item {number}: a picture needs a waypoint before it")
        count = _number(number, item, 3, low=0.0, high=MAX_PICTURES, usual=1.0)
        maker.add("photograph", target=maker.here, count=max(1, round(count)))
    else:
        name = label("MAV_CMD", item.command).removeprefix("MAV_CMD_")
        raise UnfitItem(UNSUPPORTED, f"item {number}: {name} is not supported")


def _go(maker: _Maker, number: int, item: Item) -> None:
    place = maker.place(number, item)
    if item.command == _LOITER_TURNS:
        laps = max(1, round(_number(number, item, 1, low=0.0, high=MAX_LAPS, usual=1.0)))
        radius = max(0.5, abs(_number(number, item, 3, low=-100.0, high=100.0, usual=2.0)) or 2.0)
        maker.check_circle(number, item, radius)
        maker.here = place
        maker.add("orbit", target=place, laps=laps, radius_m=radius)
        return
    maker.pass_by(place)
    hold_s = 0.0
    if item.command != _LOITER:
        hold_s = _number(number, item, 1, low=0.0, high=MAX_HOLD_S, usual=0.0)
    if item.command != _WAYPOINT or hold_s > 0:
        maker.hold(hold_s)


def _number(number: int, item: Item, place: int, *, low: float, high: float, usual: float | None = None) -> float:
    """Return a parameter (7 is the altitude) within bounds; NaN is what is usual, if anything is."""
    value = item.z if place == 7 else item.params[place - 1]
    if value is None:
        value = usual
    if value is None or not math.isfinite(value) or not low <= value <= high:
        raise UnfitItem(
            _FIRST_PARAM + place - 1,
            f"item {number}: param{place} is {'missing' if value is None else f'{value:g}'}, use {low:g} to {high:g}",
        )
    return value


log = structlog.get_logger(__name__)

# --- server ----------------------------------------------------------------------------------------------------------

MISSION_MESSAGES = frozenset(
    (
        "MISSION_COUNT",
        "MISSION_ITEM_INT",
        "MISSION_ITEM",
        "MISSION_REQUEST_LIST",
        "MISSION_REQUEST_INT",
        "MISSION_REQUEST",
        "MISSION_CLEAR_ALL",
        "MISSION_WRITE_PARTIAL_LIST",
        "MISSION_ACK",
    )
)
PREFIX = "mavlink/mission/"
"""Of the held missions in the gateway's store, by robot."""
MAX_UPLOADS = 16
MAX_HELD = 64
"""Robots whose missions are held; the one uploaded longest ago is forgotten first."""
MAX_DONE = 64
"""Senders whose last answer is remembered, since an acknowledgement may be lost."""
MISSION, ALL = 0, 255
"""MAV_MISSION_TYPE: fences and rally points are not taken."""

Reply = Callable[[Message], None]


class _Upload:
    """A mission on its way in."""

    def __init__(self, robot: str, count: int, reply: Reply, now: float) -> None:
        self.robot = robot
        self.count = count
        self.reply = reply
        self.items: list[Item] = []
        self.asked_at = now
        self.tries = 0


class MissionServer:
    """Takes missions, holds them, gives them back.

    Args:
        config: how long an item is waited for, how often it is asked for, and how many there may be.
        site: where missions are.
        store: keeps the missions.
        refused: counters of bad input.
        clock: monotonic seconds.
        problems: what is wrong with a plan; a mission whose plan has problems is refused, since it would never run.
    """

    def __init__(
        self,
        config: RobotsConfig,
        *,
        site: Site,
        store: KeyValues,
        refused: dict[str, int],
        clock: Callable[[], float],
        problems: Callable[[Plan], Sequence[str]] = lambda _: (),
    ) -> None:
        self._config = config
        self._problems = problems
        self._site = site
        self._store = store
        self._refused = refused
        self._clock = clock
        self._held: OrderedDict[str, tuple[Item, ...]] = OrderedDict()
        self._uploads: dict[tuple[int, int], _Upload] = {}
        self._done: OrderedDict[tuple[int, int], tuple[int, int]] = OrderedDict()
        """Sender -> how many items its last mission had, and what it was answered."""
        self._keeping: dict[tuple[int, int], asyncio.Task[None]] = {}

    async def load(self) -> None:
        """Read what was held before a restart."""
        for key, value in await self._store.scan(PREFIX):
            try:
                self._held[key.removeprefix(PREFIX)] = msgspec.json.decode(value, type=tuple[Item, ...])
            except msgspec.DecodeError as error:
                log.warning("a kept mission cannot be read and is dropped", key=key, reason=str(error))
                await self._store.delete(key)

    async def close(self) -> None:
        """Stop; senders without an answer send again."""
        keeping = list(self._keeping.values())
        for task in keeping:
            task.cancel()
        await asyncio.gather(*keeping, return_exceptions=True)
        self._uploads.clear()

    # --- what is asked -----------------------------------------------------------------------------------------

    def take(self, frame: Frame, *, robot: str, reply: Reply) -> None:
        """Take a mission message that is for this gateway; arguments as `CommandServer.take`."""
        message = frame.message
        sender = (frame.system, frame.component)
        kind = int(getattr(message, "mission_type", MISSION))
        if frame.name == "MISSION_ACK":  # the end of a download, or a sender that gives its upload up
            if message.type != dialect.MISSION_OK:
                self._uploads.pop(sender, None)
            return
        if not robot:
            self._say(reply, "missions are a vehicle's: send them to component 191 of its system", statustext.ERROR)
            self._acknowledge(frame, reply, DENIED)
            return
        if kind != MISSION and not (kind == ALL and frame.name == "MISSION_CLEAR_ALL"):
            self._acknowledge(frame, reply, UNSUPPORTED)
            return
        match frame.name:
            case "MISSION_COUNT":
                self._count(frame, robot, reply)
            case "MISSION_ITEM_INT" | "MISSION_ITEM":
                self._item(frame, reply)
            case "MISSION_REQUEST_LIST":
                self._send(frame, reply, "MISSION_COUNT", count=len(self._held.get(robot, ())))
            case "MISSION_REQUEST_INT" | "MISSION_REQUEST":
                self._give(frame, robot, reply)
            case "MISSION_CLEAR_ALL":
                self._begin_keeping(frame, robot, (), reply)
            case _:
                self._acknowledge(frame, reply, UNSUPPORTED)

    def tick(self) -> None:
        """Ask again for what has not come; to be called some twenty times a second."""
        now = self._clock()
        for sender, upload in list(self._uploads.items()):
            if now - upload.asked_at < self._config.ack_timeout_s:
                continue
            upload.tries += 1
            if upload.tries >= self._config.tries:
                del self._uploads[sender]
                self._note("mission_given_up")
                self._say(upload.reply, f"mission: item {len(upload.items)} did not come", statustext.ERROR)
                self._ack(sender, upload.reply, dialect.MISSION_CANCELLED)
            else:
                self._ask(sender, upload, now)

    def request(self, robot: str, parameters: tuple[float, ...]) -> tuple[str, Plan]:
        """Return the instruction and plan that MAV_CMD_MISSION_START means.

        Raises:
            PayloadError: no mission is held for the vehicle, or it cannot be done.
        """
        items = self._held.get(robot, ())
        if not items:
            raise PayloadError(f"no mission is held for {robot or 'nobody'}", remedy="upload one to component 191")
        first, last = (int(each) if math.isfinite(each) else 0 for each in parameters[:2])
        try:
            plan = plan_of(items, robot=robot, site=self._site, first=first, last=last or None)
        except UnfitItem as error:
            raise PayloadError(str(error)) from error
        return f"{robot}: mission of {len(plan.subtasks)} steps, uploaded over MAVLink", plan

    # --- upload ------------------------------------------------------------------------------------------------

    def _count(self, frame: Frame, robot: str, reply: Reply) -> None:
        sender, count = (frame.system, frame.component), int(frame.message.count)
        if sender in self._keeping:
            return  # its last one is being written; it will be answered
        upload = self._uploads.get(sender)
        if upload is not None and (upload.robot, upload.count) == (robot, count) and not upload.items:
            upload.reply = reply
            self._ask(sender, upload, self._clock())  # it did not hear the first request
            return
        if count > self._config.mission_items:
            self._note("mission_refused")
            self._say(
                reply, f"mission: {count} items, at most {self._config.mission_items} are taken", statustext.ERROR
            )
            self._acknowledge(frame, reply, dialect.MISSION_NO_SPACE)
            return
        others = [each for who, each in self._uploads.items() if who != sender]
        if len(others) >= MAX_UPLOADS or any(each.robot == robot for each in others):
            self._note("mission_refused")
            self._say(reply, f"mission: another one for {robot} is being uploaded", statustext.ERROR)
            self._acknowledge(frame, reply, DENIED)
            return
        self._done.pop(sender, None)
        if count == 0:
            self._begin_keeping(frame, robot, (), reply)
            return
        upload = self._uploads[sender] = _Upload(robot, count, reply, self._clock())
        self._ask(sender, upload, self._clock())

    def _item(self, frame: Frame, reply: Reply) -> None:
        sender, number = (frame.system, frame.component), int(frame.message.seq)
        upload = self._uploads.get(sender)
        if upload is None:
            done = self._done.get(sender)
            if sender in self._keeping:
                return
            if done is not None and number == done[0] - 1:
                self._acknowledge(frame, reply, done[1])  # it did not hear the acknowledgement
            else:
                self._note("mission_out_of_order")
                self._acknowledge(frame, reply, dialect.MISSION_SEQUENCE)
            return
        upload.reply = reply
        if number != len(upload.items):
            if number > len(upload.items):
                self._note("mission_out_of_order")
                self._ask(sender, upload, self._clock())
            return  # one that came before
        upload.items.append(_read(frame.message))
        upload.tries = 0
        if len(upload.items) < upload.count:
            self._ask(sender, upload, self._clock())
            return
        del self._uploads[sender]
        try:
            plan = self._plan(upload)
        except UnfitItem as error:
            self._note("mission_refused")
            self._say(reply, f"mission: {error}", statustext.ERROR)
            self._finish(sender, upload.count, error.result)
            self._acknowledge(frame, reply, error.result)
            return
        log.info("mission uploaded", robot=upload.robot, items=upload.count, subtasks=len(plan.subtasks))
        self._begin_keeping(frame, upload.robot, tuple(upload.items), reply)

    def _plan(self, upload: _Upload) -> Plan:
        """Return what a mission means; UnfitItem where that would not run."""
        plan = plan_of(upload.items, robot=upload.robot, site=self._site)
        if problems := self._problems(plan):
            raise UnfitItem(DENIED, problems[0])
        return plan

    def _ask(self, sender: tuple[int, int], upload: _Upload, now: float) -> None:
        upload.asked_at = now
        fields = {"target_system": sender[0], "target_component": sender[1], "seq": len(upload.items)}
        upload.reply(make("MISSION_REQUEST_INT", mission_type=MISSION, **fields))

    def _begin_keeping(self, frame: Frame, robot: str, items: tuple[Item, ...], reply: Reply) -> None:
        """Write (or remove) a mission, then acknowledge it."""
        sender = (frame.system, frame.component)
        if sender in self._keeping:
            return

        async def keep() -> None:
            try:
                if items:
                    await self._store.put(PREFIX + robot, encode(items))
                else:
                    await self._store.delete(PREFIX + robot)
            except SwiftbotError as error:
                self._say(reply, f"mission: {error.message}", statustext.ERROR)
                self._acknowledge(frame, reply, dialect.MISSION_ERROR)
                return
            self._held.pop(robot, None)
            if items:
                self._held[robot] = items
            while len(self._held) > MAX_HELD:
                oldest, _ = self._held.popitem(last=False)
                await self._store.delete(PREFIX + oldest)
            self._finish(sender, len(items), dialect.MISSION_OK)
            self._acknowledge(frame, reply, dialect.MISSION_OK)

        self._uploads.pop(sender, None)
        task = self._keeping[sender] = asyncio.create_task(keep(), name=f"mission of {robot}")
        task.add_done_callback(lambda _: self._keeping.pop(sender, None))

    def _finish(self, sender: tuple[int, int], count: int, result: int) -> None:
        self._done[sender] = (count, result)
        self._done.move_to_end(sender)
        while len(self._done) > MAX_DONE:
            self._done.popitem(last=False)

    # --- download ----------------------------------------------------------------------------------------------

    def _give(self, frame: Frame, robot: str, reply: Reply) -> None:
        items, number = self._held.get(robot, ()), int(frame.message.seq)
        if number >= len(items):
            self._acknowledge(frame, reply, dialect.MISSION_SEQUENCE)
            return
        item = items[number]
        one, two, three, four = (math.nan if each is None else each for each in item.params)
        self._send(
            frame,
            reply,
            "MISSION_ITEM_INT",
            seq=number,
            frame=item.frame,
            command=item.command,
            current=0,
            autocontinue=item.autocontinue,
            param1=one,
            param2=two,
            param3=three,
            param4=four,
            x=item.x,
            y=item.y,
            z=math.nan if item.z is None else item.z,
        )

    # --- answers -----------------------------------------------------------------------------------------------

    def _send(self, asked: Frame, reply: Reply, message: str, /, **fields: Any) -> None:
        targets = {"target_system": asked.system, "target_component": asked.component}
        reply(make(message, mission_type=MISSION, **targets, **fields))

    def _acknowledge(self, frame: Frame, reply: Reply, result: int) -> None:
        kind = int(getattr(frame.message, "mission_type", MISSION))
        self._ack((frame.system, frame.component), reply, result, kind)

    def _ack(self, sender: tuple[int, int], reply: Reply, result: int, kind: int = MISSION) -> None:
        reply(make("MISSION_ACK", target_system=sender[0], target_component=sender[1], type=result, mission_type=kind))

    def _say(self, reply: Reply, text: str, severity: int) -> None:
        for each in statustext.statustext(text, severity):
            reply(each)

    def _note(self, what: str) -> None:
        self._refused[what] = self._refused.get(what, 0) + 1


def _read(message: Message) -> Item:
    """Return the item of a MISSION_ITEM_INT, or of a MISSION_ITEM, whose x and y are degrees."""
    whole = message.get_type() == "MISSION_ITEM_INT"
    x, y = (int(message.x), int(message.y)) if whole else (_e7(message.x), _e7(message.y))
    return Item(
        command=message.command,
        frame=message.frame,
        params=tuple(_finite(getattr(message, f"param{place}")) for place in range(1, 5)),  # pyright: ignore[reportArgumentType]
        x=x,
        y=y,
        z=_finite(message.z),
        current=message.current,
        autocontinue=message.autocontinue,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _e7(degrees: float) -> int:
    return max(-(2**31), min(2**31 - 1, round(degrees * 1e7))) if math.isfinite(degrees) else 0
