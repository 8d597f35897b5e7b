"""Requests that are signed by who makes them, and checked where they are carried out.

Zenoh tells the receiver of a message no certificate, only that access control let it through, maybe two links ago. So
who gives an order signs it: over the key that it is sent to, its payload, the time and a number, with the key of its
certificate, which goes with it. What is carried out, and what the audit says, goes by that name.

**Replay.** The same request counts once. Each signer numbers its requests within a session of its own, and each
verifier remembers which of the last `WINDOW` numbers it has seen (as RFC 4303 does): a fixed amount for each signer,
however many requests there are. A session that is forgotten cannot come back: people's and robots' requests must be
made within `SKEW_S` of the verifier's clock. Gateways' need not, since nothing between gateways goes by the time of
day, and only gateways could repeat what a gateway has said.

Pure: clocks are passed in. Signing takes 0.03 ms and verifying 0.08 ms (a known certificate).
"""

import hashlib
import secrets
import struct
import warnings
from collections import Counter, OrderedDict
from collections.abc import Callable

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.utils import CryptographyDeprecationWarning
from msgspec import Struct

from appliance.errors import IdentityError
from appliance.identity import certificates
from appliance.identity.member import Identity
from appliance.model.roles import Role

SKEW_S = 60.0
"""How far the clocks of people's and robots' machines may be from a gateway's."""
WINDOW = 4096
"""Numbers of one session that may arrive in another order than they were given."""
MOST_SESSIONS = 4096
"""Signers' sessions remembered at once."""
MOST_OF_ONE = 1024
"""Of these of one certificate: one member that opens sessions without end must not keep the others' requests out."""
MOST_CERTIFICATES = 1024
"""Certificates of which it is remembered that the authority signed them."""
MOST_BYTES = 4096
"""Of a signature with its certificate."""
_DOMAIN = b"swiftbot request 1\0"
_HEAD = struct.Struct(">B8sQQ64s")
"""Version, session, number, Unix nanoseconds, signature."""
_VERSION = 1


def _signed(key: str, payload: bytes, session: bytes, number: int, at_ns: int) -> bytes:
    digest = hashlib.sha256(payload).digest()
    return b"".join((_DOMAIN, session, struct.pack(">QQ", number, at_ns), digest, key.encode()))


class Signer:
    """Signs the requests of one process."""

    def __init__(self, key: Ed25519PrivateKey, certificate: x509.Certificate) -> None:
        self._key = key
        self._certificate = certificate.public_bytes(Encoding.DER)
        self._session = secrets.token_bytes(8)
        self._number = 0

    def sign(self, key: str, payload: bytes, at_ns: int) -> bytes:
        """Sign a request for a key, made now; another number each time."""
        self._number += 1
        signature = self._key.sign(_signed(key, payload, self._session, self._number, at_ns))
        return _HEAD.pack(_VERSION, self._session, self._number, at_ns, signature) + self._certificate


class _Seen:
    """Which numbers of a session have come: the highest, and a bit for each of those below it."""

    def __init__(self) -> None:
        self.last_s = 0.0
        self._highest = 0
        self._bits = 0

    def first(self, number: int) -> bool:
        """Note a number; False when it has come before, or is too old to tell."""
        ahead = number - self._highest
        if ahead > 0:
            self._bits = ((self._bits << ahead) | 1) & ((1 << WINDOW) - 1) if ahead < WINDOW else 1
            self._highest = number
            return True
        if -ahead >= WINDOW or self._bits >> -ahead & 1:
            return False
        self._bits |= 1 << -ahead
        return True


class _Known(Struct, frozen=True):
    """A certificate that the authority signed."""

    identity: Identity
    public: Ed25519PublicKey


class Verifier:
    """Checks requests that others have signed.

    Args:
        authority: whose certificates count.
        check: raises IdentityError for one that is expired or revoked; told the moment in Unix seconds.
    """

    def __init__(self, authority: x509.Certificate, check: Callable[[Identity, float], None]) -> None:
        self._authority = authority
        self._check = check
        self._known: OrderedDict[bytes, _Known] = OrderedDict()
        self._seen: OrderedDict[tuple[str, bytes], _Seen] = OrderedDict()
        """Serial number and session -> its numbers; the one that was used last is last."""
        self._counts: Counter[str] = Counter()
        """Serial number -> its sessions in the table."""

    def verify(self, signature: bytes, key: str, payload: bytes, *, now: float, clock_s: float) -> Identity:
        """Return who signed a request for a key.

        Args:
            signature: what came with it.
            key: for which it came.
            payload: all of it.
            now: Unix seconds.
            clock_s: seconds of a clock that runs evenly.

        Raises:
            IdentityError: it is not signed, or for another key or payload; the certificate is of another authority,
                expired or revoked; the clocks are too far apart; it has come before.
        """
        if not signature:
            raise IdentityError("the request is not signed", remedy="use the commands of this version, with --keys")
        if not _HEAD.size < len(signature) <= MOST_BYTES or signature[0] != _VERSION:
            raise IdentityError("the signature cannot be read", remedy="use the commands of this version")
        _, session, number, at_ns, mark = _HEAD.unpack_from(signature)
        known = self._certificate(signature[_HEAD.size :])
        identity = known.identity
        try:
            known.public.verify(mark, _signed(key, payload, session, number, at_ns))
        except InvalidSignature:
            raise IdentityError(
                f"the signature of {identity.text} is for another request", remedy="send the request as it was signed"
            ) from None
        self._check(identity, now)
        if identity.role is not Role.GATEWAY and abs(ahead_s := at_ns / 1e9 - now) > SKEW_S:
            where = "ahead of" if ahead_s > 0 else "behind"
            raise IdentityError(
                f"the clock of {identity.text} is {abs(ahead_s):,.0f} s {where} this gateway's, or the request is old",
                remedy="set the clocks of both machines (timedatectl)",
            )
        if not self._session(identity, session, clock_s).first(number):
            raise IdentityError(f"the request of {identity.text} has come before", remedy="sign it again")
        return identity

    def _certificate(self, data: bytes) -> _Known:
        known = self._known.get(data)
        if known is None:
            try:
                with warnings.catch_warnings():
                    # What the library still reads and the standard forbids, such as a negative serial number.
                    warnings.simplefilter("error", CryptographyDeprecationWarning)
                    certificate = x509.load_der_x509_certificate(data)
            except (ValueError, x509.InvalidVersion, CryptographyDeprecationWarning) as error:
                raise IdentityError(f"the certificate of the request cannot be read: {error}") from None
            known = _Known(certificates.identify(certificate, self._authority), certificates.ed25519_of(certificate))
            while len(self._known) >= MOST_CERTIFICATES:
                self._known.popitem(last=False)
        self._known[data] = known
        self._known.move_to_end(data)
        return known

    def _session(self, identity: Identity, session: bytes, clock_s: float) -> _Seen:
        name = identity.serial, session
        seen = self._seen.get(name)
        if seen is None:
            self._make_room(identity, clock_s)
            seen = self._seen[name] = _Seen()
            self._counts[identity.serial] += 1
        seen.last_s = clock_s
        self._seen.move_to_end(name)
        return seen

    def _make_room(self, identity: Identity, clock_s: float) -> None:
        """Forget the oldest sessions until there is room; IdentityError where they could still come back."""
        while (own := self._counts[identity.serial] >= MOST_OF_ONE) or len(self._seen) >= MOST_SESSIONS:
            (serial, session), oldest = next(iter(self._seen.items()))
            if clock_s - oldest.last_s <= 2 * SKEW_S:
                most, whose = (MOST_OF_ONE, f" of {identity.text}") if own else (MOST_SESSIONS, "")
                raise IdentityError(
                    f"{most:,} sessions{whose} have signed requests within {2 * SKEW_S:.0f} s",
                    remedy="try again in two minutes",
                )
            del self._seen[serial, session]
            self._counts[serial] -= 1
            if not self._counts[serial]:
                del self._counts[serial]
