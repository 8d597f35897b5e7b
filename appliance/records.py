"""Records of a fleet as a person or program outside looks at them and changes them: read, list, compare and set."""

import uuid
from typing import Literal

from msgspec import Struct

from appliance.connection import FleetConnection
from appliance.errors import ConfigError, NotFoundError, SwiftbotError
from appliance.model import VersionVector, keyspace
from appliance.model.plane_api import Copy, KeyAsk, Listed, Record, RecordAsk, RecordChange, RecordPlace, RecordsAsk
from appliance.plane.records import check_key

How = Literal["owner", "replica"]
_WRITE_S = 8.0
"""Longer than a gateway looks for an owner: what it says of the outcome is heard."""


class Held(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A record as all gateways together hold it."""

    key: str
    owner: str
    replicas: tuple[str, ...]
    copies: tuple[Copy, ...]
    """Of the gateways that answered."""

    @property
    def agree(self) -> bool:
        """Whether the copies are equal and just the replicas hold one."""
        return len({each.digest for each in self.copies}) == 1 and {each.gateway for each in self.copies} == set(
            self.replicas
        )

    @property
    def newest(self) -> Copy:
        """The copy with the most writes in its version."""
        return max(self.copies, key=lambda each: (sum(each.version.values()), each.digest))


class Records(FleetConnection):
    """What can be done with records through any gateway."""

    async def read(self, key: str, how: How = "owner") -> Record:
        """A record from its owner, or from any replica.

        Raises:
            NotFoundError: there is none.
            UnreachableError: nobody who has it answers.
        """
        ask = RecordAsk(key=check_key(key), replica=how == "replica")
        found = (await self._ask(keyspace.RECORD_READ, ask)).record
        if found is None or found.deleted:
            raise NotFoundError(f"there is no record {key}", remedy="see `swiftbot plane ls`")
        return found

    async def place(self, key: str) -> RecordPlace:
        """Where a record belongs, and what each replica holds of it."""
        return await self._ask(keyspace.RECORD_PLACE, KeyAsk(check_key(key)))

    async def write(
        self, key: str, value: bytes, *, expected: VersionVector | None, force: bool = False
    ) -> VersionVector:
        """Compare and set; errors as for `Dht.write`.

        Args:
            key: of the record.
            value: its new value.
            expected: the version that it must have; None: there must be none.
            force: also what gateways write themselves.
        """
        self._check(key, force=force)
        change = RecordChange(key=key, value=value, expected=expected, write=uuid.uuid4().hex)
        return (await self._ask(keyspace.RECORD_WRITE, change, timeout_s=_WRITE_S)).version

    async def remove(self, key: str, *, expected: VersionVector, force: bool = False) -> VersionVector:
        """Remove a record of that version; as `write`."""
        self._check(key, force=force)
        change = RecordChange(key=key, deleted=True, expected=expected, write=uuid.uuid4().hex)
        return (await self._ask(keyspace.RECORD_WRITE, change, timeout_s=_WRITE_S)).version

    @staticmethod
    def _check(key: str, *, force: bool) -> None:
        if keyspace.record_kind(check_key(key)) is not None and not force:
            raise ConfigError(
                f"{key} is written by the gateways themselves", remedy="--force, if you know what goes by it"
            )

    async def held(self, prefix: str, limit: int) -> tuple[list[Held], dict[str, SwiftbotError]]:
        """Records of the fleet in order of keys, at most so many, with all their copies; and who did not answer.

        A removed record is listed while it is remembered.
        """
        await self.gateway()
        found, failed = await self._each("", keyspace.RECORDS, RecordsAsk(prefix=prefix, limit=limit))
        by_key: dict[str, dict[str, Listed]] = {}
        # Where one gateway's answer was cut, others' may go on: beyond it not all copies are known.
        cuts = [each.records[-1].key for each in found.values() if each.more and each.records]
        until = min(cuts, default=None)
        for name, told in found.items():
            for each in told.records:
                if until is None or each.key <= until:
                    by_key.setdefault(each.key, {})[name] = each
        return [_held(key, by_key[key]) for key in sorted(by_key)[:limit]], failed


def _held(key: str, told: dict[str, Listed]) -> Held:
    # Views of the ring may differ for a moment: the owner itself knows best.
    best = next((each for name, each in told.items() if each.owner == name), next(iter(told.values())))
    copies = tuple(told[name].copy for name in sorted(told))
    return Held(key=key, owner=best.owner, replicas=best.replicas, copies=copies)
