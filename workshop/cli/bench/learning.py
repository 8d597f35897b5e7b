"""Measurements of federated learning."""

from pathlib import Path
from typing import Annotated, Any, cast

from cyclopts import Parameter

from appliance import console
from appliance.cli.common import Json
from appliance.errors import Exit
from workshop.bench.learning.cells import Size, Workload
from workshop.cli.bench.common import Words, bench_app, measure, say, tell


@bench_app.command
def learn(
    *,
    workload: Annotated[Workload, Parameter(help="What is trained: drawn clips, or spoken words.")] = "clips",
    size: Annotated[
        Size, Parameter(help="quick shows that each cell works (minutes); short takes hours, full a day on two cores.")
    ] = "short",
    cells: Annotated[
        Words, Parameter(help="Kinds of cells, or beginnings of their names; all of them if not given.")
    ] = (),
    out: Annotated[Path, Parameter(help="Folder of results and data; a bench begun again goes on there.")] = Path(
        "bench-learn"
    ),
    again: Annotated[bool, Parameter(negative="", help="Measure cells that are there already, too.")] = False,
    show: Annotated[bool, Parameter(negative="", help="Measure nothing: show what is there.")] = False,
    as_json: Json = False,
) -> int:
    """Federated learning against FedAvg and Flower: round times, accuracy, fairness, takeovers, memory.

    Each cell is a file in `OUT/cells`. Interrupted, the bench keeps the cells that are done, and goes on with the
    others when it is begun again. Exit code 1 when a figure missed its goal; what was not measured missed none.

    Kinds of cells: decided (round times in virtual time), virtual (accuracy in virtual time, with real training),
    hostile, wall (round times of emulated devices by the clock), takeover, restart, clients (killed), costs (overhead,
    memory), flower (after `make flower`).
    """
    from workshop.bench.learning.run import run

    result = measure(run(out.expanduser().absolute(), workload, size, cells, again=again, only_read=show, progress=say))
    if as_json:
        tell(result, as_json=True)
    else:
        console.out.print(_table(result), markup=False, highlight=False, soft_wrap=True)
    return Exit.FAILED if any(figure["met"] is False for figure in result["figures"]) else Exit.DONE


def _table(result: dict[str, Any]) -> str:
    from workshop.bench.tables import table

    words = {True: "yes", False: "no", None: "–"}
    rows = [
        (each["name"], each["goal"], _shown(each["value"], each["unit"]), words[each["met"]], each["note"])
        for each in result["figures"]
    ]
    missing = f"\n\nnot measured: {', '.join(result['missing'])}" if result["missing"] else ""
    return table(("figure", "goal", "value", "met", "note"), rows) + missing


def _shown(value: Any, unit: str) -> str:
    if value is None:
        return "–"
    listed = cast("list[float]", value) if isinstance(value, list) else [value]
    return f"{', '.join(map(str, listed))} {unit}".strip()
