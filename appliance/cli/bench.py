"""Measurements: `swiftbot bench …`."""

import asyncio
from pathlib import Path

from cyclopts import App

from appliance import console
from appliance.cli.common import TOOLS, Json, show

bench_app = App(name="bench", help="Measure a promise beside its alternative, in one run.", group=TOOLS)


def add_to(app: App) -> None:
    """Add these commands."""
    app.command(bench_app)


@bench_app.command
def startup(*, count: int = 100, cold: int = 5, image: str = "base", as_json: Json = False) -> int:
    """Subtask startup: cold containers, warm local ones, warm ones found on another gateway, in one run.

    Args:
        count: Warm runs of each kind.
        cold: Cold runs.
        image: Image of the containers.
    """
    from appliance.bench.federated import run_all

    result = asyncio.run(run_all(count, cold, image=image, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0


@bench_app.command(name="record")
def bench_record(*, messages: int = 50_000, rounds: int = 3, as_json: Json = False) -> int:
    """Logging: messages/s of the recorder's writer beside the bare MCAP library.

    Args:
        messages: Messages a round.
        rounds: Rounds of each; the median counts.
    """
    from appliance.bench.record import run as bench

    result = asyncio.run(bench(messages=messages, rounds=rounds))
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

    result = asyncio.run(bench(cases, limit=limit, progress=console.err.print))
    show(result, as_json=as_json, table=console.bench_table(result))
    return 0
