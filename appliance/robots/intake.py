"""Tasks that robots ask for: what they put on `robot/{id}/task` goes to the composition root.

This room knows nothing of tasks, so it only checks, bounds and hands over. Every gateway of the fleet hears the
put; a request without an id gets one made of the robot, the text and the publisher's second, so that several
gateways that submit it submit one task.
"""

import hashlib
from collections.abc import Callable

import msgspec
import structlog

from appliance.errors import PayloadError
from appliance.model import TaskRequest
from appliance.plane.keys import check_name
from appliance.plane.session import Closer, Message, Session

log = structlog.get_logger(__name__)

MAX_BYTES = 64 * 1024
MAX_INSTRUCTION = 4000
_SECOND_NS = 1_000_000_000


class TaskIntake:
    """Subscribes to the robots' task key; `on_task(robot, request)` is called on the event loop."""

    def __init__(
        self,
        session: Session,
        on_task: Callable[[str, TaskRequest], None],
        refused: dict[str, int] | None = None,
    ) -> None:
        self._session = session
        self._on_task = on_task
        self._closer: Closer | None = None
        self.refused: dict[str, int] = {} if refused is None else refused

    def start(self) -> None:
        """Begin to listen."""
        self._closer = self._session.subscribe(self._session.keys.intake(), self._heard)

    def stop(self) -> None:
        """Stop listening."""
        if self._closer is not None:
            self._closer.close()
            self._closer = None

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
    """Return the robot and its checked request, with id and submitter; PayloadError when it is none (pure)."""
    robot = check_name(message.key.split("/")[-2], "robot")
    if len(message.payload) > MAX_BYTES:
        raise PayloadError(f"a task request of {len(message.payload)} bytes", remedy=f"at most {MAX_BYTES}")
    try:
        request = msgspec.json.decode(message.payload, type=TaskRequest)
    except msgspec.DecodeError as error:
        raise PayloadError(f"not a TaskRequest: {error}", remedy='send {"instruction": "..."} as JSON') from error
    if not request.instruction.strip() or len(request.instruction) > MAX_INSTRUCTION:
        raise PayloadError(f"an instruction has 1 to {MAX_INSTRUCTION} characters")
    identity = request.id
    if identity:
        check_name(identity, "task")
    else:
        seed = b"\0".join((robot.encode(), message.payload, str(message.at_ns // _SECOND_NS).encode()))
        identity = f"r-{hashlib.sha256(seed).hexdigest()[:12]}"
    return robot, msgspec.structs.replace(request, id=identity, submitter=request.submitter or robot)
