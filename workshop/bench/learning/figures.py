"""What the cells show, each figure beside what was demanded of it. Pure.

A figure that is not `met` says so; one whose cells are missing, or were not valid, has no verdict and says why. Nothing
is taken from another machine or an older run.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import mean, median
from typing import Any, NamedTuple

from workshop.bench.learning.store import Kept

PROMISED_RATIO = 0.35
EVEN_RATIO = 1.05
NEAR = 0.10
"""Virtual and wall time agree within this share."""
POINTS, LOSS = 0.5, 0.03
OWN = {"offload": 1.0, "partial": 2.0}
"""Points below FedAvg that the accuracy on stragglers' own data may be."""
NEXT_STEP_MS = 1000.0
OVERHEAD_MS = 150.0
FIRST_STEP_MS = 50.0
CONTAINER_MB = 160.0
AGGREGATOR_MB = 150.0
"""Beyond two models and two shards."""
FLAT_MB = 8.0
ROBUST_POINTS = 2.0
LOSS_CURVE, LONGEST = 0.02, 1.3
FLOWER = {"deployment": 1 / 20, "simulation": 1 / 2}


class Figure(NamedTuple):
    """A figure. `met` is None where it was not measured, was not valid, or has no goal; `note` says which."""

    name: str
    goal: str
    value: Any
    unit: str
    met: bool | None
    cells: tuple[str, ...]
    note: str = ""


class _Cells:
    """The results that are there, by kind and settings."""

    def __init__(self, workload: str, kept: Iterable[Kept]) -> None:
        self.workload = workload
        self._kept = [each for each in kept if each.settings.get("workload") == workload]

    def of(self, kind: str, **settings: Any) -> list[Kept]:
        return [
            each
            for each in self._kept
            if each.kind == kind and all(each.settings.get(key) == value for key, value in settings.items())
        ]

    def one(self, kind: str, **settings: Any) -> Kept | None:
        found = self.of(kind, **settings)
        return found[0] if found else None

    def values(self, kind: str, key: str) -> list[Any]:
        return sorted({each.settings[key] for each in self._kept if each.kind == kind})


def judge(workload: str, kept: Sequence[Kept]) -> list[Figure]:
    """Return all figures of a workload."""
    cells = _Cells(workload, kept)
    made: tuple[Callable[[_Cells], list[Figure]], ...] = (
        _round_times, _even_rounds, _agreement, _accuracy, _hostile, _takeover, _restart, _clients, _costs, _flower,
    )  # fmt: skip
    return [figure for make in made for figure in make(cells)]


def _missing(name: str, goal: str, unit: str = "") -> Figure:
    return Figure(name, goal, None, unit, None, (), "not measured")


def _invalid(name: str, result: Mapping[str, Any]) -> str:
    """Why a measurement by the clock does not count; empty: it does."""
    if result["valid"]:
        return ""
    return f"invalid, {name}: {result['exceeded']} of {result['nominal_runs']} nominal runs took 10 % too long"


class _Run(NamedTuple):
    """Rounds of one mode, of a cell in virtual time or of a part of one by the clock."""

    cell: str
    result: Mapping[str, Any]
    invalid: str


def _run_of(cells: _Cells, kind: str, mode: str, clients: int, *, stragglers: bool) -> _Run | None:
    if kind == "decided":
        found = cells.one(kind, mode=mode, clients=clients, stragglers=stragglers)
        return None if found is None else _Run(found.cell, found.result, "")
    found = cells.one(kind, clients=clients)
    name = mode if stragglers else f"{mode}-even"
    if found is None or name not in found.result["runs"]:
        return None
    result = found.result["runs"][name]
    return _Run(found.cell, result, _invalid(name, result))


def _ratio(base: _Run, ours: _Run) -> tuple[float, tuple[str, ...], str]:
    """Return round time against round time, the cells, and why that does not count."""
    value = round(ours.result["p50_s"] / base.result["p50_s"], 3)
    names = tuple(dict.fromkeys((base.cell, ours.cell)))
    return value, names, "; ".join(each for each in (base.invalid, ours.invalid) if each)


def _round_times(cells: _Cells) -> list[Figure]:
    """Round time with stragglers against FedAvg, in virtual time and by the clock."""
    found: list[Figure] = []
    for kind, how in (("decided", "virtual time"), ("wall", "by the clock")):
        modes = ("partial", "offload", "buffered", "drop") if kind == "decided" else ("partial", "offload")
        for clients in cells.values(kind, "clients"):
            base = _run_of(cells, kind, "sync", clients, stragglers=True)
            for mode in modes:
                name, goal = f"round time, {mode} / FedAvg, N = {clients}, {how}", f"≤ {PROMISED_RATIO}"
                ours = _run_of(cells, kind, mode, clients, stragglers=True)
                if base is None or ours is None:
                    found.append(_missing(name, goal, "times"))
                    continue
                value, names, invalid = _ratio(base, ours)
                met = None if invalid or mode in ("buffered", "drop") else value <= PROMISED_RATIO
                note = invalid or ("beside it, no goal" if met is None else "")
                found.append(Figure(name, goal, value, "times", met, names, note))
    return found or [_missing("round time against FedAvg", f"≤ {PROMISED_RATIO}", "times")]


def _even_rounds(cells: _Cells) -> list[Figure]:
    """Round time without stragglers against FedAvg."""
    found: list[Figure] = []
    for kind, how in (("decided", "virtual time"), ("wall", "by the clock")):
        for clients in cells.values(kind, "clients"):
            base = _run_of(cells, kind, "sync", clients, stragglers=False)
            ours = _run_of(cells, kind, "partial", clients, stragglers=False)
            if base is None or ours is None:
                continue
            value, names, invalid = _ratio(base, ours)
            name = f"no stragglers: partial / FedAvg, N = {clients}, {how}"
            met = None if invalid else value <= EVEN_RATIO
            found.append(Figure(name, f"≤ {EVEN_RATIO}", value, "times", met, names, invalid))
    return found or [_missing("no stragglers: partial / FedAvg", f"≤ {EVEN_RATIO}", "times")]


def _agreement(cells: _Cells) -> list[Figure]:
    """Wall time against virtual time."""
    found: list[Figure] = []
    for each in cells.of("wall"):
        for name, result in each.result["runs"].items():
            value = round(result["p50_s"] / result["virtual_p50_s"], 3)
            invalid = _invalid(name, result)
            met = None if invalid else abs(value - 1.0) <= NEAR
            title = f"wall / virtual round time, {name}, N = {each.settings['clients']}"
            found.append(Figure(title, "0.9 to 1.1", value, "times", met, (each.cell,), invalid))
    return found or [_missing("wall / virtual round time", "0.9 to 1.1", "times")]


def last(kept: Kept) -> Mapping[str, Any]:
    """Return the last evaluation of a cell."""
    return kept.result["curve"][-1]


def reached_s(curve: Sequence[Mapping[str, Any]], accuracy: float) -> float | None:
    """Return when a curve reaches an accuracy, by straight lines between evaluations; None: it does not."""
    before_s, before = 0.0, 0.0
    for each in curve:
        if each["accuracy"] >= accuracy:
            rise = each["accuracy"] - before
            part = (accuracy - before) / rise if rise > 0 else 1.0
            return before_s + part * (each["at_s"] - before_s)
        before_s, before = each["at_s"], each["accuracy"]
    return None


def _accuracy(cells: _Cells) -> list[Figure]:
    """Final accuracy and loss, stragglers' own data, time to accuracy: of the seeds that both sides have."""
    found: list[Figure] = []
    base = {each.settings["seed"]: each for each in cells.of("virtual", mode="sync")}
    if base:
        # No goal: what the others are compared with.
        values = [round(100 * last(each)["accuracy"], 2) for each in base.values()]
        names = tuple(each.cell for each in base.values())
        found.append(Figure("final accuracy, FedAvg", "–", values, "%", None, names, "what others are compared with"))
    for mode in ("partial", "offload", "buffered", "drop"):
        ours = {each.settings["seed"]: each for each in cells.of("virtual", mode=mode)}
        seeds = sorted(ours.keys() & base.keys())
        goal_own = f"≥ -{OWN[mode]:g}" if mode in OWN else "–"
        titles = (
            (f"final accuracy, {mode} - FedAvg", f"± {POINTS}", "points"),
            (f"final loss, {mode} / FedAvg", f"± {LOSS:.0%}", "times"),
            (f"accuracy on stragglers' own data, {mode} - FedAvg", goal_own, "points"),
            (f"time to FedAvg's accuracy - 1 point, {mode} / FedAvg", f"≤ {PROMISED_RATIO}", "times"),
        )
        if not seeds:
            found += [_missing(*title) for title in titles]
            continue
        pairs = [(ours[seed], base[seed]) for seed in seeds]
        names = tuple(each.cell for pair in pairs for each in pair)
        apart = [100 * (last(one)["accuracy"] - last(other)["accuracy"]) for one, other in pairs]
        loss = [last(one)["loss"] / last(other)["loss"] for one, other in pairs]
        own = [100 * (last(one)["own"] - last(other)["own"]) for one, other in pairs]
        times = [_time_ratio(one, other) for one, other in pairs]
        goals = mode in OWN
        note = f"seeds {', '.join(map(str, seeds))}" + ("" if goals else "; beside it, no goal")
        found.append(_figure(titles[0], apart, lambda value: abs(value) <= POINTS, goals, names, note))
        found.append(_figure(titles[1], loss, lambda value: abs(value - 1) <= LOSS, goals, names, note))
        found.append(_figure(titles[2], own, lambda value, mode=mode: value >= -OWN[mode], goals, names, note))
        found.append(_figure(titles[3], times, lambda value: value <= PROMISED_RATIO, goals, names, note))
    return found


def _figure(
    title: tuple[str, str, str],
    values: Sequence[float | None],
    good: Callable[[float], bool],
    goals: bool,
    names: tuple[str, ...],
    note: str,
) -> Figure:
    known = [each for each in values if each is not None]
    if len(known) < len(values):
        return Figure(title[0], title[1], None, title[2], False if goals else None, names, f"{note}; never reached")
    value = round(mean(known), 3)
    each = ", ".join(f"{one:.3g}" for one in known)
    return Figure(title[0], title[1], value, title[2], good(value) if goals else None, names, f"{note}: {each}")


def _time_ratio(ours: Kept, base: Kept) -> float | None:
    wanted = last(base)["accuracy"] - 0.01
    one, other = reached_s(ours.result["curve"], wanted), reached_s(base.result["curve"], wanted)
    return None if one is None or not other else one / other


def _hostile(cells: _Cells) -> list[Figure]:
    """Accuracy with a quarter of the clients hostile, against that without."""
    clean = cells.one("hostile", attack="none")
    found: list[Figure] = []
    for attack in ("mixed", "hidden"):
        for rule in ("trimmed", "multikrum", "mean"):
            name = f"4 of 16 hostile ({attack}), {rule} - clean"
            goal = f"≥ -{ROBUST_POINTS:g}" if rule != "mean" else "–"
            one = cells.one("hostile", attack=attack, rule=rule)
            if clean is None or one is None:
                found.append(_missing(name, goal, "points"))
                continue
            value = round(100 * (last(one)["accuracy"] - last(clean)["accuracy"]), 2)
            met = None if rule == "mean" else value >= -ROBUST_POINTS
            note = f"{one.result['refusals']} updates refused, {len(one.result['excluded'])} clients excluded"
            found.append(Figure(name, goal, value, "points", met, (clean.cell, one.cell), note))
    return found


def _takeover(cells: _Cells) -> list[Figure]:
    found: list[Figure] = []
    for phase in ("before", "during", "after"):
        name = f"coordinator killed {phase} the sum"
        one = cells.one("takeover", phase=phase)
        if one is None:
            found += [
                _missing(f"{name}: next step", f"≤ {NEXT_STEP_MS:g}", "ms"),
                _missing(f"{name}: digests", "all the same"),
            ]
            continue
        kills = one.result["kills"]
        steps = [each["next_step_ms"] for each in kills]
        known = [each for each in steps if each is not None]
        worst = max(known) if len(known) == len(steps) and known else None
        met = worst is not None and worst <= NEXT_STEP_MS
        note = f"{len(kills)} kills, after detection; {', '.join(f'{each:g}' for each in known)}"
        found.append(Figure(f"{name}: next step", f"≤ {NEXT_STEP_MS:g}", worst, "ms", met, (one.cell,), note))
        same = sum(each["same"] for each in kills)
        found.append(
            Figure(f"{name}: digests", "all the same", f"{same} of {len(kills)}", "", same == len(kills), (one.cell,))
        )
    return found


def _restart(cells: _Cells) -> list[Figure]:
    one = cells.one("restart")
    name, goal = "all gateways restarted: same digests", "yes, in the same round or the next"
    if one is None:
        return [_missing(name, goal)]
    at, on = one.result["killed_in_round"], one.result["went_on_in_round"]
    met = bool(one.result["same"]) and on in (at, at + 1)
    return [Figure(name, goal, one.result["same"], "", met, (one.cell,), f"killed in round {at}, went on in {on}")]


def _clients(cells: _Cells) -> list[Figure]:
    one = cells.one("clients")
    titles = (
        ("a quarter of the clients killed: loss against undisturbed", f"± {LOSS_CURVE:.0%}", "share"),
        ("a quarter of the clients killed: longest round", f"≤ {LONGEST}", "times"),
    )
    if one is None:
        return [_missing(*title) for title in titles]
    note = _invalid("it", one.result)
    apart, longest = one.result["most_apart"], one.result["longest"]
    short = None if note else longest <= LONGEST
    return [
        Figure(titles[0][0], titles[0][1], apart, titles[0][2], apart <= LOSS_CURVE, (one.cell,)),
        Figure(titles[1][0], titles[1][1], longest, titles[1][2], short, (one.cell,), note),
    ]


def _costs(cells: _Cells) -> list[Figure]:
    found: list[Figure] = []
    every = sorted(cells.of("costs"), key=lambda each: each.settings["clients"])
    for one in every:
        clients, result = one.settings["clients"], one.result
        for way in ("emulated", "plain"):
            note = _invalid(way, result[way])
            parts = ", ".join(
                f"{name} {value:g}" for name, value in result[way]["overhead_ms"].items() if name != "whole"
            )
            goal = way == "emulated" and clients == 16
            value = result[way]["overhead_ms"].get("whole")
            met = None if note or not goal or value is None else value <= OVERHEAD_MS
            how = "devices emulated" if way == "emulated" else "all at once"
            name = f"round beyond its slowest client, N = {clients}, {how}"
            found.append(
                Figure(
                    name,
                    f"≤ {OVERHEAD_MS:g}" if goal else "–",
                    value,
                    "ms",
                    met,
                    (one.cell,),
                    f"{note or 'p50'}; {parts}",
                )
            )
    if not every:
        return [
            _missing("round beyond its slowest client, N = 16", f"≤ {OVERHEAD_MS:g}", "ms"),
            _missing("warm to first step", f"≤ {FIRST_STEP_MS:g}", "ms"),
            _missing("private memory of a client's container", f"≤ {CONTAINER_MB:g}", "MB"),
            _missing("aggregator's peak", f"≤ {AGGREGATOR_MB:g} and flat", "MB"),
        ]
    names = tuple(each.cell for each in every)
    first = median(each.result["single"]["first_step_ms"]["p50"] for each in every)
    starts = median(each.result["single"]["start_ms"]["p50"] for each in every)
    note = f"one client at a time; and {starts:.1f} ms from the order to the handler's first line"
    found.append(
        Figure(
            "warm to first step, p50",
            f"≤ {FIRST_STEP_MS:g}",
            round(first, 1),
            "ms",
            first <= FIRST_STEP_MS,
            names,
            note,
        )
    )
    private = max(each.result["container_mb"]["private"] for each in every)
    found.append(
        Figure(
            "private memory of a client's container",
            f"≤ {CONTAINER_MB:g}",
            private,
            "MB",
            private <= CONTAINER_MB,
            names,
        )
    )
    peaks = [each.result["peak_mb"]["aggregate"] for each in every]
    several = len(peaks) > 1
    flat = max(peaks) - min(peaks) <= FLAT_MB
    note = (
        f"N = {', '.join(str(each.settings['clients']) for each in every)}: {', '.join(f'{peak:g}' for peak in peaks)}"
    )
    found.append(
        Figure("aggregator's peak grows with N by", f"≤ {FLAT_MB:g}", round(max(peaks) - min(peaks), 1), "MB",
               flat if several else None, names, f"{note}; with what it shares with its container")
    )  # fmt: skip
    return found


def _flower(cells: _Cells) -> list[Figure]:
    found: list[Figure] = []
    for way, share in FLOWER.items():
        rivals = cells.of("flower", way=way)
        if not rivals:
            found.append(_missing(f"round, ours / Flower's {way}", f"≤ {share:.3g}", "times"))
        for rival in sorted(rivals, key=lambda each: each.settings["clients"]):
            clients = rival.settings["clients"]
            name = f"round, ours / Flower's {way}, N = {clients}, no emulation"
            ours = cells.one("costs", clients=clients)
            theirs = rival.result["later_p50_s"]
            if ours is None:
                found.append(_missing(name, f"≤ {share:.3g}", "times"))
                continue
            mine = ours.result["plain"]["p50_s"]
            value = round(mine / theirs, 4)
            note = f"{mine:g} and {theirs:g} s, after Flower's first of {rival.result['first_s']:g} s"
            found.append(Figure(name, f"≤ {share:.3g}", value, "times", value <= share, (ours.cell, rival.cell), note))
    return found
