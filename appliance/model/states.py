"""The states of tasks and subtasks."""

from appliance.model.open_enum import OpenEnum


class TaskState(OpenEnum):
    """Life of a task. The last three are final."""

    ACCEPTED = "accepted"
    """Durable, not yet planned."""
    PROPOSED = "proposed"
    """Planned; its plan waits for an operator's approval, and nothing runs."""
    RUNNING = "running"
    CANCELLING = "cancelling"
    """Somebody asked to stop it; runs are being ended."""
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """Whether nothing will follow."""
        return self in (TaskState.SUCCEEDED, TaskState.FAILED, TaskState.CANCELLED)


class SubtaskState(OpenEnum):
    """Life of a subtask. The last three are final."""

    WAITING = "waiting"
    """Its predecessors have not all succeeded."""
    READY = "ready"
    """Could start now; waits for a place (robot, gateway, retry delay)."""
    DISPATCHED = "dispatched"
    """Attempt written to the record and sent to a gateway."""
    RUNNING = "running"
    """Its handler has run its first line."""
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        """Whether nothing will follow."""
        return self in (SubtaskState.SUCCEEDED, SubtaskState.FAILED, SubtaskState.CANCELLED)
