"""Verb phrases of handling things: picking, putting, bringing, handing over, and what hands do otherwise.

Apart from `phrases` because delivery has rules of its own (annotation rule 2): fetching X from A and bringing it to B
is goto(A), pick(X), goto(B), and then place, give or handover by what B is.
"""

import re
from typing import Any

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules.phrases import Match, Patterns, Scope, Step

PATTERNS = Patterns()

_FROM = r"(?:from|out of|off)"
_IN = r"(?:in|into|on|onto|at|inside|on top of|beside|next to|under|by|to)"


def _at(text: str | None, scope: Scope) -> str:
    return scope.place(text) if text else ""


def _pick(match: Match, scope: Scope) -> list[Step]:
    groups = match.groupdict()
    where = _at(groups.get("from"), scope)
    return [Step("pick", {"object": scope.thing(each)}, at=where) for each in lx.things(match["o"])]


def _deliver(objects: str, source: str | None, to: str, scope: Scope, *, held: bool = False) -> list[Step] | None:
    """Return pick at the source, then the way to `to` and place, give or hand over."""
    inside = re.fullmatch(r"(?P<p>.+?) (?:in|at) (?P<where>.+)", to, re.IGNORECASE)
    steps: list[Step] = []
    for each in lx.things(objects):
        thing = scope.cargo(each)
        if not held:
            steps.append(Step("pick", {"object": thing}, at=_at(source, scope), fetch=lx.noun(each) in ("it", "them")))
        if (robot := scope.robot(to)) is not None:
            steps.append(Step("handover", {"object": thing, "to": robot}))
        elif inside and scope.is_person(inside["p"]):
            steps.append(
                Step("give", {"object": thing, "to": scope.person(inside["p"])}, at=scope.place(inside["where"]))
            )
        elif scope.is_person(to):
            steps.append(Step("give", {"object": thing, "to": scope.person(to)}))
        else:
            place = scope.place(to)
            steps.append(Step("place", {"object": thing, "at": place}, at=place))
    return steps


_CARRY = "bring take carry deliver transport haul transfer move fetch get return"
_MOVE = "bring carry deliver transport haul transfer move get fetch"
PATTERNS.on(
    _CARRY,
    rf" (?P<o>.+?) {_FROM} (?P<a>.+?)(?:,? and (?:bring|take|carry|deliver) (?:it|them))? (?:over |back )?to (?P<b>.+)",
)(lambda m, s: _deliver(m["o"], m["a"], m["b"], s))
PATTERNS.on(_CARRY, rf" (?P<o>.+?) (?:over |back )?to (?P<b>.+?) {_FROM} (?P<a>.+)")(
    lambda m, s: _deliver(m["o"], m["a"], m["b"], s)
)
PATTERNS.on("fetch retrieve collect grab", rf"(?: up)? (?P<o>.+?)(?: (?:{_FROM}|at|in|on) (?P<from>.+))?")(_pick)
PATTERNS.on("get take", rf" (?P<o>.+?) {_FROM} (?P<from>.+)")(_pick)
PATTERNS.on("pick", rf"(?: up)? (?P<o>.+?)(?: up)?(?: (?:{_FROM}|at|in|on) (?P<from>.+))?")(_pick)
PATTERNS.on("grasp lift get", rf"(?: up| hold of)? (?P<o>.+?)(?: (?:{_FROM}|at|on) (?P<from>.+))?")(_pick)
PATTERNS.on(_CARRY, r" (?P<o>.+?) (?:over |back )?to (?P<b>.+)")(lambda m, s: _deliver(m["o"], None, m["b"], s))


@PATTERNS.on(
    "bring fetch get",
    (
        r" (?P<p>[A-Z][\w.]*(?: [A-Z][\w.]*)?|me|us|him|her|them|the \w+) (?P<o>(?:an?|the|some|"
        r"his|her|two|three) .+?)(?: (?:from|out of) (?P<a>.+))?"
    ),
)
def _bring_person(match: Match, scope: Scope) -> list[Step] | None:
    return _deliver(match["o"], match["a"], match["p"], scope)


def _put(match: Match, scope: Scope) -> list[Step]:
    prep = match["prep"].lower()
    target = match["b"]
    steps: list[Step] = []
    for each in lx.things(match["o"]):
        step = Step("place", {"object": scope.cargo(each), "at": scope.place(target)}, fetch=True)
        if prep == "at" or scope.known_place(target):
            step.at = step.params["at"]
        steps.append(step)
    return steps


PATTERNS.on(
    "put place set lay drop load store stow stack leave", rf"(?: down)? (?P<o>.+?)(?: down)? (?P<prep>{_IN}) (?P<b>.+)"
)(_put)
PATTERNS.on("put set drop place", rf" (?P<o>it|them) down (?P<prep>{_IN}) (?P<b>.+)")(_put)


def _hand(match: Match, scope: Scope) -> list[Step] | None:
    to = match["to"]
    robot = scope.robot(to)
    if robot is not None:
        return [Step("handover", {"object": scope.cargo(match["o"]), "to": robot})]
    return [Step("give", {"object": scope.cargo(match["o"]), "to": scope.person(to)})]


PATTERNS.on("hand pass give", r"(?: over)? (?P<o>.+?)(?: over)? to (?P<to>.+)")(_hand)
PATTERNS.on(
    "give hand pass",
    r" (?P<to>[A-Z][\w.]*(?: [A-Z][\w.]*)?|me|us|him|her|it|the \w+) (?P<o>(?:an?|the|some|his|her|it) ?.*)",
)(_hand)


def _simple(lemmas: str, tail: str, skill: str) -> None:
    def maker(match: Match, scope: Scope) -> list[Step]:
        groups = match.groupdict()
        at = _at(groups.get("loc"), scope)
        steps: list[Step] = []
        for each in lx.things(match["o"]):
            params: dict[str, Any] = {"object": scope.thing(each)}
            if groups.get("to"):
                params["into" if skill == "pour" else "to"] = scope.thing(groups["to"])
            steps.append(Step(skill, params, at=at))
        return steps

    PATTERNS.on(lemmas, tail)(maker)


_LOC = r"(?: (?:at|in|inside) (?P<loc>.+?))?"
_simple("push pull slide drag shove", r" (?P<o>.+?)(?: (?:to|into|towards?|onto|over to) (?P<to>.+))?", "push")
_simple("open", rf"(?: up)? (?P<o>.+?){_LOC}", "open")
_simple("close shut", rf" (?P<o>.+?){_LOC}", "close")
_simple("cut slice trim chop", rf"(?: up)? (?P<o>.+?){_LOC}", "cut")
_simple(
    "clean wash wipe sweep vacuum scrub mop dust rinse",
    rf"(?: (?:down|up|off|out))? (?P<o>.+?)(?: down)?{_LOC}",
    "clean",
)
_simple("pour decant tip", r" (?P<o>.+?) (?:into|in) (?P<to>.+)", "pour")
for _word, _skill in (("on", "switch_on"), ("off", "switch_off")):
    _simple("switch turn power", rf" {_word} (?P<o>.+?){_LOC}", _skill)
    _simple("switch turn power", rf" (?P<o>.+?) {_word}{_LOC}", _skill)
_simple(
    "fasten screw bolt attach mount tighten", r"(?: down)? (?P<o>.+?)(?: (?:to|onto|on|into) (?P<to>.+))?", "fasten"
)
_simple("unfasten unscrew unbolt loosen detach", rf" (?P<o>.+?){_LOC}", "unfasten")

# Going comes last: "move" and "take" mean it only when nothing is moved or taken.
PATTERNS.on(
    "go drive walk fly head proceed travel navigate move roll advance run set continue make come get return",
    (
        r" (?:(?:straight|directly|over|up|down|back|on|out|off|along|quickly|slowly|your way|"
        r"its way|their way) )*(?:to|towards?|into|for) (?P<p>.+)"
    ),
)(lambda m, s: [Step("goto", {"place": s.place(each)}) for each in lx.things(m["p"])])
PATTERNS.on("go drive walk fly", r" (?:down|up|along|through) (?P<p>.+)")(
    lambda m, s: [Step("goto", {"place": s.place(m["p"])})]
)
PATTERNS.on("go drive fly walk head", r" there")(lambda _, s: [Step("goto", {"place": s.place("there")})])
PATTERNS.on("visit reach", r" (?P<p>.+)")(
    lambda m, s: [Step("goto", {"place": s.place(each)}) for each in lx.things(m["p"])]
)
