"""Votes on registers that were removed long ago are forgotten, where all voters agree that they were.

A removal is a value like any other, and every voter remembers its vote on it. To drop such a vote is safe only when no
voter can bring back what was there before: none may hold an older value, and none may accept one that is still on its
way. So a voter asks all the others first (`register.forgettable`), and promises for good what it had promised for that
register, for all registers of which it remembers nothing (the floor). CASPaxos (section 3.1) does the same with the
ages of proposers.
"""

import asyncio
import time

import structlog

from appliance.errors import SwiftbotError
from appliance.plane.quorum import register
from appliance.plane.quorum.voter import GONE, VOTE
from appliance.plane.quorum.voting import Voting
from appliance.plane.store import Store

log = structlog.get_logger(__name__)

EVERY_S = 300.0
_MOST = 64
"""Registers looked at in one go, each a question to its voters: the rest has its turn."""


class Forgetting:
    """Tidies one voter's votes. `kept_hours`: how long a removal is remembered (`plane.tombstone_hours`)."""

    def __init__(self, voting: Voting, *, gateway: str, store: Store, kept_hours: float) -> None:
        self._voting = voting
        self._gateway = gateway
        self._store = store
        self._kept_ns = int(kept_hours * 3.6e12)
        self._after = ""
        self._running: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Look now and then."""
        self._running = asyncio.create_task(self._run(), name="forget removed registers")

    async def _run(self) -> None:
        while True:
            await asyncio.sleep(EVERY_S)
            try:
                await self.forget(time.time_ns() - self._kept_ns)
            except Exception:  # supervision boundary: what could not be forgotten now is looked at again
                log.exception("forgetting removed registers failed")

    async def forget(self, before_ns: int) -> int:
        """Forget registers whose removal was accepted here before that; returns how many.

        Args:
            before_ns: Unix nanoseconds of this machine's clock, which also noted the removal.
        """
        done = 0
        due = [key for key, at in await self._store.scan(GONE) if int(at) < before_ns]
        page = [key for key in due if key > self._after][:_MOST]
        self._after = page[-1] if len(page) == _MOST else ""
        for key in page:
            try:
                done += await self._forget_one(key.removeprefix(GONE))
            except SwiftbotError as error:
                log.debug("a removed register is kept", key=key, reason=str(error))
        if done:
            log.info("removed registers were forgotten", registers=done)
        return done

    async def _forget_one(self, key: str) -> bool:
        raw = await self._store.get(VOTE + key)
        vote = self._voting.voter.read_vote(raw)
        if raw is None or vote.record is None or not vote.record.deleted:
            await self._store.delete(GONE + key)  # written anew since, or forgotten when this process ended
            return False
        voters = self._voting.voters(key)
        if not self._voting.voter.votes or self._gateway not in voters:
            return False
        told = [(each.vote, each.plain) for each in await self._voting.told(key)]
        if not register.forgettable(vote, await self._store.record(key), told, len(voters)):
            if len(told) == len(voters) - 1 and voters[0] == self._gateway:
                # Somebody lags: brought up to date now, it is forgotten by and by.
                await self._voting.everywhere(key)
            return False
        # First the promise, then what it stands for: whatever comes between is kept out either way.
        await self._voting.voter.raise_floor(vote.promised)
        if not await self._store.delete(VOTE + key, only=raw):
            return False
        await self._store.delete(GONE + key)
        self._voting.let_go(key)
        return True

    async def close(self) -> None:
        """Look no more."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)
