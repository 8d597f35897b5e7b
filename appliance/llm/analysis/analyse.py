"""Puts the analysis of an instruction together. Pure."""

from collections.abc import Callable, Sequence

from msgspec import Struct

from appliance.llm.analysis.allocation import Allocation, allocations
from appliance.llm.analysis.constraints import Constraint, constraints
from appliance.llm.checks.schema import able
from appliance.llm.language.values import unit_of
from appliance.model import Plan, RobotInfo, Subtask
from appliance.skills.catalogue import Catalogue

MOST_ABLE = 32
DEFAULT_S = 3.0
"""Expected of a skill of which nothing is known."""


class Parameter(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One parameter of a subtask, as it was understood."""

    subtask: str
    name: str
    value: str | float | tuple[str, ...]
    unit: str = ""
    """`s`, `ms`, `m` or `mps`; empty for text and plain numbers."""


class Able(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Who can do what one robot of the plan (or a label such as `any1`) has to do."""

    label: str
    skills: tuple[str, ...]
    robots: tuple[str, ...] = ()
    """The most reliable by experience first."""
    shunned: dict[str, str] = {}
    """Of these, who is chosen last, and why."""


class Analysis(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What an instruction asks for."""

    domain: str
    parameters: tuple[Parameter, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    able: tuple[Able, ...] = ()
    allocation: tuple[Allocation, ...] = ()
    expected_s: float = 0.0
    """How long the plan takes when nothing waits."""


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

    def takes(subtask: Subtask) -> float:
        asked = subtask.params.get("duration_s", 0.0)
        known = expected_s(subtask.skill, subtask.robot or "")
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
