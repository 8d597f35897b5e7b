"""Snapshots of screens as text: the characters, and below them for each theme which style stands where.

They are compared with files in `snapshots/`; `SWIFTBOT_RENEW_SNAPSHOTS=1 pytest …` writes the files again, to be read
before they are committed.
"""

import os
import string
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from rich.style import Style
from textual.app import App
from textual.pilot import Pilot

from appliance.tui.app import SwiftbotApp
from appliance.tui.settings import TuiConfig

if TYPE_CHECKING:
    from .conftest import FakeView

NOW_NS = 1_700_000_000 * 10**9
THEMES = ("dark", "light", "contrast-dark")
SIZES = pytest.mark.parametrize("size", [(80, 24), (160, 48)], ids=["80x24", "160x48"])
OTHER_SIZES = pytest.mark.parametrize("size", [(40, 12), (20, 6), (300, 80)])
FOLDER = Path(__file__).parent / "snapshots"
RENEW = bool(os.environ.get("SWIFTBOT_RENEW_SNAPSHOTS"))
_LETTERS = "." + string.ascii_letters + string.digits


def characters(app: App[object]) -> str:
    """Return what is on the screen, line by line, without blanks at the ends."""
    strips = app.screen._compositor.render_strips()
    return "\n".join("".join(part.text for part in strip).rstrip() for strip in strips)


async def settle(app: SwiftbotApp, pilot: Pilot[None]) -> str:
    """Let everything happen and be drawn; return what is on the screen."""
    await app.workers.wait_for_complete()
    await pilot.pause()
    app.draw(force=True)
    await pilot.pause()
    return characters(app)


def styles(app: App[object]) -> str:
    """Return a letter for the style of each cell, and what each letter means; the commonest is a dot."""
    rows: list[list[tuple[str, int]]] = []
    count: dict[str, int] = {}
    for strip in app.screen._compositor.render_strips():
        row = [(_words(part.style), part.cell_length) for part in strip]
        rows.append(row)
        for words, length in row:
            count[words] = count.get(words, 0) + length
    order = sorted(count, key=lambda words: (-count[words], words))
    letter = {words: _LETTERS[min(index, len(_LETTERS) - 1)] for index, words in enumerate(order)}
    drawn = ["".join(letter[words] * length for words, length in row).rstrip(".") for row in rows]
    return "\n".join([*drawn, *(f"{letter[words]} = {words}" for words in order)])


def _words(style: Style | None) -> str:
    if style is None:
        return "plain"
    parts = [name for name in ("bold", "dim", "italic", "underline", "reverse") if getattr(style, name)]
    colour = style.color.name if style.color is not None else "default"
    ground = style.bgcolor.name if style.bgcolor is not None else "default"
    return " ".join([*parts, f"{colour} on {ground}"])


def compare(name: str, picture: str) -> None:
    """Compare a picture with its file, or write the file again when that is asked for."""
    path = FOLDER / f"{name}.txt"
    if RENEW:
        path.write_text(picture + "\n")
    assert path.exists(), f"{path.name} is missing: write it with SWIFTBOT_RENEW_SNAPSHOTS=1"
    assert picture + "\n" == path.read_text(), f"{path.name} differs; SWIFTBOT_RENEW_SNAPSHOTS=1 writes it again"


@contextmanager
def universal_time(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have times of day be those of UTC, until patches are undone."""
    monkeypatch.setenv("TZ", "UTC")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@asynccontextmanager
async def shown(
    view: "FakeView", keys: Sequence[str], size: tuple[int, int], *, write: bool = False
) -> AsyncIterator[tuple[SwiftbotApp, Pilot[None]]]:
    """Open the terminal UI on a fleet, press keys, and let all come to rest."""
    app = SwiftbotApp(view, TuiConfig(write=write, refresh_hz=0.2))
    async with app.run_test(size=size) as pilot:
        await pilot.pause()
        for key in keys:
            await pilot.press(key)
            await pilot.pause()
        await app.workers.wait_for_complete()
        await pilot.pause()
        yield app, pilot


async def compare_screen(
    view: "FakeView", name: str, keys: Sequence[str], size: tuple[int, int], *, write: bool = False
) -> None:
    """Compare what is on the screen after some keys, and its styles in each of the themes, with its snapshot."""
    async with shown(view, keys, size, write=write) as (app, pilot):
        parts: list[str] = []
        for theme in THEMES:
            app.set_look(theme)
            await pilot.pause()
            app.draw(force=True)
            await pilot.pause()
            if not parts:
                parts += ["--- characters", characters(app)]
            parts += [f"--- styles of {theme}", styles(app)]
        compare(f"{name}-{size[0]}x{size[1]}", "\n".join(parts))


async def never_refused(view: "FakeView", keys: Sequence[str], size: tuple[int, int]) -> None:
    """Check that a window of any size has its lines, and that what comes first is in them."""
    async with shown(view, keys, size) as (app, pilot):
        app.draw(force=True)
        await pilot.pause()
        lines = characters(app).split("\n")
        assert len(lines) == size[1]
        assert "[R]" in lines[0]
