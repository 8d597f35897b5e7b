"""What a run of words means: a name, a free text, a robot, or a quantity in the unit of its parameter.

The rules are those of correct plans (lower case, no articles or possessives, number words of names in figures, numbers
in the unit that the parameter's name carries), so that a planner has to point only, and not to convert.
"""

import re

FREE = frozenset({"text", "question", "event"})
"""Parameters that keep their words."""
_ARTICLES = frozenset({"the", "a", "an", "my", "our", "your", "its", "his", "her", "their"})
_ONES = (
    *("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven"),
    *("twelve", "thirteen", "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen"),
)
_NUMBERS = {word: number for number, word in enumerate(_ONES)} | {"oh": 0, "niner": 9}
_TENS = {
    word: 10 * tens
    for tens, word in enumerate(("twenty", "thirty", "forty", "fifty", "sixty", "seventy", "eighty", "ninety"), start=2)
}
_LARGE = {"hundred": 100, "thousand": 1000, "dozen": 12}
_TIMES = {"once": 1.0, "twice": 2.0, "thrice": 3.0, "single": 1.0, "couple": 2.0, "pair": 2.0, "both": 2.0}
_ARTICLE_NUMBERS = frozenset({"a", "an", "another"})
_PARTS = {"half": 0.5, "quarter": 0.25, "quarters": 0.25, "a": 1.0, "an": 1.0, "another": 1.0}
_FILLERS = frozenset({"and", "-", ",", "of", "for", "to", "at", "about", "times", "time", "more", "x", "per"})
_SLASHED = re.compile(r"\b(m|km|cm)/(s|h)\b")
_WORD = re.compile(r"[a-z]+|\d+(?:[.,]\d+)*|[½¼¾]|\S")


def _units(**words: str) -> dict[str, float]:
    scales = {"milli": 1e-3, "centi": 0.01, "one": 1.0, "kilo": 1e3, "minute": 60.0, "hour": 3600.0, "day": 86_400.0}
    scales |= {"foot": 0.3048, "yard": 0.9144, "inch": 0.0254, "mile": 1609.344}
    scales |= {"kmh": 1 / 3.6, "knot": 0.514444, "mph": 0.44704}
    return {word: scales[scale] for scale, said in words.items() for word in said.split()}


_METRES = "m metre metres meter meters"
_CENTIMETRES = "cm centimetre centimetres centimeter centimeters"
_KILOMETRES = "km kilometre kilometres kilometer kilometers"
_SECONDS = "s sec secs second seconds"
_MILLISECONDS = "ms msec msecs millis millisecond milliseconds"
_UNITS = {
    "s": _units(
        milli=_MILLISECONDS,
        one=_SECONDS,
        minute="m min mins minute minutes",
        hour="h hr hrs hour hours",
        day="day days",
    ),
    "ms": _units(one=_MILLISECONDS, kilo=_SECONDS),
    "m": _units(
        centi=_CENTIMETRES,
        one=_METRES,
        kilo=_KILOMETRES,
        foot="ft foot feet",
        yard="yd yds yards",  # the singular is a place
        inch="inch inches",
        mile="mile miles",
    ),
    "mps": _units(
        centi=f"cmpers {_CENTIMETRES}",
        one=f"mps mpers {_METRES} second s hour h",
        kmh=f"kmh kph kmperh {_KILOMETRES}",
        knot="knot knots",
        mph="mph mile miles",
    ),
}
"""Words for units, in the unit of the parameter whose name ends in it."""
_VULGAR = {"½": 0.5, "¼": 0.25, "¾": 0.75}


def name(text: str) -> str:
    """Return a run of words as a name: lower case, no articles or possessives, number words in figures."""
    words = _clean(text).split()
    # The last word is no article: what would it belong to? "Door A" is a name.
    kept = [word for number, word in enumerate(words, start=1) if number == len(words) or word not in _ARTICLES]
    return figures(" ".join(kept))


def free(text: str) -> str:
    """Return a run of words as a free text: lower case, no quotes around it, no full stop at its end."""
    return " ".join(_clean(text).split())


def robot(text: str) -> str:
    """Return a run of words as a robot's id: `robot_2` for "Robot Two's"."""
    return re.sub(r"\s+", "_", name(re.sub(r"['’]s?$", "", text.strip())))


def figures(text: str) -> str:
    """Return a name with its number words as figures: "dock four" is `dock 4`, "room two one four" is `room 214`.

    Words of one digit each in a row are the digits of one number, as on the radio.
    """
    found: list[str] = []
    digits = ""
    words = [part for word in text.split() for part in (word.split("-") if _all_numbers(word) else [word])]
    at = 0
    while at < len(words):
        word = words[at]
        if word in _TENS:
            number = _TENS[word]
            if at + 1 < len(words) and 0 < _NUMBERS.get(words[at + 1], 0) < 10:
                number += _NUMBERS[words[at + 1]]
                at += 1
            digits += str(number)
        elif word in _NUMBERS:
            digits += str(_NUMBERS[word])
        else:
            if digits:
                found.append(digits)
                digits = ""
            found.append(word)
        at += 1
    if digits:
        found.append(digits)
    return " ".join(found)


def quantity(text: str, unit: str) -> float | int | None:
    """Return a quantity in a unit, to three decimals; None when the words are none.

    Args:
        text: "two and a half minutes", "400 ms", "twice", "20m", "an hour and a half", "one minute thirty".
        unit: s, ms, m, mps, or empty for a plain number (`unit_of`).
    """
    words = _WORD.findall(_SLASHED.sub(r"\1per\2", _clean(text).replace("'s", "")))
    return _Quantity(_UNITS.get(unit, {}), unit).of(words)


class _Quantity:
    """Adds up the numbers of a phrase, each times the unit after it."""

    def __init__(self, table: dict[str, float], unit: str) -> None:
        self._table = table
        self._unit = unit
        self._total = 0.0
        self._number: float | None = None
        self._scale: float | None = None
        """Of the last unit: what follows without one ("and a half", "thirty") is parts of it."""
        self._seen = False

    def of(self, words: list[str]) -> float | int | None:
        for at, word in enumerate(words):
            before = words[at - 1] if at else ""
            if word in _FILLERS or (before == "per" and word in self._table):
                continue
            value = _number(word)
            if value is not None:
                self._seen = True
                if not self._take(word, value, before):
                    return None
            elif word in self._table and self._number is not None:
                self._total += self._number * self._table[word]
                self._number, self._scale = None, self._table[word]
            elif self._table or self._number is None:
                return None
        if self._number is not None:
            # "One minute thirty": what has no unit is of the next smaller one.
            whole = self._scale is not None and self._unit == "s" and self._number >= 1
            self._total += self._number * (self._scale / 60 if whole and self._scale and self._scale >= 60 else 1.0)
        if not self._seen:
            return None
        rounded = round(self._total, 3)
        return int(rounded) if rounded == int(rounded) else rounded

    def _take(self, word: str, value: float, before: str) -> bool:
        """Take a number word; False when it does not go with those before it."""
        number = self._number
        if word in ("half", "quarter", "quarters"):
            if number is None and self._scale is not None:
                self._total += value * self._scale  # an hour and a half
            elif word == "quarters" and number is not None:
                self._number = number * value  # three quarters
            elif number is None or (before in ("a", "") and number == 1.0 and not self._said_number):
                self._number = value
            else:
                self._number = number + value  # two and a half minutes
        elif word in _ARTICLE_NUMBERS:
            if number is None and self._scale is None:
                self._number = 1.0
                self._said_number = False
        elif number is None or (number == 1.0 and not self._said_number):
            self._number, self._said_number = value, True
        elif word in _LARGE:
            self._number = number * value
        elif (word in _NUMBERS and value < 10 and _ends_in_tens(number)) or (
            value < 100 <= number and number % 100 == 0
        ):
            self._number = number + value
        elif word in _NUMBERS and value < 10 and number < 1000:
            self._number = 10 * number + value  # one five zero
        else:
            return False
        return True

    _said_number = False
    """Whether the number came from a number word, not from an article."""


def _ends_in_tens(number: float) -> bool:
    return number % 10 == 0 and number % 100 >= 20


def unit_of(parameter: str) -> str:
    """Return the unit that a parameter's name carries; empty for a plain number."""
    tail = parameter.rpartition("_")[2]
    return tail if tail in _UNITS and "_" in parameter else ""


def _clean(text: str) -> str:
    return text.lower().replace("’", "'").strip(" \t\n.,;:!\"“”'‘")


def _all_numbers(word: str) -> bool:
    parts = word.split("-")
    return len(parts) > 1 and all(part in _NUMBERS or part in _TENS for part in parts)


def _number(word: str) -> float | None:
    if word[0].isdigit():
        try:
            return float(word.replace(",", ""))
        except ValueError:
            return None
    for table in (_NUMBERS, _TENS, _LARGE, _TIMES, _PARTS, _VULGAR):
        if word in table:
            return float(table[word])
    return None
