"""The latest value of each thing of one kind, and what has changed since somebody looked. Bounded; pure."""

from collections.abc import Callable, ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import Any, Generic, TypeVar

from msgspec import Struct

T = TypeVar("T")


class Changes(Struct, frozen=True):
    """What has changed: keys with a new value, latest first, and keys that are gone."""

    revision: int
    changed: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    whole: bool = False
    """Whether more has changed than is remembered: all is to be looked at."""


class Shelf(Mapping[str, T], Generic[T]):
    """Values by key.

    Args:
        most: values kept. A further one is refused, unless `age` is given.
        age: how old a value is to be thought, higher for newer; the oldest go first then.
    """

    def __init__(self, most: int, *, age: Callable[[T], Any] | None = None) -> None:
        self.most = most
        self.revision = 0
        """Rises with every change."""
        self.arrangement = 0
        """Rises when keys come or go."""
        self.refused = 0
        """Values for which there was no room."""
        self._age = age
        self._values: dict[str, T] = {}
        self._changed: dict[str, int] = {}
        """Key -> revision of its last change, oldest change first; gone ones too, as far as they are remembered."""
        self._from = 0
        """Changes up to this revision are not remembered any more."""

    def __getitem__(self, key: str) -> T:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    # Mapping's own views ask for each key in Python; these are the dictionary's.

    def keys(self) -> KeysView[str]:
        """Return the keys as they are now and will be."""
        return self._values.keys()

    def values(self) -> ValuesView[T]:
        """Return the values as they are now and will be."""
        return self._values.values()

    def items(self) -> ItemsView[str, T]:
        """Return keys and values as they are now and will be."""
        return self._values.items()

    def put(self, key: str, value: T) -> bool:
        """Set a value; whether anything has changed by it."""
        values = self._values
        if key in values:
            if values[key] is value or values[key] == value:
                return False
        elif len(values) >= self.most and self._age is None:
            self.refused += 1
            return False
        else:
            self.arrangement += 1
        values[key] = value
        self._note(key)
        if len(values) > self.most and self._age is not None:
            self._drop_oldest(self._age)
        return True

    def drop(self, key: str) -> bool:
        """Forget a value; whether there was one."""
        if key not in self._values:
            return False
        del self._values[key]
        self.arrangement += 1
        self._note(key)
        return True

    def clear(self) -> None:
        """Forget all."""
        for key in tuple(self._values):
            self.drop(key)

    def since(self, revision: int) -> Changes:
        """Return what has changed since a revision, each key once."""
        if revision < self._from:
            return Changes(self.revision, tuple(self._values), whole=True)
        changed: list[str] = []
        gone: list[str] = []
        for key in reversed(self._changed):
            if self._changed[key] <= revision:
                break
            (changed if key in self._values else gone).append(key)
        return Changes(self.revision, tuple(changed), tuple(gone))

    def _note(self, key: str) -> None:
        self.revision += 1
        self._changed.pop(key, None)  # so that it stands last
        self._changed[key] = self.revision
        if len(self._changed) > 2 * self.most + 16:
            oldest = next(iter(self._changed))
            self._from = self._changed.pop(oldest)

    def _drop_oldest(self, age: Callable[[T], Any]) -> None:
        """Drop a tenth at once: looking through all for each new one would cost more than the value is worth."""
        keys = sorted(self._values, key=lambda key: age(self._values[key]))
        for key in keys[: max(1, self.most // 10)]:
            self.drop(key)
