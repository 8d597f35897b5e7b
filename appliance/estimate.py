"""What a plan would do by the site's map: ways, lengths, times, places passed, limits. Pure; nothing is simulated.

Ways are those that the skill `goto` plans, by the same function. How long they take is reckoned with one speed, without
starting, turning and waiting for others; how long other skills take is what their runs took before. So it is an
estimate: a robot, a person or a door in the way is in none of it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

import msgspec
from msgspec import Struct

from appliance.model import Plan, RobotInfo, Site, Subtask
from appliance.model.site import Place, off_site
from appliance.skills._lib import coordinates, paths

Point = tuple[float, float]
PASSED_M = 1.0
"""A place nearer to a way than this is passed."""
NOTE = (
    "estimate from the site's map, nothing was simulated: ways as the skill goto plans them, at a steady speed; "
    "without other robots, people, doors and waits"
)


class Step(Struct, frozen=True, kw_only=True):
    """What is expected of a subtask."""

    subtask: str
    skill: str
    robot: str
    start_s: float
    """Seconds after the plan begins; waits for its predecessors and its robot alone."""
    takes_s: float | None = None
    """None: not known."""
    way: tuple[Point, ...] = ()
    """From where the robot is then to where it goes, metres."""
    length_m: float = 0.0
    speed_mps: float = 0.0
    limit: str = ""
    """What the speed is limited by: `asked`, `robot`, `site`."""
    passes: tuple[str, ...] = ()
    """Places on the way, in its order, start and goal left out."""
    problem: str = ""
    """Why it cannot be done, or its way is not known."""


class Estimate(Struct, frozen=True, kw_only=True):
    """What is expected of a plan."""

    steps: tuple[Step, ...]
    takes_s: float
    """Until the last step ends, of which the times are known."""
    unknown: tuple[str, ...] = ()
    """Skills of which no time is known: `takes_s` is without them."""
    note: str = NOTE

    @property
    def problems(self) -> tuple[str, ...]:
        """What hinders it."""
        return tuple(f"{each.subtask} {each.skill}: {each.problem}" for each in self.steps if each.problem)


def estimate(
    plan: Plan, *, site: Site, robots: Mapping[str, RobotInfo], measured: Mapping[tuple[str, str], float]
) -> Estimate:
    """Return what a plan is expected to do.

    Args:
        plan: valid, so that its subtasks follow from each other without a circle.
        site: the map.
        robots: as they were heard last, by name.
        measured: seconds that runs of a skill on a robot took, by both names; a robot "" stands for a gateway.
    """
    at: dict[str, Point | None] = {
        name: (robot.pose.x, robot.pose.y) if robot.pose is not None else None for name, robot in robots.items()
    }
    free_s: dict[str, float] = {}
    ended_s: dict[str, float] = {}
    steps: list[Step] = []
    for each in in_order(plan.subtasks):
        robot = each.robot or ""
        start_s = max([free_s.get(robot, 0.0) if robot else 0.0, *(ended_s.get(name, 0.0) for name in each.after)])
        step = _step(each, start_s, at=at, site=site, robots=robots, measured=measured)
        steps.append(step)
        ended_s[each.id] = free_s[robot] = start_s + (step.takes_s or 0.0)
    unknown = tuple(dict.fromkeys(each.skill for each in steps if each.takes_s is None))
    return Estimate(steps=tuple(steps), takes_s=max(ended_s.values(), default=0.0), unknown=unknown)


def in_order(subtasks: Sequence[Subtask]) -> Iterable[Subtask]:
    """Yield subtasks so that each comes after its predecessors; of a circle the rest in the order of the plan."""
    left, done = list(subtasks), set[str]()
    known = {each.id for each in subtasks}
    while left:
        ready = next((each for each in left if set(each.after) & known <= done), left[0])
        left.remove(ready)
        done.add(ready.id)
        yield ready


def _step(
    each: Subtask,
    start_s: float,
    *,
    at: dict[str, Point | None],
    site: Site,
    robots: Mapping[str, RobotInfo],
    measured: Mapping[tuple[str, str], float],
) -> Step:
    """Return what is expected of a subtask; where its robot is afterwards is noted in `at`."""
    robot = each.robot or ""
    plain = Step(
        subtask=each.id, skill=each.skill, robot=robot, start_s=start_s,
        takes_s=measured.get((each.skill, robot), measured.get((each.skill, ""))),
    )  # fmt: skip
    if each.skill not in ("goto", "return_home"):
        return plain
    info = robots.get(robot)
    goal = _goal(each, info, site)
    here, at[robot] = at.get(robot), None
    if isinstance(goal, str):
        return msgspec.structs.replace(plain, problem=goal)
    at[robot] = (goal.x, goal.y)
    if (off := off_site(site, goal)) is not None:
        return msgspec.structs.replace(plain, problem=f"the goal {off.why}")
    if here is None:
        return msgspec.structs.replace(plain, problem=f"where {robot or 'the robot'} starts from is not known")
    try:
        way = (here, *_way(here, (goal.x, goal.y), site, flies=info is not None and info.flies))
    except paths.NoPath as error:
        return msgspec.structs.replace(plain, problem=error.message)
    speed, limit = _speed(each, info, site)
    metres = paths.length(way)
    return msgspec.structs.replace(
        plain, way=way, length_m=metres, speed_mps=speed, limit=limit, takes_s=metres / speed, passes=passed(way, site)
    )


def _goal(each: Subtask, info: RobotInfo | None, site: Site) -> Place | str:
    """Return where a subtask goes, or why that is not known."""
    if each.skill == "return_home":
        home = info.home if info is not None else None
        return Place(x=home.x, y=home.y) if home is not None else f"the home of {each.robot} is not known"
    name = str(each.params.get("place", ""))
    if (place := site.find(name)) is not None:
        return place
    point = coordinates.read(name)
    return Place(x=point[0], y=point[1], z=point[2]) if point is not None else f"the site has no place {name[:60]!r}"


def _way(here: Point, goal: Point, site: Site, *, flies: bool) -> list[Point]:
    """Return the way as `_lib.moves.plan_way` does."""
    forbidden = paths.rectangles(msgspec.to_builtins(site.forbidden))
    obstacles = paths.rectangles(msgspec.to_builtins(site.obstacles))
    aisles = [] if flies else paths.one_ways(msgspec.to_builtins(site.aisles))
    try:
        return paths.plan(here, goal, [*obstacles, *forbidden], aisles=aisles)
    except paths.NoPath:
        if not flies:
            raise
        return paths.plan(here, goal, forbidden)


def _speed(each: Subtask, info: RobotInfo | None, site: Site) -> tuple[float, str]:
    """Return the speed of a way, metres a second, and what it is limited by."""
    found = [(site.speed_limit_mps, "site")]
    if info is not None and info.limits is not None and info.limits.speed_mps:
        found.append((info.limits.speed_mps, "robot"))
    asked = each.params.get("speed_mps")
    if isinstance(asked, int | float) and math.isfinite(asked) and asked > 0:
        found.append((float(asked), "asked"))
    speed, limit = min(found, key=lambda pair: pair[0])
    return max(speed, 0.01), limit


def passed(way: Sequence[Point], site: Site) -> tuple[str, ...]:
    """Return the places that a way passes, in its order, those at its ends left out."""
    found: list[tuple[float, str]] = []
    for name, place in site.places.items():
        point = (place.x, place.y)
        if min(math.dist(point, way[0]), math.dist(point, way[-1])) <= PASSED_M:
            continue
        gone = 0.0
        for begin, end in pairwise(way):
            share = _nearest(begin, end, point)
            nearest = (begin[0] + share * (end[0] - begin[0]), begin[1] + share * (end[1] - begin[1]))
            if math.dist(nearest, point) <= PASSED_M:
                found.append((gone + math.dist(begin, nearest), name))
                break
            gone += math.dist(begin, end)
    return tuple(name for _, name in sorted(found))


def _nearest(begin: Point, end: Point, point: Point) -> float:
    """Return where on a line a point is nearest, 0 at its beginning to 1 at its end."""
    along = (end[0] - begin[0], end[1] - begin[1])
    square = along[0] ** 2 + along[1] ** 2
    if not square:
        return 0.0
    return min(1.0, max(0.0, ((point[0] - begin[0]) * along[0] + (point[1] - begin[1]) * along[1]) / square))


def unreachable(site: Site) -> tuple[str, ...]:
    """Return the places to which, or from which, no robot on the ground finds a way, with why.

    The other end is the site's first place.
    """
    names = list(site.places)
    found: list[str] = []
    for name in names[1:]:
        first, place = site.places[names[0]], site.places[name]
        for word, start, end in (("from", first, place), ("to", place, first))[: 2 if site.aisles else 1]:
            try:
                _way((start.x, start.y), (end.x, end.y), site, flies=False)
            except paths.NoPath as error:
                found.append(f"{name}: no way {word} {names[0]} ({error.message})")
    return tuple(found)
