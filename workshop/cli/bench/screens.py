"""Measurements of the terminal UI."""

from typing import Annotated

from cyclopts import Parameter

from appliance.cli.common import Json
from appliance.errors import Exit
from workshop.cli.bench.common import bench_app, measure, say, tell


@bench_app.command(name="tui")
def bench_tui(
    *,
    seconds: float = 60.0,
    gateways: int = 100,
    robots: int = 500,
    tasks: int = 1000,
    rate: int = 2000,
    plain: Annotated[bool, Parameter(help="Measure a plain table beside it.")] = True,
    as_json: Json = False,
) -> int:
    """Key to paint, CPU and memory of the terminal UI on a large busy fleet, beside a plain table; exit 1 off target.

    Args:
        seconds: For how long each is measured; 600 shows whether memory stays flat.
        gateways: Gateways of the fleet, all put by one process.
        robots: Its robots.
        tasks: Its tasks.
        rate: Updates a second.
        plain: Measure a plain table beside it.
        as_json: Print JSON.
    """
    from workshop.bench.tui.run import run

    result = measure(
        run(seconds=seconds, gateways=gateways, robots=robots, tasks=tasks, rate=rate, plain=plain, progress=say)
    )
    tell(result, as_json=as_json)
    ui, targets = result["ui"], result["targets"]
    p95 = ui["key_to_paint_ms"]["p95"]
    met = p95 is not None and p95 <= targets["key_to_paint_p95_ms"]
    return Exit.DONE if met and ui["cpu_share_of_a_core"] <= targets["cpu_share_of_a_core"] else Exit.FAILED
