"""Count how often a task changes rooms on its way through a gateway, from `submit` to its result.

A gateway runs in this process with real containers, a simulated robot and the client that submits run in others. Each
callback of the event loop notes what scheduled it: the callback that ran then, and the calls that were open (`Step`).
Read backwards from the publication of the task's final record, these notes are the one chain of calls and wake-ups that
led to it. Where a wake-up comes from outside the loop, what was sent before it leads on: the last write to a container
whose frame is read, the last publication of a key that is heard, otherwise the task's own question that is answered.

A room is a package of `appliance`, or a module beside the packages. The path changes rooms where it enters another one
by a call or a wake-up; where a call returns to its caller it does not: that room was never left (these are counted
beside). Calls that come back without being waited for (a decision, a look at a table) are no stations of the path.
Modules of the lowest layer (`model`, `background`, ...) are no rooms. What happens
in other processes (containers, the model, the robot) is left out.

    scripts/as_user.sh python scripts/room_changes.py [--all | --json]

It needs the images that `scripts/setup.sh gateway` builds. `--all` prints each function of the path.
"""

# ruff: noqa: SLF001, D102 - it looks into the event loop, and overrides what the loop documents

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import msgspec

from appliance.config import GatewayConfig
from appliance.gateway import Gateway
from appliance.model import TaskRecord, keyspace
from appliance.plane.session import Publishing
from appliance.plane.settings import PlaneConfig
from appliance.pool.settings import PoolConfig
from appliance.ports import free_port

PRODUCT = Path(__file__).resolve().parent.parent / "appliance"
BELOW = {"logs", "process", "ports", "background", "identity", "model", "durable", "errors"}
"""The lowest layer of docs/architecture.md."""
INSTRUCTION = "rover_1 go to charger"


@dataclass(frozen=True)
class Station:
    """A call that is open: its frame and where its code is."""

    frame: int
    room: str
    name: str


@dataclass(eq=False)
class Step:
    """One callback of the event loop."""

    cause: Step | None
    """What ran when it was scheduled; None for what comes from outside: sockets, threads."""
    stack: tuple[Station, ...]
    """The calls that were open then, the outermost first."""
    resumed: tuple[Station, ...] = ()
    """The calls that wait in its asyncio task when it begins."""
    before: Step | None = None
    """The last step of that task."""
    sent: Step | None = None
    """For what comes from outside: the step in which was sent what it answers."""

    @property
    def outside(self) -> bool:
        """Whether it came from outside, and nothing is known of what it answers."""
        return self.cause is None and not self.resumed and self.sent is None


def station(code: CodeType, frame: int) -> Station | None:
    """Name a call within the product; None for others and for the lowest layer."""
    path = Path(code.co_filename)
    if not path.is_relative_to(PRODUCT):
        return None
    parts = path.relative_to(PRODUCT).parts
    room = parts[0].removesuffix(".py")
    return None if room in BELOW else Station(frame, room, f"{'/'.join(parts)}:{code.co_qualname}")


def open_calls(frame: FrameType | None) -> tuple[Station, ...]:
    """List the calls of the product that are open, the outermost first."""
    found: list[Station] = []
    while frame is not None:
        if (here := station(frame.f_code, id(frame))) is not None:
            found.append(here)
        frame = frame.f_back
    return tuple(reversed(found))


def waiting_frames(task: asyncio.Task[Any]) -> list[FrameType]:
    """List the frames of the coroutines that wait in a task, the outermost first."""
    found: list[FrameType] = []
    awaited: Any = task.get_coro()
    while awaited is not None:
        for prefix in ("cr", "ag", "gi"):
            frame = getattr(awaited, f"{prefix}_frame", None)
            if frame is not None:
                found.append(frame)
                awaited = getattr(awaited, f"{prefix}_{'yieldfrom' if prefix == 'gi' else 'await'}", None)
                break
        else:
            break
    return found


def far_end(transport: Any) -> object:
    """Return what a transport leads to: for the pipes of a process the process, otherwise itself."""
    return getattr(transport.get_protocol(), "proc", transport)


class TracedLoop(asyncio.SelectorEventLoop):
    """Event loop whose callbacks know what scheduled them."""

    def __init__(self) -> None:
        super().__init__()
        self.step: Step | None = None
        self.sent: dict[object, Step] = {}
        """The last step in which something was written to a transport or put on a key."""
        self._last: dict[asyncio.Task[Any], Step] = {}

    def here(self) -> Step:
        """Take down where the loop is."""
        return Step(self.step, open_calls(sys._getframe(1)))

    def call_soon(self, callback: Any, *args: Any, context: Any = None) -> Any:
        return super().call_soon(self._run_step, self._note(), callback, args, context=context)

    def call_soon_threadsafe(self, callback: Any, *args: Any, context: Any = None) -> Any:
        step = Step(None, ())
        return super().call_soon_threadsafe(self._run_step, step, callback, args, context=context)

    def call_at(self, when: float, callback: Any, *args: Any, context: Any = None) -> Any:
        return super().call_at(when, self._run_step, self._note(), callback, args, context=context)

    def _note(self) -> Step:
        frame: FrameType | None = sys._getframe(2)
        step = Step(self.step, open_calls(frame))
        while self.step is not None and self.step.cause is None and frame is not None:
            # A message that was heard: what put it leads on.
            message = frame.f_locals.get("message") if frame.f_code.co_name == "deliver" else None
            if message is not None:
                self.step.sent = self.sent.get(message.key)
            frame = frame.f_back
        return step

    def _run_step(self, step: Step, callback: Any, args: tuple[Any, ...]) -> None:
        task = getattr(callback, "__self__", None)
        if isinstance(task, asyncio.Task):
            frames = waiting_frames(task)
            step.resumed = tuple(found for each in frames if (found := station(each.f_code, id(each))) is not None)
            step.before, self._last[task] = self._last.get(task), step
            if frames and frames[-1].f_code.co_name == "_wait_for_data":
                step.sent = self.sent.get(far_end(frames[-1].f_locals["self"]._transport))
        self.step, before = step, self.step
        try:
            callback(*args)
        finally:
            self.step = before


def watch_writes(loop: TracedLoop) -> asyncio.Future[tuple[Step, TaskRecord]]:
    """Note what is written to streams and put on keys; returns where and with what the task ends."""
    ended: asyncio.Future[tuple[Step, TaskRecord]] = loop.create_future()
    write, send = asyncio.StreamWriter.write, Publishing._send

    def noted_write(self: asyncio.StreamWriter, data: bytes) -> None:
        loop.sent[far_end(self.transport)] = loop.here()
        write(self, data)

    def noted_send(self: Publishing, key: str, payload: bytes | None, **options: Any) -> None:
        loop.sent[key] = here = loop.here()
        if keyspace.TASK_UPDATE.match(key) is not None and payload is not None and not ended.done():
            record = msgspec.json.decode(payload, type=TaskRecord)
            if record.state.final:
                ended.set_result((here, record))
        send(self, key, payload, **options)

    asyncio.StreamWriter.write = noted_write
    Publishing._send = noted_send
    return ended


@dataclass
class Visit:
    """A stay of the path in one room."""

    room: str
    returned: bool
    """Whether the path came by the return of a call: to where it had been before."""
    functions: list[str]


def path_to(end: Step) -> list[Visit]:
    """Follow the causes of a step back to what came from outside; returns the stays in rooms from there on."""
    pieces: list[tuple[tuple[Station, bool | None], ...]] = []
    """Stations, and whether each is returned to; None for the one that is woken."""
    stack, step = end.stack, end.cause
    while step is not None:
        # Within a step: from where its task waited back out to what is still open at the end, and into what was called.
        common = 0
        while common < min(len(step.resumed), len(stack)) and step.resumed[common] == stack[common]:
            common += 1
        back = tuple(reversed(step.resumed[max(0, common - 1) :]))
        pieces.append(
            (*((each, None if each is back[0] else True) for each in back), *((each, False) for each in stack[common:]))
        )
        if step.sent is not None:
            stack, step = step.sent.stack, step.sent.cause
        elif step.before is not None and (step.cause is None or step.cause.outside):
            stack, step = step.resumed, step.before  # the answer to what this task asked
        else:
            stack, step = step.stack, step.cause
    visits: list[Visit] = []
    seen: set[Station] = set()
    for each, returned in (station for piece in reversed(pieces) for station in piece):
        if not visits or visits[-1].room != each.room:
            # A wake-up of a call that the path has come through returns to it too: its part ran as a task of its own.
            visits.append(Visit(each.room, each in seen if returned is None else returned, []))
        seen.add(each)
        if visits[-1].functions[-1:] != [each.name]:
            visits[-1].functions.append(each.name)
    return visits


async def traced(folder: Path) -> tuple[list[Visit], TaskRecord]:
    """Run one task on a gateway here; returns its path, and the record it ended with."""
    loop = asyncio.get_running_loop()
    if not isinstance(loop, TracedLoop):
        raise TypeError("it needs a TracedLoop")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = GatewayConfig(
        id="gw-1",
        fleet=f"rooms-{folder.name}",
        data_dir=str(folder / "data"),
        run_dir=str(folder / "run"),
        site="warehouse",
        plane=PlaneConfig(listen=(endpoint,)),
        pool=PoolConfig(capacity=2),
        keep_containers=False,
    )
    gateway = Gateway(config)
    await gateway.start()
    swiftbot = (sys.executable, "-m", "appliance.cli")
    where = ("--fleet", config.fleet, "--connect", endpoint)
    robot = await asyncio.create_subprocess_exec(
        *swiftbot, "sim", "zenoh", "--name", "rover_1", *where, stdout=asyncio.subprocess.DEVNULL
    )
    try:
        async with asyncio.timeout(120):
            while not (gateway.plane.registry.robots and gateway.status().ready):  # noqa: ASYNC110 - two of its parts
                await asyncio.sleep(0.2)
            ended = watch_writes(loop)
            client = await asyncio.create_subprocess_exec(*swiftbot, "submit", INSTRUCTION, "--yes", *where)
            end, record = await ended
            await client.wait()
    finally:
        robot.terminate()
        await robot.wait()
        await gateway.stop(at_once=True)
    return path_to(end), record


def main() -> None:
    """Print the path."""
    with tempfile.TemporaryDirectory(prefix="rooms") as folder, asyncio.Runner(loop_factory=TracedLoop) as runner:
        visits, record = runner.run(traced(Path(folder)))
    changes = sum(not visit.returned for visit in visits[1:])
    if "--json" in sys.argv[1:]:
        found = {"state": record.state, "changes": changes, "visits": [asdict(visit) for visit in visits]}
        print(json.dumps(found, indent=2))
        return
    for visit in visits:
        steps = visit.functions if "--all" in sys.argv[1:] else dict.fromkeys((visit.functions[0], visit.functions[-1]))
        print(f"{'  back to' if visit.returned else 'into':9} {visit.room:8} {' > '.join(steps)}")
    print(f"{record.id} {record.state}: {changes} changes of room, {len(visits) - 1 - changes} returns")


if __name__ == "__main__":
    main()
