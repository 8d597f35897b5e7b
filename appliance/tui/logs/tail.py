"""The last lines of what is heard, those that a filter lets through; the filter comes before the tail is cut.

So a rare line stays on screen however many others come after it: what is shown are the last so many matching lines, and
not the matching ones among the last so many. While nothing is filtered both are the same. Pure.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from appliance.tui.filter import Filter

T = TypeVar("T")


class Tail(Generic[T]):
    """The tail of one stream.

    Args:
        most: lines kept, and as many that match while there is a filter.
        plain: makes the text that a filter sees of a line.
    """

    def __init__(self, most: int, plain: Callable[[T], str]) -> None:
        self.most = most
        self.count = 0
        """Lines put so far."""
        self.revision = 0
        """Rises when other lines are to be shown."""
        self._plain = plain
        self._all: deque[T] = deque(maxlen=most)
        self._matching: deque[T] | None = None
        self._filter = Filter()

    @property
    def filter(self) -> Filter:
        """The filter in force."""
        return self._filter

    def set_filter(self, wanted: Filter) -> None:
        """Show only lines that match, those that are kept at once."""
        if wanted == self._filter:
            return
        self._filter = wanted
        self._matching = None
        if wanted:
            self._matching = deque((each for each in self._all if self._fits(each)), maxlen=self.most)
        self.revision += 1

    def put(self, line: T) -> None:
        """Take a line."""
        self.count += 1
        self._all.append(line)
        if self._matching is None:
            self.revision += 1
        elif self._fits(line):
            self._matching.append(line)
            self.revision += 1

    def clear(self) -> None:
        """Forget all lines; what is put from now on is shown."""
        self._all.clear()
        if self._matching is not None:
            self._matching.clear()
        self.revision += 1

    @property
    def lines(self) -> Sequence[T]:
        """What is shown, oldest first."""
        return self._all if self._matching is None else self._matching

    def _fits(self, line: T) -> bool:
        return self._filter.matches(self._plain(line))
