"""The dashboard is what Grafana takes: its JSON is held against the published format, so an import loses nothing.

The schema is written after Grafana's own, `kinds/dashboard/dashboard_kind.cue` in the repository grafana/grafana and
the JSON schemas that grafana/cog makes of it and of the panels (`generated/dashboard.jsonschema.json`, `stat`,
`timeseries`, `prometheus`, at 5daa8936), for the parts that this dashboard has. Grafana passes over a key that it does
not know, and shows something else than what was meant: here such a key is an error.
"""

import json
from copy import deepcopy
from importlib import import_module
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

DASHBOARD = Path(__file__).parents[3] / "docs" / "examples" / "grafana-dashboard.json"
TEXT = {"type": "string"}
NUMBER = {"type": "number"}
COUNT = {"type": "integer", "minimum": 0}
YES_OR_NO = {"type": "boolean"}


def one_of(*words: object) -> dict[str, Any]:
    """Return the schema of some words."""
    return {"enum": list(words)}


def all_of(kind: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a list."""
    return {"type": "array", "items": kind}


def fields(*required: str, **known: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of an object with these fields and no others."""
    return {"type": "object", "additionalProperties": False, "required": list(required), "properties": known}


SOURCE = fields("type", "uid", type=TEXT, uid=TEXT)
QUERY = fields(
    "refId", "expr", "datasource",
    refId=TEXT, expr={"type": "string", "minLength": 1}, legendFormat=TEXT, datasource=SOURCE, instant=YES_OR_NO,
    range=YES_OR_NO, exemplar=YES_OR_NO, hide=YES_OR_NO, interval=TEXT, queryType=TEXT, intervalFactor=NUMBER,
    editorMode=one_of("code", "builder"), format=one_of("time_series", "table", "heatmap"),
)  # fmt: skip
THRESHOLDS = fields(
    "mode", "steps",
    mode=one_of("absolute", "percentage"),
    steps=all_of(fields("value", "color", value={"type": ["number", "null"]}, color=TEXT)),
)  # fmt: skip
COLOUR = fields("mode", mode=TEXT, fixedColor=TEXT, seriesBy=one_of("min", "max", "last"))
DEFAULTS = fields(
    unit=TEXT, min=NUMBER, max=NUMBER, decimals=NUMBER, displayName=TEXT, noValue=TEXT, color=COLOUR,
    thresholds=THRESHOLDS, mappings={"type": "array"}, custom={"type": "object"},
)  # fmt: skip
OVERRIDE = fields(
    "matcher", "properties",
    matcher=fields("id", id=TEXT, options={}), properties=all_of(fields("id", id=TEXT, value={})),
)  # fmt: skip
STAT = fields(
    "graphMode", "colorMode", "justifyMode", "textMode", "wideLayout", "reduceOptions", "showPercentChange",
    "orientation",
    graphMode=one_of("none", "line", "area"), colorMode=one_of("value", "background", "background_solid", "none"),
    justifyMode=one_of("auto", "center"), textMode=one_of("auto", "value", "value_and_name", "name", "none"),
    wideLayout=YES_OR_NO, showPercentChange=YES_OR_NO, orientation=one_of("auto", "vertical", "horizontal"),
    reduceOptions=fields("calcs", calcs=all_of(TEXT), values=YES_OR_NO, limit=NUMBER, fields=TEXT),
)  # fmt: skip
TIMESERIES = fields(
    "legend", "tooltip",
    legend=fields(
        "displayMode", "placement", "showLegend", "calcs",
        displayMode=one_of("list", "table", "hidden"), placement=one_of("bottom", "right"), showLegend=YES_OR_NO,
        calcs=all_of(TEXT), sortBy=TEXT, sortDesc=YES_OR_NO, width=NUMBER, isVisible=YES_OR_NO, asTable=YES_OR_NO,
    ),
    tooltip=fields(
        "mode", "sort",
        mode=one_of("single", "multi", "none"), sort=one_of("asc", "desc", "none"), maxWidth=NUMBER, maxHeight=NUMBER,
        hideZeros=YES_OR_NO,
    ),
    timezone=all_of(TEXT), orientation=one_of("auto", "vertical", "horizontal"),
)  # fmt: skip


def panel(kind: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a panel of some kind."""
    return fields(
        "id", "type", "title", "gridPos", "options", "targets", "datasource",
        id={"type": "integer", "minimum": 1}, type={"const": kind}, title=TEXT, description=TEXT, datasource=SOURCE,
        gridPos=fields("h", "w", "x", "y", h=COUNT, w=COUNT, x=COUNT, y=COUNT, static=YES_OR_NO),
        fieldConfig=fields("defaults", "overrides", defaults=DEFAULTS, overrides=all_of(OVERRIDE)),
        options=options, targets={**all_of(QUERY), "minItems": 1}, transparent=YES_OR_NO, interval=TEXT,
        pluginVersion=TEXT, maxDataPoints=NUMBER, timeFrom=TEXT, timeShift=TEXT,
    )  # fmt: skip


CHOICE = fields("text", "value", selected=YES_OR_NO, text=TEXT, value=TEXT)
VARIABLE = fields(
    "type", "name",
    type=one_of("query", "adhoc", "groupby", "constant", "datasource", "interval", "textbox", "custom", "system"),
    name=TEXT, label=TEXT, hide=one_of(0, 1, 2), skipUrlSync=YES_OR_NO, description=TEXT, query=TEXT, datasource=SOURCE,
    current=CHOICE, multi=YES_OR_NO, options=all_of(CHOICE), refresh=one_of(0, 1, 2), includeAll=YES_OR_NO,
    allValue=TEXT, regex=TEXT,
)  # fmt: skip
BOARD = fields(
    "schemaVersion", "templating", "annotations", "title", "uid", "panels", "time",
    title=TEXT, uid={"type": "string", "minLength": 8, "maxLength": 40}, description=TEXT, tags=all_of(TEXT),
    timezone=TEXT, editable=YES_OR_NO, graphTooltip=one_of(0, 1, 2), refresh=TEXT,
    schemaVersion={"type": "integer", "minimum": 36}, version=COUNT, liveNow=YES_OR_NO, weekStart=TEXT,
    time=fields("from", "to", **{"from": TEXT, "to": TEXT}), templating=fields("list", list=all_of(VARIABLE)),
    annotations=fields(list={"type": "array", "maxItems": 0}),
    panels=all_of({"oneOf": [panel("stat", STAT), panel("timeseries", TIMESERIES)]}),
)  # fmt: skip


def errors(board: dict[str, Any]) -> list[str]:
    """Return what is wrong in a dashboard by the schema."""
    validator: Any = import_module("jsonschema").Draft202012Validator
    validator.check_schema(BOARD)
    return [each.message for each in validator(BOARD).iter_errors(board)]


@pytest.fixture
def board() -> dict[str, Any]:
    """The dashboard in the documentation."""
    return json.loads(DASHBOARD.read_text())


def test_the_dashboard_keeps_to_the_published_format(board: dict[str, Any]) -> None:
    """No key that Grafana does not know, none that it needs is missing, each value of the kind it takes."""
    assert errors(board) == []


@pytest.mark.parametrize(
    "change",
    [
        lambda board: board.pop("schemaVersion"),
        lambda board: board.update(datasource="prometheus"),
        lambda board: board["templating"]["list"][0].update(current={}),
        lambda board: board["panels"][0].update(type="singlestat"),
        lambda board: board["panels"][0]["gridPos"].update(w="4"),
        lambda board: board["panels"][0]["targets"][0].pop("expr"),
        lambda board: board["panels"][-1]["options"]["legend"].update(placement="top"),
    ],
)
def test_a_dashboard_that_is_broken_is_found(board: dict[str, Any], change: Any) -> None:
    """What the schema lets through it would not be worth having."""
    broken = deepcopy(board)
    change(broken)
    assert errors(broken)


def test_panels_have_places_and_numbers_of_their_own(board: dict[str, Any]) -> None:
    """Each lies within the grid's 24 columns, and none upon another; Grafana would move them."""
    places = [each["gridPos"] for each in board["panels"]]
    assert len({each["id"] for each in board["panels"]}) == len(places)
    assert all(each["x"] + each["w"] <= 24 for each in places)
    for one, other in combinations(places, 2):
        apart_x = one["x"] + one["w"] <= other["x"] or other["x"] + other["w"] <= one["x"]
        apart_y = one["y"] + one["h"] <= other["y"] or other["y"] + other["h"] <= one["y"]
        assert apart_x or apart_y, (one, other)
    sources = {each["name"] for each in board["templating"]["list"] if each["type"] == "datasource"}
    used = {query["datasource"]["uid"] for each in board["panels"] for query in each["targets"]}
    assert used == {f"${{{name}}}" for name in sources}
