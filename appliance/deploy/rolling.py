"""A whole fleet from one release to another, one gateway after the other: `swiftbot upgrade FILE --fleet NAME`.

    for each gateway:  copy the bundle ─► drain ─► upgrade there (`deploy.upgrade`) ─► wait until it is back

The others go on meanwhile, and work beside the new version. The first failure ends it: what was upgraded stays, the
gateway that failed has gone back by itself, and the others were not touched. `roll` decides; a `Fleet` and a `Remote`
are the seams to gateways and machines.
"""

import asyncio
import contextlib
import shlex
import time
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Protocol

import msgspec
from msgspec import Struct

from appliance.deploy.upgrade import Ended
from appliance.errors import ConfigError, PrerequisiteError, RefusedError, SwiftbotError, UnreachableError
from appliance.model import GatewayStatus

Sleep = Callable[[float], Awaitable[None]]

LOOK_S = 1.0
DRAIN_S = 600.0
"""How long runs may take to be moved away; those that are left are ended by the stop, and repeated elsewhere."""
BACK_S = 300.0
"""How long a gateway may take to be in the fleet again."""
SSH = ("-o", "BatchMode=yes", "-o", "ConnectTimeout=15")
SSH_FAILED = 255
_SHOWN = 300


class Fleet(Protocol):
    """What is asked of the gateways; each raises SwiftbotError where it fails."""

    def gateways(self) -> Mapping[str, GatewayStatus]:
        """Return those that answer, by id."""
        ...

    async def drain(self, gateway: str) -> bool:
        """Have a gateway give its runs away, or go on with that; returns whether none is left."""
        ...

    async def undrain(self, gateway: str) -> None:
        """Have a gateway take runs again."""
        ...


class Remote(Protocol):
    """What is asked of the machines that gateways run on; each raises SwiftbotError where it fails."""

    async def running(self, destination: str) -> str:
        """Return the release that is current on a machine; empty for none."""
        ...

    async def copy(self, destination: str, file: Path) -> str:
        """Copy a bundle to a machine; returns where it is there."""
        ...

    async def upgrade(self, destination: str, path: str, *, older: bool) -> Ended:
        """Install a bundle that was copied, and remove it."""
        ...


class _Listed(Struct, frozen=True):
    """A release of `swiftbot release list --json`; other fields are ignored."""

    id: str
    current: bool


class Rolled(Struct, frozen=True, kw_only=True):
    """What became of one gateway."""

    gateway: str
    state: str
    """`upgraded`, `failed` or `not touched`."""
    release: str = ""
    """That runs there now, where it is known."""
    problem: str = ""


def check(targets: Mapping[str, str], here: Mapping[str, GatewayStatus]) -> None:
    """Check that a fleet can be upgraded as it is (pure).

    Args:
        targets: machine of each gateway.
        here: the gateways that answer.

    Raises:
        ConfigError: a gateway has no machine, or a machine no gateway.
        RefusedError: a gateway drains or cannot take runs: its work could not be moved there.
    """
    if missing := sorted(here.keys() - targets.keys()):
        raise ConfigError(
            f"no machine is named for {', '.join(missing)}", remedy=f"--ssh {missing[0]}=root@HOST for each gateway"
        )
    if absent := sorted(targets.keys() - here.keys()):
        raise RefusedError(
            f"{', '.join(absent)} does not answer", remedy="bring it back first, or leave it out: swiftbot fleet"
        )
    check_calm(here, "")


def check_calm(here: Mapping[str, GatewayStatus], but: str) -> None:
    """Raise RefusedError where a gateway, but the one that is next, could not take over its work."""
    for name, status in sorted(here.items()):
        if name != but and (why := "it drains" if status.draining else status.pool_problem):
            raise RefusedError(f"{name} cannot take runs: {why}", remedy="see `swiftbot fleet`, then try again")


async def roll(
    fleet: Fleet,
    remote: Remote,
    targets: Mapping[str, str],
    file: Path,
    *,
    release: str,
    older: bool = False,
    say: Callable[[str], None],
    sleep: Sleep = asyncio.sleep,
) -> tuple[Rolled, ...]:
    """Upgrade each gateway of a fleet, in the order of their names, until one fails.

    Args:
        fleet: its gateways.
        remote: their machines.
        targets: machine of each gateway.
        file: the bundle.
        release: its name: a gateway that runs it already is left as it is.
        older: whether an older version is wanted.
        say: hears of each step.
        sleep: in place of asyncio's; for tests.

    Raises:
        ConfigError, RefusedError: as `check`; nothing was touched.
    """
    check(targets, fleet.gateways())
    names = sorted(targets)
    done: list[Rolled] = []
    for number, name in enumerate(names):
        say(f"{name} ({number + 1} of {len(names)})")
        drained = False
        try:
            check_calm(fleet.gateways(), name)
            gone = sorted(targets.keys() - fleet.gateways().keys())
            if gone:
                raise RefusedError(f"{', '.join(gone)} is gone from the fleet", remedy="swiftbot fleet")
            before = fleet.gateways()[name]
            if await remote.running(targets[name]) == release:
                say(f"{name}: {release} runs already")
                done.append(Rolled(gateway=name, state="upgraded", release=release))
                continue
            say(f"{name}: copy the bundle to {targets[name]}")
            path = await remote.copy(targets[name], file)
            say(f"{name}: drain")
            drained = True
            await _drained(fleet, name, say, sleep)
            say(f"{name}: upgrade")
            ended = await remote.upgrade(targets[name], path, older=older)
            if ended.problem:
                back = f"; it is back on {ended.release}" if ended.rolled_back else ""
                raise RefusedError(f"not upgraded: {ended.problem}{back}", remedy=f"journalctl there: {targets[name]}")
            await _back(fleet, name, before, sleep)
        except SwiftbotError as error:
            say(f"{name}: failed: {error}")
            if drained and name in fleet.gateways():
                with contextlib.suppress(SwiftbotError):
                    await fleet.undrain(name)
            done.append(Rolled(gateway=name, state="failed", problem=str(error)[:_SHOWN]))
            done += [Rolled(gateway=each, state="not touched") for each in names[number + 1 :]]
            break
        say(f"{name}: {ended.release} runs")
        done.append(Rolled(gateway=name, state="upgraded", release=ended.release))
    return tuple(done)


async def _drained(fleet: Fleet, name: str, say: Callable[[str], None], sleep: Sleep) -> None:
    """Wait until a gateway has no run left, at most `DRAIN_S`: then its stop ends them, and they go on elsewhere."""
    for _ in range(int(DRAIN_S / LOOK_S)):
        if await fleet.drain(name):
            return
        await sleep(LOOK_S)
    say(f"{name}: runs are left after {DRAIN_S:.0f} s; they are repeated elsewhere")


async def _back(fleet: Fleet, name: str, before: GatewayStatus, sleep: Sleep) -> None:
    """Wait until a gateway that was restarted is in the fleet and takes runs; UnreachableError after `BACK_S`."""
    for _ in range(int(BACK_S / LOOK_S)):
        now = fleet.gateways().get(name)
        if now is not None and (now.started_ns, now.pid) != (before.started_ns, before.pid):
            if now.draining:
                await fleet.undrain(name)
            elif not now.pool_problem or before.pool_problem:
                return
        await sleep(LOOK_S)
    raise UnreachableError(
        f"{name} was upgraded and is not back in the fleet, ready for runs, after {BACK_S:.0f} s",
        remedy="swiftbot fleet; journalctl -u swiftbot-gateway there; swiftbot rollback",
    )


class Ssh:
    """Machines that are reached by `ssh` and `scp`, without questions: by keys, as root or with `sudo -n`."""

    async def running(self, destination: str) -> str:
        """Return the release that is current on a machine."""
        text = await self._run(destination, "ssh", *SSH, "--", destination, "swiftbot release list --json")
        try:
            found = msgspec.json.decode(text, type=list[_Listed])
        except msgspec.MsgspecError as error:
            raise UnreachableError(
                f"{destination} does not say which release runs: {error}",
                remedy=f"ssh {destination}",
            ) from error
        return next((each.id for each in found if each.current), "")

    async def copy(self, destination: str, file: Path) -> str:
        """Copy a bundle to a machine."""
        path = f"/var/tmp/swiftbot-upgrade-{int(time.time())}.bundle"  # noqa: S108 - there, not here
        await self._run(destination, "scp", "-q", *SSH, "--", str(file), f"{destination}:{path}")
        return path

    async def upgrade(self, destination: str, path: str, *, older: bool) -> Ended:
        """Install a bundle there; what it says of itself is in the answer."""
        words = shlex.join(["swiftbot", "upgrade", path, "--json", *(["--older"] if older else [])])
        either = f'if [ "$(id -u)" = 0 ]; then {words}; else sudo -n {words}; fi'
        script = f"{either}; ended=$?; rm -f {shlex.quote(path)}; exit $ended"
        text = await self._run(destination, "ssh", *SSH, "--", destination, script, failing=True)
        try:
            return msgspec.json.decode(text, type=Ended)
        except msgspec.MsgspecError as error:
            raise UnreachableError(
                f"{destination} does not say how its upgrade ended: {error}", remedy="swiftbot release list there"
            ) from error

    async def _run(self, destination: str, *command: str, failing: bool = False) -> bytes:
        """Run a command; returns what it printed. `failing`: it may end with another code than 0 if it printed that."""
        try:
            process = await asyncio.create_subprocess_exec(
                *command,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
            )
        except FileNotFoundError:
            raise PrerequisiteError(f"{command[0]} is not installed", remedy="apt-get install openssh-client") from None
        try:
            out, said = await process.communicate()
        except asyncio.CancelledError:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            raise
        code = process.returncode or 0
        if code and not (failing and code != SSH_FAILED and out.strip()):
            last = said.decode("utf-8", "replace").strip().rpartition("\n")[2][:_SHOWN]
            what = "cannot be reached" if code == SSH_FAILED else f"ended {command[0]} with status {code}"
            hint = "; the upgrade may go on there: swiftbot release list" if failing else ""
            raise UnreachableError(
                f"{destination} {what}: {last or 'it said nothing'}", remedy=f"try `ssh {destination}`{hint}"
            )
        return out
