"""Where robots came from: their last positions, bounded. Pure."""

from collections import deque
from collections.abc import Iterable
from itertools import islice

from appliance.model import RobotInfo

TRAIL = 60
"""Positions remembered of each robot."""
MOST_TRAILS = 1000
MOST_SHOWN = 2000
"""Positions of all trails that are shown together."""


def shown_of(robots: int) -> int:
    """Return how many positions each of so many robots leaves on the map: with hundreds, long trails are one blur."""
    return max(1, MOST_SHOWN // max(1, robots))


class Trails:
    """Where robots were."""

    def __init__(self) -> None:
        self._trails: dict[str, deque[tuple[float, float]]] = {}

    def note(self, robots: Iterable[RobotInfo]) -> None:
        """Take positions; one like the last is not kept twice."""
        for each in robots:
            pose = each.pose
            if pose is None:
                continue
            trail = self._trails.get(each.id)
            if trail is None:
                if len(self._trails) >= MOST_TRAILS:
                    continue
                trail = self._trails[each.id] = deque(maxlen=TRAIL)
            at = (pose.x, pose.y)
            if not trail or trail[-1] != at:
                trail.append(at)

    def last(self, robot: str, most: int) -> tuple[tuple[float, float], ...]:
        """Return the last positions of a robot, oldest first."""
        trail = self._trails.get(robot)
        if trail is None:
            return ()
        return tuple(trail) if len(trail) <= most else tuple(islice(trail, len(trail) - most, None))
