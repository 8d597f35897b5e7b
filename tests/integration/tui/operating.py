"""An operator at a terminal UI on a real fleet, under Textual's pilot: keys in, screen out."""

from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import pytest
from textual.pilot import Pilot

from appliance.connection import FleetState
from appliance.operations import OPERATIONS
from appliance.plane.settings import PlaneConfig
from appliance.tui.app import SwiftbotApp
from appliance.tui.command_line import Command
from appliance.tui.settings import TuiConfig
from appliance.tui.store import Store
from appliance.tui.subscriptions import FleetView

KEYS = {" ": "space", "-": "minus", "/": "slash", "_": "underscore", ".": "full_stop", "?": "question_mark"}
LONG_S = 60.0
"""Nothing that is waited for here takes so long; the machine may be busy."""


AUDITED = {operation.name: operation.audit for operation in OPERATIONS if operation.name and operation.audit}
"""As what the audit has each action of the registry that is an order."""

T = TypeVar("T", bound=Callable[..., object])


def does(*actions: str) -> Callable[[T], T]:
    """Say which actions of the registry a test does against a real fleet; `watched` looks whether that is so."""

    def marked(test: T) -> T:
        test.__dict__["does"] = actions
        return test

    return marked


class WatchedApp(SwiftbotApp):
    """The terminal UI, which remembers what was begun and what was done with it."""

    def __init__(self, view: FleetView, config: TuiConfig) -> None:
        super().__init__(view, config)
        self.begun: set[tuple[str, str]] = set()
        """Actions, and why they were given."""
        self.done: set[str] = set()
        """Those that the fleet was asked for and did."""

    def begin(self, command: Command) -> None:
        """Remember it, unless it cannot begin."""
        if not command.missing and (self.unlocked or command.action.always or not command.action.writes):
            self.begun.add((command.action.name, command.given.get("why", "")))
        super().begin(command)

    def note(self, line: str, outcome: str, *, level: str = "info") -> None:
        """Remember what came of it."""
        if level == "info":
            self.done.add(line.split(maxsplit=1)[0])
        super().note(line, outcome, level=level)


WATCHED: list[WatchedApp] = []
"""The terminal UIs of the test that runs."""


class Operator:
    """Somebody at a terminal UI.

    Args:
        app: the UI.
        pilot: presses its keys.
    """

    def __init__(self, app: SwiftbotApp, pilot: Pilot[None]) -> None:
        self.app = app
        self._pilot = pilot

    @property
    def store(self) -> Store:
        """What the UI knows."""
        return self.app.view.store

    @property
    def chosen(self) -> dict[str, str]:
        """What is selected on the screen."""
        with self.app._context():
            return self.app.front.chosen() if self.app.front is not None else {}

    def seen(self) -> str:
        """Return what is on the screen."""
        return "\n".join("".join(part.text for part in strip) for strip in self.app.screen._compositor.render_strips())

    def said(self, *words: str) -> bool:
        """Whether a line of the log has all these words."""
        return any(all(word in entry.text for word in words) for entry in self.store.entries)

    async def press(self, *keys: str) -> None:
        """Press keys, by Textual's names."""
        with self.app._context():  # there may be two UIs in this process
            await self._pilot.press(*keys)

    async def write(self, text: str) -> None:
        """Type a text."""
        await self.press(*(KEYS.get(each, each) for each in text))

    async def line(self, text: str) -> None:
        """Write a command line, and Enter."""
        await self.press("colon")
        await self.write(text)
        await self.press("enter")

    async def until(self, holds: Callable[[], object]) -> None:
        """Wait until something holds; after a minute, fail with what the screen and its log show."""
        with self.app._context():
            for _ in range(int(LONG_S / 0.05)):
                if holds():
                    return
                await self._pilot.pause(0.05)
        told = "\n".join(entry.text for entry in list(self.store.entries)[-10:])
        pytest.fail(f"it never came to hold:\n{self.seen()}\n{told}")

    async def see(self, *words: str, without: str = "") -> None:
        """Wait until all these words are on the screen, in as many lines as they take."""

        def there() -> bool:
            text = self.seen()
            return all(word in text for word in words) and not (without and without in text)

        await self.until(there)

    async def hears(self, *words: str) -> None:
        """Wait until a line of the log has all these words."""
        await self.until(lambda: self.said(*words))

    async def until_true(self, ask: Callable[[], Coroutine[Any, Any, object]]) -> None:
        """Wait until an answer of the fleet is true."""
        for _ in range(int(LONG_S / 0.1)):
            if await ask():
                return
            await self._pilot.pause(0.1)
        pytest.fail(f"the fleet never came to say so:\n{self.seen()}")


@asynccontextmanager
async def operator(
    fleet: FleetState, name: str = "ann", *, size: tuple[int, int] = (120, 40), logs: tuple[str, ...] = ()
) -> AsyncIterator[Operator]:
    """Open an unlocked terminal UI on a fleet, and wait until all of the fleet is on it."""
    config = TuiConfig(refresh_hz=5.0, write=True, logs=logs)
    view = FleetView(PlaneConfig(mode="client", connect=fleet.endpoint.connect), fleet.fleet, config)
    view.operator = name
    app = WatchedApp(view, config)
    WATCHED.append(app)
    async with app.run_test(size=size, notifications=True) as pilot:
        it = Operator(app, pilot)
        robots = set(fleet.robots)
        await it.until(
            lambda: (
                it.store.connection.connected
                and len(it.store.gateways) == len(fleet.gateways)
                and robots <= set(it.store.robots)
            )
        )
        yield it
        await it.until(lambda: not app.under_way)  # the fleet may have done what the UI has not yet been answered
