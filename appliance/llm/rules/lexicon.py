"""Words: verb forms, numbers, units, noun phrases. All the English that is not grammar.

Kept apart so that the grammar reads as grammar. Parameters come out as the annotation rules want them: lower case,
without articles and possessives, numbers in the unit that the parameter's name carries.
"""

import re
from functools import lru_cache

from appliance.llm.language.plurals import singular

_ARTICLE = r"(?:the|a|an|its|his|her|their|your|my|our|some|any)"
_IRREGULAR = {
    "go": "goes going gone went",
    "fly": "flies flying flown flew",
    "do": "does doing done did",
    "take": "takes taking taken took",
    "get": "gets getting got gotten",
    "put": "puts putting",
    "set": "sets setting",
    "cut": "cuts cutting",
    "shut": "shuts shutting",
    "find": "finds finding found",
    "read": "reads reading",
    "say": "says saying said",
    "tell": "tells telling told",
    "let": "lets letting",
    "give": "gives giving given gave",
    "bring": "brings bringing brought",
    "hold": "holds holding held",
    "lead": "leads leading led",
    "meet": "meets meeting met",
    "make": "makes making made",
    "come": "comes coming came",
    "run": "runs running ran",
    "split": "splits splitting",
    "send": "sends sending sent",
    "drive": "drives driving driven drove",
    "keep": "keeps keeping kept",
    "sweep": "sweeps sweeping swept",
    "slide": "slides sliding slid",
    "shoot": "shoots shooting shot",
    "map": "maps mapping mapped",
    "grab": "grabs grabbing grabbed",
    "stop": "stops stopping stopped",
    "spot": "spots spotting spotted",
    "scan": "scans scanning scanned",
    "plan": "plans planning planned",
    "mop": "mops mopping mopped",
    "scrub": "scrubs scrubbing scrubbed",
    "drop": "drops dropping dropped",
    "snap": "snaps snapping snapped",
    "chop": "chops chopping chopped",
    "drag": "drags dragging dragged",
    "transfer": "transfers transferring transferred",
    "show": "shows showing shown showed",
    "lay": "lays laying laid",
    "film": "films filming filmed",
    "write": "writes writing written wrote",
}
_REGULAR = (
    "drive walk head proceed travel navigate move roll advance visit reach return follow "
    "traverse patrol explore survey "
    "localise localize compute work calculate hover stay remain wait orbit circle land launch "
    "lift climb dock attach pick "
    "grasp collect fetch retrieve carry deliver transport haul place load store stow stack push pull shove open close "
    "slice trim clean wash wipe vacuum dust rinse pour decant tip switch turn power fasten screw bolt tighten mount "
    "unfasten unscrew unbolt loosen detach photograph picture video videotape record locate look search detect count "
    "track match register measure gather assemble rendezvous converge form line hand pass divide merge combine inspect "
    "examine check compare report notify inform alert message announce ask guide escort accompany "
    "extract sample encode "
    "classify preprocess denoise transcribe correct train aggregate evaluate test build create "
    "file image hear continue pause "
    "touch join sound rotate identify monitor repeat estimate conduct perform"
)
FILLER = re.compile(
    r"\b(?:please|kindly|now|just|also|again|then|first|firstly|finally|lastly|next|immediately|"
    r"straight away|right away|"
    r"at once|over to you|ok|okay|right|so|well|thanks|thank you|out|both|each|all)\b",
    re.IGNORECASE,
)
_NUMBERS: dict[str, float] = {
    word: float(value)
    for value, word in enumerate(
        [
            "zero",
            "one",
            "two",
            "three",
            "four",
            "five",
            "six",
            "seven",
            "eight",
            "nine",
            "ten",
            "eleven",
            "twelve",
            "thirteen",
            "fourteen",
            "fifteen",
            "sixteen",
            "seventeen",
            "eighteen",
            "nineteen",
            "twenty",
        ]
    )
} | {"thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "ninety": 90, "hundred": 100, "a": 1, "an": 1, "once": 1}
_NUMBERS.update({"twice": 2, "thrice": 3, "both": 2, "half": 0.5})
WORD_NUMBER = "|".join(sorted(_NUMBERS, key=len, reverse=True))
NUMBER = (
    r"(?:\d{1,7}(?:\.\d{1,4})?|half an?|(?:an? |three )?quarters? of an?|half|twenty[ -]five|forty[ -]five|"
    rf"(?:{WORD_NUMBER})\b)"
)
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}
TIME_UNIT = r"(?:seconds?|secs?|s|minutes?|mins?|hours?|hrs?|h)\b"
LENGTH_UNIT = r"(?:metres?|meters?|m|feet|foot|ft)\b"


def _third(verb: str) -> str:
    if verb.endswith("y") and verb[-2] not in "aeiou":
        return verb[:-1] + "ies"
    return verb + ("es" if verb.endswith(("s", "sh", "ch", "x", "z", "o")) else "s")


def _forms(verb: str) -> tuple[str, ...]:
    stem = verb.removesuffix("e")
    past = verb[:-1] + "ied" if verb.endswith("y") and verb[-2] not in "aeiou" else stem + "ed"
    return (_third(verb), stem + "ing", past)


def _lemmas() -> dict[str, str]:
    found: dict[str, str] = {}
    for verb in _REGULAR.split():
        for form in (verb, *_forms(verb)):
            found.setdefault(form, verb)
    for verb, forms in _IRREGULAR.items():
        found[verb] = verb
        for form in forms.split():
            found[form] = verb
    return found


LEMMA = _lemmas()
"""Verb form -> base form."""

_CONNECTIVES = (
    "while",
    "then",
    "before",
    "after",
    "once",
    "when",
    "finally",
    "meanwhile",
    "please",
    "and",
    "first",
    "finished",
)
_SPELLINGS = {
    **{word: word for word in _CONNECTIVES},
    **{word: word for word, base in LEMMA.items() if len(word) >= 5 and word in (base, _third(base))},
}


@lru_cache(maxsize=512)
def spell(word: str) -> str:
    """Mend a misspelt verb or connective: two letters swapped, or one doubled or dropped in a longer word."""
    low = word.lower()
    if not low.isalpha() or low in _SPELLINGS or low != word.lower() or not 3 <= len(low) <= 14 or low in LEMMA:
        return word
    for i in range(len(low) - 1):
        swapped = low[:i] + low[i + 1] + low[i] + low[i + 2 :]
        if swapped in _SPELLINGS and low[i] != low[i + 1]:
            return swapped.capitalize() if word[0].isupper() else swapped
    if len(low) >= 5:
        for i in range(len(low)):
            shorter = low[:i] + low[i + 1 :]
            if (
                ((i and low[i] == low[i - 1]) or (len(low) >= 7 and i < len(low) - 1))
                and shorter in _SPELLINGS
                and not low.endswith("s")
            ):
                return shorter
    if low in ("plese", "pleas", "plase"):
        return "please"
    return word


def number(text: str) -> float | None:
    """Return the value of a number as digits or words, or None."""
    low = text.lower().strip()
    if match := re.fullmatch(r"(an? |three )?quarters? of an?", low):
        return 0.75 if match[1] and match[1].startswith("three") else 0.25
    if re.fullmatch(r"half(?: an?)?", low):
        return 0.5
    if "-" in low or " " in low:
        parts = [_NUMBERS.get(part) for part in re.split(r"[ -]", low)]
        return None if None in parts else float(sum(part for part in parts if part is not None))
    if low in _NUMBERS:
        return float(_NUMBERS[low])
    try:
        return float(low)
    except ValueError:
        return None


def plain(value: float) -> int | float:
    """Return 3.0 as 3, and 0.1 + 0.2 as 0.3."""
    value = round(value, 4)
    return int(value) if value == int(value) else value


def seconds(amount: str, unit: str) -> int | float | None:
    """Return seconds of an amount and its unit."""
    value = number(amount)
    return None if value is None else plain(value * _SECONDS[unit.lower()[0]])


def metres(amount: str, unit: str) -> int | float | None:
    """Return metres of an amount in metres or feet."""
    value = number(amount)
    return None if value is None else plain(value * (0.3048 if unit.lower().startswith("f") else 1.0))


_SPEED = {
    "m/s": 1.0,
    "metre": 1.0,
    "meter": 1.0,
    "km/h": 1 / 3.6,
    "kph": 1 / 3.6,
    "kilo": 1 / 3.6,
    "mph": 0.44704,
    "knot": 0.514444,
}
SPEED_UNIT = r"(?:m/s|met(?:re|er)s? per second|km/h|kph|kilomet(?:re|er)s? per hour|mph|knots?)"


def speed(amount: str, unit: str) -> int | float | None:
    """Return metres per second."""
    value = number(amount)
    factor = next(factor for name, factor in _SPEED.items() if unit.lower().startswith(name))
    return None if value is None else plain(value * factor)


def noun(text: str) -> str:
    """Return a noun phrase as a parameter holds it: lower case, no articles, quotes or trailing fillers."""
    text = re.sub(r"[\"\u201c\u201d]", "", text).strip(" ,.;:!?-\n\t")
    text = re.sub(
        r"(?:,? (?:please|now|again|too|as well|there|here|each|first|immediately|afterwards|together|please))+$",
        "",
        text,
        flags=re.IGNORECASE,
    )
    text = re.sub(rf"\b{_ARTICLE}\s+", "", text, flags=re.IGNORECASE)
    text = re.sub(r"(\w)['\u2019]s\b", r"\1", text)
    return " ".join(text.lower().split())


def things(text: str) -> list[str]:
    """Split "the red box and the blue box" into its things; "salt and pepper" stays one."""
    parts = [part for part in re.split(r"\s*,\s*(?:and\s+)?|\s+and\s+", text) if part]
    if len(parts) < 2:
        return [text]
    first = re.match(r"(?:the |a |an )?([\w-]+)s?\b", parts[0], re.IGNORECASE)
    numbered = re.fullmatch(r"(?:the )?(.+?)s? (\d+|[A-Za-z])", parts[0].strip(), re.IGNORECASE)
    if numbered and all(re.fullmatch(r"\d+|[A-Za-z]", part.strip()) for part in parts[1:]):
        head = singular(numbered[1])
        return [f"{head} {numbered[2]}", *(f"{head} {part.strip()}" for part in parts[1:])]
    if first and all(re.match(r"(?:the|a|an|his|her|its|your) ", part, re.IGNORECASE) for part in parts):
        return parts
    heads = {part.split()[0].lower() for part in parts if len(part.split()) > 1}
    numbers = all(re.search(r" (?:\d+|[A-Za-z])$", part) for part in parts)
    return parts if len(heads) == 1 and numbers else [text]
