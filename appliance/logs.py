"""Structured logging of every process: to standard error for journald, and to the fleet's log key for people.

Lines are JSON under systemd and readable text in a terminal. A gateway publishes its lines from `info` up as
`LogLine`, so the recorder has them and the terminal UI shows them.
"""

import contextlib
import itertools
import logging
import sys
import time
from collections.abc import Callable, MutableMapping
from typing import Any, TextIO, cast

import structlog

from appliance.model import LogLine


class _StandardError:
    """Writes to whatever standard error is at that moment: it may be replaced after logging was set up.

    What cannot be written (a full disk, a reader that is gone) is lost and counted, and never an error of the work that
    it tells of: work that is done must not be answered as failed.
    """

    def __init__(self) -> None:
        self._lost = 0

    def write(self, text: str) -> int:
        try:
            if self._lost:
                sys.stderr.write(f"{self._lost} log lines could not be written\n")
                self._lost = 0
            sys.stderr.write(text)
        except (OSError, ValueError):  # ValueError: it is closed
            self._lost += text.endswith("\n")  # a line comes in two pieces
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()


_numbers = itertools.count(1)
_publish: Callable[[LogLine], None] | None = None
_PLAIN = (str, int, float, bool, type(None))


def configure(*, level: str = "info", style: str = "json") -> None:
    """Set up structlog for this process: `style` is `json` or `text`."""
    renderer: Any = (
        structlog.processors.JSONRenderer()
        if style == "json"
        else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            _tee,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()]),
        logger_factory=structlog.PrintLoggerFactory(file=cast("TextIO", _StandardError())),
        cache_logger_on_first_use=False,
    )


def publish_to(publish: Callable[[LogLine], None] | None) -> None:
    """Have log lines from `info` up handed to a function as well; None ends it."""
    global _publish  # noqa: PLW0603 - logging is per process, like structlog's own configuration
    _publish = publish


def _tee(logger: Any, method: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:  # noqa: ARG001
    if _publish is not None and method != "debug":
        fields = {
            key: value if isinstance(value, _PLAIN) else str(value)[:500]
            for key, value in event.items()
            if key not in ("event", "level", "exc_info")
        }
        _publish(
            LogLine(
                at_ns=time.time_ns(),
                level=method,
                source=str(event.get("gateway", "")),
                event=str(event.get("event", "")),
                fields=fields,
                number=next(_numbers),
            )
        )
    return event
