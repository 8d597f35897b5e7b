"""What is heard on the plane, put into the store: the same for a fleet that is there and for a recorded one.

A live view lets the plane decode, and count what is malformed (`events`); a recorded log comes as keys and bytes
(`hear`).
"""

import time
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import Struct, structs

from appliance.model import (
    Act,
    ContainerInfo,
    ContainerState,
    Enquiry,
    GatewayStatus,
    Lifted,
    LogLine,
    Notice,
    RobotInfo,
    RunEvent,
    SoftStop,
    TaskRecord,
)
from appliance.plane.keys import Keys
from appliance.record.facts import RecorderStatus
from appliance.tui.store import Gateway, Store

Take = Callable[[str, Any], None]


class Door(Struct, frozen=True):
    """Keys of one kind: the expression that matches them, what they carry, and who takes it (None: deleted)."""

    expr: str
    kind: type[Any]
    take: Take


class Hearing:
    """Puts what is heard into a store.

    Args:
        store: where it is kept.
        fleet: whose keys they are.
    """

    def __init__(self, store: Store, fleet: str) -> None:
        self.refused: dict[str, int] = {}
        """Messages that could not be decoded, by kind."""
        self._store = store
        keys = Keys(fleet)
        self.events: tuple[Door, ...] = (
            Door(keys.task(), TaskRecord, self._task),
            Door(keys.run(), RunEvent, self._run),
            Door(keys.notice(), Notice, self._notice),
            Door(keys.log(), LogLine, self._log),
            Door(keys.recorder_status(), RecorderStatus, self._recorder),
            Door(keys.act(), Act, self._act),
            Door(keys.enquiry(), Enquiry, self._enquiry),
            Door(keys.soft_stop(), SoftStop, self._stop),
            Door(keys.lifted(), Lifted, self._lift),
        )
        """What nobody but us keeps the latest of."""
        self.facts: tuple[Door, ...] = (
            Door(keys.status(), GatewayStatus, self._status),
            Door(keys.container(), ContainerInfo, self._container),
            Door(keys.robot(), RobotInfo, self._robot),
        )
        """What a live view takes from the plane's registry instead, which knows of membership too."""
        self._doors = [
            (door.expr.split("/"), door, msgspec.json.Decoder(door.kind)) for door in (*self.events, *self.facts)
        ]

    def hear(self, key: str, payload: bytes, at_ns: int, *, deleted: bool = False) -> bool:
        """Take one message; whether it was for the store. What cannot be decoded is counted in `refused`.

        Args:
            key: where it was put.
            payload: what was put.
            at_ns: when, Unix nanoseconds.
            deleted: whether the key was deleted instead.
        """
        parts = key.split("/")
        for pattern, door, decoder in self._doors:
            if len(pattern) != len(parts) or any(
                each not in ("*", part) for each, part in zip(pattern, parts, strict=True)
            ):
                continue
            self._at_ns = at_ns
            if deleted:
                door.take(key, None)
                return True
            try:
                value = decoder.decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                name = door.kind.__name__
                self.refused[name] = self.refused.get(name, 0) + 1
                return False
            door.take(key, value)
            return True
        return False

    _at_ns = 0

    def _task(self, key: str, record: TaskRecord | None) -> None:
        if record is None:
            self._store.forget_task(key.split("/")[-2])
        else:
            self._store.take_task(record)

    def _run(self, _key: str, event: RunEvent | None) -> None:
        if event is not None:
            self._store.take_run(event, event.at_ns or self._at_ns or time.time_ns())

    def _notice(self, _key: str, notice: Notice | None) -> None:
        if notice is not None:
            self._store.take_notice(notice)

    def _log(self, key: str, line: LogLine | None) -> None:
        if line is not None:
            # Whose log it is the key says; a line's own source may be another gateway that it is about, or nobody.
            self._store.take_log(structs.replace(line, source=key.split("/")[-2]))

    def _act(self, _key: str, act: Act | None) -> None:
        if act is not None:
            self._store.take_act(act)

    def _stop(self, _key: str, stop: SoftStop | None) -> None:
        if stop is not None:
            self._store.take_stops((stop,))

    def _lift(self, _key: str, lifted: Lifted | None) -> None:
        if lifted is not None:
            self._store.take_stops((), (lifted,))

    def _enquiry(self, key: str, enquiry: Enquiry | None) -> None:
        if enquiry is None:
            self._store.enquiries.drop(key.rsplit("/", maxsplit=1)[-1])
        else:
            self._store.enquiries.put(enquiry.id, enquiry)

    def _recorder(self, _key: str, status: RecorderStatus | None) -> None:
        if status is not None:
            self._store.take_recorder(status, time.monotonic())

    def _status(self, key: str, status: GatewayStatus | None) -> None:
        name = key.split("/")[-2]
        if status is None:
            self._store.gateways.drop(name)
            return
        known = self._store.gateways.get(name)
        fresh = Gateway(status=status) if known is None else structs.replace(known, status=status, lost_ns=0)
        self._store.gateways.put(name, fresh)

    def _container(self, key: str, info: ContainerInfo | None) -> None:
        name = "/".join(key.split("/")[-3::2])
        if info is None or info.state is ContainerState.DEAD:
            self._store.containers.drop(name)
        else:
            self._store.containers.put(name, info)

    def _robot(self, key: str, info: RobotInfo | None) -> None:
        name = key.split("/")[-2]
        if info is None:
            self._store.robots.drop(name)
        else:
            self._store.robots.put(name, info)
