"""An instruction as numbered words.

A word is a run of letters and digits with what may stand inside a name ("robot_1", "crow's", "a.wav", "B-12", "10:42");
every other mark is a word of its own, blanks are none. Words keep where they stand, so that a run of them is again the
text as it was written. The robots of the roster follow as words after the instruction's own.

Lines of a list are read as one sentence: what stands before an item ("2.", "b)", "-") is no figure of the order before
it, and the end of a line parts as a mark does. A letter stands before an item only where the lines' letters follow one
another (a, b, c): else it is somebody's initial ("A. Smith waits").
"""

import re
from collections.abc import Sequence

from msgspec import Struct

MAX_WORDS = 256
"""Words of an instruction and its roster; a longer one is for another planner."""
_ITEM = re.compile(r"(?:\(?(?:\d{1,2}|[a-z])[.)](?=\s)|\d{1,2}:(?=\s)|[-–—*•·](?=\s))\s*", re.IGNORECASE)
"""What stands before an item of a list."""
_LETTER = re.compile(r"[a-z]\.\s", re.IGNORECASE)
"""How a line begins whose item has a letter, or where somebody is called by an initial."""
_BY_NUMBER = re.compile(
    r"\b(?:step|item|point|line|number|after|once|until|before|with|and)s?\s+#?\d{1,2}\b"
    r"(?=\s*(?:$|[,;:)!]|[.](?!\d)|(?:is|are|has|have|was|and|or)\b))",
    re.IGNORECASE,
)
"""An item spoken of by its number ("after 1", "step 2 is done")."""
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
    text = in_one_line(instruction)
    spans = [match.span() for match in _WORD.finditer(text)]
    own = len(spans)
    for robot in robots:
        text += "\n"
        spans.append((len(text), len(text) + len(robot)))
        text += robot
    return Words(text, tuple(spans), own)


def in_one_line(instruction: str) -> str:
    """Return an instruction of several lines as one sentence; any other as it is.

    The numbers of items go, unless an item is spoken of by its number. A line that heads a list ends in a colon.
    """
    lines = [line.strip() for line in instruction.splitlines() if line.strip()]
    if len(lines) < 2:
        return instruction
    items = _items(lines)
    numbered = _BY_NUMBER.search(
        " ".join(line[item.end() :] if item else line for line, item in zip(lines, items, strict=True))
    )
    made = ""
    for number, (line, item) in enumerate(zip(lines, items, strict=True)):
        said = line if item is None or numbered else line[item.end() :]
        made += said
        if number + 1 < len(lines):
            heads = item is None and items[number + 1] is not None
            ended = said.endswith((".", ",", ";", ":", "!", "?", "–", "—", "-", "…"))
            goes_on = re.match(r"(?:and|then|or|but)\b", lines[number + 1], re.IGNORECASE)
            made += " " if ended else ": " if heads else ", " if goes_on else "; "
    return made


def _items(lines: Sequence[str]) -> list[re.Match[str] | None]:
    """Return what stands before the item of each line, if anything does.

    "a)" always does; "a." may be somebody's initial, and does only in a list: from a (or A) on, letter after letter,
    whatever lines stand between.
    """
    items = [_ITEM.match(line) for line in lines]
    letters = {number: line[0] for number, line in enumerate(lines) if _LETTER.match(line)}
    runs: list[list[int]] = []
    for number, letter in letters.items():
        if runs and ord(letter) == ord(letters[runs[-1][-1]]) + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    for run in runs:
        if len(run) < 2 or letters[run[0]] not in "aA":
            for number in run:
                items[number] = None
    return items
