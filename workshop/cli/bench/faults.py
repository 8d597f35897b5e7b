"""Measurements under outages and faults of the network: tasks with counted effects."""

import sys

from appliance.cli.common import Json
from appliance.errors import Exit
from workshop.cli.bench.common import GOOD, Network, bench_app, measure, say, tell


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
    )  # fmt: skip
    result = measure(run(options, progress=say))
    tell(result, as_json=as_json)
    return Exit.DONE if result["held"] else Exit.FAILED
