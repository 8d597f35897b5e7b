"""What all measurements share: the group of commands, options that several have, how they run and print."""

import asyncio
import signal
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import uvloop
from cyclopts import App, Parameter

from appliance import console
from appliance.cli.common import TOOLS, show

T = TypeVar("T")

Ints = Annotated[tuple[int, ...], Parameter(consume_multiple=True)]
Floats = Annotated[tuple[float, ...], Parameter(consume_multiple=True)]
Words = Annotated[tuple[str, ...], Parameter(consume_multiple=True)]
Image = Annotated[str, Parameter(help="Image of the containers.")]
Lease = Annotated[
    int, Parameter(help="`plane.lease_ms` of all: after so long silence a gateway counts as gone, milliseconds.")
]
Secured = Annotated[bool, Parameter(help="With keys: TLS, roles and signatures on every link.")]

bench_app = App(name="bench", help="Measure a promise beside its alternative, in one run.", group=TOOLS)


@Parameter(name="*")
@dataclass(frozen=True)
class Network:
    """Faults of the network that a measurement goes through, and what it keeps."""

    faults: Annotated[
        str,
        Parameter(
            help="Faults of the network, one after the other: some of loss,delay,reorder,oneway,partition, or all."
        ),
    ] = ""
    fault_s: Annotated[float, Parameter(help="How long each lasts; 0: 30 to 60 s.")] = 0.0
    rest_s: Annotated[float, Parameter(help="How long the network is good before each.")] = 15.0
    down_at_once: Annotated[
        int, Parameter(help="Most gateways down at the same time; up to 2, of 3 replicas one is always there.")
    ] = 2
    seed: Annotated[int, Parameter(help="Of the work, outages and faults.")] = 1
    keep: Annotated[str, Parameter(help="Folder to keep data, logs and ledgers in.")] = ""


GOOD = Network()


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
    from workshop.bench.tables import markdown

    if as_json:
        show(result, as_json=True)
    else:
        console.out.print(markdown(result), markup=False, highlight=False, soft_wrap=True, end="")
