"""Files that the authority has signed: the text that is signed and its signature, together in one JSON object.

Anybody may pass such a file on: who has the authority's certificate can check it without asking anybody.
"""

import base64
from typing import Any

import msgspec
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from appliance.errors import IdentityError

AGAIN = "copy it again from the authority"


def seal(name: str, text: bytes, key: Ed25519PrivateKey) -> bytes:
    """Return the file of a text, signed with the authority's key; `name` is what it is, such as `roster`."""
    signature = base64.b64encode(key.sign(_domain(name) + text)).decode()
    return msgspec.json.format(msgspec.json.encode({name: text.decode(), "signature": signature}))


def unseal(name: str, data: bytes, authority: Ed25519PublicKey, *, most: int) -> str:
    """Return the text of a file.

    Args:
        name: what it is, as it was signed.
        data: the file.
        authority: whose signature counts.
        most: bytes that the file may have.

    Raises:
        IdentityError: it is too large, damaged, or another authority signed it.
    """
    if len(data) > most:
        raise IdentityError(f"the {name} has {len(data):,} bytes", remedy=f"at most {most:,}")
    try:
        file = msgspec.json.decode(data, type=dict[str, Any])  # a later version may have more in it
        text, signature = file[name], file["signature"]
        if not isinstance(text, str) or not isinstance(signature, str):
            raise ValueError("no text")  # noqa: TRY301,TRY004 - as any other damage
        authority.verify(base64.b64decode(signature, validate=True), _domain(name) + text.encode())
    except InvalidSignature:
        raise IdentityError(f"the {name} is changed, or another authority signed it", remedy=AGAIN) from None
    except KeyError as error:
        raise IdentityError(f"that is no {name}: it has no {error}", remedy=AGAIN) from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # ValueError: no base64, no UTF-8
        raise damaged(name, error) from None
    return text


def damaged(name: str, error: Exception) -> IdentityError:
    """Return the error of a file that cannot be read."""
    return IdentityError(f"the {name} is damaged or cut off: {error}", remedy=AGAIN)


def _domain(name: str) -> bytes:
    """Before what is signed, so that a signature of something else is none of this."""
    return f"swiftbot {name} 1\0".encode()
