"""The roster: what the authority has issued and revoked, signed so that anybody may pass it on."""

import contextlib

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import IdentityError
from appliance.identity import roster
from appliance.identity.member import Identity
from appliance.identity.roster import Issued, Roster
from appliance.model.roles import Role

KEY = Ed25519PrivateKey.generate()
DAY = 86_400.0


def issued(serial: str, name: str = "ann", *, role: Role = Role.OPERATOR, until: float = DAY) -> Issued:
    """Return an entry."""
    return Issued(role=role, name=name, serial=serial, not_after=until, issued=0.0)


def identity(serial: str) -> Identity:
    """Return what a certificate of ann says."""
    return Identity(fleet="yard", role=Role.OPERATOR, name="ann", serial=serial, not_before=0.0, not_after=DAY)


def test_a_revoked_member_is_refused_and_others_are_not() -> None:
    """All its valid certificates are, with the reason; one that the roster lacks is no concern of the roster."""
    listed = Roster(fleet="yard").add(issued("a")).add(issued("b")).add(issued("c", "bob"))
    gone = listed.revoke(Role.OPERATOR, "ann", now=1.0, why="left")
    for serial in "ab":
        with pytest.raises(IdentityError, match="left"):
            gone.check(identity(serial))
    gone.check(identity("c"))
    gone.check(identity("unlisted"))
    assert gone.number == 4
    assert gone.names(Role.OPERATOR, 2.0) == ("bob",)


def test_what_has_expired_is_not_valid() -> None:
    """Nor is it revoked by a later revocation: it is over."""
    listed = Roster(fleet="yard").add(issued("a", until=5.0)).add(issued("b"))
    assert [each.serial for each in listed.valid(Role.OPERATOR, "ann", 6.0)] == ["b"]
    states = [each.state(7.0) for each in listed.revoke(Role.OPERATOR, "ann", now=6.0, why="").issued]
    assert states == ["expired", "revoked"]


def test_a_roster_is_read_as_it_was_signed() -> None:
    """All that it says."""
    listed = Roster(fleet="yard").add(issued("a")).revoke(Role.OPERATOR, "ann", now=1.0, why="ü")
    assert roster.unseal(roster.seal(listed, KEY), KEY.public_key(), "yard") == listed


@given(st.data())
def test_a_changed_roster_is_refused(data: st.DataObject) -> None:
    """Cut off anywhere, or any byte of it changed, unless it says the same."""
    listed = Roster(fleet="yard").add(issued("a"))
    sealed = roster.seal(listed, KEY)
    at = data.draw(st.integers(0, len(sealed) - 1))
    cut = data.draw(st.booleans())
    changed = (
        sealed[:at] if cut else sealed[:at] + bytes([sealed[at] ^ data.draw(st.integers(1, 255))]) + sealed[at + 1 :]
    )
    with contextlib.suppress(IdentityError):
        assert roster.unseal(changed, KEY.public_key(), "yard") == listed


def test_another_fleets_roster_is_refused() -> None:
    """Also one that the same key has signed; and one that another key has."""
    sealed = roster.seal(Roster(fleet="dock"), KEY)
    with pytest.raises(IdentityError, match="fleet dock, not yard"):
        roster.unseal(sealed, KEY.public_key(), "yard")
    with pytest.raises(IdentityError, match="another authority"):
        roster.unseal(sealed, Ed25519PrivateKey.generate().public_key(), "dock")


def test_a_signature_of_something_else_is_none_of_a_roster() -> None:
    """What the authority's key may sign elsewhere cannot be passed off as a roster."""
    text = msgspec.json.encode(Roster(fleet="yard")).decode()
    passed_off = msgspec.json.encode({"roster": text, "signature": msgspec.to_builtins(KEY.sign(text.encode()))})
    with pytest.raises(IdentityError):
        roster.unseal(passed_off, KEY.public_key(), "yard")


@pytest.mark.parametrize(
    "data",
    ['{"roster":"{}","signature":"ü"}'.encode(), b'{"other":' + b"[" * 100_000 + b"]" * 100_000 + b"}"],
    ids=["signature not ASCII", "nested"],
)
def test_garbage_is_refused_as_a_damaged_roster(data: bytes) -> None:
    """Whatever the decoders raise for it: another error would end the watch of the roster."""
    with pytest.raises(IdentityError, match="damaged"):
        roster.unseal(data, KEY.public_key(), "yard")
