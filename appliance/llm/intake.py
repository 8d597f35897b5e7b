"""What is no instruction at all, said before any planner is asked; and why nothing could be planned, said after. Pure.

A model asked to plan a greeting or a page of JSON will plan something. So what can be told from the text alone is
refused here, on every tier alike and in microseconds, with a reason that a person understands; whatever is merely
doubtful is left to the planners.
"""

import json
import re
import unicodedata
from collections.abc import Sequence

from appliance.errors import PlanError, RefusedError
from appliance.llm.checks.schema import MAX_PROBLEMS
from appliance.llm.stop_words import StopRequest
from appliance.model import Finding, TierAttempt

MAX_CHARACTERS = 4000
"""Longer text is no instruction; the gateway's own bound (`tasks.max_instruction_chars`) is lower."""
_EXAMPLE = 'say it as an order, such as "Robot_1: go to goal 2, then photograph the shelf"'
_STRANGE = 0.05
"""Share of characters that no text has, above which it is none."""
_FOREIGN = 0.3
"""Share of letters of other scripts, above which it is not English; names of places may have some."""
_WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)?")
_LANGUAGES = {
    "English": "the a an to and then go at of in with while from for it is on take pick up down get bring fetch find "
    "come back its this that all every when after before please put place move wait stop follow check look film "
    "photograph report tell into near until once both first next send have be my your our there here over by as if or "
    "not do",
    "German": "der die das und dann zum zur mit nach bitte den dem ein eine einen ist nicht fahre fahr gehe geh hole "
    "hol bringe bring zu von auf im ins alle danach kiste nimm fotografiere melde",
    "French": "le la les et puis du des une vers avec allez va aller prends prendre est au aux pour dans sur tous "
    "apporte boîte ensuite photographie dis moi",
    "Spanish": "el la los las y luego hacia con ve una un del al por lleva trae toma en después todos caja recoge "
    "fotografía espera avisa",
    "Italian": "il lo la gli le e poi verso con vai una un del prendi porta al nel tutti dopo scatola fotografa",
    "Portuguese": "o os as e depois para com vá uma um do da leve pegue ao no na todos caixa fotografe espere",
    "Dutch": "de het een en dan naar met ga van op alle breng haal pak doos daarna wacht fotografeer",
    "Polish": "i potem na weź idź z po przy wszystkie skrzynkę przynieś zrób zdjęcie",
}
"""Frequent words of orders, by language."""
_KNOWN = {name: frozenset(words.split()) for name, words in _LANGUAGES.items()}
_ENGLISH = _KNOWN.pop("English")
_QUESTION = re.compile(
    r"^(?:so |and |hey |well )?(?:what(?:'s| is| are| was| do| does| did)|who(?:'s| is| are| am)|why|when(?:'s| is)|"
    r"how (?:are|is|do you|old|much is)|are you|do you|is there (?:a )?(?:god|life)|"
    r"tell me (?:a|about) )\b",
    re.IGNORECASE,
)
_SEEN = re.compile(
    r"\b(?:on|in|at|near|inside|behind|under|beside|robot|rover|drone|camera|shelf|dock|aisle|room|door|yard|bay|many)"
    r"\b|\d",
    re.IGNORECASE,
)
"""Words of a question that a robot could look into."""
_FLY = re.compile(
    r"^(?:please )?(?:fly|levitate|hover) (?:the|a|an|my|our) (?P<thing>[a-z][\w -]{1,40})$", re.IGNORECASE
)


def refused(instruction: str) -> PlanError | None:
    """Return why a text is no instruction, or None when the planners should look at it."""
    text = instruction.strip()
    if not text:
        return PlanError("the instruction is empty", remedy="say what a robot shall do")
    if len(text) > MAX_CHARACTERS:
        return PlanError(
            f"the instruction has {len(text):,} characters", remedy=f"at most {MAX_CHARACTERS:,}; give it in parts"
        )
    return _not_text(text) or _data(text) or _not_english(text) or _asks_nothing(text)


def explained(instruction: str) -> str:
    """Return what is the matter with an instruction that no tier could plan, in words; "" when nothing is known."""
    text = instruction.strip().rstrip(".!")
    if match := _FLY.match(text):
        return f"no skill flies {match['thing'].strip()}: only a robot that flies takes off, by its name in the roster"
    if text.endswith("?") or _QUESTION.match(text):
        return "it is a question, and says nothing that a robot shall do"
    return ""


def stop_refused(stop: StopRequest) -> RefusedError:
    """Return the error for a text that is a soft stop: never planned, but carried out by a person's command."""
    who = " ".join(stop.robots)
    if stop.unknown and not who:
        names = ", ".join(stop.unknown)
        return RefusedError(
            f"this is a stop, not a task, of a robot that the fleet has not: {names}",
            remedy="swiftbot stop ROBOT halts one, swiftbot stop halts all; swiftbot robots lists their names",
        )
    return RefusedError(
        f"this is a stop, not a task{f' (of {who})' if who else ''}", remedy=f"swiftbot stop {who}".rstrip()
    )


def no_plan(attempts: Sequence[TierAttempt], why: str, refusals: Sequence[Finding] = ()) -> PlanError:
    """Return the error for an instruction that no tier had a plan for: what each lacked, and how to say it.

    Args:
        attempts: the tiers that were asked.
        why: what is the matter with the instruction itself; "" when nothing is known.
        refusals: what the review found against their plans.
    """
    if not attempts:
        return PlanError("no planner is configured", remedy='set llm.tiers; "rules" needs nothing else')
    problems = [f"{each.tier}: {problem}" for each in attempts for problem in each.problems]
    # The last tier asked is the one of last resort: its problems are the most telling, but for a real reason to refuse.
    last = attempts[-1].problems or ("no plan",)
    reasons = tuple(dict.fromkeys(each.message for each in refusals))[:3]
    hint = next((each.hint for each in refusals if each.hint), "")
    said = (why, *(reasons or last[:3])) if why else (reasons or last[:3])
    return PlanError(
        f"no valid plan for the instruction: {'; '.join(said)}",
        remedy=hint or 'rephrase, for example "Robot_1: go to goal 2, then photograph the shelf"; see docs/limits.md',
        problems=tuple(problems[:MAX_PROBLEMS]),
    )


def _not_text(text: str) -> PlanError | None:
    strange = sum(unicodedata.category(each) in ("Cc", "Cs", "Co", "Cn") and each not in "\n\r\t" for each in text)
    strange += text.count("\ufffd")
    if "\0" in text or strange > _STRANGE * len(text):
        return PlanError("the instruction is binary data, not text", remedy=_EXAMPLE)
    if not any(each.isalnum() for each in text):
        return PlanError("the instruction has no words", remedy=_EXAMPLE)
    return None


def _data(text: str) -> PlanError | None:
    if text[0] not in "{[" and not text.startswith("<?xml"):
        return None
    try:
        data = text[0] not in "{[" or isinstance(json.loads(text), dict | list)
    except (ValueError, RecursionError):
        # "[to the drone] go home" is an order; braces and quotation marks in number are not.
        data = text.count('"') >= 4 and text.count(":") >= 2
    if not data:
        return None
    return PlanError(
        "the instruction is data (JSON or the like), not words",
        remedy=f"{_EXAMPLE}; a plan is handed in as `plan` of a task",
    )


def _not_english(text: str) -> PlanError | None:
    letters = [each for each in text if each.isalpha()]
    foreign = [each for each in letters if not unicodedata.name(each, "LATIN").startswith("LATIN")]
    if letters and len(foreign) > _FOREIGN * len(letters):
        script = unicodedata.name(foreign[0], "another").split()[0].capitalize()
        return PlanError(f"the instruction is not in English ({script} script): only English is understood")
    words = [each.casefold() for each in _WORD.findall(text)]
    english = sum(each in _ENGLISH for each in words)
    name, count = max(
        ((name, sum(each in known - _ENGLISH for each in words)) for name, known in _KNOWN.items()),
        key=lambda each: each[1],
    )
    if (count >= 2 and english == 0) or (count >= 3 and count > 2 * english):
        return PlanError(
            f"the instruction looks like {name}: only English is understood", remedy="say it in English; names may stay"
        )
    return None


def _asks_nothing(text: str) -> PlanError | None:
    if _QUESTION.match(text) and not _SEEN.search(text) and len(text.split()) <= 12:
        return PlanError(
            "there is nothing to do: it is a question, and says nothing that a robot shall do", remedy=_EXAMPLE
        )
    return None
