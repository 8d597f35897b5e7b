"""Verb phrases of dealing with people: reports, messages, saying, asking, waiting for them, guiding.

Telling the one who gave the order is a message to the operator; `report` is for a report that is asked for.
"""

from typing import Any

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules.phrases import ARTICLE, Match, Patterns, Scope, Step

PATTERNS = Patterns()


# --- reports and people ---------------------------------------------------------------------------------------------

_PLAINLY = (
    "findings",
    "results",
    "result",
    "it",
    "them",
    "finding",
    "what you find",
    "everything",
    "that",
    "this",
    "outcome",
)


def _report(to: str | None, about: str | None, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {}
    if about and lx.noun(about) not in _PLAINLY:
        params["about"] = scope.thing(about)
    if to:
        params["to"] = scope.person(to)
    return [Step("report", params)]


_R_TO = r"(?: to (?P<to>.+?))?"
_R_ON = r"(?: (?:on|about|of|covering) (?P<on>.+?))?"
for _tail in (rf"{_R_TO}{_R_ON}", rf"{_R_ON}{_R_TO}", rf" (?:back|in){_R_TO}{_R_ON}", rf" (?!to\b)(?P<on>.+?){_R_TO}"):
    PATTERNS.on("report", _tail)(lambda match, scope: _report(match["to"], match["on"], scope))
for _tail in (rf"{_R_ON}{_R_TO}", rf"{_R_TO}{_R_ON}"):
    PATTERNS.on(
        "send write file make submit produce prepare give create compile",
        rf" {ARTICLE}(?:short |written |full |brief )?report{_tail}",
    )(lambda match, scope: _report(match["to"], match["on"], scope))
PATTERNS.on("send give", rf" (?P<to>.+?) {ARTICLE}(?:short |full )?report{_R_ON}")(
    lambda match, scope: _report(match["to"], match["on"], scope)
)


def _notify(to: str, text: str | None, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"to": scope.person(to)}
    said = scope.thing(text) if text and text.startswith("\x00") else " ".join((text or "").split()).strip(" .!\"'")
    if said:
        params["text"] = said
    return [Step("notify", params)]


PATTERNS.on("notify inform alert message", r" (?P<to>.+?)(?: that|:|,) (?P<text>.+)")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
PATTERNS.on("notify inform alert message", r" (?P<to>[^\x00]+?) (?P<text>\x00.+)")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
PATTERNS.on("notify inform alert message", r" (?P<to>.+?)(?: (?:about|of) .+)?")(lambda m, s: _notify(m["to"], None, s))
PATTERNS.on("send", rf" {ARTICLE}(?:message|notification|alert) to (?P<to>.+?)(?:(?: saying| that|:) (?P<text>.+))?")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
PATTERNS.on("let", r" (?P<to>.+?) know(?: (?:that )?(?P<text>.+))?")(
    lambda m, s: _notify(m["to"], None if lx.noun(m["to"]) in ("me", "us") else m["text"], s)
)


@PATTERNS.on(
    "tell",
    (
        r" (?:me|us) (?:how many|the number of) (?P<t>.+?)(?: there)?(?: (?:are|is|you (?:see|"
        r"find)))?(?: (?:there )?(?:in|on|at) (?P<a>.+))?"
    ),
)
def _how_many(match: Match, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"target": scope.thing(match["t"])}
    if match["a"]:
        params["area"] = scope.thing(match["a"])
    return [Step("count", params), Step("notify", {"to": "operator"})]


@PATTERNS.on("tell", r" (?P<to>[^\x00]+?)(?:(?: that|:|,)? (?P<text>\x00.+| ?.+))?")
def _tell(match: Match, _: Scope) -> list[Step] | None:
    if lx.noun(match["to"]) in ("me", "us"):
        return [Step("notify", {"to": "operator"})]
    return None


PATTERNS.on("tell", r" (?P<to>.+?)(?: that|:) (?P<text>.+)")(lambda m, s: _notify(m["to"], m["text"], s))


def _say(text: str, to: str | None, scope: Scope) -> list[Step]:
    said = scope.thing(text) if "\x00" in text else " ".join(text.split()).strip(" .!\"'")
    return [Step("say", {"text": said} | ({"to": scope.person(to)} if to else {}))]


PATTERNS.on("say announce", r"(?: (?:out loud|aloud))?:? (?P<text>\x00\d+\x00)(?: to (?P<to>.+))?")(
    lambda m, s: _say(m["text"], m["to"], s)
)
PATTERNS.on("say announce", r" to (?P<to>[^\x00:]+?)(?::| that|,)? (?P<text>\x00\d+\x00)")(
    lambda m, s: _say(m["text"], m["to"], s)
)
PATTERNS.on("say announce", r" to (?P<to>[^\x00:]+?)(?::| that) (?P<text>.+)")(lambda m, s: _say(m["text"], m["to"], s))
PATTERNS.on("tell", r" (?P<to>[^\x00:]+?)(?::| that|,)? (?P<text>\x00\d+\x00)")(
    lambda m, s: _say(m["text"], m["to"], s)
)
PATTERNS.on("say announce", r"(?: that|:)? (?P<text>.+?)(?: to (?P<to>.+))?")(lambda m, s: _say(m["text"], m["to"], s))


def _ask(text: str, to: str | None, scope: Scope) -> list[Step]:
    asked = scope.thing(text) if "\x00" in text else " ".join(text.split())
    return [Step("ask", {"question": asked} | ({"to": scope.person(to)} if to else {}))]


PATTERNS.on("ask", r" (?P<to>[^\x00]+?)[:,]? (?P<q>\x00\d+\x00)")(lambda m, s: _ask(m["q"], m["to"], s))
PATTERNS.on("ask", r":? (?P<q>\x00\d+\x00)(?: (?:to|of) (?P<to>.+))?")(lambda m, s: _ask(m["q"], m["to"], s))
PATTERNS.on("ask", r" (?P<to>.+?),? (?P<q>(?:whether|if|what|where|when|how|which|who|why)\b.+)")(
    lambda m, s: _ask(m["q"], m["to"], s)
)


@PATTERNS.on("wait", r"(?: here| there)?(?: (?:for|until|till) (?P<e>.+))?")
def _wait(match: Match, scope: Scope) -> list[Step]:
    event = " ".join((match["e"] or "").split()).strip(" .!")
    if not event:
        return [Step("hold")]
    return [
        Step(
            "wait_for",
            {"event": scope.thing(event) if "\x00" in event else event.lower() if event.isupper() else event},
        )
    ]


@PATTERNS.on("guide lead escort accompany show take walk", r" (?P<p>.+?) (?:the way )?to (?P<to>.+)")
def _guide(match: Match, scope: Scope) -> list[Step] | None:
    verb = match[0].split()[0].lower()
    if verb in ("take", "walk") and not scope.is_person(match["p"]):
        return None
    return [Step("guide", {"person": scope.person(match["p"]), "place": scope.place(match["to"])})]
