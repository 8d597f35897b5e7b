"""Pool policies on arrival traces, in simulation: cold starts against wasted memory, here and over many gateways.

No container is started: the pool's own planner decides over hours of generated arrivals (pool/simulator). All
policies see the same traces; each is played with several memory budgets, which gives its curve of cold starts against
memory held idle. Figures depend on the seed alone, not on the machine; only `seconds` does.
"""

import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance.errors import ConfigError
from appliance.pool.policies import Evictor
from appliance.pool.settings import PoolConfig
from appliance.record.reader import read
from appliance.skills.catalogue import Catalogue, load_catalogue
from appliance.tasks.machine import Transition, TransitionKind
from workshop.simulators.pool import Arrival, Image, Outcome, Trace, simulate
from workshop.simulators.pool.clairvoyant import Belady, cold_with_foresight, least_cold, least_cold_within
from workshop.simulators.pool.traces import azure, plain, read_trace, trace_of

ENDS = (TransitionKind.SUCCEEDED, TransitionKind.ATTEMPT_FAILED)


def read_any(path: Path) -> Trace:
    """Read a trace from a fleet's MCAP log or from a JSONL file.

    Raises:
        ConfigError: it has no arrivals, or is neither.
        NotFoundError, RecordError: no such log, or a damaged one.
    """
    return read_log(path, load_catalogue()) if path.suffix == ".mcap" else read_trace(path)


def read_log(path: Path, catalogue: Catalogue) -> Trace:
    """Return the runs that a log tells of: images by their skills, gateways numbered as they come up.

    A run without an end in the log, or of a skill that is not in the catalogue, is left out.
    """
    decoder = msgspec.json.Decoder(Transition)
    skills: dict[tuple[str, str], str] = {}
    began: dict[tuple[str, str, int], Transition] = {}
    gateways: dict[str, int] = {}
    arrivals: list[Arrival] = []
    for message in read(path, keys="**/task/*/transition"):
        try:
            step = decoder.decode(message.payload)
        except msgspec.DecodeError:
            continue  # not one of ours
        if step.plan is not None:
            skills |= {(step.task, each.id): each.skill for each in step.plan.subtasks}
        run = (step.task, step.subtask, step.attempt)
        if step.kind is TransitionKind.STARTED:
            began[run] = step
        elif step.kind in ENDS and (start := began.pop(run, None)) is not None:
            skill = catalogue.skills.get(skills.get(run[:2], ""))
            if skill is not None:
                arrivals.append(
                    Arrival(
                        at_s=start.at_ns / 1e9,
                        image=skill.image,
                        service_s=max(0.0, (step.at_ns - start.at_ns) / 1e9),
                        gateway=gateways.setdefault(start.gateway, len(gateways)),
                    )
                )
    if not arrivals:
        raise ConfigError(f"{path}: no run of a known skill in it")
    images = {each.image: Image(name=each.image) for each in arrivals}
    return trace_of(path.stem, arrivals, images)


Progress = Callable[[str], None]

BUDGETS_MB = (1024, 2048, 4096, 8192)
FOREVER_S = 1e9
DEFAULT = "default"
KEEP_ALIVE = "keep-alive"
"""The paper's local pool and OpenWhisk: 10 minutes, and a start belongs to the run that it was made for."""
SOONER = "keep-alive-sooner"
"""The same where a run takes what comes free before its own start has ended, as in this pool whatever the policy."""
CLAIRVOYANT = "clairvoyant"
BY_NUMBER = "clairvoyant-number"
"""Policies with a crystal ball: one saves the most time, as the default is meant to, one the most cold starts."""
FLEET = 10
"""Gateways of the fleet in which the shipped default, which is federated, is held against keep-alive."""
FLEET_TRACES: dict[str, Callable[[int], Trace]] = {
    "azure": lambda seed: azure(seed=seed, most_rate=0.1 * FLEET, duration_s=7200.0, gateways=FLEET),
    "poisson": lambda seed: plain("poisson", seed=seed, rate=0.5 * FLEET, duration_s=7200.0, gateways=FLEET),
    "bursts": lambda seed: plain("bursts", seed=seed, rate=0.5 * FLEET, duration_s=7200.0, gateways=FLEET),
    "diurnal": lambda seed: plain("diurnal", seed=seed, rate=0.2 * FLEET, duration_s=14_400.0, gateways=FLEET),
    "timer": lambda seed: plain("timer", seed=seed, rate=0.5 * FLEET, duration_s=7200.0, gateways=FLEET),
}
TICKS = 17_280
"""The pools are gone through so often over a trace, but at most once a second: for a day every 5 s."""
TRACES: dict[str, Callable[[int], Trace]] = {
    "azure": lambda seed: azure(seed=seed),
    "poisson": lambda seed: plain("poisson", seed=seed, rate=0.5),
    "bursts": lambda seed: plain("bursts", seed=seed, rate=0.5),
    "diurnal": lambda seed: plain("diurnal", seed=seed, rate=0.2, duration_s=86_400.0),
    "timer": lambda seed: plain("timer", seed=seed, rate=0.5),
}


def policies() -> dict[str, PoolConfig]:
    """Return the settings of each policy: one gateway, no floor, as many containers as the memory holds."""
    plain_ = replace(PoolConfig(), mode="local", floor={}, capacity=256)
    bare = replace(plain_, prewarm=(), keep="fixed")
    keep_alive = replace(bare, eviction="lru", idle_s=600.0)
    return {
        KEEP_ALIVE: keep_alive,
        SOONER: keep_alive,
        "lru": replace(bare, eviction="lru", idle_s=FOREVER_S),
        "greedy-dual": replace(bare, eviction="greedy-dual", idle_s=FOREVER_S),
        "histogram": replace(bare, eviction="lru", prewarm=("histogram",), keep="histogram", idle_s=600.0),
        "learned": replace(bare, eviction="learned", idle_s=FOREVER_S),
        DEFAULT: plain_,
    }


def binds(name: str) -> bool:
    """Whether a start belongs to its run with that policy: only with the baseline, which is played as published."""
    return name == KEEP_ALIVE


class Point(Struct, frozen=True, kw_only=True):
    """One policy with one budget on one trace."""

    budget_mb: int
    cold_percent: float
    wasted_gb: float
    """Memory held idle, on average over the trace."""
    cold_ms_per_run: float
    """What runs waited for cold starts, on average over all of them."""
    p99_ms: float
    evictions: int
    prewarmed: int
    unused: int


def point(trace: Trace, budget_mb: int, outcome: Outcome) -> Point:
    """Return what counts of an outcome."""
    return Point(
        budget_mb=budget_mb,
        cold_percent=round(100 * outcome.cold_rate, 3),
        wasted_gb=round(outcome.wasted_gb_s / trace.duration_s, 4),
        cold_ms_per_run=round(1e3 * outcome.cold_s / max(1, outcome.runs), 2),
        p99_ms=round(outcome.p99_ms, 1),
        evictions=outcome.evictions,
        prewarmed=outcome.prewarmed,
        unused=outcome.unused,
    )


def cold_at(curve: Sequence[Point], wasted_gb: float) -> float:
    """Return a policy's cold starts (percent) at that much wasted memory, linear between its points.

    Below its first point its first is meant and beyond its last its last: it cannot be had for less, nor use more.
    """
    ordered = sorted(curve, key=lambda each: (each.wasted_gb, each.cold_percent))
    at = bisect_left([each.wasted_gb for each in ordered], wasted_gb)
    if at == 0:
        return ordered[0].cold_percent
    if at == len(ordered):
        return min(each.cold_percent for each in ordered)
    low, high = ordered[at - 1], ordered[at]
    part = (wasted_gb - low.wasted_gb) / (high.wasted_gb - low.wasted_gb)
    return low.cold_percent + part * (high.cold_percent - low.cold_percent)


def _fewer(ours: float, theirs: float) -> float:
    """Return by how many percent ours are fewer."""
    return round(100 * (1 - ours / theirs), 1) if theirs else 0.0


def on_frontier(mine: Point, others: Iterable[Point]) -> bool:
    """Whether no other point, with no more memory for its containers, is better.

    Better is by 5 % in one of the two (and by 0.1 % of the runs, less is chance), at most 2 % worse in the other.
    """
    return not any(
        (
            each.cold_percent < min(0.95 * mine.cold_percent, mine.cold_percent - 0.1)
            and each.wasted_gb <= 1.02 * mine.wasted_gb
        )
        or (each.cold_percent <= 1.02 * mine.cold_percent and each.wasted_gb < 0.95 * mine.wasted_gb)
        for each in others
        if each.budget_mb <= mine.budget_mb
    )


def compare(curves: dict[str, list[Point]]) -> dict[str, Any]:
    """Return how the default stands: against keep-alive at equal memory, and on the frontier of the others.

    At each budget: `fewer_at_budget`, percent fewer cold starts than keep-alive with the same budget;
    `fewer_at_waste`, the same against keep-alive's curve where it wastes as much (None: it never wastes so much);
    `on_frontier`, whether no point of another policy is better.
    """
    others = [each for name, curve in curves.items() if name not in {DEFAULT, CLAIRVOYANT, BY_NUMBER} for each in curve]
    most_gb = 1.02 * max(each.wasted_gb for each in curves[KEEP_ALIVE])
    return {
        str(mine.budget_mb): {
            "fewer_at_budget": _fewer(mine.cold_percent, theirs.cold_percent),
            "fewer_at_waste": _fewer(mine.cold_percent, cold_at(curves[KEEP_ALIVE], mine.wasted_gb))
            if mine.wasted_gb <= most_gb
            else None,
            "on_frontier": on_frontier(mine, others),
        }
        for mine, theirs in zip(curves[DEFAULT], curves[KEEP_ALIVE], strict=True)
    }


def on_traces(
    traces: Sequence[Trace], budgets_mb: Sequence[int], progress: Progress = lambda _: None
) -> dict[str, Any]:
    """Return every policy's curve, the clairvoyant ones beside them, and how the default stands.

    `possible` is by how many percent fewer cold starts than keep-alive with the same budget there can be: below the
    bound nobody gets who starts on demand and lets no run wait for another; `foresight` is a plan made with all
    arrivals known, the crystal balls are policies that know when each container is used next.

    Several traces are one kind of arrivals drawn with several seeds: each point is the mean over them, since on one
    draw alone two good policies differ by more than they do in general.
    """
    played = [_play(trace, budgets_mb, progress) for trace in traces]
    curves = {name: _mean([each[0][name] for each in played]) for name in played[0][0]}
    bounds = [each[1] for each in played]
    within, foresight = (
        [fmean(each) for each in zip(*(each[which] for each in played), strict=True)] for which in (2, 3)
    )
    return {
        "runs": sum(len(trace.arrivals) for trace in traces),
        "hours": round(sum(trace.duration_s for trace in traces) / 3600, 1),
        "images": len({each.image for each in traces[0].arrivals}),
        "draws": len(traces),
        "curves": {name: [_plain(each) for each in curve] for name, curve in curves.items()},
        "bound_at_default_waste": [round(fmean(each), 3) for each in zip(*bounds, strict=True)],
        "bound_within_budget": [round(each, 3) for each in within],
        "with_foresight": [round(each, 3) for each in foresight],
        "possible": {
            str(theirs.budget_mb): {
                "bound": _fewer(bound, theirs.cold_percent),
                "foresight": _fewer(planned, theirs.cold_percent),
                CLAIRVOYANT: _fewer(saving.cold_percent, theirs.cold_percent),
                BY_NUMBER: _fewer(sparing.cold_percent, theirs.cold_percent),
            }
            for theirs, bound, planned, saving, sparing in zip(
                curves[KEEP_ALIVE], within, foresight, curves[CLAIRVOYANT], curves[BY_NUMBER], strict=True
            )
        },
        "default": compare(curves),
        "default_each_draw": [
            {budget: stands["on_frontier"] for budget, stands in compare(each[0]).items()} for each in played
        ],
    }


def _play(
    trace: Trace, budgets_mb: Sequence[int], progress: Progress
) -> tuple[dict[str, list[Point]], list[float], list[float], list[float]]:
    """Return every policy's curve on one trace, and three figures of cold starts for each budget, percent.

    The bound with the default's idle memory on average, that with no more memory than the budget at any moment, and the
    plan made with all arrivals known.
    """
    chosen = policies()
    curves: dict[str, list[Point]] = {}
    tick_s = max(1.0, trace.duration_s / TICKS)
    for name, settings in chosen.items():
        progress(f"{trace.name}: {name}")
        curves[name] = [
            point(trace, budget, simulate(trace, replace(settings, memory_mb=budget), tick_s=tick_s, binds=binds(name)))
            for budget in budgets_mb
        ]

    ideal = chosen["greedy-dual"]
    for name, by_number in ((CLAIRVOYANT, False), (BY_NUMBER, True)):
        progress(f"{trace.name}: {name}")

        def crystal_ball(gateway: int, *, by_number: bool = by_number) -> Evictor:
            return Belady(trace, gateway, by_number=by_number)

        curves[name] = [
            point(
                trace,
                budget,
                simulate(trace, replace(ideal, memory_mb=budget), tick_s=tick_s, make_evictor=crystal_ball),
            )
            for budget in budgets_mb
        ]
    bound = least_cold(trace, [each.wasted_gb * 1024 * trace.duration_s for each in curves[DEFAULT]])
    percent = 100 / len(trace.arrivals)
    within, foresight = least_cold_within(trace, budgets_mb), cold_with_foresight(trace, budgets_mb)
    return (
        curves,
        [percent * each for each in bound],
        [percent * each for each in within],
        [percent * each for each in foresight],
    )


def _mean(curves: Sequence[Sequence[Point]]) -> list[Point]:
    """Return the mean of one policy's curves over several draws of a trace."""
    return [
        Point(
            budget_mb=same[0].budget_mb,
            cold_percent=round(fmean(each.cold_percent for each in same), 3),
            wasted_gb=round(fmean(each.wasted_gb for each in same), 4),
            cold_ms_per_run=round(fmean(each.cold_ms_per_run for each in same), 2),
            p99_ms=round(fmean(each.p99_ms for each in same), 1),
            evictions=round(fmean(each.evictions for each in same)),
            prewarmed=round(fmean(each.prewarmed for each in same)),
            unused=round(fmean(each.unused for each in same)),
        )
        for same in zip(*curves, strict=True)
    ]


def over_gateways(
    counts: Sequence[int],
    *,
    seed: int,
    budget_mb: int,
    duration_s: float = 7200.0,
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Return cold, local and federated pools with the default policies at so many gateways.

    The load grows with the gateways; half of each image's runs come to its home, the others anywhere. `keep_alive` is
    the paper's local pool: 10 minutes, no other gateway.
    """
    result: dict[str, Any] = {}
    chosen = policies()
    for count in counts:
        progress(f"{count} gateways")
        trace = plain("poisson", seed=seed, images=24, rate=0.05 * count, duration_s=duration_s, gateways=count)
        lines: dict[str, Any] = {"runs": len(trace.arrivals)}
        for name, policy, mode in (
            ("cold", DEFAULT, "cold"),
            ("keep_alive", KEEP_ALIVE, "local"),
            ("local", DEFAULT, "local"),
            ("federated", DEFAULT, "federated"),
        ):
            settings = replace(chosen[policy], memory_mb=budget_mb, mode=mode)
            outcome = simulate(trace, settings, tick_s=10.0, binds=binds(policy))
            lines[name] = {
                "cold_percent": round(100 * outcome.cold_rate, 2),
                "remote_percent": round(100 * outcome.remote / max(1, outcome.runs), 2),
                "p50_ms": outcome.p50_ms,
                "p99_ms": round(outcome.p99_ms, 1),
                "wasted_gb_per_gateway": round(outcome.wasted_gb_s / trace.duration_s / count, 3),
            }
        result[str(count)] = lines
    return result


def in_a_fleet(
    kinds: Sequence[str], budgets_mb: Sequence[int], *, seed: int, progress: Progress = lambda _: None
) -> dict[str, Any]:
    """Return the default as it is shipped (federated) beside keep-alive, on each gateway of a fleet with equal memory.

    A gateway's load is that of the traces of one gateway; half of each image's runs come to its home, the others
    anywhere. `fewer_at_budget` as in `compare`; memory held idle is given per gateway. Every other policy is played
    federated too (`keep_alive_federated` among them): what is left beside those is the default's own, and
    `on_frontier` is said of it among those. `bound`: the fewest percent that anybody who starts on demand and lets
    no run wait for another can have with the memory of all gateways together, as if they were one.
    """
    chosen = policies()
    ways = [("keep_alive", KEEP_ALIVE, "local"), ("keep_alive_federated", SOONER, "federated")]
    ways += [(name, name, "federated") for name in chosen if name not in {KEEP_ALIVE, SOONER}]
    result: dict[str, Any] = {}
    for kind in kinds:
        trace = FLEET_TRACES[kind](seed)
        lines: dict[str, Any] = {"runs": len(trace.arrivals)}
        progress(f"{FLEET} gateways: {kind}, bound")
        bounds = least_cold_within(trace, [FLEET * each for each in budgets_mb])
        seen: list[Point] = []
        for budget, bound in zip(budgets_mb, bounds, strict=True):
            progress(f"{FLEET} gateways: {kind} with {budget} MB each")
            points: dict[str, Point] = {}
            for name, policy, mode in ways:
                settings = replace(chosen[policy], memory_mb=budget, mode=mode)
                outcome = simulate(trace, settings, tick_s=10.0, binds=binds(policy))
                points[name] = point(trace, budget, outcome)
            seen += [each for name, each in points.items() if name not in {"keep_alive", DEFAULT}]
            lines[str(budget)] = {
                name: {"cold_percent": each.cold_percent, "wasted_gb": round(each.wasted_gb / FLEET, 3)}
                for name, each in points.items()
            } | {
                "fewer_at_budget": _fewer(points[DEFAULT].cold_percent, points["keep_alive"].cold_percent),
                "on_frontier": on_frontier(points[DEFAULT], seen),
                "bound": round(100 * bound / len(trace.arrivals), 3),
            }
        result[kind] = lines
    return result


def _plain(each: Point) -> dict[str, Any]:
    return {name: getattr(each, name) for name in each.__struct_fields__}


def run(
    *,
    traces: Sequence[str] = (),
    recorded: Path | None = None,
    budgets_mb: Sequence[int] = BUDGETS_MB,
    gateways: Sequence[int] = (1, 10, 100),
    seed: int = 1,
    draws: int = 1,
    progress: Progress = lambda _: None,
) -> dict[str, Any]:
    """Play all policies on traces and return the figures.

    Args:
        traces: names of generated traces (TRACES); all when none is named and none recorded.
        recorded: file of a recorded trace, JSONL or a fleet's MCAP log.
        budgets_mb: memory budgets of a gateway.
        gateways: numbers of gateways for federated against local; with none, no fleet is simulated.
        seed: of the traces.
        draws: each kind of trace is drawn so often, with this seed and those after it; points are means.
        progress: told what is being played.

    Raises:
        ConfigError: there is no such trace, the file is none, or there are no draws.
    """
    if draws < 1:
        raise ConfigError(f"{draws} draws of a trace", remedy="at least 1")
    for name in traces:
        if name not in TRACES:
            raise ConfigError(f"no trace {name!r}", remedy=f"known: {', '.join(TRACES)}")
    began = time.perf_counter()
    seeds = range(seed, seed + draws)
    played = [[TRACES[name](each) for each in seeds] for name in traces or (TRACES if recorded is None else ())]
    if recorded is not None:
        played.append([read_any(recorded)])
    result: dict[str, Any] = {
        "seed": seed,
        "traces": {drawn[0].name: on_traces(drawn, budgets_mb, progress) for drawn in played},
    }
    if gateways:
        result["gateways"] = over_gateways(gateways, seed=seed, budget_mb=2048, progress=progress)
        if recorded is None:
            result["fleet"] = in_a_fleet(traces or tuple(FLEET_TRACES), budgets_mb, seed=seed, progress=progress)
    result["seconds"] = round(time.perf_counter() - began, 1)
    return result
