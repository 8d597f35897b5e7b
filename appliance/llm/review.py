"""The review of a plan: one ordered list of named checks, run once for each candidate, wherever it comes from. Pure.

Local, peer and upstream models, the cache, the rules, robots, templates and people hand in plans; all pass here. A
check gives findings; the worst severity decides: `refuse` (it cannot run), `hold` (an operator approves it first) or
run. No check can take back what another found, so the order of the list only orders the text. Of a plan that a person
wrote or edited, checks of the words give notes: what they typed is the plan.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from appliance.llm.checks import consistency, robots, things, wording
from appliance.llm.checks.consistency import contradictions
from appliance.llm.checks.facts import Facts
from appliance.llm.checks.safety import policy_holds, ungrounded, unsafe
from appliance.llm.checks.schema import MAX_PROBLEMS, validate
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.model import SPLIT, Finding, Plan, Severity, Verdict
from appliance.skills.catalogue import Catalogue

__all__ = ["CHECKS", "Check", "Facts", "Review", "review"]


class Check(NamedTuple):
    """A named check."""

    name: str
    run: Callable[[Facts], Iterable[Finding]]
    words: bool = False
    """Whether it is about the words: of an edited plan it then gives notes."""


class Review(Struct, frozen=True, kw_only=True):
    """What the checks found of one plan."""

    findings: tuple[Finding, ...] = ()
    confidence: float = 1.0
    """How sure the plan is, on the one scale of all tiers."""

    @property
    def decision(self) -> Verdict:
        """What becomes of the plan."""
        severities = {each.severity for each in self.findings}
        if Severity.REFUSE in severities:
            return Verdict.REFUSE
        return Verdict.HOLD if Severity.HOLD in severities else Verdict.RUN

    @property
    def problems(self) -> tuple[str, ...]:
        """Why it cannot run, each as a sentence."""
        return tuple(each.message for each in self.findings if each.severity is Severity.REFUSE)

    @property
    def holds(self) -> tuple[str, ...]:
        """Why an operator approves it first, each as a sentence."""
        return tuple(each.message for each in self.findings if each.severity is Severity.HOLD)

    @property
    def doubts(self) -> int:
        """How many findings hold it that another plan for the same words might not have."""
        return sum(each.severity is Severity.HOLD and each.check not in INTRINSIC for each in self.findings)


def review(facts: Facts) -> Review:
    """Run all checks on a plan; those of the words only on one whose form is right."""
    found: list[Finding] = []
    formed = True
    for check in CHECKS:
        if not formed and check.name not in _OF_ANY_FORM:
            continue  # what cannot be a plan cannot be compared with words
        if facts.continued and check.words and check.name not in _OF_A_REST:
            continue  # the rest of a task accounts for the rest of the words
        for each in check.run(facts):
            softened = check.words and facts.edited and each.severity is not Severity.NOTE
            found.append(replace(each, severity=Severity.NOTE) if softened else each)
        formed = formed and not (check.name == "schema" and found)
        if len(found) >= MAX_PROBLEMS:
            break
    sure = _accounted(facts, found)
    if sure < facts.run_from and not facts.edited:
        text = f"the planner is {sure:.2f} sure, and plans run unasked from {facts.run_from:.2f}"
        found = [*found[: MAX_PROBLEMS - 1], Finding(check="confidence", severity=Severity.HOLD, message=text)]
    return Review(findings=tuple(found[:MAX_PROBLEMS]), confidence=sure)


ACCOUNTED = 0.55
"""What a plan that accounts for every word is sure of beside its planner: of the cases of `swiftbot bench intent` 201
of 207 such plans were right whose planner was 0.1 to 0.6 sure, 808 of 809 above that, and 9 of 14 below it."""


def _accounted(facts: Facts, found: Sequence[Finding]) -> float:
    """How sure a plan is, on the one scale of all tiers: its planner's probability, and whether all words are in it."""
    if facts.continued or any(each.severity is not Severity.NOTE and each.check not in INTRINSIC for each in found):
        return facts.confidence
    return round(ACCOUNTED + (1 - ACCOUNTED) * facts.confidence, 4)


def reasons(context: PlanContext, catalogue: Catalogue) -> tuple[Finding, ...]:
    """Return what of an instruction no plan of any planner accounts for: the real reason where none had a plan."""
    empty = Facts(Plan(domain="", subtasks=()), context, catalogue, SafetyConfig())
    checks = (
        wording.time,
        wording.negation,
        wording.exception,
        wording.condition,
        wording.alternative,
        wording.question,
    )
    return tuple(each for check in checks for each in check(empty) if each.severity is not Severity.NOTE)


def _refusing(name: str, problems: Callable[[Facts], Iterable[str]]) -> Callable[[Facts], Iterable[Finding]]:
    def run(facts: Facts) -> Iterable[Finding]:
        for text in problems(facts):
            hint = SPLIT if text.endswith(SPLIT) else ""
            yield Finding(check=name, severity=Severity.REFUSE, message=text.removesuffix(f": {SPLIT}"), hint=hint)

    return run


def _schema(facts: Facts) -> Iterable[str]:
    return validate(
        facts.plan, facts.catalogue, robots=facts.robots, site=facts.site, require_implemented=facts.require_implemented
    )


def _policy(facts: Facts) -> Iterable[str]:
    return unsafe(facts.plan, facts.context, facts.catalogue, facts.safety)


def _grounding(facts: Facts) -> Iterable[str]:
    return ungrounded(facts.plan, facts.context, facts.added) if facts.safety.grounded else ()


def _consistency(facts: Facts) -> Iterable[Finding]:
    """The annotation rules of plans: what breaks one is never sure enough to run unasked."""
    meaning = consistency.Meaning(
        instruction=facts.instruction,
        robots=tuple(each.id for each in facts.robots or ()),
        domain=facts.plan.domain,
        subtasks=facts.plan.subtasks,
    )
    for text in consistency.problems(meaning, facts.catalogue, style=False):
        yield Finding(check="consistency", severity=Severity.HOLD, message=text)


CHECKS: tuple[Check, ...] = (
    Check("schema", _refusing("schema", _schema)),
    Check("contradiction", _refusing("contradiction", lambda facts: contradictions(facts.plan, facts.catalogue))),
    Check("policy", _refusing("policy", _policy)),
    Check("grounding", _refusing("grounding", _grounding), words=True),
    Check("negation", wording.negation, words=True),
    Check("exception", wording.exception, words=True),
    Check("condition", wording.condition, words=True),
    Check("time", wording.time, words=True),
    Check("alternative", wording.alternative, words=True),
    Check("correction", wording.correction, words=True),
    Check("question", wording.question, words=True),
    Check("condition", wording.late_waits, words=True),
    Check("names", wording.told_values, words=True),
    Check("negation", wording.left_alone, words=True),
    Check("assignment", wording.shared_figures, words=True),
    Check("sequence", wording.said_first, words=True),
    Check("pronoun", wording.pronoun, words=True),
    Check("names", wording.names, words=True),
    Check("quantity", wording.quantity, words=True),
    Check("polarity", wording.polarity, words=True),
    Check("polarity", wording.leaving, words=True),
    Check("delivery", wording.delivery, words=True),
    Check("coverage", wording.coverage, words=True),
    Check("sequence", wording.sequence, words=True),
    Check("repeated", wording.repeated, words=True),
    Check("unseen", wording.unseen, words=True),
    Check("unnamed_robot", robots.unnamed_robot, words=True),
    Check("choose_robot", robots.choose_robot, words=True),
    Check("idle_robot", robots.idle_robot, words=True),
    Check("capability", robots.flies, words=True),
    Check("assignment", robots.assignment, words=True),
    Check("assignment", robots.each_of_group, words=True),
    Check("quantity", robots.group_size, words=True),
    Check("elsewhere", things.elsewhere),
    Check("not_held", things.not_held, words=True),
    Check("unknown_thing", things.unknown_thing, words=True),
    Check("names", things.odd_names, words=True),
    Check("quantity", things.counted, words=True),
    Check("names", things.other_point, words=True),
    Check("unknown_place", things.unknown_place, words=True),
    Check("consistency", _consistency, words=True),
    Check("approval", policy_holds),
)
"""In the order in which their findings are listed."""
_OF_ANY_FORM = frozenset(("schema", "contradiction", "consistency", "approval"))
"""Checks that survive any plan that decodes."""
_OF_A_REST = frozenset(("grounding",))
"""Checks of the words that hold for the rest of a task, too."""
INTRINSIC = frozenset(("choose_robot", "approval", "unseen", "elsewhere"))
"""Checks whose findings another plan for the same words would have too: no further planner is asked."""
