"""Puts orders in other frames: what is worked on first, robots told of or named behind, places first.

The words that the plan points at stay, so what a frame means under the rules of plans follows from where it stands
alone (`frames.toml`).
"""

import random
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from workshop.train.examples import DETERMINERS, ROBOT, Example, Span, inserted, pointed, spans, substitute
from workshop.train.lexicon import Lexicon
from workshop.train.linking import MAX_SUBTASKS, is_a_clause, robots_of, subtasks_of, then_linked, unended
from workshop.train.renaming import renamed
from workshop.train.reword import going_on

_FRAMES: dict[str, list[str]] = tomllib.loads(Path(__file__).with_name("frames.toml").read_text(encoding="utf-8"))
_IRREGULAR = {
    **{each: each for each in ("read", "put", "set", "cut", "shut")},
    "find": "found",
    "bring": "brought",
    "take": "taken",
    "lead": "led",
    "lay": "laid",
    "sweep": "swept",
    "undo": "undone",
    "get": "got",
    "mow": "mown",
    "patrol": "patrolled",
    "scan": "scanned",
}
_VERBS = {tuple(each.split()) for each in _FRAMES["verbs"]}
_STARTS = frozenset({each[0] for each in _VERBS} | set(_FRAMES["starts"]))
_WORKED_ON = frozenset({"object", "asset", "target", "area", "person", "model", "dataset", "quantity"})
_BEGINNINGS = frozenset({".", ";", "!", ":"})
"""Behind these a sentence begins; behind the others an order does."""
_BEFORE = _BEGINNINGS | {"then", "and", "please"}
_BEHIND = frozenset(
    {".", ";", "!", "(", "then", "from", "at", "in", "on", "with", "to", "for", "into", "onto", "inside", "near"}
    | {"by", "twice", "before", "after", "once", "when", "please"}
)
_PLACED = frozenset({"at", "in", "on", "from", "to", "into", "inside", "near", "behind", "under", "with", "for"})
_WHERE = frozenset({"place", "at", "area", "to", "into", "person"})
_ALONE = frozenset(
    {"guide", "follow", "handover", "give", "rendezvous", "form_up", "lift_together", "split_area", "takeoff", "land"}
)
"""Skills that one does not do with several in turn, or that are for several robots."""


def framed(example: Example, lexicon: Lexicon, rng: random.Random, *, share: float = 0.5) -> Example:
    """Return an order in which what is worked on is said before the work, here and there; any other as it is.

    Args:
        example: the example.
        lexicon: nouns, for the robot that a single order may get.
        rng: of everything that is random.
        share: of what can be changed.
    """
    if example.symbols[0] == "none":
        return example
    made = example
    found = {first: span for span in spans(example) if (first := _verb_before(example, span)) is not None}
    for first, span in sorted(found.items(), key=lambda each: -each[0]):
        if rng.random() < share:
            made = _passive(made, first, span, lexicon, rng)
    return made


def _verb_before(example: Example, span: Span) -> int | None:
    """Return where the verb begins whose object a run of words is; None if it has none, or cannot be turned round."""
    words = example.words
    if span.role not in _WORKED_ON or not span.alone or span.last >= example.own or _goes_on(example, span.last + 1):
        return None
    end = span.first
    while end and words[end - 1] in DETERMINERS:
        end -= 1
    first = next((end - long for long in (2, 1) if end >= long and words[end - long : end] in _VERBS), None)
    if first is None or not (first == 0 or words[first - 1] in _BEFORE or _comma_before(example, first)):
        return None
    return first if pointed(example).isdisjoint(range(first, end)) else None


def _goes_on(example: Example, at: int) -> bool:
    """Whether what is worked on goes on with word `at`: "the mast of the ship", "the mast, the hull"."""
    behind = example.words[at : example.own]
    if not behind or behind[0] in _BEHIND:
        return False
    return not (behind[0] in (",", "and") and behind[1:] and (behind[1] == "then" or behind[1] in _STARTS))


def _comma_before(example: Example, at: int) -> bool:
    """Whether a word stands behind "then," and the like."""
    before, mark = ("", *example.words[:at])[-2:]
    return mark == "," and before in ("then", "that", "next", "done")


def _passive(example: Example, first: int, span: Span, lexicon: Lexicon, rng: random.Random) -> Example:
    words = example.words
    end = span.first
    while words[end - 1] in DETERMINERS and end - 1 >= first:
        end -= 1
    verb, *particle = words[first:end]
    stands_for = {"DONE": [past(verb), *particle], "DOING": [going_on(verb), *particle]}
    starts = first == 0 or words[first - 1] in _BEGINNINGS
    before, _, after = rng.choice([*_FRAMES["turned"], *(_FRAMES["passive"] if starts else ())]).partition("OBJ")
    opening = before.split()
    ending = [word for each in after.split() for word in stands_for.get(each, [each])]
    made = substitute(example, [(first, end - 1, opening)])
    last = span.last + len(opening) - (end - first)
    made = inserted(made, last + 1, ending)
    if not _is_one_for_whomever(example) or rng.random() > 0.4:
        return made
    at = last + 1 + len(ending) if rng.random() < 0.5 else len(unended(made))
    return done_by(made, at, rng.choice(_FRAMES["by"]), lexicon.noun(ROBOT, rng))


def _is_one_for_whomever(example: Example) -> bool:
    """Whether it is one order, for no robot by name, and without a roster."""
    alone = len(subtasks_of(example)) == 1 and len(example.words) == example.own and is_a_clause(example)
    return alone and robots_of(example) == {"any"}


def past(verb: str) -> str:
    """Return the form of "is photographed"."""
    if verb in _IRREGULAR:
        return _IRREGULAR[verb]
    if verb.endswith("e"):
        return f"{verb}d"
    if verb.endswith("y") and verb[-2] not in "aeiou":
        return f"{verb[:-1]}ied"
    return f"{going_on(verb)[:-3]}ed"


def done_by(example: Example, at: int, phrase: str, name: Sequence[str]) -> Example:
    """Return an order to whomever as one to a robot, whose name is put in with a phrase before word `at`."""
    before, after = (each.split() for each in phrase.split("NAME"))
    made = inserted(example, at, [*before, *name, *after])
    first = at + len(before)
    pointer = (f"w{first}", f"w{first + len(name) - 1}")
    return replace(
        made, symbols=tuple(word for each in made.symbols for word in (pointer if each == "any" else (each,)))
    )


def is_an_order(example: Example) -> bool:
    """Whether it begins with a verb, as what follows "Kit should" does."""
    return example.words[0] in _STARTS


def _is_work(example: Example) -> bool:
    """Whether it begins with a verb, right behind which stands what is worked on."""
    return example.words[:1] in _VERBS or example.words[:2] in _VERBS


def told(example: Example, name: Sequence[str], rng: random.Random) -> Example:
    """Return an order to whomever as one that a robot shall do, which is said before it, or behind all of it."""
    if is_an_order(example) and rng.random() < 0.6:
        return done_by(example, 0, rng.choice(_FRAMES["told"]), name)
    kept = len(unended(example))
    cut = substitute(example, [(kept, example.own - 1, ())]) if kept < example.own else example
    return done_by(cut, kept, rng.choice(_FRAMES["behind"]), name)


def fronted(example: Example, rng: random.Random) -> Example:
    """Return an order whose last words say where, from where or for whom, with those first; any other as it is."""
    if example.symbols[0] == "none" or len(example.words) > example.own or not is_a_clause(example):
        return example
    if not _is_work(example) or robots_of(example) != {"any"}:
        return example
    end = len(unended(example))
    found = list(spans(example))
    last = next((span for span in found if span.last == end - 1), None)
    if last is None or last.role not in _WHERE or not last.alone:
        return example
    first = last.first
    while first and example.words[first - 1] in DETERMINERS:
        first -= 1
    first -= 1
    if first < 2 or example.words[first] not in _PLACED or example.words[first - 1].isdigit():
        return example
    inside = [span for span in found if span.last >= first]
    # Something is worked on before it, or the preposition may be the verb's: "look for the cup".
    if not any(span.last < first for span in found) or any(span.first <= first for span in inside):
        return example
    comma = [","] if rng.random() < 0.75 else []
    moved = end - first
    shift = moved + len(comma)
    words = (*example.words[first:end], *comma, *example.words[:first], *example.words[end:])

    def new(symbol: str) -> str:
        number = int(symbol[1:])
        return f"w{number - first if number >= first else number + shift}"

    symbols = tuple(new(each) if re.fullmatch(r"w\d+", each) else each for each in example.symbols)
    return Example(words, len(words), symbols)


def gapped(example: Example, lexicon: Lexicon, rng: random.Random) -> Example:
    """Return an order about one thing as one about two or three, each with its own places, and the verb said once."""
    one = _bare(example)
    if one is None:
        return example
    made = one
    start = _first_said(one)
    for _ in range(2 if rng.random() < 0.35 else 1):
        other = renamed(one, lexicon, rng, share=1.0)
        if {_name(other, span) for span in spans(other)} & {_name(made, span) for span in spans(made)}:
            return example
        other = substitute(other, [(0, start - 1, ())])
        linked = then_linked(made, other, rng.choice(_FRAMES["without_verb"]))
        if len(subtasks_of(linked)) > MAX_SUBTASKS:
            return example
        made = linked
    return made


def _bare(example: Example) -> Example | None:
    """Return an order that is one clause, without marks at its end, whose verb can be left out; None for any other."""
    if example.symbols[0] == "none" or len(example.words) > example.own or not is_a_clause(example):
        return None
    found = list(spans(example))
    if not _is_work(example) or robots_of(example) != {"any"} or not found:
        return None
    if {body[0] for body, _ in subtasks_of(example)} & _ALONE or "it" in example.words:
        return None
    if not all(span.alone and span.role in (*_WORKED_ON, "place", "at", "to", "into") for span in found):
        return None
    if example.words.count("to") > 1 or _first_said(example) < 1:
        return None
    kept = len(unended(example))
    return substitute(example, [(kept, example.own - 1, ())]) if kept < example.own else example


def _first_said(example: Example) -> int:
    """Return where the first name begins, with its article."""
    first = min(span.first for span in spans(example))
    while first and example.words[first - 1] in DETERMINERS:
        first -= 1
    return first


def _name(example: Example, span: Span) -> tuple[str, ...]:
    return example.words[span.first : span.last + 1]
