"""The roster of a fleet: every certificate that its authority has issued, and which of them are revoked.

The authority signs it, and each version has a number one higher than the last. So any copy may be passed on by anybody,
and of two copies the one with the higher number counts. A certificate that is not in the roster yet is good, as far as
the roster is concerned: the authority's signature on it says so. What the roster takes away is taken away at once.
"""

import msgspec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import IdentityError
from appliance.identity import sealed
from appliance.identity.member import Identity
from appliance.model.roles import Role

_NAME = "roster"
MOST_BYTES = 4 * 2**20
"""Of a roster file; 10,000 certificates are about 2.5 MB."""


class Issued(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A certificate that was issued."""

    role: Role
    name: str
    serial: str
    not_after: float
    """Unix seconds."""
    issued: float
    hosts: tuple[str, ...] = ()
    revoked: float = 0.0
    """When it was revoked; 0: it is not."""
    why: str = ""

    def state(self, now: float) -> str:
        """`revoked`, `expired` or `valid`."""
        return "revoked" if self.revoked else "expired" if now >= self.not_after else "valid"


class Roster(Struct, frozen=True, kw_only=True):
    """The certificates of a fleet."""

    fleet: str
    number: int = 0
    """One higher with each change."""
    issued: tuple[Issued, ...] = ()

    def valid(self, role: Role, name: str, now: float) -> list[Issued]:
        """The certificates of a member that are neither expired nor revoked, the latest last."""
        found = (each for each in self.issued if (each.role, each.name) == (role, name))
        return [each for each in found if each.state(now) == "valid"]

    def names(self, role: Role, now: float) -> tuple[str, ...]:
        """The names of a role that have a valid certificate."""
        return tuple(sorted({each.name for each in self.issued if each.role is role and each.state(now) == "valid"}))

    def add(self, issued: Issued) -> "Roster":
        """The next version, with one certificate more."""
        return replace(self, number=self.number + 1, issued=(*self.issued, issued))

    def revoke(self, role: Role, name: str, *, now: float, why: str) -> "Roster":
        """The next version, in which every valid certificate of a member is revoked."""
        gone = {each.serial for each in self.valid(role, name, now)}
        issued = tuple(replace(each, revoked=now, why=why) if each.serial in gone else each for each in self.issued)
        return replace(self, number=self.number + 1, issued=issued)

    def revoked(self, serial: str) -> Issued | None:
        """The certificate of that serial number, if it is revoked."""
        return next((each for each in self.issued if each.serial == serial and each.revoked), None)

    def check(self, identity: Identity) -> None:
        """Raise IdentityError when a certificate is revoked."""
        if (gone := self.revoked(identity.serial)) is not None:
            why = f": {gone.why}" if gone.why else ""
            raise IdentityError(
                f"the certificate of {identity.text} is revoked{why}",
                remedy=f"swiftbot keys issue {identity.role} {identity.name} makes a new one",
            )


def seal(roster: Roster, key: Ed25519PrivateKey) -> bytes:
    """Sign a roster with the authority's key; what comes out is its file."""
    return sealed.seal(_NAME, msgspec.json.encode(roster), key)


def unseal(data: bytes, authority: Ed25519PublicKey, fleet: str) -> Roster:
    """Read a roster's file.

    Raises:
        IdentityError: it is damaged, of another fleet, or another authority signed it.
    """
    text = sealed.unseal(_NAME, data, authority, most=MOST_BYTES)
    try:
        roster = msgspec.json.decode(text, type=Roster)
    except (msgspec.DecodeError, RecursionError) as error:
        raise sealed.damaged(_NAME, error) from None
    if roster.fleet != fleet:
        raise IdentityError(f"the roster is of fleet {roster.fleet}, not {fleet}", remedy="copy the right one")
    return roster
