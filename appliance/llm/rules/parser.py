"""Instruction to graph: sentences, the clauses in them, and what the words between them mean for the order.

Goes through the text once, left to right. Each word of it is either understood (part of a clause that fits a pattern,
or a connective) or not; the share that was understood is the confidence. Nothing is guessed: a clause that fits no
pattern adds no subtask and costs confidence.

A clause is `subject? auxiliary* verb rest`. The subject may be a robot's name, a group, "a robot" or nothing (the one
spoken to); the verb may stand in any form, the passive included. It is read without changing anything, so that a
reading can be tried and dropped. Quantities said beside the verb (how long, how fast, how often) are taken out before
it is matched: "film it for two minutes" and "for two minutes, film it" need one pattern of the grammar and not four.

Orders that wait for others, or are named in another sequence than they happen ("while A, B", "before A, B", "once A,
B", "A after B", "A first", "if A, B"), come down to clauses added in the order in which they happen, and edges between
them.
"""

import re
from abc import ABC, abstractmethod
from typing import Any

from msgspec import Struct, field

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules import names
from appliance.llm.rules.grammar import PICTURES, AddedSkills, Step, steps_of
from appliance.llm.rules.graph import Graph, Mentions, Snapshot
from appliance.llm.rules.lexicon import (
    BETWEEN,
    DONE,
    FILE,
    HEADING,
    HERE,
    LEAD_ALL,
    LEAD_BESIDE,
    LEAD_FIRST,
    PREFIX,
    TRAILING,
    clean,
    first_chunk,
    renamed,
    sentences,
)
from appliance.model import RobotInfo, Site, Subtask
from appliance.skills.catalogue import Catalogue

_N = lx.NUMBER
_T = lx.TIME_UNIT
_L = lx.LENGTH_UNIT


class Modifiers(Struct):
    """What was said of quantity; a skill takes what it has parameters for, the rest counts as not understood."""

    values: dict[str, Any] = field(default_factory=dict[str, Any])
    times: int = 0
    """Twice: 2; not said: 0."""
    words: dict[str, int] = field(default_factory=dict[str, int])
    """Key -> how many words said it."""


def _rule(pattern: str) -> re.Pattern[str]:
    return re.compile(pattern, re.IGNORECASE)


_WINDOW = (
    _rule(
        rf",?\s*\b(?:with|using|over|in)?\s*\b(?:an? |the )?(?:time )?window (?:length )?(?:of "
        rf")?(?P<n>{_N}) ?(?P<u>ms|milliseconds?|seconds?|s)\b"
    ),
    _rule(rf"\b(?:with|using|over|in) an? (?P<n>{_N})[ -]?(?P<u>ms|millisecond|second|s)\b window"),
)
_TIMEOUT = (
    _rule(rf",?\s*\b(?:for )?(?:at most|up to|no longer than|no more than|a maximum of) (?P<n>{_N})[ -]?(?P<u>{_T})"),
    _rule(rf",?\s*(?:for )?(?P<n>{_N})[ -]?(?P<u>{_T}) at (?:the )?most\b"),
)
_DURATION = (
    _rule(rf",?\s*\bfor (?:about |around |exactly |another |the next )?(?P<n>{_N})[ -]?(?P<u>{_T})"),
    _rule(r"\b(?P<n>\d+)[ -](?P<u>second|minute|hour)\b"),
)
_SPEED = (_rule(rf",?\s*\bat (?:a speed of )?(?P<n>{_N}) ?(?P<u>{lx.SPEED_UNIT})(?!\w)"),)
_FPS = (_rule(rf",?\s*\bat (?P<n>{_N}) ?(?:fps|frames (?:per|a) second)\b"),)
_RADIUS = (
    _rule(rf",?\s*\b(?:at|with|in) an? radius of (?P<n>{_N}) ?(?P<u>{_L})"),
    _rule(rf",?\s*\b(?:at|with|in) an? (?P<n>{_N})[ -]?(?P<u>{_L})[ -]radius\b"),
    _rule(rf",?\s*\b(?:with )?radius (?P<n>{_N}) ?(?P<u>{_L})"),
)
_EPOCHS = (_rule(rf",?\s*\b(?:for )?(?P<n>{_N}) (?:local )?epochs?\b"),)
_LAPS = (_rule(rf"\b(?P<n>{_N}) (?:full |complete )?(?:laps?|rounds?|circuits?|loops?|orbits?)\b"),)
_TIMES = (
    _rule(rf",?\s*\b(?P<n>{_N}) times\b"),
    _rule(r",?\s*\b(?P<n>twice|thrice)\b(?! as)"),
    _rule(r"(?<=\w)\s+(?P<n>once)$"),
)


def take_modifiers(text: str, *, altitude: bool) -> tuple[str, Modifiers]:
    """Return the clause without its quantities, and the quantities.

    Args:
        text: one clause.
        altitude: whether lengths are altitudes (the clause takes off).
    """
    found = Modifiers()

    def use(key: str, patterns: tuple[re.Pattern[str], ...], convert: Any) -> None:
        nonlocal text
        for pattern in patterns:
            match = pattern.search(text)
            if match is None:
                continue
            groups = match.groupdict()
            value = convert(groups["n"], groups.get("u") or "")
            if value is None:
                continue
            found.values[key] = value
            found.words[key] = len(match[0].split())
            text = text[: match.start()] + " " + text[match.end() :]
            return

    use("window_ms", _WINDOW, _milliseconds)
    use("timeout_s", _TIMEOUT, lx.seconds)
    use("duration_s", _DURATION, lx.seconds)
    use("speed_mps", _SPEED, lx.speed)
    use("fps", _FPS, _count)
    use("radius_m", _RADIUS, lx.metres)
    use("epochs", _EPOCHS, _count)
    if altitude:
        use(
            "altitude_m",
            (
                _rule(
                    rf",?\s*\b(?:to|at|up to) (?:an? )?(?:altitude |height )?(?:of )?(?P<n>{_N}) ?(?P<u>{_L})"
                    rf"(?: altitude| high)?"
                ),
            ),
            lx.metres,
        )
    use("laps", _LAPS, _count)
    use("times", _TIMES, _count)
    found.times = int(found.values.pop("times", 0))
    return " ".join(text.split()), found


def _milliseconds(amount: str, unit: str) -> int | float | None:
    value = lx.number(amount)
    return None if value is None else lx.plain(value * (1.0 if unit.lower().startswith("m") else 1000.0))


def _count(amount: str, unit: str) -> int | float | None:
    del unit
    value = lx.number(amount)
    return None if value is None else lx.plain(value)


_LEADING = re.compile(
    r"(?:please|kindly|also|just|now|then|again|and|but|so|first|firstly|finally|lastly|next|"
    r"i(?:'d| would) like (?:you )?to|i want you to|"
    r"(?:i )?(?:need|want) you to|(?:could|can|would|will) you(?: please| kindly)?|be sure "
    r"to|make sure to|don't forget to|go ahead and|"
    r"start by|begin by|try to|on the gateway|could somebody(?: please)?|your (?:task|job)"
    r" is to|the (?:task|job) is to|you (?:should|must|need to|have to|can|may)|"
    r"(?:i'd|i would) like|i need|i want|we need|let's|subsequently)\b[,:]?\s*",
    re.IGNORECASE,
)
_AUXILIARY = re.compile(
    (
        r"(?:(?:should|must|will|shall|can|may|needs? to|has to|have to|is to|are to|is going "
        r"to|are going to|is|are|to|then|also|now|each|both|all|"
        r"please|immediately|meanwhile|simultaneously|first|finally|has|have|had|been|quickly|"
        r"slowly|carefully|'s to|'ll|subsequently|go and)\s+)+"
    ),
    re.IGNORECASE,
)
_CAUSE = re.compile(
    r"(?P<verb>have|let|get|tell|ask|order|command|instruct|send|dispatch|make|use)\s+(?P<rest>.+)",
    re.IGNORECASE | re.DOTALL,
)
_PASSIVE = re.compile(
    (
        r"(?P<what>.+?) (?:(?:has|have|is|are|was|were|must|should|needs?|will|shall)(?: (?:to|"
        r"all|both|only))?)(?: been| be| being)*(?: (?:been|be|being))? (?P<verb>\w+)(?P<rest>\b.*)"
    ),
    re.IGNORECASE | re.DOTALL,
)
_SUSPICIOUS = re.compile(
    (
        r"\b(?:then|while|whilst|before|until|unless|because|if|meanwhile|afterwards|once|simultaneously|"
        r"otherwise|except|without|not|never|don't)\b"
    ),
    re.IGNORECASE,
)
_FREE_TEXT = ("text", "question", "event")
_TOOLED = frozenset({"localize", "match_scene", "split_area", "fasten"})
"""Skills in which "with X" is not the robot that does it."""


class Who(Struct):
    """The subject: robots, or `[]` for the one spoken to last. `kind` says how it was put."""

    robots: list[str] = field(default_factory=list[str])
    kind: str = "elided"
    """named, all, several, one, the, first, other, pronoun, elided"""


class Clause(Struct):
    """A clause that was understood: `lost` of its `words` were not."""

    who: Who
    steps: list[Step]
    prefix: str
    words: int
    lost: float
    quantities: dict[str, Any] = field(default_factory=dict[str, Any])


class Reader:
    """Reads clauses against what was mentioned so far. It is the `Scope` of the patterns."""

    def __init__(self, catalogue: Catalogue, who: names.Names, known_place: Any, quotes: list[str]) -> None:
        self.catalogue = catalogue
        self._added = AddedSkills.of(catalogue)
        self.names = who
        self.mentions = Mentions()
        self._known_place = known_place
        self._quotes = quotes
        self._group: list[str] = []
        self._trying = False
        """Whether a reading is only tried: what "there" is may be said before it is read in earnest."""
        self._with = re.compile(rf"\s+(?:with|using|by)\s+(?P<n>{who.sure.pattern})$")

    # --- Scope ---------------------------------------------------------------------------------------------------

    def unquote(self, text: str) -> str:
        """Put quoted texts back."""
        return re.sub(r"\x00(\d+)\x00", lambda match: self._quotes[int(match[1])], text)

    def thing(self, text: str) -> str:
        """Resolve an object, pronouns included."""
        if "\x00" in text:
            return self.unquote(text).strip()
        low = lx.noun(text)
        if low in ("it", "them", "this", "that", "these", "those", "one", "him", "her"):
            return self.mentions.thing or self.mentions.place or low
        return low

    def cargo(self, text: str) -> str:
        """Resolve what is put down or handed over: "it" is the thing held, whatever was spoken of since."""
        pronoun = lx.noun(text) in ("it", "them", "this", "that", "these", "those")
        return self.mentions.held if pronoun and self.mentions.held else self.thing(text)

    def place(self, text: str) -> str:
        """Resolve a place; "there" is the last one."""
        low = lx.noun(text)
        if low in ("", "it") or text.strip().lower() in ("there", "it", "that place", "same place"):
            return self.mentions.place or self.mentions.thing or ("there" if self._trying else "")
        return low

    def person(self, text: str) -> str:
        """Resolve somebody; "me" and "us" are the operator."""
        low = lx.noun(text)
        if low in ("me", "us", "control"):
            return "operator"
        return self.mentions.person or low if low in ("him", "her", "them") else low

    def robot(self, text: str) -> str | None:
        """Return the robot a text names, or None."""
        return self.names.known(text)

    def is_person(self, text: str) -> bool:
        """Whether a text names a person rather than a place."""
        low = lx.noun(text)
        if self.known_place(text) or self.names.known(text):
            return False
        if low in ("me", "us", "him", "her", "them"):
            return True
        if re.match(r"(?:dr|mr|mrs|ms|miss|prof|sir|nurse|captain|sergeant|chef)\b", low):
            return True
        last = low.split()[-1] if low else ""
        if re.fullmatch(
            (
                r"(?:operator|nurse|doctor|patient|driver|guests?|visitors?|worker|workers|technician|"
                r"engineer|manager|foreman|supervisor|chef|customers?|"
                r"guard|clerk|surgeon|surveyors?|delegates|passengers|attendant|mechanic|electrician|farmer|"
                r"teacher|students?|man|woman|person|people|"
                r"lady|gentleman|child|crew|team|staff|colleague|porter|pharmacist|receptionist|owner|"
                r"inspector|officer|lead|warden|caretaker)"
            ),
            last,
        ):
            return True
        return bool(re.fullmatch(r"[A-Z][a-z]+", text.strip()))

    def known_place(self, text: str) -> bool:
        """Whether the site knows a place of that name."""
        return bool(self._known_place(lx.noun(text)))

    def group(self, text: str) -> list[str]:
        """Return the robots a text names; "" is those spoken to."""
        low = text.strip().lower()
        if not low or low in ("them", "themselves", "it"):
            return list(self._group or self.mentions.robots)
        if listed := self.names.listed(text):
            return listed
        if match := names.ALL.fullmatch(low) or names.ALL.fullmatch("all " + low.removeprefix("the ")):
            return self.names.everyone(match.groupdict().get("kind") or match.groupdict().get("plural") or "")
        if match := names.SEVERAL.fullmatch(low):
            return [f"any{index + 1}" for index in range(int(lx.number(match["n"]) or 2))]
        return []

    def model(self) -> str:
        """Return the model last spoken of."""
        return self.mentions.model

    # --- reading ---------------------------------------------------------------------------------------------------

    def read(self, text: str, *, speaking_to: list[str]) -> Clause | None:
        """Read one clause; None when no pattern fits.

        Args:
            text: the clause, connectives taken off.
            speaking_to: whom an elided subject means.
        """
        text = text.strip(" ,.;:!?-\n\t")
        words = len(text.split())
        if not text or words > 60:
            return None
        core = text
        for _ in range(4):
            if (match := _LEADING.match(core)) and match.end():
                core = core[match.end() :]
        if match := self._with.search(core):
            found = self.read(core[: match.start()], speaking_to=[self.names.resolve(match["n"])])
            if (
                found is not None
                and found.who.kind == "elided"
                and not any(step.skill in _TOOLED for step in found.steps)
            ):
                found.who = Who([self.names.resolve(match["n"])], "named")
                found.words = words
                return found
        for who, rest in self._subjects(core):
            self._group = who.robots or speaking_to
            if found := self._predicate(rest, explicit=who.kind != "elided"):
                steps, prefix, lost, quantities = found
                return Clause(who, steps, prefix, words, lost, quantities)
        return self._passive(core, words, speaking_to)

    def starts(self, text: str) -> bool:
        """Whether a text begins like a clause: verb first, or subject and verb."""
        self._trying = True
        try:
            return self.read(text, speaking_to=["any1", "any2"]) is not None
        finally:
            self._trying = False

    def _subjects(self, text: str) -> list[tuple[Who, str]]:
        found: list[tuple[Who, str]] = []
        if cause := _CAUSE.match(text):
            target, verb = cause["rest"], cause["verb"].lower()
            for who, said in self._named(target):
                rest = re.sub(r"^\s*(?:to|and)\s+(?=\w)", "" if verb != "send" else "to ", said)
                if verb in ("send", "dispatch"):
                    rest = re.sub(
                        r"^\s*to (?=(\w+))",
                        lambda m: "" if m[1].lower() in lx.LEMMA and m[1].lower() != "dock" else "go to ",
                        rest.strip(),
                    )
                found.append((who, rest))
        first = text.split(maxsplit=1)[0].lower() if text.split() else ""
        elided = (Who(), text)
        verb_first = first in lx.LEMMA or first in self._added.verbs
        subjects = self._named(text)
        return found + ([elided, *subjects] if verb_first else [*subjects, elided])

    def _named(self, text: str) -> list[tuple[Who, str]]:
        found: list[tuple[Who, str]] = []
        if named := self.names.leading(text):
            found.append((Who(named[0], "named"), named[1]))
            if len(set(named[0])) < len(named[0]):
                # "Heron, Heron, this is base": called twice, still one.
                found.append((Who(list(dict.fromkeys(named[0])), "named"), named[1]))
        for pattern, kind in (
            (names.SEVERAL, "several"),
            (names.ALL, "all"),
            (names.ONE, "one"),
            (names.THE, "the"),
            (names.OTHER, "other"),
            (names.FIRST, "first"),
            (names.PRONOUN, "pronoun"),
        ):
            if match := pattern.match(text):
                groups = match.groupdict()
                robots: list[str] = []
                if kind == "all":
                    low = match[0].lower()
                    both = low.startswith("both") or "of them" in low or low in ("each", "all")
                    robots = (
                        list(self.mentions.group)
                        if both and self.mentions.group
                        else self.names.everyone(groups.get("kind") or groups.get("plural") or "")
                    )
                elif kind == "several":
                    robots = [f"any{index + 1}" for index in range(int(lx.number(groups["n"]) or 2))]
                elif kind == "one":
                    robots = ["any"]
                elif kind == "the":
                    # Definite, so the one of its kind; else the one spoken of, else whichever.
                    alike = self.names.everyone(groups["kind"])
                    spoken = [name for name in self.mentions.robots if name in alike]
                    robots = alike if len(alike) == 1 and alike != ["all"] else spoken[:1] or ["any"]
                found.append((Who(robots, kind), text[match.end() :]))
        return found

    def _predicate(self, text: str, *, explicit: bool) -> tuple[list[Step], str, float, dict[str, Any]] | None:
        text = text.strip(" ,:-")
        if match := _AUXILIARY.match(text + " "):
            text = text[match.end() :] if match.end() <= len(text) else ""
        if match := _LEADING.match(text):
            text = text[match.end() :]
        parts = text.split(None, 1)
        if not parts:
            return None
        if self._added and (found := self._by_phrase(text)):
            return found
        lemma = lx.LEMMA.get(lx.spell(parts[0]).lower().strip(",:"))
        if lemma is None:
            return self._nominal(text) if not explicit or re.search(r"\b(?:of|scan)\b", text) else None
        tail = parts[1] if len(parts) > 1 else ""
        lifted = (re.match(r"off\b", tail, re.IGNORECASE) is not None and lemma in ("take", "lift")) or lemma in (
            "launch",
            "climb",
        )
        if lemma in ("wait", "hold", "hover", "stay", "pause", "remain"):
            tail = re.sub(rf"^(?=(?:about |another )?{lx.NUMBER} ?{lx.TIME_UNIT})", "for ", tail, flags=re.IGNORECASE)
        rest, quantities = take_modifiers(tail, altitude=lifted)
        return self._match(lemma, rest, quantities)

    def _by_phrase(self, text: str) -> tuple[list[Step], str, float, dict[str, Any]] | None:
        """Read a clause by the phrases of skills that are not built in."""
        rest, quantities = take_modifiers(text, altitude=False)
        if (step := self._added.step(rest, self)) is None:
            return None
        return [step], "", self._give_quantities([step], quantities) + self._doubt([step]), quantities.values

    def _nominal(self, text: str) -> tuple[list[Step], str, float, dict[str, Any]] | None:
        """Read "three photos of the stage", "thermal scan of X", "frames at 12 fps"."""
        rest, quantities = take_modifiers(text, altitude=False)
        low = rest.lower()
        if re.match(rf"(?:{lx.NUMBER} )?(?:\w+ )?{PICTURES} of ", low):
            return self._match("take", rest, quantities)
        if match := re.match(r"(?:an? )?thermal scans?(?: of|,|:)? (?P<t>.+)", rest, re.IGNORECASE):
            return self._match("take", f"thermal scan of {match['t']}", quantities)
        if re.match(r"(?:the )?(?:audio pre-?processing|transcription|frame extraction)$", low):
            return self._match("run", rest, quantities)
        return None

    def _match(
        self, lemma: str, rest: str, quantities: Modifiers
    ) -> tuple[list[Step], str, float, dict[str, Any]] | None:
        rest = re.sub(
            (
                r"(?:^|\s+)(?:please|now|immediately|right away|straight away|too|as well|again|once|at the "
                r"same time|simultaneously|in parallel|in that order|meanwhile)$"
            ),
            "",
            rest.strip(" ,"),
            flags=re.IGNORECASE,
        )
        found = steps_of(lemma, rest, self)
        if found is None and lemma in ("do", "make", "run", "fly", "drive", "walk") and "laps" in quantities.values:
            found = steps_of("patrol", re.sub(r"^(?:of|around|round) ", "", rest), self)
        if found is None and lemma in ("wait", "pause") and "duration_s" in quantities.values:
            found = steps_of("hold", rest, self)
        if found is None:
            return None
        steps, prefix = found
        if lemma == "wait" and quantities.values.get("duration_s") and steps[0].skill == "wait_for":
            quantities.values["timeout_s"] = quantities.values.pop("duration_s")
        lost = self._give_quantities(steps, quantities)
        return steps, prefix, lost + self._doubt(steps), quantities.values

    def _give_quantities(self, steps: list[Step], quantities: Modifiers) -> float:
        """Put quantities where a skill has a parameter for them; return the words that found no place."""
        lost = 0.0
        for key, value in quantities.values.items():
            takers = [step for step in steps if self._has(step.skill, key)]
            for step in takers[-1:]:
                step.params[key] = value
            lost += 0 if takers else quantities.words.get(key, 1)
        if quantities.times > 1:
            last = steps[-1]
            key = next((name for name in ("laps", "count") if self._has(last.skill, name)), "")
            if key:
                last.params[key] = quantities.times
            else:
                steps *= min(quantities.times, 16)
        return lost

    def _has(self, skill: str, key: str) -> bool:
        manifest = self.catalogue.skills.get(skill)
        return manifest is not None and key in manifest.params

    def _doubt(self, steps: list[Step]) -> float:
        """Return how many words of the slots look as if more had been meant than one noun phrase."""
        lost = 0.0
        for step in steps:
            for key, value in [*step.params.items(), ("at", step.at)]:
                if not isinstance(value, str) or key in _FREE_TEXT:
                    continue
                count = len(value.split())
                if key not in ("to", "target") and self.names.sure.search(value) and self.names.roster:
                    lost += count
                lost += max(0, count - 6)
                if lx.LEMMA.get(value) == value and key in ("object", "target", "asset"):
                    lost += 2  # "inspect, photograph and film the shelf": a verb is no thing
                if _SUSPICIOUS.search(value):
                    lost += count
                lost += 3 * bool(re.search(r"\b(?:and|to)\b", value)) * bool(count > 3)
        return lost

    def _passive(self, text: str, words: int, speaking_to: list[str]) -> Clause | None:
        """Read "helpdesk.wav has been preprocessed" as "preprocess helpdesk.wav"."""
        match = _PASSIVE.fullmatch(text)
        if match is None or (lemma := lx.LEMMA.get(match["verb"].lower())) is None:
            return None
        self._group = speaking_to
        rest, quantities = take_modifiers(f"{match['what']}{match['rest']}", altitude=False)
        found = self._match(lemma, rest, quantities)
        return Clause(Who(), found[0], found[1], words, found[2], found[3]) if found else None


class Conditions(ABC):
    """State of reading one instruction, and the conditions in it."""

    def __init__(self, catalogue: Catalogue, *, robots: tuple[RobotInfo, ...] | None, site: Site | None) -> None:
        roster = None if robots is None else tuple(robot.id for robot in robots)
        self._names = names.Names(roster, tuple(robot.id for robot in robots or () if robot.flies))
        self._quotes: list[str] = []
        self._site = site
        self._reader = Reader(catalogue, self._names, self._known_place, self._quotes)
        self._graph = Graph(catalogue)
        self._said = 0
        self._lost: float = 0.0
        self._pieces: list[str] = []
        self._to: list[str] = ["any"]
        """Whom an elided subject means."""
        self._anys = 0
        self._last: Clause | None = None
        self._whole: Clause | None = None
        """The last clause that was read while splitting a sentence."""
        self._all_beside = False
        """The sentence said in advance that all of it runs together."""
        self._source = ""
        """A file that was put before what is done with it."""

    def _known_place(self, name: str) -> bool:
        return self._site is not None and self._site.find(name) is not None

    def _prefixed(self, word: str, rest: str, start: Snapshot | None) -> bool:
        """Read "while A, B", "before A, B", "once A, B"; False when no comma separates two clauses."""
        word = word.removeprefix("only ")
        for match in re.finditer(r"\s*[,:]\s*(?:then\s+)?", rest):
            condition, main = rest[: match.start()], rest[match.end() :]
            vocative = self._names.leading(main)
            if not (
                self._reader.starts(first_chunk(main))
                or vocative
                or LEAD_FIRST.match(main)
                or re.match(r"at |in ", main)
            ):
                continue
            if word in ("while", "whilst", "as"):
                before = self._graph.snapshot() if start is None else start
                self._clauses(condition, start)
                self._graph.scope = set()
                self._clauses(self._spoken_to(main), before)
            elif word == "before":
                old = len(self._graph.steps)
                self._clauses(self._spoken_to(main), start)
                self._graph.barrier |= self._graph.lasts(range(old, len(self._graph.steps)))
                self._clauses(condition, None)
            else:
                self._condition(word, condition)
                self._clauses(self._spoken_to(main), None)
            return True
        return False

    def _condition(self, word: str, text: str) -> None:
        """Make what follows in this sentence wait for a condition: work that is done, or an event."""
        graph = self._graph
        if graph.steps and HERE.fullmatch(text):
            graph.barrier |= graph.lasts()
            return
        done = DONE.fullmatch(text)
        if graph.steps and done:
            robot = self._names.known(done["who"]) or (
                self._names.resolve(done["who"]) if self._names.resolve(done["who"]) in graph.tails else None
            )
            graph.barrier |= graph.tails[robot] if robot in graph.tails else graph.lasts()
            return
        old = len(graph.steps)
        if self._reader.starts(first_chunk(text)) and word != "if":
            self._clauses(text, None)
            if len(graph.steps) > old:
                graph.barrier |= graph.lasts(range(old, len(graph.steps)))
                return
        checked = any(graph.catalogue.skills[skill].observes for skill, _, _ in graph.steps)
        if word in ("if", "in case"):
            graph.barrier |= graph.lasts()
            if not checked:
                self._lose(f"{word} {text}", len(text.split()) + 1)
        elif (
            graph.steps
            and checked
            and re.match(r"(?:you|it|he|she|they|everyone|everybody|all|both)\b", text, re.IGNORECASE)
        ):
            graph.barrier |= graph.lasts()
        else:
            step = Step("wait_for", {"event": self._reader.unquote(text.strip(" ,."))})
            _, ends = graph.add(self._to[:1] if self._to != ["all"] else ["any"], [step])
            graph.barrier |= ends

    def _afterwards(self, kind: str, said: str, clause: Clause, before: str, start: Snapshot | None) -> set[int] | None:
        """Read "A after B" in the order in which it happens; None when B is no clause.

        B is said with A's words ("places the box after fetching it"), so A is remembered first, then B is added.
        """
        speaking_to, last = self._to, self._last
        self._to = self._doers(clause.who)
        self._remember(clause)
        if (first := self._reader.read(before, speaking_to=self._to)) is None:
            self._to, self._last = speaking_to, last
            return None
        doers = self._to
        _, ends = self._emit(kind, first, start)
        self._to = doers
        clause = self._reader.read(said, speaking_to=doers) or clause
        self._lost += first.lost + clause.lost
        firsts, _ = self._emit("list", clause, None)
        self._graph.order(ends, firsts)
        return firsts

    def _earlier(self, text: str) -> None:
        """Read "Close the clamp first", said after what it comes before."""
        graph = self._graph
        clause = self._reader.read(re.sub(r"\s+first[.!]?$", "", text), speaking_to=self._to)
        if clause is None:
            self._lose(text, len(text.split()))
            return
        self._lost += clause.lost
        later = {node for node in range(len(graph.steps)) if not graph.before[node]}
        tails = dict(graph.tails)
        _, ends = graph.add(list(self._doers(clause.who)), clause.steps, beside=Snapshot({}, frozenset(), frozenset()))
        graph.order(ends, later)
        graph.tails = {**graph.tails, **tails}

    def _halves(self, text: str) -> tuple[str, str] | None:
        """Split "you find him, notify the guard" (the comma may be missing) into condition and order."""
        for match in re.finditer(r",\s*", text):
            if self._reader.starts(first_chunk(text[match.end() :])):
                return text[: match.start()], text[match.end() :]
        for match in re.finditer(r"\s+(?=([a-z]+)\b)", text):
            condition = text[: match.start()]
            if match[1] in lx.LEMMA and lx.LEMMA[match[1]] == match[1] and len(condition.split()) > 1:
                about = DONE.fullmatch(condition) or self._reader.starts(condition)
                if about and self._reader.starts(first_chunk(text[match.end() :])):
                    return condition, text[match.end() :]
        return None

    def _late_condition(self, kind: str, text: str, firsts: set[int], sentence: Snapshot) -> None:
        """Read "A once B", said in that order: B comes first."""
        graph = self._graph
        old = len(graph.steps)
        if DONE.fullmatch(clean(text)) and len(graph.steps) > len(firsts):
            graph.order(graph.lasts(set(range(old)) - firsts), firsts)
            return
        tails, thread = dict(graph.tails), graph.thread
        graph.tails, graph.thread, graph.barrier = dict(sentence.tails), sentence.thread, sentence.barrier
        graph.scope = set()
        if self._reader.starts(first_chunk(text)):
            self._clauses(text, None)
            graph.order(graph.lasts(range(old, len(graph.steps))), firsts)
            graph.tails, graph.thread = {**graph.tails, **tails}, thread
            return
        if kind == "when":
            step = Step("wait_for", {"event": self._reader.unquote(clean(text))})
            robots = self._to[:1] if self._to != ["all"] else ["any"]
            _, ends = graph.add(robots, [step], beside=Snapshot(dict(sentence.tails), frozenset(), graph.barrier))
            graph.order(ends, firsts)
            graph.tails, graph.thread = {**graph.tails, **tails}, thread
            return
        graph.tails, graph.thread = tails, thread
        self._lose(text, len(text.split()))

    @abstractmethod
    def _clauses(self, text: str, start: Snapshot | None) -> None:
        """Read clauses and what stands between them."""

    @abstractmethod
    def _emit(self, kind: str, clause: Clause, beside: Snapshot | None) -> tuple[set[int], set[int]]:
        """Add a clause to the graph; return its first and last subtasks."""

    @abstractmethod
    def _spoken_to(self, text: str) -> str:
        """Take the names off the front of a text; they are spoken to from then on."""

    @abstractmethod
    def _doers(self, who: Who) -> list[str]:
        """Return the robots that a subject means."""

    @abstractmethod
    def _remember(self, clause: Clause) -> None:
        """Keep what was mentioned, for pronouns."""

    @abstractmethod
    def _lose(self, piece: str, words: int) -> None:
        """Count words that were not understood."""


class Reading(Struct):
    """What became of an instruction: the subtasks and how much of it was understood."""

    subtasks: tuple[Subtask, ...]
    confidence: float
    lost: tuple[str, ...]
    """Pieces that fit no pattern."""


class Parser(Conditions):
    """Reads one instruction."""

    def parse(self, instruction: str) -> Reading:
        """Read the whole instruction."""
        for sentence in sentences(instruction, self._quotes, self._names.sure.pattern):
            self._sentence(sentence)
        subtasks = self._graph.subtasks()
        labels = {each.robot for each in subtasks} | {
            name for each in subtasks for name in each.params.get("robots", ())
        }
        if "any1" in labels and "any2" not in labels:
            subtasks = tuple(renamed(each, "any1", "any") for each in subtasks)
        elif "any2" in labels and not labels & {"any", "any1"}:
            subtasks = tuple(renamed(each, "any2", "any") for each in subtasks)
        elif "any2" in labels and "any" in labels:
            subtasks = tuple(renamed(each, "any", "any1") for each in subtasks)
        confidence = max(0.0, 1.0 - self._lost / self._said) if self._said and subtasks else 0.0
        return Reading(subtasks, round(confidence, 3), tuple(self._pieces[:8]))

    # --- one sentence ---------------------------------------------------------------------------------------------

    def _sentence(self, text: str) -> None:
        words = len(text.split())
        self._said += words
        beside = False
        wait_all = False
        for _ in range(3):
            if match := LEAD_ALL.match(text):
                wait_all, text = True, text[match.end() :]
            elif match := LEAD_BESIDE.match(text):
                beside, text = True, text[match.end() :]
            elif match := LEAD_FIRST.match(text):
                text = text[match.end() :]
        if not text.strip(" ,.:"):
            return
        start = self._graph.new_sentence(parallel=beside)
        if wait_all:
            self._graph.barrier |= self._graph.lasts()
            self._graph.sentence.barrier = self._graph.barrier
        self._all_beside = beside and not self._graph.steps
        self._last = None
        text = self._spoken_to(text)
        if not text.strip(" ,.:"):
            return
        if (match := FILE.fullmatch(text)) and self._reader.starts(first_chunk(match["rest"])):
            self._source, text = match["file"], match["rest"]
        elif (
            (match := HEADING.fullmatch(text))
            and not PREFIX.match(text)
            and not self._reader.starts(text)
            and match["rest"]
        ):
            self._lost += len(match["head"].split())
            text = self._spoken_to(match["rest"])
        if re.search(r"\w first[.!]?$", text) and self._graph.steps:
            self._earlier(text)
            return
        text = self._trailing(text)
        if (match := PREFIX.fullmatch(text)) and self._prefixed(match["word"].lower(), match["rest"], start):
            return
        if self._leading_place(text, start):
            return
        self._clauses(text, start)

    def _spoken_to(self, text: str) -> str:
        """Take "Robot_1:", "A and B," off the front; they are spoken to until somebody else is."""
        match = re.match(r"(?:mission|task|plan|orders|list|job) for (?P<rest>.+)", text, re.IGNORECASE | re.DOTALL)
        body = match["rest"] if match else text
        if match := re.match(
            r"(?P<n>[A-Z][\w-]*(?: (?:\d+|[A-Z]))?)'s (?:list|tasks?|jobs?|orders)[^:]*:\s*(?P<rest>.+)",
            body,
            re.DOTALL,
        ):
            self._address([self._names.resolve(match["n"])])
            return match["rest"]
        if match := names.ALL.match(body) or names.SEVERAL.match(body):
            rest = body[match.end() :]
            if mark := re.match(r"(?:,? please)?\s*[:,]\s*", rest):
                groups = match.groupdict()
                if groups.get("n"):
                    robots = [f"any{index + 1}" for index in range(int(lx.number(groups["n"]) or 2))]
                else:
                    robots = self._names.everyone(groups.get("kind") or groups.get("plural") or "")
                self._address(robots)
                return rest[mark.end() :]
        found = self._names.leading(body)
        if found:
            robots, rest = found
            mark = re.match(r"\s*(?::|,|\s-)\s*", rest)
            if mark and rest[mark.end() :].strip() and (":" in mark[0] or self._follows(rest[mark.end() :])):
                self._address(list(dict.fromkeys(robots)))
                return re.sub(r"^(?:this is \w+[:,.]?\s*)", "", rest[mark.end() :])
            if mark is None and rest.strip(" .") == "":
                self._address(robots)
                return ""
        return text

    def _follows(self, text: str) -> bool:
        """Whether what stands after a name is said to it: it starts with a verb, or a politeness before one."""
        text = re.sub(r"^(?:this is \w+[:,.]?\s*)", "", text)
        if not text.strip():
            return True
        if (
            PREFIX.match(text)
            or LEAD_FIRST.match(text)
            or re.match(r"(?:at|in) (?!the same)|please|what|i\b|could|can|would", text, re.IGNORECASE)
        ):
            return True
        first = re.match(r"[A-Za-z']+", text)
        return bool(first and first[0].lower() in lx.LEMMA and not re.match(r"\w+(?:es|s)\b", first[0])) or bool(
            first and self._reader.starts(BETWEEN.split(text)[0] or text)
        )

    def _trailing(self, text: str) -> str:
        """Take a name off the end ("Inspect the pump, Heron") or the middle and speak to it."""
        for match in TRAILING.finditer(text):
            name = match["name"]
            sure = self._names.sure.fullmatch(name)
            if not sure and not (
                name[0].isupper() and name.split()[0].lower() not in names.NOT_NAMES and self._names.roster is None
            ):
                continue
            without = text[: match.start()] + text[match.end() :]
            if not sure and not self._reader.starts(text[: match.start()]):
                continue
            if re.search(r",\s*[A-Z]\w*|\b[A-Z]\w* and\b", text[: match.start()]) and not sure:
                continue
            self._address([self._names.resolve(name)])
            return without
        return text

    def _address(self, robots: list[str]) -> None:
        self._names.seen.update(robots)
        self._to = robots
        self._mention(robots)

    def _mention(self, robots: list[str]) -> None:
        mentions = self._reader.mentions
        mentions.robots = list(robots)
        if len(robots) > 1:
            mentions.group = list(robots)
        elif robots and robots[0] not in mentions.group and not robots[0].startswith("any"):
            mentions.group = [*mentions.group[-1:], *robots] if mentions.group else list(robots)

    def _leading_place(self, text: str, start: Snapshot | None) -> bool:
        """Read "at stations 3, 5 and 8, read the barcode": the rest once at each place."""
        match = re.match(
            r"(?:at|in|on|inside) (?P<p>.+?), (?P<rest>(?!and )[^,]*\b.*)", text, re.IGNORECASE | re.DOTALL
        )
        while match and not self._reader.starts(first_chunk(match["rest"])):
            match = re.match(
                rf"(?:at|in|on|inside) (?P<p>{re.escape(match['p'])}, .+?), (?P<rest>(?!and ).+)",
                text,
                re.IGNORECASE | re.DOTALL,
            )
        if match is None or self._reader.starts(match["p"]):
            return False
        if re.match(r"the (?:gateway|server|edge)\b", match["p"], re.IGNORECASE):
            self._clauses(match["rest"], start)
            return True
        for place in lx.things(match["p"]):
            where = self._reader.place(place)
            self._graph.add(self._doers(Who()), [Step("goto", {"place": where})], beside=start)
            self._reader.mentions.place = where
            self._clauses(match["rest"], None)
        return True

    # --- clauses and what stands between them -----------------------------------------------------------------------

    def _chunks(self, text: str) -> list[tuple[str, str]]:
        """Split a sentence into (connective, clause), where both sides of a connective are clauses."""
        found: list[tuple[str, str]] = []
        kind, begin, where = "list", 0, 0
        while match := BETWEEN.search(text, where):
            left, right = text[begin : match.start()], text[match.end() :]
            this = match.lastgroup or "list"
            this = "if" if this == "when" and match[0].split()[-1].lower() == "if" else this
            where = match.end()
            if not left.strip(" ,"):
                kind, begin = (this if this != "list" else kind), match.end()
                continue
            if this == "beside" and not right.strip(" ,."):
                continue
            if self._breaks(this, left, right):
                found.append((kind, left))
                kind, begin = this, match.end()
        found.append((kind, text[begin:]))
        return found

    def _breaks(self, kind: str, left: str, right: str) -> bool:
        head = first_chunk(right)
        clause = self._reader.read(left, speaking_to=self._to) or self._gapped(left, self._whole)
        readable = clause is not None or self._reader.starts(left)
        gapped = self._gapped(head, clause) if clause is not None else None
        gap = gapped is not None
        if clause is not None:
            self._whole = clause
        if kind in ("before", "after", "when", "if"):
            if re.search(r"\b(?:wait|until|till|waits)\b", left) and kind != "before":
                return False
            return readable and (
                self._reader.starts(head) or DONE.fullmatch(clean(right)) is not None or kind in ("when", "if")
            )
        if kind == "beside":
            return readable or self._reader.starts(head)
        if not readable:
            return False
        if self._reader.starts(head) or gap:
            return True
        if kind == "then" and (self._follows(right)):
            return True
        if kind == "list" and re.match(r"(?:once|when|after|before|while|if|as soon as)\b", right, re.IGNORECASE):
            return True
        match = BETWEEN.match(right) or None
        return match is not None and match.lastgroup != "list"

    def _gapped(self, text: str, previous: Clause | None) -> Clause | None:
        """Read "robot 3 pallet 62 at dock 5" after "robot 2 picks up pallet 61 at dock 4"."""
        if previous is None:
            return None
        if (match := re.match(r"(to|of|from|for) ", clean(text), re.IGNORECASE)) and previous.prefix.lower().endswith(
            " " + match[1].lower()
        ):
            clause = self._reader.read(f"{previous.prefix.rsplit(' ', 1)[0]} {clean(text)}", speaking_to=self._to)
            if clause is not None:
                clause.prefix = previous.prefix
            return clause
        if re.match(r"(?:the|an?) .+ (?:from|at|in|on|to|into|onto) ", clean(text), re.IGNORECASE):
            # "fetch the red box from dock 3 and the blue box from dock 1"
            clause = self._reader.read(f"{previous.prefix} {clean(text)}", speaking_to=self._to)
            skills = [step.skill for step in previous.steps]
            if clause and skills[-1] in ("pick", "place") and [step.skill for step in clause.steps] == skills:
                clause.prefix = previous.prefix
                return clause
            return None
        if previous.who.kind not in ("named", "one", "first", "other", "all", "the"):
            return None
        found = self._names.leading(clean(text))
        if found is None or len(found[0]) != 1 or not found[1].strip():
            return None
        rest = found[1].strip()
        if re.match(r"(?:that|those) (?:of|from) ", rest) and (quantity := previous.steps[-1].params.get("quantity")):
            rest = f"{quantity} {rest.split(None, 1)[1]}"
        prefix = previous.prefix
        # "drone_1 flies to mast 1 and drone_2 to mast 2": the preposition is said again.
        shorter = prefix.rsplit(" ", 1)[0]
        again = rest.split(None, 1)[0].lower() == prefix.rsplit(" ", 1)[-1].lower()
        for candidate in (shorter, prefix) if again else (prefix, shorter):
            clause = self._reader.read(f"{candidate} {rest}", speaking_to=found[0])
            if clause and [step.skill for step in clause.steps] == [step.skill for step in previous.steps]:
                clause.who = Who(found[0], "named")
                clause.prefix = prefix
                return clause
        return None

    def _clauses(self, text: str, start: Snapshot | None) -> None:
        sentence = self._graph.snapshot() if start is None else start
        pending: list[set[int]] = []
        chunks = self._chunks(text)
        told = False
        for index, (kind, piece) in enumerate(chunks):
            if told:
                told = False
                continue
            if kind in ("when", "if"):
                if halves := self._halves(piece):
                    self._condition(kind, halves[0])
                    self._clauses(halves[1], None)
                    continue
                if pending:
                    # All that follows belongs to the condition: "report once A has done X and B has done Y".
                    rest = " and ".join(each for _, each in chunks[index:])
                    self._late_condition(kind, rest, pending[-1], sentence)
                return
            if (
                kind == "list"
                and (match := PREFIX.fullmatch(piece.strip()))
                and self._prefixed(match["word"].lower(), match["rest"], None)
            ):
                continue
            said = self._spoken_to(piece.strip()) if kind != "list" or not pending or ":" in piece else piece
            clause = self._reader.read(said, speaking_to=self._to) or self._gapped(said, self._last)
            if clause is None:
                self._lose(said, len(said.split()))
                continue
            if [each for each, _ in chunks[index + 1 : index + 2]] == ["after"] and kind != "after":
                done = self._afterwards(kind, said, clause, chunks[index + 1][1], start if not pending else None)
                if done is not None:
                    pending.append(done)
                    told = True
                    continue
            self._lost += clause.lost
            fresh = not pending or clause.who.kind not in ("elided", "pronoun")
            how = "beside" if self._all_beside and pending and kind == "list" else kind
            firsts, ends = self._emit(how, clause, start if fresh else None)
            if kind == "after" and pending:
                self._graph.order(ends, pending[-1])
            pending.append(firsts)

    def _doers(self, who: Who) -> list[str]:
        """Return the robots that a subject means now."""
        mentions = self._reader.mentions
        if who.kind in ("named", "all", "several", "the"):
            return who.robots
        if who.kind == "one":
            return ["any"]
        if who.kind == "first":
            return [mentions.group[0]] if mentions.group else ["any1"]
        if who.kind == "other":
            rest = [name for name in (self._names.roster or mentions.group) if name not in mentions.robots]
            return rest[:1] if len(rest) == 1 else ["any2"]
        if who.kind == "pronoun":
            return mentions.robots or self._to
        return self._to

    def _emit(self, kind: str, clause: Clause, beside: Snapshot | None) -> tuple[set[int], set[int]]:
        graph = self._graph
        assigned = [step.params["_robot"] for step in clause.steps if "_robot" in step.params]
        robots = assigned or self._doers(clause.who)
        explicit = clause.who.kind not in ("elided", "pronoun")
        computes = all(graph.catalogue.skills[step.skill].runs == "compute" for step in clause.steps)
        if kind in ("then", "before") and (explicit or computes) and graph.scope:
            graph.barrier |= graph.lasts(graph.scope)
        if kind in ("beside", "after"):
            if explicit and robots != self._to:
                beside = Snapshot(
                    {name: tail for name, tail in graph.tails.items() if not set(tail) & graph.scope},
                    frozenset(),
                    graph.barrier,
                )
                graph.scope = set()
            else:
                beside = graph.previous
        if explicit and robots != self._to:
            graph.thread = graph.thread if kind == "then" else frozenset()
        if self._source:
            clause.steps[0].params = self._with_source(clause.steps[0])
        firsts, ends = graph.add(list(robots), clause.steps, beside=beside)
        if explicit:
            self._names.seen.update(robots)
            self._to = list(robots)
        if not computes or explicit:
            self._mention(list(robots))
        if clause.who.kind in ("first", "other", "one", "several"):
            self._mention(list(robots))
        self._remember(clause)
        self._last = clause
        return firsts, ends

    def _with_source(self, step: Step) -> dict[str, Any]:
        manifest = self._graph.catalogue.skills.get(step.skill)
        source, self._source = self._source, ""
        return {"source": source, **step.params} if manifest and "source" in manifest.params else step.params

    def _remember(self, clause: Clause) -> None:
        mentions = self._reader.mentions
        for step in clause.steps:
            manifest = self._graph.catalogue.skills[step.skill]
            for key in ("object", "target", "asset", "source"):
                if value := step.params.get(key):
                    mentions.thing = str(value)
            if "load" in manifest.ties or step.fetch:
                mentions.held = str(step.params.get("object", ""))
            if "load" in manifest.frees:
                mentions.held = ""
            for key in ("place", "area", "station"):
                if value := step.params.get(key):
                    mentions.place = str(value)
                    if step.skill == "goto":
                        mentions.thing = str(value)
            if step.at:
                mentions.place = step.at
            if (to := step.params.get("to")) and step.skill in ("give", "say", "ask", "notify", "report"):
                mentions.person = str(to)
            if model := step.params.get("model"):
                mentions.model = str(model)

    def _lose(self, piece: str, words: int) -> None:
        said = self._reader.unquote(" ".join(piece.split())).strip(" ,.:;")
        bare = lx.FILLER.sub("", said).strip(" ,.:;")
        if bare:
            self._pieces.append(said)
            self._lost += words
