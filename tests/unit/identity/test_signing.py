"""Signed requests: who made it, for which key, and only once."""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import IdentityError
from appliance.identity import signing
from appliance.identity.certificates import make_authority, make_certificate
from appliance.identity.member import Identity
from appliance.identity.roster import Issued, Roster
from appliance.identity.signing import Signer, Verifier
from appliance.model.roles import Role

AT = datetime(2026, 11, 27, 12, tzinfo=UTC)
NOW = AT.timestamp()
NOW_NS = int(NOW * 1e9)
KEY = Ed25519PrivateKey.generate()
AUTHORITY = make_authority("yard", KEY, AT)


def signer(role: Role = Role.OPERATOR, name: str = "ann") -> Signer:
    """Return one with a new certificate."""
    own = Ed25519PrivateKey.generate()
    return Signer(
        own,
        make_certificate(AUTHORITY, KEY, own.public_key(), role=role, name=name, hosts=(), days=30, now=AT),
    )


SIGNED = signer().sign("k", b"p", NOW_NS)
"""Of one certificate: those of others are some bytes longer or shorter."""


def good(identity: Identity, now: float) -> None:
    """Find nothing wrong but the time."""
    identity.check_time(now)


def verifier(check: Callable[[Identity, float], None] = good) -> Verifier:
    """Return one that has seen nothing."""
    return Verifier(AUTHORITY, check)


def test_a_request_says_who_signed_it() -> None:
    """Role and name of the certificate."""
    signature = signer().sign("k", b"payload", NOW_NS)
    identity = verifier().verify(signature, "k", b"payload", now=NOW, clock_s=0.0)
    assert (identity.role, identity.name, identity.fleet) == (Role.OPERATOR, "ann", "yard")


@given(st.binary(max_size=200), st.binary(max_size=200), st.text(max_size=40), st.text(max_size=40))
def test_a_signature_is_for_one_key_and_payload(payload: bytes, other: bytes, key: str, other_key: str) -> None:
    """With another of either it is refused."""
    signature = signer().sign(key, payload, NOW_NS)
    check = partial(verifier().verify, signature, now=NOW, clock_s=0.0)
    if (other_key, other) != (key, payload):
        with pytest.raises(IdentityError, match="another request"):
            check(other_key, other)
    check(key, payload)


@given(st.data())
def test_any_change_of_a_signature_is_noticed(data: st.DataObject) -> None:
    """Cut off anywhere or one bit changed: refused with a reason, and nothing else is raised."""
    whole = SIGNED
    at = data.draw(st.integers(0, len(whole) - 1))
    changed = whole[:at] if data.draw(st.booleans()) else whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]
    with pytest.raises(IdentityError):
        verifier().verify(changed, "k", b"p", now=NOW, clock_s=0.0)


@given(st.binary(max_size=90))
def test_what_is_no_signature_is_refused(junk: bytes) -> None:
    """Whatever it is; an empty one is named as such."""
    with pytest.raises(IdentityError, match="signature cannot be read" if junk else "not signed"):
        verifier().verify(junk, "k", b"p", now=NOW, clock_s=0.0)


def test_the_same_request_counts_once() -> None:
    """At each verifier; a further request of the same signer counts too."""
    one, check, other = signer(), verifier(), verifier()
    first, second = (one.sign("k", b"p", NOW_NS) for _ in range(2))
    for each in (first, second):
        check.verify(each, "k", b"p", now=NOW, clock_s=0.0)
        with pytest.raises(IdentityError, match="has come before"):
            check.verify(each, "k", b"p", now=NOW, clock_s=0.0)
    other.verify(first, "k", b"p", now=NOW, clock_s=0.0)


@given(st.permutations(range(60)))
def test_the_order_of_arrival_does_not_matter(order: list[int]) -> None:
    """Each counts exactly once, in whatever order they come."""
    one, check = signer(), verifier()
    signed = [one.sign("k", b"p", NOW_NS) for _ in order]
    for number in order:
        check.verify(signed[number], "k", b"p", now=NOW, clock_s=0.0)
    for number in order:
        with pytest.raises(IdentityError, match="has come before"):
            check.verify(signed[number], "k", b"p", now=NOW, clock_s=0.0)


@given(st.lists(st.integers(1, 3 * signing.WINDOW), max_size=40))
def test_a_number_is_taken_as_new_at_most_once(numbers: list[int]) -> None:
    """Far jumps and late ones too; one within the window that has not come is taken."""
    seen, taken, highest = signing._Seen(), set[int](), 0
    for number in numbers:
        fresh = number not in taken and number > highest - signing.WINDOW
        assert seen.first(number) is fresh
        if fresh:
            taken.add(number)
            highest = max(highest, number)


@pytest.mark.parametrize("off_s", [-3600.0, -61.0, 61.0, 10 * 365 * 86_400.0])
def test_clocks_that_are_apart_are_told(off_s: float) -> None:
    """By how much and which is ahead, with the remedy; gateways' requests go by no clock."""
    at_ns = int((NOW + off_s) * 1e9)
    with pytest.raises(IdentityError, match="ahead of" if off_s > 0 else "behind") as told:
        verifier().verify(signer().sign("k", b"p", at_ns), "k", b"p", now=NOW, clock_s=0.0)
    assert "timedatectl" in told.value.remedy
    gateway = signer(Role.GATEWAY, "gw-1").sign("k", b"p", at_ns)
    assert verifier().verify(gateway, "k", b"p", now=NOW, clock_s=0.0).name == "gw-1"


def test_clocks_may_be_a_little_apart() -> None:
    """Within a minute."""
    for off_s in (-59.0, 59.0):
        verifier().verify(signer().sign("k", b"p", int((NOW + off_s) * 1e9)), "k", b"p", now=NOW, clock_s=0.0)


def test_revoked_expired_and_foreign_certificates_are_refused() -> None:
    """From the moment on that the roster says so; a certificate that was good before is looked at again."""
    one = signer()
    roster = Roster(fleet="yard")

    def check(identity: Identity, now: float) -> None:
        identity.check_time(now)
        roster.check(identity)

    it = verifier(check)
    identity = it.verify(one.sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=0.0)
    entry = Issued(role=Role.OPERATOR, name="ann", serial=identity.serial, not_after=NOW * 2, issued=0.0)
    roster = roster.add(entry).revoke(Role.OPERATOR, "ann", now=NOW, why="left")
    with pytest.raises(IdentityError, match="left"):
        it.verify(one.sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=0.0)
    late = NOW + 31 * 86_400
    with pytest.raises(IdentityError, match="expired"):
        verifier().verify(one.sign("k", b"p", int(late * 1e9)), "k", b"p", now=late, clock_s=0.0)
    own, stranger = Ed25519PrivateKey.generate(), Ed25519PrivateKey.generate()
    other = make_authority("yard", stranger, AT)
    forged = make_certificate(
        other, stranger, own.public_key(), role=Role.OPERATOR, name="ann", hosts=(), days=1, now=AT - timedelta(1)
    )
    with pytest.raises(IdentityError, match="another authority"):
        verifier().verify(Signer(own, forged).sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=0.0)


def test_sessions_are_remembered_as_long_as_they_could_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """More at once than there is room for are refused and told so; those that are over make room."""
    monkeypatch.setattr(signing, "MOST_SESSIONS", 2)
    it = verifier()
    for _ in range(2):
        it.verify(signer().sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=0.0)
    with pytest.raises(IdentityError, match="2 sessions"):
        it.verify(signer().sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=1.0)
    it.verify(signer().sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=2 * signing.SKEW_S + 1)


def test_one_member_does_not_fill_the_table_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A member that opens sessions without end is refused alone, until those that are over make room."""
    monkeypatch.setattr(signing, "MOST_SESSIONS", 4)
    monkeypatch.setattr(signing, "MOST_OF_ONE", 2)
    own = Ed25519PrivateKey.generate()
    certificate = make_certificate(
        AUTHORITY, KEY, own.public_key(), role=Role.VIEWER, name="eve", hosts=(), days=30, now=AT
    )
    it = verifier()

    def ask(who: Signer, clock_s: float) -> Identity:
        return it.verify(who.sign("k", b"p", NOW_NS), "k", b"p", now=NOW, clock_s=clock_s)

    for _ in range(2):
        ask(Signer(own, certificate), 0.0)
    for _ in range(9):
        with pytest.raises(IdentityError, match="2 sessions of viewer eve"):
            ask(Signer(own, certificate), 0.0)
    assert ask(signer(), 1.0).name == "ann"
    assert ask(Signer(own, certificate), 2 * signing.SKEW_S + 0.5).name == "eve"
