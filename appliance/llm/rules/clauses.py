"""One clause: who, what, how much. Reads it without changing anything, so that a reading can be tried and dropped.

A clause is `subject? auxiliary* verb rest`. The subject may be a robot's name, a group, "a robot" or nothing (the one
spoken to); the verb may stand in any form, the passive included.
"""

import re
from typing import Any

from msgspec import Struct, field

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules import modifiers, names
from appliance.llm.rules.added import AddedSkills
from appliance.llm.rules.grammar import steps_of
from appliance.llm.rules.graph import Mentions
from appliance.llm.rules.phrases import PICTURES, Step
from appliance.skills.catalogue import Catalogue

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
    """The subject: robots, or `[]` for whoever was spoken to last. `kind` says how it was put."""

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
        rest, quantities = modifiers.take(tail, altitude=lifted)
        return self._match(lemma, rest, quantities)

    def _by_phrase(self, text: str) -> tuple[list[Step], str, float, dict[str, Any]] | None:
        """Read a clause by the phrases of skills that are not built in."""
        rest, quantities = modifiers.take(text, altitude=False)
        if (step := self._added.step(rest, self)) is None:
            return None
        return [step], "", self._give_quantities([step], quantities) + self._doubt([step]), quantities.values

    def _nominal(self, text: str) -> tuple[list[Step], str, float, dict[str, Any]] | None:
        """Read "three photos of the stage", "thermal scan of X", "frames at 12 fps"."""
        rest, quantities = modifiers.take(text, altitude=False)
        low = rest.lower()
        if re.match(rf"(?:{lx.NUMBER} )?(?:\w+ )?{PICTURES} of ", low):
            return self._match("take", rest, quantities)
        if match := re.match(r"(?:an? )?thermal scans?(?: of|,|:)? (?P<t>.+)", rest, re.IGNORECASE):
            return self._match("take", f"thermal scan of {match['t']}", quantities)
        if re.match(r"(?:the )?(?:audio pre-?processing|transcription|frame extraction)$", low):
            return self._match("run", rest, quantities)
        return None

    def _match(
        self, lemma: str, rest: str, quantities: modifiers.Modifiers
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

    def _give_quantities(self, steps: list[Step], quantities: modifiers.Modifiers) -> float:
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
        rest, quantities = modifiers.take(f"{match['what']}{match['rest']}", altitude=False)
        found = self._match(lemma, rest, quantities)
        return Clause(Who(), found[0], found[1], words, found[2], found[3]) if found else None
