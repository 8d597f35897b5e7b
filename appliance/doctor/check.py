"""What a check says."""

from msgspec import Struct

SETUP = "run `make setup`"
"""The remedy for much."""


class Check(Struct, frozen=True, kw_only=True):
    """One prerequisite: what was found, and what to do when it is not `ok`."""

    name: str
    ok: bool
    detail: str
    remedy: str = ""
    required: bool = True
