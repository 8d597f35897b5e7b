"""Commands to robots: the caller's side. Asks until there is an answer, or until `retry` gives the robot up.

`send_command` sends one command and waits for its end, `hold_robot` stops what a task has begun. `tell_to_hold`
broadcasts the verb `stop`, which every robot answers: its executor ends its commands and halts.
"""

import asyncio
import random
from collections.abc import Callable, Iterable

import msgspec
import structlog

from appliance.background import Background
from appliance.errors import ContractError, DeadlineError, RobotError, SwiftbotError, UnreachableError
from appliance.model import Failure, RobotCommand, RobotReply, encode, keyspace
from appliance.plane.session import Session
from appliance.robots.executor import MAX_ID, UNREADABLE
from appliance.robots.retry import Ask, CommandRetry, Done, End, Ending, Wait

log = structlog.get_logger(__name__)

_COUNT_S = 1.0
"""How long those that go by a name have to say that they are there."""
_STOP_TIMEOUT_S = 3.0
_PAST_END_S = 10.0
_MAX_WHY = 300
_stopping = Background()
"""Stops on their way: they outlive the call that gave the command."""


async def send_command(
    session: Session,
    robot: str,
    command: RobotCommand,
    *,
    timeout_s: float,
    doubtful: bool = False,
    on_silence: Callable[[str], None] = lambda _: None,
) -> RobotReply:
    """Give a robot a command and wait for what comes of it.

    The same id is sent again as `retry` says, so a lost query, a restarting gateway and a second caller with the
    same command do no harm. Cancelled, at its deadline, or given up, it tells the robot to stop that command.

    `doubtful`: more than one may go by that name, and each would carry it out. Those that answer are counted first.

    `on_silence`: told in words when the robot has not said a word and is asked again.

    Returns:
        The robot's reply; what the robot could not do is in its `failure` and raises nothing.

    Raises:
        UnreachableError: nobody answers for the robot, and it is not there.
        ContractError: it is there and does not answer, or does again what it has done (docs/robot-contract.md).
        DeadlineError: the command did not end in `timeout_s` seconds.
        RobotError: the answer is no RobotReply.
        SwiftbotError: what else the answering side refused, such as PayloadError.
    """
    if doubtful and (namesakes := await _namesakes(session, robot, command)) is not None:
        return namesakes
    try:
        return await _ask_until(session, robot, command, timeout_s, on_silence)
    except (asyncio.CancelledError, DeadlineError, ContractError):
        _stopping.start(_send_stop(session, robot, command), f"stop {command.id}")
        raise


async def _namesakes(session: Session, robot: str, command: RobotCommand) -> RobotReply | None:
    """Return the refusal of a command that several robots of one name would carry out; None where there is one."""
    if command.verb in ("state", "stop"):
        return None
    asked = RobotCommand(id=f"{command.id[:150]}~who", verb="state")
    count = await session.answerers(session.keys(keyspace.COMMAND, robot), encode(asked), timeout_s=_COUNT_S)
    if count <= 1:
        return None
    session.refuse("namesake robot/*/command", robot=robot, answer=count)
    failure = Failure(
        code="refused",
        message=f"{count} robots answer to the name {robot}, and each would do it",
        remedy="give each a name of its own",
    )
    return RobotReply(id=command.id, failure=failure)


async def _ask_until(
    session: Session, robot: str, command: RobotCommand, timeout_s: float, on_silence: Callable[[str], None]
) -> RobotReply:
    """Ask as `Patience` says; what goes out and comes in is here, when and how often there."""
    loop = asyncio.get_running_loop()
    key, payload = session.keys(keyspace.COMMAND, robot), encode(command)
    live = command.verb in ("state", "stop")
    patience = CommandRetry(loop.time(), timeout_s, live=live, chance=random.random())  # noqa: S311 - no secret
    # A question stays open when the next one is sent: an answer to any of them will do.
    open_: dict[asyncio.Task[bytes], int] = {}
    reply: RobotReply | None = None
    try:
        while True:
            now = loop.time()
            match patience.next(now):
                case Ask():
                    if patience.asks and open_:
                        note = f"no word from {robot} for {patience.silence(now):.0f} s, {command.verb} is asked again"
                        log.warning(note, id=command.id)
                        on_silence(note)
                    # Longer than the policy ever waits: a time that runs out is then the robot's word, not ours.
                    lasts_s = max(0.0, patience.deadline - now) + _PAST_END_S
                    number = patience.asked(now)
                    open_[asyncio.create_task(session.query(key, payload, timeout_s=lasts_s, sign=True))] = number
                case Wait(until):
                    left_s = max(0.0, until - now)
                    if not open_:
                        await asyncio.sleep(left_s)
                        continue
                    done, _ = await asyncio.wait(open_, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
                    # In the order in which they were sent, where several have come.
                    for task in sorted(done, key=lambda each: open_[each]):
                        number = open_.pop(task)
                        try:
                            answer = _read_reply(robot, command, task.result())
                        except DeadlineError:
                            patience.under_way(number, loop.time())
                        except UnreachableError:
                            patience.gone(number, loop.time())
                        else:
                            same = reply is None or reply == answer
                            patience.answered(number, loop.time(), same=same, kept=answer.failure is None)
                            reply = answer if reply is None else reply
                case Done() if reply is not None:
                    return reply
                case End(why):
                    raise await _given_up(session, robot, command, patience, why, timeout_s)
                case _:
                    raise AssertionError("an answer holds that has not come")
    finally:
        for task in open_:
            task.cancel()
        await asyncio.gather(*open_, return_exceptions=True)


def _read_reply(robot: str, command: RobotCommand, answer: bytes) -> RobotReply:
    try:
        reply = msgspec.json.decode(answer, type=RobotReply)
    except UNREADABLE as error:
        raise RobotError(f"{robot} answered {command.verb} with something else: {error}") from error
    if reply.id != command.id:
        raise ContractError(
            f"robot {robot} answered {command.verb} {command.id} with a reply to {reply.id[:MAX_ID]!r}",
            remedy=_check_it(robot),
        )
    return reply


async def _given_up(
    session: Session, robot: str, command: RobotCommand, patience: CommandRetry, why: Ending, timeout_s: float
) -> SwiftbotError:
    """Return the error of a command that is not asked for any more."""
    silent_s = patience.silence(asyncio.get_running_loop().time())
    times = f"{patience.asks} time{'s' if patience.asks != 1 else ''}"
    if why is Ending.LATE:
        remedy = "allow more time"
        if patience.said:
            remedy += (
                f"; it said {patience.said} times that it is under way: if it restarts each time, {_check_it(robot)}"
            )
        return DeadlineError(f"{robot} did not end {command.verb} within {timeout_s:g} s", remedy=remedy)
    if why is Ending.FORGETFUL:
        return ContractError(
            f"robot {robot} carries {command.verb} out again when it is asked again: it keeps no replies by command id",
            remedy=f"answer an id that is known with its reply; {_check_it(robot)}",
        )
    if await session.alive_now(session.keys(keyspace.ROBOT_ALIVE, robot)):
        return ContractError(
            f"robot {robot} did not answer {command.verb} for {silent_s:.0f} s (asked {times}), though it is online",
            remedy=f"restart its program; {_check_it(robot)}",
        )
    return UnreachableError(
        f"no answer from robot {robot} for {silent_s:.0f} s (asked {times}): it is not online",
        remedy="`swiftbot robots` shows who is online; is its gateway up?",
    )


def _check_it(robot: str) -> str:
    return f"`swiftbot robots check {robot}` shows what its program does not do (docs/robot-contract.md)"


async def hold_robot(session: Session, robot: str, *, why: str, identity: str, timeout_s: float = 10.0) -> RobotReply:
    """Make a robot hold where it is: what its base does ends with `why`, and it stays until the next command.

    A vehicle in the air hovers, one on the ground stands. A robot that a pilot or a failsafe has is left to them, and
    the reply says so. Same `identity`: same hold.

    Raises:
        UnreachableError, DeadlineError, RobotError: as `send_command`.
    """
    command = RobotCommand(id=identity, verb="hold", args={"why": why[:_MAX_WHY]})
    return await send_command(session, robot, command, timeout_s=timeout_s)


async def _send_stop(session: Session, robot: str, command: RobotCommand) -> None:
    """Best effort: a robot that cannot be reached now will be told by the operator."""
    stop = msgspec.structs.replace(
        command, id=f"{command.id[:150]}~stop{command.attempt}", verb="stop", args={"id": command.id}
    )
    try:
        key = session.keys(keyspace.COMMAND, robot)
        await session.query(key, encode(stop), timeout_s=_STOP_TIMEOUT_S, sign=True, urgent=True)
    except SwiftbotError as error:
        log.warning("stop not delivered", robot=robot, id=command.id, error=str(error))


TELL_S = 2.0
"""How long a robot may take to say that it holds."""
AT_ONCE = 32


async def tell_to_hold(
    session: Session, robots: Iterable[str], *, act: str, timeout_s: float = TELL_S
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Have robots end what they do and hold; those that said so, and why the others did not.

    Args:
        session: where they are reached.
        robots: by name.
        act: id of the order: told twice by it, a robot does it once.
        timeout_s: how long each may take.
    """
    names = sorted(set(robots))
    room = asyncio.Semaphore(AT_ONCE)

    async def tell(robot: str) -> str:
        command = RobotCommand(id=f"{act}~{robot}"[:200], verb="stop")
        async with room:
            try:
                key, payload = session.keys(keyspace.COMMAND, robot), encode(command)
                answer = await session.query(key, payload, timeout_s=timeout_s, sign=True, urgent=True)
                reply = msgspec.json.decode(answer, type=RobotReply)
            except SwiftbotError as error:
                return error.message
            except UNREADABLE as error:
                return f"it answered with something else: {error}"
        return reply.failure.message if reply.failure is not None else ""

    said = await asyncio.gather(*(tell(each) for each in names))
    held = tuple(robot for robot, problem in zip(names, said, strict=True) if not problem)
    return held, {robot: problem for robot, problem in zip(names, said, strict=True) if problem}
