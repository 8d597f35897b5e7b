"""Measurements: `swiftbot bench …`."""

import asyncio
import signal
import sys
from collections.abc import Coroutine
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import uvloop
from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import TOOLS, Json, show

T = TypeVar("T")
bench_app = App(name="bench", help="Measure a promise beside its alternative, in one run.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(bench_app)


def measure(work: Coroutine[Any, Any, T]) -> T:
    """Run a measurement on the event loop that the daemons use.

    SIGTERM ends it as Ctrl-C does, so that fleets, containers and folders go with it.
    """

    async def ended_by_signal() -> T:
        task = asyncio.current_task()
        if task is not None:
            asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
        return await work

    try:
        return uvloop.run(ended_by_signal())
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None


def say(text: str) -> None:
    """Show how far a measurement is; as plain text, whatever is in it."""
    console.err.print(text, markup=False, highlight=False, soft_wrap=True)


def tell(result: dict[str, Any], *, as_json: bool) -> None:
    """Print a result as JSON, or as Markdown tables."""
    from appliance.bench.tables import markdown

    if as_json:
        show(result, as_json=True)
    else:
        console.out.print(markdown(result), markup=False, highlight=False, soft_wrap=True, end="")


@bench_app.command
def startup(*, count: int = 100, cold: int = 5, image: str = "base", ray: bool = True, as_json: Json = False) -> int:
    """Subtask startup: cold containers, warm local ones, warm ones of other gateways, Ray's actors, in one run.

    Args:
        count: Warm runs of each kind.
        cold: Cold runs.
        image: Image of the containers.
        ray: Measure Ray's actors beside them, if `make ray` has installed it.
    """
    from appliance.bench.federated import run_all

    tell(measure(run_all(count, cold, image=image, ray=ray, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def rate(
    *,
    mode: tuple[Literal["cold", "local", "federated"], ...] = ("cold", "local", "federated"),
    spread: tuple[Literal["even", "uneven"], ...] = ("even", "uneven"),
    rates: Annotated[tuple[float, ...], Parameter(consume_multiple=True)] = (1, 2, 5, 10, 20, 40, 80, 160, 320),
    service_ms: Annotated[tuple[float, ...], Parameter(consume_multiple=True)] = (0.0, 150.0),
    seconds: float = 6.0,
    limit_ms: float = 1000.0,
    seed: int = 1,
    image: str = "base",
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
        image: Image of the containers.
    """
    from appliance.bench.rate import Options, run

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
    at_once: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (1, 2, 4),
    image: str = "base",
    as_json: Json = False,
) -> int:
    """How fast an empty pool fills with ready containers.

    Args:
        containers: How many.
        at_once: Starts at the same time; one measurement each.
        image: Image of the containers.
    """
    from appliance.bench.refill import run

    tell(measure(run(containers, at_once, image=image, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def zygote(
    *,
    count: int = 200,
    sizes_mb: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (0, 50, 200),
    image: str = "base",
    as_json: Json = False,
) -> int:
    """What a large preloaded heap costs at a start: forks of a zygote that holds it, beside a plain process.

    Args:
        count: Runs of each kind of start and heap.
        sizes_mb: Sizes of the heap.
        image: Image of the containers.
    """
    from appliance.bench.zygote import run

    tell(measure(run(count, sizes_mb, image=image, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def transfer(*, megabytes: int = 64, rounds: int = 3, as_json: Json = False) -> int:
    """How long a state volume takes from gateway to gateway, beside Podman's own export and import.

    Args:
        megabytes: Size of the volume.
        rounds: Rounds of each way; the median counts.
    """
    from appliance.bench.transfer import run

    tell(measure(run(megabytes, rounds, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def migrate(
    *,
    moves: int = 30,
    volume_moves: int = 6,
    megabytes: int = 64,
    cold: int = 5,
    runs: int = 16,
    work_s: float = 3.0,
    overload: Annotated[bool, Parameter(negative="--no-overload")] = True,
    as_json: Json = False,
) -> int:
    """How long moving a run to another gateway takes, beside starting it anew cold; and overload with and without.

    Args:
        moves: Moves with a checkpoint of 1 kB, and of 256 kB.
        volume_moves: Moves with a state volume.
        megabytes: Size of that volume.
        cold: Runs that are ended and started anew.
        runs: Runs that come to one gateway of four.
        work_s: What each of them works, seconds.
        overload: Measure the overload too.
    """
    from appliance.bench.migrate import run

    work = run(moves, volume_moves, megabytes, cold, runs, work_s, overload=overload, progress=say)
    tell(measure(work), as_json=as_json)
    return 0


@bench_app.command
def soak(*, count: int = 10_000, at_once: int = 3, image: str = "base", seed: int = 1, as_json: Json = False) -> int:
    """Thousands of subtasks through one gateway, some of which misbehave: counts before and after, leaks, memory.

    Ends with 1 when something leaked, a run was lost, or memory was not flat.

    Args:
        count: Subtasks.
        at_once: How many at the same time.
        image: Image of the containers.
        seed: Which subtasks misbehave.
    """
    from appliance.bench.soak import run

    result = measure(run(count, at_once=at_once, image=image, seed=seed, progress=say))
    tell(result, as_json=as_json)
    return 0 if not result["census"]["leaks"] and not result["lost"] and result["census"]["flat"] else 1


def _faults(named: str) -> tuple[str, ...]:
    """Return the faults of the network that are named; with any, this process is run again inside a namespace."""
    from appliance.bench.net.faults import FAULTS
    from appliance.bench.net.space import enter
    from appliance.errors import ConfigError

    if not named:
        return ()
    faults = FAULTS if named == "all" else tuple(each.strip() for each in named.split(","))
    if unknown := [each for each in faults if each not in FAULTS]:
        raise ConfigError(f"there is no fault {unknown[0][:40]!r}", remedy=f"there are: {', '.join(FAULTS)}")
    enter(sys.argv[1:])
    return faults


@bench_app.command
def chaos(
    *,
    minutes: float = 5.0,
    tasks: int = 200,
    gateways: int = 8,
    every_s: float | None = None,
    down_at_once: int = 2,
    freezes: float = 0.2,
    faults: str = "",
    fault_s: float = 0.0,
    rest_s: float = 15.0,
    seed: int = 1,
    keep: str = "",
    as_json: Json = False,
) -> int:
    """Tasks with counted effects on gateways that are killed, stopped and started again: is anything lost or doubled?

    Ends with 1 when a task that was accepted did not end, or an effect is missing or there twice; then the folder
    with the MCAP log and the ledger is kept and named.

    Args:
        minutes: How long gateways go down; with faults of the network their times count.
        tasks: Tasks handed in over that time.
        gateways: Gateways, each a process.
        every_s: Mean time between outages, seconds, 0 for none; by default 4, and none with faults of the network.
        down_at_once: Most that are down at the same time; up to 2, of 3 replicas one is always there.
        freezes: Share of outages in which a gateway is only stopped (SIGSTOP) for a while.
        faults: Faults of the network, one after the other: some of loss,delay,reorder,oneway,partition, or all.
        fault_s: How long each lasts; 0: 30 to 60 s.
        rest_s: How long the network is good before each.
        seed: Of tasks, outages and faults.
        keep: Folder to keep logs and ledger in.
    """
    from appliance.bench.chaos.run import Options, run

    named = _faults(faults)
    options = Options(
        gateways=gateways, tasks=tasks, seconds=minutes * 60, down_at_once=down_at_once, freezes=freezes, seed=seed,
        every_s=every_s if every_s is not None else 0.0 if named else 4.0, faults=named, fault_s=fault_s,
        rest_s=rest_s, keep=keep,
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    return 0 if result["held"] else 1


@bench_app.command
def history(
    *,
    seconds: float = 60.0,
    gateways: int = 5,
    clients: int = 8,
    keys: int = 6,
    quorum: bool = True,
    every_s: float = 3.0,
    freezes: float = 0.4,
    down_at_once: int = 2,
    faults: str = "",
    fault_s: float = 0.0,
    rest_s: float = 15.0,
    seed: int = 1,
    keep: str = "",
    as_json: Json = False,
) -> int:
    """Concurrent compare-and-sets on records while gateways are killed and stopped: was every answer right?

    With a quorum the history of each key is checked for linearizability; without one, that replicas agree in the end
    and that no acknowledged write is forgotten. Ends with 1 when it is not so; the recorded history is kept and named.

    Args:
        seconds: How long; with faults of the network their times count.
        gateways: Gateways, each a process with nothing but its plane.
        clients: Clients, each linked to one gateway.
        keys: Keys they share.
        quorum: Ask for a quorum.
        every_s: Mean time between outages, seconds; 0 for none.
        freezes: Share of outages in which a gateway is only stopped (SIGSTOP) for a while.
        down_at_once: Most that are down at the same time.
        faults: Faults of the network, one after the other: some of loss,delay,reorder,oneway,partition, or all.
        fault_s: How long each lasts; 0: 30 to 60 s.
        rest_s: How long the network is good before each.
        seed: Of clients, outages and faults.
        keep: Folder to keep the gateways' data and logs in.
    """
    from appliance.bench.history.run import Options, run

    options = Options(
        seconds=seconds, gateways=gateways, clients=clients, keys=keys, quorum=quorum, every_s=every_s,
        freezes=freezes, down_at_once=down_at_once, faults=_faults(faults), fault_s=fault_s, rest_s=rest_s, seed=seed,
        keep=keep,
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    return 0 if result["held"] else 1


@bench_app.command
def throughput(
    *,
    parallel: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (1, 4, 8, 16, 32),
    seconds: float = 8.0,
    gateways: int = 4,
    containers: int = 3,
    kills: int = 5,
    ray: bool = True,
    profile: bool = True,
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
    from appliance.bench.throughput.run import Options, parallels, run

    options = Options(
        parallel=parallels(parallel), seconds=seconds, gateways=gateways, containers=containers, kills=kills, ray=ray,
        profile=profile,
    )  # fmt: skip
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


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


@bench_app.command(name="record")
def bench_record(*, messages: int = 50_000, rounds: int = 3, as_json: Json = False) -> int:
    """Logging: messages/s of the recorder's writer beside the bare MCAP library.

    Args:
        messages: Messages a round.
        rounds: Rounds of each; the median counts.
    """
    from appliance.bench.record import run as bench

    result = measure(bench(messages=messages, rounds=rounds))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command(name="plan")
def bench_plan(*, cases: Path | None = None, limit: int = 0, as_json: Json = False) -> int:
    """Plans: how good the rules' plans are on a set of instructions with gold plans.

    Args:
        cases: JSONL file of cases with score.py beside it; by default the development set.
        limit: Use the first so many cases; 0 for all.
    """
    from appliance.bench.plan import run as bench

    result = measure(bench(cases, limit=limit, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command
def dht(
    *,
    sizes: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (16, 64, 256, 1000, 4096, 10_000),
    lookups: int = 2000,
    seconds: float = 20.0,
    seed: int = 1,
    part: Literal["all", "simulation", "live"] = "all",
    nodes: int = 16,
    count: int = 500,
    as_json: Json = False,
) -> int:
    """The ring simulated with the plane's own code, beside Chord; put and get live, beside the kademlia package.

    Args:
        sizes: Gateways of the simulated rings; 10,000 take some minutes.
        lookups: Simulated lookups behind each figure.
        seconds: Simulated time of each figure of traffic.
        seed: Of the simulation.
        part: Only the simulation, or only what is live.
        nodes: Gateways, and nodes of kademlia, that run live on loopback.
        count: Live puts and gets.
    """
    from appliance.bench.dht import live, simulation

    result: dict[str, Any] = {}
    if part != "live":
        tell = console.err.print
        result = simulation.run(sizes, lookups=lookups, seconds=seconds, seed=seed, progress=tell)
    if part != "simulation":
        result["live"] = measure(live.run(nodes=nodes, count=count, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command
def members(
    *,
    members: int = 300,
    per_process: int = 50,
    view: tuple[Literal["full", "bounded"], ...] = ("full", "bounded"),
    rounds: int = 5,
    count: int = 500,
    idle_s: float = 10.0,
    lease_ms: int = 10_000,
    as_json: Json = False,
) -> int:
    """A large fleet on this machine: members (ring, registry, records; no pool) behind one router, and their costs.

    Memory and idle CPU of a member and of the router, the time until a new member is known and a killed one forgotten
    everywhere, and the times of record reads and writes.

    Args:
        members: How many.
        per_process: Members that share a process.
        view: Full: each knows all; bounded: 4·log2 of their number (`plane.view`). Several one after the other.
        rounds: New members, each killed again.
        count: Records written and read.
        idle_s: How long idle CPU is taken over.
        lease_ms: `plane.lease_ms` of all.
    """
    from appliance.bench.members.run import Options, run

    options = Options(
        members=members, per_process=per_process, views=view, rounds=rounds, count=count, idle_s=idle_s,
        lease_ms=lease_ms,
    )  # fmt: skip
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def idle(
    *,
    gateways: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (1, 3),
    seconds: float = 20.0,
    as_json: Json = False,
) -> int:
    """Memory and CPU of gateways that have nothing to do, without a language model.

    Args:
        gateways: Sizes of fleets, one measured after the other.
        seconds: Over which CPU is taken.
    """
    from appliance.bench.idle import Options, run

    tell(measure(run(Options(gateways=gateways, seconds=seconds), progress=say)), as_json=as_json)
    return 0


@bench_app.command
def restart(
    *,
    gateways: int = 8,
    rounds: int = 20,
    records: int = 200,
    how: Literal["stop", "kill"] = "stop",
    lease_ms: int = 1000,
    as_json: Json = False,
) -> int:
    """A gateway is restarted again and again: how soon after its session is open it is back in the ring.

    Args:
        gateways: Processes on this machine.
        rounds: Restarts of one of them.
        records: In the ring meanwhile.
        how: Stopped with SIGTERM, or killed.
        lease_ms: `plane.lease_ms` of all.
    """
    from appliance.bench.failover.restart import Options, run

    options = Options(gateways=gateways, rounds=rounds, records=records, how=how, lease_ms=lease_ms)
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def takeover(
    *,
    gateways: int = 8,
    kills: int = 10,
    freezes: int = 5,
    tasks: int = 8,
    sleep_ms: float = 3000.0,
    lease_ms: int = 1000,
    image: str = "base",
    as_json: Json = False,
) -> int:
    """Coordinators of running tasks are killed and frozen: how soon it is noticed, and another goes on.

    Ends with 1 when a task did not succeed, or a subtask ended more than once.

    Args:
        gateways: Processes on this machine.
        kills: Coordinators that get SIGKILL, one after the other.
        freezes: Coordinators that get SIGSTOP, and SIGCONT once they were succeeded.
        tasks: Under way at the same time.
        sleep_ms: What the first of a task's two subtasks works.
        lease_ms: `plane.lease_ms` of all: after so long silence a gateway counts as gone.
        image: Image of the containers.
    """
    from appliance.bench.failover.takeover import Options, run

    options = Options(
        gateways=gateways, kills=kills, freezes=freezes, tasks=tasks, sleep_ms=sleep_ms, lease_ms=lease_ms,
        image=image,
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    wrong = [each for how in ("kill", "freeze") if how in result for each in result[how]["not_exactly_once"]]
    return 1 if wrong else 0


@bench_app.command
def policy(
    *,
    traces: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    trace: Path | None = None,
    budgets: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (1024, 2048, 4096, 8192),
    gateways: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (1, 10, 100),
    seed: int = 1,
    as_json: Json = False,
) -> int:
    """Pool policies on arrival traces, simulated: cold starts against memory held idle, and federated against local.

    Args:
        traces: azure, poisson, bursts, diurnal, timer; all of them when none is named and no file is given.
        trace: A recorded trace: a fleet's MCAP log, or a JSONL file with an arrival a line.
        budgets: Memory of a gateway's containers, MB.
        gateways: Numbers of gateways for federated against local; 0 leaves that out.
        seed: Of the generated traces.
    """
    from appliance.bench.policy import run as bench

    result = bench(
        traces=traces,
        recorded=trace,
        budgets_mb=budgets,
        gateways=tuple(each for each in gateways if each > 0),
        seed=seed,
        progress=console.err.print,
    )
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0
