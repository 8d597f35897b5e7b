"""What operators and other gateways ask of a pool: warm this, give up that, start again what would not start.

It exists apart from the door because nothing here is on a run's way. Every answer says what was done, or why not and
what to do about it.
"""

import asyncio
import contextlib
from collections import Counter

import structlog
from msgspec.structs import replace

from appliance.errors import NotFoundError, PayloadError, RefusedError
from appliance.model import ContainerInfo, ContainerState, PoolHint
from appliance.pool.api import (
    DecisionList,
    DecisionsAsk,
    EvictAsk,
    Evicted,
    Hinted,
    ReleaseAsk,
    Released,
    WarmAsk,
    Warmed,
)
from appliance.pool.keeper import Keeper
from appliance.pool.policies.hints import OPERATOR
from appliance.pool.settings import PoolConfig
from appliance.skills.catalogue import Catalogue

log = structlog.get_logger(__name__)

MOST_AHEAD_S = 86400.0
"""A day: nobody plans further ahead, and nothing is kept ready for longer on one word."""
MOST_WAIT_S = 60.0
"""An answer that is waited for longer is not wanted any more."""


class Verbs:
    """The pool's verbs, as the gateway serves them over RPC (`pool/api.py` has the structs)."""

    def __init__(
        self, config: PoolConfig, keeper: Keeper, *, gateway: str, catalogue: Catalogue, refused: Counter[str]
    ) -> None:
        self._config = config
        self._keeper = keeper
        self._gateway = gateway
        self._catalogue = catalogue
        self._refused = refused

    async def hint(self, hint: PoolHint) -> Hinted:
        """Take note of what another gateway's plan will need here; best effort. A count of 0 takes it back.

        Raises:
            NotFoundError: there is no such image.
            PayloadError: numbers that cannot be.
        """
        self._check_image(hint.image)
        if not (hint.count >= 0 and 0 <= hint.in_s <= MOST_AHEAD_S and 0 < hint.keep_s <= MOST_AHEAD_S):
            self._refused["bad hint"] += 1
            raise PayloadError(
                f"{hint.count} containers in {hint.in_s:g} s for {hint.keep_s:g} s cannot be had ready",
                remedy=f"none or more, within and for at most {MOST_AHEAD_S:g} s",
            )
        if why := self._no_warming():
            return Hinted(taken=False, why=why)
        self._keeper.planning.hinted(replace(hint, count=min(hint.count, self._config.capacity)))
        return Hinted(taken=True)

    async def warm(self, ask: WarmAsk) -> Warmed:
        """Have containers of an image ready; answers at once, or when those that start are there.

        Raises:
            NotFoundError: there is no such image.
            PayloadError: numbers that cannot be.
            RefusedError: draining, mode cold, or none more can be started, with the reason.
        """
        self._check_image(ask.image)
        if not (ask.count >= 1 and 0 < ask.keep_s <= MOST_AHEAD_S and 0 <= ask.wait_s <= MOST_WAIT_S):
            self._refused["bad warm"] += 1
            raise PayloadError(
                f"{ask.count} containers for {ask.keep_s:g} s, answered within {ask.wait_s:g} s, cannot be had ready",
                remedy=f"at least one, for at most {MOST_AHEAD_S:g} s, waiting at most {MOST_WAIT_S:g} s",
            )
        if why := self._no_warming():
            raise RefusedError(why)
        counted = self._count(ask.image)
        if sum(counted) < ask.count and (why := self._keeper.planning.why_no_start(ask.image)):
            self._refused["no room to warm"] += 1
            raise RefusedError(why, remedy="swiftbot pool evict something, raise pool.memory_mb, or wait")
        self._keeper.planning.hinted(PoolHint(image=ask.image, count=ask.count, keep_s=ask.keep_s, task=OPERATOR))
        if ask.wait_s:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(ask.wait_s):
                    await self._keeper.have(ask.image, ask.count)
        ready, starting = self._count(ask.image)
        problem = ""
        if ready + starting < ask.count:
            problem = self._keeper.planning.why_no_start(ask.image) or "they are started as soon as others have been"
        return Warmed(image=ask.image, ready=ready, starting=starting, problem=problem)

    async def evict(self, ask: EvictAsk) -> Evicted:
        """Give up one idle container, or all idle ones of an image.

        Raises:
            NotFoundError: there is no such container or image.
            PayloadError: none is named, or both.
            RefusedError: the one that is named works.
        """
        if bool(ask.container) == bool(ask.image):
            raise PayloadError("neither a container nor an image is named, or both", remedy="name one of the two")
        if ask.image:
            self._check_image(ask.image)
        held = [each for each in self._keeper.books.facts() if each.id == ask.container or each.image == ask.image]
        if ask.container and not held:
            known = ", ".join(each.id for each in self._keeper.books.facts())
            raise NotFoundError(f"no container {ask.container[:60]!r} here", remedy=f"there are: {known or 'none'}")
        kept = {each.id: why for each in held if (why := _why_kept(each))}
        if ask.container in kept:
            raise RefusedError(
                f"container {ask.container} is not idle: {kept[ask.container]}",
                remedy="wait for its run to end, or cancel the task",
            )
        gone = tuple(each.id for each in held if each.id not in kept)
        for each in gone:
            self._keeper.give_up(each, "an operator gave it up")
        floors = {each.image: self._config.floor.get(each.image, 0) for each in held if each.id not in kept}
        note = "; ".join(f"the floor keeps {count} of {image}" for image, count in floors.items() if count)
        return Evicted(containers=gone, kept=kept, note=note)

    async def release_quarantine(self, ask: ReleaseAsk) -> Released:
        """Start containers of an image again that kept failing.

        Raises:
            NotFoundError: there is no such image.
            RefusedError: it is not in quarantine.
        """
        self._check_image(ask.image)
        reason = self._keeper.release_quarantine(ask.image)
        if not reason:
            raise RefusedError(f"image {ask.image} is not in quarantine", remedy="swiftbot fleet shows which are")
        log.info("quarantine released", image=ask.image, reason=reason)
        return Released(image=ask.image, reason=reason)

    async def decisions(self, ask: DecisionsAsk) -> DecisionList:
        """Return what was started and given up lately, and why."""
        return self._keeper.decisions.recent(ask.limit)

    def _count(self, image: str) -> tuple[int, int]:
        books = self._keeper.books
        return books.count(image, ContainerState.READY), books.count(image, ContainerState.STARTING)

    def _no_warming(self) -> str:
        if self._keeper.draining:
            return f"{self._gateway} is draining"
        return "pool.mode is cold: nothing is kept ready" if self._config.mode == "cold" else ""

    def _check_image(self, image: str) -> None:
        if image not in self._catalogue.images:
            raise unknown_image(image, self._catalogue, self._refused)


def unknown_image(image: str, catalogue: Catalogue, refused: Counter[str]) -> NotFoundError:
    """Count that an unknown image was asked for; returns the error to raise."""
    refused["unknown image"] += 1
    return NotFoundError(f"no image {image[:60]!r}", remedy=f"known: {', '.join(sorted(catalogue.images))}")


def _why_kept(info: ContainerInfo) -> str:
    """Return why a container cannot be given up now; empty when it can."""
    match info.state:
        case ContainerState.READY:
            return ""
        case ContainerState.BUSY:
            return f"it runs {info.run}"
        case ContainerState.RESERVED:
            return "a run is about to begin in it"
        case state:
            return f"it is {state}"
