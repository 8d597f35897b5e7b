"""Results of cells as the data of figures, with the paper's values as reference marks. Pure."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any, Literal

from msgspec import Struct

from workshop.bench.learning.store import Kept
from workshop.bench.paper.published import P99_MS, ROUND_RATIO, START_MS, TABLE
from workshop.bench.paper.steps import TIERS

Row = tuple[str, ...]
NAMES = {"sync": "FedAvg", "partial": "SwiftBot (partial)", "offload": "SwiftBot (offload)"}
DATA = {"clips": "drawn clips (paper: UCF101)", "words": "spoken words (paper: LibriSpeech)"}


class Line(Struct, frozen=True, kw_only=True):
    """A curve, or with `published` points that the paper gives."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    published: bool = False


class Violin(Struct, frozen=True, kw_only=True):
    """A distribution, at a place on the x axis."""

    label: str
    x: float
    values: tuple[float, ...]


class Figure(Struct, frozen=True, kw_only=True):
    """What a figure is drawn from; its JSON lies beside it."""

    name: str
    title: str
    x: str
    y: str
    lines: tuple[Line, ...] = ()
    violins: tuple[Violin, ...] = ()
    at: tuple[float, ...] = ()
    """Places that are marked on the x axis."""
    scale: Literal["linear", "log"] = "linear"
    """Of the x axis."""
    note: str = ""


def figures(kept: Sequence[Kept]) -> list[Figure]:
    """Return the figures for which there are results."""
    found: list[Figure] = []
    for workload in dict.fromkeys(each.settings["workload"] for each in kept if "workload" in each.settings):
        mine = [each for each in kept if each.settings.get("workload") == workload]
        curves = [each for each in mine if each.kind == "virtual"]
        found += [figure for value in ("accuracy", "loss") if (figure := _curves(workload, curves, value)) is not None]
        if (figure := _rounds(workload, [each for each in mine if each.kind == "decided"])) is not None:
            found.append(figure)
        found += [_failing(workload, each) for each in mine if each.kind == "clients"]
    found += [_startup(each) for each in kept if each.kind == "startup"]
    found += [_rate(each) for each in kept if each.kind == "rate"]
    return found


def _curves(workload: str, kept: Sequence[Kept], value: str) -> Figure | None:
    lines = tuple(
        Line(
            label=f"{NAMES[each.settings['mode']]}, {each.settings['clients']} clients",
            x=tuple(point["round"] for point in each.result["curve"]),
            y=tuple(point[value] for point in each.result["curve"]),
        )
        for each in kept
    )
    title = f"Test {value}, {DATA[workload]}"
    return Figure(name=f"{value}-{workload}", title=title, x="round", y=value, lines=lines) if lines else None


def _rounds(workload: str, kept: Sequence[Kept]) -> Figure | None:
    """Round times, from the second round on: in the first nothing is known of clients' speeds."""
    violins: list[Violin] = []
    ratios: list[str] = []
    by = {(each.settings["mode"], each.settings["clients"]): tuple(each.result["took_s"][1:]) for each in kept}
    for clients in sorted({number for _, number in by}):
        for mode in ("sync", "partial", "offload"):
            values = by.get((mode, clients), ())
            violins += [Violin(label=NAMES[mode], x=float(clients), values=values)] if values else []
        if (base := by.get(("sync", clients))) and (ours := by.get(("offload", clients))):
            ratios.append(f"{clients} clients {median(ours) / median(base):.2f}")
    if not violins:
        return None
    return Figure(
        name=f"rounds-{workload}", title=f"Time of a round, {DATA[workload]}", x="clients", y="seconds (virtual time)",
        violins=tuple(violins),
        note=f"SwiftBot (offload) over FedAvg, medians: {', '.join(ratios) or 'none'}; the paper with 16 clients: "
        f"{ROUND_RATIO[workload]:.2f}",
    )  # fmt: skip


def _failing(workload: str, kept: Kept) -> Figure:
    def line(label: str, values: Sequence[float]) -> Line:
        return Line(label=label, x=tuple(float(number) for number in range(1, len(values) + 1)), y=tuple(values))

    result = kept.result
    lines = (line("a quarter of the clients killed", result["loss"]), line("undisturbed", result["calm_loss"]))
    return Figure(
        name=f"failing-{workload}", title=f"Training loss with failing clients, {DATA[workload]}", x="round", y="loss",
        lines=lines, at=tuple(float(number) for number in result["killed"]),
        note=f"at most {100 * result['most_apart']:.1f} % apart; the longest round took {result['longest']} times the "
        "median of the undisturbed run",
    )  # fmt: skip


def _startup(kept: Kept) -> Figure:
    ways = {"cold": "cold_ordered", "local": "ordered", "federated": "federated"}
    lines: list[Line] = []
    for mode, way in ways.items():
        points = [(time, share) for time, share in kept.result["cdf"][way] if time is not None]
        lines.append(Line(label=mode, x=tuple(time for time, _ in points), y=tuple(share for _, share in points)))
        lines.append(Line(label=f"{mode}, the paper's median", x=(START_MS[mode],), y=(0.5,), published=True))
    return Figure(
        name="startup", title="Startup of a subtask", x="ms", y="share of runs", lines=tuple(lines), scale="log",
        note=f"cold over federated, medians: {kept.result['cold_over_federated']}; the paper: 5.4",
    )  # fmt: skip


def _rate(kept: Kept) -> Figure:
    lines: list[Line] = []
    for ladder in kept.result["ladders"]:
        points = [(float(rate), cell["start"].get("p99")) for rate, cell in ladder["cells"].items()]
        good = [(rate, p99) for rate, p99 in points if p99 is not None]
        lines.append(Line(label=ladder["mode"], x=tuple(rate for rate, _ in good), y=tuple(p99 for _, p99 in good)))
    for mode, published in P99_MS.items():
        xs, ys = zip(*published, strict=True)
        lines.append(Line(label=f"{mode}, the paper", x=xs, y=ys, published=True))
    return Figure(name="rate", title="p99 of startup against the arrival rate", x="runs a second", y="ms",
                  lines=tuple(lines))  # fmt: skip


def table(kept: Sequence[Kept]) -> list[Row]:
    """Return the rows of Table I: what was measured here, then what the paper gives."""
    rows: list[Row] = []
    measured = {each.settings["tier"]: each.result for each in kept if each.kind == "table"}
    for tier in TIERS:
        if (result := measured.get(tier)) is not None:
            every, p50 = result["all"], result["latency_ms"]["p50"]
            one, two = every["decomposition"], every["parallel_recall"]
            rows.append((f"SwiftBot, {tier}", _shown(one), _shown(two), _shown(p50)))
    return rows + [(f"{name} (the paper)", f"{one}", f"{two}", f"{ms:,.0f}") for name, one, two, ms in TABLE]


def _shown(value: Any) -> str:
    return "–" if value is None else f"{value:,.1f}"


def missing(wanted: Mapping[str, Kept | None]) -> list[str]:
    """Return the cells that are not measured."""
    return [name for name, each in wanted.items() if each is None]
