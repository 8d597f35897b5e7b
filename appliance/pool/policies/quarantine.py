"""Images that do not start are left alone for a while."""

from collections import Counter


class Quarantine:
    """Images whose containers fail to start are left alone for a while, with the reason. The clock is passed in."""

    def __init__(self, *, after: int, for_s: float) -> None:
        self._after = after
        self._for_s = for_s
        self._failures: Counter[str] = Counter()
        self._until: dict[str, tuple[float, str]] = {}

    def failed(self, image: str, reason: str, now: float) -> None:
        """Note a failed start."""
        self._failures[image] += 1
        if self._failures[image] >= self._after:
            self._until[image] = (now + self._for_s, reason)

    def succeeded(self, image: str) -> None:
        """Note a start that worked."""
        self._failures.pop(image, None)
        self._until.pop(image, None)

    def reason(self, image: str, now: float) -> str:
        """Return why the image is left alone; empty when it is not. After the time one more start is tried."""
        until, reason = self._until.get(image, (0.0, ""))
        if not reason or now >= until:
            return ""
        return f"{self._failures[image]} starts of image {image} failed in a row, left alone for a while: {reason}"

    def reasons(self, now: float) -> tuple[str, ...]:
        """Return the reasons of all that are left alone."""
        return tuple(text for image in sorted(self._until) if (text := self.reason(image, now)))
