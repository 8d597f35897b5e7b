"""Configuration of the planner, and the words its callers use with it.

They stand apart from the cascade so that whoever only passes them on (the RPC verbs, the terminal UI, the
configuration file) imports nothing that plans.
"""

from pathlib import Path

from msgspec import Struct

from appliance.errors import ConfigError
from appliance.llm.so_far import SoFar
from appliance.model import Plan, RobotInfo, Site

KNOWN_TIERS = ("local", "upstream", "rules")
"""Tiers that can be named in the configuration."""


class LlmConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which planners are asked, in which order, for how long, and how sure they must be."""

    tiers: tuple[str, ...] = KNOWN_TIERS
    """Order of asking: cheapest model first, then the larger one, and the rules when no model can answer. A tier
    that is not configured (no folder, no URL) is left out."""

    local_model: str = ""
    """Folder of an onnxruntime-genai model; empty: this gateway has no local tier."""
    local_deadline_s: float = 20.0
    """A small model on two cores takes a second or two for a long plan; beyond this something is wrong."""
    local_start_s: float = 120.0
    """Loading a model and its fixed prompt; large int4 models take tens of seconds on slow disks."""
    local_min_confidence: float = 0.6
    """Below it the next tier is asked; the slot's margins are not calibrated for every model, so not too strict."""
    local_max_words: int = 150
    """Longer instructions go straight to the next tier: small models lose track in long ones."""
    local_max_tokens: int = 8192
    """Bound of prompt and answer together; the catalogue takes some 2,500. The model's context bounds it too."""
    local_threads: int = 0
    """Threads of the slot; 0: as the model's configuration says. Two help prefill, one is as good for decoding."""

    upstream_url: str = ""
    """Base URL of an OpenAI-compatible server, such as `http://server:8000/v1`; empty: no upstream tier."""
    upstream_model: str = ""
    """Name of the model there."""
    upstream_key_file: str = ""
    """File that holds the API key; a file, so that the key is in no process list and no configuration dump."""
    upstream_deadline_s: float = 30.0
    """One plan, retries and repair apart; hosted models answer in 1-5 s (paper: 1.28 s)."""
    upstream_retries: int = 1
    """Further tries after a connection failure or a 429/5xx answer."""
    upstream_min_confidence: float = 0.5
    """A server that gives no log-probabilities counts as 0.9 sure of a valid plan."""
    upstream_max_tokens: int = 4096
    """Longest answer asked for."""

    rules_deadline_s: float = 5.0
    """The parser needs milliseconds; the bound is for hostile text."""
    rules_min_confidence: float = 0.8
    """Share of the instruction the parser must have understood: half an instruction carried out is a wrong one."""

    floor_confidence: float = 0.3
    """A valid plan that no tier was sure enough of is still taken, when nothing better came, down to this."""
    repair: bool = True
    """Ask a model once more, with the validator's problems, when its plan is not valid."""
    require_implemented: bool = True
    """Refuse plans with skills that have no handler on this fleet; off only to measure planners."""

    def check(self) -> None:
        """Check what types cannot tell; ConfigError names the key."""
        for name in self.tiers:
            if name not in KNOWN_TIERS:
                raise ConfigError(f"llm.tiers: no tier {name!r}", remedy=f"use {', '.join(KNOWN_TIERS)}")
        if len(set(self.tiers)) != len(self.tiers) or not self.tiers:
            raise ConfigError("llm.tiers: each tier once, at least one", remedy=f"use {', '.join(KNOWN_TIERS)}")
        for key in ("local_deadline_s", "local_start_s", "upstream_deadline_s", "rules_deadline_s"):
            if not 0 < getattr(self, key) <= 3600:
                raise ConfigError(f"llm.{key}: {getattr(self, key)}", remedy="give seconds between 0 and 3600")
        for key in ("local_min_confidence", "upstream_min_confidence", "rules_min_confidence", "floor_confidence"):
            if not 0 <= getattr(self, key) <= 1:
                raise ConfigError(f"llm.{key}: {getattr(self, key)}", remedy="give a number from 0 to 1")
        if not 0 <= self.upstream_retries <= 5:
            raise ConfigError(f"llm.upstream_retries: {self.upstream_retries}", remedy="give 0 to 5")
        if not 256 <= self.local_max_tokens <= 65536 or not 64 <= self.upstream_max_tokens <= 65536:
            raise ConfigError("llm: local_max_tokens or upstream_max_tokens", remedy="give 256 to 65536 tokens")
        if self.upstream_url and not self.upstream_url.startswith(("http://", "https://")):
            raise ConfigError(f"llm.upstream_url: {self.upstream_url!r}", remedy="start it with http:// or https://")
        if self.upstream_url and not self.upstream_model:
            raise ConfigError("llm.upstream_model is missing", remedy="name the model that upstream_url serves")
        if self.upstream_key_file and not Path(self.upstream_key_file).is_file():
            raise ConfigError(f"llm.upstream_key_file: no file {self.upstream_key_file}", remedy="write the key to it")


class PlanContext(Struct, frozen=True, kw_only=True):
    """What is known when an instruction arrives."""

    instruction: str
    robots: tuple[RobotInfo, ...] | None = None
    """The roster; None when it is unknown, which an empty one is not."""
    site: Site | None = None
    so_far: SoFar | None = None
    """What has become of an earlier plan for it; with it the rest is to be planned anew."""
    private: bool = False
    """The text must not leave this machine: the upstream tier is not asked."""


class TierAttempt(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What one tier made of an instruction; `problems` says why its plan was not taken."""

    tier: str
    ok: bool
    confidence: float = 0.0
    latency_ms: float = 0.0
    problems: tuple[str, ...] = ()


class PlanOutcome(Struct, frozen=True, kw_only=True):
    """The plan that is taken, and every tier that was asked on the way."""

    plan: Plan
    attempts: tuple[TierAttempt, ...] = ()
