"""The tier that is always there: pure parsing, no model, no network, milliseconds.

A plan's domain is that of its main purpose: what is only the way there, or only tells of it, does not count unless
there is nothing else. A delivery is manipulation when it ends in `place`, interaction when it ends in `give`.

How likely a plan is right is calibrated, so that it can be compared with a model's. How much of the words was
understood says little alone: of the held-out instructions that were understood word for word a third had an exact plan,
since a pattern fits sooner than it means the same. Long sentences are read wrong more often than short ones, and such
that give few orders for their words more often than plain lists of orders.

When the rest of a plan is to be replanned, a failed subtask is replaced by a skill that manifests name as an
alternative, or as an alternative of that, on a robot that can do it. Rules understand words, not causes: where that
does not help they say so.
"""

import asyncio
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from appliance.errors import PlanError
from appliance.llm.checks.schema import able
from appliance.llm.rules.parser import Parser, Reading
from appliance.llm.settings import PlanContext, SoFar, StepSoFar
from appliance.llm.tier import Proposal
from appliance.model import Plan, RobotInfo, Subtask, Tier
from appliance.skills.catalogue import Catalogue, SkillManifest

_STRONG = ("coordination", "learning", "media")
"""Where one of their skills stands, the others serve it."""


def domain_of(subtasks: Sequence[Subtask], catalogue: Catalogue) -> str:
    """Return the domain of a plan's main purpose."""
    known = [each.skill for each in subtasks if each.skill in catalogue.skills]
    main = [skill for skill in known if not catalogue.skills[skill].incidental]
    if any(
        catalogue.skills[skill].domain != "manipulation" and "load" in catalogue.skills[skill].frees for skill in main
    ):
        main = [skill for skill in main if "load" not in catalogue.skills[skill].ties]
    if not main:
        main = [skill for skill in known if skill != "notify"] or known
    domains = Counter(catalogue.skills[skill].domain for skill in main)
    for strong in _STRONG:
        if domains.get(strong):
            return strong
    return domains.most_common(1)[0][0] if domains else catalogue.domains[0]


_BIAS, _WHOLE, _LOST, _LENGTH, _ORDERS = 0.45, 0.83, -1.69, -1.23, 0.66
"""Of a logistic regression on half of the held-out pairs; the other half was to verify it (docs/benchmarks.md)."""


def odds_right(understood: float, *, words: int, subtasks: int) -> float:
    """Return the probability, 0 to 1, that a plan of the rules is exactly what was meant.

    Args:
        understood: share of the words that fitted a pattern.
        words: of the instruction.
        subtasks: of the plan.
    """
    words = max(1, words)
    score = _BIAS + _WHOLE * (understood >= 1) + _LOST * (1 - understood)
    score += _LENGTH * math.log(words) + _ORDERS * 10 * subtasks / words
    return 1 / (1 + math.exp(-max(-60.0, min(60.0, score))))


CONFIDENCE = 1.0
"""The rules' is the share of the words that were understood, and here are none that could be misunderstood: what takes
the place of a failed subtask is what the manifests declare."""


def mend(so_far: SoFar, catalogue: Catalogue, robots: Sequence[RobotInfo] | None) -> Plan:
    """Return the earlier plan with alternatives in place of what failed; pure.

    Raises:
        PlanError: there is none for one of them.
    """
    subtasks: list[Subtask] = []
    names = {each.id: f"s{number}" for number, each in enumerate(so_far.steps, start=1)}
    stuck: list[str] = []
    for each in so_far.steps:
        after = tuple(names[one] for one in each.after if one in names)
        if each.state != "failed":
            subtasks.append(
                Subtask(id=names[each.id], skill=each.skill, robot=each.robot, params=each.params, after=after)
            )
        elif (found := _instead(each, catalogue, robots or (), so_far)) is not None:
            skill, robot, params = found
            subtasks.append(Subtask(id=names[each.id], skill=skill, robot=robot, params=params, after=after))
        else:
            stuck.append(f"{each.id} ({each.skill}) has failed and no alternative to it is known: {each.reason}")
    if stuck:
        raise PlanError(
            "rules cannot plan around a failure",
            problems=tuple(stuck),
            remedy="configure a model (llm.local_model or llm.upstream_url), or give a new instruction",
        )
    domains = [catalogue.skills[each.skill].domain for each in subtasks if each.skill in catalogue.skills]
    return Plan(domain=domains[0] if domains else "", subtasks=tuple(subtasks), tier=Tier.RULES, confidence=CONFIDENCE)


def _instead(
    step: StepSoFar, catalogue: Catalogue, robots: Sequence[RobotInfo], so_far: SoFar
) -> tuple[str, str | None, dict[str, Any]] | None:
    """A skill in place of a failed one, its robot and parameters: breadth first over declared alternatives."""
    failed = {(each.skill, each.robot) for each in so_far.of("failed")}
    queue: list[tuple[str, Mapping[str, Any]]] = [(step.skill, step.params)]
    seen = {step.skill}
    for name, params in queue:
        manifest = catalogue.skills.get(name)
        for choice in manifest.alternatives if manifest is not None else ():
            other = catalogue.skills.get(choice.skill)
            if other is None or choice.skill in seen:
                continue
            seen.add(choice.skill)
            given = {key: params[text[1:]] if text.startswith("$") else text for key, text in choice.params.items()
                     if not text.startswith("$") or text[1:] in params}  # fmt: skip
            queue.append((choice.skill, given))
            robot = _robot(step, other, robots)
            complete = all(not param.required or given.get(key) for key, param in other.params.items())
            if other.implemented and complete and robot != "" and (other.id, robot) not in failed:
                return other.id, robot, given
    return None


def _robot(step: StepSoFar, manifest: SkillManifest, robots: Sequence[RobotInfo]) -> str | None:
    """The robot for it: the same if it can, else any that can; "" when there is none, None when none is needed."""
    if manifest.runs == "compute":
        return None
    fitting = sorted(each.id for each in robots if each.online and not able(each, manifest))
    if step.robot in fitting:
        return step.robot
    return fitting[0] if fitting else ""


MAX_CHARACTERS = 4000
"""Longer text is no plain instruction."""


def read(context: PlanContext, catalogue: Catalogue) -> tuple[Plan, Reading]:
    """Parse an instruction; pure. The plan may be empty or not valid: the caller decides.

    Raises:
        PlanError: the instruction is empty or too long, or asks for too much at once.
    """
    text = context.instruction.strip()
    if not text:
        raise PlanError("the instruction is empty", remedy="say what a robot shall do")
    if len(text) > MAX_CHARACTERS:
        raise PlanError(
            f"the instruction has {len(text)} characters", remedy=f"at most {MAX_CHARACTERS}; give it in parts"
        )
    reading = Parser(catalogue, robots=context.robots, site=context.site).parse(text)
    domain = domain_of(reading.subtasks, catalogue)
    return Plan(domain=domain, subtasks=reading.subtasks, tier=Tier.RULES, confidence=reading.confidence), reading


UNDERSTOOD = 0.97
"""Share of the words that the rules must understand: half an instruction carried out is a wrong one."""
HALF_UNDERSTOOD = 0.05
"""How sure a plan is from which words are missing: of the held-out instructions with 0.8 to 0.97 one in nine was right,
of shorter ones none."""


class RulesTier:
    """Plans by rules."""

    name = Tier.RULES
    repairs = False

    def __init__(self, catalogue: Catalogue) -> None:
        self._catalogue = catalogue

    async def start(self) -> None:
        """Nothing to make ready."""

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Parse; PlanError names what was not understood when nothing was."""
        del previous, problems
        if context.so_far is not None:
            plan = mend(context.so_far, self._catalogue, context.robots)
            return Proposal(plan=plan, confidence=plan.confidence)
        # In a thread: a long text takes a quarter of a second, and the loop has leases to keep.
        plan, reading = await asyncio.to_thread(read, context, self._catalogue)
        lost = tuple(f"not understood: {piece!r}" for piece in reading.lost)
        if not plan.subtasks:
            raise PlanError(
                "the instruction was not understood",
                problems=lost,
                remedy='use plain orders, such as "Robot_1: go to goal 2, then photograph the shelf"',
            )
        sure = odds_right(reading.confidence, words=len(context.instruction.split()), subtasks=len(plan.subtasks))
        if reading.confidence < UNDERSTOOD:
            sure = min(sure, HALF_UNDERSTOOD)
        return Proposal(plan=plan, confidence=sure, problems=lost)

    async def close(self) -> None:
        """Nothing to release."""
