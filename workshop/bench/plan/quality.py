"""How good plans are: a set of instructions with gold plans, put to the cascade, scored by the set's own `score.py`.

The scorer is loaded from beside the cases, since figures are only comparable when counted by the same program. Each
case's roster gets every ability of the catalogue (the set names robots, not what they can do), and no site. Two
figures stand side by side: `all`, what the tiers propose for every case whatever their confidence, and `taken`, the
cases in which a plan was sure enough to be carried out. The second must be high, and the first minus it is what goes
to a better tier or back to the operator: `curve` says what that brings. `cascade` is measured, not worked out: the same
cases put to the real cascade with the upstream stand-in, several at a time.
"""

import asyncio
import importlib.util
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
from msgspec import Struct

from appliance.errors import NotFoundError, PayloadError, PlanError
from appliance.llm.batch import everyman, prediction
from appliance.llm.cascade import Decomposer, Slot
from appliance.llm.routing import Budget
from appliance.llm.settings import LlmConfig, PlanContext, SafetyConfig
from appliance.llm.tiers import configured
from appliance.model import Plan, Tier
from appliance.skills.catalogue import Catalogue, load_catalogue
from workshop.bench.plan.curve import UPSTREAM_MS, Answered, GoldTier, curve, gold_plan
from workshop.scoring import Score, mean_figures

Progress = Callable[[str], None]
AT_ONCE = 16
"""Cases at a time that the real cascade is given: most of them wait for the stand-in."""


class Case(Struct, frozen=True):
    """One line of the set; what else it holds is the scorer's."""

    id: str
    instruction: str
    gold: dict[str, Any]
    robots: tuple[str, ...] | None = None


def default_cases() -> Path:
    """Return the development set, which comes with the package, its scorer beside it."""
    return Path(__file__).parent / "cases" / "dev.jsonl"


async def run(
    cases: Path | None = None,
    *,
    config: LlmConfig | None = None,
    limit: int = 0,
    upstream: bool = True,
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Plan every case and score the plans.

    Args:
        cases: JSONL file of cases, with `score.py` beside it; by default the development set.
        config: tiers to measure; by default the rules alone. Thresholds count for `taken` only.
        limit: use the first so many cases; 0 for all.
        upstream: also put the cases to the real cascade with the upstream stand-in.
        progress: told each case whose plan is not exact.

    Returns:
        `all` and `taken`: percent by figure and the number of cases; `by_domain`: decomposition by domain;
        `latency_ms`: p50 and p99; `tiers`: how often each tier's plan was used; `routed_on`: the tier whose confidence
        decides; `curve`: accuracy against share escalated, by threshold; `cascade`: the real cascade with the stand-in.

    Raises:
        NotFoundError: the cases or their scorer are not there.
        PayloadError: a line is no case.
    """
    path = cases or default_cases()
    found = _read(path)[: limit or None]
    score = _scorer(path.parent / "score.py")
    wanted = config or LlmConfig(tiers=("rules",))
    catalogue = load_catalogue()
    # Whatever its confidence: thresholds are applied below, to tell apart what would have been taken.
    asking = msgspec.structs.replace(
        wanted,
        require_implemented=False,
        cache=0,
        run_confidence=0.0,
        show_confidence=0.0,
    )
    paid = Budget(
        cost=wanted.upstream_budget,
        requests=wanted.upstream_requests,
        price_in=wanted.upstream_price_in,
        price_out=wanted.upstream_price_out,
    )
    slots = configured(asking, catalogue, None, lambda: (paid, lambda: None), SafetyConfig())
    decomposer = Decomposer(asking, catalogue, slots=slots)
    await decomposer.start()
    rows: list[Score] = []
    answered: list[Answered] = []
    taken: list[Score] = []
    domains: dict[str, list[Score]] = {}
    latency: list[float] = []
    tiers: dict[str, int] = {}
    try:
        for case in found:
            plan = await _plan(decomposer, case, catalogue)
            row = _scored(score, case, _prediction(plan))
            rows.append(row)
            answered.append(
                Answered(
                    confidence=plan.confidence if plan is not None else 0.0,
                    latency_ms=plan.latency_ms if plan is not None else 0.0,
                    row=msgspec.to_builtins(row),
                    gold=msgspec.to_builtins(_scored(score, case, case.gold)),
                )
            )
            domains.setdefault(str(case.gold.get("domain")), []).append(row)
            if plan is None:
                progress(f"{case.id}: no plan")
                continue
            latency.append(plan.latency_ms)
            tiers[plan.tier.value] = tiers.get(plan.tier.value, 0) + 1
            if plan.confidence >= wanted.run_confidence:
                taken.append(row)
            if not row.exact:
                progress(f"{case.id}: confidence {plan.confidence:.2f}, decomposition {row.decomposition:.2f}")
    finally:
        await decomposer.close()
    latency.sort()
    first = decomposer.tiers[0] if decomposer.tiers else "none"
    return {
        "all": mean_figures(rows),
        "taken": mean_figures(taken),
        "by_domain": {name: mean_figures(each)["decomposition"] for name, each in sorted(domains.items())},
        "latency_ms": {"p50": _at(latency, 0.5), "p99": _at(latency, 0.99)},
        "tiers": tiers,
        "routed_on": f"the confidence of {first}" + (": there is no local model" if first != "local" else ""),
        "upstream": f"gold plans after {UPSTREAM_MS:g} ms",
        "curve": curve(answered),
        "cascade": await _cascade(found, wanted, catalogue, score) if upstream else None,
    }


async def _cascade(cases: Sequence[Case], config: LlmConfig, catalogue: Catalogue, score: ModuleType) -> dict[str, Any]:
    """Put all cases to the real cascade, `AT_ONCE` at a time, with an upstream that is always right after a while."""
    config = msgspec.structs.replace(config, require_implemented=False, cache=0)
    made = configured(config, catalogue, None, _unpaid, SafetyConfig())
    slots = [slot for slot in made if slot.planner.name is not Tier.UPSTREAM]
    gold = GoldTier({case.instruction: gold_plan(case.gold) for case in cases})
    slots.append(Slot(planner=gold, deadline_s=60.0, leaves_machine=True))
    decomposer = Decomposer(msgspec.structs.replace(config, at_once=AT_ONCE), catalogue, slots=slots)
    await decomposer.start()
    turns = asyncio.Semaphore(AT_ONCE)

    async def one(case: Case) -> tuple[Score, Plan | None, float]:
        async with turns:
            began = time.monotonic()
            plan = await _plan(decomposer, case, catalogue)
            elapsed = 1000 * (time.monotonic() - began)
        return _scored(score, case, _prediction(plan)), plan, elapsed

    try:
        found = await asyncio.gather(*(one(case) for case in cases))
    finally:
        await decomposer.close()
    times = sorted(elapsed for _, _, elapsed in found)
    escalated = sum(plan is not None and plan.tier is Tier.UPSTREAM for _, plan, _ in found)
    return {
        "figures": mean_figures([row for row, _, _ in found]),
        "escalated": round(100 * escalated / max(1, len(found)), 1),
        "run_confidence": config.run_confidence,
        "latency_ms": {"p50": _at(times, 0.5), "p99": _at(times, 0.99)},
        "planless": sum(plan is None for _, plan, _ in found),
    }


def _unpaid() -> tuple[Budget, Callable[[], None]]:
    return Budget(cost=0, requests=0, price_in=0, price_out=0), lambda: None


async def _plan(decomposer: Decomposer, case: Case, catalogue: Catalogue) -> Plan | None:
    robots = None if case.robots is None else tuple(everyman(name, catalogue) for name in case.robots)
    try:
        return (await decomposer.plan(PlanContext(instruction=case.instruction, robots=robots))).plan
    except PlanError:
        return None


def _scored(scorer: ModuleType, case: Case, said: dict[str, Any]) -> Score:
    """Return the figures of a plan as the set's own scorer counts them."""
    return msgspec.convert(scorer.score_case(msgspec.to_builtins(case), said), Score)


def _prediction(plan: Plan | None) -> dict[str, Any]:
    return {} if plan is None else prediction("", plan)


def _at(ordered: Sequence[float], part: float) -> float | None:
    return round(ordered[min(len(ordered) - 1, int(len(ordered) * part))], 3) if ordered else None


def _read(path: Path) -> list[Case]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise NotFoundError(f"no cases at {path}: {error.strerror}", remedy="name a JSONL file of cases") from error
    found: list[Case] = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                found.append(msgspec.json.decode(line, type=Case))
            except msgspec.DecodeError as error:
                raise PayloadError(f"{path}:{number} is no case: {error}", remedy="see the set's README") from error
    return found


def _scorer(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("decomposition_score", path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise NotFoundError(f"no scorer at {path}", remedy="keep score.py beside the cases")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
