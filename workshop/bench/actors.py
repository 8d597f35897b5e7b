"""The same trivial work in a pool of Ray actors: what a user would pick instead, without isolation between runs.

Ray is large and no part of the product: it lives in an environment of its own (`make ray`), and its side of the
measurement (`ray_side.py`) runs there as a process that talks JSON lines. Where it is not installed, the result says
so.
"""

import asyncio
import contextlib
import importlib.util
import json
import os
import signal
import sys
import tempfile
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from appliance.errors import PoolError
from workshop.bench.figures import cdf, ratio, summary
from workshop.bench.pooled import PAUSE_S

REMEDY = "make ray, or SWIFTBOT_RAY_PYTHON=a Python that has ray"
ACTORS = 2
"""As many as the pool beside it keeps warm."""
WAIT_S = 120.0
"""For one line, beside the pauses: Ray starts in 3 to 20 s; its cold actors take about a second each."""
GRACE_S = 15.0
PROMISED_RATIO = 3.0
_SIDE = Path(__file__).with_name("ray_side.py")


def find_python() -> Path | None:
    """Return a Python that has Ray: as told by SWIFTBOT_RAY_PYTHON, this one, or that of `make ray`."""
    told = os.environ.get("SWIFTBOT_RAY_PYTHON", "")
    if told:
        return Path(told)
    if importlib.util.find_spec("ray") is not None:
        return Path(sys.executable)
    prefix = Path(sys.prefix)
    for folder in (prefix.parent / "ray", prefix / ".ray"):
        if (folder / "bin" / "ray").exists() and (folder / "bin" / "python").exists():
            return folder / "bin" / "python"
    return None


async def run(count: int, cold: int, *, progress: Callable[[str], None]) -> dict[str, Any]:
    """Measure warm calls of actors and the making of new ones.

    Returns:
        `start` and `round_trip` of warm calls and `cold` (create to first line), each count, p50, p90, p99, max in
        ms; `cdf`; `version`. Or `missing` with how to install it.

    Raises:
        PoolError: Ray is there and did not work.
    """
    python = find_python()
    if python is None:
        progress(f"Ray is not installed: {REMEDY}")
        return {"missing": "Ray is not installed", "remedy": REMEDY}
    progress(f"Ray: {count} warm calls, {cold} new actors")
    with tempfile.TemporaryDirectory(prefix="swiftbot-ray-") as folder:
        arguments = ("startup", str(count), str(cold), str(ACTORS), str(PAUSE_S), folder)
        async with side(python, arguments, folder) as process:
            wait_s = WAIT_S + 2 * PAUSE_S * count + 5 * cold
            found = {event: await line(process, event, wait_s) for event in ("ready", "warm", "cold")}
    times = {
        "start": found["warm"]["start_ms"],
        "round_trip": found["warm"]["round_trip_ms"],
        "cold": found["cold"]["start_ms"],
    }
    result: dict[str, Any] = {"version": found["ready"]["version"], "ready_ms": round(found["ready"]["took_ms"])}
    return (
        result
        | {name: summary(each) for name, each in times.items()}
        | {"cdf": {name: cdf(each) for name, each in times.items()}}
    )


@asynccontextmanager
async def side(python: Path, arguments: Sequence[str], folder: str) -> AsyncGenerator[asyncio.subprocess.Process]:
    """Ray's side as a process group of its own, ended with all it started whatever happens here."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    environment |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_DEDUP_LOGS": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
    # -P: this folder is no place to import from.
    process = await asyncio.create_subprocess_exec(
        str(python), "-P", str(_SIDE), *arguments,
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
        limit=2**24, env=environment, cwd=folder, start_new_session=True,
    )  # fmt: skip
    try:
        yield process
        async with asyncio.timeout(GRACE_S):
            await process.wait()
    finally:
        # Ray's own processes end with the one that started them.
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, number)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(GRACE_S if number is signal.SIGTERM else 2.0):
                    await process.wait()
                    break


async def line(process: asyncio.subprocess.Process, event: str, wait_s: float) -> dict[str, Any]:
    """Return the next line, which must be of that event."""
    if process.stdout is None or process.stderr is None:
        raise PoolError("Ray's side has no pipes")
    try:
        async with asyncio.timeout(wait_s):
            while True:
                found = await process.stdout.readline()
                if not found:
                    problem = (await process.stderr.read(2**16)).decode(errors="replace").strip()
                    raise PoolError(f"Ray's side ended: {problem[-400:] or 'without a word'}", remedy=REMEDY)
                if found.startswith(b"{"):  # Ray itself prints as well
                    break
    except TimeoutError:
        raise PoolError(f"Ray's side told no {event} within {wait_s:g} s") from None
    told = json.loads(found)
    if told.get("event") != event:
        raise PoolError(f"Ray's side told {str(told)[:80]}, not {event}")
    return told


def compare(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return our medians beside Ray's: start and round trip of a warm call, and a cold start by a warm one of ours."""
    ray: Mapping[str, Any] = result.get("ray", {})
    if "start" not in ray:
        return {}
    found = {
        "local_over_ray_start": ratio(result["local"].get("p50"), ray["start"].get("p50")),
        "local_over_ray_round_trip": ratio(result["local_round_trip"].get("p50"), ray["round_trip"].get("p50")),
        "ray_cold_over_local": ratio(ray["cold"].get("p50"), result["local"].get("p50")),
        "ray_cold_over_federated": ratio(ray["cold"].get("p50"), result.get("federated", {}).get("p50")),
    }
    return {"against_ray": found}
