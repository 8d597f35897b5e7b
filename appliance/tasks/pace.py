"""When each subtask of a task may be tried next, and what the waiting ones wait for. The clock is passed in."""

LOOK_AGAIN_S = 0.5
"""How soon after it could not be placed a subtask is tried again."""


class Pace:
    """The waits of one task's subtasks; times in seconds on this machine's monotonic clock."""

    def __init__(self) -> None:
        self.not_before: dict[str, float] = {}
        self._reasons: dict[str, str] = {}
        self._since: dict[str, float] = {}

    @property
    def waiting(self) -> bool:
        """Whether a subtask waits for a robot or a gateway."""
        return bool(self._reasons)

    def may_go(self, subtask: str, now: float) -> bool:
        """Whether a ready subtask may be tried now."""
        if self.not_before.get(subtask, 0.0) > now:
            return False
        self.not_before.pop(subtask, None)
        return True

    def goes(self, subtask: str) -> None:
        """It waits no more."""
        self._reasons.pop(subtask, None)
        self._since.pop(subtask, None)

    def waited_s(self, subtask: str, now: float) -> float:
        """Seconds since a subtask began to wait for what it still waits for."""
        return now - self._since.get(subtask, now)

    def waits(self, subtask: str, reason: str, now: float) -> bool:
        """Note why it waits, and look again soon; returns whether the reason is a new one."""
        self.not_before[subtask] = now + LOOK_AGAIN_S
        new = self._reasons.get(subtask) != reason
        self._reasons[subtask] = reason
        self._since.setdefault(subtask, now)
        return new

    def repeats(self, subtask: str, at: float) -> None:
        """Its next attempt may begin then."""
        self.not_before[subtask] = at

    def look_again(self) -> None:
        """What the waiting ones wait for may have come: they may be tried at once."""
        for subtask in self._reasons:
            self.not_before.pop(subtask, None)
