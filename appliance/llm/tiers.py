"""The tiers that the configuration names, with the cascade's terms for each."""

from collections.abc import Callable
from pathlib import Path

from msgspec import Struct

from appliance.llm.routing import Budget
from appliance.llm.rules.tier import RulesTier
from appliance.llm.settings import LlmConfig, SafetyConfig
from appliance.llm.tier import Planner
from appliance.model import Tier
from appliance.skills.catalogue import Catalogue


class Slot(Struct, frozen=True, kw_only=True):
    """A tier with the cascade's terms for it."""

    planner: Planner
    deadline_s: float
    max_words: int = 100_000
    leaves_machine: bool = False
    instead_of: Tier | None = None
    """Asked only when that tier made no proposal at all: its second opinion would be the same."""


def configured(
    config: LlmConfig,
    catalogue: Catalogue,
    peers: Planner | None,
    pay: Callable[[], tuple[Budget, Callable[[], None]]],
    safety: SafetyConfig,
    check_model: Callable[[Path], None] = lambda _: None,
) -> tuple[Slot, ...]:
    """Return the tiers of a configuration, in order of asking.

    Args:
        config: which, and their terms.
        catalogue: the skills there are.
        peers: the tier that asks other gateways; None where there are none.
        pay: what upstream may cost, and whom to tell that it did.
        safety: the policy that the local tier chooses its answers by.
        check_model: raises IdentityError where a model's folder may not be loaded.
    """
    slots: list[Slot] = []
    for name in config.tiers:
        if name == Tier.LOCAL and config.local_model:
            slots.append(local(config, catalogue, safety, check_model))
        elif name == Tier.PEER and peers is not None:
            slots.append(
                Slot(
                    planner=peers,
                    deadline_s=config.peer_deadline_s * config.peer_tries + 1.0,
                    max_words=config.local_max_words,
                    leaves_machine=True,
                    instead_of=Tier.LOCAL,
                )
            )
        elif name == Tier.UPSTREAM and config.upstream_url:
            from appliance.llm.upstream import UpstreamTier  # noqa: PLC0415 - a gateway without must not pay for it

            slots.append(
                Slot(
                    planner=UpstreamTier(config, catalogue, *pay()),
                    deadline_s=config.upstream_deadline_s,
                    leaves_machine=True,
                )
            )
        elif name == Tier.RULES:
            slots.append(
                Slot(
                    planner=RulesTier(catalogue),
                    deadline_s=config.rules_deadline_s,
                )
            )
    return tuple(slots)


def local(
    config: LlmConfig,
    catalogue: Catalogue,
    safety: SafetyConfig | None = None,
    check_model: Callable[[Path], None] = lambda _: None,
) -> Slot:
    """Return the local tier for `config.local_model`."""
    from appliance.llm.local import LocalTier  # noqa: PLC0415 - a gateway without model must not pay for it

    return Slot(
        planner=LocalTier(config, catalogue, safety, check_model),
        deadline_s=config.local_deadline_s,
        max_words=config.local_max_words,
    )
