"""The grammar of verb phrases: patterns by verb, and the steps of a plan that each stands for.

A pattern is matched against "base-form rest" of one clause, quantities already taken out. Patterns of one verb are
tried in order, the most specific first. What a step's parameters hold is still text of the instruction; pronouns are
resolved by the `Scope`, since only it knows what was mentioned before. The parts, in the order in which they are tried:

- sensing, and work on what was sensed (perception, media, learning): fixed nouns ("extract frames", "encode the clip")
  stand before the general patterns of the same verbs.
- telling: reports, messages, saying, asking, waiting for people, guiding. Telling the one who gave the order is a
  message to the operator; `report` is for a report that is asked for.
- moving: navigation of one robot, and what several do together. A joint skill is one step whose `robots` lists all that
  take part.
- handling things. Delivery has rules of its own (annotation rule 2): fetching X from A and bringing it to B is goto(A),
  pick(X), goto(B), and then place, give or handover by what B is. Going comes last: "move" and "take" mean it only when
  nothing is moved or taken.

The built-in grammar knows the built-in skills. A skill in a folder of an operator's own is asked for by one of its
manifest's phrases and, where it has a parameter of text, the thing behind it: "polish the handrail at dock 2".
"""

import re
from collections.abc import Callable
from typing import Any, Protocol

from msgspec import Struct, field

from appliance.llm.rules import lexicon as lx
from appliance.llm.words import forms
from appliance.skills.catalogue import SKILLS, Catalogue, SkillManifest


class Step(Struct):
    """One thing to do. `at`: where the robot must be for it. `fetch`: pick `object` first unless it is held."""

    skill: str
    params: dict[str, Any] = field(default_factory=dict[str, Any])
    at: str = ""
    fetch: bool = False


class Scope(Protocol):
    """What the patterns ask about the conversation so far."""

    def thing(self, text: str) -> str:
        """Resolve an object, pronouns included."""
        ...

    def cargo(self, text: str) -> str:
        """Resolve what is put down or handed over, "it" being the thing held."""
        ...

    def place(self, text: str) -> str:
        """Resolve a place; "there" is the last one."""
        ...

    def person(self, text: str) -> str:
        """Resolve somebody; "me" and "us" are the operator."""
        ...

    def robot(self, text: str) -> str | None:
        """Return the robot a text names, or None."""
        ...

    def is_person(self, text: str) -> bool:
        """Whether a text names a person rather than a place."""
        ...

    def known_place(self, text: str) -> bool:
        """Whether the site knows a place of that name."""
        ...

    def group(self, text: str) -> list[str]:
        """Return the robots a text names; "themselves", "" and the like are those spoken to."""
        ...

    def model(self) -> str:
        """Return the model last spoken of."""
        ...


Match = re.Match[str]
Maker = Callable[[Match, Scope], list[Step] | None]

LOCATION = r"(?: (?:at|in|inside) (?P<loc>(?!order\b|parallel\b).+?))?"
"""Where it is done, said after the object."""
ARTICLE = r"(?:(?:the|a|an|its|his|her|their|your|my|our|any|some|one) )?"
PICTURES = r"(?:photos?|photographs?|pictures?|stills?|snapshots?|images?|shots?|snaps?)"
ROUTES = r"(?:routes?|paths?|trails?|tracks?|waypoints?|trajector(?:y|ies)|way)"


class Patterns:
    """The patterns of one part of the grammar, by verb."""

    def __init__(self) -> None:
        self._table: dict[str, list[tuple[re.Pattern[str], Maker]]] = {}

    def on(self, lemmas: str, tail: str) -> Callable[[Maker], Maker]:
        """Register a maker for these verbs followed by `tail`, a regular expression up to the end of the clause."""

        def register(maker: Maker) -> Maker:
            for lemma in lemmas.split():
                pattern = re.compile(f"{lemma}{tail}", re.IGNORECASE | re.DOTALL)
                self._table.setdefault(lemma, []).append((pattern, maker))
            return maker

        return register

    def fixed(self, lemmas: str, tail: str, skill: str) -> None:
        """Register verbs that mean a skill without parameters."""

        def maker(match: Match, scope: Scope) -> list[Step]:
            del match, scope
            return [Step(skill)]

        self.on(lemmas, tail)(maker)

    def simple(self, lemmas: str, tail: str, skill: str, **slots: str) -> None:
        """Register verbs whose slots are one object each (parameter=group); group `loc` is the place to be at.

        Several things in the first slot ("pump 3 and pump 4") are one step each.
        """

        def maker(match: Match, scope: Scope) -> list[Step]:
            groups = match.groupdict()
            at = scope.place(groups["loc"]) if groups.get("loc") else ""
            main = next(iter(slots), "")
            steps: list[Step] = []
            for each in lx.things(groups.get(slots[main]) or "") if main else [""]:
                said = {name: each if name == main else groups.get(slot) for name, slot in slots.items()}
                params = {name: scope.thing(text) for name, text in said.items() if text}
                steps.append(Step(skill, {name: value for name, value in params.items() if value}, at=at))
            return steps

        self.on(lemmas, tail)(maker)

    def match(self, lemma: str, text: str, scope: Scope) -> tuple[list[Step], str] | None:
        """Return the steps of a verb phrase and the words before its first slot, or None when no pattern fits."""
        for pattern, maker in self._table.get(lemma, ()):
            if match := pattern.fullmatch(text):
                steps = maker(match, scope)
                if steps:
                    starts = [match.start(name) for name, value in match.groupdict().items() if value]
                    return steps, text[: min(starts, default=len(text))].strip()
        return None


SENSING = Patterns()


# --- learning and media: fixed nouns, so before the general patterns of the same verbs -----------------------------

SENSING.simple(
    "extract sample grab decode",
    (
        r" (?:the |some )?(?:video )?frames?(?: (?:from|of|out of) (?:the |this |that )?(?:video|"
        r"recording|clip|footage|film))?"
    ),
    "extract_frames",
)
SENSING.simple(
    "extract sample grab decode",
    r" (?:the |some )?(?:video )?frames? (?:from|of|out of) (?P<s>.+)",
    "extract_frames",
    source="s",
)
SENSING.simple("decode", r" (?P<s>\S+\.\w+)(?: and sample frames)?", "extract_frames", source="s")
SENSING.simple("encode", r" .*", "encode_clip")
SENSING.simple("classify", r" .*", "classify_action")
SENSING.simple(
    "preprocess denoise",
    r"(?: and segment)?(?: (?:the |this |that )?(?:audio|recording|sound|it|them|both))?",
    "preprocess_audio",
)
SENSING.simple("preprocess denoise", r"(?: and segment)? (?P<s>.+)", "preprocess_audio", source="s")
SENSING.simple(
    "run start perform",
    r" (?:the )?audio pre-?processing(?: (?:on|of|for) (?:it|the (?:audio|recording)))?",
    "preprocess_audio",
)
SENSING.simple("run start perform", r" (?:the )?transcription.*", "transcribe")
SENSING.simple("run start perform", r" (?:the )?frame extraction.*", "extract_frames")
SENSING.simple("transcribe", r"(?: .+)?", "transcribe")
SENSING.simple("correct", r" .+", "correct_text")


@SENSING.on(
    "train",
    (
        r"(?: locally)? (?P<m>.+?)(?: locally)?(?: (?:on|with|using) (?:its|their|your|the robots?'?|"
        r"local|each robot's) (?:own )?.*data)?(?: locally)?(?: (?:on|with) (?P<on>[A-Za-z][\w-]*(?: "
        r"(?:\d+|[A-Z]))?))?(?: locally)?"
    ),
)
def _train(match: Match, scope: Scope) -> list[Step] | None:
    model = match["m"]
    model = scope.model() if lx.noun(model) in ("it", "model", "them") else scope.thing(model)
    step = Step("train_local", {"model": model})
    if match["on"]:
        named = scope.group(match["on"])
        robot = scope.robot(match["on"]) or (named[0] if len(named) == 1 and match["on"][0].isupper() else None)
        if robot is None:
            return None
        step.params["_robot"] = robot
    return [step]


@SENSING.on("run do perform", r" (?:(?:a |one )?rounds? of )?(?:of )?local training (?:on|of|for) (?P<m>.+)")
def _training(match: Match, scope: Scope) -> list[Step]:
    return [Step("train_local", {"model": scope.thing(match["m"])})]


@SENSING.on("aggregate", r"(?: (?:the |all |both )*updates(?: (?:for|of) (?P<u>.+))?| (?P<m>.+))?")
def _aggregate(match: Match, scope: Scope) -> list[Step]:
    named = match["u"] or match["m"] or ""
    pronoun = lx.noun(named) in ("", "it", "them", "model", "models", "results")
    return [Step("aggregate", {"model": scope.model() if pronoun else scope.thing(named)})]


@SENSING.on("evaluate test validate", r" (?P<m>.+?)(?: (?:on|with|against) .+)?")
def _evaluate(match: Match, scope: Scope) -> list[Step]:
    pronoun = lx.noun(match["m"]) in ("it", "model", "result", "new model", "global model")
    return [Step("evaluate", {"model": scope.model() if pronoun else scope.thing(match["m"])})]


# --- perception -----------------------------------------------------------------------------------------------------


@SENSING.on(
    "take get grab shoot snap capture make like want",
    rf" (?:(?P<n>{lx.NUMBER}) )?{ARTICLE}(?:[\w-]+ )?{PICTURES} (?:of|showing) (?P<t>.+?){LOCATION}",
)
def _pictures(match: Match, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"target": scope.thing(match["t"])}
    if match["n"] and (value := lx.number(match["n"])) and value > 1:
        params["count"] = int(value)
    return [Step("photograph", params, at=scope.place(match["loc"]) if match["loc"] else "")]


@SENSING.on("take get snap", rf" (?:(?P<n>{lx.NUMBER}) )?{ARTICLE}{PICTURES}(?: there)?")
def _picture_here(match: Match, scope: Scope) -> list[Step] | None:
    target = scope.place("there")
    params: dict[str, Any] = {"target": target}
    if match["n"] and (value := lx.number(match["n"])) and value > 1:
        params["count"] = int(value)
    return [Step("photograph", params)] if target else None


SENSING.simple("photograph snap picture", rf" (?P<t>.+?){LOCATION}", "photograph", target="t")
SENSING.simple(
    "take make do get perform run conduct",
    rf" {ARTICLE}thermal (?:scan|image|picture)s? of (?P<t>.+?)",
    "scan_thermal",
    asset="t",
)
SENSING.simple("scan", r" (?P<t>.+?) (?:thermally|with (?:the|a) thermal camera|for heat)", "scan_thermal", asset="t")
SENSING.simple(
    "record", rf" (?:some |the )?(?:audio|sound)(?: (?:of|from) (?P<t>.+?))?{LOCATION}", "record_audio", target="t"
)
SENSING.simple("record", r" (?:the )?sound of (?P<t>.+)", "record_audio", target="t")
SENSING.simple(
    "record take shoot make",
    rf" {ARTICLE}(?:video|film|footage|clip)(?: clip)?s? of (?P<t>.+?){LOCATION}",
    "record_video",
    target="t",
)
SENSING.simple("film video videotape record", rf" (?P<t>.+?){LOCATION}", "record_video", target="t")
SENSING.simple(
    "look search hunt",
    r" for (?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "find",
    target="t",
    area="a",
)
SENSING.simple("search", r" (?P<a>.+?) for (?P<t>.+)", "find", target="t", area="a")
SENSING.simple(
    "find locate", r" (?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?", "find", target="t", area="a"
)
SENSING.simple(
    "detect spot identify",
    r" (?:all |any )?(?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "detect",
    target="t",
    area="a",
)
SENSING.simple(
    "count",
    r" (?:up )?(?:all |how many )?(?P<t>.+?)(?: (?:there )?are)?(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "count",
    target="t",
    area="a",
)
SENSING.simple("track", rf" (?P<t>.+?){LOCATION}", "track", target="t")
SENSING.simple("keep", r" (?P<t>.+?) (?:tracked|in sight|in view|located)", "track", target="t")
SENSING.simple("keep", r" (?:track of|an eye on) (?P<t>.+?)", "track", target="t")
SENSING.simple("read", rf" (?:off |out )?(?P<t>.+?){LOCATION}", "read", target="t")
SENSING.simple("scan", rf" (?P<t>.*\b(?:bar ?code|label|qr code|tag|code)s?(?: .+?)?){LOCATION}", "read", target="t")


@SENSING.on(
    "match register",
    (
        r" (?:the |this |your |its )?(?:current |present )?(?:scene|view|image|picture|surroundings)"
        r" (?:against|with|to|on) (?P<d>.+?)(?: (?:data ?sets?|maps?))?"
    ),
)
def _scene(match: Match, scope: Scope) -> list[Step]:
    names = [
        scope.thing(re.sub(r"\s*data ?sets?$", "", each)) for each in re.split(r",\s*(?:and )?|\s+and\s+", match["d"])
    ]
    return [Step("match_scene", {"datasets": [each for each in names if each]})]


SENSING.simple("measure", rf" (?P<q>.+?) (?:of|from) (?P<t>.+?){LOCATION}", "measure", quantity="q", target="t")
SENSING.simple("measure", rf" (?P<q>.+?){LOCATION}", "measure", quantity="q")
SENSING.simple(
    "take check",
    (
        rf" {ARTICLE}(?P<q>(?:temperature|gas level|noise level|sound level|humidity|pressure|radiation "
        rf"level)) (?:of|at|in) (?P<t>.+?)"
    ),
    "measure",
    quantity="q",
    target="t",
)
SENSING.simple("look", rf" (?P<t>.+?) over(?: for .+?)?{LOCATION}", "inspect", asset="t")
SENSING.simple("look", rf" over (?P<t>.+?)(?: for .+?)?{LOCATION}", "inspect", asset="t")
SENSING.simple("inspect examine", rf" (?P<t>.+?)(?: for .+?)?{LOCATION}", "inspect", asset="t")
SENSING.simple("check", rf" (?!that |if |whether )(?:on )?(?P<t>.+?)(?: for .+?){LOCATION}", "inspect", asset="t")
SENSING.simple("check", rf" (?!that |if |whether )(?P<t>.+?){LOCATION}", "inspect", asset="t")


@SENSING.on("compare", r" (?P<what>.+?)(?: (?:with|to|against) (?P<b>.+))?")
def _compare(match: Match, scope: Scope) -> list[Step]:
    baseline = lx.noun(match["b"] or "")
    return [
        Step("compare", {} if baseline in ("", "each other", "one another") else {"baseline": scope.thing(baseline)})
    ]


TELLING = Patterns()


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
    TELLING.on("report", _tail)(lambda match, scope: _report(match["to"], match["on"], scope))
for _tail in (rf"{_R_ON}{_R_TO}", rf"{_R_TO}{_R_ON}"):
    TELLING.on(
        "send write file make submit produce prepare give create compile",
        rf" {ARTICLE}(?:short |written |full |brief )?report{_tail}",
    )(lambda match, scope: _report(match["to"], match["on"], scope))
TELLING.on("send give", rf" (?P<to>.+?) {ARTICLE}(?:short |full )?report{_R_ON}")(
    lambda match, scope: _report(match["to"], match["on"], scope)
)


def _notify(to: str, text: str | None, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"to": scope.person(to)}
    said = scope.thing(text) if text and text.startswith("\x00") else " ".join((text or "").split()).strip(" .!\"'")
    if said:
        params["text"] = said
    return [Step("notify", params)]


TELLING.on("notify inform alert message", r" (?P<to>.+?)(?: that|:|,) (?P<text>.+)")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
TELLING.on("notify inform alert message", r" (?P<to>[^\x00]+?) (?P<text>\x00.+)")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
TELLING.on("notify inform alert message", r" (?P<to>.+?)(?: (?:about|of) .+)?")(lambda m, s: _notify(m["to"], None, s))
TELLING.on("send", rf" {ARTICLE}(?:message|notification|alert) to (?P<to>.+?)(?:(?: saying| that|:) (?P<text>.+))?")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
TELLING.on("let", r" (?P<to>.+?) know(?: (?:that )?(?P<text>.+))?")(
    lambda m, s: _notify(m["to"], None if lx.noun(m["to"]) in ("me", "us") else m["text"], s)
)


@TELLING.on(
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


@TELLING.on("tell", r" (?P<to>[^\x00]+?)(?:(?: that|:|,)? (?P<text>\x00.+| ?.+))?")
def _tell(match: Match, _: Scope) -> list[Step] | None:
    if lx.noun(match["to"]) in ("me", "us"):
        return [Step("notify", {"to": "operator"})]
    return None


TELLING.on("tell", r" (?P<to>.+?)(?: that|:) (?P<text>.+)")(lambda m, s: _notify(m["to"], m["text"], s))


def _say(text: str, to: str | None, scope: Scope) -> list[Step]:
    said = scope.thing(text) if "\x00" in text else " ".join(text.split()).strip(" .!\"'")
    return [Step("say", {"text": said} | ({"to": scope.person(to)} if to else {}))]


TELLING.on("say announce", r"(?: (?:out loud|aloud))?:? (?P<text>\x00\d+\x00)(?: to (?P<to>.+))?")(
    lambda m, s: _say(m["text"], m["to"], s)
)
TELLING.on("say announce", r" to (?P<to>[^\x00:]+?)(?::| that|,)? (?P<text>\x00\d+\x00)")(
    lambda m, s: _say(m["text"], m["to"], s)
)
TELLING.on("say announce", r" to (?P<to>[^\x00:]+?)(?::| that) (?P<text>.+)")(lambda m, s: _say(m["text"], m["to"], s))
TELLING.on("tell", r" (?P<to>[^\x00:]+?)(?::| that|,)? (?P<text>\x00\d+\x00)")(lambda m, s: _say(m["text"], m["to"], s))
TELLING.on("say announce", r"(?: that|:)? (?P<text>.+?)(?: to (?P<to>.+))?")(lambda m, s: _say(m["text"], m["to"], s))


def _ask(text: str, to: str | None, scope: Scope) -> list[Step]:
    asked = scope.thing(text) if "\x00" in text else " ".join(text.split())
    return [Step("ask", {"question": asked} | ({"to": scope.person(to)} if to else {}))]


TELLING.on("ask", r" (?P<to>[^\x00]+?)[:,]? (?P<q>\x00\d+\x00)")(lambda m, s: _ask(m["q"], m["to"], s))
TELLING.on("ask", r":? (?P<q>\x00\d+\x00)(?: (?:to|of) (?P<to>.+))?")(lambda m, s: _ask(m["q"], m["to"], s))
TELLING.on("ask", r" (?P<to>.+?),? (?P<q>(?:whether|if|what|where|when|how|which|who|why)\b.+)")(
    lambda m, s: _ask(m["q"], m["to"], s)
)


@TELLING.on("wait", r"(?: here| there)?(?: (?:for|until|till) (?P<e>.+))?")
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


@TELLING.on("guide lead escort accompany show take walk", r" (?P<p>.+?) (?:the way )?to (?P<to>.+)")
def _guide(match: Match, scope: Scope) -> list[Step] | None:
    verb = match[0].split()[0].lower()
    if verb in ("take", "walk") and not scope.is_person(match["p"]):
        return None
    return [Step("guide", {"person": scope.person(match["p"]), "place": scope.place(match["to"])})]


MOVING = Patterns()


# --- navigation -----------------------------------------------------------------------------------------------------

_HOME = r"(?:home|(?:its |your |their |the )?(?:home|launch)(?: (?:position|point|base|location))?|(?:the )?base)"
MOVING.fixed("return go fly drive come head get", rf" (?:back )?(?:to )?{_HOME}", "return_home")
MOVING.fixed("return come", r"(?: back)?", "return_home")
MOVING.fixed("take lift", r" off", "takeoff")
MOVING.fixed("launch", r"", "takeoff")
MOVING.fixed("climb", r"", "takeoff")
MOVING.on("land", r"(?: (?:at|on) (?P<loc>.+)| there| here| safely)?")(
    lambda m, s: [Step("land", at=s.place(m["loc"]) if m["loc"] else "")]
)
MOVING.fixed("touch", r" down", "land")
MOVING.fixed(
    "hold hover stay remain stop pause",
    r"(?: (?:your |its |their )?(?:position|station|still|put|there|here|in place|where (?:you|it) (?:are|is)))*",
    "hold",
)
MOVING.on("hold hover stay remain wait", r" (?:position )?(?:at|in|over|above) (?P<loc>.+)")(
    lambda m, s: [Step("hold", at=s.place(m["loc"]))]
)
MOVING.on("patrol", r" (?:along |around |round )?(?P<a>.+)")(lambda m, s: [Step("patrol", {"area": s.thing(m["a"])})])
MOVING.on("do make drive fly walk run go", r" (?:laps )?(?:of|around|round) (?P<a>.+)")(
    lambda m, s: [Step("patrol", {"area": s.thing(m["a"])})]
)
MOVING.on("explore", r" (?P<a>.+)")(lambda m, s: [Step("explore", {"area": s.thing(m["a"])})])
MOVING.on("map survey", r" (?:out )?(?P<a>.+)")(lambda m, s: [Step("map_area", {"area": s.thing(m["a"])})])
MOVING.on("make build create draw", rf" {ARTICLE}map of (?P<a>.+)")(
    lambda m, s: [Step("map_area", {"area": s.thing(m["a"])})]
)
MOVING.on("localise localize", r"(?: (?:itself|yourself|themselves))?(?: (?:with|using|by|via) (?P<m>.+))?")(
    lambda m, s: [Step("localize", {"method": s.thing(m["m"])} if m["m"] else {})]
)
MOVING.on(
    "plan compute work calculate find determine",
    rf" (?:out )?{ARTICLE}(?:[\w-]+ )?{ROUTES} (?:to|for|towards) (?P<p>.+)",
)(lambda m, s: [Step("plan_route", {"place": s.place(m["p"])})])
MOVING.on("orbit circle", r" (?:around |round )?(?P<t>.+)")(lambda m, s: [Step("orbit", {"target": s.thing(m["t"])})])
MOVING.on("dock", r"(?: (?:at|with|on|onto|to|in|into) (?P<s>.+))?")(
    lambda m, s: [Step("dock", {"station": s.thing(m["s"])} if m["s"] else {})]
)
MOVING.on("follow traverse take drive walk fly", rf" (?:along )?(?P<p>.+? {ROUTES}(?: .+)?)")(
    lambda m, s: [Step("follow_path", {"path": s.thing(m["p"])})]
)
MOVING.on("traverse", r" (?P<p>.+)")(lambda m, s: [Step("follow_path", {"path": s.thing(m["p"])})])
MOVING.on("follow shadow", r" (?:behind |after )?(?P<t>.+)")(lambda m, s: [Step("follow", {"target": s.thing(m["t"])})])


# --- coordination ---------------------------------------------------------------------------------------------------


@MOVING.on(
    "meet gather assemble rendezvous converge come",
    r"(?: up| together)*(?: (?:at|in|by|on|near) (?P<p>.+?))(?: together)?",
)
def _rendezvous(match: Match, scope: Scope) -> list[Step] | None:
    robots = scope.group("")
    if len(robots) < 2 and robots != ["all"]:
        return None
    return [Step("rendezvous", {"robots": robots, "place": scope.place(match["p"])})]


def _form(match: Match, scope: Scope) -> list[Step]:
    return [Step("form_up", {"robots": scope.group(""), "formation": scope.thing(match["f"])})]


MOVING.on("form", rf"(?: up)?(?: (?:in|into))? {ARTICLE}(?P<f>.+?)(?: formation)?")(_form)
MOVING.on("line", r" up(?: in)? (?P<f>.+?)(?: formation)?")(_form)
MOVING.on("take keep hold fly assume adopt", rf"(?: up)?(?: in)? {ARTICLE}(?P<f>[\w -]+?) formation")(_form)


@MOVING.on("lift carry move bring take", r" (?:up )?(?P<o>.+?)(?: to (?P<to>.+?))?")
def _lift(match: Match, scope: Scope) -> list[Step] | None:
    robots = scope.group("")
    joint = re.search(r"\b(?:together|jointly)\b", match[0], re.IGNORECASE)
    if len(robots) < 2 or not (joint or match[0].lower().startswith("lift")):
        return None
    clean = {
        key: re.sub(r"\s*\b(?:together|jointly)\b", "", value) for key, value in match.groupdict().items() if value
    }
    params: dict[str, Any] = {"robots": robots, "object": scope.thing(clean["o"])}
    if clean.get("to"):
        params["to"] = scope.thing(clean["to"])
    return [Step("lift_together", params)]


@MOVING.on("split divide", r"(?: up)? (?P<a>.+?) (?:between|among|amongst|over) (?P<r>.+)")
def _split(match: Match, scope: Scope) -> list[Step] | None:
    robots = scope.group(match["r"])
    return [Step("split_area", {"area": scope.thing(match["a"]), "robots": robots})] if robots else None


MOVING.fixed("merge combine join", r" .*\b(?:maps?|detections|results|findings|them|it)\b.*", "merge_maps")


HANDLING = Patterns()

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
HANDLING.on(
    _CARRY,
    rf" (?P<o>.+?) {_FROM} (?P<a>.+?)(?:,? and (?:bring|take|carry|deliver) (?:it|them))? (?:over |back )?to (?P<b>.+)",
)(lambda m, s: _deliver(m["o"], m["a"], m["b"], s))
HANDLING.on(_CARRY, rf" (?P<o>.+?) (?:over |back )?to (?P<b>.+?) {_FROM} (?P<a>.+)")(
    lambda m, s: _deliver(m["o"], m["a"], m["b"], s)
)
HANDLING.on("fetch retrieve collect grab", rf"(?: up)? (?P<o>.+?)(?: (?:{_FROM}|at|in|on) (?P<from>.+))?")(_pick)
HANDLING.on("get take", rf" (?P<o>.+?) {_FROM} (?P<from>.+)")(_pick)
HANDLING.on("pick", rf"(?: up)? (?P<o>.+?)(?: up)?(?: (?:{_FROM}|at|in|on) (?P<from>.+))?")(_pick)
HANDLING.on("grasp lift get", rf"(?: up| hold of)? (?P<o>.+?)(?: (?:{_FROM}|at|on) (?P<from>.+))?")(_pick)
HANDLING.on(_CARRY, r" (?P<o>.+?) (?:over |back )?to (?P<b>.+)")(lambda m, s: _deliver(m["o"], None, m["b"], s))


@HANDLING.on(
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


HANDLING.on(
    "put place set lay drop load store stow stack leave", rf"(?: down)? (?P<o>.+?)(?: down)? (?P<prep>{_IN}) (?P<b>.+)"
)(_put)
HANDLING.on("put set drop place", rf" (?P<o>it|them) down (?P<prep>{_IN}) (?P<b>.+)")(_put)


def _hand(match: Match, scope: Scope) -> list[Step] | None:
    to = match["to"]
    robot = scope.robot(to)
    if robot is not None:
        return [Step("handover", {"object": scope.cargo(match["o"]), "to": robot})]
    return [Step("give", {"object": scope.cargo(match["o"]), "to": scope.person(to)})]


HANDLING.on("hand pass give", r"(?: over)? (?P<o>.+?)(?: over)? to (?P<to>.+)")(_hand)
HANDLING.on(
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

    HANDLING.on(lemmas, tail)(maker)


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
HANDLING.on(
    "go drive walk fly head proceed travel navigate move roll advance run set continue make come get return",
    (
        r" (?:(?:straight|directly|over|up|down|back|on|out|off|along|quickly|slowly|your way|"
        r"its way|their way) )*(?:to|towards?|into|for) (?P<p>.+)"
    ),
)(lambda m, s: [Step("goto", {"place": s.place(each)}) for each in lx.things(m["p"])])
HANDLING.on("go drive walk fly", r" (?:down|up|along|through) (?P<p>.+)")(
    lambda m, s: [Step("goto", {"place": s.place(m["p"])})]
)
HANDLING.on("go drive fly walk head", r" there")(lambda _, s: [Step("goto", {"place": s.place("there")})])
HANDLING.on("visit reach", r" (?P<p>.+)")(
    lambda m, s: [Step("goto", {"place": s.place(each)}) for each in lx.things(m["p"])]
)


_PARTS = (SENSING, TELLING, MOVING, HANDLING)


def steps_of(lemma: str, rest: str, scope: Scope) -> tuple[list[Step], str] | None:
    """Return the steps of "verb rest" and the words before its first slot, or None when no pattern fits."""
    text = f"{lemma} {rest}".strip()
    for part in _PARTS:
        if found := part.match(lemma, text, scope):
            return found
    return None


class AddedSkills:
    """The skills of a catalogue that are not built in, with the patterns of their phrases, longest first.

    Args:
        manifests: of the skills; those without phrases cannot be asked for.
    """

    def __init__(self, manifests: tuple[SkillManifest, ...]) -> None:
        phrases = sorted(
            ((phrase, each) for each in manifests for phrase in each.phrases), key=lambda pair: -len(pair[0])
        )
        self._patterns = [(_pattern(phrase, each), each) for phrase, each in phrases]
        self.verbs = frozenset(form for phrase, _ in phrases for form in forms(phrase.split()[0]))
        """First words of the phrases, in all forms."""

    def __bool__(self) -> bool:
        """Whether there are any phrases."""
        return bool(self._patterns)

    @staticmethod
    def of(catalogue: Catalogue) -> "AddedSkills":
        """Return those of a catalogue."""
        return AddedSkills(tuple(each for each in catalogue.skills.values() if each.folder.parent != SKILLS))

    def step(self, text: str, scope: Scope) -> Step | None:
        """Return the step that a clause without subject and quantities asks for, or None."""
        for pattern, manifest in self._patterns:
            if match := pattern.fullmatch(text.strip(" ,")):
                groups = match.groupdict()
                params = {name: scope.thing(groups["what"]) for name in _texts(manifest)[:1] if groups.get("what")}
                at = scope.place(groups["loc"]) if groups.get("loc") else ""
                return Step(manifest.id, params, at=at)
        return None


def _texts(manifest: SkillManifest) -> list[str]:
    """The parameters of text, those that are required first."""
    texts = [name for name, each in manifest.params.items() if each.type == "string"]
    return sorted(texts, key=lambda name: not manifest.params[name].required)


def _pattern(phrase: str, manifest: SkillManifest) -> re.Pattern[str]:
    verb, *rest = phrase.split()
    words = [f"(?:{'|'.join(map(re.escape, sorted(forms(verb))))})"]
    words += [f"{ARTICLE}{re.escape(word)}" for word in rest if word not in ("the", "a", "an")]
    texts = _texts(manifest)
    thing = r" (?P<what>.+?)" if texts else ""
    if texts and not manifest.params[texts[0]].required:
        thing = f"(?:{thing})?"
    return re.compile(f"{' '.join(words)}{thing}{LOCATION}", re.IGNORECASE)
