"""What a verb phrase asks for: patterns of plain imperative forms, each with the steps that it stands for.

A pattern is matched against "base-form rest" of one clause, quantities already taken out. Patterns of one verb are
tried in order, the most specific first. What a step's parameters hold is still text of the instruction; pronouns
are resolved by the `Scope`, since only it knows what was mentioned before.
"""

import re
from collections.abc import Callable
from typing import Any, Protocol

from msgspec import Struct, field

from appliance.llm.rules import lexicon as lx


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
_TABLE: dict[str, list[tuple[re.Pattern[str], Maker]]] = {}

_LOC = r"(?: (?:at|in|inside) (?P<loc>(?!order\b|parallel\b).+?))?"
_TO = r"(?:to|towards?|into)"
_WAY = r"(?:(?:straight|directly|over|up|down|back|on|out|off|along|across|round|around|quickly|slowly|carefully|its way|your way|their way) )*"
_A = r"(?:(?:the|a|an|its|his|her|their|your|my|our|any|some|one) )?"
_PIC = r"(?:photos?|photographs?|pictures?|stills?|snapshots?|images?|shots?|snaps?)"
_ROUTE = r"(?:routes?|paths?|trails?|tracks?|waypoints?|trajector(?:y|ies)|way)"


def on(lemmas: str, tail: str) -> Callable[[Maker], Maker]:
    """Register a maker for these verbs followed by `tail` (a regular expression up to the end of the clause)."""

    def register(maker: Maker) -> Maker:
        for lemma in lemmas.split():
            _TABLE.setdefault(lemma, []).append((re.compile(f"{lemma}{tail}", re.IGNORECASE | re.DOTALL), maker))
        return maker

    return register


def steps_of(lemma: str, rest: str, scope: Scope) -> tuple[list[Step], str] | None:
    """Return the steps of a verb phrase and the words before its first slot, or None when no pattern fits."""
    text = f"{lemma} {rest}".strip()
    for pattern, maker in _TABLE.get(lemma, ()):
        if match := pattern.fullmatch(text):
            steps = maker(match, scope)
            if steps:
                starts = [match.start(name) for name, value in match.groupdict().items() if value]
                return steps, text[: min(starts, default=len(text))].strip()
    return None


def _simple(lemmas: str, tail: str, skill: str, **slots: str) -> None:
    """Register a verb whose slots are one object each; `loc` becomes the place to be at."""

    def maker(match: Match, scope: Scope) -> list[Step]:
        groups = match.groupdict()
        params = {name: scope.thing(groups[slot]) for name, slot in slots.items() if groups.get(slot)}
        at = scope.place(groups["loc"]) if groups.get("loc") else ""
        return [Step(skill, {k: v for k, v in params.items() if v}, at=at)]

    on(lemmas, tail)(maker)


# --- learning and media: fixed nouns, so before the general patterns of the same verbs -----------------------------

_simple(
    "extract sample grab decode",
    r" (?:the |some )?(?:video )?frames?(?: (?:from|of|out of) (?:the |this |that )?(?:video|recording|clip|footage|film))?",
    "extract_frames",
)
_simple(
    "extract sample grab decode",
    r" (?:the |some )?(?:video )?frames? (?:from|of|out of) (?P<s>.+)",
    "extract_frames",
    source="s",
)
_simple("decode", r" (?P<s>\S+\.\w+)(?: and sample frames)?", "extract_frames", source="s")
_simple("encode", r" .*", "encode_clip")
_simple("classify", r" .*", "classify_action")
_simple(
    "preprocess denoise",
    r"(?: and segment)?(?: (?:the |this |that )?(?:audio|recording|sound|it|them|both))?",
    "preprocess_audio",
)
_simple("preprocess denoise", r"(?: and segment)? (?P<s>.+)", "preprocess_audio", source="s")
_simple(
    "run start perform",
    r" (?:the )?audio pre-?processing(?: (?:on|of|for) (?:it|the (?:audio|recording)))?",
    "preprocess_audio",
)
_simple("run start perform", r" (?:the )?transcription.*", "transcribe")
_simple("run start perform", r" (?:the )?frame extraction.*", "extract_frames")
_simple("transcribe", r"(?: .+)?", "transcribe")
_simple("correct", r" .+", "correct_text")


@on(
    "train",
    r"(?: locally)? (?P<m>.+?)(?: locally)?(?: (?:on|with|using) (?:its|their|your|the robots?'?|local|each robot's) (?:own )?.*data)?(?: locally)?(?: (?:on|with) (?P<on>[A-Za-z][\w-]*(?: (?:\d+|[A-Z]))?))?(?: locally)?",
)
def _train(match: Match, scope: Scope) -> list[Step] | None:
    model = match["m"]
    model = scope.model() if lx.noun(model) in ("it", "model", "them") else scope.thing(model)
    step = Step("train_local", {"model": model})
    if match["on"]:
        robot = scope.robot(match["on"])
        if robot is None:
            return None
        step.params["_robot"] = robot
    return [step]


@on("run do perform", r" (?:(?:a |one )?rounds? of )?(?:of )?local training (?:on|of|for) (?P<m>.+)")
def _training(match: Match, scope: Scope) -> list[Step]:
    return [Step("train_local", {"model": scope.thing(match["m"])})]


@on("aggregate", r"(?: (?:the |all |both )*updates(?: (?:for|of) (?P<u>.+))?| (?P<m>.+))?")
def _aggregate(match: Match, scope: Scope) -> list[Step]:
    named = match["u"] or match["m"] or ""
    pronoun = lx.noun(named) in ("", "it", "them", "model", "models", "results")
    return [Step("aggregate", {"model": scope.model() if pronoun else scope.thing(named)})]


@on("evaluate test validate", r" (?P<m>.+?)(?: (?:on|with|against) .+)?")
def _evaluate(match: Match, scope: Scope) -> list[Step]:
    pronoun = lx.noun(match["m"]) in ("it", "model", "result", "new model", "global model")
    return [Step("evaluate", {"model": scope.model() if pronoun else scope.thing(match["m"])})]


# --- perception -----------------------------------------------------------------------------------------------------


@on(
    "take get grab shoot snap capture make like want",
    rf" (?:(?P<n>{lx.NUMBER}) )?{_A}(?:[\w-]+ )?{_PIC} (?:of|showing) (?P<t>.+?){_LOC}",
)
def _pictures(match: Match, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"target": scope.thing(match["t"])}
    if match["n"] and (value := lx.number(match["n"])) and value > 1:
        params["count"] = int(value)
    return [Step("photograph", params, at=scope.place(match["loc"]) if match["loc"] else "")]


_simple("photograph snap picture", rf" (?P<t>.+?){_LOC}", "photograph", target="t")
_simple(
    "take make do get perform run conduct",
    rf" {_A}thermal (?:scan|image|picture)s? of (?P<t>.+?)",
    "scan_thermal",
    asset="t",
)
_simple("scan", r" (?P<t>.+?) (?:thermally|with (?:the|a) thermal camera|for heat)", "scan_thermal", asset="t")
_simple("record", rf" (?:some |the )?(?:audio|sound)(?: (?:of|from) (?P<t>.+?))?{_LOC}", "record_audio", target="t")
_simple("record", r" (?:the )?sound of (?P<t>.+)", "record_audio", target="t")
_simple(
    "record take shoot make",
    rf" {_A}(?:video|film|footage|clip)(?: clip)?s? of (?P<t>.+?){_LOC}",
    "record_video",
    target="t",
)
_simple("film video videotape record", rf" (?P<t>.+?){_LOC}", "record_video", target="t")
_simple(
    "look search hunt",
    r" for (?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "find",
    target="t",
    area="a",
)
_simple("search", r" (?P<a>.+?) for (?P<t>.+)", "find", target="t", area="a")
_simple(
    "find locate", r" (?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?", "find", target="t", area="a"
)
_simple(
    "detect spot identify",
    r" (?:all |any )?(?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "detect",
    target="t",
    area="a",
)
_simple(
    "count",
    r" (?:up )?(?:all |how many )?(?P<t>.+?)(?: (?:there )?are)?(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "count",
    target="t",
    area="a",
)
_simple("track", rf" (?P<t>.+?){_LOC}", "track", target="t")
_simple("keep", r" (?P<t>.+?) (?:tracked|in sight|in view|located)", "track", target="t")
_simple("keep", r" (?:track of|an eye on) (?P<t>.+?)", "track", target="t")
_simple("read", rf" (?:off |out )?(?P<t>.+?){_LOC}", "read", target="t")
_simple("scan", rf" (?P<t>.*\b(?:bar ?code|label|qr code|tag|code)s?(?: .+?)?){_LOC}", "read", target="t")


@on(
    "match register",
    rf" (?:the |this |your |its )?(?:current |present )?(?:scene|view|image|picture|surroundings) (?:against|with|to|on) (?P<d>.+?)(?: (?:data ?sets?|maps?))?",
)
def _scene(match: Match, scope: Scope) -> list[Step]:
    names = [
        scope.thing(re.sub(r"\s*data ?sets?$", "", each)) for each in re.split(r",\s*(?:and )?|\s+and\s+", match["d"])
    ]
    return [Step("match_scene", {"datasets": [each for each in names if each]})]


_simple("measure", rf" (?P<q>.+?) (?:of|from) (?P<t>.+?){_LOC}", "measure", quantity="q", target="t")
_simple("measure", rf" (?P<q>.+?){_LOC}", "measure", quantity="q")
_simple(
    "take check",
    rf" {_A}(?P<q>(?:temperature|gas level|noise level|sound level|humidity|pressure|radiation level)) (?:of|at|in) (?P<t>.+?)",
    "measure",
    quantity="q",
    target="t",
)
_simple("look", rf" (?P<t>.+?) over(?: for .+?)?{_LOC}", "inspect", asset="t")
_simple("look", rf" over (?P<t>.+?)(?: for .+?)?{_LOC}", "inspect", asset="t")
_simple("inspect examine", rf" (?P<t>.+?)(?: for .+?)?{_LOC}", "inspect", asset="t")
_simple("check", rf" (?!that |if |whether )(?:on )?(?P<t>.+?)(?: for .+?){_LOC}", "inspect", asset="t")
_simple("check", rf" (?!that |if |whether )(?P<t>.+?){_LOC}", "inspect", asset="t")


@on("compare", r" (?P<what>.+?)(?: (?:with|to|against) (?P<b>.+))?")
def _compare(match: Match, scope: Scope) -> list[Step]:
    baseline = lx.noun(match["b"] or "")
    return [
        Step("compare", {} if baseline in ("", "each other", "one another") else {"baseline": scope.thing(baseline)})
    ]


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
    on("report", _tail)(lambda match, scope: _report(match["to"], match["on"], scope))
for _tail in (rf"{_R_ON}{_R_TO}", rf"{_R_TO}{_R_ON}"):
    on(
        "send write file make submit produce prepare give create compile",
        rf" {_A}(?:short |written |full |brief )?report{_tail}",
    )(lambda match, scope: _report(match["to"], match["on"], scope))
on("send give", rf" (?P<to>.+?) {_A}(?:short |full )?report{_R_ON}")(
    lambda match, scope: _report(match["to"], match["on"], scope)
)


def _notify(to: str, text: str | None, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"to": scope.person(to)}
    said = scope.thing(text) if text and text.startswith("\x00") else " ".join((text or "").split()).strip(" .!\"'")
    if said:
        params["text"] = said
    return [Step("notify", params)]


on("notify inform alert message", r" (?P<to>.+?)(?: that|:|,) (?P<text>.+)")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
on("notify inform alert message", r" (?P<to>[^\x00]+?) (?P<text>\x00.+)")(lambda m, s: _notify(m["to"], m["text"], s))
on("notify inform alert message", r" (?P<to>.+?)(?: (?:about|of) .+)?")(lambda m, s: _notify(m["to"], None, s))
on("send", rf" {_A}(?:message|notification|alert) to (?P<to>.+?)(?:(?: saying| that|:) (?P<text>.+))?")(
    lambda m, s: _notify(m["to"], m["text"], s)
)
on("let", r" (?P<to>.+?) know(?: (?:that )?(?P<text>.+))?")(
    lambda m, s: _notify(m["to"], None if lx.noun(m["to"]) in ("me", "us") else m["text"], s)
)


@on(
    "tell",
    r" (?:me|us) (?:how many|the number of) (?P<t>.+?)(?: there)?(?: (?:are|is|you (?:see|find)))?(?: (?:there )?(?:in|on|at) (?P<a>.+))?",
)
def _how_many(match: Match, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"target": scope.thing(match["t"])}
    if match["a"]:
        params["area"] = scope.thing(match["a"])
    return [Step("count", params), Step("notify", {"to": "operator"})]


@on("tell", r" (?P<to>[^\x00]+?)(?:(?: that|:|,)? (?P<text>\x00.+| ?.+))?")
def _tell(match: Match, scope: Scope) -> list[Step] | None:
    if lx.noun(match["to"]) in ("me", "us"):
        return [Step("notify", {"to": "operator"})]
    return None


on("tell", r" (?P<to>.+?)(?: that|:) (?P<text>.+)")(lambda m, s: _notify(m["to"], m["text"], s))


def _say(text: str, to: str | None, scope: Scope) -> list[Step]:
    said = scope.thing(text) if "\x00" in text else " ".join(text.split()).strip(" .!\"'")
    return [Step("say", {"text": said} | ({"to": scope.person(to)} if to else {}))]


on("say announce", r"(?: (?:out loud|aloud))?:? (?P<text>\x00\d+\x00)(?: to (?P<to>.+))?")(
    lambda m, s: _say(m["text"], m["to"], s)
)
on("say announce", r" to (?P<to>[^\x00:]+?)(?::| that|,)? (?P<text>\x00\d+\x00)")(
    lambda m, s: _say(m["text"], m["to"], s)
)
on("say announce", r" to (?P<to>[^\x00:]+?)(?::| that) (?P<text>.+)")(lambda m, s: _say(m["text"], m["to"], s))
on("tell", r" (?P<to>[^\x00:]+?)(?::| that|,)? (?P<text>\x00\d+\x00)")(lambda m, s: _say(m["text"], m["to"], s))
on("say announce", r"(?: that|:)? (?P<text>.+?)(?: to (?P<to>.+))?")(lambda m, s: _say(m["text"], m["to"], s))


def _ask(text: str, to: str | None, scope: Scope) -> list[Step]:
    asked = scope.thing(text) if "\x00" in text else " ".join(text.split())
    return [Step("ask", {"question": asked} | ({"to": scope.person(to)} if to else {}))]


on("ask", r" (?P<to>[^\x00]+?)[:,]? (?P<q>\x00\d+\x00)")(lambda m, s: _ask(m["q"], m["to"], s))
on("ask", r":? (?P<q>\x00\d+\x00)(?: (?:to|of) (?P<to>.+))?")(lambda m, s: _ask(m["q"], m["to"], s))
on("ask", r" (?P<to>.+?),? (?P<q>(?:whether|if|what|where|when|how|which|who|why)\b.+)")(
    lambda m, s: _ask(m["q"], m["to"], s)
)


@on("wait", r"(?: here| there)?(?: (?:for|until|till) (?P<e>.+))?")
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


@on("guide lead escort accompany show take walk", rf" (?P<p>.+?) (?:the way )?to (?P<to>.+)")
def _guide(match: Match, scope: Scope) -> list[Step] | None:
    verb = match[0].split()[0].lower()
    if verb in ("take", "walk") and not scope.is_person(match["p"]):
        return None
    return [Step("guide", {"person": scope.person(match["p"]), "place": scope.place(match["to"])})]


# --- navigation -----------------------------------------------------------------------------------------------------

_HOME = r"(?:home|(?:its |your |their |the )?(?:home|launch)(?: (?:position|point|base|location))?|(?:the )?base)"
on("return go fly drive come head get", rf" (?:back )?(?:to )?{_HOME}")(lambda m, s: [Step("return_home")])
on("return come", r"(?: back)?")(lambda m, s: [Step("return_home")])
on("take lift", r" off")(lambda m, s: [Step("takeoff")])
on("launch", r"")(lambda m, s: [Step("takeoff")])
on("climb", r"")(lambda m, s: [Step("takeoff")])
on("land", r"(?: (?:at|on) (?P<loc>.+)| there| here| safely)?")(
    lambda m, s: [Step("land", at=s.place(m["loc"]) if m["loc"] else "")]
)
on("touch", r" down")(lambda m, s: [Step("land")])
on(
    "hold hover stay remain stop",
    r"(?: (?:your |its |their )?(?:position|station|still|put|there|here|in place|where (?:you|it) (?:are|is)))*",
)(lambda m, s: [Step("hold")])
on("hold hover stay remain wait", r" (?:position )?(?:at|in|over|above) (?P<loc>.+)")(
    lambda m, s: [Step("hold", at=s.place(m["loc"]))]
)
on("patrol", r" (?:along |around |round )?(?P<a>.+)")(lambda m, s: [Step("patrol", {"area": s.thing(m["a"])})])
on("do make drive fly walk run go", r" (?:laps )?(?:of|around|round) (?P<a>.+)")(
    lambda m, s: [Step("patrol", {"area": s.thing(m["a"])})]
)
on("explore", r" (?P<a>.+)")(lambda m, s: [Step("explore", {"area": s.thing(m["a"])})])
on("map survey", r" (?:out )?(?P<a>.+)")(lambda m, s: [Step("map_area", {"area": s.thing(m["a"])})])
on("make build create draw", rf" {_A}map of (?P<a>.+)")(lambda m, s: [Step("map_area", {"area": s.thing(m["a"])})])
on("localise localize", r"(?: (?:itself|yourself|themselves))?(?: (?:with|using|by|via) (?P<m>.+))?")(
    lambda m, s: [Step("localize", {"method": s.thing(m["m"])} if m["m"] else {})]
)
on("plan compute work calculate find determine", rf" (?:out )?{_A}(?:[\w-]+ )?{_ROUTE} (?:to|for|towards) (?P<p>.+)")(
    lambda m, s: [Step("plan_route", {"place": s.place(m["p"])})]
)
on("orbit circle", r" (?:around |round )?(?P<t>.+)")(lambda m, s: [Step("orbit", {"target": s.thing(m["t"])})])
on("dock", r"(?: (?:at|with|on|onto|to|in|into) (?P<s>.+))?")(
    lambda m, s: [Step("dock", {"station": s.thing(m["s"])} if m["s"] else {})]
)
on("follow traverse take drive walk fly", rf" (?:along )?(?P<p>.+? {_ROUTE}(?: .+)?)")(
    lambda m, s: [Step("follow_path", {"path": s.thing(m["p"])})]
)
on("traverse", r" (?P<p>.+)")(lambda m, s: [Step("follow_path", {"path": s.thing(m["p"])})])
on("follow shadow", r" (?:behind |after )?(?P<t>.+)")(lambda m, s: [Step("follow", {"target": s.thing(m["t"])})])


# --- coordination ---------------------------------------------------------------------------------------------------


@on(
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


on("form", rf"(?: up)?(?: (?:in|into))? {_A}(?P<f>.+?)(?: formation)?")(_form)
on("line", r" up(?: in)? (?P<f>.+?)(?: formation)?")(_form)
on("take keep hold fly assume adopt", rf"(?: up)?(?: in)? {_A}(?P<f>[\w -]+?) formation")(_form)


@on("lift carry move bring take", r" (?:up )?(?P<o>.+?)(?: to (?P<to>.+?))?")
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


@on("split divide", r"(?: up)? (?P<a>.+?) (?:between|among|amongst|over) (?P<r>.+)")
def _split(match: Match, scope: Scope) -> list[Step] | None:
    robots = scope.group(match["r"])
    return [Step("split_area", {"area": scope.thing(match["a"]), "robots": robots})] if robots else None


on("merge combine join", r" .*\b(?:maps?|detections|results|findings|them|it)\b.*")(lambda m, s: [Step("merge_maps")])
