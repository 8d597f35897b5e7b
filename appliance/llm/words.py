"""An instruction as numbered words; plurals and ranges among them.

A word is a run of letters and digits with what may stand inside a name ("robot_1", "crow's", "a.wav", "B-12", "10:42");
every other mark is a word of its own, blanks are none. Words keep where they stand, so that a run of them is again the
text as it was written. The robots of the roster follow as words after the instruction's own.

Lines of a list are read as one sentence: what stands before an item ("2.", "b)", "-") is no figure of the order before
it, and the end of a line parts as a mark does. A letter stands before an item only where the lines' letters follow one
another (a, b, c): else it is somebody's initial ("A. Smith waits").

`singular` gives the singular of a name, as people give names to things and places; `between` the numbers and letters
that are meant without being said, those between the ends of "pumps 4 to 7" and "bays A to D"; `forms` the forms of a
verb as orders use them.
"""

import re
from collections.abc import Iterator, Sequence
from functools import lru_cache

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


_F = frozenset({"shelves", "halves", "calves", "leaves", "loaves", "wolves", "thieves", "scarves", "hooves", "sheaves"})
_FE = frozenset({"knives", "wives", "lives"})
_IE = frozenset(
    {"cookies", "brownies", "movies", "smoothies", "hoodies", "selfies", "pies", "ties", "zombies", "veggies"}
)
_OTHERS = {
    "shoes": "shoe",
    "horseshoes": "horseshoe",
    "snowshoes": "snowshoe",
    "toes": "toe",
    "canoes": "canoe",
    "hoes": "hoe",
    "buses": "bus",
    "minibuses": "minibus",
    "gases": "gas",
    "lenses": "lens",
    "viruses": "virus",
    "axes": "axe",
    "series": "series",
    "species": "species",
}


def singular(text: str) -> str:
    """Return a name with its last word in the singular, and without the 's of its owner.

    Args:
        text: lower case; its last word is taken to be regular, or one of the common others.
    """
    if text.endswith("'s"):
        return text[:-2]
    before, blank, word = text.rpartition(" ")
    return f"{before}{blank}{_one(word)}"


def _one(word: str) -> str:
    if (other := _OTHERS.get(word)) is not None:
        return other
    if word in _F:
        return f"{word[:-3]}f"
    if word in _FE:
        return f"{word[:-3]}fe"
    if word.endswith("shelves"):
        return f"{word[:-3]}f"
    if word.endswith("ies") and len(word) > 4:
        return word[:-1] if word in _IE else f"{word[:-3]}y"
    if word.endswith(("ches", "shes", "xes", "sses", "oes")):
        return word[:-2]
    return word[:-1] if word.endswith("s") and not word.endswith("ss") else word


MOST = 20
"""A longer range is no list of things to do one after the other."""
_TO = frozenset({"to", "through", "thru", "till", "until", "-", "–", "—", "up"})
_MARK = re.compile(r"\d{1,4}|[a-z]")


def between(words: Words) -> tuple[str, ...]:
    """Return what lies between the ends of an instruction's ranges, in order, each once; not the ends."""
    return tuple(dict.fromkeys(mark for first, last in _ends(words) for mark in _inside(first, last)))


def _ends(words: Words) -> Iterator[tuple[str, str]]:
    said = [words[number].lower() for number in range(words.own)]
    for at, first in enumerate(said):
        if not _MARK.fullmatch(first):
            continue
        end = at + 1
        while end < len(said) and said[end] in _TO:
            end += 1
        if at + 1 < end < len(said) and _MARK.fullmatch(said[end]):
            yield first, said[end]


def _inside(first: str, last: str) -> list[str]:
    if first.isdigit() and last.isdigit():
        low, high = int(first), int(last)
        return [str(each) for each in range(low + 1, high)] if high - low <= MOST and first == str(low) else []
    if first.isalpha() and last.isalpha():
        return [chr(each) for each in range(ord(first) + 1, ord(last))] if ord(last) - ord(first) <= MOST else []
    return []


_IRREGULAR = {
    "go": ("goes", "going", "gone", "went"), "fly": ("flies", "flying", "flown"), "take": ("takes", "taking", "taken"),
    "put": ("puts", "putting"), "bring": ("brings", "bringing", "brought"), "drive": ("drives", "driving", "driven"),
    "get": ("gets", "getting"), "give": ("gives", "giving", "given"), "shoot": ("shoots", "shooting"),
    "say": ("says", "saying", "said"),
    "tell": ("tells", "telling"), "find": ("finds", "finding", "found"),
    "hold": ("holds", "holding", "held"), "leave": ("leaves", "leaving", "left"), "set": ("sets", "setting"),
    "shut": ("shuts", "shutting"),
    "come": ("comes", "coming"),
    "run": ("runs", "running"), "be": ("is", "are", "being"),
    "read": ("reads", "reading"), "send": ("sends", "sending", "sent"), "make": ("makes", "making"),
    "keep": ("keeps", "keeping"), "wait": ("waits", "waiting"), "let": ("lets", "letting"),
    "lift": ("lifts", "lifting"),
}  # fmt: skip


@lru_cache(maxsize=4096)
def forms(verb: str) -> frozenset[str]:
    """Return a verb's forms as orders use them: "photograph", "photographs", "photographing", "photographed"."""
    found = {verb, *_IRREGULAR.get(verb, ())}
    if verb in _IRREGULAR:
        return frozenset(found)
    found.add(f"{verb}s")
    if verb.endswith(("s", "x", "z", "ch", "sh", "o")):
        found.add(f"{verb}es")
    if len(verb) > 2 and verb.endswith("y") and verb[-2] not in "aeiou":
        found |= {f"{verb[:-1]}ies", f"{verb[:-1]}ied"}
    if verb.endswith("e"):
        found |= {f"{verb[:-1]}ing", f"{verb}d"}
    else:
        found |= {f"{verb}ing", f"{verb}ed"}
        if len(verb) > 2 and verb[-1] not in "aeiouwxy" and verb[-2] in "aeiou":
            found |= {f"{verb}{verb[-1]}ing", f"{verb}{verb[-1]}ed"}
    return frozenset(found)
