"""Tasks that robots ask this gateway for: whose they are, which are refused, and that each is done once.

A robot asks on its own key, by a message or by a query, or over a MAVLink link. Whatever it says of who it is, a task
on its key is its own. What comes before the task manager is there waits for it, or is refused for now.
"""

import asyncio
from collections.abc import Awaitable, Callable
from typing import NamedTuple

import msgspec
import structlog

from appliance.background import Background
from appliance.errors import RefusedError, SwiftbotError
from appliance.llm.settings import SafetyConfig
from appliance.model import TaskRecord, TaskRequest
from appliance.model.task_api import CancelTaskAsk, TaskAsk
from appliance.plane.node import Plane
from appliance.robots.task_listener import Tasks
from appliance.tasks.endpoints import Questions
from appliance.tasks.records import clean

log = structlog.get_logger(__name__)

MOST_HANDED_IN = 64
"""Tasks of robots on their way at once; a robot that asks faster is refused, and counted."""


class _Desk(NamedTuple):
    """Where tasks are handed in and asked after."""

    submit: Callable[[TaskRequest], Awaitable[TaskRecord]]
    questions: Questions


class RobotTasks:
    """The intake of one gateway; `open` once tasks can be handed in."""

    def __init__(self, plane: Plane, safety: SafetyConfig) -> None:
        self.draining = False
        self._plane = plane
        self._safety = safety
        self._desk: _Desk | None = None
        self._opened = asyncio.Event()
        self._handing_in = Background()

    def doors(self) -> Tasks:
        """What robots may ask of the fleet's tasks."""
        return Tasks(submit=self.submit, cancel=self.cancel, look=self.look, submit_of=self.submit_of)

    def open(self, submit: Callable[[TaskRequest], Awaitable[TaskRecord]], questions: Questions) -> None:
        """Hand in what waits, and what comes.

        Args:
            submit: takes a task; durable when it returns.
            questions: answers for the fleet's tasks.
        """
        self._desk = _Desk(submit, questions)
        self._opened.set()

    def close(self) -> None:
        """Give up what is on its way."""
        self._handing_in.cancel()

    # --- messages ---------------------------------------------------------------------------------------------

    def take(self, robot: str, request: TaskRequest) -> None:
        """A robot wants something: the gateway that owns the robot's key hands it in, so that it is done once."""
        if not self._plane.dht.owns(f"robot/{robot}"):
            return
        if self._handing_in.count >= MOST_HANDED_IN:
            self._refuse(robot, f"{MOST_HANDED_IN} tasks of robots are being handed in")
            return
        self._handing_in.start(self.hand_in(robot, request), f"task of {robot}")

    async def hand_in(self, robot: str, request: TaskRequest) -> None:
        """Hand in what a robot put on its key; nobody waits for an answer."""
        # Robots are heard before the task manager is there.
        await self._opened.wait()
        try:
            await self._submit_own(robot, request)
        except SwiftbotError as error:
            self._refuse(robot, str(error))
        except Exception as error:  # the boundary to what a robot sent: logged, and counted
            log.exception("a robot's task broke", robot=robot)
            self._refuse(robot, f"{type(error).__name__}: {error}")

    def _refuse(self, robot: str, reason: str) -> None:
        self._plane.session.refused["robot task"] = self._plane.session.refused.get("robot task", 0) + 1
        log.warning("a robot's task is refused", robot=robot, reason=reason)

    # --- questions --------------------------------------------------------------------------------------------

    async def submit_of(self, robot: str, request: TaskRequest) -> TaskRecord:
        """Hand in a task that a robot asked for by query; durable when this returns."""
        self._ready()
        return await self._submit_own(robot, request)

    async def submit(self, request: TaskRequest) -> TaskRecord:
        """Hand in a task by MAVLink, whose desks say who asked; durable when this returns."""
        return await self._ready().submit(request)

    async def cancel(self, task: str, by: str) -> TaskRecord:
        """Stop a task for a speaker on a link; a robot whose tasks may do less stops its own alone."""
        questions = self._ready().questions
        if self._safety.robot_tasks != "any" and by in self._plane.registry.robots:
            record = await questions.task(TaskAsk(id=task))
            if record.submitter != by:
                raise RefusedError(
                    f"{task} is not a task of {by} (safety.robot_tasks)", remedy="an operator can stop it"
                )
        return await questions.cancel(CancelTaskAsk(id=task, by=by))

    async def look(self, task: str) -> TaskRecord:
        """How a task stands."""
        return await self._ready().questions.task(TaskAsk(id=task))

    # --- both -------------------------------------------------------------------------------------------------

    async def _submit_own(self, robot: str, request: TaskRequest) -> TaskRecord:
        """Hand in a task as the robot's on whose key it came, whomever it names."""
        if self._safety.robot_tasks != "any" or (request.plan is not None and self._safety.confirm_skills):
            self._check_known(robot)
        return await self._opened_desk().submit(msgspec.structs.replace(request, submitter=robot))

    def _check_known(self, robot: str) -> None:
        """Refuse a task on the key of a robot that nobody knows: it would count as an operator's."""
        if robot not in self._plane.registry.robots:
            raise RefusedError(
                f"there is no robot {clean(robot, 80)} that has told its state, and [safety] holds for robots' tasks",
                remedy="put its state on its key first",
            )

    def _ready(self) -> _Desk:
        if self.draining:
            raise RefusedError(f"{self._plane.gateway} is draining")
        return self._opened_desk()

    def _opened_desk(self) -> _Desk:
        if self._desk is None:
            raise RefusedError(f"{self._plane.gateway} is starting")
        return self._desk
