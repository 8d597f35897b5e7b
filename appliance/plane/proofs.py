"""Proofs of gateways: each signs a challenge, at its own key, with a certificate of its own name."""

import secrets
from collections import OrderedDict
from typing import TYPE_CHECKING, Final

from appliance.errors import IdentityError, SwiftbotError
from appliance.identity.member import Identity
from appliance.model import keyspace
from appliance.model.keys import Keys
from appliance.model.plane_api import MemberAsk
from appliance.plane.membership import MOST_MEMBERS
from appliance.plane.rpc import Rpc

if TYPE_CHECKING:
    from appliance.identity.credentials import Credentials

_VERB: Final = keyspace.MEMBER


class Proofs:
    """Asks gateways for proofs, and gives this one's.

    The certificate of each gateway's last proof is remembered. One that does not answer is refused when the roster has
    revoked that certificate: the holder of a stolen key would otherwise stay a member by its silence.
    """

    def __init__(self, credentials: "Credentials", *, rpc: Rpc, keys: Keys, gateway: str, within_s: float) -> None:
        self._credentials = credentials
        self._rpc = rpc
        self._keys = keys
        self._gateway = gateway
        self._within_s = within_s
        self._known: OrderedDict[str, Identity] = OrderedDict()
        """Gateway -> the certificate that it proved itself with last."""

    async def prove(self, name: str) -> None:
        """Have a gateway prove that it is the one of that id.

        Raises:
            IdentityError: it is not, or it does not answer and its last certificate is revoked.
            SwiftbotError: it does not answer.
        """
        challenge = secrets.token_hex(16)
        ask = MemberAsk(gateway=self._gateway, challenge=challenge)
        try:
            answer = await self._rpc.call(name, _VERB, ask, timeout_s=self._within_s)
        except SwiftbotError:
            if (known := self._known.get(name)) is not None:
                self._credentials.roster.check(known)
            raise
        identity = self._credentials.verify(answer.proof, self._key(name), challenge.encode(), roles=keyspace.GATEWAYS)
        if identity.name != name:
            raise IdentityError(f"{identity.text} answers for gateway {name}")
        self._known[name] = identity
        self._known.move_to_end(name)
        while len(self._known) > MOST_MEMBERS:
            self._known.popitem(last=False)

    def proof(self, challenge: str) -> bytes:
        """Sign another gateway's challenge."""
        return self._credentials.sign(self._key(self._gateway), challenge.encode())

    def _key(self, name: str) -> str:
        return self._keys(keyspace.RPC, name, _VERB.name)
