"""Tells robots to hold, by the verb `stop` that each answers: whoever carries out its commands ends them and halts."""

import asyncio
from collections.abc import Iterable

import msgspec

from appliance.errors import SwiftbotError
from appliance.model import RobotCommand, RobotReply, encode
from appliance.plane.session import Session
from appliance.robots.commands import UNREADABLE

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
                answer = await session.query(session.keys.command(robot), encode(command), timeout_s=timeout_s)
                reply = msgspec.json.decode(answer, type=RobotReply)
            except SwiftbotError as error:
                return error.message
            except UNREADABLE as error:
                return f"it answered with something else: {error}"
        return reply.failure.message if reply.failure is not None else ""

    said = await asyncio.gather(*(tell(each) for each in names))
    held = tuple(robot for robot, problem in zip(names, said, strict=True) if not problem)
    return held, {robot: problem for robot, problem in zip(names, said, strict=True) if problem}
