"""Missions that are uploaded to the gateway instead of an autopilot: they become plans, and MISSION_START a task.

A ground station uploads to component 191 of a vehicle's system; the mission is then that vehicle's, held by the
gateway, in its store before it is acknowledged. Uploading moves nothing: MAV_CMD_MISSION_START (param1 first item,
param2 last, both 0 for all) hands the plan in as a task, and is accepted when that is durable on its replicas. Items
are asked for one after the other and again while they do not come; what comes late or twice is recognised.
Source: MAVLink guide, "Mission Protocol".
"""

import asyncio
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import structlog

from appliance.errors import PayloadError, SwiftbotError
from appliance.model import Plan, Site, encode
from appliance.robots.ledger import KeyValues
from appliance.robots.mavlink import dialect, texts
from appliance.robots.mavlink.dialect import Frame, Message, make
from appliance.robots.mavlink.mission_plan import DENIED, UNSUPPORTED, Item, UnfitItem, plan_of
from appliance.robots.settings import RobotsConfig

log = structlog.get_logger(__name__)

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


class MissionDesk:
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
        """Stop; whoever had no answer sends again."""
        keeping = list(self._keeping.values())
        for task in keeping:
            task.cancel()
        await asyncio.gather(*keeping, return_exceptions=True)
        self._uploads.clear()

    # --- what is asked -----------------------------------------------------------------------------------------

    def take(self, frame: Frame, *, robot: str, reply: Reply) -> None:
        """Take a mission message that is for this gateway; arguments as `RequestDesk.take`."""
        message = frame.message
        sender = (frame.system, frame.component)
        kind = int(getattr(message, "mission_type", MISSION))
        if frame.name == "MISSION_ACK":  # the end of a download, or a sender that gives its upload up
            if message.type != dialect.MISSION_OK:
                self._uploads.pop(sender, None)
            return
        if not robot:
            self._say(reply, "missions are a vehicle's: send them to component 191 of its system", texts.ERROR)
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
                self._say(upload.reply, f"mission: item {len(upload.items)} did not come", texts.ERROR)
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
            self._say(reply, f"mission: {count} items, at most {self._config.mission_items} are taken", texts.ERROR)
            self._acknowledge(frame, reply, dialect.MISSION_NO_SPACE)
            return
        others = [each for who, each in self._uploads.items() if who != sender]
        if len(others) >= MAX_UPLOADS or any(each.robot == robot for each in others):
            self._note("mission_refused")
            self._say(reply, f"mission: another one for {robot} is being uploaded", texts.ERROR)
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
            self._say(reply, f"mission: {error}", texts.ERROR)
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
                self._say(reply, f"mission: {error.message}", texts.ERROR)
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
        for each in texts.statustext(text, severity):
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
