"""The tiers that the configuration names, with the cascade's terms for each."""

from collections.abc import Callable

from msgspec import Struct

from appliance.llm.routing.budget import Budget
from appliance.llm.rules.tier import RulesTier
from appliance.llm.settings import LlmConfig
from appliance.llm.tier import Planner
from appliance.model import Tier
from appliance.skills.catalogue import Catalogue


class Slot(Struct, frozen=True, kw_only=True):
    """A tier with the cascade's terms for it."""

    planner: Planner
    deadline_s: float
    min_confidence: float
    max_words: int = 100_000
    leaves_machine: bool = False
    fallback: bool = True
    """Whether its valid plan may be taken, below its own threshold, when nothing better came."""
    grounded: bool = True
    """Whether its plans are held to the words of the instruction (`safety.grounding`): models invent, rules do not."""
    takes_doubtful: bool = False
    """Whether a plan that breaks a rule of plans may be taken before other tiers are asked: to measure this one."""
    instead_of: Tier | None = None
    """Asked only when that tier made no proposal at all: its second opinion would be the same."""


def configured(
    config: LlmConfig,
    catalogue: Catalogue,
    peers: Planner | None,
    pay: Callable[[], tuple[Budget, Callable[[], None]]],
) -> tuple[Slot, ...]:
    """Return the tiers of a configuration, in order of asking.

    Args:
        config: which, and their terms.
        catalogue: the skills there are.
        peers: the tier that asks other gateways; None where there are none.
        pay: what upstream may cost, and whom to tell that it did.
    """
    slots: list[Slot] = []
    for name in config.tiers:
        if name == Tier.LOCAL and config.local_model:
            slots.append(local(config, catalogue))
        elif name == Tier.PEER and peers is not None:
            slots.append(
                Slot(
                    planner=peers,
                    deadline_s=config.peer_deadline_s * config.peer_tries + 1.0,
                    min_confidence=config.local_min_confidence,
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
                    min_confidence=config.upstream_min_confidence,
                    leaves_machine=True,
                )
            )
        elif name == Tier.RULES:
            slots.append(
                Slot(
                    planner=RulesTier(catalogue),
                    deadline_s=config.rules_deadline_s,
                    min_confidence=config.rules_min_confidence,
                    # Below its threshold words were not understood: carrying out the rest would be inventing.
                    fallback=False,
                    grounded=False,
                )
            )
    return tuple(slots)


def local(config: LlmConfig, catalogue: Catalogue) -> Slot:
    """Return the local tier for `config.local_model`."""
    from appliance.llm.local import LocalTier  # noqa: PLC0415 - a gateway without model must not pay for it

    return Slot(
        planner=LocalTier(config, catalogue),
        deadline_s=config.local_deadline_s,
        min_confidence=config.local_min_confidence,
        max_words=config.local_max_words,
    )
