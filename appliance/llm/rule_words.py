"""Which texts are a standing rule and not a plan: "no drone goes to dock 1 after 18:00". Pure.

A rule is a closed form (`model.closures.Rule`): some robots never go to places, take things up, or begin anything, at
all times or at hours and days. Each word of a text is accounted for: one that is left over, such as a condition or an
exception, makes it no rule, with the reason. So a rule never forbids less than what was said; a person reads it back
in the words of the form (`Rule.text`, which is read as the same rule) and confirms it.

A text with further orders is an ordinary instruction, which the planner and its review judge.
"""

import re
from collections.abc import Callable, Sequence
from typing import Literal
from zoneinfo import ZoneInfo

from msgspec import Struct

from appliance.model import RobotInfo, Site
from appliance.model.closures import ANYTHING, DAY_MIN, DAYS, Rule


class RuleWords(Struct, frozen=True):
    """A prohibition in words: the rule that it says, or why no rule says it."""

    rule: Rule | None
    problem: str = ""


class _NoRuleError(Exception):
    """What a text says has no form; the argument says why."""


def rule_words(text: str, robots: Sequence[RobotInfo], site: Site | None, *, zone: str = "UTC") -> RuleWords | None:
    """Return the rule that a text says, or why none does; None for a text that is no mere prohibition. Never raises.

    Args:
        text: as it was typed.
        robots: the roster.
        site: whose places may be named.
        zone: IANA name of the zone of times that name none.
    """
    plain = " ".join(text[: _LONGEST + 1].split())
    if len(plain) > _LONGEST:
        return None
    plain = _COURTESY.sub("", _LEAD.sub("", plain)).strip(" .!")
    try:
        rest, when = _when(plain, zone)
        return _shaped(rest, when, _Known(robots, site))
    except (_NoRuleError, ValueError) as error:
        return RuleWords(None, str(error)) if _PROHIBITS.search(plain) else None


_LONGEST = 400


def _words(pattern: str) -> re.Pattern[str]:
    return re.compile(pattern, re.IGNORECASE)


_LEAD = _words(
    r"^(?:(?:please|from now on|henceforth|in future|in general|always|remember|note|attention|as a (?:standing )?rule|"
    r"(?:(?:standing|new) )?rule)[,:]? (?:that )?)+"
)
_COURTESY = _words(
    r"(?:,? (?:please|from now on|any ?more|ever again|ever|at all|at all times|at any time|under any circumstances))+"
    r"[.!]*$"
)
_PROHIBITS = _words(
    r"\b(?:never|no|not|nobody|none|noone|neither|cannot|out|off|ban|bar|banned|barred|forbid|forbidden|prohibit|prohibited)\b"
    r"|n't\b"
)

# --- who -----------------------------------------------------------------------------------------------------------

_DETERMINER = _words(r"^(?:(?:all|any|every|each|none)(?: of)? )?(?:the |our |my )?")
_ALL = frozenset(
    "robot robots machine machines vehicle vehicles everyone everybody anyone anybody you fleet all any".split()  # noqa: SIM905 - a list of words
)
_FLYING = re.compile(r"(?:drone|uav|copter|quadcopter|aircraft|flying (?:robot|vehicle|machine))s?")
_GROUND = re.compile(r"(?:ground (?:robot|vehicle|machine)|ugv)s?")
_WHEELED = re.compile(r"rovers?")


def _fold(name: str) -> str:
    return re.sub(r"[\s_-]+", "", name.casefold())


class _Who(Struct, frozen=True):
    robots: tuple[str, ...] = ()
    group: Literal["all", "flying", "ground"] = "all"


class _Known(Struct, frozen=True):
    """What names may mean."""

    robots: Sequence[RobotInfo]
    site: Site | None

    def who(self, text: str | None) -> _Who:
        """Return the robots that a text names."""
        if text is None or not (plain := text.strip(" ,:")):
            return _Who()
        bare = _DETERMINER.sub("", plain).casefold()
        groups = (bare in _ALL, _FLYING.fullmatch(bare), _GROUND.fullmatch(bare), _WHEELED.fullmatch(bare))
        if any(groups) and self._robot(bare):
            raise _NoRuleError(f'"{bare}" is a robot and a kind of robots: use swiftbot rules add --robot or --group')
        if bare in _ALL:
            return _Who()
        if _FLYING.fullmatch(bare):
            return _Who(group="flying")
        if _GROUND.fullmatch(bare):
            return _Who(group="ground")
        if _WHEELED.fullmatch(bare):
            # The form has no wheels: it may stand for all robots on the ground only where all are rovers.
            if all(each.flies or _fold(each.id).startswith("rover") for each in self.robots):
                return _Who(group="ground")
            raise _NoRuleError("not all ground robots are rovers: name the robots, or say ground robots")
        return _Who(robots=_listed(plain, self._robot, "robot"))

    def _robot(self, name: str) -> tuple[str, ...]:
        wanted = _fold(re.sub(r"^(?:the )?(?:robot |both )?(?=.)", "", name, flags=re.IGNORECASE))
        return tuple(each.id for each in self.robots if _fold(each.id) == wanted)

    def named(self, text: str) -> bool:
        """Whether a text has the name of a robot or place in it."""
        words = text.split()
        parts = (" ".join(words[at:end]) for at in range(len(words)) for end in range(at + 1, len(words) + 1))
        return any(self._robot(each) or self._place(each) for each in parts)

    def places(self, text: str) -> tuple[str, ...]:
        """Return the places that a text names, by their names on the site."""
        return _listed(text, self._place, "place")

    def _place(self, name: str) -> tuple[str, ...]:
        if self.site is None:
            return ()
        found = self.site.find(name)
        return tuple(key for key, each in self.site.places.items() if each is found)


_BETWEEN = _words(r",? (?:or|and|nor) (?:to |at |in |into )?|, ?")


def _listed(text: str, known: Callable[[str], tuple[str, ...]], kind: str) -> tuple[str, ...]:
    """Return what each part of a list names: names may have the words in them that stand between others."""
    text = re.sub(r"^(?:either|both|neither) ", "", text.strip(" ,"), flags=re.IGNORECASE)
    if found := known(text):
        return found
    for cut in _BETWEEN.finditer(text):
        if first := known(text[: cut.start()]):
            rest = text[cut.end() :]
            if rest.isdigit() and (numbered := re.match(r"(.*?)\d+$", text[: cut.start()])):
                rest = numbered[1] + rest  # "dock 1 and 2"
            return (*first, *_listed(rest, known, kind))
    raise _NoRuleError(_unknown(text, kind))


def _unknown(text: str, kind: str) -> str:
    if found := _CONDITION.search(text):
        return f'"{found[0]}": a rule has no conditions or exceptions, only hours and days'
    if found := _NEAR.search(text):
        return (
            f'"{found[0]}": a rule says where robots are not sent, not what they pass or come near (forbidden areas do)'
        )
    return f'no {kind} "{text[:60]}"'


_CONDITION = _words(
    r"\b(?:unless|except|without|while|when|whenever|if|only|until|till|other than|but|as long as|than|during|after|"
    r"before|since|because|for|with|within|today|tonight|tomorrow|night|evening|morning|noon|hours?|minutes?)\b"
)
_NEAR = _words(
    r"\b(?:over|through|past|across|around|near|nearer|close|closer|by|along|above|below|under|towards?|away|behind|"
    r"between|beside|via)\b"
)

# --- when ----------------------------------------------------------------------------------------------------------

_TIME = r"(?:(?:[01]?\d|2[0-4])(?:[:.][0-5]\d)?(?: ?(?:am|pm|a\.m\.?|p\.m\.?|o'clock|h|hrs)\b)?|noon|midday|midnight)"
_DAY = (
    r"(?:mon(?:day)?|tue(?:s|sday)?|wed(?:nesday)?|thu(?:rs|rsday)?|fri(?:day)?|sat(?:urday)?|sun(?:day)?|weekday|weekend|"
    r"working day)s?"
)
_DAY_LIST = rf"{_DAY}(?:(?:, and |, | and | or | & ){_DAY})*"
_BOTH = _words(
    rf",? ?\b(?:between|from) (?P<a>{_TIME}) ?(?:and|to|until|till|through|-|–) ?(?P<b>{_TIME})(?![\w:])"
    rf"|,? ?\b(?:after|from|past) (?P<a2>{_TIME}),?(?: and| or| until| till| to)?(?: before| until)? (?P<b2>{_TIME})"
    r"(?![\w:])"
    rf"|,? ?\bbefore (?P<b3>{_TIME}),? (?:and|or) after (?P<a3>{_TIME})(?![\w:])"
)
_AFTER = _words(rf",? ?\b(?:after|past) (?P<a>{_TIME})(?![\w:])")
_BEFORE = _words(rf",? ?\bbefore (?P<b>{_TIME})(?![\w:])")
_ON_DAYS = _words(
    rf",? ?\b(?:(?:on|every|each|at|over)(?: the)? (?P<days>{_DAY_LIST})(?!\w)"
    rf"|(?:from )?(?P<first>{_DAY}) ?(?:to|through|-|–) ?(?P<last>{_DAY})(?!\w))"
)
_ZONE = _words(r" \(?((?:[A-Za-z]+(?:_[A-Za-z]+)*/)+[A-Za-z_+-]+\d*|UTC)\)?(?=$|,)")
_NO_LIMIT = _words(r",? ?\b(?:every day|each day|daily|by local time|local time|around the clock)\b")


class _When(Struct, frozen=True):
    begin_min: int = 0
    end_min: int = DAY_MIN
    days: tuple[int, ...] = ()
    zone: str = "UTC"
    said: bool = False


def _when(text: str, zone: str) -> tuple[str, _When]:
    """Return a text without its hours and days, and these."""
    text, begin, end, days, said = _NO_LIMIT.sub("", text), 0, DAY_MIN, tuple[int, ...](), False
    if found := _ZONE.search(text):
        zone, text = _zone(found[1]), text[: found.start()] + text[found.end() :]
    if found := _ON_DAYS.search(text):
        days, text, said = _days(found), _without(text, found), True
    if found := _BOTH.search(text) or _AFTER.search(text) or _BEFORE.search(text):
        groups = found.groupdict()
        first, last = ("".join(filter(None, (groups.get(f"{each}{n}") for n in ("", "2", "3")))) for each in "ab")
        (begin, unsure), (end, unsure_end) = _clock(first or "0:00"), _clock(last or "24:00")
        afternoon = not any(re.search("[apm]", each) for each in (first, last)) and max(begin, end) >= 13 * 60
        if (unsure or unsure_end) and not (first and last and afternoon):
            raise _NoRuleError(f'"{found[0].strip(" ,")}": write hours like 06:00 and 18:00, or with am and pm')
        begin, end, text, said = begin % DAY_MIN, end or DAY_MIN, _without(text, found), True
        if (re.search(r"\bor\b", found[0]) and begin < end) or (begin, end) == (0, DAY_MIN):
            raise _NoRuleError(f'"{found[0].strip(" ,")}" is always')
        if days and begin > end and re.search(r"\bbefore\b", found[0], re.IGNORECASE):
            # As one rule its hours would begin on these days and end on the next ones.
            raise _NoRuleError(f'"{found[0].strip(" ,")}": say each with its own hours as a rule of its own')
    return " ".join(text.split()).strip(" ,"), _When(begin, end, days, zone if said else "UTC", said)


def _without(text: str, found: re.Match[str]) -> str:
    """Return a text without its hours or days; what goes on after them, in a list, may be meant for all times."""
    rest = text[found.end() :]
    if re.match(r",? ?(?:and|or|nor)\b", rest, re.IGNORECASE):
        raise _NoRuleError(f'"{rest.strip(" ,")[:60]}": say each with its own hours as a rule of its own')
    return text[: found.start()] + rest


def _clock(text: str) -> tuple[int, bool]:
    """Return the minute of the day that a text is, and whether it may be another twelve hours later."""
    named = {"noon": 720, "midday": 720, "midnight": 0}
    if (said := text.casefold()) in named:
        return named[said], False
    found = re.match(r"(\d{1,2})(?:[:.](\d\d))? ?(\D*)", said)
    hour, minute, half = int(found[1]), int(found[2] or 0), (found[3][:1]) if found else ""  # type: ignore[index]
    if half in ("a", "p"):
        if not 1 <= hour <= 12:
            raise _NoRuleError(f'"{text}" is no time of day')
        return (hour % 12 + 12 * (half == "p")) * 60 + minute, False
    if hour == 24 and minute:
        raise _NoRuleError(f'"{text}" is no time of day')
    sure = hour > 12 or hour == 0 or found[2] is not None or found[1].startswith("0")  # type: ignore[index]
    return hour * 60 + minute, not sure


def _days(found: re.Match[str]) -> tuple[int, ...]:
    if found["first"]:
        first, last = (DAYS.index(found[each][:3].casefold()) for each in ("first", "last"))
        return tuple(sorted((first + each) % 7 for each in range((last - first) % 7 + 1)))
    many = {"weekd": range(5), "worki": range(5), "weeke": range(5, 7)}
    days = set[int]()
    for each in re.split(r", and |, | and | or | & ", found["days"].casefold()):
        days |= set(many[each[:5]]) if each[:5] in many else {DAYS.index(each[:3])}
    return tuple(sorted(days))


def _zone(name: str) -> str:
    try:
        ZoneInfo(name)
    except (OSError, ValueError, KeyError):
        raise _NoRuleError(f'no time zone "{name[:60]}"') from None
    return name


# --- what ----------------------------------------------------------------------------------------------------------

_GO = _words(
    r"(?:(?:go|goes|going|drives?|driving|moves?|moving|travels?|travelling|comes?|coming|heads?|heading|returns?|"
    r"returning|rolls?|rolling|(?P<fly>fly|flies|flying))(?: back)? (?:to|into|in|inside|onto)"
    r"|enter(?:s|ing)?(?: into)?|visit(?:s|ing)?|uses?|using|be (?:at|in|inside|on)) (?P<place>.+)"
)
_AT = _words(r"(?:(?:is |are |be )?(?:allowed |permitted |welcome ))?(?:at|in|into|inside|on|to) (?P<place>.+)")
_TAKE = _words(
    r"(?:carry|carries|carrying|transport(?:s|ing)?|pick(?:s|ing)? up|takes? up|taking up|lift(?:s|ing)?|"
    r"fetch(?:es|ing)?|grab(?:s|bing)?|haul(?:s|ing)?) (?P<thing>.+)"
)
_BEGIN = _words(
    r"(?:starts?|begins?|do|does) (?:any subtask|any task|anything|any work)"
    r"|work(?:s|ing)?|operates?|operating|run(?:s|ning)?|moves?|moving|drives?|driving|(?P<fly>fly|flies|flying)"
)
_LET = _words(
    r"(?:let|allow|permit) (?P<who>.+?) (?:to )?(?P<act>(?:go|drive|move|travel|come|head|return|roll|fly|enter|visit|"
    r"use|carry|transport|pick up|lift|fetch|grab|haul|in|into|at|inside|on|work|operate|run)\b.*)"
    r"|(?:send|drive|bring|take|fly) (?P<sent>.+?) (?:to|into) (?P<to>.+)"
)
_ARTICLE = _words(r"^(?:an?|the|any|some) ")
_ANY_THING = _words(r"(?:any)?things?|something|(?:any )?(?:loads?|cargo|objects?|items?|goods)")
_JUDGED = _words(
    r"\b(?:heavy|heavier|light|big|large|small|fragile|dangerous|hazardous|sharp|hot|broken|full|empty|things?|anything|"
    r"objects?|items?|loads?|people|made)\b"
)
_NAMED = re.compile(r"[\w-]+(?: [\w-]+){0,3}")
_INSIDE = _words(r"\b(?:to|from|into|in|at|on|of|that|which|and|or|out|up|down)\b")
_ORDER = _words(
    r"\b(?:go|drive|move|travel|come|head|return|roll|fly|enter|visit|use|carry|carrie|transport|pick|take|lift|fetch|grab|"
    r"haul|land|stop|halt|freeze|abort|hold|wait|pause|photograph|film|record|inspect|scan|report|detect|find|look|place|put|"
    r"drop|bring|deliver|push|pull|follow|charge|dock|undock|start|begin|do|work|operate|run|turn|rotate|open|close|switch|"
    r"clean|sweep|cut|patrol|explore|map|measure|read|say|ask|tell|send|give|hand|keep|stay|leave|let|make|try|help|load|"
    r"unload|fasten|unfasten|pour|count|check|cancel|resume|orbit|circle|hover|climb|descend)(?:e?s|d|ed|ing)?\b"
)
"""Orders: a thing whose name has one of them may be a second order, which no rule says."""
_FILLER = _words(
    r"\b(?:again|now|yet|first|last|later|all|both|every|everything|each|it|this|that|these|those|my|your|our|their|its|other|"
    r"others|same|twice|alone|together|outside|inside|upstairs|downstairs|here|there|yourself|no|not|never|nor|neither|none|"
    r"must|may|shall|should|can|will|anymore|longer)\b|^\d+\b|n't\b"
)
"""What is no part of a thing's name, so that with it the name would not be found in a plan's."""


def _thing(text: str, known: _Known) -> tuple[str, ...]:
    bare = _ARTICLE.sub("", text.strip(" ,"))
    if _ANY_THING.fullmatch(bare):
        return (ANYTHING,)
    if _CONDITION.search(bare) or _NEAR.search(bare):
        raise _NoRuleError(_unknown(bare, "thing"))
    if _INSIDE.search(bare) or not _NAMED.fullmatch(bare):
        raise _NoRuleError(f'"{bare[:60]}": a rule on what is taken up names the thing alone')
    if found := _ORDER.search(bare) or _FILLER.search(bare):
        raise _NoRuleError(
            f'"{found[0]}" is no part of the name of a thing: say one rule at a time, with its name alone'
        )
    if known.named(bare):
        raise _NoRuleError(f'"{bare[:60]}" names a robot or place, no thing')
    if found := _JUDGED.search(bare):
        raise _NoRuleError(f'"{found[0]}" cannot be told from the name of a thing: name it, or say anything')
    return (bare.casefold(),)


def _things(text: str, known: _Known) -> tuple[str, ...]:
    """Return the things of a list with `or`: after `and` or a comma alone a further order may follow."""
    if re.search(r",? and |,(?!.* (?:or|nor) )", text, re.IGNORECASE):
        raise _NoRuleError(f'"{text[:60]}": say things with "or" between them, or one rule at a time')
    return tuple(name for each in re.split(r",? (?:or|nor) |, ?", text) for name in _thing(each, known))


def _act(text: str, who: _Who, when: _When, known: _Known, *, bare: bool = False) -> RuleWords:
    """Return the rule that some robots never do what a text says; `bare`: a place alone is going there."""
    rule: dict[str, tuple[str, ...]] = {}
    if found := _GO.fullmatch(text) or _AT.fullmatch(text):
        rule["places"] = known.places(found["place"])
        who = _flyers(who, found)
    elif found := _TAKE.fullmatch(text):
        rule["things"] = _things(found["thing"], known)
    elif found := _BEGIN.fullmatch(text):
        if not when.said:
            raise _NoRuleError(f'"{text}": say at which hours or days, or: swiftbot robots maintain ROBOT')
        who = _flyers(who, found)
    elif bare:
        rule["places"] = known.places(text)
    elif _CONDITION.search(text) or _NEAR.search(text):
        raise _NoRuleError(_unknown(text, "place"))
    else:
        raise _NoRuleError(
            f'"{text[:60]}": a rule says where robots never go, what they never take up, or when none works'
        )
    return RuleWords(_rule(who, when, **rule))


def _flyers(who: _Who, found: re.Match[str]) -> _Who:
    flies = "fly" in found.re.groupindex and found["fly"] and not who.robots and who.group == "all"
    return _Who(group="flying") if flies else who


def _rule(who: _Who, when: _When, places: tuple[str, ...] = (), things: tuple[str, ...] = ()) -> Rule:
    return Rule(
        robots=tuple(sorted(set(who.robots))), group=who.group, places=tuple(sorted(set(places))),
        things=tuple(sorted(set(things))), begin_min=when.begin_min, end_min=when.end_min, days=when.days,
        zone=when.zone,
    )  # fmt: skip


# --- shapes --------------------------------------------------------------------------------------------------------

_MODAL = r"(?:must|may|shall|should|can|will|do|does|is|are)"
_NOT = (
    rf"(?:never|{_MODAL}(?: not|n't| never)|cannot|can't|won't|shan't|don't)(?: ever)?"
    r"(?: (?:be )?(?:allowed|permitted|supposed)(?= to| (?:at|in|into|inside|on) ))?(?: to(?= ))?"
)

_KEEP = _words(
    r"(?:(?P<who>.+?)[,:]?(?: must| should| shall| have to| has to| are to| is to)?(?: always)? )?"
    r"(?:keeps?|stays?) out of (?P<place>.+)"
)
_KEEP_THEM = _words(r"keep (?P<who>.+?) out of (?P<place>.+)")
_ENTRY = _words(
    r"no (?:entry|access|entrance|admittance)(?: for (?P<who>.+?))? (?:to|into) (?P<place>.+?)(?: for (?P<for>.+))?"
)
_OFF = _words(
    r"(?P<place>.+?) (?:is|are) (?:(?:off[- ]limits|out of bounds)(?: (?:for|to) (?P<who>.+))?"
    r"|(?:forbidden|prohibited|a no[- ]go (?:area|zone|place))(?: for (?P<for>.+))?)"
)
_BAN = _words(
    r"(?:ban|bar|forbid|prohibit) (?P<who>.+?) (?:from|to) (?P<act>.+)"
    r"|(?P<who2>.+?) (?:is|are) (?:banned|barred|forbidden|prohibited) (?:from|to) (?P<act2>.+)"
)
_NOBODY = _words(
    r"(?:nobody|no[- ]?one|(?:no|none of) (?P<who>(?:the |our )?(?:flying |ground )?[\w.-]+?)"
    r"|neither (?P<pair>.+? nor .+?)) "
    rf"(?:(?:ever |{_MODAL} (?:ever )?(?:(?:allowed|permitted) )?(?:to )?))?(?P<act>.+)"
)
_NEVER = _words(rf"(?:(?P<who>.+?)[:,]? )?{_NOT} (?P<act>.+)")


def _shaped(text: str, when: _When, known: _Known) -> RuleWords | None:
    if re.search(r"[.;!?] ", text):
        raise _NoRuleError("say one rule at a time")
    for shape in (_KEEP_THEM, _KEEP, _ENTRY, _OFF):
        if found := shape.fullmatch(text):
            groups = found.groupdict()
            if groups.get("who") and groups.get("for"):
                raise _NoRuleError("it is said twice for whom")
            who = known.who(groups.get("who") or groups.get("for"))
            return RuleWords(_rule(who, when, places=known.places(found["place"])))
    if found := _BAN.fullmatch(text):
        return _act(found["act"] or found["act2"], known.who(found["who"] or found["who2"]), when, known, bare=True)
    if found := _NOBODY.fullmatch(text):
        return _act(found["act"], known.who(found["pair"] or found["who"]), when, known)
    if found := _NEVER.fullmatch(text):
        if let := _LET.fullmatch(found["act"]):
            if found["who"]:
                raise _NoRuleError(f'"{found["act"][:60]}": say what the robots never do')
            act = let["act"] or f"go to {let['to']}"
            return _act(act, known.who(let["who"] or let["sent"]), when, known)
        return _act(found["act"], known.who(found["who"]), when, known)
    return None
