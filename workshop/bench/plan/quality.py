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
from collections.abc import Callable, Mapping, Sequence
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
from appliance.llm.tier import Proposal
from appliance.llm.tiers import configured
from appliance.model import Plan, Subtask, Tier
from appliance.skills.catalogue import Catalogue, load_catalogue
from workshop.bench.figures import quantile
from workshop.bench.plan.rosters import by_size
from workshop.scoring import Score, mean_figures

UPSTREAM_MS = 1280.0
"""GPT-4o's latency in the paper (Table: task decomposition across models)."""
THRESHOLDS = tuple(round(0.05 * step, 2) for step in range(21))


class Answered(Struct, frozen=True, kw_only=True):
    """What the first tier made of a case."""

    confidence: float
    """0 for a case that it had no plan for."""
    latency_ms: float
    row: Mapping[str, Any]
    """The scorer's figures of it."""
    gold: Mapping[str, Any]
    """The same of the gold plan itself: not every figure is defined for every case."""


def curve(
    answered: Sequence[Answered], *, thresholds: Sequence[float] = THRESHOLDS, upstream_ms: float = UPSTREAM_MS
) -> list[dict[str, Any]]:
    """Return accuracy, share escalated and latency for each threshold. Pure.

    Args:
        answered: what the first tier made of each case.
        thresholds: confidences below which a case is escalated.
        upstream_ms: latency of an escalated case, beside the first tier's own.
    """
    points: list[dict[str, Any]] = []
    for threshold in thresholds:
        escalated = [each.confidence < threshold or not each.confidence for each in answered]
        rows = [each.gold if up else each.row for each, up in zip(answered, escalated, strict=True)]
        times = sorted(
            each.latency_ms + (upstream_ms if up else 0.0) for each, up in zip(answered, escalated, strict=True)
        )
        points.append(
            {
                "threshold": threshold,
                "escalated": round(100 * sum(escalated) / max(1, len(answered)), 1),
                "decomposition": _mean(rows, "decomposition"),
                "parallel_recall": _mean(rows, "parallel_recall"),
                "exact": _mean(rows, "exact"),
                "mean_ms": round(sum(times) / max(1, len(times)), 1),
                "p50_ms": round(quantile(times, 0.5), 1) if times else None,
                "p99_ms": round(quantile(times, 0.99), 1) if times else None,
            }
        )
    return points


def _mean(rows: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = [float(row[name]) for row in rows if row[name] is not None]
    return round(100 * sum(values) / len(values), 1) if values else None


class GoldTier:
    """An upstream model that is always right: gives the gold plan of an instruction after a while.

    Args:
        plans: by instruction.
        delay_ms: how long it takes.
    """

    name = Tier.UPSTREAM
    repairs = False
    model = "gold"

    def __init__(self, plans: Mapping[str, Plan], *, delay_ms: float = UPSTREAM_MS) -> None:
        self._plans = plans
        self._delay_s = delay_ms / 1000

    async def start(self) -> None:
        """It is ready."""

    async def propose(
        self, context: PlanContext, *, previous: Plan | None = None, problems: tuple[str, ...] = ()
    ) -> Proposal:
        """Give the gold plan."""
        del previous, problems
        await asyncio.sleep(self._delay_s)
        return Proposal(plan=self._plans[context.instruction], confidence=1.0, model=self.model)

    async def close(self) -> None:
        """Nothing to release."""


def gold_plan(gold: Mapping[str, Any]) -> Plan:
    """Return the gold plan of a case as a plan."""
    return Plan(
        domain=str(gold.get("domain", "")),
        subtasks=tuple(
            Subtask(
                id=str(each["id"]),
                skill=str(each["skill"]),
                robot=each.get("robot"),
                params=dict(each.get("params") or {}),
                after=tuple(each.get("after") or ()),
            )
            for each in gold["subtasks"]
        ),
    )


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
    sizes: Sequence[int] = (),
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Plan every case and score the plans.

    Args:
        cases: JSONL file of cases, with `score.py` beside it; by default the development set.
        config: tiers to measure; by default the rules alone. Thresholds count for `taken` only.
        limit: use the first so many cases; 0 for all.
        upstream: also put the cases to the real cascade with the upstream stand-in.
        sizes: also give the orders of `rosters` to fleets of so many robots.
        progress: told each case whose plan is not exact.

    Returns:
        `all` and `taken`: percent by figure and the number of cases; `by_domain`: decomposition by domain;
        `latency_ms`: p50 and p99; `tiers`: how often each tier's plan was used; `routed_on`: the tier whose confidence
        decides; `curve`: accuracy against share escalated, by threshold; `cascade`: the real cascade with the stand-in;
        `rosters`: `rosters.by_size`.

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
        "rosters": await by_size(wanted, sizes=sizes),
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
