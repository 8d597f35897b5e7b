"""Who is spoken to: robots by name, groups, "a robot", "the other one", and pronouns for them.

A roster makes it sure; without one, names are recognised by their form (`Robot_1`, `drone 4`, or a capitalised word
where a verb follows). A name that looks like a robot and is not in the roster stays: the validator refuses it, which
tells more than a plan for another robot would.
"""

import re
from collections.abc import Sequence

from appliance.llm.words import singular

KIND = (
    r"(?:robots?|drones?|rovers?|arms?|uavs?|ugvs?|bots?|carts?|vehicles?|quadcopters?|copters?|"
    r"quads?|amrs?|agvs?|trucks?|"
    r"machines?|units?|crawlers?|loaders?|forklifts?|tugs?|manipulators?|humanoids?|ones?|of them)"
)
_GENERIC = {"robot", "bot", "machine", "unit", "one", "of them", "vehicle"}
_FLYING = {"drone", "uav", "quadcopter", "copter", "quad"}
_CODE = r"(?:\d{1,4}|[A-Z])(?![\w])"
_BY_KIND = rf"(?i:robot|drone|rover|arm|uav|ugv|bot|cart|truck|amr|agv|unit|tug|loader|forklift|crawler)[ _-]?{_CODE}"
_BY_UNDERSCORE = r"[A-Za-z][A-Za-z0-9]*(?:[_-][A-Za-z0-9]+)*_[A-Za-z0-9]+"
_BY_CAPITAL = rf"[A-Z][A-Za-z]*\d*(?:-[A-Za-z0-9]+)*(?: {_CODE})?(?![\w])"
_AND = r"(?:\s*,\s*(?:and\s+)?|\s+and\s+|\s*&\s*)"

ONE = re.compile(
    (
        rf"(?:(?:an?|any|some|one) (?:available |free |single |idle )?{KIND}\b|one of (?:the |our "
        rf"|your )?{KIND}\b|somebody|someone|anyone)"
    ),
    re.IGNORECASE,
)
ALL = re.compile(
    rf"(?:all|both|each|every|all of|both of|each of|every one of)(?: of)?(?: the| our| your)"
    rf"?(?: (?:two|three|four|five|six))? ?(?P<kind>{KIND}|them)?\b"
    rf"|everyone|everybody|the (?P<plural>robots|drones|rovers|arms|uavs|ugvs|bots|carts|vehicles|machines)\b",
    re.IGNORECASE,
)
SEVERAL = re.compile(
    rf"(?:the )?(?P<n>two|three|four|five|six|2|3|4|5|6) (?:different |free |available )?(?P<kind>{KIND})\b",
    re.IGNORECASE,
)
THE = re.compile(
    r"the (?P<kind>robot|drone|rover|uav|ugv|copter|quadcopter|bot|amr|agv|arm)\b(?! (?:\d|[A-Z]\b))", re.IGNORECASE
)
OTHER = re.compile(rf"(?:the other|another|the second)(?: (?:{KIND}))?\b", re.IGNORECASE)
FIRST = re.compile(rf"(?:one|the first)(?: (?:{KIND}))?\b", re.IGNORECASE)
PRONOUN = re.compile(r"(?:they|it|he|she|you|we|who|both|them)\b", re.IGNORECASE)
NOT_NAMES = frozenset(
    [
        "the",
        "a",
        "an",
        "and",
        "then",
        "if",
        "when",
        "while",
        "once",
        "after",
        "before",
        "as",
        "at",
        "in",
        "on",
        "to",
        "it",
        "they",
        "he",
        "she",
        "you",
        "we",
        "i",
        "this",
        "that",
        "these",
        "those",
        "there",
        "finally",
        "first",
        "meanwhile",
        "next",
        "please",
        "all",
        "both",
        "each",
        "every",
        "everyone",
        "one",
        "two",
        "three",
        "let",
        "have",
        "make",
        "tell",
        "ask",
        "send",
        "get",
        "only",
        "not",
        "no",
        "yes",
        "ok",
        "okay",
        "could",
        "would",
        "can",
        "will",
        "should",
        "may",
        "might",
        "what",
        "how",
        "who",
        "where",
        "why",
        "which",
        "for",
        "from",
        "with",
        "by",
        "of",
        "or",
        "but",
        "so",
        "now",
        "also",
        "again",
        "break",
        "over",
        "out",
        "do",
        "does",
        "did",
        "is",
        "are",
        "was",
        "were",
        "be",
        "been",
        "being",
        "has",
        "had",
        "night",
        "mission",
        "task",
        "note",
        "warning",
    ]
)


def canonical(text: str) -> str:
    """Return a robot's name as plans hold it: lower case, spaces as `_`."""
    return "_".join(text.lower().split())


class Names:
    """Recognises robots by name; `roster` None means that nobody told who there is."""

    def __init__(self, roster: Sequence[str] | None, flying: Sequence[str] = ()) -> None:
        self.roster = None if roster is None else tuple(roster)
        self._flying = tuple(flying)
        self._squashed = {re.sub(r"[ _-]", "", name.lower()): name for name in roster or ()}
        parts = [
            r"[ _-]?".join(re.escape(part) for part in re.split(r"[ _-]", name))
            for name in sorted(roster or (), key=len, reverse=True)
        ]
        known = [rf"(?i:{'|'.join(parts)})(?![\w])"] if parts else []
        self.sure = re.compile("|".join([*known, _BY_KIND, _BY_UNDERSCORE]))
        self._any = "|".join([*known, _BY_KIND, _BY_UNDERSCORE, _BY_CAPITAL])
        self._list = re.compile(rf"(?:{self._any})(?:{_AND}(?:{self._any}))*")
        self._one = re.compile(self._any)
        self.seen: set[str] = set()

    def resolve(self, text: str) -> str:
        """Return the roster's spelling of a name, or its plain form."""
        return self._squashed.get(re.sub(r"[ _-]", "", text.lower()), canonical(text))

    def known(self, text: str) -> str | None:
        """Return the robot that a noun phrase names, or None when it does not look like one."""
        text = re.sub(r"^(?:the|robot named) ", "", text.strip(), flags=re.IGNORECASE)
        if self.sure.fullmatch(text) or self.resolve(text) in self.seen:
            return self.resolve(text)
        return None

    def leading(self, text: str) -> tuple[list[str], str] | None:
        """Return the names a text starts with ("A, B and C ...") and the rest."""
        match = self._list.match(text)
        if match is None:
            return None
        names = [found[0] for found in self._one.finditer(match[0])]
        if any(name.split()[0].lower() in NOT_NAMES for name in names):
            return None
        return [self.resolve(name) for name in names], text[match.end() :]

    def listed(self, text: str) -> list[str]:
        """Return all names in a list such as "Rex, Max and Lou"; empty when it is anything else."""
        found = self.leading(text.strip())
        return found[0] if found and not found[1].strip(" .,!") else []

    def everyone(self, kind: str) -> list[str]:
        """Return the robots of a kind ("drones"); `["all"]` when the roster is unknown."""
        if self.roster is None:
            return ["all"]
        word = singular(kind.lower().strip()) if kind else ""
        if not word or word in _GENERIC or word == "them":
            return list(self.roster)
        named = [name for name in self.roster if name.startswith(word) or name.endswith(word)]
        if not named and word in _FLYING:
            named = list(self._flying)
        return named or list(self.roster)
