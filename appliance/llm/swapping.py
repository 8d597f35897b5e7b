"""Changing the local model of a running gateway: also of one that has had none so far."""

import time
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.llm.api import Swapped
from appliance.llm.embedded import folder_of
from appliance.llm.local import LocalTier
from appliance.llm.settings import KNOWN_TIERS, LlmConfig
from appliance.llm.tiers import Slot, local
from appliance.model import Tier
from appliance.skills.catalogue import Catalogue


async def swap(
    slots: Sequence[Slot], folder: str, config: LlmConfig, catalogue: Catalogue
) -> tuple[tuple[Slot, ...], Swapped]:
    """Have the local tier use another model; returns the tiers from then on.

    Raises:
        ConfigError: `llm.tiers` has no local tier.
        SwiftbotError: as `LocalTier.swap`; nothing has changed then.
    """
    began = time.monotonic()
    if Tier.LOCAL not in config.tiers:
        raise ConfigError("llm.tiers has no local tier", remedy='add "local" to llm.tiers and restart')
    here = next((slot.planner for slot in slots if isinstance(slot.planner, LocalTier)), None)
    if here is not None:
        before = here.model
        tests = await here.swap(folder)
        after = tuple(slots)
    else:
        before, slot = "", local(replace(config, local_model=folder), catalogue)
        planner = slot.planner
        assert isinstance(planner, LocalTier)  # noqa: S101 - `local` makes nothing else
        try:
            await planner.start()
            tests = await planner.self_test()
        except BaseException:
            await planner.close()
            raise
        after = tuple(sorted((*slots, slot), key=lambda each: _place(each, config)))
    ms = round(1000 * (time.monotonic() - began), 1)
    return after, Swapped(before=before, after=Path(folder_of(folder)).name, ms=ms, tests=tests)


def _place(slot: Slot, config: LlmConfig) -> int:
    order = [*config.tiers, *KNOWN_TIERS]
    return order.index(slot.planner.name.value) if slot.planner.name.value in order else len(order)
