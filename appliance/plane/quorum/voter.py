"""What one gateway has promised and accepted, on its disk before it answers."""

import asyncio
import hashlib
import time
from collections.abc import Callable
from functools import partial

import msgspec
import structlog

from appliance.errors import ConfigError, PayloadError, RefusedError
from appliance.plane.quorum import register
from appliance.plane.quorum.messages import AcceptAsk, PrepareAsk, VoteAsk, Voted
from appliance.plane.quorum.register import NONE, Ballot, Vote, check_ballot
from appliance.plane.ring import Ring
from appliance.plane.rpc import Rpc
from appliance.plane.settings import PlaneConfig
from appliance.plane.store import Store
from appliance.plane.versions import Record, check_key, check_record

log = structlog.get_logger(__name__)

VOTE = "quorum/"
"""Votes are kept in the store under this and the key."""
GONE = "quorum-gone/"
"""Under this and the key: when a removal was accepted here, Unix nanoseconds of this machine's clock."""
_NO_VOTE = "quorum-lost"
_FLOOR = "quorum-floor"
_MOST_JUMP = 2**32
"""A ballot further ahead than that is no proposer's: it would use up the numbers."""


class Voter:
    """One gateway's votes on the registers that it is named for."""

    def __init__(self, config: PlaneConfig, *, gateway: str, store: Store, rpc: Rpc) -> None:
        self._config = config
        self._gateway = gateway
        self._store = store
        self._ring = Ring(config.voters, virtual_nodes=config.virtual_nodes)
        named = f"{sorted(config.voters)} {config.replicas} {config.virtual_nodes}"
        self.digest = hashlib.blake2b(named.encode(), digest_size=8).hexdigest()
        """Of the voters as they are configured here: all must have the same."""
        self._lost = True
        self._floor = NONE
        """The highest promise that was forgotten with its register."""
        rpc.register("quorum_prepare", PrepareAsk, self.on_prepare, exchange=False)
        rpc.register("quorum_accept", AcceptAsk, self.on_accept, exchange=False)
        rpc.register("quorum_vote", VoteAsk, self.on_vote, exchange=False)

    @property
    def votes(self) -> bool:
        """Whether this gateway has all that it promised, and may vote."""
        return not self._lost

    def voters(self, key: str) -> tuple[str, ...]:
        """The gateways that vote on a key, there or not; ConfigError when none are configured."""
        if not self._config.voters:
            raise ConfigError(
                "a quorum was asked for, and plane.voters names nobody",
                remedy="name the gateways that vote in plane.voters, the same at every gateway",
            )
        return self._ring.successors(key, self._config.replicas)

    async def start(self, *, lost: bool) -> None:
        """Begin to vote. `lost`: the store's file could not be read, and with it went what was promised."""
        if lost:
            await self._store.put(_NO_VOTE, b"1")
        self._lost = await self._store.get(_NO_VOTE) is not None
        floor = await self._store.get(_FLOOR)
        self._floor = NONE if floor is None else msgspec.msgpack.decode(floor, type=Ballot)
        if self._lost and self._gateway in self._config.voters:
            log.error(
                "this gateway does not vote: its promises were lost with its file",
                remedy="give it a new id and name that in plane.voters in place of the old one",
            )

    async def raise_floor(self, promised: Ballot) -> None:
        """Promise so much for every register of which nothing is remembered; on the disk when this returns."""
        if promised > self._floor:
            self._floor = promised
            await self._store.put(_FLOOR, msgspec.msgpack.encode(self._floor))

    async def on_prepare(self, asked: PrepareAsk) -> Voted:
        """Promise a ballot, unless a higher one was promised."""
        self._check(asked.key, asked.voters)
        check_ballot(asked.ballot)
        return await self._vote(asked.key, partial(_promised, asked.ballot))

    async def on_accept(self, asked: AcceptAsk) -> Voted:
        """Accept a value, unless a higher ballot was promised."""
        self._check(asked.key, asked.voters)
        check_ballot(asked.ballot)
        check_record(asked.record, max_bytes=self._config.max_record_bytes)
        if asked.record.key != asked.key:
            raise PayloadError(f"a record of {asked.record.key} for {asked.key}")
        if asked.record.deleted:
            # On the disk no later than the vote, or nobody would ever look at it again.
            noted = self._store.put(GONE + asked.key, str(time.time_ns()).encode())
            _, voted = await asyncio.gather(
                noted, self._vote(asked.key, partial(_accepted, asked.ballot, asked.record))
            )
        else:
            voted = await self._vote(asked.key, partial(_accepted, asked.ballot, asked.record))
        # The proposer knows the record.
        return Voted(granted=voted.granted, vote=Vote(promised=voted.vote.promised))

    async def on_vote(self, asked: VoteAsk) -> Voted:
        """Tell what was promised and accepted."""
        self._check(asked.key, asked.voters)
        return Voted(
            vote=self.read_vote(await self._store.get(VOTE + asked.key)), plain=await self._store.record(asked.key)
        )

    async def _vote(self, key: str, change: Callable[[Vote], Vote | None]) -> Voted:
        """Change a vote and have it on the disk; not granted when `change` says None."""

        def alter(raw: bytes | None) -> bytes | None:
            nonlocal vote, granted
            vote, granted = self.read_vote(raw), False
            changed = change(vote)
            if changed is None:
                return None
            vote, granted = changed, True
            return msgspec.msgpack.encode(changed)

        vote, granted = Vote(), False
        await self._store.alter(VOTE + key, alter)
        return Voted(granted=granted, vote=vote, plain=await self._store.record(key))

    def read_vote(self, raw: bytes | None) -> Vote:
        """A vote as it was kept; of a register that is not known, one that promises all that was forgotten."""
        return register.unknown(self._floor) if raw is None else msgspec.msgpack.decode(raw, type=Vote)

    def _check(self, key: str, digest: str) -> None:
        check_key(key)
        if digest != self.digest:
            raise RefusedError(
                f"{self._gateway} is told other voters than whoever asks",
                remedy="plane.voters, replicas and virtual_nodes must be the same at every gateway",
            )
        if self._gateway not in self.voters(key):
            raise RefusedError(f"{self._gateway} does not vote on {key}")
        if self._lost:
            raise RefusedError(f"{self._gateway} has lost its promises and does not vote", remedy="give it a new id")


def _promised(ballot: Ballot, vote: Vote) -> Vote | None:
    if ballot.round > vote.promised.round + _MOST_JUMP:
        raise PayloadError(f"a ballot of round {ballot.round:,} after {vote.promised.round:,}")
    return register.promise(vote, ballot)


def _accepted(ballot: Ballot, record: Record, vote: Vote) -> Vote | None:
    if ballot.round > vote.promised.round + _MOST_JUMP:
        raise PayloadError(f"a ballot of round {ballot.round:,} after {vote.promised.round:,}")
    return register.accept(vote, ballot, record)
