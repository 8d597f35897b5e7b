"""What robots may ask of the rest of the appliance; the composition root puts it in."""

from collections.abc import Awaitable, Callable

from msgspec import Struct

from appliance.model import TaskRecord, TaskRequest


class Tasks(Struct, frozen=True):
    """The doors to the fleet's tasks: `submit` returns when the task is durable, `cancel` when it is being stopped.

    `look` returns how a task stands. All raise SwiftbotErrors.
    """

    submit: Callable[[TaskRequest], Awaitable[TaskRecord]]
    cancel: Callable[[str], Awaitable[TaskRecord]]
    look: Callable[[str], Awaitable[TaskRecord]]
