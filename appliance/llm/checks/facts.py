"""What a check of a plan may look at: the plan, its context, and which words it accounts for. Pure.

A plan is aligned with the tokens of its instruction: values of parameters with the words that say them, numbers with
their units, skills with the phrases of their manifests, robots with their mentions. What is left over is what the plan
does not do; a subtask without words is what nobody asked for. The alignment uses no model and no planner's output but
the plan itself.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property

from msgspec import Struct

from appliance.llm.checks import lexicon as lx
from appliance.llm.checks.consistency import precedes
from appliance.llm.checks.places import coordinate
from appliance.llm.checks.reading import Reading, Token, read, stem
from appliance.llm.settings import PlanContext, SafetyConfig
from appliance.llm.values import FREE, figures, quantity, unit_of
from appliance.llm.words import forms
from appliance.model import Plan, Site, Subtask
from appliance.skills.catalogue import Catalogue, SkillManifest

ARTICLES = frozenset(
    ("the", "a", "an", "my", "our", "your", "its", "his", "her", "their", "some", "of", "that", "this")
)
_GAP = 5
"""Tokens that may stand between a verb and its particle: "pick the big red box up"."""
_PARTICLES = frozenset(
    ("up", "down", "on", "off", "out", "back", "away", "over", "in", "together", "around", "for", "to", "at", "know")
)
_PARAM_WORDS = {
    "laps": ("lap", "laps", "times", "round", "rounds", "circuit", "circuits", "loop", "loops"),
    "count": ("times", "shots", "pictures", "photos"),
    "altitude_m": ("altitude", "height", "high", "up", "above", "ground", "to", "climb", "rise"),
    "radius_m": ("radius", "distance", "away", "diameter"),
    "speed_mps": ("speed", "velocity", "at"),
    "duration_s": ("for", "during", "lasting", "long"),
    "timeout_s": ("for", "within", "at", "most", "maximum", "up", "to", "limit", "timeout", "than", "longer", "no"),
    "fps": ("fps", "frames", "per", "second", "rate"),
    "window_ms": ("window",),
    "epochs": ("epoch", "epochs"),
    "place": (
        *("coordinates", "coordinate", "position", "point", "x", "y", "z", "location", "spot"),
        *("metres", "meters", "m"),
    ),
    "path": ("path", "route", "along", "via", "through"),
}  # fmt: skip
"""Words that come with a parameter and say nothing else."""
_BLANK = frozenset((",", "-", "–", "(", ")", "and", ":", "="))


_WAITED = frozenset(("until", "till", "once", "when", "after", "if", "that", "for"))
"""Words before what is waited for."""


class Claim(Struct, frozen=True):
    """A phrase of the instruction that asks for skills."""

    at: tuple[int, ...]
    """Indices of its tokens."""
    text: str
    skills: frozenset[str]


class Account(Struct, kw_only=True):
    """The alignment of a plan with its instruction."""

    covered: set[int]
    """Indices of tokens that the plan accounts for."""
    evidence: dict[str, set[int]]
    """Subtask -> indices of the tokens that ask for it: its phrase, its values, its numbers."""
    called: dict[str, set[int]]
    """Subtask -> indices of tokens of phrases that call for its skill."""
    values: dict[str, set[int]]
    """Subtask -> indices of tokens that say its values."""
    unsaid: list[tuple[str, str, str]]
    """Values that no words say: subtask, parameter, value."""
    unclaimed: list[Claim]
    """Phrases that ask for skills the plan does not have."""


def account(reading: Reading, plan: Plan, catalogue: Catalogue, site: Site | None) -> Account:
    """Align a plan with its instruction."""
    found = Account(
        covered={number for number, each in enumerate(reading.tokens) if each.kind == "robot"},
        evidence={each.id: set() for each in plan.subtasks},
        called={each.id: set() for each in plan.subtasks},
        values={each.id: set() for each in plan.subtasks},
        unsaid=[],
        unclaimed=[],
    )
    for subtask in plan.subtasks:
        for name, value in subtask.params.items():
            if name == "robots":
                continue
            said = robot_said(reading, value, subtask.skill, catalogue) if isinstance(value, str) else None
            said = said or _said(reading, name, value, site)
            if said and name not in FREE and not isinstance(value, int | float):
                # A name that swallows "unless" or "then" has not accounted for it.
                said = {index for index in said if reading.tokens[index].text not in lx.GUARDS}
                if any(_counts(reading, index) for index in said):
                    said = None  # "the aisle three times" is no aisle 3
            if said:
                found.values[subtask.id] |= said
                found.covered |= said
            elif said is None:
                found.unsaid.append((subtask.id, name, str(value)))
    _heads(reading, plan, found)
    for subtask in plan.subtasks:
        _param_words(reading, subtask, found, names=("place",))
    _phrases(reading, plan, catalogue, found)
    for subtask in plan.subtasks:
        # "until Eva confirms", "when the doorbell rings": what is waited for follows the word that says so.
        first = min(found.values[subtask.id], default=0)
        if "event" in subtask.params and first and reading.tokens[first - 1].text in _WAITED:
            found.called[subtask.id].add(first - 1)
            found.covered.add(first - 1)
    for subtask in plan.subtasks:
        found.evidence[subtask.id] = found.called[subtask.id] | found.values[subtask.id]
    for subtask in plan.subtasks:
        _param_words(reading, subtask, found)
    return found


def _counts(reading: Reading, index: int) -> bool:
    """Whether a number says how often or how much: "three times", "2 laps", "5 m"."""
    tokens = reading.tokens
    after = tokens[index + 1].text if index + 1 < len(tokens) else ""
    return tokens[index].value is not None and (
        after in ("times", "laps", "rounds") or after in lx.UNITS - {"m", "s", "h", "min"}
    )


# --- values --------------------------------------------------------------------------------------------------------


def _said(reading: Reading, name: str, value: object, site: Site | None) -> set[int] | None:
    """The tokens that say a value; None when none do, empty when it needs none."""
    if isinstance(value, bool) or value is None:
        return set()
    if isinstance(value, int | float):
        unit = unit_of(name)
        return _kept(reading, ("number", repr(value), unit), lambda: number_said(reading, value, unit))
    if isinstance(value, list | tuple):
        found: set[int] = set()
        for each in value:  # pyright: ignore[reportUnknownVariableType]
            said = _text(reading, str(each), site)  # pyright: ignore[reportUnknownArgumentType]
            if said is None:
                return None
            found |= said
        return found
    text = str(value)
    if name in FREE:
        return _kept(reading, ("free", text, ""), lambda: free_said(reading, text))
    return _text(reading, text, site)


def _text(reading: Reading, text: str, site: Site | None) -> set[int] | None:
    return _kept(reading, ("text", text, str(id(site))), lambda: text_said(reading, text, site))


def _kept(reading: Reading, key: tuple[str, str, str], find: Callable[[], set[int] | None]) -> set[int] | None:
    """What was found before for another plan of the same words, else what is found now."""
    if key not in reading.memo:
        found = find()
        reading.memo[key] = None if found is None else frozenset(found)
    kept = reading.memo[key]
    return None if kept is None else set(kept)


def number_said(reading: Reading, value: float, unit: str) -> set[int] | None:
    """Return the tokens of a quantity with its unit, all of its mentions; None when it is not said."""
    tokens = reading.tokens
    found: set[int] = set()
    at = 0
    while at < len(tokens):
        best = 0
        # "-1 m/s" is no 1 m/s.
        if _starts_quantity(tokens[at]) and (tokens[at].value or 0) >= 0:
            for length in range(1, 8):
                window = tokens[at : at + length]
                if (
                    not all(_of_quantity(each) for each in window)
                    or len(window) < length
                    or any(each.kind in ("quote", "robot") or each.text in _ENDS for each in window)
                ):
                    break
                if not (_ends_quantity(window[-1]) if unit else _ends_number(window[-1])):
                    continue
                if unit == "mps" and not any(each.text in _PER for each in window):
                    continue  # "a metre at a time" is no speed
                said = quantity(reading.text[window[0].start : window[-1].end], unit)
                if said is not None and abs(float(said) - value) <= 1e-3 * max(1.0, abs(value)):
                    best = length
        scaled = at + best < len(tokens) and tokens[at + best].text in ("times", "time") and unit
        if best and not scaled and not _goes_on(tokens, at + best):  # "four times as high" is no 4 m
            found.update(range(at, at + best))
        at += max(1, best)
    return found or None


def _goes_on(tokens: Sequence[Token], index: int) -> bool:
    """Whether a number in words goes on: "thirty one" is no 30."""
    if not 0 < index < len(tokens):
        return False
    tens, ones = tokens[index - 1], tokens[index]
    return (
        tens.text.endswith("ty")
        and tens.value is not None
        and ones.value is not None
        and ones.text.isalpha()
        and 1 <= ones.value <= 9
    )


_PER = frozenset(("/", "per", "mps", "mph", "kmh", "kph", "knot", "knots"))
"""What makes a figure a speed."""
_ENDS = frozenset((";", "?", "!", "\n", ","))


def _of_quantity(token: Token) -> bool:
    """Whether a token may be part of a quantity: "a million" is no 1."""
    return (
        _starts_quantity(token)
        or token.text in lx.UNITS
        or token.text
        in ("times", "time", "quarters", "dozen", "hundred", "thousand", "and", "of", "per", "-", "/", "more")
    )


def _ends_number(token: Token) -> bool:
    return _starts_quantity(token) or token.text in ("times", "time")


def _ends_quantity(token: Token) -> bool:
    return _starts_quantity(token) or token.text in lx.UNITS or token.text in ("quarters", "dozen")


def _starts_quantity(token: Token) -> bool:
    return token.value is not None or token.text in (
        "a", "an", "half", "quarter", "once", "twice", "thrice", "single", "couple", "pair", "both", "three", "hundred",
        "another", "½", "¼", "¾",
    )  # fmt: skip


def free_said(reading: Reading, text: str) -> set[int] | None:
    """Return the tokens of a free text: a quotation, or a run of words as it stands."""
    wanted = re.findall(r"\w+", text.casefold())
    if not wanted:
        return set()
    for number, token in enumerate(reading.tokens):
        if token.kind == "quote" and re.findall(r"\w+", token.text) == wanted:
            return {number}
    # What stands in quotation marks is one text: no part of it is taken together with words outside.
    flat: list[tuple[str, int]] = [
        (word, number)
        for number, token in enumerate(reading.tokens)
        for word in (re.findall(r"\w+", token.text) if token.kind != "quote" else ("\0",))
    ]
    text_words = [word for word, _ in flat]
    for start in range(len(flat) - len(wanted) + 1):
        if all(_same(one, two) for one, two in zip(text_words[start : start + len(wanted)], wanted, strict=True)):
            return {number for _, number in flat[start : start + len(wanted)]}
    return None


def text_said(reading: Reading, text: str, site: Site | None = None) -> set[int] | None:
    """Return the tokens that say a name or coordinate, all of its mentions; None when they do not."""
    if coordinate(text) is not None:
        return _point_said(reading, text)
    names = [text]
    place = site.find(text) if site is not None else None
    if site is not None and place is not None:
        names += [key for key, each in site.places.items() if each is place]
        names += place.aliases
    found: set[int] = set()
    for name in dict.fromkeys(names):
        found |= _spans(reading, _words(name))
    if found:
        return found
    return _scattered(reading, _words(text))


def robot_said(reading: Reading, text: str, skill: str, catalogue: Catalogue) -> set[int] | None:
    """Return the mentions of a robot to which a skill is done ("drone_1 tracks rover_2"); None where there is none.

    A phrase of the skill or a preposition stands before them. All others may be of the one that does something:
    "drone_1 tracks rover_2, then send rover_2 to dock 1".
    """
    tokens = reading.tokens
    named = [
        number
        for number, token in enumerate(tokens)
        if number and token.kind == "robot" and token.group == "one" and token.robots == (text,)
    ]
    if not named:
        return None
    verbs = {
        at
        for options in claims(reading, catalogue)
        for claim in options
        if skill in claim.skills and skill not in _ways(catalogue)
        for at in claim.at
    }
    found: set[int] = set()
    for number in named:
        before = number - 1
        while before > 0 and tokens[before].text in ("the", "our", "my"):
            before -= 1
        if before in verbs or tokens[before].text in _NOT_SUBJECT or tokens[before].text in _TOWARDS:
            found.add(number)
    return found or None


_TOWARDS = frozenset(("of", "on", "onto", "into", "about", "against"))
"""Further prepositions before a robot to which something is done: "a photo of rover_2"."""


def _point_said(reading: Reading, text: str) -> set[int] | None:
    """The tokens of a coordinate: its numbers one after the other, with nothing but marks and units between."""
    wanted = [float(each.replace("−", "-")) for each in re.findall(r"[-−]?\d+(?:\.\d+)?", text)]
    tokens = reading.tokens
    for start in range(len(tokens)):
        index, run = start, list[int]()
        for number in wanted:
            while run and index < len(tokens) and (tokens[index].text in _BLANK or tokens[index].text in _AXES):
                run.append(index)
                index += 1
            if index >= len(tokens) or tokens[index].kind != "number" or tokens[index].value != number:
                run = []
                break
            run.append(index)
            index += 1
        if run:
            return set(run)
    return None


_AXES = frozenset(("x", "y", "z", "m", "metres", "meters", ";"))
"""What may stand between the numbers of a coordinate."""


def _words(text: str) -> list[str]:
    words: list[str] = re.findall(r"[-−]?\d+(?:[.,]\d+)*|[^\W\d_]+(?:'[^\W\d_]+)*", figures(text.casefold()))
    last = len(words) - 1  # "rack a": a label, no article
    return [each.removesuffix("'s") for at, each in enumerate(words) if each not in ARTICLES or at == last]


def _same(said: str, wanted: str) -> bool:
    if said == wanted or stem(said) == stem(wanted):
        return True
    return said.removesuffix("'s") == wanted


def _equal(token: Token, wanted: str) -> bool:
    if token.kind in ("number", "word") and token.value is not None and wanted[-1].isdigit():
        try:
            return token.value == float(wanted.replace(",", "").replace("−", "-"))
        except ValueError:
            return False
    if token.kind == "robot":
        return wanted.isalpha() and wanted in re.findall(r"[^\W\d_]+", token.text)
    return _same(token.text, wanted)


def _spans(reading: Reading, wanted: Sequence[str]) -> set[int]:
    """All runs of tokens that say these words in this order, articles and joining marks between them passed over."""
    tokens = reading.tokens
    found: set[int] = set()
    if not wanted:
        return found
    for start in range(len(tokens)):
        index, run = start, list[int]()
        for number, word in enumerate(wanted):
            while (
                number
                and index < len(tokens)
                and (
                    tokens[index].text in ARTICLES
                    or tokens[index].text in _BLANK
                    or tokens[index].text in ("_", "/", ".")
                )
                and not _equal(tokens[index], word)
            ):
                run.append(index)
                index += 1
            if index >= len(tokens) or not _equal(tokens[index], word):
                run = []
                break
            run.append(index)
            index += 1
        found.update(run)
    return found


def _scattered(reading: Reading, wanted: Sequence[str]) -> set[int] | None:
    """Tokens that say each of these words somewhere ("stations 3, 5 and 8", "the box that is red")."""
    found: set[int] = set()
    for word in wanted:
        at = {number for number, token in enumerate(reading.tokens) if token.kind != "quote" and _equal(token, word)}
        if not at:
            return None
        found |= at
    return found or None


def _heads(reading: Reading, plan: Plan, found: Account) -> None:
    """Cover a thing that is spoken of again by its noun alone: "the blue box ... as soon as the box is there"."""
    heads = {
        words[-1] for each in plan.subtasks for value in each.params.values()
        if isinstance(value, str) and len(words := _words(value)) > 1 and words[-1].isalpha()
    }  # fmt: skip
    for number, token in enumerate(reading.tokens):
        if (
            number
            and token.kind == "word"
            and token.text in heads
            and reading.tokens[number - 1].text in ("the", "that")
        ):
            found.covered.add(number)


# --- skills --------------------------------------------------------------------------------------------------------


def phrase_table(catalogue: Catalogue) -> Mapping[str, tuple[tuple[tuple[str, ...], frozenset[str]], ...]]:
    """Return first word in any form -> phrases (words, skills), longest first, of all manifests of a catalogue."""
    key = id(catalogue.skills)
    kept = _TABLES.get(key)
    if kept is not None and kept[0] is catalogue.skills:
        return kept[1]
    skills: dict[tuple[str, ...], set[str]] = {}
    for manifest in catalogue.skills.values():
        for phrase in manifest.phrases:
            skills.setdefault(tuple(phrase.split()), set()).add(manifest.id)
    table: dict[str, list[tuple[tuple[str, ...], frozenset[str]]]] = {}
    for words, asked in sorted(skills.items(), key=lambda pair: -len(pair[0])):
        for form in forms(words[0]):
            table.setdefault(form, []).append((words, frozenset(asked)))
    made = {form: tuple(each) for form, each in table.items()}
    _TABLES[key] = (catalogue.skills, made)
    while len(_TABLES) > 8:
        _TABLES.pop(next(iter(_TABLES)))
    return made


_TABLES: dict[
    int, tuple[dict[str, SkillManifest], Mapping[str, tuple[tuple[tuple[str, ...], frozenset[str]], ...]]]
] = {}


def claims(reading: Reading, catalogue: Catalogue, *, taken: Iterable[int] = ()) -> list[list[Claim]]:
    """Return for each token that may begin a phrase its phrases, the likeliest first; `taken` are no verbs."""
    table = phrase_table(catalogue)
    tokens = reading.tokens
    kept = set(taken)
    found: list[list[Claim]] = []
    for start, token in enumerate(tokens):
        if token.kind != "word" or start in kept:
            continue
        options: list[Claim] = []
        for words, skills in table.get(token.text, ()):
            at = _phrase_at(reading, start, words, kept)
            # "take drone_1 to the gate": a robot that is brought somewhere goes there itself.
            robot = start + 1 < len(tokens) and tokens[start + 1].kind == "robot"
            brought = robot and token.text not in _EMPTIES and _carries(skills, catalogue)
            if at:
                text = " ".join(tokens[index].text for index in at)
                options.append(Claim(at, text, skills | _ways(catalogue) if brought else skills))
        if options:
            found.append(options)
    return found


_EMPTIES = frozenset(("unload", "unloads", "offload", "load", "loads", "empty", "drop", "release", "leave"))
"""Verbs of handling whose object stays where it is, or is no robot: "unload the truck"."""


def _ways(catalogue: Catalogue) -> frozenset[str]:
    """The skills by which a robot goes somewhere on behalf of others."""
    return frozenset(
        each.id for each in catalogue.skills.values() if each.moves_robot and each.incidental and not each.flying
    )


def _carries(skills: Iterable[str], catalogue: Catalogue) -> bool:
    return any("load" in (*catalogue.skills[each].ties, *catalogue.skills[each].frees) for each in skills)


def _phrase_at(reading: Reading, start: int, words: Sequence[str], taken: set[int]) -> tuple[int, ...]:
    """The tokens of a phrase that begins at `start`; a last particle may stand behind its object."""
    tokens = reading.tokens
    at = [start]
    index = start + 1
    for word in words[1:]:
        if word in ("a", "an", "the"):
            continue
        while (
            index < len(tokens)
            and (tokens[index].text in ARTICLES or tokens[index].value is not None or tokens[index].kind == "robot")
            and tokens[index].text != word
        ):
            index += 1
        if index < len(tokens) and (tokens[index].text == word or stem(tokens[index].text) == stem(word)):
            at.append(index)
            index += 1
            continue
        if word in _PARTICLES and word == words[-1]:
            for further in range(index, min(len(tokens), index + _GAP)):
                each = tokens[further]
                if (
                    each.kind == "mark"
                    or reading.sentence[further] != reading.sentence[start]
                    or each.text in ("and", "then")
                ):
                    break
                if each.text == word and further not in taken:
                    return (*at, further)
        return ()
    return tuple(at)


def _phrases(reading: Reading, plan: Plan, catalogue: Catalogue, found: Account) -> None:
    planned = {each.skill for each in plan.subtasks}
    # Words that say a value are no verbs: "dock 1" asks for no docking. But a value that is also the only verb is one:
    # "photograph the photograph" is rare, "dock at the dock" is not, so only whole values are left out.
    inside = set[int]().union(*found.values.values()) if found.values else set[int]()
    used: set[int] = set()
    pending: list[list[Claim]] = []
    for options in claims(reading, catalogue, taken=inside):
        start = options[0].at[0]
        if start in used or (start and reading.tokens[start - 1].text == "the"):
            continue  # "the dock" is a thing
        state = [each for each in options if reading.tokens[start].text == each.text]
        if state and start and reading.tokens[start - 1].text in ("is", "are", "is:") and state[0].skills & planned:
            found.covered.add(start)  # "once it is open": how a thing is then, and no order
            continue
        longest = max((_weight(each.text) for each in options if _joined(each)), default=0)
        fitting = [
            each for each in options if each.skills & planned and (_weight(each.text) >= longest or not _joined(each))
        ]
        if fitting:
            best = max(fitting, key=lambda each: len(each.at))
            skills = frozenset[str]().union(*(each.skills for each in fitting))
            for subtask in plan.subtasks:
                if subtask.skill in skills:
                    found.called[subtask.id] |= set(best.at)
            found.covered |= set(best.at)
            used |= set(best.at)
        else:
            pending.append(options)
    for options in pending:
        lost = {index for each in found.unclaimed for index in each.at}
        left = [each for each in options if not set(each.at) & (found.covered | lost)]
        if left:
            found.unclaimed.append(max(left, key=lambda each: len(each.at)))


def _joined(claim: Claim) -> bool:
    """Whether the tokens of a phrase stand together."""
    return claim.at[-1] - claim.at[0] < len(claim.at) + 1


def _weight(text: str) -> int:
    """How many words of a phrase tell: "wait for" is no more telling than "wait", "put down" is than "put"."""
    return sum(word not in _WEAK for word in text.split()) or 1


_WEAK = frozenset(("for", "at", "to", "in", "the", "a", "an", "of", "into", "with"))


def _param_words(reading: Reading, subtask: Subtask, found: Account, *, names: Iterable[str] | None = None) -> None:
    """Cover the words that come with a parameter next to its value: "for", "laps", "at a height of"."""
    said = found.values[subtask.id]
    for name in subtask.params if names is None else names:
        words = _PARAM_WORDS.get(name, ()) if name in subtask.params else ()
        for number, token in enumerate(reading.tokens):
            near = _beside if name == "place" else _near
            if token.text in words and number not in found.covered and near(number, said, reading):
                found.covered.add(number)


def _near(index: int, said: set[int], reading: Reading) -> bool:
    return any(abs(each - index) <= 4 and reading.sentence[each] == reading.sentence[index] for each in said)


def _beside(index: int, said: set[int], reading: Reading) -> bool:
    """Whether nothing but marks, articles and such words stand between a word of a place and the place itself."""
    between = ARTICLES | _BLANK | _AXES | frozenset((*_PARAM_WORDS["place"], "at", "to", "is"))
    for step in (1, -1):
        at = index + step
        while 0 <= at < len(reading.tokens) and abs(at - index) <= _GAP:
            if at in said:
                return True
            if reading.tokens[at].text not in between:
                break
            at += step
    return False


_NOT_SUBJECT = frozenset(
    (
        "to",
        "follow",
        "follows",
        "following",
        "towards",
        "toward",
        "behind",
        "beside",
        "near",
        "from",
        "at",
        "meet",
        "around",
    )
)
"""Words before a robot that is no subject: "give the box to rover_2"."""
_AND = frozenset((",", "and", "&", "plus"))


def _governors(reading: Reading, found: Account) -> list[frozenset[str]]:
    """For each token the robots that may be its subject; empty where none was named."""
    tokens = reading.tokens
    values = set[int]().union(*found.values.values()) if found.values else set[int]()
    subjects: list[tuple[int, int, frozenset[str]]] = []
    number = 0
    while number < len(tokens):
        if not _subject(tokens, number, values):
            number += 1
            continue
        first, last, robots = number, number, set(tokens[number].robots)
        while True:
            step = last + 1
            while step < len(tokens) and tokens[step].text in _AND:
                step += 1
            if step == last + 1 or step >= len(tokens) or tokens[step].kind != "robot" or step in values:
                break
            robots |= set(tokens[step].robots)
            last = step
        subjects.append((first, last, frozenset(robots)))
        number = last + 1
    governs: list[frozenset[str]] = []
    for index in range(len(tokens)):
        earlier = [robots for _, last, robots in subjects if last <= index]
        sentence = reading.sentence[index]
        later = [
            (first, robots) for first, _, robots in subjects if first > index and reading.sentence[first] == sentence
        ]
        meant = set(earlier[-1]) if earlier else set[str]()
        if later and (not earlier or _trails(tokens, later[0][0])):
            meant |= later[0][1]
        governs.append(frozenset(meant))
    return governs


def _subject(tokens: tuple[Token, ...], number: int, values: set[int]) -> bool:
    if tokens[number].kind != "robot" or number in values or not tokens[number].robots:
        return False
    if tokens[number].group == "any":
        return False  # "could somebody fetch it": one of them, and not each
    before = number - 1
    while before >= 0 and tokens[before].text in ("the", "our", "my"):
        before -= 1
    return before < 0 or tokens[before].text not in _NOT_SUBJECT


def _trails(tokens: tuple[Token, ...], first: int) -> bool:
    """Whether a mention names who does what stands before it: at the end of its sentence, or after "with"."""
    if first and tokens[first - 1].text in ("with", "using", "by", "via"):
        return True
    after = tokens[first + 1].text if first + 1 < len(tokens) else "."
    return after in (".", "!", "?", ";", "\n")


class Facts:
    """A plan with everything that bears on it; what is derived is worked out once, when a check first asks.

    Args:
        plan: one of a form that decodes.
        context: the words, the roster, the site, who asks.
        catalogue: the skills there are.
        safety: the operator's policy.
        require_implemented: whether skills need a handler.
        edited: whether a person or a robot wrote the plan: the words then only give notes.
        confidence: how sure the planner is, 0 to 1.
        run_from: the confidence from which a plan runs unasked.
        added: ids of ways that the site made necessary (`completion`): no words ask for them.
    """

    def __init__(
        self,
        plan: Plan,
        context: PlanContext,
        catalogue: Catalogue,
        safety: SafetyConfig,
        *,
        require_implemented: bool = False,
        edited: bool = False,
        confidence: float = 1.0,
        run_from: float = 0.0,
        added: frozenset[str] = frozenset(),
    ) -> None:
        self.plan = plan
        self.context = context
        self.instruction = context.instruction
        self.robots = context.robots
        self.site = context.site
        self.continued = context.so_far is not None
        self.catalogue = catalogue
        self.safety = safety
        self.require_implemented = require_implemented
        self.edited = edited
        self.confidence = confidence
        self.run_from = run_from
        self.added = added

    @cached_property
    def reading(self) -> Reading:
        """The instruction, read."""
        names: list[str] = []
        for each in self.plan.subtasks:
            listed: object = each.params.get("robots")
            names += [str(name) for name in listed] if isinstance(listed, list | tuple) else []  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
            names += [each.robot] if each.robot else []
        return read(self.instruction, self.robots, names, self.site)

    @cached_property
    def account(self) -> Account:
        """The plan, aligned with the words."""
        return account(self.reading, self.plan, self.catalogue, self.site)

    @cached_property
    def governors(self) -> list[frozenset[str]]:
        """For each token the robots that may be its subject; empty where none was named."""
        return _governors(self.reading, self.account)

    @cached_property
    def before(self) -> dict[str, set[str]]:
        """For each subtask all that come before it, directly or not."""
        return precedes(self.plan)

    def manifest(self, subtask: Subtask) -> SkillManifest | None:
        """Return the manifest of a subtask's skill."""
        return self.catalogue.skills.get(subtask.skill)

    def words(self, indices: Sequence[int]) -> str:
        """Return tokens as they stand in the text, without what lies between distant ones."""
        tokens = self.reading.tokens
        parts: list[str] = []
        last = -2
        for index in sorted(indices):
            text = self.reading.text[tokens[index].start : tokens[index].end]
            if index == last + 1 and parts:
                parts[-1] += self.reading.text[tokens[last].end : tokens[index].end]
            else:
                parts.append(text)
            last = index
        return " … ".join(" ".join(each.split()) for each in parts)
