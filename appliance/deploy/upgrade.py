"""From one release to another, and back by itself: `swiftbot upgrade` and `swiftbot rollback`.

An upgrade goes step by step, and what it is about to do is on the disk before it does it (`upgrade.json`). Every step
can be done again without harm, so after a cut it goes on with the one it was at: `swiftbot-upgrade.service` does so at
boot.

    STOP ─► SWITCH ─► START ─► CHECK ─► DONE
      │        │         │        │
      └────────┴────┬────┴────────┘ failed
                    ▼
    BACK_STOP ─► BACK_SWITCH ─► BACK_START ─► BACK_CHECK ─► FAILED

A new release is laid out beside the others before all this; until STOP nothing that runs is touched, and the journal is
not written. `after` decides and does nothing; `Upgrade` does what it says through a `Host`, the seam to systemd.

The check compares: what `swiftbot doctor` found wrong before the upgrade does not end it, since an upgrade may be the
remedy; what is wrong only afterwards does.
"""

import contextlib
import fcntl
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Protocol

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from appliance import durable
from appliance.deploy.layout import Layout
from appliance.errors import ConfigError, ConflictError, NotFoundError, PayloadError, RefusedError, SwiftbotError

JOURNAL = "upgrade.json"
LAST = "last-upgrade.json"


class Step(StrEnum):
    """What is about to be done."""

    STOP = "stop"
    SWITCH = "switch"
    START = "start"
    CHECK = "check"
    DONE = "done"
    BACK_STOP = "back: stop"
    BACK_SWITCH = "back: switch"
    BACK_START = "back: start"
    BACK_CHECK = "back: check"
    FAILED = "failed"


ENDS = frozenset({Step.DONE, Step.FAILED})
_BACK = frozenset({Step.BACK_STOP, Step.BACK_SWITCH, Step.BACK_START, Step.BACK_CHECK})
_NEXT = {
    Step.STOP: Step.SWITCH,
    Step.SWITCH: Step.START,
    Step.START: Step.CHECK,
    Step.CHECK: Step.DONE,
    Step.BACK_STOP: Step.BACK_SWITCH,
    Step.BACK_SWITCH: Step.BACK_START,
    Step.BACK_START: Step.BACK_CHECK,
    Step.BACK_CHECK: Step.FAILED,
}
_SAID = {
    Step.STOP: "stop the services: runs drain",
    Step.SWITCH: "switch to {target}",
    Step.START: "start the services",
    Step.CHECK: "check: services stay up, swiftbot doctor finds nothing new",
    Step.BACK_STOP: "back: stop the services",
    Step.BACK_SWITCH: "back: switch to {source}",
    Step.BACK_START: "back: start the services",
    Step.BACK_CHECK: "back: check",
}


class Journal(Struct, frozen=True, kw_only=True):
    """An upgrade or rollback as it is on the disk."""

    source: str
    """Release that ran; empty: none."""
    target: str
    """Release that is to run."""
    before: str = ""
    """Release that `swiftbot rollback` would have gone to; it is so again after a failure."""
    step: Step = Step.STOP
    back: bool = True
    """Whether a failure leads back to `source`."""
    services: tuple[str, ...] = ()
    """Units that ran, and are started again."""
    wrong: tuple[str, ...] = ()
    """What `swiftbot doctor` found wrong before."""
    problem: str = ""
    """Why it failed."""
    problem_back: str = ""
    """Why the release before does not work either."""


def after(journal: Journal, problem: str = "") -> Journal:
    """Decide what follows a step (pure).

    Args:
        journal: with the step that was done.
        problem: why it failed; empty: it did not.
    """
    step = journal.step
    if not problem:
        return replace(journal, step=_NEXT.get(step, step))
    if step in (Step.STOP, Step.SWITCH, Step.START, Step.CHECK):
        if journal.back and journal.source:
            return replace(journal, step=Step.BACK_STOP, problem=problem)
        if step in (Step.STOP, Step.SWITCH):  # what was stopped runs again, with the release that is current
            return replace(journal, step=Step.BACK_START, problem=problem)
        return replace(journal, step=Step.FAILED, problem=problem)
    # On the way back nothing is given up: a service that does not stop is no reason to leave the new release current.
    return replace(journal, step=_NEXT.get(step, step), problem_back=journal.problem_back or problem)


def resumed(journal: Journal) -> Journal:
    """Decide where to go on after a cut (pure): what was stopped may run again, since the machine was started."""
    again = {Step.SWITCH: Step.STOP, Step.BACK_SWITCH: Step.BACK_STOP}
    return replace(journal, step=again.get(journal.step, journal.step))


class Host(Protocol):
    """What an upgrade asks of the machine; each raises SwiftbotError where it fails."""

    async def running(self) -> tuple[str, ...]:
        """Return the units of this product that run."""
        ...

    async def stop(self, services: Sequence[str]) -> None:
        """Stop units; the gateway drains."""
        ...

    async def start(self, services: Sequence[str]) -> None:
        """Start units, and return once they say that they are ready."""
        ...

    async def reload(self) -> None:
        """Let systemd read the units of the release that is current, and what goes with them."""
        ...

    async def processes(self, services: Sequence[str]) -> Mapping[str, int]:
        """Return the main process of each unit that runs."""
        ...

    async def settle(self) -> None:
        """Wait as long as a service that cannot work takes to end."""
        ...

    async def wrong(self, program: Path) -> Mapping[str, str]:
        """Return what a release's `swiftbot doctor` finds wrong, by the name of the check."""
        ...


class Ended(Struct, frozen=True, kw_only=True):
    """How an upgrade or rollback ended."""

    release: str
    """That is current now."""
    before: str
    """That `swiftbot rollback` goes to."""
    rolled_back: bool = False
    problem: str = ""
    problem_back: str = ""
    removed: tuple[str, ...] = ()
    """Old releases that went."""


class Upgrade:
    """Carries an upgrade or rollback out.

    Args:
        layout: of the machine's releases.
        host: the machine's services.
        say: hears of each step.
    """

    def __init__(self, layout: Layout, host: Host, *, say: Callable[[str], None]) -> None:
        self._layout = layout
        self._host = host
        self._say = say
        self._file = layout.prefix / JOURNAL

    def interrupted(self) -> Journal | None:
        """Return the one that was cut off; None where there is none.

        Raises:
            PayloadError: its file cannot be read.
        """
        try:
            return msgspec.json.decode(self._file.read_bytes(), type=Journal)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError) as error:
            raise PayloadError(
                f"{self._file} cannot be read: {error}", remedy="remove it, then: swiftbot release list"
            ) from error

    @contextmanager
    def alone(self, *, make: bool = True) -> Generator[None]:
        """Keep another upgrade from running meanwhile.

        Args:
            make: make the folder of the releases where it is missing, for a first release.

        Raises:
            ConflictError: one does.
            ConfigError: the folder of the releases cannot be made or written.
            NotFoundError: it is missing, and not to be made.
        """
        if not make and not self._layout.prefix.exists():
            raise NotFoundError(
                f"there is no installation: {self._layout.prefix} does not exist", remedy="check the path of --root"
            )
        try:
            durable.make_folder(self._layout.prefix, mode=0o755)
            handle = os.open(self._layout.prefix / ".lock", os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            raise ConfigError(
                f"{self._layout.prefix} cannot be written: {error.strerror}",
                remedy="check the path of --root, its owner and the room on its disk (ls -ld, df -h)",
            ) from error
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ConflictError("another upgrade or rollback is running", remedy="wait until it ends") from None
            yield
        finally:
            os.close(handle)

    def check_none(self) -> None:
        """Raise ConflictError where one was cut off: it is finished first."""
        if (found := self.interrupted()) is not None:
            raise ConflictError(
                f"the switch to {found.target} was interrupted at: {found.step}",
                remedy="swiftbot upgrade --resume finishes it",
            )

    async def to(self, release: str, *, back: bool = True) -> Ended:
        """Switch to a release that is installed, and check it.

        Args:
            release: its id.
            back: go back to the one that runs where it does not work.
        """
        self.check_none()
        source = self._layout.running()
        if release == source:
            raise RefusedError(f"{release} runs already", remedy="swiftbot release list shows the others")
        services = await self._host.running()
        wrong: Mapping[str, str] = {}
        if source:
            wrong = await self._host.wrong(self._program())
        for name, detail in wrong.items():
            self._say(f"wrong before, and not counted: {name}: {detail}")
        before = self._layout.before()
        journal = Journal(
            source=source, target=release, before=before, back=back, services=services, wrong=tuple(wrong)
        )
        if problem := self._written(journal):
            raise RefusedError(f"{problem}; nothing was stopped", remedy="free some space (df -h)")
        return await self._go(journal)

    async def rollback(self) -> Ended:
        """Go back to the release before; one that was cut off on its way to a new release is turned round."""
        found = self.interrupted()
        if found is not None:
            if not found.source:
                raise NotFoundError("there is no release to go back to", remedy="swiftbot upgrade --resume")
            self._say(f"the switch to {found.target} was interrupted at: {found.step}")
            return await self._go(replace(found, step=Step.BACK_STOP, problem=found.problem or "rolled back by hand"))
        before = self._layout.before()
        if not before:
            raise NotFoundError("there is no release to go back to", remedy="swiftbot release list; swiftbot upgrade")
        return await self.to(before, back=False)

    async def resume(self) -> Ended | None:
        """Go on with one that was cut off; None where there is none."""
        found = self.interrupted()
        if found is None:
            return None
        self._say(f"the switch to {found.target} was interrupted at: {found.step}; going on")
        return await self._go(resumed(found))

    async def _go(self, journal: Journal) -> Ended:
        while journal.step not in ENDS:
            problem = self._written(journal)
            self._say(_SAID[journal.step].format(target=journal.target, source=journal.source))
            if problem and journal.step in _BACK:
                # A full disk ends an upgrade, and not the way back: services that are down would stay down.
                self._say(problem)
                problem = ""
            if not problem:
                try:
                    await self._do(journal)
                except SwiftbotError as error:
                    problem = str(error)
                except OSError as error:
                    problem = f"{error.strerror}: {error.filename}"
            if problem:
                self._say(f"failed: {problem}")
            journal = after(journal, problem)
        return self._end(journal)

    def _end(self, journal: Journal) -> Ended:
        removed: list[str] = []
        if journal.step is Step.DONE:
            with contextlib.suppress(OSError):  # what is left is removed by the next one
                removed = self._layout.prune()
        durable.rename(self._file, self._layout.prefix / LAST)
        return Ended(
            release=self._layout.running(),
            before=self._layout.before(),
            rolled_back=journal.step is Step.FAILED and self._layout.running() == journal.source,
            problem=journal.problem,
            problem_back=journal.problem_back,
            removed=tuple(removed),
        )

    async def _do(self, journal: Journal) -> None:
        match journal.step:
            case Step.STOP | Step.BACK_STOP:
                await self._host.stop(journal.services)
            case Step.SWITCH:
                self._layout.switch(journal.target)
                await self._host.reload()
            case Step.BACK_SWITCH:
                self._layout.switch(journal.source, before=journal.before)
                await self._host.reload()
            case Step.START | Step.BACK_START:
                await self._host.start(journal.services)
            case _:
                await self._check(journal)

    async def _check(self, journal: Journal) -> None:
        """Raise RefusedError where services do not stay up, or doctor finds what it did not find before."""
        begun = await self._host.processes(journal.services)
        await self._host.settle()
        now = await self._host.processes(journal.services)
        down = [each for each in journal.services if begun.get(each) is None or now.get(each) != begun[each]]
        if down:
            raise RefusedError(f"{', '.join(down)} did not stay up", remedy=f"journalctl -u {down[0]} -n 50")
        wrong = await self._host.wrong(self._program())
        found = {name: detail for name, detail in wrong.items() if name not in journal.wrong}
        if found:
            raise RefusedError("; ".join(f"{name}: {detail}" for name, detail in found.items()))

    def _program(self) -> Path:
        return self._layout.current / "venv/bin/swiftbot"

    def _written(self, journal: Journal) -> str:
        """Write the journal; returns why that cannot be done, empty where it was."""
        try:
            durable.write(self._file, msgspec.json.format(msgspec.json.encode(journal)), mode=0o644)
        except OSError as error:
            return f"{self._file} cannot be written: {error.strerror}"
        return ""
