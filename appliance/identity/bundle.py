"""What one process needs to prove who it is: its private key, its certificate and the authority's, in one PEM file.

One file is copied whole or not at all. Zenoh is handed the three parts one by one (`parts`).
"""

import re
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from msgspec import Struct

from appliance.errors import IdentityError
from appliance.identity import certificates, files
from appliance.identity.member import Identity

_BLOCK = re.compile(rb"-----BEGIN ([A-Z ]+)-----\r?\n.*?-----END \1-----\r?\n?", re.DOTALL)
_WHOLE = ["PRIVATE KEY", "CERTIFICATE", "CERTIFICATE"]
_ISSUE = "swiftbot keys issue ROLE NAME, on the machine that has the authority, makes one"


class Bundle(Struct, frozen=True, kw_only=True):
    """A private key with its certificate and that of the authority which signed it."""

    path: Path
    """Where it was read."""
    key: Ed25519PrivateKey
    certificate: x509.Certificate
    authority: x509.Certificate
    identity: Identity

    @classmethod
    def load(cls, path: Path) -> "Bundle":
        """Read a file; whether it is expired or revoked is not looked at.

        Raises:
            IdentityError: it is absent, open to others, cut off, or its parts do not belong together.
        """
        return cls.parse(files.read(path, private=True, absent=_ISSUE), path)

    @classmethod
    def parse(cls, data: bytes, path: Path) -> "Bundle":
        """Read what a file has; as `load`."""
        blocks = [(found[1].decode(), found[0]) for found in _BLOCK.finditer(data)]
        labels = [label for label, _ in blocks]
        if labels != _WHOLE:
            has = ", ".join(labels) or "nothing that is PEM"
            raise IdentityError(
                f"{path} is cut off or no file of keys: it has {has}",
                remedy=f"copy it again; {_ISSUE}",
            )
        try:
            key = serialization.load_pem_private_key(blocks[0][1], password=None)
            own, authority = (x509.load_pem_x509_certificate(block) for _, block in blocks[1:])
        except (ValueError, TypeError, x509.InvalidVersion) as error:
            raise IdentityError(f"{path} is damaged: {error}", remedy=f"copy it again; {_ISSUE}") from None
        if not isinstance(key, Ed25519PrivateKey):
            raise IdentityError(f"{path} has a key that is not Ed25519", remedy=_ISSUE)
        try:
            identity = certificates.identify(own, authority)
        except IdentityError as error:
            raise IdentityError(f"{path}: {error.message}", remedy=error.remedy) from error
        if key.public_key() != certificates.ed25519_of(own):
            raise IdentityError(f"{path}: key and certificate do not belong together", remedy=_ISSUE)
        return cls(path=path, key=key, certificate=own, authority=authority, identity=identity)

    def parts(self) -> tuple[bytes, bytes, bytes]:
        """Private key, certificate and the authority's certificate, each as PEM."""
        return (
            private_text(self.key),
            self.certificate.public_bytes(serialization.Encoding.PEM),
            self.authority.public_bytes(serialization.Encoding.PEM),
        )

    def text(self) -> bytes:
        """What its file has."""
        return b"".join(self.parts())


def private_text(key: Ed25519PrivateKey) -> bytes:
    """A private key as PEM."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
