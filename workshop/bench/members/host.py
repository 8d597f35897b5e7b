"""A process with many members in it, told over its standard input what to do (`run`).

Each member is a `Plane` as a gateway has it: a session of its own, ring, registry, and records in a store of its own;
it tells a status and two containers, as a gateway that idles does. There is no pool and no language model. Lines are
JSON; times are those of the machine's monotonic clock, so that processes' times can be compared.
"""

import asyncio
import gc
import json
import os
import random
import resource
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import uvloop
from msgspec import Struct

from appliance import logs
from appliance.errors import SwiftbotError, UnreachableError
from appliance.model import ContainerInfo, ContainerState, GatewayStatus
from appliance.plane.events import FactsChanged, FleetEvent, Joined, Lost, Stage
from appliance.plane.node import Plane
from appliance.plane.settings import PlaneConfig

STATUS_S = 2.0
"""How often a gateway gives an account of itself when nothing changes; the registry decides what is published of it."""
_LOOK_S = 0.02
_TRIES = 5
_IMAGES = ("base", "vision")


class HostOptions(Struct, frozen=True, kw_only=True):
    """What is the same for all members of a host."""

    fleet: str
    folder: str
    connect: tuple[str, ...]
    lease_ms: int


class Host:
    """Some members in this process."""

    def __init__(self, options: HostOptions) -> None:
        self._options = options
        self._planes: dict[str, Plane] = {}
        self._came: dict[str, dict[str, float]] = {}
        """Member that came -> member that saw it -> when."""
        self._told: dict[str, dict[str, float]] = {}
        """The same of its status."""
        self._awaited: set[str] = set()
        self._went: dict[str, dict[str, float]] = {}
        self._publishing: list[asyncio.Task[None]] = []
        self.verbs: dict[str, Callable[[dict[str, Any]], Awaitable[Any]]] = {
            "open": self._open,
            "settled": self._settled,
            "came": self._until_came,
            "went": self._until_went,
            "write": self._write,
            "read": self._read,
            "usage": self._usage,
        }

    async def _open(self, ask: dict[str, Any]) -> dict[str, dict[str, float]]:
        """Open these members one after the other; answers with their milestones."""
        options, opened = self._options, dict[str, dict[str, float]]()
        for name in ask["names"]:
            config = PlaneConfig(
                mode="client", connect=options.connect, lease_ms=options.lease_ms,
                connect_timeout_s=20.0,
            )  # fmt: skip
            began = time.monotonic()
            plane = await self._open_one(config, name)
            self._planes[name] = plane
            opened[name] = {"began": began, **plane.milestones}
            self._watch(name, plane)
            self._publishing.append(asyncio.create_task(self._keep_publishing(name, plane)))
        return opened

    async def _open_one(self, config: PlaneConfig, name: str) -> Plane:
        """Open a member; a router that is busy with hundreds of others may take more than one try to answer."""
        for attempt in range(_TRIES):
            try:
                return await Plane.open(
                    config, fleet=self._options.fleet, gateway=name, data_dir=Path(self._options.folder) / name
                )
            except UnreachableError:
                if attempt == _TRIES - 1:
                    raise
        raise AssertionError

    def _watch(self, name: str, plane: Plane) -> None:
        def on_event(event: FleetEvent) -> None:
            match event:
                case Joined(other):
                    self._came.setdefault(other, {})[name] = time.monotonic()
                case Lost(other):
                    self._went.setdefault(other, {})[name] = time.monotonic()
                case FactsChanged("gateway"):
                    for other in self._awaited:
                        if other in plane.registry.gateways:
                            self._told.setdefault(other, {}).setdefault(name, time.monotonic())
                case _:
                    pass

        plane.events.subscribe(Stage.WATCHERS, on_event)

    async def _keep_publishing(self, name: str, plane: Plane) -> None:
        """What an idle gateway tells of itself."""
        containers = tuple(
            ContainerInfo(id=f"{name}-{image}", gateway=name, image=image, state=ContainerState.READY)
            for image in _IMAGES
        )
        plane.registry.publish_containers(containers)
        while True:
            cpu = random.uniform(1, 4)  # noqa: S311 - as an idle machine's
            status = GatewayStatus(
                id=name, fleet=self._options.fleet, load=cpu / 100, cpu_percent=cpu, memory_mb=100.0, capacity=8,
                containers=len(containers), ready=len(containers), pid=os.getpid(),
            )  # fmt: skip
            plane.registry.publish_status(status)
            await asyncio.sleep(STATUS_S)

    async def _settled(self, ask: dict[str, Any]) -> dict[str, float]:
        """Wait until every member here knows all the others, and has reconciled; answers since when."""
        wanted, until = frozenset(ask["names"]), time.monotonic() + float(ask["within_s"])
        since: dict[str, float] = {}
        while True:
            now = time.monotonic()
            for name, plane in self._planes.items():
                members = plane.members()
                known = wanted <= members <= plane.registry.gateways.keys()
                if known and plane.dht.settling.reconciled():
                    since.setdefault(name, now)
                else:
                    since.pop(name, None)
            if len(since) == len(self._planes):
                return since
            if now > until:
                behind = [_lacking(plane, wanted) for name, plane in self._planes.items() if name not in since]
                raise SwiftbotError(f"{len(behind)} of {len(self._planes)} are not settled: {'; '.join(behind[:5])}")
            await asyncio.sleep(_LOOK_S)

    async def _until_came(self, ask: dict[str, Any]) -> dict[str, Any]:
        """Wait until every member here knows another and its status."""
        member = ask["member"]
        self._awaited, wanted = {member}, len(self._planes)
        while min(len(self._came.get(member, ())), len(self._told.get(member, ()))) < wanted:  # noqa: ASYNC110 - of many
            await asyncio.sleep(_LOOK_S)
        return {"seen": list(self._came[member].values()), "told": list(self._told[member].values())}

    async def _until_went(self, ask: dict[str, Any]) -> dict[str, Any]:
        """Wait until no member here knows another."""
        member = ask["member"]
        while any(member in plane.members() for plane in self._planes.values()):  # noqa: ASYNC110 - of many
            await asyncio.sleep(_LOOK_S)
        for listed in (self._came, self._told):
            listed.pop(member, None)
        return {"seen": list(self._went.pop(member, {}).values())}

    async def _write(self, ask: dict[str, Any]) -> list[float]:
        """Write these keys through members at random, one after the other; ms each."""
        took: list[float] = []
        for key in ask["keys"]:
            dht = random.choice(list(self._planes.values())).dht  # noqa: S311 - spreads load
            began = time.perf_counter()
            await dht.write(key, b"x" * 400, expected=None)
            took.append((time.perf_counter() - began) * 1e3)
        return took

    async def _read(self, ask: dict[str, Any]) -> list[float]:
        """Read these keys likewise; they must be there."""
        took: list[float] = []
        for key in ask["keys"]:
            dht = random.choice(list(self._planes.values())).dht  # noqa: S311 - spreads load
            began = time.perf_counter()
            if await dht.read(key) is None:
                raise SwiftbotError(f"{key} was written and is not there")
            took.append((time.perf_counter() - began) * 1e3)
        return took

    async def _usage(self, _: dict[str, Any]) -> dict[str, Any]:
        """What this process has used so far: CPU seconds; and bad input and lost messages, which must be none."""
        gc.collect()
        used = resource.getrusage(resource.RUSAGE_SELF)
        refused: dict[str, int] = {}
        for plane in self._planes.values():
            for what, count in plane.session.refused.items():
                refused[what] = refused.get(what, 0) + count
        known = [len(plane.members()) for plane in self._planes.values()]
        return {"cpu_s": used.ru_utime + used.ru_stime, "refused": refused, "known": sum(known) / max(1, len(known))}

    async def close(self) -> None:
        """Leave with all members."""
        for task in self._publishing:
            task.cancel()
        await asyncio.gather(*self._publishing, return_exceptions=True)
        await asyncio.gather(*(plane.close() for plane in self._planes.values()))


def _lacking(plane: Plane, wanted: frozenset[str]) -> str:
    """What a member that is not settled has not got yet."""
    members = plane.members()
    unknown, untold = sorted(wanted - members), sorted(members - plane.registry.gateways.keys())
    compared = "its shard is compared" if plane.dht.settling.reconciled() else "its shard is not compared"
    return (
        f"{plane.gateway} does not see {len(unknown)} ({', '.join(unknown[:5])}), has no facts of {len(untold)} "
        f"({', '.join(untold[:5])}), {compared}"
    )


async def _serve(options: HostOptions) -> None:
    host = Host(options)
    reader = asyncio.StreamReader(limit=2**24)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)

    def tell(what: object) -> None:
        sys.stdout.write(json.dumps(what) + "\n")
        sys.stdout.flush()

    tell({"event": "ready"})
    try:
        while line := await reader.readline():
            ask = json.loads(line)
            if ask["do"] == "close":
                break
            try:
                tell({"event": ask["do"], "answer": await host.verbs[ask["do"]](ask)})
            except SwiftbotError as error:
                tell({"event": "problem", "answer": str(error)})
    finally:
        await host.close()


def main() -> None:
    """Serve until standard input ends."""
    logs.configure(level="error", style="text")
    uvloop.run(_serve(msgspec.json.decode(sys.argv[1], type=HostOptions)))


if __name__ == "__main__":
    main()
