"""The paper's evaluation as one command."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from appliance import console
from appliance.cli.common import Json
from workshop.cli.bench.common import bench_app, measure, say, tell


@bench_app.command
def paper(
    *,
    out: Annotated[Path, Parameter(help="Folder of the report and of its data; begun again it goes on there.")],
    size: Annotated[
        Literal["smoke", "short", "full"],
        Parameter(help="smoke shows that all of it works (minutes), short is meant for an hour, full for a day."),
    ] = "short",
    again: Annotated[bool, Parameter(negative="", help="Measure what is there already, too.")] = False,
    show: Annotated[bool, Parameter(negative="", help="Measure nothing: draw what is there.")] = False,
    as_json: Json = False,
) -> int:
    """The paper's evaluation on this machine: Table I, accuracy and loss, round times, failing clients, startup.

    Writes `OUT/report.md` with figures as SVG and the JSON that each is drawn from; the paper's values are reference
    marks in them. Needs image `learn` and the extra `report` (docs/paper.md).
    """
    from workshop.bench.paper import run

    result = measure(run(out.expanduser().absolute(), size, again=again, only_read=show, progress=say))
    if as_json:
        tell(result, as_json=True)
    else:
        lacking = f"; not measured: {', '.join(result['missing'])}" if result["missing"] else ""
        console.out.print(
            f"{result['report']}: {len(result['figures'])} figures{lacking}", markup=False, soft_wrap=True
        )
    return 0
