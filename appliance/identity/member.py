"""A member of the fleet as its certificate names it, and whose request is being answered just now.

Apart from `certificates` so that a process without keys does not load what only those with keys need.
"""

from contextvars import ContextVar
from datetime import UTC, datetime

from msgspec import Struct

from appliance.errors import IdentityError
from appliance.model.roles import Role


class Identity(Struct, frozen=True, kw_only=True):
    """What a certificate says of its holder."""

    fleet: str
    role: Role
    name: str
    serial: str
    """Hexadecimal."""
    not_before: float
    """Unix seconds."""
    not_after: float

    @property
    def text(self) -> str:
        """Role and name, for people and logs."""
        return f"{self.role} {self.name}"

    def check_time(self, now: float) -> None:
        """Raise IdentityError when the certificate is not yet, or no longer, good at a moment (Unix seconds)."""
        if now < self.not_before:
            raise IdentityError(
                f"the certificate of {self.text} is valid from {_day(self.not_before)}, and it is {_day(now)} here",
                remedy="set this machine's clock",
            )
        if now >= self.not_after:
            raise IdentityError(
                f"the certificate of {self.text} expired on {_day(self.not_after)}",
                remedy=f"swiftbot keys renew {self.role} {self.name}",
            )

    def days_left(self, now: float) -> float:
        """Days until it expires; negative after that."""
        return (self.not_after - now) / 86_400


SENDER: ContextVar[Identity | None] = ContextVar("sender", default=None)
"""Who signed the request that is being answered; None: on links without keys, or where none is asked for."""


def _day(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M UTC")
