"""What a check says of a plan, and what it may look at. Pure."""

from collections.abc import Sequence
from functools import cached_property

from appliance.llm.checks.accounting import Account, account
from appliance.llm.checks.reading import Reading, read
from appliance.llm.safety.settings import SafetyConfig
from appliance.llm.settings import PlanContext
from appliance.model import Finding, Plan, Severity, Subtask
from appliance.skills.catalogue import Catalogue, SkillManifest

__all__ = ["Facts", "Finding", "Severity"]


class Facts:
    """A plan with everything that bears on it; what is derived is worked out once, when a check first asks.

    Args:
        plan: one of a form that decodes.
        context: the words, the roster, the site, who asks.
        catalogue: the skills there are.
        safety: the operator's policy.
        require_implemented: whether skills need a handler.
        edited: whether a person or a robot wrote the plan: the words then only give notes.
        confidence: how sure the planner is, 0 to 1.
        run_from: the confidence from which a plan runs unasked.
        added: ids of ways that the site made necessary (`completion`): no words ask for them.
    """

    def __init__(
        self,
        plan: Plan,
        context: PlanContext,
        catalogue: Catalogue,
        safety: SafetyConfig,
        *,
        require_implemented: bool = False,
        edited: bool = False,
        confidence: float = 1.0,
        run_from: float = 0.0,
        added: frozenset[str] = frozenset(),
    ) -> None:
        self.plan = plan
        self.context = context
        self.instruction = context.instruction
        self.robots = context.robots
        self.site = context.site
        self.continued = context.so_far is not None
        self.catalogue = catalogue
        self.safety = safety
        self.require_implemented = require_implemented
        self.edited = edited
        self.confidence = confidence
        self.run_from = run_from
        self.added = added

    @cached_property
    def reading(self) -> Reading:
        """The instruction, read."""
        names: list[str] = []
        for each in self.plan.subtasks:
            listed: object = each.params.get("robots")
            names += [str(name) for name in listed] if isinstance(listed, list | tuple) else []  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            names += [each.robot] if each.robot else []
        return read(self.instruction, self.robots, names)

    @cached_property
    def account(self) -> Account:
        """The plan, aligned with the words."""
        return account(self.reading, self.plan, self.catalogue, self.site)

    @cached_property
    def before(self) -> dict[str, set[str]]:
        """For each subtask all that come before it, directly or not."""
        from appliance.llm.checks.contradiction import precedes  # noqa: PLC0415 - it needs this module's neighbours

        return precedes(self.plan)

    def manifest(self, subtask: Subtask) -> SkillManifest | None:
        """Return the manifest of a subtask's skill."""
        return self.catalogue.skills.get(subtask.skill)

    def words(self, indices: Sequence[int]) -> str:
        """Return tokens as they stand in the text, without what lies between distant ones."""
        tokens = self.reading.tokens
        parts: list[str] = []
        last = -2
        for index in sorted(indices):
            text = self.reading.text[tokens[index].start : tokens[index].end]
            if index == last + 1 and parts:
                parts[-1] += self.reading.text[tokens[last].end : tokens[index].end]
            else:
                parts.append(text)
            last = index
        return " … ".join(" ".join(each.split()) for each in parts)
