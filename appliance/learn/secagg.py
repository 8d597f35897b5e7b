"""Secure aggregation: the keys of a round's clients, without I/O. Source: Bonawitz et al. 2017, figure 4 (semi-honest).

The parties are the clients of a round; what a client holds in secret is held by the gateway at which it trains
(`Holder`). For each round and cohort (an *epoch* of keys):

1. `advertise`: each client makes two X25519 key pairs, one for masks and one for shares, and tells the public keys.
2. `share`: it draws the seed of its own mask, cuts that seed and its private mask key into Shamir shares, of which
   `threshold` of the cohort are needed, and encrypts each share for one other client. `hold`: it keeps those of others.
3. Its update is masked (`masks`) with its own mask and one for each other client, that both of a pair know from their
   keys (HKDF) and that one adds and the other subtracts.
4. `unmask`: when it is certain whose updates are summed, clients give away of each of those the share of its own
   mask's seed, of each other one the share of its mask key: never both of one client, and for one set of clients only.

From `threshold` shares `leftover` works out which masks are left in the sum of the updates that came, so that any
number of clients up to n - threshold may drop out. Private keys are in memory alone: a gateway that restarts forgets
them, and its clients drop out of the round.
"""

import secrets
from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from appliance.errors import PayloadError, RefusedError
from appliance.model.learn_api import Revealed, Sealed
from appliance.model.learning import Cohort, PublicKeys
from appliance.skills._lib.learning.masks import SEED_BYTES, Seed

PRIME = 2**521 - 1
"""Field of shares: a Mersenne prime above 2^256, so that any secret of 32 bytes is in it."""
LEAST = 3
"""Clients of a cohort at least: of two each could tell the other's update from the sum."""
KEPT = 4096
"""Epochs of clients whose keys a gateway keeps; the oldest go first."""
_NONCE = bytes(12)
"""Each key encrypts one message only."""


def threshold(clients: int) -> int:
    """Return how many shares are needed: more than half, so that no two sets of clients can unmask two sums."""
    return clients // 2 + 1


def check_spread(places: Mapping[str, str]) -> None:
    """Raise RefusedError where a cohort hides nothing: too small, or one gateway has the keys of so many alone.

    Args:
        places: client -> its gateway.
    """
    if len(places) < LEAST:
        raise RefusedError(f"{len(places)} clients with keys, secure aggregation needs at least {LEAST}")
    at: dict[str, int] = {}
    for gateway in places.values():
        at[gateway] = at.get(gateway, 0) + 1
    gateway, most = max(at.items(), key=lambda item: (item[1], item[0]))
    if most >= threshold(len(places)):
        raise RefusedError(
            f"{most} of {len(places)} clients are at {gateway}, which could unmask the others alone",
            remedy="secure aggregation needs less than a majority of the clients at each gateway",
        )


# --- Shamir's secret sharing


def split(secret: bytes, count: int, needed: int) -> list[int]:
    """Return `count` shares of a secret of 32 bytes, for x = 1, 2, …; any `needed` of them give it back."""
    terms = [int.from_bytes(secret, "big"), *(secrets.randbelow(PRIME) for _ in range(needed - 1))]
    shares: list[int] = []
    for x in range(1, count + 1):
        value = 0
        for term in reversed(terms):
            value = (value * x + term) % PRIME
        shares.append(value)
    return shares


def join(shares: Mapping[int, int]) -> bytes:
    """Return the secret of some shares, by x (Lagrange's interpolation at 0); PayloadError where it is none."""
    secret = 0
    for x, y in shares.items():
        top = bottom = 1
        for other in shares:
            if other != x:
                top = top * -other % PRIME
                bottom = bottom * (x - other) % PRIME
        secret = (secret + y * top * pow(bottom, -1, PRIME)) % PRIME
    if secret >= 1 << 8 * SEED_BYTES:
        raise PayloadError("the shares of a secret do not fit together")
    return secret.to_bytes(SEED_BYTES, "big")


# --- keys


def _pair() -> tuple[bytes, str]:
    private = X25519PrivateKey.generate()
    return private.private_bytes_raw(), private.public_key().public_bytes_raw().hex()


def _agreed(private: bytes, public: str, use: str) -> bytes:
    """Return what two clients know of each other's keys, for one use; PayloadError where a key is none."""
    try:
        shared = X25519PrivateKey.from_private_bytes(private).exchange(
            X25519PublicKey.from_public_bytes(bytes.fromhex(public))
        )
    except ValueError as error:
        raise PayloadError(f"a client's public key is none: {error}") from error
    return HKDF(algorithm=SHA256(), length=SEED_BYTES, salt=None, info=f"swiftbot secagg {use}".encode()).derive(shared)


def _pair_seed(private: bytes, public: str, epoch: str, one: str, other: str) -> bytes:
    first, second = sorted((one, other))
    return _agreed(private, public, f"mask {epoch} {first} {second}")


class _Client:
    """A client of an epoch, with its secrets."""

    def __init__(self, name: str, gateway: str) -> None:
        self.sharing, sharing = _pair()
        self.masking, masking = _pair()
        self.public = PublicKeys(client=name, gateway=gateway, sharing=sharing, masking=masking)
        self.seed = secrets.token_bytes(SEED_BYTES)
        self.cohort: dict[str, PublicKeys] = {}
        self.needed = 0
        self.held: dict[str, tuple[int, int, int]] = {}
        """Of another client: x, the share of its seed, the share of its mask key."""
        self.summed: frozenset[str] | None = None
        """Whose updates are summed, once that was told."""


class Holder:
    """The secrets of the clients at a gateway.

    Args:
        gateway: its name.
    """

    def __init__(self, gateway: str) -> None:
        self._gateway = gateway
        self._clients: OrderedDict[tuple[str, str], _Client] = OrderedDict()

    def advertise(self, epoch: str, clients: Iterable[str]) -> tuple[PublicKeys, ...]:
        """Make the keys of clients here; asked again the same ones."""
        found: list[PublicKeys] = []
        for name in clients:
            client = self._clients.get((epoch, name))
            if client is None:
                client = self._clients[epoch, name] = _Client(name, self._gateway)
            found.append(client.public)
        while len(self._clients) > KEPT:
            self._clients.popitem(last=False)
        return tuple(found)

    def _here(self, cohort: Cohort) -> list[_Client]:
        found = (self._clients.get((cohort.epoch, each.client)) for each in cohort.clients)
        return [client for client in found if client is not None]

    def share(self, cohort: Cohort) -> tuple[Sealed, ...]:
        """Cut the secrets of the clients here for a cohort, each share encrypted for one of it.

        Raises:
            RefusedError: the cohort hides nothing.
            PayloadError: a public key is none.
        """
        check_spread({each.client: each.gateway for each in cohort.clients})
        ordered = sorted(cohort.clients, key=lambda each: each.client)
        needed = threshold(len(ordered))
        sealed: list[Sealed] = []
        for client in self._here(cohort):
            name = client.public.client
            seeds = split(client.seed, len(ordered), needed)
            keys = split(client.masking, len(ordered), needed)
            for x, (other, seed, key) in enumerate(zip(ordered, seeds, keys, strict=True), start=1):
                if other.client == name:
                    client.held[name] = (x, seed, key)
                    continue
                text = b"".join((x.to_bytes(4, "big"), seed.to_bytes(66, "big"), key.to_bytes(66, "big")))
                secret = _agreed(client.sharing, other.sharing, f"share {cohort.epoch} {name} {other.client}")
                data = ChaCha20Poly1305(secret).encrypt(_NONCE, text, None)
                sealed.append(Sealed(of=name, to=other.client, data=data.hex()))
        return tuple(sealed)

    def hold(self, cohort: Cohort, sealed: Iterable[Sealed]) -> int:
        """Keep the shares of others for the clients here, whose masks are for that cohort from now on.

        Returns:
            How many clients of it are here.

        Raises:
            PayloadError: a share is not for its client, or was changed.
        """
        known = {each.client: each for each in cohort.clients}
        here = self._here(cohort)
        for client in here:
            client.cohort, client.needed = known, threshold(len(known))
        for each in sealed:
            client, of = self._clients.get((cohort.epoch, each.to)), known.get(each.of)
            if client is None or of is None:
                continue
            secret = _agreed(client.sharing, of.sharing, f"share {cohort.epoch} {each.of} {each.to}")
            try:
                text = ChaCha20Poly1305(secret).decrypt(_NONCE, bytes.fromhex(each.data), None)
            except (InvalidTag, ValueError) as error:
                raise PayloadError(f"the share of {each.of} for {each.to} was changed on its way") from error
            x, seed, key = (int.from_bytes(text[low:high], "big") for low, high in ((0, 4), (4, 70), (70, 136)))
            client.held[each.of] = (x, seed, key)
        return len(here)

    def masks(self, epoch: str, client: str) -> list[Seed]:
        """Return the masks of a client's update; PayloadError where it is not of the epoch, such as after a restart."""
        found = self._clients.get((epoch, client))
        if found is None or not found.cohort or found.summed is not None:
            raise PayloadError(
                f"{self._gateway} has no keys of {client} for this round",
                remedy="it takes part in the next one: keys are in memory, and go with a restart or a move",
            )
        seeds = [Seed(found.seed, 1)]
        for name, other in sorted(found.cohort.items()):
            if name != client:
                seed = _pair_seed(found.masking, other.masking, epoch, client, name)
                seeds.append(Seed(seed, 1 if client < name else -1))
        return seeds

    def unmask(self, epoch: str, summed: Collection[str]) -> tuple[Revealed, ...]:
        """Give away what the sum of some clients' updates needs, for one such set only.

        Raises:
            RefusedError: too few are summed, or shares were given for another set.
        """
        wanted = frozenset(summed)
        here = [client for (of, _), client in self._clients.items() if of == epoch and client.cohort]
        for client in here:
            if not wanted <= client.cohort.keys() or len(wanted) < client.needed:
                raise RefusedError(f"{len(wanted)} updates are summed, {client.needed} of the cohort are needed")
            if client.summed not in (None, wanted):
                raise RefusedError("the shares of this round were given for other updates")
        found: list[Revealed] = []
        for client in here:
            client.summed = wanted
            found += [
                Revealed(of=of, x=x, y=f"{seed if of in wanted else key:x}")
                for of, (x, seed, key) in sorted(client.held.items())
            ]
        return tuple(found)


class MissingSharesError(ValueError):
    """Too few shares of a client's secret are there."""


def leftover(cohort: Cohort, summed: Collection[str], revealed: Iterable[Revealed]) -> list[Seed]:
    """Return the masks that are left in the sum of some clients' updates.

    Args:
        cohort: all clients for which masks were made.
        summed: those whose updates came.
        revealed: the shares that clients gave away.

    Raises:
        MissingSharesError: of a client fewer than the threshold are there.
        PayloadError: shares do not fit together.
    """
    needed = threshold(len(cohort.clients))
    shares: dict[str, dict[int, int]] = {}
    for each in revealed:
        shares.setdefault(each.of, {})[each.x] = int(each.y, 16)
    seeds: list[Seed] = []
    for each in sorted(cohort.clients, key=lambda each: each.client):
        found = dict(sorted(shares.get(each.client, {}).items())[:needed])
        if len(found) < needed:
            raise MissingSharesError(f"{len(found)} of {needed} shares of {each.client}")
        secret = join(found)
        if each.client in summed:
            seeds.append(Seed(secret, 1))
            continue
        for other in cohort.clients:
            if other.client in summed:
                seed = _pair_seed(secret, other.masking, cohort.epoch, each.client, other.client)
                seeds.append(Seed(seed, 1 if other.client < each.client else -1))
    return seeds
