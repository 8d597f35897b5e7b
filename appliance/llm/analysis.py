"""What an instruction asks for, beside its plan: parameters with units, constraints, robots by capability, allocation.

The paper's semantic analysis and its container allocation hints, as facts for people, the terminal UI and pools. Pure.
Constraints are what the words state: deadlines, time windows, rates, bounds, named data sets. Allocation hints say
which containers a plan will need, how many at once, and about when. The paper's hint is (image, cpu, memory, volumes);
here it comes from the manifests, and from what runs of the same skills took: how long, so that it is known when the
next begin, and how much memory.
"""

import re
from collections.abc import Callable, Mapping, Sequence

from appliance.llm.checks.schema import able
from appliance.llm.values import quantity, unit_of
from appliance.model import Plan, RobotInfo, Subtask
from appliance.model.planner_api import Able, Allocation, Analysis, Constraint, Parameter
from appliance.skills.catalogue import Catalogue, SkillManifest

DATASETS = (
    "3dmatch", "replica", "scannet", "matterport3d", "habitat", "tum rgb-d", "tum", "kitti", "nuscenes", "waymo open",
    "euroc", "newer college", "oxford robotcar", "coco", "imagenet", "cifar-10", "cifar-100", "mnist", "fashion-mnist",
    "ucf101", "ucf-101", "hmdb51", "kinetics-400", "kinetics", "something-something", "librispeech", "common voice",
    "tedlium", "voxceleb", "argoverse", "semantickitti", "s3dis", "modelnet40", "shapenet", "ycb", "openloris",
)  # fmt: skip
"""Public data sets that robot and perception work names; a site's own are found by their parameter."""
_NUMBER = (
    r"(?:\d+(?:[.,]\d+)?|half an?|a quarter of an|an?|one|two|three|four|five|six|seven|eight|nine|ten|twelve|fifteen|"
    r"twenty|thirty|forty|fifty|sixty|ninety)(?:[ -](?:and a half|one|two|three|four|five))?"
)
_TIME = r"(?:ms|milliseconds?|s|secs?|seconds?|m|mins?|minutes?|h|hrs?|hours?|days?)"
_LENGTH = r"(?:m|metres?|meters?|cm|centimetres?|centimeters?|km|kilometres?|kilometers?|ft|feet)"
_SPEED = r"(?:m/s|mps|km/h|kmh|kph|knots?|metres? (?:per|a) second|meters? (?:per|a) second)"
_DAY = r"noon|midnight|sunset|sunrise|dawn|dusk|nightfall"
_CLOCK = rf"(?:[01]?\d|2[0-3])[:.][0-5]\d(?: ?[ap]m)?|(?:1[0-2]|[1-9]) ?[ap]m|{_DAY}"
_MOVING = r"(?:moving |sliding |rolling )?"


def _pattern(*parts: str) -> re.Pattern[str]:
    return re.compile("".join(parts))


_PATTERNS = (
    ("deadline", "s", _pattern(
        r"\b(?:within|in under|in less than|no later than|in at most)(?: the next)? ", rf"({_NUMBER} ?{_TIME})\b")),
    ("clock", "", _pattern(rf"\b(?:by|before|until|no later than) ({_CLOCK})\b")),
    ("window", "ms", _pattern(rf"\b{_MOVING}windows?(?: of| size(?: of)?|:)? ({_NUMBER} ?{_TIME})\b")),
    ("window", "ms", _pattern(rf"\b({_NUMBER}[ -]?{_TIME})[ -]{_MOVING}windows?\b")),
    ("period", "s", _pattern(rf"\bevery ({_NUMBER} ?{_TIME})\b")),
    ("duration", "s", _pattern(rf"\bfor (?:about |at least |at most )?({_NUMBER} ?{_TIME})\b")),
    ("speed", "mps", _pattern(
        r"\b(?:at|below|under|no faster than|not faster than|at most) ", rf"({_NUMBER} ?{_SPEED})")),
    ("distance", "m", _pattern(
        rf"\b(?:at least|keep|stay|maintain) ({_NUMBER} ?{_LENGTH}) (?:away|apart|from|distance)")),
    ("altitude", "m", _pattern(
        r"\b(?:at|to|below|under|above)(?: an altitude of| a height of)? ", rf"({_NUMBER} ?{_LENGTH})\b(?!/)")),
)  # fmt: skip
_ORDER = ("deadline", "clock", "window", "period", "duration", "distance", "speed", "altitude", "dataset")


def constraints(instruction: str) -> tuple[Constraint, ...]:
    """Return the constraints that an instruction states, in a fixed order of kinds."""
    text = " ".join(instruction.casefold().split())
    found: list[Constraint] = []
    taken: list[tuple[int, int]] = []
    for kind, unit, pattern in _PATTERNS:
        for match in pattern.finditer(text):
            span = match.span(1)
            if any(span[0] < end and start < span[1] for start, end in taken):
                continue  # "a window of 400 ms" is no duration besides
            value = quantity(match[1].replace("-", " "), unit) if unit else None
            if unit and value is None:
                continue
            taken.append(span)
            found.append(Constraint(kind=kind, text=match[0], value=None if value is None else float(value), unit=unit))
    covered = ""
    for name in sorted(DATASETS, key=len, reverse=True):
        if re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text) and name not in covered:
            covered += f" {name}"
            found.append(Constraint(kind="dataset", text=name))
    return tuple(sorted(found, key=lambda each: (_ORDER.index(each.kind), text.find(each.text))))


def starts(plan: Plan, seconds: Mapping[str, float]) -> dict[str, float]:
    """Return when each subtask is expected to begin, seconds from the plan's beginning, when nothing waits."""
    begins: dict[str, float] = {}
    left = list(plan.subtasks)
    ids = {each.id for each in left}
    while left:
        later: list[Subtask] = []
        for each in left:
            before = [name for name in each.after if name in ids]
            if all(name in begins for name in before):
                begins[each.id] = max((begins[name] + seconds.get(name, 0.0) for name in before), default=0.0)
            else:
                later.append(each)
        if len(later) == len(left):
            break  # a circle, which no valid plan has
        left = later
    return begins


def allocations(
    plan: Plan,
    manifests: Mapping[str, SkillManifest],
    *,
    expected_s: Callable[[Subtask], float],
    peak_mb: Callable[[str], float],
) -> tuple[Allocation, ...]:
    """Return what a plan asks of pools, the first needed first.

    Args:
        plan: a valid one.
        manifests: by skill; a skill without asks for nothing.
        expected_s: how long a subtask is expected to take.
        peak_mb: most memory that runs of a skill took lately.
    """
    seconds = {each.id: max(0.0, expected_s(each)) for each in plan.subtasks}
    begins = starts(plan, seconds)
    grouped: dict[tuple[str, tuple[str, ...]], list[Subtask]] = {}
    for each in plan.subtasks:
        manifest = manifests.get(each.skill)
        if manifest is not None and each.id in begins:
            grouped.setdefault((manifest.image, manifest.volumes), []).append(each)
    found: list[Allocation] = []
    for (image, volumes), subtasks in grouped.items():
        spans = [(begins[each.id], begins[each.id] + seconds[each.id]) for each in subtasks]
        first = min(start for start, _ in spans)
        used = [manifests[each.skill] for each in subtasks]
        found.append(
            Allocation(
                image=image,
                cpu=max(each.cpu for each in used),
                memory_mb=max(each.memory_mb for each in used),
                volumes=volumes,
                count=max(sum(start <= at < end or start == at for start, end in spans) for at, _ in spans),
                start_s=round(first, 2),
                busy_s=round(max(end for _, end in spans) - first, 2),
                subtasks=tuple(each.id for each in subtasks),
                seen_mb=round(max((peak_mb(each.id) for each in used), default=0.0), 1),
            )
        )
    return tuple(sorted(found, key=lambda each: (each.start_s, each.image, each.volumes)))


MOST_ABLE = 32
DEFAULT_S = 3.0
"""Expected of a skill of which nothing is known."""


def analyse(
    instruction: str,
    plan: Plan,
    catalogue: Catalogue,
    robots: Sequence[RobotInfo] | None,
    *,
    expected_s: Callable[[str, str], float | None] = lambda _skill, _robot: None,
    peak_mb: Callable[[str], float] = lambda _: 0.0,
    reliability: Callable[[str, str], float] = lambda _skill, _robot: 1.0,
    shuns: Callable[[str, str], str] = lambda _skill, _robot: "",
) -> Analysis:
    """Analyse an instruction with its plan.

    Args:
        instruction: as it was given.
        plan: a valid one.
        catalogue: the skills there are.
        robots: the roster; None when it is unknown.
        expected_s: skill, robot -> how long a run takes, None when nothing is known.
        peak_mb: skill -> most memory that its runs took lately.
        reliability: skill, robot -> share of successes expected.
        shuns: skill, robot -> why the robot is chosen last, or "".
    """
    unmeasured: dict[str, None] = {}

    def takes(subtask: Subtask) -> float:
        asked = subtask.params.get("duration_s", 0.0)
        known = expected_s(subtask.skill, subtask.robot or "")
        if known is None and not asked:
            unmeasured[subtask.skill] = None
        expected = DEFAULT_S if known is None else known
        return max(expected, asked) if isinstance(asked, int | float) and 0 < asked < 86_400 else expected

    allocation = allocations(plan, catalogue.skills, expected_s=takes, peak_mb=peak_mb)
    return Analysis(
        domain=plan.domain,
        parameters=tuple(
            Parameter(
                subtask=each.id,
                name=name,
                value=tuple(map(str, value)) if isinstance(value, list | tuple) else value,  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
                unit=unit_of(name),
            )
            for each in plan.subtasks
            for name, value in each.params.items()
        ),
        constraints=constraints(instruction),
        able=_able(plan, catalogue, robots, reliability, shuns),
        allocation=allocation,
        expected_s=round(max((each.start_s + each.busy_s for each in allocation), default=0.0), 2),
        unmeasured=tuple(unmeasured),
    )


def _able(
    plan: Plan,
    catalogue: Catalogue,
    robots: Sequence[RobotInfo] | None,
    reliability: Callable[[str, str], float],
    shuns: Callable[[str, str], str],
) -> tuple[Able, ...]:
    wanted: dict[str, list[str]] = {}
    for each in plan.subtasks:
        if each.robot is not None and each.skill in catalogue.skills:
            wanted.setdefault(each.robot, []).append(each.skill)
    found: list[Able] = []
    for label, skills in wanted.items():
        distinct = tuple(dict.fromkeys(skills))
        manifests = [catalogue.skills[each] for each in distinct]
        fitting = [each.id for each in robots or () if not any(able(each, manifest) for manifest in manifests)]
        fitting.sort(key=lambda robot: (-min(reliability(skill, robot) for skill in distinct), robot))
        reasons = {
            robot: why for robot in fitting if (why := next(filter(None, (shuns(s, robot) for s in distinct)), ""))
        }
        found.append(Able(label=label, skills=distinct, robots=tuple(fitting[:MOST_ABLE]), shunned=reasons))
    return tuple(found)
