"""Measurements of the plane: the ring, large fleets, restarts and takeovers, gateways with nothing to do."""

from typing import Any, Literal

from appliance import console
from appliance.cli.common import Json, show
from appliance.errors import Exit
from workshop.cli.bench.common import Image, Ints, Lease, bench_app, measure, say, tell


@bench_app.command
def dht(
    *,
    sizes: Ints = (16, 64, 256, 1000, 4096, 10_000),
    lookups: int = 2000,
    seconds: float = 20.0,
    seed: int = 1,
    part: tuple[Literal["all", "simulation", "hops", "join", "failures", "traffic", "live"], ...] = ("all",),
    nodes: int = 16,
    count: int = 500,
    layout: tuple[Literal["one", "each"], ...] = ("one", "each"),
    as_json: Json = False,
) -> int:
    """The ring simulated with the plane's own code, beside Chord; put and get live, beside the kademlia package.

    Args:
        sizes: Gateways of the simulated rings.
        lookups: Simulated lookups behind each figure.
        seconds: Simulated time of each figure of traffic.
        seed: Of the simulation.
        part: Only these: what is live, or (any of) what is simulated.
        nodes: Gateways, and nodes of kademlia, that run live on loopback.
        count: Live puts and gets.
        layout: Live nodes share one process a side, or have one each, as gateways run; both one after the other.
    """
    from workshop.bench.dht import live, simulation

    result: dict[str, Any] = {}
    parts = {each for each in simulation.PARTS if {each, "all", "simulation"}.intersection(part)}
    if parts:
        result = simulation.run(
            sizes, lookups=lookups, seconds=seconds, seed=seed, parts=parts, progress=console.err.print
        )
    if {"all", "live"}.intersection(part):
        kinds: dict[str, tuple[str, live.Layout]] = {
            "one": ("live", "one process"),
            "each": ("live_processes", "a process each"),
        }
        for name, kind in (kinds[each] for each in kinds if each in layout):
            result[name] = measure(live.run(nodes=nodes, count=count, layout=kind, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command
def members(
    *,
    members: int = 300,
    per_process: int = 50,
    rounds: int = 5,
    count: int = 500,
    idle_s: float = 10.0,
    lease_ms: Lease = 10_000,
    as_json: Json = False,
) -> int:
    """A large fleet on this machine: members (ring, registry, records; no pool) behind one router, and their costs.

    Memory and idle CPU of a member and of the router, the time until a new member is known and a killed one forgotten
    everywhere, and the times of record reads and writes.

    Args:
        members: How many.
        per_process: Members that share a process.
        rounds: New members, each killed again.
        count: Records written and read.
        idle_s: How long idle CPU is taken over.
    """
    from workshop.bench.members.run import Options, run

    options = Options(
        members=members, per_process=per_process, rounds=rounds, count=count, idle_s=idle_s,
        lease_ms=lease_ms,
    )  # fmt: skip
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def idle(
    *,
    gateways: Ints = (1, 3),
    seconds: float = 20.0,
    as_json: Json = False,
) -> int:
    """Memory and CPU of gateways that have nothing to do, without a language model.

    Args:
        gateways: Sizes of fleets, one measured after the other.
        seconds: Over which CPU is taken.
    """
    from workshop.bench.idle import Options, run

    tell(measure(run(Options(gateways=gateways, seconds=seconds), progress=say)), as_json=as_json)
    return 0


@bench_app.command
def restart(
    *,
    gateways: int = 8,
    rounds: int = 20,
    records: int = 200,
    how: Literal["stop", "kill"] = "stop",
    lease_ms: Lease = 1000,
    as_json: Json = False,
) -> int:
    """A gateway is restarted again and again: how soon after its session is open it is back in the ring.

    Args:
        gateways: Processes on this machine.
        rounds: Restarts of one of them.
        records: In the ring meanwhile.
        how: Stopped with SIGTERM, or killed.
    """
    from workshop.bench.failover.restart import Options, run

    options = Options(gateways=gateways, rounds=rounds, records=records, how=how, lease_ms=lease_ms)
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command
def takeover(
    *,
    gateways: int = 8,
    kills: int = 10,
    freezes: int = 5,
    silents: int = 3,
    tasks: int = 8,
    sleep_ms: float = 3000.0,
    lease_ms: Lease = 1000,
    image: Image = "base",
    as_json: Json = False,
) -> int:
    """Coordinators of running tasks are killed and frozen: how soon it is noticed, and another goes on.

    Ends with 1 when a task did not succeed, or a subtask ended more than once.

    Args:
        gateways: Processes on this machine.
        kills: Coordinators that get SIGKILL, one after the other.
        freezes: Coordinators that get SIGSTOP, and SIGCONT once they were succeeded.
        silents: Coordinators that are killed while another gateway with copies of their tasks is frozen.
        tasks: Under way at the same time.
        sleep_ms: What the first of a task's two subtasks works.
    """
    from workshop.bench.failover.takeover import Options, run

    options = Options(
        gateways=gateways, kills=kills, freezes=freezes, silents=silents, tasks=tasks, sleep_ms=sleep_ms,
        lease_ms=lease_ms, image=image,
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    wrong = [each for how in ("kill", "freeze", "silent") if how in result for each in result[how]["not_exactly_once"]]
    return Exit.FAILED if wrong else Exit.DONE
