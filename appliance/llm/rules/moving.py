"""Verb phrases of moving: navigation of one robot, and what several do together.

A joint skill is one step whose `robots` lists all that take part.
"""

import re
from typing import Any

from appliance.llm.rules.phrases import ARTICLE, ROUTES, Match, Patterns, Scope, Step

PATTERNS = Patterns()


# --- navigation -----------------------------------------------------------------------------------------------------

_HOME = r"(?:home|(?:its |your |their |the )?(?:home|launch)(?: (?:position|point|base|location))?|(?:the )?base)"
PATTERNS.fixed("return go fly drive come head get", rf" (?:back )?(?:to )?{_HOME}", "return_home")
PATTERNS.fixed("return come", r"(?: back)?", "return_home")
PATTERNS.fixed("take lift", r" off", "takeoff")
PATTERNS.fixed("launch", r"", "takeoff")
PATTERNS.fixed("climb", r"", "takeoff")
PATTERNS.on("land", r"(?: (?:at|on) (?P<loc>.+)| there| here| safely)?")(
    lambda m, s: [Step("land", at=s.place(m["loc"]) if m["loc"] else "")]
)
PATTERNS.fixed("touch", r" down", "land")
PATTERNS.fixed(
    "hold hover stay remain stop pause",
    r"(?: (?:your |its |their )?(?:position|station|still|put|there|here|in place|where (?:you|it) (?:are|is)))*",
    "hold",
)
PATTERNS.on("hold hover stay remain wait", r" (?:position )?(?:at|in|over|above) (?P<loc>.+)")(
    lambda m, s: [Step("hold", at=s.place(m["loc"]))]
)
PATTERNS.on("patrol", r" (?:along |around |round )?(?P<a>.+)")(lambda m, s: [Step("patrol", {"area": s.thing(m["a"])})])
PATTERNS.on("do make drive fly walk run go", r" (?:laps )?(?:of|around|round) (?P<a>.+)")(
    lambda m, s: [Step("patrol", {"area": s.thing(m["a"])})]
)
PATTERNS.on("explore", r" (?P<a>.+)")(lambda m, s: [Step("explore", {"area": s.thing(m["a"])})])
PATTERNS.on("map survey", r" (?:out )?(?P<a>.+)")(lambda m, s: [Step("map_area", {"area": s.thing(m["a"])})])
PATTERNS.on("make build create draw", rf" {ARTICLE}map of (?P<a>.+)")(
    lambda m, s: [Step("map_area", {"area": s.thing(m["a"])})]
)
PATTERNS.on("localise localize", r"(?: (?:itself|yourself|themselves))?(?: (?:with|using|by|via) (?P<m>.+))?")(
    lambda m, s: [Step("localize", {"method": s.thing(m["m"])} if m["m"] else {})]
)
PATTERNS.on(
    "plan compute work calculate find determine",
    rf" (?:out )?{ARTICLE}(?:[\w-]+ )?{ROUTES} (?:to|for|towards) (?P<p>.+)",
)(lambda m, s: [Step("plan_route", {"place": s.place(m["p"])})])
PATTERNS.on("orbit circle", r" (?:around |round )?(?P<t>.+)")(lambda m, s: [Step("orbit", {"target": s.thing(m["t"])})])
PATTERNS.on("dock", r"(?: (?:at|with|on|onto|to|in|into) (?P<s>.+))?")(
    lambda m, s: [Step("dock", {"station": s.thing(m["s"])} if m["s"] else {})]
)
PATTERNS.on("follow traverse take drive walk fly", rf" (?:along )?(?P<p>.+? {ROUTES}(?: .+)?)")(
    lambda m, s: [Step("follow_path", {"path": s.thing(m["p"])})]
)
PATTERNS.on("traverse", r" (?P<p>.+)")(lambda m, s: [Step("follow_path", {"path": s.thing(m["p"])})])
PATTERNS.on("follow shadow", r" (?:behind |after )?(?P<t>.+)")(
    lambda m, s: [Step("follow", {"target": s.thing(m["t"])})]
)


# --- coordination ---------------------------------------------------------------------------------------------------


@PATTERNS.on(
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


PATTERNS.on("form", rf"(?: up)?(?: (?:in|into))? {ARTICLE}(?P<f>.+?)(?: formation)?")(_form)
PATTERNS.on("line", r" up(?: in)? (?P<f>.+?)(?: formation)?")(_form)
PATTERNS.on("take keep hold fly assume adopt", rf"(?: up)?(?: in)? {ARTICLE}(?P<f>[\w -]+?) formation")(_form)


@PATTERNS.on("lift carry move bring take", r" (?:up )?(?P<o>.+?)(?: to (?P<to>.+?))?")
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


@PATTERNS.on("split divide", r"(?: up)? (?P<a>.+?) (?:between|among|amongst|over) (?P<r>.+)")
def _split(match: Match, scope: Scope) -> list[Step] | None:
    robots = scope.group(match["r"])
    return [Step("split_area", {"area": scope.thing(match["a"]), "robots": robots})] if robots else None


PATTERNS.fixed("merge combine join", r" .*\b(?:maps?|detections|results|findings|them|it)\b.*", "merge_maps")
