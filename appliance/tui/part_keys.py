"""Keys of the parts that screens are made of: tables, texts that scroll, the log.

A part that has the focus gets a key first, before the screen and the application. So a key of these does something
else there than what an action of the registry says of it; `actions.keymap` takes care that each action keeps one that
is not taken. The parts make their bindings from these tables. Pure.
"""

from collections.abc import Mapping

from textual.binding import Binding, BindingType

GRID: Mapping[str, str] = {
    "cursor(-1)": "up,k",
    "cursor(1)": "down,j",
    "page(-1)": "pageup",
    "page(1)": "pagedown",
    "edge(0)": "home,g",
    "edge(1)": "end,G",
    "pick": "enter",
}
"""Of a table, by what they do there."""
PANE: Mapping[str, str] = {
    "scroll_up": "up,k",
    "scroll_down": "down,j",
    "scroll_home": "home",
    "scroll_end": "end",
    "page_up": "pageup",
    "page_down": "pagedown",
}
"""Of a text that scrolls."""
LINES: Mapping[str, str] = {
    "move(-1)": "up,k",
    "move(1)": "down,j",
    "page(-1)": "pageup",
    "page(1)": "pagedown",
    "first": "home,g",
    "last": "end,G",
    "sideways(-1)": "left,h",
    "sideways(1)": "right,l",
}
"""Of the log."""
DRIVE: Mapping[str, str] = {
    "move('forward')": "up",
    "move('back')": "down",
    "move('turn left')": "left",
    "move('turn right')": "right",
    "move('left')": "a",
    "move('right')": "d",
    "move('up')": "pageup",
    "move('down')": "pagedown",
    "hold": "space",
    "speed(1)": "plus,equals_sign",
    "speed(-1)": "minus",
}
"""Of a robot that was taken over."""
_TABLES = (GRID, PANE)
_BY_SCREEN: Mapping[str, tuple[Mapping[str, str], ...]] = {"log": (LINES,), "takeover": (DRIVE,)}


def taken(screen: str) -> frozenset[str]:
    """Return the keys that the parts of a screen have for themselves."""
    tables = _BY_SCREEN.get(screen, _TABLES)
    return frozenset(key for table in tables for keys in table.values() for key in keys.split(","))


def part_bindings(table: Mapping[str, str]) -> list[BindingType]:
    """Return the bindings of a part."""
    return [Binding(keys, action, show=False) for action, keys in table.items()]
