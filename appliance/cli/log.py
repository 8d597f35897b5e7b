"""Logs: `swiftbot log …`."""

import os
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import HERE, TOOLS, Json, Where, show
from appliance.errors import ConfigError, DeadlineError, Exit

log_app = App(name="log", help="Inspect, recover, edit, replay and check MCAP logs.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(log_app)


@log_app.command(name="info")
def log_info(path: Path, /, *, verify: bool = False, as_json: Json = False) -> int:
    """Show what an MCAP log holds, also a truncated one.

    Args:
        path: The log.
        verify: Read every message, also of a finished file, so that damage in its middle is found.
    """
    from appliance.record.reader import info

    found = info(path, verify=verify)
    show(found, as_json=as_json, table=console.log_summary(found))
    return 0


Keys = Annotated[tuple[str, ...], Parameter(name="--key", help="Only keys that match, such as **/task/*.")]
Without = Annotated[tuple[str, ...], Parameter(help="Not keys that match.")]
Since = Annotated[str, Parameter(name="--from", help="Seconds from the start, before the end (-3), or ISO 8601 time.")]
Until = Annotated[str, Parameter(help="The same; not included.")]
Out = Annotated[Path, Parameter(name=("--out", "-o"), help="File to write; must not exist.")]


def _named(paths: tuple[Path, ...]) -> None:
    if not paths:
        raise ConfigError("no log file is named", remedy="name one or more MCAP files")


def _select(paths: tuple[Path, ...], keys: tuple[str, ...], without: tuple[str, ...], since: str, until: str) -> Any:
    from appliance.record.edit import Select, instant, span
    from appliance.record.models import check_expression

    _named(paths)
    for each in (*keys, *without):
        check_expression(each)
    if not since and not until:
        return Select(keys=keys, without=without)
    start_ns, end_ns = span(paths)
    moments = [instant(each, start_ns=start_ns, end_ns=end_ns) if each else None for each in (since, until)]
    return Select(keys=keys, without=without, since_ns=moments[0], until_ns=moments[1])


def _copied(paths: tuple[Path, ...], out: Path, select: Any, *, as_json: bool) -> int:
    from appliance.record.edit import copy

    with console.err.status("reading") as status:
        made = copy(paths, out, select, progress=lambda count: status.update(f"{count:,} messages"))
    show(made, as_json=as_json, table=console.log_summary(made))
    return 0


@log_app.command(name="recover")
def log_recover(path: Path, out: Path | None = None, /, *, as_json: Json = False) -> int:
    """Recover an unfinished or damaged log into a new file; the original is not changed.

    Args:
        path: The log of a recorder that was killed, or of a disk that was full or is dying.
        out: File to write; NAME.recovered.mcap beside it by default.
    """
    if not path.name:
        raise ConfigError(f"{str(path)!r} is no file", remedy="name the log")
    return _copied((path,), out or path.with_name(f"{path.stem}.recovered.mcap"), None, as_json=as_json)


@log_app.command(name="merge")
def log_merge(paths: tuple[Path, ...], /, *, out: Out, as_json: Json = False) -> int:
    """Merge logs by time: rotated files of one recorder, or of several recorders.

    Args:
        paths: The logs.
    """
    return _copied(paths, out, _select(paths, (), (), "", ""), as_json=as_json)


@log_app.command(name="trim")
def log_trim(
    path: Path,
    /,
    *,
    out: Out,
    since: Since = "",
    until: Until = "",
    keys: Keys = (),
    without: Without = (),
    as_json: Json = False,
) -> int:
    """Copy a part of a log, by time and key, into a new file.

    Args:
        path: The log.
    """
    return _copied((path,), out, _select((path,), keys, without, since, until), as_json=as_json)


@log_app.command(name="cat")
def log_cat(
    paths: tuple[Path, ...],
    /,
    *,
    since: Since = "",
    until: Until = "",
    keys: Keys = (),
    without: Without = (),
    grep: Annotated[str, Parameter(help="Only messages whose text matches this regular expression.")] = "",
    limit: Annotated[int, Parameter(help="How many at most; 0: all.")] = 0,
    task: Annotated[str, Parameter(help="Only what is about this task: its record, transitions and runs.")] = "",
    as_json: Json = False,
) -> int:
    """Print a log's messages, a line each: time, key, payload; --json prints JSON lines.

    Args:
        paths: The logs, one after the other.
    """
    from appliance.record.edit import cat

    if task:
        keys = (*keys, f"swiftbot/*/task/{task}/**")
    select = _select(paths, keys, without, since, until)
    try:
        damaged = cat(paths, select, grep=grep, limit=limit, as_json=as_json, write=sys.stdout.write)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader has enough (`| head`); nothing more may be written, not even when Python ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    for problem in damaged:
        console.err.print(f"! {problem}", markup=False)
    return Exit.FAILED if damaged else Exit.DONE


@log_app.command(name="layout")
def log_layout(
    *,
    recorder: Annotated[
        str, Parameter(help="Recorder that writes the log; `live` for `swiftbot foxglove`.")
    ] = "recorder",
    as_json: Json = True,
    where: Where = HERE,
) -> int:
    """Print a layout for Foxglove as JSON: robots in 3D and on the map, log, the task and robot of its variables.

    Write it to a file and choose "Import from file" among Foxglove's layouts.
    """
    from appliance.model.keys import check_name
    from appliance.record.layout import layout

    del as_json  # a layout is JSON in any case
    show(layout(where.fleet, check_name(recorder, "recorder")), as_json=True)
    return Exit.DONE


@log_app.command(name="pin")
def log_pin(paths: tuple[Path, ...], /, *, remove: bool = False, as_json: Json = False) -> int:
    """Pin logs: the recorder's disk budget does not delete them; --remove unpins.

    Args:
        paths: The logs.
        remove: Unpin them.
    """
    from appliance.record.retention import pin

    for path in paths:
        pin(path, pinned=not remove)
        if not as_json:
            console.out.print(f"{path} is {'no longer pinned' if remove else 'pinned'}", markup=False)
    if as_json:
        show([{"path": str(path), "pinned": not remove} for path in paths], as_json=True)
    return 0


@log_app.command(name="check")
def log_check(paths: tuple[Path, ...], /, *, as_json: Json = False) -> int:
    """Recompute the decisions of logs with this version and compare; exit code 1 when one differs.

    The task state machine, the retry policy, the choice of gateways and containers, evictions, rounds of federated
    learning: as far as what they rested on is in the log. Files of one recorder are given in their order.

    Args:
        paths: The logs.
    """
    from appliance.learn.decisions import all_traced
    from appliance.tasks.replay import check

    _named(paths)
    with console.err.status("reading") as status:
        report = check(paths, traced=all_traced(), progress=lambda count: status.update(f"{count:,} messages"))
    show(report, as_json=as_json, table=console.check_summary(report))
    return Exit.DONE if report.same else Exit.FAILED


@log_app.command(name="trigger")
async def log_trigger(
    reason: str, /, *, by: str = "", wait: float = 5.0, as_json: Json = False, where: Where = HERE
) -> int:
    """Mark an incident: recorders note it, and those set to `incidents` write it.

    Args:
        reason: What happened.
        by: Operator.
        wait: Seconds to wait for a recorder to confirm it; 0: do not wait.
    """
    from appliance.record.remote_control import trigger

    endpoint = where.endpoint()
    by = by or os.environ.get("USER", "")
    confirmed = await trigger(endpoint.fleet, endpoint.connect, reason, by=by, wait_s=wait, keys=endpoint.keys)
    if wait and not confirmed:
        raise DeadlineError(
            f"no recorder of {endpoint.fleet} has confirmed it within {wait:g} s",
            remedy="is one running? `swiftbot record`, or the unit swiftbot-recorder",
        )
    lines = [f"{each.id}: {each.state}, incident {each.incidents}, file {each.file or 'none'}" for each in confirmed]
    show(confirmed, as_json=as_json, table="\n".join(lines))
    return 0


@log_app.command(name="replay")
async def log_replay(
    paths: tuple[Path, ...],
    /,
    *,
    onto: Annotated[str, Parameter(name="--as", help="Fleet to play onto; not one at work.")] = "replay",
    rate: Annotated[float, Parameter(help="Seconds of the log a second; 0: as fast as listeners take it.")] = 1.0,
    since: Since = "",
    until: Until = "",
    keys: Keys = (),
    without: Without = (),
    remap: Annotated[tuple[str, ...], Parameter(help="FROM=TO: keys that begin so are played on others.")] = (),
    loop: Annotated[bool, Parameter(help="Repeat from the start at the end.")] = False,
    paused: Annotated[bool, Parameter(help="Start paused; needs a terminal.")] = False,
    orders: Annotated[bool, Parameter(help="Also play task requests; listeners act on them.")] = False,
    clock: Annotated[
        bool, Parameter(negative="--no-clock", help="Put the log's time on recorder/replay/clock.")
    ] = True,
    listen: Annotated[tuple[str, ...], Parameter(help="Endpoint for listeners, where no fleet is to be joined.")] = (),
    connect: Annotated[tuple[str, ...], Parameter(help="Endpoint of a gateway or router to join.")] = (),
    as_json: Json = False,
) -> int:
    """Play logs onto the plane, as the fleet `replay`, so that the terminal UI, Foxglove or a program sees them again.

    In a terminal: space stops and goes on, `.` plays one message, left and right go 5 seconds, + and - change the rate,
    q ends. Ctrl-C ends it too.

    Args:
        paths: The logs; several are played together, by time.
        as_json: Print what came of it as JSON.
    """
    from appliance.record.player import PlayOptions, check_rate, parse_remap
    from appliance.record.remote_control import replay

    select = _select(paths, keys, without, since, until)
    options = PlayOptions(
        select=select,
        rate=check_rate(rate),
        loop=loop,
        paused=paused,
        remap=parse_remap(remap),
        orders=orders,
        clock=clock,
    )
    if paused and not sys.stdin.isatty():
        raise ConfigError("--paused needs a terminal to go on from", remedy="leave it out")
    endpoints = listen or (() if connect else ("tcp/127.0.0.1:7460",))
    if endpoints:
        places = " ".join(f"--connect {each}" for each in endpoints)
        console.err.print(f"to watch: swiftbot tui --fleet {onto} {places}", markup=False)
    with console.err.status("reading") as status:
        played = await replay(paths, options, fleet=onto, listen=endpoints, connect=connect, tell=status.update)
    show(played, as_json=as_json, table=console.played_text(played))
    return Exit.DONE if played.ended else Exit.INTERRUPTED
