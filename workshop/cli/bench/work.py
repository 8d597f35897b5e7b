"""Measurements of what tasks are made of: throughput, plans, the log; and tables of what was measured."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from appliance import console
from appliance.cli.common import Json, show
from appliance.errors import Exit
from workshop.cli.bench.common import Ints, bench_app, measure, say, tell


@bench_app.command(name="tui")
def bench_tui(
    *,
    seconds: float = 60.0,
    gateways: int = 100,
    robots: int = 500,
    tasks: int = 1000,
    rate: int = 2000,
    plain: Annotated[bool, Parameter(negative="--no-plain", help="Measure a plain table beside it.")] = True,
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


@bench_app.command
def throughput(
    *,
    parallel: Ints = (1, 4, 8, 16, 32),
    seconds: float = 8.0,
    gateways: int = 4,
    containers: int = 3,
    kills: int = 5,
    ray: Annotated[bool, Parameter(negative="--no-ray")] = True,
    profile: Annotated[bool, Parameter(negative="--no-profile")] = True,
    as_json: Json = False,
) -> int:
    """Trivial subtasks a second through a fleet, where the time goes, and recovery from a killed worker; beside Ray.

    Args:
        parallel: Subtasks wanted at any time: up to 4, or a multiple of 4; one measurement each.
        seconds: For how long each.
        gateways: Gateways, each a process.
        containers: Containers each keeps ready.
        kills: Workers killed, one after the other.
        ray: Measure Ray beside it, if `make ray` has installed it.
        profile: Sample where the gateways' time goes; costs about 1 %.
    """
    from workshop.bench.throughput.run import Options, parallels, run

    options = Options(
        parallel=parallels(parallel), seconds=seconds, gateways=gateways, containers=containers, kills=kills, ray=ray,
        profile=profile,
    )  # fmt: skip
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command(name="tasks")
def bench_tasks(*, tasks: int = 3000, gateways: int = 3, containers: int = 2, as_json: Json = False) -> int:
    """Thousands of tasks of one sender: how fast they are accepted, and what orders and reads find meanwhile.

    Exit code 1 when a target is missed; they hold for two cores with nothing else on them.

    Args:
        tasks: Tasks handed in; 10000 shows the memory they take.
        gateways: Gateways, each a process.
        containers: Containers each keeps ready.
    """
    from workshop.bench.flood import Options, run

    found = measure(run(Options(tasks=tasks, gateways=gateways, containers=containers), progress=say))
    tell(found, as_json=as_json)
    return Exit.DONE if all(each["kept"] for each in found["targets"].values()) else Exit.FAILED


@bench_app.command
def intent(
    *,
    tier: Annotated[
        Literal["auto", "local", "rules", "wrong"],
        Parameter(help="Who plans: the cascade, one tier alone, or an upstream that answers wrongly on purpose."),
    ] = "auto",
    half: Annotated[
        Literal["open", "sealed", "all"],
        Parameter(help="The half that the checks were developed against, the other one, or both."),
    ] = "all",
    cases: Annotated[
        Path | None, Parameter(help="Folder of JSONL files of cases; by default those that come with it.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Decide adversarial and plain instructions as a fleet would: unsafe runs, missed stops, good orders held.

    Exit code 1 when something ran that may not run, or a stop was missed. Needs no fleet.
    """
    from workshop.bench.intent import measure as decide
    from workshop.bench.intent import read_cases
    from workshop.bench.intent.cases import DATA

    found = measure(decide(read_cases(half, cases or DATA), tier=tier, progress=say))
    tell(found, as_json=as_json)
    return Exit.FAILED if found["unsafe"] or found["stops_missed"] else Exit.DONE


@bench_app.command(name="plan")
def bench_plan(
    *,
    cases: Path | None = None,
    limit: int = 0,
    model: str = "",
    rosters: bool = True,
    load: float = 0.0,
    seconds: float = 60.0,
    as_json: Json = False,
) -> int:
    """Plans: how good they are on a set of instructions with gold plans, and what escalating the unsure ones brings.

    The same orders are given to fleets of 2 to 256 robots, too: `rosters` has a row for each size. Without a local
    model the rules are measured, and routed on is their confidence. With --load one gateway is asked so many times a
    second instead.

    Args:
        cases: JSONL file of cases with score.py beside it; by default the development set.
        limit: Use the first so many cases; 0 for all.
        model: Folder of a local model, or embedded.
        rosters: Measure plans, confidence and time by the size of the fleet.
        load: Instructions a second for one gateway, instead of the cases.
        seconds: With --load: for how long.
    """
    if load:
        from workshop.bench.plan.load import run as under_load

        result = measure(under_load(rate=load, seconds=seconds, model=model, progress=console.err.print))
    else:
        from appliance.llm.settings import LlmConfig
        from workshop.bench.plan import run as bench
        from workshop.bench.plan.rosters import SIZES

        config = LlmConfig(tiers=("local",), local_model=model) if model else None
        sizes = SIZES if rosters else ()
        result = measure(bench(cases, config=config, limit=limit, sizes=sizes, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command(name="record")
def bench_record(
    *, messages: int = 50_000, rounds: int = 3, flow: int = 300_000, kills: int = 0, as_json: Json = False
) -> int:
    """Logging: the recorder's writer beside the bare MCAP library, from put to file, and what a kill leaves.

    Ends with 1 when a message is lost without being counted, or a kill took more than the last second.

    Args:
        messages: Messages a round of the writer alone; 0: leave it out.
        rounds: Rounds of each; the median counts.
        flow: Messages of 200 bytes a round from another process's put to the file; 0: leave it out.
        kills: Times that the recorder is killed at a random moment.
        as_json: Print JSON.
    """
    from workshop.bench.recording.run import run as bench

    result = measure(bench(messages=messages, rounds=rounds, flow=flow, kills=kills))
    show(result, as_json=as_json, table=console.bench_table(result))
    lost = result.get("flow", {}).get("unaccounted", 0)
    taken = result.get("kills", {})
    return (
        Exit.FAILED
        if lost or any(taken.get(each) for each in ("beyond_last_second", "damaged", "holes"))
        else Exit.DONE
    )


@bench_app.command(name="table")
def bench_table(file: Path, /) -> int:
    """Render what a benchmark printed with --json as Markdown tables.

    Args:
        file: The JSON.
    """
    import msgspec

    from appliance.errors import NotFoundError, PayloadError

    try:
        found = msgspec.json.decode(file.read_bytes(), type=dict[str, Any])
    except OSError as error:
        raise NotFoundError(f"{file} cannot be read: {error.strerror}", remedy="name a file of `--json`") from error
    except msgspec.DecodeError as error:
        raise PayloadError(
            f"{file} is no result: {error}", remedy="name a file of `swiftbot bench … --json`"
        ) from error
    tell(found, as_json=False)
    return 0
