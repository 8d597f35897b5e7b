"""What a subtask asks of a container, and how one was chosen for it (paper, Algorithm 1)."""

from msgspec import Struct

from appliance.model.open_enum import OpenEnum


class Phase(OpenEnum):
    """Which phase of container selection served a subtask (paper, Algorithm 1)."""

    LOCAL_WARM = "local warm"
    REMOTE_WARM = "remote warm"
    COLD = "cold"


class Way(OpenEnum):
    """How a container comes to serve a subtask; the cheaper of the last two is taken (algorithms: selection)."""

    HERE = "here"
    """It is on the gateway that decides, with the state the subtask asks for."""
    RUN_THERE = "run there"
    """The subtask goes to the container: input bytes / bandwidth + round trip."""
    BRING_HERE = "bring here"
    """State volumes come to a container here: state bytes / bandwidth + serialise + deserialise + start."""
    NEW = "new"
    """A cold start."""


class Need(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What a subtask asks of a container: T = (image, cpu, mem, volumes) of Algorithm 1."""

    image: str
    cpu: float = 0.5
    memory_mb: int = 128
    volumes: tuple[str, ...] = ()


class Considered(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One possibility that a selection weighed. `verdict` says in words why it was (not) taken."""

    gateway: str
    container: str = ""
    image: str = ""
    way: Way = Way.HERE
    score: float = 0.0
    cost_ms: float = 0.0
    taken: bool = False
    verdict: str = ""


class Choice(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How a container was selected for an attempt, kept in the task's record for `swiftbot pool why`."""

    phase: Phase
    way: Way
    by: str
    """The gateway that decided."""
    gateway: str
    container: str = ""
    cold_ms: float = 0.0
    """What a cold start was expected to cost there and then."""
    considered: tuple[Considered, ...] = ()
    """The best ones first, at most 12."""
    why: str = ""
