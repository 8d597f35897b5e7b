"""Measurements of robots: MAVLink through the gateway."""

from typing import Annotated

from cyclopts import Parameter

from appliance.cli.common import Json
from appliance.errors import Exit
from workshop.cli.bench.common import Ints, bench_app, measure, say, tell


@bench_app.command
def mavlink(
    *,
    log: str = "",
    frames: int = 30_000,
    rounds: int = 3,
    real_s: float = 20.0,
    record: Annotated[bool, Parameter(negative="--no-record", help="Measure with a recorder too.")] = True,
    profile: Annotated[bool, Parameter(negative="--no-profile", help="Show where the router's time goes.")] = True,
    beside: str = "auto",
    delivery: Annotated[bool, Parameter(help="Deliver tasks over a bad link instead.")] = False,
    tasks: int = 1000,
    loss: float = 0.2,
    as_json: Json = False,
) -> int:
    """A vehicle's log through the router at real time and full speed, beside others: what arrives, what is recorded.

    With --delivery: tasks asked for over a link that loses, doubles and reorders frames each way, on a real fleet.

    Args:
        log: A telemetry log (.tlog); generated frames when not given.
        frames: How many are generated.
        rounds: How often the log is played at full speed.
        real_s: Seconds of the log that are played at real time; 0 for all of it.
        beside: Routers measured too, of mavp2p, mavrouter and mavproxy; `auto` is all that are installed, or `none`.
        tasks: Of --delivery: how many are asked for.
        loss: Of --delivery: share of datagrams lost, each way.
    """
    if delivery:
        from workshop.bench.mavlink import delivery as deliveries
        from workshop.bench.mavlink.relay import Badness

        wanted = deliveries.Options(tasks=tasks, badness=Badness(loss=loss))
        tell(measure(deliveries.run(wanted, progress=say)), as_json=as_json)
        return 0
    from workshop.bench.mavlink.run import Options, run

    options = Options(
        log=log, frames=frames, rounds=rounds, real_s=real_s, record=record, profile=profile, beside=beside
    )
    tell(measure(run(options, progress=say)), as_json=as_json)
    return 0


@bench_app.command(name="fleet")
def bench_fleet(
    *,
    vehicles: int = 64,
    behind: int = 8,
    stations: int = 3,
    seconds: float = 15.0,
    storm: int = 20_000,
    as_json: Json = False,
) -> int:
    """Many MAVLink vehicles at one gateway: its processor, the log, losses, commands and a stop; beside a storm too.

    Exit code 1 when a target is missed; they are for 64 vehicles on two cores with nothing else on them.

    Args:
        vehicles: Simulated vehicles of 50 frames a second each, in one process.
        behind: Of these, behind one link; the others have a link each.
        stations: Ground stations that hear all.
        seconds: For how long, without and with the storm.
        storm: Frames a second of one more vehicle, in the second half.
    """
    from workshop.bench.vehicles import Options, run

    options = Options(vehicles=vehicles, behind=behind, stations=stations, seconds=seconds, storm=storm)
    found = measure(run(options, progress=say))
    tell(found, as_json=as_json)
    return Exit.DONE if all(each["kept"] for each in found["targets"].values()) else Exit.FAILED


@bench_app.command
def floor(
    *,
    robots: Ints = (4, 8, 16, 32),
    seconds: float = 600.0,
    site: str = "warehouse",
    seed: int = 1,
    down_s: float = 10.0,
    as_json: Json = False,
) -> int:
    """Simulate robots that share a floor: collisions, deadlocks, throughput; also one at a time and uncoordinated.

    Args:
        robots: How many, one simulation each.
        seconds: Simulated time of each.
        site: Built-in site or site file.
        seed: Of the places that robots go to.
        down_s: Seconds of each minute that one of the three grantors is down, in turn.
    """
    from workshop.bench import floor as floors

    options = floors.Options(robots=robots, seconds=seconds, site=site, seed=seed, down_s=down_s)
    found = floors.measure(options, progress=say)
    tell(found, as_json=as_json)
    return Exit.DONE if found["kept"] else Exit.FAILED
