"""An instruction as numbered words.

A word is a run of letters and digits with what may stand inside a name ("robot_1", "crow's", "a.wav", "B-12", "10:42");
every other mark is a word of its own, blanks are none. Words keep where they stand, so that a run of them is again the
text as it was written. The robots of the roster follow as words after the instruction's own.
"""

import re
from collections.abc import Sequence

from msgspec import Struct

MAX_WORDS = 256
"""Words of an instruction and its roster; a longer one is for another planner."""
_WORD = re.compile(r"\w+(?:[_.'’:/-]\w+)*|[^\w\s]")


class Words(Struct, frozen=True):
    """The words of an instruction and of the roster after it. `spans` are places in `text`."""

    text: str
    spans: tuple[tuple[int, int], ...]
    own: int
    """How many are the instruction's; the others are robots of the roster."""

    def __len__(self) -> int:
        return len(self.spans)

    def __getitem__(self, number: int) -> str:
        start, end = self.spans[number]
        return self.text[start:end]

    def run(self, first: int, last: int) -> str:
        """Return the text from one word to another, both included, as it was written."""
        return self.text[self.spans[first][0] : self.spans[last][1]]


def words_of(instruction: str, robots: Sequence[str] = ()) -> Words:
    """Cut an instruction into words and append a roster, one word for each robot."""
    spans = [match.span() for match in _WORD.finditer(instruction)]
    own, text = len(spans), instruction
    for robot in robots:
        text += "\n"
        spans.append((len(text), len(text) + len(robot)))
        text += robot
    return Words(text, tuple(spans), own)
