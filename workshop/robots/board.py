"""The mission on board of a simulated autopilot: taken in item by item, told again, as the mission protocol has it.

No I/O: messages in, messages out, time passed in. An item that was lost is asked for again by the clock; a sender that
falls silent is given up.
"""

from collections.abc import Callable
from typing import NamedTuple

from appliance.robots.mavlink import dialect
from appliance.robots.mavlink.dialect import Message, make
from workshop.robots.flight import Point

MAX_ITEMS = 700
_REQUEST_AGAIN_S = 0.4
_TRANSFER_S = 8.0

Sender = tuple[int, int]


class MissionItem(NamedTuple):
    """One item as uploaded; `point` in metres of home where it has a position, `where` as it came."""

    command: int
    parameters: tuple[float, float, float, float]
    point: Point
    where: tuple[int, int, float]
    frame: int


class _Transfer:
    """A mission upload in progress."""

    def __init__(self, sender: Sender, count: int, now: float) -> None:
        self.sender = sender
        self.items: list[MissionItem] = []
        self.count = count
        self.asked_at = now
        self.began_at = now


class Board:
    """Mission store of one vehicle.

    Args:
        point: makes metres of home of latitude and longitude (1e-7 degrees), height and frame.
        refuses: says why no mission is taken just now, empty when one is.
        flyable: which commands an item may have.
    """

    def __init__(
        self, point: Callable[[int, int, float, int], Point], refuses: Callable[[], str], flyable: frozenset[int]
    ) -> None:
        self.items: list[MissionItem] = []
        self.fresh = False
        """A mission was taken and nobody has noticed yet."""
        self.says: list[str] = []
        """Warnings that are to be told."""
        self._point = point
        self._refuses = refuses
        self._flyable = flyable
        self._transfer: _Transfer | None = None
        self._taken: tuple[Sender, int] | None = None
        """Sender and length of the last mission taken, to acknowledge it again."""

    def count(self, message: Message, sender: Sender, now: float) -> list[Message]:
        """Take in MISSION_COUNT: an upload begins."""
        if getattr(message, "mission_type", 0) != 0:
            # Fence and rally points: it has none, and an empty list of them is no upload.
            kind = int(message.mission_type)
            return [_ack(sender, dialect.MISSION_OK if message.count == 0 else dialect.MISSION_UNSUPPORTED, kind)]
        if message.count > MAX_ITEMS:
            return [_ack(sender, dialect.MISSION_NO_SPACE)]
        if why := self._refuses():
            self.says.append(why)
            return [_ack(sender, dialect.MISSION_ERROR)]
        if message.count == 0:
            return self.clear(sender)
        self._transfer = _Transfer(sender, message.count, now)
        self._taken = None
        return [self._request(self._transfer)]

    def clear(self, sender: Sender) -> list[Message]:
        """Forget the mission."""
        self.items, self.fresh = [], True
        return [_ack(sender, dialect.MISSION_OK)]

    def item(self, message: Message, sender: Sender, now: float) -> list[Message]:
        """Take in MISSION_ITEM_INT or MISSION_ITEM."""
        transfer = self._transfer
        if transfer is None or transfer.sender != sender:
            if self._taken == (sender, message.seq + 1):
                return [_ack(sender, dialect.MISSION_OK)]
            return [_ack(sender, dialect.MISSION_ERROR)]
        if message.seq != len(transfer.items):
            return []  # a repeat; what is missing is asked for again by the clock
        whole = message.get_type() == "MISSION_ITEM_INT"
        x, y = (message.x, message.y) if whole else (round(message.x * 1e7), round(message.y * 1e7))
        transfer.items.append(
            MissionItem(
                int(message.command),
                (message.param1, message.param2, message.param3, message.param4),
                self._point(x, y, message.z, message.frame),
                (x, y, message.z),
                int(message.frame),
            )
        )
        transfer.asked_at = transfer.began_at = now
        if len(transfer.items) < transfer.count:
            return [self._request(transfer)]
        self._transfer = None
        unknown = [each.command for each in transfer.items if each.command not in self._flyable]
        if unknown:
            self.says.append(f"mission item {dialect.label('MAV_CMD', unknown[0])} not supported")
            return [_ack(sender, dialect.MISSION_UNSUPPORTED)]
        self.items, self.fresh = transfer.items, True
        self._taken = (sender, transfer.count)
        return [_ack(sender, dialect.MISSION_OK)]

    def tell(self, name: str, message: Message, sender: Sender) -> list[Message]:
        """Answer MISSION_REQUEST_LIST, MISSION_REQUEST_INT or MISSION_REQUEST."""
        target = {"target_system": sender[0], "target_component": sender[1]}
        kind = int(getattr(message, "mission_type", 0))
        if name == "MISSION_REQUEST_LIST":
            return [make("MISSION_COUNT", count=len(self.items) if kind == 0 else 0, mission_type=kind, **target)]
        if kind != 0 or not 0 <= message.seq < len(self.items):
            return [_ack(sender, dialect.MISSION_SEQUENCE, kind)]
        item = self.items[int(message.seq)]
        x, y, z = item.where
        one, two, three, four = item.parameters
        fields = {
            "seq": message.seq,
            "frame": item.frame,
            "command": item.command,
            "current": 0,
            "autocontinue": 1,
            "param1": one,
            "param2": two,
            "param3": three,
            "param4": four,
            "z": z,
            "mission_type": 0,
        }
        if name == "MISSION_REQUEST":
            return [make("MISSION_ITEM", x=x / 1e7, y=y / 1e7, **fields, **target)]
        return [make("MISSION_ITEM_INT", x=x, y=y, **fields, **target)]

    def step(self, now: float) -> list[Message]:
        """Ask again for what was lost; give up a sender that is silent."""
        transfer = self._transfer
        if transfer is None:
            return []
        if now - transfer.asked_at > _TRANSFER_S:
            self._transfer = None
            return [_ack(transfer.sender, dialect.MISSION_CANCELLED)]
        if now - transfer.began_at > _REQUEST_AGAIN_S:
            transfer.began_at = now
            return [self._request(transfer)]
        return []

    def _request(self, transfer: _Transfer) -> Message:
        return make(
            "MISSION_REQUEST_INT",
            target_system=transfer.sender[0],
            target_component=transfer.sender[1],
            seq=len(transfer.items),
            mission_type=0,
        )


def _ack(sender: Sender, result: int, kind: int = 0) -> Message:
    return make("MISSION_ACK", target_system=sender[0], target_component=sender[1], type=result, mission_type=kind)
