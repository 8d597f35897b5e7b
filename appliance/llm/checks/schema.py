"""Whether a plan may run: the one check every tier's plan, and every plan handed in from outside, must pass.

Why it exists: a language model proposes, this decides. It is deterministic and pure, it can only refuse, and it says
everything that is wrong at once, each as a sentence with subtask and remedy, so that a model can correct its plan and a
person understands the refusal. It must survive any plan that decodes at all, so every walk over it is bounded and
none recurses.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from appliance.llm.checks.places import place_problems, shown
from appliance.model import MAX_SUBTASKS, SPLIT, Plan, RobotInfo, Site, Subtask, oversize
from appliance.skills.catalogue import Catalogue, Param, SkillManifest

MAX_PROBLEMS = 32
"""Problems listed; the rest would help nobody."""
MAX_TEXT = 500
MAX_ITEMS = 64
MAX_SECONDS = 86_400.0
MAX_NUMBER = 1_000_000.0

_ID = re.compile(r"[a-z][a-z0-9_]{0,30}")
_ROBOT = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}")
_ANY = re.compile(r"any\d{0,2}")


def validate(
    plan: Plan,
    catalogue: Catalogue,
    *,
    robots: Sequence[RobotInfo] | None = None,
    site: Site | None = None,
    require_implemented: bool = False,
) -> tuple[str, ...]:
    """Return every problem of a plan, at most `MAX_PROBLEMS`; none means that it may run.

    Args:
        plan: any plan that decodes, hostile ones included.
        catalogue: the skills there are.
        robots: the roster; None when it is unknown, and then names are only checked for their form.
        site: places, forbidden areas and limits; None when it is unknown.
        require_implemented: refuse skills that have no handler here.
    """
    if not plan.subtasks:
        return ("the plan is empty: give at least one subtask",)
    if problem := oversize(len(plan.subtasks)):
        return (f"{problem}: {SPLIT}",)
    problems: list[str] = []
    if plan.domain not in catalogue.domains:
        problems.append(f"domain {shown(plan.domain)} is unknown: use one of {', '.join(catalogue.domains)}")
    problems += _ids(plan)
    problems += _order(plan)
    roster = None if robots is None else {robot.id: robot for robot in robots}
    for subtask in plan.subtasks:
        manifest = catalogue.skills.get(subtask.skill)
        where = f"{shown(subtask.id)} ({shown(subtask.skill)})"
        if manifest is None:
            problems.append(f"{where}: there is no such skill: use one of the catalogue")
            continue
        if require_implemented and not manifest.implemented:
            problems.append(
                f"{where}: skill {manifest.id} is not implemented on this fleet: add it, or ask for something else"
            )
        problems += [f"{where}: {text}" for text in _params(subtask, manifest)]
        problems += [f"{where}: {text}" for text in _robot(subtask, manifest, roster)]
        if site is not None:
            problems += [f"{where}: {text}" for text in place_problems(subtask, site)]
        if len(problems) > MAX_PROBLEMS:
            break
    if roster is not None and not problems:
        problems += _unnamed(plan, catalogue, roster)
    return tuple(problems[:MAX_PROBLEMS])


def able(robot: RobotInfo, manifest: SkillManifest) -> str:
    """Return why a robot cannot do a skill, or nothing."""
    missing = [use for use in manifest.uses if use not in robot.uses]
    if missing:
        return f"robot {robot.id} has no {' and no '.join(missing)}"
    if manifest.flying and not robot.flies:
        return f"robot {robot.id} does not fly"
    lacking = [verb for verb in manifest.verbs if verb not in robot.verbs]
    if lacking:
        return f"robot {robot.id} does not know the command {' or '.join(lacking)}"
    return ""


def is_unnamed(robot: str) -> bool:
    """Whether a robot is a label for one that is yet to be chosen: any, any1, ..."""
    return _ANY.fullmatch(robot) is not None


def _ids(plan: Plan) -> Iterable[str]:
    seen: set[str] = set()
    for subtask in plan.subtasks:
        if not _ID.fullmatch(subtask.id):
            yield f"subtask id {shown(subtask.id)} is not allowed: use s1, s2, ..."
        elif subtask.id in seen:
            yield f"subtask id {subtask.id} is used twice: give each its own"
        seen.add(subtask.id)


def _order(plan: Plan) -> Iterable[str]:
    """Unknown and repeated predecessors, and cycles (Kahn's algorithm: no recursion)."""
    known = {subtask.id for subtask in plan.subtasks}
    waiting: dict[str, set[str]] = {}
    for subtask in plan.subtasks:
        if len(subtask.after) > MAX_SUBTASKS:
            yield f"{shown(subtask.id)}: comes after {len(subtask.after)} subtasks: name the direct ones only"
        for other in subtask.after[:MAX_SUBTASKS]:
            if other not in known:
                yield f"{shown(subtask.id)}: comes after {shown(other)}, which is not in the plan: name one that is"
            elif other == subtask.id:
                yield f"{shown(subtask.id)}: comes after itself: take that out"
        waiting[subtask.id] = {other for other in subtask.after[:MAX_SUBTASKS] if other in known}
    while free := {each for each, before in waiting.items() if not before}:
        waiting = {each: before - free for each, before in waiting.items() if each not in free}
    if waiting:
        names = ", ".join(shown(each) for each in list(waiting)[:8])
        yield f"subtasks {names} wait for each other in a circle: take one dependency out"


def _params(subtask: Subtask, manifest: SkillManifest) -> Iterable[str]:
    for name, param in manifest.params.items():
        if param.required and subtask.params.get(name) in (None, "", [], ()):
            yield f"parameter {name} is missing: {manifest.id} needs it"
    for name, value in subtask.params.items():
        if name not in manifest.params:
            known = ", ".join(manifest.params) or "none"
            yield f"there is no parameter {shown(name)}: {manifest.id} has {known}"
        elif wrong := (
            _wrong_type(value, manifest.params[name])
            or _out_of_bounds(value, manifest.params[name])
            or _wrong_value(name, value)
        ):
            yield f"parameter {name}: {wrong}"


def _wrong_type(value: Any, param: Param) -> str:
    if param.type == "string":
        if not isinstance(value, str):
            return f"must be text, not {shown(value)}"
        if len(value) > MAX_TEXT:
            return f"is {len(value)} characters long: at most {MAX_TEXT}"
    elif param.type == "array":
        if not isinstance(value, list | tuple) or not all(isinstance(item, str) and item for item in value):  # pyright: ignore[reportUnknownVariableType]
            return "must be a list of texts"
        if len(value) > MAX_ITEMS or any(len(str(item)) > MAX_TEXT for item in value):  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            return f"is too long: at most {MAX_ITEMS} texts of {MAX_TEXT} characters"
    elif isinstance(value, bool) or not isinstance(value, int | float):
        return f"must be a number, not {shown(value)}"
    elif not _within(value):
        return "is not a number that can be meant"
    elif param.type == "integer" and value != int(value):
        return f"must be a whole number, not {value}"
    return ""


def _out_of_bounds(value: Any, param: Param) -> str:
    if not isinstance(value, int | float):
        return ""
    if param.least is not None and value < param.least:
        return f"is {value}: at least {param.least:g}"
    return f"is {value}: at most {param.most:g}" if param.most is not None and value > param.most else ""


def _within(value: float) -> bool:
    """Whether a number is finite and of a sane size; huge integers must not reach float()."""
    return (
        -MAX_NUMBER <= value <= MAX_NUMBER
        if isinstance(value, int)
        else math.isfinite(value) and abs(value) <= MAX_NUMBER
    )


def _wrong_value(name: str, value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    if value < 0 or (value == 0 and name != "window_ms"):
        return f"{value} is not more than 0"
    if name in ("duration_s", "timeout_s") and value > MAX_SECONDS:
        return f"{value} s is longer than a day"
    return ""


def _robot(subtask: Subtask, manifest: SkillManifest, roster: dict[str, RobotInfo] | None) -> Iterable[str]:
    if manifest.runs == "compute":
        if subtask.robot is not None:
            yield f"runs on a gateway, not on {shown(subtask.robot)}: leave the robot out"
    elif subtask.robot is None:
        yield "no robot is named: name one, or any"
    else:
        yield from _named(subtask.robot, manifest, roster)
    if manifest.joint and isinstance(listed := subtask.params.get("robots"), list | tuple):
        names = [each for each in listed[:MAX_ITEMS] if isinstance(each, str)]  # pyright: ignore[reportUnknownVariableType]
        for name in names:
            if name != subtask.robot:
                yield from _named(name, manifest, roster)
        if len(set(names)) != len(names):
            yield "a robot is listed twice: list each once"
        fewest = int(manifest.params["robots"].least or 2)
        if manifest.runs == "robot" and names and len(names) < fewest and "all" not in names:
            yield (
                f"{manifest.id} is done by at least {fewest} robots together, and it lists {', '.join(names)} alone: "
                "list every robot that takes part, or ask for a skill of one robot"
            )
        if subtask.robot is not None and names and subtask.robot not in names:
            yield f"robot {shown(subtask.robot)} is not among its robots: list it first"


def _named(name: str, manifest: SkillManifest, roster: dict[str, RobotInfo] | None) -> Iterable[str]:
    if not _ROBOT.fullmatch(name):
        yield f"robot name {shown(name)} is not allowed: use the name in the roster"
    elif roster is None or _ANY.fullmatch(name):
        return
    elif name == "all":
        yield "robot all must be one subtask for each robot, since the roster is known"
    elif (robot := roster.get(name)) is None:
        there = ", ".join(sorted(roster)[:12]) or "none"
        yield f"there is no robot {name}: the fleet has {there}"
    elif why := able(robot, manifest):
        fitting = [other.id for other in roster.values() if not able(other, manifest)]
        yield f"{why}: {'ask ' + ' or '.join(sorted(fitting)[:6]) if fitting else 'no robot of the fleet can do it'}"


def _unnamed(plan: Plan, catalogue: Catalogue, roster: dict[str, RobotInfo]) -> Iterable[str]:
    """Whether `any`, `any1`, ... can each be a different robot that can do all its subtasks (augmenting paths)."""
    wanted: dict[str, list[SkillManifest]] = {}
    for subtask in plan.subtasks:
        listed = subtask.params.get("robots")
        names = [subtask.robot, *(listed if isinstance(listed, list | tuple) else ())]  # pyright: ignore[reportUnknownVariableType]
        for name in dict.fromkeys(each for each in names if isinstance(each, str) and _ANY.fullmatch(each)):  # pyright: ignore[reportUnknownVariableType]
            wanted.setdefault(name, []).append(catalogue.skills[subtask.skill])
    fits: dict[str, list[str]] = {}
    for name, manifests in wanted.items():
        fits[name] = [robot.id for robot in roster.values() if not any(able(robot, each) for each in manifests)]
        if not fits[name]:
            skills = ", ".join(dict.fromkeys(each.id for each in manifests))
            yield f"no robot of the fleet can do all that {name} is asked ({skills}): name robots, or split the order"
            return
    taken: dict[str, str] = {}
    for name in fits:
        if name != "any" and not assign(name, fits, taken):
            yield f"the plan needs {len(fits)} different robots that can do this: the fleet has {len(roster)}"
            return


def assign(name: str, fits: Mapping[str, Sequence[str]], taken: dict[str, str]) -> bool:
    """Give `name` a robot that fits it, moving earlier ones along a shortest augmenting path.

    Args:
        name: who needs one.
        fits: name -> the robots that it can have, best first.
        taken: robot -> the name that has it; changed where True is returned.
    """
    came: dict[str, str] = {}
    queue = [name]
    for current in queue:
        for robot in fits[current]:
            if robot in came:
                continue
            came[robot] = current
            if robot not in taken:
                while True:
                    holder = came[robot]
                    previous = next((held for held, owner in taken.items() if owner == holder), None)
                    taken[robot] = holder
                    if previous is None:
                        return True
                    robot = previous  # noqa: PLW2901 - walks the path back
            queue.append(taken[robot])
    return False
