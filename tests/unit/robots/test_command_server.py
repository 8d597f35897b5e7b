"""Tasks asked for by MAVLink command: asked once, answered alike, refused with a reason."""

import asyncio
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from appliance.errors import ConfigError, NotFoundError, RefusedError, SwiftbotError
from appliance.model import Failure, Subtask, SubtaskRecord, TaskRecord, TaskRequest, TaskState
from appliance.robots.mavlink.command_server import MAX_AT_WORK, CommandServer, task_number
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.qgc import actions
from appliance.robots.settings import RobotsConfig, Template
from appliance.robots.task_listener import Tasks
from tests.unit.robots.conftest import FakeStore

pytestmark = pytest.mark.anyio

TEMPLATES = (
    Template(id=1, instruction="{robot} photograph the gate", label="Gate"),
    Template(id=2, instruction="film the yard for {2} seconds at {5} {6}"),
)
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, IN_PROGRESS = 0, 1, 2, 3, 5


class Fleet:
    """The fleet's tasks, and what a desk said to the sender."""

    def __init__(self, store: FakeStore) -> None:
        self.store = store
        self.submitted: list[TaskRequest] = []
        self.cancelled: list[str] = []
        self.by: list[str] = []
        self.heard: set[tuple[str, int]] = set()
        self.looked: list[str] = []
        self.records: dict[str, TaskRecord] = {}
        self.error: SwiftbotError | None = None
        self.gate = asyncio.Event()
        self.gate.set()
        self.said: list[Message] = []
        self.refused: dict[str, int] = {}
        self.on_answer: list[Callable[[], None]] = []
        """What the sender does in the very moment of each final answer."""
        self.desk = self.new_desk()

    def new_desk(self) -> CommandServer:
        """Return a desk on the same store, as after a restart."""
        tasks = Tasks(submit=self.submit, cancel=self.cancel_by, look=self.look)
        return CommandServer(TEMPLATES, tasks=tasks, store=self.store, refused=self.refused, reach=self.reach)

    def reach(self, sender: str, system: int) -> Callable[[Message], None] | None:
        """Find a sender of before a restart, once it is heard."""
        return self.said.append if (sender, system) in self.heard else None

    async def look(self, task: str) -> TaskRecord:
        """Tell how a task stands, or raise."""
        self.looked.append(task)
        if self.error is not None:
            raise self.error
        return self.records[task]

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task, or raise."""
        await self.gate.wait()
        if self.error is not None:
            raise self.error
        self.submitted.append(request)
        return TaskRecord(id=request.id, instruction=request.instruction)

    async def cancel_by(self, task: str, by: str) -> TaskRecord:
        """Cancel a task for somebody."""
        self.by.append(by)
        return await self.cancel(task)

    async def cancel(self, task: str) -> TaskRecord:
        """Cancel a task."""
        self.cancelled.append(task)
        return TaskRecord(id=task, instruction="", state=TaskState.CANCELLING)

    def send(
        self,
        *,
        robot: str = "drone_1",
        asker: str = "",
        name: str = "COMMAND_LONG",
        source: tuple[int, int] = (255, 190),
        **fields: Any,
    ) -> None:
        """Send a command."""
        numbers = {f"param{number}": 0.0 for number in range(1, 8)}
        if name == "COMMAND_INT":
            numbers = {f"param{number}": 0.0 for number in range(1, 5)}
            numbers |= {"frame": 0, "current": 0, "autocontinue": 0, "x": 0, "y": 0, "z": 0.0}
        else:
            numbers["confirmation"] = 0
        common = {"target_system": 1, "target_component": 191, "command": 31010}
        (frame,) = Codec(245, 191).read(Codec(*source).pack(make(name, **(common | numbers | fields))))
        assert isinstance(frame, Frame)
        self.desk.take(frame, robot=robot, asker=asker, reply=self._reply)

    def _reply(self, message: Message) -> None:
        self.said.append(message)
        if message.get_type() == "COMMAND_ACK" and message.result != IN_PROGRESS and self.on_answer:
            self.on_answer.pop(0)()

    @property
    def acks(self) -> list[tuple[int, int]]:
        """Result and number of each COMMAND_ACK so far."""
        return [(each.result, each.result_param2) for each in self.said if each.get_type() == "COMMAND_ACK"]

    @property
    def texts(self) -> list[str]:
        """STATUSTEXTs so far."""
        return [str(each.text) for each in self.said if each.get_type() == "STATUSTEXT"]

    async def answered(self, count: int) -> None:
        """Wait for so many answers."""
        async with asyncio.timeout(60):
            while len(self.acks) < count:
                await asyncio.sleep(0)
        for _ in range(3):
            await asyncio.sleep(0)


@pytest.fixture
def fleet(store: FakeStore) -> Fleet:
    """Return a fleet."""
    return Fleet(store)


async def test_a_button_makes_a_task(fleet: Fleet) -> None:
    """IN_PROGRESS, then ACCEPTED with the task's number when it is durable; its text has the vehicle's name."""
    fleet.send(param1=1.0)
    await fleet.answered(2)
    (request,) = fleet.submitted
    assert (request.instruction, request.submitter) == ("drone_1 photograph the gate", "mavlink-255-190")
    assert fleet.acks == [(IN_PROGRESS, 0), (ACCEPTED, task_number(request.id))]


async def test_a_task_is_of_whoever_sent_the_command(fleet: Fleet) -> None:
    """A vehicle's task is its own; one that addresses another vehicle asks about that and not as that."""
    fleet.send(param1=1.0, source=(1, 1), robot="drone_1", asker="drone_1")
    await fleet.answered(2)
    fleet.send(param1=1.0, source=(2, 1), robot="drone_1", asker="drone_2")
    await fleet.answered(4)
    assert [(each.instruction, each.submitter) for each in fleet.submitted] == [
        ("drone_1 photograph the gate", "drone_1"),
        ("drone_1 photograph the gate", "drone_2"),
    ]


async def test_arguments_are_filled_in(fleet: Fleet) -> None:
    """Numbers are written plainly; a COMMAND_INT's place is in degrees."""
    fleet.send(name="COMMAND_INT", robot="", param1=2.0, param2=30.0, x=473977420, y=-85455940)
    await fleet.answered(2)
    assert fleet.submitted[0].instruction == "film the yard for 30 seconds at 47.397742 -8.545594"


async def test_a_repetition_is_answered_alike(fleet: Fleet) -> None:
    """A command with a confirmation count is the same task, while it is handed in, after, and after a restart."""
    fleet.gate.clear()
    fleet.send(param1=1.0)
    await fleet.answered(1)
    fleet.send(param1=1.0, confirmation=1)
    fleet.send(param1=2.0)
    assert [result for result, _ in fleet.acks] == [IN_PROGRESS, IN_PROGRESS, TEMPORARILY_REJECTED]
    fleet.gate.set()
    await fleet.answered(4)
    fleet.send(param1=1.0, confirmation=2)
    await fleet.answered(5)
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    fleet.send(param1=1.0, confirmation=3)
    await fleet.answered(6)
    assert len(fleet.submitted) == 1
    assert fleet.acks[3:] == [(ACCEPTED, task_number(fleet.submitted[0].id))] * 3
    fleet.send(param1=1.0)
    await fleet.answered(8)
    assert len({each.id for each in fleet.submitted}) == 2


async def test_a_crash_before_the_answer(fleet: Fleet) -> None:
    """A gateway that was killed while handing in asks for the very same task when its sender repeats."""
    fleet.gate.clear()
    fleet.send(param1=1.0)
    await fleet.answered(1)
    await fleet.desk.close()
    fleet.gate.set()
    kept = [msgspec.json.decode(value)["task"] for value in fleet.store.values.values()]
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    fleet.send(param1=1.0, confirmation=1)
    await fleet.answered(3)
    assert [each.id for each in fleet.submitted] == kept


@pytest.mark.parametrize(
    ("fields", "robot", "told"),
    [
        ({"param1": 9.0}, "drone_1", "no template 9; known: 1, 2"),
        ({"param1": float("nan")}, "drone_1", "no template nan"),
        ({"param1": float("inf")}, "drone_1", "no template inf"),
        ({"param1": 1.0}, "", "needs a vehicle"),
        ({"param1": 2.0, "param2": float("nan")}, "", "needs a number as param2"),
    ],
)
async def test_what_cannot_be(fleet: Fleet, fields: dict[str, float], robot: str, told: str) -> None:
    """Unknown templates and numbers that are none are DENIED, with a text that says why; repeated, the same again."""
    fleet.send(robot=robot, **fields)
    await fleet.answered(2)
    assert fleet.acks[-1][0] == DENIED
    assert told in "".join(fleet.texts)
    assert fleet.submitted == []
    assert fleet.refused == {"mavlink_request_denied": 1}


async def test_back_pressure_passes(fleet: Fleet) -> None:
    """A fleet that is full rejects for now with the reason; a repetition is tried again and taken."""
    fleet.error = RefusedError("too many tasks")
    fleet.send(param1=1.0)
    await fleet.answered(2)
    assert (fleet.acks[-1][0], fleet.texts) == (TEMPORARILY_REJECTED, ["too many tasks"])
    fleet.error = None
    fleet.send(param1=1.0, confirmation=1)
    await fleet.answered(4)
    assert fleet.acks[-1][0] == ACCEPTED


async def test_other_commands(fleet: Fleet) -> None:
    """What is no request is UNSUPPORTED, and counted."""
    fleet.send(command=400)
    assert fleet.acks == [(UNSUPPORTED, 0)]
    assert fleet.refused == {"command_unsupported": 1}


async def test_cancelling(fleet: Fleet) -> None:
    """MAV_CMD_USER_2 cancels the sender's last task; without one it is DENIED."""
    fleet.send(command=31011)
    await fleet.answered(1)
    assert fleet.acks == [(DENIED, 0)]
    fleet.send(param1=1.0)
    await fleet.answered(3)
    fleet.send(command=31011)
    await fleet.answered(5)
    assert fleet.cancelled == [fleet.submitted[0].id]
    assert fleet.by == ["mavlink-255-190"]
    assert fleet.acks[-1] == (ACCEPTED, task_number(fleet.submitted[0].id))


async def test_two_commands_in_one_burst(fleet: Fleet) -> None:
    """A second command before the first has begun hears that it has to wait, also one that repeats a cancel."""
    fleet.gate.clear()
    fleet.send(param1=1.0)
    fleet.send(param1=1.0, confirmation=1)
    fleet.send(param1=2.0, param2=5.0)
    fleet.gate.set()
    await fleet.answered(4)
    assert sorted(result for result, _ in fleet.acks) == [ACCEPTED, TEMPORARILY_REJECTED, IN_PROGRESS, IN_PROGRESS]
    fleet.said.clear()
    fleet.send(command=31011)
    fleet.send(command=31011, confirmation=1)
    fleet.send(param1=1.0)
    await fleet.answered(4)
    assert sorted(result for result, _ in fleet.acks) == [ACCEPTED, TEMPORARILY_REJECTED, IN_PROGRESS, IN_PROGRESS]
    assert len(fleet.submitted) == len(fleet.cancelled) == 1


async def test_a_crowd_of_senders(fleet: Fleet) -> None:
    """Beyond a bound of requests at work the next senders have to ask again, and are counted; nobody is lost."""
    fleet.gate.clear()
    for system in range(1, MAX_AT_WORK + 4):
        fleet.send(param1=1.0, source=(system, 190))
    await fleet.answered(MAX_AT_WORK + 3)
    assert [result for result, _ in fleet.acks].count(TEMPORARILY_REJECTED) == 3
    assert fleet.refused == {"mavlink_request_rejected": 3}
    fleet.gate.set()
    await fleet.answered(2 * MAX_AT_WORK + 3)
    assert len(fleet.submitted) == MAX_AT_WORK
    assert all(fleet.desk.follows(each.id) for each in fleet.submitted)
    assert not fleet.desk.follows("t-another")


async def test_how_it_goes_on_is_told(fleet: Fleet) -> None:
    """Each change is sent once, long reasons in parts that belong together, and nothing of others' tasks."""
    fleet.send(param1=1.0)
    await fleet.answered(2)
    task = fleet.submitted[0].id
    parts = tuple(SubtaskRecord(subtask=Subtask(id=f"s{number}", skill="goto")) for number in (1, 2))
    running = TaskRecord(id=task, instruction="", state=TaskState.RUNNING, subtasks=parts)
    failure = Failure(code="robot", message="the gripper is jammed – nobody could have known that this would happen")
    for record in (
        running, running, msgspec.structs.replace(running, id="another"),
        msgspec.structs.replace(running, state=TaskState.FAILED, failure=failure), running,
    ):  # fmt: skip
        fleet.desk.news(record)
    first, *rest = [each for each in fleet.said if each.get_type() == "STATUSTEXT"]
    assert first.text == f"{task} running 0/2"
    assert "".join(each.text for each in rest).startswith(f"{task} failed: the gripper is jammed ? nobody")
    assert [each.chunk_seq for each in rest] == [0, 1]
    assert len({each.id for each in rest}) == 1
    assert rest[0].id != 0
    assert rest[0].severity == 3


async def _later(fleet: Fleet, now: float) -> None:
    fleet.desk.tick(now)
    for _ in range(10):
        await asyncio.sleep(0)


async def test_how_it_goes_on_is_told_after_a_restart(fleet: Fleet) -> None:
    """Once its sender is heard again it hears how its task stands, then each change; its end once, over restarts."""
    fleet.send(param1=1.0)
    await fleet.answered(2)
    task = fleet.submitted[0].id
    parts = tuple(SubtaskRecord(subtask=Subtask(id=f"s{number}", skill="goto")) for number in (1, 2))
    fleet.records[task] = TaskRecord(id=task, instruction="", state=TaskState.RUNNING, subtasks=parts)
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    await _later(fleet, 1.0)
    assert fleet.looked == []
    fleet.heard.add(("255-190", 1))
    fleet.error = RefusedError("gw-1 is starting")
    await _later(fleet, 1.5)
    assert fleet.looked == [], "not more than once a second"
    await _later(fleet, 3.0)
    assert (fleet.looked, fleet.texts) == ([task], [])
    fleet.error = None
    await _later(fleet, 5.0)
    assert fleet.texts == [f"{task} running 0/2"]
    assert fleet.desk.follows(task)
    await _later(fleet, 7.0)
    assert len(fleet.looked) == 2
    fleet.desk.news(msgspec.structs.replace(fleet.records[task], state=TaskState.SUCCEEDED))
    assert fleet.texts[1:] == [f"{task} succeeded"]
    await fleet.desk.close()
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    await _later(fleet, 9.0)
    assert len(fleet.looked) == 2, "its end has been told"
    fleet.send(param1=1.0, confirmation=4)
    await fleet.answered(3)
    assert fleet.acks[-1] == (ACCEPTED, task_number(task))


async def test_what_ended_while_the_gateway_was_away_is_told(fleet: Fleet) -> None:
    """The result reaches its sender all the same; a task that nobody knows any more is asked for once."""
    for system, state in ((254, TaskState.SUCCEEDED), (255, None)):
        fleet.send(param1=1.0, source=(system, 190))
        await fleet.answered(2 * (system - 253))
        task = fleet.submitted[-1].id
        if state is not None:
            fleet.records[task] = TaskRecord(id=task, instruction="", state=state)
        fleet.heard.add((f"{system}-190", 1))
    done, gone = (each.id for each in fleet.submitted)
    kept = fleet.store.values["mavlink/request/254-190"]
    fleet.store.values["mavlink/request/no sender"] = kept.replace(done.encode(), b"m-1")

    async def look(task: str) -> TaskRecord:
        fleet.looked.append(task)
        if task == gone:
            raise NotFoundError(f"no task {task}")
        return fleet.records[task]

    fleet.look = look  # type: ignore[method-assign]
    fleet.desk = fleet.new_desk()
    await fleet.desk.load()
    for now in (2.0, 4.0, 6.0):
        await _later(fleet, now)
    assert fleet.texts == [f"{done} succeeded"]
    assert fleet.looked.count(gone) == 1
    assert not fleet.desk.follows(gone)


@pytest.mark.parametrize(
    "templates",
    [
        (Template(id=0, instruction="x"),),
        (Template(id=1, instruction=" "),),
        (Template(id=1, instruction="go to {1}"),),
        (Template(id=1, instruction="go {where}"),),
        (Template(id=1, instruction="x"), Template(id=1, instruction="y")),
    ],
)
def test_templates_that_cannot_be(templates: tuple[Template, ...]) -> None:
    """Impossible numbers, empty texts, places that stand for nothing and double ids are ConfigErrors."""
    with pytest.raises(ConfigError):
        RobotsConfig(templates=templates).check()


def test_buttons_for_a_ground_station() -> None:
    """QGroundControl's file has a button for each template, with its command, component and number."""
    made = msgspec.json.decode(actions(TEMPLATES, component=191))
    assert (made["version"], made["fileType"]) == (1, "MavlinkActions")
    assert [(each["label"], each["mavCmd"], each.get("param1")) for each in made["actions"]] == [
        ("Gate", 31010, 1), ("film the yard for {2} seconds ", 31010, 2), ("Cancel task", 31011, None),
    ]  # fmt: skip
    assert {each["compId"] for each in made["actions"]} == {191}
