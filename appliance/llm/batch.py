"""Plans for a file of instructions, without a fleet: JSONL cases in, JSONL predictions out.

Every prediction is on the disk before the next case begins, so an interrupted run has lost nothing, and a run that is
started again goes on behind the last one. A case without a plan gets a line too, with the reason, so that the output
has an answer to each case. Lines that are no case are reported with their numbers and left out.
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConfigError, NotFoundError, PlanError, RecordError
from appliance.llm.cascade import Decomposer
from appliance.llm.preprocessing import rule_refused, training_refused
from appliance.llm.rule_words import rule_words
from appliance.llm.settings import LlmConfig, PlanContext, SafetyConfig
from appliance.llm.stop_words import stop_request
from appliance.llm.training_words import training_request
from appliance.model import Plan, RobotInfo, Site, Verdict
from appliance.skills.catalogue import Catalogue

Choice = Literal["auto", "local", "upstream", "rules"]
Progress = Callable[[str], None]
MAX_LINE = 1 << 20
"""Bytes; a longer line is no case."""
MAX_ID = 200


class Case(Struct, frozen=True):
    """One line of the input; what else it holds is not looked at."""

    id: str
    instruction: str
    robots: tuple[str, ...] | None = None


class Malformed(Struct, frozen=True):
    """A line that is no case."""

    line: int
    why: str


class Report(Struct, frozen=True, kw_only=True):
    """What came of a run."""

    cases: int
    """Of the input, without malformed lines."""
    written: int
    """Predictions of this run."""
    before: int
    """Predictions that were there already."""
    planless: int
    """Of those of this run: cases that nobody had a plan for."""
    malformed: tuple[Malformed, ...] = ()


def read_cases(path: Path) -> tuple[list[Case], list[Malformed]]:
    """Read a file of cases.

    Raises:
        NotFoundError: there is no such file, or it cannot be read.
    """
    try:
        lines = path.read_bytes().split(b"\n")
    except OSError as error:
        raise NotFoundError(
            f"no cases at {path}: {error.strerror}", remedy="name a JSONL file with id and instruction in each line"
        ) from error
    found: list[Case] = []
    malformed: list[Malformed] = []
    seen: dict[str, int] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        case = _case(line, seen)
        if isinstance(case, str):
            malformed.append(Malformed(number, case[:200]))
        else:
            seen[case.id] = number
            found.append(case)
    return found, malformed


def _case(line: bytes, seen: Mapping[str, int]) -> Case | str:
    """Return the case of a line, or why it is none."""
    if len(line) > MAX_LINE:
        return f"{len(line):,} bytes, at most {MAX_LINE:,}"
    try:
        case = msgspec.json.decode(line, type=Case)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return str(error)
    if not case.id or len(case.id) > MAX_ID:
        return f"an id has 1 to {MAX_ID} characters"
    return f"the id {case.id!r} is that of line {seen[case.id]} too" if case.id in seen else case


def config_for(config: LlmConfig, tier: Choice) -> LlmConfig:
    """Return the configuration with which one tier, or all of them, answer every case, however sure they are.

    Raises:
        ConfigError: the tier is not configured.
    """
    if tier == "local" and not config.local_model:
        raise ConfigError("there is no local model", remedy="name its folder with --model, or in llm.local_model")
    if tier == "upstream" and not config.upstream_url:
        raise ConfigError("there is no upstream model", remedy="set llm.upstream_url and give the file with --config")
    # Every case gets its best plan, however unsure; `decision` says what a fleet would do with it.
    asked = replace(config, require_implemented=False, show_confidence=0.0, cache=0)
    return asked if tier == "auto" else replace(asked, tiers=(tier,))


def everyman(name: str, catalogue: Catalogue) -> RobotInfo:
    """Return a robot that can do everything: cases name robots, not what they can do."""
    uses = tuple(sorted({use for skill in catalogue.skills.values() for use in skill.uses}))
    verbs = tuple(sorted({verb for skill in catalogue.skills.values() for verb in skill.verbs}))
    return RobotInfo(id=name, kind="zenoh", uses=uses, verbs=verbs, flies=True)


def prediction(
    case: str, plan: Plan | None, why: str = "", *, decision: Verdict | None = None, stops: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the line of a case: the plan, what a fleet would do with it, and the checks that spoke."""
    if plan is None:
        empty: dict[str, Any] = {"id": case, "domain": "", "subtasks": [], "tier": "none", "confidence": 0.0}
        found: dict[str, Any] = {"decision": (decision or Verdict.REFUSE).value, "checks": []}
        stopped = {"robots": list(stops)} if decision is Verdict.STOP else {}
        return {**empty, "latency_ms": 0.0, "why": why, **found, **stopped}
    subtasks = [
        {"id": each.id, "skill": each.skill, "robot": each.robot, "params": each.params, "after": list(each.after)}
        for each in plan.subtasks
    ]
    first = plan.provenance
    return {
        "id": case,
        "domain": plan.domain,
        "subtasks": subtasks,
        "tier": plan.tier.value,
        "confidence": plan.confidence,
        "latency_ms": first.latency_ms if first is not None else plan.latency_ms,
        **({"model": first.model} if first is not None and first.model else {}),
        "decision": (decision or Verdict.RUN).value,
        "checks": msgspec.to_builtins(first.findings if first is not None else ()),
    }


async def run(
    cases: Path,
    out: Path,
    *,
    config: LlmConfig,
    catalogue: Catalogue,
    tier: Choice = "auto",
    safety: SafetyConfig | None = None,
    site: Site | None = None,
    roster: Mapping[str, RobotInfo] | None = None,
    progress: Progress = lambda _: None,
) -> Report:
    """Plan every case that has no prediction yet, one after the other.

    Args:
        cases: JSONL, as `read_cases` takes them.
        out: JSONL of predictions; it is gone on with when it is there.
        config: the tiers.
        catalogue: the skills there are.
        tier: which of them; `auto` asks in order as a gateway does.
        safety: the policy; by default one that forbids nothing.
        site: its places, things, fence and limits count; None: names of places are not checked.
        roster: what robots can do, by name; one that it lacks can do everything.
        progress: told how far it is.

    Raises:
        NotFoundError: there are no cases.
        ConfigError: the tier is not configured.
        RecordError: the output cannot be written, or holds something else.
    """
    found, malformed = read_cases(cases)
    for each in malformed:
        progress(f"{cases}:{each.line}: no case, left out: {each.why}")
    asked = config_for(config, tier)
    done = _resumed(out)
    left = [case for case in found if case.id not in done]
    if len(left) < len(found):
        progress(f"{len(found) - len(left)} of {len(found)} cases are in {out} already")
    decomposer = Decomposer(asked, catalogue, safety=safety)
    planless = written = 0
    try:
        await decomposer.start()
        with _opened(out) as file:
            for number, case in enumerate(left, start=1):
                line = await predicted(
                    decomposer, case, catalogue, site=site, roster=roster or {}, show_from=config.show_confidence
                )
                planless += line["tier"] == "none"
                file.write(json.dumps(line, ensure_ascii=False).encode(errors="replace") + b"\n")
                file.flush()
                os.fsync(file.fileno())
                written += 1
                said = f"{line['tier']}, {line['confidence']:.2f} sure, {line['latency_ms']:.1f} ms"
                progress(f"{number} of {len(left)}: {case.id}: {line.get('why') or said}")
    finally:
        await decomposer.close()
    return Report(
        cases=len(found),
        written=written,
        before=len(found) - len(left),
        planless=planless,
        malformed=tuple(malformed),
    )


async def predicted(
    decomposer: Decomposer,
    case: Case,
    catalogue: Catalogue,
    *,
    site: Site | None = None,
    roster: Mapping[str, RobotInfo] | None = None,
    show_from: float = 0.0,
) -> dict[str, Any]:
    """Return the line of a case, decided as a fleet would: run, hold, refuse or stop."""
    known = roster or {}
    robots = (
        None if case.robots is None else tuple(known.get(name) or everyman(name, catalogue) for name in case.robots)
    )
    if (stop := stop_request(case.instruction, case.robots or ())) is not None:
        return prediction(case.id, None, "a stop, not a task", decision=Verdict.STOP, stops=stop.robots)
    if (training := training_request(case.instruction, case.robots or ())) is not None:
        return prediction(case.id, None, training_refused(training).message)
    if (said := rule_words(case.instruction, robots or (), site)) is not None and said.rule:
        return prediction(case.id, None, rule_refused(case.instruction).message)
    try:
        outcome = await decomposer.plan(PlanContext(instruction=case.instruction, robots=robots, site=site))
    except PlanError as error:
        return prediction(case.id, None, error.message)
    plan = outcome.plan
    held = plan.provenance is not None and bool(plan.provenance.confirm)
    decision = Verdict.REFUSE if plan.confidence < show_from else Verdict.HOLD if held else Verdict.RUN
    return prediction(case.id, plan, decision=decision)


def _resumed(out: Path) -> set[str]:
    """Return the ids that have a prediction; a last line that was cut off by an interruption is taken out."""
    try:
        whole = out.read_bytes()
    except FileNotFoundError:
        return set()
    except OSError as error:
        raise RecordError(f"{out} cannot be read: {error.strerror}") from error
    end = whole.rfind(b"\n") + 1
    found: set[str] = set()
    for number, line in enumerate(whole[:end].split(b"\n"), start=1):
        if line.strip():
            try:
                found.add(msgspec.json.decode(line, type=_Id).id)
            except (msgspec.DecodeError, RecursionError) as error:
                raise RecordError(
                    f"{out}:{number} is no prediction: {error}", remedy="give another --out, or remove the file"
                ) from error
    if end < len(whole):
        with out.open("r+b") as file:
            file.truncate(end)
    return found


class _Id(Struct):
    id: str


def _opened(out: Path) -> BinaryIO:
    try:
        return out.open("ab")
    except OSError as error:
        raise RecordError(f"{out} cannot be written: {error.strerror}", remedy="give another --out") from error
