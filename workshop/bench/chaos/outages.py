"""Gateways that go down and come back as planned, and faults of the network: what chaos and histories share."""

import asyncio
import signal
import time
from collections.abc import Callable, Sequence

from msgspec import Struct

from workshop.bench.chaos import plan
from workshop.bench.chaos.arena import Arena, Progress
from workshop.bench.net.faults import REST_S, Phase, phases


class Conditions(Struct, frozen=True, kw_only=True):
    """Under what a fleet is tried."""

    gateways: int
    seconds: float
    """How long gateways go down; with faults of the network their times count."""
    every_s: float
    """Mean time between outages; 0: there are none."""
    freezes: float
    """Share of outages in which the gateway is only stopped and goes on later."""
    down_at_once: int = 2
    """r - 1: more than that is not what replication promises to survive without waiting."""
    seed: int = 1
    faults: tuple[str, ...] = ()
    """Faults of the network that it goes through, one after the other (`net.faults`); each gateway has a network
    namespace of its own then, and the process must be inside one (`net.space.enter`)."""
    fault_s: float = 0.0
    """How long each lasts; 0: as a full run has it."""
    rest_s: float = REST_S
    keep: str = ""
    """Folder for data and logs of the run; empty: a temporary one."""

    def names(self) -> tuple[str, ...]:
        """Names of the gateways."""
        return tuple(f"gw-{number + 1}" for number in range(self.gateways))

    def phases(self) -> tuple[Phase, ...]:
        """The faults of the network with their times."""
        return tuple(phases(self.faults, self.names(), fault_s=self.fault_s, rest_s=self.rest_s, seed=self.seed))

    def outages(self, seconds: float) -> tuple[plan.Outage, ...]:
        """The outages of so many seconds."""
        if self.every_s <= 0:
            return ()
        return plan.outages(
            self.names(), seconds=seconds, most=self.down_at_once, every_s=self.every_s, freezes=self.freezes,
            seed=self.seed,
        )  # fmt: skip


async def carry_out(
    arena: Arena,
    planned: Sequence[plan.Outage],
    began: float,
    *,
    progress: Progress,
    noted: Callable[[plan.Outage], Callable[[], None]] = lambda _: lambda: None,
) -> None:
    """Have gateways go down and come back as planned, from `began` (monotonic) on.

    `noted` is called as one goes down; what it returns, when it is back.
    """

    async def outage(each: plan.Outage) -> None:
        if each.gateway not in arena.up():
            progress(f"{each.gateway} is not up when it should go down: see its log")
            return
        back = noted(each)
        if each.kind == "freeze":
            arena.signal(each.gateway, signal.SIGSTOP)
        else:
            await arena.kill(each.gateway)
        try:
            await asyncio.sleep(max(0.0, began + each.until_s - time.monotonic()))
        finally:
            if each.kind == "freeze":
                arena.signal(each.gateway, signal.SIGCONT)
            else:
                arena.start(each.gateway)
            back()

    async with asyncio.TaskGroup() as group:
        for each in planned:
            await asyncio.sleep(max(0.0, began + each.at_s - time.monotonic()))
            group.create_task(outage(each))
