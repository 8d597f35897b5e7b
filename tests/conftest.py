"""Fixtures that every test may use: the async backend, free ports, and the folder of the tests' data.

They exist so that tests need nothing from outside the project: ports are asked of the kernel, never fixed, and all data
lies in `tests/data` or in the package.
"""

import asyncio
import functools
import gc
import inspect
import os
import socket
import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest
import structlog
from hypothesis import configuration, settings

from appliance.ports import free_port as ask_port

# Found examples are printed, not kept: no run depends on an earlier one, and the tree may be read-only.
# No deadlines: how long an example takes says how busy the machine is.
settings.register_profile("alone", database=None, deadline=None, max_examples=50)
settings.load_profile("alone")
if sys.pycache_prefix:
    # What hypothesis reads out of the sources (their constants) is kept where their bytecode is: a second a process.
    configuration.set_hypothesis_home_dir(Path(sys.pycache_prefix) / "hypothesis")

# Exceptions that are logged on the way are shown plainly: boxes of source and locals cost a tenth of a second each.
structlog.configure(
    processors=[
        *structlog.get_config()["processors"][:-1],
        structlog.dev.ConsoleRenderer(colors=False, exception_formatter=structlog.dev.plain_traceback),
    ]
)

ROOT = Path(__file__).resolve().parent.parent
"""The project's root folder."""


FEW_EXAMPLES = 10
"""Of each property, when quick feedback is wanted (SWIFTBOT_QUICK=1, as `make check` does)."""
QUICK = bool(os.environ.get("SWIFTBOT_QUICK"))
"""Whether it is."""


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """Look for cycles seldom: not while tests are collected nor in what came of it, and rarely afterwards."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 50)
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Where quick feedback is wanted try fewer examples of each property, and leave out what is marked `thorough`."""
    if not QUICK:
        return
    thorough = [item for item in items if item.get_closest_marker("thorough")]
    config.hook.pytest_deselected(items=thorough)
    items[:] = [item for item in items if not item.get_closest_marker("thorough")]
    for item in items:
        test = getattr(item, "obj", None)
        chosen = getattr(test, "_hypothesis_internal_use_settings", None)
        if isinstance(chosen, settings) and chosen.max_examples > FEW_EXAMPLES:
            test._hypothesis_internal_use_settings = settings(chosen, max_examples=FEW_EXAMPLES)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, Any, Any]:
    """End an async test that waits in vain within the loop, a little before its time limit.

    The limit's own alarm interrupts the loop but not the test: that would go on waiting in it, the fixtures could not
    be torn down, and the whole run would hang.
    """
    test = pyfuncitem.obj
    if inspect.iscoroutinefunction(test):
        marker = pyfuncitem.get_closest_marker("timeout")
        limit_s = float(marker.args[0] if marker is not None else pyfuncitem.config.getini("timeout") or 180)

        @functools.wraps(test)
        async def bounded(**arguments: Any) -> None:
            async with asyncio.timeout(limit_s * 0.8):
                await test(**arguments)

        pyfuncitem.obj = bounded
    return (yield)


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    """Run every async test on asyncio: the product runs on nothing else."""
    return "asyncio"


@pytest.fixture
def free_ports() -> Callable[..., list[int]]:
    """Return a function `free_ports(n, udp=False)`: n different loopback ports that are free just now."""

    def ask(count: int, *, udp: bool = False) -> list[int]:
        kind = socket.SOCK_DGRAM if udp else socket.SOCK_STREAM
        return sorted(ask_port(kind) for _ in range(count))

    return ask


@pytest.fixture
def free_port() -> int:
    """Return a loopback TCP port that is free just now."""
    return ask_port()


@pytest.fixture
def free_udp_port() -> int:
    """Return a loopback UDP port that is free just now."""
    return ask_port(socket.SOCK_DGRAM)


@pytest.fixture(scope="session")
def project_root() -> Path:
    """Return the project's root folder."""
    return ROOT


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the tests' data, `tests/data`; its README says where they are from."""
    return ROOT / "tests" / "data"
