"""Tasks asked for in words over MAVLink: each accepted once over a bad link, and answered; nonsense costs nothing."""

import asyncio
import itertools
import random
from collections import Counter

import msgspec
import pytest

from appliance.errors import NotFoundError, RefusedError, SwiftbotError
from appliance.model import (
    Failure,
    Plan,
    Provenance,
    Subtask,
    SubtaskRecord,
    SubtaskState,
    TaskRecord,
    TaskRequest,
    TaskState,
    Tier,
)
from appliance.robots.mavlink.dialect import Codec, Frame, Message, make
from appliance.robots.mavlink.tunnel import GIVE_UP_S, MAX_GOING, MAX_PAYLOAD, PAYLOAD_TYPE, Channel
from appliance.robots.mavlink.tunnel_rpc import Answer, TunnelServer
from appliance.robots.task_listener import Tasks

pytestmark = pytest.mark.anyio


class Air:
    """A gateway's desk, a robot's channel, and a link between them that loses, doubles and reorders."""

    def __init__(self, *, loss: float = 0.0, tasks: bool = True) -> None:
        self.now = 0.0
        self.loss = loss
        self.chance = random.Random(5)  # noqa: S311 - a bad radio, no secret
        self.submitted: Counter[str] = Counter()
        self.requests: list[TaskRequest] = []
        self.error: SwiftbotError | None = None
        self.refused: dict[str, int] = {}
        doors = Tasks(submit=self.submit, cancel=lambda task, _: self.look(task), look=self.look) if tasks else None
        self.desk = TunnelServer(tasks=doors, refused=self.refused, clock=lambda: self.now)
        self.robot = Channel(itertools.count(7).__next__)
        self.codec, self.reader = Codec(1, 192), Codec(245, 191)
        self.up: list[tuple[float, bytes]] = []
        self.down: list[tuple[float, bytes]] = []
        self.answers: list[Answer] = []

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Take a task."""
        if self.error is not None:
            raise self.error
        self.submitted[request.id] += 1
        self.requests.append(request)
        return TaskRecord(id=request.id, instruction=request.instruction, sequence=1)

    async def look(self, task: str) -> TaskRecord:
        """Tell how a task stands."""
        if task not in self.submitted:
            raise NotFoundError(f"no task {task}")
        return TaskRecord(id=task, instruction="", state=TaskState.RUNNING, sequence=3)

    def _send(self, air: list[tuple[float, bytes]], payload: bytes) -> None:
        while self.chance.random() >= self.loss:
            air.append((self.now + self.chance.uniform(0, 0.3), payload))
            if self.chance.random() >= self.loss:
                break

    def _land(self, air: list[tuple[float, bytes]]) -> list[bytes]:
        landed = [payload for at, payload in air if at <= self.now]
        air[:] = [each for each in air if each[0] > self.now]
        self.chance.shuffle(landed)
        return landed

    def frame(self, payload: bytes) -> Frame:
        """Return a payload as the gateway's frame."""
        raw = self.codec.pack(
            make(
                "TUNNEL", target_system=245, target_component=191, payload_type=PAYLOAD_TYPE,
                payload_length=len(payload), payload=list(payload.ljust(MAX_PAYLOAD, b"\0")),
            )
        )  # fmt: skip
        (frame,) = self.reader.read(raw)
        assert isinstance(frame, Frame)
        return frame

    def reply(self, message: Message) -> None:
        """Take what the desk sends."""
        self._send(self.down, bytes(message.payload[: message.payload_length]))

    async def step(self) -> None:
        """Let 50 ms pass."""
        self.now += 0.05
        for payload in self.robot.due(self.now):
            self._send(self.up, payload)
        for payload in self._land(self.up):
            self.desk.take(self.frame(payload), asker="drone_1", reply=self.reply)
        self.desk.tick()
        for payload in self._land(self.down):
            whole = self.robot.take(payload, self.now)
            if whole is not None:
                self.answers.append(msgspec.json.decode(whole, type=Answer))
        for _ in range(3):
            await asyncio.sleep(0)

    async def ask(self, data: bytes) -> Answer:
        """Send a message and return the next answer."""
        before = len(self.answers)
        self.robot.send(data, self.now)
        while len(self.answers) == before:
            await self.step()
            assert self.now < 600
        return self.answers[-1]


def letter(op: str, task: str, instruction: str = "") -> bytes:
    """Return a message."""
    return msgspec.json.encode({"op": op, "id": task, "instruction": instruction})


async def test_a_thousand_tasks_over_a_bad_link() -> None:
    """With a fifth of all frames lost, doubled and reordered, 1,000 tasks are accepted once each, and told so."""
    air = Air(loss=0.2)
    waiting = [f"t{number}" for number in range(1000)]
    while len(air.answers) < 1000:
        while waiting and len(air.robot._going) < 4:
            task = waiting.pop()
            air.robot.send(letter("submit", task, f"look at gate {task} and tell me whether it is shut " * 4), air.now)
        await air.step()
        assert air.now < 3000
    assert air.submitted == Counter(f"t{number}" for number in range(1000))
    assert Counter((each.op, each.id) for each in air.answers) == Counter(
        ("accepted", f"t{number}") for number in range(1000)
    )


async def test_news_until_the_end() -> None:
    """Each change of a task is sent once, also to one that asks to follow it, and nothing after its end."""
    air = Air()
    assert (await air.ask(letter("submit", "t1", "go home"))).op == "accepted"
    assert (await air.ask(letter("follow", "t1"))).state == "running"
    running = TaskRecord(id="t1", instruction="", state=TaskState.RUNNING, sequence=4)
    done = msgspec.structs.replace(running, state=TaskState.SUCCEEDED)
    for record in (running, done, running):
        air.desk.news(record)
    for _ in range(40):
        await air.step()
    assert [each.state for each in air.answers if each.op == "news"] == ["running", "succeeded"]


async def test_the_end_is_told_after_an_outage_with_many_changes() -> None:
    """What changed while a robot was not heard is sent as it stands now: steps on the way do not crowd out the end."""
    air = Air()
    assert (await air.ask(letter("submit", "t1", "go home"))).op == "accepted"
    air.loss = 1.0
    steps = 60
    for done in range(steps + 1):
        subtasks = tuple(
            SubtaskRecord(
                subtask=Subtask(id=f"s{number}", skill="goto"),
                state=SubtaskState.SUCCEEDED if number < done else SubtaskState.WAITING,
            )
            for number in range(steps)
        )
        state = TaskState.SUCCEEDED if done == steps else TaskState.RUNNING
        air.desk.news(TaskRecord(id="t1", instruction="", state=state, subtasks=subtasks, sequence=2 + done))
        for _ in range(10):
            await air.step()
    air.loss = 0.0
    while not (told := [each for each in air.answers if each.op == "news"]) or told[-1].state != "succeeded":
        await air.step()
        assert air.now < 90
    assert [each.done for each in told] == sorted(each.done for each in told)
    assert len(told) <= 3, "what has been overtaken is not told"
    assert not air.desk.follows("t1")


async def test_ends_of_many_tasks_at_once() -> None:
    """More tasks of one robot end in one moment than messages may wait: it hears of each."""
    air = Air()
    names = [f"t{number}" for number in range(3 * MAX_GOING)]
    for name in names:
        await air.ask(letter("submit", name, "go home"))
    for name in names:
        air.desk.news(TaskRecord(id=name, instruction="", state=TaskState.FAILED, sequence=9))
    while len({each.id for each in air.answers if each.op == "news"}) < len(names):
        await air.step()
        assert air.now < 120


async def test_news_of_nobody_are_not_kept() -> None:
    """A robot that is not heard any more costs no memory and no air: when it comes back it asks."""
    air = Air()
    for number in range(20):
        await air.ask(letter("submit", f"t{number}", "go home"))
    air.loss = 1.0
    for number in range(20):
        for done in range(3):
            running = TaskRecord(id=f"t{number}", instruction="", state=TaskState.RUNNING, sequence=3 + done)
            air.desk.news(msgspec.structs.replace(running, failure=Failure(code="x", message=f"step {done}")))
    until = air.now + 2 * GIVE_UP_S + 5.0
    while air.now < until:
        await air.step()
    (sender,) = air.desk._senders.values()
    assert not sender.channel._going
    assert not sender.news


async def test_results_beyond_a_message_are_left_out() -> None:
    """However long the names of subtasks and what is said of a failure: the end of a task fits into a message."""
    air = Air()
    assert (await air.ask(letter("submit", "t1", "go home"))).op == "accepted"
    subtasks = tuple(
        SubtaskRecord(subtask=Subtask(id=f"{number:064}", skill="goto"), result={"n": 1}) for number in range(1000)
    )
    failure = Failure(code="x", message="\x01" * 5000)
    air.desk.news(
        TaskRecord(id="t1", instruction="", state=TaskState.FAILED, subtasks=subtasks, failure=failure, sequence=9)
    )
    while not (told := [each for each in air.answers if each.op == "news"]):
        await air.step()
        assert air.now < 60
    assert told[0].state == "failed"
    assert told[0].total == 1000


@pytest.mark.parametrize("length", [1, 20_000])
async def test_a_refusal_of_any_length_is_told(length: int) -> None:
    """A reason that no message holds is cut; the robot is not left without an answer."""
    air = Air()
    air.error = RefusedError("no" * length, remedy="wait" * length)
    answer = await air.ask(letter("submit", "t1", "go"))
    assert (answer.op, answer.code, answer.message[:2], answer.remedy[:4]) == ("rejected", "refused", "no", "wait")


async def test_a_whole_request_comes_with_its_plan() -> None:
    """A structured task is the sender's own, whomever it names, and where its plan came from is not for it to say."""
    air = Air()
    plan = Plan(
        domain="transport",
        subtasks=tuple(Subtask(id=f"s{number}", skill="goto", params={"place": "gate" * 20}) for number in range(30)),
        provenance=Provenance(tier=Tier.RULES),
    )
    request = TaskRequest(instruction="to the gate", id="other", submitter="an operator", plan=plan, priority=7)
    data = msgspec.json.encode({"op": "submit", "id": "t1", "request": request})
    assert len(data) > 2000
    answer = await air.ask(data)
    assert (answer.op, answer.to, answer.id) == ("accepted", "submit", "t1")
    bare = msgspec.structs.replace(plan, provenance=None)
    assert air.requests == [msgspec.structs.replace(request, id="t1", submitter="drone_1", plan=bare)]


@pytest.mark.parametrize(
    "request_",
    [
        b"[]",
        b'"go"',
        b"{}",
        b'{"instruction":"go","priority":99}',
        b'{"instruction":"go","plan":{"subtasks":7}}',
        b'{"instruction":"go","unknown":1}',
        b'{"instruction":"go","plan":{"subtasks":[{"id":"s","skill":"x","params":'
        + b'{"a":' * 2000
        + b"1"
        + b"}" * 2004,
    ],
)
async def test_whole_requests_that_are_none(request_: bytes) -> None:
    """What is no TaskRequest is answered so and counted, however deep; nothing is handed in."""
    air = Air()
    answer = await air.ask(b'{"op":"submit","id":"t1","request":' + request_ + b"}")
    assert (answer.op, answer.code) == ("rejected", "payload")
    assert air.refused == {"tunnel_malformed": 1}
    assert air.requests == []
    assert (await air.ask(letter("submit", "t1", "go"))).op == "accepted"


async def test_each_follower_is_told() -> None:
    """Two that follow one task are both told; one who is refused about it takes nobody's news away."""
    air = Air()
    heard: dict[int, list[bytes]] = {2: [], 3: []}
    said: dict[int, list[bytes]] = {2: [], 3: []}
    channels = {system: Channel(itertools.count(system << 8).__next__) for system in heard}

    async def other(system: int, data: bytes) -> None:
        air.codec = Codec(system, 192)
        channels[system].send(data, air.now)
        for _ in range(12):
            await turn()

    async def turn() -> None:
        air.now += 0.05
        for system, channel in channels.items():
            air.codec = Codec(system, 192)
            for payload in channel.due(air.now):
                air.desk.take(
                    air.frame(payload),
                    reply=lambda message, to=system: said[to].append(bytes(message.payload[: message.payload_length])),
                )
        await asyncio.sleep(0)
        air.desk.tick()
        for system, payloads in said.items():
            while payloads:
                whole = channels[system].take(payloads.pop(0), air.now)
                if whole is not None:
                    heard[system].append(whole)
        for _ in range(3):
            await asyncio.sleep(0)

    await other(2, letter("submit", "t1", "go"))
    await other(3, letter("follow", "t1"))
    air.error = RefusedError("too many tasks")
    await other(3, letter("submit", "t1", "go"))
    await other(3, letter("cancel", "t9"))
    air.desk.news(TaskRecord(id="t1", instruction="", state=TaskState.SUCCEEDED, sequence=9))
    for _ in range(12):
        await turn()
    for system, told in heard.items():
        answers = [msgspec.json.decode(each, type=Answer) for each in told]
        assert [each.state for each in answers if each.op == "news"][-1] == "succeeded", system
    assert not air.desk.follows("t1")
    assert not air.desk.follows("t9")


async def test_refusals_have_their_reason() -> None:
    """What is refused comes back with code, message and whether it may be asked again."""
    air = Air()
    air.error = RefusedError("too many tasks", remedy="wait")
    answer = await air.ask(letter("submit", "t1", "go"))
    assert (answer.op, answer.code, answer.message, answer.remedy, answer.retry) == (
        "rejected", "refused", "too many tasks", "wait", True,
    )  # fmt: skip
    answer = await air.ask(letter("cancel", "t9"))
    assert (answer.op, answer.code, answer.retry) == ("rejected", "not-found", False)
    assert (await Air(tasks=False).ask(letter("submit", "t1", "go"))).message == "this gateway takes no tasks"


@pytest.mark.parametrize(
    "data",
    [b"", b"\xff", b"[1]", b'{"op":"fly","id":"x"}', b'{"op":"submit"}', b"[" * 5000,
     b'{"op":"cancel","id":"%s"}' % (b"x" * 16_000)],
)  # fmt: skip
async def test_messages_that_are_none(data: bytes) -> None:
    """What is no message is answered so and counted; the next one is taken."""
    air = Air()
    answer = await air.ask(data)
    assert (answer.op, answer.code) == ("rejected", "payload")
    assert air.refused == {"tunnel_malformed": 1}
    assert (await air.ask(letter("submit", "t1", "go"))).op == "accepted"


async def test_payloads_that_are_none() -> None:
    """Truncated, foreign and oversize payloads are counted, and many senders cost no more memory than some."""
    air = Air()
    for payload in (b"", b"SB", b"XX\x01\x01" + bytes(12), b"SB\x01\x09" + bytes(12)):
        air.desk.take(air.frame(payload), reply=air.reply)
    assert air.refused["tunnel_malformed"] >= 3
    assert (await air.ask(letter("submit", "t1", "go"))).op == "accepted"
    for system in range(1, 200):
        air.codec = Codec(system, 1)
        air.desk.take(air.frame(b""), reply=air.reply)
    assert len(air.desk._senders) == 64
    # One forgotten for them hears nothing more, and that is not kept either.
    air.desk.news(TaskRecord(id="t1", instruction="", state=TaskState.RUNNING, sequence=3))
    assert not air.desk.follows("t1")
