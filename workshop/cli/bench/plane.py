"""Measurements of the plane: the ring, large fleets, restarts and takeovers, gateways with nothing to do."""

import sys
from typing import Any, Literal

from appliance import console
from appliance.cli.common import Json, show
from appliance.errors import Exit
from workshop.cli.bench.common import GOOD, Image, Ints, Lease, Network, Secured, bench_app, measure, say, tell


def _faults(named: str) -> tuple[str, ...]:
    """Return the faults of the network that are named; with any, this process is run again inside a namespace."""
    from appliance.errors import ConfigError
    from workshop.bench.net.faults import FAULTS
    from workshop.bench.net.space import enter

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
    freezes: float = 0.2,
    orders: int = 1,
    secured: Secured = False,
    network: Network = GOOD,
    as_json: Json = False,
) -> int:
    """Tasks with counted effects on gateways that are killed, stopped and started again: is anything lost or doubled?

    With `--faults partition` the gateways are cut into two halves for 5, 20 and 60 s, and operators on both sides
    approve, cancel and submit tasks meanwhile: afterwards every gateway has to answer the same for every task within
    1 s.

    Ends with 1 when a task that was accepted did not end, an effect is missing or there twice, gateways answer
    differently after a partition, or an order was lost without a notice; then the folder with the MCAP log and the
    ledger is kept and named.

    Args:
        minutes: How long gateways go down; with faults of the network their times count.
        tasks: Tasks handed in over that time.
        gateways: Gateways, each a process.
        every_s: Mean time between outages, seconds, 0 for none; by default 4, and none with faults of the network.
        freezes: Share of outages in which a gateway is only stopped (SIGSTOP) for a while.
        orders: Rounds of orders on both sides of each partition, 11 tasks a round.
    """
    from workshop.bench.chaos.run import Options, run

    named = _faults(network.faults)
    options = Options(
        gateways=gateways, tasks=tasks, seconds=minutes * 60, down_at_once=network.down_at_once, freezes=freezes,
        seed=network.seed, every_s=every_s if every_s is not None else 0.0 if named else 4.0, faults=named,
        fault_s=network.fault_s, rest_s=network.rest_s, keep=network.keep, orders=orders,
        secured=secured,
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    return Exit.DONE if result["held"] else Exit.FAILED


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
def security(*, count: int = 500, starts: int = 100, image: Image = "base", as_json: Json = False) -> int:
    """What keys cost: gets, puts, round trips and warm starts elsewhere with TLS, roles and signatures, and without.

    Args:
        count: Gets, puts and round trips, each with keys and without.
        starts: Warm starts on another gateway, each with keys and without; 0: none (they need Podman).
    """
    from workshop.bench.security import run

    result = measure(run(count, starts, image=image, progress=say))
    tell(result, as_json=as_json)
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
    secured: Secured = False,
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

    options = Options(gateways=gateways, rounds=rounds, records=records, how=how, lease_ms=lease_ms, secured=secured)
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
    secured: Secured = False,
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
        lease_ms=lease_ms, image=image, secured=secured,
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    wrong = [each for how in ("kill", "freeze", "silent") if how in result for each in result[how]["not_exactly_once"]]
    return Exit.FAILED if wrong else Exit.DONE
