"""What systemd wants to hear of a daemon (sd_notify): readiness, the watchdog, that it stops.

Without systemd every call does nothing, so daemons tell it unconditionally.
"""

import asyncio
import os
from functools import cache
from typing import Any

import sdnotify


@cache
def _notifier() -> Any:  # untyped library; it opens a socket, which only daemons need
    return sdnotify.SystemdNotifier()


def ready() -> None:
    """The service can work."""
    _notifier().notify("READY=1")


def alive() -> None:
    """It still turns."""
    _notifier().notify("WATCHDOG=1")


def stopping() -> None:
    """It is on its way out; the drain deadline is systemd's TimeoutStopSec."""
    _notifier().notify("STOPPING=1")


def watchdog_s() -> float:
    """Half the interval within which systemd wants to hear `alive`, seconds; 0 without a watchdog."""
    return int(os.environ.get("WATCHDOG_USEC", "0")) / 2e6


async def keep_alive() -> None:
    """Tell systemd that the event loop turns, until cancelled; returns at once without a watchdog."""
    interval_s = watchdog_s()
    while interval_s:
        alive()
        await asyncio.sleep(interval_s)
