"""Verb phrases of sensing and of working on what was sensed: perception, media, learning.

Fixed nouns ("extract frames", "encode the clip") stand before the general patterns of the same verbs.
"""

import re
from typing import Any

from appliance.llm.rules import lexicon as lx
from appliance.llm.rules.phrases import ARTICLE, LOCATION, PICTURES, Match, Patterns, Scope, Step

PATTERNS = Patterns()


# --- learning and media: fixed nouns, so before the general patterns of the same verbs -----------------------------

PATTERNS.simple(
    "extract sample grab decode",
    (
        r" (?:the |some )?(?:video )?frames?(?: (?:from|of|out of) (?:the |this |that )?(?:video|"
        r"recording|clip|footage|film))?"
    ),
    "extract_frames",
)
PATTERNS.simple(
    "extract sample grab decode",
    r" (?:the |some )?(?:video )?frames? (?:from|of|out of) (?P<s>.+)",
    "extract_frames",
    source="s",
)
PATTERNS.simple("decode", r" (?P<s>\S+\.\w+)(?: and sample frames)?", "extract_frames", source="s")
PATTERNS.simple("encode", r" .*", "encode_clip")
PATTERNS.simple("classify", r" .*", "classify_action")
PATTERNS.simple(
    "preprocess denoise",
    r"(?: and segment)?(?: (?:the |this |that )?(?:audio|recording|sound|it|them|both))?",
    "preprocess_audio",
)
PATTERNS.simple("preprocess denoise", r"(?: and segment)? (?P<s>.+)", "preprocess_audio", source="s")
PATTERNS.simple(
    "run start perform",
    r" (?:the )?audio pre-?processing(?: (?:on|of|for) (?:it|the (?:audio|recording)))?",
    "preprocess_audio",
)
PATTERNS.simple("run start perform", r" (?:the )?transcription.*", "transcribe")
PATTERNS.simple("run start perform", r" (?:the )?frame extraction.*", "extract_frames")
PATTERNS.simple("transcribe", r"(?: .+)?", "transcribe")
PATTERNS.simple("correct", r" .+", "correct_text")


@PATTERNS.on(
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


@PATTERNS.on("run do perform", r" (?:(?:a |one )?rounds? of )?(?:of )?local training (?:on|of|for) (?P<m>.+)")
def _training(match: Match, scope: Scope) -> list[Step]:
    return [Step("train_local", {"model": scope.thing(match["m"])})]


@PATTERNS.on("aggregate", r"(?: (?:the |all |both )*updates(?: (?:for|of) (?P<u>.+))?| (?P<m>.+))?")
def _aggregate(match: Match, scope: Scope) -> list[Step]:
    named = match["u"] or match["m"] or ""
    pronoun = lx.noun(named) in ("", "it", "them", "model", "models", "results")
    return [Step("aggregate", {"model": scope.model() if pronoun else scope.thing(named)})]


@PATTERNS.on("evaluate test validate", r" (?P<m>.+?)(?: (?:on|with|against) .+)?")
def _evaluate(match: Match, scope: Scope) -> list[Step]:
    pronoun = lx.noun(match["m"]) in ("it", "model", "result", "new model", "global model")
    return [Step("evaluate", {"model": scope.model() if pronoun else scope.thing(match["m"])})]


# --- perception -----------------------------------------------------------------------------------------------------


@PATTERNS.on(
    "take get grab shoot snap capture make like want",
    rf" (?:(?P<n>{lx.NUMBER}) )?{ARTICLE}(?:[\w-]+ )?{PICTURES} (?:of|showing) (?P<t>.+?){LOCATION}",
)
def _pictures(match: Match, scope: Scope) -> list[Step]:
    params: dict[str, Any] = {"target": scope.thing(match["t"])}
    if match["n"] and (value := lx.number(match["n"])) and value > 1:
        params["count"] = int(value)
    return [Step("photograph", params, at=scope.place(match["loc"]) if match["loc"] else "")]


@PATTERNS.on("take get snap", rf" (?:(?P<n>{lx.NUMBER}) )?{ARTICLE}{PICTURES}(?: there)?")
def _picture_here(match: Match, scope: Scope) -> list[Step] | None:
    target = scope.place("there")
    params: dict[str, Any] = {"target": target}
    if match["n"] and (value := lx.number(match["n"])) and value > 1:
        params["count"] = int(value)
    return [Step("photograph", params)] if target else None


PATTERNS.simple("photograph snap picture", rf" (?P<t>.+?){LOCATION}", "photograph", target="t")
PATTERNS.simple(
    "take make do get perform run conduct",
    rf" {ARTICLE}thermal (?:scan|image|picture)s? of (?P<t>.+?)",
    "scan_thermal",
    asset="t",
)
PATTERNS.simple("scan", r" (?P<t>.+?) (?:thermally|with (?:the|a) thermal camera|for heat)", "scan_thermal", asset="t")
PATTERNS.simple(
    "record", rf" (?:some |the )?(?:audio|sound)(?: (?:of|from) (?P<t>.+?))?{LOCATION}", "record_audio", target="t"
)
PATTERNS.simple("record", r" (?:the )?sound of (?P<t>.+)", "record_audio", target="t")
PATTERNS.simple(
    "record take shoot make",
    rf" {ARTICLE}(?:video|film|footage|clip)(?: clip)?s? of (?P<t>.+?){LOCATION}",
    "record_video",
    target="t",
)
PATTERNS.simple("film video videotape record", rf" (?P<t>.+?){LOCATION}", "record_video", target="t")
PATTERNS.simple(
    "look search hunt",
    r" for (?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "find",
    target="t",
    area="a",
)
PATTERNS.simple("search", r" (?P<a>.+?) for (?P<t>.+)", "find", target="t", area="a")
PATTERNS.simple(
    "find locate", r" (?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?", "find", target="t", area="a"
)
PATTERNS.simple(
    "detect spot identify",
    r" (?:all |any )?(?P<t>.+?)(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "detect",
    target="t",
    area="a",
)
PATTERNS.simple(
    "count",
    r" (?:up )?(?:all |how many )?(?P<t>.+?)(?: (?:there )?are)?(?: (?:in|on|at|inside|around|along|near) (?P<a>.+))?",
    "count",
    target="t",
    area="a",
)
PATTERNS.simple("track", rf" (?P<t>.+?){LOCATION}", "track", target="t")
PATTERNS.simple("keep", r" (?P<t>.+?) (?:tracked|in sight|in view|located)", "track", target="t")
PATTERNS.simple("keep", r" (?:track of|an eye on) (?P<t>.+?)", "track", target="t")
PATTERNS.simple("read", rf" (?:off |out )?(?P<t>.+?){LOCATION}", "read", target="t")
PATTERNS.simple("scan", rf" (?P<t>.*\b(?:bar ?code|label|qr code|tag|code)s?(?: .+?)?){LOCATION}", "read", target="t")


@PATTERNS.on(
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


PATTERNS.simple("measure", rf" (?P<q>.+?) (?:of|from) (?P<t>.+?){LOCATION}", "measure", quantity="q", target="t")
PATTERNS.simple("measure", rf" (?P<q>.+?){LOCATION}", "measure", quantity="q")
PATTERNS.simple(
    "take check",
    (
        rf" {ARTICLE}(?P<q>(?:temperature|gas level|noise level|sound level|humidity|pressure|radiation "
        rf"level)) (?:of|at|in) (?P<t>.+?)"
    ),
    "measure",
    quantity="q",
    target="t",
)
PATTERNS.simple("look", rf" (?P<t>.+?) over(?: for .+?)?{LOCATION}", "inspect", asset="t")
PATTERNS.simple("look", rf" over (?P<t>.+?)(?: for .+?)?{LOCATION}", "inspect", asset="t")
PATTERNS.simple("inspect examine", rf" (?P<t>.+?)(?: for .+?)?{LOCATION}", "inspect", asset="t")
PATTERNS.simple("check", rf" (?!that |if |whether )(?:on )?(?P<t>.+?)(?: for .+?){LOCATION}", "inspect", asset="t")
PATTERNS.simple("check", rf" (?!that |if |whether )(?P<t>.+?){LOCATION}", "inspect", asset="t")


@PATTERNS.on("compare", r" (?P<what>.+?)(?: (?:with|to|against) (?P<b>.+))?")
def _compare(match: Match, scope: Scope) -> list[Step]:
    baseline = lx.noun(match["b"] or "")
    return [
        Step("compare", {} if baseline in ("", "each other", "one another") else {"baseline": scope.thing(baseline)})
    ]
