"""What a benchmark measured as Markdown tables, for `docs/benchmarks.md`. Pure."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

from appliance.errors import PayloadError

Row = Sequence[Any]


def markdown(result: Mapping[str, Any]) -> str:
    """Render a result of any benchmark.

    Distributions (mappings with a `count`) become one table, their curves another, ladders of rates one each, policies
    one a trace, a census one of before and after; what is left stands below as a list.

    Raises:
        PayloadError: it is of no benchmark.
    """
    try:
        return _markdown(result)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise PayloadError(
            f"this is no result of a benchmark ({type(error).__name__}: {error})",
            remedy="name a file of `swiftbot bench … --json`",
        ) from error


def _markdown(result: Mapping[str, Any]) -> str:
    parts: list[str] = []
    rest: list[Row] = []
    rows: list[Row] = []
    for name, value in _flat(_by_heap(result)):
        if isinstance(value, Mapping) and "count" in value:
            rows.append((f"`{name}`", *(_figure(value.get(key)) for key in ("count", "p50", "p90", "p99", "max"))))  # pyright: ignore[reportUnknownMemberType]
        else:
            rest.append((f"`{name}`", _figure(value)))
    if rows:
        parts.append(table(("way", "count", "p50 ms", "p90 ms", "p99 ms", "max ms"), rows))
    if curves := _curves(result):
        parts.append(curves)
    parts += [_ladder(each) for each in result.get("ladders", ())]
    parts += [_policies(name, trace) for name, trace in result.get("traces", {}).items()]
    if "census" in result:
        before, after = result["census"]["before"], result["census"]["after"]
        parts.append(table(("held", "before", "after"), [(key, before[key], after[key]) for key in before]))
    if rest:
        parts.append("\n".join(f"- {name}: {value}" for name, value in rest))
    return "\n\n".join(parts) + "\n"


def table(header: Row, rows: Sequence[Row]) -> str:
    """Return a table; a cell's `|` is escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(each).replace("|", "\\|") for each in line) + " |" for line in lines)


def _ladder(ladder: Mapping[str, Any]) -> str:
    title = f"{ladder['mode']}, {ladder['spread']} arrivals, {ladder['service_ms']:g} ms of work"
    rows: list[Row] = []
    for rate, cell in ladder["cells"].items():
        phases = ", ".join(f"{count} {phase}" for phase, count in cell["phases"].items())
        unserved = sum(cell["unserved"].values())
        start = cell["start"]
        rows.append(
            (rate, start["count"], *(_figure(start.get(key)) for key in ("p50", "p90", "p99")), unserved, phases,
             f"{cell['cpu']:.0%}")
        )  # fmt: skip
    broke = ladder["breaking"]
    if broke["breaks"] is None:
        ending = f"Carried to {broke['holds']:g}/s, the highest rate offered."
    else:
        ending = f"Breaks at {broke['breaks']:g}/s: {'; '.join(broke['why'])}."
    header = ("runs/s", "count", "p50 ms", "p90 ms", "p99 ms", "unserved", "phases", "CPU")
    return f"{title}:\n\n{table(header, rows)}\n\n{ending}"


def _curves(result: Mapping[str, Any]) -> str:
    """Return the distribution curves: within how many milliseconds which share of the runs was; empty without any."""
    curves: dict[str, Any] = dict(result.get("cdf", {}))
    for name, value in result.items():
        inner: Mapping[str, Any] = cast("Any", value) if isinstance(value, Mapping) else {}
        curves |= {f"{name}.{key}": curve for key, curve in inner.get("cdf", {}).items()}
    points = {name: {share: at_ms for at_ms, share in curve} for name, curve in curves.items() if curve}
    if not points:
        return ""
    rows = [(f"`{name}`", *(_figure(found.get(share)) for share in SHARES)) for name, found in points.items()]
    return table(("so many were within, ms", *(f"{share:.4g} %" for share in (100 * each for each in SHARES))), rows)


def _policies(name: str, trace: Mapping[str, Any]) -> str:
    """Return one trace's policies with each budget, how the default stands, and what could be had at all."""
    curves: Mapping[str, Sequence[Mapping[str, Any]]] = trace["curves"]
    budgets = list(trace["default"])
    rows: list[Row] = [
        (f"`{policy}`", *(f"{each['cold_percent']:.2f} / {each['wasted_gb']:.2f}" for each in curve))
        for policy, curve in curves.items()
    ]
    for key, words in _STANDS.items():
        rows.append((words, *(_figure(trace["default"][budget][key]) for budget in budgets)))
    for key in trace["possible"][budgets[0]]:
        words = f"percent fewer than keep-alive: {key}"
        rows.append((words, *(_figure(trace["possible"][budget][key]) for budget in budgets)))
    header = ("cold starts in percent / GB held idle", *(f"{int(budget) / 1024:g} GB" for budget in budgets))
    return f"`{name}`, {trace['runs']:,} runs:\n\n{table(header, rows)}"


def _by_heap(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result with its heaps by name instead of in a list."""
    heaps = {f"{each['size_mb']} MB of {each['kind']}": each for each in result.get("heaps", ())}
    parts = {name: {key: heap[key] for key in heap if key not in ("size_mb", "kind")} for name, heap in heaps.items()}
    return {key: value for key, value in result.items() if key != "heaps"} | parts


SHARES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999, 1.0)
"""Points of a distribution curve that a table shows, of those in `figures.CDF_SHARES`."""
_STANDS = {
    "fewer_at_budget": "percent fewer than keep-alive: default",
    "fewer_at_waste": "the same at equal idle memory",
    "on_frontier": "default on the frontier",
}
_APART = frozenset({"cdf", "ladders", "traces", "census", "checkpoints"})


def _flat(result: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the leaves and distributions of a result by their path."""
    found: list[tuple[str, Any]] = []
    for key, value in result.items():
        if key in _APART:
            continue
        inner = cast("Mapping[str, Any]", value if isinstance(value, Mapping) else {"count": 1})
        if "count" in inner:
            found.append((f"{prefix}{key}", cast("Any", value)))
        else:
            found += _flat(inner, f"{prefix}{key}.")
    return found


def _figure(value: Any) -> str:
    """Return a number as short as it says something."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.1f}" if abs(value) >= 10 else f"{value:.2f}".rstrip("0").rstrip(".")
    if isinstance(value, list):
        return ", ".join(_figure(each) for each in cast("list[Any]", value))
    return str(value)
