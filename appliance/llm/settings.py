"""Configuration of the planner and of plans' safety, and the types its callers use with it.

`LlmConfig` is the configuration's `llm`, `SafetyConfig` its `safety`; `folder_of` finds the model that
`llm.local_model` names, `embedded` being the one that comes with the program. `PlanContext` is a request: an
instruction with the roster, the site and, when the rest of a plan is to be replanned, what has become of the earlier
plan (`SoFar`). `PlanOutcome` is the answer.

They stand apart from the cascade so that modules that only pass them on (the RPC verbs, the terminal UI, the
configuration file, the model's own process) import nothing that plans.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from appliance.errors import ConfigError
from appliance.model import Plan, RobotInfo, Site, SubtaskState, TaskRecord, TierAttempt
from appliance.model.closures import Closure

EMBEDDED = "embedded"
_PACKAGE = Path(__file__).resolve().parents[1]
_IN_TREE = _PACKAGE.parent / "models" / "planner"
EMBEDDED_FOLDER = _IN_TREE if _IN_TREE.is_dir() else _PACKAGE / "data" / "planner"
"""The planner that comes with the program: `models/planner` of a source tree, `data/planner` of an installed one."""


def folder_of(model: str) -> str:
    """Return the folder of a model as the configuration names it: `embedded`, a path, or "" for none."""
    return str(EMBEDDED_FOLDER) if model == EMBEDDED else str(Path(model).expanduser()) if model else ""


def remedy_of(folder: str) -> str:
    """Return what to do about a folder that is no model's."""
    if Path(folder) == EMBEDDED_FOLDER:
        return 'this installation lacks its planner: install it again, or set llm.local_model to "" for none'
    return 'set llm.local_model to "embedded", to an onnxruntime-genai folder, or to "" for none'


Pattern = Annotated[str, Meta(min_length=1, max_length=100)]


class RobotLimits(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What certain robots may not do. All that match a robot hold for it, the strictest of each kind."""

    robots: tuple[Pattern, ...]
    """Shell patterns of robot ids, such as `drone_*`."""
    altitude_m: Annotated[float, Meta(ge=0)] | None = None
    """A plan that says more, or names a place that lies higher, is refused; a skill's usual take-off is lowered."""
    speed_mps: Annotated[float, Meta(gt=0)] | None = None
    """A plan that says more is refused; what a skill or robot would choose is lowered when the order is sent."""
    duration_s: Annotated[float, Meta(gt=0)] | None = None
    """A plan that says more is refused, and one that says none where the skill's usual time is above it or unknown."""
    skills_never: tuple[Pattern, ...] = ()
    """Shell patterns of skills."""
    places_never: tuple[Pattern, ...] = ()
    """Shell patterns of place names, lower case."""


class SafetyConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The safety policy: it can only tighten what roster, catalogue and site allow, of handed-in plans too."""

    skills_never: tuple[Pattern, ...] = ()
    """Shell patterns of skills that no plan may have."""
    places_never: tuple[Pattern, ...] = ()
    """Shell patterns of names (lower case) of places, areas and objects that no plan may send a robot to, beside the
    site's forbidden areas."""
    exclusive_places: tuple[Pattern, ...] = ()
    """Shell patterns of place names where only one robot may be at a time: a plan has to order their visits."""
    limits: tuple[RobotLimits, ...] = ()
    """Of single robots. An unnamed robot is held to the strictest that could be chosen."""
    robot_tasks: Literal["any", "own", "never"] = "any"
    """Whom a task that a robot asks for may command: `any` robot, only itself (`own`), or nobody (`never`)."""
    grounded: bool = True
    """Refuse a model's plan that names a robot, place, object or text of which the instruction says nothing: neither
    invention nor what was slipped into names and notes of robots becomes a subtask."""
    choose_robot: Literal["ask", "auto"] = "ask"
    """What becomes of an order that names no robot where several can do it: `ask` holds the plan until an operator
    approves the choice, `auto` lets the scheduler choose. Where only one robot can do it, that one does."""
    confirm_skills: tuple[Pattern, ...] = ()
    """Shell patterns of skills with which every plan waits until an operator agrees, such as `cut`."""

    def check(self) -> None:
        """Check what types cannot tell; ConfigError names the key."""
        for number, limits in enumerate(self.limits):
            if not limits.robots:
                raise ConfigError(f"safety.limits[{number}].robots is empty", remedy='give patterns of ids, or "*"')
        for key in ("places_never", "exclusive_places"):
            for each in getattr(self, key):
                if each != each.lower():
                    raise ConfigError(f"safety.{key}: {each!r}", remedy="write names in lower case")


MAX_REASON = 200


class StepSoFar(Struct, frozen=True, kw_only=True):
    """A subtask of the earlier plan. `state` is one of `done`, `running`, `failed`, `open`."""

    id: str
    skill: str
    robot: str | None
    params: dict[str, Any]
    after: tuple[str, ...]
    state: str
    reason: str = ""
    """Of a failed one: why."""


class SoFar(Struct, frozen=True, kw_only=True):
    """All subtasks of the earlier plan, in its order."""

    steps: tuple[StepSoFar, ...]

    def of(self, state: str) -> tuple[StepSoFar, ...]:
        """Return those of one state."""
        return tuple(each for each in self.steps if each.state == state)


_STATES = {
    SubtaskState.SUCCEEDED: "done",
    SubtaskState.DISPATCHED: "running",
    SubtaskState.RUNNING: "running",
    SubtaskState.FAILED: "failed",
}


def so_far(record: TaskRecord) -> SoFar:
    """Return what has become of a task's plan; a robot that was chosen is named."""
    return SoFar(
        steps=tuple(
            StepSoFar(
                id=each.subtask.id,
                skill=each.subtask.skill,
                robot=each.bound_robot or each.subtask.robot,
                params=each.subtask.params,
                after=each.subtask.after,
                state=_STATES.get(each.state, "open"),
                reason=each.failure.message[:MAX_REASON] if each.failure else "",
            )
            for each in record.subtasks
        )
    )


KNOWN_TIERS = ("local", "peer", "upstream", "rules")
"""Tiers that can be named in the configuration."""


class LlmConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which planners are asked, in which order, for how long, and how sure they must be."""

    tiers: tuple[str, ...] = KNOWN_TIERS
    """Order of asking: cheapest model first, then that of another gateway, then the larger one, and the rules when no
    model can answer. A tier that is not configured (no folder, no URL) or that nobody has (`peer`) is left out."""
    cache: int = 512
    """Plans kept of tasks that succeeded; the same instruction for the same fleet gets the same plan again. 0: none."""
    at_once: int = 4
    """Instructions planned at the same time; the local model answers one after the other in any case."""
    waiting: int = 64
    """Instructions that may wait for that; more are refused with the time after which to ask again. At a quarter of a
    second each, 64 are gone in the seconds that a person waits."""

    local_model: str = "embedded"
    """`embedded`: the planner that comes with the program; else the folder of an onnxruntime-genai model. Empty: this
    gateway has no local tier."""
    local_deadline_s: float = 20.0
    """A small model on two cores takes a second or two for a long plan; beyond this something is wrong."""
    local_start_s: float = 120.0
    """Loading a model and its fixed prompt; large int4 models take tens of seconds on slow disks."""
    local_max_words: int = 150
    """Longer instructions go straight to the next tier: small models lose track in long ones."""
    local_max_tokens: int = 8192
    """Bound of prompt and answer together; the catalogue takes some 2,500. The model's context bounds it too."""
    local_queue: int = 16
    """Instructions that may wait for the local model; beyond it the next tier is asked at once."""
    local_threads: int = 0
    """Threads of the slot; 0: as the model's configuration says. Two help prefill, one is as good for decoding."""

    peer_deadline_s: float = 8.0
    """A gateway that has a model answers in a second or two; then another is asked, and after that the next tier."""
    peer_tries: int = 2
    """Gateways asked for one instruction."""

    upstream_url: str = ""
    """Base URL of an OpenAI-compatible server, such as `http://server:8000/v1`; empty: no upstream tier."""
    upstream_model: str = ""
    """Name of the model there."""
    upstream_key_file: str = ""
    """File that holds the API key; a file, so that the key is in no process list and no configuration dump. Empty: the
    systemd credential `swiftbot-upstream-key` of the service, else the environment's `SWIFTBOT_UPSTREAM_KEY`."""
    upstream_deadline_s: float = 30.0
    """One plan, retries and repair apart; hosted models answer in 1-5 s (paper: 1.28 s)."""
    upstream_retries: int = 1
    """Further tries after a connection failure or a 429/5xx answer."""
    upstream_max_tokens: int = 4096
    """Longest answer asked for."""
    upstream_budget: float = 0.0
    """What the server may cost a day, in the currency of the prices; when it is spent the next tier is asked. 0: no
    bound."""
    upstream_requests: int = 0
    """Requests a day; 0: no bound."""
    upstream_price_in: float = 0.0
    """Price of a million prompt tokens."""
    upstream_price_out: float = 0.0
    """Price of a million answer tokens."""
    upstream_never: tuple[str, ...] = ()
    """Regular expressions: an instruction in which one is found never leaves this machine."""
    upstream_never_robots: tuple[str, ...] = ()
    """Shell patterns of robot ids: an instruction that names one never leaves this machine, and no server hears of
    them."""
    upstream_private_tag: str = "#private"
    """A word in an order that keeps it on this machine. Empty: there is none."""
    upstream_open_s: float = 15.0
    """After three failures in a row the server is left alone for so long, twice as long each time after, up to ten
    minutes: offline is normal, and must not cost each instruction a deadline."""

    rules_deadline_s: float = 5.0
    """The parser needs milliseconds; the bound is for hostile text."""

    run_confidence: float = 0.6
    """A plan runs unasked only if its planner is at least this sure, on the one scale of all tiers (the probability
    that the plan is right), and no check holds it. Below it the next tier is asked. Experience can raise it."""
    show_confidence: float = 0.1
    """A valid plan that is less sure than `run_confidence` is shown to an operator down to this, when nothing better
    came; below it the instruction is refused. Of the embedded planner's plans with 0.1 to 0.3 a quarter is right, of
    those below one in fifteen."""
    repair: bool = True
    """Ask a model once more, with the validator's problems, when its plan is not valid."""
    require_implemented: bool = True
    """Refuse plans with skills that have no handler on this fleet; off only to measure planners."""

    def check(self) -> None:
        """Check what types cannot tell; ConfigError names the key."""
        self._check_tiers()
        self._check_bounds()
        if self.upstream_url and not self.upstream_url.startswith(("http://", "https://")):
            raise ConfigError(f"llm.upstream_url: {self.upstream_url!r}", remedy="start it with http:// or https://")
        if self.upstream_url and not self.upstream_model:
            raise ConfigError("llm.upstream_model is missing", remedy="name the model that upstream_url serves")
        if self.upstream_key_file and not Path(self.upstream_key_file).is_file():
            raise ConfigError(f"llm.upstream_key_file: no file {self.upstream_key_file}", remedy="write the key to it")

    def _check_tiers(self) -> None:
        for name in self.tiers:
            if name not in KNOWN_TIERS:
                raise ConfigError(f"llm.tiers: no tier {name!r}", remedy=f"use {', '.join(KNOWN_TIERS)}")
        if len(set(self.tiers)) != len(self.tiers) or not self.tiers:
            raise ConfigError("llm.tiers: each tier once, at least one", remedy=f"use {', '.join(KNOWN_TIERS)}")

    def _check_bounds(self) -> None:
        for key in (
            *("local_deadline_s", "local_start_s", "peer_deadline_s"),
            *("upstream_deadline_s", "upstream_open_s", "rules_deadline_s"),
        ):
            if not 0 < getattr(self, key) <= 3600:
                raise ConfigError(f"llm.{key}: {getattr(self, key)}", remedy="give seconds between 0 and 3600")
        for key in ("run_confidence", "show_confidence"):
            if not 0 <= getattr(self, key) <= 1:
                raise ConfigError(f"llm.{key}: {getattr(self, key)}", remedy="give a number from 0 to 1")
        for key, low, high in (
            *(("cache", 0, 100_000), ("at_once", 1, 64), ("waiting", 0, 10_000)),
            *(("local_queue", 1, 10_000), ("peer_tries", 1, 8)),
        ):
            if not low <= getattr(self, key) <= high:
                raise ConfigError(f"llm.{key}: {getattr(self, key)}", remedy=f"give {low} to {high:,}")
        for key in ("upstream_budget", "upstream_requests", "upstream_price_in", "upstream_price_out"):
            if not 0 <= getattr(self, key) < 1e9:
                raise ConfigError(f"llm.{key}: {getattr(self, key)}", remedy="give a number from 0 on")
        if self.upstream_budget and not (self.upstream_price_in or self.upstream_price_out):
            raise ConfigError("llm.upstream_budget without prices", remedy="set llm.upstream_price_in and _out")
        for each in self.upstream_never:
            try:
                re.compile(each)
            except re.error as error:
                raise ConfigError(f"llm.upstream_never: {each!r}: {error}", remedy="see Python's `re`") from error
        if not 0 <= self.upstream_retries <= 5:
            raise ConfigError(f"llm.upstream_retries: {self.upstream_retries}", remedy="give 0 to 5")
        if not 256 <= self.local_max_tokens <= 65536 or not 64 <= self.upstream_max_tokens <= 65536:
            raise ConfigError("llm: local_max_tokens or upstream_max_tokens", remedy="give 256 to 65536 tokens")


class OutOfUse(Struct, frozen=True, kw_only=True):
    """What operators have taken out of use, by name, with why and until when in words; standing rules."""

    places: Mapping[str, str] = {}
    robots: Mapping[str, str] = {}
    rules: tuple[Closure, ...] = ()
    """Those that hold now."""


class PlanContext(Struct, frozen=True, kw_only=True):
    """What is known when an instruction arrives."""

    instruction: str
    robots: tuple[RobotInfo, ...] | None = None
    """The roster; None when it is unknown, which an empty one is not."""
    site: Site | None = None
    so_far: SoFar | None = None
    """What has become of an earlier plan for it; with it the rest is to be replanned."""
    private: bool = False
    """The text must not leave this machine: neither the upstream tier nor another gateway is asked."""
    submitter: str = ""
    """Who asks."""
    from_robot: bool = False
    """Whether that is a robot, whom the safety policy may allow less."""
    out_of_use: OutOfUse = OutOfUse()
    """Places that are closed, robots in maintenance, and standing rules."""


class PlanOutcome(Struct, frozen=True, kw_only=True):
    """The plan that is taken, and every tier that was asked on the way."""

    plan: Plan
    attempts: tuple[TierAttempt, ...] = ()
