"""Requests and replies of the verbs by which operators and other gateways steer a gateway's pool.

Requests refuse unknown fields, so that a typing error is an error and not a silent default.
"""

from msgspec import Struct

from appliance.model import Signed


class Hinted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Answer to a `PoolHint`: `taken` is False where it cannot be followed, `why` says so."""

    taken: bool
    why: str = ""


class WarmAsk(Signed, frozen=True, kw_only=True):
    """`pool_warm`: have `count` containers of an image ready besides those that work, for `keep_s` seconds.

    `wait_s`: how long the answer may wait for those that are started; 0 answers at once.
    """

    image: str
    count: int = 1
    keep_s: float = 600.0
    wait_s: float = 0.0


class Warmed(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How many containers of the image are ready and starting by now. `problem`: why there are fewer than asked."""

    image: str
    ready: int
    starting: int
    problem: str = ""


class EvictAsk(Signed, frozen=True, kw_only=True):
    """`pool_evict`: one container by its id, or all idle ones of an image; one of the two is named."""

    container: str = ""
    image: str = ""


class Evicted(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The containers that were given up, and those that were not, each with the reason."""

    containers: tuple[str, ...]
    kept: dict[str, str] = {}
    note: str = ""
    """What follows: the floor is filled again."""


class ReleaseAsk(Signed, frozen=True, kw_only=True):
    """`pool_release_quarantine`: which image may be started again."""

    image: str


class Released(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The image is started again; `reason` is why it had been left alone."""

    image: str
    reason: str


class DecisionsAsk(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`pool_decisions`: how many at most, newest first."""

    limit: int = 100


class PoolDecision(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A container was started or given up for a reason. `at_ns` is Unix time on the pool's gateway."""

    at_ns: int
    what: str
    """`start`, `retire`, `fail` (a start that did not work) or `adopt`."""
    image: str
    container: str
    why: str


class DecisionList(Struct, frozen=True, kw_only=True):
    """Recent decisions, newest first; `counts` of all since the gateway started, by what was done."""

    decisions: tuple[PoolDecision, ...]
    counts: dict[str, int]
