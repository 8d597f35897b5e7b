"""What `/` means: a regular expression without regard to case; a leading `!` shows all the others. Pure."""

import re
import warnings

LONGEST = 200
"""Characters of a filter."""
_NESTED = re.compile(r"[+*}]\??\)+\??(?:[+*]|\{\d*,)")
"""A repetition of what ends in a repetition: matching may take for ever, and the screen would stand still."""


class Filter:
    """A filter of lines of text.

    Args:
        text: as a person typed it. One that is no regular expression is looked for as it stands.
    """

    def __init__(self, text: str = "") -> None:
        self.text = text[:LONGEST]
        self.note = ""
        """Why it is not taken for a regular expression; empty when it is."""
        self.inverse = self.text.startswith("!")
        wanted = self.text[1:] if self.inverse else self.text
        self._wanted = wanted.casefold()
        self._pattern: re.Pattern[str] | None = None
        if not wanted:
            return
        if _NESTED.search(wanted):
            self.note = "repeats within repeats may take for ever; looked for as plain text"
            return
        try:
            with warnings.catch_warnings():
                # What Python may read otherwise one day is no news to whoever filters a table.
                warnings.simplefilter("ignore", FutureWarning)
                self._pattern = re.compile(wanted, re.IGNORECASE)
        except (re.error, RecursionError, OverflowError) as error:
            self.note = f"no regular expression ({error}); looked for as plain text"

    def __bool__(self) -> bool:
        """Whether it hides anything."""
        return bool(self._wanted)

    def __eq__(self, other: object) -> bool:
        """Filters of the same text are the same."""
        return isinstance(other, Filter) and self.text == other.text

    def __hash__(self) -> int:
        """As `__eq__` has it."""
        return hash(self.text)

    def matches(self, line: str) -> bool:
        """Whether a line is to be shown."""
        if not self._wanted:
            return True
        found = self._pattern.search(line) is not None if self._pattern else self._wanted in line.casefold()
        return found is not self.inverse
