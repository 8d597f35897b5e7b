"""Stop words: which texts are a soft stop and no task. Pure.

A stop is a whole text, or a sentence of one, whose verb is a stop word of a supported language and whose object is
nothing, a robot, robots, or everything. It reaches no planner: typed by a person it is carried out at once, from a
robot or a template it is refused with the command. What stands in quotation marks is spoken, and stops nobody.
"""

import re
import unicodedata
from collections.abc import Sequence

from msgspec import Struct

MAX_CHARACTERS = 100_000
"""Longer texts are no stop: nobody types so much in need."""
_QUOTED = re.compile(r"\"[^\"]*\"|“[^”]*”|«[^»]*»|„[^“”]*[“”]|(?<!\w)['‘][^'’]*['’](?!\w)")
_SENTENCE = re.compile(r"[.;!\n]+|[?]")
_WORD = re.compile(r"[^\W_]+(?:[_-][^\W_]+)*|[?,:]")
_CONFUSABLE = str.maketrans("аеорсухітԁһѕјԛԝΑΒΕΖΗΙΚΜΝΟΡΤΥΧαορ", "aeopcyxitdhsjqwABEZHIKMNOPTYXaop")
"""Letters of other scripts that look like Latin ones."""


def _phrases(*texts: str) -> tuple[tuple[str, ...], ...]:
    found = {tuple(each.split()) for text in texts for each in text.split("|")}
    return tuple(sorted(found, key=len, reverse=True))


_STOPS = _phrases(
    # en
    "stop|stops|halt|freeze|abort|cease|estop|e-stop|e stop|emergency stop|emergency halt|full stop|"
    "all stop|hard stop|soft stop|stop moving|stop driving|stop flying|stop it|stop that|"
    "stop right there|stop there|stand still|hold still|hold everything|hold it|stay where you are|"
    "do not move|don't move|dont move|nobody move|cease all movement|stop what you are doing|"
    "stop what you're doing|stop whatever you are doing|cut it out|stop now|halt now|stop all motion|"
    "stop all movement|cease movement|cease operations|abort mission|abort the mission|abort everything|"
    "kill it|panic stop",
    # es
    "alto|para|pare|paren|parad|detengan|paren todos|detente|detengase|detenganse|deteneos|detener|"
    "parar|alto ya|parada de emergencia",
    # pt
    "parem|parem todos|parada de emergência|parada de emergencia",
    # fr
    "arrete|arretez|arreter|arrete-toi|arretez-vous|stoppez|halte|arret d'urgence|arret",
    # de
    "stopp|anhalten|stehen bleiben|stehenbleiben|bleib stehen|bleibt stehen|nothalt|not-halt|"
    "sofort anhalten|not aus|not-aus",
    # it
    "fermati|ferma|fermo|fermi|fermatevi|alt|arresto di emergenza",
    # nl
    "stoppen|noodstop|stilstaan|sta stil",
    # pl
    "stoj|zatrzymaj|zatrzymaj sie|zatrzymac|stac",
)
"""Stop words and phrases, without accents, longer ones first."""


def _words(*texts: str) -> frozenset[str]:
    return frozenset(word for text in texts for word in text.split())


_COURTESY = _words(
    "please pls plz now immediately at once right away asap just hey ok okay everyone all robots guys oh no god quick",
    "quickly i said say damn it ya ahora inmediatamente por favor agora imediatamente sofort jetzt bitte tout de suite",
    "maintenant s'il vous plait svp subito adesso per favore nu meteen direct natychmiast teraz prosze and then the a",
    "this that you must should need to have has want can could will would we for sake mission task",
)
"""Words that may stand beside a stop word."""
_EVERYTHING = _words(
    "everything everybody everyone all everywhere anything robots fleet robot machines vehicles todos todo todas tudo",
    "tous tout toutes alle alles alle tutti tutto wszystko wszyscy los las els die der das movement motion operations",
    "movimiento work both them they of units every each whole complete",
)
"""Objects that mean robots without naming one."""
_NEGATED = _words(
    "not don't dont never no doesn't didn't won't can't cannot without nicht kein nie ne pas non nunca jamais niet geen"
)
_QUESTIONS = _words("why when where who what how did does do is was has which if warum wann pourquoi por que cuando")
_KINDS = _words("robot drone rover uav ugv arm cart unit vehicle machine copter bot truck tug forklift")


_BEFORE_NOUNS = _words("bus next last first the a")
"""Words behind which "stop" is a noun."""


class StopRequest(Struct, frozen=True):
    """A soft stop that somebody asked for in words."""

    robots: tuple[str, ...] = ()
    """The robots named; empty: all."""
    unknown: tuple[str, ...] = ()
    """Names that no robot of the roster has."""


def stop_request(text: str, robots: Sequence[str] = ()) -> StopRequest | None:
    """Return the stop that a text asks for; None for any other text. It never raises.

    Args:
        text: as it was typed.
        robots: the roster's names.
    """
    if len(text) > MAX_CHARACTERS:
        return None
    plain = _plain(_QUOTED.sub(" § ", text))
    names: list[str] = []
    unknown: list[str] = []
    found = False
    everybody = False
    for sentence, question in _sentences(plain):
        if question and not _courteous(sentence):
            continue
        said = _read(sentence, robots)
        if said is None:
            continue
        found = True
        names += said.robots
        unknown += said.unknown
        everybody = everybody or not (said.robots or said.unknown)
    if not found:
        return None
    if everybody:
        return StopRequest()
    return StopRequest(tuple(dict.fromkeys(names)), tuple(dict.fromkeys(unknown)))


def mentions_stop(text: str) -> bool:
    """Whether a stop word is in a text at all: only then `stop_request` needs the names of robots."""
    words = set(re.findall(r"[^\W_]+(?:['_-][^\W_]+)*", _plain(text[:MAX_CHARACTERS])))
    return any(phrase[0] in words for phrase in _STOPS)


def _plain(text: str) -> str:
    """Lower case without accents, invisible characters and look-alike letters of other scripts."""
    folded = unicodedata.normalize("NFKD", unicodedata.normalize("NFKC", text.translate(_CONFUSABLE)))
    kept = "".join(each for each in folded if unicodedata.category(each) not in ("Mn", "Cf"))
    return kept.casefold().translate(_CONFUSABLE).replace("’", "'").replace("ł", "l")


def _sentences(text: str) -> list[tuple[str, bool]]:
    found: list[tuple[str, bool]] = []
    start = 0
    for mark in _SENTENCE.finditer(text):
        # "dr. smith", "1.5": a full stop without a blank behind it ends nothing.
        if mark.group() == "." and mark.end() < len(text) and not text[mark.end()].isspace():
            continue
        found.append((text[start : mark.start()], "?" in mark.group()))
        start = mark.end()
    found.append((text[start:], False))
    return [(each, question) for each, question in found if each.strip()]


def _courteous(sentence: str) -> bool:
    return re.match(r"\s*(?:could|can|would|will) (?:you|everyone|everybody|all)\b", sentence) is not None


def _read(sentence: str, robots: Sequence[str]) -> StopRequest | None:
    """Return the stop of one sentence. Every word has to be the stop word, a robot, or say nothing by itself."""
    for piece in _pieces(sentence):
        words = re.findall(r"§|[^\W_]+(?:['_-][^\W_]+)*", piece)
        if not words or len(words) > 24 or "§" in words or words[0] in _QUESTIONS:
            continue
        at = _stop_at(words)
        if at is None:
            continue
        rest = [*words[: at[0]], *words[at[1] :]]
        if at[0] and words[at[0] - 1] in _NEGATED:
            continue
        names, left = _names(rest, robots)
        unknown = _unknown(left, robots)
        if unknown is None:
            continue
        if not _plausible(words, at, names):
            continue
        return StopRequest(tuple(names), tuple(unknown))
    return None


def _pieces(sentence: str) -> list[str]:
    """A sentence, and its clauses behind a colon or comma, so that "land? no, stop" is heard."""
    pieces = [re.sub(r"[:,–—]", " ", sentence)]
    last = re.split(r"[,–—]", sentence)[-1]
    return pieces if last == sentence else [*pieces, last]


def _stop_at(words: Sequence[str]) -> tuple[int, int] | None:
    for start in range(len(words)):
        for phrase in _STOPS:
            if tuple(words[start : start + len(phrase)]) == phrase:
                return start, start + len(phrase)
    return None


def _names(words: list[str], robots: Sequence[str]) -> tuple[list[str], list[str]]:
    """Take the robots out of words: by name, or "the drone", "both rovers"."""
    text = " ".join(words)
    found: list[tuple[int, str]] = []
    for robot in sorted(robots, key=len, reverse=True):
        parts = [re.escape(each) for each in re.findall(r"[^\W\d_]+|\d+", robot.casefold())]
        if not parts:
            continue
        pattern = re.compile(rf"(?<![^\W_]){'[ _-]?'.join(parts)}(?:'s)?(?![^\W_])")
        if match := pattern.search(text):
            found.append((match.start(), robot))
            text = pattern.sub(" ", text)
    left: list[str] = []
    for word in text.split():
        kind = word.removesuffix("s")
        of_kind = [each for each in robots if each.casefold().startswith(kind)]
        if kind in _KINDS and kind not in ("robot", "unit", "vehicle", "machine", "bot") and of_kind:
            found += [(99, each) for each in of_kind]
        else:
            left.append(word)
    return [robot for _, robot in sorted(found, key=lambda each: each[0])], left


def _unknown(left: Sequence[str], robots: Sequence[str]) -> list[str] | None:
    """Names of robots that are not there; None when words are left that are no robot."""
    text = " ".join(left)
    found = [
        match.group()
        for match in re.finditer(rf"\b({'|'.join(sorted(_KINDS))})s?(?:[ _-]?\d{{1,4}}|[ _-][a-z])\b", text)
    ]
    for name in found:
        text = text.replace(name, " ")
    others = [word for word in text.split() if word not in _COURTESY and word not in _EVERYTHING and word not in _KINDS
              and word.removesuffix("s") not in _KINDS and not _again(word)]  # fmt: skip
    if not others:
        return found
    if len(others) == 1 and robots and _looks_like(others[0], robots):
        return [*found, others[0]]
    return None


def _again(word: str) -> bool:
    return any(len(each) == 1 and each[0] == word for each in _STOPS)


def _looks_like(word: str, robots: Sequence[str]) -> bool:
    """Whether a word looks like a mistyped robot's name: "rover1", "rovr_1"."""
    import difflib  # noqa: PLC0415 - only for a text that has a stop word and one word more

    return bool(difflib.get_close_matches(word, [each.casefold() for each in robots], n=1, cutoff=0.75))


def _plausible(words: Sequence[str], at: tuple[int, int], names: Sequence[str]) -> bool:
    """Whether the stop word is a verb here: "bus stop" and "para ana" are none, however little is left beside them."""
    word = words[at[0]]
    if word == "para" and len(words) > 1 and not names and not set(words) & {"ya", "todo", "todos", "ahora"}:
        return words.count("para") == len(words)
    noun = word in ("stop", "halt") and at[0] > 0 and words[at[0] - 1] in _BEFORE_NOUNS
    return not noun or bool(names)
