"""Requests and replies of the planner's verbs, and what it tells of an instruction and of its experience."""

from typing import Annotated

from msgspec import Meta, Struct

from appliance.model import Plan, RobotInfo, Signed


class Constraint(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One of them. `value` in `unit`; a data set or a time of day stands in `text` alone."""

    kind: str
    text: str
    """As it was said."""
    value: float | None = None
    unit: str = ""


class Allocation(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a plan asks of pools, for one image and set of volumes."""

    image: str
    cpu: float
    memory_mb: int
    volumes: tuple[str, ...] = ()
    count: int = 1
    """Containers that are needed at the same time."""
    start_s: float = 0.0
    """Expected from the plan's beginning until the first is needed."""
    busy_s: float = 0.0
    """Expected from then until the last is done."""
    subtasks: tuple[str, ...] = ()
    seen_mb: float = 0.0
    """Most memory that runs of these skills took lately; 0: not known."""


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
    """How long the plan takes when nothing waits; of `unmeasured` skills 3 s are counted."""
    unmeasured: tuple[str, ...] = ()
    """Skills of the plan of which no run has been seen yet."""


class Row(Struct, frozen=True, kw_only=True):
    """The same, for people and for the store."""

    skill: str
    robot: str
    good: float
    """Successes, weighed by age."""
    bad: float
    reliability: float
    """Share of successes that is expected of the next runs."""
    expected_s: float | None = None
    peak_mb: float = 0.0
    durations_s: tuple[float, ...] = ()
    why: str = ""
    shunned: bool = False
    """Whether other robots are given the skill first."""
    age_s: float = 0.0


class ProposeAsk(Struct, frozen=True, kw_only=True):
    """`propose`: what does the local model of the asked gateway make of an instruction?"""

    instruction: str
    robots: tuple[RobotInfo, ...] | None = None
    """The roster of the gateway that asks, so that both mean the same robots."""


class Proposed(Struct, frozen=True, kw_only=True):
    """A plan that is not reviewed yet, and how sure the model is of it."""

    plan: Plan
    confidence: float
    model: str = ""


class SwapAsk(Signed, frozen=True, kw_only=True):
    """`llm_swap`: a folder on the asked gateway, made for onnxruntime-genai, or `embedded`."""

    folder: Annotated[str, Meta(min_length=1, max_length=1000)]


class Swapped(Struct, frozen=True, kw_only=True):
    """What a swap came to. It lasts until the gateway is restarted; `llm.local_model` is the lasting setting."""

    before: str
    """Folder name of the model before; empty: there was none."""
    after: str
    ms: float
    """From the order until the new one serves."""
    tests: tuple[str, ...]
    """What it made of each instruction of the self-test."""
