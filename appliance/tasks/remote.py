"""Phase 2 of container selection, finding a ready container elsewhere (paper, Algorithm 1, distributed search).

The k successors of hash(image) are asked; each answers with the ready containers it knows of, its own and those
it has heard of. The cost of using one is the measured round trip to its gateway, kept as a moving average.
"""

import asyncio
import time

from appliance.errors import SwiftbotError
from appliance.model import ContainerInfo, ContainerState, Need
from appliance.plane.node import Plane
from appliance.pool.selection import Candidate
from appliance.tasks.api import ContainerList

ASK_TIMEOUT_S = 0.15
"""A neighbour slower than this is no help: a cold start costs about as much."""
UNKNOWN_ROUND_TRIP_MS = 5.0


class RemoteContainers:
    """Finds ready containers on other gateways, and answers when others look for ours."""

    def __init__(self, plane: Plane, *, successors: int) -> None:
        self._plane = plane
        self._successors = successors
        self._round_trip_ms: dict[str, float] = {}

    async def find(self, need: Need) -> list[Candidate]:
        """Ready containers on other gateways that could serve a need, each with its cost."""
        here = self._plane.gateway
        asked = [each for each in self._plane.ring.successors(f"image/{need.image}", self._successors) if each != here]
        found: dict[str, ContainerInfo] = {each.id: each for each in self._known(need)}
        answers = await asyncio.gather(*(self._ask(each, need) for each in asked))
        for containers in answers:
            # What a gateway says of its own containers is newer than what was heard.
            found.update({each.id: each for each in containers})
        members = self._plane.members()
        return [
            Candidate(container=each, cost_ms=self._round_trip_ms.get(each.gateway, UNKNOWN_ROUND_TRIP_MS))
            for each in found.values()
            if each.gateway != here and each.gateway in members
        ]

    async def _ask(self, gateway: str, need: Need) -> tuple[ContainerInfo, ...]:
        began = time.monotonic()
        try:
            answer = await self._plane.rpc.call(
                gateway, "find_containers", need, ContainerList, timeout_s=ASK_TIMEOUT_S
            )
        except SwiftbotError:
            return ()
        took_ms = (time.monotonic() - began) * 1e3
        before = self._round_trip_ms.get(gateway, took_ms)
        self._round_trip_ms[gateway] = 0.8 * before + 0.2 * took_ms
        return answer.containers

    def _known(self, need: Need) -> list[ContainerInfo]:
        return [
            each
            for containers in self._plane.registry.containers.values()
            for each in containers.values()
            if each.state is ContainerState.READY and (each.image == need.image or need.image in each.compatible)
        ]

    async def answer(self, need: Need) -> ContainerList:
        """Answer `find_containers`: the ready containers this gateway knows of."""
        return ContainerList(containers=tuple(self._known(need)))
