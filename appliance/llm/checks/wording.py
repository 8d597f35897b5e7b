"""Checks of the words: every word of an instruction stands in its plan, and nothing else does. Pure.

A plan runs unasked only where it accounts for all that was typed. What changes the meaning of an order (negation,
exception, condition, time, alternative, correction, question) has a check of its own, so that a refusal names the real
reason; all other words that are left over have to be derivable by the grammar of `clauses` (`coverage`), and subtasks
that no words ask for are found by `polarity`.
"""

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise

from appliance.llm.checks import clauses, schedules
from appliance.llm.checks import lexicon as lx
from appliance.llm.checks.facts import Claim, Facts, claims, free_said, number_said, robot_said, text_said
from appliance.llm.checks.places import coordinate
from appliance.llm.checks.reading import NUMBERS, Token
from appliance.llm.checks.schema import is_unnamed
from appliance.llm.values import FREE, unit_of
from appliance.model import Finding, Severity, Subtask

_CLOCK = re.compile(
    r"\b(?:[01]?\d|2[0-3]):[0-5]\d\b|\b\d{1,2}\s*(?:am\b|pm\b|a\.m|p\.m|o'clock|h\b(?=\s*(?:sharp|today)))",
    re.IGNORECASE,
)
_DELAYED = re.compile(
    r"\b(?:in|after|within)\s+(?:about\s+|around\s+)?(?:a|an|half|\d+|two|three|four|five|six|ten|fifteen|twenty|thirty)"
    r"(?:\s+(?:a|an|few|couple|of|more))*\s*(?:hours?|h|minutes?|mins?|seconds?|secs?|s|days?|weeks?)\b",
    re.IGNORECASE,
)
_REPEATED = re.compile(
    r"\b(?:every|each)\s+(?:other\s+|few\s+|\d+\s+|half\s+|two\s+|three\s+|five\s+|ten\s+|fifteen\s+|thirty\s+)*"
    r"(?:hour|minute|min|second|sec|day|night|morning|evening|afternoon|week|month|shift|time|monday|tuesday|wednesday|"
    r"thursday|friday|saturday|sunday)s?\b|"
    r"\b(?:twice|once|three times)\s+(?:a|an|per|each|every)\s+\w+",
    re.IGNORECASE,
)
_CLAUSE_END = frozenset((",", ";", ".", "!", "?", ":", "\n", "–", "—"))
_LONGEST_S = 290.0
"""A wait that any skill may take."""
_SPARE_S = 10.0
"""What a run of a skill needs beside the time that it is asked for."""
_MEASURE = re.compile(
    r"\b\d+(?:\.\d+)? ?(?:m|metres?|meters?|km|cm|s|sec|seconds?|min|minutes?|hours?|laps?|m/s|km/h|feet|ft|times)\b"
)
"""A quantity with its unit."""


_NO_EVENT = (
    lx.UNITS
    | frozenset(NUMBERS)
    | {
        "at",
        "for",
        "in",
        "about",
        "a",
        "an",
        "half",
        "after",
        "the",
        "of",
        "and",
        "radius",
        "height",
        "speed",
        "altitude",
        "high",
    }
)
"""A quantity alone is nothing that happens."""


_COURTEOUS_EVENT = re.compile(
    r"^(?:you|you've) (?:have|get|got|find) (?:a|the|some) (?:\w+ )?(?:moment|minute|sec|second|time)\b"
)
_SPOKEN_SO = re.compile(
    r" (?:in|with) (?:\w+ ){0,3}(?:voice|tone|accent|language|whisper|volume|manner|style|dialect)\b"
    r"| like (?:a|an|the|my) |"
    r" in (?:english|german|french|spanish|italian|polish|portuguese|dutch|russian|chinese|japanese|hindi|arabic)\b"
    r"| (?:aloud|loudly|quietly|softly|gently|slowly|politely|firmly|again|twice|thrice|repeatedly|\w+ times)$"
)
"""How something is spoken, which no skill can do."""


class Scope(Finding, frozen=True, kw_only=True):
    """A negated clause, and which subtasks do what it forbids."""

    at: tuple[int, ...] = ()
    broken_by: tuple[str, ...] = ()
    kept: bool = False


# --- what is left over ----------------------------------------------------------------------------------------------


def left(facts: Facts) -> list[int]:
    """Return the tokens that the plan does not account for, marks and small words included."""
    kept = facts.account.covered | _phrased(facts) | forbidden(facts) | _conditions(facts)[0]
    return [number for number in range(len(facts.reading.tokens)) if number not in kept]


def _phrased(facts: Facts) -> set[int]:
    """Tokens of courtesies, whose words mean nothing by themselves."""
    kept = facts.reading.memo.get(("courtesy", "", ""))
    if kept is not None:
        return set(kept)
    found: set[int] = set()
    texts = tuple(each.text for each in facts.reading.tokens)
    for words in clauses.COURTESIES:
        for start in range(len(texts) - len(words) + 1):
            if texts[start] == words[0] and texts[start : start + len(words)] == words:
                found.update(range(start, start + len(words)))
    facts.reading.memo["courtesy", "", ""] = frozenset(found)
    return found


def _clause_end(tokens: Sequence[Token], start: int, *, stops: frozenset[str] = frozenset(("but", "then"))) -> int:
    """The index behind the last token of the clause that begins at `start`."""
    index = start
    while index < len(tokens):
        each = tokens[index]
        if index > start and ((each.kind == "mark" and each.text in _CLAUSE_END) or each.text in stops):
            break
        index += 1
    return index


# --- negation -------------------------------------------------------------------------------------------------------


def _scopes(facts: Facts) -> list[Scope]:
    """Each negated clause of the instruction."""
    cached = facts.__dict__.get("_scopes")
    if cached is not None:
        return cached
    tokens = facts.reading.tokens
    account = facts.account
    filler = _phrased(facts)
    found: list[Scope] = []
    behind = 0
    named = set[int]().union(*account.values.values()) if account.values else set[int]()
    options = claims(facts.reading, facts.catalogue, taken=named)
    open_ended = lx.ALTERNATIVES | lx.CONDITIONS
    for number, token in enumerate(tokens):
        if number < behind or token.kind != "word" or token.text not in lx.NEGATIONS or number in filler:
            continue
        if number in account.covered and token.text not in ("not", "no", "never", "don't", "dont"):
            continue
        if number in _free_values(facts):
            continue
        end = _clause_end(tokens, number + 1)
        at = tuple(range(number, end))
        if _ends_only(tokens, number, end):
            account.covered.add(number)
            continue
        behind = end
        inside = set(at)
        asked = [
            each for group in options for each in group[:2]
            if set(each.at) <= inside and each.at[0] > number and tokens[each.at[0] - 1].text not in _BEFORE_NOUNS
            and each.text not in _HASTE
        ]  # fmt: skip
        who = _who(facts, number, inside)
        broken = tuple(each.id for each in facts.plan.subtasks if _does(facts, each, asked, inside, who))
        alone = token.text in ("no", "nope") and number + 1 < len(tokens) and tokens[number + 1].kind == "mark"
        same = any(_may_do(facts, each, asked, inside, who) for each in facts.plan.subtasks)
        kept = bool(asked) and not broken and not alone and not same
        kept = kept and not any(tokens[index].text in open_ended for index in at)
        if token.text == "without":
            # What follows is how an order is to be carried out, which no skill knows.
            kept = kept and number + 1 < len(tokens) and tokens[number + 1].text in _HALTING
        words = facts.words(at)
        found.append(
            Scope(
                check="negation", severity=Severity.REFUSE if broken else Severity.HOLD, message=words, words=(words,),
                at=at, broken_by=broken, kept=kept,
            )
        )  # fmt: skip
    facts.__dict__["_scopes"] = found
    return found


_HASTE = frozenset(("hurry", "rush", "dash", "zip"))
"""How to go, rather than to go."""
_HALTING = frozenset(("stopping", "pausing", "waiting", "halting"))
_BEFORE_NOUNS = frozenset(("a", "an", "any", "the", "no", "some"))


def _who(facts: Facts, number: int, inside: set[int]) -> frozenset[str]:
    """The robots that a negated clause is about: those in it, else those last named before it."""
    tokens = facts.reading.tokens
    here = frozenset(robot for index in inside for robot in tokens[index].robots)
    if here:
        return here
    before = [each.robots for each in tokens[:number] if each.kind == "robot"]
    return frozenset(before[-1]) if before else frozenset()


def _ends_only(tokens: Sequence[Token], number: int, end: int) -> bool:
    """Whether "stop" stands at the end of a way: "go to dock 1 and stop" (there)."""
    rest = [each.text for each in tokens[number + 1 : end]]
    return (
        tokens[number].text in ("stop", "stops", "halt")
        and number > 0
        and set(rest) <= {"there", "here"}
        and (tokens[number - 1].text in ("and", "then", ","))
    )


def _free_values(facts: Facts) -> set[int]:
    """Tokens of texts that are spoken, asked, or waited for: what they forbid is no order."""
    cached = facts.__dict__.get("_free")
    if cached is None:
        cached = set[int]()
        for subtask in facts.plan.subtasks:
            for name, value in subtask.params.items():
                if name in FREE and isinstance(value, str):
                    cached |= free_said(facts.reading, value) or set()
        facts.__dict__["_free"] = cached
    return cached


def _does(facts: Facts, subtask: Subtask, asked: Sequence[Claim], inside: set[int], who: frozenset[str]) -> bool:
    """Whether a subtask does what a negated clause forbids."""
    if subtask.robot is not None and who and subtask.robot not in who and not is_unnamed(subtask.robot):
        return False
    account = facts.account
    values, called = account.values[subtask.id], account.called[subtask.id]
    named = any(subtask.skill in each.skills for each in asked)
    if not named:
        return subtask.skill == "goto" and bool(values & inside) and not values - inside
    if values - inside:
        return False
    return bool(values & inside) or not called - inside


def _may_do(facts: Facts, subtask: Subtask, asked: Sequence[Claim], inside: set[int], who: frozenset[str]) -> bool:
    """Whether a subtask may be what a negated clause forbids: the same skill, and the clause names nothing else."""
    if subtask.robot is not None and who and subtask.robot not in who:
        return False
    if not any(subtask.skill in each.skills for each in asked):
        return False
    verbs = {index for each in asked for index in each.at}
    tokens = facts.reading.tokens
    own = [
        index for index in inside - verbs - facts.account.covered
        if tokens[index].kind in ("word", "number") and tokens[index].text not in clauses.SMALL | lx.NEGATIONS
    ]  # fmt: skip
    return not own or not facts.account.values[subtask.id]


def forbidden(facts: Facts) -> set[int]:
    """Tokens of negated clauses that the plan keeps."""
    return {index for each in _scopes(facts) if each.kept for index in each.at}


def negation(facts: Facts) -> Iterable[Finding]:
    """A plan does nothing that the instruction forbids, and no negation is passed over."""
    for scope in _scopes(facts):
        if scope.broken_by:
            does = ", ".join(scope.broken_by)
            yield Finding(
                check="negation", severity=Severity.REFUSE, words=scope.words,
                message=f'the instruction forbids this action: "{scope.words[0]}", and the plan does it ({does})',
                hint="say only what the robots are to do; to halt robots: swiftbot stop",
            )  # fmt: skip
        elif scope.kept and {facts.reading.tokens[each].text for each in scope.at} & _SORRY:
            yield _hold("correction", f'"{scope.words[0]}" takes something back', scope.words)
        elif scope.kept:
            inside = set(scope.at)
            if not any(each - inside for each in facts.account.evidence.values()):
                said = f'"{scope.words[0]}" forbids something and asks for nothing'
                yield _hold("negation", said, scope.words, hint="swiftbot rules add makes a standing rule of it")
            else:
                yield Finding(
                    check="negation", severity=Severity.NOTE, words=scope.words,
                    message=f'not in the plan, as "{scope.words[0]}" says',
                )  # fmt: skip
        else:
            yield _hold("negation", f'the plan does not account for "{scope.words[0]}"', scope.words)


_SORRY = (lx.CORRECTIONS - {"no", "instead", "rather"}) | {"forget", "disregard"}


# --- conditions -----------------------------------------------------------------------------------------------------


def _conditions(facts: Facts) -> tuple[set[int], list[tuple[int, tuple[int, ...]]]]:
    """Tokens of conditions that the plan keeps, and those that it does not, each with its first token."""
    cached = facts.__dict__.get("_conditions")
    if cached is not None:
        return cached
    tokens = facts.reading.tokens
    filler = _phrased(facts)
    kept: set[int] = set()
    lost: list[tuple[int, tuple[int, ...]]] = []
    for number, token in enumerate(tokens):
        if token.kind != "word" or token.text not in lx.CONDITIONS or number in filler or number in _free_values(facts):
            continue
        if token.text in ("case", "condition", "given", "else") and number in facts.account.covered:
            continue
        end = _clause_end(tokens, number + 1, stops=frozenset(("then", "otherwise")))
        clause = tuple(range(number, end))
        sentence = facts.reading.sentence[number]
        governed = [
            index for index in range(len(tokens)) if facts.reading.sentence[index] == sentence and index not in clause
        ]
        if (token.text in ("if", "provided", "providing") and _waits(facts, clause, governed)) or (
            token.text == "if" and len(clause) > 3 and _only_reports(facts, set(governed), set(clause))
        ):
            kept |= set(clause)
        else:
            lost.append((number, clause))
    facts.__dict__["_conditions"] = (kept, lost)
    return kept, lost


def _of(facts: Facts, indices: set[int]) -> list[Subtask]:
    """Subtasks that these tokens ask for."""
    return [each for each in facts.plan.subtasks if facts.account.evidence[each.id] & indices]


def _waits(facts: Facts, clause: Sequence[int], governed: Sequence[int]) -> bool:
    """Whether what a condition governs comes after a wait for it."""
    waits = [each for each in facts.plan.subtasks if each.skill == "wait_for"]
    content = {
        index for index in clause[1:]
        if facts.reading.tokens[index].kind != "mark" and facts.reading.tokens[index].text not in ("that", "and", "the")
    }  # fmt: skip
    for wait in waits:
        if content <= facts.account.values[wait.id]:
            after = [each for each in _of(facts, set(governed)) if each.id != wait.id]
            return bool(after) and all(wait.id in facts.before[each.id] for each in after)
    return False


def _only_reports(facts: Facts, governed: set[int], clause: set[int]) -> bool:
    """Whether what a condition governs only tells somebody something."""
    manifest = facts.manifest
    after = [each for each in facts.plan.subtasks if (facts.account.evidence[each.id] - clause) & governed]
    return bool(after) and all((m := manifest(each)) is not None and m.reports for each in after)


def condition(facts: Facts) -> Iterable[Finding]:
    """What an order depends on is waited for before it is carried out."""
    tokens = facts.reading.tokens
    for number, token in enumerate(tokens):
        begins = number == 0 or facts.reading.sentence[number] != facts.reading.sentence[number - 1]
        if begins and token.text in ("should", "were", "had"):
            yield _hold("condition", f'"{token.text}" begins a condition', (token.text,))
    for number, clause in _conditions(facts)[1]:
        words = facts.words(clause)
        first = facts.reading.tokens[number].text
        yield _hold(
            "condition", f'the plan does not wait for "{words}"', (words,),
            hint="wait for a person's answer instead, such as: wait for the all-clear from Ana, then ..."
            if first != "otherwise" else "",
        )  # fmt: skip


def exception(facts: Facts) -> Iterable[Finding]:
    """What an order leaves out is left out."""
    tokens = facts.reading.tokens
    kept = facts.account.covered | _phrased(facts) | forbidden(facts)
    for number, token in enumerate(tokens):
        if token.kind != "word" or token.text not in lx.EXCEPTIONS or number in kept:
            continue
        words = facts.words(range(number, _clause_end(tokens, number + 1)))
        yield _hold("exception", f'the plan does not account for "{words}"', (words,))


# --- times, alternatives, corrections, questions ----------------------------------------------------------------------


def time(facts: Facts) -> Iterable[Finding]:
    """Clock times, delays and repeats are no part of a plan, and one that passes them over cannot run.

    The hint names the command that schedules the instruction.
    """
    rest = set(left(facts))
    tokens = facts.reading.tokens
    found: list[int] = []
    small = clauses.SMALL - lx.TIMES - lx.UNITS - {"every", "each"}
    text = facts.reading.text
    for match in (*_CLOCK.finditer(text), *_DELAYED.finditer(text), *_REPEATED.finditer(text)):
        inside = [n for n, each in enumerate(tokens) if each.start < match.end() and each.end > match.start()]
        if inside and any(index in rest and tokens[index].text not in small for index in inside):
            found += inside
    if found:
        words = facts.words(sorted(set(found)))
        yield Finding(
            check="time", severity=Severity.REFUSE, words=(words,),
            message=f'clock times, delays and repeats are not supported in an instruction: "{words}"',
            hint=f"{_scheduled(facts.instruction)}; a robot can wait up to 290 s, such as: wait 30 seconds, then ...",
        )  # fmt: skip
        return
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        for name, value in subtask.params.items():
            if name == "event" and isinstance(value, str) and (set(value.split()) & lx.TIMES or _CLOCK.search(value)):
                yield _hold("time", f'{subtask.id}: "{value}" is a time, which nobody is asked about', (value,))
            most = max(_LONGEST_S, manifest.timeout_s - _SPARE_S) if manifest is not None else 0.0
            if name in ("duration_s", "timeout_s") and isinstance(value, int | float) and 0 < most < value:
                text = f"{subtask.id} ({subtask.skill}): {value:g} s is longer than a run may take, {most:g} s"
                yield _hold("time", text, ())
    for index in sorted(rest):
        if tokens[index].kind == "word" and tokens[index].text in lx.TIMES:
            if tokens[index].text == "again" and any(index - 1 in each for each in facts.account.called.values()):
                continue  # "switch it off again"
            word = tokens[index].text
            hint = f"times are not supported in an instruction: {schedules.GENERIC}"
            yield _hold("time", f'the plan does not account for "{word}"', (word,), hint=hint)
            return


def _scheduled(instruction: str) -> str:
    """Return the command that schedules an instruction, by the expressions of time in it."""
    spans = sorted(match.span() for each in (_CLOCK, _DELAYED, _REPEATED) for match in each.finditer(instruction))
    apart = all(end <= begin for (_, end), (begin, _) in pairwise(spans))
    return schedules.command(instruction, spans) if spans and apart else schedules.GENERIC


def alternative(facts: Facts) -> Iterable[Finding]:
    """An order that leaves a choice open is not decided by the planner."""
    tokens = facts.reading.tokens
    for number in left(facts):
        if tokens[number].kind == "word" and tokens[number].text in lx.ALTERNATIVES:
            words = facts.words(range(max(0, number - 2), min(len(tokens), number + 3)))
            yield _hold("alternative", f'the words leave a choice open: "{words}"', (tokens[number].text,),
                        hint="name the one that is meant")  # fmt: skip
            return


def correction(facts: Facts) -> Iterable[Finding]:
    """A correction in mid-sentence is looked at by a person."""
    tokens = facts.reading.tokens
    phrased = _phrased(facts)
    for number in left(facts):
        if tokens[number].kind == "word" and tokens[number].text in lx.CORRECTIONS and number not in phrased:
            yield _hold("correction", f'"{tokens[number].text}" takes something back', (tokens[number].text,),
                        hint="say the order once, as it is meant")  # fmt: skip
            return
        if tokens[number].text == "*" and not _opens_line(tokens, number):
            yield _hold("correction", '"*" takes something back', ("*",), hint="say the order once, as it is meant")
            return


def _opens_line(tokens: Sequence[Token], number: int) -> bool:
    return number == 0 or tokens[number - 1].text == "\n"


def told_values(facts: Facts) -> Iterable[Finding]:
    """What is reported, and to whom, is said as such: trailing words are no subject of a report."""
    tokens = facts.reading.tokens
    for subtask in facts.plan.subtasks:
        for name, leads in (("about", _ABOUT), ("to", _TO)):
            value = subtask.params.get(name)
            manifest = facts.manifest(subtask)
            if not isinstance(value, str) or subtask.id in facts.added or manifest is None or not manifest.reports:
                continue
            if value in ("operator", "home") or (facts.site is not None and facts.site.find(value) is not None):
                continue
            said = robot_said(facts.reading, value, subtask.skill, facts.catalogue)
            said = said or text_said(facts.reading, value, facts.site)
            if not said:
                continue
            lead = min(said) - 1
            while lead >= 0 and tokens[lead].text in _ARTICLES:
                lead -= 1
            article = lead < min(said) - 1
            before = tokens[lead].text if lead >= 0 else ""
            first = tokens[min(said)].text
            asked = lead in facts.account.called[subtask.id]
            subject = name == "about" and (
                (article and asked) or bool(set(value.lower().split()) & _SUBJECTS) or first in _WHAT
            )
            lasting = before == "for" and bool(set(value.lower().split()) & (lx.TIMES | lx.DURATIONS))
            if lasting or (before not in leads and not subject):
                yield _hold("names", f'{subtask.id}: "{value}" is not said to be what is reported', (value,))


_ARTICLES = frozenset(("the", "a", "an", "any", "all", "its", "his", "her", "their", "my", "our", "your"))
_ABOUT = frozenset(("about", "on", "of", "regarding", "concerning"))
_TO = frozenset(("to", "tell", "inform", "notify", "alert", "warn", "let", "update", "brief", "for", "send", "give"))
_WHAT = frozenset(("what", "how", "whether", "where", "which", "who", "anything", "everything", "any"))
_SUBJECTS = (lx.RESULTS - {"data", "list", "round"}) | lx.SUBJECTS


def left_alone(facts: Facts) -> Iterable[Finding]:
    """A robot that is to be left or kept where it is does not move: "leave the drone on its pad"."""
    tokens = facts.reading.tokens
    for number, token in enumerate(tokens):
        if token.text not in ("leave", "leaving", "keep", "keeping") or number in _free_values(facts):
            continue
        index = number + 1
        while index < len(tokens) and tokens[index].text in _ARTICLES:
            index += 1
        if index == len(tokens) or tokens[index].kind != "robot":
            continue
        kept = frozenset(tokens[index].robots)
        end = _clause_end(tokens, index, stops=frozenset(("and", "then", "but", "while")))
        said = set(range(index, end))
        for subtask in facts.plan.subtasks:
            manifest = facts.manifest(subtask)
            moves = manifest is not None and manifest.moves_robot
            if moves and subtask.robot in kept and facts.account.values[subtask.id] & said:
                words = facts.words(range(number, end))
                yield _hold("negation", f'{subtask.id}: "{words}" leaves {subtask.robot} where it is', (words,))


def shared_figures(facts: Facts) -> Iterable[Finding]:
    """A figure that counts for each of several robots is given to each: "take off, ten metres each"."""
    tokens = facts.reading.tokens
    covered = facts.account.covered
    if not any(each.text in ("each", "apiece") and n and n not in covered for n, each in enumerate(tokens)):
        return
    for subtask in facts.plan.subtasks:
        for name, value in subtask.params.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            lacking = [
                each.id for each in facts.plan.subtasks if each.skill == subtask.skill and name not in each.params
            ]
            if lacking:
                yield _hold("assignment", f'"each" gives {name} to {", ".join(lacking)} too', ("each",))
                return


def said_first(facts: Facts) -> Iterable[Finding]:
    """What is said to come first does: "find the cone, go to the shelf first"."""
    tokens = facts.reading.tokens
    for number, token in enumerate(tokens):
        ends = number + 1 == len(tokens) or tokens[number + 1].kind == "mark"
        if token.text != "first" or not ends or number in facts.account.covered:
            continue
        begin = number
        while begin and tokens[begin - 1].kind != "mark" and tokens[begin - 1].text not in ("and", "but", "then"):
            begin -= 1
        here = set(range(begin, number))
        first = [each for each in facts.plan.subtasks if facts.account.called[each.id] & here]
        for one in first:
            others = (each for each in facts.plan.subtasks if each not in first and each.robot == one.robot)
            if late := [each.id for each in others if one.id not in facts.before[each.id]]:
                yield _hold("sequence", f"{one.id} is said to come first, and {', '.join(late)} does", ("first",))


def late_waits(facts: Facts) -> Iterable[Finding]:
    """What is to happen once something has happened comes after the wait for it."""
    tokens = facts.reading.tokens
    for wait in facts.plan.subtasks:
        values = facts.account.values[wait.id]
        if "event" not in wait.params or not values or min(values) == 0:
            continue
        first = min(values)
        word = tokens[first - 1].text
        called = facts.account.called[wait.id] - {first - 1}
        sentence = facts.reading.sentence[first]
        earlier = [
            each for each in facts.plan.subtasks
            if each.id != wait.id and (said := facts.account.called[each.id])
            and max(said) < first and facts.reading.sentence[max(said)] == sentence
        ]  # fmt: skip
        later = any(
            max(facts.account.evidence[each.id], default=-1) > max(values)
            and facts.reading.sentence[max(facts.account.evidence[each.id])] == sentence
            for each in facts.plan.subtasks if each.id != wait.id
        )  # fmt: skip
        if called or later or not earlier or word not in ("once", "when", "after", "if", "until", "till"):
            continue
        # Behind the order that it governs: "go to dock 1 once the floor is dry".
        if word in ("until", "till") or wait.id not in facts.before[earlier[-1].id]:
            text = facts.words(range(first - 1, max(values) + 1))
            yield _hold("condition", f'the plan does not wait for "{text}" before what depends on it', (text,),
                        hint="say what comes first, such as: wait for the all-clear from Ana, then ...")  # fmt: skip


def question(facts: Facts) -> Iterable[Finding]:
    """A question is no order, however courteous orders may end in a question mark."""
    tokens = facts.reading.tokens
    free = _free_values(facts)
    first = next((each for each in tokens if each.kind != "mark"), None)
    if first is not None and first.text in lx.ASKING and not any(each.text == "?" for each in tokens):
        yield _hold("question", "it reads as a question, not as an order", (first.text,),
                    hint="ask for the state of robots with: swiftbot robots")  # fmt: skip
    for number, token in enumerate(tokens):
        if token.text != "?" or number in free or number in facts.account.covered:
            continue
        sentence = facts.reading.sentence[number]
        inside = [index for index in range(number) if facts.reading.sentence[index] == sentence]
        words = [tokens[index].text for index in inside if tokens[index].kind == "word"]
        if (
            _courteous(words)
            or words[-2:] in (["would", "you"], ["will", "you"], ["could", "you"])
            or ({"possible", "about"} & set(words[:5]) and words[:1] in (["would"], ["how"]))
        ):
            continue
        if _asked_of_robots(facts, inside):
            continue
        subtasks = _of(facts, set(inside))
        past = set(words) & {"did", "was", "were", "had", "has", "have"}
        if (
            words
            and words[0] in ("what", "how")
            and not past
            and subtasks
            and all(_perceives(facts, each) for each in subtasks)
        ):
            continue
        yield _hold("question", "it reads as a question, not as an order", (facts.words(inside),),
                    hint="ask for the state of robots with: swiftbot robots")  # fmt: skip


_GREETINGS = frozenset(
    ("hey", "hi", "hello", "good", "dear", "morning", "afternoon", "evening", "day", "ok", "okay", "so", "and", "then")
) | {"please"}
"""Words before a courteous question that ask nothing."""


def _courteous(words: Sequence[str]) -> bool:
    body = [each for each in words if each not in _GREETINGS]
    if body[:1] == ["mind"] or (body[:1] == ["would"] and "mind" in body[1:3]) or words[-1:] == ["please"]:
        return True
    return len(body) > 1 and body[0] in ("could", "can", "would", "will") and body[1] in (
        "you", "somebody", "someone", "we", "i", "one",
    )  # fmt: skip


_ABLE = frozenset(("reach", "fit", "carry", "handle", "manage", "see", "hear", "have", "know", "get", "lift"))
"""Verbs behind "could the rover" that ask what it is able to do."""


def _asked_of_robots(facts: Facts, inside: Sequence[int]) -> bool:
    """Whether a sentence is "could rover_1 go to dock 1?": an order to robots, unless it asks what they are able to."""
    tokens = facts.reading.tokens
    body = [
        n for n in inside if tokens[n].kind == "robot" or (tokens[n].text not in _OPENERS and tokens[n].kind == "word")
    ]
    if not body or tokens[body[0]].text not in ("could", "would"):
        return False
    rest = [n for n in body[1:] if tokens[n].text not in ("and", "please", "both", "kindly")]
    who = [n for n in rest if tokens[n].kind == "robot"]
    verbs = [n for n in rest if tokens[n].kind == "word"]
    called = set[int]().union(*facts.account.called.values()) if facts.account.called else set[int]()
    return bool(
        who and verbs and rest[0] == who[0] and tokens[verbs[0]].text not in _ABLE
        and (verbs[0] in called or tokens[verbs[0]].text in ("make", "be", "mind"))
    )  # fmt: skip


_OPENERS = frozenset(("hey", "hi", "hello", "ok", "okay", "so", "and", "then", "please", "there", "now"))


def _perceives(facts: Facts, subtask: Subtask) -> bool:
    manifest = facts.manifest(subtask)
    return manifest is not None and not manifest.moves_robot and set(manifest.uses) <= {"camera", "microphone"}


def pronoun(facts: Facts) -> Iterable[Finding]:
    """A pronoun stands for something that was said before it."""
    tokens = facts.reading.tokens
    said = sorted(set[int]().union(*facts.account.values.values())) if facts.account.values else []
    for number, token in enumerate(tokens):
        if token.kind != "word" or token.text not in lx.PRONOUNS or number in _free_values(facts):
            continue
        if token.text in ("it", "there") and number in _phrased(facts):
            continue
        before = (bool(said) and said[0] < number) or any(each.kind == "robot" for each in tokens[:number])
        following = tokens[number + 1] if number + 1 < len(tokens) else None
        if token.text in ("there", "here") and not before:
            yield _hold("pronoun", f'nothing was said that "{token.text}" could mean', (token.text,))
            return
        if (
            token.text in lx.THINGS
            and following is not None
            and number + 1 in facts.account.covered
            and token.text in ("that", "this", "these", "those")
        ):
            continue
        if token.text in lx.THINGS and not (said and said[0] < number) and not _subject(facts, number):
            yield _hold("pronoun", f'nothing was said that "{token.text}" could mean', (token.text,))
            return
        if not before and token.text not in ("here", "her", "his"):
            yield _hold("pronoun", f'nothing was said that "{token.text}" could mean', (token.text,))
            return
    yield from _one_of_several(facts)
    for subtask in facts.plan.subtasks:
        for name, value in subtask.params.items():
            spoken = name in ("text", "question", "event", "about", "to")
            if isinstance(value, str) and not spoken and set(value.split()) & lx.NAMELESS:
                yield _hold("pronoun", f'{subtask.id}: {name} is "{value}", which names nothing', (value,))


def _one_of_several(facts: Facts) -> Iterable[Finding]:
    """A word for one robot or thing follows where one was said: "rover_1 and rover_2 go there, then it lands"."""
    tokens = facts.reading.tokens
    for number, token in enumerate(tokens):
        if token.text not in _SINGULAR or not number or number in _free_values(facts) or number in _phrased(facts):
            continue
        after = number + 1 if number + 1 < len(tokens) else number
        acts = tokens[after].text in _ACTS or any(after in called for called in facts.account.called.values())
        robots = any(each.kind == "robot" for each in tokens[:number])
        if acts and after != number and robots and len(facts.governors[number]) > 1:
            yield _hold(
                "pronoun", f'"{token.text}" may be any of {", ".join(sorted(facts.governors[number]))}', (token.text,)
            )
            return
        for subtask in facts.plan.subtasks:
            if number - 1 in facts.account.called[subtask.id] and len(held := _held(facts, subtask)) > 1:
                yield _hold("pronoun", f'"{token.text}" may be any of {", ".join(sorted(held))}', (token.text,))
                return


def _held(facts: Facts, subtask: Subtask) -> set[str]:
    """The things that a robot has when it puts one down: those it took before and has not put down."""
    manifest = facts.manifest(subtask)
    if manifest is None or "load" not in manifest.frees:
        return set()
    earlier = [
        (each, m)
        for each in facts.plan.subtasks
        if each.id in facts.before[subtask.id]
        and each.robot == subtask.robot
        and "object" in each.params
        and (m := facts.manifest(each)) is not None
    ]
    taken = {str(each.params["object"]) for each, m in earlier if "load" in m.ties}
    return taken - {str(each.params["object"]) for each, m in earlier if "load" in m.frees}


_SINGULAR = frozenset(("it", "he", "she", "him", "her"))
_ACTS = frozenset(("should", "must", "shall", "will", "can", "needs", "then"))


def _subject(facts: Facts, number: int) -> bool:
    """Whether a pronoun is who does something, and so may mean a robot: "once it is there", "let it return"."""
    tokens = facts.reading.tokens
    before = tokens[number - 1].text if number else ""
    after = tokens[number + 1].text if number + 1 < len(tokens) else ""
    called = set[int]().union(*facts.account.called.values()) if facts.account.called else set[int]()
    return (
        number + 1 in called
        or after in ("is", "has", "should", "must", "shall", "will", "can", "needs", "then", "to")
        or before in ("let", "have", "make", "once", "when", "while", "after", "until", "before", "and", "get")
        or after in lx.SUBORDINATE
    )


def _uses(facts: Facts, subtask: Subtask) -> tuple[str, ...]:
    manifest = facts.manifest(subtask)
    return manifest.uses if manifest is not None else ()


def leaving(facts: Facts) -> Iterable[Finding]:
    """A place that a robot is to leave, or that it is to look at from elsewhere, is not where it is sent."""
    tokens = facts.reading.tokens
    texts = [token.text for token in tokens]
    from_elsewhere = any(pair in (("from", "there"), ("from", "here")) for pair in pairwise(texts))
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None or not manifest.moves_robot:
            continue
        said = facts.account.values[subtask.id]
        if (
            from_elsewhere
            and subtask.skill in lx.WAYS
            and any(
                said and said <= facts.account.called[other.id] | facts.account.values[other.id]
                for other in facts.plan.subtasks
                if other.robot == subtask.robot and other.skill not in lx.WAYS
            )
        ):
            yield _hold(
                "polarity", f'{subtask.id}: the words say "from there", and the plan goes there', ("from there",)
            )
        for index in facts.account.values[subtask.id]:
            before = index - 1
            while before > 0 and tokens[before].text in ("the", "a", "our"):
                before -= 1
            away = before > 0 and (tokens[before - 1].text, tokens[before].text) in lx.AWAY
            alone = subtask.skill in lx.WAYS and before > 0 and tokens[before].text == "from"
            if away or (alone and len(facts.plan.subtasks) == 1):
                words = f"{tokens[before - 1].text} {tokens[before].text}"
                yield _hold("polarity", f'{subtask.id}: the words say "{words}", and the plan goes there', (words,))
                break


def names(facts: Facts) -> Iterable[Finding]:
    """A name is a name: it has swallowed neither a preposition with what follows it nor another clause."""
    for subtask in facts.plan.subtasks:
        if subtask.id in facts.added:
            continue
        for name, value in subtask.params.items():
            if isinstance(value, str):
                wrong = _path if name == "path" else _free_text if name in FREE else _name
                for text in wrong(facts, subtask, name, value):
                    yield _hold("names", f"{subtask.id}: {text}", (value,))
    for subtask, name, value in facts.account.unsaid:
        if name not in FREE and subtask not in facts.added and value not in ("operator", "home"):
            yield _hold("names", f'{subtask}: no words say {name} "{value}"', (value,))


def _path(facts: Facts, subtask: Subtask, name: str, value: str) -> Iterable[str]:
    del subtask
    if facts.site is not None and facts.site.find(value) is not None:
        yield f'"{value}" is one place, and no path'
    said = value.lower().split()
    if "from" in said and "to" not in said:
        yield f'the path "{value}" leads nowhere'
    if words := sorted(set(said) & _NOT_IN[name]):
        yield f'"{words[0]}" is no place of a path'
    if long := next(
        (each for each in re.split(r"[,;(]|\b(?:then|and|via|to|from)\b", value) if len(each.split()) > 5), ""
    ):
        yield f'"{long.strip()}" is no place of a path'


def _free_text(facts: Facts, subtask: Subtask, name: str, value: str) -> Iterable[str]:
    """What is wrong with a text to be spoken, or with what is waited for."""
    last = re.findall(r"[\w']+|\.\.\.", value.lower())[-1:]
    quoted = any(each.kind == "quote" for each in facts.reading.tokens)
    if value.lower() in _NOBODY:
        yield f'{name} "{value}" names nobody and nothing'
    if not quoted and last and (last[0] in lx.NEGATIONS or "..." in value):
        yield f'"{value}" takes something back at its end'
    place = re.search(r" (?:at|in|by|near) (?:the )?([\w ]+)$", value.lower())
    if (
        name == "text"
        and not quoted
        and place
        and facts.site is not None
        and facts.site.find(place.group(1)) is not None
    ):
        yield f'"{place.group().strip()}" may be where it is to be spoken'
    if subtask.params.get("to") == "operator" and "speaker" in _uses(facts, subtask):
        yield "a robot cannot speak to the operator: notify does"
    ahead = re.match(r"(?:at|in|by|near|to|from) (?:the )?([\w ]+?)[:,]", value.lower())
    if name == "text" and not quoted and ahead and facts.site is not None and facts.site.find(ahead.group(1)):
        yield f'"{ahead.group().strip()}" may be where it is to be spoken'
    if name == "text" and not quoted and (how := _SPOKEN_SO.search(value.lower())):
        yield f'"{how.group().strip()}" may be how it is to be spoken'
    words = set(re.findall(r"[a-z]+", value.lower()))
    inner = sorted(free_said(facts.reading, value) or ())[1:]
    swallowed = any(facts.reading.tokens[index].kind == "robot" for index in inner)
    if name == "event" and (swallowed or re.search(r"\b(?:shall|should|must|please|then)\b", value.lower())):
        yield f'"{value}" is more than something that happens'
    if name == "event" and re.match(r"(?:there|here|at|in|on)\b", value.lower()):
        yield f'"{value}" is where something is, and nothing that happens'
    if name == "event" and _COURTEOUS_EVENT.search(value.lower()):
        yield f'"{value}" is courtesy, and nothing that happens'
    if name == "event" and (words <= _NO_EVENT or set(value.lower().split()[-1:]) & lx.DURATIONS):
        yield f'"{value}" is nothing that happens'


def _name(facts: Facts, subtask: Subtask, name: str, value: str) -> Iterable[str]:
    """What is wrong with a name of a thing, a place or a person."""
    del subtask
    low = value.lower()
    if low in _NOBODY:
        yield f'{name} "{value}" names nobody and nothing'
    if name in ("to", "person") and set(low.split()) & {"over", "through", "via", "by", "using", "on", "in", "with"}:
        yield f'{name} "{value}" is more than a name'
    if (facts.site is not None and facts.site.find(value) is not None) or coordinate(value) is not None:
        return
    if low in _CHANGING or (name in _THINGS and re.fullmatch(r"[a-z]+ing", low) and low not in lx.NOUNS_IN_ING):
        yield f'{name} "{value}" is no name'
    if name in _PLACES and (shorter := _known_part(facts, value)):
        yield f'{name} "{value}" is more than {shorter}'
    elif set(low.split()) & _NOT_IN.get(name, lx.IN_NO_NAME) or "," in value or (name in _THINGS and " from " in low):
        yield f'{name} "{value}" is more than a name'


_NOBODY = frozenset(("him", "her", "them", "it", "there"))
_THINGS = frozenset(("target", "object", "asset"))
"""Parameters that name a thing."""
_PLACES = frozenset(("place", "area", "station", "at"))
"""Parameters that name a place."""


_NOT_IN: dict[str, frozenset[str]] = dict.fromkeys(
    _PLACES, lx.IN_NO_NAME | {"with", "exception", "beside", "besides", "apart", "minus", "short"}
)


_NOT_IN["path"] = lx.BY_THE_WAY | lx.TIMES | {"with", "exception", "unless", "except", "without", "than", "for"}


_CHANGING = lx.NEGATIONS | lx.EXCEPTIONS | lx.CONDITIONS | lx.ALTERNATIVES
"""Words that alone are no name."""


def _known_part(facts: Facts, value: str) -> str:
    """The place of the site that a longer name begins with: what follows it is no part of its name."""
    words = value.split()
    shorter = (" ".join(words[:count]) for count in range(len(words) - 1, 0, -1))
    return next((each for each in shorter if facts.site is not None and facts.site.find(each) is not None), "")


# --- words and subtasks --------------------------------------------------------------------------------------------


def quantity(facts: Facts) -> Iterable[Finding]:
    """Every figure stands in the plan with its unit, and no name has swallowed one."""
    tokens = facts.reading.tokens
    for number in left(facts):
        token = tokens[number]
        if token.kind == "number" and not _item(tokens, number):
            yield _hold("quantity", f"{token.text} is said and stands nowhere in the plan", (token.text,))
        elif token.text in ("twice", "thrice"):
            yield _hold("quantity", f'the plan does not account for "{token.text}"', (token.text,))
    for subtask in facts.plan.subtasks:
        for name, value in subtask.params.items():
            if (
                isinstance(value, str)
                and name not in FREE
                and coordinate(value) is None
                and (swallowed := _MEASURE.search(value))
            ):
                said = swallowed.group()
                yield _hold(
                    "quantity", f'{subtask.id}: {name} "{value}" holds "{said}", which is no part of a name', (said,)
                )
    yield from _durations(facts)


def _durations(facts: Facts) -> Iterable[Finding]:
    """What is said behind "for" with a unit of time is how long, and the value of nothing else."""
    tokens = facts.reading.tokens
    for subtask in facts.plan.subtasks:
        for name, value in subtask.params.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or name in _HOW_LONG:
                continue
            for number in number_said(facts.reading, value, unit_of(name)) or ():
                unit = tokens[number + 1].text if number + 1 < len(tokens) else ""
                if number and tokens[number - 1].text == "for" and unit in lx.DURATIONS:
                    words = f"for {tokens[number].text} {unit}"
                    yield _hold(
                        "quantity", f'{subtask.id}: the words say "{words}", and {name} is no duration', (words,)
                    )


_HOW_LONG = frozenset(("duration_s", "timeout_s"))


def delivery(facts: Facts) -> Iterable[Finding]:
    """What is to be brought somewhere is put down or given there."""
    texts = {each.text for number, each in enumerate(facts.reading.tokens) if number not in _free_values(facts)}
    if not texts & lx.DELIVERY or facts.continued:
        return
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None or "load" not in manifest.ties:
            continue
        later = [each for each in facts.plan.subtasks if subtask.id in facts.before[each.id]]
        freed = any((m := facts.manifest(each)) is not None and "load" in m.frees for each in later)
        moved = any(
            each.robot == subtask.robot and (m := facts.manifest(each)) is not None and m.moves_robot for each in later
        )
        if moved and not freed:
            yield _hold("delivery", f"{subtask.id}: {subtask.params.get('object')} is taken along and not put down", ())


def _item(tokens: Sequence[Token], number: int) -> bool:
    """Whether a figure numbers an item of a list."""
    before = tokens[number - 1].text if number else "\n"
    after = tokens[number + 1].text if number + 1 < len(tokens) else ""
    if after == ")" and before != "(":
        return True
    return after in (")", ".", ":") and before in ("\n", ":", ";", ".", ",", "(") and "." not in tokens[number].text


def coverage(facts: Facts) -> Iterable[Finding]:
    """Every word stands in the plan, or is derivable as part of an order."""
    tokens = facts.reading.tokens
    unknown = _stray(facts) or _said_twice(facts)
    if unknown:
        words = tuple(dict.fromkeys(tokens[index].text for index in unknown if tokens[index].text.strip()))[:12]
        shown = ", ".join(f'"{each}"' for each in words)
        yield _hold(
            "coverage",
            f"the plan does not account for {shown}",
            words,
            hint="leave these words out, or say it otherwise",
        )


def _stray(facts: Facts) -> list[int]:
    """Tokens that neither the plan accounts for nor the recogniser of clauses derives."""
    cached = facts.__dict__.get("_stray")
    if cached is None:
        texts = [each.text for each in facts.reading.tokens]
        cached = clauses.outstanding(_labels(facts), texts, several=len(facts.plan.subtasks) > 1)
        facts.__dict__["_stray"] = cached
    return cached


def _said_twice(facts: Facts) -> list[int]:
    """A verb beside the one that its subtask has: "go to dock 1 and continue", "say: rover_1, say hello"."""
    tokens, account = facts.reading.tokens, facts.account
    called = set[int]().union(*account.called.values()) if account.called else set[int]()
    content = called.union(*account.values.values()) if account.values else called
    begin, end = min(content, default=-1), max(content, default=-1)
    led = begin in called and tokens[begin].text not in ("tell", "ask")
    if led and begin + 1 < len(tokens) and tokens[begin + 1].robots:
        asked = [each for each in facts.plan.subtasks if begin in account.called[each.id]]
        still = not any((m := facts.manifest(each)) is not None and m.moves_robot for each in asked)
        if asked and still and all(max(account.called[each.id]) > begin + 1 for each in asked):
            return [begin]
    if end not in called or tokens[end].text in ("thanks", "thank"):
        return []
    begin = end
    while begin - 1 in called:
        begin -= 1
    before = tokens[begin - 1].text if begin else ""
    joined = before in ("and", "then")
    last = end + 1 == len(tokens) or tokens[end + 1].kind == "mark"
    if not last or tokens[begin].text in _PARTICLES or not (joined or begin - 1 in content):
        return []
    asked = [each for each in facts.plan.subtasks if account.called[each.id] & set(range(begin, end + 1))]
    double = all(
        max(account.values[each.id], default=begin) < begin and (joined or min(account.called[each.id]) < begin)
        for each in asked
    )
    return list(range(begin, end + 1)) if asked and double else []


_PARTICLES = frozenset(("up", "down", "on", "off", "out", "back", "over", "in", "many", "know", "again"))


def _labels(facts: Facts) -> list[str]:
    """What each token is for the recogniser of clauses: content that the plan accounts for, or a word."""
    account, tokens = facts.account, facts.reading.tokens
    kept = forbidden(facts) | _conditions(facts)[0]
    called = set[int]().union(*account.called.values()) if account.called else set[int]()
    values = set[int]().union(*account.values.values()) if account.values else set[int]()
    found: list[str] = []
    item = 0.0
    for number, token in enumerate(tokens):
        if number in kept:
            found.append("K")
        elif token.kind == "robot" and token.robots:
            found.append("R")
        elif (token.text in ("thank", "thanks") and number not in values) or (
            token.text == "you" and number and found[-1] == "thank"
        ):
            found.append(token.text)
        elif number in called:
            found.append("V")
        elif number in values or (number in account.covered and (token.kind != "robot" or facts.robots is None)):
            found.append("A")
        elif token.kind == "number" and _item(tokens, number) and token.value == item + 1:
            item += 1
            found.append("\n")
        elif token.text in ("-", "*", "•") and _opens_line(tokens, number) and number + 1 < len(tokens):
            found.append("\n")
        elif token.kind == "quote":
            found.append('"')
        elif (token.text in lx.RESULTS and _later(facts, number) and not _alone(tokens, number)) or (
            token.text in lx.UNITS and number and tokens[number - 1].value is not None
        ):
            found.append("A")
        else:
            found.append(token.text)
    return found


def _alone(tokens: Sequence[Token], number: int) -> bool:
    """Whether a word is a clause of its own, and so an order: "dock 2, photo."."""
    before, after = number == 0 or tokens[number - 1].kind == "mark", number + 1 == len(tokens)
    return before and (after or tokens[number + 1].kind == "mark")


def _later(facts: Facts, number: int) -> bool:
    """Whether some subtask was asked for before: a result of it may be spoken of."""
    return any(evidence and min(evidence) < number for evidence in facts.account.evidence.values())


def polarity(facts: Facts) -> Iterable[Finding]:
    """Each verb is carried out by a skill that it asks for, and each subtask is asked for by words."""
    if facts.continued:
        return
    opposed = {
        other for each in facts.plan.subtasks if (m := facts.manifest(each)) is not None for other in m.opposite_of
    }
    kept = forbidden(facts) | _conditions(facts)[0] | _phrased(facts)
    stray = set(_stray(facts))
    for claim in facts.account.unclaimed:
        if set(claim.at) <= kept or set(claim.at) & _free_values(facts):
            continue
        if not set(claim.at) & stray:
            continue  # "once it is there", "have rover_1 ...": part of what makes an order
        if facts.reading.tokens[claim.at[0]].text in lx.RESULTS and _later(facts, claim.at[0]):
            continue
        asks = ", ".join(sorted(claim.skills))
        if claim.skills & opposed:
            yield Finding(
                check="polarity", severity=Severity.REFUSE, words=(claim.text,),
                message=f'"{claim.text}" asks for {asks}, and the plan does the opposite',
            )  # fmt: skip
        else:
            yield _hold("polarity", f'"{claim.text}" asks for {asks}, which is not in the plan', (claim.text,))
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is None:
            continue
        if subtask.id in facts.added:
            continue
        called = facts.account.called[subtask.id] - forbidden(facts)
        stays = set(manifest.uses) == {"base"} and not manifest.moves_robot
        implied = (subtask.skill == "goto" or stays) and facts.account.values[subtask.id]
        if not called and not implied and not _implied(facts, subtask):
            yield _hold("polarity", f"no words ask for {subtask.id} ({subtask.skill})", ())


def _implied(facts: Facts, subtask: Subtask) -> bool:
    """Whether a way is there for a thing that the site knows to be at its end."""
    if _put_later(facts, subtask):
        return True
    return (
        subtask.skill == "goto"
        and facts.site is not None
        and any(
            facts.site.find(each.at) is facts.site.find(str(subtask.params.get("place", "")))
            for each in facts.site.objects
            if any(each.name == other.params.get("object") for other in facts.plan.subtasks)
        )
    )


_IN_HAND = frozenset(("down", "drop", "drops", "dropping", "release", "releases", "let", "lets", "leave", "leaves"))
"""Words of putting that say that the thing is held already."""


def _put_later(facts: Facts, subtask: Subtask) -> bool:
    """Whether a thing is taken because the words ask to put it somewhere: "put the orange cone at the gate"."""
    manifest = facts.manifest(subtask)
    if manifest is None or "load" not in manifest.ties or not subtask.params.get("object"):
        return False
    return any(
        subtask.id in facts.before[each.id]
        and each.params.get("object") == subtask.params["object"]
        and facts.site is not None
        and facts.site.find(str(each.params.get("at", ""))) is not None
        and (called := {facts.reading.tokens[index].text for index in facts.account.called[each.id]})
        and not called & _IN_HAND
        and (m := facts.manifest(each)) is not None
        and "load" in m.frees
        for each in facts.plan.subtasks
    )


def unseen(facts: Facts) -> Iterable[Finding]:
    """Characters that a person cannot see, or not tell apart, change no order."""
    if facts.reading.hidden:
        yield _hold("unseen", f"{facts.reading.hidden} invisible characters were in the text", ())
    if facts.reading.mixed:
        shown = ", ".join(ascii(each) for each in facts.reading.mixed[:4])
        yield _hold("unseen", f"words mix letters of several scripts: {shown}", facts.reading.mixed[:4])


# --- order ---------------------------------------------------------------------------------------------------------


def sequence(facts: Facts) -> Iterable[Finding]:
    """What the words order is ordered in the plan, and what they say of the same time is not."""
    tokens = facts.reading.tokens
    subtasks = facts.plan.subtasks
    called = facts.account.called
    evidence = {each.id: _own(facts, each) for each in subtasks}
    for number, token in enumerate(tokens):
        if token.text == "first" and _closes(tokens, number):
            begin = next(
                (n for n in range(number, -1, -1) if tokens[n].text in _CLAUSE_END or tokens[n].text == "but"), 0
            )
            early = [each for each in subtasks if called[each.id] and min(called[each.id]) > begin]
            late = [each for each in subtasks if called[each.id] and max(called[each.id]) < begin]
            if any(b.id not in facts.before[a.id] for a in late for b in early if a.robot == b.robot):
                yield _hold("sequence", '"first" is said at its end, and the plan has another order', ("first",))
                return
        if token.text == "first" and number and tokens[number - 1].text == "but":
            early = [each for each in subtasks if called[each.id] and max(called[each.id]) > number]
            late = [each for each in subtasks if called[each.id] and max(called[each.id]) < number]
            if any(b.id not in facts.before[a.id] for a in late for b in early):
                yield _hold("sequence", '"but first" is said, and the plan has another order', ("first",))
                return
        if token.kind != "word":
            continue
        if token.text in lx.SEQUENCE or _done_first(facts, number):
            first = [each for each in subtasks if evidence[each.id] and min(evidence[each.id]) < number]
            second = [each for each in subtasks if evidence[each.id] and min(evidence[each.id]) > number]
            forward = any(a.id in facts.before[b.id] for a in first for b in second)
            back = not _reordered(tokens) and any(
                b.id in facts.before[a.id] and max(evidence[a.id]) < number for a in first for b in second
            )
            if first and second and (back or not forward):
                yield _hold("sequence", f'"{token.text}" is said, and the plan has another order', (token.text,))
                return
        elif token.text in lx.SIDE_BY_SIDE or side_by_side(tokens, number) or _in_the_meantime(tokens, number):
            pairs = ((a, b) for n, a in enumerate(subtasks) for b in subtasks[n + 1 :])
            if all(a.id in facts.before[b.id] or b.id in facts.before[a.id] for a, b in pairs):
                yield _hold("sequence", f'"{token.text}" is said and nothing runs side by side', (token.text,))
                return
    yield from _opposites(facts)
    yield from _before_after(facts)
    yield from _as_said(facts)


def _done_first(facts: Facts, number: int) -> bool:
    """Whether what was said before is done first by a word: "after that", "when they are there, ...".

    A clause of its own content says what else is first ("once you have photographed it"), or is waited for.
    """
    tokens, account = facts.reading.tokens, facts.account
    after = tokens[number + 1].text if number + 1 < len(tokens) else ""
    if tokens[number].text == "after" and after in ("that", "this"):
        return True
    soon = tokens[number].text == "as" and tokens[number - 1].text == "soon"
    if not (soon or tokens[number].text in ("after", "when", "once")) or after not in _THEY:
        return False
    if any(number in account.called[each.id] or number + 1 in account.values[each.id] for each in facts.plan.subtasks):
        return False
    inside = number + 1
    while inside < len(tokens) and (tokens[inside].text in _THEY | _HAVE or tokens[inside].value is not None):
        inside += 1
    return not any(evidence and min(evidence) == inside for evidence in account.evidence.values())


_THEY = frozenset(
    "it it's they they're they've you you're you've he he's she she's all both everyone everybody".split()  # noqa: SIM905 - a list of words
)
_HAVE = frozenset(("has", "have", "is", "are", "been", "both", "all", "of", "them"))


def _in_the_meantime(tokens: Sequence[Token], number: int) -> bool:
    return [each.text for each in tokens[number : number + 3]] == ["in", "the", "meantime"]


def _own(facts: Facts, subtask: Subtask) -> set[int]:
    """The tokens that say what a subtask does; of several mentions those that the words give to its robot."""
    said = facts.account.values[subtask.id] or facts.account.called[subtask.id]
    return {index for index in said if subtask.robot in facts.governors[index]} or said


def _as_said(facts: Facts) -> Iterable[Finding]:
    """Without words that say otherwise a robot goes about places in the order in which they are said."""
    tokens = facts.reading.tokens
    values = {each: found or facts.account.called[each] for each, found in facts.account.values.items()}
    if _reordered(tokens):
        return
    by_the_way = next((n for n, each in enumerate(tokens) if each.text in lx.BY_THE_WAY), None)
    for one in facts.plan.subtasks:
        for two in facts.plan.subtasks:
            first, second = values[one.id], values[two.id]
            if one.id not in facts.before[two.id] or one.robot != two.robot or not first or not second:
                continue
            if "base" not in _uses(facts, one) or "base" not in _uses(facts, two):
                continue
            late = min(first) > max(second)
            if by_the_way is None and late and not (first & second):
                yield _hold("sequence", f"{two.id} ({two.skill}) is said before {one.id} ({one.skill})", ())
                return
            if by_the_way is not None and max(first) < by_the_way < min(second):
                word = tokens[by_the_way].text
                yield _hold("sequence", f'"{word}" is said, and the plan has another order', (word,))
                return


def _closes(tokens: Sequence[Token], number: int) -> bool:
    """Whether a word ends a clause that another one precedes: "close the door, go to the office first"."""
    return number + 1 >= len(tokens) or tokens[number + 1].text in _CLAUSE_END


def _opposites(facts: Facts) -> Iterable[Finding]:
    """Two orders that undo each other come in the order in which they are said."""
    tokens, called = facts.reading.tokens, facts.account.called
    if any(each.text in ("before", "after", "first", "until") for each in tokens):
        return
    for one in facts.plan.subtasks:
        for two in facts.plan.subtasks:
            manifest = facts.manifest(one)
            opposed = manifest is not None and two.skill in manifest.opposite_of
            if not opposed or one.params.get("object") != two.params.get("object") or one.robot != two.robot:
                continue
            first, second = called[one.id], called[two.id]
            if one.id in facts.before[two.id] and first and second and min(first) > max(second):
                yield _hold("sequence", f"{two.id} ({two.skill}) is said before {one.id} ({one.skill})", ())
                return


def side_by_side(tokens: Sequence[Token], number: int) -> bool:
    """Whether "at the same time" or "in parallel" ends here."""
    texts = [each.text for each in tokens[max(0, number - 3) : number + 1]]
    return texts[-4:] == ["at", "the", "same", "time"] or texts[-2:] == ["in", "parallel"]


def repeated(facts: Facts) -> Iterable[Finding]:
    """A plan does a thing twice only where the words say so."""
    if any(each.text in lx.AGAIN or each.value is not None for each in facts.reading.tokens if each.kind == "word"):
        return
    seen: list[tuple[object, ...]] = []
    for subtask in facts.plan.subtasks:
        manifest = facts.manifest(subtask)
        if manifest is not None and manifest.moves_robot:
            seen = [each for each in seen if each[1] != subtask.robot]  # elsewhere the same is another thing
        what = (subtask.skill, subtask.robot, subtask.params)
        same = sum((each.skill, each.robot, each.params) == what for each in facts.plan.subtasks)
        said = facts.account.evidence.get(subtask.id, set()) - forbidden(facts)
        if same > 1 and manifest is not None and manifest.moves_robot and same > _mentions(said) and what not in seen:
            yield _hold("repeated", f"{subtask.id} ({subtask.skill}) is planned {same} times", ())
        if manifest is not None and not manifest.repeats and what in seen:
            yield _hold("repeated", f"{subtask.id} ({subtask.skill}) is planned twice", ())
        seen.append(what)


def _mentions(said: set[int]) -> int:
    """How often a thing is said: runs of tokens that stand apart."""
    return sum(each - 1 not in said and each - 2 not in said for each in said)


def _reordered(tokens: Sequence[Token]) -> bool:
    behind = [each.text for each in tokens[1:]] + [""]
    return any(
        each.text in ("before", "once", "first", "when", "until", "from")
        or (each.text == "after" and follows not in ("that", "which", "this", "it", "wards"))
        for each, follows in zip(tokens, behind, strict=False)
    )


def _before_after(facts: Facts) -> Iterable[Finding]:
    tokens = facts.reading.tokens
    for number, token in enumerate(tokens):
        if token.kind != "word" or token.text not in ("before", "after") or number in facts.account.covered:
            continue
        if number + 1 < len(tokens) and tokens[number + 1].text == "that":
            continue
        end = _clause_end(tokens, number + 1)
        clause = set(range(number, end))
        sentence = facts.reading.sentence[number]
        rest = {index for index in range(len(tokens)) if facts.reading.sentence[index] == sentence} - clause
        inner = [
            each
            for each in facts.plan.subtasks
            if facts.account.called[each.id] & clause and not facts.account.called[each.id] & rest
        ]
        outer = [
            each
            for each in facts.plan.subtasks
            if facts.account.called[each.id] & rest and not facts.account.called[each.id] & clause
        ]
        if not inner or not outer:
            continue
        early, late = (outer, inner) if token.text == "before" else (inner, outer)
        if not any(a.id in facts.before[b.id] for a in early for b in late):
            yield _hold("sequence", f'"{token.text}" is said, and the plan has another order', (token.text,))


def _hold(check: str, message: str, words: Sequence[str], hint: str = "") -> Finding:
    return Finding(check=check, severity=Severity.HOLD, message=message, words=tuple(words), hint=hint)
