"""Textual's own widgets as they are used here: a field with editing keys of one's own, a box that scrolls, a bar.

Terminal multiplexers keep control keys for themselves (`screen` takes ^a, `tmux` ^b, both may take any other), so each
one that does something here has a name under which it is given other keys (`keys.keymap`).
"""

from textual.binding import Binding
from textual.containers import VerticalScroll
from textual.widgets import Input, Static

from appliance.tui.keys import line_bindings


class Field(Input, inherit_bindings=False):
    """A line in which something is written."""

    BINDINGS = line_bindings()  # pyright: ignore[reportAssignmentType] - Textual wants a list of its own union


class Pane(VerticalScroll, inherit_bindings=False):
    """A part of a screen that scrolls; without Textual's keys for scrolling sideways, which it has no use for."""

    BINDINGS = [
        Binding("up,k", "scroll_up", show=False),
        Binding("down,j", "scroll_down", show=False),
        Binding("home", "scroll_home", show=False),
        Binding("end", "scroll_end", show=False),
        Binding("pageup", "page_up", show=False),
        Binding("pagedown", "page_down", show=False),
    ]


class Bar(Static):
    """Lines of names that can be clicked, in their own colours: Textual would underline all of it, as links."""

    def __init__(self, *, id: str) -> None:  # noqa: A002 - Textual's name
        super().__init__(id=id)
        self.auto_links = False
