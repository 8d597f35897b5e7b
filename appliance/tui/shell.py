"""The window: which screens there are, when the one that is seen is drawn, and in which colours.

Textual's part of it, nothing else: it works at 80 columns by 24 lines over SSH, draws a few times a second and only
what changed, and never stops because the network does.
"""

import contextlib
import re
from pathlib import Path
from typing import ClassVar

from rich.console import RenderableType
from textual.app import App
from textual.css.query import NoMatches

from appliance.errors import ConfigError, SwiftbotError
from appliance.tui import themes
from appliance.tui.data import View
from appliance.tui.dialogs import TextDialog
from appliance.tui.frame import FleetScreen
from appliance.tui.keys import bindings, keymap
from appliance.tui.plans.history import History
from appliance.tui.prompt import Lines
from appliance.tui.safe import safe
from appliance.tui.screens import SCREENS
from appliance.tui.settings import TuiConfig

_FONT = re.compile(r"@font-face \{[^}]*\}\s*")


class Shell(App[None], inherit_bindings=False):
    """A window on a view of a fleet: what is seen of it, when it is drawn, and in which colours.

    Args:
        view: What is shown; closed with the app.
        config: How it looks and how often it is drawn.
        history: Instructions submitted before; kept in memory alone when none is given.
    """

    TITLE = "SwiftBot"
    BINDINGS = bindings()  # pyright: ignore[reportAssignmentType] - Textual wants a list of its own union
    MODES = SCREENS  # pyright: ignore[reportAssignmentType] - of classes, which make themselves
    DEFAULT_MODE = "fleet"
    ENABLE_COMMAND_PALETTE: ClassVar[bool] = False
    """Textual would bind ^p to it for good; it is there all the same, under the keys of the action `palette`."""
    CSS = """
    ModalScreen { align: center middle; }
    .dialog { width: 90%; max-width: 110; height: 80%; border: round $accent; background: $surface; padding: 0 1; }
    .small { height: auto; width: 60; }
    .title { text-style: bold; }
    #plan-box { height: 1fr; scrollbar-size: 1 1; }
    #hint { color: $text-muted; }
    VerticalScroll { scrollbar-size: 1 1; }
    """

    def __init__(self, view: View, config: TuiConfig | None = None, *, history: History | None = None) -> None:
        self.config = config or TuiConfig()
        self.config.check()
        self._own_keys = keymap(self.config.keys)
        if self.config.theme not in themes.BY_NAME:
            known = ", ".join(themes.BY_NAME)
            raise ConfigError(f"tui.theme is {self.config.theme!r}", remedy=f"there are: {known}")
        self._look = ""
        """The theme that styles were worked out for."""
        super().__init__()
        self.use_command_palette = True
        self.view = view
        self.history = history or History(None)
        """Instructions submitted before."""
        self.behind: View | None = None
        """The fleet, while a recorded log is shown instead."""
        self.lines = Lines()
        """Command lines written before."""
        self.unlocked = self.config.write and view.steerable
        """Whether what changes the fleet is allowed."""
        self.under_way: dict[str, None] = {}
        """Orders that have not been answered yet, as command lines."""
        self.wanted_task = ""
        """A task that is to be selected as soon as it is shown."""
        if not self.config.animation:
            self.animation_level = "none"
        for look in themes.LOOKS:
            self.register_theme(look.theme())

    async def on_mount(self) -> None:
        """Begin to listen and to draw."""
        self.set_look(self.config.theme)
        self.set_keymap(self._own_keys)
        await self.view.start()
        if not self.view.steerable:
            self.switch_mode("replay")
        self.set_interval(1 / self.config.refresh_hz, self._tick)

    async def on_unmount(self) -> None:
        """End listening."""
        await self.view.close()
        if self.behind is not None:
            await self.behind.close()

    # --- drawing -----------------------------------------------------------------------------------------

    @property
    def front(self) -> FleetScreen | None:
        """The screen that is seen, behind a dialog if there is one."""
        return next((each for each in reversed(self.screen_stack) if isinstance(each, FleetScreen)), None)

    def _tick(self) -> None:
        # While the app ends, the timer may still fire when parts of the screen are gone.
        with contextlib.suppress(NoMatches):
            self.draw()

    def draw(self, *, force: bool = False) -> None:
        """Draw what is new on the screen that is seen; the others wait until they are."""
        self.view.sync()
        if (front := self.front) is not None:
            front.flush(force=force)

    def delay_update(self, delay: float = 0.05) -> None:
        """Hold painting back while screens change; shorter than Textual does, since ours are drawn at once."""
        super().delay_update(min(delay, 0.005))

    def refresh_css(self, animate: bool = True) -> None:
        """Work out the styles anew when the colours have changed.

        Textual does so whenever a screen is shown for the first time as well, which is styled with these colours as it
        is made: that took longer than all else of showing it.
        """
        screens = [each for each in self.screen_stack if isinstance(each, FleetScreen)]
        for each in screens:
            each.look = each.look or self._look
        if self._look == self.theme and all(each.look == self.theme for each in screens):
            return
        super().refresh_css(animate)
        self._look = self.theme
        for each in screens:
            each.look = self.theme

    def get_theme_variable_defaults(self) -> dict[str, str]:
        """Return variables that themes have beside Textual's: its own theme, until ours is set, lacks them."""
        return {"cursor": themes.LOOKS[0].cursor}

    def set_look(self, name: str) -> None:
        """Change the colours."""
        look = themes.BY_NAME[name]
        self.ansi_theme_dark = self.ansi_theme_light = look.terminal()
        self.theme = name

    # --- what is told -----------------------------------------------------------------------------------------

    def tell(self, error: SwiftbotError) -> None:
        """Show an error with its remedy."""
        remedy = f"\n→ {safe(error.remedy)}" if error.remedy else ""
        self.notify(f"{safe(error.message)}{remedy}", title="Error", severity="error", timeout=10, markup=False)

    def read(self, title: str, content: RenderableType) -> None:
        """Show something to be read at leisure."""
        self.push_screen(TextDialog(title, content))

    def export_svg(self, path: Path) -> None:
        """Write a picture of the screen as it is now, without references to fonts on other machines."""
        path.write_text(_FONT.sub("", self.export_screenshot(title=f"SwiftBot · {self.view.fleet}")))
