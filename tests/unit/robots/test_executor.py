"""Commands: each id once, each actuator one at a time, and callers that do not give up at a lost reply."""

import asyncio
import contextlib
import itertools
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from appliance.errors import ContractError, DeadlineError, PayloadError, RobotError, UnreachableError
from appliance.model import Failure, RobotCommand, RobotReply, encode
from appliance.robots import retry
from appliance.robots.executor import CommandExecutor, Done, IdempotencyLog, Verb
from appliance.robots.sender import send_command
from appliance.robots.verbs import RobotFailure

pytestmark = pytest.mark.anyio

WAY: dict[str, Any] = {"waypoints": [{"x": 1.0, "y": 2.0}]}


def order(identity: str, verb: str = "goto", attempt: int = 1, **args: Any) -> RobotCommand:
    """Make a command of task t, subtask s1."""
    if verb == "goto" and not args:
        args = WAY
    return RobotCommand(id=identity, verb=verb, args=args, task="t", subtask="s1", attempt=attempt)


class Robot:
    """A robot whose verbs end when told to, and which counts what it does."""

    def __init__(self, session: Any, store: Any = None) -> None:
        self.done: list[str] = []
        self.halts = 0
        self.gate = asyncio.Event()
        self.problem: RobotFailure | None = None
        self.stopped = ""
        self.lease = "l"
        self.session = session
        self.refused: dict[str, int] = {}
        self.ledger = IdempotencyLog("r", store)
        self.desk = CommandExecutor(
            "r",
            session=session,
            ledger=self.ledger,
            verbs={
                "goto": Verb(run=self.act("goto"), uses=("base",), resumable=True),
                "hold": Verb(run=self.at_once, uses=("base",), resumable=True, preempts=True),
                "pick": Verb(run=self.act("pick"), uses=("arm",)),
                "state": Verb(run=self.at_once),
            },
            ready=self.ready,
            halt=self.halt,
            refused=self.refused,
            gate=lambda _, command: "" if command.lease == self.lease else self.stopped,
        )

    def act(self, name: str) -> Any:
        """Make a verb that waits for the gate."""

        async def run(args: Any) -> Done:
            await self.gate.wait()
            self.done.append(name)
            return Done({"did": name})

        return run

    async def at_once(self, args: Any) -> Done:  # noqa: ARG002
        """Do a verb at once."""
        return Done({"ok": True})

    def ready(self) -> None:
        """Raise the problem there is."""
        if self.problem is not None:
            raise self.problem

    async def halt(self) -> None:
        """Count halts."""
        self.halts += 1

    async def begin(self, command: RobotCommand) -> "asyncio.Task[RobotReply]":
        """Give a command and let it get under way."""
        task = asyncio.create_task(self.desk.execute(command))
        for _ in range(10):
            await asyncio.sleep(0)
        return task


@pytest.fixture
async def robot(session: Any) -> Robot:
    """Return a robot."""
    return Robot(session)


async def test_a_repeated_id_acts_once(robot: Robot) -> None:
    """The same id during the command joins it, after it gets the stored reply; it is announced once."""
    first = await robot.begin(order("t/s1/1"))
    second = await robot.begin(order("t/s1/1", attempt=2))
    robot.gate.set()
    replies = [await first, await second, await robot.desk.execute(order("t/s1/1", attempt=2))]
    assert replies == [RobotReply(id="t/s1/1", result={"did": "goto"})] * 3
    assert robot.done == ["goto"]
    assert [each.id for each in robot.session.commanded()] == ["t/s1/1"]


async def test_an_overtaken_attempt_is_refused(robot: Robot) -> None:
    """Once a higher attempt was seen, commands of a lower one are refused and do nothing."""
    robot.gate.set()
    await robot.desk.execute(order("t/s1/1", attempt=2))
    reply = await robot.desk.execute(order("t/s1/2", attempt=1))
    assert reply.failure is not None
    assert reply.failure.code == "refused"
    assert robot.done == ["goto"]


async def test_a_busy_actuator_is_refused_as_retryable(robot: Robot) -> None:
    """A second command for the base is refused as busy and not remembered; one for the arm runs beside it."""
    first = await robot.begin(order("t/s1/1"))
    reply = await robot.desk.execute(order("t/s1/2"))
    assert reply.failure is not None
    assert (reply.failure.code, reply.failure.retryable) == ("busy", True)
    assert "busy with goto (t/s1/1)" in reply.failure.message
    pick = await robot.begin(order("t/s1/3", "pick", object="box"))
    robot.gate.set()
    await first
    assert (await pick).failure is None
    assert (await robot.desk.execute(order("t/s1/2"))).failure is None


async def test_a_robot_that_may_not_be_commanded_takes_nothing_up(robot: Robot) -> None:
    """The refusal says who and why, and that it is worth asking again; stopping works, and the lease's own commands."""
    robot.gate.set()
    robot.stopped = "stopped by ann: a person"
    reply = await robot.desk.execute(order("t/s1/1"))
    assert reply.failure is not None
    assert reply.failure.retryable
    assert "stopped by ann: a person" in reply.failure.message
    assert robot.done == []
    assert (await robot.desk.execute(order("t/s1/2", verb="stop"))).failure is None
    assert (await robot.desk.execute(replace(order("by-hand"), lease="l"))).failure is None
    robot.stopped = ""
    assert (await robot.desk.execute(order("t/s1/1"))).failure is None
    assert robot.done == ["goto", "goto"]


async def test_hold_ends_what_the_base_does(robot: Robot) -> None:
    """A hold is done at once, and the goto under way is answered as cancelled."""
    going = await robot.begin(order("t/s1/1"))
    assert (await robot.desk.execute(order("h", "hold"))).failure is None
    failure = (await going).failure
    assert failure is not None
    assert (failure.code, failure.message) == ("cancelled", "ended by hold (h)")
    assert robot.done == []


async def test_stop_ends_one_or_all(robot: Robot) -> None:
    """Stop with an id ends that command, without one every command; the base is brought to rest."""
    going = await robot.begin(order("t/s1/1"))
    picking = await robot.begin(order("t/s1/2", "pick", object="box"))
    reply = await robot.desk.execute(order("x", "stop", id="t/s1/2"))
    assert reply.result == {"stopped": ["t/s1/2"]}
    assert robot.halts == 0
    reply = await robot.desk.execute(order("y", "stop"))
    assert reply.result == {"stopped": ["t/s1/1"]}
    assert robot.halts == 1
    for task in (going, picking):
        failure = (await task).failure
        assert failure is not None
        assert failure.code == "cancelled"


async def test_a_stale_stop_does_not_end_the_next_attempt(robot: Robot) -> None:
    """A stop of an attempt that has been overtaken is refused: the next attempt goes on."""
    going = await robot.begin(order("t/s1/1", attempt=2))
    reply = await robot.desk.execute(order("x", "stop", attempt=1, id="t/s1/1"))
    assert reply.failure is not None
    robot.gate.set()
    assert (await going).failure is None


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (order("a", "fly_to_the_moon"), "refused"),
        (order("b", "land"), "refused"),
        (order("c", "goto", waypoints="home"), "payload"),
        (order("d", "goto", waypoints=[{"x": 1, "y": 2}], altitude=3), "payload"),
        (order("e", "pick"), "payload"),
    ],
)
async def test_bad_commands_say_what_is_wrong(robot: Robot, command: RobotCommand, code: str) -> None:
    """Unknown verbs, verbs it does not have and wrong arguments are answered with a remedy, counted, not taken up."""
    reply = await robot.desk.execute(command)
    assert reply.failure is not None
    assert reply.failure.code == code
    assert reply.failure.remedy
    assert robot.refused == {f"command_{code}": 1}
    assert robot.session.commanded() == []


BOMB = b'{"a":' * 6000 + b"1" + b"}" * 6000
"""Nested deeper than anybody reads."""


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"[1]",
        b'{"verb": "goto"}',
        b'{"id": "", "verb": "goto"}',
        b"\xff",
        b'{"id": "\xff", "verb": "goto"}',
        b'{"id": "1", "verb": "goto", "args": ' + BOMB + b"}",
        b'{"id": "1", "verb": "goto", "attempt": ' + b"9" * 6000 + b"}",
    ],
)
async def test_what_is_no_command_is_a_payload_error(robot: Robot, payload: bytes) -> None:
    """Malformed queries are counted and answered as PayloadError."""
    with pytest.raises(PayloadError):
        await robot.desk.handle("swiftbot/test/robot/r/command", payload)
    assert robot.refused == {"command_malformed": 1}


async def test_a_robot_that_is_not_ready_takes_nothing_up(robot: Robot) -> None:
    """While it is offline commands fail as retryable, and succeed with the same id afterwards."""
    robot.problem = RobotFailure("robot", "offline", retryable=True)
    robot.gate.set()
    assert (await robot.desk.execute(order("t/s1/1"))).failure == Failure(
        code="robot", message="offline", retryable=True
    )
    robot.problem = None
    assert (await robot.desk.execute(order("t/s1/1"))).failure is None


async def test_losing_the_robot_fails_what_is_under_way(robot: Robot) -> None:
    """`fail_all` answers every running command with that failure, and the next attempt does it again."""
    going = await robot.begin(order("t/s1/1"))
    gone = Failure(code="robot", message="gone", retryable=True)
    await robot.desk.fail_all(gone)
    assert (await going).failure == gone
    robot.gate.set()
    assert (await robot.desk.execute(order("t/s1/1", attempt=2))).failure is None
    assert [each.attempt for each in robot.session.commanded()] == [1, 2]


async def test_a_defect_in_a_verb_is_a_failure_not_a_silence(robot: Robot) -> None:
    """An unexpected exception is answered with code internal and frees the actuator."""

    async def broken(args: Any) -> Done:
        raise ZeroDivisionError

    robot.desk.verbs = {"goto": Verb(run=broken, uses=("base",))}
    for identity in ("a", "b"):
        failure = (await robot.desk.execute(order(identity))).failure
        assert failure is not None
        assert failure.code == "internal"


async def test_a_restart_resumes_goals_and_owns_up_to_acts(session: Any, store: Any) -> None:
    """After a restart an interrupted goto is done to its end without a second announcement; a pick is not repeated."""
    before = Robot(session, store)
    going = await before.begin(order("t/s1/1"))
    picking = await before.begin(order("t/s1/2", "pick", object="box"))
    await before.desk.close()
    for task in (going, picking):
        with pytest.raises(UnreachableError):
            await task
    after = Robot(session, store)
    await after.ledger.load()
    after.gate.set()
    assert (await after.desk.execute(order("t/s1/1"))).result == {"did": "goto"}
    failure = (await after.desk.execute(order("t/s1/2", "pick", object="box"))).failure
    assert failure is not None
    assert "outcome is unknown" in failure.message
    assert after.done == ["goto"]
    assert [each.id for each in session.commanded()] == ["t/s1/1", "t/s1/2"]


# --- the caller's side ---------------------------------------------------------------------------------------------


async def test_lost_replies_and_restarts_are_asked_again(session: Any) -> None:
    """A query without an answer and a robot nobody serves for a moment are both asked again with the same id."""
    problems: list[Exception] = [DeadlineError("lost"), UnreachableError("restarting"), DeadlineError("long poll")]

    async def answer(payload: bytes) -> bytes:
        if problems:
            raise problems.pop(0)
        return encode(RobotReply(id="t/s1/1", result={"n": 1}))

    session.answer = answer
    reply = await send_command(session, "r", order("t/s1/1"), timeout_s=5.0)
    assert reply.result == {"n": 1}
    assert len(session.queries) == 4
    assert len(set(session.queries)) == 1


async def test_nobody_answers(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that nobody serves is UnreachableError with the remedy, well before a long deadline."""
    monkeypatch.setattr(retry, "UNREACHABLE_S", 0.3)
    with pytest.raises(UnreachableError, match="swiftbot robots"):
        await send_command(session, "r", order("t/s1/1"), timeout_s=60.0)


@pytest.mark.parametrize("told", [b"hello", b'{"id": "\xff"}', b'{"id": "1", "result": ' + BOMB + b"}"])
async def test_an_answer_that_is_none(told: bytes, session: Any) -> None:
    """Bytes that are no RobotReply are a RobotError."""

    async def answer(payload: bytes) -> bytes:
        return told

    session.answer = answer
    with pytest.raises(RobotError):
        await send_command(session, "r", order("t/s1/1"), timeout_s=1.0)


@pytest.mark.parametrize("how", ["cancel", "deadline"])
async def test_giving_up_stops_the_robot(session: Any, how: str) -> None:
    """A caller that is cancelled, or at its deadline, sends a stop for its command and attempt."""
    seen = asyncio.Event()

    async def answer(payload: bytes) -> bytes:
        command = msgspec.json.decode(payload, type=RobotCommand)
        if command.verb == "stop":
            assert command.args == {"id": "t/s1/1"}
            assert (command.task, command.subtask, command.attempt) == ("t", "s1", 3)
            seen.set()
            return encode(RobotReply(id=command.id))
        await asyncio.sleep(0.05)
        raise DeadlineError("still under way")

    session.answer = answer
    timeout_s = 60.0 if how == "cancel" else 0.2
    task = asyncio.create_task(send_command(session, "r", order("t/s1/1", attempt=3), timeout_s=timeout_s))
    if how == "cancel":
        await asyncio.sleep(0.1)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    else:
        with pytest.raises(DeadlineError):
            await task
    await seen.wait()


async def test_a_robot_that_is_there_and_does_not_answer_breaks_the_contract(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says which robot, which verb, how long and how often; it gets a stop, and has a check."""
    monkeypatch.setattr(retry, "UNREACHABLE_S", 0.5)
    session.alive = True
    with pytest.raises(ContractError, match=r"robot r did not answer goto for \d s \(asked \d times\)") as caught:
        await send_command(session, "r", order("t/s1/1"), timeout_s=60.0)
    assert "swiftbot robots check r" in caught.value.remedy
    await asyncio.sleep(0)
    last = msgspec.json.decode(session.queries[-1], type=RobotCommand)
    assert (last.verb, last.args) == ("stop", {"id": "t/s1/1"})


async def test_a_reply_to_another_command_is_none(session: Any) -> None:
    """A robot that mixes its replies up is not believed."""

    async def answer(payload: bytes) -> bytes:
        return encode(RobotReply(id="t/s1/7"))

    session.answer = answer
    with pytest.raises(ContractError, match="a reply to 't/s1/7'"):
        await send_command(session, "r", order("t/s1/1"), timeout_s=1.0)


async def test_a_robot_that_does_again_what_it_has_done_is_told_so(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its second answer differs from the first: each question was carried out."""
    monkeypatch.setattr(retry, "FIRST_SILENCE_S", 0.1)
    free, done = asyncio.Lock(), itertools.count()

    async def answer(payload: bytes) -> bytes:
        command = msgspec.json.decode(payload, type=RobotCommand)
        if command.verb == "stop":
            return encode(RobotReply(id=command.id))
        async with free:  # one after the other, each as if it was new
            await asyncio.sleep(0.15)
            return encode(RobotReply(id=command.id, result={"turn": next(done)}))

    session.answer = answer
    with pytest.raises(ContractError, match="keeps no replies by command id"):
        await send_command(session, "r", order("t/s1/1"), timeout_s=60.0)
