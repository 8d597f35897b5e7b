"""ASCII in place of signs that a terminal may not have: the console of Linux, serial lines, other character sets.

Everything that is drawn goes through the driver, so the signs are replaced there, each by as many cells as it takes:
screens and tables know nothing of it.
"""

import locale
import os
from collections.abc import Iterator, Mapping

from rich.cells import cell_len
from textual.drivers.linux_driver import LinuxDriver

from appliance.tui.settings import TuiConfig

_SIGNS = {
    "✔": "+", "✘": "x", "●": "*", "○": "o", "◇": "?", "◔": "~", "◌": "-", "▲": "!", "⊘": "/", "■": "#", "‖": "=",
    "▶": ">", "▸": ">", "›": ">", "→": ">", "←": "<", "↑": "^", "↓": "v", "↖": "\\", "↗": "/", "↘": "\\", "↙": "/",
    "⇧": "^", "⇅": "|", "✉": "@", "…": ".", "·": ".", "–": "-", "—": "-", "−": "-", "°": "'", "␛": "^", "␡": "^",
    "▁": "_", "▂": "_", "▃": "-", "▄": "-", "▅": "=", "▆": "=", "▇": "#", "█": "#", "▌": "|", "▐": "|", "░": ".",
    "▒": ":", "▓": "#", "‘": "'", "’": "'", "“": '"', "”": '"', "╭": "+", "╮": "+", "╰": "+", "╯": "+",
}  # fmt: skip
_BOXES = range(0x2500, 0x2580)
_LINES = {"─": "-", "━": "-", "═": "-", "│": "|", "┃": "|", "║": "|"}
_BRAILLE = range(0x2800, 0x2900)
"""Dots of maps and plots."""
_UPPER_DOTS = 0x1B
"""Of a braille sign: those of its two upper rows."""
_PLAIN = 0x2000
"""Below it stand the letters of most alphabets, which terminals have more often than signs."""
_POOR = frozenset({"linux", "vt100", "vt102", "vt220", "dumb", "ansi", "cons25"})
"""Terminal types without most signs."""


class _Table(Mapping[int, str]):
    """What each character is written as, for `str.translate`."""

    def __getitem__(self, number: int) -> str:
        character = chr(number)
        if character in _SIGNS:
            return _SIGNS[character]
        if number in _BOXES:
            return _LINES.get(character, "+")
        if number in _BRAILLE:
            upper, lower = bool(number & _UPPER_DOTS), bool(number & ~_UPPER_DOTS & 0xFF)
            return ":" if upper and lower else "'" if upper else "." if lower else " "
        if number < _PLAIN:
            raise LookupError  # it is left as it is
        return "?" * cell_len(character)

    def __iter__(self) -> Iterator[int]:
        return iter(map(ord, _SIGNS))

    def __len__(self) -> int:
        return len(_SIGNS)


TABLE = _Table()


def in_ascii(text: str) -> str:
    """Return a text with signs of ASCII, as many cells wide."""
    return text if text.isascii() else text.translate(TABLE)


def needs_ascii(config: TuiConfig, environment: Mapping[str, str], encoding: str) -> bool:
    """Whether signs are to be replaced.

    Args:
        config: `glyphs` decides, unless it is `auto`.
        environment: of this process.
        encoding: of the terminal, by the locale.
    """
    if config.glyphs != "auto":
        return config.glyphs == "ascii"
    return environment.get("TERM", "") in _POOR or encoding.lower().replace("-", "") != "utf8"


class AsciiDriver(LinuxDriver):
    """Writes to the terminal with signs of ASCII."""

    def write(self, data: str) -> None:
        """Write what was drawn."""
        super().write(in_ascii(data))


def in_browser() -> bool:
    """Whether a browser is the terminal (`swiftbot tui --serve`)."""
    return "TEXTUAL_DRIVER" in os.environ


def driver_for(config: TuiConfig) -> type[LinuxDriver] | None:
    """Return the driver for this terminal; None for Textual's own."""
    if in_browser():
        return None
    return AsciiDriver if needs_ascii(config, os.environ, locale.getpreferredencoding(do_setlocale=False)) else None
