"""The one error tree: every failure a person can meet names its cause and, where there is one, the remedy.

    SwiftbotError
    ├── ConfigError          a configuration file or option is wrong
    ├── PayloadError         a message is malformed or too large
    ├── PrerequisiteError    something the machine must have is missing (Podman, an image, a model)
    ├── UnreachableError     no gateway, robot or server answered
    ├── DeadlineError        it answered too late
    ├── ConflictError        the record has moved on since it was read (optimistic concurrency)
    ├── NotFoundError        no such task, robot, container, file
    ├── RefusedError         understood and declined, with the reason (capacity, draining, stale attempt)
    │   └── UnapprovedError  no operator approved the plan in time
    ├── PlanError            no valid plan for the instruction
    ├── PoolError            a container could not be started, reached or kept
    ├── RobotError           a robot did not do what was asked
    │   ├── TakenError       a pilot or a failsafe at the vehicle has it
    │   └── ContractError    its program does not answer commands, or carries one out again when it is asked again
    ├── RecordError          a log cannot be written or read
    ├── IdentityError        a certificate, key or signature is missing, wrong, expired, revoked or of another role
    └── CancelledByOperatorError  somebody asked for it to stop

`code` travels over Zenoh in an error reply and is turned back into the same class on the other side.
`exit_code` is what the command line ends with, one of `Exit`.
"""

from enum import IntEnum, unique
from typing import ClassVar


@unique
class Exit(IntEnum):
    """What a command ends with; no other place gives these numbers a meaning (docs/configuration.md is made of it)."""

    DONE = 0
    """done"""
    FAILED = 1
    """it failed: a task or robot that did not do it, a replay that differs, an unreadable log, an internal error"""
    USAGE = 2
    """the command line or a configuration is wrong"""
    UNREACHABLE = 3
    """nobody answered (no gateway, robot or server)"""
    REFUSED = 4
    """refused or not found, and nothing was changed: no valid plan; unknown robot, skill, task or place; a full
    gateway; a record that has moved on since it was read (a conflict); a robot that a pilot has"""
    MISSING = 5
    """something the machine must have is missing (`swiftbot doctor` says what)"""
    LATE = 6
    """no result in time"""
    CANCELLED = 7
    """cancelled"""
    REJECTED = 8
    """its plan was rejected, or not approved in time"""
    DENIED = 9
    """a certificate or key is missing, wrong, expired or revoked, or its role may not do it"""
    INTERRUPTED = 130
    """interrupted"""


class SwiftbotError(Exception):
    """Base of all errors of this product: `message` says what happened, `remedy` what to do about it."""

    code: ClassVar[str] = "internal"
    exit_code: ClassVar[Exit] = Exit.FAILED

    def __init__(self, message: str, *, remedy: str = "", retry_after_s: float = 0.0) -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy
        self.retry_after_s = retry_after_s
        """Of what was refused for want of room: when to ask again; 0: not known."""

    def __str__(self) -> str:
        """Cause and remedy in one line."""
        return f"{self.message} ({self.remedy})" if self.remedy else self.message


class ConfigError(SwiftbotError):
    """A configuration file or option is wrong."""

    code = "config"
    exit_code = Exit.USAGE


class PayloadError(SwiftbotError):
    """A message is malformed or too large; it was counted and dropped."""

    code = "payload"
    exit_code = Exit.REFUSED


class PrerequisiteError(SwiftbotError):
    """Something the machine must have is missing."""

    code = "prerequisite"
    exit_code = Exit.MISSING


class UnreachableError(SwiftbotError):
    """No gateway, robot or server answered."""

    code = "unreachable"
    exit_code = Exit.UNREACHABLE

    def __init__(self, message: str, *, remedy: str = "", retry_after_s: float = 0.0, sent: bool = False) -> None:
        super().__init__(message, remedy=remedy, retry_after_s=retry_after_s)
        self.sent = sent
        """Whether what was asked for may have been done: it was on its way when the addressee went away."""


class DeadlineError(SwiftbotError):
    """No result within the time allowed."""

    code = "deadline"
    exit_code = Exit.LATE


class ConflictError(SwiftbotError):
    """The record has moved on since it was read: read, decide again, retry."""

    code = "conflict"
    exit_code = Exit.REFUSED


class NotFoundError(SwiftbotError):
    """What was named does not exist."""

    code = "not-found"
    exit_code = Exit.REFUSED


class RefusedError(SwiftbotError):
    """Understood and declined; the message is the reason."""

    code = "refused"
    exit_code = Exit.REFUSED


class UnapprovedError(RefusedError):
    """No operator approved the plan in time."""

    code = "unapproved"
    exit_code = Exit.REJECTED


class PlanError(SwiftbotError):
    """No valid plan for the instruction; `problems` lists what is wrong with the best attempt."""

    code = "plan"
    exit_code = Exit.REFUSED

    def __init__(
        self, message: str, *, remedy: str = "", problems: tuple[str, ...] = (), oversize: bool = False
    ) -> None:
        super().__init__(message, remedy=remedy)
        self.problems = problems
        self.oversize = oversize
        """Whether the plan would be longer than any may be: no other planner can do better."""


class PoolError(SwiftbotError):
    """A container could not be started, reached or kept."""

    code = "pool"


class RobotError(SwiftbotError):
    """A robot did not do what was asked."""

    code = "robot"


class ContractError(RobotError):
    """A robot's program does not keep to docs/robot-contract.md: another attempt would go the same way."""

    code = "contract"


class PreconditionError(RobotError):
    """What is asked cannot be done as things stand: too far away, the hand full or empty, still on the ground.

    The order is at fault and not the robot; a step before it would help.
    """

    code = "precondition"
    exit_code = Exit.REFUSED


class TakenError(RobotError):
    """A pilot or a failsafe at the vehicle has control: commands wait until it is given back."""

    code = "taken"
    exit_code = Exit.REFUSED


class RecordError(SwiftbotError):
    """A log cannot be written or read."""

    code = "record"


class IdentityError(SwiftbotError):
    """A certificate, key or signature is missing, wrong, expired, revoked, or of a role that may not do it."""

    code = "identity"
    exit_code = Exit.DENIED
    sender = ""
    """Name in the certificate of who asked, where the signature is good and only the role is not."""


class CancelledByOperatorError(SwiftbotError):
    """Somebody asked for it to stop."""

    code = "cancelled"
    exit_code = Exit.CANCELLED


def _tree(root: type[SwiftbotError]) -> dict[str, type[SwiftbotError]]:
    # A kind without a code of its own, such as one of a room, travels as the kind that it is made from.
    found = {root.code: root} if "code" in vars(root) else {}
    for child in root.__subclasses__():
        found |= _tree(child)
    return found


def from_code(code: str, message: str, remedy: str = "", retry_after_s: float = 0.0) -> SwiftbotError:
    """Rebuild an error that came over the wire; an unknown code becomes the base class."""
    error = _tree(SwiftbotError).get(code, SwiftbotError)(message, remedy=remedy)
    error.retry_after_s = retry_after_s
    return error
