"""A fleet of the benchmark's own on this machine, and run orders to it as a coordinator sends them.

Times are the client's: from the order (or from when it was to be sent) to the `started` event that comes
back over Zenoh, so a search for a container, both hops and the way back are in them.
"""

import asyncio
import secrets
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager

from msgspec.structs import replace

from appliance.client import FleetClient
from appliance.config import GatewayConfig
from appliance.connection import FleetState
from appliance.errors import SwiftbotError
from appliance.llm.settings import LlmConfig
from appliance.model import RunEvent, RunEventKind, RunRequest, keyspace
from appliance.model.roles import Role
from appliance.pool.settings import PoolConfig
from workshop import keyring, local_fleet
from workshop.bench.load import Arrival, Outcome
from workshop.bench.pooled import SKILL, fleet_name, need_of, workspace, write_skill
from workshop.local_fleet import Order

Progress = Callable[[str], None]


@asynccontextmanager
async def running(
    pools: dict[str, PoolConfig], *, image: str, progress: Progress, secured: bool = False
) -> AsyncGenerator[tuple[FleetState, "Orders"]]:
    """A fleet with these pools (gateways `gw-1`, `gw-2`, ... in order) and a way to order; all gone afterwards.

    `secured`: with keys; orders are given with a gateway's, since others may not give them.
    """
    with workspace() as folder:
        skills = write_skill(folder, image)
        order = Order(
            fleet=fleet_name(),
            directory=folder / "fleet",
            gateways=len(pools),
            mavlink=0,
            zenoh=0,
            base=GatewayConfig(id="gw-1", llm=LlmConfig(tiers=("rules",)), skills=(str(skills),)),
            pools=pools,
            secured=secured,
        )
        state = await local_fleet.up(order, progress=progress)
        try:
            endpoint = state.endpoint
            if secured:
                keys = keyring.file_of(local_fleet.keys_folder(order.directory), Role.GATEWAY, "gw-1")
                endpoint = replace(endpoint, keys=str(keys))
            async with FleetClient(endpoint) as client:
                yield state, Orders(client, image)
        finally:
            await local_fleet.down(order.directory, progress=progress, volumes=True)


class Orders:
    """Sends run orders to gateways and hears what becomes of them."""

    def __init__(self, client: FleetClient, image: str) -> None:
        self.client = client
        self._need = need_of(image)
        self._task = f"bench-{secrets.token_hex(4)}"
        self._number = 0
        self._open: dict[str, tuple[float, Outcome, asyncio.Event]] = {}
        client.plane.session.subscribe_typed(keyspace.RUN_EVENT, self._take, self._task)

    def _take(self, key: str, event: RunEvent | None) -> None:
        del key
        if event is None or event.subtask not in self._open:
            return
        intended, outcome, ended = self._open[event.subtask]
        at_ms = (time.monotonic() - intended) * 1e3
        match event.kind:
            case RunEventKind.STARTED:
                outcome.started_ms = at_ms
                outcome.within_ms = event.startup_ms if event.startup_ms is not None else outcome.within_ms
                outcome.gateway = event.gateway
                outcome.phase = event.phase.value if event.phase else ""
            case RunEventKind.SUCCEEDED:
                outcome.ended_ms = at_ms
                ended.set()
            case RunEventKind.FAILED:
                outcome.problem = event.failure.code if event.failure else "failed"
                ended.set()
            case _:
                pass

    async def run(
        self, gateway: str, *, service_ms: float = 0.0, intended: float | None = None, patience_s: float = 30.0
    ) -> Outcome:
        """Order one run at a gateway and hear it to its end.

        Args:
            gateway: whom to ask; where it runs is that gateway's decision.
            service_ms: how long the handler works (sleeps).
            intended: time.monotonic() at which it was to be sent; by default now.
            patience_s: when to give it up for lost.
        """
        self._number += 1
        name = f"n{self._number}"
        now = time.monotonic()
        intended = now if intended is None else intended
        outcome, ended = Outcome(sent_ms=(now - intended) * 1e3, asked=gateway), asyncio.Event()
        self._open[name] = (intended, outcome, ended)
        request = RunRequest(
            task=self._task, subtask=name, attempt=1, skill=SKILL, need=self._need,
            params={"service_ms": service_ms}, deadline_s=10.0 + service_ms / 1e3,
        )  # fmt: skip
        try:
            async with asyncio.timeout(patience_s):
                await self.client.plane.rpc.call(gateway, keyspace.RUN, request, timeout_s=patience_s)
                await ended.wait()
        except TimeoutError:
            outcome.problem = "lost"
        except SwiftbotError as error:
            outcome.problem = error.code
        finally:
            del self._open[name]
        if outcome.problem:
            outcome.started_ms = outcome.ended_ms = float("inf")
        return outcome

    async def offer(
        self,
        wanted: Sequence[Arrival],
        *,
        service_ms: float,
        patience_s: float,
        sent: Callable[[], None] = lambda: None,
    ) -> list[Outcome]:
        """Send orders when they are wanted, however those before them fare; returns when all have ended.

        `sent` is called when the last one has gone: from then on the fleet only works off what is left.
        """
        runs: list[asyncio.Task[Outcome]] = []
        start = time.monotonic()
        try:
            for each in wanted:
                wait_s = start + each.at_s - time.monotonic()
                if wait_s > 0:
                    await asyncio.sleep(wait_s)
                work = self.run(each.gateway, service_ms=service_ms, intended=start + each.at_s, patience_s=patience_s)
                runs.append(asyncio.create_task(work, name="bench order"))
            sent()
            return list(await asyncio.gather(*runs))
        except BaseException:
            for run in runs:
                run.cancel()
            await asyncio.gather(*runs, return_exceptions=True)
            raise
