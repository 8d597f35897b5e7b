"""Proofs of gateways: a certificate's own name counts, and silence does not keep a revoked one a member."""

import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import cast
from unittest.mock import AsyncMock, MagicMock

import pytest

from appliance.errors import DeadlineError, IdentityError
from appliance.identity import credentials as module
from appliance.identity.authority import Authority
from appliance.identity.credentials import Credentials
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.plane_api import Member, MemberAsk
from appliance.model.roles import Role
from appliance.plane.proofs import Proofs
from appliance.plane.rpc import Rpc

pytestmark = pytest.mark.anyio
KEYS = Keys("f")


class Pair:
    """gw-1, which asks, and gw-2, which answers until `silent`."""

    def __init__(self, folder: Path) -> None:
        self.silent = False
        self.authority = Authority.create(folder / "authority", "f", datetime.now(UTC))
        self.asker, self.other = self._make(folder, "gw-1"), self._make(folder, "gw-2")

    def _make(self, folder: Path, name: str) -> Proofs:
        keys = folder / name / "keys.pem"
        keys.parent.mkdir()
        self.authority.issue(Role.GATEWAY, name, out=keys)
        credentials = Credentials.load(keys, folder / "roster.json", fleet="f", now=datetime.now(UTC).timestamp())
        rpc = cast("Rpc", MagicMock(call=AsyncMock(side_effect=self._call)))
        return Proofs(credentials, rpc=rpc, keys=KEYS, gateway=name, within_s=1.0)

    async def _call(self, _: str, verb: object, ask: MemberAsk, **__: float) -> Member:
        assert verb is keyspace.MEMBER
        if self.silent:
            raise DeadlineError("busy")
        return Member(here=True, proof=self.other.proof(ask.challenge))

    def revoke(self, folder: Path) -> None:
        """Revoke gw-2, and bring gw-1 the roster."""
        self.authority.revoke(Role.GATEWAY, "gw-2", why="stolen")
        shutil.copy(self.authority.roster_file, folder / "roster.json")
        self.asker._credentials.refresh()


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pair:
    """Return two whose rosters are looked at whenever asked."""
    monkeypatch.setattr(module, "LOOK_S", 0.0)
    return Pair(tmp_path)


async def test_a_gateway_proves_its_own_name_only(pair: Pair) -> None:
    """What gw-2 signs is a proof of gw-2 and of no other."""
    await pair.asker.prove("gw-2")
    with pytest.raises(IdentityError):
        await pair.asker.prove("gw-3")


async def test_silence_does_not_keep_a_revoked_gateway(pair: Pair, tmp_path: Path) -> None:
    """One that does not answer is late as long as its certificate is good, and refused once that is revoked."""
    await pair.asker.prove("gw-2")
    pair.silent = True
    with pytest.raises(DeadlineError):
        await pair.asker.prove("gw-2")
    pair.revoke(tmp_path)
    with pytest.raises(IdentityError, match="stolen"):
        await pair.asker.prove("gw-2")
