"""Certificates say a role and a name, and only what the authority signed counts."""

from datetime import UTC, datetime, timedelta
from ipaddress import ip_address

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from hypothesis import given
from hypothesis import strategies as st

from appliance.errors import ConfigError, IdentityError
from appliance.identity import certificates
from appliance.identity.certificates import make_authority, make_certificate
from appliance.model.roles import Role

NOW = datetime(2026, 11, 27, 12, tzinfo=UTC)
KEY = Ed25519PrivateKey.generate()
AUTHORITY = make_authority("yard", KEY, NOW)
NAMES = st.from_regex(r"[a-z0-9][a-z0-9_.-]{0,57}", fullmatch=True)


def made(role: Role, name: str, *, hosts: tuple[str, ...] = (), days: int = 30) -> x509.Certificate:
    """Return a certificate of the authority."""
    public = Ed25519PrivateKey.generate().public_key()
    return make_certificate(AUTHORITY, KEY, public, role=role, name=name, hosts=hosts, days=days, now=NOW)


@given(st.sampled_from(tuple(Role)), NAMES)
def test_what_is_written_into_a_certificate_is_read_from_it(role: Role, name: str) -> None:
    """Fleet, role, name and times, whatever the name."""
    identity = certificates.identify(made(role, name), AUTHORITY)
    assert (identity.fleet, identity.role, identity.name) == ("yard", role, name)
    assert identity.not_after == (NOW + timedelta(days=30)).timestamp()
    assert identity.not_before == (NOW - certificates.BACKDATED).timestamp()


@pytest.mark.parametrize("role", tuple(Role))
def test_only_gateways_accept_links(role: Role) -> None:
    """The certificate of anybody else is none for a server, so that it cannot pass for a gateway."""
    usage = made(role, "one").extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert ExtendedKeyUsageOID.CLIENT_AUTH in usage
    assert (ExtendedKeyUsageOID.SERVER_AUTH in usage) is (role is Role.GATEWAY)


def test_roles_share_common_names_but_robots() -> None:
    """Access control goes by whole common names: a further operator needs no new rule, a robot has rules of its own."""

    def named(role: Role) -> str:
        return str(made(role, "one").subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)

    assert [named(role) for role in Role] == ["gateway", "recorder", "robot:one", "viewer", "operator", "engineer"]


def test_a_gateway_is_dialled_by_its_hosts_and_on_the_loopback() -> None:
    """Host names and addresses, of both kinds; those of the loopback are always among them."""
    certificate = made(Role.GATEWAY, "gw-1", hosts=("gw-1.example", "192.168.1.11", "[fd00::1]"))
    assert set(certificates.hosts_of(certificate)) == {"gw-1.example", "192.168.1.11", "fd00::1"}
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "localhost" in names.get_values_for_type(x509.DNSName)
    assert ip_address("127.0.0.1") in names.get_values_for_type(x509.IPAddress)


def test_another_authoritys_certificate_is_refused() -> None:
    """Also one that has the same name, and a certificate that signed itself."""
    other_key = Ed25519PrivateKey.generate()
    other = make_authority("yard", other_key, NOW)
    forged = make_certificate(
        other, other_key, KEY.public_key(), role=Role.OPERATOR, name="eve", hosts=(), days=1, now=NOW
    )
    with pytest.raises(IdentityError, match="another authority"):
        certificates.identify(forged, AUTHORITY)
    with pytest.raises(IdentityError, match="another authority"):
        certificates.identify(other, AUTHORITY)


def test_the_authoritys_own_certificate_is_no_members() -> None:
    """Though it is signed by the authority."""
    with pytest.raises(IdentityError, match="no certificate of a member"):
        certificates.identify(AUTHORITY, AUTHORITY)


def test_a_certificate_is_good_from_its_beginning_to_its_end() -> None:
    """Before that the clock is named as the cause, after it the command that renews."""
    identity = certificates.identify(made(Role.VIEWER, "ann", days=1), AUTHORITY)
    identity.check_time(NOW.timestamp())
    with pytest.raises(IdentityError, match="clock"):
        identity.check_time((NOW - timedelta(hours=2)).timestamp())
    with pytest.raises(IdentityError, match="swiftbot keys renew viewer ann"):
        identity.check_time((NOW + timedelta(days=1)).timestamp())


@pytest.mark.parametrize(
    ("role", "name", "hosts", "days", "told"),
    [
        (Role.GATEWAY, "Gw 1", (), 1, "not a valid name"),
        (Role.ROBOT, "r" * 59, (), 1, "at most 58"),
        (Role.VIEWER, "ann", ("h",), 1, "only gateways"),
        (Role.GATEWAY, "gw-1", ("tcp/h:1",), 1, "neither a host name nor an address"),
        (Role.GATEWAY, "gw-1", ("*.example",), 1, "neither a host name nor an address"),
        (Role.GATEWAY, "gw-1", ("",), 1, "neither a host name nor an address"),
        (Role.GATEWAY, "gw-1", (), 0, "from 1 to"),
        (Role.GATEWAY, "gw-1", (), 10_000, "from 1 to"),
    ],
)
def test_what_cannot_be_certified_is_refused(
    role: Role, name: str, hosts: tuple[str, ...], days: int, told: str
) -> None:
    """With what is wrong and what would do."""
    with pytest.raises(ConfigError) as refused:
        made(role, name, hosts=hosts, days=days)
    assert told in str(refused.value)
