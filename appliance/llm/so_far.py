"""What has become of an earlier plan, as the planner is told it when the rest is to be planned anew."""

from typing import Any

from msgspec import Struct

from appliance.model import SubtaskState, TaskRecord

MAX_REASON = 200


class Step(Struct, frozen=True, kw_only=True):
    """A subtask of the earlier plan. `state` is one of `done`, `running`, `failed`, `open`."""

    id: str
    skill: str
    robot: str | None
    params: dict[str, Any]
    after: tuple[str, ...]
    state: str
    reason: str = ""
    """Of a failed one: why."""


class SoFar(Struct, frozen=True, kw_only=True):
    """All subtasks of the earlier plan, in its order."""

    steps: tuple[Step, ...]

    def of(self, state: str) -> tuple[Step, ...]:
        """Return those of one state."""
        return tuple(each for each in self.steps if each.state == state)


_STATES = {
    SubtaskState.SUCCEEDED: "done",
    SubtaskState.DISPATCHED: "running",
    SubtaskState.RUNNING: "running",
    SubtaskState.FAILED: "failed",
}


def so_far(record: TaskRecord) -> SoFar:
    """Return what has become of a task's plan; a robot that was chosen is named."""
    return SoFar(
        steps=tuple(
            Step(
                id=each.subtask.id,
                skill=each.subtask.skill,
                robot=each.bound_robot or each.subtask.robot,
                params=each.subtask.params,
                after=each.subtask.after,
                state=_STATES.get(each.state, "open"),
                reason=each.failure.message[:MAX_REASON] if each.failure else "",
            )
            for each in record.subtasks
        )
    )
