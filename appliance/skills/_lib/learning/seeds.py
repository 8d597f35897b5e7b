"""Seeds of a run: every use of chance in it has its own, so a round can be computed again anywhere, in any order."""

import hashlib


def seed(run_seed: int, round_number: int, client: str, use: str) -> int:
    """Return the seed of one use (`"shuffle"`, `"dropout"`, …) by a client in a round: 63 bits.

    Blake2b of the parts joined by `/`, so two runs, rounds, clients or uses share no seed. 63 bits, since a signed
    integer of 64 is the largest that JSON decoders, numpy and torch all take.

    Raises:
        ValueError: `client` or `use` contains `/`, so that other parts could have the same seed.
    """
    if "/" in client or "/" in use:
        raise ValueError(f"client {client!r} and use {use!r} of a seed may not contain '/'")
    text = f"{run_seed}/{round_number}/{client}/{use}"
    return int.from_bytes(hashlib.blake2b(text.encode()).digest()[:8], "big") >> 1
