"""English that is not grammar: verb forms, numbers, units, noun phrases, and the words between clauses.

Kept apart so that the grammar reads as grammar. Parameters come out as the annotation rules want them: lower case,
without articles and possessives, numbers in the unit that the parameter's name carries. An instruction becomes
sentences here; quoted texts are taken out first, so that no comma in a message looks like the end of an order.
"""

import re
from functools import lru_cache

from appliance.llm.words import singular
from appliance.model import Subtask

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


QUOTE = re.compile(
    r"[\"\u201c]([^\"\u201c\u201d]{1,400})[\"\u201d]|(?<![\w])['\u2018]([^'\u2018\u2019]{1,400})['\u2019](?!\w)"
)
LEAD_ALL = re.compile(
    (
        r"(?:and )?(?:then|after that|after this|afterwards|afterward|thereafter|next|finally|"
        r"lastly|subsequently|in the end|"
        r"(?:once|when|as soon as) (?:(?:you are|you're|that is|that's|all(?: of (?:that|this|"
        r"them))? (?:is|are)|everything is|it is|it's|this is) )?(?:all )?(?:done|finished|complete|"
        r"ready))\b[,:]?\s*"
    ),
    re.IGNORECASE,
)
LEAD_BESIDE = re.compile(
    (
        r"(?:and )?(?:meanwhile|in the meantime|in the meanwhile|at the same time|simultaneously|"
        r"in parallel|concurrently)\b[,:]?\s*"
    ),
    re.IGNORECASE,
)
LEAD_FIRST = re.compile(r"(?:first|firstly|first of all|to begin with|to start with)\b[,:]?\s*", re.IGNORECASE)
PREFIX = re.compile(
    r"(?P<word>while|whilst|as soon as|as|before|(?:only )?(?:after|once|when|whenever|if)|in case)\s+(?P<rest>.+)",
    re.IGNORECASE | re.DOTALL,
)
BETWEEN = re.compile(
    r"(?P<then>[,;]?\s+(?:and |but )?(?:then|after that|afterwards|after which|thereafter|"
    r"next|finally|lastly|followed by)\b,?\s+)"
    r"|(?P<beside>[,;]?\s+(?:and\b|but\b|all\b)?,?\s*(?:while|whilst|meanwhile|in the meantime|"
    r"at the same time as|at the same time|simultaneously|in parallel|as (?=(?:you|it|he|she|"
    r"they)\b))\b,?\s+(?:also )?)"
    r"|(?P<before>,?\s+(?:but )?before\s+)"
    r"|(?P<after>,?\s+(?:but )?(?:only )?after\s+|,?\s+(?:- )?but first,?\s+)"
    r"|(?P<when>,?\s+(?:and\b,?\s*|but\b,?\s*)?(?:only )?(?:as soon as|once|when|if)\s+)"
    r"|(?P<list>\s*,\s*(?:and\s+|but\s+)?(?:also\s+)?|\s+and\s+(?:also\s+)?|\s+-\s+|\s*:\s+)",
    re.IGNORECASE,
)
DONE = re.compile(
    r"(?P<who>.+?)(?:'s|'re| is| are| has| have| gets?| get| was| were)?(?: all| both)? (?:been )?"
    r"(?:done|finished|finnished|complete|completed|arrives?|gets? there|there|ready|through|"
    r"arrived|answered|replied|docked|airborne|landed|in position|in place|back|home|in|over|"
    r"up|"
    r"returned|it|at .+|taken off|loaded|charged|the .+ there)(?: (?:there|both|it|this|that|up))?",
    re.IGNORECASE,
)
HERE = re.compile(r"(?:there|done|finished|ready|complete|arrived|in position|back|airborne)", re.IGNORECASE)
FILE = re.compile(
    r"(?:(?:take|use|with|for|from) )?(?P<file>[\w-]+\.[A-Za-z][A-Za-z0-9]{1,4})\s*[:,]\s*(?P<rest>.+)",
    re.IGNORECASE | re.DOTALL,
)
HEADING = re.compile(r"(?P<head>[^:,]{3,80}):\s*(?P<rest>.*)", re.DOTALL)
REWRITES = tuple(
    (re.compile(pattern, re.IGNORECASE), replacement)
    for pattern, replacement in (
        (r",? in (?:that|this) order\b", ""),
        (
            (
                r",?\s*(?:\band,? )?\bwhile (?:driving|flying|walking|moving|going|doing (?:so|that|this)"
                r"),?\s+(?=\w+ )(?!to\b|over\b)"
            ),
            " and at the same time ",
        ),
        (r"\bonly (once|when|after) ([^,.;]+?) (?:may|can|should|will|shall|does) ", r"\1 \2, "),
        (r"\bwhat does ([^,.;?]+?) (?:say|read|show)\b", r"read \1"),
        (r"(?:^|(?<=[.!?] ))((?:the |our )?[\w -]{3,40}?) (?:gets|receives) an? report\b", r"send a report to \1"),
        (
            (
                r"\b(?:i|we) (?:need|want|would like) ((?:the |this |that |a )[^,.;]+?) ((?:transcrib|"
                r"clean|inspect|photograph|film|record|scann|mapp|measur|evaluat|aggregat|check)ed)\b"
            ),
            r"\2 \1",
        ),
    )
)
"""Ways of saying it that are another way of saying it: question, inversion, what somebody needs."""
TRAILING = re.compile(r",\s*(?P<name>[A-Za-z][\w-]*(?: (?:\d+|[A-Z]))?)(?=\s*(?:$|,\s))")


def sentences(text: str, quotes: list[str], names: str) -> list[str]:
    r"""Split an instruction into sentences, lists into one sentence each.

    Args:
        text: the instruction.
        quotes: receives the quoted texts; `\x00n\x00` stands for the n-th in what is returned.
        names: regular expression of names that are surely robots.
    """
    text = text.replace("\x00", " ").replace("\u2013", "-").replace("\u2014", " - ").replace("\u2019", "'")

    def keep(match: re.Match[str]) -> str:
        said = match[1] or match[2]
        quotes.append(said.strip())
        ends = said.rstrip().endswith((".", "?", "!"))
        follows = re.match(r"\s+[A-Z]", text[match.end() :])
        return f"\x00{len(quotes) - 1}\x00" + (". " if ends and follows else "")

    text = QUOTE.sub(keep, text)
    text = re.sub(r"[A-Za-z]+", lambda match: spell(match[0]), text)
    text = re.sub(r"(?:^|(?<=[:\n]))\s*(?:[-*\u2022]) +", "\n", text)
    for pattern, replacement in REWRITES:
        text = pattern.sub(replacement, text)
    text = re.sub(rf"({names}), who (?:then |will |shall )?", r"\1, then \1 ", text)
    marks = re.findall(r"(?:(?<=\s)|^)\(?\d{1,2}[.)]\s", text)
    if len(marks) > 1:
        text = re.sub(r"\s*(?:(?<=\s)|^)\(?(\d{1,2})[.)]\s+", lambda match: " " if match[1] == "1" else ", then ", text)
        text = re.sub(r"[.;]\s*, then ", ", then ", text)
    text = re.sub(r"\b(Dr|Mr|Mrs|Ms|St|No|approx)\.", r"\1", text)
    text = re.sub(r"(?:each|all|both|every one) of (?:the )?(?=\w+s? (?:\d+|[A-Z])\b)", "", text)
    text = re.sub(r"\b([A-Za-z]+)s ((?:(?:\d+|[A-Z]),? )+and (?:\d+|[A-Z]))\b", spread, text)
    parts = re.split(r"(?<=[\w\x00)\]])[.!?;]+(?=\s|$)|\n+|^\. |\s\. ", text)
    return [part.strip() for part in parts if part and part.strip(" .,;:!?")]


def first_chunk(text: str) -> str:
    """Return the text up to its first connective, or a little more where that is no clause yet."""
    match = BETWEEN.search(text, 1)
    return text[: match.start()] if match else text


def clean(text: str) -> str:
    """Strip punctuation and space from both ends."""
    return text.strip(" ,.;:!?-\n\t")


def spread(match: re.Match[str]) -> str:
    """Write "goals 1, 2 and 3" as "goal 1, goal 2 and goal 3"."""
    head = match[1]
    items = re.findall(r"\d+|\b[A-Z]\b", match[2])
    named = [f"{singular(head + 's')} {item}" for item in items]
    return ", ".join(named[:-1]) + " and " + named[-1]


def renamed(subtask: Subtask, old: str, new: str) -> Subtask:
    """Return a subtask with one robot label in place of another."""
    params = dict(subtask.params)
    if "robots" in params:
        params["robots"] = [new if name == old else name for name in params["robots"]]
    robot = new if subtask.robot == old else subtask.robot
    return Subtask(id=subtask.id, skill=subtask.skill, robot=robot, params=params, after=subtask.after)
