"""What a handler may ask of the appliance while it runs: robot commands, notices, questions to people, files.

Every effect has the id `task/subtask/n`, n being the number of the call within the handler, the same in a
repeated attempt; it is carried out once per id. So a gateway that dies between doing and
telling never doubles an effect.
"""

import asyncio
import base64
import re
import time
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, cast

import msgspec
import structlog
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConflictError, PayloadError, RobotError, SwiftbotError, from_code
from appliance.floor.keeper import FloorKeeper
from appliance.model import Failure, Notice, RobotCommand, RobotReply, encode, keyspace
from appliance.model.keys import check_name
from appliance.model.task_api import ArtifactAsk, ArtifactPiece
from appliance.plane.node import Plane
from appliance.pool.pool import Call
from appliance.robots.limits import CHOSEN
from appliance.robots.sender import send_command
from appliance.tasks.artifacts import ArtifactCopies, Artifacts
from appliance.tasks.enquiries import Enquiries, enquiry_of
from appliance.tasks.placement import waits_for_lost
from appliance.tasks.records import MAX_RUN_S, clean, task_key
from appliance.tasks.together import Together

log = structlog.get_logger(__name__)

Orders = Callable[[str, RobotCommand, frozenset[str], bool], RobotCommand]
Offer = Callable[[Call], Awaitable[dict[str, Any]]]

_NOT_A_NAME = re.compile(r"[^a-z0-9_.-]")
HEARD_S = 0.5
"""How long after a command was cancelled a soft stop may still be on its way here."""
ANSWER_S = 240.0
"""How long people are waited for when a handler does not say."""
LOST_LOOK_S = 1.0
"""How often a command that waits for its answer looks whether its robot is still there."""
BUSY_RETRY_S = 0.5
"""Pause before a busy robot is asked again."""


class Calls:
    """Carries out handlers' calls on one gateway."""

    def __init__(
        self,
        plane: Plane,
        artifacts: Artifacts,
        *,
        copies: ArtifactCopies | None = None,
        on_wait: Callable[[Call, str], None],
        hindrance: Callable[[str], str] = lambda _: "",
        enquiries: Enquiries | None = None,
        floor: FloorKeeper | None = None,
        orders: Orders = lambda _, command, __, ___: command,
    ) -> None:
        """Make them.

        Args:
            plane: the fleet.
            artifacts: files of handlers.
            copies: has each copied to other gateways; None: they stay here alone.
            on_wait: told what a call waits for.
            hindrance: why a robot may not be commanded just now, "" when it may.
            enquiries: takes questions to people.
            floor: keeps robots apart; None: they are moved at once.
            orders: returns an order as it may be sent to a robot, given the arguments that no plan asked for and
                whether an earlier attempt may have begun it; raises a SwiftbotError with the reason when it may not be.
        """
        self._orders = orders
        self._enquiries = enquiries
        self._hindrance = hindrance
        self._floor = floor
        self._plane = plane
        self._artifacts = artifacts
        self._copies = copies
        self._on_wait = on_wait
        self._offered: dict[str, Offer] = {}
        self._together = Together(plane, hindrance=hindrance)

    def offer(self, name: str, answer: Offer) -> None:
        """Have another part of the gateway answer calls of a name."""
        self._offered[name] = answer

    async def __call__(self, call: Call) -> dict[str, Any]:
        """Carry out one call and return its answer; a SwiftbotError is the handler's to see."""
        match call.name:
            case "command":
                return await self._command(call)
            case "command_all":
                return await self._command_all(call)
            case "notify":
                return await self._notify(call)
            case "ask":
                return await self._ask(call)
            case "put_artifact":
                return await self._put(call)
            case "get_artifact":
                return await self._get(call)
            case _ if (offer := self._offered.get(call.name)) is not None:
                return await offer(call)
            case _:
                raise PayloadError(f"a handler asked for {call.name[:40]!r}, which the appliance does not offer")

    async def _command(self, call: Call) -> dict[str, Any]:
        run = call.run
        if run.robot is None:
            raise PayloadError(f"{run.skill} commands a robot but its subtask names none")
        timeout_s = _timeout(call.args.get("timeout_s", 60.0))
        command = _order(call, call.args.get("args") or {})
        # The same id of an earlier attempt: a robot that drives it already is joined, one that has done it answers.
        begun = run.attempt > 1 or run.resume is not None
        deadline = _Deadline(timeout_s)
        while True:
            await self._until_free(call, run.robot, deadline.at)
            # What the robot and its site allow may have changed meanwhile, and so may where it is.
            sent = self._orders(run.robot, command, CHOSEN - run.params.keys(), begun)
            reply = await self._drive(call, run.robot, sent, deadline, begun=begun)
            left = deadline.left_s
            if reply.failure is None:
                return _answer(reply)
            if reply.failure.code == "cancelled" and await self._was_stopped(run.robot):
                # Its task hears of the stop or lease as well, and ends this run; its next attempt does the rest.
                await self._until_free(call, run.robot, deadline.at)
            if reply.failure.code != "busy" or left <= BUSY_RETRY_S:
                raise _error(reply.failure)
            self._on_wait(call, f"waits for {run.robot}: {reply.failure.message}")
            await asyncio.sleep(BUSY_RETRY_S)

    async def _command_all(self, call: Call) -> dict[str, Any]:
        """Have several robots of a joint skill do a verb together: all of them, or none any longer."""
        run = call.run
        given: object = call.args.get("robots")
        robots = (run.robot, *run.others) if run.robot is not None else ()
        if not isinstance(given, dict) or not given or not given.keys() <= {*robots}:
            raise PayloadError(
                f"{run.skill} commands robots that are not its own: {', '.join(robots) or 'it has none'}"
            )
        orders = {robot: _order(call, args) for robot, args in cast("dict[str, object]", given).items()}
        timeout_s = _timeout(call.args.get("timeout_s", 60.0))
        begun = run.attempt > 1 or run.resume is not None

        async def one(robot: str) -> dict[str, Any]:
            sent = self._orders(robot, orders[robot], CHOSEN - run.params.keys(), begun)
            reply = await self._drive(call, robot, sent, _Deadline(timeout_s), begun=begun)
            if reply.failure is not None:
                raise _error(reply.failure)
            return _answer(reply)

        give_up = time.monotonic() + timeout_s
        try:
            return await self._together.run(
                tuple(orders),
                one,
                act=f"{_effect(call)}~{run.attempt}",
                give_up=give_up,
                on_wait=lambda note: self._on_wait(call, note),
            )
        except SwiftbotError:
            for robot in orders:
                if await self._was_stopped(robot, HEARD_S / len(orders)):
                    # As for one robot: its task hears of the stop as well, and its next attempt does the rest.
                    await self._until_free(call, robot, give_up)
            raise

    async def _drive(
        self, call: Call, robot: str, command: RobotCommand, deadline: "_Deadline", *, begun: bool
    ) -> RobotReply:
        """Send a command once its robot has a way, where it moves it; returns the answer."""

        async def send(sent: RobotCommand) -> RobotReply:
            if sent is not command:  # a way of the floor's: held to the same limits
                sent = self._orders(robot, sent, CHOSEN, begun)
            sending = send_command(
                self._plane.session, robot, sent, timeout_s=max(0.1, deadline.left_s),
                doubtful=self._plane.registry.doubtful(robot), on_silence=lambda note: self._on_wait(call, note),
            )  # fmt: skip
            return await self._noting_loss(call, robot, sending)

        if self._floor is None:
            return await send(command)
        return await self._floor.drive(
            robot, command, send=send, on_wait=lambda note: self._on_wait(call, note), on_waited=deadline.extend
        )

    async def _noting_loss(self, call: Call, robot: str, sending: Coroutine[Any, Any, RobotReply]) -> RobotReply:
        """Wait for a robot's answer, and tell when the robot is lost meanwhile, and when it is back."""
        registry = self._plane.registry
        answer = asyncio.ensure_future(sending)
        lost = False
        try:
            while not (await asyncio.wait({answer}, timeout=LOST_LOOK_S))[0]:
                info = registry.robots.get(robot)
                gone = info is None or not info.online
                if gone and not lost:
                    self._on_wait(call, waits_for_lost(robot, info, registry.lost_ns.get(robot)))
                elif lost and not gone:
                    self._on_wait(call, f"{robot} is back")
                lost = gone
            return answer.result()
        finally:
            answer.cancel()

    async def _until_free(self, call: Call, robot: str, give_up: float) -> None:
        """Wait while a robot is stopped or an operator has it; RobotError when that lasts too long."""
        while why := self._hindrance(robot):
            if time.monotonic() >= give_up:
                raise RobotError(f"{robot} is {why}", remedy="the task goes on when that is over")
            self._on_wait(call, f"waits for {robot}: {why}")
            await asyncio.sleep(BUSY_RETRY_S)

    async def _was_stopped(self, robot: str, heard_s: float = HEARD_S) -> bool:
        """Whether a command was ended by a soft stop or a lease, of which the robot may have heard first."""
        until = time.monotonic() + heard_s
        while not self._hindrance(robot):
            if time.monotonic() >= until:
                return False
            await asyncio.sleep(0.02)
        return True

    async def _notify(self, call: Call) -> dict[str, Any]:
        effect = _effect(call)
        to = _NOT_A_NAME.sub("_", str(call.args.get("to", "operator")).lower()).strip("_.-")[:60] or "operator"
        key = keyspace.EFFECT_RECORD.prefix + effect
        version = None
        try:
            version = await self._plane.dht.write(key, encode(_Effect(done=False)), expected=None)
        except ConflictError:
            record = await self._plane.dht.read(key)
            if record is not None and msgspec.json.decode(record.value, type=_Effect).done:
                return {"notice": effect, "repeated": True}
            version = record.version if record else None
        notice = Notice(
            id=effect,
            to=check_name(to, "recipient"),
            text=clean(str(call.args.get("text", "")), 4000),
            task=call.run.task,
            gateway=self._plane.gateway,
            at_ns=time.time_ns(),
        )
        self._plane.session.publish(keyspace.NOTICE, notice, notice.to)
        try:
            await self._plane.dht.write(key, encode(_Effect(done=True)), expected=version)
        except ConflictError:
            log.info("notice was settled by another attempt", effect=effect)
        return {"notice": effect, "to": notice.to}

    async def _ask(self, call: Call) -> dict[str, Any]:
        if self._enquiries is None:
            raise PayloadError("this gateway takes no questions to people")
        args = call.args
        enquiry = enquiry_of(
            _effect(call),
            question=args.get("question"),
            choices=args.get("choices") or [],
            to=args.get("to", "operator"),
            expires_s=_timeout(args.get("timeout_s", ANSWER_S)),
        )
        asked = replace(enquiry, robot=call.run.robot or "")
        answered = await self._enquiries.ask(asked, on_wait=lambda note: self._on_wait(call, note))
        return {"answer": answered.answer or "", "by": answered.by}

    async def _put(self, call: Call) -> dict[str, Any]:
        data = call.args.get("data", b"")
        if isinstance(data, str):
            try:
                data = base64.b64decode(data, validate=True)
            except ValueError as error:
                raise PayloadError(f"the file's bytes are not base64: {error}") from error
        if not isinstance(data, bytes):
            raise PayloadError("put_artifact needs bytes", remedy="encode text first")
        owner = call.run.owner or task_key(call.run.task)
        reference = await self._artifacts.put(
            str(call.args.get("name", "file")),
            data,
            str(call.args.get("media_type", "application/octet-stream")),
            owner=owner,
        )
        if self._copies is not None:
            self._copies.later(reference, owner)
        return cast("dict[str, Any]", msgspec.to_builtins(reference))

    async def _get(self, call: Call) -> dict[str, Any]:
        reference = call.args.get("ref")
        if not isinstance(reference, dict):
            raise PayloadError("get_artifact needs a reference from a result")

        async def ask(member: str, piece: ArtifactAsk) -> ArtifactPiece:
            return await self._plane.rpc.call(member, keyspace.ARTIFACT, piece)

        data = await self._artifacts.get(
            cast("dict[str, Any]", reference),
            ask=ask,
            members=self._plane.members(),
            owner=call.run.owner or task_key(call.run.task),
        )
        return {"data": data}


class _Deadline:
    """When a command is given up; waiting for others on the floor does not count."""

    def __init__(self, timeout_s: float) -> None:
        self.at = time.monotonic() + timeout_s

    @property
    def left_s(self) -> float:
        return self.at - time.monotonic()

    def extend(self, seconds: float) -> None:
        self.at += seconds


def _timeout(value: object) -> float:
    """Seconds a command may take, as a handler says; PayloadError when that is no positive number."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= MAX_RUN_S:
        raise PayloadError(f"timeout_s {str(value)[:40]} is not between 0 and {MAX_RUN_S:g} s")
    return float(value)


class _Effect(Struct):
    done: bool


def _effect(call: Call) -> str:
    return f"{call.run.task}/{call.run.subtask}/{call.number}"


def _order(call: Call, args: object) -> RobotCommand:
    """Return the command that a handler asks for; the same id in each attempt."""
    run, verb = call.run, str(call.args.get("verb", ""))
    if not isinstance(args, dict):
        raise PayloadError(f"the arguments of {verb[:40]!r} are not a table")
    return RobotCommand(
        id=_effect(call),
        verb=verb,
        args=cast("dict[str, Any]", args),
        task=run.task,
        subtask=run.subtask,
        attempt=run.attempt,
    )


def _error(failure: Failure) -> SwiftbotError:
    """Return what a robot could not do as an error."""
    error = from_code(failure.code, failure.message, failure.remedy)
    return RobotError(failure.message, remedy=failure.remedy) if type(error) is SwiftbotError else error


def _answer(reply: RobotReply) -> dict[str, Any]:
    return {**reply.result, "blobs": reply.blobs} if reply.blobs else dict(reply.result)
