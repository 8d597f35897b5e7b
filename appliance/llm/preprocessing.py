"""An instruction before it is planned: refused when it is none, else put as planners read it best. Pure.

A model asked to plan a greeting or a page of JSON will plan something. So what can be told from the text alone is
refused here (`refused`), on every tier alike and in microseconds, with a reason that a person understands; whatever is
merely doubtful is left to the planners. `explained` says why nothing could be planned, afterwards.

Planners read names better than "the drone", "(26, 6)" or a roster of robots that nobody spoke of: `told` names robots,
puts a word for points, and keeps of the roster only the robots that the words can mean. The review goes by the words as
they were typed and by the whole roster, so that nothing is lost by it.
"""

import json
import re
import shlex
import unicodedata
from collections.abc import Sequence, Set
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from appliance.errors import PlanError, RefusedError
from appliance.llm.checks.places import coordinate
from appliance.llm.checks.reading import Reading, names_of, normalise, read, spelled
from appliance.llm.checks.schema import MAX_PROBLEMS
from appliance.llm.settings import PlanContext
from appliance.llm.shortlist import literally
from appliance.llm.stop_words import StopRequest
from appliance.llm.training_words import TrainingRequest
from appliance.model import Finding, Plan, RobotInfo, Site, Subtask, TierAttempt

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


def training_refused(training: TrainingRequest) -> RefusedError:
    """Return the error for a text that is a run of federated learning: never planned, but started by a command."""
    if training.unknown:
        names = ", ".join(training.unknown)
        return RefusedError(
            f"this is a run of federated learning, not a task, on a robot that the fleet has not: {names}",
            remedy=f"{training.command}; swiftbot robots lists their names",
        )
    return RefusedError("this is a run of federated learning, not a task", remedy=training.command)


def rule_refused(text: str) -> RefusedError:
    """Return the error for a text that is a mere prohibition: never planned, but offered as a standing rule."""
    return RefusedError("this is a standing rule, not a task", remedy=f"swiftbot rules add {shlex.quote(text.strip())}")


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
    said = each_once((why, *(reasons or last[:3])) if why else (reasons or last[:3]))
    return PlanError(
        f"no valid plan for the instruction: {'; '.join(said)}",
        remedy=hint or 'rephrase, for example "Robot_1: go to goal 2, then photograph the shelf"; see docs/limits.md',
        problems=tuple(problems[:MAX_PROBLEMS]),
    )


_ABOUT = re.compile(r"(?P<subtasks>s\d+) \((?P<skill>\w+)\): (?P<what>.+)", re.DOTALL)
_CLAUSE = ": it knows "


def each_once(reasons: Sequence[str]) -> tuple[str, ...]:
    """Return reasons with nothing said twice: subtasks of one problem together, a list of what is known at its end.

    "s3 (goto): no place a: it knows x; s4 (goto): no place a: it knows x" is "s3, s4 (goto): no place a: it knows x".
    """
    together: dict[tuple[str, str], list[str]] = {}
    for reason in reasons:
        match = _ABOUT.fullmatch(reason)
        about = (match["skill"], match["what"]) if match else ("", reason)
        together.setdefault(about, []).append(match["subtasks"] if match else "")
    found = [
        f"{', '.join(dict.fromkeys(subtasks))} ({skill}): {what}" if skill else what
        for (skill, what), subtasks in together.items()
    ]
    tails = [each.partition(_CLAUSE)[2] for each in found]
    last = {tail: index for index, tail in enumerate(tails)}
    return tuple(
        each.partition(_CLAUSE)[0] if tail and last[tail] != index else each
        for index, (each, tail) in enumerate(zip(found, tails, strict=True))
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


_NUMBER = r"[-−]?\d{1,4}(?:\.\d+)?"
_POINT = re.compile(
    rf"(?:\b(?:the\s+)?(?:coordinates?|coords|position|point|location|spot|grid(?:\s+point)?)\s*:?\s*)?"
    rf"(?:\(\s*{_NUMBER}\s*[,;]\s*{_NUMBER}(?:\s*[,;]\s*{_NUMBER})?\s*\)"
    rf"|\bx\s*=?\s*{_NUMBER}\s*m?\s*(?:,|;|and)?\s*y\s*=?\s*{_NUMBER}(?:\s*m\b)?"
    rf"|(?<![\w.,])(?<!\d ){_NUMBER}\s?,\s?{_NUMBER}"
    r"(?![\w.,]*\d)(?!\s*(?:m\b|m/s|metres?|meters?|seconds?|s\b|laps?|(?:,|and|&|or)\s*\d)))",
    re.IGNORECASE,
)
"""A pair of figures that can only be a point: in brackets, with axes, or two figures with nothing but a comma."""
_LISTED = re.compile(
    r"\b(?:waypoints?|docks?|goals?|aisles?|bays?|stations?|racks?|rovers?|drones?|robots?|rooms?|numbers?)\s*$",
    re.IGNORECASE,
)
"""What stands before figures that are numbers of places: "docks 1, 2"."""
_OTHERS = frozenset(("other", "others", "another", "rest", "remaining", "else", "second", "latter", "former", "last"))
"""Words for robots that are not named."""


def as_typed(text: str, instruction: str) -> str:
    """Return a text as it stands in an instruction, but for case and the blanks between words; itself if it does not.

    Of several places those in quotation marks come first: what is quoted is read out, or typed.
    """
    words = text.split()
    if not words:
        return text
    said = r"\s+".join(map(re.escape, words))
    found = re.compile(rf"(?<!\w){said}(?!\w)", re.IGNORECASE)
    places = sorted(found.finditer(instruction), key=lambda match: not _quoted(instruction, match.start()))
    return " ".join(places[0].group().split()) if places else text


class Told(Struct, frozen=True, kw_only=True):
    """An instruction as planners are given it."""

    instruction: str
    robots: tuple[RobotInfo, ...] | None
    points: dict[str, str] = field(default_factory=dict)
    """Word -> the point that it stands for, as a plan writes it."""

    def context(self, context: PlanContext) -> PlanContext:
        """Return what a planner is asked with."""
        site = context.site
        if site is not None and self.points:
            spots = {word: spot for word, point in self.points.items() if (spot := coordinate(point)) is not None}
            site = replace(site, places={**site.places, **spots})
        return replace(context, instruction=self.instruction, robots=self.robots, site=site)

    def restored(self, plan: Plan, *, verbatim: Set[tuple[str, str]] = frozenset()) -> Plan:
        """Return a planner's plan with the points that words stand for, and free texts in the case they were typed in.

        Args:
            plan: as a planner made it; planners write lower case.
            verbatim: skill and parameter of the texts that people read or hear.
        """

        def params(subtask: Subtask) -> dict[str, Any]:
            found = {name: self._value(value) if isinstance(value, str) else value
                     for name, value in subtask.params.items()}  # fmt: skip
            return {
                name: as_typed(value, self.instruction) if isinstance(value, str) and (subtask.skill, name) in verbatim
                else value for name, value in found.items()
            }  # fmt: skip

        if not self.points and not verbatim:
            return plan
        return replace(plan, subtasks=tuple(replace(each, params=params(each)) for each in plan.subtasks))

    def _value(self, text: str) -> str:
        for word, point in self.points.items():
            if text.casefold() == word:
                return point
            # In a path, beside others.
            text = re.sub(rf"\b{word}\b", f"({point})", text, flags=re.IGNORECASE)
        return text


def told(context: PlanContext) -> Told:
    """Return what planners get for an instruction."""
    found = read(context.instruction, context.robots, site=context.site)
    robots = _meant(context.instruction, found, context.robots)
    instruction = spelled(context.instruction, names_of(context.robots, context.site))
    if normalise(instruction)[0] != instruction:
        return Told(instruction=instruction, robots=robots)
    text, points = _with_points(_with_names(instruction, found, context.robots), context.site)
    return Told(instruction=text, robots=robots, points=points)


def _with_names(text: str, found: Reading, robots: Sequence[RobotInfo] | None) -> str:
    """Return an instruction with names of robots for their kinds: "the drone" is drone_1, where there is one."""
    for token in reversed(found.tokens) if robots else ():
        said = ""
        if token.group == "one" and len(token.robots) == 1 and token.text != token.robots[0]:
            said = token.robots[0]
        elif token.listed:
            said = f"{', '.join(token.robots[:-1])} and {token.robots[-1]}"
        if said:
            text = f"{text[: token.start]}{said}{text[token.end :]}"
    return text


def _with_points(text: str, site: Site | None) -> tuple[str, dict[str, str]]:
    """Return an instruction with words for its points, and what each stands for: words that name nothing else."""
    points: dict[str, str] = {}

    def word(match: re.Match[str]) -> str:
        figures = ", ".join(f"{float(each.replace('−', '-')):g}" for each in re.findall(_NUMBER, match.group()))
        if _LISTED.search(text[: match.start()]) or coordinate(figures) is None or _quoted(text, match.start()):
            return match.group()
        name = next((known for known, point in points.items() if point == figures), "")
        number = len(points) + 7
        while not name:
            known = site is not None and site.find(f"waypoint {number}") is not None
            name = "" if known or re.search(rf"waypoint {number}\b", text, re.IGNORECASE) else f"waypoint {number}"
            number += 1
        points[name] = figures
        return name

    return _POINT.sub(word, text), points


def _quoted(text: str, at: int) -> bool:
    return text[:at].count('"') % 2 == 1


def _meant(instruction: str, found: Reading, robots: tuple[RobotInfo, ...] | None) -> tuple[RobotInfo, ...] | None:
    """Return the robots that the words can mean: those they name; all where they name none, or speak of others."""
    if robots is None or any(each.text in _OTHERS for each in found.tokens):
        return robots
    meant = {name for each in found.tokens if each.kind == "robot" for name in each.robots}
    if not meant:
        return robots
    meant |= literally(instruction, robots)
    return tuple(each for each in robots if each.id in meant)
