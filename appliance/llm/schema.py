"""The form of a plan, as a JSON schema for servers and as a grammar for the local slot; and its reading.

Two forms, because the two sides differ. A server gets a JSON schema with one alternative for each skill, whatever it
makes of it. The slot gets a Lark grammar for llguidance, in which a plan is right by construction: subtask i may only
come after subtasks 1 to i-1 (no circles), each skill has its own parameters in a fixed order, and there is no white
space for a weak model to loop in. As a JSON schema that would need each skill's alternative at each position (64 x 63
of them); in the grammar all positions share one rule per skill. Names are not forced to the roster's alone: a robot
that the instruction names and the fleet lacks must come out as such and be refused, not become another robot. The
validator has the last word in both cases.
"""

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import msgspec
from msgspec import Struct, field

from appliance.errors import PlanError
from appliance.llm.checks.schema import MAX_SUBTASKS
from appliance.model import Plan, RobotInfo, Site, Subtask, Tier
from appliance.skills.catalogue import Catalogue, Param, SkillManifest

GRAMMAR_SUBTASKS = 32
"""Longest plan the grammar allows: twice the longest of the development set, and a bound on its size."""
MAX_ANSWER_BYTES = 256 * 1024
_NAME_LIKE = re.compile(r"\b[A-Za-z][A-Za-z0-9]*(?:[_-][A-Za-z0-9]+|[ ]\d{1,4}\b|\d{1,4}\b)")
_DIRECT = 11
"""Further direct predecessors of a subtask: a list without bound is one to loop in."""
_DOMAIN = '"domain":'
_ANY = 4
"""Unnamed robots: any, any1 ... any4."""


# --- JSON schema for servers ----------------------------------------------------------------------------------------


def plan_schema(catalogue: Catalogue) -> dict[str, Any]:
    """Return the JSON schema of a plan: one alternative for each skill. Circles are left to the validator."""
    return {
        "type": "object",
        "properties": {
            "domain": {"type": "string", "enum": list(catalogue.domains)},
            "subtasks": {
                "type": "array",
                "minItems": 1,
                "maxItems": MAX_SUBTASKS,
                "items": {"anyOf": [_subtask_schema(skill) for skill in catalogue.skills.values()]},
            },
        },
        "required": ["domain", "subtasks"],
        "additionalProperties": False,
    }


def _subtask_schema(skill: SkillManifest) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {
            "id": {"type": "string"},
            "skill": {"type": "string", "enum": [skill.id]},
            "robot": {"type": "null"} if skill.runs == "compute" else {"type": "string"},
            "params": {
                "type": "object",
                "properties": {name: _param_schema(param) for name, param in skill.params.items()},
                "required": [name for name, param in skill.params.items() if param.required],
                "additionalProperties": False,
            },
            "after": {"type": "array", "items": {"type": "string"}},
        },
        "required": ["id", "skill", "robot", "params", "after"],
        "additionalProperties": False,
    }


def _param_schema(param: Param) -> dict[str, Any]:
    if param.type == "array":
        return {"type": "array", "items": {"type": "string"}, "minItems": 1}
    return {"type": param.type}


# --- grammar for the slot -------------------------------------------------------------------------------------------


def robot_names(
    robots: Sequence[RobotInfo] | None, instruction: str, site: Site | None = None
) -> tuple[str, ...] | None:
    """Return the names a plan may use, None when any may be used: the roster, any, and what looks like a name.

    Places of the site are none: with the same names the grammar is the same, and the model's warm prefix is used again.
    """
    if robots is None:
        return None
    found = [robot.id for robot in robots]
    found += [
        match[0].lower().replace(" ", "_")
        for match in _NAME_LIKE.finditer(instruction)
        if site is None or site.find(match[0]) is None
    ]
    return tuple(dict.fromkeys([*found, "any", *(f"any{index + 1}" for index in range(min(_ANY, len(robots))))]))


def plan_grammar(catalogue: Catalogue, names: tuple[str, ...] | None) -> str:
    """Return the llguidance grammar (Lark) of a plan; `names` as `robot_names` gives them."""
    return _grammar(catalogue_key(catalogue), catalogue.domains, names)


class Shape(Struct, frozen=True):
    """What the grammar needs of a skill, hashable."""

    id: str
    compute: bool
    params: tuple[tuple[str, str, bool], ...]
    """Name, type, required."""


def catalogue_key(catalogue: Catalogue) -> tuple[Shape, ...]:
    """Return the catalogue as far as grammars depend on it."""
    return tuple(
        Shape(skill.id, skill.runs == "compute", tuple((n, p.type, p.required) for n, p in skill.params.items()))
        for skill in catalogue.skills.values()
    )


@lru_cache(maxsize=16)
def _grammar(skills: tuple[Shape, ...], domains: tuple[str, ...], names: tuple[str, ...] | None) -> str:
    subtasks, after, params = _text(',"subtasks":['), _text(',"after":['), _text(',"params":{')
    comma, close = _text(","), _text("]}")
    lines = [
        f"start: {_text('{' + _DOMAIN)} domain {subtasks} t1 {close}",
        f"domain: {_choice(_quoted(domain) for domain in domains)}",
        f"action: {' | '.join('a_' + skill.id for skill in skills)}",
        'after1: ""',
    ]
    for index in range(1, GRAMMAR_SUBTASKS + 1):
        head = _text(f'{{"id":"s{index}",')
        follow = f" ({comma} t{index + 1})?" if index < GRAMMAR_SUBTASKS else ""
        lines.append(f"t{index}: {head} action {after} after{index} {close}{follow}")
        if index > 1:
            lines.append(f"after{index}: (d{index} ({comma} d{index}){{0,{_DIRECT}}})?")
            lines.append(f"d{index}: {_choice(_quoted(f's{earlier}') for earlier in range(1, index))}")
    for skill in skills:
        robot = _text("null") if skill.compute else "robot"
        head = _text(f'"skill":"{skill.id}","robot":')
        lines.append(f"a_{skill.id}: {head} {robot} {params} {_params(skill)} {_text('}')}")
    lines += [
        f"robot: {_choice(_quoted(name) for name in names)}" if names else 'robot: /"[a-z][a-z0-9_-]{0,40}"/',
        f"robots: {_text('[')} robot ({_text(',')} robot){{0,15}} {_text(']')}",
        f"strings: {_text('[')} STRING ({_text(',')} STRING){{0,15}} {_text(']')}",
        # Bounded, and without control characters, quotes and backslashes: a parameter needs none of them.
        r'STRING: /"[^"\\\x00-\x1f\x7f]{1,120}"/',
        "NUMBER: /[1-9][0-9]{0,5}(\\.[0-9]{1,3})?|0\\.[0-9]{0,2}[1-9]/",
        "INTEGER: /[1-9][0-9]{0,3}/",
    ]
    return "\n".join(lines) + "\n"


def _params(skill: Shape) -> str:
    """Return the parameters' rule: required ones first, then any of the optional, in fixed order."""
    needed = [_param(name, kind) for name, kind, required in skill.params if required]
    optional = [_param(name, kind) for name, kind, required in skill.params if not required]
    comma = _text(",")
    if needed:
        return " ".join([f" {comma} ".join(needed), *(f"({comma} {each})?" for each in optional)])
    if not optional:
        return '""'
    choices = [
        " ".join([first, *(f"({comma} {other})?" for other in optional[index + 1 :])])
        for index, first in enumerate(optional)
    ]
    return f"({' | '.join(choices)})?"


def _param(name: str, kind: str) -> str:
    value = {"string": "STRING", "number": "NUMBER", "integer": "INTEGER"}.get(
        kind, "robots" if name == "robots" else "strings"
    )
    return f"{_text(f'{chr(34)}{name}{chr(34)}:')} {value}"


def _text(literal: str) -> str:
    return msgspec.json.encode(literal).decode()


def _quoted(word: str) -> str:
    return _text(f'"{word}"')


def _choice(alternatives: Iterable[str]) -> str:
    return " | ".join(alternatives)


# --- reading --------------------------------------------------------------------------------------------------------


class _Subtask(Struct, forbid_unknown_fields=False):
    id: str
    skill: str
    robot: str | None = None
    params: dict[str, Any] | None = field(default_factory=dict[str, Any])
    after: list[str] | None = field(default_factory=list[str])


class _Plan(Struct):
    domain: str
    subtasks: list[_Subtask]


def read_plan(text: str, *, tier: Tier) -> Plan:
    """Read a model's answer; a code fence or words around the object are forgiven.

    Raises:
        PlanError: it is no plan, with what is wrong and where.
    """
    if len(text) > MAX_ANSWER_BYTES:
        raise PlanError(f"the {tier} model's answer has {len(text)} characters", remedy="it loops: use another model")
    begin, end = text.find("{"), text.rfind("}")
    if begin < 0 or end <= begin:
        raise PlanError(f"the {tier} model's answer holds no plan: {text[:80]!r}")
    try:
        found = msgspec.json.decode(text[begin : end + 1].encode(errors="replace"), type=_Plan)
    except (msgspec.DecodeError, RecursionError) as error:
        raise PlanError(f"the {tier} model's answer is no plan: {str(error)[:200]}") from error
    subtasks = tuple(
        Subtask(
            id=each.id,
            skill=each.skill,
            robot=each.robot or None,
            params={name: value for name, value in (each.params or {}).items() if value is not None},
            after=tuple(dict.fromkeys(each.after or ())),
        )
        for each in found.subtasks
    )
    return Plan(domain=found.domain, subtasks=subtasks, tier=tier)
