"""Quorum reads and writes between gateways: the shell round `register`.

Anybody may propose; so that proposers do not get into each other's way, everybody hands a change to the first voter
of the key that is seen, and that one does them one after the other. A read asks all voters at once and is done when
a majority has accepted the same; only where they differ the first voter settles it.
"""

import asyncio
import random
import secrets
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from typing import TypeVar
from weakref import WeakValueDictionary

import structlog
from msgspec import Struct

from appliance.errors import (
    ConflictError,
    DeadlineError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import VersionVector
from appliance.plane.membership import Membership
from appliance.plane.quorum import register
from appliance.plane.quorum.messages import AcceptAsk, Outcome, PrepareAsk, SettleAsk, VoteAsk, Voted
from appliance.plane.quorum.register import NONE, Ballot, check_vote, majority
from appliance.plane.quorum.voter import Voter
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import (
    Behind,
    Record,
    Resolver,
    Write,
    by_bytes,
    check_key,
    check_record,
    check_write,
    decide,
)

log = structlog.get_logger(__name__)

A = TypeVar("A", bound=Struct)

_PHASE_S = 1.0
"""One question to all voters; it ends as soon as a majority has answered, or cannot any more."""
_LEAD_S = 2.0
"""How long the first voter tries to get a change through; whoever asked it waits a little longer and asks another."""
_HANDED_S = 3.0
_AGAIN_S = 0.03
_BACK_OFF_S = (0.003, 0.03)
"""After another proposer was faster: drawn, so that two do not keep step."""
_MOST_LEADS = 4096
"""Registers whose next change needs no promise."""


class _OutrunError(Exception):
    """Another proposer has the higher ballot."""


class _NoMajorityError(Exception):
    """Fewer than a majority of the voters answer."""


class Voting:
    """One gateway's part in the registers: as a voter, as a proposer, and for its own callers."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc, membership: Membership) -> None:
        self.resolver: Callable[[], Resolver] = lambda: by_bytes
        self.learn: Callable[[Record], Awaitable[None]] | None = None
        """Told each value that was chosen here, for the ordinary records."""
        self._config = config
        self._gateway = gateway
        self._rpc = rpc
        self._membership = membership
        self.voter = Voter(config, gateway=gateway, store=store, rpc=rpc)
        self._proposer = f"{gateway}:{secrets.token_hex(6)}"
        self._round = 0
        self._leads: OrderedDict[str, tuple[Ballot, Record | None]] = OrderedDict()
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        rpc.register("quorum_write", Write, self._on_write, exchange=False)
        rpc.register("quorum_settle", SettleAsk, self._on_settle, exchange=False)

    # --- the door ---------------------------------------------------------------------------------------------

    def voters(self, key: str) -> tuple[str, ...]:
        """The gateways that vote on a key, there or not; ConfigError when none are configured."""
        return self.voter.voters(key)

    async def read(self, key: str) -> Record | None:
        """Return the register's value (a tombstone too) as it was at some moment during the call.

        Raises:
            ConfigError: `plane.voters` is empty.
            UnreachableError: fewer than a majority of the key's voters answer.
        """
        voters = self.voters(check_key(key))
        ask = VoteAsk(key=key, voters=self.voter.digest)

        def same(answers: list[Voted]) -> bool:
            return register.agreed((each.vote for each in answers), len(voters)) is not None

        answers = await self._poll(voters, "quorum_vote", ask, self.voter.on_vote, same)
        ballot = register.agreed((each.vote for each in answers), len(voters))
        if ballot is not None:
            agreeing = [each for each in answers if each.vote.accepted == ballot]
            plain = [each.plain for each in agreeing if each.plain is not None]
            return register.current((each.vote for each in agreeing), plain, self.resolver())
        # They differ, or too few answered: whoever settles it says which.
        return (await self._handed("quorum_settle", SettleAsk(key), self._on_settle, key)).record

    async def write(self, asked: Write) -> VersionVector:
        """Change the register; by then a majority of its voters has it on disk.

        Raises:
            ConfigError: `plane.voters` is empty.
            ConflictError: the record has moved on; nothing was written.
            UnreachableError: fewer than a majority of the voters answer; the message says whether it may be written.
            PayloadError: the value or key is too large.
        """
        check_write(asked, max_bytes=self._config.max_record_bytes)
        return (await self._handed("quorum_write", asked, self._on_write, asked.key)).version

    async def told(self, key: str) -> list[Voted]:
        """What the other voters of a key have promised and accepted; those that do not answer are left out."""
        others = tuple(each for each in self.voters(key) if each != self._gateway)
        ask = VoteAsk(key=key, voters=self.voter.digest)
        return await self._poll(others, "quorum_vote", ask, self.voter.on_vote, lambda _: False)

    def let_go(self, key: str) -> None:
        """Prepare anew before the next change of a register."""
        self._leads.pop(key, None)

    async def everywhere(self, key: str) -> None:
        """Have all voters accept the register's value that can be reached, not just a majority."""
        await self._propose(key, None)
        voters = self.voters(key)
        async with self._locks.setdefault(key, asyncio.Lock()):
            ballot, record = self._leads.pop(key, (NONE, None))
            if record is not None:
                ask = AcceptAsk(key=key, ballot=ballot, record=record, voters=self.voter.digest)
                await self._poll(voters, "quorum_accept", ask, self.voter.on_accept, lambda _: False)

    # --- handing on -------------------------------------------------------------------------------------------

    async def _handed(self, verb: str, ask: A, here: Callable[[A], Awaitable[Outcome]], key: str) -> Outcome:
        """Have the first voter that is there do it; the next when it does not answer."""
        voters = self.voters(key)
        loop = asyncio.get_running_loop()
        until = loop.time() + self._config.write_timeout_s
        unsure, writing, problem = False, isinstance(ask, Write), "nobody answers"
        while True:
            for voter in sorted(voters, key=lambda name: not self._membership.sees(name)):
                try:
                    if voter == self._gateway:
                        outcome = await here(ask)
                    else:
                        outcome = await self._rpc.call(voter, verb, ask, Outcome, timeout_s=_HANDED_S)
                except ConflictError as error:
                    if unsure:
                        # It may be this very write that moved the record on.
                        raise UnreachableError(
                            f"{key} has moved on, perhaps by this write", remedy="read it and decide again"
                        ) from error
                    raise
                except RefusedError as error:
                    problem = str(error)
                except (UnreachableError, DeadlineError) as error:
                    unsure, problem = unsure or writing, str(error)
                else:
                    if not outcome.problem:
                        return outcome
                    unsure, problem = unsure or outcome.unsure, outcome.problem
                if loop.time() > until:
                    what = "may be written" if unsure else "was not written"
                    raise UnreachableError(
                        f"no majority of {', '.join(voters)} for {key}: {problem}",
                        remedy=f"try again; it {what}" if writing else "try again",
                    )
            await asyncio.sleep(_AGAIN_S)

    async def _poll(
        self,
        voters: tuple[str, ...],
        verb: str,
        ask: A,
        here: Callable[[A], Awaitable[Voted]],
        done: Callable[[list[Voted]], bool],
    ) -> list[Voted]:
        """Ask all voters at once; returns the answers as soon as they are enough, or when no more will come."""

        async def one(voter: str) -> Voted | None:
            try:
                if voter == self._gateway:
                    return _checked(await here(ask), self._config.max_record_bytes)
                answer = await self._rpc.call(voter, verb, ask, Voted, timeout_s=_PHASE_S)
                return _checked(answer, self._config.max_record_bytes)
            except SwiftbotError as error:
                log.debug("a voter does not vote", voter=voter, verb=verb, reason=str(error))
                return None

        answers: list[Voted] = []
        waiting = {asyncio.create_task(one(voter)) for voter in voters}
        try:
            while waiting and not done(answers):
                finished, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                answers += [answer for task in finished if (answer := task.result()) is not None]
        finally:
            for task in waiting:
                task.cancel()
        return answers

    # --- proposing --------------------------------------------------------------------------------------------

    async def _on_write(self, asked: Write) -> Outcome:
        check_write(asked, max_bytes=self._config.max_record_bytes)
        return await self._propose(asked.key, asked)

    async def _on_settle(self, asked: SettleAsk) -> Outcome:
        return await self._propose(check_key(asked.key), None)

    async def _propose(self, key: str, asked: Write | None) -> Outcome:
        """Get a change (None: no change, only agreement) through, as the one who does so for this key."""
        voters = self.voters(key)
        if self._gateway not in voters:
            raise RefusedError(f"{self._gateway} does not vote on {key}", remedy=f"ask {voters[0]}")
        until = asyncio.get_running_loop().time() + _LEAD_S
        unsure = False
        lock = self._locks.setdefault(key, asyncio.Lock())
        async with lock:
            while True:
                try:
                    ballot, found = self._leads.pop(key, None) or await self._prepare(key, voters)
                    conflict: ConflictError | None = None
                    try:
                        new = found if asked is None else _decided(found, asked, self._gateway)
                    except ConflictError as error:
                        conflict, new = error, found
                    # What may be of a minority only must not have been seen by anybody before a majority has it.
                    unsure = unsure or (asked is not None and conflict is None)
                    if new is not None:
                        await self._accept(key, voters, ballot, new)
                    if conflict is None:
                        return Outcome(version={} if new is None else new.version, record=new)
                    if not unsure:
                        raise conflict
                    return Outcome(problem=str(conflict), unsure=True)
                except _OutrunError:
                    problem = "others change it all the time"
                except _NoMajorityError as error:
                    return Outcome(problem=str(error), unsure=unsure)
                if asyncio.get_running_loop().time() > until:
                    return Outcome(problem=problem, unsure=unsure)
                await asyncio.sleep(random.uniform(*_BACK_OFF_S))  # noqa: S311 - spreads load, protects nothing

    async def _prepare(self, key: str, voters: tuple[str, ...]) -> tuple[Ballot, Record | None]:
        """Have a majority promise a ballot; returns it, and the register's value."""
        self._round += 1
        ballot = Ballot(self._round, self._proposer)
        ask = PrepareAsk(key=key, ballot=ballot, voters=self.voter.digest)
        answers = await self._majority(voters, "quorum_prepare", ask, self.voter.on_prepare)
        votes = [each.vote for each in answers]
        plain = [each.plain for each in answers if each.plain is not None]
        return ballot, register.current(votes, plain, self.resolver())

    async def _accept(self, key: str, voters: tuple[str, ...], ballot: Ballot, record: Record) -> None:
        self._round = max(self._round, ballot.round + 1)
        ask = AcceptAsk(key=key, ballot=ballot, record=record, voters=self.voter.digest)
        await self._majority(voters, "quorum_accept", ask, self.voter.on_accept)
        self._leads[key] = (ballot.next(), record)
        if len(self._leads) > _MOST_LEADS:
            self._leads.popitem(last=False)
        if self.learn is not None:
            await self.learn(record)

    async def _majority(
        self, voters: tuple[str, ...], verb: str, ask: A, here: Callable[[A], Awaitable[Voted]]
    ) -> list[Voted]:
        """Return the answers of a majority that grants it."""
        needed = majority(len(voters))

        def done(answers: list[Voted]) -> bool:
            granted = sum(each.granted for each in answers)
            return granted >= needed or len(answers) - granted > len(voters) - needed

        answers = await self._poll(voters, verb, ask, here, done)
        self._round = max(self._round, *(each.vote.promised.round for each in answers), 0)
        granted = [each for each in answers if each.granted]
        if len(granted) >= needed:
            return granted
        if len(answers) > len(granted):
            raise _OutrunError
        raise _NoMajorityError(f"{len(granted)} of {len(voters)} voters answer, {needed} are needed")


def _decided(found: Record | None, asked: Write, gateway: str) -> Record:
    try:
        return decide(found, asked, gateway)
    except Behind:
        raise ConflictError(
            f"{asked.key}: no majority knows the version expected",
            remedy="read it with a quorum, and decide again",
        ) from None


def _checked(answer: Voted, most: int) -> Voted:
    if answer.vote.accepted != NONE or answer.vote.record is not None:
        check_vote(answer.vote, max_bytes=most)
    if answer.plain is not None:
        check_record(answer.plain, max_bytes=most)
    return answer
