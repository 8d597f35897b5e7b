"""X.509 certificates of a fleet: made for a role and a name, and read back. Pure; all times are passed in.

A certificate says three things: the role in its common name, which is what Zenoh's access control goes by; fleet, role
and name in a URI (`swiftbot://FLEET/ROLE/NAME`); and in its extended key usage whether it may accept links.

- **Common name.** Zenoh compares common names as a whole, and its rules are fixed once a session is open. So all
  gateways share the name `gateway`, all operators `operator`: another one needs no new rules. Robots alone have names
  of their own, `robot:NAME`, since each may write below its own key only. No public authority signs such a name, which
  matters because Zenoh trusts public authorities too when it dials.
- **Key usage.** Only gateways' certificates are for servers. A robot or an operator cannot pass for a gateway to those
  who dial: TLS itself refuses the link.
- **Keys** are Ed25519: small, quick to verify (0.05 ms), and taken by rustls, which Zenoh has.
"""

import ipaddress
import re
from collections.abc import Sequence
from datetime import datetime, timedelta
from urllib.parse import urlsplit

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from appliance.errors import ConfigError, IdentityError, PayloadError
from appliance.identity.member import Identity
from appliance.model.keys import check_name
from appliance.model.roles import Role

SCHEME = "swiftbot"
AUTHORITY_NAME = "SwiftBot fleet authority"
AUTHORITY_DAYS = 3650
MOST_DAYS = 3650
DAYS = {
    Role.GATEWAY: 365,
    Role.RECORDER: 365,
    Role.ROBOT: 365,
    Role.ENGINEER: 90,
    Role.OPERATOR: 90,
    Role.VIEWER: 90,
}
"""How long a certificate is good by default: machines a year, people, who carry theirs about, three months."""
BACKDATED = timedelta(hours=1)
"""A certificate is good from so long before it was made: clocks of other machines may be behind."""
WARN_DAYS = 21
"""Days before its end when a certificate is reported as expiring."""
LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Every gateway's certificate is good for these: tools on the gateway itself."""
_HOST = re.compile(r"(?=.{1,253}$)[a-z0-9]([a-z0-9-]{0,62})(\.[a-z0-9]([a-z0-9-]{0,62}))*", re.IGNORECASE)
MOST_COMMON_NAME = 64
"""Characters of a common name (RFC 5280)."""


def common_name(role: Role, name: str) -> str:
    """The common name of a certificate, which access control goes by."""
    return f"{role}:{name}" if role is Role.ROBOT else str(role)


def check_member(role: Role, name: str) -> None:
    """Raise ConfigError when no member can have that name."""
    try:
        check_name(name, str(role))
    except PayloadError as error:
        raise ConfigError(error.message, remedy=error.remedy) from error
    most = MOST_COMMON_NAME - len(common_name(role, ""))
    if role is Role.ROBOT and len(name) > most:
        raise ConfigError(f"robot name {name!r} has {len(name)} characters", remedy=f"at most {most} in a certificate")


def make_authority(fleet: str, key: Ed25519PrivateKey, now: datetime) -> x509.Certificate:
    """Make the certificate of a fleet's authority, which signs itself."""
    name = _authority_name(fleet)
    public = key.public_key()
    return (
        _builder(name, name, public, now, AUTHORITY_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
        .sign(key, None)
    )


def make_certificate(
    authority: x509.Certificate,
    authority_key: Ed25519PrivateKey,
    public: Ed25519PublicKey,
    *,
    role: Role,
    name: str,
    hosts: Sequence[str],
    days: int,
    now: datetime,
) -> x509.Certificate:
    """Make a certificate. `hosts`: names and addresses under which a gateway is dialled; others accept no links."""
    check_member(role, name)
    fleet = fleet_of(authority)
    if not 1 <= days <= MOST_DAYS:
        raise ConfigError(f"--days {days}", remedy=f"from 1 to {MOST_DAYS:,}")
    subject = x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, common_name(role, name)),
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, fleet),
        ]
    )
    if hosts and role is not Role.GATEWAY:
        raise ConfigError(f"--host is given for a {role}", remedy="only gateways and routers accept links")
    served = (*LOOPBACK, *hosts) if role is Role.GATEWAY else ()
    names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(f"{SCHEME}://{fleet}/{role}/{name}")]
    names += [_host(each) for each in dict.fromkeys(served)]
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role is Role.GATEWAY:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    return (
        _builder(subject, authority.subject, public, now, days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(_ed25519(authority)),
            critical=False,
        )
        .sign(authority_key, None)
    )


def hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    """The names and addresses that a certificate is good for, those of the loopback left out."""
    found = _alternative_names(certificate)
    names = [*found.get_values_for_type(x509.DNSName), *map(str, found.get_values_for_type(x509.IPAddress))]
    return tuple(each for each in names if each not in LOOPBACK)


def fleet_of(authority: x509.Certificate) -> str:
    """The fleet that an authority is of."""
    found = authority.subject.get_attributes_for_oid(NameOID.ORGANIZATION_NAME)
    if len(found) != 1:
        raise IdentityError("that is no certificate of a fleet's authority", remedy="swiftbot keys init makes one")
    return str(found[0].value)


def identify(certificate: x509.Certificate, authority: x509.Certificate) -> Identity:
    """Read a certificate and check that the authority signed it; not whether it is expired or revoked.

    Raises:
        IdentityError: another authority signed it, or it is no certificate of a fleet's member.
    """
    try:
        certificate.verify_directly_issued_by(authority)
        signed = True
    except (InvalidSignature, ValueError, TypeError, UnsupportedAlgorithm):
        signed = False
    if not signed:
        raise IdentityError(
            "another authority signed that certificate",
            remedy=f"ask the keeper of the authority of fleet {fleet_of(authority)} for one",
        )
    try:
        (uri,) = _alternative_names(certificate).get_values_for_type(x509.UniformResourceIdentifier)
        parts = urlsplit(uri)
        _, role, name = parts.path.split("/")
        found = Role(role)
        check_name(name, role)
        named = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
    except (ValueError, IndexError, PayloadError, x509.ExtensionNotFound) as error:
        raise IdentityError(f"that is no certificate of a member of the fleet: {error}") from error
    fleet = fleet_of(authority)
    if (parts.scheme, parts.netloc) != (SCHEME, fleet) or named != common_name(found, name):
        raise IdentityError("that is no certificate of a member of the fleet", remedy=f"its fleet is {parts.netloc}")
    return Identity(
        fleet=fleet,
        role=found,
        name=name,
        serial=serial_of(certificate),
        not_before=certificate.not_valid_before_utc.timestamp(),
        not_after=certificate.not_valid_after_utc.timestamp(),
    )


def serial_of(certificate: x509.Certificate) -> str:
    """The serial number of a certificate, as it is shown and listed."""
    return f"{certificate.serial_number:040x}"


def ed25519_of(certificate: x509.Certificate) -> Ed25519PublicKey:
    """The public key of a certificate; IdentityError where it is of another kind."""
    return _ed25519(certificate)


def _ed25519(certificate: x509.Certificate) -> Ed25519PublicKey:
    key = certificate.public_key()
    if not isinstance(key, Ed25519PublicKey):
        raise IdentityError(
            "the key of that certificate is not Ed25519", remedy="have `swiftbot keys issue` make it, with its key"
        )
    return key


def _alternative_names(certificate: x509.Certificate) -> x509.SubjectAlternativeName:
    return certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value


def _authority_name(fleet: str) -> x509.Name:
    return x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, AUTHORITY_NAME),
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, fleet),
        ]
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, public: Ed25519PublicKey, now: datetime, days: int
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(now + timedelta(days=days))
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text.strip("[]")))
    except ValueError:
        pass
    if not _HOST.fullmatch(text):
        raise ConfigError(
            f"--host {text[:80]!r} is neither a host name nor an address",
            remedy="write it as gw-1.example or 192.168.1.11, without protocol and port",
        )
    return x509.DNSName(text)
