"""Quorum reads and writes between gateways: the shell round `register`.

Anybody may propose; so that proposers do not get into each other's way, everybody hands a change to the first voter
of the key that is seen, and that one does them one after the other. A read asks all voters at once and is done when
a majority has accepted the same; only where they differ the first voter settles it.
"""

import asyncio
import hashlib
import random
import secrets
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TypeVar
from weakref import WeakValueDictionary

import msgspec
import structlog
from msgspec import Struct

from appliance.errors import (
    ConfigError,
    ConflictError,
    DeadlineError,
    PayloadError,
    RefusedError,
    SwiftbotError,
    UnreachableError,
)
from appliance.model import VersionVector
from appliance.plane.membership import Membership
from appliance.plane.quorum import register
from appliance.plane.quorum.messages import AcceptAsk, Outcome, PrepareAsk, SettleAsk, VoteAsk, Voted
from appliance.plane.quorum.register import NONE, Ballot, Vote, check_ballot, check_vote, majority
from appliance.plane.ring import Ring
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
_MOST_JUMP = 2**32
"""A ballot further ahead than that is no proposer's: it would use up the numbers."""
_VOTE = "quorum/"
"""Votes are kept in the store under this and the key."""
_NO_VOTE = "quorum-lost"


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
        self._store = store
        self._rpc = rpc
        self._membership = membership
        self._ring = Ring(config.voters, virtual_nodes=config.virtual_nodes)
        named = f"{sorted(config.voters)} {config.replicas} {config.virtual_nodes}"
        self._digest = hashlib.blake2b(named.encode(), digest_size=8).hexdigest()
        self._proposer = f"{gateway}:{secrets.token_hex(6)}"
        self._round = 0
        self._leads: OrderedDict[str, tuple[Ballot, Record | None]] = OrderedDict()
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        self._lost = True
        rpc.register("quorum_prepare", PrepareAsk, self._on_prepare, exchange=False)
        rpc.register("quorum_accept", AcceptAsk, self._on_accept, exchange=False)
        rpc.register("quorum_vote", VoteAsk, self._on_vote, exchange=False)
        rpc.register("quorum_write", Write, self._on_write, exchange=False)
        rpc.register("quorum_settle", SettleAsk, self._on_settle, exchange=False)

    # --- the door ---------------------------------------------------------------------------------------------

    def voters(self, key: str) -> tuple[str, ...]:
        """The gateways that vote on a key, there or not; ConfigError when none are configured."""
        if not self._config.voters:
            raise ConfigError(
                "a quorum was asked for, and plane.voters names nobody",
                remedy="name the gateways that vote in plane.voters, the same at every gateway",
            )
        return self._ring.successors(key, self._config.replicas)

    async def read(self, key: str) -> Record | None:
        """Return the register's value (a tombstone too) as it was at some moment during the call.

        Raises:
            ConfigError: `plane.voters` is empty.
            UnreachableError: fewer than a majority of the key's voters answer.
        """
        voters = self.voters(check_key(key))
        ask = VoteAsk(key=key, voters=self._digest)

        def same(answers: list[Voted]) -> bool:
            return register.agreed((each.vote for each in answers), len(voters)) is not None

        answers = await self._poll(voters, "quorum_vote", ask, self._on_vote, same)
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

    async def start(self, *, lost: bool) -> None:
        """Begin to vote. `lost`: the store's file could not be read, and with it went what was promised."""
        if lost:
            await self._store.put(_NO_VOTE, b"1")
        self._lost = await self._store.get(_NO_VOTE) is not None
        if self._lost and self._gateway in self._config.voters:
            log.error(
                "this gateway does not vote: its promises were lost with its file",
                remedy="give it a new id and name that in plane.voters in place of the old one",
            )

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
        ask = PrepareAsk(key=key, ballot=ballot, voters=self._digest)
        answers = await self._majority(voters, "quorum_prepare", ask, self._on_prepare)
        votes = [each.vote for each in answers]
        plain = [each.plain for each in answers if each.plain is not None]
        return ballot, register.current(votes, plain, self.resolver())

    async def _accept(self, key: str, voters: tuple[str, ...], ballot: Ballot, record: Record) -> None:
        self._round = max(self._round, ballot.round + 1)
        ask = AcceptAsk(key=key, ballot=ballot, record=record, voters=self._digest)
        await self._majority(voters, "quorum_accept", ask, self._on_accept)
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

    # --- voting -----------------------------------------------------------------------------------------------

    async def _on_prepare(self, asked: PrepareAsk) -> Voted:
        self._check(asked.key, asked.voters)
        check_ballot(asked.ballot)
        return await self._vote(asked.key, partial(_promised, asked.ballot))

    async def _on_accept(self, asked: AcceptAsk) -> Voted:
        self._check(asked.key, asked.voters)
        check_ballot(asked.ballot)
        check_record(asked.record, max_bytes=self._config.max_record_bytes)
        if asked.record.key != asked.key:
            raise PayloadError(f"a record of {asked.record.key} for {asked.key}")
        voted = await self._vote(asked.key, partial(_accepted, asked.ballot, asked.record))
        # The proposer knows the record.
        return Voted(granted=voted.granted, vote=Vote(promised=voted.vote.promised))

    async def _on_vote(self, asked: VoteAsk) -> Voted:
        self._check(asked.key, asked.voters)
        raw = await self._store.get(_VOTE + asked.key)
        vote = Vote() if raw is None else msgspec.msgpack.decode(raw, type=Vote)
        return Voted(vote=vote, plain=await self._store.record(asked.key))

    async def _vote(self, key: str, change: Callable[[Vote], Vote | None]) -> Voted:
        """Change a vote and have it on the disk; not granted when `change` says None."""

        def alter(raw: bytes | None) -> bytes | None:
            nonlocal vote, granted
            vote, granted = Vote() if raw is None else msgspec.msgpack.decode(raw, type=Vote), False
            changed = change(vote)
            if changed is None:
                return None
            vote, granted = changed, True
            return msgspec.msgpack.encode(changed)

        vote, granted = Vote(), False
        await self._store.alter(_VOTE + key, alter)
        return Voted(granted=granted, vote=vote, plain=await self._store.record(key))

    def _check(self, key: str, digest: str) -> None:
        check_key(key)
        if digest != self._digest:
            raise RefusedError(
                f"{self._gateway} is told other voters than whoever asks",
                remedy="plane.voters, replicas and virtual_nodes must be the same at every gateway",
            )
        if self._gateway not in self.voters(key):
            raise RefusedError(f"{self._gateway} does not vote on {key}")
        if self._lost:
            raise RefusedError(f"{self._gateway} has lost its promises and does not vote", remedy="give it a new id")


def _decided(found: Record | None, asked: Write, gateway: str) -> Record:
    try:
        return decide(found, asked, gateway)
    except Behind:
        raise ConflictError(
            f"{asked.key}: no majority knows the version expected",
            remedy="read it with a quorum, and decide again",
        ) from None


def _promised(ballot: Ballot, vote: Vote) -> Vote | None:
    if ballot.round > vote.promised.round + _MOST_JUMP:
        raise PayloadError(f"a ballot of round {ballot.round:,} after {vote.promised.round:,}")
    return register.promise(vote, ballot)


def _accepted(ballot: Ballot, record: Record, vote: Vote) -> Vote | None:
    if ballot.round > vote.promised.round + _MOST_JUMP:
        raise PayloadError(f"a ballot of round {ballot.round:,} after {vote.promised.round:,}")
    return register.accept(vote, ballot, record)


def _checked(answer: Voted, most: int) -> Voted:
    if answer.vote.accepted != NONE or answer.vote.record is not None:
        check_vote(answer.vote, max_bytes=most)
    if answer.plain is not None:
        check_record(answer.plain, max_bytes=most)
    return answer
