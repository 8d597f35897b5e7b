"""What the policies are told and what they answer: facts in, orders out, each order with its reason."""

from msgspec import Struct, field


class Idle(Struct, frozen=True, kw_only=True):
    """A ready container that nobody has. `since` is when it became so, seconds of the clock that is passed in."""

    id: str
    image: str
    memory_mb: int
    runs: int
    cold_ms: float
    since: float


class View(Struct, frozen=True, kw_only=True):
    """The containers of one gateway at one moment, and what they may take."""

    idle: tuple[Idle, ...] = ()
    busy: dict[str, int] = field(default_factory=dict[str, int])
    """Containers of each image that have a run or are reserved for one."""
    lasting: dict[str, int] = field(default_factory=dict[str, int])
    """Of these, how many have been so for longer than a start of their image takes."""
    starting: dict[str, int] = field(default_factory=dict[str, int])
    memory_mb: int = 0
    """Memory of all containers in whatever state."""
    containers: int = 0
    """All containers in whatever state."""
    budget_mb: int
    """What they may take together now: less than the setting while the machine is short of memory."""
    capacity: int
    blocked: frozenset[str] = frozenset()
    """Images that are not to be started now (quarantine)."""


class Start(Struct, frozen=True, kw_only=True):
    """Start a container of this image, because."""

    image: str
    why: str


class Retire(Struct, frozen=True, kw_only=True):
    """Give this container up, because."""

    id: str
    why: str
