"""Tasks that robots ask for on `robot/{id}/task`: what they put, or query, goes to the composition root.

This room knows nothing of tasks, so it only checks, bounds and hands over; what it may ask of the rest of the appliance
is `Tasks`, which the composition root puts in. A put is heard by every gateway of the fleet and answered by none; a
request without an id gets one made of the robot, the text and the publisher's second, so that several gateways that
submit it submit one task. A query goes to one gateway, and its answer is the task's record once that is durable, or the
reason why not. The task is of the robot on whose key it came, whomever it names: what robots may have done
(`safety.robot_tasks`), whose turn it is and who counts as the asker hang on that.
"""

import hashlib
import time
from collections.abc import Awaitable, Callable

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import PayloadError
from appliance.model import Plan, TaskRecord, TaskRequest, encode, keyspace
from appliance.model.keys import check_name
from appliance.plane.session import Closer, Message, Session


class Tasks(Struct, frozen=True):
    """The doors to the fleet's tasks: `submit` returns when the task is durable, `cancel` when it is being stopped.

    `cancel` gets by whom: a vehicle's name, or `mavlink-{system}-{component}` of another speaker. `look`
    returns how a task stands; `submit_of` submits what a robot asked on its own key. All raise SwiftbotErrors.
    """

    submit: Callable[[TaskRequest], Awaitable[TaskRecord]]
    cancel: Callable[[str, str], Awaitable[TaskRecord]]
    look: Callable[[str], Awaitable[TaskRecord]]
    submit_of: Callable[[str, TaskRequest], Awaitable[TaskRecord]] | None = None
    """None: queries of robots are not answered here."""
    problems: Callable[[Plan], tuple[str, ...]] = lambda _: ()
    """What is wrong with a plan, each as a sentence: what has problems here would not run if it was submitted."""


log = structlog.get_logger(__name__)

MAX_BYTES = 64 * 1024
MAX_INSTRUCTION = 4000
_SECOND_NS = 1_000_000_000


class TaskListener:
    """Listens on the robots' task key.

    Args:
        session: this gateway's.
        on_task: given each robot and what it put, on the event loop.
        refused: counters of bad input.
        submit: hands in what a robot asked by query; None: queries are not answered here.
    """

    def __init__(
        self,
        session: Session,
        on_task: Callable[[str, TaskRequest], None],
        refused: dict[str, int] | None = None,
        *,
        submit: Callable[[str, TaskRequest], Awaitable[TaskRecord]] | None = None,
    ) -> None:
        self._session = session
        self._on_task = on_task
        self._submit = submit
        self._closers: list[Closer] = []
        self.refused: dict[str, int] = {} if refused is None else refused

    def start(self) -> None:
        """Begin to listen."""
        key = self._session.keys(keyspace.INTAKE)
        self._closers.append(self._session.subscribe(key, self._heard))
        if self._submit is not None:
            self._closers.append(self._session.serve(key, self._asked))

    def stop(self) -> None:
        """Stop listening."""
        for closer in self._closers:
            closer.close()
        self._closers.clear()

    async def _asked(self, key: str, payload: bytes) -> bytes:
        """Answer a query; errors go to the asker."""
        assert self._submit is not None  # noqa: S101 - only served with one
        try:
            robot, request = read_request(Message(key, payload, False, time.time_ns(), ""))
        except PayloadError:
            self.refused["task_malformed"] = self.refused.get("task_malformed", 0) + 1
            raise
        return encode(await self._submit(robot, request))

    def _heard(self, message: Message) -> None:
        if message.deleted:
            return
        try:
            robot, request = read_request(message)
        except PayloadError as error:
            self.refused["task_malformed"] = self.refused.get("task_malformed", 0) + 1
            log.warning("task of a robot refused", key=message.key, error=str(error))
            return
        self._on_task(robot, request)


def read_request(message: Message) -> tuple[str, TaskRequest]:
    """Return the robot and its checked request, with an id, and as its own; PayloadError when it is none (pure)."""
    robot = check_name(keyspace.INTAKE.names(message.key)[0], "robot")
    if len(message.payload) > MAX_BYTES:
        raise PayloadError(f"a task request of {len(message.payload)} bytes", remedy=f"at most {MAX_BYTES}")
    try:
        request = msgspec.json.decode(message.payload, type=TaskRequest)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:  # the last: nested a thousand deep
        raise PayloadError(f"not a TaskRequest: {error}", remedy='send {"instruction": "..."} as JSON') from error
    if not request.instruction.strip() or len(request.instruction) > MAX_INSTRUCTION:
        raise PayloadError(f"an instruction has 1 to {MAX_INSTRUCTION} characters")
    identity = request.id
    if identity:
        check_name(identity, "task")
    else:
        seed = b"\0".join((robot.encode(), message.payload, str(message.at_ns // _SECOND_NS).encode()))
        identity = f"r-{hashlib.sha256(seed).hexdigest()[:12]}"
    return robot, own(request, identity=identity, submitter=robot)


def own(request: TaskRequest, *, identity: str, submitter: str) -> TaskRequest:
    """Return what a robot asks as its own, whomever it names.

    Where its plan came from is not for it to say: planners here say that, and would bring it into the
    cache of those.
    """
    plan = request.plan
    if plan is not None and plan.provenance is not None:
        plan = msgspec.structs.replace(plan, provenance=None)
    return msgspec.structs.replace(request, id=identity, submitter=submitter, plan=plan)
