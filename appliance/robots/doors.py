"""What robots may ask of the rest of the appliance; the composition root puts it in."""

from collections.abc import Awaitable, Callable

from msgspec import Struct

from appliance.model import Plan, TaskRecord, TaskRequest


class Tasks(Struct, frozen=True):
    """The doors to the fleet's tasks: `submit` returns when the task is durable, `cancel` when it is being stopped.

    `cancel` is told by whom: a vehicle's name, or `mavlink-{system}-{component}` of whoever else spoke. `look`
    returns how a task stands; `submit_of` submits what a robot asked on its own key. All raise SwiftbotErrors.
    """

    submit: Callable[[TaskRequest], Awaitable[TaskRecord]]
    cancel: Callable[[str, str], Awaitable[TaskRecord]]
    look: Callable[[str], Awaitable[TaskRecord]]
    submit_of: Callable[[str, TaskRequest], Awaitable[TaskRecord]] | None = None
    """None: queries of robots are not answered here."""
    problems: Callable[[Plan], tuple[str, ...]] = lambda _: ()
    """What is wrong with a plan, each as a sentence: what has problems here would not run if it was submitted."""
