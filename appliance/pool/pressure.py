"""Memory pressure: what the kernel says of it, and how much the pool may hold while it lasts.

It exists because the kernel answers a lack of memory by killing, and containers that nobody uses are the cheapest
thing a gateway can give up before that. Readings come from pressure stall information (PSI: the part of the last
10 s in which some, or all, processes stood still for want of memory), of the machine and, with cgroup v2, of this
user's slice; where the kernel has none, from MemAvailable alone.

`Squeeze` decides, without I/O: readings and the clock in, a budget out. A reading above the high mark takes a part
of what is held away, again every `settle_s` while it stays high (the averages of PSI lag by some seconds); below the
low mark, for `calm_s` on end, the budget grows back in steps. Between the marks nothing changes: a pool that shrank
and grew with every reading would start containers only to give them up.

Worked example, 4096 MB allowed, 2048 held, `shrink` 0.25, `regrow` 0.125: at some = 14 % the budget becomes 1536 MB and
idle containers go; 3 s later, still 12 %, 1152 MB; at 0 % for 20 s it is 1664 MB, and so on to 4096.
"""

import asyncio
import os
import time
from collections.abc import Callable
from pathlib import Path

import structlog
from msgspec import Struct

from appliance.pool.settings import PressureConfig

log = structlog.get_logger(__name__)

MB = 2**20


class Reading(Struct, frozen=True, kw_only=True):
    """What the kernel says. Percentages are of the last 10 s; None where it does not say."""

    available_mb: float | None = None
    some: float | None = None
    full: float | None = None

    @property
    def text(self) -> str:
        """The reading in words."""
        parts = [
            f"{self.available_mb:.0f} MB available" if self.available_mb is not None else "",
            f"processes stood still for {self.some:.0f} % of the last 10 s" if self.some is not None else "",
        ]
        return ", ".join(each for each in parts if each) or "unknown"


class Squeeze:
    """Turns readings into the memory that the pool may hold. Pure: the clock is passed in, seconds."""

    def __init__(self, config: PressureConfig, *, memory_mb: int) -> None:
        self.budget_mb = memory_mb
        self.reason = ""
        """Why the budget is smaller than the setting; empty when it is not."""
        self.steps = 0
        """How often it was made smaller."""
        self._config = config
        self._most_mb = memory_mb
        self._least_mb = min(config.least_mb, memory_mb)
        self._changed_at = float("-inf")
        self._calm_since: float | None = None

    def heard(self, reading: Reading, *, held_mb: int, now: float) -> int:
        """Take a reading and return the budget, MB. `held_mb`: what the containers held now are allowed together."""
        config = self._config
        if self._high(reading):
            self._calm_since = None
            if now - self._changed_at >= config.settle_s and self.budget_mb > self._least_mb:
                self.budget_mb = max(self._least_mb, int(min(self.budget_mb, held_mb) * (1 - config.shrink)))
                self._changed_at = now
                self.steps += 1
            self.reason = f"memory is short ({reading.text})" if self.budget_mb < self._most_mb else ""
        elif not self._low(reading):
            self._calm_since = None
        elif self.budget_mb < self._most_mb:
            if self._calm_since is None:
                self._calm_since = now
            if now - max(self._calm_since, self._changed_at) >= config.calm_s:
                self.budget_mb = min(self._most_mb, self.budget_mb + max(1, int(self._most_mb * config.regrow)))
                self._changed_at = now
                self.reason = f"memory was short ({reading.text})" if self.budget_mb < self._most_mb else ""
        return self.budget_mb

    def _high(self, reading: Reading) -> bool:
        return (
            (reading.some is not None and reading.some >= self._config.some_high)
            or (reading.full is not None and reading.full >= self._config.full_high)
            or (reading.available_mb is not None and reading.available_mb < self._config.spare_mb)
        )

    def _low(self, reading: Reading) -> bool:
        return (reading.some is None or reading.some < self._config.low) and (
            reading.available_mb is None or reading.available_mb >= 1.5 * self._config.spare_mb
        )


class MemoryWatch:
    """Asks the kernel now and then and keeps the budget. `held_mb`: what the containers held are allowed together."""

    def __init__(
        self,
        config: PressureConfig,
        *,
        memory_mb: int,
        held_mb: Callable[[], int],
        on_change: Callable[[], None],
        read: Callable[[], Reading] | None = None,
    ) -> None:
        self.squeeze = Squeeze(config, memory_mb=memory_mb)
        self._config = config
        self._held_mb = held_mb
        self._on_change = on_change
        self._read = read or reader()

    async def run(self) -> None:
        """Watch for as long as the gateway lives."""
        while self._config.watch:
            reading = await asyncio.to_thread(self._read)
            before = self.squeeze.budget_mb
            budget_mb = self.squeeze.heard(reading, held_mb=self._held_mb(), now=time.monotonic())
            if budget_mb != before:
                tell = log.warning if budget_mb < before else log.info
                tell("memory for containers", budget_mb=budget_mb, before_mb=before, reading=reading.text)
                self._on_change()
            await asyncio.sleep(self._config.every_s)


def reader(
    proc: Path = Path("/proc"), cgroup: Path = Path("/sys/fs/cgroup"), uid: int | None = None
) -> Callable[[], Reading]:
    """Return a function that reads the kernel's files; blocking, though for 0.1 ms only."""
    user = os.getuid() if uid is None else uid
    slice_ = cgroup / "user.slice" / f"user-{user}.slice"
    stalls = (proc / "pressure" / "memory", slice_ / "memory.pressure")

    def read() -> Reading:
        somes: list[float] = []
        fulls: list[float] = []
        for file in stalls:
            some, full = parse_stalls(_text(file))
            somes += [some] if some is not None else []
            fulls += [full] if full is not None else []
        available = [each for each in (parse_available(_text(proc / "meminfo")), _left_mb(slice_)) if each is not None]
        return Reading(
            available_mb=min(available, default=None), some=max(somes, default=None), full=max(fulls, default=None)
        )

    return read


def _text(file: Path) -> str:
    """Return a file's text, empty where there is none: an old kernel, another cgroup version, no right to read."""
    try:
        return file.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""


def _left_mb(slice_: Path) -> float | None:
    """Return what the user's slice may still take, MB; what it holds of files can be dropped and counts as free."""
    limit, held = _text(slice_ / "memory.max").strip(), _text(slice_ / "memory.current").strip()
    if not (limit.isdecimal() and held.isdecimal()):  # "max": it has no limit of its own
        return None
    fields = dict(line.split(maxsplit=1) for line in _text(slice_ / "memory.stat").splitlines() if " " in line)
    files = fields.get("inactive_file", "0")
    return (int(limit) - int(held) + (int(files) if files.isdecimal() else 0)) / MB


def parse_stalls(text: str) -> tuple[float | None, float | None]:
    """Return avg10 of `some` and of `full`, percent, of a PSI file's text; None for what is not there."""
    found: dict[str, float] = {}
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        for field in rest.split():
            key, _, value = field.partition("=")
            if key == "avg10":
                try:
                    found[kind] = float(value)
                except ValueError:
                    continue
    return found.get("some"), found.get("full")


def parse_available(text: str) -> float | None:
    """Return MemAvailable of the text of /proc/meminfo in MB, None when it is not there."""
    for line in text.splitlines():
        key, _, rest = line.partition(":")
        if key == "MemAvailable" and (fields := rest.split()) and fields[0].isdecimal():
            return int(fields[0]) / 1024
    return None
