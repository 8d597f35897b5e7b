"""Handing in many tasks: in their order, as fast as the fleet takes them.

So many submissions are under way at once that each takes about `TARGET_S`: more while they are quick, fewer while they
are slow (additive increase, multiplicative decrease, as TCP has it), so the fleet's own work and other senders go on. A
gateway that cannot take one says when to come back; nothing further is handed in until then, and what was sent away is
the next.
"""

import asyncio
import heapq
import time
from collections.abc import AsyncGenerator, Iterable

from appliance.client import FleetClient
from appliance.errors import DeadlineError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import TaskRecord, TaskRequest

TARGET_S = 0.15
"""How long a submission should take; beyond it fewer are under way at once."""
LEAST_AT_ONCE, MOST_AT_ONCE = 8, 64
"""Under way at once: so few are no burden even to a fleet that has no time, and enough for it to see that tasks are
being handed in, which it puts before taking them up."""
TRIES = 3
"""How often one is handed in to a fleet that does not answer; each time gateways are looked for."""


class Pace:
    """How many submissions may be under way at once, by how the last ones went. Pure; the clock is passed in."""

    def __init__(self) -> None:
        self._window = float(LEAST_AT_ONCE)
        self.until = 0.0
        """Until when nothing is handed in, on the monotonic clock: a gateway has said so."""
        self.waits = ""
        """Why, in the gateway's words."""

    def at_once(self, now: float) -> int:
        """Return how many may be under way."""
        return 0 if now < self.until else int(self._window)

    def taken(self, took_s: float) -> None:
        """One was taken after so long."""
        if took_s <= TARGET_S:
            self._window = min(MOST_AT_ONCE, self._window + 1 / self._window)
        else:
            self._window = max(LEAST_AT_ONCE, self._window - 0.3)

    def sent_away(self, error: RefusedError, now: float) -> None:
        """One is to come back later."""
        if now >= self.until:  # of those that were under way together only the first makes it slower
            self._window = max(LEAST_AT_ONCE, self._window / 2)
        self.until, self.waits = max(self.until, now + error.retry_after_s), str(error)


async def submit_all(
    client: FleetClient, requests: Iterable[TaskRequest], *, pace: Pace | None = None
) -> AsyncGenerator[tuple[TaskRequest, TaskRecord | SwiftbotError]]:
    """Hand in tasks that have ids; yields each when it is durable, or with why it is not taken.

    Closed before its end, it hands in nothing more; what is under way may be taken.

    Args:
        client: of the fleet.
        requests: begun in this order; read as they are needed.
        pace: may be looked at for what is waited for.

    Raises:
        UnreachableError, DeadlineError: the fleet does not answer any more; what was not yielded may be handed in
            again, under the same ids.
    """
    pace = pace or Pace()
    source = ((number, request, 0) for number, request in enumerate(requests))
    again: list[tuple[int, TaskRequest, int]] = []
    """Number, request and tries of those that are to be handed in again."""
    under_way: dict[asyncio.Task[TaskRecord | SwiftbotError], tuple[int, TaskRequest, int, float]] = {}
    ended = False
    try:
        while not ended or again or under_way:
            while len(under_way) < pace.at_once(now := time.monotonic()):
                following = heapq.heappop(again) if again else next(source, None)
                if following is None:
                    ended = True
                    break
                work = asyncio.create_task(_handed_in(client, following[1]), name=f"submit {following[1].id}")
                under_way[work] = *following, now
            pause_s = max(0.0, pace.until - time.monotonic())
            if not under_way:
                await asyncio.sleep(pause_s)
                continue
            done, _ = await asyncio.wait(under_way, timeout=pause_s or None, return_when=asyncio.FIRST_COMPLETED)
            for work in sorted(done, key=lambda each: under_way[each][0]):
                number, request, tries, began = under_way.pop(work)
                outcome, now = work.result(), time.monotonic()
                if isinstance(outcome, RefusedError) and outcome.retry_after_s:
                    pace.sent_away(outcome, now)
                    heapq.heappush(again, (number, request, tries))
                    continue
                if isinstance(outcome, UnreachableError | DeadlineError):
                    if tries + 1 >= TRIES:
                        raise outcome
                    heapq.heappush(again, (number, request, tries + 1))
                    continue
                if isinstance(outcome, TaskRecord):
                    pace.taken(now - began)
                yield request, outcome
    finally:
        for work in under_way:
            work.cancel()
        await asyncio.gather(*under_way, return_exceptions=True)


async def _handed_in(client: FleetClient, request: TaskRequest) -> TaskRecord | SwiftbotError:
    try:
        return await client.submit_once(request)
    except SwiftbotError as error:
        return error
