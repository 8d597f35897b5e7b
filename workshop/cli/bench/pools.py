"""Measurements of the pool: starts, arrival rates, filling, moving, endurance, policies."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from appliance.cli.common import Json
from appliance.errors import Exit
from workshop.cli.bench.common import Floats, Image, Ints, Words, bench_app, measure, say, tell


@bench_app.command
def startup(
    *,
    count: int = 100,
    cold: int = 5,
    image: Image = "base",
    ray: Annotated[bool, Parameter(negative="--no-ray")] = True,
    as_json: Json = False,
) -> int:
    """Subtask startup: cold containers, warm local ones, warm ones of other gateways, Ray's actors, in one run.

    Args:
        count: Warm runs of each kind.
        cold: Cold runs.
        ray: Measure Ray's actors beside them, if `make ray` has installed it.
    """
    from workshop.bench.federated import run_all

    tell(measure(run_all(count, cold, image=image, ray=ray, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def rate(
    *,
    mode: tuple[Literal["cold", "local", "federated"], ...] = ("cold", "local", "federated"),
    spread: tuple[Literal["even", "uneven"], ...] = ("even", "uneven"),
    rates: Floats = (1, 2, 5, 10, 20, 40, 80, 160, 320),
    service_ms: Floats = (0.0, 150.0),
    seconds: float = 6.0,
    limit_ms: float = 1000.0,
    seed: int = 1,
    image: Image = "base",
    as_json: Json = False,
) -> int:
    """p99 of the start against the arrival rate until it breaks: four gateways, arrivals even and uneven over them.

    Args:
        mode: Pool modes to measure; may be given several times.
        spread: Even or uneven arrivals; may be given several times.
        rates: Runs a second over all gateways, rising until one is too much.
        service_ms: What a run works.
        seconds: For how long each rate is offered.
        limit_ms: p99 beyond which a rate is too much.
        seed: Of the arrivals.
    """
    from workshop.bench.rate import Options, run

    options = Options(
        modes=mode, spreads=spread, rates=rates, services_ms=service_ms, seconds=seconds, limit_ms=limit_ms,
        seed=seed, image=image,
    )  # fmt: skip
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def refill(
    *,
    containers: int = 8,
    at_once: Ints = (1, 2, 4),
    image: Image = "base",
    as_json: Json = False,
) -> int:
    """How fast an empty pool fills with ready containers.

    Args:
        containers: How many.
        at_once: Starts at the same time; one measurement each.
    """
    from workshop.bench.refill import run

    tell(measure(run(containers, at_once, image=image, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def zygote(
    *,
    count: int = 200,
    sizes_mb: Ints = (0, 50, 200),
    image: Image = "base",
    as_json: Json = False,
) -> int:
    """What a large preloaded heap costs at a start: forks of a zygote that holds it, beside a plain process.

    Args:
        count: Runs of each kind of start and heap.
        sizes_mb: Sizes of the heap.
    """
    from workshop.bench.zygote import run

    tell(measure(run(count, sizes_mb, image=image, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def training(
    *,
    clients: int = 16,
    rounds: int = 40,
    by: str = "dirichlet:0.5",
    every: int = 10,
    seed: int = 1,
    as_json: Json = False,
) -> int:
    """What training in a warm container costs, and what rounds of it come to: clips, in virtual time.

    Args:
        clients: How many train in each round.
        rounds: How many rounds.
        by: How data are shared out: dirichlet:A, site, even.
        every: Judge the model after so many rounds.
        seed: Of the run and its data.
    """
    from workshop.bench.training import run

    tell(measure(run("clips", clients, rounds, by=by, every=every, seed=seed, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def transfer(*, megabytes: int = 64, rounds: int = 3, as_json: Json = False) -> int:
    """How long a state volume takes from gateway to gateway, beside Podman's own export and import.

    Args:
        megabytes: Size of the volume.
        rounds: Rounds of each way; the median counts.
    """
    from workshop.bench.transfer import run

    tell(measure(run(megabytes, rounds, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def migrate(
    *,
    moves: int = 20,
    volume_moves: int = 6,
    megabytes: int = 64,
    cold: int = 5,
    runs: int = 12,
    work_s: float = 2.0,
    long_s: float = 12.0,
    short: int = 9,
    part: Literal["all", "moves", "overload"] = "all",
    as_json: Json = False,
) -> int:
    """How long moving a run to another gateway takes, beside starting it again cold; and overload with and without.

    Args:
        moves: Moves with a checkpoint of 1 kB, and of 256 kB.
        volume_moves: Moves with a state volume.
        megabytes: Size of that volume.
        cold: Runs that are ended and started again.
        runs: Runs that come to one gateway of four.
        work_s: What each of them works, seconds.
        long_s: What runs work that hold all containers of one gateway, seconds.
        short: Runs of a second that may run only there, and wait for those.
        part: Only the moves, or only the overload.
    """
    from workshop.bench.migrate import Overload, run

    load = Overload(runs=runs, work_s=work_s, long_s=long_s, short=short)
    tell(measure(run(moves, volume_moves, megabytes, cold, load=load, part=part, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def soak(*, count: int = 10_000, at_once: int = 3, image: Image = "base", seed: int = 1, as_json: Json = False) -> int:
    """Thousands of subtasks through one gateway, some of which misbehave: counts before and after, leaks, memory.

    Ends with 1 when something leaked, a run was lost, or memory was not flat.

    Args:
        count: Subtasks.
        at_once: How many at the same time.
        seed: Which subtasks misbehave.
    """
    from workshop.bench.soak import run

    result = measure(run(count, at_once=at_once, image=image, seed=seed, progress=say))
    tell(result, as_json=as_json)
    return (
        Exit.DONE if not result["census"]["leaks"] and not result["lost"] and result["census"]["flat"] else Exit.FAILED
    )


@bench_app.command
def policy(
    *,
    traces: Words = (),
    trace: Path | None = None,
    budgets: Ints = (1024, 2048, 4096, 8192),
    gateways: Ints = (1, 10, 100),
    seed: int = 1,
    draws: int = 1,
    as_json: Json = False,
) -> int:
    """Pool policies on arrival traces, simulated: cold starts against memory held idle, and federated against local.

    Args:
        traces: azure, poisson, bursts, diurnal, timer; all of them when none is named and no file is given.
        trace: A recorded trace: a fleet's MCAP log, or a JSONL file with an arrival a line.
        budgets: Memory of a gateway's containers, MB.
        gateways: Numbers of gateways for federated against local; 0 leaves that out.
        seed: Of the generated traces.
        draws: How often each trace of one gateway is drawn, with this seed and those after it; figures are means.
    """
    from workshop.bench.policy import run as bench

    result = bench(
        traces=traces,
        recorded=trace,
        budgets_mb=budgets,
        gateways=tuple(each for each in gateways if each > 0),
        seed=seed,
        draws=draws,
        progress=say,
    )
    tell(result, as_json=as_json)
    return 0
