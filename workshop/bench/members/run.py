"""Some hundred members behind one router on this machine: what they cost, and how fast the fleet hears of one.

Processes: the router, hosts with some dozens of members each, and for each newcomer a process of its own, which is
killed with SIGKILL. Times are taken by the members themselves, on the machine's monotonic clock.
"""

import asyncio
import contextlib
import json
import secrets
import signal
import sys
import tempfile
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import msgspec
import psutil
from msgspec import Struct

from appliance.errors import DeadlineError, SwiftbotError
from appliance.ports import free_port
from workshop.bench.figures import summary
from workshop.bench.members.host import HostOptions

Progress = Callable[[str], None]
PATIENCE_S = 300.0
"""For one step of all members: opening them takes longest."""
SETTLE_S = 240.0
"""For all to know each other: less, so that a late member can say what it lacks."""
END_S = 10.0


class Options(Struct, frozen=True, kw_only=True):
    """What to measure."""

    members: int = 300
    per_process: int = 50
    rounds: int = 5
    """Newcomers, each killed again."""
    count: int = 500
    """Records written and read."""
    idle_s: float = 10.0
    lease_ms: int = 10_000
    """Longer than a gateway's own: hundreds of members on a few cores are late as they would not be alone."""


class Side:
    """A process that takes commands, a line each way."""

    def __init__(self, process: asyncio.subprocess.Process, name: str) -> None:
        self.process = process
        self.name = name

    async def ask(self, do: str, **fields: Any) -> Any:
        """Have it do something; SwiftbotError with its words when it cannot or ends."""
        if self.process.stdin is None:
            raise SwiftbotError(f"{self.name} has no pipes")
        self.process.stdin.write(json.dumps({"do": do, **fields}).encode() + b"\n")
        return await self.hear(do)

    async def hear(self, event: str) -> Any:
        """Its next answer."""
        if self.process.stdout is None:
            raise SwiftbotError(f"{self.name} has no pipes")
        try:
            async with asyncio.timeout(PATIENCE_S):
                line = await self.process.stdout.readline()
        except TimeoutError:
            raise DeadlineError(f"{self.name} did not finish {event} within {PATIENCE_S:g} s") from None
        if not line:
            raise SwiftbotError(f"{self.name} ended while it did {event}")
        told = json.loads(line)
        if told["event"] != event:
            raise SwiftbotError(f"{self.name}: {told.get('answer', told)}")
        return told.get("answer")

    def rss_mb(self) -> float:
        """Its resident memory."""
        return psutil.Process(self.process.pid).memory_info().rss / 2**20

    def cpu_s(self) -> float:
        """CPU time it has used."""
        used = psutil.Process(self.process.pid).cpu_times()
        return used.user + used.system

    async def kill(self) -> float:
        """SIGKILL; returns when."""
        at = time.monotonic()
        self.process.kill()
        await self.process.wait()
        return at


@asynccontextmanager
async def side(name: str, *command: str, ready: bool = True) -> AsyncGenerator[Side]:
    """Run a process; it has ended afterwards, by itself or killed. `ready`: wait until it says so."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", *command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE if ready else asyncio.subprocess.DEVNULL,
        stderr=None if ready else asyncio.subprocess.DEVNULL,
        limit=2**24,
    )  # fmt: skip
    it = Side(process, name)
    try:
        if ready:
            await it.hear("ready")
        yield it
    except BaseException:
        # Cancelled or failed: it has nothing to finish, and one after the other would take a minute.
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        raise
    finally:
        if process.returncode is None:
            if process.stdin is not None:
                process.stdin.close()
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM if not ready else signal.SIGCONT)
            try:
                async with asyncio.timeout(END_S):
                    await process.wait()
            except (TimeoutError, asyncio.CancelledError):
                process.kill()
                await process.wait()


async def run(options: Options, *, progress: Progress) -> dict[str, Any]:
    """Measure a fleet of members, with a router and hosts of its own.

    Returns:
        Memory and idle CPU of a member and of the router, and the times of joining, of forgetting, of reads and of
        writes.
    """
    names = [f"m{number:04d}" for number in range(options.members)]
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="swiftbot-bench-"))
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        lease = str(options.lease_ms)
        router = await stack.enter_async_context(
            side("the router", "appliance.cli", "router", "--listen", endpoint, "--lease-ms", lease, ready=False)
        )
        host_options = HostOptions(
            fleet=f"bench-{secrets.token_hex(4)}", folder=folder, connect=(endpoint,), lease_ms=options.lease_ms,
        )  # fmt: skip

        def host(name: str) -> contextlib.AbstractAsyncContextManager[Side]:
            return side(name, "workshop.bench.members.host", msgspec.json.encode(host_options).decode())

        shares = [names[at : at + options.per_process] for at in range(0, len(names), options.per_process)]
        hosts: list[Side] = []
        progress(f"{options.members} members in {len(shares)} processes")
        for number, share in enumerate(shares):
            hosts.append(await stack.enter_async_context(host(f"host {number + 1} with {share[0]} to {share[-1]}")))
        fleet = Fleet(options, hosts, router, host, names, progress)
        of = {"members": options.members, "members_per_process": options.per_process, "lease_ms": options.lease_ms}
        return of | await fleet.measure()


class Fleet:
    """The running processes, and what is measured on them."""

    def __init__(
        self,
        options: Options,
        hosts: list[Side],
        router: Side,
        host: Callable[[str], contextlib.AbstractAsyncContextManager[Side]],
        names: list[str],
        progress: Progress,
    ) -> None:
        self._options = options
        self._hosts = hosts
        self._router = router
        self._host = host
        self._names = names
        self._progress = progress

    async def measure(self) -> dict[str, Any]:
        """All figures of this fleet."""
        options, result = self._options, dict[str, Any]()
        empty_mb = sum(each.rss_mb() for each in self._hosts)
        result["router_alone_mb"] = round(self._router.rss_mb(), 1)
        began = time.monotonic()
        await self._open()
        opened = time.monotonic()
        self._progress(f"all are open after {opened - began:.1f} s, now they get to know each other")
        await self._all("settled", names=self._names, within_s=SETTLE_S)
        result["open_s"], result["all_know_all_s"] = round(opened - began, 2), round(time.monotonic() - began, 2)
        self._progress(f"all know all after {result['all_know_all_s']} s; idle for {options.idle_s:g} s")
        result |= await self._idle(empty_mb)
        self._progress(f"{options.count} records")
        result |= await self._records()
        result |= await self._newcomers()
        refused = [(await each.ask("usage"))["refused"] for each in self._hosts]
        result["refused"] = {what: count for each in refused for what, count in each.items()}
        return result

    async def _open(self) -> None:
        """The first member alone, then all hosts at the same time, each one member after the other."""
        size, shares = self._options.per_process, list[list[str]]()
        for at in range(0, len(self._names), size):
            shares.append(self._names[at : at + size])
        await self._hosts[0].ask("open", names=shares[0][:1])
        shares[0] = shares[0][1:]
        for at in range(0, size, 10):
            await asyncio.gather(
                *(each.ask("open", names=share[at : at + 10]) for each, share in zip(self._hosts, shares, strict=True))
            )
            self._progress(f"{min(len(self._names), (at + 10) * len(self._hosts))} of {len(self._names)} are open")

    async def _all(self, do: str, **fields: Any) -> list[Any]:
        return list(await asyncio.gather(*(each.ask(do, **fields) for each in self._hosts)))

    async def _idle(self, empty_mb: float) -> dict[str, Any]:
        options = self._options
        usages = await self._all("usage")
        before = [each.cpu_s() for each in (self._router, *self._hosts)]
        await asyncio.sleep(options.idle_s)
        after = [each.cpu_s() for each in (self._router, *self._hosts)]
        router_s, hosts_s = after[0] - before[0], sum(after[1:]) - sum(before[1:])
        held_mb = sum(each.rss_mb() for each in self._hosts)
        return {
            "known_by_each": round(sum(each["known"] for each in usages) / len(usages), 1),
            "member_mb": round((held_mb - empty_mb) / options.members, 2),
            "empty_process_mb": round(empty_mb / len(self._hosts), 1),
            "router_mb": round(self._router.rss_mb(), 1),
            "member_idle_cpu_percent": round(hosts_s / options.idle_s / options.members * 100, 3),
            "router_idle_cpu_percent": round(router_s / options.idle_s * 100, 1),
        }

    async def _records(self) -> dict[str, Any]:
        """Records written and read through members at random, one at a time in the whole fleet."""
        keys = [f"bench/{number}" for number in range(self._options.count)]
        took: dict[str, list[float]] = {"write": [], "read": []}
        for do in took:
            for at in range(0, len(keys), 20):
                # Another host's members read than have written.
                turn = at // 20 + (do == "read")
                took[do] += await self._hosts[turn % len(self._hosts)].ask(do, keys=keys[at : at + 20])
        return {do: summary(times) for do, times in took.items()}

    async def _newcomers(self) -> dict[str, Any]:
        """Members that come, each in a process of its own, and are killed."""
        opening: list[float] = []
        joining: list[float] = []
        known: list[float] = []
        told: list[float] = []
        forgotten: list[float] = []
        alone_mb = 0.0
        for number in range(self._options.rounds):
            name = f"new{number}"
            async with self._host(name) as newcomer:
                waiting = asyncio.gather(*(each.ask("came", member=name) for each in self._hosts))
                try:
                    reached = (await newcomer.ask("open", names=[name]))[name]
                    found = await waiting
                finally:
                    waiting.cancel()
                alone_mb = newcomer.rss_mb()
                opening.append((reached["session"] - reached["began"]) * 1e3)
                joining.append((reached["joined"] - reached["session"]) * 1e3)
                known.append((max(at for each in found for at in each["seen"]) - reached["session"]) * 1e3)
                told.append((max(at for each in found for at in each["told"]) - reached["session"]) * 1e3)
                waiting = asyncio.gather(*(each.ask("went", member=name) for each in self._hosts))
                try:
                    killed = await newcomer.kill()
                    gone = await waiting
                finally:
                    waiting.cancel()
                forgotten.append((max(at for each in gone for at in each["seen"]) - killed) * 1e3)
            self._progress(f"{name}: known everywhere after {known[-1]:.0f} ms, forgotten after {forgotten[-1]:.0f} ms")
        return {
            "one_member_process_mb": round(alone_mb, 1),
            "newcomer_session": summary(opening),
            "newcomer_joined": summary(joining),
            "newcomer_known_everywhere": summary(known),
            "newcomer_facts_everywhere": summary(told),
            "killed_forgotten_everywhere": summary(forgotten),
        }
