"""What upstream may cost a day: requests and money, by the prices that are configured. Pure; the day is passed in.

A day is the calendar day of this gateway's own clock, as it is on the bill; nothing between gateways rests on it.
"""

from msgspec import Struct
from msgspec.structs import replace

MILLION = 1_000_000


class Spent(Struct, frozen=True, kw_only=True):
    """On one day."""

    day: str = ""
    requests: int = 0
    cost: float = 0.0


class Budget:
    """Counts what is spent and says when it is enough.

    Args:
        cost: a day, in the currency of the prices; 0: no bound.
        requests: a day; 0: no bound.
        price_in: of a million prompt tokens.
        price_out: of a million answer tokens.
    """

    def __init__(self, *, cost: float, requests: int, price_in: float, price_out: float) -> None:
        self._cost = cost
        self._requests = requests
        self._price_in = price_in
        self._price_out = price_out
        self._spent = Spent()

    def on(self, day: str) -> Spent:
        """Return what was spent on a day."""
        return self._spent if self._spent.day == day else Spent(day=day)

    def refuses(self, day: str) -> str:
        """Return why nothing may be asked any more on a day, or ""."""
        spent = self.on(day)
        if self._requests and spent.requests >= self._requests:
            return f"{spent.requests} requests today, and no more than {self._requests} are allowed"
        if self._cost and spent.cost >= self._cost:
            return f"{spent.cost:.2f} spent today of {self._cost:.2f}"
        return ""

    def spend(self, day: str, *, tokens_in: int = 0, tokens_out: int = 0, requests: int = 1) -> Spent:
        """Note a request and what it took; returns what the day has cost by then."""
        spent = self.on(day)
        cost = (max(0, tokens_in) * self._price_in + max(0, tokens_out) * self._price_out) / MILLION
        self._spent = replace(spent, requests=spent.requests + requests, cost=round(spent.cost + cost, 6))
        return self._spent

    @property
    def last(self) -> Spent:
        """What was spent on the latest day."""
        return self._spent

    def load(self, spent: Spent) -> None:
        """Take in what was spent before a restart."""
        self._spent = spent
