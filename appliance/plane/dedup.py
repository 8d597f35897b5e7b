"""Deduplication: what is sent more than once under one id, such as by both sides of a partition, is heard once."""

from collections import OrderedDict

_MOST_IDS = 4096


class Deduplicator:
    """Remembers the ids that came last, at most `most`."""

    def __init__(self, most: int = _MOST_IDS) -> None:
        self._most = most
        self._seen: OrderedDict[str, None] = OrderedDict()

    def new(self, name: str) -> bool:
        """Whether an id comes for the first time; an empty one always does."""
        if not name:
            return True
        known = name in self._seen
        self._seen[name] = None
        self._seen.move_to_end(name)
        if len(self._seen) > self._most:
            self._seen.popitem(last=False)
        return not known
